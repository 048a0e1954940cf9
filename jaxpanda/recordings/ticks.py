r"""The true ticks of a log that a host has stamped.

A host that samples a controller's state now and then logs a state twice, or misses one, and stamps it when it
gets to it. Position and velocity know better: between two rows the controller has run for

$$ \Delta t = \frac{\sum_j \dot q_j\, \Delta q_j}{\sum_j \dot q_j^2}, $$

the least-squares solution of $\Delta q_j = \dot q_j \Delta t$, and in units of the controller's period that
is an integer: 0 where a row repeats the one before, 2 where one tick is missing. How far from integers the
ratio is tells whether the ticks can be recovered at all, and rms(dq - d(q)/dt) tells whether they are worth
it.
"""

import dataclasses
import itertools

import numpy as np
from jaxtyping import Float, Int

PERIODS = (0.25e-3, 0.5e-3, 1e-3, 2e-3, 2.5e-3, 4e-3, 5e-3, 8e-3, 10e-3, 20e-3)
"""Periods of robot controllers [s]."""
SLOWEST = 0.05
"""Below this speed, |dq| over all joints [rad/s], the ratio says nothing: velocity is late and noisy."""
JITTER = 0.05
"""Stamps whose steps stay this close to their median, as a share of it, are the ticks already."""
RESIDUAL = 0.1
"""Largest rms distance of the ratios from integers at which ticks count as recovered [ticks]."""
_LONG_REST = 0.2  # [s] of rest inside a motion, over which the stamps are the better clock


@dataclasses.dataclass(frozen=True)
class Ticks:
    """The tick of each row, and what it is worth."""

    tick: Int[np.ndarray, " time"]
    """Ticks since the first row; rows that share one hold the same state."""
    period: float
    """[s]"""
    residual: float
    """rms distance of the tick counts from integers, before rounding."""
    stamped: int
    """Rows at rest, where the ratio says nothing and the stamps were rounded to ticks."""
    mismatch_stamps: float
    """rms(dq - d(q)/dt) with the stamps [rad/s]."""
    mismatch_ticks: float
    """The same with the ticks [rad/s]."""

    @property
    def better(self) -> bool:
        """Whether ticks were recovered and fit the velocities better than the stamps do."""
        return self.residual < RESIDUAL and self.mismatch_ticks < 0.5 * self.mismatch_stamps


def consistent(time: Float[np.ndarray, " time"]) -> bool:
    """Whether stamps are the controller's own: uniform but for whole steps that are missing."""
    steps = np.diff(time)
    period = np.median(steps)
    whole = np.round(steps / period)
    return bool(np.all(np.abs(steps - whole * period) <= JITTER * period) and np.all(whole >= 1))


def reconstruct(
    time: Float[np.ndarray, " time"],
    q: Float[np.ndarray, "time dof"],
    qd: Float[np.ndarray, "time dof"],
    tau: Float[np.ndarray, "time dof"] | None = None,
) -> Ticks | None:
    """The tick of each row; None where the motion is too slow to tell.

    At rest the ratio is ill-conditioned. There a row whose channels all repeat the row before is on the same
    tick, and any other is as many ticks later as its stamp says. A rest inside the motion takes as long as
    the stamps say.
    """
    channels = np.column_stack([channel for channel in (q, qd, tau) if channel is not None])
    repeats = np.all(np.diff(channels, axis=0) == 0, axis=1)
    speed = np.linalg.norm(qd[1:], axis=1)
    moving = speed > SLOWEST
    if moving.sum() < 20:
        return None
    elapsed = np.sum(qd[1:] * np.diff(q, axis=0), axis=1) / np.maximum(speed, SLOWEST) ** 2
    period = _period(time, elapsed[moving])
    ratio = elapsed / period
    stamps = np.where(repeats, 0, np.maximum(np.round(np.diff(time) / period), 1))
    steps = np.where(moving, np.maximum(np.round(ratio), 0), stamps).astype(int)
    for first, last in _rests(moving):
        if (last - first) * period > _LONG_REST:
            steps[first:last] = _stretched(steps[first:last], round((time[last] - time[first]) / period))
    tick = np.concatenate([[0], np.cumsum(steps)])
    new = np.concatenate([[True], steps > 0])
    return Ticks(
        tick=tick,
        period=period,
        residual=_rms((ratio - np.round(ratio))[moving]),
        stamped=int(np.sum(~moving)),
        mismatch_stamps=_mismatch(time, q, qd),
        mismatch_ticks=_mismatch(tick[new] * period, q[new], qd[new]),
    )


def _period(time: Float[np.ndarray, " time"], elapsed: Float[np.ndarray, " row"]) -> float:
    """The longest period near the stamps' median step of which the elapsed times are multiples."""
    step = float(np.median(np.diff(time)))
    near = [period for period in PERIODS if 0.3 * step < period < 1.5 * step] or [step]
    for period in reversed(near):
        if _rms(elapsed / period - np.round(elapsed / period)) < RESIDUAL:
            return period
    return min(near, key=lambda period: abs(period - step))


def _rests(moving: np.ndarray) -> list[tuple[int, int]]:
    """Spans [first, last) of steps at rest that have motion on both sides."""
    edges = np.flatnonzero(np.diff(moving.astype(int))).tolist()
    return [(a + 1, b + 1) for a, b in itertools.pairwise(edges) if not moving[a + 1]]


def _stretched(steps: np.ndarray, total: int) -> np.ndarray:
    """The same steps, stretched evenly to another sum."""
    if steps.sum() == 0:
        return steps
    return np.diff(np.round(np.concatenate([[0], np.cumsum(steps)]) * (total / steps.sum()))).astype(int)


def _mismatch(time: np.ndarray, q: np.ndarray, qd: np.ndarray) -> float:
    """rms(dq - d(q)/dt) over rows and joints, by differences between neighbouring rows [rad/s]."""
    slope = np.diff(q, axis=0) / np.diff(time)[:, None]
    return _rms(slope - (qd[1:] + qd[:-1]) / 2)


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(x))))
