"""A blind trial with two torques at every joint: what a sensor behind the gear shows, and what the motor gives.

python make.py --seed S --count N --out CASES [--jobs J]
"""

import argparse
import json
from copy import deepcopy
from multiprocessing import Pool
from pathlib import Path

import numpy as np
from arms import ARMS, Arm, as_mjcf, built, rigid
from causes import CONFUSED, DRIVE, EXCLUDE, LINK, PASSING, coulomb, put_in, viscous, wrong_link
from motions import plan
from plant import GRID, Drive, Links, Record, Sensors, Truth, as_shown, inverse, parts, tracked
from sensors import Sensing, sensing
from truths import allowed, effects

KINDS = ("null", "drive", "link", "both")
EDGE = 0.5  # s at either end of the held-out motion that is not judged
SLIDES = 0.02  # rad/s
FILES = ("frictionless", "placeholder")  # as causes of a drive
OLD = {  # what the file lacks already on the reference: (names that are not news, causes that would hide in it)
    "": ((), ()),
    "frictionless": (
        ("coulomb_friction", "viscous_friction", "presliding_hysteresis"),
        (coulomb, viscous),
    ),
    "links": (("inertial_parameters",), (wrong_link,)),
}


def rounded(values: np.ndarray, digits: int) -> np.ndarray:
    return np.array([float(f"{value:.{digits}g}") for value in values])


def base_truth(rng: np.random.Generator, arm: Arm) -> Truth:
    n = arm.joints
    zero = np.zeros(n)
    drive = Drive(
        coulomb=rounded(rng.uniform(0.02, 0.055, n) * arm.rated, 4),
        viscous=rounded(rng.uniform(0.01, 0.03, n) * arm.rated, 4),
        armature=rounded(arm.armature, 4),
        breakaway=np.exp(rng.uniform(np.log(0.3e-3), np.log(2e-3), n)),
        elastic=rng.uniform(0.3, 0.8, n),
        stribeck_speed=zero + 0.1,
        ripple_order=zero + 1,
        **{
            name: zero.copy()
            for name in ("stribeck", "asymmetry", "load", "warming", "ripple", "ripple_phase")
        },
    )
    links = Links(zero + 1, np.zeros((n, 3)), zero.copy(), zero.copy())
    return Truth(drive, links, Sensors(*(zero.copy() for _ in range(7))))


def held_by(file: str, rng: np.random.Generator, drive: Drive) -> dict[str, np.ndarray]:
    """The drives as the user's file has them."""
    held = {name: getattr(drive, name).copy() for name in ("coulomb", "viscous", "armature")}
    if file == "frictionless":
        held["coulomb"], held["viscous"] = 0 * held["coulomb"], 0 * held["viscous"]
    if file == "placeholder":
        held = {name: rounded(values * rng.uniform(1.4, 3, len(values)), 1) for name, values in held.items()}
    return held


def chosen(rng: np.random.Generator, kind: str, index: int, seed: int) -> tuple[str, dict[str, list]]:
    """(file, causes of either side), before any is found not to show."""
    turn = np.random.default_rng([seed, 7])
    file, links, drives = "right", [], []
    if kind == "drive":
        each = [*turn.permutation(len(DRIVE)).tolist(), -1, -2]
        which = each[(index // len(KINDS)) % len(each)]
        file, drives = (FILES[which], []) if which < 0 else ("right", [DRIVE[which]])
    if kind == "link":
        links = [LINK[turn.permutation(len(LINK))[(index // len(KINDS)) % len(LINK)]]]
    if kind == "both":
        file = rng.choice(["right", *FILES], p=[0.5, 0.35, 0.15])
        link, drive = CONFUSED[turn.permutation(len(CONFUSED))[(index // len(KINDS)) % len(CONFUSED)]]
        links = [
            link,
            *(LINK[i] for i in rng.permutation(len(LINK))[: rng.integers(3)] if LINK[i] is not link),
        ]
        room = 3 if file == "right" else 2
        others = [DRIVE[i] for i in rng.permutation(len(DRIVE)) if DRIVE[i] is not drive]
        drives = [drive, *others[: rng.integers(room)]]
        links = [c for c in links if c is link or not clash(c, [*links[: links.index(c)], drive])]
        drives = [c for c in drives if c is drive or not clash(c, links)]
    return file, {"link": links, "drive": drives}


def clash(cause, others: list) -> bool:
    return any(other in EXCLUDE.get(cause, ()) for other in others)


def old_story(rng: np.random.Generator, causes: list) -> str:
    """What the file lacked before anything went wrong, where there is a reference to tell."""
    old = str(rng.choice(["", "", "frictionless", "links"]))
    return "" if set(causes) & set(OLD[old][1]) else old


def put_all(
    rng, wanted: dict[str, list], arm, xml, base: Truth, held, model: Record, noise, seconds, banned
) -> Truth:
    """The base with all causes in it; the first of a side that would not show gives way to another."""
    truth, everything = deepcopy(base), [*wanted["link"], *wanted["drive"]]
    for side, spare in (("link", LINK), ("drive", DRIVE)):
        free = np.ones(arm.joints, bool)
        for cause in wanted[side]:
            ways = [cause] * 3
            if cause is wanted[side][0]:
                others = [spare[i] for i in rng.permutation(len(spare))]
                ways += [c for c in others if c not in (*everything, *banned) and not clash(c, everything)]
            for way in ways:
                made = way(rng, arm, base, seconds)
                taken = put_in(rng, made, arm, xml, base, truth, held, model, noise[side], free)
                if taken is not None:
                    free &= ~taken
                    break
    return truth


def planned(arm: Arm, xml: str, base: Truth, motion) -> Record:
    """The reference as if it were followed exactly; what the sizes are taken from."""
    t, q, qd, qdd = (values[::GRID] for values in motion)
    tau = inverse(rigid(xml), q, qd, qdd)
    stick, drive = np.tanh(qd / 0.005), base.drive
    lost = drive.coulomb * stick + drive.viscous * qd + drive.armature * qdd
    return Record(t, q, qd, qdd, tau, tau + lost, stick)


def without_passing(truth: Truth) -> Truth:
    """The arm on another day: pushes, things picked up and slow changes are over."""
    later = deepcopy(truth)
    later.links.push, later.links.gained = np.zeros(3), 0.0
    later.sensors.drift, later.sensors.motor_drift = 0 * truth.sensors.drift, 0 * truth.sensors.drift
    later.drive.warming = 0 * truth.drive.warming
    return later


def write_csv(path: Path, columns: dict[str, np.ndarray], t: np.ndarray) -> None:
    names = [f"{name}_{j + 1}" for name, values in columns.items() for j in range(values.shape[1])]
    table = np.column_stack([t, *columns.values()])
    np.savetxt(path, table, fmt="%.7g", delimiter=",", header=",".join(["time", *names]), comments="")


def recorded(rng, s: Sensing, truth: Truth, r: Record) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """(time, columns) of a recording at the rate of the arm's computer."""
    sampled = r.every(s.every)
    q, dq = s.motion(r.q + truth.sensors.encoder)
    tau, motor = as_shown(truth, sampled)
    shown = {"tau": s.tau.shows(rng, tau, s.rate), "tau_motor": s.motor.shows(rng, motor, s.rate)}
    return np.arange(len(q)) / s.rate, {"q": q, "dq": dq, **shown}


def judged(t: np.ndarray, qd: np.ndarray, stick: np.ndarray) -> dict[str, np.ndarray]:
    """Rows that count, (time, n): of tau_motor those where the joint slides, since no file tells of rest."""
    inside = ((t > t[0] + EDGE) & (t < t[-1] - EDGE))[:, None] & np.ones(qd.shape, bool)
    return {"tau": inside, "tau_motor": inside & (np.abs(qd) > SLIDES) & (np.abs(stick) > 0.9)}


def rms_error(off: np.ndarray, rows: np.ndarray) -> np.ndarray:
    return np.sqrt(np.sum(off**2 * rows, axis=0) / np.maximum(np.sum(rows, axis=0), 1))


def held_out(xml: str, truth: Truth, held, s: Sensing, r: Record, shown) -> dict:
    """RMS error of the user's file and of the truth, for either torque."""
    r = r.every(s.every)
    rows, (tau, motor) = judged(r.t, r.qd, r.stick), as_shown(truth, r)
    said = inverse(rigid(xml), r.q + truth.sensors.encoder, r.qd, r.qdd)
    lost = held["coulomb"] * np.sign(r.qd) + held["viscous"] * r.qd + held["armature"] * r.qdd
    off = {
        "rmse_nominal": rms_error(shown["tau"] - said, rows["tau"]),
        "rmse_true_model": rms_error(shown["tau"] - tau, rows["tau"]),
        "rmse_nominal_motor": rms_error(shown["tau_motor"] - said - lost, rows["tau_motor"]),
        "rmse_true_model_motor": rms_error(shown["tau_motor"] - motor, rows["tau_motor"]),
    }
    return {name: values.tolist() for name, values in off.items()}


def hidden(arm: Arm, xml: str, truth: Truth, held, name: str, r: Record) -> tuple[dict, dict]:
    """(parts, what check.py needs of a recording) on the grid of 100 Hz."""
    added = parts(arm, xml, truth, held, r)
    tau, motor = as_shown(truth, r)
    kept = vars(r) | {"q_shown": r.q + truth.sensors.encoder, "tau_shown": tau, "tau_motor_shown": motor}
    kept = {f"{name}/{key}": value for key, value in kept.items()}
    kept |= {f"{name}/{side}/{e}": p for side in added for e, p in added[side].items() if np.any(p)}
    return added, {key: value.astype(np.float32) for key, value in kept.items()}


def make_case(seed: int, index: int, out: Path) -> None:
    rng, kind = np.random.default_rng([seed, index]), KINDS[index % len(KINDS)]
    arm = built(ARMS[rng.integers(len(ARMS))], rng)
    file, wanted = chosen(rng, kind, index, seed)
    base = base_truth(rng, arm)
    s = sensing(rng, arm)
    noise = {"link": s.tau.std(rng, s.rate)}
    noise["drive"] = np.hypot(noise["link"], s.motor.std(rng, s.rate))

    reference = rng.random() < 0.3
    causes = [*wanted["link"], *wanted["drive"]]
    old = old_story(rng, causes) if reference and causes and file == "right" else ""
    if old == "links":
        base.links.mass_factor = 1 + rng.choice([-1, 1], arm.joints) * rng.uniform(0.03, 0.08, arm.joints)
    held = held_by("frictionless" if old == "frictionless" else file, rng, base.drive)
    xml = as_mjcf(arm, held["viscous"], held["coulomb"], held["armature"])

    once = rng.random() < 0.65 or any(cause in PASSING for cause in causes)
    longest = 20 if s.rate > 500 else 40 if once else 22
    lengths = [float(round(rng.uniform(15 if once else 12, longest))) for _ in range(1 if once else 2)]
    motions = [plan(rng, arm, length) for length in lengths]
    model = planned(arm, xml, base, motions[0])
    truth = put_all(rng, wanted, arm, xml, base, held, model, noise, lengths[0], OLD[old][1])

    bandwidth = rng.uniform(6, 12)
    names = [f"train_{k + 1}.csv" for k in range(len(motions))]
    case = out / f"case_{index:03d}"
    case.mkdir(parents=True, exist_ok=True)
    (case / "model.xml").write_text(xml)
    records, added, kept = [], [], {}
    for name, motion in zip(names, motions, strict=True):
        r = tracked(arm, xml, truth, motion, bandwidth)
        t, columns = recorded(rng, s, truth, r)
        write_csv(case / name, columns, t)
        records.append(r.every(GRID))
        its_parts, its_kept = hidden(arm, xml, truth, held, name, records[-1])
        added.append(its_parts)
        kept |= its_kept
    if reference:
        r = tracked(arm, xml, base, plan(rng, arm, float(round(rng.uniform(12, 20)))), bandwidth)
        t, columns = recorded(rng, s, base, r)
        write_csv(case / "reference_1.csv", columns, t)

    later = without_passing(truth)
    r = tracked(arm, xml, later, plan(rng, arm, float(round(rng.uniform(10, 16)))), bandwidth)
    t, columns = recorded(rng, s, later, r)
    write_csv(case / "heldout_motion.csv", {name: columns[name] for name in ("q", "dq")}, t)
    write_csv(case / "heldout.csv", {name: columns[name] for name in ("tau", "tau_motor")}, t)
    kept |= hidden(arm, xml, later, held, "heldout.csv", r.every(GRID))[1]
    np.savez_compressed(case / "hidden.npz", **kept)

    together = {
        side: {effect: np.concatenate([a[side][effect] for a in added]) for effect in added[0][side]}
        for side in ("link", "drive")
    }
    entries = effects(truth, held, OLD[old][0], together, records, names, noise)
    story = {
        "kind": kind,
        "arm": arm.name,
        "file": "frictionless" if old == "frictionless" else file,
        "old": old,
        "noise_std": noise["link"].tolist(),
        "noise_std_drive": noise["drive"].tolist(),
        "noise": {"tau": s.tau.style, "tau_motor": s.motor.style, "rate": s.rate, "bits": s.bits},
        "effects": entries,
        "allowed": allowed(entries),
        "heldout": held_out(xml, later, held, s, r, columns),
    }
    (case / "truth.json").write_text(json.dumps(story, indent=1) + "\n")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--count", type=int, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=1)
    args = parser.parse_args()
    with Pool(args.jobs) as pool:
        pool.starmap(make_case, [(args.seed, index, args.out) for index in range(args.count)], chunksize=1)


if __name__ == "__main__":
    main()
