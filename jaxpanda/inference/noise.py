"""Noise of each joint's torque, from what a model with everything in it leaves.

The noise must not be read off the residual of the nominal model: what is slow in a missing effect would pass for
correlated noise, and hide it. A saturated fit (rigid body with free parameters, smooth functions of position,
velocity, load and time, dry friction that turns over a distance, and where that takes most of the rest velocities
of the other joints and products of any two) takes any effect away first, as well as it can, at the price of its
degrees of freedom.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Float

from ..effects import SIGN_WIDTH
from ..host import parallel
from ..traces import Trace
from .library import turning

ORDER = 3
LEAST_FREE, FEWEST_FREE = 0.25, 25.0
"""Share of a joint's samples that the saturated model must leave free for them to tell of noise, and how many."""
DETAILS = (1.0, 0.6, 0.35, 0.2)
"""Shares of the knots that its smooth functions have; the first that leaves so much free is taken."""
QUIETEST = 1e-9
"""Noise is taken for at least this [N m]."""
_RESOLVED = 1e-6
"""Share of a joint's torque for which its noise is taken at least: of squares 1e-16 is lost by rounding, so that
beside less, as of a simulation without noise, a prior could not be told. And of a largest singular value that
from which one counts."""
_SHARES = (0.0, 0.001, 0.01, 0.1, 1.0)
"""Of the variance of what laws may be off from sample to sample, those that are told apart."""
_SHARP = tuple(np.geomspace(1e-3, 1.0, 10).tolist())
"""Of the variance of what torque may be off by in sharp motion, those that are told apart."""


def hats(x: Float[np.ndarray, " _time"], count: int) -> Float[np.ndarray, "_time _count"]:
    """Piecewise linear functions on knots at equally many samples each; they add up to 1."""
    knots = np.unique(np.quantile(x, np.linspace(0, 1, count)))
    if len(knots) < 3:
        return np.ones((len(x), 1))
    return np.stack([np.interp(x, knots, e) for e in np.eye(len(knots))], 1)


@dataclasses.dataclass(frozen=True)
class _Basis:
    """Of the columns of a joint's saturated model."""

    detail: float
    U: Float[np.ndarray, "rows n"]
    """Orthonormal."""
    largest: float
    """Singular value."""
    taken: Float[np.ndarray, "lags lags"]
    """What the model takes of the moments of white noise of unit variance."""
    count: float
    """How many samples tell."""

    @property
    def free(self) -> float:
        """How many of them the model leaves."""
        return self.count - self.U.shape[1]

    @property
    def tells(self) -> bool:
        return self.free > max(LEAST_FREE * self.count, FEWEST_FREE)


class JointNoise(NamedTuple):
    """What a saturated model leaves of a joint."""

    a: Float[np.ndarray, " order"]
    """Of the autoregression."""
    sigma: float
    """Deviation of the innovations, beside what laws are off [N m]."""
    std: float
    """Of all that is left [N m]."""
    quiet: float
    """Mean square of the innovations at rest, over that of all: an arm at rest is mostly quieter."""
    share: float
    """How much of the variance of what laws may be off from sample to sample the innovations bear out."""
    beside: float
    """Deviation of the noise, beside what laws are off [N m]."""


class Saturation:
    """The saturated model of some recordings, joint by joint: one below the other, zero in their gaps.

    Of a joint with few samples it is coarser. What it then leaves of an effect passes for noise: the effect may
    be missed, but none is invented.
    """

    def __init__(self, traces: Sequence[Trace]):
        self.traces = tuple(traces)
        self._bases: dict[int, _Basis] = {}

    def columns(
        self, joint: int, extra: Sequence[Float[np.ndarray, "_time _n"]] = (), detail: float | None = None
    ) -> Float[np.ndarray, "_rows _n"]:
        """All columns of a joint but other joints' velocities, `extra` ones of each recording last; in as much
        detail as samples allow."""
        if detail is None:
            detail = self._basis(joint).detail

        def stacked(part) -> np.ndarray:
            return np.concatenate([np.asarray(part(trace)) for trace in self.traces])

        def knots(count: int) -> int:
            return round(detail * count)

        traces = self.traces
        Q, s, _ = np.linalg.svd(stacked(lambda t: t.motion.regressor[:, joint]), full_matrices=False)
        rigid = Q[:, s > 1e-7 * s[0]]
        q, qd = stacked(lambda t: t.motion.q[:, joint]), stacked(lambda t: t.motion.qd[:, joint])
        load = stacked(lambda t: t.motion.load[:, joint])
        sign = stacked(lambda t: t.down(np.tanh(np.asarray(t.channels.qd[:, joint]) / SIGN_WIDTH)))
        rates = [np.gradient(t.motion.load[:, joint], t.motion.dt) for t in traces]
        bends = [np.gradient(rate, t.motion.dt) for rate, t in zip(rates, traces, strict=True)]
        swings = np.stack([np.concatenate(rates), np.concatenate(bends)], 1)
        speed = hats(np.abs(qd), knots(8))
        clock = scipy.linalg.block_diag(*[hats(t.motion.time, knots(10)) for t in traces])
        shaken = stacked(lambda t: t.shaken[:, joint])
        smooth = [rigid, shaken, hats(q, knots(10)), speed, hats(load, knots(5)), swings, clock]
        rough = [sign[:, None] * x for x in (speed, hats(q, knots(4)), hats(load, knots(3)), clock[:, ::2])]
        turned = turning(traces, joint)
        known = [stacked(lambda t: t.down(t.sign[:, joint]))[:, None]] if self._rubs(joint) else []
        A = np.concatenate(
            [*smooth, *rough, turned, *known, *([np.concatenate(list(extra))] if len(extra) else [])], 1
        )
        return A * self._weight(joint)[:, None]

    def _rubs(self, joint: int) -> bool:
        """Whether the user's model has dry friction there, which turns as MuJoCo's constraint does; there may be
        less of it."""
        return bool(np.asarray(self.traces[0].motion.arm.frictionloss)[joint] > 0)

    def left(
        self, joint: int, extra: Sequence[Float[np.ndarray, "_time _n"]] = ()
    ) -> tuple[Float[np.ndarray, " _rows"], list[Float[np.ndarray, "_rows _n"]]]:
        """What the model with `extra` columns leaves of the measured torque, and the bases of what it takes."""
        basis = self._basis(joint)
        U = basis.U
        r = self._residual(joint)
        r = r - U @ (U.T @ r)
        if not len(extra):
            return r, [U]
        V, _ = _beside(basis, np.concatenate(list(extra)) * self._weight(joint)[:, None])
        return r - V @ (V.T @ r), [U, V]

    def noise(
        self,
        joint: int,
        extra: Sequence[Float[np.ndarray, "_time _n"]],
        rests: Float[np.ndarray, " _rows"],
        off: Float[np.ndarray, " _rows"],
        holds: Float[np.ndarray, " _rows"],
    ) -> JointNoise:
        r"""`autoregression` of what the model with `extra` columns leaves, with what it took of noise put back.

        Args:
            joint: whose.
            extra: columns in each recording.
            rests: where the joint does, 0 to 1.
            off: variance of what laws may be off from sample to sample [N² m²].
            holds: that of a load which friction may hold: nothing is borne out there.

        Of white noise of variance $\sigma^2$ a model with orthonormal columns U takes
        $\sigma^2 \sum_t U_{t-k} \cdot U_{t-l}$ of the moment of lags k and l: most where it is slow. Where a
        joint may rest samples weigh little, and have no less noise (`Trace.scatter`); of one that creeps all do.
        """
        r, bases = self.left(joint, extra)
        basis = self._basis(joint)
        told = self._told(joint)
        unit = basis.count / max(float(np.sum(told)), 1e-300)
        taken = sum((self.moments(V) for V in bases[1:]), basis.taken)
        count, used = basis.count, sum(U.shape[1] for U in bases)
        variance = unit * float(r @ r) / max(count - used, LEAST_FREE * count)
        a, *noise = autoregression(unit * self.moments(r[:, None]) + variance * taken, count)
        sigma, std = np.maximum(noise, self._resolved[joint]).tolist()
        left = self._innovations(r, a) / sigma
        counts = told * (left != 0) * (holds == 0)
        share, scale = borne_out(left, off / std**2, counts)
        left /= scale * np.sqrt(1 + share * off / std**2)
        free = rests * (1 - sum(np.sum(U**2, 1) for U in bases))
        quiet = (rests @ left**2 + FEWEST_FREE) / (np.sum(free) + FEWEST_FREE)
        return JointNoise(a, sigma * scale, std, float(quiet), share * scale**2, std * scale)

    @functools.cached_property
    def _resolved(self) -> Float[np.ndarray, " dof"]:
        """The least noise that each joint's torque is told from [N m]."""
        torque = np.concatenate([t.motion.torque for t in self.traces])
        return _RESOLVED * np.sqrt(np.mean(torque**2, 0))

    def tells(self, joint: int) -> bool:
        """Whether the recordings are long enough for the model to leave noise of a joint to be seen."""
        return self._basis(joint).tells

    def samples(self, joint: int) -> float:
        """How many samples tell of a joint: fewer than there are where they weigh unalike."""
        return self._basis(joint).count

    def free(self, joint: int) -> float:
        """How many samples the model leaves: noise's variance is known to a share of about sqrt(2 / free)."""
        return max(self._basis(joint).free, 1.0)

    def _basis(self, joint: int) -> "_Basis":
        """Of the model's columns."""
        if joint not in self._bases:
            basis = self._of(joint, DETAILS[0])
            for coarser in DETAILS[1:]:
                if basis.tells:
                    break
                basis = self._of(joint, coarser)
            self._bases[joint] = self._coupled(joint, basis)
        return self._bases[joint]

    def _of(self, joint: int, detail: float) -> _Basis:
        U, s, _ = np.linalg.svd(self.columns(joint, detail=detail), full_matrices=False)
        U = U[:, s > _RESOLVED * s[0]]
        return _Basis(detail, U, float(s[0]), self.moments(U), self._count(joint))

    def _coupled(self, joint: int, basis: _Basis) -> _Basis:
        """With other joints' velocities and products of any two, where these take more than half of what the
        others leave of a joint's torque, and make it likelier by more than they are worth (Schwarz 1978)."""
        qd = np.concatenate([t.motion.qd for t in self.traces])
        products = [qd[:, i, None] * qd[:, i:] for i in range(qd.shape[1])]
        E = np.concatenate([np.delete(qd, joint, 1), *products], 1) * self._weight(joint)[:, None]
        V, largest = _beside(basis, E)
        U, taken = np.concatenate([basis.U, V], 1), basis.taken + self.moments(V)
        wider = dataclasses.replace(basis, U=U, largest=largest, taken=taken)
        if not wider.tells:
            return basis
        r, own = self._residual(joint), [basis.U, V]
        before, after = r @ r - np.cumsum([np.sum((A.T @ r) ** 2) for A in own])
        bar = max(2.0, basis.count ** (V.shape[1] / basis.count))
        return wider if before > bar * max(after, 1e-300) else basis

    def _residual(self, joint: int) -> Float[np.ndarray, " _rows"]:
        """Measured less modelled torque, by what each row weighs."""
        return np.concatenate([t.residual[:, joint] for t in self.traces]) * self._weight(joint)

    def moments(self, x: Float[np.ndarray, "_rows _n"]) -> Float[np.ndarray, "_lags _lags"]:
        """`moments` of the recordings, one below the other."""
        return np.sum([moments(part) for part in self._apart(x)], 0)

    def _apart(self, x: Float[np.ndarray, "_rows ..."]) -> list[Float[np.ndarray, "_time ..."]]:
        """The rows of each recording."""
        return np.split(x, np.cumsum([t.motion.samples for t in self.traces])[:-1])

    def _innovations(
        self, x: Float[np.ndarray, " _rows"], a: Float[np.ndarray, " _order"]
    ) -> Float[np.ndarray, " _rows"]:
        """What an autoregression does not foretell of each recording."""
        b = np.concatenate([[1.0], -a])
        return np.concatenate([np.convolve(part, b)[: len(part)] for part in self._apart(x)])

    def _weight(self, joint: int) -> Float[np.ndarray, " _rows"]:
        return np.concatenate([t.weights[:, joint] for t in self.traces])

    def _told(self, joint: int) -> Float[np.ndarray, " _rows"]:
        """`Trace.scatter`."""
        return np.concatenate([t.scatter[:, joint] for t in self.traces])

    def _count(self, joint: int) -> float:
        r"""How many samples tell of a joint: $(\sum s)^2 / \sum s^2$ with s their `Trace.scatter`, their number
        where all scatter alike."""
        told = self._told(joint)
        return float(np.sum(told) ** 2 / max(np.sum(told**2), 1e-300))

    def sharpness(self, joint: int) -> float:
        """The largest share of `Trace.too_sharp` that a joint's innovations do not deny: what a filter takes away
        is looked for around a sample, and at the sample itself less is missing, mostly."""
        off = np.concatenate([t.too_sharp[:, joint] for t in self.traces])
        if not np.any(off) or not self.tells(joint):
            return 1.0
        r, _ = self.left(joint)
        a, *_ = autoregression(self.moments(r[:, None]), self.samples(joint))
        left = self._innovations(r, a)
        nats, _ = likelihoods(left * np.sqrt(1 + off), off, self._told(joint) * (left != 0), _SHARP)
        return float(_SHARP[np.flatnonzero(nats > nats.max() - 0.5 * np.log(self.samples(joint)))[-1]])

    @functools.cached_property
    def ripples(self) -> list[list[Float[np.ndarray, "_time _n"]]]:
        """For each joint the order that the saturated model leaves most of, as columns in each recording.

        They join the saturated model: a ripple would otherwise pass for noise of its own frequency.
        """

        def one(joint: int) -> list[np.ndarray]:
            left, _ = self.left(joint)
            return strongest_order([t.motion.q[:, joint] for t in self.traces], self._apart(left))

        for trace in self.traces:  # made once, before there are threads
            trace.motion.regressor, trace.motion.load, trace.shaken  # noqa: B018
        return parallel(one, range(self.traces[0].motion.dof))


def as_sharp_as_shown(traces: Sequence[Trace]) -> list[Trace]:
    """Recordings that trust samples of sharp motion as far as their innovations bear out."""
    saturation = Saturation(traces)
    share = np.array([saturation.sharpness(joint) for joint in range(traces[0].motion.dof)])
    return [t.as_sharp_as(share) for t in traces]


def _beside(basis: _Basis, E: Float[np.ndarray, "_rows _n"]) -> tuple[Float[np.ndarray, "_rows _m"], float]:
    """An orthonormal basis of what further columns add to one, and the largest singular value of either."""
    U, largest = basis.U, max(basis.largest, float(np.linalg.norm(E, 2)))
    for _ in range(2):  # once would leave rounding of what is taken off
        E = E - U @ (U.T @ E)
    V, s, _ = np.linalg.svd(E, full_matrices=False)
    return V[:, s > _RESOLVED * largest], largest


def borne_out(
    left: Float[np.ndarray, " rows"], off: Float[np.ndarray, " rows"], counts: Float[np.ndarray, " rows"]
) -> tuple[float, float]:
    r"""How much of an error from sample to sample innovations bear out, and their deviation beside it, over that
    of all.

    Of variance $\sigma^2 (1 + s\,o_t)$ the least s than which none is likelier by what a number of its own is
    worth (Schwarz 1978).

    Args:
        left: innovations, times the root of what their rows count.
        off: variance $o_t$ of the error, over that of the innovations.
        counts: how much each row does, 0 to 1.
    """
    count = float(np.sum(counts))
    if count < 1:
        return _SHARES[0], 1.0
    nats, variance = likelihoods(left, off, counts, _SHARES)
    least = int(np.argmax(nats > nats.max() - 0.5 * np.log(count)))
    return _SHARES[least], float(np.sqrt(variance[least] / variance[0]))


def likelihoods(
    left: Float[np.ndarray, " rows"],
    off: Float[np.ndarray, " rows"],
    counts: Float[np.ndarray, " rows"],
    shares: Sequence[float],
) -> tuple[Float[np.ndarray, " _share"], Float[np.ndarray, " _share"]]:
    """Log likelihood of each share of an error, with the arguments of `borne_out`, and the sum of squares of the
    innovations beside it."""
    squares = np.where(counts > 0, left, 0.0) ** 2
    spread = [1 + share * off for share in shares]
    variance = np.maximum([np.sum(squares / x) for x in spread], 1e-300)
    return -0.5 * (np.sum(counts) * np.log(variance) + [counts @ np.log(x) for x in spread]), variance


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


def moments(x: Float[np.ndarray, "_time _n"]) -> Float[np.ndarray, "_lags _lags"]:
    r"""$\sum_t x_{t-k} \cdot x_{t-l}$ for the lags that an autoregression takes."""
    now = [x[ORDER - k : len(x) - k] for k in range(ORDER + 1)]
    return np.array([[np.vdot(a, b) for b in now] for a in now])


def autoregression(
    moments: Float[np.ndarray, "_lags _lags"], count: float
) -> tuple[np.ndarray, float, float]:
    """Coefficients, deviation of the innovations, and deviation of the noise, by least squares.

    Args:
        moments: of the noise, summed over its samples.
        count: how many those are.
    """
    S = moments / count
    a = np.linalg.solve(S[1:, 1:] + 1e-6 * max(S[0, 0], 1e-12) * np.eye(ORDER), S[1:, 0])
    b = np.concatenate([[1.0], -a])
    return a, max(float(np.sqrt(max(b @ S @ b, 0.0))), QUIETEST), max(float(np.sqrt(S[0, 0])), QUIETEST)
