"""What encoders, torque sensors and loggers make of clean signals."""

from dataclasses import dataclass, replace

import numpy as np
from plant import DT
from scipy.interpolate import CubicSpline
from scipy.signal import butter, lfilter, sosfiltfilt


@dataclass(frozen=True)
class Sensors:
    fs: int  # [Hz]
    q_std: float  # [rad]
    q_step: float  # [rad], 0 for none
    dq_mode: str  # difference | filtered | none
    dq_cut: float  # [Hz], of the vendor's filter
    colored: float  # share of the torque noise that is coloured
    color_tau: float  # [s]
    tails: float = 0.0  # degrees of freedom of Student's t, 0 for Gaussian
    spikes: float = 0.0  # [1/s]
    spike_size: float = 0.0  # in torque noise
    walk: float = 0.0  # random-walk bias after 10 s, in torque noise
    jitter: float = 0.0  # of the sampling instants, share of the period
    stamp_jitter: float = 0.0  # [s], of the stamps themselves
    missing: float = 0.0  # share of the rows
    gap: float = 0.0  # [s], one hole in a recording


def draw_sensors(rng: np.random.Generator, clean: bool = False) -> Sensors:
    """Sensors of some lab. `clean` leaves out tails, spikes, walks and gaps, not noise."""
    mode = rng.choice(["difference", "filtered", "none"], p=[0.3, 0.5, 0.2])
    s = Sensors(
        fs=int(
            rng.choice(
                [50, 100, 125, 200, 250, 400, 500, 1000], p=[0.07, 0.2, 0.2, 0.1, 0.2, 0.06, 0.12, 0.05]
            )
        ),
        q_std=float(np.exp(rng.uniform(np.log(2e-6), np.log(4e-5)))),
        q_step=float(rng.choice([0.0, 2 * np.pi / 2**20, 2 * np.pi / 2**18, 2 * np.pi / 2**16])),
        dq_mode=str(mode),
        dq_cut=float(rng.uniform(10, 30)) if mode == "filtered" else 0.0,
        colored=float(rng.uniform(0, 0.6)),
        color_tau=float(np.exp(rng.uniform(np.log(0.003), np.log(0.08)))),
        jitter=float(rng.choice([0.0, 0.3], p=[0.75, 0.25])),
        stamp_jitter=float(rng.choice([0.0, 2e-5, 1e-4], p=[0.6, 0.3, 0.1])),
        missing=float(rng.choice([0.0, 0.005, 0.03], p=[0.75, 0.15, 0.1])),
    )
    if clean:
        return s
    return replace(
        s,
        tails=float(rng.choice([0.0, 3.0, 5.0], p=[0.85, 0.08, 0.07])),
        spikes=float(rng.choice([0.0, 0.2, 1.0], p=[0.85, 0.1, 0.05])),
        spike_size=float(rng.uniform(8, 40)),
        gap=float(rng.choice([0.0, 1.5, 3.0], p=[0.88, 0.08, 0.04])),
    )


def rows_of(s: Sensors, rng: np.random.Generator, count: int, holes: bool) -> np.ndarray:
    """Grid indices at which the logger writes a row."""
    step = round(1 / (s.fs * DT))
    index = np.arange(0, count, step)
    if s.jitter and step > 3:
        wide = int(s.jitter * step)
        index = np.clip(index + rng.integers(-wide, wide + 1, len(index)), 0, count - 1)
    keep = rng.random(len(index)) >= s.missing
    if holes and s.gap:
        begin = rng.uniform(0.25, 0.6) * count
        keep &= ~((index > begin) & (index < begin + s.gap / DT))
    return np.unique(index[keep])


def encoder(s: Sensors, rng: np.random.Generator, q: np.ndarray) -> np.ndarray:
    q = q + s.q_std * rng.standard_normal(q.shape)
    return np.round(q / s.q_step) * s.q_step if s.q_step else q


def velocity(s: Sensors, q: np.ndarray, rows: np.ndarray, t: np.ndarray) -> np.ndarray | None:
    """dq as the vendor writes it: of the rows, or filtered at the controller's own rate, with its lag."""
    if s.dq_mode == "none":
        return None
    if s.dq_mode == "difference":
        x = q[rows]
        d = np.diff(x, axis=0) / np.diff(t)[:, None]
        return np.concatenate([d[:1], d])
    rate = np.diff(q, axis=0, prepend=q[:1]) / DT
    b, a = butter(1, s.dq_cut, fs=1 / DT)
    for _ in range(2):
        rate = lfilter(b, a, rate, axis=0)
    return rate[rows]


def torque_noise(s: Sensors, rng: np.random.Generator, t: np.ndarray, std: np.ndarray) -> np.ndarray:
    """White and coloured noise of total deviation `std`, then spikes and a random walk on top."""
    count, n = len(t), len(std)
    white = rng.standard_normal((count, n))
    if s.tails:
        white = rng.standard_t(s.tails, (count, n)) / np.sqrt(s.tails / (s.tails - 2))
    pole = np.exp(-1 / (s.fs * s.color_tau))
    drive = rng.standard_normal((count, n)) * np.sqrt(1 - pole**2)
    slow = lfilter([1.0], [1.0, -pole], drive, axis=0)
    noise = np.sqrt(1 - s.colored) * white + np.sqrt(s.colored) * slow
    hit = rng.random((count, n)) < s.spikes / s.fs
    noise += hit * rng.choice([-1, 1], (count, n)) * s.spike_size * rng.uniform(0.5, 1.5, (count, n))
    if s.walk:
        steps = rng.standard_normal((count, n)) * np.sqrt(np.diff(t, prepend=t[0]) / 10.0)[:, None]
        noise += s.walk * np.cumsum(steps, axis=0)
    return noise * std


CUTS = (2.5, 5.0, 10.0, 20.0, 40.0)  # [Hz]


def smooth(t: np.ndarray, q: np.ndarray, cut: float):
    """q, qd, qdd at the rows: cubic resampling, zero-phase Butterworth, derivatives of a spline."""
    period = np.median(np.diff(t))
    even = np.arange(t[0], t[-1] + 0.5 * period, period)
    x = (
        CubicSpline(t, q)(even)
        if np.max(np.diff(t)) < 3 * period
        else np.stack([np.interp(even, t, column) for column in q.T], 1)
    )
    if cut < 0.45 / period:
        sos = butter(3, cut, fs=1 / period, output="sos")
        x = sosfiltfilt(sos, x, axis=0, padlen=min(len(x) - 1, int(1.5 / (cut * period))))
    spline = CubicSpline(even, x)
    inside = np.clip(t, even[0], even[-1])
    return spline(inside), spline(inside, 1), spline(inside, 2)


def usable(t: np.ndarray, edge: float = 0.3) -> np.ndarray:
    """Rows away from both ends and from holes in the recording."""
    holes = np.flatnonzero(np.diff(t) > 0.2)
    keep = (t > t[0] + edge) & (t < t[-1] - edge)
    for k in holes:
        keep &= (t < t[k] - edge) | (t > t[k + 1] + edge)
    return keep
