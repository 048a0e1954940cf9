"""What every format's rows must satisfy before they become a `Recording`."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

from ..errors import InputError
from .clock import on_clock
from .glitches import without_glitches
from .recording import Recording

RATES = (50.0, 4000.0)
"""Sample rates that occur [Hz]."""
SHORTEST = 0.25
"""Nothing can be said about a motion shorter than this [s]."""
STRONGEST = 1e9
"""No joint bears such a torque [N m]."""
_MARGIN = 1.1  # on `RATES`: a nominal 50 Hz log may run at 48
_TURN = 2 * np.pi
_WRAPS = 0.5
"""How far from a whole turn the jump of a wrapped angle is [rad]: what the joint turns from row to row."""
_LEAPS = 30.0
"""Speed beyond which it is a jump, where rows are missing [rad/s]."""
_RESETS = 0.05
"""How far a position that jumps does so, at least [rad]."""
_STAYS = 0.1
"""How long it is there then, at least [s]."""
_APART = 3.0
"""How many times faster than the rows beside it."""
_EMPTY = 50.0
"""How many times as many samples as there are rows may be missing from a recording."""
_UNLIKE, _ALIKE = 0.5, 0.9
"""Correlations of dq with d(q)/dt below which it is not that joint's, and from which it is another's."""
_TRAVELS = 0.5
"""How far a joint moves that says which unit positions are in [rad]."""
_FASTEST = 10.0
"""Speed that a joint reaches at most, from one row to the next or where it turns on [rad/s]."""


def checked(recording: Recording, row: Callable[[int], str] | None = None) -> Recording:
    """The same recording, once it is long enough and in SI units; of readings that
    stand alone (`glitches`) the rows are left out, samples that were uniform are on their ticks (`clock`),
    and that is told.

    Args:
        recording: as read.
        row: how the file counts sample `i` (0-based), for messages.

    Raises:
        InputError: naming file, column and row, and what would work.
    """
    row = row or (lambda i: f"row {i + 1}")
    _rate(recording)
    _on_and_on(recording, row)
    _long_enough(recording)
    _unwrapped(recording, row)
    recording = without_glitches(recording)
    _units(recording)
    _continuous(recording)
    return on_clock(recording)


def plausible(recording: Recording) -> Recording:
    """The same recording, once its rate and units are those of an arm; for recordings that came from no file.

    Raises:
        InputError: naming what is not, and what would work.
    """
    row = lambda i: f"row {i + 1}"
    _rate(recording)
    _on_and_on(recording, row)
    _unwrapped(recording, row)
    _units(recording)
    _continuous(recording)
    return recording


def _units(recording: Recording) -> None:
    _radians(recording)
    _newton_metres(recording)
    _same_order(recording)
    _velocity_unit(recording)


def _rate(recording: Recording) -> None:
    if recording.samples < 2:
        return
    step = float(np.median(np.diff(recording.time)))
    fastest, slowest = 1 / (RATES[1] * _MARGIN), _MARGIN / RATES[0]
    if fastest <= step <= slowest:
        return
    for unit, short, factor in (
        ("milliseconds", "ms", 1e3),
        ("microseconds", "us", 1e6),
        ("nanoseconds", "ns", 1e9),
    ):
        if fastest <= step / factor <= slowest:
            raise InputError(
                f"{recording.name}: column time looks like {unit} (its median step is {step:g}), where "
                f"seconds are needed: divide it by {factor:g}, or say it, as --columns"
                f" time={recording.called('time')}:{short}"
            )
    raise InputError(
        f"{recording.name}: column time has a median step of {step:g} s ({1 / step:g} Hz), where sample "
        f"rates from {RATES[0]:g} Hz to {RATES[1]:g} Hz in seconds can be used: check its unit, or record at "
        "such a rate"
    )


def _on_and_on(recording: Recording, row: Callable[[int], str]) -> None:
    """No stamp is so far from the rest that next to nothing of the time was recorded: motions go on a grid."""
    if recording.samples < 2:
        return
    steps = np.diff(recording.time)
    span = float(recording.time[-1] - recording.time[0])
    if span < _EMPTY * recording.samples * float(np.median(steps)):
        return
    i = int(np.argmax(steps)) + 1
    before, after = recording.time[i - 1 : i + 1]
    part = f"--from {after:.10g}" if i < recording.samples / 2 else f"--to {before:.10g}"
    raise InputError(
        f"{recording.name}: column time, {row(i)}: time jumps from {before:.10g} s to {after:.10g} s, and of"
        f" {span:.4g} s no more than {span - steps.max():.4g} s are recorded: read what lies on one side of it"
        f" ({part}), or mend the stamp"
    )


def _long_enough(recording: Recording) -> None:
    duration = recording.time[-1] - recording.time[0] if recording.samples else 0.0
    if duration < SHORTEST:
        raise InputError(
            f"{recording.name}: too short, {recording.samples} row{'s' * (recording.samples != 1)} over "
            f"{duration:g} s, where at least {SHORTEST} s are needed (a few seconds of motion to filter it, "
            "ten or more to identify)"
        )


def _unwrapped(recording: Recording, row: Callable[[int], str]) -> None:
    """No joint turns by a whole turn between two rows, or over one more that a resampling put in between."""
    for apart in (1, 2):
        step = recording.q[apart:] - recording.q[:-apart]
        elapsed = (recording.time[apart:] - recording.time[:-apart])[:, None]
        jumps = (np.abs(np.abs(step) - _TURN) < _WRAPS) & (np.abs(step) > _LEAPS * elapsed)
        if apart == 2 and len(step):  # beside which nothing is fast: in degrees every step may be that wide
            jumps &= np.abs(step) > 2 * _APART * np.quantile(
                np.abs(np.diff(recording.q, axis=0)), 0.9, axis=0
            )
        if not jumps.any():
            continue
        j = int(np.argmax(jumps.any(0)))
        i = int(np.argmax(jumps[:, j])) + apart
        before, after = recording.q[i - apart, j], recording.q[i, j]
        if apart == 2:
            raise InputError(
                f"{recording.name}: column q_{j + 1}, {row(i - 1)}: the angle jumps by a turn ({before:.4g} rad,"
                f" then {recording.q[i - 1, j]:.4g} and {after:.4g} rad), as where wrapped angles were resampled:"
                " unwrap them before that, as numpy.unwrap(q, axis=0) does"
            )
        cure = (_without_edge(recording, i) if jumps.sum() == 1 else "") or (
            ", where positions must be continuous: unwrap them, as numpy.unwrap(q, axis=0) does"
        )
        if np.max(np.abs(recording.q[:, j])) > 4 * _TURN:
            cure += "; or, if the joint slides, by millimetres, say so, as"
            cure += f" --columns {_of_joint(recording, j)}:mm"
        raise InputError(
            f"{recording.name}: column q_{j + 1}, {row(i)}: the angle jumps by a turn ({before:.4g} rad, then "
            f"{after:.4g} rad; {int(jumps.sum())} such jumps in all){cure}"
        )


def _continuous(recording: Recording) -> None:
    """No position jumps, and stays there, between two rows, as where an encoder was reset while the log ran on.

    A joint that comes there within what has passed since its position last changed has turned: rows were lost.
    """
    if recording.samples < 2:
        return
    every = float(np.median(np.diff(recording.time)))
    stays = _rows_of(recording, _STAYS)
    for j, q in enumerate(recording.q.T):
        at = np.flatnonzero(np.diff(q)) + 1
        step, elapsed = q[at] - q[at - 1], np.diff(recording.time[np.r_[0, at]])
        speed = np.abs(step) / np.maximum(elapsed, every)
        wide = np.pad(speed, 2)
        beside = np.max([wide[k : k + len(speed)] for k in (0, 1, 3, 4)], 0)
        alone = (np.abs(step) > _RESETS) & (speed > _FASTEST) & (speed > _APART * beside)
        for i, size in zip(at[alone], step[alone], strict=True):
            if not np.all((q[i : i + stays] - q[i - 1]) / size > 0.5):
                continue
            cure = _without_edge(recording, int(i)) or (
                " and stays there, as where an encoder is reset while the log runs on, where positions must be"
                " continuous: read one side of it (--to, --from), or record again"
            )
            raise InputError(
                f"{recording.name}: column q_{j + 1} jumps from {q[i - 1]:.4g} rad to {q[i]:.4g} rad at "
                f"{recording.time[i]:.6g} s{cure}"
            )


def _without_edge(recording: Recording, i: int) -> str:
    """How to leave out the rows before a jump to row `i`, or from there on, where these are few; else nothing."""
    stays = _rows_of(recording, _STAYS)
    if min(i, recording.samples - i) >= stays:
        return ""
    where, option, kept = ("beginning", "--from", i) if i < stays else ("end", "--to", i - 1)
    return f", its {where}: leave those rows out ({option} {recording.time[kept]:.10g})"


def _rows_of(recording: Recording, duration: float) -> int:
    return max(1, round(duration / float(np.median(np.diff(recording.time)))))


def _radians(recording: Recording) -> None:
    """Joints turn a few times at most: two joints beyond two turns, or one beyond four, are degrees.

    Unless all others stay within a turn, move about there, and nothing is fast: of numbers in degrees few are so
    small. That dq agrees with q says nothing, as both may be in degrees.
    """
    furthest = np.max(np.abs(recording.q), axis=0)
    far = furthest > 2 * _TURN
    if (np.sum(far) < 2 and not np.any(furthest > 4 * _TURN)) or _turns_on(recording, far):
        return
    j = int(np.argmax(furthest))
    row = int(np.argmax(np.abs(recording.q[:, j])))
    raise InputError(
        f"{recording.name}: column q_{j + 1} reaches {recording.q[row, j]:g} at {recording.time[row]:g} "
        "s, which looks like degrees where radians are needed, or like millimetres of a joint that slides: "
        f"multiply positions (and velocities) by pi/180, or say it, as --columns {_in_degrees(recording)}, "
        f"of one joint {_of_joint(recording, j)}:mm; if they are radians of a joint that turns on, take whole"
        " turns off it, or cut the recording"
    )


def _of_joint(recording: Recording, j: int) -> str:
    """How `--columns` says one joint's position, its unit to follow."""
    return f"q_{j + 1}={recording.called(f'q_{j + 1}')}"


def _in_degrees(recording: Recording) -> str:
    """How `--columns` says that positions, and velocities where there are any, are in degrees."""
    velocities = "" if recording.qd is None else f" dq={recording.called('dq')}:deg/s"
    return f"q={recording.called('q')}:deg{velocities}"


def _turns_on(recording: Recording, far: Bool[np.ndarray, " dof"]) -> bool:
    """Whether the joints that go far turn on, beside others that move as joints do in radians."""
    near, apart = recording.q[:, ~far], max(1, round(0.1 * recording.rate))
    elapsed = (recording.time[apart:] - recording.time[:-apart])[:, None]
    speed = np.abs(recording.q[apart:] - recording.q[:-apart]) / elapsed
    moves = np.any(np.ptp(near, axis=0) > _TRAVELS) and np.all(np.abs(near) < _TURN)
    return bool(moves and np.all(speed < _FASTEST))


def _newton_metres(recording: Recording) -> None:
    if recording.tau is None or (size := np.abs(recording.tau)).max() < STRONGEST:
        return
    row, j = np.unravel_index(np.argmax(size), size.shape)
    raise InputError(
        f"{recording.name}: column tau_{j + 1} reaches {recording.tau[row, j]:g} at {recording.time[row]:g} s, "
        "which no joint bears: check its unit (N m), or leave out the rows that were not measured"
    )


def _velocity_unit(recording: Recording) -> None:
    """dq = k d(q)/dt with k near a conversion factor is a wrong unit of one of the two."""
    k = velocity_scale(recording)
    if k is None:
        return
    for factor, cure in (
        (
            180 / np.pi,
            "dq looks like degrees per second: multiply it by pi/180, or say --columns"
            f" dq={recording.called('dq')}:deg/s",
        ),
        (
            np.pi / 180,
            "q looks like degrees beside dq in rad/s: multiply q by pi/180, or say --columns"
            f" q={recording.called('q')}:deg",
        ),
        (30 / np.pi, "dq looks like revolutions per minute: multiply it by pi/30"),
        (1e3, "dq is a thousand times d(q)/dt: check the units of time and dq"),
        (1e-3, "dq is a thousandth of d(q)/dt: check the units of time and dq"),
    ):
        if abs(k / factor - 1) < 0.1:
            raise InputError(
                f"{recording.name}: columns dq_1 ... dq_{recording.dof} are {k:.3g} times d(q)/dt: {cure}"
            )


def _same_order(recording: Recording) -> None:
    """dq of a joint that is d(q)/dt of another, and that one's of this or a third: q or dq is out of order."""
    if (pair := _slopes(recording)) is None:
        return
    least = np.finfo(float).tiny
    pair = tuple(x / np.maximum(np.abs(x).max(0), least) for x in pair)  # squares may overflow
    slope, qd = (x / np.maximum(np.linalg.norm(x, axis=0), least) for x in pair)
    alike = qd.T @ slope
    other = np.argmax(alike, 1)
    moved = np.flatnonzero(other != np.arange(recording.dof))
    moved = moved[(np.diag(alike)[moved] < _UNLIKE) & (alike[moved, other[moved]] > _ALIKE)]
    if len(moved) and set(moved) == set(other[moved]):
        each = ", ".join(f"dq_{i + 1} is d(q_{other[i] + 1})/dt" for i in moved)
        raise InputError(
            f"{recording.name}: {each}: columns of q or of dq are in each other's place: write them in "
            "the order of the joints, or say which are which (--columns)"
        )


def velocity_scale(recording: Recording) -> float | None:
    """k of the least-squares fit dq = k d(q)/dt over 20 ms; None where it explains little."""
    if (pair := _slopes(recording)) is None:
        return None
    slope, qd = pair
    sizes = float(np.abs(slope).max()), float(np.abs(qd).max())
    slope, qd = slope / sizes[0], qd / sizes[1]  # squares of what some files hold overflow
    k = np.sum(slope * qd) / np.sum(slope**2) * (sizes[1] / sizes[0])
    correlation = np.sum(slope * qd) / np.sqrt(np.sum(slope**2) * np.sum(qd**2))
    return float(k) if abs(correlation) > 0.8 else None


def _slopes(
    recording: Recording,
) -> tuple[Float[np.ndarray, "rows dof"], Float[np.ndarray, "rows dof"]] | None:
    """d(q)/dt over 20 ms and dq there; None where either is all zero, or the recording too short."""
    if recording.qd is None:
        return None
    half = max(1, round(0.01 / float(np.median(np.diff(recording.time)))))
    if recording.samples < 4 * half + 4:
        return None
    dt = recording.time[2 * half :] - recording.time[: -2 * half]
    slope = (recording.q[2 * half :] - recording.q[: -2 * half]) / dt[:, None]
    qd = recording.qd[half:-half]
    return (slope, qd) if np.any(slope) and np.any(qd) else None
