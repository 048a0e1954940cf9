"""What a log's columns are, where they are not as `docs/files.md` has them: sign, unit, order, gravity.

A user says it, by the options of the commands that read recordings; `jaxpanda.meaning` tells what to say. This
module is read by `jaxpanda --help`, and imports JAX and numpy only when something is to be done.
"""

import dataclasses
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from .arms.model_file import Model
from .errors import InputError

if TYPE_CHECKING:
    from .arms.arm import Arm
    from .recordings import Recording

UNITS = {
    "Nm": 1.0,
    "Nmm": 1e-3,
    "mNm": 1e-3,
    "Ncm": 1e-2,
    "kNm": 1e3,
    "kgfm": 9.80665,
    "kgfcm": 0.0980665,
    "lbfft": 1.3558179483314004,
    "lbfin": 0.1129848290276167,
    "ozfin": 0.007061551814226044,
}
"""Units that torque is written in [N m]."""
REMOVED = "removed"
"""The word of `gravity` for a torque column without gravity."""
_SIGNS = {"+": 1.0, "1": 1.0, "+1": 1.0, "-": -1.0, "-1": -1.0}


@dataclasses.dataclass(frozen=True)
class Convention:
    """What the columns of a log are, joint by joint; all empty for the columns of `docs/files.md`."""

    torque_sign: tuple[str, ...] = ()
    """+ or - for each joint, or one for all: - where tau is positive against the joint's axis."""
    torque_unit: tuple[str, ...] = ()
    """Unit of tau, for each joint or one for all: Nm, Nmm, Ncm, kNm, kgfcm, lbfin …, or a number of N·m that one
    unit of the column is worth, as a motor's N·m/A times its gear ratio."""
    joint_order: tuple[str, ...] = ()
    """The joint of each column, from 1: `1 3 2 4` where q_2, dq_2, tau_2 are joint 3's; `tau 1 3 2 4` where tau
    alone is out of order."""
    gravity: tuple[str, ...] = ()
    """Gravity in the frame of the model's world [m/s²], in place of the model's: `0 0 9.81` for an arm on a
    ceiling. Or `removed`: tau holds no gravity, and the model's is added to it."""

    @property
    def removed(self) -> bool:
        """Whether gravity is to be added to the torque."""
        return self.gravity == (REMOVED,)

    @property
    def mounting(self) -> tuple[float, float, float] | None:
        """Gravity in place of the model's [m/s²]."""
        if not self.gravity or self.removed:
            return None
        try:
            x, y, z = map(float, self.gravity)
        except ValueError:
            raise InputError(
                f"--gravity {' '.join(self.gravity)}: three numbers x y z in m/s² are expected, or the word"
                f" {REMOVED}"
            ) from None
        if not all(abs(v) < 100 for v in (x, y, z)):
            raise InputError(f"--gravity {' '.join(self.gravity)}: is no acceleration in m/s²")
        return x, y, z

    def factors(self, dof: int) -> list[float]:
        """What tau of each joint is multiplied by to be in N m, positive along the axis."""
        signs = [_sign(word) for word in _each("--torque-sign", self.torque_sign, dof, "+")]
        units = [_unit(word) for word in _each("--torque-unit", self.torque_unit, dof, "Nm")]
        return [sign * unit for sign, unit in zip(signs, units, strict=True)]

    def order(self, dof: int) -> tuple[list[int], bool]:
        """The joint, 0-based, of each column, and whether tau alone is out of order."""
        alone = self.joint_order[:1] == ("tau",)
        words = self.joint_order[alone:]
        if not words and not alone:
            return list(range(dof)), False
        if sorted(words) != sorted(str(j + 1) for j in range(dof)):
            raise InputError(
                f"--joint-order {' '.join(self.joint_order)}: each joint from 1 to {dof} is expected once, the"
                " joint of each column; the word tau before them where tau alone is out of order"
            )
        return [int(word) - 1 for word in words], alone

    def applied(self, recordings: Sequence["Recording"], model: Model | None = None) -> list["Recording"]:
        """The recordings as they are meant, with a note of what was done.

        Args:
            recordings: as read.
            model: whose gravity is added where that was removed; None for the project's own Panda.

        Raises:
            InputError: an option that does not fit the recordings.
        """
        if self == PLAIN:
            return list(recordings)
        from .arms.arm import Arm

        arm = None
        if self.removed:
            arm = Arm.panda() if model is None else Arm.from_mjcf(model)
        return [self._one(recording, arm) for recording in recordings]

    def _one(self, recording: "Recording", arm: "Arm | None") -> "Recording":
        dof, notes = recording.dof, []
        order, alone = self.order(dof)
        factors = self.factors(dof)
        q, qd, tau, motor = recording.q, recording.qd, recording.tau, recording.tau_motor
        place = [order.index(j) for j in range(dof)]
        if self.joint_order:
            tau = None if tau is None else tau[:, place]
            if not alone:
                q, qd = q[:, place], None if qd is None else qd[:, place]
                motor = None if motor is None else motor[:, place]
            what = "tau" if alone else "all columns"
            notes.append(f"{what} read as those of joints {' '.join(str(j + 1) for j in order)}")
        if tau is not None and (self.torque_sign or self.torque_unit):
            tau = tau * factors
            notes.append(f"tau multiplied by {' '.join(f'{k:g}' for k in factors)}")
        if tau is not None and arm is not None:
            recording.require_dof(arm.dof)
            tau = tau + weight_torque(arm, q)
            notes.append("the model's gravity torque was added to tau, so that it tells nothing of weights")
        notes = (*recording.notes, *(f"as asked, {note}" for note in notes))
        return dataclasses.replace(recording, q=q, qd=qd, tau=tau, tau_motor=motor, notes=notes)


PLAIN = Convention()
"""The columns of `docs/files.md`."""


def _each(option: str, words: Sequence[str], dof: int, usual: str) -> Sequence[str]:
    """A word a joint."""
    if len(words) not in (0, 1, dof):
        raise InputError(
            f"{option}: {len(words)} values, where one, or one for each of {dof} joints, is expected"
        )
    return [*(words or (usual,))] * (1 if len(words) == dof else dof)


def _sign(word: str) -> float:
    if word not in _SIGNS:
        raise InputError(f"--torque-sign {word}: + or - is expected for each joint, or one for all")
    return _SIGNS[word]


def _unit(word: str) -> float:
    """One unit [N m]."""
    name = re.sub(r"[·.* ]", "", word)
    if name in UNITS:
        return UNITS[name]
    try:
        value = float(word)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise InputError(
            f"--torque-unit {word}: one of {', '.join(UNITS)} is expected, or the N·m that one unit of the"
            " column is worth"
        )
    return value


def weight_torque(arm: "Arm", q):
    """Gravity torque of the model [N m]."""
    import jax
    import numpy as np
    from jaxpanda_kernels import gravity_torque

    return np.asarray(jax.jit(jax.vmap(gravity_torque, in_axes=(None, None, 0)))(arm.chain, arm.standard, q))
