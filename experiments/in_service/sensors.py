"""What is written down of a run: encoders, speeds, torque sensors and their noise, clocks and lost rows."""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from plant import Plan, Rigid, Run, account
from scipy.signal import lfilter


@dataclass
class Logger:
    """How the arm's torques and angles become columns; the same for every recording of a case."""

    fs: int
    q_std: float
    q_step: list[float]
    dq_mode: str  # difference | filtered | absent
    dq_std: float
    dq_lag: float
    colored: float
    color_tau: float
    wander: float
    heavy: bool
    torque_step: list[float]
    ringing: dict[
        int, tuple[float, float]
    ]  # joint [from 0] -> frequency [Hz], size in noise_std of the sensor
    jitter: bool
    missing: bool

    def public(self) -> dict:
        return asdict(self) | {"ringing": {j + 1: value for j, value in self.ringing.items()}}


def logger(arm, noise: np.ndarray, rng: np.random.Generator, sort: str) -> Logger:
    """`sort` of a control case may ask for coarse encoders, heavy tails or ringing."""
    fs = int(rng.choice([100, 125, 200, 250, 500, 1000], p=[0.1, 0.15, 0.2, 0.25, 0.2, 0.1]))
    small = arm.name in ("vx300", "small4")
    coarse = sort == "coarse encoders"
    bits = 12 if small else int(rng.integers(14, 16)) if coarse else int(rng.integers(17, 21))
    step = 2 * np.pi / 2**bits
    rings = {}
    if sort == "ringing" or rng.random() < 0.25:
        for j in rng.choice(arm.n, 2, replace=False):
            rings[int(j)] = (float(rng.uniform(10, min(40, fs / 3))), float(rng.uniform(0.6, 1.5)))
    return Logger(
        fs,
        float(rng.uniform(0.1, 1) * step),
        [float(step)] * arm.n,
        str(rng.choice(["difference", "filtered", "absent"], p=[0.3, 0.5, 0.2])),
        float(rng.uniform(0.5, 4) * 1e-3),
        float(rng.choice([0.002, 0.005, 0.01])),
        float(rng.uniform(0.1, 0.6)),
        float(rng.uniform(0.004, 0.04)),
        float(rng.uniform(0, 0.3)),
        sort == "heavy tails" or rng.random() < 0.1,
        [float(x) for x in noise * rng.choice([0.02, 0.2, 0.8])],
        rings,
        bool(fs < 1000 and rng.random() < 0.3),
        bool(rng.random() < 0.3),
    )


def torque_noise(log: Logger, noise: np.ndarray, samples: int, rng: np.random.Generator) -> np.ndarray:
    n = len(noise)
    draw = (
        (lambda: rng.standard_t(3, (samples, n)) / np.sqrt(3))
        if log.heavy
        else (lambda: rng.normal(size=(samples, n)))
    )
    pole = np.exp(-1 / (log.fs * log.color_tau))
    white = draw()
    colored = lfilter([np.sqrt(1 - pole**2)], [1, -pole], rng.normal(size=(samples, n)), axis=0)
    slow = np.zeros((samples, n))
    for seconds in (0.5, 2.0, 8.0):  # a sum of first-order lags falls nearly as 1/f
        p = np.exp(-1 / (log.fs * seconds))
        slow += lfilter([np.sqrt(1 - p**2)], [1, -p], rng.normal(size=(samples, n)), axis=0) / np.sqrt(3)
    total = np.sqrt(1 - log.colored) * white + np.sqrt(log.colored) * colored + log.wander * slow
    for j, (frequency, size) in log.ringing.items():
        w, zeta = 2 * np.pi * frequency / log.fs, 0.03
        r = np.exp(-zeta * w)
        mode = lfilter([1], [1, -2 * r * np.cos(w), r * r], rng.normal(size=samples))
        total[:, j] += size * mode / mode.std()
    return noise * total


def background(plan: Plan, run: Run, at: np.ndarray, tau: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Small things nobody names; `size` (4, n): ripple, load-dependent friction, warm-up, gain [N·m]."""
    theta, omega = run.theta[at], run.omega[at]
    way = np.tanh(omega / 0.02)
    load = np.abs(tau) / (np.abs(tau).mean(0) + 1e-9)
    age = np.exp(-(run.clock + run.t[at]) / 15)[:, None]
    scaled = tau / (np.sqrt(np.mean(tau**2, 0)) + 1e-9)
    return (
        size[0] * np.sin(np.array(plan.arm.gear) * theta)
        + size[1] * way * (load - 1)
        + size[2] * way * age
        + size[3] * scaled
    )


def measured(
    plan: Plan,
    log: Logger,
    run: Run,
    at: np.ndarray,
    recording: int,
    small: np.ndarray,
    rng: np.random.Generator,
):
    """(torque column, torque of the user's model, of every cause, what is left over) at the samples `at`.

    column = model + sum of causes + rest, to the rounding of the column. `rest`: noise and background.
    """
    base, parts = account(plan, run, at, recording)
    tau = run.tau[at]
    rest = torque_noise(log, plan.noise, len(at), rng) + background(plan, run, at, tau, small)
    rest += parts.pop("background", 0)
    signal = tau - parts_background(base, parts, tau)

    def put(name: str, now: np.ndarray) -> None:
        nonlocal signal
        parts[name] = now - signal
        signal = now

    if plan.delay:
        late = np.maximum(at - round(plan.delay / (run.t[1] - run.t[0])), 0)
        put("time_delay", signal + run.tau[late] - tau)
    if plan.gain is not None:
        now = signal * (1 + plan.gain)
        put("torque_gain", now if plan.limit is None else plan.limit * np.tanh(now / plan.limit))
    if plan.crosstalk is not None:
        put("torque_crosstalk", signal + signal @ plan.crosstalk.T)
    if plan.offset is not None:
        put("torque_offset", signal + plan.offset)
    if plan.drift is not None and recording >= 0:
        put(
            "torque_drift",
            signal + plan.drift[0] * (1 - np.exp(-(run.clock + run.t[at])[:, None] / plan.drift[1])),
        )
    step = np.array(log.torque_step)
    if plan.meaning and plan.meaning[0] != "mounting":
        kind, value = plan.meaning
        if kind == "gravity_removed":
            zero = np.zeros_like(tau)
            put(
                "torque_meaning",
                signal - Rigid(plan.arm, plan.phi_true, plan.gravity_true).torque(run.q[at], zero, zero),
            )
        elif kind == "joint_order":
            put("torque_meaning", signal[:, value])
            rest, step = rest[:, value], step[value]
        else:
            put("torque_meaning", signal * value)
            rest, step = rest * value, np.abs(step * value)
    column = np.round((signal + rest) / step) * step
    return column, base, parts, column - base - sum(parts.values())


def parts_background(base: np.ndarray, parts: dict[str, np.ndarray], tau: np.ndarray) -> np.ndarray:
    """The unnamed difference of links and level, which belongs to the rest and not to the signal."""
    return tau - base - sum(parts.values())


def samples(log: Logger, run: Run, rng: np.random.Generator) -> np.ndarray:
    """Which steps of the simulation are written down."""
    step = round(1 / (log.fs * (run.t[1] - run.t[0])))
    at = np.arange(0, len(run.t), step)
    if log.jitter:
        at = np.unique(np.clip(at + rng.integers(-(step // 4), step // 4 + 1, len(at)), 0, len(run.t) - 1))
    if log.missing:
        keep = rng.random(len(at)) > 0.004
        hole = int(rng.integers(len(at) // 4, 3 * len(at) // 4))
        keep[hole : hole + int(rng.uniform(0.02, 0.08) * log.fs)] = False
        at = at[keep]
    return at


def motion_columns(plan: Plan, log: Logger, run: Run, at: np.ndarray, rng: np.random.Generator):
    """(q, dq or None) as written down."""
    n = plan.arm.n
    true = run.theta if plan.encoder is None else run.theta + plan.encoder
    step = np.array(log.q_step)
    q = np.round((true[at] + rng.normal(0, log.q_std, (len(at), n))) / step) * step
    if log.dq_mode == "absent":
        return q, None
    if log.dq_mode == "difference":
        dq = (
            np.vstack([q[1] - q[0], np.diff(q, axis=0)])
            / np.diff(run.t[at], prepend=2 * run.t[at[0]] - run.t[at[1]])[:, None]
        )
        return q, lfilter([0.35], [1, -0.65], dq, axis=0, zi=0.65 * dq[:1])[0]
    p = np.exp(-(run.t[1] - run.t[0]) / log.dq_lag)
    smooth = lfilter([1 - p], [1, -p], run.omega, axis=0, zi=p * run.omega[:1])[0]
    return q, smooth[at] + rng.normal(0, log.dq_std, (len(at), n))


def write(path: Path, t: np.ndarray, q: np.ndarray, dq: np.ndarray | None, tau: np.ndarray | None) -> None:
    n = q.shape[1]
    blocks, names, form = [t[:, None]], ["time"], ["%.6f"]
    for name, block, digits in (("q", q, "%.7f"), ("dq", dq, "%.5f"), ("tau", tau, "%.7g")):
        if block is not None:
            blocks.append(block)
            names += [f"{name}_{j + 1}" for j in range(n)]
            form += [digits] * n
    np.savetxt(path, np.hstack(blocks), fmt=form, delimiter=",", header=",".join(names), comments="")
