"""NumPy archives: arrays `time` (n,), `q`, `dq` or `qd`, `tau` (n, dof); others by `--columns`."""

import zipfile
import zlib
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..reading import CHANNELS, Reading
from .checks import checked
from .libfranka import PANDA_PY_ARRAYS
from .recording import Origin, Recording
from .table import of_arrays, recording_of, refuse, within

_ALIASES = {"time": ("time",), "q": ("q",), "dq": ("dq", "qd"), "tau": ("tau",)}


def read_npz(path: Path, reading: Reading) -> list[Recording]:
    """A recording from `.npz`; pickled objects are never loaded.

    Raises:
        InputError: naming the file and the array, and what would work.
    """
    refuse(path.name, reading, "topic", "episode")
    try:
        with np.load(path, allow_pickle=False) as archive:
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise InputError(
                    f"{path.name}: a single array, where an archive with time, q, dq, tau is needed"
                )
            if reading.columns or "tau_J" in archive.files:
                arrays = {name: archive[name] for name in archive.files}
                numeric = {k: v for k, v in arrays.items() if v.dtype.kind in "fiu" and v.ndim in (1, 2)}
                shapes = {name: array.shape for name, array in numeric.items()}
                table = of_arrays(path, path.name, shapes, numeric.__getitem__)
                return [recording_of(table, (PANDA_PY_ARRAYS,), reading)]
            return [
                _canonical(path, {channel: _array(archive, channel, path) for channel in _ALIASES}, reading)
            ]
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


def _canonical(path: Path, arrays: dict[str, np.ndarray | None], reading: Reading) -> Recording:
    for channel in ("time", "q"):
        if arrays[channel] is None:
            raise InputError(
                f"{path.name}: no array {channel}; arrays time (n,), q, dq, tau (n, joints) are needed, or "
                "--columns that say which is which"
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
    origin = Origin("canonical arrays", {c: c for c in CHANNELS if arrays[c] is not None}, "measured")
    recording = Recording(path.name, time, q, arrays["dq"], arrays["tau"], path, origin=origin)
    cut, first = within(recording, reading)
    return checked(cut, lambda i: f"row {i + first + 1}")


def _array(archive, channel: str, path: Path) -> np.ndarray | None:
    present = [name for name in _ALIASES[channel] if name in archive.files]
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
