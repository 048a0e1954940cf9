r"""What a prediction has to say of the recordings' torque that a diagnosis need not ask.

How friction turns: MuJoCo's constraint holds a joint almost without creep; the bristles of a gear yield by some
mrad, and what they hold at rest depends on where the joint came from; $\tanh(\dot q/v)$ is about their mean over
many motions. And how much of fast motion the torque shows: its channel may be filtered more than q is. A
diagnosis weighs such samples down. A prediction takes of each what is nearest to a joint's recorded torque; but
bristles, which a single rest may speak for, only where they are nearer by more than the standard error from
piece to piece of the recordings (Breiman et al., Classification and Regression Trees, 1984), of the joint or of
all joints together.
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
"""How friction of a gear may turn [rad/s, rad], beside MuJoCo's way."""
PLAIN = 2
"""Of these ways, the first that remember nothing: MuJoCo's and tanh."""
_FORGOTTEN = 3 * max(turn.size for turn in TURNS if turn.over == "distance")
"""Way from where a recording begins, after which bristles hold nothing of what they held there [rad]."""
CUTOFFS = (40.0, 30.0, 24.0, 20.0, 17.0, 14.0, 12.0, 10.0, 8.5, 7.0, 6.0, 5.0)
"""Low-passes of the motion that are tried [Hz]."""
LONG = 120.0
"""What of a recording is compared, from its start, at most [s]: more says the same again."""
MOST = 0.5
"""Of the squared error of predictions, what must be motion that the torque does not show."""


def as_recorded(whole: Sequence[Trajectory], corrected: Corrected, judged: Sequence[bool]) -> Corrected:
    """The same with friction at rest, and what of fast motion each joint's torque shows, as in the recordings.

    Of joints that were not `judged` their own torque tells nothing of friction, which may have carried any load
    at rest. Theirs is taken to turn as that of the arm does; fast motion in their torque is as in most others',
    unless that shows little of it itself.
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
    """How the friction of each joint turned. Joints of one arm are alike: what their recordings say of bristles
    together, each piece as a share of its joint's squared error, holds for those whose own say nothing of it."""
    arm = corrected.arm
    rubs = np.asarray(arm.frictionloss + corrected.frictionloss_change) != 0
    if not rubs.any():
        return ()
    ways = (None, *TURNS)
    each = [dataclasses.replace(corrected, turns=(way,) * arm.dof) for way in ways]
    pieces = np.stack([_pieces(moved, one, _FORGOTTEN) for one in each])
    shares = pieces / np.maximum(pieces[0].sum(0), 1e-300)
    known = np.asarray(judged) & rubs
    of_arm = _nearest(shares[:, :, known].reshape(len(ways), -1)) if known.any() else 0
    best = np.full(arm.dof, of_arm)
    for joint in np.flatnonzero(judged):
        own = pieces[:, :, joint]
        nearest = _nearest(own)
        silent = of_arm >= PLAIN > nearest and not _is_further(own, of_arm, nearest)
        best[joint] = of_arm if silent else nearest
    return tuple(ways[k] for k in best) if any(best) else ()


def _nearest(pieces: Float[np.ndarray, "ways pieces"]) -> int:
    """The way with the least squared error; of those that remember something only where the plain are further."""
    squares = pieces.sum(1)
    nearest = int(squares.argmin())
    plain = [k for k in range(PLAIN) if not _is_further(pieces, k, nearest)]
    return min(plain, key=lambda k: squares[k], default=nearest)


def _is_further(pieces: Float[np.ndarray, "ways pieces"], way: int, than: int) -> bool:
    """Whether a way has more squared error than another, by more than the standard error from piece to piece."""
    further = pieces[way] - pieces[than]
    return len(further) > 1 and bool(further.sum() > np.sqrt(len(further)) * further.std(ddof=1))


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


def _pieces(
    moved: Sequence[Trajectory], corrected: Corrected, away: float = 0.0
) -> Float[np.ndarray, "pieces dof"]:
    """The same for each piece of the recordings, from when a joint has been so far away from where it was."""
    out = []
    for one, names in zip(moved, _up_to(moved), strict=True):
        trace, torque = predicted(one, corrected, names)
        assert trace.tau is not None
        q = np.asarray(trace.motion.q)
        counts = (trace.weight > 0)[:, None] & (np.maximum.accumulate(np.abs(q - q[0])) >= away)
        squares = (trace.tau - torque) ** 2 * counts
        time = trace.motion.time
        count = max(round(float(time[-1] - time[0]) / PIECE), 1)
        out += [piece.sum(0) for piece in np.array_split(squares, count)]
    return np.array(out)


def _up_to(moved: Sequence[Trajectory]) -> list[list[str]]:
    """For each recording its name, after those before it."""
    names = [one.recording.name for one in moved]
    return [names[: k + 1] for k in range(len(names))]
