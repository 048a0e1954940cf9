"""Bytes of a text file, plain or gzipped, into numbers, with the place of whatever is none."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from .. import inputs
from ..errors import InputError


def read_text(path: Path) -> str:
    """The file's text without a byte-order mark; `.gz` is decompressed.

    Raises:
        InputError: the file is missing, unreadable, a broken gzip file, empty, or no text.
    """
    return inputs.read_text(path, what="a recording as UTF-8 CSV")


def numbers(
    lines: list[str],
    name: str,
    delimiter: str | None,
    columns: list[str],
    first_line: int,
    places: Sequence[int] | None = None,
) -> Float[np.ndarray, "row column"]:
    """Columns of a table of numbers; every line has as many cells as `columns` has names.

    Args:
        lines: the data lines, without a header; blank lines are skipped.
        name: the file's name, for messages.
        delimiter: between cells; None for blanks and tabs.
        columns: the columns' names, for messages.
        first_line: number of `lines[0]` in the file, 1-based.
        places: of the columns wanted; what stands in the others need be no number. None for all.

    Raises:
        InputError: naming the first ragged line or the first cell that is no number.
    """
    wanted = list(range(len(columns)) if places is None else places)
    try:
        table = np.loadtxt(lines, dtype=float, delimiter=delimiter, comments=None, ndmin=2)
    except ValueError:
        table = None
    if table is not None and table.shape[1] == len(columns):
        return table[:, wanted]
    if fault := _first_fault(lines, delimiter, columns, first_line, set(wanted)):
        raise InputError(f"{name}: {fault}")
    try:
        return np.loadtxt(lines, dtype=float, delimiter=delimiter, comments=None, ndmin=2, usecols=wanted)
    except ValueError:  # Python takes 1_000 for a number
        raise InputError(f"{name}: the rows cannot be read as numbers") from None


def _first_fault(
    lines: list[str], delimiter: str | None, columns: list[str], first_line: int, wanted: set[int]
) -> str:
    """What keeps the columns wanted from being numbers; empty where nothing does."""
    row, last = 0, max((number for number, line in enumerate(lines, first_line) if line.strip()), default=0)
    for number, line in enumerate(lines, first_line):
        if not line.strip():
            continue
        row += 1
        where = f"row {row} (line {number})"
        cells = line.split(delimiter)
        if len(cells) > 1 and not cells[-1].strip() and (not columns[-1] or len(cells) == len(columns) + 1):
            every = "every line" if not columns[-1] else where
            return f"{every} ends with {delimiter!r}, after which nothing comes: take it off"
        if len(cells) != len(columns):
            return (
                f"{where} has {len(cells)} cell{'s' * (len(cells) != 1)}, where the columns are "
                f"{len(columns)} ({columns[0]} ... {columns[-1]}): "
                + (
                    "the last line was cut off: take it away"
                    if number == last and row > 1 and len(cells) < len(columns)
                    else "every row must have as many cells as there are columns"
                )
            )
        for place, (column, cell) in enumerate(zip(columns, cells, strict=True)):
            if place not in wanted:
                continue
            try:
                float(cell)
            except ValueError:
                what = f"{cell.strip()[:40]!r} is no number" if cell.strip() else "the cell is empty"
                return f"column {column}, {where}: {what}; every cell must hold one, with a decimal point"
    return ""
