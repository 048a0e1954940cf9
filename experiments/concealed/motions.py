"""Motions that a user would record: excitation, picking, slow and fast, small reversals, and too little."""

import numpy as np
from arm import HOME, LIMITS, N

FAMILIES = ("fourier", "pick", "mixed", "micro")
STEP = 0.001  # [s] of the simulation
LEAD = 0.6  # [s] moved before the recording starts
_MARGIN = 60  # steps cut off at either end, where derivatives and averages are one-sided
_REACH = np.array([0.8, 0.5, 0.8, 0.5, 0.9, 0.6, 0.9])


def _fourier(rng, t, peak, reach):
    period = rng.uniform(0.7, 1.3) * (t[-1] - t[0])
    harmonics = np.arange(1, 6)
    q = np.empty((len(t), N))
    for j in range(N):
        a, b = rng.standard_normal((2, 5)) / harmonics**0.7
        phase = 2 * np.pi * np.outer(t, harmonics) / period
        wave = np.sin(phase) @ a + np.cos(phase) @ b
        wave -= wave.mean()
        speed = np.max(np.abs(np.gradient(wave, t)))
        q[:, j] = wave * min(peak / speed, reach[j] / np.max(np.abs(wave)))
    return q


def _legs(rng, t, legs):
    """Minimum-jerk legs through points; `legs` draws (duration, dwell, target)."""
    q = np.empty((len(t), N))
    start, here, k = t[0] - rng.uniform(0, 1), legs(0)[2], 1
    while start < t[-1] + 1:
        seconds, dwell, there = legs(k)
        s = np.clip((t - start) / seconds, 0, 1)
        inside = (t >= start) & (t <= start + seconds + dwell)
        shape = s**3 * (10 - 15 * s + 6 * s * s)
        q[inside] = here + shape[inside, None] * (there - here)
        start, here, k = start + seconds + dwell, there, k + 1
    return q


def _pick(rng, t):
    reach = _REACH * rng.uniform(0.5, 1.0)
    pace = rng.uniform(0.7, 1.2)
    return _legs(
        rng, t, lambda k: (pace * rng.uniform(0.8, 2.2), rng.uniform(0.2, 0.7), rng.uniform(-1, 1, N) * reach)
    )


def _mixed(rng, t):
    reach = _REACH * rng.uniform(0.5, 0.9)
    last = [rng.uniform(-1, 1, N) * reach]

    def leg(k):
        if k % 2:
            target = np.clip(last[0] + rng.uniform(-0.35, 0.35, N), -reach, reach)
            seconds, dwell = rng.uniform(2, 4), 0.0
        else:
            target = rng.uniform(-1, 1, N) * reach
            seconds, dwell = rng.uniform(0.8, 1.4), rng.uniform(0.0, 0.4)
        last[0] = target
        return seconds, dwell, target

    return _legs(rng, t, leg)


def _micro(rng, t):
    q = _fourier(rng, t, rng.uniform(0.2, 0.45), _REACH)
    swing = np.exp(rng.uniform(np.log(0.004), np.log(0.03), N))
    hertz = rng.uniform(0.5, 1.6, N)
    envelope = 0.5 - 0.5 * np.cos(2 * np.pi * t[:, None] * rng.uniform(0.1, 0.25, N) + rng.uniform(0, 6, N))
    return q + swing * envelope * np.sin(2 * np.pi * hertz * t[:, None] + rng.uniform(0, 6, N))


def desired(rng, family, seconds):
    """Joint positions [rad] at every step, from LEAD before the start to `seconds`, and two derivatives."""
    t = np.arange(-int(LEAD / STEP) - _MARGIN, int(seconds / STEP) + 1 + _MARGIN) * STEP
    if family == "fourier":
        q = _fourier(rng, t, rng.uniform(0.6, 1.6), _REACH)
    elif family == "pick":
        q = _pick(rng, t)
    elif family == "mixed":
        q = _mixed(rng, t)
    elif family == "micro":
        q = _micro(rng, t)
    else:
        q = _fourier(rng, t, 0.3, np.full(N, 0.12))
    q += HOME + rng.uniform(-0.25, 0.25, N) * np.array([1, 0.5, 1, 0.5, 1, 0.5, 1])
    assert np.all((q > LIMITS[:, 0]) & (q < LIMITS[:, 1]))
    q = _rounded(q)
    v = np.gradient(q, STEP, axis=0)
    a = np.gradient(v, STEP, axis=0)
    return tuple(x[_MARGIN:-_MARGIN] for x in (t, q, v, a))


def _rounded(q):
    """A short moving average: no steps in acceleration where legs meet."""
    width = 25
    padded = np.pad(q, ((width, width), (0, 0)), mode="edge")
    sums = np.cumsum(np.vstack([np.zeros(N), padded]), axis=0)
    for _ in range(2):
        smooth = (sums[width:] - sums[:-width]) / width
        sums = np.cumsum(np.vstack([np.zeros(N), smooth]), axis=0)
    smooth = sums[1:] - sums[:-1]
    offset = (len(smooth) - len(q)) // 2
    return smooth[offset : offset + len(q)]
