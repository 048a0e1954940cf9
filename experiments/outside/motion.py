"""Motions as an arm's owner would run them: reference q, qd, qdd on the simulation's grid."""

import numpy as np
from arms import Arm
from plant import DT

FAMILIES = ("fourier", "pick", "reversals", "one_by_one", "dwell", "slow", "mixed")


def blend(s: np.ndarray):
    """Fifth-order step from 0 to 1 and its derivatives in s."""
    s = np.clip(s, 0.0, 1.0)
    inside = (s > 0) & (s < 1)
    return (
        s**3 * (10 - 15 * s + 6 * s**2),
        30 * s**2 * (1 - s) ** 2,
        np.where(inside, 60 * s * (1 - s) * (1 - 2 * s), 0.0),
    )


class Path:
    """A reference that is built from steps, one joint or all at a time."""

    def __init__(self, arm: Arm, seconds: float, start: np.ndarray):
        self.arm, self.t = arm, np.arange(round(seconds / DT)) * DT
        self.q = np.tile(start, (len(self.t), 1))
        self.qd, self.qdd = np.zeros_like(self.q), np.zeros_like(self.q)
        self.now, self.at = 0.0, start.copy()

    @property
    def left(self) -> float:
        return self.t[-1] - self.now

    def go(self, target: np.ndarray, pace: float):
        """Move there at `pace` times the arm's speed (the fastest joint decides)."""
        step = target - self.at
        seconds = max(0.15, np.max(1.875 * np.abs(step) / (pace * self.arm.speed)))
        x, xd, xdd = blend((self.t - self.now) / seconds)
        self.q += np.outer(x, step)
        self.qd += np.outer(xd / seconds, step)
        self.qdd += np.outer(xdd / seconds**2, step)
        self.at, self.now = target.copy(), self.now + seconds

    def rest(self, seconds: float):
        self.now += seconds

    def arrays(self):
        return self.q, self.qd, self.qdd


def pose(arm: Arm, rng: np.random.Generator) -> np.ndarray:
    return arm.home + arm.reach * rng.uniform(-0.9, 0.9, arm.n)


def fourier(arm: Arm, rng: np.random.Generator, seconds: float):
    """Sum of five harmonics of a slow base frequency, as in excitation for identification."""
    t = np.arange(round(seconds / DT)) * DT
    base = 2 * np.pi * rng.uniform(0.06, 0.14)
    order = np.arange(1, 6)
    phase = np.outer(t, base * order)
    q, qd, qdd = (np.zeros((len(t), arm.n)) for _ in range(3))
    for j in range(arm.n):
        a, b = rng.standard_normal((2, 5)) / order**0.7
        x = np.sin(phase) @ a + np.cos(phase) @ b
        xd = (np.cos(phase) * base * order) @ a - (np.sin(phase) * base * order) @ b
        xdd = -(np.sin(phase) * (base * order) ** 2) @ a - (np.cos(phase) * (base * order) ** 2) @ b
        middle = 0.5 * (x.max() + x.min())
        size = min(2 * arm.reach[j] / np.ptp(x), arm.speed[j] / np.abs(xd).max()) * rng.uniform(0.6, 0.95)
        q[:, j], qd[:, j], qdd[:, j] = arm.home[j] + size * (x - middle), size * xd, size * xdd
    return q, qd, qdd


def pick(arm, rng, seconds, dwell=(0.0, 0.8)):
    path = Path(arm, seconds, pose(arm, rng))
    path.rest(rng.uniform(0.1, 0.5))
    while path.left > 0:
        path.go(pose(arm, rng), rng.uniform(0.3, 1.0))
        path.rest(rng.uniform(*dwell))
    return path.arrays()


def dwell(arm, rng, seconds):
    """Poses that are held for long, with moves between."""
    return pick(arm, rng, seconds, dwell=(1.0, 4.0))


def slow(arm, rng, seconds):
    path = Path(arm, seconds, pose(arm, rng))
    while path.left > 0:
        path.go(path.at + (pose(arm, rng) - path.at) * 0.5, rng.uniform(0.08, 0.25))
    return path.arrays()


def reversals(arm, rng, seconds):
    """Large moves and, between them, many small ones forth and back."""
    path = Path(arm, seconds, pose(arm, rng))
    while path.left > 0:
        path.go(pose(arm, rng), rng.uniform(0.4, 0.9))
        here = path.at.copy()
        for _ in range(rng.integers(3, 8)):
            path.go(here + rng.uniform(0.01, 0.12) * rng.choice([-1, 1], arm.n), rng.uniform(0.1, 0.4))
    return path.arrays()


def one_by_one(arm, rng, seconds):
    """One joint at a time, there and back, at several paces."""
    path = Path(arm, seconds, pose(arm, rng))
    joints = rng.permutation(arm.n)
    k = 0
    turn = max(1.0, seconds / (2 * arm.n))
    while path.left > 0:
        j, until = joints[k % arm.n], path.now + turn
        while path.now < until:
            target = path.at.copy()
            target[j] = pose(arm, rng)[j]
            path.go(target, rng.uniform(0.2, 0.9))
        k += 1
    return path.arrays()


def mixed(arm, rng, seconds):
    path = Path(arm, seconds, pose(arm, rng))
    while path.left > 0:
        moved = rng.random(arm.n) < 0.6
        path.go(np.where(moved, pose(arm, rng), path.at), np.exp(rng.uniform(np.log(0.1), 0.0)))
        if rng.random() < 0.3:
            path.rest(rng.uniform(0.2, 2.0))
    return path.arrays()


def draw_motion(arm: Arm, rng: np.random.Generator, seconds: float, family: str):
    return {f.__name__: f for f in (fourier, pick, reversals, one_by_one, dwell, slow, mixed)}[family](
        arm, rng, seconds
    )
