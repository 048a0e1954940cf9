"""MATLAB's `.mat`: versions 4 to 7 by SciPy, 7.3, which is HDF5, by h5py (extra [io]).

A variable is called by its name, a field of a structure by `structure.field`, columns by `[0]`, `[1]`, …; time
runs along the longer side of a matrix. Names are free, so `--columns` says which is which.
"""

import dataclasses
import io
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from .. import inputs
from ..errors import InputError
from ..reading import Reading
from .hdf5 import opened, table_of
from .recording import Recording
from .table import Source, of_arrays, recording_of, refuse

ARRAYS = Source("MATLAB's arrays", {"time": "time", "q": "q", "dq": "dq", "tau": "tau"})
"""Variables that are called as the canonical archive's arrays are."""


def read_mat(path: Path, reading: Reading) -> list[Recording]:
    """The recording in a `.mat` file.

    Raises:
        MissingExtraError: version 7.3 without h5py.
        InputError: no such file, or columns that cannot be told.
    """
    refuse(path.name, reading, "topic", "episode")
    start = inputs.read_start(path, 1024)
    if start.startswith(b"MATLAB 7.3") or b"\x89HDF\r\n\x1a\n" in start:
        with opened(path) as file:
            table = table_of(path, path.name, file)
            names = [name.replace("/", ".") for name in table.names]
            return [recording_of(dataclasses.replace(table, names=names), (ARRAYS,), reading)]
    packed = inputs.read_bytes(path)
    try:
        _require_unpacked(path.name, packed)
        content = scipy.io.loadmat(io.BytesIO(packed), simplify_cells=True)
    except InputError:
        raise
    except Exception as error:  # what a broken file raises is as varied as its parts
        said = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"{path.name}: no MATLAB file, or a broken one ({said})") from None
    arrays = dict(_arrays({k: v for k, v in content.items() if not k.startswith("__")}))
    table = of_arrays(
        path, path.name, {key: array.shape for key, array in arrays.items()}, arrays.__getitem__
    )
    return [recording_of(table, (ARRAYS,), reading)]


def _require_unpacked(name: str, content: bytes) -> None:
    """Refuse a file of version 7 whose packed variables would fill the memory; others are not packed."""
    if content[124:128] not in (b"\x00\x01IM", b"\x01\x00MI"):
        return
    order = "<II" if content[126:128] == b"IM" else ">II"
    at, size = 128, 0
    while at + 8 <= len(content):
        kind, length = struct.unpack_from(order, content, at)
        if kind == _PACKED:
            rest, unpacker = content[at + 8 : at + 8 + length], zlib.decompressobj()
            while rest and (part := unpacker.decompress(rest, 1 << 20)):
                size, rest = size + len(part), unpacker.unconsumed_tail
                inputs.require_unpacked(name, len(content), size)
        at += 8 + length


_PACKED = 15  # miCOMPRESSED of MATLAB's MAT-file format, level 5


def _arrays(content: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Vectors and matrices of numbers, those of structures by their path."""
    for key, value in content.items():
        if isinstance(value, Mapping):
            yield from _arrays(value, f"{prefix}{key}.")
        elif (
            isinstance(value, np.ndarray)
            and value.dtype.kind in "fiu"
            and value.ndim in (1, 2)
            and value.size > 1
        ):
            yield f"{prefix}{key}", value
