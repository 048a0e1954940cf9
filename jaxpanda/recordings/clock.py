r"""When samples were taken, where a host stamped them.

A controller samples uniformly; the host that logs it stamps a row when it gets to it, a fraction of a sample
late or early. Differentiated twice, a tenth of a sample makes $\ddot q$ a fifth wrong. Two things are asked
of a recording:

1. Is there a clock, $s_i = s_0 + k_i T$ with integers $k_i$, about which the stamps scatter? T is where the
   stamps are most in phase; which ticks have no row is told by the rows that come later (isotonic regression).
2. Did the samples follow the clock or the stamps? If stamps $t_i = s_i + \delta_i$ are when q was read, then
   $q_i = q(s_i) + \beta\,\dot q_i \delta_i$ with $\beta = 1$; if the host only wrote them late, $\beta = 0$.
   What a cubic through the two rows before and the two after leaves of a row holds no motion, so that $\beta$
   is seen in it.
"""

import dataclasses

import numpy as np
import scipy.optimize
from jaxtyping import Float, Int

from ..errors import InputError
from .recording import Recording

MOVED = "rows moved from their stamp to their tick"
"""What the account of repairs says."""
JITTER = 0.01
"""Stamps that stay this close to ticks, as a share of the period (rms), do no harm, unless q shows otherwise."""
_EXACT = 0.001
"""How close steps of stamps are to whole periods where no clock is looked for, as a share of one."""
FEW = 40
"""Rows below which no clock is looked for."""
_AROUND = 0.07
"""How far from the median step the period is looked for, as a share of it."""
_IN_PHASE = 0.08
"""Length of the mean phasor of the stamps at which there is a clock; 0.11 where they scatter by ±0.45 period."""
_WINDOW, _MOST = 2048, 16384
"""Rows in which the period is looked for first, and at most."""
_LATE = 20.0
"""Periods by which a stamp may be off its tick."""
_MENDED = 0.7
"""What cubics leave on ticks in what they leave with the stamps, at most, where one is a period off or more."""
_WIDE = 8
"""Ticks that the five rows of a cubic span, at most; more is a gap."""
_SURE = 3.0
"""Standard deviations by which beta must be below a half."""
_MOVES = 0.05
"""Speed of a joint that tells of a time error [rad/s]."""
_COMMON, _DECIDES = 0.9, 0.1
"""Share of what the cubics leave that goes with the velocities of all joints, and share of the acceleration
that this makes up, beyond which stamps are known to be wrong and to decide the acceleration."""
_BAND = 12.0
"""Band in which accelerations are compared [Hz]."""


@dataclasses.dataclass(frozen=True)
class Clock:
    """Ticks about which stamps scatter, and whether samples followed them."""

    tick: Int[np.ndarray, " time"]
    period: float
    """[s]"""
    start: float
    """Time of tick 0 by the stamps [s]."""
    jitter: float
    """rms distance of the stamps from the ticks [periods]."""
    farthest: float
    """The largest such distance [periods]."""
    seen: float
    """Share of it that the motion shows: 0 for uniform samples, 1 for samples taken at their stamps."""
    std: float
    """Of `seen`; infinite where nothing moves."""
    left: float
    """What cubics leave of q on these ticks, in what they leave with the stamps as they are (rms)."""

    @property
    def time(self) -> Float[np.ndarray, " time"]:
        return self.start + self.period * self.tick

    @property
    def uniform(self) -> bool:
        """Whether samples were uniform for sure."""
        return self.seen + _SURE * self.std < 0.5 and self.left < (1.0 if self.farthest <= 1 else _MENDED)


def on_clock(recording: Recording) -> Recording:
    """The recording with its rows on ticks where samples were uniform and their stamps were not, and as it is
    where stamps say when samples were taken or nothing tells; `Recording.stamps` keeps what was written.

    Raises:
        InputError: stamps are wrong by so much that they decide the acceleration, and no clock is found.
    """
    t, q = recording.time, recording.q
    if recording.samples < FEW or _is_regular(t):
        return recording
    clocks = [clock for clock in _clocks(t, q) if clock.jitter > JITTER or clock.left < _MENDED]
    sure = [clock for clock in clocks if clock.uniform]
    if not sure:
        shown = next((clock for clock in clocks if clock.seen - _SURE * clock.std > 0.5), None)
        if shown is None:
            _check(recording, t)
            return recording
        said = (
            f"{recording.name}: time is not uniform, and the stamps say when samples were taken: the motion shows"
            f" {shown.seen:.2g} ± {shown.std:.1g} of their scatter"
        )
        return dataclasses.replace(recording, notes=(*recording.notes, said))
    clock = min(sure, key=lambda clock: clock.left)
    _check(recording, clock.time)
    missing = int(clock.tick[-1] - clock.tick[0] + 1 - recording.samples)
    more = {"ticks missing between rows": missing} if missing else {}
    return dataclasses.replace(
        recording,
        time=clock.time,
        stamps=t,
        repairs={**recording.repairs, MOVED: recording.samples, **more},
        notes=(
            *recording.notes,
            f"{recording.name}: samples were uniform and their stamps were not: rows are on ticks of"
            f" {1e3 * clock.period:.6g} ms, from which the stamps are {clock.jitter:.2g} of a tick off (rms); of"
            f" that the motion shows {clock.seen:.2g} ± {clock.std:.1g}, where it would show all of it had"
            " samples been taken at their stamps",
        ),
    )


def _is_regular(time: Float[np.ndarray, " time"]) -> bool:
    """Whether stamps are ticks already, but for whole ones that are missing; multiples of what 32 bits resolve
    are none."""
    steps = np.diff(time)
    period = float(np.median(steps))
    short = time.astype(np.float32)
    if np.array_equal(short, time) and np.spacing(np.abs(short).max()) > _EXACT * period:
        return False
    return bool(np.all(np.abs(steps - np.round(steps / period) * period) <= _EXACT * period))


def _clocks(time: Float[np.ndarray, " time"], q: Float[np.ndarray, "time dof"]) -> list[Clock]:
    """Clocks that stamps may scatter about: with a row at every tick, and with which they are in phase."""
    rows = np.arange(len(time))
    found = [rows]
    period = _period(time)
    if period is not None:
        phase = float(np.angle(np.mean(np.exp(2j * np.pi * time / period)))) / (2 * np.pi)
        late = time / period - phase - rows
        # of all non-decreasing integers the nearest are those of the isotonic regression, rounded
        tick = rows + np.round(scipy.optimize.isotonic_regression(late).x).astype(int)
        found.append(tick)
    out = []
    for tick in found:
        tick = tick - tick[0]
        period, start = map(float, np.polyfit(tick, time, 1))
        delta = time - start - period * tick
        far = float(np.abs(delta).max()) / period
        if far > _LATE:
            continue
        seen, std, left = _seen(start + period * tick, delta, q, period)
        out.append(Clock(tick, period, start, float(np.std(delta)) / period, far, seen, std, left))
    return out


def _period(time: Float[np.ndarray, " time"]) -> float | None:
    """The period near the median step with which the stamps are most in phase, first of some rows, then of ever
    more."""
    rate, count = 1 / float(np.median(np.diff(time))), min(len(time), _WINDOW)
    low, high = rate * (1 - _AROUND), rate * (1 + _AROUND)
    while True:
        first = (len(time) - count) // 2
        t = time[first : first + count : max(1, count // _MOST)]
        width = t[-1] - t[0]
        tried = np.arange(low, high, 1 / (6 * width))[: 1 << 14]
        power = np.array([np.abs(np.mean(np.exp(2j * np.pi * rate * t))) for rate in tried])
        best = float(tried[np.argmax(power)])
        if count == len(time):
            return 1 / best if power.max() > _IN_PHASE else None
        count = min(2 * count, len(time))
        low, high = best - 0.6 / width, best + 0.6 / width


def _left(
    time: Float[np.ndarray, " time"], x: Float[np.ndarray, "time ..."]
) -> tuple[Float[np.ndarray, "inner ..."], Float[np.ndarray, " inner"]]:
    """What a cubic through two rows before and two after leaves of a row, over what it would leave of white
    noise of unit variance; and how long the five rows take."""
    rows = np.lib.stride_tricks.sliding_window_view(time, 5)
    others = rows[:, [0, 1, 3, 4]]
    weights = np.ones_like(others)
    for a in range(4):
        for b in range(4):
            if a != b:
                weights[:, a] *= (rows[:, 2] - others[:, b]) / (others[:, a] - others[:, b])
    size = np.sqrt(1 + np.sum(weights**2, 1))
    flat = x.reshape(len(x), -1)
    made = sum(weights[:, [k]] * flat[row : row + len(rows)] for k, row in enumerate((0, 1, 3, 4)))
    left = (flat[2:-2] - made) / size[:, None]
    return left.reshape(len(rows), *x.shape[1:]), rows[:, 4] - rows[:, 0]


def _velocity(
    time: Float[np.ndarray, " time"], q: Float[np.ndarray, "time dof"], period: float
) -> Float[np.ndarray, "time dof"]:
    """Of q over some 20 ms, or from the row before to the row after."""
    apart = max(1, round(0.01 / period))
    first, last = np.maximum(np.arange(len(q)) - apart, 0), np.minimum(np.arange(len(q)) + apart, len(q) - 1)
    return (q[last] - q[first]) / (time[last] - time[first])[:, None]


def _seen(
    ticks: Float[np.ndarray, " time"],
    delta: Float[np.ndarray, " time"],
    q: Float[np.ndarray, "time dof"],
    period: float,
) -> tuple[float, float, float]:
    """Share of the stamps' scatter that the motion shows, its standard deviation, and `Clock.left`."""
    qd = _velocity(ticks, q, period)
    e, wide = _left(ticks, q)
    x, _ = _left(ticks, qd * delta[:, None])
    written, _ = _left(ticks + delta, q)
    e, x, written = (part[wide < _WIDE * period] for part in (e, x, written))
    variance = np.minimum(np.mean(e**2, 0), np.mean(written**2, 0)) if len(e) else np.zeros(q.shape[1])
    w = np.where(variance > 0, 1 / np.where(variance > 0, variance, 1.0), 0.0)
    power = float(np.sum(w * x**2))
    if power == 0:
        return 0.0, np.inf, 1.0
    seen = float(np.sum(w * x * e)) / power
    scores = np.sum(
        w * x * (e - seen * x), 1
    )  # what neighbours leave is correlated: in blocks of their reach
    blocks = np.add.reduceat(scores, np.arange(0, len(scores), 5))
    left = float(np.sqrt(np.sum(w * e**2) / np.sum(w * written**2)))
    return seen, float(np.sqrt(np.sum(blocks**2))) / power, left


def _check(recording: Recording, t: Float[np.ndarray, " time"]) -> None:
    """Refuse times that are proven wrong: what cubics leave of q goes with the velocity of all joints."""
    q, period = recording.q, 1 / recording.rate
    qd = _velocity(t, q, 0.25 * period)
    e, wide = _left(t, q)
    v, near = qd[2:-2], wide < _WIDE * period
    moving = near & (np.sum(np.abs(v) > _MOVES, 1) >= 3)
    if moving.sum() < FEW:
        return
    e, v = e[moving], v[moving]
    late = np.sum(e * v, 1) / np.sum(v**2, 1)
    common = float(np.sum((late[:, None] * v) ** 2) / np.sum(e**2))
    error = float(np.sqrt(np.mean(late**2)))
    band = min(_BAND, 0.25 / period)
    noise = error * np.sqrt(np.mean(v**2)) * (2 * np.pi * band) ** 2 * np.sqrt(0.4 * band * period)
    slow = max(1, round(0.05 / period))
    bend = (qd[2 * slow :] - qd[: -2 * slow]) / (t[2 * slow :] - t[: -2 * slow])[:, None]
    if common > _COMMON and noise > _DECIDES * np.sqrt(np.mean(bend**2)):
        raise InputError(
            f"{recording.name}: column time is off by {1e3 * error:.2g} ms (rms) from when samples were taken,"
            " as all joints show row by row, and that decides the acceleration; no uniform clock fits either: log"
            " the controller's own time"
        )
