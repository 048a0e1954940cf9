"""MATLAB's `.mat`: versions 4 to 7 by SciPy, 7.3, which is HDF5, by h5py (extra [io]).

A variable is called by its name, a field of a structure by `structure.field`, columns by `[0]`, `[1]`, …; time
runs along the longer side of a matrix. Names are free, so `--columns` says which is which.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

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
    try:
        with path.open("rb") as file:
            start = file.read(1024)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    if start.startswith(b"MATLAB 7.3") or b"\x89HDF\r\n\x1a\n" in start:
        with opened(path) as file:
            table = table_of(path, path.name, file)
            names = [name.replace("/", ".") for name in table.names]
            return [recording_of(dataclasses.replace(table, names=names), (ARRAYS,), reading)]
    try:
        content = scipy.io.loadmat(path, simplify_cells=True)
    except Exception as error:  # what a broken file raises is as varied as its parts
        said = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"{path.name}: no MATLAB file, or a broken one ({said})") from None
    arrays = dict(_arrays({k: v for k, v in content.items() if not k.startswith("__")}))
    table = of_arrays(
        path, path.name, {key: array.shape for key, array in arrays.items()}, arrays.__getitem__
    )
    return [recording_of(table, (ARRAYS,), reading)]


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
