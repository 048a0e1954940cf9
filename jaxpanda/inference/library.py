"""Every shape of every effect as columns on the coarse grid of each recording."""

import dataclasses
import functools
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from jaxtyping import Float

from ..effects import AbstractEffect, joint_columns, turns
from ..host import parallel
from ..traces import Trace

_BATCH = 4
"""Shapes that one compiled call takes: what a refinement tries at once. A grid takes several calls, for which
nothing more has to be traced."""


@dataclasses.dataclass(frozen=True)
class Candidates:
    """Shapes of one form of an effect at one joint (or in the whole arm), with their columns.

    `columns` holds for each recording `(time, m, n)` where the effect acts in one joint, else
    `(time, dof, m, n)`.
    """

    effects: tuple[AbstractEffect, ...]
    columns: tuple[np.ndarray, ...]

    @functools.cached_property
    def joint(self) -> int | None:
        """The one that they act in; None for the whole arm."""
        return self.effects[0].joints[0] if self.effects[0].one_joint else None

    @property
    def name(self) -> str:
        return self.effects[0].name

    @functools.cached_property
    def form_priors(self) -> Float[np.ndarray, " m"]:
        """Odds of each shape's form, as logarithms."""
        return np.array([e.form_prior for e in self.effects])


def columns_of(effects: Sequence[AbstractEffect], trace: Trace) -> Float[np.ndarray, "_time ..."]:
    """Columns of shapes of one class and form: `(time, m, n)` in one joint, `(time, dof, m, n)` in the arm."""
    if effects[0].one_joint:
        parts = []
        for start in range(0, len(effects), _BATCH):
            batch = list(effects[start : start + _BATCH])
            filled = batch + [batch[-1]] * (_BATCH - len(batch))
            fine = joint_columns(filled, trace.stretches, trace.dt)  # pyright: ignore
            parts.append(trace.down(fine)[:, : len(batch)])
        return np.concatenate(parts, 1)
    return type(effects[0]).over_many(effects, trace.motion)  # pyright: ignore


def turning(traces: Sequence[Trace], joint: int) -> Float[np.ndarray, "rows n"]:
    """Signs of a joint's velocity that turn over several speeds and distances, low-passed like the torque."""
    kinds = sorted({type(e) for e in turns(joint)}, key=lambda kind: kind.__name__)
    alike = [[e for e in turns(joint) if type(e) is kind] for kind in kinds]
    return np.concatenate(
        [np.concatenate([columns_of(same, t)[:, :, 0] for same in alike], 1) for t in traces]
    )


def form_of(effect: AbstractEffect) -> tuple[str, str]:
    """What must agree for shapes to be evaluated together."""
    return type(effect).__name__, str(getattr(effect, "form", ""))


def build(
    traces: Sequence[Trace], catalogue: Sequence[type[AbstractEffect]], began: float
) -> list[Candidates]:
    """The catalogue's grids on these recordings, with time counted from when they `began` [s]."""
    arm = traces[0].motion.arm
    longest = max(float(np.ptp(t.motion.time)) for t in traces)
    groups: dict[tuple, list[AbstractEffect]] = defaultdict(list)
    for effect_class in catalogue:
        for effect in effect_class.grid(arm):
            if effect.period < 2 * longest:
                groups[form_of(effect)].append(effect.counted_from(began))
    for trace in traces:  # made once, before there are threads
        trace.motion.load, trace.motion.regressor, trace.motion.mass, trace.motion.slope  # noqa: B018
    return _evaluated(traces, groups.values(), _by_joint)


def from_motions(traces: Sequence[Trace], catalogue: Sequence[type[AbstractEffect]]) -> list[Candidates]:
    """Shapes that depend on where the recordings have been, each by itself."""
    groups: dict[tuple, list[AbstractEffect]] = defaultdict(list)
    for effect_class in catalogue:
        for effect in effect_class.from_motions([t.motion for t in traces]):
            groups[form_of(effect), len(effect.coefficients)].append(effect)
    return _evaluated(traces, groups.values(), lambda effects: [[i] for i in range(len(effects))])


def _evaluated(
    traces: Sequence[Trace],
    groups: Iterable[Sequence[AbstractEffect]],
    split: Callable[[Sequence[AbstractEffect]], Iterable[list[int]]],
) -> list[Candidates]:
    """Groups of shapes of one form with their columns, each split into candidates."""

    def one(effects: Sequence[AbstractEffect]) -> list[Candidates]:
        columns = [columns_of(effects, trace) for trace in traces]
        return [
            Candidates(tuple(effects[i] for i in at), tuple(c[..., at, :] for c in columns))
            for at in split(effects)
        ]

    return [candidates for group in parallel(one, groups) for candidates in group]


def _by_joint(effects: Sequence[AbstractEffect]) -> Iterable[list[int]]:
    places: dict[tuple, list[int]] = defaultdict(list)
    for i, effect in enumerate(effects):
        places[effect.joints].append(i)
    return places.values()
