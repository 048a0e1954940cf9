r"""What several estimates of one number say together: a random-effects model.

$$y_i = \mu + \beta\,(t_i - \bar t) + u_i + e_i, \qquad u_i \sim N(0, \tau^2), \quad e_i \sim N(0, s_i^2)$$

with the estimate $y_i$ of recording i, its deviation $s_i$ and, where it is known, when it was made. $\mu$ is
for good, $\beta$ drifts, $u_i$ scatters from one recording to the next, and a recording that this law does not
foresee happened once.

$\tau^2$ is Paule and Mandel's: where $Q(\tau^2) = \sum_i w_i (y_i - \hat y_i)^2$, with weights
$w_i = 1/(\tau^2 + s_i^2)$, is as large as it is on average, $n - p$; its interval is where Q is between quantiles
of $\chi^2_{n-p}$. Both are exact for normal estimates whose deviations are right, however few. $\mu$ and $\beta$
take Student's t with n - p degrees of freedom, as $\tau^2$ is estimated: wider than needed where recordings do
not differ, right where they do (`tests/test_fleet_hierarchy.py`).

A recording is set beside what the others foresee for it, as many times as there are recordings; the one that
stands out most is left out, and so on, and as many are set apart as there were when one last stood out beyond
chance (Rosner's generalised test, the chance shared out), so that two do not hide each other. More than a quarter
of the recordings are scatter.

References:
    Paule, Mandel, J. Res. NBS 1982; Viechtbauer, Stat. Med. 2007 (the interval); Knapp, Hartung, Stat. Med. 2003
    (Student's t); Viechtbauer, Cheung, Res. Synth. Methods 2010 (deleted residuals); Rosner,
    Technometrics 1983; Benjamini, Hochberg, JRSS B 1995 (`discoveries`).
"""

import dataclasses

import numpy as np
import scipy.special
import scipy.stats
from jaxtyping import Bool, Float, Int

LEVEL = 0.95
"""Of every interval."""
APART = 0.01
"""Probability, all its recordings counted, with which one of a quiet arm is set apart."""
FEWEST_TREND, FEWEST_ONCE, FEWEST_BOTH = 4, 5, 6
"""Recordings that a trend takes, one that stands out, and one that stands out of a trend."""
_STEPS = 80
_FIRST = 0.8
"""Share of the chance of a false alarm that the first to be left out has; the others share the rest."""
_MOST_APART = 10
"""Recordings that may be set apart, of four times as many: what happens more often does not happen once."""


@dataclasses.dataclass(frozen=True)
class Number:
    """An estimate with its deviation, interval and the probability that zero gives as much."""

    value: float
    std: float
    interval: tuple[float, float]
    p: float


@dataclasses.dataclass(frozen=True)
class Once:
    """A recording that the others do not foresee."""

    index: int
    """Among those that were given."""
    value: float
    expected: float
    std: float
    """Of the difference."""
    p: float
    """That one of so many recordings stands out as far by chance."""


@dataclasses.dataclass(frozen=True)
class History:
    """What the estimates of one number say together; those set apart in `once` do not count in the rest."""

    count: int
    mean: Number
    """For good: at the mean time of the recordings."""
    between: float
    """Deviation from one recording to the next, beside that of the estimates."""
    between_interval: tuple[float, float]
    drift: Number | None
    """A unit of time; None where times are not known, all one, or too few."""
    centre: float | None
    """The time that `mean` is at."""
    once: tuple[Once, ...]
    p_once: float | None
    """That any recording stands out as far as the first by chance; None where they are too few to tell."""


def history(
    value: Float[np.ndarray, " n"],
    std: Float[np.ndarray, " n"],
    time: Float[np.ndarray, " n"] | None = None,
) -> History:
    """What estimates with deviations, two or more, say together.

    Args:
        value: finite.
        std: of each, positive.
        time: of each, in any unit; None where it is not known.
    """
    scale = float(np.median(std))
    y, v = value / scale, np.square(std / scale)
    when = None if time is None or np.ptp(time) == 0 or len(np.unique(time)) < FEWEST_TREND else time
    keep, once, p_once = _set_apart(y, v, when)
    at = np.flatnonzero(keep)
    y, v, n = y[at], v[at], len(at)
    X, drift, centre = np.ones((n, 1)), None, None if when is None else float(when[at].mean())
    sloped = _law(len(value), when, at, FEWEST_TREND)[at]
    if when is not None and sloped.shape[1] == 2:
        beta, covariance, _ = _fit(y, v, sloped)
        drift = _number(beta, covariance, 1, n - 2, scale / float(np.ptp(when[at])))
        if drift.p < 1 - LEVEL:  # else the mean is known better without: a slope costs a degree of freedom
            X = sloped
    beta, covariance, tau2 = _fit(y, v, X)
    mean = _number(beta, covariance, 0, n - X.shape[1], scale)
    low, high = _interval(y, v, X)
    return History(
        count=n,
        mean=mean,
        between=scale * float(np.sqrt(tau2)),
        between_interval=(scale * low, scale * high),
        drift=drift,
        centre=centre,
        once=tuple(
            dataclasses.replace(o, value=scale * o.value, expected=scale * o.expected, std=scale * o.std)
            for o in once
        ),
        p_once=p_once,
    )


def discoveries(p: Float[np.ndarray, " tests"], rate: float = 1 - LEVEL) -> Bool[np.ndarray, " tests"]:
    """Which of many tests say something, so that at most this share of those is by chance (Benjamini and
    Hochberg); where none has anything to say, with this probability none is said to."""
    p = np.asarray(p, float)
    order = np.sort(p)
    below = np.flatnonzero(order <= rate * np.arange(1, len(p) + 1) / max(len(p), 1))
    return p <= order[below[-1]] if len(below) else np.zeros(len(p), bool)


def _set_apart(
    y: Float[np.ndarray, " n"], v: Float[np.ndarray, " n"], time: Float[np.ndarray, " n"] | None
) -> tuple[Bool[np.ndarray, " n"], list[Once], float | None]:
    """Which recordings are left, which stand out, and the probability that chance makes any do so.

    The one that stands out most is left out, then the next, whether or not that is beyond chance: two hide each
    other. As many stand out as there were when one last did.
    """
    keep, left_out, chances = np.ones(len(y), bool), [], []
    steps = min(_MOST_APART, len(y) // 4)
    for step in range(steps):
        at = np.flatnonzero(keep)
        if len(at) < FEWEST_ONCE:
            break
        _, _, p = _foreseen(y[at], v[at], _law(len(y), time, at, FEWEST_BOTH)[at])
        i = int(np.argmin(p))
        left_out.append(int(at[i]))
        share = 1.0 if steps == 1 else _FIRST if step == 0 else (1 - _FIRST) / (steps - 1)
        chances.append(float(min(1.0, len(at) * p[i] / share)))
        keep[at[i]] = False
    many = max((k + 1 for k, chance in enumerate(chances) if chance <= APART), default=0)
    keep[left_out[many:]] = True
    out = []
    if many:
        at = np.flatnonzero(keep)
        every = _law(len(y), time, at, FEWEST_BOTH)
        beta, covariance, tau2 = _fit(y[at], v[at], every[at])
        for k, i in enumerate(left_out[:many]):
            std = float(np.sqrt(tau2 + v[i] + every[i] @ covariance @ every[i]))
            out.append(Once(i, float(y[i]), float(every[i] @ beta), std, min(chances[k:many])))
    return keep, sorted(out, key=lambda one: one.index), min(chances, default=None)


def _law(
    count: int, time: Float[np.ndarray, " n"] | None, at: Int[np.ndarray, " m"], fewest: int
) -> Float[np.ndarray, "n p"]:
    """Columns of a mean and, if the estimates `at` are as many as `fewest` at several times, of a trend about
    their mean time, in their span."""
    if time is None or len(at) < fewest or np.ptp(time[at]) == 0:
        return np.ones((count, 1))
    return np.stack([np.ones(count), (time - time[at].mean()) / np.ptp(time[at])], 1)


def _foreseen(
    y: Float[np.ndarray, " n"], v: Float[np.ndarray, " n"], X: Float[np.ndarray, "n p"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """What the others foresee for each, the deviation of the difference, and how likely it is as large."""
    n, width = X.shape
    others = ~np.eye(n, dtype=bool)
    freedom = n - 1 - width
    tau2 = _paule_mandel(y, v, X, others, np.full(n, float(freedom)))
    beta, covariance = _weighted(y, v, X, others, tau2)[:2]
    expected = np.einsum("np,np->n", X, beta)
    std = np.sqrt(tau2 + v + np.einsum("np,npq,nq->n", X, covariance, X))
    return expected, std, 2 * scipy.special.stdtr(freedom, -np.abs(y - expected) / std)


def _fit(
    y: Float[np.ndarray, " n"], v: Float[np.ndarray, " n"], X: Float[np.ndarray, "n p"]
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p p"], float]:
    """Coefficients, their covariance, and tau²."""
    every = np.ones((1, len(y)), bool)
    tau2 = _paule_mandel(y, v, X, every, np.array([float(len(y) - X.shape[1])]))
    beta, covariance = _weighted(y, v, X, every, tau2)[:2]
    return beta[0], covariance[0], float(tau2[0])


def _interval(
    y: Float[np.ndarray, " n"], v: Float[np.ndarray, " n"], X: Float[np.ndarray, "n p"]
) -> tuple[float, float]:
    """Of tau, by Q's own distribution."""
    tails = scipy.stats.chi2.ppf([(1 + LEVEL) / 2, (1 - LEVEL) / 2], len(y) - X.shape[1])
    low, high = np.sqrt(_paule_mandel(y, v, X, np.ones((2, len(y)), bool), tails))
    return float(low), float(high)


def _number(
    beta: Float[np.ndarray, " p"],
    covariance: Float[np.ndarray, "p p"],
    at: int,
    freedom: int,
    unit: float,
) -> Number:
    std = float(np.sqrt(covariance[at, at]))
    value, wide = float(beta[at]), std * float(scipy.special.stdtrit(freedom, (1 + LEVEL) / 2))
    p = 2 * float(scipy.special.stdtr(freedom, -abs(value) / std))
    return Number(unit * value, unit * std, (unit * (value - wide), unit * (value + wide)), p)


def _weighted(
    y: Float[np.ndarray, " n"],
    v: Float[np.ndarray, " n"],
    X: Float[np.ndarray, "n p"],
    keep: Bool[np.ndarray, "m n"],
    tau2: Float[np.ndarray, " m"],
) -> tuple[
    Float[np.ndarray, "m p"], Float[np.ndarray, "m p p"], Float[np.ndarray, " m"], Float[np.ndarray, " m"]
]:
    """Of m choices of estimates: coefficients, their covariance, Q, and how fast Q falls with tau²."""
    w = keep / (tau2[:, None] + v)
    width = X.shape[1]
    information = w @ (X[:, :, None] * X[:, None]).reshape(len(y), -1)
    covariance = np.linalg.inv(information.reshape(-1, width, width))
    beta = (covariance @ (w @ (X * y[:, None]))[:, :, None])[:, :, 0]
    squares = np.square(y - beta @ X.T)
    return beta, covariance, np.sum(w * squares, 1), np.sum(w**2 * squares, 1)


def _paule_mandel(
    y: Float[np.ndarray, " n"],
    v: Float[np.ndarray, " n"],
    X: Float[np.ndarray, "n p"],
    keep: Bool[np.ndarray, "m n"],
    wanted: Float[np.ndarray, " m"],
) -> Float[np.ndarray, " m"]:
    """Where Q is as large as wanted, or 0, by Newton's steps on 1/Q, which is a straight line where deviations
    are one."""
    tau2 = np.zeros(len(keep))
    for _ in range(_STEPS):
        _, _, Q, falls = _weighted(y, v, X, keep, tau2)
        step = Q * (Q - wanted) / (wanted * np.maximum(falls, 1e-300))
        step = np.maximum(step, -tau2)  # where Q is less from the start, 0 it stays
        tau2 = tau2 + step
        if np.all(np.abs(step) <= 1e-9 * (1 + tau2)):
            break
    return tau2
