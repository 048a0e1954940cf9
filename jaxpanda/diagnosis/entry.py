"""`diagnose`: which physics a simulation is missing, by recordings."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from ..arms import markup
from ..arms.arm import Arm
from ..arms.export import panda_mjcf
from ..arms.mjcf import with_gravity
from ..arms.model_file import Model
from ..arms.source import from_document, from_mjcf
from ..effects import AbstractEffect, catalogue_with
from ..errors import InputError, require_x64
from ..host import on_host
from ..inference import knowledge as knowledge_
from ..recordings import Recording, distinct, load
from ..session import Say, silent
from ..traces import Trace, prepare, work_rate
from .diagnosis import Diagnosis, sought
from .meaning import Misread, misread
from .resting import AtRest, judge, rests, while_still
from .two_sided import TwoSided, both, drive_alone, links_alone, notes_of, on_drives, on_motors
from .written import file_with

Found = TypeVar("Found", AtRest, Misread)


@on_host
def diagnose(
    model: Model | None,
    recordings: Sequence[str | Path | Recording],
    *,
    reference: Sequence[str | Path | Recording] = (),
    knowledge: knowledge_.Knowledge = "identified",
    gravity: Sequence[float] | None = None,
    effects: Sequence[type[AbstractEffect]] = (),
    progress: Say = silent,
) -> Diagnosis | TwoSided | AtRest | Misread:
    """Say which physics a simulation is missing; of an arm that holds still, what friction at rest leaves open;
    of torque that is not what inverse dynamics gives, what it is; of torque that was measured before and behind
    the drives, on which side of them physics is missing.

    Args:
        model: the simulation (MJCF) as the user has it; None for the project's own Panda.
        recordings: of the arm, with torque.
        reference: recordings of the same arm from when nothing was wrong; what they show is not reported.
        knowledge: how well the model's numbers are known; `jaxpanda.inference.knowledge` explains the words.
        gravity: in place of the model's, in the frame of its world [m/s²].
        effects: classes of your own that are tried beside the catalogue's; `Corrected.load`, `predict` and
            `replay` take them too. They are not tried on an arm that holds still.
        progress: called with what is being done, and with each line of `log` as it is written.

    Raises:
        InputError: a file that cannot be read, a recording that does not fit the model, or one given twice; an
            effect that is none, or whose name is taken.
    """
    found = diagnosed(model, recordings, reference, knowledge, gravity, effects, progress)
    return found.bare if isinstance(found, Diagnosis | TwoSided) else found


def diagnosed(
    model: Model | None,
    recordings: Sequence[str | Path | Recording],
    reference: Sequence[str | Path | Recording],
    knowledge: knowledge_.Knowledge,
    gravity: Sequence[float] | None = None,
    effects: Sequence[type[AbstractEffect]] = (),
    progress: Say = silent,
) -> Diagnosis | TwoSided | AtRest | Misread:
    """`diagnose`, with all that its search keeps: for who writes a report, and then is done with it."""
    require_x64("a diagnosis")
    catalogue = catalogue_with(effects)
    knowledge_.check(knowledge)
    if model is None:
        own = markup.parse(panda_mjcf(), "mujoco", Path("panda.xml"))
        arm, source = from_document(with_gravity(own, gravity))
    else:
        arm, source = from_mjcf(model, gravity)
    if not recordings:
        raise InputError("no recording: a diagnosis needs at least one")
    loaded = [one if isinstance(one, Recording) else load(one) for one in (*recordings, *reference)]
    loaded, active = distinct(loaded), [i < len(recordings) for i in range(len(loaded))]
    for recording in loaded:
        recording.require_dof(arm.dof)
        recording.require_tau()
    two = all(one.tau_motor is not None for one in loaded)
    if not two:
        loaded = [_without_motors(one, "not all recordings have it") for one in loaded]
    link_arm = links_alone(arm) if two else arm
    coarse, traces = work_rate(loaded), []
    for recording in loaded:
        traces.append(prepare(recording.of_link_side(), link_arm, coarse=coarse))
        progress(_read(traces[-1]))
    suspect = [trace for trace, on in zip(traces, active, strict=True) if on]
    if all(rests(trace) for trace in suspect):
        given = [one for one, on in zip(loaded, active, strict=True) if on]
        suspect = [_at_rest(one, trace, coarse) for one, trace in zip(given, suspect, strict=True)]
        healthy = [trace for trace, on in zip(traces, active, strict=True) if not on]
        return _as_it_is(judge(suspect, healthy, source, knowledge, catalogue), arm)
    for recording in loaded:
        _require_live_torque(recording)
    in_question = [one.of_link_side() for one, on in zip(loaded, active, strict=True) if on]
    wrongly_read = misread(in_question, suspect, source, knowledge)
    if wrongly_read is not None:
        return _as_it_is(wrongly_read, arm)
    found, kept = sought(link_arm, source, in_question, traces, active, knowledge, catalogue, progress)
    if not two:
        document, warnings = file_with(source, kept, found.problem, in_question)
        return dataclasses.replace(found, written=document, notes=(*found.notes, *warnings))
    progress("now what the drives take between the motors and the links")
    views = on_motors(found, loaded)
    motors = drive_alone(arm)
    traces = [prepare(view, motors, coarse=coarse) for view in views]
    in_question = [view for view, on in zip(views, active, strict=True) if on]
    drives, drives_kept = sought(
        motors, source, in_question, traces, active, knowledge, on_drives(catalogue), progress
    )
    whole = both(arm, kept, drives_kept)
    document, warnings = file_with(source, whole, drives.problem, in_question)
    corrected, notes = both(arm, found.corrected, drives.corrected), notes_of(found, drives, warnings)
    return TwoSided(found, drives, corrected, document, warnings, notes)


def _as_it_is(found: Found, arm: Arm) -> Found:
    """With the user's arm, drives and all, where it was compared without them."""
    return dataclasses.replace(found, corrected=dataclasses.replace(found.corrected, arm=arm))


def _at_rest(recording: Recording, trace: Trace, coarse: float) -> Trace:
    """The trace of a recording in which no joint moves, where none does."""
    still = while_still(_without_motors(recording, "no joint moves"), trace)
    return trace if still is recording else prepare(still, trace.motion.arm, coarse=coarse)


def _without_motors(recording: Recording, why: str) -> Recording:
    """The torque of the motors left out, and said so."""
    if recording.tau_motor is None:
        return recording
    note = f"{recording.name}: tau_motor is not used, as {why}"
    return dataclasses.replace(recording.of_link_side(), notes=(*recording.notes, note))


def _read(trace: Trace) -> str:
    """What was read, in a line."""
    time, dof = trace.motion.time, trace.motion.q.shape[1]
    return f"{trace.name}: {time[-1] - time[0]:.1f} s, {dof} joints"


def _require_live_torque(recording: Recording) -> None:
    """Refuse a channel that is stuck: without noise nothing tells what is beyond it."""
    for name in ("tau", "tau_motor"):
        torque = recording.measured.get(name)
        stuck = [] if torque is None else np.flatnonzero(np.ptp(torque, axis=0) == 0)
        if len(stuck):
            raise InputError(
                f"{recording.name}: column {name}_{stuck[0] + 1} never changes; a diagnosis needs torque as the"
                " sensor gave it, with its noise"
            )
