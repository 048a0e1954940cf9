"""Tables of text: the canonical CSV of `docs/files.md`, and others whose source or user says what they hold.

`time,q_1,…,q_n,dq_1,…,dq_n,tau_1,…,tau_n`; cells between commas, semicolons, tabs or blanks.
"""

import gzip
import re
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..reading import Reading
from .kuka import SUNRISE
from .libfranka import LIBFRANKA, PANDA_PY
from .recording import Recording
from .table import Table, canonical, canonical_names, recording_of, refuse
from .text import numbers, read_text
from .ur import RTDE

SOURCES = (LIBFRANKA, PANDA_PY, RTDE, SUNRISE)
"""Whose tables are known by their columns."""


def read_csv(path: Path, reading: Reading) -> list[Recording]:
    """The recording in a table of text, plain or `.gz`.

    Raises:
        InputError: naming file, column and row, and what would work.
    """
    refuse(path.name, reading, "topic", "episode")
    lines = read_text(path).splitlines()
    start = _header(lines)
    header = lines[start]
    if header.lstrip()[0] in "{[<":
        raise InputError(
            f"{path.name}: JSON or markup, no recording: a CSV with the columns {canonical(7)} is needed"
        )
    names, delimiter = _cells(header)
    headless = _are_numbers(names)
    if headless:
        if not {"time", "q"} <= reading.channels().keys():
            raise InputError(
                f"{path.name}: line {start + 1} holds numbers where the header must be: put the line "
                f"{canonical(7)} first, or say which column is which by its number, as --columns time=1 q=2..8"
            )
        names = [str(i + 1) for i in range(len(names))]
    first = start if headless else start + 1
    body = lines[first:]
    if not any(line.strip() for line in body):
        raise InputError(f"{path.name}: a header but no rows")
    filled = [first + 1 + i for i, line in enumerate(body) if line.strip()]

    def take(places) -> np.ndarray:
        return numbers(body, path.name, delimiter, names, first + 1, places)

    def row(i: int) -> str:
        return f"row {i + 1} (line {filled[i]})"

    return [recording_of(Table(path, path.name, names, take, row), SOURCES, reading)]


def _header(lines: list[str]) -> int:
    """The first line that is not blank, a comment nor a spreadsheet's `sep=;`; the last comment, where a row that
    begins with a number follows."""
    filled = [i for i, line in enumerate(lines) if line.strip() and not re.fullmatch(r"sep=.", line.strip())]
    plain = next((i for i in filled if lines[i].lstrip()[0] not in "#%"), filled[-1])
    comments = [i for i in filled if i < plain]
    if not comments:
        return plain
    row, header = _cells(lines[plain])[0], _cells(lines[comments[-1]])[0]
    follows = len(row) == len(header) > 1 and _is_number(row[0]) and not _is_number(header[0])
    return comments[-1] if follows or _are_numbers(row) else plain


def _cells(line: str) -> tuple[list[str], str | None]:
    """A line taken apart, and what stands between its cells; None for blanks."""
    delimiter = max(",;\t", key=line.count)
    between = delimiter if delimiter in line else None
    return [cell.strip().strip("\"'").strip() for cell in line.strip().lstrip("%#").split(between)], between


def _are_numbers(cells: list[str]) -> bool:
    return len(cells) > 1 and all(_is_number(cell) for cell in cells)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def csv_bytes(recording: Recording, name: str) -> bytes:
    """The canonical CSV, packed for a `.gz`; every number in the shortest form that reads back the same."""
    names = canonical_names(recording)
    table = np.column_stack([recording.time, *recording.channels()])
    text = "\n".join([",".join(names), *(",".join(map(repr, row)) for row in table.tolist())]) + "\n"
    content = text.encode()
    return gzip.compress(content, mtime=0) if name.endswith(".gz") else content
