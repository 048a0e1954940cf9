"""Is the trial sound?  python check.py --cases CASES

Of every case, from its own files, model.xml in MuJoCo and the parts in hidden.npz: torques are the sum of what
the truth lists, without noise and within it; angles are inside their ranges; sizes and `detectable` are as said;
a cause that is called detectable comes back from the noisy recording with a factor of one.
"""

import argparse
import json
from pathlib import Path

import mujoco
import numpy as np
from arms import rigid
from plant import REST, inverse
from sensors import low_pass

EXACT = 0.05  # of the noise: what a torque may differ from the sum of its parts
ROOM = 0.05  # rad to the end of a range
SENSOR = ("torque_gain", "torque_offset", "torque_drift")


def table(path: Path) -> dict[str, np.ndarray]:
    names = path.read_text().split("\n", 1)[0].split(",")
    values = np.loadtxt(path, delimiter=",", skiprows=1)
    kinds = {
        name: [k for k, full in enumerate(names) if full.rpartition("_")[0] == name]
        for name in ("q", "dq", "tau", "tau_motor")
    }
    return {"time": values[:, 0]} | {name: values[:, rows] for name, rows in kinds.items() if rows}


def sides(hidden: dict, name: str, side: str) -> dict[str, np.ndarray]:
    prefix = f"{name}/{side}/"
    return {
        key[len(prefix) :]: hidden[key]
        for key in hidden
        if key.startswith(prefix) and not key.endswith("/file")
    }


def file_torques(xml: str, hidden: dict, name: str) -> tuple[np.ndarray, np.ndarray]:
    """(rigid body, drives) of the user's file along the true motion, anew from model.xml."""
    q, qd, qdd, stick = (hidden[f"{name}/{key}"] for key in ("q_shown", "qd", "qdd", "stick"))
    model = mujoco.MjModel.from_xml_string(xml)
    damping = model.dof_damping.reshape(model.nv, -1)[:, 0]
    sign = np.where(np.abs(qd) > REST, np.sign(qd), stick)
    return inverse(
        rigid(xml), q, qd, qdd
    ), model.dof_frictionloss * sign + damping * qd + model.dof_armature * qdd


def rms(x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(x**2, axis=0))


def on(t: np.ndarray, grid: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(t, grid, column) for column in values.T], axis=1)


def rows_of(entry: dict, t: np.ndarray) -> np.ndarray:
    rows = np.zeros(len(t), bool)
    for start, end in entry["intervals"] or [[None, None]]:
        rows |= (t >= (0 if start is None else start)) & (t <= (np.inf if end is None else end))
    return rows


def check_recording(case: Path, name: str, truth: dict, hidden: dict, xml: str) -> tuple[list[str], dict]:
    """(what is wrong, low-passed parts and noise by side at 100 Hz)."""
    noise = {"link": np.array(truth["noise_std"]), "drive": np.array(truth["noise_std_drive"])}
    file_link, file_drive = file_torques(xml, hidden, name)
    link, drive = sides(hidden, name, "link"), sides(hidden, name, "drive")
    tau, motor = hidden[f"{name}/tau_shown"], hidden[f"{name}/tau_motor_shown"]
    summed = {
        "link": file_link + sum(link.values()),
        "drive": file_drive + sum(drive.values()) - sum(link.get(effect, 0) for effect in SENSOR),
    }
    wrong = []
    for side, is_shown in (("link", tau), ("drive", motor - tau)):
        worst = float(np.max(rms(summed[side] - is_shown) / noise[side]))
        if worst > EXACT:
            wrong.append(f"{name}: parts of {side} miss the torque by {worst:.2f} of the noise")

    csv = table(case / name)
    t, grid = csv["time"], hidden[f"{name}/t"].astype(float)
    motion = csv if "q" in csv else table(case / "heldout_motion.csv")
    limits = mujoco.MjModel.from_xml_string(xml).jnt_range
    if np.min(np.minimum(motion["q"] - limits[:, 0], limits[:, 1] - motion["q"])) < ROOM:
        wrong.append(f"{name}: a joint comes too near the end of its range")
    if np.max(rms(motion["dq"] - on(t, grid, hidden[f"{name}/qd"]))) > 0.08:
        wrong.append(f"{name}: dq is not the speed")
    rate = 1 / (t[1] - t[0])
    left = {}
    for side, measured in (("link", csv["tau"]), ("drive", csv["tau_motor"] - csv["tau"])):
        rest = low_pass(measured - on(t, grid, summed[side]), rate)
        left[side] = on(grid, t, rest)
        ratio = np.std(rest, axis=0) / noise[side]
        if np.any((ratio < 0.6) | (ratio > 1.6)):
            wrong.append(f"{name}: noise of {side} is {ratio.min():.2f} to {ratio.max():.2f} of what is said")
    low = {
        side: {e: low_pass(p, 100) for e, p in its.items()}
        for side, its in (("link", link), ("drive", drive))
    }
    return wrong, {"t": grid, "parts": low, "left": left}


def check_effect(entry: dict, truth: dict, records: list[dict]) -> list[str]:
    side, effect = entry["side"], entry["effect"]
    noise = np.array(truth["noise_std" if side == "link" else "noise_std_drive"])
    rows = [rows_of(entry, r["t"]) for r in records]
    part = np.concatenate([r["parts"][side][effect][k] for r, k in zip(records, rows, strict=True)])
    left = np.concatenate([r["left"][side][k] for r, k in zip(records, rows, strict=True)])
    sizes, said, wrong = rms(part), np.array(entry["rms_torque"]), []
    if not np.allclose(sizes, said, rtol=0.02, atol=0.02 * noise.min()):
        wrong.append(f"{effect}: sizes are not as said")
    joints = np.array(entry["joints"], int) - 1
    if entry["detectable"] != bool(len(joints) and np.any(said[joints] >= noise[joints])):
        wrong.append(f"{effect}: detectable is not as said")
    for j in joints:
        if said[j] >= 1.5 * noise[j] and not entry["optional"]:
            factor = 1 + part[:, j] @ left[:, j] / (part[:, j] @ part[:, j])
            if not 0.6 < factor < 1.4:
                wrong.append(f"{effect} at joint {j + 1}: comes back with a factor of {factor:.2f}")
    return wrong


def check(case: Path) -> list[str]:
    truth, xml = json.loads((case / "truth.json").read_text()), (case / "model.xml").read_text()
    with np.load(case / "hidden.npz") as file:
        hidden = dict(file)
    wrong, records = [], []
    for name in [*sorted(path.name for path in case.glob("train_*.csv")), "heldout.csv"]:
        said, record = check_recording(case, name, truth, hidden, xml)
        wrong += said
        records += [record] if name != "heldout.csv" else []
    for entry in truth["effects"]:
        wrong += check_effect(entry, truth, records)
    missing = {entry["side"] for entry in truth["effects"] if entry["detectable"] and not entry["optional"]}
    wanted = {"null": set(), "drive": {"drive"}, "link": {"link"}, "both": {"drive", "link"}}[truth["kind"]]
    if missing != wanted:
        wrong.append(f"{truth['kind']}: something shows on {sorted(missing)}")
    for key in ("", "_motor"):
        best, nominal = (np.array(truth["heldout"][f"rmse_{k}{key}"]) for k in ("true_model", "nominal"))
        if np.any(best > 1.1 * nominal):
            wrong.append(f"held-out{key}: the truth is worse than the file")
    return wrong


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=Path, required=True)
    cases = sorted(path.parent for path in parser.parse_args().cases.glob("*/truth.json"))
    problems = {case.name: check(case) for case in cases}
    for name, wrong in problems.items():
        print(f"{name}: {'sound' if not wrong else '; '.join(wrong)}")
    raise SystemExit(any(problems.values()))


if __name__ == "__main__":
    main()
