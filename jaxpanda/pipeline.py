"""The stages on files: what each command does between its arguments and its result."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from . import inputs
from .arms import markup
from .arms.arm import Arm
from .arms.export import Change, panda_mjcf, read_sidecar, sidecar_of, write_parameters
from .arms.lint import lint
from .arms.model_file import Model, ModelFile, part_of
from .arms.source import from_document, from_mjcf
from .arms.urdf import MARK, left_out, to_urdf
from .convention import PLAIN, Convention
from .errors import InputError
from .files import output_file, output_folder, remove, write_bytes, write_text
from .friction import Friction
from .identification import Identification, identify, identify_mass_gravity
from .identification.result import KIND as IDENTIFICATION
from .inspection import Inspection, inspect
from .ranks import ALONE, Ranks
from .reading import Reading
from .recordings import Recording, content_of, distinct, load, load_many
from .retrieval import CHECKPOINT_FILE, Retrieval, retrieve
from .retrieval import KIND as RETRIEVAL
from .session import progress, telling
from .validation import KIND as VALIDATION
from .validation import Validation, validate


def arm_of(model: Model | None, gravity: Sequence[float] | None = None) -> Arm:
    """The arm in a user's MJCF, or under another gravity; without a file, the project's own Panda."""
    arm = Arm.panda() if model is None else Arm.from_mjcf(model)
    if gravity is None:
        return arm
    return dataclasses.replace(arm, chain=dataclasses.replace(arm.chain, gravity=jnp.asarray(gravity)))


def recordings_of(
    paths: Sequence[Path],
    arm: Arm | None = None,
    *,
    model: Model | None = None,
    reading: Reading | None = None,
    convention: Convention = PLAIN,
) -> list[Recording]:
    """Read recordings by the convention of their columns, and make sure that they are of this arm."""
    if not paths:
        raise InputError("--recording: none given; name at least one file or folder")
    recordings = distinct(convention.applied(load_many(paths, reading), model))
    for recording in recordings:
        if arm is not None:
            recording.require_dof(arm.dof)
    return recordings


@dataclasses.dataclass(frozen=True)
class Inspections:
    """What `inspect` found in each recording."""

    recordings: tuple[Inspection, ...]

    def to_json(self) -> dict[str, Any]:
        return {"schema": "jaxpanda.inspections/1", "recordings": [one.to_json() for one in self.recordings]}


def inspect_files(
    paths: Sequence[Path],
    model: Model | None,
    reading: Reading | None = None,
    convention: Convention = PLAIN,
) -> Inspections:
    """`jaxpanda inspect`."""
    recordings = recordings_of(paths, model=model, reading=reading, convention=convention)
    if model is None and any(recording.dof != Arm.panda().dof for recording in recordings):
        return Inspections(tuple(inspect(recording) for recording in recordings))
    arm = arm_of(model, convention.mounting)
    each = tuple(inspect(recording, arm) for recording in recordings)
    if model is None:
        why = "no --model was given: signs, gravity and order are compared with the project's Panda's"
        each = tuple(dataclasses.replace(one, notes=(why, *one.notes)) for one in each)
    return Inspections(each)


@dataclasses.dataclass(frozen=True)
class Conversion:
    """What was read of a log and written."""

    recording: Recording
    path: Path

    def to_json(self) -> dict[str, Any]:
        origin = self.recording.origin
        return {
            "schema": "jaxpanda.conversion/1",
            "path": str(self.path),
            "samples": self.recording.samples,
            "joints": self.recording.dof,
            "origin": None if origin is None else origin.to_json(),
            "repairs": dict(self.recording.repairs),
            "notes": list(self.recording.notes),
        }


def convert_file(file: Path, out: Path, reading: Reading, convention: Convention = PLAIN) -> Conversion:
    """`jaxpanda convert`: the recording of a log, as a file that reads back to the same numbers."""
    log, end = file.resolve(), out.resolve()
    if end == log or log in end.parents or (out.exists() and file.exists() and out.samefile(file)):
        raise InputError(f"--out {out}: is the log itself or lies in it; choose another place")
    if convention.gravity:
        raise InputError(
            "--gravity: is a matter of the model; give it to the command that reads what convert writes"
        )
    (recording,) = convention.applied([load(file, reading=reading)])
    content = content_of(recording, out)
    with output_file(out, content.__eq__) as written:  # of what stands there nothing tells whose it is
        write_bytes(written, content)
    return Conversion(recording, out)


def identify_files(
    out: Path,
    recordings: Sequence[Path],
    mass_gravity: Path | None,
    model: Model | None,
    *,
    method: str,
    friction: str,
    weighting: str,
    cutoff: float,
    folds: int,
    reading: Reading | None = None,
    convention: Convention = PLAIN,
) -> Identification:
    """`jaxpanda identify`."""
    if (mass_gravity is None) == (not recordings):
        raise InputError("identify: give either --recording or --mass-gravity, one of the two")
    arm = arm_of(model, convention.mounting)
    with output_folder(out, IDENTIFICATION) as folder:
        if mass_gravity is not None:
            found = identify_mass_gravity(mass_gravity, arm, folds=folds)
        else:
            with progress("identifying") as tick:
                found = identify(
                    recordings_of(recordings, arm, model=model, reading=reading, convention=convention),
                    arm,
                    method=method,
                    friction=friction,
                    weighting=weighting,
                    cutoff=cutoff,
                    folds=folds,
                    progress=tick,
                )
        if model is not None:
            file = str(Path(model).resolve())
            found = dataclasses.replace(found, model_file=file, model_part=part_of(model))
        found.save(folder)
    return found


def retrieve_files(
    out: Path,
    identification: Path,
    bounds: Path | None,
    model: Model | None,
    *,
    weighting: Literal["auto", "torque", "none"],
    starts: int,
    seed: int,
    ranks: Ranks = ALONE,
) -> Retrieval | None:
    """`jaxpanda retrieve`, on all devices; of several ranks, the first alone has something to return.

    Starts are kept in `out` as they finish, until the result is there: the same command goes on from them.
    """
    arm = None if model is None else Arm.from_mjcf(model)
    options: dict[str, Any] = {
        "bounds": bounds,
        "arm": arm,
        "weighting": weighting,
        "starts": starts,
        "seed": seed,
        "ranks": ranks,
    }
    if ranks.rank > 0:
        retrieve(identification, **options)
        return None
    checkpoint, done = out / CHECKPOINT_FILE, 0

    def count(finished: int, total: int) -> None:
        nonlocal done
        done = finished
        tick(finished, total)

    with output_folder(out, RETRIEVAL) as folder, progress("random starts") as tick:
        try:
            links = retrieve(identification, **options, checkpoint=checkpoint, progress=count)
            links.save(folder)
        except KeyboardInterrupt:
            if not done:
                remove(checkpoint)
                raise
            said = f"{done} of {starts} starts are kept in {checkpoint}; the same command goes on from there"
            raise KeyboardInterrupt(said) from None
        except InputError:
            if done == starts:  # of these starts nothing can be made
                remove(checkpoint)
            raise
    remove(checkpoint)
    return links


@dataclasses.dataclass(frozen=True)
class Export:
    """What an export wrote."""

    path: Path
    changes: tuple[Change, ...]
    """In the user's file; empty where the file is the project's own."""
    warnings: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        return {
            "schema": "jaxpanda.export/1",
            "path": str(self.path),
            "changes": [dataclasses.asdict(change) for change in self.changes],
            "warnings": list(self.warnings),
        }


def to_mjcf(links: Retrieval, out: str | Path, model: Model | None = None) -> Export:
    """Write retrieved links, and the friction identified with them, as MJCF (or URDF, by the suffix).

    Armature, springs and friction that the identified model held stay, in whichever file is written. What MJCF
    cannot hold (a constant offset, a sigmoid) goes into `<name>.jaxpanda.json` beside it.

    Args:
        links: what `retrieve` found.
        out: the file to write.
        model: the user's own MJCF, of which only the parameters change. Without it the one that was identified,
            where that was read from a file by `identify_files`; else the project's Panda.

    Raises:
        InputError: the model holds another arm, cannot hold the parameters, or is not there any more.
    """
    out = Path(out)
    if out.suffix.lower() not in (".xml", ".urdf"):
        raise InputError(f"{out}: a name ending in .xml (MJCF) or .urdf is needed")
    with inputs.remembered():
        return _to_mjcf(links, out, model or _identified_file(links))


def _to_mjcf(links: Retrieval, out: Path, model: Model | None) -> Export:
    own = model is None
    arm, source = from_document(markup.parse(panda_mjcf(), "mujoco", out)) if own else from_mjcf(model)
    if links.dof != arm.dof:
        raise InputError(f"{model or 'the Panda'}: has {arm.dof} links, but the retrieval has {links.dof}")
    arm = dataclasses.replace(arm, **{name: jnp.asarray(values) for name, values in links.known.items()})
    if out.suffix.lower() == ".urdf":
        with output_file(out, lambda content: MARK.encode() in content) as file:
            write_text(file, to_urdf(arm, links.standard, links.friction))
        return Export(out, (), tuple(f"not in {out.name}: {what}" for what in left_out(arm, links.friction)))
    written = write_parameters(source, arm, links.standard, links.friction)
    return Export(out, () if own else written.changes, (*written.warnings, *written.save(out)))


def _identified_file(links: Retrieval) -> ModelFile | None:
    """The MJCF to export into where none is given; None for the project's own Panda."""
    if not links.model_file:
        if not links.own:
            raise InputError(
                f"export: the links are those of the arm '{links.arm}', which is not the project's own Panda;"
                " give its MJCF by --model"
            )
        return None
    if not (model := Path(links.model_file)).is_file():
        raise InputError(f"{model}: the MJCF that was identified is not there any more; give it by --model")
    return ModelFile(model, links.model_part)


def validate_files(
    out: Path,
    model: Model,
    recordings: Sequence[Path],
    *,
    cutoff: float,
    in_mjx: bool = True,
    reading: Reading | None = None,
    convention: Convention = PLAIN,
) -> Validation:
    """`jaxpanda validate`: with the offset in an exported file's sidecar, and what the lint has to say."""
    engines = "MuJoCo and MJX; MJX takes most of the time, --no-mjx leaves it out" if in_mjx else "MuJoCo"
    with output_folder(out, VALIDATION) as folder, telling("validating") as say:
        say(f"comparing inverse dynamics, torque and a roll-out in {engines}")
        friction, beside = beyond_mjcf(model)
        logs = recordings_of(recordings, model=model, reading=reading, convention=convention)
        checked = validate(
            model, logs, cutoff=cutoff, in_mjx=in_mjx, friction=friction, gravity=convention.mounting
        )
        slips = tuple(f"{slip.severity}: {slip.where}: {slip.message}" for slip in lint(model))
        checked = dataclasses.replace(checked, notes=(*checked.notes, *beside, *slips))
        checked.save(folder)
    return checked


def beyond_mjcf(model: Model) -> tuple[Friction | None, tuple[str, ...]]:
    """The constant torque in `<name>.jaxpanda.json` beside a model that was exported here, and a note of it."""
    file = sidecar_of(Path(model))
    if not file.exists():
        return None, ()
    offset = np.array(read_sidecar(file)["torque_offset"])
    zero = np.zeros_like(offset)
    return Friction("coulomb_viscous_offset", {"viscous": zero, "coulomb": zero, "offset": offset}), (
        f"the constant joint torque in {file.name}, for which MJCF has no place, was added",
    )
