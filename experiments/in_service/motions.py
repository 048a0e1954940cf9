"""What the arms were told to do: positions, velocities and accelerations on the grid of the simulation."""

import numpy as np

FAMILIES = ("fourier", "ptp_trapezoid", "ptp_quintic", "pick", "sweep", "jog")


def motion(family: str, arm, seconds: float, dt: float, still: np.ndarray, rng: np.random.Generator):
    """(q, qd, qdd), each (samples, n). `still`: factor on each joint's travel, 1 for free."""
    t = np.arange(round(seconds / dt)) * dt
    low, high = arm.range.T
    home = np.array(arm.home, float)
    room = 0.8 * np.minimum(np.minimum(home - low, high - home), 1.4) * rng.uniform(0.6, 1, arm.n) * still
    speed = np.array(arm.speed) * rng.uniform(0.45, 0.9)
    if family == "fourier":
        return _fourier(t, home, room, speed, rng)
    if family == "sweep":
        return _sweep(t, home, room, speed, rng)
    profile = _trapezoid if family in ("ptp_trapezoid", "jog") else _quintic
    if family == "pick":
        ring = home + room * rng.uniform(-1, 1, (int(rng.integers(3, 6)), arm.n))
        points = np.tile(ring, (60, 1))
    elif family == "jog":
        points = _jogged(home, room, rng)
    else:
        points = home + room * rng.uniform(-1, 1, (80, arm.n))
    dwell = rng.uniform(0.05, 0.7, 5) if family != "jog" else rng.uniform(0.1, 0.4, 5)
    return _through(points, t, speed, speed * rng.uniform(2, 5), dwell, profile)


def _fourier(t, home, room, speed, rng):
    base = 2 * np.pi / rng.uniform(6, 12)
    order = np.arange(1, 6)
    a = rng.normal(size=(2, 5, len(home))) / np.sqrt(order)[None, :, None]
    phase = np.outer(t, base * order)
    s, c = np.sin(phase), np.cos(phase)
    w = (base * order)[:, None]
    q, v = s @ a[0] + c @ a[1], c @ (w * a[0]) - s @ (w * a[1])
    scale = np.minimum(room / np.abs(q).max(0), speed / np.abs(v).max(0))
    return home + scale * q, scale * v, scale * (-s @ (w**2 * a[0]) - c @ (w**2 * a[1]))


def _sweep(t, home, room, speed, rng):
    f0, f1 = rng.uniform(0.05, 0.12), rng.uniform(0.5, 1.2)
    shift = rng.uniform(0, 2 * np.pi, len(home))
    rate = 2 * np.pi * (f0 + (f1 - f0) * t / t[-1])[:, None] * rng.uniform(0.7, 1.3, len(home))
    q = np.sin(np.cumsum(rate, 0) * (t[1] - t[0]) + shift)
    fade = (1 / (1 + (rate / (0.5 * speed / room)) ** 2)) ** 0.5
    q = home + room * fade * q
    dt = t[1] - t[0]
    v = np.gradient(q, dt, axis=0)
    return q, v, np.gradient(v, dt, axis=0)


def _jogged(home, room, rng):
    points = [home]
    for j in rng.permutation(np.tile(np.arange(len(home)), 12)):
        point = points[-1].copy()
        point[j] = home[j] + room[j] * rng.uniform(-1, 1)
        points.append(point)
    return np.array(points)


def _through(points, t, speed, acceleration, dwell, profile):
    """Stop at every point; all joints arrive together."""
    q, v, a = (np.zeros((len(t), points.shape[1])) for _ in range(3))
    dt, i, k = t[1] - t[0], 0, 0
    while i < len(t):
        start, step = points[k], points[(k + 1) % len(points)] - points[k]
        need = np.maximum(1.9 * np.abs(step) / speed, np.sqrt(6 * np.abs(step) / acceleration))
        length = max(need.max(), 0.05)
        move, rest = int(length / dt), int(dwell[k % len(dwell)] / dt)
        s, ds, dds = profile(np.arange(move + rest) / max(move, 1))
        stop = min(i + move + rest, len(t))
        part = slice(0, stop - i)
        q[i:stop] = start + np.outer(s[part], step)
        v[i:stop] = np.outer(ds[part], step) / length
        a[i:stop] = np.outer(dds[part], step) / length**2
        i, k = stop, (k + 1) % (len(points) - 1)
        if k == 0:
            points = np.vstack([points[-1], points[1:]])
    return q, v, a


def _quintic(x):
    x = np.minimum(x, 1)
    return 10 * x**3 - 15 * x**4 + 6 * x**5, 30 * x**2 * (1 - x) ** 2, 60 * x * (1 - x) * (1 - 2 * x)


def _trapezoid(x, ramp=0.25):
    """A quarter of the time speeding up, a quarter slowing down, with short ramps of acceleration."""
    peak = 1 / (ramp * (1 - ramp))
    edge = 0.04
    dds = peak * (
        np.clip(x / edge, 0, 1)
        - np.clip((x - ramp + edge) / edge, 0, 1)
        - np.clip((x - 1 + ramp) / edge, 0, 1)
        + np.clip((x - 1 + edge) / edge, 0, 1)
    )
    dx = x[1] - x[0]
    ds = np.cumsum(dds) * dx
    s = np.cumsum(ds) * dx
    end = s[np.searchsorted(x, 1)] if x[-1] > 1 else s[-1]
    late = x > 1
    s, ds, dds = s / end, ds / end, dds / end
    return np.where(late, 1, s), np.where(late, 0, ds), np.where(late, 0, dds)
