"""Blind trial of arms in service: python make.py --seed S --count N [--jobs J] [--kinds …] --out CASES"""

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from arms import ARMS, inertials, mjcf
from kinds import NEAR, SHARES, Scaler, Sight, deal
from laws import Friction
from motions import FAMILIES, motion
from plant import G, Plan, Rigid, simulate
from scipy.signal import butter, sosfiltfilt
from sensors import logger, measured, motion_columns, samples, write


def case_list(kinds: list[str], count: int) -> list[tuple[str, int]]:
    """(kind, its turn) for every case, by the shares."""
    share = np.array([SHARES[kind] for kind in kinds])
    given, out = np.zeros(len(kinds), int), []
    for k in range(count):
        pick = int(np.argmax(share / share.sum() * (k + 1) - given))
        out.append((kinds[pick], int(given[pick])))
        given[pick] += 1
    return out


def perturbed(phi: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Links 1 % off."""
    out = phi.copy()
    out[:, [0, 4, 5, 6, 7, 8, 9]] *= 1 + 0.01 * rng.normal(size=(len(phi), 1))
    out[:, 1:4] *= 1 + 0.01 * rng.normal(size=(len(phi), 3))
    return out


def prepare(seed: int, index: int, kind: str, turn: int):
    """(plan, logger, dt, motions, sizes of the background, family, rng) of one case."""
    rng = np.random.default_rng([seed, index])
    block, place = divmod(index, len(ARMS))
    arm = ARMS[np.random.default_rng([seed, block, 9]).permutation(len(ARMS))[place]]
    phi = inertials(arm, rng)
    noise = np.array(arm.torque) * rng.uniform(0.0012, 0.0035) * rng.uniform(0.7, 1.4, arm.n)
    count = 1 if rng.random() < 0.4 else 2
    seconds = [float(np.round(rng.uniform(10, 18), 1)) for _ in range(count + 1)]
    if count == 1 and rng.random() < 0.3:
        seconds[0] = float(np.round(rng.uniform(25, 40), 1))
    still = np.ones(arm.n)
    if rng.random() < 0.25:
        still[rng.choice(arm.n, 2, replace=False)] = rng.uniform(0.01, 0.08, 2)
    family = str(rng.choice(FAMILIES, p=[0.3, 0.18, 0.17, 0.15, 0.1, 0.1]))
    grid = 1e-3
    moves = [motion(family, arm, s, grid, still, rng) for s in seconds[:-1]]
    moves.append(motion("fourier" if rng.random() < 0.3 else family, arm, seconds[-1], grid, still, rng))
    armature = np.array(arm.armature) * rng.uniform(0.8, 1.2, arm.n)
    speed = np.array(arm.speed)
    friction = Friction.none(arm.n)
    friction.breakaway[:] = rng.uniform(4e-4, 2e-3, arm.n)
    user = {"damping": np.zeros(arm.n), "frictionloss": np.zeros(arm.n), "armature": armature.copy()}
    plan = Plan(arm, noise, phi, phi, phi, phi, G, G, friction, armature, user)
    if rng.random() < 0.5:  # friction that the user's file has
        friction.coulomb[:] = noise * rng.uniform(2, 10, arm.n)
        friction.viscous[:] = friction.coulomb * rng.uniform(0.2, 0.8, arm.n) / speed
        user["frictionloss"][:], user["damping"][:] = friction.coulomb, friction.viscous
        plan.role["coulomb"] = ["presliding_hysteresis"] * arm.n
    sight = look(plan, moves[:-1], seconds[:-1], grid)
    scaler = Scaler(plan, sight, rng)
    sort = deal(kind, turn + 15 * (seed - 1), scaler)
    unsettle(plan, sight, rng, 1.0 if sort == "identified links" else 0.6)
    if sort == "sticking" and not user["frictionloss"].any():
        friction.coulomb[:] = noise * rng.uniform(3, 10, arm.n)
        user["frictionloss"][:] = friction.coulomb
        plan.role["coulomb"] = ["presliding_hysteresis"] * arm.n
    floor = 40 * friction.coulomb * grid**2 / (armature * rng.uniform(1, 1.01))
    friction.breakaway = np.maximum(friction.breakaway, floor)
    log = logger(arm, noise, rng, sort)
    small = noise * rng.uniform(0.05, 0.2, (4, arm.n))
    return plan, log, grid, moves, small, family, sort, rng


def look(plan: Plan, moves: list, seconds: list[float], grid: float) -> Sight:
    every = 40
    q, v, a = (np.vstack([move[k][::every] for move in moves]) for k in range(3))
    start = np.cumsum([0, *[s + 60 for s in seconds]])[:-1]
    t = np.concatenate(
        [s + np.arange(len(move[0][::every])) * every * grid for s, move in zip(start, moves, strict=True)]
    )
    tau = Rigid(plan.arm, plan.phi_true, G).torque(q, v, a) + plan.armature * a
    tau = tau + plan.friction.coulomb * np.tanh(v / 0.01) + plan.friction.viscous * v
    return Sight(q, v, a, t, tau, seconds, every * grid)


def unsettle(plan: Plan, sight: Sight, rng: np.random.Generator, most: float) -> None:
    """The unnamed part: the user's links and level a little off, by at most 0.3 × `most` of the noise."""
    named = plan.phi_named
    wild = perturbed(named, rng)
    tilt = rng.normal(0, 9e-4, 2)
    level = G + 9.81 * np.array([tilt[0], tilt[1], 0])
    s = sight
    torque = lambda phi, gravity: Rigid(plan.arm, phi, gravity).torque(s.q, s.v, s.a)
    change = torque(wild, level) - torque(named, G)
    worst = np.max(np.sqrt(np.mean(change**2, 0)) / plan.noise)
    share = min(1.0, 0.5 * most / worst)
    true = named + share * (wild - named)
    loaded = plan.phi_loaded
    plan.phi_loaded = loaded + (true - named) if loaded is not named else true
    plan.phi_true = true
    plan.gravity_level = G + share * (level - G)
    plan.gravity_true = plan.gravity_level if plan.gravity_true is G else plan.gravity_true
    if loaded is named:
        plan.phi_loaded = plan.phi_true


def record(seed: int, index: int, kind: str, turn: int) -> dict:
    """Everything of a case, before it is written: recordings, torque of the causes and what is left over."""
    plan, log, grid, moves, small, family, sort, rng = prepare(seed, index, kind, turn)
    dt = 5e-4 if plan.stiffness or plan.play else grid
    out = []
    clock = 0.0
    for k, move in enumerate(moves):
        if dt != grid:
            move = tuple(np.repeat(x, 2, axis=0) for x in move)
            move = tuple(np.vstack([(x[:-1] + x[1:]) / 2, x[-1:]]) for x in move)
        last = k == len(moves) - 1
        number = -1 if last else k
        clock = 1e4 if last else clock
        run = simulate(plan, move, dt, number, clock)
        clock += run.t[-1] + 60
        if not np.isfinite(run.tau).all() or np.abs(run.q - move[0]).max() > 0.6:
            raise ValueError(f"{kind}_{index}: the arm does not follow its command")
        at = samples(log, run, rng)
        column, base, parts, rest = measured(plan, log, run, at, number, small, rng)
        if plan.meaning and plan.meaning[0] == "mounting":
            parts["torque_meaning"] = parts.pop("gravity_direction")
        q, dq = motion_columns(plan, log, run, at, rng)
        states = (run.theta[at] + (0 if plan.encoder is None else plan.encoder), run.omega[at], run.alpha[at])
        out.append(
            dict(t=run.t[at], q=q, dq=dq, tau=column, base=base, parts=parts, rest=rest, states=states)
        )
    return dict(plan=plan, log=log, family=family, sort=sort, recordings=out)


def rms(x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(x**2, 0))


def answers(case: dict, seed: int, kind: str) -> dict:
    """truth.json."""
    plan, log, recordings = case["plan"], case["log"], case["recordings"]
    train, held = recordings[:-1], recordings[-1]
    noise = rms(np.vstack([r["rest"] for r in train]))
    effects, allowed = [], list(plan.allowed)
    known = {cause["effect"]: cause for cause in plan.causes}
    for name in dict.fromkeys([*known, *(name for r in train for name in r["parts"])]):
        cause = known.get(name, {"effect": name, "joints": None, "parameters": []})
        together = np.vstack([r["parts"].get(name, np.zeros_like(r["base"])) for r in train])
        if name in ("backlash", "joint_elasticity"):  # what a log can show: encoders hide a gear's chatter
            sos = butter(2, min(10, 0.4 * log.fs), fs=log.fs, output="sos")
            together = sosfiltfilt(sos, together, axis=0)
        acting = np.any(together != 0, axis=1)
        size = rms(together[acting]) if acting.any() else np.zeros(plan.arm.n)
        joints = cause["joints"]
        if name not in known:  # friction of the file that sticks in truth
            joints = [j + 1 for j in range(plan.arm.n) if size[j] > 1e-9]
            allowed.append({"effect": name, "joints": joints})
            joints = [j for j in joints if size[j - 1] >= noise[j - 1]] or joints
        elif joints is None:
            joints = [j + 1 for j in range(plan.arm.n) if size[j] >= 0.5 * noise[j]] or [
                int(np.argmax(size / noise)) + 1
            ]
        seen = cause.get("recordings") or [
            f"train_{k}.csv" for k, r in enumerate(train) if np.any(r["parts"].get(name, 0) != 0)
        ]
        entry = {
            "effect": name,
            "joints": joints,
            "recordings": seen,
            "intervals": cause.get("intervals"),
            "parameters": cause["parameters"],
            "rms_torque": [float(f"{x:.5g}") for x in size],
            "detectable": bool(np.max(size / noise) >= 1),
            "also": cause.get("also", NEAR.get(name, [])),
            "optional": name not in known,
        }
        effects.append(entry | {key: cause[key] for key in ("kind", "what") if key in cause})
    if kind != "friction_all" and plan.user["frictionloss"].any():
        rubbing = [int(j) + 1 for j in np.flatnonzero(plan.user["frictionloss"])]
        allowed.append({"effect": "presliding_hysteresis", "joints": rubbing})
    if log.ringing:
        rings = [j + 1 for j in log.ringing]
        allowed += [{"effect": "unknown", "joints": rings}, {"effect": "joint_elasticity", "joints": rings}]
    unique = list({json.dumps(x, sort_keys=True): x for x in allowed}.values())
    return {
        "seed": seed,
        "kind": kind,
        "sort": case["sort"],
        "arm": plan.arm.name,
        "effects": effects,
        "allowed": unique,
        "noise_std": [float(f"{x:.5g}") for x in noise],
        "nominal": "identified",
        "family": case["family"],
        "sensors": log.public(),
        "heldout": {
            "rmse_nominal": [float(f"{x:.5g}") for x in rms(held["tau"] - held["base"])],
            "rmse_true_model": [float(f"{x:.5g}") for x in rms(held["rest"])],
        },
    }


def make(job: tuple) -> str:
    seed, index, kind, turn, out = job
    case = record(seed, index, kind, turn)
    plan = case["plan"]
    folder = Path(out) / f"{kind}_{index:03d}"
    folder.mkdir(parents=True, exist_ok=True)
    user = {key: value for key, value in plan.user.items() if value.any()}
    (folder / "model.xml").write_text(mjcf(plan.arm, plan.phi_user, G, user, 1e-3))
    for k, r in enumerate(case["recordings"]):
        name = "heldout" if k == len(case["recordings"]) - 1 else f"train_{k}"
        write(folder / f"{name}.csv", r["t"], r["q"], r["dq"], r["tau"])
        if name == "heldout":
            write(folder / "heldout_motion.csv", r["t"], r["q"], r["dq"], None)
            np.savez_compressed(folder / "hidden.npz", heldout_motion=np.stack(r["states"]))
    (folder / "truth.json").write_text(json.dumps(answers(case, seed, kind), indent=1, ensure_ascii=False))
    return folder.name


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--count", type=int, required=True)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--kinds", nargs="+", choices=list(SHARES), default=list(SHARES))
    parser.add_argument("--out", required=True)
    options = parser.parse_args()
    jobs = [
        (options.seed, k, kind, turn, options.out)
        for k, (kind, turn) in enumerate(case_list(options.kinds, options.count))
    ]
    if options.jobs == 1:
        for job in jobs:
            print(make(job), flush=True)
    else:
        with ProcessPoolExecutor(options.jobs) as pool:
            for name in pool.map(make, jobs):
                print(name, flush=True)


if __name__ == "__main__":
    main()
