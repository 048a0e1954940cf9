r"""How friction that the model holds turns with velocity in the recordings, for predictions.

MuJoCo's constraint holds a joint at rest almost without creep; the bristles of a gear yield by some mrad.
A diagnosis need not ask, as samples near rest count for little, but a prediction has to say something of
them: by the one whose torque is nearer to the recordings'. What bristles do depends on where the joint came from,
which few recordings tell, so for them it is $\tanh(\dot q/v)$, about their mean over many motions.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..corrected import Corrected
from ..recordings import Recording
from .traces import prepare

GEAR = 0.01
"""Velocity over which the friction of a gear turns [rad/s]."""


def turning_as(
    recordings: Sequence[Recording], corrected: Corrected, noise: Float[np.ndarray, " dof"]
) -> Corrected:
    """The same with its Coulomb friction turning as in the recordings."""
    if not np.any(np.asarray(corrected.arm.frictionloss + corrected.frictionloss_change)):
        return corrected
    laws = [dataclasses.replace(corrected, turning=turning) for turning in (None, GEAR)]
    squares = [np.zeros(corrected.arm.dof) for _ in laws]
    for recording in recordings:
        for law, total in zip(laws, squares, strict=True):
            trace = prepare(recording, law.arm, whole=True, noise=noise, turning=law.turning)
            assert trace.tau is not None
            left = trace.tau - law.measured_torque(trace.motion, trace.channels, trace.sign)
            total += np.sum(left**2 * (trace.weight > 0)[:, None], 0)
    constraint, gear = squares
    return laws[int(np.sum(np.log(gear / constraint)) < 0)]
