r"""What no effect of the catalogue explains, and no free curve either.

- A torque that is stuck: the sensor repeats its last value, or is at its limit, while the arm moves.
- A joint that stands off its noise, always or now and then.
- A joint that holds still throughout, off by more than friction may carry there.
- A torque that hums: a line in its spectrum, as the mains, a fan or a shaking floor leave, at one frequency
  whatever the arm does. It is looked for in the torque as measured, also above the band in which effects are
  fitted, under Hann's window. A motion's harmonics come many together, and what depends on the motion is as wide
  as that is uneven: a line counts that is far above everything near it.
"""

import dataclasses
from collections.abc import Collection, Sequence

import numpy as np
import scipy.ndimage
from jaxtyping import Float
from scipy.signal.windows import hann

from ..arms.arm import joints_named
from ..effects import UNNAMED, may_carry
from ..inference.problem import Problem
from ..inference.state import State, coefficients, mean_squares, misfit
from ..signals import Signals, white_noise
from ..traces import Trace
from .calibration import SUREST
from .finding import Finding, joined

BEYOND = 4.0
"""Mean square of a joint's error, over its noise's, from which it cannot be noise though nothing explains it."""
_COLOURED = 2.5
"""How much larger than its white part noise in the band may be."""
UNSURE = 3.0
"""Deviations by which noise's variance may be larger than it was estimated, and what else is estimated."""
_SMOOTHED, _PAUSE = 0.1, 0.3
"""Over which such an error is averaged, and a pause that does not end it [s]."""
_LOWEST, _NEARBY = 5.0, 2.0
"""From where lines are looked for, and how far around them nothing else may be [Hz]."""
_ALONE, _HEARD = 20.0, 0.5
"""By which factor a line's power exceeds any other there, and its rms over the noise's from which it counts."""
_LOBE = 3
"""Bins on either side that a line takes under the window."""


def standing_off(problem: Problem, state: State, named: Collection[int]) -> list[Finding]:
    """For each joint beyond its noise in which nothing was found, when it is.

    `named`: joints of what was found.
    """
    joints = range(problem.dof)
    counts = [
        np.stack([problem.weights(state.noise, r, j) for j in joints], 1) for r in range(len(problem.traces))
    ]
    x = state.design.x.copy()
    x[problem.shaken] = 0.0
    of_joints = [misfit(problem, state.terms, x, j) for j in joints]
    left = [np.stack(columns, 1) for columns in zip(*of_joints, strict=True)]
    parts = zip(left, problem.traces, counts, problem.active, strict=True)
    suspect = [(e, trace, count) for e, trace, count, on in parts if on]
    left = np.concatenate([e for e, _, _ in suspect])
    weights = np.concatenate([count for _, _, count in suspect])
    # what stands off now and then passes for noise of a joint; its torque from sample to sample shows less
    white = np.median([white_noise(t.signals.tau) for t in problem.traces if t.signals.tau is not None], 0)
    noise = np.minimum(state.noise.std, np.where(white > 0, _COLOURED * white, np.inf))  # 0: coarse steps
    free = np.array([problem.saturation.free(j) for j in joints])
    noise = noise * np.sqrt(1 + UNSURE * np.sqrt(2 / free))
    weight = np.maximum(np.mean(weights**2, 0), 1e-9)
    beyond = np.mean((left / noise * weights) ** 2, 0) / weight
    # what is slow, as friction that holds a joint at rest somewhere, is beyond noise only if its changes are
    beyond = np.minimum(
        beyond, mean_squares(problem, problem.noise(state.terms), state.terms, state.design.x)
    )
    far = set(np.flatnonzero(beyond >= BEYOND).tolist()) - set(named)
    return [
        _standing_off(j, float(beyond[j]), (noise**2 * weight)[j], suspect, problem.dof) for j in sorted(far)
    ]


def _standing_off(
    joint: int,
    beyond: float,
    unit: float,
    suspect: Sequence[tuple[np.ndarray, Trace, np.ndarray]],
    dof: int,
) -> Finding:
    """A joint whose error's mean square is so many times its noise's.

    Args:
        joint: which.
        beyond: how many times.
        unit: square of a weighted error that counts as one of the noise's [N² m²].
        suspect: what is left of each recording, and what its samples weigh.
        dof: how many joints there are.
    """
    seen = []
    for e, trace, count in suspect:
        power = (e[:, joint] * count[:, joint]) ** 2 / unit
        power = scipy.ndimage.uniform_filter1d(power, max(1, round(_SMOOTHED / trace.motion.dt)))
        seen.append((float(power[power > BEYOND].sum()), trace, trace.motion.time[power > BEYOND]))
    _, trace, times = max(seen, key=lambda one: one[0])
    when = joined([(float(t), float(t)) for t in times], _PAUSE)
    whole = not when or sum(b - a for a, b in when) > 0.5 * float(np.ptp(trace.motion.time))
    at = "" if whole else f" at times, in {trace.name} first from {when[0][0]:.2f} s to {when[0][1]:.2f} s"
    rms = np.zeros(dof)
    rms[joint] = np.sqrt(np.mean(np.concatenate([e[:, joint] for e, _, _ in suspect]) ** 2))
    samples = sum(np.count_nonzero(count[:, joint]) for _, _, count in suspect)
    return Finding(
        effect=UNNAMED,
        joints=(joint,),
        recordings=(trace.name,),
        intervals=None if whole else when,
        confidence=1 - 1 / beyond,
        equation="no law was found",
        rms_torque=rms,
        evidence=float(0.5 * samples * (beyond - 1 - np.log(beyond))),
        foretold=0.0,
        summary=f"Joint {joint + 1} is {np.sqrt(beyond):.1f} times its noise off the simulation{at}; neither a"
        " named effect nor a free curve explains it.",
    )


def held_off(problem: Problem, state: State) -> Finding | None:
    """Joints that hold still throughout a recording while its torque is further from the simulation's than
    friction at rest, and what the model's numbers are uncertain by, may carry; None where there are none.

    Friction that the model lacks may be what an arm like this has, or as much as any that was found in it.
    """
    dry = [
        np.concatenate(t.columns) @ coefficients(state, i) for i, t in enumerate(state.terms) if t.effect.dry
    ]
    found = max((float(np.sqrt(np.mean(torque**2, 0)).max()) for torque in dry), default=0.0)
    x = state.design.x
    seen: dict[int, tuple[float, Trace, np.ndarray]] = {}
    for r, (trace, on) in enumerate(zip(problem.traces, problem.active, strict=True)):
        if not on:
            continue
        arm, there = trace.motion.arm, trace.weight > 0
        friction = trace.residual_at_rest - trace.residual
        white = white_noise(trace.signals.tau) if trace.signals.tau is not None else np.zeros(arm.dof)
        rubs = np.asarray(arm.frictionloss) + np.maximum(UNSURE * may_carry(arm), found)
        for joint in np.flatnonzero(~trace.trust.any(0)).tolist():
            unsure = np.sqrt(np.sum(problem.nuisance[r][:, joint] ** 2, 1))
            off = (misfit(problem, state.terms, x, joint)[r] + friction[:, joint])[there]
            may = (rubs[joint] + _COLOURED * white[joint] + UNSURE * unsure)[there]
            times = float(np.mean(off**2) / np.mean(may**2))
            if times >= BEYOND and times > seen.get(joint, (0.0,))[0]:
                seen[joint] = times, trace, off
    if not seen:
        return None
    rms = np.zeros(problem.dof)
    rms[list(seen)] = [np.sqrt(np.mean(off**2)) for _, _, off in seen.values()]
    clearest = max(seen, key=lambda joint: seen[joint][0])
    times, trace, off = seen[clearest]
    return Finding(
        effect=UNNAMED,
        joints=tuple(sorted(seen)),
        recordings=tuple(dict.fromkeys(trace.name for _, trace, _ in seen.values())),
        confidence=1 - 1 / times,
        equation="no law was found",
        rms_torque=rms,
        evidence=float(0.5 * len(off) * (times - 1 - np.log(times))),
        summary=f"Joint {clearest + 1} holds still throughout {trace.name}, and its torque is"
        f" {rms[clearest]:.3g} {problem.arm.unit('N·m', clearest)} rms off the simulation's,"
        f" {np.sqrt(times):.1f} times what friction at rest may carry.",
    )


def stuck(problem: Problem, std: Float[np.ndarray, " dof"]) -> Finding | None:
    """Torque that repeats itself while the arm moves, in the recording that has most of it; None if none does.

    `std`: deviation of each joint's noise [N m].
    """
    suspect = [trace for trace, on in zip(problem.traces, problem.active, strict=True) if on]
    trace = max(suspect, key=lambda t: sum(stop - start for _, start, stop in t.stuck))
    if not trace.stuck:
        return None
    joints = tuple(sorted({joint for joint, _, _ in trace.stuck}))
    when = joined(sorted((start, stop) for _, start, stop in trace.stuck), 0.0)
    error = np.zeros(trace.residual.shape)
    for joint, start, stop in trace.stuck:
        inside = (trace.motion.time >= start) & (trace.motion.time <= stop)
        error[inside, joint] = trace.residual[inside, joint]
    rms = np.sqrt((error**2).sum(0) / np.maximum((error != 0).sum(0), 1))
    return Finding(
        effect=UNNAMED,
        joints=joints,
        recordings=(trace.name,),
        intervals=when,
        confidence=SUREST,
        equation="tau = constant",
        rms_torque=rms,
        evidence=float(0.5 * np.sum((error / std) ** 2)),
        summary=f"The measured torque of {joints_named(joints)} is stuck in {trace.name}, first from"
        f" {when[0][0]:.2f} s to {when[0][1]:.2f} s, while the arm moves: a sensor that repeats itself or is at"
        " its limit. What it gave then was not used.",
    )


def hum(
    recordings: Sequence[Signals],
    active: Sequence[bool],
    std: Float[np.ndarray, " dof"],
    lowest: float = _LOWEST,
) -> Finding | None:
    """Lines of one frequency in the measured torque that stand alone in its spectrum; None if there are none.

    Args:
        recordings: all of them.
        active: which are of the arm in question; what a healthy one hums too is not told.
        std: deviation of each joint's noise [N m].
        lowest: frequency from which lines are looked for [Hz].
    """
    pairs = [(one, _lines(one, std, lowest), on) for one, on in zip(recordings, active, strict=True)]
    usual = [line for _, lines, on in pairs if not on for line in lines.values()]
    new = [
        (one, {j: line for j, line in lines.items() if not any(map(line.is_at, usual))})
        for one, lines, on in pairs
        if on
    ]
    if not any(lines for _, lines in new):
        return None
    clearest = max((line for _, lines in new for line in lines.values()), key=lambda line: line.alone)
    same = [(one, {j: line for j, line in lines.items() if line.is_at(clearest)}) for one, lines in new]
    each = sorted(((j, line) for _, x in same for j, line in x.items()), key=lambda one: one[1].amplitude)
    loudest = dict(sorted(dict(each).items()))  # of each joint the last
    rms = np.zeros(len(std))
    rms[list(loudest)] = [line.amplitude / np.sqrt(2) for line in loudest.values()]
    told = [("frequency", None, clearest.frequency, clearest.spread, "Hz")]
    told += [("amplitude", j + 1, line.amplitude, line.deviation, "N·m") for j, line in loudest.items()]
    return Finding(
        effect=UNNAMED,
        joints=tuple(loudest),
        recordings=tuple(one.name for one, lines in same if lines),
        confidence=1 - 1 / clearest.alone,
        equation="tau = amplitude * sin(2 pi frequency t + phase)",
        parameters=tuple(
            dict(zip(("name", "joint", "value", "std", "unit"), one, strict=True)) for one in told
        ),
        rms_torque=rms,
        evidence=sum(0.5 * (line.amplitude / line.deviation) ** 2 for _, x in same for line in x.values()),
        summary=f"The measured torque of {joints_named([*loudest])} hums at "
        f"{clearest.frequency:.2f} Hz whatever the arm does, with up to {np.sqrt(2) * rms.max():.2g} N·m.",
    )


def _lines(one: Signals, std: Float[np.ndarray, " dof"], lowest: float) -> dict[int, "_Line"]:
    """Those of a recording that count, by joint."""
    if one.tau is None:
        return {}
    least = _HEARD * np.sqrt(2) * np.maximum(white_noise(one.tau), std)
    found = {j: _line(x, one.rate, lowest) for j, x in enumerate(one.tau.T)}
    return {j: line for j, line in found.items() if line is not None and line.amplitude > least[j]}


@dataclasses.dataclass(frozen=True)
class _Line:
    """A sine in noise."""

    frequency: float
    """[Hz]"""
    spread: float
    """Standard deviation of the frequency [Hz]."""
    amplitude: float
    deviation: float
    """Of the amplitude."""
    alone: float
    """Power over the greatest nearby."""
    resolved: float
    """Distance from which another is another [Hz]."""

    def is_at(self, other: "_Line") -> bool:
        """Whether the other has the same frequency."""
        return abs(self.frequency - other.frequency) < self.resolved + other.resolved


def sines(x: Float[np.ndarray, " time"]) -> Float[np.ndarray, " frequencies"]:
    """Amplitude of the sine at each of the frequencies of `np.fft.rfftfreq`, under Hann's window."""
    window = hann(len(x), sym=False)
    return 2 * np.abs(np.fft.rfft((x - x.mean()) * window)) / window.sum()


def _line(x: Float[np.ndarray, " time"], rate: float, lowest: float) -> _Line | None:
    """The line that stands out most."""
    step = rate / len(x)
    wide = int(_NEARBY / step)
    half = (wide - _LOBE - 1) // 2
    if half < 2 * _LOBE:
        return None  # too short to tell a line from what is beside it
    sine = sines(x)
    # the greatest on either side, beyond the line's own bins
    most = scipy.ndimage.maximum_filter1d(np.pad(sine, 2 * wide), 2 * half + 1, mode="constant")
    below, above = (most[2 * wide + side * (_LOBE + 1 + half) :][: len(sine)] for side in (-1, 1))
    alone = (sine / np.maximum(np.maximum(below, above), 1e-300)) ** 2
    alone[: int(np.ceil(lowest / step))] = 0.0
    alone[-_LOBE:] = 0.0
    top = int(alone.argmax())
    if alone[top] < _ALONE:
        return None
    # between bins, as Hann's window has it
    side = 1 if sine[top + 1] > sine[top - 1] else -1
    ratio = sine[top + side] / sine[top]
    off = float(np.clip((2 * ratio - 1) / (ratio + 1), 0.0, 0.5))
    amplitude = float(sine[top] * (1 - off**2) / np.sinc(off))
    beside = np.r_[sine[max(0, top - wide) : top - _LOBE], sine[top + _LOBE + 1 : top + wide]]
    deviation = float(np.sqrt(np.median(beside**2) / np.log(4)))
    spread = step * deviation / amplitude  # by simulation; a little less where the line is strong
    return _Line((top + side * off) * step, spread, amplitude, deviation, float(alone[top]), step)
