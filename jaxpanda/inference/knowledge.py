r"""How well the numbers in the user's model are known, as columns with a prior: what is no physics to report.

The nuisance is $\tau_0 = N\,x$ with $x \sim N(0, 1)$. Its columns are scaled by the uncertainty, so that
"exact" leaves none and "unknown" leaves everything free.

- `exact`: the inertial parameters and known friction are those of the arm.
- `identified`: they were identified from a motion much like those recorded: a covariance
  $\sigma^2 (W^\top W)^{-1}$ of an identification motion, far below the noise in torque, whatever the parameters.
- `rough`: masses to 4 %, centres of mass to 3 mm, inertias to 10 %, friction to 20 %.
- `unknown`: flat.
"""

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float

from ..arms.arm import Arm
from ..errors import InputError
from ..parameters import random_regressor, triangle
from ..traces import Trace
from .bodies import Correction
from .discrepancy import of_known

Knowledge = Literal["exact", "identified", "rough", "unknown"]

_SAMPLES = 1500
"""Samples, taken as independent, of the identification that "identified" supposes."""
_FRICTION = {"exact": 0.0, "identified": 0.02, "rough": 0.2, "unknown": 10.0}
_UNKNOWN = 1e3
"""Deviation, in those of an identification, that passes for unknown."""


def check(knowledge: str) -> None:
    """Refuse a word that is none."""
    if knowledge not in get_args(Knowledge):
        raise InputError(f"unknown knowledge {knowledge!r}; there are {', '.join(get_args(Knowledge))}")


def inertial_spread(
    arm: Arm, knowledge: Knowledge, noise: Float[np.ndarray, " dof"]
) -> Float[np.ndarray, "standard n"]:
    """Square root L of the covariance $LL^\\top$ of the standard parameters; of an arm without links, none."""
    if knowledge == "exact" or not np.any(arm.standard):
        return np.zeros((10 * arm.dof, 0))
    if knowledge == "rough":
        return _rough(arm)
    W = np.asarray(random_regressor(arm, _SAMPLES)).reshape(_SAMPLES, arm.dof, -1) / noise[:, None]
    _, s, Vt = np.linalg.svd(triangle(W.reshape(-1, 10 * arm.dof)))
    felt = s > 1e-8 * s[0]
    return Vt[felt].T / s[felt] * (1.0 if knowledge == "identified" else _UNKNOWN)


def _rough(arm: Arm) -> Float[np.ndarray, "standard n"]:
    standard = np.asarray(arm.standard)
    columns = []
    for link, phi in enumerate(standard):
        mass = max(abs(phi[0]), 0.1)
        block = np.zeros((10, 10))
        block[:, 0] = 0.04 * phi
        block[1:4, 1:4] = 0.003 * mass * np.eye(3)
        block[4:, 4:] = 0.1 * max(np.abs(phi[[4, 6, 9]]).max(), 1e-4) * np.eye(6)
        wide = np.zeros((standard.size, 10))
        wide[10 * link : 10 * link + 10] = block
        columns.append(wide)
    return np.concatenate(columns, 1)


def nuisance(
    traces: Sequence[Trace],
    spread: Float[np.ndarray, "standard n"],
    knowledge: Knowledge,
    std: Float[np.ndarray, " dof"],
    scale: float = 1.0,
) -> tuple[list[Float[np.ndarray, "_time dof _n"]], int, dict[int, Correction]]:
    """The columns N of each recording, how many of them are numbers of the model, and which of these are not to
    be negative; the others are what its friction may be off and what was recorded otherwise than it was, which
    no knowledge takes away. `std`: of the noise [N m]; `scale` multiplies the uncertainty of friction and rotors
    where it is "rough"."""
    arm = traces[0].motion.arm
    damping, level, armature = spreads = friction_spread(arm, knowledge, scale)
    held = [
        Correction((name, int(j)), float(np.asarray(getattr(arm, name))[j]), float(spread[j]))
        for name, spread in zip(("damping", "frictionloss", "armature"), spreads, strict=True)
        for j in np.flatnonzero(spread > 0)
    ]
    out, numbers = [], 0
    for trace, off in zip(traces, of_known(traces, std), strict=True):
        parts = [trace.motion.regressor @ spread]
        joints = np.eye(arm.dof)
        for j in np.flatnonzero(damping > 0):
            parts.append((damping[j] * trace.motion.qd)[:, :, None] * joints[:, j : j + 1])
        sign = trace.down(trace.sign)
        for j in np.flatnonzero(level > 0):
            parts.append((level[j] * sign)[:, :, None] * joints[:, j : j + 1])
        for j in np.flatnonzero(armature > 0):
            parts.append((armature[j] * trace.motion.qdd)[:, :, None] * joints[:, j : j + 1])
        numbers = sum(p.shape[2] for p in parts)
        out.append(np.concatenate([*parts, off, trace.shaken], 2))
    return out, numbers, dict(enumerate(held, spread.shape[1]))


def friction_spread(
    arm: Arm, knowledge: Knowledge, scale: float = 1.0
) -> tuple[Float[np.ndarray, " dof"], Float[np.ndarray, " dof"], Float[np.ndarray, " dof"]]:
    """Deviations of damping, frictionloss and armature."""
    share = _FRICTION[knowledge] * (scale if knowledge == "rough" else 1.0)
    rotors = share if knowledge in ("rough", "unknown") else 0.0
    numbers = np.asarray(arm.damping), np.asarray(arm.frictionloss), np.asarray(arm.armature)
    return share * numbers[0], share * numbers[1], rotors * numbers[2]


def changes(
    arm: Arm,
    x: Float[np.ndarray, " columns"],
    spread: Float[np.ndarray, "standard n"],
    knowledge: Knowledge,
    scale: float = 1.0,
) -> tuple[
    Float[np.ndarray, "dof 10"],
    Float[np.ndarray, " dof"],
    Float[np.ndarray, " dof"],
    Float[np.ndarray, " dof"],
]:
    """What coefficients x of `nuisance` change: standard parameters, damping, frictionloss and armature."""
    inertial = spread.shape[1]
    standard = (spread @ x[:inertial]).reshape(arm.dof, 10)
    friction = []
    done = inertial
    for deviation in friction_spread(arm, knowledge, scale):
        change, here = np.zeros(arm.dof), np.flatnonzero(deviation > 0)
        change[here] = deviation[here] * x[done : done + len(here)]
        done += len(here)
        friction.append(change)
    return standard, *friction
