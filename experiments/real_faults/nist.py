"""NIST's UR5: 18 trials of one grid motion, 1.6 or 4.5 lb at the flange, half or full speed, warm or cold.

A trial is a CSV without a header, 73 columns in the order below, vectors in brackets. The copy of one trial that
jaxpanda's developers use is an `.npz`: an array `M` and the names `h` of its columns.
"""

import itertools
import re
from pathlib import Path

import arms
import numpy as np
from recording import BadFile, Case, Recording, advancing, checked, known_content, truth
from ur import torque_constants

POUND = 0.45359237
SIX = {
    "target_q": "ROBOT_TARGET_JOINT_POSITIONS",
    "q": "ROBOT_ACTUAL_JOINT_POSITIONS",
    "target_qd": "ROBOT_TARGET_JOINT_VELOCITIES",
    "qd": "ROBOT_ACTUAL_JOINT_VELOCITIES",
    "target_current": "ROBOT_TARGET_JOITN_CURRENT",  # so spelt
    "current": "ROBOT_ACTUAL_JOINT_CURRENT",
    "target_qdd": "ROBOT_TARGET_JOINT_ACCELERATIONS",
    "target_torque": "ROBOT_TARGET_JOINT_TORQUES",
    "control_current": "ROBOT_JOINT_CONTROL_CURRENT",
}
TOOL = ("ROBOT_CARTESIAN_COORD_TOOL", "ROBOT_TCP_FORCE")
COLUMNS = (
    ["ROBOT_TIME"]
    + [f"{name} (J{j})" for name in SIX.values() for j in range(1, 7)]
    + [f"{name} ({axis})" for name in TOOL for axis in ("x", "y", "z", "rx", "ry", "rz")]
    + [f"ROBOT_JOINT_TEMP (J{j})" for j in range(1, 7)]
)
NAME = re.compile(r"ur5testresult_(coldstart_)?(full|half)speed_payload(1\.6|4\.5)lb_([123])\.csv")
COPY = "nist_half_1p6_1.npz"


def condition(path: Path) -> tuple[str, float, str, int]:
    """(speed, payload [lb], warm or cold, trial) by the file's name."""
    if path.name == COPY:
        return "half", 1.6, "warm", 1
    if not (match := NAME.fullmatch(path.name)):
        raise BadFile(f"{path}: its name does not say speed, payload and trial, as ur5testresult_... do")
    cold, speed, pounds, trial = match.groups()
    return speed, float(pounds), "cold" if cold else "warm", int(trial)


def files(data: Path) -> list[Path]:
    folder = data / "nist_ur5"
    return sorted([*folder.glob("ur5testresult_*speed*.csv"), *folder.glob(COPY)])


def load(path: Path) -> Recording:
    """Motor current times the controller's own torque a current, so friction and rotors are in it."""
    speed, pounds, start, trial = condition(path)
    source = known_content(path, "nist_ur5")
    table = _npz(path) if path.suffix == ".npz" else _csv(path)
    time = table[:, 0]
    new, dropped = advancing(time)
    table, time = table[new], time[new]
    six = lambda what: table[:, [COLUMNS.index(f"{SIX[what]} (J{j})") for j in range(1, 7)]]
    q = six("q") * _unit(path, time, six("q"), six("qd"))
    constants = torque_constants(path, six("target_qd"), six("target_current"), six("target_torque"))
    source |= {"N m/A": [round(float(k), 3) for k in constants]}
    channels = {"q": q, "qd": six("qd"), "tau": six("current") * constants}
    return checked(path, f"{start} {speed} {pounds} lb trial {trial}", time, channels, source, dropped)


def tool(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(q [rad], position of the tool's centre [m]) of every row."""
    table = _npz(path) if path.suffix == ".npz" else _csv(path)
    at = COLUMNS.index(f"{SIX['q']} (J1)")
    q, qd = table[:, at : at + 6], table[:, COLUMNS.index(f"{SIX['qd']} (J1)") :][:, :6]
    place = COLUMNS.index("ROBOT_CARTESIAN_COORD_TOOL (x)")
    return q * _unit(path, table[:, 0], q, qd), table[:, place : place + 3]


def _npz(path: Path) -> np.ndarray:
    try:
        with np.load(path, allow_pickle=False) as found:
            if set(found.files) != {"M", "h"}:
                raise BadFile(f"{path}: holds {sorted(found.files)}, not M and h")
            table, names = found["M"].astype(float), [str(h) for h in found["h"]]
    except (OSError, ValueError) as error:
        if isinstance(error, BadFile):
            raise
        raise BadFile(f"{path}: is no npz of numbers: {error}") from error
    return _in_order(path, table, names)


def _csv(path: Path) -> np.ndarray:
    rows, names = [], COLUMNS
    for number, line in enumerate(path.read_text().splitlines(), 1):
        cells = [cell.strip() for cell in re.sub(r"[\"\[\]]", "", line).split(",")]
        if number == 1 and cells[0].startswith("ROBOT_"):
            names = cells
            continue
        if len(cells) != len(COLUMNS):
            raise BadFile(f"{path}: row {number} has {len(cells)} columns, not {len(COLUMNS)}")
        try:
            rows.append([float(cell.strip("()")) for cell in cells])
        except ValueError:
            raise BadFile(f"{path}: row {number} holds a cell that is no number") from None
    if not rows:
        raise BadFile(f"{path}: is empty")
    return _in_order(path, np.array(rows), names)


def _in_order(path, table, names) -> np.ndarray:
    if sorted(names) != sorted(COLUMNS) or table.shape[1] != len(COLUMNS):
        missing = [name for name in COLUMNS if name not in names]
        raise BadFile(f"{path}: its columns are not NIST's" + (f": no {missing[0]!r}" if missing else ""))
    return table[:, [names.index(name) for name in COLUMNS]]


def _unit(path, time, q, qd) -> float:
    """rad for one of the file: its velocities, which are in rad/s, tell degrees from radians."""
    new, _ = advancing(time)
    slope = np.gradient(q[new], time[new], axis=0)
    ratio = np.sum(slope * qd[new]) / max(np.sum(qd[new] ** 2), 1e-12)
    for unit in (1.0, np.pi / 180):
        if abs(ratio * unit - 1) < 0.1:
            return unit
    raise BadFile(f"{path}: positions change {ratio:.3g} times as fast as velocities say, which is no unit")


def cases(data: Path):
    """One trial alone: its payload, and its halves. Several: payload, cold start, speed and repeats."""
    logs: dict = {}
    for path in files(data):
        *key, trial = condition(path)
        logs.setdefault(tuple(key), {}).setdefault(trial, load(path))
    for key in logs:
        yield from _alone(key, logs[key])
    first = {key: trials[min(trials)] for key, trials in logs.items()}
    for (one, before), (other, now) in itertools.permutations(first.items(), 2):
        if told := _change(one, other):
            yield Case(f"nist_{_name(one)}_to_{_name(other)}", now, arms.ur5(), told, (before,))


def _alone(key, trials):
    _, pounds, _ = key
    number = min(trials)
    log = trials[number]
    size = {"name": "mass", "value": round(pounds * POUND, 4), "unit": "kg"}
    note = "the file has published masses and no friction: friction at every joint is right as well"
    for knowledge in ("rough", "identified"):
        title = f"{pounds} lb at the flange, published model taken as {knowledge}"
        told = truth("fault", title, ["load"], ["payload"], None, size=size, note=note, beside=["friction"])
        told["arguments"] = ["--knowledge", knowledge]
        yield Case(f"nist_{_name(key)}_payload_{knowledge}", log, arms.ur5(), told)
    middle = 0.5 * log.time[-1]
    told = truth("control", "second half of a trial, its first half as reference")
    halves = log.part(0, middle), log.part(middle, np.inf)
    yield Case(f"nist_{_name(key)}_halves", halves[1], arms.ur5(), told, (halves[0],))
    for repeat in sorted(trials)[1:]:
        told = truth("control", "the same again")
        yield Case(f"nist_{_name(key)}_repeat{repeat}", trials[repeat], arms.ur5(), told, (log,))


def _change(one, other) -> dict | None:
    """What differs between two conditions where it is one thing, in the direction in which it is more."""
    differs = [a != b for a, b in zip(one, other, strict=True)]
    if sum(differs) != 1:
        return None
    if differs[1] and other[1] > one[1]:
        more = round((other[1] - one[1]) * POUND, 4)
        size = {"name": "mass", "value": more, "unit": "kg"}
        return truth("fault", f"{more} kg more at the flange", ["load"], ["payload"], None, size=size)
    if differs[2] and other[2] == "cold":
        return truth("fault", "cold start", ["friction"], ["viscous_friction", "friction_drift"], None)
    if differs[0] and other[0] == "full":
        return truth("control", "full speed in place of half: nothing of the arm changed")
    return None


def _name(key) -> str:
    speed, pounds, start = key
    return f"{start}_{speed}_{str(pounds).replace('.', 'p')}"
