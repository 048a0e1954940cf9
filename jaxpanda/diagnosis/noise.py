"""Noise of each joint's torque, from what a model with everything in it leaves.

The noise must not be read off the residual of the nominal model: what is slow in a missing effect would pass for
correlated noise, and hide it. A saturated fit (rigid body with free parameters, smooth functions of position,
velocity, load and time) takes any effect away first, as well as it can, at the price of its degrees of freedom.
"""

from collections.abc import Sequence

import numpy as np
import scipy.linalg
from jaxtyping import Float

from .traces import Trace

ORDER = 3


def hats(x: Float[np.ndarray, " _time"], count: int) -> Float[np.ndarray, "_time _count"]:
    """Piecewise linear functions on knots at equally many samples each; they add up to 1."""
    knots = np.unique(np.quantile(x, np.linspace(0, 1, count)))
    if len(knots) < 3:
        return np.ones((len(x), 1))
    return np.stack([np.interp(x, knots, e) for e in np.eye(len(knots))], 1)


def saturated_columns(
    traces: Sequence[Trace], joint: int, extra: Sequence[Float[np.ndarray, "_time _n"]]
) -> Float[np.ndarray, "_rows _n"]:
    """Columns of the saturated model in a joint of all recordings, one below the other, zero in their gaps."""

    def stacked(part) -> np.ndarray:
        return np.concatenate([np.asarray(part(trace)) for trace in traces])

    Q, s, _ = np.linalg.svd(stacked(lambda t: t.motion.regressor[:, joint]), full_matrices=False)
    rigid = Q[:, s > 1e-7 * s[0]]
    q, qd = stacked(lambda t: t.motion.q[:, joint]), stacked(lambda t: t.motion.qd[:, joint])
    load = stacked(lambda t: t.motion.load[:, joint])
    sign = stacked(lambda t: t.down(np.tanh(np.asarray(t.channels.qd[:, joint]) / 0.01)))
    rates = [np.gradient(t.motion.load[:, joint], t.motion.dt) for t in traces]
    bends = [np.gradient(rate, t.motion.dt) for rate, t in zip(rates, traces, strict=True)]
    swings = np.stack([np.concatenate(rates), np.concatenate(bends)], 1)
    speed = hats(np.abs(qd), 8)
    clock = scipy.linalg.block_diag(*[hats(t.motion.time, 10) for t in traces])
    shaken = stacked(lambda t: t.shaken[:, joint])
    smooth = [rigid, shaken, hats(q, 10), speed, hats(load, 5), swings, clock]
    rough = [sign[:, None] * x for x in (speed, hats(q, 4), hats(load, 3), clock[:, ::2])]
    A = np.concatenate([*smooth, *rough, *([np.concatenate(list(extra))] if extra else [])], 1)
    return A * np.concatenate([t.weights[:, joint] for t in traces])[:, None]


def saturated_residual(
    traces: Sequence[Trace],
    residual: Sequence[Float[np.ndarray, "_time dof"]],
    joint: int,
    extra: Sequence[Float[np.ndarray, "_time _n"]],
) -> tuple[list[Float[np.ndarray, " _time"]], int]:
    """What the saturated model leaves in a joint of each recording, and its degrees of freedom."""
    U, s, _ = np.linalg.svd(saturated_columns(traces, joint, extra), full_matrices=False)
    U = U[:, s > 1e-6 * s[0]]
    r = np.concatenate([x[:, joint] * t.weights[:, joint] for x, t in zip(residual, traces, strict=True)])
    left = r - U @ (U.T @ r)
    return np.split(left, np.cumsum([t.motion.samples for t in traces])[:-1]), U.shape[1]


def strongest_order(
    q: Sequence[Float[np.ndarray, " _time"]], left: Sequence[Float[np.ndarray, " _time"]]
) -> list[Float[np.ndarray, "_time 4"]]:
    """The order of position that takes most out of a residual, with its second harmonic, as columns."""
    travel = max(float(np.ptp(x)) for x in q)
    orders = np.arange(4.0, 300.0, np.pi / (2 * max(travel, 0.3)))
    power = np.zeros(len(orders))
    for part in np.array_split(np.arange(len(orders)), 8):
        waves = sum(r @ np.exp(1j * np.outer(x, orders[part])) for x, r in zip(q, left, strict=True))
        power[part] = np.abs(waves)
    n = orders[power.argmax()]
    return [np.stack([np.sin(n * x), np.cos(n * x), np.sin(2 * n * x), np.cos(2 * n * x)], 1) for x in q]


def autoregression(
    parts: Sequence[Float[np.ndarray, " _time"]], used: int
) -> tuple[np.ndarray, float, float]:
    """Coefficients, deviation of the innovations, and deviation of the noise, by least squares."""
    past = np.concatenate(
        [np.stack([p[ORDER - 1 - k : len(p) - 1 - k] for k in range(ORDER)], 1) for p in parts]
    )
    now = np.concatenate([p[ORDER:] for p in parts])
    ridge = 1e-6 * max(float(now @ now), 1e-12) * np.eye(ORDER)
    a = np.linalg.solve(past.T @ past + ridge, past.T @ now)
    innovation = now - past @ a
    freedom = max(len(now) - used - ORDER, len(now) // 4)
    sigma = float(np.sqrt(innovation @ innovation / freedom))
    return a, max(sigma, 1e-9), float(np.sqrt(now @ now / freedom))
