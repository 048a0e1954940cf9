"""The command `diagnose`: from files to a folder."""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from .. import inputs, report
from ..arms.export import missing_assets
from ..arms.model_file import Model
from ..convention import PLAIN, Convention
from ..corrected import KIND, XML
from ..errors import InputError
from ..files import output_folder
from ..host import on_host
from ..inference.knowledge import Knowledge
from ..reading import Reading
from ..recordings import Recording, distinct, load_many
from ..rollout import compare
from ..session import telling
from . import meaning, page, resting, two_sided
from .diagnosis import Diagnosis
from .entry import diagnosed


@on_host
def diagnose_files(
    out: Path,
    model: Model | None,
    recordings: Sequence[Path],
    reference: Sequence[Path],
    knowledge: Knowledge,
    *,
    reading: Reading | None = None,
    convention: Convention = PLAIN,
) -> Diagnosis | two_sided.TwoSided | resting.AtRest | meaning.Misread:
    """`jaxpanda diagnose`."""
    if not recordings:
        raise InputError("--recording: none given; name at least one file or folder")
    with output_folder(out, KIND) as folder, telling("diagnosing") as say:
        count = len(recordings) + len(reference)
        say(f"reading {count} recording{'s' * (count != 1)}")
        suspect, healthy = (
            convention.applied(load_many(paths, reading), model) for paths in (recordings, reference)
        )
        every = distinct([*suspect, *healthy])
        suspect, healthy = every[: len(suspect)], every[len(suspect) :]
        found = diagnosed(
            model,
            suspect,
            healthy,
            knowledge,
            gravity=convention.mounting,
            progress=lambda line: say(plainly(line)),
        )
        given = [("model", Path(p)) for p in [model] if p]
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
            say("simulating both arms along a recording")
            found = _replayed(found, suspect)
            say("writing the report")
            whole = isinstance(found, two_sided.TwoSided)
            sections = page.sides(found) if whole else page.sections(found)
        report.to_html("jaxpanda: diagnosis", sections, folder / "report.html")
        found.save(folder)
    return found


def plainly(line: str) -> str:
    """A line of a diagnosis' log for who follows it on a terminal: `add coulomb_friction[4]: 139.3` in words."""
    if tried := re.fullmatch(r"(\d+) terms: (.*)", line):
        each = [part.rpartition(" ") for part in tried[2].split("; ")]
        likely = [what for what, _, gained in each if what and float(gained) > 0][:3]
        beside = f" beside {tried[1]} found" if tried[1] != "0" else ""
        line = f"tried every effect{beside}: " + (
            f"{'; '.join(likely)} {'is' if len(likely) == 1 else 'are'} likeliest" if likely else "none helps"
        )
    elif line == "free forms":
        line = "looking for torque that no named effect explains"
    elif taken := re.fullmatch(r"(add|drop) (.*): \S+", line):
        line = f"{'added' if taken[1] == 'add' else 'dropped'} {taken[2]}"
    elif changed := re.fullmatch(r"(.*) for (.*): \S+ for \S+", line):
        line = f"took {changed[1]} instead of {changed[2]}"
    return re.sub(r"([a-z]\w+)\[([\d, ]+)\]", _placed, line)


def _placed(term: re.Match[str]) -> str:
    joints = term[2].split(", ")
    return f"{term[1].replace('_', ' ')} at joint{'s' * (len(joints) > 1)} {', '.join(joints)}"


def _replayed(
    found: Diagnosis | two_sided.TwoSided, recordings: Sequence[Recording]
) -> Diagnosis | two_sided.TwoSided:
    """With how closely both simulations follow a recording, the one in which something happened if any, under the
    torque of the motors where that was measured."""
    if not found.findings:
        return found
    once = [f.recordings[0] for f in found.findings if f.intervals is not None]
    recording = next((r for r in recordings if r.name in once), recordings[0])
    if isinstance(found, two_sided.TwoSided):
        recording = recording.of_motor_side()
    try:
        return dataclasses.replace(found, replays=(compare(found.corrected, found.source, recording),))
    except InputError as error:
        return dataclasses.replace(found, notes=(*found.notes, f"not replayed in simulation: {error}"))


def _source(role: str, path: Path, names: Mapping[Path | None, str]) -> dict[str, str]:
    """Name and digest of a file, or of all files of a folder in the order of their names."""
    parts = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    name = path.name if path.is_dir() else names.get(path, path.name)
    return {"role": role, "name": name, "sha256": inputs.digest(*parts)}
