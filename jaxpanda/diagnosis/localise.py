r"""Where the difference between model and recordings lies: by joint, time, regime, order and lag.

Everything is tested on whitened residuals, so that noise which is correlated from sample to sample does not pass
for structure, and on what is left once the nuisance and the accepted terms are projected out. A set of columns
$\Phi$ in a joint (say, a bin of velocity each) is tested by

$$T = b^\top G^{+} b \sim \chi^2_{rank\,G}$$

with b and G of `evidence`: the score test, which holds whatever the nuisance turns out to be.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.ndimage
import scipy.signal
import scipy.special
import scipy.stats
from jaxtyping import Float

from ..effects import SIGN_WIDTH, least_order
from ..inference.evidence import Design, Noise
from ..inference.problem import Problem, Term
from ..traces import Trace

ALARM = 0.01
"""Probability that noise alone shows anything at all in one kind of test, all joints together."""
REGIMES = {
    "level": "the same everywhere: an offset",
    "direction": "the sign of the velocity",
    "speed, odd": "speed, with the sign of the velocity: friction",
    "speed, even": "speed, whatever its sign",
    "position": "joint position",
    "acceleration": "joint acceleration",
    "load": "torque that the joint carries",
    "load, odd": "load, with the sign of the velocity",
    "reversals": "distance since the last reversal, with the sign of the velocity",
    "time": "time",
    "time, odd": "time, with the sign of the velocity: warming up",
}
"""What a residual is binned by, and what that means."""
_LAGS = np.linspace(-0.1, 0.1, 41)
_NARROWEST = 5
"""Samples of the narrowest window in the search for change points."""
_MOST_WINDOWS = 6
_SIMULATED, _ITERATIONS, _SETTLE = 8, 3, 50


@dataclasses.dataclass(frozen=True)
class Regime:
    """How much of a joint's residual goes with one regime."""

    joint: int
    name: str
    share: float
    """Of the whitened residual's variance, what noise would give taken off."""
    p: float
    """Probability that noise alone gives as much."""
    beyond: bool
    """Whether that is beyond noise, all regimes and joints taken together."""


@dataclasses.dataclass(frozen=True)
class Change:
    """An instant at which the residual of a joint changes."""

    joint: int
    recording: str
    time: float
    kind: str
    """Of its "level" or of its "spread"."""
    z: float
    """Deviations by which the stretch on one side of it stands out."""


@dataclasses.dataclass(frozen=True)
class Order:
    """The strongest order of joint position in a joint's residual."""

    joint: int
    order: float
    """Periods in one turn of the joint."""
    amplitude: float
    """[N m]"""
    p: float
    beyond: bool


@dataclasses.dataclass(frozen=True)
class Lag:
    """By how much the torque of one joint is late on the model's."""

    joint: int
    lag: float
    """[s]"""
    std: float | None
    """None where the likeliest lies beyond the lags that were tried, of which `lag` is the last."""
    p: float
    beyond: bool


@dataclasses.dataclass(frozen=True)
class Localisation:
    """What stands out of noise, in every joint."""

    regimes: tuple[Regime, ...]
    changes: tuple[Change, ...]
    orders: tuple[Order, ...]
    lags: tuple[Lag, ...]
    samples: int
    effective_samples: Float[np.ndarray, " dof"]
    """Independent samples that would say as much of a mean as the correlated ones do."""

    @property
    def beyond_noise(self) -> bool:
        """Whether anything stands out."""
        tests = (*self.regimes, *self.orders, *self.lags)
        return bool(self.changes) or any(one.beyond for one in tests)

    def to_json(self) -> dict[str, Any]:
        """Joints 1-based."""
        document: dict[str, Any] = {
            "samples": self.samples,
            "effective_samples": [float(v) for v in self.effective_samples],
        }
        for name in ("regimes", "changes", "orders", "lags"):
            rows = [dataclasses.asdict(one) for one in getattr(self, name)]
            document[name] = [{**row, "joint": row["joint"] + 1} for row in rows]
        return document


def localise(problem: Problem, design: Design, noise: Noise) -> Localisation:
    """What stands out of the noise in what a model leaves."""
    regimes, orders, lags = [], [], []
    kinds = len(REGIMES) * problem.dof
    for j in range(problem.dof):
        regimes += [
            dataclasses.replace(one, beyond=one.p < ALARM / kinds)
            for one in _regimes(problem, design, noise, j)
        ]
        orders += _order(problem, design, noise, j)
        lags.append(_lag(problem, design, noise, j))
    n = sum(int(t.weight.sum()) for t in problem.traces)
    spectrum = noise.sigma**2 / (1 - noise.a.sum(1)) ** 2
    return Localisation(
        tuple(regimes),
        tuple(_changes(problem, design, noise)),
        tuple(orders),
        tuple(lags),
        n,
        n * np.minimum(noise.std**2 / spectrum, 1.0),
    )


def unbiased(problem: Problem, terms: Sequence[Term], noise: Noise) -> Noise:
    r"""The noise with what the saturated model took out of it put back.

    A model with a hundred columns takes slow noise with it, and an autoregression fitted to what is left holds
    slow structure for less likely than it is. Noise with the estimated spectrum is put through the same model:
    what its autocovariances lose there is added to those estimated, until both agree:
    $\gamma \leftarrow \hat\gamma + \gamma_{sim} - \gamma_{sim}'$.
    """
    a, sigma, std = np.empty_like(noise.a), np.empty_like(noise.sigma), np.empty_like(noise.std)
    rng, order = np.random.default_rng(0), noise.a.shape[1]
    ends = np.cumsum([t.motion.samples for t in problem.traces])[:-1]
    weights = np.concatenate([t.weights for t in problem.traces])

    def autocovariances(x: np.ndarray) -> np.ndarray:
        """Means over the samples that count, of lags 0 to the order."""
        parts = np.split(x, ends)
        return sum(
            np.stack([np.sum(p[: len(p) - k] * p[k:], 0).mean() for k in range(order + 1)]) for p in parts
        ) / max(weights[:, j].sum(), 1.0)

    for j in range(problem.dof):
        if not weights[:, j].any():
            a[j], sigma[j], std[j] = noise.a[j], noise.sigma[j], noise.std[j]
            continue
        here = [t for t in terms if any(np.any(c[:, j]) for c in t.columns)]
        extra = [
            np.concatenate([problem.saturation.ripples[j][r], *(t.columns[r][:, j] for t in here)], 1)
            for r in range(len(problem.traces))
        ]
        A = problem.saturation.columns(j, extra)
        A = A / np.maximum(np.sqrt((A**2).sum(0)), 1e-12)
        values, vectors = np.linalg.eigh(A.T @ A)
        kept = values > 1e-9 * values[-1]
        U = A @ (vectors[:, kept] / np.sqrt(values[kept]))
        r = np.concatenate([x[:, j] for x in problem.residual]) * weights[:, j]
        measured = autocovariances((r - U @ (U.T @ r))[:, None])
        e = rng.normal(size=(len(r) + _SETTLE, _SIMULATED))
        gamma = measured
        for _ in range(_ITERATIONS):
            a[j], sigma[j] = _yule_walker(gamma)
            b = np.concatenate([[1.0], -a[j]])
            x = np.asarray(scipy.signal.lfilter([sigma[j]], b, e, axis=0))[_SETTLE:] * weights[:, j, None]
            gamma = measured + autocovariances(x) - autocovariances(x - U @ (U.T @ x))
        a[j], sigma[j] = _yule_walker(gamma)
        std[j] = np.sqrt(gamma[0])
    return Noise(a, sigma, std)


def _yule_walker(gamma: Float[np.ndarray, " lags"]) -> tuple[Float[np.ndarray, " order"], float]:
    order = len(gamma) - 1
    lags = np.abs(np.subtract.outer(np.arange(order), np.arange(order)))
    a = np.linalg.solve(gamma[lags] + 1e-9 * gamma[0] * np.eye(order), gamma[1:])
    return a, float(np.sqrt(max(gamma[0] - a @ gamma[1:], 1e-18)))


def whitened_residual(problem: Problem, design: Design, joint: int) -> list[Float[np.ndarray, " _time"]]:
    """What a model leaves in a joint of each recording, in deviations of its innovations."""
    left = design.left[joint]
    return np.split(left, np.cumsum([t.motion.samples for t in problem.traces])[:-1])


def hats(x: Float[np.ndarray, " _time"], count: int) -> Float[np.ndarray, "_time _count"]:
    """Piecewise linear bins between the quantiles of x: together they are 1."""
    low, high = np.quantile(x, (0.01, 0.99))
    knots = 0.5 * np.linspace(low, high, count) + 0.5 * np.quantile(x, np.linspace(0.01, 0.99, count))
    knots = np.unique(knots)
    if len(knots) < 2 or high - low < 1e-9:
        return np.ones((len(x), 1))
    return np.stack([np.interp(x, knots, e) for e in np.eye(len(knots))], 1)


def since_reversal(trace: Trace, joint: int) -> Float[np.ndarray, " time"]:
    """Distance from where the joint last turned round [rad]; large before its first reversal."""
    q, qd = trace.motion.q[:, joint], trace.motion.qd[:, joint]
    moving = np.abs(qd) > 0.02 * np.sqrt(np.mean(qd**2) + 1e-12)
    sign = np.sign(qd) * moving
    held = np.maximum.accumulate(np.where(sign != 0, np.arange(len(q)), 0))
    sign = sign[held]
    turned = np.flatnonzero(np.diff(sign) != 0) + 1
    last = np.zeros(len(q), int)
    last[turned] = turned
    last = np.maximum.accumulate(last)
    away = np.abs(q - q[last])
    away[last == 0] = np.ptp(q) + 1.0
    return away


def _regimes(problem: Problem, design: Design, noise: Noise, joint: int) -> list[Regime]:
    traces = problem.traces

    def binned(part, count):
        parts = [part(t) for t in traces]
        return np.split(hats(np.concatenate(parts), count), np.cumsum([len(p) for p in parts])[:-1])

    sign = [t.down(np.tanh(np.asarray(t.channels.qd[:, joint]) / SIGN_WIDTH))[:, None] for t in traces]
    speed = binned(lambda t: np.abs(t.motion.qd[:, joint]), 6)
    load = binned(lambda t: t.motion.load[:, joint], 6)
    carried = binned(lambda t: np.abs(t.motion.load[:, joint]), 4)
    clock = binned(lambda t: t.motion.time, 8)
    warm = binned(lambda t: t.motion.time, 4)
    near = [np.exp(-since_reversal(t, joint)[:, None] / np.array([0.003, 0.01, 0.03, 0.1])) for t in traces]
    columns = {
        "level": [np.ones((t.motion.samples, 1)) for t in traces],
        "direction": sign,
        "speed, odd": [s * x for s, x in zip(sign, speed, strict=True)],
        "speed, even": speed,
        "position": binned(lambda t: t.motion.q[:, joint], 10),
        "acceleration": binned(lambda t: t.motion.qdd[:, joint], 6),
        "load": load,
        "load, odd": [s * x for s, x in zip(sign, carried, strict=True)],
        "reversals": [s * x for s, x in zip(sign, near, strict=True)],
        "time": clock,
        "time, odd": [s * x for s, x in zip(sign, warm, strict=True)],
    }
    widths = np.cumsum([0, *(c[0].shape[1] for c in columns.values())])
    together = [np.concatenate([c[r] for c in columns.values()], 1) for r in range(len(traces))]
    Phi = problem.whitened(together, noise, joint)
    b, G = design.in_joint(joint, Phi[:, None], (Phi.T @ Phi)[None])
    b, G = b[0], G[0]
    total = float(sum(e @ e for e in whitened_residual(problem, design, joint)))
    size = np.diag(Phi.T @ Phi)
    out = []
    for place, name in enumerate(columns):
        own = range(int(widths[place]), int(widths[place + 1]))
        beside = [] if name == "level" else [0]
        T, rank = _score(b, G, size, [*beside, *own])
        T0, rank0 = _score(b, G, size, beside) if beside else (0.0, 0)
        T, rank = max(T - T0, 0.0), max(rank - rank0, 1)
        out.append(
            Regime(
                joint,
                name,
                float(np.clip((T - rank) / max(total, 1e-12), 0.0, 1.0)),
                float(scipy.stats.chi2.sf(T, rank)),
                False,
            )
        )
    return out


def _score(b: np.ndarray, G: np.ndarray, size: np.ndarray, at: Sequence[int]) -> tuple[float, int]:
    """$b^\\top G^+ b$ and its degrees of freedom; columns that the nuisance has absorbed do not count."""
    scale = 1 / np.sqrt(np.maximum(size[at], 1e-300))
    values, vectors = np.linalg.eigh(scale[:, None] * G[np.ix_(at, at)] * scale)
    kept = values > 1e-6
    y = vectors[:, kept].T @ (scale * b[at])
    return float(np.sum(y**2 / values[kept])), int(kept.sum())


def order_spectrum(
    problem: Problem, design: Design, noise: Noise, joint: int
) -> tuple[Float[np.ndarray, " orders"], Float[np.ndarray, " orders"], Float[np.ndarray, " orders"]]:
    r"""Orders of position, their $\chi^2_2$ over the local floor, and their amplitude [N m].

    The floor is what is left of the spectrum without its strongest order: what leaks from one order into others,
    or is spread over all of them, is no order.
    """
    q = [t.motion.q[:, joint] for t in problem.traces]
    qd = [t.motion.qd[:, joint] for t in problem.traces]
    travel = max(float(np.ptp(x)) for x in q)
    speed = float(np.sqrt(np.mean(np.concatenate(qd) ** 2)))
    if travel < 0.1 or speed < 0.02:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    highest = min(400.0, 2 * np.pi * 0.9 * problem.traces[0].cutoff / speed)
    step = np.pi / (2 * travel)
    orders = step * np.arange(np.ceil(least_order(travel) / step), highest / step)
    if len(orders) < 8:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    moving = [
        (np.abs(v) > 0.1 * speed) * t.weights[:, joint] for v, t in zip(qd, problem.traces, strict=True)
    ]
    left = [m * e for m, e in zip(moving, whitened_residual(problem, design, joint), strict=True)]

    a = noise.a[joint]
    steps = [np.abs(v[m > 0]) * t.motion.dt for v, m, t in zip(qd, moving, problem.traces, strict=True)]
    counts, edges = np.histogram(np.concatenate(steps), 48)
    w = np.outer(orders, 0.5 * (edges[:-1] + edges[1:]))
    gain = np.abs(1 - sum(a[k] * np.exp(-1j * (k + 1) * w) for k in range(len(a)))) ** 2
    power = 0.5 * (gain @ counts) / noise.sigma[joint] ** 2

    wave = _angular(q, left, noise, joint, orders, step)
    n = orders[(np.abs(wave) ** 2 / power).argmax()]
    waves = [np.stack([np.sin(n * x), np.cos(n * x), np.sin(2 * n * x), np.cos(2 * n * x)], 1) for x in q]
    rows = np.concatenate(moving)
    Phi, e = problem.whitened(waves, noise, joint) * rows[:, None], np.concatenate(left)
    e = e - Phi @ np.linalg.lstsq(Phi, e, rcond=1e-9)[0]
    rest = np.split(e, np.cumsum([len(x) for x in q])[:-1])
    floor = np.abs(_angular(q, rest, noise, joint, orders, step)) ** 2 / power / (2 * np.log(2))
    floor = scipy.ndimage.median_filter(floor, min(61, len(floor)), mode="nearest")
    return orders, np.abs(wave) ** 2 / power / np.maximum(floor, 1.0), np.abs(wave) / power


def _angular(
    q: Sequence[Float[np.ndarray, " _time"]],
    e: Sequence[Float[np.ndarray, " _time"]],
    noise: Noise,
    joint: int,
    orders: Float[np.ndarray, " orders"],
    step: float,
) -> np.ndarray:
    r"""Angular periodogram $\sum_t v_t e^{i n q_t}$ at multiples of `step`, by bins of position.

    $v = W^\top e$ is the residual whitened twice. Its variance is that of the noise at the frequencies
    $n\,\dot q/2\pi$ at which the order was passed.
    """
    bins = int(2 ** np.ceil(np.log2(8 * orders[-1] / step)))
    grid, a = np.zeros(bins), noise.a[joint]
    for x, part in zip(q, e, strict=True):
        twice = part.copy()
        for k in range(len(a)):
            twice[: -k - 1] -= a[k] * part[k + 1 :]
        place = (x - q[0][0]) * step / (2 * np.pi) * bins
        left = np.floor(place).astype(int)
        share = place - left
        np.add.at(grid, left % bins, (1 - share) * twice)
        np.add.at(grid, (left + 1) % bins, share * twice)
    return np.fft.rfft(grid)[np.round(orders / step).astype(int)] / noise.sigma[joint]


def _order(problem: Problem, design: Design, noise: Noise, joint: int) -> list[Order]:
    orders, T, amplitude = order_spectrum(problem, design, noise, joint)
    if not len(orders):
        return []
    top = int(T.argmax())
    p = float(min(1.0, 2 * len(orders) * np.exp(-T[top] / 2)))
    return [Order(joint, float(orders[top]), float(amplitude[top]), p, p < ALARM / problem.dof)]


def lag_profile(
    problem: Problem, design: Design, noise: Noise, joint: int
) -> tuple[Float[np.ndarray, " lags"], Float[np.ndarray, " lags"]]:
    """Lags of a joint's torque [s], and what the log likelihood of the residual gains by each."""
    columns = []
    for trace, on in zip(problem.traces, problem.active, strict=True):
        torque, time = trace.motion.torque_shown[:, joint], trace.motion.time
        late = [np.interp(time - d, time, torque) - torque for d in _LAGS]
        columns.append(np.stack(late, 1) * on)
    Phi = problem.whitened(columns, noise, joint)[:, :, None]
    b, G = design.in_joint(joint, Phi, np.einsum("tmn,tmn->m", Phi, Phi)[:, None, None])
    return _LAGS, b[:, 0] - 0.5 * G[:, 0, 0]


def _lag(problem: Problem, design: Design, noise: Noise, joint: int) -> Lag:
    """The likeliest lag, by a parabola through the best of the profile where that is inside."""
    lags, gain = lag_profile(problem, design, noise, joint)
    k = int(gain.argmax())
    if k in (0, len(lags) - 1):
        p = float(scipy.stats.chi2.sf(max(2 * float(gain[k]), 0.0), 1))
        return Lag(joint, float(lags[k]), None, p, p < ALARM / problem.dof)
    step = lags[1] - lags[0]
    bend = gain[k - 1] - 2 * gain[k] + gain[k + 1]
    slope = 0.5 * (gain[k + 1] - gain[k - 1])
    bend = min(bend, -1e-12)
    shift = float(np.clip(-slope / bend, -1.0, 1.0))
    top = float(gain[k] + slope * shift + 0.5 * bend * shift**2)
    p = float(scipy.stats.chi2.sf(max(2 * top, 0.0), 1))
    return Lag(joint, float(lags[k] + shift * step), float(step / np.sqrt(-bend)), p, p < ALARM / problem.dof)


def _changes(problem: Problem, design: Design, noise: Noise) -> list[Change]:
    out = []
    tests = 2 * problem.dof * len(problem.traces)
    for j in range(problem.dof):
        for trace, e in zip(problem.traces, whitened_residual(problem, design, j), strict=True):
            rows = np.flatnonzero(trace.weight > 0)
            rows = rows[rows >= noise.a.shape[1]]
            for kind, x in (("level", e[rows]), ("spread", np.abs(e[rows]))):
                for k, z in change_points(x, ALARM / tests):
                    out.append(Change(j, trace.name, float(trace.motion.time[rows[k]]), kind, z))
    return sorted(out, key=lambda c: (c.joint, c.recording, c.time))


def change_points(x: Float[np.ndarray, " samples"], alarm: float) -> list[tuple[int, float]]:
    """Where the level of independent samples changes, and by how many deviations a stretch stands out.

    Stretches of all widths are compared with the rest by their ranks, so that nothing but independence is
    assumed; the one that stands out most is cut out while noise would give one like it with a probability below
    `alarm`, and its parts are searched in turn (circular binary segmentation, Olshen et al. 2004).
    """
    found: dict[int, float] = {}
    parts, windows = [(0, len(x))], 0
    while parts and windows < _MOST_WINDOWS:
        first, last = parts.pop(0)
        best = _stretch(x[first:last], alarm)
        if best is None:
            continue
        start, stop, z = best
        windows += 1
        for k in (start, stop):
            if 0 < k < last - first:
                found[first + k] = max(abs(z), abs(found.get(first + k, 0.0))) * np.sign(z)
        parts += [(first, first + start), (first + start, first + stop), (first + stop, last)]
    return sorted((k, float(z)) for k, z in found.items())


def _stretch(x: Float[np.ndarray, " samples"], alarm: float) -> tuple[int, int, float] | None:
    n = len(x)
    if n < 4 * _NARROWEST or np.ptp(x) == 0:
        return None
    scores = scipy.special.ndtri((scipy.stats.rankdata(x) - 0.5) / n)
    sums = np.concatenate([[0.0], np.cumsum(scores)]) / scores.std()
    widths = np.unique(np.geomspace(_NARROWEST, n - _NARROWEST, 24).astype(int)).tolist()
    best, tried = (0.0, 0, 0), 0
    for w in widths:
        z = (sums[w:] - sums[:-w]) / np.sqrt(w * (1 - w / n))
        k = int(np.abs(z).argmax())
        tried += len(z)
        if abs(z[k]) > abs(best[0]):
            best = float(z[k]), k, w
    z, start, width = best
    if abs(z) < -scipy.special.ndtri(0.5 * alarm / tried):
        return None
    return start, start + width, z
