"""Columns of every shape of every effect that is tried on some recordings, made once."""

import dataclasses
import functools
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..effects import AbstractEffect, Sweep
from ..traces import Trace
from .library import Candidates, build, columns_of, from_motions

_MEMORY = 1 << 28
"""Bytes of columns of shapes off the grid that are kept."""


@dataclasses.dataclass(frozen=True)
class Grid:
    """Shapes of effects, and their columns: the same for all problems that some recordings are posed as."""

    traces: tuple[Trace, ...]
    active: tuple[bool, ...]
    catalogue: tuple[type[AbstractEffect], ...]
    _lock: threading.Lock = dataclasses.field(
        default_factory=threading.Lock, init=False, repr=False, compare=False
    )
    """Of what `columns` keeps."""

    @property
    def began(self) -> float:
        """When the first of the recordings in question began [s]."""
        on = [t for t, active in zip(self.traces, self.active, strict=True) if active]
        return min(float(t.signals.time[0]) for t in on or self.traces)

    @functools.cached_property
    def library(self) -> list[Candidates]:
        """The catalogue on these recordings; zero in those of reference."""
        return self._acting(build(self.traces, self.catalogue, self.began))

    @functools.cached_property
    def catchalls(self) -> list[Candidates]:
        """Shapes that depend on where these recordings have been, likewise."""
        return self._acting(from_motions(self.traces, self.catalogue))

    def sweep(self, effect: type[AbstractEffect], joint: int) -> Sweep | None:
        """Shapes of an effect at a joint that are too many for a grid."""
        key = effect, joint
        if key not in self._sweeps:
            self._sweeps[key] = effect.sweep(joint, [t.motion for t in self.traces], self.traces[0].cutoff)
        return self._sweeps[key]

    @functools.cached_property
    def _sweeps(self) -> dict[tuple, Sweep | None]:
        return {}

    def at_some_time(self, r: int) -> list[Sequence[AbstractEffect]]:
        """What may begin or end within a recording: at each place its forms."""
        trace = self.traces[r]
        return [p for c in self.catalogue for p in c.at_some_time(trace.motion.dof, trace.name)]

    @functools.cached_property
    def _throughout(self) -> dict[int, list[np.ndarray]]:
        return {}

    def throughout(self, r: int) -> list[np.ndarray]:
        """Columns of what `at_some_time` has at each place, were it there throughout `(time, dof, n)`."""
        with self._lock:
            if r not in self._throughout:
                motion = self.traces[r].motion
                self._throughout[r] = [forms[0].over(motion) for forms in self.at_some_time(r)]  # pyright: ignore
            return self._throughout[r]

    def _acting(self, candidates: Sequence[Candidates]) -> list[Candidates]:
        some = lambda columns: zip(columns, self.active, strict=True)
        return [
            dataclasses.replace(c, columns=tuple(x if on else np.zeros_like(x) for x, on in some(c.columns)))
            for c in candidates
        ]

    @functools.cached_property
    def _evaluated(self) -> dict[tuple, list[np.ndarray]]:
        """Columns of shapes met before: a search tries many again."""
        known = {}
        for group in (*self.library, *self.catchalls):
            for i, effect in enumerate(group.effects):
                known[_key(effect)] = [c[..., i, :] for c in group.columns]
        return known

    @functools.cached_property
    def _later(self) -> dict[tuple, int]:
        """Which of these are no shapes of the grids, and their bytes."""
        return {}

    def columns(self, effects: Sequence[AbstractEffect]) -> list[np.ndarray]:
        """Columns of shapes of one form at one place in all recordings, as `columns_of`."""
        keys = [_key(effect) for effect in effects]
        with self._lock:
            known = {key: self._evaluated[key] for key in keys if key in self._evaluated}
        new = {key: effect for key, effect in zip(keys, effects, strict=True) if key not in known}
        if new:
            shapes, columns = list(new.values()), []
            for r, trace in enumerate(self.traces):
                here = self.placed(shapes, r)
                columns.append(columns_of(here, trace) if here else 0.0 * columns_of(shapes, trace))
            fresh = {key: [c[..., i, :] for c in columns] for i, key in enumerate(new)}
            known.update(fresh)
            with self._lock:
                if sum(self._later.values()) > _MEMORY:
                    for key in self._later:
                        del self._evaluated[key]
                    self._later.clear()
                self._later.update({key: sum(c.nbytes for c in kept) for key, kept in fresh.items()})
                self._evaluated.update(fresh)
        return [np.stack([known[key][r] for key in keys], -2) for r in range(len(self.traces))]

    def placed(self, effects: Sequence[AbstractEffect], r: int) -> list[AbstractEffect]:
        """What of shapes of one form acts in a recording; empty if nothing does."""
        if not self.active[r]:
            return []
        names = [t.name for t in self.traces]
        bound = effects[0].recordings
        later = r > names.index(bound[0]) if bound else None
        return [p for e in effects if (p := e.placed(names[r], later)) is not None]


def _key(effect: AbstractEffect) -> tuple[Any, ...]:
    """What makes two shapes the same."""
    return type(effect).__name__, *(getattr(effect, f.name) for f in dataclasses.fields(effect))
