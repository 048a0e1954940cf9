"""Free-form hypotheses for each joint: they compete with the catalogue, so that it is not believed blindly."""

import itertools
from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from ..effects import AbstractJointEffect, Motion
from ..effects.unknown import (
    FORMS,
    Unknown,
    UnknownDrag,
    UnknownLimit,
    UnknownOfSpeeds,
    UnknownOfTwo,
    UnknownSpin,
)
from .host import parallel
from .library import Candidates, columns_of
from .traces import Trace

_KNOTS = {"odd in dq": 8, "even in dq": 8, "of q": 10, "friction of q": 9}
_FEW = 6
_MOVES = 0.02
"""Travel from which a joint's position may count beside another's [rad]."""
_SLOW = 1e-3
"""What a product of two joints' velocities [rad²/s²], and the last link's [m/s], must exceed to tell anything."""
_OF_FASTEST, _REACHES = (0.15, 0.4, 0.7, 1.0), (0.0, 0.1, 0.2)
"""Knots of a drag, in the largest speed of the last link, and where beyond its frame it may act [m]."""

Free = Unknown | UnknownOfTwo | UnknownOfSpeeds | UnknownDrag | UnknownSpin | UnknownLimit

_LIMITS = np.geomspace(0.1, 0.98, 16)
"""Of a torque sensor, in the largest torque of its joint."""
_KINDS = {
    "odd in dq": lambda m, j: np.abs(m.qd[:, j]),
    "even in dq": lambda m, j: np.abs(m.qd[:, j]),
    "of q": lambda m, j: m.q[:, j],
    "of load": lambda m, j: m.load[:, j],
    "friction of q": lambda m, j: m.q[:, j],
    "friction of load": lambda m, j: np.abs(m.load[:, j]),
    "of ddq": lambda m, j: m.qdd[:, j],
    "of q_k": lambda m, j: m.q[:, j],
    "odd in dq_k": lambda m, j: np.abs(m.qd[:, j]),
}


def build(traces: Sequence[Trace]) -> list[Candidates]:
    """Every free form at every joint, with knots where the recordings have been."""
    dof = traces[0].motion.dof
    alike: dict[tuple, list[Free]] = defaultdict(list)
    for form in FORMS:
        for j in range(dof):
            for k in range(dof) if form.endswith("_k") else (j,):
                knots = _knots(form, np.concatenate([_KINDS[form](t.motion, k) for t in traces]))
                if (k != j or not form.endswith("_k")) and len(knots) > 2:
                    alike[form, len(knots)].append(Unknown(j, k, tuple(knots.tolist()), form))

    low, high = np.quantile(np.concatenate([t.motion.q for t in traces]), (0.005, 0.995), axis=0)
    for j, k in itertools.permutations(np.flatnonzero(high - low > _MOVES).tolist(), 2):
        ends = tuple((float(x[j]), float(x[k])) for x in (low, high))
        alike["of q, q_k", 0].append(UnknownOfTwo(j, k, *ends))
    qd = np.concatenate([t.motion.qd for t in traces])
    for i, k in itertools.combinations_with_replacement(range(dof), 2):
        largest = float(np.max(np.abs(qd[:, i] * qd[:, k])))
        if largest > _SLOW:
            alike["of dq_i * dq_k", 0] += [UnknownOfSpeeds(j, i, k, largest) for j in range(dof)]

    largest = np.max([np.abs(t.motion.torque_shown).max(0) for t in traces], 0)
    for j in np.flatnonzero(largest > 0):
        alike["limit", 0] += [UnknownLimit(int(j), float(share * largest[j])) for share in _LIMITS]

    speeds = np.concatenate([_speed_of_last_link(t.motion) for t in traces])
    knots = np.max(speeds) * np.array(_OF_FASTEST)
    of_drives = any(t.motion.transmitted is not None for t in traces)  # which feel links by their load alone
    if knots[0] > _SLOW and not of_drives:
        alike["spin", 0].append(UnknownSpin(dof))
        slides = bool(traces[0].motion.arm.chain.prismatic[-1])
        alike["drag", 0] += [UnknownDrag(dof, reach, tuple(knots.tolist()), slides) for reach in _REACHES]

    def evaluated(same: list[Free]) -> list[Candidates]:
        columns = [columns_of(same, trace) for trace in traces]
        local = isinstance(same[0], AbstractJointEffect)
        return [
            Candidates(
                (effect,), effect.joints[0] if local else None, tuple(c[..., i : i + 1, :] for c in columns)
            )
            for i, effect in enumerate(same)
        ]

    return [one for group in parallel(evaluated, alike.values()) for one in group]


def _speed_of_last_link(motion: Motion) -> np.ndarray:
    """[m/s]"""
    return np.linalg.norm(np.einsum("tja,tj->ta", motion.wrench_columns[:, -1, :, :3], motion.qd), axis=1)


def _knots(form: str, x: np.ndarray) -> np.ndarray:
    """Half by the range, half by where the samples are."""
    count = _KNOTS.get(form, _FEW)
    share = np.linspace(0, 1, count)
    low, high = np.quantile(x, (0.005, 0.995))
    if high - low < 1e-6:
        return np.zeros(0)
    return 0.5 * (low + share * (high - low)) + 0.5 * np.quantile(x, 0.005 + 0.99 * share)
