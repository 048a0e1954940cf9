"""The stages on files: what each command does between its arguments and its result."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .arm import Arm
from .errors import InputError
from .export import Change, panda_mjcf, sidecar, write_parameters
from .files import output_folder, to_json, write_text
from .friction import Friction
from .identification import Identification, identify, identify_mass_gravity
from .inspection import Inspection, inspect
from .mjcf import from_mjcf
from .recordings import Recording, load_many
from .retrieval import Retrieval, retrieve
from .session import progress
from .validation import Validation, validate


def arm_of(model: Path | None) -> Arm:
    """The arm in a user's MJCF; without one, the project's own Panda."""
    return Arm.panda() if model is None else Arm.from_mjcf(model)


def recordings_of(paths: Sequence[Path], arm: Arm | None = None) -> list[Recording]:
    """Read recordings, and make sure that they are of this arm."""
    if not paths:
        raise InputError("--recording: none given; name at least one file or folder")
    recordings = load_many(paths)
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


def inspect_files(paths: Sequence[Path], model: Path | None) -> Inspections:
    """`jaxpanda inspect`."""
    recordings = recordings_of(paths)
    if model is None and any(recording.dof != Arm.panda().dof for recording in recordings):
        return Inspections(tuple(inspect(recording) for recording in recordings))
    arm = arm_of(model)
    return Inspections(tuple(inspect(recording, arm) for recording in recordings))


def identify_files(
    out: Path,
    recordings: Sequence[Path],
    mass_gravity: Path | None,
    model: Path | None,
    *,
    method: str,
    friction: str,
    weighting: str,
    cutoff: float,
    folds: int,
) -> Identification:
    """`jaxpanda identify`."""
    if (mass_gravity is None) == (not recordings):
        raise InputError("identify: give either --recording or --mass-gravity, one of the two")
    arm = arm_of(model)
    with output_folder(out) as folder:
        if mass_gravity is not None:
            found = identify_mass_gravity(mass_gravity, arm, folds=folds)
        else:
            with progress("identifying") as tick:
                found = identify(
                    recordings_of(recordings, arm),
                    arm,
                    method=method,
                    friction=friction,
                    weighting=weighting,
                    cutoff=cutoff,
                    folds=folds,
                    progress=tick,
                )
        found.save(folder)
    return found


def retrieve_files(
    out: Path,
    identification: Path,
    bounds: Path | None,
    model: Path | None,
    *,
    weighting: str,
    starts: int,
    seed: int,
) -> Retrieval:
    """`jaxpanda retrieve`."""
    arm = None if model is None else Arm.from_mjcf(model)
    with output_folder(out) as folder, progress("random starts") as tick:
        links = retrieve(
            identification, bounds=bounds, arm=arm, weighting=weighting, starts=starts, seed=seed, progress=tick
        )
        links.save(folder)
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


def to_mjcf(links: Retrieval, out: str | Path, model: str | Path | None = None) -> Export:
    """Write retrieved links, and the friction identified with them, as MJCF (or URDF, by the suffix).

    What MJCF cannot hold (a constant offset, a sigmoid) goes into `<name>.jaxpanda.json` beside it.

    Args:
        links: what `retrieve` found.
        out: the file to write.
        model: the user's own MJCF, of which only the parameters change; the project's Panda without it.

    Raises:
        InputError: the model holds another arm, or cannot hold the parameters.
    """
    out = Path(out)
    if model is None:
        arm, source = Arm.panda(), None
    else:
        arm, source = from_mjcf(model)
    if links.dof != arm.dof:
        raise InputError(f"{model or 'the Panda'}: has {arm.dof} links, but the retrieval has {links.dof}")
    if out.suffix == ".urdf":
        from .urdf import to_urdf

        write_text(out, to_urdf(arm, links.standard, links.friction))
        return Export(out, (), ())
    if source is None:
        write_text(out, panda_mjcf(links.standard, links.friction))
        write_text(out.with_name(f"{out.stem}.jaxpanda.json"), to_json(sidecar(arm, links.friction)))
        return Export(out, (), ())
    written = write_parameters(source, arm, links.standard, links.friction)
    return Export(out, written.changes, (*written.warnings, *written.save(out)))


def validate_files(
    out: Path, model: Path, recordings: Sequence[Path], *, cutoff: float, friction: Friction | None = None
) -> Validation:
    """`jaxpanda validate`."""
    with output_folder(out) as folder:
        checked = validate(model, recordings_of(recordings), cutoff=cutoff, friction=friction)
        checked.save(folder)
    return checked
