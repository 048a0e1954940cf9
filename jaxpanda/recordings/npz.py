"""NumPy archives: arrays `time` (n,), `q`, `dq` or `qd`, `tau` (n, dof)."""

import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..errors import InputError
from .checks import checked
from .recording import Recording

_ALIASES = {"time": ("time",), "q": ("q",), "dq": ("dq", "qd"), "tau": ("tau",)}


def read_npz(path: Path, columns: Mapping[str, str] | None = None) -> Recording:
    """A recording from `.npz`; pickled objects are never loaded.

    Args:
        path: the file.
        columns: {time, q, dq or tau: name of the array in the file} where the two differ.

    Raises:
        InputError: naming the file and the array, and what would work.
    """
    arrays = _arrays(path, columns)
    for channel in ("time", "q"):
        if arrays[channel] is None:
            raise InputError(
                f"{path.name}: no array {channel}; arrays time (n,), q, dq, tau (n, joints) are needed"
            )
    time, q = arrays["time"], arrays["q"]
    assert time is not None
    assert q is not None
    if time.ndim != 1:
        raise InputError(f"{path.name}: array time has the shape {time.shape}, where (n,) is needed")
    shape = (len(time), q.shape[1] if q.ndim == 2 else "joints")
    for channel in ("q", "dq", "tau"):
        array = arrays[channel]
        if array is not None and (array.shape != shape or array.shape[1] == 0):
            raise InputError(
                f"{path.name}: array {channel} has the shape {array.shape}, where {shape} is needed"
            )
    return checked(Recording(path.name, time, q, arrays["dq"], arrays["tau"], path))


def _arrays(path: Path, columns: Mapping[str, str] | None) -> dict[str, np.ndarray | None]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise InputError(
                    f"{path.name}: a single array, where an archive with time, q, dq, tau is needed"
                )
            return {channel: _array(archive, channel, path, columns) for channel in _ALIASES}
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path.name}: no NumPy archive, or a broken one ({error})") from None
    except InputError:
        raise
    except ValueError as error:
        raise InputError(
            f"{path.name}: holds no plain arrays ({error}): save numbers only, no objects"
        ) from None


def _array(archive, channel: str, path: Path, columns: Mapping[str, str] | None) -> np.ndarray | None:
    asked = (columns or {}).get(channel)
    if asked is not None and asked not in archive.files:
        raise InputError(
            f"{path.name}: no array {asked!r} (asked for as {channel}); it has {', '.join(archive.files)}"
        )
    present = [asked] if asked else [name for name in _ALIASES[channel] if name in archive.files]
    if not present:
        return None
    if len(present) > 1:
        raise InputError(f"{path.name}: arrays {' and '.join(present)} are both there: keep one")
    array = archive[present[0]]
    if not (np.issubdtype(array.dtype, np.floating) or np.issubdtype(array.dtype, np.integer)):
        raise InputError(
            f"{path.name}: array {present[0]} holds {array.dtype}, where real numbers are needed"
        )
    return np.asarray(array, dtype=float)


def write_npz(recording: Recording, path: Path) -> None:
    """The archive that `read_npz` reads."""
    arrays = {"time": recording.time, "q": recording.q, "dq": recording.qd, "tau": recording.tau}
    with path.open("wb") as file:
        np.savez_compressed(file, **{name: array for name, array in arrays.items() if array is not None})
