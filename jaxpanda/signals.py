r"""Recordings into signals that a regression can use: uniform, differentiated, filtered alike on both sides.

Velocity and acceleration come from q alone: it is low-passed without phase (4th-order Butterworth, forward
and backward, hence -6 dB at the cutoff) and differentiated by central differences of sixth order. A logged dq
is late by milliseconds and is not used. Then every column of the regressor and the torque pass through one
more such low-pass, `Signals.lowpass`: "parallel filtering". It is linear, edges included, so that
$F\tau - F W\beta = F(\tau - W\beta)$: what the filter does at the edges it does to the residual only.
"""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property

import numpy as np
import scipy.interpolate
import scipy.ndimage
import scipy.signal
from jaxtyping import Bool, Float, Int

from .errors import InputError
from .recordings import Recording, plausible
from .recordings.ticks import PERIODS

DERIVATIVE_CUTOFF = 25.0
"""Low-pass of q before it is differentiated [Hz], where the rate allows it."""
LONGEST_GAP = 0.1
"""Rows missing for longer than this [s] are bridged, but nothing near the bridge is kept."""
STILL = 3e-3
"""Travel below which a joint stands still in a recording [rad or m]."""
REST = 5.0
"""Noise of the velocity within which a joint counts as at rest, in standard deviations."""
TURN = 0.01
"""How long before or after a joint turns its friction may [s]: MuJoCo's constraint does so before the velocity
changes sign, the friction of a gear after it, and a filtered velocity shows neither."""
BESIDE = 0.02
"""How far the low-pass of the torque and a model of its noise carry a wrong sign [s]."""
REPEATS = 0.02
"""A motion repeats where q differs by less than this share of its own spread (rms)."""
_ORDER = 4  # of the Butterworth filter, before it runs back over its output
_SHORTEST_PAD = 30  # samples, for cutoffs near half the rate
_SEARCH_STEP = 0.02  # [s] at which repeated motion is looked for
_PROMISING = (
    0.5  # share of the spread by which motions may differ, rms over start and stop, to be compared closely
)
_UNIFORM = 0.02  # deviation of stamps from a uniform grid, as a share of its step, that is rounding


@dataclasses.dataclass(frozen=True)
class Signals:
    """One motion on a uniform grid, with q's derivatives and the filter for everything else.

    `lowpass` and `keep` turn anything that lives on the full grid into what a regression may use.
    """

    name: str
    time: Float[np.ndarray, " time"]
    """The full grid [s], by the recording's clock."""
    q: Float[np.ndarray, "time dof"]
    """Joint positions [rad], low-passed."""
    qd: Float[np.ndarray, "time dof"]
    """[rad/s]"""
    qdd: Float[np.ndarray, "time dof"]
    """[rad/s²]"""
    tau: Float[np.ndarray, "time dof"] | None
    """Measured torque [N m] on the grid, not filtered."""
    rate: float
    """Of the full grid [Hz]."""
    cutoff: float
    """Of `lowpass` [Hz]."""
    derivative_cutoff: float
    """Of the low-pass of q [Hz]."""
    keep: Int[np.ndarray, " kept"]
    """The output grid, as indices into the full one; edges and long gaps are left out."""
    period: float | None
    """After which the motion repeats itself [s]."""
    noise: Float[np.ndarray, " dof"] | None
    """Noise of each joint's torque, sample to sample (`white_noise`) [N m]."""
    position_noise: Float[np.ndarray, " dof"]
    """Noise of each joint's position, sample to sample, before the low-pass [rad]."""
    repairs: Mapping[str, int]
    """What reading and resampling dropped, filled or moved, and how often."""
    notes: tuple[str, ...] = ()

    @property
    def dof(self) -> int:
        return self.q.shape[1]

    @cached_property
    def times(self) -> Float[np.ndarray, " kept"]:
        """The output grid [s]."""
        return self.time[self.keep]

    @property
    def moves(self) -> Bool[np.ndarray, " dof"]:
        """Joints that do not stand still throughout."""
        return np.ptp(self.q[self.keep], axis=0) >= STILL

    @property
    def output_rate(self) -> float:
        """Of the output grid [Hz]."""
        return self.rate / float(np.min(np.diff(self.keep), initial=len(self.time)))

    @property
    def unsure(self) -> Float[np.ndarray, "time dof"]:
        """`unsure_sign` on the full grid."""
        return unsure_sign(self.q, self.qd, self.qdd, self.position_noise, self.derivative_cutoff, self.rate)

    def lowpass(self, x: Float[np.ndarray, "time ..."]) -> Float[np.ndarray, "kept ..."]:
        """Anything on the full grid, low-passed without phase at `cutoff`, on the output grid."""
        return zero_phase(np.asarray(x, dtype=float), self.cutoff, self.rate)[self.keep]


def prepare(
    recording: Recording,
    *,
    cutoff: float = 5.0,
    derivative_cutoff: float | None = None,
    rate: float | None = None,
    trim: float | None = None,
) -> Signals:
    """A recording, or a motion without torque, as signals.

    Args:
        recording: as read.
        cutoff: of the low-pass that regressor and torque share [Hz].
        derivative_cutoff: of the low-pass of q [Hz]; 25 Hz, more for a high cutoff, at most 0.4 of the rate.
        rate: of the output grid [Hz], at most; 100 Hz by default. Every n-th point of the full grid is kept.
        trim: left out at both ends [s]; 0.6 s or one period of `cutoff`, whichever is longer. What the filter
            makes up beyond the ends is then below 1e-4 N m at 5 Hz (0.02 N m at 1 Hz).

    Raises:
        InputError: a cutoff that the rate does not allow, too short a recording, or one in other units.
    """
    plausible(recording)
    time, step, repairs, notes = _grid(recording)
    full_rate = 1 / step
    derivative_cutoff, notes = _cutoffs(recording.name, cutoff, derivative_cutoff, full_rate, notes)
    bridged = np.max(np.diff(recording.time)) > LONGEST_GAP
    smooth = scipy.interpolate.PchipInterpolator if bridged else scipy.interpolate.CubicSpline
    q = resampled(recording.time, recording.q, time, smooth)
    noise = position_noise(q)
    q, qd, qdd = derivatives(q, derivative_cutoff, full_rate)
    tau = None if recording.tau is None else resampled(recording.time, recording.tau, time)
    trim = max(0.6, 1 / cutoff) if trim is None else trim
    keep = _kept(recording, time, step, trim, min(100.0 if rate is None else rate, full_rate))
    return Signals(
        name=recording.name,
        time=time,
        q=q,
        qd=qd,
        qdd=qdd,
        tau=tau,
        rate=full_rate,
        cutoff=cutoff,
        derivative_cutoff=derivative_cutoff,
        keep=keep,
        period=period(time, q),
        noise=None if recording.tau is None else white_noise(recording.tau),
        position_noise=noise,
        repairs={**recording.repairs, **repairs},
        notes=recording.notes + notes,
    )


def zero_phase(x: Float[np.ndarray, "time ..."], cutoff: float, rate: float) -> Float[np.ndarray, "time ..."]:
    """A 4th-order Butterworth low-pass, run forward and backward over the first axis.

    Beyond the ends x continues point-symmetrically for 1.5 periods of the cutoff: of the usual continuations
    this disturbs a position least.
    """
    sos = scipy.signal.butter(_ORDER, cutoff, fs=rate, output="sos")
    pad = min(max(round(1.5 * rate / cutoff), _SHORTEST_PAD), len(x) - 1)
    return scipy.signal.sosfiltfilt(sos, x, axis=0, padtype="odd", padlen=pad)


def zero_phase_gain(
    f: Float[np.ndarray, " frequencies"], cutoffs: Float[np.ndarray, " cutoffs"]
) -> Float[np.ndarray, "cutoffs frequencies"]:
    """What `zero_phase` leaves of frequencies [Hz] far below half the rate."""
    return 1 / (1 + (f / cutoffs[:, None]) ** (2 * _ORDER))


def derivatives(
    q: Float[np.ndarray, "time dof"], cutoff: float, rate: float
) -> tuple[Float[np.ndarray, "time dof"], Float[np.ndarray, "time dof"], Float[np.ndarray, "time dof"]]:
    """Low-passed q with its first two derivatives, by central differences of sixth order.

    Second-order differences would shrink 2 Hz by 1 % at a rate of 50 Hz.
    """
    smooth = zero_phase(q, cutoff, rate)
    padded = np.pad(smooth, ((3, 3), (0, 0)), mode="reflect", reflect_type="odd")
    first = np.array([-1, 9, -45, 0, 45, -9, 1]) / 60 * rate
    second = np.array([2, -27, 270, -490, 270, -27, 2]) / 180 * rate**2
    windows = np.lib.stride_tricks.sliding_window_view(padded, 7, axis=0)
    return smooth, windows @ first, windows @ second


def white_noise(tau: Float[np.ndarray, "time dof"]) -> Float[np.ndarray, " dof"]:
    r"""Standard deviation of what changes from one sample to the next [N m].

    From third differences, $\sigma^2 = \langle(\Delta^3\tau)^2\rangle / 20$, where the motion has gone.
    Slower noise (resonances, drift) is not in it.
    """
    return np.sqrt(np.mean(np.diff(tau, n=3, axis=0) ** 2, axis=0) / 20)


def position_noise(q: Float[np.ndarray, "time dof"]) -> Float[np.ndarray, " dof"]:
    """Noise of q from sample to sample [rad], from the median of third differences: gaps do not count."""
    if len(q) < 4:
        return np.zeros(q.shape[1])
    return np.median(np.abs(np.diff(q, n=3, axis=0)), axis=0) / (0.6745 * np.sqrt(20))


def velocity_noise(
    noise: Float[np.ndarray, " dof"], cutoff: float | Float[np.ndarray, "time dof"], rate: float
) -> Float[np.ndarray, "*time dof"]:
    """Noise of the velocity [rad/s] from that of q [rad], white up to the cutoff."""
    return 2 * np.pi * noise * np.sqrt(2 * cutoff**3 / (3 * rate))


def unsure_sign(
    q: Float[np.ndarray, "time dof"],
    qd: Float[np.ndarray, "time dof"],
    qdd: Float[np.ndarray, "time dof"],
    noise: Float[np.ndarray, " dof"],
    cutoff: float,
    rate: float,
) -> Float[np.ndarray, "time dof"]:
    """1 where the sign of the velocity, or of the friction, cannot be told, else 0; with what filters make of it
    nearby.

    There dry friction holds the joint and carries what it must, up to its level. Before a joint sets out from
    rest, a sharp filter swings to the other side. A velocity smaller than its difference from that of a filter
    that does not ring, than what noise of q pretends or than it changes in `TURN` has no sign.

    Args:
        q: positions [rad].
        qd: velocities behind the low-pass [rad/s].
        qdd: accelerations behind it [rad/s²].
        noise: of q, from sample to sample [rad].
        cutoff: of the low-pass [Hz].
        rate: of the samples [Hz].
    """
    width = rate * np.sqrt(np.log(2)) / (2 * np.pi * cutoff)
    smooth = scipy.ndimage.gaussian_filter1d(q, width, 0, mode="nearest", truncate=6.0)
    error = np.abs(qd - np.gradient(smooth, 1 / rate, axis=0))
    unsure = np.abs(qd) < 2 * error + REST * velocity_noise(noise, cutoff, rate) + TURN * np.abs(qdd)
    reach = 2 * round(rate * BESIDE) + 1
    return scipy.ndimage.maximum_filter1d(unsure.astype(float), reach, axis=0)


def repeatability(signals: Signals) -> Float[np.ndarray, " dof"] | None:
    r"""Noise of the low-passed torque [N m] from a motion that repeats itself: std of the difference over √2.

    No model enters: no model can explain less. None without torque or without a repeat.
    """
    if signals.tau is None or signals.period is None:
        return None
    shift = signals.period * signals.rate
    smooth = zero_phase(signals.tau, signals.cutoff, signals.rate)
    grid = np.arange(len(smooth))
    later = signals.keep + shift
    first = signals.keep[later <= signals.keep[-1]]
    if len(first) < 2:
        return None
    second = scipy.interpolate.CubicSpline(grid, smooth)(first + shift)
    return np.std(second - smooth[first], axis=0) / np.sqrt(2)


def period(time: Float[np.ndarray, " time"], q: Float[np.ndarray, "time dof"]) -> float | None:
    """The shift after which a motion repeats itself [s], or None."""
    found = _shift(time, q, time, q)
    return None if found is None else found[0]


@dataclasses.dataclass(frozen=True)
class Repeat:
    """Two recordings of which one holds motion of the other."""

    first: str
    second: str
    shift: float
    """Time in `second` minus time in `first` of the same motion [s]."""
    overlap: float
    """How much motion they share [s]."""


def repeats(signals: Sequence[Signals]) -> list[Repeat]:
    """Pairs of recordings that share motion; a test on one of them would repeat training on the other."""
    return [
        Repeat(a.name, b.name, *found)
        for a, b in itertools.combinations(signals, 2)
        if a.dof == b.dof and (found := _shift(a.time, a.q, b.time, b.q)) is not None
    ]


Split = tuple[Bool[np.ndarray, " kept"], Bool[np.ndarray, " kept"]]
"""Training and test samples, as masks over the output grid; a sample may be in neither."""


def blocks(signals: Signals, folds: int = 5, guard: float = 0.1) -> list[Split]:
    """Splits for cross-validation that never test on a repeat of training data.

    A motion that repeats itself is cut by its phase: all repeats of a block are held out together. Any other
    is cut by time.

    Args:
        signals: one motion.
        folds: number of blocks.
        guard: left out of training on both sides of a test block [s].

    Raises:
        InputError: too few samples for so many folds.
    """
    return [splits[0] for splits in blocks_many([signals], folds, guard)]


def blocks_many(
    signals: Sequence[Signals], folds: int = 5, guard: float = 0.1, rounds: int = 1
) -> list[list[Split]]:
    """`blocks` for several recordings: for each fold, one split a recording.

    Recordings that share motion share their blocks. A fold holds out one block of each of `rounds` parts of a
    recording: several leave something of every time in training. There are fewer where blocks would be shorter
    than thrice the guard. Time of which nothing is kept, as in a gap, belongs to no block.
    """
    clocks = _clocks(signals)
    result: list[list[Split]] = []
    for k in range(folds):
        splits = []
        for s, clock in zip(signals, clocks, strict=True):
            phase, length, cyclic = clock.recorded(s.times), clock.length, clock.cyclic
            test, near = np.zeros(len(phase), bool), np.zeros(len(phase), bool)
            count = folds * max(1, min(rounds, int(length / (3 * guard * folds)) if guard else rounds))
            for block in range(k, count, folds):
                low, high = block * length / count, (block + 1) * length / count
                test |= (phase >= low) & ((phase < high) | (block == count - 1))
                near |= (phase >= low - guard) & (phase < high + guard)
                if cyclic:
                    near |= (phase >= low - guard + length) | (phase < high + guard - length)
            splits.append((~test & ~near, test))
        result.append(splits)
    for k, splits in enumerate(result):
        if not any(test.any() for _, test in splits) or not any(train.any() for train, _ in splits):
            raise InputError(
                f"{signals[0].name}: too few samples for {folds} folds (fold {k + 1} is empty): record longer"
            )
    return result


def time_split(
    signals: Signals, fraction: float = 0.7, *, guard: float = 0.1, allow_repeats: bool = False
) -> Split:
    """Train on the first `fraction` of the time, test on the rest.

    Raises:
        InputError: the rest repeats training data, unless that is explicitly allowed.
    """
    t = signals.times
    border = t[0] + fraction * (t[-1] - t[0])
    train, test = t < border, t >= border + guard
    if not train.any() or not test.any():
        raise InputError(
            f"{signals.name}: a split at {fraction:g} of the time leaves one side empty: choose another"
        )
    if signals.period is not None and not allow_repeats and np.any(t[test] - signals.period >= t[0]):
        raise InputError(
            f"{signals.name}: the motion repeats itself after {signals.period:.3f} s, so that a test on what "
            f"comes after {border:.2f} s would repeat training data: use phase blocks"
        )
    return train, test


def _grid(recording: Recording) -> tuple[Float[np.ndarray, " time"], float, dict[str, int], tuple[str, ...]]:
    """The uniform grid, its step, and what putting the rows on it takes."""
    t = recording.time
    steps = np.diff(t)
    step = float(np.median(steps))
    count = np.round(steps / step)
    if np.all(count >= 1):  # refine the step over the whole recording, missing rows counted
        step = float((t[-1] - t[0]) / count.sum())
    else:  # stamps jitter by half a step and more: a usual period serves as well as the median
        usual = min(PERIODS, key=lambda period: abs(period / step - 1))
        step = usual if abs(usual / step - 1) < 0.02 else step
    time = t[0] + step * np.arange(int(np.floor((t[-1] - t[0]) / step + 1e-6)) + 1)
    off = np.abs((t - t[0]) / step - np.round((t - t[0]) / step)) > _UNIFORM
    nearest = np.searchsorted((t[1:] + t[:-1]) / 2, time)
    empty = int(np.sum(np.abs(t[nearest] - time) > 0.75 * step))
    repairs = {"grid points filled where rows are missing": empty} if empty else {}
    if off.any():
        repairs["rows moved to a uniform grid by interpolation"] = int(off.sum())
    gaps = steps[steps > LONGEST_GAP]
    notes = ()
    if gaps.size:
        notes = (
            f"{gaps.size} gaps longer than {LONGEST_GAP:g} s, the longest {gaps.max():.3g} s, are left out",
        )
    return time, step, repairs, notes


def resampled(
    time: Float[np.ndarray, " row"],
    x: Float[np.ndarray, "row dof"],
    grid: Float[np.ndarray, " time"],
    interpolate: Callable = scipy.interpolate.PchipInterpolator,
) -> Float[np.ndarray, "time dof"]:
    """x on the grid: as it is where rows lie on the grid, else interpolated.

    Torque is noisy: a monotone interpolation (PCHIP) cannot overshoot. Position is smooth: a cubic spline
    bridges missing rows with a tenth of the error in acceleration, unless the bridge is long.
    """
    if len(time) == len(grid) and np.allclose(time, grid, rtol=0, atol=1e-3 * (grid[1] - grid[0])):
        return x
    return interpolate(time, x)(np.clip(grid, time[0], time[-1]))


def _cutoffs(
    name: str, cutoff: float, derivative_cutoff: float | None, rate: float, notes: tuple[str, ...]
) -> tuple[float, tuple[str, ...]]:
    """The low-pass of q that fits a rate, once all cutoffs are possible."""
    asked = derivative_cutoff
    wanted = max(DERIVATIVE_CUTOFF, 2.5 * cutoff)
    chosen = min(wanted, 0.4 * rate) if asked is None else asked
    for what, value in (("cutoff", cutoff), ("derivative_cutoff", chosen)):
        if not 0 < value < 0.5 * rate:
            raise InputError(
                f"{name}: {what} {value:g} Hz, where a recording at {rate:.4g} Hz allows more than 0 and "
                f"less than {0.5 * rate:.4g} Hz"
            )
    if cutoff > chosen:
        raise InputError(
            f"{name}: cutoff {cutoff:g} Hz is above the low-pass of q at {chosen:g} Hz: lower it, or raise "
            "derivative_cutoff"
        )
    if asked is None and chosen < wanted:
        notes += (
            f"q is low-passed at {chosen:.3g} Hz instead of {wanted:g} Hz, for the rate of {rate:.4g} Hz",
        )
    return chosen, notes


def _kept(
    recording: Recording, time: Float[np.ndarray, " time"], step: float, trim: float, rate: float
) -> Int[np.ndarray, " kept"]:
    """The output grid: every n-th point, away from the ends and from long gaps."""
    if trim < 0 or not rate > 0:
        raise InputError(
            f"{recording.name}: trim {trim:g} s and rate {rate:g} Hz cannot be: use positive numbers"
        )
    stride = max(1, int(np.ceil(1 / (rate * step) - 1e-6)))
    slack = 1e-6 * step
    inside = (time >= time[0] + trim - slack) & (time <= time[-1] - trim + slack)
    t = recording.time
    for i in np.flatnonzero(np.diff(t) > LONGEST_GAP):
        inside &= (time <= t[i] - trim) | (time >= t[i + 1] + trim)
    places = np.arange(len(time))
    keep = places[inside & ((places - np.argmax(inside)) % stride == 0)]
    if len(keep) < 2:
        raise InputError(
            f"{recording.name}: {time[-1] - time[0]:.3g} s are too short, for {trim:g} s are left out at "
            "both ends and around gaps: record longer (a higher cutoff leaves out less)"
        )
    return keep


@dataclasses.dataclass(frozen=True)
class _Clock:
    """Time of a motion, which recordings that share it share."""

    offset: float
    """Of the recording's clock to the shared one [s]."""
    start: float
    """[s]"""
    cycle: float | None
    """After which the motion repeats itself [s]."""
    length: float
    """Recorded time: of a cycle or of the whole [s]."""
    gaps: Float[np.ndarray, "gaps 2"]
    """Where nothing is kept of any of the recordings: from and to, since the start [s]."""

    @property
    def cyclic(self) -> bool:
        return self.cycle is not None

    def phase(self, time: Float[np.ndarray, " kept"]) -> Float[np.ndarray, " kept"]:
        """Time since the start, or since the start of its cycle [s]."""
        since = time - self.offset - self.start
        return since if self.cycle is None else np.mod(since, self.cycle)

    def recorded(self, time: Float[np.ndarray, " kept"]) -> Float[np.ndarray, " kept"]:
        """Recorded time since then: gaps take none [s]."""
        phase = self.phase(time)
        return phase - sum(np.clip(phase - low, 0, high - low) for low, high in self.gaps)


def _clocks(signals: Sequence[Signals]) -> list[_Clock]:
    """Each recording's clock."""
    offsets = [0.0] * len(signals)
    group = list(range(len(signals)))
    for a, b in itertools.combinations(range(len(signals)), 2):
        found = _shift(signals[a].time, signals[a].q, signals[b].time, signals[b].q)
        if found is not None and group[a] != group[b]:
            move, joining = offsets[a] + found[0] - offsets[b], group[b]
            for j in [j for j, g in enumerate(group) if g == joining]:
                offsets[j], group[j] = offsets[j] + move, group[a]
    clocks: dict[int, _Clock] = {}
    for g in set(group):
        members = [j for j in range(len(signals)) if group[j] == g]
        clocks[g] = _shared_clock([signals[j] for j in members], [offsets[j] for j in members])
    return [dataclasses.replace(clocks[g], offset=offset) for g, offset in zip(group, offsets, strict=True)]


def _shared_clock(signals: Sequence[Signals], offsets: Sequence[float]) -> _Clock:
    """The clock of recordings that share their motion; its offset is nobody's."""
    start = min(s.times[0] - offset for s, offset in zip(signals, offsets, strict=True))
    end = max(s.times[-1] - offset for s, offset in zip(signals, offsets, strict=True))
    cycle = next((s.period for s in signals if s.period is not None), None)
    whole = _Clock(0.0, start, cycle, end - start if cycle is None else cycle, np.zeros((0, 2)))
    phases = [whole.phase(s.times - offset) for s, offset in zip(signals, offsets, strict=True)]
    phases = np.sort(np.concatenate(phases))
    step = max(1 / s.output_rate for s in signals)
    before = np.flatnonzero(np.diff(phases) > max(LONGEST_GAP, 2 * step))
    gaps = np.column_stack([phases[before] + step, phases[before + 1]])
    return dataclasses.replace(whole, length=whole.length - float(np.sum(gaps[:, 1] - gaps[:, 0])), gaps=gaps)


def _shift(
    time_a: Float[np.ndarray, " a"],
    q_a: Float[np.ndarray, "a dof"],
    time_b: Float[np.ndarray, " b"],
    q_b: Float[np.ndarray, "b dof"],
) -> tuple[float, float] | None:
    """The shift s with q_b(t + s) = q_a(t), and for how long [s]; None if no motion repeats.

    Shifts at which the mean square of q_b(t + s) - q_a(t) is small and smallest are tried: half of the path
    in the overlap must agree, and a tenth of the shorter path, for a second at least. Rest does not count,
    nor does how a motion starts and stops. Of one motion with itself the smallest such shift counts, of two
    that with most in common.
    """
    same = q_a is q_b
    grid_a, grid_b = (np.arange(t[0], t[-1], _SEARCH_STEP) for t in (time_a, time_b))
    a = _at(time_a, q_a, grid_a)
    b = a if same else _at(time_b, q_b, grid_b)
    if min(len(a), len(b)) * _SEARCH_STEP < 1.0:
        return None
    spread = float(np.sqrt(np.mean(np.sum((a - a.mean(axis=0)) ** 2, axis=1))))
    lags, distance = _distances(a, b, same)
    inner = (
        (distance[1:-1] < _PROMISING * spread)
        & (distance[1:-1] <= distance[:-2])
        & (distance[1:-1] < distance[2:])
    )
    tried = lags[1:-1][inner]
    if not same and 0 in lags:  # what started together is tried, even if its start and end differ
        tried = np.union1d(tried, [0])
    agreements = [_agreement(a, b, int(lag), REPEATS * spread) for lag in tried]
    found = [one for one in agreements if one is not None]
    if not found:
        return None
    shift, overlap = found[0] if same else max(found, key=lambda one: one[1])
    return shift + (0.0 if same else float(time_b[0] - time_a[0])), overlap


def _distances(
    a: Float[np.ndarray, "a dof"], b: Float[np.ndarray, "b dof"], same: bool
) -> tuple[Int[np.ndarray, " lag"], Float[np.ndarray, " lag"]]:
    """rms of b[i + lag] - a[i] over each overlap of a second or more, by squares and a correlation."""
    least = round(1.0 / _SEARCH_STEP)
    lags = np.arange(0 if same else least - len(a), len(b) - least + 1)
    first, last = np.maximum(0, -lags), np.minimum(len(a), len(b) - lags)  # what of a overlaps
    squares_a, squares_b = (np.concatenate([[0.0], np.cumsum(np.sum(x**2, axis=1))]) for x in (a, b))
    products = sum(scipy.signal.correlate(y, x, method="fft") for x, y in zip(a.T, b.T, strict=True))
    total = squares_a[last] - squares_a[first] + squares_b[last + lags] - squares_b[first + lags]
    mean = (total - 2 * np.asarray(products)[lags + len(a) - 1]) / (last - first)
    return lags, np.sqrt(np.maximum(mean, 0))


def _agreement(
    a: Float[np.ndarray, "a dof"], b: Float[np.ndarray, "b dof"], lag: int, tolerance: float
) -> tuple[float, float] | None:
    """The shift near a lag [s], to a fraction of a step, and how long a and b agree there [s], if they do."""
    first, last = max(0, -lag), min(len(a), len(b) - lag)
    x, y = a[first:last], b[first + lag : last + lag]
    speed = np.gradient(y, axis=0)
    agree = np.linalg.norm(y - x, axis=1) < tolerance + 0.5 * np.linalg.norm(speed, axis=1)
    if not agree.any() or not np.any(speed[agree]):
        return None
    late = -np.sum(speed[agree] * (y - x)[agree]) / np.sum(
        speed[agree] ** 2
    )  # steps, by linear least squares
    agree = np.linalg.norm(y + late * speed - x, axis=1) < tolerance
    path = np.linalg.norm(speed, axis=1)
    shorter = min(np.sum(np.linalg.norm(np.diff(z, axis=0), axis=1)) for z in (a, b))
    duration = float(np.sum(agree) * _SEARCH_STEP)
    if np.sum(path[agree]) < max(0.5 * np.sum(path), 0.1 * shorter) or duration < 1.0:
        return None
    return float((lag + late) * _SEARCH_STEP), duration


def _at(
    time: Float[np.ndarray, " time"], x: Float[np.ndarray, "time dof"], grid: Float[np.ndarray, " grid"]
) -> Float[np.ndarray, "grid dof"]:
    return np.column_stack([np.interp(grid, time, column) for column in x.T])
