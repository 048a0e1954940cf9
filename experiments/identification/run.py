"""Whether `identify` finds the friction of arms whose joints stick as they turn back."""

import argparse
import tempfile
from pathlib import Path

import jax
import mujoco
import numpy as np

from jaxpanda import Arm, Recording, identify

GAINS = {100: 20, 400: 40, 2500: 100}
"""Of the computed torque: stiffness [1/s²] and damping [1/s]."""
RATE, ENGINE_RATE, SECONDS = 250, 2000, 15.0
HARMONICS, FUNDAMENTAL = 5, 0.1


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arms", type=int, default=12, help="random arms for each gain")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print(
        "| stiffness, 1/s² | parameter | joints | error, median | bias, median | 95 % interval holds the truth |"
    )
    print("|---|---|---|---|---|---|")
    for stiffness, damping in GAINS.items():
        each = [one(stiffness, damping, [options.seed, stiffness, k]) for k in range(options.arms)]
        truth, found, std = (np.concatenate(parts, 1) for parts in zip(*each, strict=True))
        size = np.linalg.norm(truth, axis=0)
        for k, name in enumerate(("Coulomb", "viscous")):
            off = (found - truth)[k]
            share, held = off[size > 0] / size[size > 0], np.abs(off) < 1.96 * std[k]
            print(
                f"| {stiffness} | {name} | {len(off)} | {100 * np.median(np.abs(share)):.1f} % |"
                f" {100 * np.median(share):+.1f} % | {100 * held.mean():.0f} % |",
                flush=True,
            )


def one(stiffness: float, damping: float, seed: list[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coulomb's and viscous friction of an arm's joints: as they are, as identified, and with what deviation."""
    rng = np.random.default_rng(seed)
    xml = serial_arm(rng)
    recording, truth = recorded(xml, stiffness, damping, rng)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "arm.xml"
        file.write_text(xml)
        friction = identify(recording, Arm.from_mjcf(file), folds=0).friction
    names = ("coulomb", "viscous")
    return truth, *(
        np.stack([np.asarray(of[name]) for name in names]) for of in (friction.parameters, friction.std)
    )


def serial_arm(rng: np.random.Generator) -> str:
    """MJCF of an arm of three to six joints without friction, one in eight of them a slide."""
    count, mass = int(rng.integers(3, 7)), 8.0
    out = '<mujoco><compiler angle="radian"/><worldbody>'
    for k in range(count):
        length, mass = rng.uniform(0.1, 0.35), mass * rng.uniform(0.5, 0.9)
        axis = rng.choice(["0 0 1", "0 1 0", "1 0 0"]) if k else "0 0 1"
        inertia, (x, y), z = mass * length**2 / 12, rng.uniform(-0.05, 0.05, 2), rng.uniform(0.02, 0.2)
        kind = 'type="slide" range="-0.4 0.4"' if rng.random() < 1 / 8 else 'range="-2 2"'
        out += (
            f'<body pos="0 {rng.uniform(-0.1, 0.1)} {length}">'
            f'<joint name="j{k}" {kind} axis="{axis}" armature="{0.02 * mass}"/>'
            f'<inertial mass="{mass}" pos="{x} {y} {z}" diaginertia="{inertia} {inertia} {0.6 * inertia}"/>'
        )
    return out + "</body>" * count + "</worldbody></mujoco>"


def recorded(
    xml: str, stiffness: float, damping: float, rng: np.random.Generator
) -> tuple[Recording, np.ndarray]:
    """A Fourier motion under computed torque that knows nothing of friction, and that friction: Coulomb's of 2 to
    25 % and viscous of 2 to 20 % of each joint's torque (rms, at 1 rad/s), at four joints of five."""
    model = mujoco.MjModel.from_xml_string(xml)
    model.opt.timestep, model.opt.integrator = 1 / ENGINE_RATE, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    data, dof = mujoco.MjData(model), model.nv
    w = 2 * np.pi * FUNDAMENTAL * np.arange(1, HARMONICS + 1) * (1 + 0.05 * rng.random())
    a, b = rng.normal(size=(2, dof, HARMONICS)) / np.arange(1, HARMONICS + 1)
    at = np.arange(0, SECONDS, 0.01)[:, None, None]
    reach = np.abs((a * np.sin(w * at) + b * np.cos(w * at)).sum(2)).max(0)
    a, b = (x * (0.55 * model.jnt_range[:, 1] / reach)[:, None] for x in (a, b))

    def desired(t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        sin, cos = np.sin(w * t), np.cos(w * t)
        return (
            (a * sin + b * cos).sum(1),
            ((a * cos - b * sin) * w).sum(1),
            -((a * sin + b * cos) * w**2).sum(1),
        )

    rigid = []
    for t in np.arange(0, SECONDS, 0.05):
        data.qpos[:], data.qvel[:], data.qacc[:] = desired(t)
        mujoco.mj_inverse(model, data)
        rigid.append(data.qfrc_inverse.copy())
    size = np.sqrt(np.mean(np.square(rigid), 0))
    share = rng.uniform(0.02, [[0.25], [0.2]], (2, dof)) * (rng.random((2, dof)) < 0.8)
    model.dof_frictionloss[:], model.dof_damping[:] = share * size
    mujoco.mj_resetData(model, data)
    data.qpos[:], data.qvel[:] = desired(0.0)[:2]
    M, rows = np.zeros((dof, dof)), []
    for k in range(int(SECONDS * ENGINE_RATE)):
        q, qd, qdd = desired(k / ENGINE_RATE)
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, M)
        pull = stiffness * (q - data.qpos) + damping * (qd - data.qvel)
        data.qfrc_applied[:] = M @ (qdd + pull) + data.qfrc_bias
        if k % (ENGINE_RATE // RATE) == 0:
            rows.append(np.stack([data.qpos, data.qvel, data.qfrc_applied]))
        mujoco.mj_step(model, data)
    q, qd, tau = np.moveaxis(np.array(rows), 1, 0)
    noise = lambda deviation: deviation * rng.normal(size=q.shape)
    time = np.arange(len(q)) / RATE
    return Recording(
        "sticks", time, q + noise(2e-5), qd + noise(1e-3), tau + noise(0.02 * size)
    ), share * size


if __name__ == "__main__":
    main()
