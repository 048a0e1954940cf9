"""Recordings from files and folders, and back."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from ..errors import InputError
from ..files import write_bytes
from ..reading import Reading
from .csv import csv_bytes, read_csv
from .hdf5 import read_hdf5
from .lerobot import INFO, read_lerobot
from .matlab import read_mat
from .npz import npz_bytes, read_npz
from .parquet import parquet_bytes, read_parquet
from .raw_logs import read_raw_logs
from .recording import Recording
from .ros import read_bag

_READERS: Mapping[str, Callable[[Path, Reading], list[Recording]]] = {
    "csv": read_csv,
    "npz": read_npz,
    "parquet": read_parquet,
    "bag": read_bag,
    "hdf5": read_hdf5,
    "mat": read_mat,
    "lerobot": read_lerobot,
    "raw_logs": read_raw_logs,
}
_WRITERS: Mapping[str, Callable[[Recording, str], bytes]] = {
    "csv": csv_bytes,
    "npz": npz_bytes,
    "parquet": parquet_bytes,
}
_TEXT = (".csv", ".txt", ".log", ".dat", ".tsv")
_SUFFIXES = {
    **{suffix + packed: "csv" for suffix in _TEXT for packed in ("", ".gz")},
    ".npz": "npz",
    ".parquet": "parquet",
    **dict.fromkeys((".bag", ".mcap", ".db3"), "bag"),
    **dict.fromkeys((".h5", ".hdf5"), "hdf5"),
    ".mat": "mat",
}
_FOLDERS = {INFO: "lerobot", Path("metadata.yaml"): "bag"}
"""The file that makes a folder what it is; a folder without any is one of raw logs."""


def load(
    path: str | Path,
    *,
    format: str = "auto",
    columns: Mapping[str, str] | None = None,
    reading: Reading | None = None,
) -> Recording:
    """The recording in a file or a folder.

    Args:
        path: what `docs/files.md` lists: CSV and other tables of text, `.npz`, Parquet, bags and MCAP, HDF5,
            `.mat`, a folder of a LeRobot data set, of a bag, or of one-number-a-line logs.
        format: "csv", "npz", "parquet", "bag", "hdf5", "mat", "lerobot", "raw_logs"; "auto" goes by the name.
        columns: {time, q, dq, tau, or one joint's q_1, …: columns in the file}, as `Reading.columns`.
        reading: which topic, episode, columns and times are meant.

    Raises:
        InputError: one sentence that names file, column and row, and what would work.
        MissingExtraError: a format whose library is not installed.
    """
    reading = Reading() if reading is None else reading
    said = tuple(f"{channel}={where}" for channel, where in (columns or {}).items())
    path = Path(path)
    return _only(_read(path, format, dataclasses.replace(reading, columns=(*reading.columns, *said))), path)


def load_many(paths: Iterable[str | Path], reading: Reading | None = None) -> list[Recording]:
    """Every recording in several files and folders, in their order.

    A folder of logs that holds several runs, where time goes back between them, gives one recording a run; of a
    file with several episodes those that `reading` asks for.
    """
    reading = Reading() if reading is None else reading
    return [recording for path in map(Path, paths) for recording in _read(path, "auto", reading)]


def _read(path: Path, format: str, reading: Reading) -> list[Recording]:
    return _READERS[_format(path, format)](path, reading)


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
    write_bytes(path, content_of(recording, path))


def content_of(recording: Recording, path: str | Path) -> bytes:
    """What `save` writes.

    Raises:
        InputError: unknown suffix, or a folder that does not exist.
    """
    path = Path(path)
    kind = next((kind for suffix, kind in _SUFFIXES.items() if path.name.lower().endswith(suffix)), "")
    writer = _WRITERS.get(kind)
    if writer is None or path.name.lower().removesuffix(".gz").endswith(_TEXT[1:]):
        raise InputError(f"{path}: recordings are written as .csv, .csv.gz, .npz or .parquet")
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist")
    return writer(recording, path.name)


def _format(path: Path, format: str) -> str:
    if format == "auto":
        if not path.exists():
            raise InputError(f"{path}: no such file or folder")
        if path.is_dir():
            return next((kind for mark, kind in _FOLDERS.items() if (path / mark).is_file()), "raw_logs")
        return _by_suffix(path)
    if format not in _READERS:
        raise InputError(f"unknown format {format!r}; there are auto, {', '.join(_READERS)}")
    return format


def _by_suffix(path: Path) -> str:
    name = path.name.lower()
    for suffix, kind in _SUFFIXES.items():
        if name.endswith(suffix):
            return kind
    known = ", ".join(suffix for suffix in _SUFFIXES if not suffix.endswith(".gz"))
    raise InputError(
        f"{path.name}: unknown kind of recording; a name ending in {known}, or a folder of logs, a bag or a "
        "LeRobot data set is needed"
    )


def _only(runs: list[Recording], path: Path) -> Recording:
    if len(runs) > 1:
        starts = ", ".join(f"{run.samples} rows" for run in runs)
        raise InputError(
            f"{path}: {len(runs)} runs ({starts}), where one is needed: choose by --episode, from 1 on"
        )
    return runs[0]
