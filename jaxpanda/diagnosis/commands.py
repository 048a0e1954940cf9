"""The commands `diagnose` and `predict`: between files and files."""

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import report
from ..corrected import XML
from ..errors import InputError
from ..export import missing_assets
from ..files import output_folder, write_text
from ..recordings import Recording, distinct, load, load_many
from ..rollout import compare
from . import meaning, page, resting
from .diagnosis import Diagnosis, diagnose, predict
from .host import on_host
from .knowledge import Knowledge


@dataclasses.dataclass(frozen=True)
class Prediction:
    """Torque of a motion, and where it was written."""

    path: Path
    rows: int
    rms: tuple[float, ...]
    """Of each joint's torque [N m]."""

    def to_json(self) -> dict[str, Any]:
        return {
            "schema": "jaxpanda.prediction/1",
            "path": str(self.path),
            "rows": self.rows,
            "rms": list(self.rms),
        }

    def lines(self) -> list[str]:
        return [f"{self.rows} rows of torque in {self.path}."]


@on_host
def diagnose_files(
    out: Path,
    model: Path | None,
    recordings: Sequence[Path],
    reference: Sequence[Path],
    knowledge: Knowledge,
) -> Diagnosis | resting.AtRest | meaning.Misread:
    """`jaxpanda diagnose`."""
    if not recordings:
        raise InputError("--recording: none given; name at least one file or folder")
    with output_folder(out) as folder:
        suspect, healthy = load_many(recordings), load_many(reference)
        every = distinct([*suspect, *healthy])
        suspect, healthy = every[: len(suspect)], every[len(suspect) :]
        found = diagnose(model, suspect, reference=healthy, knowledge=knowledge)
        given = [("model", p) for p in [model] if p]
        given += [("recording", p) for p in recordings] + [("reference", p) for p in reference]
        names = {r.path: r.name for r in every}
        sources = tuple(_source(role, path, names) for role, path in given)
        missing = (f"{XML}: {what}" for what in missing_assets(found.written, out))
        notes = (*found.notes, *missing)
        found = dataclasses.replace(found, sources=sources, notes=notes)
        if isinstance(found, resting.AtRest):
            sections = resting.sections(found)
        elif isinstance(found, meaning.Misread):
            sections = meaning.sections(found)
        else:
            found = _replayed(found, suspect)
            sections = page.sections(found)
        report.to_html("jaxpanda: diagnosis", sections, folder / "report.html")
        found.save(out)  # not by way of the other folder: what is included may belong outside of `out`
    return found


def _replayed(found: Diagnosis, recordings: Sequence[Recording]) -> Diagnosis:
    """With how closely both simulations follow a recording, the one in which something happened if any."""
    if not found.findings:
        return found
    once = [f.recordings[0] for f in found.findings if f.intervals is not None]
    recording = next((r for r in recordings if r.name in once), recordings[0])
    try:
        return dataclasses.replace(found, replays=(compare(found.corrected, found.source, recording),))
    except InputError as error:
        return dataclasses.replace(found, notes=(*found.notes, f"not replayed in simulation: {error}"))


def _source(role: str, path: Path, names: Mapping[Path | None, str]) -> dict[str, str]:
    """Name and digest of a file, or of all files of a folder in the order of their names."""
    parts = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part.read_bytes())
    name = path.name if path.is_dir() else names.get(path, path.name)
    return {"role": role, "name": name, "sha256": digest.hexdigest()}


def predict_files(diagnosis: Path, recording: Path, out: Path) -> Prediction:
    """`jaxpanda predict`."""
    motion = load(recording)
    tau = predict(diagnosis, motion)
    head = ",".join(["time", *(f"tau_{j + 1}" for j in range(tau.shape[1]))])
    table = np.column_stack([motion.time if motion.stamps is None else motion.stamps, tau]).tolist()
    write_text(out, "\n".join([head, *(",".join(map(repr, row)) for row in table)]) + "\n")
    return Prediction(out, len(tau), tuple(float(v) for v in np.sqrt(np.mean(tau**2, 0))))
