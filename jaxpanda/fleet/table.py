"""The table that a fleet is given as: a row a recording.

Columns `recording`, and where they are there `arm`, `model`, `time` or `day`, `reference`; all others are carried
through.
"""

import csv
import dataclasses
import datetime
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from .. import inputs
from ..errors import InputError

BYTES = 1 << 26
"""Most that a table may have."""
ROWS = 1_000_000
"""Most rows that it may have."""
_OWN = ("recording", "arm", "model", "time", "day", "reference")
RESULTS = ("row", "when", "status", "message", "verdict", "findings", "off_by_noise", "key")
"""Columns that recordings.parquet has beside those of the table."""
_YES = {"1", "true", "yes", "y", "x"}
_NO = {"", "0", "false", "no", "n"}
_SECONDS = 86400.0
_PANDA = "of the Panda"


@dataclasses.dataclass(frozen=True)
class Row:
    """One recording of one arm."""

    number: int
    """Of the row in the table, from 1, the header not counted."""
    recording: str
    """As the table has it."""
    path: Path
    arm: str
    model: Path | None
    """None for the project's own Panda."""
    when: float | None
    """When it was made: the number in the table, or days since 1970 where that is a date."""
    reference: bool
    """Whether nothing was wrong then."""
    extra: Mapping[str, str]
    """Further columns, as they are."""


@dataclasses.dataclass(frozen=True)
class Table:
    """Rows, and what their columns are."""

    path: Path
    rows: tuple[Row, ...]
    columns: tuple[str, ...]
    """That are carried through."""
    time: str
    """Name of the column that says when; "" where there is none."""
    dated: bool
    """Whether that column has dates, rather than numbers."""


def load_table(path: Path, model: Path | None) -> Table:
    """The table in a CSV (cells between commas, semicolons or tabs, in quotation marks where needed).

    Args:
        path: the table. Recordings and models in it are relative to its folder.
        model: of rows that name none; None for the project's own Panda.

    Raises:
        InputError: one sentence that names the column and the row.
    """
    text = inputs.read_text(path, BYTES, "a table of recordings as CSV")
    header = text.lstrip().partition("\n")[0]
    delimiter = max(",;\t", key=header.count)
    try:
        lines = [
            (reader.line_num, cells)
            for reader in [csv.reader(io.StringIO(text), delimiter=delimiter, strict=True)]
            for cells in reader
            if any(cell.strip() for cell in cells)
        ]
    except csv.Error as error:
        raise InputError(f"{path.name}: no CSV ({error}); close quotation marks, or leave them out") from None
    names = [name.strip() for name in lines[0][1]]
    _require_columns(path.name, names)
    if len(lines) == 1:
        raise InputError(f"{path.name}: a header but no rows; a row for each recording is needed")
    if len(lines) - 1 > ROWS:
        raise InputError(f"{path.name}: has {len(lines) - 1} rows, where at most {ROWS} are taken: split it")
    time = next((name for name in ("time", "day") if name in names), "")
    rows = []
    for number, (line, cells) in enumerate(lines[1:], 1):
        where = f"{path.name}: row {number} (line {line})"
        if len(cells) != len(names):
            raise InputError(f"{where} has {len(cells)} cells, where the columns are {len(names)}")
        rows.append(_row(where, number, dict(zip(names, map(str.strip, cells), strict=True)), path, model))
    dates = {_is_date(row) for row in rows if row[time]} if time else set()
    if len(dates) > 1:
        odd = next(i for i, row in enumerate(rows, 1) if row[time] and _is_date(row) != _is_date(rows[0]))
        raise InputError(f"{path.name}: column {time} has dates and numbers (row {odd}); one kind is needed")
    extra = tuple(name for name in names if name not in _OWN)
    made = tuple(_made(row, extra) for row in rows)
    _require_sense(path.name, made)
    return Table(path, made, extra, time, True in dates)


def _require_columns(name: str, names: Sequence[str]) -> None:
    if "recording" not in names:
        raise InputError(
            f"{name}: no column recording (columns: {', '.join(names[:8])}); it must name the files to diagnose"
        )
    for column in names:
        if names.count(column) > 1:
            raise InputError(f"{name}: column {column or '(without a name)'} is there twice")
        if column in RESULTS:
            raise InputError(
                f"{name}: column {column}: results have a column of that name; call it otherwise"
            )
    if {"time", "day"} <= set(names):
        raise InputError(f"{name}: has both columns time and day; one of them says when a recording was made")


def _row(where: str, number: int, cells: dict[str, str], path: Path, model: Path | None) -> dict:
    """The cells of a row, with what is read of them."""
    if not cells["recording"]:
        raise InputError(f"{where}: column recording is empty; a file or folder is needed")
    reference = cells.get("reference", "").lower()
    if reference not in _YES | _NO:
        raise InputError(f"{where}: column reference: {cells['reference']!r} is neither yes nor no")
    own = cells.get("model", "")
    cells |= {"time": cells.get("time", ""), "day": cells.get("day", "")}
    when = cells["time"] or cells["day"]
    return cells | {
        "_number": number,
        "_path": path.parent / cells["recording"],
        "_model": path.parent / own if own else model,
        "_when": _when(where, "time" if cells["time"] else "day", when) if when else (None, False),
        "_reference": reference in _YES,
    }


def _when(where: str, column: str, text: str) -> tuple[float, bool]:
    """A number, or days since 1970 (UTC where a date does not say), and whether it was a date."""
    try:
        value = float(text)
    except ValueError:
        pass
    else:
        if not math.isfinite(value):
            raise InputError(f"{where}: column {column}: {text!r} is no finite number")
        return value, False
    try:
        date = datetime.datetime.fromisoformat(text)
    except ValueError:
        raise InputError(
            f"{where}: column {column}: {text!r} is neither a number nor a date such as 2026-03-14 or"
            " 2026-03-14T09:30"
        ) from None
    date = date if date.tzinfo else date.replace(tzinfo=datetime.UTC)
    return date.timestamp() / _SECONDS, True


def _is_date(row: Mapping) -> bool:
    return row["_when"][1]


def _made(row: Mapping, extra: Sequence[str]) -> Row:
    model = row["_model"]
    return Row(
        number=row["_number"],
        recording=row["recording"],
        path=row["_path"],
        arm=row.get("arm", "") or ("panda" if model is None else model.stem),
        model=model,
        when=row["_when"][0],
        reference=row["_reference"],
        extra={name: row[name] for name in extra},
    )


def _require_sense(name: str, rows: Sequence[Row]) -> None:
    """Refuse what is there twice, and an arm of two models: its estimates are corrections to one."""
    seen: dict[Path, int] = {}
    models: dict[str, Row] = {}
    for row in rows:
        if (first := seen.setdefault(row.path.resolve(), row.number)) != row.number:
            raise InputError(
                f"{name}: row {row.number}: {row.recording} stands in row {first} already; each counts once"
            )
        other = models.setdefault(row.arm, row)
        if other.model != row.model:
            raise InputError(
                f"{name}: row {row.number}: arm {row.arm} has the model {row.model or _PANDA}, in row"
                f" {other.number} {other.model or _PANDA}; estimates of one arm are corrections to one model"
            )
