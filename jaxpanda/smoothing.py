r"""Positions differentiated with a low-pass that follows the motion.

One cutoff for a whole recording is too low where an arm sets out and too high where it glides. Of a ladder
of low-passes each joint takes, instant by instant, the lowest whose acceleration agrees with that of all higher
ones within their noise: the intersection of confidence intervals of Goldenshluger and Nemirovski (On spatially
adaptive estimation of nonparametric regression, 1997), a form of Lepski's method.

Noise of q is white noise, and what rounding to an encoder's steps adds. Where noise is wider than a step, that
is white too; of a coarse encoder it is a staircase, as slow as the joint. So it is made again: a smooth motion
like this one, rounded to the same steps in several places of a step.
"""

import dataclasses
import functools

import numpy as np
import scipy.ndimage
import scipy.signal
from jaxtyping import Float

from .signals import derivatives, zero_phase, zero_phase_gain

LEAST = 1.0
"""The lowest cutoff [Hz]."""
RATIO = 1.5
"""Of one cutoff to the next."""
_AGREE = 3.5
"""Standard deviations within which accelerations agree."""
_AROUND, _LEVEL = 0.5, 0.2
"""How long noise is alike [s]; and its least level, as a share of that of the whole recording."""
_STAIRS = 0.2
"""How long what rounding leaves is alike [s]."""
_BLEND = 0.05
"""Over which one cutoff goes over into another, and a higher one is kept beside an instant that needs it [s]."""
_BANDS = (0.15, 0.25), (0.25, 0.35), (0.35, 0.5)
"""Shares of the rate between which there is noise of q and hardly a motion."""
_STEEPER = 1.5
"""Ratio of the noise in the first of these bands to that in the second from which on it is not white alone: what
rows off the grid lose of it by interpolation they lose in the last."""
_SPECTRUM = 4.0
"""Of a stretch whose spectrum is taken [s]."""
_SMOOTH = 3.0
"""Low-pass by which a motion is smooth [Hz]."""
_DITHERED = 0.5
"""Noise, in steps of an encoder, from which on its rounding is white."""
_PLACES = 8
"""Places in a step from which rounding is made again."""
_FITTED, _CONTINUED = (0.3, 1.2), (0.2, 0.7)
"""At the ends of a recording q is fitted over so long, and continued by so much: at least [s], and in periods of
the low-pass. With less, noise at the ends of slow low-passes is hundreds of times that within."""
_DRAWN = 64
"""Recordings of noise that tell how much there is at the ends."""


@dataclasses.dataclass(frozen=True)
class Smoothed:
    """Positions low-passed, with their derivatives."""

    q: Float[np.ndarray, "time dof"]
    qd: Float[np.ndarray, "time dof"]
    qdd: Float[np.ndarray, "time dof"]
    cutoff: Float[np.ndarray, "time dof"]
    """Of the low-pass that each instant took [Hz]."""


def smooth(
    q: Float[np.ndarray, "time dof"], step: Float[np.ndarray, " dof"], rate: float, most: float
) -> Smoothed:
    """Positions with their derivatives, each instant of each joint by its own low-pass.

    Args:
        q: on a uniform grid [rad].
        step: that each joint's position was written in; 0 if in none [rad].
        rate: of the grid [Hz].
        most: the highest cutoff [Hz].
    """
    count = max(2, 1 + round(np.log(most / LEAST) / np.log(RATIO)))
    cutoffs = most / RATIO ** np.arange(count)
    columns = [_smooth_joint(x, float(one), cutoffs, rate) for x, one in zip(q.T, step, strict=True)]
    return Smoothed(*(np.stack(parts, 1) for parts in zip(*columns, strict=True)))


def _smooth_joint(
    q: Float[np.ndarray, " time"], step: float, cutoffs: Float[np.ndarray, " cutoffs"], rate: float
) -> tuple[Float[np.ndarray, " time"], ...]:
    each = np.stack([continued_derivatives(q[:, None], cutoff, rate) for cutoff in cutoffs])[..., 0]
    qdd = each[:, 2]
    reach = _AGREE * _noise(q, step, cutoffs, rate)
    for row, cutoff in zip(reach, cutoffs, strict=True):
        more = _at_ends(float(cutoff), rate)[: len(q)]
        row[: len(more)] *= more
        row[len(row) - len(more) :] *= more[::-1]
    low, high = np.maximum.accumulate(qdd - reach, 0), np.minimum.accumulate(qdd + reach, 0)
    lowest = np.sum(np.logical_and.accumulate(low <= high, 0), 0) - 1.0
    lowest = scipy.ndimage.minimum_filter1d(lowest, _samples(2 * _BLEND, rate))
    lowest = scipy.ndimage.gaussian_filter1d(lowest, _BLEND * rate)
    first = np.clip(lowest.astype(int), 0, len(cutoffs) - 2)
    share, rows = lowest - first, np.arange(len(q))
    mixed = (1 - share) * each[first, :, rows].T + share * each[first + 1, :, rows].T
    return *mixed, cutoffs[0] / RATIO**lowest


def _noise(
    q: Float[np.ndarray, " time"], step: float, cutoffs: Float[np.ndarray, " cutoffs"], rate: float
) -> Float[np.ndarray, "cutoffs time"]:
    """Standard deviation of the acceleration that noise of q leaves behind each low-pass [rad/s²]."""
    white, jumps = _levels(q, rate)
    f = np.linspace(0, rate / 2, 2048)
    passed = zero_phase_gain(f, cutoffs) * (2 * np.pi * f)
    variance = lambda level, power: np.mean((passed * (2 * np.pi * f) ** power) ** 2, 1) * level * rate / 2
    here = _local(np.pad(np.diff(q, n=4) ** 2, 2, "edge"), _AROUND, rate)
    total = (variance(white, 1) + variance(jumps, 0))[:, None] * here
    std = np.sqrt(white * rate / 2)
    own = np.sqrt(max(std**2 - step**2 / 12, 0.0))
    if own >= _DITHERED * step:
        return np.sqrt(total)
    rng, steps = np.random.default_rng(0), zero_phase(q, _SMOOTH, rate) / step
    shifted = steps[:, None] + np.arange(_PLACES) / _PLACES
    shifted += own / step * rng.standard_normal((len(q), _PLACES))
    rounding = step * (np.round(shifted) - shifted)
    squares = np.stack(
        [np.mean(continued_derivatives(rounding, cutoff, rate)[2] ** 2, 1) for cutoff in cutoffs]
    )
    left = np.stack([_local(x, _STAIRS, rate) * np.mean(x) for x in squares])
    return np.sqrt(np.maximum(left + variance(own**2 * 2 / rate, 1)[:, None] * here, total))


def _levels(q: Float[np.ndarray, " time"], rate: float) -> tuple[float, float]:
    """Of the power of q's noise, at frequencies at which an arm hardly moves: of white noise [rad²/Hz], and of
    jumps from row to row, as of rows that were lost, of which it is that over frequency squared [rad²/s² /Hz]."""
    window = min(len(q) - 2, round(_SPECTRUM * rate))
    f, power = scipy.signal.welch(np.diff(q, n=2), rate, nperseg=window)
    over = (2 * np.sin(np.pi * f[1:] / rate)) ** -2.0  # of jumps, in units of white noise
    levels, f = power[1:] * over**2, f[1:]
    bands = [band for low, high in _BANDS if (band := (f > low * rate) & (f <= high * rate)).any()]
    white = np.array([np.median(levels[band]) for band in bands])
    if len(bands) < len(_BANDS) or white[0] < _STEEPER * white[1]:
        return float(np.max(white)), 0.0
    jumps = np.min(np.diff(white) / np.diff([np.mean(over[band]) for band in bands]))
    jumps = max(0.0, float(jumps))
    return max(0.0, float(white[-1] - jumps * np.mean(over[bands[-1]]))), jumps * rate**2


def _local(x: Float[np.ndarray, " time"], seconds: float, rate: float) -> Float[np.ndarray, " time"]:
    """The mean of x around each instant, over that of all; 1 where x is 0."""
    mean = float(np.mean(x))
    if mean == 0:
        return np.ones_like(x)
    return np.maximum(scipy.ndimage.uniform_filter1d(x, _samples(seconds, rate)) / mean, _LEVEL**2)


def _samples(seconds: float, rate: float) -> int:
    """An odd number of samples of so long a stretch."""
    return 2 * round(seconds * rate / 2) + 1


def continued_derivatives(
    q: Float[np.ndarray, "time dof"], cutoff: float, rate: float
) -> tuple[Float[np.ndarray, "time dof"], Float[np.ndarray, "time dof"], Float[np.ndarray, "time dof"]]:
    """`signals.derivatives`, with q continued beyond its ends by quartics: an arm may be cut off in motion."""
    fitted, continued = (round(max(least, of / cutoff) * rate) for least, of in (_FITTED, _CONTINUED))
    count, more = min(max(8, fitted), len(q)), max(4, continued)
    x = np.arange(count) / rate
    ends = []
    for part, at in (
        (q[:count], -np.arange(more, 0, -1) / rate),
        (q[-count:], x[-1] + np.arange(1, more + 1) / rate),
    ):
        quartic = np.polynomial.polynomial.polyfit(x, part, 4)
        ends.append(np.polynomial.polynomial.polyval(at, quartic).T)
    longer = derivatives(np.concatenate([ends[0], q, ends[1]]), cutoff, rate)
    smoothed, first, second = (part[more:-more] for part in longer)
    return smoothed, first, second


@functools.lru_cache(maxsize=64)
def _at_ends(cutoff: float, rate: float) -> Float[np.ndarray, " time"]:
    """How much more noise there is in the acceleration at each sample from an end than within, 1 or more."""
    reach = max(16, round(rate / cutoff))
    noise = np.random.default_rng(0).standard_normal((4 * reach, _DRAWN))
    square = np.mean(continued_derivatives(noise, cutoff, rate)[2] ** 2, 1)
    ends = 0.5 * (square[:reach] + square[: -reach - 1 : -1])
    return np.maximum(np.sqrt(ends / np.mean(square[reach:-reach])), 1.0)
