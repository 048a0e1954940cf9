"""Pairs of recordings without and with a body at the flange, by MuJoCo's C engine and plain formulas of friction."""

import dataclasses
import sys
from pathlib import Path

import mujoco
import numpy as np
from helpers import half_correlated

from jaxpanda.recordings import Recording

sys.path.insert(0, str(Path(__file__).parents[1] / "experiments" / "concealed"))
import arm as panda  # noqa: E402

sys.path.pop(0)
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
    name: str, xml: str, motion, friction: Friction | None, seed: int, noise: float = 0.03, gripped: float = 0.9
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


BODY = panda.Body(1.37, np.array([0.031, -0.012, 0.083]), np.array([0.0052, 0.0061, 0.0034, 3e-4, -4e-4, 2e-4]))


def panda_pair(seed: int, body: panda.Body | None = BODY, *, seconds=20.0, speed=1.0, changed=0.03, friction=True):
    """The user's MJCF (links off by some per cent, no friction), and recordings without and with the body."""
    rng = np.random.default_rng(seed)
    truth = panda.draw_arm(rng)
    truth = dataclasses.replace(truth, damping=np.zeros(7), frictionloss=np.zeros(7), gripper=None)
    user = panda.mjcf(panda.rough(truth, rng))
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
        record("without", panda.mjcf(truth), motions[0], law if friction else None, 10 * seed + 3),
        record("with", panda.mjcf(loaded), motions[1], warmer if friction else None, 10 * seed + 4),
    )
