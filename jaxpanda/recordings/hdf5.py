"""HDF5, as DROID, robomimic and others write it; needs the extra [io].

A dataset is called by its path, `observation/robot_state/joint_positions`, and its columns by `[0]`, `[1]`, …
"""

import contextlib
import json
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from .. import inputs
from ..errors import InputError, MissingExtraError
from ..reading import Reading
from .recording import Recording
from .table import MEASURED, Source, Table, chosen, of_arrays, recording_of, refuse

_STATE = "observation/robot_state/"
DROID = Source(
    "DROID's trajectory",
    {
        "time": "observation/timestamp/robot_state/robot_timestamp_seconds"
        "+observation/timestamp/robot_state/robot_timestamp_nanos",
        "q": f"{_STATE}joint_positions",
        "dq": f"{_STATE}joint_velocities",
        "tau": f"{_STATE}motor_torques_measured",
    },
    "measured",
    f"motor_torques_measured is libfranka's tau_J, the {MEASURED}; joint_torques_computed is commanded",
    {f"{_STATE}joint_torques_computed": "commanded"},
)
ROBOMIMIC = Source(
    "robomimic's demonstrations",
    {"time": "step/control_freq", "q": "obs/robot0_joint_pos", "dq": "obs/robot0_joint_vel"},
    "unstated",
    "it keeps no torque, and its time is the row over the control frequency in env_args",
)


def read_hdf5(path: Path, reading: Reading) -> list[Recording]:
    """The recording in a file, or those of its demonstrations that are asked for.

    Raises:
        MissingExtraError: h5py is not installed.
        InputError: no HDF5, or columns that cannot be told.
    """
    refuse(path.name, reading, "topic")
    with opened(path) as file:
        demos = [name for name in _own(file, "data") or () if re.fullmatch(r"demo_\d{1,9}", name)]
        if not demos:
            refuse(path.name, reading, "episode")
            return [recording_of(table_of(path, path.name, file), (DROID,), reading)]
        numbers = sorted(demos, key=lambda name: int(name[5:]))
        wanted = chosen(path.name, [name[5:] for name in numbers], reading)
        return [
            recording_of(_demonstration(path, file, f"demo_{number}", len(demos) > 1), (ROBOMIMIC,), reading)
            for number in wanted
        ]


def table_of(path: Path, name: str, group: Any) -> Table:
    """All numeric vectors and matrices below a group."""
    h5py = _h5py()
    shapes: dict[str, tuple[int, ...]] = {}

    def visit(key: str, item: Any) -> None:
        if (
            not isinstance(item, h5py.Dataset)
            or item.dtype.kind not in "fiu"
            or len(item.shape) not in (1, 2)
        ):
            return
        if item.external or item.is_virtual:
            raise InputError(
                f"{name}: {key} keeps its numbers in another file, which is not read: copy the data into one file"
            )
        shapes[key] = item.shape

    group.visititems(visit)
    return of_arrays(path, name, shapes, lambda key: group[key][()])


def _demonstration(path: Path, file: Any, demo: str, several: bool) -> Table:
    """One demonstration, with time from the control frequency if the file says that."""
    group, name = _own(file["data"], demo), f"{path.name} (episode {demo[5:]})" if several else path.name
    table = table_of(path, name, group)
    with contextlib.suppress(KeyError, ValueError, TypeError, AttributeError):
        rate = float(json.loads(file["data"].attrs["env_args"])["env_kwargs"]["control_freq"])
        rows = len(group["actions"])
        inner = len(table.names)
        every = lambda places: np.column_stack(
            [np.arange(rows) / rate if i == inner else table.take([i])[:, 0] for i in places]
        )
        return Table(path, name, [*table.names, "step/control_freq"], every)
    return table


def _own(group: Any, name: str) -> Any:
    """What is called so in a group, unless that is a link, which may lead to another file."""
    h5py = _h5py()
    link = group.get(name, getlink=True)
    if link is not None and not isinstance(link, h5py.HardLink):
        raise InputError(f"{group.file.filename}: {name} is a link, which is not followed")
    return group.get(name)


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Any]:
    """An HDF5 file, read only; what cannot be read in it ends in one sentence."""
    h5py = _h5py()
    try:
        with h5py.File(inputs.in_place(path), "r") as file:
            yield file
    except InputError:
        raise
    except (OSError, RuntimeError, LookupError, ValueError, TypeError, MemoryError) as error:
        said = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"{path.name}: no HDF5, or a broken file ({said})") from None


def _h5py() -> ModuleType:
    try:
        import h5py
    except ImportError:
        raise MissingExtraError("HDF5", "io") from None
    return h5py
