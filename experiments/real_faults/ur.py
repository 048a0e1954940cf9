"""What two logs of Universal Robots' controllers share: torque out of current."""

import numpy as np
from recording import BadFile

SIZES = ((0, 1, 2), (3, 4, 5))
"""Joints with the same drive."""
SCATTER = 0.03
"""By how much the torque a current may differ at rest, as a share, before the log is refused."""


def torque_constants(path, target_qd, target_current, target_torque) -> np.ndarray:
    """(6,) [N m/A] at the joint: the controller's own target torque over its target current, at rest.

    In motion its target current holds more than that torque. Drives of one size share their number, since some
    joints carry nothing.
    """
    still = np.all(target_qd == 0, axis=1)
    constants = np.zeros(6)
    for joints in SIZES:
        current, torque = target_current[still][:, joints].ravel(), target_torque[still][:, joints].ravel()
        if not np.any(np.abs(current) > 0.05):
            raise BadFile(
                f"{path}: at rest no load of joints {_text(joints)} tells how much torque a current is"
            )
        slope = current @ torque / (current @ current)
        off = np.linalg.norm(torque - slope * current) / np.linalg.norm(torque)
        if off > SCATTER or slope <= 0:
            raise BadFile(
                f"{path}: at rest target torque is not target current times a number ({off:.0%} off)"
            )
        constants[list(joints)] = slope
    return constants


def _text(joints) -> str:
    return f"{joints[0] + 1} to {joints[-1] + 1}"
