"""Readings that stand alone, as where a bit flipped or a sensor says "no value": no arm has moved or felt so."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from .recording import Recording

LEFT_OUT = "rows left out, as a reading in them stands alone"
"""What the account of repairs says."""
_LEAST = {"q": 0.01, "tau": 1.0, "tau_motor": 1.0}
"""How far from those beside it [rad, N m]; what is nearer does no harm."""
_LONGEST = 3
"""Rows that such a reading lasts, at most."""
_BEYOND = 0.5
"""How far beyond all the others it lies, in their spread."""
_JUMP, _USUAL = 50.0, 0.95
"""How many times larger the steps to it and from it are than such a share of those from row to row, and than the
smallest, which is what a column is written in."""
_BACK = 0.1
"""How far apart the readings before and after it may lie, in its own distance."""
_FEW = 0.01
"""Share of the rows beyond which it is the sensor that is so."""


def without_glitches(recording: Recording) -> Recording:
    """The recording without the rows in which a position or a torque stands alone; counted, and the first named.

    One row of a torque that is 1e6 N m for a millisecond would else decide how noisy its joint is, and where a
    simulation under that torque goes.
    """
    channels = {name: x for name, x in recording.measured.items() if name in _LEAST}
    columns = {(name, j): x for name, channel in channels.items() for j, x in enumerate(channel.T)}
    alone = {(name, j): _alone(x, _LEAST[name]) for (name, j), x in columns.items()}
    found = {place: where for place, where in alone.items() if where.any()}
    bad = np.any([*found.values()], axis=0) if found else np.zeros(recording.samples, bool)
    if not bad.any() or bad.mean() > _FEW:
        return recording
    (name, j), where = next(iter(found.items()))
    i, keep = int(np.argmax(where)), ~bad
    return dataclasses.replace(
        recording.at(keep),
        repairs={**recording.repairs, LEFT_OUT: int(bad.sum())},
        notes=(
            *recording.notes,
            f"{recording.name}: column {name}_{j + 1} reads {columns[name, j][i]:g} at {recording.time[i]:g} s,"
            f" far from all other readings and from those beside it{_and_others(found)}; such rows are left out",
        ),
    )


def _and_others(found: dict[tuple[str, int], Bool[np.ndarray, " time"]]) -> str:
    counts = [int(np.sum(np.diff(where, prepend=False) & where)) for where in found.values()]
    said = [
        f"{name}_{j + 1}" + (f" {count} times" if count > 1 else "")
        for (name, j), count in zip(found, counts, strict=True)
    ]
    return f" (in all: {', '.join(said)})" if sum(counts) > 1 else ""


def _alone(x: Float[np.ndarray, " time"], least: float) -> Bool[np.ndarray, " time"]:
    """Where a reading lies beyond all the others, and comes and goes within a few rows."""
    out = np.zeros(len(x), bool)
    low, high = np.quantile(x, [0.005, 0.995])
    reach = _BEYOND * (high - low)
    edges = np.flatnonzero(np.diff(np.r_[False, (x < low - reach) | (x > high + reach), False]))
    if not edges.size:
        return out
    steps = np.abs(np.diff(x))
    jump = max(least, _JUMP * np.quantile(steps, _USUAL), _JUMP * np.min(steps[steps > 0], initial=np.inf))
    for first, last in edges.reshape(-1, 2):
        if last - first > _LONGEST:
            continue
        after = x[last] if last < len(x) else x[first - 1]
        before = x[first - 1] if first else after
        there = np.abs(x[first:last] - (before + after) / 2).min()
        out[first:last] = there > jump and abs(after - before) < _BACK * there
    return out
