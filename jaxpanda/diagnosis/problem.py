"""What a diagnosis works on, and the model it has arrived at so far."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from .. import signals as signals_
from ..effects import AbstractEffect, AbstractJointEffect
from . import catchall
from .evidence import Design, Noise, gram
from .library import Candidates, build, columns_of
from .noise import estimate, saturated_residual, strongest_order
from .traces import Trace

FOLDS = 5
"""Blocks of the cross-validation."""


@dataclasses.dataclass(frozen=True)
class Term:
    """An effect taken into the model: its columns in each recording, and the prior of its coefficients."""

    effect: AbstractEffect
    columns: tuple[Float[np.ndarray, "_time dof _n"], ...]
    deviation: Float[np.ndarray, " n"]

    @property
    def key(self) -> tuple[str, tuple[int, ...]]:
        """Name and joints: what makes two terms the same finding."""
        return self.effect.name, self.effect.joints


@dataclasses.dataclass(frozen=True)
class Problem:
    """Recordings, what the nominal model leaves of them, and what is no physics to report."""

    traces: tuple[Trace, ...]
    active: tuple[bool, ...]
    """Whether effects may act in a recording; not in those of reference."""
    nuisance: tuple[Float[np.ndarray, "_time dof _n"], ...]

    @property
    def dof(self) -> int:
        return self.traces[0].motion.dof

    @functools.cached_property
    def residual(self) -> list[Float[np.ndarray, "_time dof"]]:
        """Measured less nominal torque [N m]."""
        return [trace.residual for trace in self.traces]

    @functools.cached_property
    def library(self) -> list[Candidates]:
        """The catalogue on these recordings; zero in those of reference."""
        out = []
        for c in build(self.traces):
            columns = tuple(
                x if on else np.zeros_like(x) for x, on in zip(c.columns, self.active, strict=True)
            )
            out.append(dataclasses.replace(c, columns=columns))
        return out

    @functools.cached_property
    def catchalls(self) -> list[Candidates]:
        """Free forms on these recordings; zero in those of reference."""
        out = []
        for c in catchall.build(self.traces):
            columns = tuple(
                x if on else np.zeros_like(x) for x, on in zip(c.columns, self.active, strict=True)
            )
            out.append(dataclasses.replace(c, columns=columns))
        return out

    def term(self, effect: AbstractEffect, deviation: Float[np.ndarray, " n"]) -> Term:
        """The effect's columns in all recordings."""
        return Term(effect, tuple(self.full_columns([effect])), deviation)

    def full_columns(self, effects: Sequence[AbstractEffect]) -> list[Float[np.ndarray, "_time dof _n"]]:
        """Columns of one effect, at all joints."""
        out = []
        for r, trace in enumerate(self.traces):
            wide = np.zeros((trace.motion.samples, self.dof, len(effects[0].coefficients)))
            here = self.placed(effects, r)
            if here and isinstance(here[0], AbstractJointEffect):
                wide[:, here[0].joints[0]] = columns_of(here, trace)[:, 0]
            elif here:
                wide = columns_of(here, trace)[:, :, 0]
            out.append(wide)
        return out

    def placed(self, effects: Sequence[AbstractEffect], r: int) -> list[AbstractEffect]:
        """What of shapes of one form acts in a recording; empty if nothing does."""
        if not self.active[r]:
            return []
        names = [t.name for t in self.traces]
        bound = getattr(effects[0], "recording", None)
        later = None if bound is None else r > names.index(bound)
        return [p for e in effects if (p := e.placed(names[r], later)) is not None]

    def whitened(self, columns: Sequence[np.ndarray], noise: Noise, joint: int) -> np.ndarray:
        """Rows of a joint in all recordings, one below the other, with unit noise."""
        parts = []
        for trace, x in zip(self.traces, columns, strict=True):
            w = trace.weight.reshape(-1, *[1] * (x.ndim - 1))
            parts.append(noise.whiten(x, joint) * w)
        return np.concatenate(parts)

    @functools.cached_property
    def _cache(self) -> dict:
        return {}

    def prepared(self, key: tuple, make: Any, noise: Noise, joint: int) -> tuple[np.ndarray, np.ndarray]:
        """Whitened columns `(rows, m, n)` in a joint and their Gram matrices, kept while the joint's noise stays.

        Args:
            key: names the columns.
            make: gives them for each recording, `(time, m, n)`.
            noise: to whiten by.
            joint: where.
        """
        stamp = noise.a[joint].tobytes(), float(noise.sigma[joint])
        kept = self._cache.get((key, joint))
        if kept is None or kept[0] != stamp:
            Phi = self.whitened(make(), noise, joint)
            kept = self._cache[key, joint] = (stamp, Phi, gram(Phi))
        return kept[1], kept[2]

    def design(self, terms: Sequence[Term], noise: Noise) -> Design:
        """The model with these terms, whitened."""
        columns = [
            np.concatenate([n, *(t.columns[r] for t in terms)], 2) for r, n in enumerate(self.nuisance)
        ]
        precision = np.concatenate([np.ones(self.nuisance[0].shape[2]), *(t.deviation**-2.0 for t in terms)])
        return Design(
            [self.whitened([c[:, j] for c in columns], noise, j) for j in range(self.dof)],
            [self.whitened([r[:, j] for r in self.residual], noise, j) for j in range(self.dof)],
            precision,
        )

    @functools.cached_property
    def folds(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Rows to train and to test on, blocked so that no test repeats training data."""
        splits = signals_.blocks_many([t.signals for t in self.traces], FOLDS)
        return [
            (np.concatenate([s[0] for s in fold]), np.concatenate([s[1] for s in fold])) for fold in splits
        ]

    def held_out_error(self, design: Design) -> float:
        """Squared whitened error on blocks that the coefficients were not fitted to."""
        error = 0.0
        for train, test in self.folds:
            columns = [A[train] for A in design.columns]
            x = Design(columns, [r[train] for r in design.residual], design.precision).x
            for A, r in zip(design.columns, design.residual, strict=True):
                error += float(np.sum((r[test] - A[test] @ x) ** 2))
        return error

    @functools.cached_property
    def ripples(self) -> list[list[Float[np.ndarray, "_time _n"]]]:
        """For each joint the order that the saturated model leaves most of, as columns in each recording.

        They join the saturated model: a ripple would otherwise pass for noise of its own frequency.
        """
        out = []
        for j in range(self.dof):
            left, _ = saturated_residual(self.traces, self.residual, j, [])
            out.append(strongest_order([t.motion.q[:, j] for t in self.traces], left))
        return out

    def noise(self, terms: Sequence[Term]) -> Noise:
        """Noise that a saturated model with these terms leaves."""
        extra = []
        for j in range(self.dof):
            here = [t for t in terms if any(np.any(c[:, j]) for c in t.columns)]
            extra.append(
                [
                    np.concatenate([self.ripples[j][r], *(t.columns[r][:, j] for t in here)], 1)
                    for r in range(len(self.traces))
                ]
            )
        return estimate(self.traces, self.residual, extra)
