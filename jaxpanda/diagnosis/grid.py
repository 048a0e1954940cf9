"""Columns of every shape of every effect that is tried on some recordings, made once."""

import dataclasses
import functools
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..effects import AbstractEffect
from . import catchall
from .library import Candidates, build, columns_of
from .traces import Trace

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

    @functools.cached_property
    def library(self) -> list[Candidates]:
        """The catalogue on these recordings; zero in those of reference."""
        return self._acting(build(self.traces, self.catalogue))

    @functools.cached_property
    def catchalls(self) -> list[Candidates]:
        """Free forms on these recordings; zero in those of reference."""
        return self._acting(catchall.build(self.traces))

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
