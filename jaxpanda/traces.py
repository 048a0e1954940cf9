"""Recordings made ready for diagnosis: one fine grid for physics with corners, one coarse grid for statistics.

What is nonlinear in velocity, has memory or high order is evaluated on the fine grid and low-passed exactly like
the torque; what is smooth is evaluated on the coarse grid. The coarse grid's rate is two to two and a half times
the cutoff of the torque: an autoregressive noise model on samples closer than that would undo the filter.
"""

import dataclasses
import functools
import itertools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import scipy.interpolate
import scipy.ndimage
from jaxtyping import Array, Bool, Float, Int

from . import signals as signals_
from .arms.arm import Arm
from .arms.mjcf import SOLIMP, SOLREF
from .effects import Channels, Motion, Stretches, Turn, masses
from .errors import InputError
from .recordings import Recording
from .smoothing import RATIO, Smoothed, continued_derivatives, smooth

WORK_RATE = 100.0
"""Rate of the coarse grid, at most [Hz]."""
_LONG, _LEAST_RATE = 40.0, 20.0
"""How long recordings may be together at that rate [s]; of longer ones as many samples are taken, at a lower
rate, but at no lower one than the motion of an arm needs [Hz]."""
FINER = 10.0
"""Rate of the fine grid over that of the coarse one, at most."""
POSITION_CUTOFF = 12.0
"""Low-pass of q before it is differentiated, at most, where the torque shows no faster motion [Hz]."""
_LEAST_CUTOFF = 5.0
"""The least low-pass of q [Hz]."""
PIECE = 2.0
"""Of a recording, about as long as a motion between two rests [s]."""
TRIM = 0.4
"""Left out at both ends of a recording [s]."""
_HELD = 0.01
"""Travel of a joint that friction may hold all the time, yielding both ways [rad]: bristles of real gears give
way by 2 to 4 mrad before they break away."""
_GAP, _NEAR = 3.5, 0.12
"""Missing steps that make a gap, and how far beyond it samples do not count [s]."""
_BESIDE_GAP, _LEAST_BESIDE = 0.06, 8
"""Rows beside a gap that tell where and how fast the arm was: of so long [s], and at least so many."""
_SHAKEN = (2.5, 5.0)
"""Where the bands begin in which noise of q, differentiated twice, may outweigh the motion [Hz]."""
_NOISE_SHARE = 0.5
"""Deviation of the share of an acceleration there that is noise."""
_APART = float(np.sqrt(1 / 12))
"""Deviation of the instants of position and torque in a row, in rows: anywhere in it."""
_SHARPER, _SHARP = 2.5, 6.0
"""Where motion is looked for that a filter took away, in its cutoffs; and how far above noise it must be."""
_RINGING = 0.2
"""Share of it with which the filter of q still rings a period of its cutoff away."""
_FROZEN, _MOVES = 0.1, 5.0
"""Torque that repeats itself for so long [s], while it must change by so many noises, is stuck."""
_AT_ONCE = 24
"""Samples of the coarse grid that one product filters."""
_UNFELT = 1e-12
"""Share of the low-pass filter's response that is cut off at either end."""
_FELT = 0.4
"""Share of the coarse grid's rate up to which it holds motion and torque."""


@dataclasses.dataclass(frozen=True)
class Trace:
    """One recording: channels on the fine grid, motion, torque and nominal residual on the coarse one."""

    name: str
    signals: signals_.Signals
    channels: Channels
    """On the fine grid."""
    dt: float
    """Step of the fine grid [s]."""
    motion: Motion
    """On the coarse grid."""
    tau: Float[np.ndarray, "time dof"] | None
    """Measured torque, low-passed [N m]."""
    weight: Float[np.ndarray, " time"]
    """0 where the coarse grid lies in a gap of the recording, else 1."""
    keep: np.ndarray
    """The coarse grid as indices into the fine one."""
    cutoff: float
    """Of the low-pass of torque and columns [Hz]."""
    sign: Float[np.ndarray, "fine dof"]
    """Share of its frictionloss at which each joint's friction stands, on the fine grid."""
    trust: Float[np.ndarray, "time dof"]
    """What a sample weighs in each joint, 0 to 1: less where nothing tells which way known friction points, and
    where the motion is sharper than the filter of q lets through or its positions jump; none where the joint
    never moves, as friction at rest may carry any part of its load, and none where its torque is stuck."""
    sharp: bool = False
    """Whether its torque shows faster motion than the noise of q lets through."""
    unsure: Float[np.ndarray, "time dof"] | None = None
    """1 where the sign of a joint's velocity cannot be told, else 0: friction at rest may carry any load."""
    moving: Float[np.ndarray, "time dof"] | None = None
    """`trust`, were known friction known at rest too; None for `trust`."""
    stuck: tuple[tuple[int, float, float], ...] = ()
    """Joint, start and stop [s] of stretches in which measured torque repeats itself although it must change."""
    friction_shown: Float[Array | np.ndarray, "2 dof"] | None = None
    """How much more friction than the model's recordings show, where `showing` was told."""

    @functools.cached_property
    def stretches(self) -> Stretches:
        """The channels as the columns of effects are made from them."""
        return Stretches(self.channels)

    @property
    def weights(self) -> Float[np.ndarray, "time dof"]:
        """`weight` and `trust` together."""
        return self.weight[:, None] * self.trust

    @functools.cached_property
    def scatter(self) -> Float[np.ndarray, "time dof"]:
        """Mean square of each sample's weighted noise, over that of others: 1, but less where friction at rest
        may hold any load. A sample weighs less there, and has no more noise."""
        if self.moving is None:
            return self.weights**2
        return self.weight[:, None] * (self.trust / self.moving) ** 2

    @property
    def too_sharp(self) -> Float[np.ndarray, "time dof"]:
        """Variance, over that of the noise, of what torque may be off by where the motion is too sharp."""
        return np.zeros_like(self.trust) if self.moving is None else 1 / self.moving**2 - 1

    @property
    def residual(self) -> Float[np.ndarray, "time dof"]:
        """Measured less nominal torque [N m]."""
        assert self.tau is not None
        return self.tau - self.motion.torque

    @property
    def residual_at_rest(self) -> Float[np.ndarray, "time dof"]:
        """`residual` with the model's Coulomb friction left out, of which a joint at rest shows no sign [N m]."""
        assert self.tau is not None
        return self.tau - self.motion.load - np.asarray(self.motion.arm.damping) * self.motion.qd

    @property
    def torque_step(self) -> Float[np.ndarray, " dof"]:
        """What measured torque is written in, at most: the least difference between two rows [N m]."""
        assert self.signals.tau is not None
        return np.minimum(_least_step(self.signals.tau), 1e9)

    @functools.cached_property
    def shaken(self) -> Float[np.ndarray, "time dof columns"]:
        r"""What was recorded otherwise than it was may have put into the nominal torque, by its deviations.

        Noise of the encoders, in the bands where it is most of $\ddot q$: $M_{\cdot k}(q)$ times joint k's
        acceleration in each. And in a sharp motion that position and torque of a row were taken some part of
        a row apart, or torque jumped at the instant of a row: $\dot\tau$ times that time.
        """
        qdd, rate = self.motion.qdd, 1 / self.motion.dt
        below = [signals_.zero_phase(qdd, cutoff, rate) for cutoff in _SHAKEN if cutoff < 0.45 * rate]
        bands = [high - low for low, high in itertools.pairwise([*below, qdd])]
        apart = np.gradient(self.motion.load, self.motion.dt, axis=0) / self.signals.rate
        noise = [_NOISE_SHARE * self.motion.mass * band[:, None] for band in bands]
        return np.concatenate([*noise, self.sharp * _APART * apart[:, :, None]], 2)

    def showing(self, friction: Float[Array | np.ndarray, "2 dof"] | None) -> "Trace":
        """The same, where recordings show so much more friction than the model has: viscous [N m s/rad] and
        Coulomb [N m]; None for as much."""
        if friction is None:
            return self
        viscous, coulomb = np.asarray(friction)
        more = viscous * self.channels.qd + coulomb * self.sign
        channels = dataclasses.replace(self.channels, torque=self.channels.torque + more)
        motion = self.motion.showing(self.down(more))
        return dataclasses.replace(self, channels=channels, motion=motion, friction_shown=friction)

    def as_sharp_as(self, share: Float[np.ndarray, " dof"]) -> "Trace":
        """The same, where recordings show in each joint that share of the variance `too_sharp`."""
        if self.moving is None:
            return self
        less = (1 - share) * self.too_sharp
        trust = 1 / np.sqrt(1 / np.maximum(self.trust, 1e-30) ** 2 - less)
        moving = 1 / np.sqrt(1 / self.moving**2 - less)
        return dataclasses.replace(self, trust=np.where(self.trust > 0, trust, 0.0), moving=moving)

    def down(self, fine: Float[np.ndarray, "fine ..."]) -> Float[np.ndarray, "time ..."]:
        """From the fine grid to the coarse one, filtered like the torque."""
        if len(self.keep) < 2 or self.keep[1] - self.keep[0] == 1:
            return fine[self.keep]
        stride, response = int(np.min(np.diff(self.keep))), self._response
        reach = len(response) // 2
        if self.keep[0] < reach or self.keep[-1] + reach >= len(fine):
            return signals_.zero_phase(fine, self.cutoff, 1 / self.dt)[self.keep]
        x = fine.reshape(len(fine), -1)[self.keep[0] - reach : self.keep[-1] + reach + 1]
        count = (self.keep[-1] - self.keep[0]) // stride + 1
        out = np.empty((count, x.shape[1]))
        wide = (_AT_ONCE - 1) * stride + len(response)
        H = np.zeros((_AT_ONCE, wide))
        for i in range(_AT_ONCE):
            H[i, i * stride : i * stride + len(response)] = response
        for i in range(0, count, _AT_ONCE):
            part = x[i * stride : i * stride + wide]
            out[i : i + _AT_ONCE] = H[: count - i, : len(part)] @ part
        return out.reshape(count, *fine.shape[1:])[(self.keep - self.keep[0]) // stride]

    @functools.cached_property
    def _response(self) -> Float[np.ndarray, " taps"]:
        """The zero-phase filter's answer to one sample; products with it are faster than its recursion."""
        reach = int(np.ceil(40 / (2 * np.pi * np.cos(3 * np.pi / 8) * self.cutoff * self.dt)))
        impulse = np.zeros(2 * reach + 1)
        impulse[reach] = 1.0
        response = signals_.zero_phase(impulse, self.cutoff, 1 / self.dt)
        felt = np.cumsum(np.abs(response)) > _UNFELT
        return response[np.argmax(felt) : len(response) - np.argmax(felt)]


def work_rate(recordings: Sequence[Recording]) -> float:
    """Rate of the coarse grid for some recordings, such that long ones fit into memory [Hz]."""
    seconds = sum(float(r.time[-1] - r.time[0]) for r in recordings)
    return max(_LEAST_RATE, WORK_RATE * _LONG / max(seconds, _LONG))


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """A whole recording on a uniform grid, ends and gaps included, differentiated as exactly as q allows."""

    recording: Recording
    signals: signals_.Signals
    smoothed: Smoothed
    slowest: Float[np.ndarray, "time dof"]
    """Speeds that noise of q may pretend [rad/s]."""
    jitter: Float[np.ndarray, "time dof"]
    """Travel that it may pretend [rad]."""

    def trace(self, arm: Arm, turns: Sequence[Turn | None] = (), below: float = np.inf) -> Trace:
        """On the grids of a prediction.

        Args:
            arm: whose torque is to be predicted; without links, where the recording says what they take.
            turns: how each joint's Coulomb friction turns; None, or no entries: as MuJoCo's constraint does.
            below: low-pass of the motion, where that is lower than what q shows [Hz].
        """
        rate = self.signals.rate
        motion = self.smoothed.q, self.smoothed.qd, self.smoothed.qdd
        if below < _most(rate):
            motion = tuple(signals_.zero_phase(x, below, rate) for x in motion)
        keep = np.arange(0, len(self.signals.time), _thinnest(rate, WORK_RATE))
        pretended = self.slowest, self.jitter
        return _on_grids(self.recording, self.signals, keep, motion, pretended, arm, turns, WORK_RATE)


def trajectory(recording: Recording) -> Trajectory:
    """A recording, or a motion without torque, for predictions."""
    signals = signals_.prepare(recording, cutoff=3.0, rate=WORK_RATE, trim=0.0)
    rate, time, rows = signals.rate, signals.time, recording.time
    position = _across_gaps(_splined(recording, time), rows, recording.q, time, rate)
    step = _written_in(recording)
    moved = smooth(position, step, rate, _most(rate))
    noise = signals_.position_noise(position)
    return Trajectory(recording, signals, moved, *_pretended(noise, step, moved.cutoff, rate))


def _most(rate: float) -> float:
    """The highest low-pass of q in a trajectory of that rate [Hz]."""
    return min(signals_.DERIVATIVE_CUTOFF, 0.25 * rate)


def prepare(recording: Recording, arm: Arm, *, coarse: float = WORK_RATE) -> Trace:
    """A recording on its two grids, for a diagnosis.

    Args:
        recording: with torque, or a motion.
        arm: whose nominal torque is to be compared; without links, where the recording says what they take.
        coarse: rate of the coarse grid, at most; motion above 0.4 of it is left out, as in the torque [Hz].
    """
    rough = signals_.prepare(recording, cutoff=3.0, rate=coarse, trim=TRIM)
    rate, time, keep = rough.rate, rough.time, rough.keep
    position = _splined(recording, time)
    noise = None if rough.tau is None else signals_.white_noise(rough.tau)
    most = min(_FELT * coarse, 0.4 * rate)
    cutoff_q = least = min(position_cutoff(position, noise, arm, rate), most)
    if noise is not None:
        cutoff_q = _cutoff_shown(recording, rough, position, arm, least, most)
    q, qd, qdd = continued_derivatives(position, cutoff_q, rate)
    noise_q = signals_.position_noise(position)
    pretended = _pretended(noise_q, _written_in(recording), cutoff_q, rate)
    trace = _on_grids(recording, rough, keep, (q, qd, qdd), pretended, arm, (), coarse)
    doubtful = signals_.unsure_sign(position, qd, qdd, noise_q, cutoff_q, rate)[keep]
    trace = dataclasses.replace(trace, unsure=doubtful, sharp=cutoff_q > least)
    if noise is None:
        return trace
    motion = trace.motion
    unsure = np.asarray(arm.frictionloss) * doubtful
    cut_off = _cut_off(position, qdd, cutoff_q, rate)[keep]
    too_sharp = (np.abs(motion.mass) @ cut_off[:, :, None])[:, :, 0]
    trust, moving = (
        1 / np.sqrt(1 + (off / np.maximum(noise, 1e-12)) ** 2)
        for off in (np.hypot(unsure, too_sharp), too_sharp)
    )
    trust[:, np.ptp(motion.q, axis=0) < _HELD] = 0.0
    stuck = () if recording.tau is None else _stuck(recording.time, recording.tau, motion, noise)
    for joint, start, stop in stuck:
        trust[(motion.time > start - _NEAR) & (motion.time < stop + _NEAR), joint] = 0.0
    return dataclasses.replace(trace, trust=trust, moving=moving, stuck=stuck)


def _on_grids(
    recording: Recording,
    signals: signals_.Signals,
    keep: np.ndarray,
    moved: Sequence[Float[np.ndarray, "time dof"]],
    pretended: Sequence[Float[np.ndarray, "*time dof"]],
    arm: Arm,
    turns: Sequence[Turn | None],
    coarse: float,
) -> Trace:
    """A motion, its derivatives and its torque on a fine grid and on the coarse one of the samples `keep`.

    `pretended`: the speed and the travel of a joint at rest that noise may pretend [rad/s, rad].
    """
    rate, time = signals.rate, signals.time
    stride = int(np.min(np.diff(keep)))
    thin = next(k for k in range(min(stride, _thinnest(rate, coarse)), 0, -1) if stride % k == 0)
    fine = np.arange(keep[0] % thin, len(time), thin)
    kept, dt = (keep - fine[0]) // thin, thin / rate
    cutoff = _coarse_cutoff(rate, stride)
    q, qd, qdd = moved
    slowest, jitter = (np.broadcast_to(x, q.shape)[fine] for x in pretended)
    settled = _settled(q[fine], jitter)
    moves = np.diff(settled, axis=0) != 0
    travels = np.pad(moves, ((1, 0), (0, 0))) | np.pad(moves, ((0, 1), (0, 0)))

    sign = held_sign(arm, qd[fine], qdd[fine], slowest)
    for joint, turn in enumerate(turns):
        if turn is not None:
            sign[:, joint] = turn.share(settled[:, joint], qd[fine, joint])
    held_fine = np.asarray(arm.damping) * qd[fine] + np.asarray(arm.frictionloss) * sign
    held = held_fine[kept]
    if stride > thin:
        held = signals_.zero_phase(held_fine, cutoff, 1 / dt)[kept]
    tau, passed = _torques(recording, signals, keep)
    motion = Motion(arm, time[keep], q[keep], qd[keep], qdd[keep], held, passed)

    def finely(x: np.ndarray) -> np.ndarray:
        if len(kept) == len(fine):
            return x
        return scipy.interpolate.CubicSpline(motion.time, x)(np.clip(time[fine], *motion.time[[0, -1]]))

    load, shown = finely(motion.load), None if tau is None else finely(tau)
    channels = Channels(
        time[fine], q[fine], qd[fine] * travels, qdd[fine], load, load + held_fine, shown, sign
    )
    weight = _weight(recording.time, time[keep], rate)
    trust = np.ones(motion.q.shape)
    return Trace(recording.name, signals, channels, dt, motion, tau, weight, kept, cutoff, sign, trust)


def _coarse_cutoff(rate: float, stride: int) -> float:
    """Low-pass of what is taken at every so manyth sample [Hz]."""
    return min(_FELT * rate / stride, 0.45 * rate)


def _torques(
    recording: Recording, signals: signals_.Signals, keep: Int[np.ndarray, " coarse"]
) -> tuple[Float[np.ndarray, "coarse dof"] | None, Float[np.ndarray, "coarse dof"] | None]:
    """Measured torque and what drives pass on to the links, low-passed, at the samples `keep` [N m]."""
    stride, rate = int(np.min(np.diff(keep))), signals.rate
    cutoff = _coarse_cutoff(rate, stride)
    coarsely = lambda x: (signals_.zero_phase(x, cutoff, rate) if stride > 1 else x)[keep]
    passed = recording.transmitted
    return (
        None if signals.tau is None else coarsely(signals.tau),
        None if passed is None else coarsely(signals_.resampled(recording.time, passed, signals.time)),
    )


def _settled(
    q: Float[np.ndarray, "time dof"], jitter: Float[np.ndarray, "time dof"]
) -> Float[np.ndarray, "time dof"]:
    """Positions that go one way from one reversal to the next, and no sooner than they must; of reversals those
    count that lead back by more than twice `jitter`.

    Noise of a joint at rest is no motion: as one it would wear away what bent bristles hold.
    """
    more = (1 << (len(q) - 1).bit_length()) - len(q)  # few lengths, few compilations
    given = (np.pad(x, ((0, more), (0, 0)), "edge") for x in (q, 2 * jitter))
    turned, since = (np.asarray(x)[: len(q)] for x in _reversals(*given))
    out = np.empty(q.shape)
    for joint, column in enumerate(q.T):
        ways = np.split(column, since[turned[:, joint], joint])
        limits = (np.maximum if k % 2 else np.minimum for k in range(len(ways)))
        out[:, joint] = np.concatenate(
            [limit.accumulate(way[::-1])[::-1] for limit, way in zip(limits, ways, strict=True)]
        )
    return out


@jax.jit
def _reversals(
    q: Float[Array, "time dof"], least: Float[Array, "time dof"]
) -> tuple[Bool[Array, "time dof"], Int[Array, "time dof"]]:
    """Where a joint has come back by so much from the farthest that it went, upwards first, and since when."""

    def step(state, now):
        way, farthest, since = state
        k, here, back = now
        on, turns = way * (here - farthest) >= 0, way * (farthest - here) > back
        kept = (
            jnp.where(turns, -way, way),
            jnp.where(on | turns, here, farthest),
            jnp.where(on | turns, k, since),
        )
        return kept, (turns, since)

    begins = jnp.ones_like(q[0]), q[0], jnp.zeros(q.shape[1], int)
    return jax.lax.scan(step, begins, (jnp.arange(len(q)), q, least))[1]


def _pretended(
    noise: Float[np.ndarray, " dof"],
    step: Float[np.ndarray, " dof"],
    cutoff: float | Float[np.ndarray, "time dof"],
    rate: float,
) -> tuple[Float[np.ndarray, "*time dof"], Float[np.ndarray, "*time dof"]]:
    """Speed and travel that noise of q, behind its low-pass, may pretend of a joint at rest [rad/s, rad]."""
    travel = signals_.REST * noise * np.sqrt(2 * cutoff / rate) + 0.5 * step
    return signals_.REST * signals_.velocity_noise(noise, cutoff, rate), travel


def _written_in(recording: Recording) -> Float[np.ndarray, " dof"]:
    """The steps of each joint's encoder [rad]; 0 where it never moves."""
    step = _least_step(recording.q)
    return np.where(np.isfinite(step), step, 0.0)


def _thinnest(rate: float, coarse: float) -> int:
    """Every how many samples the fine grid takes one, at most."""
    return max(1, int(rate / (FINER * coarse) + 1e-6))


def _splined(recording: Recording, time: Float[np.ndarray, " time"]) -> Float[np.ndarray, "time dof"]:
    """Positions on a grid, by a cubic spline through the rows."""
    rows = recording.time
    return scipy.interpolate.CubicSpline(rows, recording.q)(np.clip(time, *rows[[0, -1]]))


def _stuck(
    time: Float[np.ndarray, " rows"],
    measured: Float[np.ndarray, "rows dof"],
    motion: Motion,
    noise: Float[np.ndarray, " dof"],
) -> tuple[tuple[int, float, float], ...]:
    """Where a joint's torque is the same from row to row for long, while the nominal torque changes by far more
    than its noise and the steps it is written in."""
    out = []
    for joint, tau in enumerate(measured.T):
        steps = np.abs(np.diff(tau))
        written = float(np.min(steps[steps > 0], initial=np.inf))
        edges = np.flatnonzero(np.diff(np.r_[False, steps == 0, False]))
        for first, last in edges.reshape(-1, 2):
            start, stop = float(time[first]), float(time[last])
            if stop - start < _FROZEN:
                continue
            inside = (motion.time >= start) & (motion.time <= stop)
            if inside.any() and np.ptp(motion.torque[inside, joint]) > _MOVES * max(noise[joint], written):
                out.append((joint, start, stop))
    return tuple(out)


def _across_gaps(
    position: Float[np.ndarray, "time dof"],
    rows: Float[np.ndarray, " rows"],
    q: Float[np.ndarray, "rows dof"],
    time: Float[np.ndarray, " time"],
    rate: float,
) -> Float[np.ndarray, "time dof"]:
    """`position`, the spline through all rows, with the cubic that meets parabolas fitted to the rows on either
    side across a gap: there a spline multiplies the noise by the gap's length in rows."""
    out = position.copy()
    gaps = np.flatnonzero(np.diff(rows) > _GAP / rate)
    runs = np.concatenate([[0], gaps + 1, [len(rows)]])
    reach = max(_LEAST_BESIDE, round(_BESIDE_GAP * rate))
    for i, k in enumerate(gaps):
        before, after = (
            slice(max(runs[i], k + 1 - reach), k + 1),
            slice(k + 1, min(runs[i + 2], k + 1 + reach)),
        )
        inside = (time > rows[k]) & (time < rows[k + 1])
        if min(before.stop - before.start, after.stop - after.start) < _LEAST_BESIDE or not inside.any():
            continue
        ends = [
            np.polynomial.polynomial.polyfit(rows[p] - rows[at], q[p], 2)
            for p, at in ((before, k), (after, k + 1))
        ]
        value, slope = (np.stack([end[order] for end in ends]) for order in (0, 1))
        out[inside] = scipy.interpolate.CubicHermiteSpline(rows[k : k + 2], value, slope)(time[inside])
    return out


def _weight(
    rows: Float[np.ndarray, " rows"], grid: Float[np.ndarray, " time"], rate: float
) -> Float[np.ndarray, " time"]:
    """0 near gaps, where the filters spread what interpolation made up."""
    weight = np.ones(len(grid))
    for k in np.flatnonzero(np.diff(rows) > _GAP / rate):
        weight[(grid > rows[k] - _NEAR) & (grid < rows[k + 1] + _NEAR)] = 0.0
    return weight


def _cut_off(
    q: Float[np.ndarray, "time dof"], qdd: Float[np.ndarray, "time dof"], cutoff: float, rate: float
) -> Float[np.ndarray, "time dof"]:
    """Acceleration that the filtered positions are off by [rad/s²]: what the filter takes away, where that is far
    above its noise, and a share of it as long as the filter rings around there; else 0.

    Positions that jump, as where a row repeats the one before, are no motion, and what the filter leaves of them
    is off. Of a jump the acceleration grows as the square of the frequency, from band to band; of the sharpest
    motion, a velocity that jumps, as the frequency.
    """
    acceleration = lambda below: continued_derivatives(q, min(below, 0.4 * rate), rate)[2]
    noise = lambda x: np.median(x, axis=0) / 0.6745
    around = lambda x, reach: scipy.ndimage.maximum_filter1d(x, 2 * round(rate * reach) + 1, axis=0)
    sharper = acceleration(_SHARPER * cutoff)
    lost = np.abs(sharper - qdd)
    lost = np.where(lost > _SHARP * noise(lost), lost, 0.0)
    if _SHARPER**2 * cutoff <= 0.4 * rate:
        above = np.abs(acceleration(_SHARPER**2 * cutoff) - sharper)
        grown = around(above - _SHARP * noise(above), 1 / cutoff)
        jumps = grown > _SHARPER**1.5 * around(lost, 1 / cutoff)
        lost = np.where(jumps, lost / (_SHARPER**2 - 1), lost)
    return np.maximum(around(lost, 2 * signals_.BESIDE), _RINGING * around(lost, 1 / cutoff))


def held_sign(
    arm: Arm,
    qd: Float[np.ndarray, "time dof"],
    qdd: Float[np.ndarray, "time dof"],
    least: Float[np.ndarray, "*time dof"],
) -> Float[np.ndarray, "time dof"]:
    r"""Share of its frictionloss at which each joint's friction stands in MuJoCo, -1 to 1.

    A soft constraint holds the joint: $f = \mathrm{clip}((\ddot q + b\,\dot q)/R, \pm F_c)$, b and R as the
    file has them (`mjcf.friction_law`), or by MuJoCo's defaults for an arm from no file. On a light joint
    that is far from a sign of the velocity; on a heavy one it would turn noise of a joint at rest into
    friction, so the velocity over which it saturates is `least` [rad/s] at least.
    """
    b, R = (None if law is None else np.asarray(law) for law in (arm.friction_rate, arm.friction_slack))
    if b is None or R is None:
        impedance, most = SOLIMP[:2]
        b = np.full(arm.dof, 2 / (most * SOLREF[0]))
        M = masses(arm, np.zeros((1, arm.dof)))[0]
        try:
            mobility = np.diag(np.linalg.inv(M))
        except np.linalg.LinAlgError:
            raise InputError(
                "the model's mass matrix is singular: a joint moves nothing; give its links mass or armature"
            ) from None
        R = (1 - impedance) / impedance * np.maximum(mobility, 1e-9)
    width = np.maximum(np.asarray(arm.frictionloss) * R, b * np.maximum(least, 1e-6))
    return np.clip((b * qd + qdd) / np.maximum(width, 1e-12), -1.0, 1.0)


def position_cutoff(
    q: Float[np.ndarray, "time dof"], noise: Float[np.ndarray, " dof"] | None, arm: Arm, rate: float
) -> float:
    r"""Where the noise of q, differentiated twice and times the inertia, reaches the noise of the torque [Hz].

    $M\,(2\pi f)^2\,\sigma_q = \sigma_\tau$ for the joint where that happens first; without noise, the most.
    """
    most = min(POSITION_CUTOFF, 0.25 * rate)
    if noise is None:
        return most
    M = np.diag(masses(arm, q.mean(0)[None])[0])
    crossing = np.sqrt(noise / np.maximum(np.abs(M) * signals_.position_noise(q), 1e-12)) / (2 * np.pi)
    return float(np.clip(1.3 * crossing.min(), min(_LEAST_CUTOFF, most), most))


def _cutoff_shown(
    recording: Recording,
    signals: signals_.Signals,
    q: Float[np.ndarray, "time dof"],
    arm: Arm,
    least: float,
    most: float,
) -> float:
    r"""Of low-passes of q, from `least` to `most`, the one whose motion the torque shows best [Hz].

    Noise of q says which acceleration is certain; how much faster the arm did move, the torque. Of each joint
    that is what is left of it beside $a\,\tau_{nominal} + J \ddot q + d\,\dot q + f\,\mathrm{sign}(\dot q) + b$;
    and less must be left than with the lowest by more than the standard error from piece to piece (Breiman et
    al., Classification and Regression Trees, 1984).
    """
    keep = signals.keep
    tau, passed = _torques(recording, signals, keep)
    assert tau is not None
    time, cutoffs = signals.time[keep], [least]
    while cutoffs[-1] < most:
        cutoffs.append(min(cutoffs[-1] * RATIO, most))
    counts = _weight(recording.time, time, signals.rate) > 0
    pieces = np.array_split(np.flatnonzero(counts), max(2, round(float(time[-1] - time[0]) / PIECE)))
    floor = np.maximum(signals_.white_noise(tau), 1e-12)
    left = []
    for cutoff in cutoffs:
        here, qd, qdd = (x[keep] for x in continued_derivatives(q, cutoff, signals.rate))
        load = Motion(arm, time, here, qd, qdd, np.zeros_like(tau), passed).load
        rest = np.empty_like(tau)
        for j in range(tau.shape[1]):
            x = [load[:, j], qdd[:, j], qd[:, j], np.sign(qd[:, j]), np.ones(len(time))]
            A, y = np.stack(x, 1), tau[:, j]
            rest[:, j] = y - A @ np.linalg.lstsq(A[counts], y[counts])[0]
        squares = [np.mean(rest[rows] ** 2, 0) + 1e-6 * floor**2 for rows in pieces]
        left.append(np.sum(np.log(squares), 1))
    gained = left[0] - np.array(left)
    best = int(np.argmax(gained.mean(1)))
    sure = gained[best].mean() > gained[best].std(ddof=1) / np.sqrt(len(pieces))
    return cutoffs[best] if sure else least


def _least_step(x: Float[np.ndarray, "rows dof"]) -> Float[np.ndarray, " dof"]:
    """The least difference between two rows, which is what they are written in; infinite where all are alike."""
    steps = np.abs(np.diff(x, axis=0))
    return np.min(np.where(steps > 0, steps, np.inf), axis=0, initial=np.inf)
