"""The public recordings behind this experiment: found, checked against their sha256, and put into one layout.

None is part of jaxpanda. `sources.json` says where each comes from and what its content hashes to.
"""

import functools
import gzip
import hashlib
import io
import itertools
import json
from pathlib import Path

import numpy as np

from jaxpanda.errors import InputError
from jaxpanda.recordings import Recording

SOURCES = json.loads((Path(__file__).parent / "sources.json").read_text())

UR10E_GAINS = {
    "main.m": (14.87, 13.26, 11.13, 10.62, 11.03, 11.47),
    "UR10E_parameters.txt": (10.0, 10.6956, 8.4566, 9.0029, 9.48, 10.1232),
}
"""Torque a current as published beside the recordings [N m/A]: the two disagree by 13 to 49 %."""
_ABSURD = {"q": 2 * np.pi + 0.1, "qd": 10.0, "current": 100.0}
_REST, _MARGIN = 0.02, 0.5
"""Speed below which an arm rests [rad/s]; what is kept of the rest before and after a motion [s]."""


def content(data: Path, collection: str, name: str) -> bytes:
    """A file as upstream has it, checked.

    Raises:
        InputError: it is not there, or is another file; says where it comes from.
    """
    source = SOURCES[collection]
    entry = source["files"][name]
    where = f"{source['repository']} at {source['commit']}, {entry['path']}"
    path = data / collection / name
    packed = path.with_name(path.name + ".gz")
    if not path.exists() and not packed.exists():
        raise InputError(f"{path}: no such file; it is {where}")
    raw = path.read_bytes() if path.exists() else gzip.decompress(packed.read_bytes())
    if hashlib.sha256(raw).hexdigest() != entry["sha256"]:
        raise InputError(f"{path}: is not the file that this experiment was made with: {where}")
    return raw


def _moving(time: np.ndarray, qd: np.ndarray) -> slice:
    """From shortly before the arm starts until shortly after it stops."""
    moves = np.flatnonzero(np.abs(qd).max(1) > _REST)
    first, last = time[moves[0]] - _MARGIN, time[moves[-1]] + _MARGIN
    return slice(*np.searchsorted(time, (first, last)))


@functools.cache
def ur10e(data: Path, name: str, gains: str = "main.m") -> Recording:
    """Motor currents times the gains as torque, rests before and after the motion cut off."""
    table = np.loadtxt(io.BytesIO(content(data, "ur10e", f"ur-20_{name}.csv")), delimiter=",")
    columns = {"q": slice(1, 7), "qd": slice(7, 13), "current": slice(13, 19)}
    sane = np.all(np.isfinite(table), 1)
    for what, most in _ABSURD.items():
        sane &= np.all(np.abs(np.nan_to_num(table[:, columns[what]])) < most, 1)
    ahead = np.diff(np.maximum.accumulate(table[:, 0]), prepend=-np.inf) > 0
    kept = table[sane & ahead]
    kept = kept[_moving(kept[:, 0], kept[:, columns["qd"]])]
    return Recording(
        name,
        kept[:, 0] - kept[0, 0],
        kept[:, columns["q"]],
        kept[:, columns["qd"]],
        kept[:, columns["current"]] * np.array(UR10E_GAINS[gains]),
        repairs={
            "rows with absurd values dropped": int(np.sum(~sane)),
            "rows whose time does not increase dropped": int(np.sum(sane & ~ahead)),
        },
    )


def iiwa(data: Path, name: str) -> list[Recording]:
    """The runs of a sweep or chirp; torque reversed, as its authors suspect and gravity confirms."""
    logs = {}
    for what in (
        "cur_traj_time_s",
        "joint_position_measured",
        "joint_velocity_measured",
        "joint_torque_measured",
    ):
        logs[what] = np.loadtxt(io.BytesIO(content(data, "iiwa", f"{name}/{what}.txt")), ndmin=2)
    rows = min(map(len, logs.values()))
    time, q, qd, tau = (log[:rows] for log in logs.values())
    time = time[:, 0]
    edges = [0, *(np.flatnonzero(np.diff(time) < 0) + 1).tolist(), rows]
    runs = []
    for k, (start, stop) in enumerate(itertools.pairwise(edges)):
        new = np.diff(time[start:stop], prepend=-np.inf) > 0
        part = np.arange(start, stop)[new]
        if len(part) < 100:
            continue
        label = name if len(edges) == 2 else f"{name} ({k + 1})"
        dropped = {"rows whose time does not increase dropped": int(np.sum(~new))}
        runs.append(
            Recording(label, time[part] - time[part[0]], q[part], qd[part], -tau[part], repairs=dropped)
        )
    return runs


def kinova(data: Path, name: str, torque: str) -> Recording:
    """Motion with the torque of the joint sensors (`TorqueSm`) or from motor currents (`TorqueCur`)."""
    text = content(data, "kinova_gen3", f"{name}.csv").decode()
    head = text.split("\n", 1)[0].strip().split(",")
    table = np.loadtxt(io.StringIO(text), delimiter=",", skiprows=1)
    at = {column: k for k, column in enumerate(head)}
    channel = lambda what: table[:, [at[f"{what}{j}"] for j in range(1, 8)]]
    time = 1e-3 * table[:, at["Time"]]
    new = np.diff(time, prepend=-np.inf) > 0
    q = np.unwrap(channel("Position"), axis=0)
    return Recording(
        f"{name} {torque}",
        time[new],
        q[new],
        channel("Velocity")[new],
        channel(torque)[new],
        repairs={"rows whose time does not increase dropped": int(np.sum(~new))},
    )
