"""Friction that recordings show, where the model's numbers may be placeholders.

A sensor's gain, delay and limit act on all of a joint's torque, and so are linearised about the best that is
known of it. Damping that is ten times too large would be torque to scale and to delay that never was there.
"""

from collections.abc import Sequence

import numpy as np
import scipy.optimize
from jaxtyping import Float

from ..traces import Trace

_TRUST = 1e-4
"""Weight of the model's own numbers, as a share of what the recordings say: it decides where they say nothing."""


def friction_shown(traces: Sequence[Trace]) -> Float[np.ndarray, "2 dof"]:
    r"""Viscous [N m s/rad] and Coulomb friction [N m] of each joint beyond the model's, neither with it below 0.

    Least squares of measured torque less the rigid arm's on velocity, its sign, the arm's torque and a constant:
    $\tau_j - \tau_{r,j} = d\,\dot q_j + f\,\mathrm{sign}(\dot q_j) + a\,\tau_{r,j} + b$.
    """
    arm = traces[0].motion.arm
    out = np.zeros((2, arm.dof))
    lowest = np.array([0.0, 0.0, -np.inf, -np.inf])
    signs = [t.down(t.sign) for t in traces]
    for j in range(arm.dof):
        weight = np.concatenate([t.weights[:, j] for t in traces])
        if not weight.any():
            continue
        load = np.concatenate([t.motion.load[:, j] for t in traces])
        qd = np.concatenate([t.motion.qd[:, j] for t in traces])
        sign = np.concatenate([s[:, j] for s in signs])
        left = np.concatenate([np.asarray(t.tau)[:, j] for t in traces]) - load
        usual = np.array([float(arm.damping[j]), float(arm.frictionloss[j]), 0.0, 0.0])
        A = weight[:, None] * np.stack([qd, sign, load, np.ones_like(load)], 1)
        size = np.maximum(np.linalg.norm(A, axis=0), 1e-12)
        A = np.concatenate([A / size, np.sqrt(_TRUST) * np.eye(4)])
        y = np.concatenate([weight * left, np.sqrt(_TRUST) * usual * size])
        found = scipy.optimize.lsq_linear(A, y, (lowest, np.inf), method="bvls").x / size
        out[:, j] = found[:2] - usual[:2]
    return out
