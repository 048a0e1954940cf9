"""Parquet: the canonical columns as scalar float64 columns, or those of a data set; needs the extra [io].

A column of lists is `name[0]`, `name[1]`, …; a file of several episodes has a column that numbers them.
"""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from .. import inputs
from ..errors import InputError, MissingExtraError, reason
from ..reading import Reading
from .recording import Recording
from .table import WIDEST, Source, Table, canonical_names, chosen, recording_of, refuse
from .voraus import VORAUS

EPISODES = ("episode_index",)
"""Columns that number the episodes of a file whose source does not say which does."""


def read_parquet(path: Path, reading: Reading) -> list[Recording]:
    """The recording in a Parquet file, or those of its episodes that are asked for.

    Raises:
        MissingExtraError: pyarrow is not installed.
        InputError: naming file and column, and what would work.
    """
    refuse(path.name, reading, "topic")
    return read_episodes([path], path, path.name, (VORAUS,), reading)


def read_episodes(
    files: Sequence[Path], path: Path, name: str, sources: Sequence[Source], reading: Reading
) -> list[Recording]:
    """The episodes asked for of a data set that lies in several files of one form.

    Args:
        files: in the order of their rows.
        path: file or folder that the recordings come from.
        name: as messages call it.
        sources: who writes such data sets.
        reading: what is meant.
    """
    with _telling(name):
        names, kept, widths = _columns(_opened(files[0]))
        marks = [s.episode for s in sources if s.episode and set(s.marks) <= set(names)] or list(EPISODES)
        episode = next((mark for mark in marks if mark in names), "")
        numbers = [_numbers(file, episode, name) for file in files] if episode else []
    if not episode:
        refuse(name, reading, "episode")
        return [recording_of(_table(files, None, path, name, names, kept, widths), sources, reading)]
    every = sorted({k for each in numbers for k in np.unique(each).tolist()})
    wanted = chosen(name, [str(k) for k in every], reading)
    out = []
    for number in map(int, wanted):
        rows = [np.flatnonzero(each == number) for each in numbers]
        called = name if len(every) == 1 else f"{name} (episode {number})"
        out.append(recording_of(_table(files, rows, path, called, names, kept, widths), sources, reading))
    return out


@contextlib.contextmanager
def _telling(name: str) -> Iterator[None]:
    """What cannot be read of a file ends in one sentence."""
    arrow, _ = pyarrow()
    try:
        yield
    except InputError:
        raise
    except (OSError, LookupError, UnicodeDecodeError, arrow.ArrowException) as error:
        raise InputError(f"{name}: no Parquet file, or a broken one ({reason(error)})") from None


def _opened(file: Path) -> Any:
    return pyarrow()[1].ParquetFile(inputs.in_place(file))


def _content(file: Path, wanted: Sequence[str], name: str) -> Any:
    """Some columns, once they are found to hold no more numbers than are read; a few bytes may say many."""
    opened = _opened(file)
    groups = [opened.metadata.row_group(i) for i in range(opened.metadata.num_row_groups)]
    chunks = [group.column(i) for group in groups for i in range(group.num_columns)]
    inside = tuple(f"{column}." for column in wanted)
    inputs.require_size(name, sum(c.num_values for c in chunks if f"{c.path_in_schema}.".startswith(inside)))
    return opened.read(list(wanted))


def _columns(file: Any) -> tuple[list[str], list[tuple[str, int | None]], dict[str, int]]:
    """Names of all columns, lists taken apart; of each, the column it is in; of each list, its width."""
    arrow, _ = pyarrow()
    names: list[str] = []
    kept: list[tuple[str, int | None]] = []
    widths: dict[str, int] = {}
    for field in file.schema_arrow:
        kind = field.type
        if (
            arrow.types.is_list(kind)
            or arrow.types.is_large_list(kind)
            or arrow.types.is_fixed_size_list(kind)
        ):
            if not arrow.types.is_primitive(kind.value_type):
                continue
            if arrow.types.is_fixed_size_list(kind):
                width = kind.list_size
            else:
                first = next(file.iter_batches(1, columns=[field.name]), None)
                width = 0 if first is None else len(first.column(field.name)[0] or ())
            if width > WIDEST:
                continue
            widths[field.name] = width
            names += [f"{field.name}[{k}]" for k in range(width)]
            kept += [(field.name, k) for k in range(width)]
        else:
            names.append(field.name)
            kept.append((field.name, None))
    return names, kept, widths


def _numbers(file: Path, episode: str, name: str) -> np.ndarray:
    """The episode of each row."""
    arrow, _ = pyarrow()
    numbers = _array(arrow, _content(file, [episode], name), episode, None, name)
    if not np.all(np.abs(numbers) < 2**53) or np.any(numbers % 1):
        raise InputError(f"{name}: column {episode} numbers the episodes, but holds what is no whole number")
    return numbers.astype(int)


def _table(files, rows, path, name, names, kept, widths) -> Table:
    """Columns of some rows of every file; None for all rows."""

    def take(places: Sequence[int]) -> np.ndarray:
        arrow, _ = pyarrow()
        wanted = list(dict.fromkeys(kept[i][0] for i in places))
        parts = []
        for k, file in enumerate(files):
            if rows is not None and not len(rows[k]):
                continue
            with _telling(name):
                content = _content(file, wanted, name)
                if rows is not None:
                    content = content.take(arrow.array(rows[k]))
                arrays = {c: _array(arrow, content, c, widths.get(c), name) for c in wanted}
            parts.append(
                np.column_stack(
                    [arrays[c] if j is None else arrays[c][:, j] for c, j in (kept[i] for i in places)]
                )
            )
        return np.concatenate(parts) if parts else np.zeros((0, len(places)))

    return Table(path, name, names, take)


def _array(arrow: ModuleType, content, column: str, width: int | None, name: str) -> np.ndarray:
    """One column as float64; a list is a row of a matrix."""
    values = content.column(column).combine_chunks()
    kind = values.type if width is None else values.type.value_type
    if not (arrow.types.is_floating(kind) or arrow.types.is_integer(kind)):
        raise InputError(f"{name}: column {column} holds {kind}, where numbers are needed")
    if width is None:
        return values.to_numpy(zero_copy_only=False).astype(float)
    flat = values.flatten().to_numpy(zero_copy_only=False).astype(float)
    if len(flat) != width * len(values):
        raise InputError(
            f"{name}: column {column} holds lists of several lengths, where all must have {width} numbers"
        )
    return flat.reshape(-1, width)


def parquet_bytes(recording: Recording, name: str) -> bytes:
    """The canonical columns, losslessly compressed."""
    arrow, parquet = pyarrow()
    names = canonical_names(recording)
    table = np.column_stack([recording.time, *recording.channels()])
    out = arrow.BufferOutputStream()
    parquet.write_table(
        arrow.table({name: table[:, i] for i, name in enumerate(names)}), out, compression="zstd"
    )
    return out.getvalue().to_pybytes()


def pyarrow() -> tuple[ModuleType, ModuleType]:
    """pyarrow and its Parquet module."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise MissingExtraError("Parquet", "io") from None
    return pyarrow, pyarrow.parquet
