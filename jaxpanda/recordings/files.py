"""Recordings from files and folders, and back."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from ..errors import InputError
from ..files import write_bytes
from .csv import csv_bytes, read_csv
from .npz import npz_bytes, read_npz
from .parquet import parquet_bytes, read_parquet
from .raw_logs import read_raw_logs
from .recording import Recording

_READERS: Mapping[str, Callable[[Path, Mapping[str, str] | None], Recording]] = {
    "csv": read_csv,
    "npz": read_npz,
    "parquet": read_parquet,
    "raw_logs": lambda path, columns: _only(read_raw_logs(path, columns), path),
}
_WRITERS: Mapping[str, Callable[[Recording, str], bytes]] = {
    "csv": csv_bytes,
    "npz": npz_bytes,
    "parquet": parquet_bytes,
}
_SUFFIXES = {".csv": "csv", ".csv.gz": "csv", ".npz": "npz", ".parquet": "parquet"}


def load(path: str | Path, *, format: str = "auto", columns: Mapping[str, str] | None = None) -> Recording:
    """The recording in a file or a folder of logs.

    Args:
        path: canonical CSV (`.csv`, `.csv.gz`), `.npz`, `.parquet`, or a folder of one-number-a-line logs.
        format: "csv", "npz", "parquet", "raw_logs"; "auto" goes by the name.
        columns: {canonical name: name in the file} where the two differ. For an archive or a folder the
            canonical names are `time`, `q`, `dq` and `tau`.

    Raises:
        InputError: one sentence that names file, column and row, and what would work.
        MissingExtraError: Parquet without pyarrow.
    """
    path = Path(path)
    return _READERS[_format(path, format)](path, columns)


def load_many(paths: Iterable[str | Path]) -> list[Recording]:
    """Every recording in several files and folders, in their order.

    A folder of logs that holds several runs, where time goes back between them, gives one recording a run.
    """
    recordings: list[Recording] = []
    for path in map(Path, paths):
        recordings += read_raw_logs(path) if path.is_dir() else [load(path)]
    return recordings


def distinct(recordings: Sequence[Recording]) -> list[Recording]:
    """The recordings, those of one name called by as much of their paths as tells them apart.

    Raises:
        InputError: one is there twice, or two that come from no file have one name.
    """
    paths = [r.path.resolve().parts if r.path else None for r in recordings]
    out = []
    for i, (one, path) in enumerate(zip(recordings, paths, strict=True)):
        others = [paths[k] for k, r in enumerate(recordings) if r.name == one.name and k != i]
        if others and (path is None or None in others or path in others):
            raise InputError(
                f"{one.path or one.name}: is given twice, where each recording counts once and needs a name of"
                " its own"
            )
        count = 1
        while path and any(other and path[-count:] == other[-count:] for other in others):
            count += 1
        name = Path(*path[-count:-1], one.name).as_posix() if path and others else one.name
        out.append(dataclasses.replace(one, name=name))
    return out


def save(recording: Recording, path: str | Path) -> None:
    """Write a recording as `.csv`, `.csv.gz`, `.npz` or `.parquet`, by the name; whole or not at all.

    Every number reads back to the same float64. Repairs and notes are not kept in the file.

    Raises:
        InputError: unknown suffix, a folder that does not exist, or `path` is a link or device.
        OutputError: the disk is full.
    """
    path = Path(path)
    writer = _WRITERS[_by_suffix(path)]
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist")
    write_bytes(path, writer(recording, path.name))


def _format(path: Path, format: str) -> str:
    if format == "auto":
        if not path.exists():
            raise InputError(f"{path}: no such file or folder")
        return "raw_logs" if path.is_dir() else _by_suffix(path)
    if format not in _READERS:
        raise InputError(f"unknown format {format!r}; there are auto, {', '.join(_READERS)}")
    return format


def _by_suffix(path: Path) -> str:
    name = path.name.lower()
    for suffix, kind in _SUFFIXES.items():
        if name.endswith(suffix):
            return kind
    raise InputError(
        f"{path.name}: unknown kind of recording; a name ending in {', '.join(_SUFFIXES)}, or a folder of "
        "logs is needed"
    )


def _only(runs: list[Recording], path: Path) -> Recording:
    if len(runs) > 1:
        starts = ", ".join(f"{run.samples} rows" for run in runs)
        raise InputError(
            f"{path}: {len(runs)} runs ({starts}), where one is needed: load_many gives each of them"
        )
    return runs[0]
