"""Friction that recordings show, where the model's numbers may be placeholders.

A sensor's gain, delay and limit act on all of a joint's torque, and so are linearised about the best that is
known of it. Damping that is ten times too large would be torque to scale and to delay that never was there.
"""

from collections.abc import Sequence

import numpy as np
import scipy.linalg
import scipy.optimize
from jaxtyping import Float

from ..parameters import triangle
from ..traces import Trace

_TRUST = 1e-4
"""Weight of the model's own numbers, as a share of what the recordings say: it decides where they say nothing."""


def friction_shown(traces: Sequence[Trace]) -> Float[np.ndarray, "2 dof"]:
    r"""Viscous [N m s/rad] and Coulomb friction [N m] of each joint beyond the model's, neither with it below 0.

    Least squares of measured torque less the rigid arm's on velocity, its sign, the arm's torque and a constant,
    and on how fast that changes, which shows a delay that is the same for all joints:
    $\tau_j - \tau_{r,j} = d_j\,\dot q_j + f_j\,\mathrm{sign}(\dot q_j) + a_j\,\tau_{r,j} + b_j
    - \delta\,\dot\tau_{r,j}$. Without it weight that is felt late is viscous friction.
    """
    arm = traces[0].motion.arm
    out, parts = np.zeros((2, arm.dof)), {}
    lowest = np.array([0.0, 0.0, -np.inf, -np.inf])
    signs = [t.down(t.sign) for t in traces]
    rates = [np.gradient(t.motion.load, t.motion.dt, axis=0) for t in traces]
    usual = np.zeros((4, arm.dof))
    usual[:2] = np.asarray(arm.damping), np.asarray(arm.frictionloss)
    for j in range(arm.dof):
        weight = np.concatenate([t.weights[:, j] for t in traces])
        if not weight.any():
            continue
        load = np.concatenate([t.motion.load[:, j] for t in traces])
        qd = np.concatenate([t.motion.qd[:, j] for t in traces])
        sign, rate = (np.concatenate([x[:, j] for x in each]) for each in (signs, rates))
        left = np.concatenate([np.asarray(t.tau)[:, j] for t in traces]) - load
        A = weight[:, None] * np.stack([qd, sign, load, np.ones_like(load)], 1)
        size = np.maximum(np.linalg.norm(A, axis=0), 1e-12)
        known = np.sqrt(_TRUST) * np.concatenate(
            [np.eye(4), np.stack([np.zeros(4), usual[:, j] * size], 1)], 1
        )
        rows = np.concatenate([A / size, (weight * np.stack([-rate, left])).T], 1)
        R = triangle(np.concatenate([rows, known]))
        alone = scipy.optimize.lsq_linear(R[:, :4], R[:, 5], (lowest, np.inf), method="bvls")
        deviation = np.sqrt(2 * alone.cost / np.count_nonzero(weight))
        parts[j] = R / max(deviation, 1e-12), size
    if not parts:
        return out
    own = scipy.linalg.block_diag(*(R[:, :4] for R, _ in parts.values()))
    late, y = (np.concatenate([R[:, k] for R, _ in parts.values()]) for k in (4, 5))
    least = np.append(np.tile(lowest, len(parts)), -np.inf)
    length = max(float(np.linalg.norm(late)), 1e-12)
    A = np.concatenate([np.asarray(own), late[:, None] / length], 1)
    x = scipy.optimize.lsq_linear(A, y, (least, np.inf), method="bvls").x[:-1]
    for (j, (_, size)), found in zip(parts.items(), x.reshape(-1, 4), strict=True):
        out[:, j] = (found / size)[:2] - usual[:2, j]
    return out
