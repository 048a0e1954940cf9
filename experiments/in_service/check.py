"""Is the truth true? python check.py CASES

Makes every case again in memory and compares with what lies in the folder: the torque column must be
the torque of model.xml at the true motion, plus that of every listed effect, plus a rest of noise_std.
Where a parameter of truth.json gives the torque by a plain formula, that is compared with the torque
that the simulation booked.
"""

import json
import sys
from pathlib import Path

import mujoco
import numpy as np
from arms import possible
from kinds import SHARES
from make import case_list, record, rms

PLAIN = {  # torque of an effect from its parameters p, motion (q, v, a) and the file's model
    "viscous_friction": lambda p, q, v, a: p["damping"] * v,
    "armature": lambda p, q, v, a: p["armature"] * a,
    "torque_offset": lambda p, q, v, a: p["offset"] + 0 * v,
    "power_law_friction": lambda p, q, v, a: p["coefficient"] * np.abs(v) ** p["exponent"] * np.sign(v),
    "joint_spring": lambda p, q, v, a: p["stiffness"] * (q - p["rest"]) + p["cubic"] * (q - p["rest"]) ** 3,
    "coulomb_friction": lambda p, q, v, a: p["coulomb"] * np.tanh(v / 0.004),
}

DRY = ("coulomb_friction", "asymmetric_friction", "power_law_friction")


def torque(path: Path, q, v, a, change=lambda model: None) -> np.ndarray:
    """Inverse dynamics of a model file, its dry friction smoothed about rest."""
    model = mujoco.MjModel.from_xml_path(str(path))
    dry, model.dof_frictionloss[:] = model.dof_frictionloss.copy(), 0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    change(model)
    data, out = mujoco.MjData(model), np.empty_like(q)
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], v[k], a[k]
        mujoco.mj_inverse(model, data)
        out[k] = data.qfrc_inverse
    return out + dry * np.tanh(v / 0.004)


def again(path: Path, effect: dict, r: dict) -> np.ndarray | None:
    """An effect's torque from its parameters alone, or None where no plain formula gives it."""
    q, v, a = r["states"]
    n, name = q.shape[1], effect["effect"]
    values: dict = {}
    for p in effect["parameters"]:
        values.setdefault(p["name"], np.zeros(n))[(p["joint"] or 1) - 1] = p["value"]
    if name == "asymmetric_friction":  # with all of the dry friction, or only what differs from the file's
        file = mujoco.MjModel.from_xml_path(str(path)).dof_frictionloss
        mean, half = (values["coulomb_forward"] + np.array([1, -1])[:, None] * values["coulomb_backward"]) / 2
        return np.where(file > 0, 0, mean) * np.tanh(v / 0.004) + half * np.tanh(v / 0.004) ** 2
    if name in PLAIN:
        return PLAIN[name](values, q, v, a) * np.isin(np.arange(n) + 1, effect["joints"])
    base = torque(path, q, v, a)
    if name == "encoder_offset":
        return torque(path, q - values["offset"], v, a) - base
    if name == "gravity_direction" or effect.get("kind") == "mounting":
        g = [values[f"gravity_{x}"][0] for x in "xyz"]
        return torque(path, q, v, a, lambda m: m.opt.gravity.__setitem__(slice(None), g)) - base
    if name == "inertial_parameters":
        j = effect["joints"][0] + 1  # the inertia goes with the mass; rotations of the frame do not change

        def mend(m):
            ratio = 1 + values["mass"][j - 2] / m.body_mass[j]
            m.body_mass[j] *= ratio
            m.body_inertia[j] *= ratio
            m.body_ipos[j] += [values[f"com_{x}"][j - 2] for x in "xyz"]

        return torque(path, q, v, a, mend) - base
    if name == "payload":
        mass, com = values["mass"][0], np.array([values[f"com_{x}"][0] for x in "xyz"])

        def hang(m):  # a point: the load's own inertia is left out
            total = m.body_mass[-1] + mass
            old, m.body_ipos[-1] = (
                m.body_ipos[-1].copy(),
                (m.body_mass[-1] * m.body_ipos[-1] + mass * com) / total,
            )
            m.body_inertia[-1] += m.body_mass[-1] * mass / total * np.sum((com - old) ** 2) * 2 / 3
            m.body_mass[-1] = total

        return torque(path, q, v, a, hang) - base
    return None


def check(folder: Path, seed: int, index: int, kind: str, turn: int) -> tuple[float, dict[str, float]]:
    """(largest ratio of the rest to noise_std, relative difference of each effect that a formula gives)."""
    truth = json.loads((folder / "truth.json").read_text())
    case = record(seed, index, kind, turn)
    noise, names = np.array(truth["noise_std"]), {e["effect"] for e in truth["effects"]}
    for phi in (case["plan"].phi_user, case["plan"].phi_true, case["plan"].phi_loaded):
        assert possible(phi), folder
    rest, off = [], {}
    for k, r in enumerate(case["recordings"][:-1]):
        table = np.genfromtxt(folder / f"train_{k}.csv", delimiter=",", names=True)
        column = np.stack([table[f"tau_{j + 1}"] for j in range(len(noise))], 1)
        listed = sum(part for name, part in r["parts"].items() if name in names)
        rest.append(column - torque(folder / "model.xml", *r["states"]) - listed)
        alone = len([e for e in truth["effects"] if not e["optional"]]) == 1
        for effect in truth["effects"]:
            mine = again(folder / "model.xml", effect, r) if alone and not effect["optional"] else None
            if mine is not None and np.any(r["parts"].get(effect["effect"], 0) != 0):
                booked = r["parts"][effect["effect"]]
                if effect["effect"] in DRY:  # at rest dry friction is what the bristles remember
                    moving = np.abs(r["states"][1]) > 0.08
                    mine, booked = mine * moving, booked * moving
                if not booked.any():
                    continue
                off[effect["effect"]] = float(
                    np.max(rms(mine - booked) / noise) / np.max(rms(booked) / noise)
                )
    return float(np.max(rms(np.vstack(rest)) / noise)), off


def main() -> None:
    folders = sorted(Path(sys.argv[1]).iterdir(), key=lambda path: path.name.rsplit("_", 1)[1])
    seed = json.loads((folders[0] / "truth.json").read_text())["seed"]
    kinds = [kind for kind in SHARES if any(f.name.startswith(kind + "_") for f in folders)]
    rows = []
    for index, (kind, turn) in enumerate(case_list(kinds, len(folders))):
        ratio, off = check(folders[index], seed, index, kind, turn)
        rows.append((ratio, folders[index].name, off))
    rows.sort(key=lambda row: -row[0])
    print(f"{sum(row[0] <= 1.3 for row in rows)} of {len(rows)} cases within 1.3 noise_std; worst:")
    for ratio, name, _ in rows[:5]:
        print(f"  {ratio:.4f}  {name}")
    for _, name, off in rows:
        for effect, difference in off.items():
            print(f"  {'DIFFERS' if difference > 0.25 else 'agrees '} {difference:.3f}  {name} {effect}")


if __name__ == "__main__":
    main()
