"""contactInterpretation: a Panda in motion, touched by hand at a known link, as a glove's sensor says.

`labeled_data/linkL/NAME.csv`: a header, then `time` [s] and libfranka's `q0..6` [rad], `dq0..6` [rad/s] and
`tau_J0..6` [N m, gravity included], and `label`, 0 where nobody touches the arm. About 200 Hz, of which every
second row repeats the torque before.
"""

import csv
import re
from pathlib import Path

import numpy as np
from graabaek import intervals
from recording import BadFile, Case, Recording, advancing, checked, known_content, numbers, truth

CHANNELS = {"q": "q", "qd": "dq", "tau": "tau_J"}
FREE = 5.0
"""Without a touch so long [s], the beginning of a recording is a control."""


def files(data: Path) -> list[Path]:
    return sorted((data / "contact_panda").glob("**/link*/*.csv"))


def load(path: Path) -> tuple[Recording, list[list[float]]]:
    """The recording, and the intervals [s] in which the arm is touched."""
    source = known_content(path, "contact_panda")
    with path.open(newline="") as file:
        reader = csv.reader(file)
        names = next(reader, [])
        wanted = ["time", "label"] + [f"{column}{j}" for column in CHANNELS.values() for j in range(7)]
        if missing := [name for name in wanted if name not in names]:
            raise BadFile(f"{path}: has no column {missing[0]!r}, which labelled recordings of this set have")
        rows = numbers(path, names, reader)
    column = lambda name: rows[:, names.index(name)]
    time = column("time")
    new, dropped = advancing(time)
    channels = {
        what: np.stack([column(f"{name}{j}") for j in range(7)], 1)[new] for what, name in CHANNELS.items()
    }
    if np.abs(channels["q"]).max() > np.pi + 0.1:
        raise BadFile(f"{path}: q exceeds what a Panda's joints can turn: not rad")
    log = checked(path, path.stem, time[new], channels, source, dropped)
    return log, intervals(log.time, column("label")[new] != 0)


def cases(data: Path):
    """One recording of each link, by the project's own Panda; what comes before the first touch is a control."""
    first: dict = {}
    for path in files(data):
        first.setdefault(path.parent.name, path)
    for folder, path in first.items():
        log, touched = load(path)
        link = int(re.sub(r"\D", "", folder))
        note = f"touched at link {link}: joints 1 to {link} can feel it"
        told = truth("fault", f"touched at link {link}", ["contact"], ["external_contact"], None)
        told |= {"intervals": touched, "note": note, "beside": ["friction", "load", "sensor"]}
        yield Case(f"contact_{folder}", log, None, told)
        if touched and touched[0][0] > FREE:
            told = truth("control", "before the first touch", beside=["friction", "load", "sensor"])
            yield Case(f"contact_{folder}_before", log.part(0, touched[0][0] - 0.5), None, told)
