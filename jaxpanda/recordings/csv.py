"""The canonical CSV of `docs/recordings.md`: `time,q_1,…,q_n,dq_1,…,dq_n,tau_1,…,tau_n`."""

import gzip
import re
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from ..errors import InputError
from .checks import checked
from .recording import Recording
from .text import numbers, read_text


def read_csv(path: Path, columns: Mapping[str, str] | None = None) -> Recording:
    """A recording from a CSV, plain or `.gz`.

    Args:
        path: the file.
        columns: {canonical name: name in the file} where the two differ.

    Raises:
        InputError: naming file, column and row, and what would work.
    """
    lines = read_text(path).splitlines()
    start = next(i for i, line in enumerate(lines) if line.strip())
    header = lines[start]
    if header.lstrip()[0] in "{[<":
        raise InputError(
            f"{path.name}: JSON or markup, no recording: a CSV with the columns {canonical(7)} is needed"
        )
    delimiter = max(",;\t", key=header.count)
    names = [cell.strip().strip("\"'").strip() for cell in header.split(delimiter)]
    if len(names) > 1 and all(_is_number(cell) for cell in names):
        raise InputError(
            f"{path.name}: line {start + 1} holds numbers where the header must be: put the line "
            f"{canonical(7)} first"
        )
    channels = find_channels(names, path.name, columns)
    body = lines[start + 1 :]
    if not any(line.strip() for line in body):
        raise InputError(f"{path.name}: a header but no rows")
    table = numbers(body, path.name, delimiter, names, start + 2)
    filled = (
        [start + 2 + i for i, line in enumerate(body) if line.strip()] if len(table) < len(body) else None
    )

    def row(i: int) -> str:
        return f"row {i + 1} (line {filled[i] if filled else start + 2 + i})"

    return checked(from_table(path, names, table, channels, row), row)


def canonical(dof: int) -> str:
    """How the header of the canonical CSV reads."""
    return f"time,q_1,…,q_{dof},dq_1,…,dq_{dof},tau_1,…,tau_{dof}"


def canonical_names(dof: int, qd: bool, tau: bool) -> list[str]:
    """The columns of a recording, in order."""
    channels = ["q"] + ["dq"] * qd + ["tau"] * tau
    return ["time"] + [f"{channel}_{j + 1}" for channel in channels for j in range(dof)]


def find_channels(
    names: list[str], file: str, columns: Mapping[str, str] | None = None
) -> dict[str, list[int]]:
    """Where time, q, dq and tau stand among a table's columns; a channel that is absent has no entry.

    Raises:
        InputError: a column is missing, double, or one joint's column is absent.
    """
    if len(names) > COLUMNS:
        raise InputError(
            f"{file}: {len(names)} columns, where at most {COLUMNS} are read: leave out what is no joint's"
        )
    seen = [name.lower() for name in names]
    for canonical_name, given in (columns or {}).items():
        if given not in names:
            raise InputError(
                f"{file}: no column {given!r} (asked for as {canonical_name}); it has {_listed(names)}"
            )
        for i, name in enumerate(names):
            if name == given:
                seen[i] = canonical_name.lower()
            elif seen[i] == canonical_name.lower():
                seen[i] = ""
    double = next((name for i, name in enumerate(seen) if name and name in seen[:i] and _known(name)), None)
    if double is not None:
        raise InputError(f"{file}: column {double} is there twice: rename or drop one of them")
    if "time" not in seen:
        raise InputError(
            f"{file}: no column time; it has {_listed(names)}, where {canonical(7)} is needed{_MAP}"
        )
    found: dict[str, list[int]] = {"time": [seen.index("time")]}
    for channel in ("q", "dq", "tau"):
        joints = {
            int(m[1]): i
            for i, name in enumerate(seen)
            if (m := re.fullmatch(rf"{channel}_(\d{{1,9}})", name))
        }
        if joints:
            found[channel] = [joints[j] for j in _complete(sorted(joints), channel, file)]
    if "q" not in found:
        raise InputError(f"{file}: no columns q_1, q_2, …; it has {_listed(names)}{_MAP}")
    dof = len(found["q"])
    for channel in ("dq", "tau"):
        if channel in found and len(found[channel]) != dof:
            raise InputError(
                f"{file}: {dof} columns q_1 ... q_{dof} but {len(found[channel])} columns {channel}_1 ... "
                f"{channel}_{len(found[channel])}: each joint needs one, or leave all {channel} columns out"
            )
    return found


COLUMNS = 5000
"""Most that a table may have."""
_MAP = "; rename them, or name them from Python: load(path, columns={'q_1': 'its name in the file', …})"


def _known(name: str) -> bool:
    return name == "time" or re.fullmatch(r"(q|dq|tau)_\d+", name) is not None


def _complete(joints: list[int], channel: str, file: str) -> list[int]:
    missing = next((j for j, there in enumerate([j for j in joints if j], 1) if j != there), None)
    if missing or joints[0] != 1:
        name = f"{channel}_{missing or joints[0]}"
        raise InputError(
            f"{file}: column {name} is missing, while {channel}_{joints[-1]} is there"
            if missing
            else f"{file}: column {name} cannot be: joints count from 1"
        )
    return joints


def _listed(names: list[str]) -> str:
    shown = ", ".join(name[:30] for name in names[:8])
    return f"the columns {shown}{', …' if len(names) > 8 else ''}"


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def from_table(
    path: Path,
    names: list[str],
    table: np.ndarray,
    channels: dict[str, list[int]],
    row: Callable[[int], str] | None = None,
) -> Recording:
    """The recording in a table whose columns `find_channels` has found; `row` as `Recording` has it."""
    used = {i for places in channels.values() for i in places}
    ignored = [name or "(no name)" for i, name in enumerate(names) if i not in used]

    def take(channel: str) -> np.ndarray | None:
        return np.ascontiguousarray(table[:, channels[channel]]) if channel in channels else None

    return Recording(
        name=path.name,
        time=np.ascontiguousarray(table[:, channels["time"][0]]),
        q=np.ascontiguousarray(table[:, channels["q"]]),
        qd=take("dq"),
        tau=take("tau"),
        path=path,
        row=row,
        notes=(f"ignores {len(ignored)} other columns: {', '.join(ignored[:8])}",) if ignored else (),
    )


def csv_bytes(recording: Recording, name: str) -> bytes:
    """The canonical CSV, packed for a `.gz`; every number in the shortest form that reads back the same."""
    names = canonical_names(recording.dof, recording.qd is not None, recording.tau is not None)
    table = np.column_stack([recording.time, *recording.channels()])
    text = "\n".join([",".join(names), *(",".join(map(repr, row)) for row in table.tolist())]) + "\n"
    content = text.encode()
    return gzip.compress(content, mtime=0) if name.endswith(".gz") else content
