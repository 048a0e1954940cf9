r"""What a prediction has to say of the recordings' torque that a diagnosis need not ask.

Friction at rest: MuJoCo's constraint holds a joint almost without creep; the bristles of a gear yield by some
mrad. What they do depends on where the joint came from, which few recordings tell, so for them it is
$\tanh(\dot q/v)$, about their mean over many motions. And how much of fast motion the torque shows: its channel
may be filtered more than q is. A diagnosis weighs such samples down. A prediction takes of each what is nearer to
the recordings' torque.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..corrected import Corrected
from ..recordings import Recording
from .traces import Trace, prepare

GEAR = 0.01
"""Velocity over which the friction of a gear turns [rad/s]."""
CUTOFFS = (40.0, 30.0, 20.0, 15.0, 10.0, 7.0, 5.0)
"""Low-passes of the motion that are tried [Hz]."""
LONG = 120.0
"""What of a recording is compared, from its start, at most [s]: more says the same again."""
MOST = 0.5
"""Of the squared error of predictions, what must be motion that the torque does not show."""


def as_recorded(
    recordings: Sequence[Recording], corrected: Corrected, noise: Float[np.ndarray, " dof"]
) -> Corrected:
    """The same with friction at rest, and what of fast motion each joint's torque shows, as in the recordings."""
    recordings = [_beginning(recording) for recording in recordings]
    best, (measured, torque) = corrected, _compared(recordings, corrected, noise)
    squares = lambda x: np.maximum(np.sum((measured - x) ** 2, 0), 1e-300)
    if np.any(np.asarray(corrected.arm.frictionloss + corrected.frictionloss_change)):
        gear = dataclasses.replace(corrected, turning=GEAR)
        other = _compared(recordings, gear, noise)[1]
        if np.sum(np.log(squares(other) / squares(torque))) < 0:
            best, torque = gear, other
    slower = []
    for cutoff in CUTOFFS:
        everywhere = dataclasses.replace(best, cutoffs=(cutoff,) * corrected.arm.dof)
        slower.append(squares(_compared(recordings, everywhere, noise)[1]))
    least = np.min(slower, 0)
    # a smaller share may be noise of q, and another motion faster
    filtered = least < MOST * squares(torque)
    cutoffs = [CUTOFFS[k] if low else None for k, low in zip(np.argmin(slower, 0), filtered, strict=True)]
    return dataclasses.replace(best, cutoffs=tuple(cutoffs) if any(filtered) else ())


def misleading(
    recordings: Sequence[Recording], corrected: Corrected, noise: Float[np.ndarray, " dof"], count: int
) -> set[int]:
    """Which of the last `count` effects make the recordings' own torque be predicted worse.

    A search compares motion and torque below the frequency up to which both are known; a prediction shows all of
    the motion. What only fitted the slow part is no law of this arm.
    """
    traces = [predicted(recording, corrected, noise)[0] for recording in recordings]
    counts = np.concatenate([t.weight > 0 for t in traces])
    measured = np.concatenate([np.asarray(t.tau) for t in traces])[counts]
    squares = lambda x: np.maximum(np.sum((measured - x) ** 2, 0), 1e-300)

    def predicted_by(one: Corrected) -> Float[np.ndarray, "rows dof"]:
        return np.concatenate([one.measured_torque(t.motion, t.channels, t.sign) for t in traces])[counts]

    torque, own = predicted_by(corrected), {}
    first = len(corrected.effects) - count
    for i in range(count):
        effects, values = list(corrected.effects), list(corrected.coefficients)
        del effects[first + i], values[first + i]
        less = dataclasses.replace(corrected, effects=tuple(effects), coefficients=tuple(values))
        own[i] = torque - predicted_by(less)
    gone = set[int]()
    while own:
        costs = {i: np.sum(np.log(squares(torque - part) / squares(torque))) for i, part in own.items()}
        worst = min(costs, key=lambda i: costs[i])
        if costs[worst] >= 0:
            break
        torque = torque - own.pop(worst)
        gone.add(worst)
    return gone


def predicted(
    recording: Recording, corrected: Corrected, noise: Float[np.ndarray, " dof"]
) -> tuple[Trace, Float[np.ndarray, "time dof"]]:
    """A motion on the grid of a prediction, and the torque there [N m]."""
    out: dict[float | None, tuple[Trace, np.ndarray]] = {}
    cutoffs = corrected.cutoffs or (None,) * corrected.arm.dof
    for cutoff in dict.fromkeys(cutoffs):
        trace = prepare(
            recording, corrected.arm, whole=True, noise=noise, turning=corrected.turning, below=cutoff
        )
        out[cutoff] = trace, corrected.measured_torque(trace.motion, trace.channels, trace.sign)
    torque = np.stack([out[cutoff][1][:, joint] for joint, cutoff in enumerate(cutoffs)], 1)
    return out[cutoffs[0]][0], torque


def _beginning(recording: Recording) -> Recording:
    """The first `LONG` of a recording."""
    count = int(np.searchsorted(recording.time, recording.time[0] + LONG, "right"))
    if count == recording.samples:
        return recording
    channels = {name: getattr(recording, name) for name in ("time", "q", "qd", "tau", "stamps")}
    cut = {name: x[:count] for name, x in channels.items() if x is not None}
    return dataclasses.replace(recording, **cut, row=None)


def _compared(
    recordings: Sequence[Recording], corrected: Corrected, noise: Float[np.ndarray, " dof"]
) -> tuple[Float[np.ndarray, "rows dof"], Float[np.ndarray, "rows dof"]]:
    """Measured and predicted torque of all recordings, without gaps."""
    both = []
    for recording in recordings:
        trace, torque = predicted(recording, corrected, noise)
        assert trace.tau is not None
        both.append((trace.tau[trace.weight > 0], torque[trace.weight > 0]))
    measured, torque = (np.concatenate(parts) for parts in zip(*both, strict=True))
    return measured, torque
