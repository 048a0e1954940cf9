r"""What a prediction has to say of the recordings' torque that a diagnosis need not ask.

How friction turns: MuJoCo's constraint holds a joint almost without creep; the bristles of a gear yield by some
mrad, and what they hold at rest depends on where the joint came from; $\tanh(\dot q/v)$ is about their mean over
many motions. And how much of fast motion the torque shows: its channel may be filtered more than q is. A
diagnosis weighs such samples down. A prediction takes of each what is nearest to a joint's recorded torque; but
bristles, which a single rest may speak for, only where they are nearer by more than the standard error from
piece to piece of the recordings (Breiman et al., Classification and Regression Trees, 1984).
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..corrected import Corrected, Recorded
from ..effects import Turn
from ..traces import PIECE, Trajectory, trajectory
from .predict import predicted

TURNS = (Turn("speed", 0.01), *(Turn("distance", x) for x in (3e-4, 7e-4, 1.5e-3, 3e-3, 6e-3)))
"""How friction of a gear may turn [rad/s, rad]."""
CUTOFFS = (40.0, 30.0, 24.0, 20.0, 17.0, 14.0, 12.0, 10.0, 8.5, 7.0, 6.0, 5.0)
"""Low-passes of the motion that are tried [Hz]."""
LONG = 120.0
"""What of a recording is compared, from its start, at most [s]: more says the same again."""
MOST = 0.5
"""Of the squared error of predictions, what must be motion that the torque does not show."""


def as_recorded(whole: Sequence[Trajectory], corrected: Corrected, judged: Sequence[bool]) -> Corrected:
    """The same with friction at rest, and what of fast motion each joint's torque shows, as in the recordings.

    Of joints that were not `judged` their own torque tells nothing of friction, which may have carried any load
    at rest. Theirs is taken to turn as that of most others does; so is fast motion in their torque, unless that
    shows little of it itself.
    """
    moved = [_beginning(one) for one in whole]
    best = dataclasses.replace(corrected, turns=_turns(moved, corrected, judged))
    each = [dataclasses.replace(best, cutoffs=(cutoff,) * corrected.arm.dof) for cutoff in CUTOFFS]
    slower = [_squares(moved, one) for one in each]
    # a smaller share may be noise of q, and another motion faster
    filtered = np.min(slower, 0) < MOST * _squares(moved, best)
    cutoffs = np.where(filtered, np.array(CUTOFFS)[np.argmin(slower, 0)], np.inf)
    known = np.sort(cutoffs[np.asarray(judged)])
    cutoffs[~np.asarray(judged) & ~filtered] = known[len(known) // 2] if len(known) else np.inf
    recorded = Recorded.of([one.recording for one in whole])
    below = tuple(float(cutoff) if np.isfinite(cutoff) else None for cutoff in cutoffs)
    return dataclasses.replace(best, cutoffs=below if any(below) else (), recorded=recorded)


def _turns(
    moved: Sequence[Trajectory], corrected: Corrected, judged: Sequence[bool]
) -> tuple[Turn | None, ...]:
    """How the friction of each joint turned; where that was not judged, as in most others that rub."""
    rubs = np.asarray(corrected.arm.frictionloss + corrected.frictionloss_change) != 0
    if not rubs.any():
        return ()
    ways = (None, *TURNS)
    each = [dataclasses.replace(corrected, turns=(way,) * corrected.arm.dof) for way in ways]
    pieces = np.stack([_pieces(moved, one) for one in each])
    squares = pieces.sum(1)
    nearest = squares.argmin(0)
    further = pieces - np.take_along_axis(pieces, nearest[None, None], 0)
    count = further.shape[1]
    error = np.sqrt(count) * np.std(further, 1, ddof=1) if count > 1 else np.inf
    # MuJoCo's and tanh, which remember nothing
    plain = np.where(further.sum(1) <= error, squares, np.inf)[:2]
    nearest = np.where(np.isfinite(plain).any(0), plain.argmin(0), nearest)
    others = nearest[rubs & judged]
    nearest[~np.asarray(judged)] = np.argmax(np.bincount(others)) if len(others) else 0
    return tuple(ways[k] for k in nearest) if any(nearest) else ()


def misleading(whole: Sequence[Trajectory], corrected: Corrected, count: int) -> set[int]:
    """Which of the last `count` effects make the recordings' own torque be predicted worse.

    A search compares motion and torque below the frequency up to which both are known; a prediction shows all of
    the motion. What only fitted the slow part is no law of this arm.
    """
    traces, names = [predicted(one, corrected)[0] for one in whole], _up_to(whole)
    counts = np.concatenate([t.weight > 0 for t in traces])
    measured = np.concatenate([np.asarray(t.tau) for t in traces])[counts]
    squares = lambda x: np.maximum(np.sum((measured - x) ** 2, 0), 1e-300)

    def predicted_by(one: Corrected) -> Float[np.ndarray, "rows dof"]:
        said = [
            one.measured_torque(t.motion, t.channels, t.sign, before)
            for t, before in zip(traces, names, strict=True)
        ]
        return np.concatenate(said)[counts]

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


def _beginning(moved: Trajectory) -> Trajectory:
    """The first `LONG` of a recording."""
    recording = moved.recording
    count = int(np.searchsorted(recording.time, recording.time[0] + LONG, "right"))
    if count == recording.samples:
        return moved
    return trajectory(recording.at(slice(count)))


def _squares(moved: Sequence[Trajectory], corrected: Corrected) -> Float[np.ndarray, " dof"]:
    """Of the errors of predicted torque in all recordings, without gaps, in sum [N² m²]."""
    return _pieces(moved, corrected).sum(0)


def _pieces(moved: Sequence[Trajectory], corrected: Corrected) -> Float[np.ndarray, "pieces dof"]:
    """The same for each piece of the recordings."""
    out = []
    for one, names in zip(moved, _up_to(moved), strict=True):
        trace, torque = predicted(one, corrected, names)
        assert trace.tau is not None
        squares = (trace.tau - torque) ** 2 * (trace.weight > 0)[:, None]
        time = trace.motion.time
        count = max(round(float(time[-1] - time[0]) / PIECE), 1)
        out += [piece.sum(0) for piece in np.array_split(squares, count)]
    return np.array(out)


def _up_to(moved: Sequence[Trajectory]) -> list[list[str]]:
    """For each recording its name, after those before it."""
    names = [one.recording.name for one in moved]
    return [names[: k + 1] for k in range(len(names))]
