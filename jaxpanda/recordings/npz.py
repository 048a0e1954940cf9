"""NumPy archives: arrays `time` (n,), `q`, `dq` or `qd`, `tau` (n, dof); others by `--columns`."""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .. import inputs
from ..errors import InputError, printable
from ..reading import CHANNELS, Reading
from .checks import checked
from .libfranka import PANDA_PY_ARRAYS
from .recording import Origin, Recording
from .table import (
    MEASURED_TOO,
    UNMEASURED,
    Source,
    of_arrays,
    recording_of,
    refuse,
    unmeasured,
    within,
)

_ALIASES = {"time": ("time",), "q": ("q",), "dq": ("dq", "qd"), "tau": ("tau",), "tau_motor": ("tau_motor",)}
_CANONICAL = (
    Source("canonical arrays", {c: c for c in CHANNELS} | {"dq": "qd"}, "measured", "", marks=("qd",)),
    Source("canonical arrays", {c: c for c in CHANNELS}, "measured", ""),
)
"""What of such arrays `--columns` does not speak of."""


def read_npz(path: Path, reading: Reading) -> list[Recording]:
    """A recording from `.npz`; pickled objects are never loaded.

    Raises:
        InputError: naming the file and the array, and what would work.
    """
    refuse(path.name, reading, "topic", "episode")
    archive = inputs.read_npz(path)
    if not (reading.columns or "tau_J" in archive):
        return [_canonical(path, archive, reading)]
    numeric = {k: v for k, v in archive.items() if v.dtype.kind in "fiu" and v.ndim in (1, 2)}
    shapes = {name: array.shape for name, array in numeric.items()}
    table = of_arrays(path, path.name, shapes, numeric.__getitem__)
    return [recording_of(table, (PANDA_PY_ARRAYS, *_CANONICAL), reading)]


def _canonical(path: Path, archive: Mapping[str, np.ndarray], reading: Reading) -> Recording:
    arrays = {channel: _array(archive, channel, path) for channel in _ALIASES}
    other = [name for name in archive if not any(name in names for names in _ALIASES.values())]
    for channel in ("time", "q"):
        if arrays[channel] is None:
            raise InputError(
                f"{path.name}: no array {channel}; arrays time (n,), q, dq, tau (n, joints) are needed, or "
                "--columns that say which is which"
            )
    time, q = arrays["time"], arrays["q"]
    assert time is not None
    assert q is not None
    if q.ndim == 2 and len(q) != len(time) == q.shape[1]:
        raise InputError(
            f"{path.name}: array q has the shape {q.shape}, where ({len(time)}, joints) is needed: transpose it"
        )
    if time.ndim != 1:
        raise InputError(f"{path.name}: array time has the shape {time.shape}, where (n,) is needed")
    shape = (len(time), q.shape[1] if q.ndim == 2 else "joints")
    for channel in CHANNELS[1:]:
        array = arrays[channel]
        if array is not None and (array.shape != shape or array.shape[1] == 0):
            raise InputError(
                f"{path.name}: array {channel} has the shape {array.shape}, where {shape} is needed"
            )
    notes = []
    if other:
        notes.append(f"ignores {len(other)} other arrays: {', '.join(map(printable, other[:12]))}")
    for channel in MEASURED_TOO:
        array = arrays[channel]
        if array is not None and (what := unmeasured(array, q, False)):
            arrays[channel] = None
            notes.append(UNMEASURED.format(name=channel, what=what))
    channels = {c: c for c in CHANNELS if arrays[c] is not None}
    origin = Origin("canonical arrays", channels, "measured", columns=channels)
    rows, cut_notes = within(path.name, time, reading)
    row = lambda i: f"row {i + rows.start + 1}"
    q, qd, *torque = (None if (array := arrays[c]) is None else array[rows] for c in CHANNELS[1:])
    assert q is not None
    tau, motor = torque
    recording = Recording(
        path.name,
        time[rows],
        q,
        qd,
        tau,
        path,
        notes=(*notes, *cut_notes),
        origin=origin,
        tau_motor=motor,
        row=row,
    )
    return checked(recording, row)


def _array(archive: Mapping[str, np.ndarray], channel: str, path: Path) -> np.ndarray | None:
    present = [name for name in _ALIASES[channel] if name in archive]
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
    arrays: dict[str, Any] = {"time": recording.time, **recording.measured}
    np.savez_compressed(out := io.BytesIO(), **arrays)
    return out.getvalue()
