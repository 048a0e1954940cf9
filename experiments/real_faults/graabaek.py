"""Graabaek et al.: a UR5e picks and places at random; RTDE logs of the controller, one CSV a run.

Columns, folders and labels as the public audit in github.com/kaiwen123-yang/CERTO-FDI at 9526e7b,
src/certo_fdi_reset/datasets/d0.py, found them in the archive: 121 columns between blanks with RTDE's names,
100 Hz, and a `NAME_label.npy` beside each anomalous run, not 0 where the anomaly is on. Units are RTDE's: s, rad,
rad/s, A, N m. **This loader has not seen a file of the archive.**
"""

from pathlib import Path

import arms
import numpy as np
from recording import BadFile, Case, Recording, advancing, checked, known_content, numbers, truth
from ur import torque_constants

SIX = ("actual_q", "actual_qd", "actual_current", "target_qd", "target_current", "target_moment")
NORMAL = "normal"
REFERENCES = 3
CONTACT, BODY = ("contact",), ("load",)
MEANING = {
    "push": ("somebody pushes the arm", CONTACT, ("external_contact",)),
    "tcp_wrench": ("a wrench at the tool", CONTACT, ("external_contact",)),
    "force_stop": ("the object stands on a plate and is hit", CONTACT, ("external_contact",)),
    "change_weight": ("a cylinder of another mass", BODY, ("payload_change", "payload")),
    "drop_object": ("the cylinder is dropped", BODY, ("payload_change", "payload")),
    "outside_box": ("placed outside of the box: nothing of the arm is wrong", (), ()),
    "scale_speed": ("another speed: nothing of the arm is wrong", (), ()),
    "long_wait": ("a long wait: nothing of the arm is wrong", (), ()),
}
"""Folder -> title, families and names that are right."""


def folder(data: Path) -> Path:
    return data / "graabaek_ur5e" / "data" / "stochastic_PnP"


def files(data: Path) -> list[Path]:
    return sorted(folder(data).glob("*/**/*.csv"))


def load(path: Path) -> Recording:
    """Motor current times the controller's own torque a current."""
    source = known_content(path, "graabaek_ur5e")
    table = _table(path)
    six = {name: np.stack([table[f"{name}_{j}"] for j in range(6)], 1) for name in SIX}
    if np.abs(six["actual_q"]).max() > 2 * np.pi + 0.1:
        raise BadFile(f"{path}: actual_q exceeds a turn: not rad")
    time = table["timestamp"]
    new, dropped = advancing(time)
    constants = torque_constants(path, six["target_qd"], six["target_current"], six["target_moment"])
    source |= {"N m/A": [round(float(k), 3) for k in constants]}
    tau = six["actual_current"] * constants
    channels = {"q": six["actual_q"][new], "qd": six["actual_qd"][new], "tau": tau[new]}
    return checked(path, path.stem, time[new], channels, source, dropped)


def labelled(path: Path) -> list[list[float]]:
    """Intervals [s] since the run's beginning in which the anomaly is on."""
    beside = path.with_name(f"{path.stem}_label.npy")
    if not beside.exists():
        raise BadFile(f"{path}: has no {beside.name} beside it, so that nothing says when the anomaly is on")
    label, time = np.load(beside, allow_pickle=False), _table(path)["timestamp"]
    if label.shape != time.shape:
        raise BadFile(f"{beside}: has {label.size} labels for {time.size} rows")
    return intervals(time - time[0], label != 0)


def intervals(time, on) -> list[list[float]]:
    """From a row that is on to the last one that is, [s]."""
    edge = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]).astype(int)))
    return [[float(time[a]), float(time[b - 1])] for a, b in edge.reshape(-1, 2)]


def _table(path: Path) -> dict[str, np.ndarray]:
    lines = path.read_text().splitlines()
    names = lines[0].split() if lines else []
    wanted = ["timestamp"] + [f"{name}_{j}" for name in SIX for j in range(6)]
    missing = [name for name in wanted if name not in names]
    if missing:
        raise BadFile(
            f"{path}: has no column {missing[0]!r} between blanks, which an RTDE log of this set has"
        )
    rows = numbers(path, names, map(str.split, lines[1:]))
    return {name: rows[:, names.index(name)] for name in wanted}


def cases(data: Path):
    """The first run of each anomaly, and normal runs, each with three normal runs as reference."""
    normal = sorted((folder(data) / NORMAL).glob("**/*.csv"))
    if not normal:
        return
    before = tuple(load(path) for path in normal[:REFERENCES])
    for path in normal[REFERENCES : 2 * REFERENCES]:
        told = truth("control", "normal run")
        yield Case(f"graabaek_normal_{path.stem}", load(path), arms.ur5e(), told, before)
    for name, (title, families, effects) in MEANING.items():
        for path in sorted((folder(data) / name).glob("**/*.csv"))[:1]:
            kind = "fault" if families else "control"
            told = truth(kind, title, families, effects, None, intervals=labelled(path))
            yield Case(f"graabaek_{name}", load(path), arms.ur5e(), told, before)
