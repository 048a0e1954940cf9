"""Pairs of recordings without and with a body at the flange: MuJoCo's C engine, friction by plain formulas."""

import dataclasses
import importlib.util
import itertools
import sys
from pathlib import Path

import mujoco
import numpy as np
from helpers import half_correlated

from jaxpanda.recordings import Recording

_SPEC = importlib.util.spec_from_file_location(
    "concealed_arm", Path(__file__).parents[1] / "experiments" / "concealed" / "arm.py"
)
assert _SPEC is not None
assert _SPEC.loader is not None
panda = importlib.util.module_from_spec(_SPEC)  # not as `arm`, which other folders have too
sys.modules["concealed_arm"] = panda
_SPEC.loader.exec_module(panda)

RATE = 200.0


@dataclasses.dataclass(frozen=True)
class Friction:
    """Of one recording: Coulomb and viscous level of each joint, Stribeck's rise, share of the load, offset."""

    coulomb: np.ndarray
    viscous: np.ndarray
    stribeck: float = 0.0
    load: float = 0.0
    offset: float = 0.0

    def torque(self, qd: np.ndarray, load: np.ndarray) -> np.ndarray:
        dry = self.coulomb * (1 + self.stribeck * np.exp(-((qd / 0.1) ** 2))) + self.load * np.abs(load)
        return dry * np.tanh(qd / 0.003) + self.viscous * qd + self.offset


def fourier(seed: int, seconds: float, dof: int, middle: np.ndarray, reach: float, speed: float):
    """Sums of five sines with their derivatives, each [time, dof]."""
    rng, t = np.random.default_rng(seed), np.arange(int(seconds * RATE)) / RATE
    w = 2 * np.pi * speed * np.array([1, 2, 3, 4, 5])[:, None] / 10
    a, b = rng.normal(0, 1, (2, 5, dof)) / np.array([1, 1.5, 2, 2.5, 3])[:, None]
    size = reach / np.abs(np.sin(w * t).T @ a + np.cos(w * t).T @ b).max(0)
    a, b = a * size, b * size
    q = middle + np.sin(w * t).T @ a + np.cos(w * t).T @ b
    qd = (w * np.cos(w * t)).T @ a - (w * np.sin(w * t)).T @ b
    return t, q, qd, -((w**2) * np.sin(w * t)).T @ a - ((w**2) * np.cos(w * t)).T @ b


def record(
    name: str,
    xml: str,
    motion,
    friction: Friction | None,
    seed: int,
    noise: float = 0.03,
    gripped: float = 0.9,
) -> Recording:
    """What an arm shows in a motion; half of the noise is correlated."""
    t, q, qd, qdd = motion
    model = mujoco.MjModel.from_xml_string(xml)
    model.dof_frictionloss[:] = 0
    data, load = mujoco.MjData(model), np.empty_like(q)
    for k in range(len(t)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], qd[k], qdd[k]
        mujoco.mj_inverse(model, data)
        load[k] = data.qfrc_inverse
    rng = np.random.default_rng(seed)
    tau = load + noise * half_correlated(rng, q.shape, gripped)
    if friction is not None:
        tau = tau + friction.torque(qd, load)
    return Recording(name, t, q + 1e-5 * rng.normal(size=q.shape), qd=qd, tau=tau)


BODY = panda.Body(
    1.37, np.array([0.031, -0.012, 0.083]), np.array([0.0052, 0.0061, 0.0034, 3e-4, -4e-4, 2e-4])
)


def inertial(body: panda.Body) -> str:
    """As MJCF has it."""
    values = (" ".join(repr(float(v)) for v in np.atleast_1d(x)) for x in (body.mass, body.com, body.inertia))
    return '<inertial mass="{}" pos="{}" fullinertia="{}"/>'.format(*values)


def held_poses(seed: int, count: int, hold: float = 2.0, go: float = 1.5):
    """From pose to pose by minimum jerk, each held for a while."""
    rng, rows = np.random.default_rng(seed), int((hold + go) * RATE)
    poses = panda.HOME + rng.uniform(-0.6, 0.6, (count + 1, 7))
    s = np.clip(np.arange(rows) / (go * RATE), 0, 1)[:, None]
    share = s**3 * (10 - 15 * s + 6 * s * s)
    q = np.concatenate([a + share * (b - a) for a, b in itertools.pairwise(poses)])
    qd = np.gradient(q, 1 / RATE, axis=0)
    return np.arange(len(q)) / RATE, q, qd, np.gradient(qd, 1 / RATE, axis=0)


def panda_truth(seed: int) -> tuple[str, panda.Arm]:
    """A user's MJCF, its links off by some per cent, and the arm as it is."""
    rng = np.random.default_rng(seed)
    truth = panda.draw_arm(rng)
    truth = dataclasses.replace(truth, damping=np.zeros(7), frictionloss=np.zeros(7), gripper=None)
    return panda.mjcf(panda.rough(truth, rng)), truth


def panda_pair(
    seed: int,
    body: panda.Body | None = BODY,
    *,
    seconds: float = 20.0,
    speed: float = 1.0,
    changed: float = 0.03,
) -> tuple[str, Recording, Recording]:
    """A user's MJCF without friction, and recordings without and with the body, friction a little changed."""
    user, truth = panda_truth(seed)
    rng = np.random.default_rng(1000 + seed)
    big = np.array([1, 1, 1, 1, 0.4, 0.4, 0.4])
    law = Friction(rng.uniform(0.2, 0.8, 7) * big, rng.uniform(0.2, 1.0, 7) * big, 0.3, 0.02)
    warmer = dataclasses.replace(
        law,
        coulomb=law.coulomb * (1 + changed * rng.normal(size=7)),
        viscous=law.viscous * (1 + changed * rng.normal(size=7)),
    )
    motions = [fourier(10 * seed + k, seconds, 7, panda.HOME, 0.6, speed) for k in (1, 2)]
    loaded = dataclasses.replace(truth, load=body)
    return (
        user,
        record("without", panda.mjcf(truth), motions[0], law, 10 * seed + 3),
        record("with", panda.mjcf(loaded), motions[1], warmer, 10 * seed + 4),
    )
