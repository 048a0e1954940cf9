"""NumPy archives: arrays `time` (n,), `q`, `dq` or `qd`, `tau` (n, dof)."""

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from .. import inputs
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
    archive = inputs.read_npz(path)
    return {channel: _array(archive, channel, path, columns) for channel in _ALIASES}


def _array(
    archive: Mapping[str, np.ndarray], channel: str, path: Path, columns: Mapping[str, str] | None
) -> np.ndarray | None:
    asked = (columns or {}).get(channel)
    if asked is not None and asked not in archive:
        raise InputError(
            f"{path.name}: no array {asked!r} (asked for as {channel}); it has {', '.join(archive)}"
        )
    present = [asked] if asked else [name for name in _ALIASES[channel] if name in archive]
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


def npz_bytes(recording: Recording, name: str) -> bytes:
    """The archive that `read_npz` reads."""
    arrays = {"time": recording.time, "q": recording.q, "dq": recording.qd, "tau": recording.tau}
    np.savez_compressed(out := io.BytesIO(), **{name: a for name, a in arrays.items() if a is not None})
    return out.getvalue()
