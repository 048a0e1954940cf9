"""Does a controller track better for what a diagnosis found? See README.md.

python experiments/control/run.py --arms 3 --out figures.json
"""

import argparse
import json
import os
import platform
import time
from importlib import metadata
from pathlib import Path

import controllers
import jax.numpy as jnp
import mujoco
import numpy as np

import jaxpanda
from jaxpanda import session
from jaxpanda.arms.export import panda_mjcf
from jaxpanda.simulation import JointFriction, panda_sensors, perturbed, random_trajectory, simulate

DT = 1e-3
SECONDS = 3.0
COARSE = 10
"""Steps of the engine to one of LQR and of the roll-outs that gains are tuned on."""
TORQUE = np.array([10.0, 10, 10, 10, 2, 2, 2])
"""Feedback torque that counts as much as 10 mrad of tracking error [N m]."""


def concealed(seed: int):
    """An arm that its file does not tell: links, friction of every joint, a payload. And recordings of it."""
    rng = np.random.default_rng(seed)
    mass = float(rng.uniform(0.4, 1.2))
    model = with_payload(perturbed(panda_mjcf(), seed, 0.05), mass, np.array([0.02, 0, 0.16]))
    viscous = np.array([1, 1, 0.8, 0.8, 0.3, 0.3, 0.2]) * rng.uniform(0.3, 1.0, 7)
    coulomb = np.array([1, 1, 0.8, 0.8, 0.3, 0.3, 0.2]) * rng.uniform(0.3, 1.0, 7)
    friction = JointFriction(viscous=viscous, coulomb=coulomb)
    logs = []
    for k in range(2):
        trajectory = random_trajectory(panda_mjcf(), 10 * seed + k)
        logs.append(simulate(model, trajectory, duration=10.0, rate=500.0, friction=friction,
                             sensors=panda_sensors(), seed=k, name=f"recording {k}"))  # fmt: skip
    model.dof_damping[:], model.dof_frictionloss[:] = viscous, coulomb
    return model, logs, {"payload_kg": mass, "viscous": viscous.tolist(), "coulomb": coulomb.tolist()}


def with_payload(model: mujoco.MjModel, mass: float, place: np.ndarray) -> mujoco.MjModel:
    """A ball of 4 cm radius fixed to the last body, by the parallel-axis theorem."""

    def about_origin(m, c, central):
        return central + m * (c @ c * np.eye(3) - np.outer(c, c))

    body, axes = model.nbody - 1, np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[body])
    R, m, c = axes.reshape(3, 3), float(model.body_mass[body]), model.body_ipos[body].copy()
    inertia = about_origin(m, c, R @ np.diag(model.body_inertia[body]) @ R.T)
    inertia += about_origin(mass, place, 0.4 * mass * 0.04**2 * np.eye(3))
    com = (m * c + mass * place) / (m + mass)
    moments, R = np.linalg.eigh(inertia - about_origin(m + mass, com, np.zeros((3, 3))))
    R[:, 0] *= np.linalg.det(R)
    mujoco.mju_mat2Quat(model.body_iquat[body], R.ravel())
    model.body_mass[body], model.body_ipos[body], model.body_inertia[body] = m + mass, com, moments
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def track(model: mujoco.MjModel, motion, ahead, K, start=None) -> np.ndarray:
    """Tracking error [rad] of every step in MuJoCo's C engine; nothing of ours runs in this loop."""
    model.opt.timestep, model.opt.integrator = DT, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    data = mujoco.MjData(model)
    q, qd = (np.asarray(x) for x in motion[:2])
    data.qpos, data.qvel = q[0], qd[0]
    if start is not None:
        data.qpos += start
    errors = np.empty_like(q)
    for k in range(len(q)):
        errors[k] = q[k] - data.qpos
        data.qfrc_applied = ahead[k] + K[k] @ np.concatenate([errors[k], qd[k] - data.qvel])
        mujoco.mj_step(model, data)
    return errors


def held(x) -> np.ndarray:
    return np.repeat(np.asarray(x), COARSE, axis=0)


def one_arm(seed: int, iterations: int) -> dict:
    began = time.perf_counter()
    model, logs, truth = concealed(seed)
    found = jaxpanda.diagnose(None, logs)
    diagnosed = time.perf_counter() - began
    print(
        f"arm {seed}: {found.verdict}: {[(f.effect, f.joints) for f in found.findings]} in {diagnosed:.0f} s",
        flush=True,
    )
    arm, zero = jaxpanda.Arm.panda(), jnp.zeros(7)
    nominal = jaxpanda.Corrected(arm, jnp.zeros((7, 10)), zero, zero, (), ())
    wanted = random_trajectory(panda_mjcf(), 1000 + seed)
    motion = tuple(jnp.asarray(x) for x in wanted(np.arange(round(SECONDS / DT)) * DT))
    coarse, dt = tuple(x[::COARSE] for x in motion), COARSE * DT
    rng = np.random.default_rng(seed)
    off = jnp.asarray(
        np.concatenate(
            [rng.normal(0, 0.02, (4, 7)), np.zeros((4, 7)), TORQUE / 10 * rng.normal(size=(4, 7))], 1
        )
    )
    scale = jnp.concatenate([jnp.full(7, 0.01), jnp.full(7, 0.1)])
    rows: dict = {}

    def follow(name, controller, ahead, K):
        errors = track(model, motion, np.asarray(ahead), held(K))
        rows.setdefault(controller, {})[name] = 1e3 * float(np.sqrt(np.mean(errors**2)))
        print(f"  {name}, {controller}: {rows[controller][name]:.2f} mrad", flush=True)

    for name, corrected in (("before", nominal), ("after", found.corrected)):
        ahead = controllers.feed_forward(corrected, motion)
        first = controllers.computed_torque(corrected, coarse)
        regulator = controllers.lqr(corrected, coarse, ahead[::COARSE], dt, scale, jnp.asarray(TORQUE))
        follow(name, "computed torque", ahead, first)
        follow(name, "LQR", ahead, regulator)
        schedule, history = controllers.tuned(
            corrected, coarse, ahead[::COARSE], dt, first, off, jnp.asarray(TORQUE), iterations=iterations
        )
        follow(name, "tuned schedule", ahead, schedule)
        rows.setdefault("cost of tuning, first and least", {})[name] = [history[0], min(history)]
    return {
        "seed": seed,
        "truth": truth,
        "verdict": found.verdict,
        "findings": [[f.effect, list(f.joints)] for f in found.findings],
        "tracking_error_mrad": rows,
        "seconds": {"recording and diagnosis": diagnosed, "all": time.perf_counter() - began},
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--arms", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0, help="of the first arm")
    parser.add_argument("--iterations", type=int, default=20, help="of the gradient on the gains")
    parser.add_argument("--out", type=Path, help="figures (JSON)")
    args = parser.parse_args()
    session.start()  # float64, and what is compiled is kept
    versions = {name: metadata.version(name) for name in ("jax", "mujoco", "numpy")}
    arms = [one_arm(args.seed + k, args.iterations) for k in range(args.arms)]
    summary = {}
    print(f"\n{'tracking error [mrad], median of arms':40}{'before':>10}{'after':>10}{'ratio (worst)':>18}")
    for controller in ("computed torque", "LQR", "tuned schedule"):
        rows = [a["tracking_error_mrad"][controller] for a in arms]
        ratio = [r["after"] / r["before"] for r in rows]
        before, after = (float(np.median([r[name] for r in rows])) for name in ("before", "after"))
        summary[controller] = {
            "before": before,
            "after": after,
            "ratio": float(np.median(ratio)),
            "worst": max(ratio),
        }
        print(f"{controller:40}{before:10.2f}{after:10.2f}{np.median(ratio):10.2f} ({max(ratio):.2f})")
    if args.out:
        document = {
            "machine": platform.machine(),
            "cores": os.cpu_count(),
            **versions,
            "summary": summary,
            "arms": arms,
        }
        args.out.write_text(json.dumps(document, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
