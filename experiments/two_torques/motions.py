"""Reference motions well inside the joint ranges: Fourier series, point to point, strokes of constant speed."""

import numpy as np
from arms import Arm

DT = 1e-3  # of every simulation [s]
MARGIN = 0.12  # rad that stays free at either end of a range
RAMP = 1.5  # s in which a motion starts from rest


def fourier(rng: np.random.Generator, t: np.ndarray, n: int) -> np.ndarray:
    base = 2 * np.pi / rng.uniform(6, 11)
    k = np.arange(1, 6)[:, None]
    a, b = rng.standard_normal((2, n, 5, 1)) / k**0.8
    return np.sum(a * np.sin(k * base * t) + b * np.cos(k * base * t), axis=1).T


def points(rng: np.random.Generator, t: np.ndarray, n: int) -> np.ndarray:
    """Quintics from one posture to the next; some joints stand between them."""
    q, here, start = np.zeros((len(t), n)), np.zeros(n), 0.0
    while start < t[-1]:
        there, length = rng.uniform(-1, 1, n), rng.uniform(1.2, 2.8)
        s = np.clip((t - start) / length, 0, 1)[:, None]
        rows = t >= start
        q[rows] = (here + (there - here) * s**3 * (10 - 15 * s + 6 * s**2))[rows]
        here, start = there, start + length + rng.choice([0.0, 0.15, 0.6])
    return q


def strokes(rng: np.random.Generator, t: np.ndarray, n: int) -> np.ndarray:
    """To and fro at nearly constant speed, which is what friction is usually identified from."""
    rate = 2 * np.pi / rng.uniform(3.5, 9, n)
    pace = 0.35 + 0.65 * np.abs(np.sin(2 * np.pi * t[:, None] / rng.uniform(12, 25, n)))
    v = pace * np.tanh(3 * np.sin(rate * t[:, None] + rng.uniform(0, 2 * np.pi, n)))
    return np.cumsum(v, axis=0) * DT


def smooth(q: np.ndarray) -> np.ndarray:
    """Running mean over 80 ms, twice: finite jerk everywhere."""
    kernel = np.ones(80) / 80
    for _ in range(2):
        padded = np.pad(q, ((40, 39), (0, 0)), mode="edge")
        q = np.stack([np.convolve(column, kernel, mode="valid") for column in padded.T], axis=1)
    return q


def plan(rng: np.random.Generator, arm: Arm, seconds: float) -> tuple[np.ndarray, ...]:
    """(t, q, qd, qdd) of a reference, each joint scaled into its range, its speed and its acceleration."""
    t = np.arange(round((seconds + 1) / DT)) * DT  # a second more than is kept, so that no end is abrupt
    shape = [fourier, points, strokes][rng.integers(3)](rng, t, arm.joints)
    shape = smooth((shape - shape[0]) * (1 - np.cos(np.pi * np.clip(t / RAMP, 0, 1)))[:, None] / 2)
    shape = shape - (shape.max(axis=0) + shape.min(axis=0)) / 2
    room = np.minimum(arm.limits[:, 1] - arm.home, arm.home - arm.limits[:, 0]) - MARGIN
    reach = rng.uniform(0.45, 1, arm.joints) * np.minimum(room, 1.3) / np.max(np.abs(shape), axis=0)
    fastest = np.max(np.abs(np.gradient(shape, DT, axis=0)), axis=0)
    hardest = np.max(np.abs(np.gradient(np.gradient(shape, DT, axis=0), DT, axis=0)), axis=0)
    most_speed, most_acceleration = rng.uniform(0.6, 1) * arm.speed, rng.uniform(3, 7)
    scale = np.min([reach, most_speed / fastest, most_acceleration / hardest], axis=0)
    q = arm.home + scale * shape
    qd = np.gradient(q, DT, axis=0)
    kept = round(seconds / DT)
    return t[:kept], q[:kept], qd[:kept], np.gradient(qd, DT, axis=0)[:kept]
