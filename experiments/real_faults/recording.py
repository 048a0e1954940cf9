"""What every loader gives, checked: a recording in SI units and radians, and a case with its truth, as files."""

import csv
import dataclasses
import hashlib
import json
from pathlib import Path

import numpy as np

SOURCES = json.loads((Path(__file__).parent / "sources.json").read_text())


class BadFile(ValueError):
    """One sentence that names the file and says what is wrong; the commands end with status 2 after it."""


@dataclasses.dataclass(frozen=True)
class Recording:
    name: str
    time: np.ndarray
    """[s], strictly increasing, from 0."""
    q: np.ndarray
    qd: np.ndarray
    tau: np.ndarray
    """[N m], gravity included, positive along the axis."""
    tau_motor: np.ndarray | None = None
    """[N m] at the joint, before the gear's friction."""
    source: dict = dataclasses.field(default_factory=dict)
    """Set, file, sha256 of the file where it is small, what was dropped."""

    def part(self, start: float, stop: float) -> "Recording":
        """From `start` to `stop` [s]."""
        rows = (self.time >= start) & (self.time < stop)
        cut = {k: getattr(self, k)[rows] for k in ("time", "q", "qd", "tau")}
        motor = None if self.tau_motor is None else self.tau_motor[rows]
        return dataclasses.replace(self, **cut, tau_motor=motor)


@dataclasses.dataclass(frozen=True)
class Case:
    name: str
    recording: Recording
    model: str | None
    """MJCF; None for the project's own Panda."""
    truth: dict
    references: tuple[Recording, ...] = ()


def truth(kind: str, title: str, families=(), effects=(), joints=None, **more) -> dict:
    """What was changed. `kind`: fault or control. Joints, intervals [s], side, size: null where not known."""
    blank = {"intervals": None, "side": None, "size": None, "arguments": [], "note": ""}
    return {
        "kind": kind,
        "title": title,
        "families": list(families),
        "effects": list(effects),
        "joints": joints,
        **blank,
        **more,
    }


def known_content(path: Path, collection: str) -> dict:
    """The source entry of a file. Where upstream's sha256 is known, another content is refused."""
    files = SOURCES[collection]["files"]
    entry = {"set": collection, "upstream": SOURCES[collection]["url"], "file": path.name}
    if expected := files.get(path.name):
        with path.open("rb") as file:
            found = hashlib.file_digest(file, "sha256").hexdigest()
        if found != expected:
            raise BadFile(
                f"{path}: its sha256 begins with {found[:12]}, that of {entry['upstream']} with {expected[:12]}"
            )
        entry["sha256"] = found
    return entry


def advancing(time: np.ndarray) -> tuple[np.ndarray, dict]:
    """Rows whose stamp increases, and how many do not."""
    new = np.diff(time, prepend=-np.inf) > 0
    return new, {"rows whose time does not increase": int(np.sum(~new))}


def numbers(path: Path, names: list[str], rows) -> np.ndarray:
    """Cells of a table as numbers, as many in each row as the header has."""
    try:
        table = np.array(list(rows), float)
    except ValueError:
        raise BadFile(f"{path}: a row is shorter than the header or holds no numbers") from None
    if table.ndim != 2 or table.shape[1] != len(names):
        raise BadFile(f"{path}: its rows have not the {len(names)} columns of the header")
    return table


def checked(path, name, time, channels: dict, source, dropped=None) -> Recording:
    """A recording of these channels; numbers that are none, or a clock that does not go on, are refused."""
    for what, values in {"time": time, **channels}.items():
        if values is not None and not np.all(np.isfinite(values)):
            row = int(np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(1))[0]) + 1
            raise BadFile(f"{path}: {what} of {name} is no number in row {row}")
    if len(time) < 10:
        raise BadFile(f"{path}: {name} has {len(time)} rows, which is no recording")
    if np.any(np.diff(time) <= 0):
        row = int(np.flatnonzero(np.diff(time) <= 0)[0]) + 2
        raise BadFile(f"{path}: time of {name} does not increase in row {row}")
    return Recording(name=name, time=time - time[0], source={**source, "dropped": dropped or {}}, **channels)


def write_csv(path: Path, recording: Recording):
    """The canonical CSV."""
    channels = {"q": recording.q, "dq": recording.qd, "tau": recording.tau, "tau_motor": recording.tau_motor}
    channels = {name: values for name, values in channels.items() if values is not None}
    names = ["time"] + [f"{k}_{j + 1}" for k, v in channels.items() for j in range(v.shape[1])]
    rows = np.concatenate([recording.time[:, None], *channels.values()], 1)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        writer.writerows([f"{x:.9g}" for x in row] for row in rows)


def write_case(folder: Path, case: Case):
    """model.xml, recording.csv, reference_*.csv and truth.json."""
    folder.mkdir(parents=True, exist_ok=True)
    if case.model is not None:
        (folder / "model.xml").write_text(case.model)
    write_csv(folder / "recording.csv", case.recording)
    for k, reference in enumerate(case.references):
        write_csv(folder / f"reference_{k}.csv", reference)
    sources = {"recording": case.recording.source, "references": [r.source for r in case.references]}
    (folder / "truth.json").write_text(json.dumps({**case.truth, "sources": sources}, indent=1) + "\n")
