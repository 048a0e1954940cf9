r"""What a recording's torque column is, asked before any physics: inverse dynamics of the model, or not.

Every joint is compared by itself. Samples of its low-passed torque are explained as

$$ \tau = \mu + B\,x + F\,(s + C\,z) + e, \quad x, z \sim N(0, 1), \quad e \sim N(0, a^2 R_\rho), $$

with $\mu$ the torque of the user's model under a reading of the column. B is what may well be wrong in a model
that is read rightly: links, a payload, viscous friction, an offset, rotor inertia, a spring, a body that spins
and so feels other joints' velocities, a delay, a gain and a slight tilt, all with wide deviations. F is the size
of dry friction: s the sign of velocity, C how far friction may be from that, with one number for each rest, in
which it holds whatever load is left to it, up to about F. So a rest says no more than one sample does, and
friction holds no load at rest that it would not brake in motion.
The error e is correlated over a time $\rho$. Its size a, $\rho$, F and the size of x are integrated out, so that
unmodelled physics only makes e larger, whatever the reading. A column in another unit or of another joint is far
from any of this, and its reading gains many nats.

The likeliest reading is told only where its evidence beats the plain one's by far, more for each choice it has
(`_NEEDS`), and the posterior of the plain one is next to none (`SURE`); its own posterior is its confidence.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.special
from jaxpanda_kernels import regressor
from jaxtyping import Float, Int
from threadpoolctl import threadpool_limits

from .arms.arm import Arm, joints_named
from .convention import REMOVED, UNITS
from .recordings import Recording
from .signals import prepare

KINDS = ("gravity_removed", "sign", "unit", "current", "joint_order", "motor_side", "mounting")
SURE = 0.99
"""Posterior probability that a column is not read plainly, from which its likeliest reading is told."""
_NEEDS, _EACH = 15.0, 7.0
"""Evidence over the plain reading that it takes besides, at least, and for each choice that a reading has [nats].
Errors are never quite as modelled: physics that no model holds gained other readings up to 6 a choice in
trials."""
_CHOICES_OF_MOUNTING = 3
"""A direction, and whether it is the moon's."""
_BETTER = 15.0
"""Evidence that a further swap of joints must gain [nats]."""
_PRIOR = 0.01
"""Prior odds of each kind of reading against the plain one."""
_CUTOFF = 3.0
"""Of the low-pass on torque and columns [Hz]."""
_RARE = 0.1
"""Prior odds, beside the rest of its kind, of a unit that nobody uses and of an arm on the moon."""
_SAMPLES, _STEP = 100, 0.1
"""Samples of a recording that are compared, at most, and the least time between them [s]."""
_MOST = _SAMPLES + 2
"""Samples that the regressor is compiled for."""
_COARSE = 3
"""One sample of so many is compared first where all channels may be out of order: orders are many."""
_FEWEST = 30
"""Samples from which a recording is judged."""
_STILL = 0.02
"""Travel below which a joint is not judged [rad]: friction at rest may carry its load."""
_MEMORIES = np.array([0.05, 0.2, 0.8, 3.2])
"""Correlation times of the error [s]."""
_SIZES = np.exp(np.r_[np.arange(-9.0, 3.5, 0.5), np.arange(3.5, 10.0, 1.0)])
"""Sizes of the error, in the size of the joint's torque: the least are none, lest a factor stand in for them; the
largest of torque that nothing explains, lest its unit be doubted."""
_SHARES = np.geomspace(1e-3, 8.0, 9)
"""Shares of the deviations below that a joint may have. Most models are better than that, and some far worse: for
these a factor would be told, as it makes the deviations larger."""
_WHITE = 0.03
"""Share of the error's variance that is not correlated."""
_LINKS = 0.2, 0.02, 0.3
"""Deviations of a link: of its mass, as a share; of its centre of mass [m]; of its inertia, as a share."""
_LOAD = 0.15, 0.1
"""Deviations of a payload's mass, as a share of the arm's, and of where it is [m]."""
_GAIN, _TILT, _DELAY = 0.25, 0.1, 0.05
"""Deviations of a sensor's gain, as a share; of a base that is not level [rad]; of a delay [s]."""
_FREE = 1.0
"""Deviation of friction but dry, offset, rotor inertia, spring and a spinning body's torque, in the size of the
joint's torque."""
_FRICTIONS = np.geomspace(0.003, 0.8, 8)
"""Sizes of dry friction, in the size of the arm's largest joint torque: the drive's, whatever a joint bears."""
_SLIDING, _HELD = 0.3, 0.7
"""Deviation of dry friction in motion from that size, and of what it holds in a rest from none, as shares."""
_RESTS = 0.005
"""Velocity at which dry friction holds a load in part [rad/s]."""
_RESTING = 0.1
"""Share of what friction may hold, from which a sample belongs to a rest."""
_LONGEST = 8
"""Rests of a joint, the longest, with a number each; others are short, and friction there may be anything."""
_OFF = 0.5
"""Share of a column that the model's torque leaves, at least, where the column is another joint's."""
_SMALL = 0.1
"""Least size of a joint's torque, as a share of the largest joint's."""
_FACTORS = np.exp(np.arange(-9.6, 9.7, 0.1))
"""Factors between a column and the torque that are tried."""
_TOGETHER, _NOTHING = 16, 40.0
"""Factors that are tried together, and what counts for nothing beside something likelier [nats]."""
_FAR = 5.0
"""A constant within this factor of 1 is a gain, a load or links, not a unit."""
_ALONE = 30.0
"""Below this a single joint's constant is a load, a gain or friction that the model lacks or has, not a unit."""
_NEAR = 1.3
"""A constant within this factor of a usual unit is taken for it."""
_OWN = 0.6
"""Deviation of the logarithm of motors' constants about their common one."""
_TOLD = 10.0
"""Angle from the model's gravity beyond which a mounting is told [degrees]."""
_EARTH, _MOON = 9.81, 1.62
"""Sizes of gravity [m/s²]."""
_UNITS = {name: 1 / size for name, size in UNITS.items() if name not in ("Nm", "lbfft", "kgfm", "Nmm")}
"""Units that torque is written in, each per N·m; lbf·ft is too near to a gain to be told, kgf·m to current."""
_GEARS = 30.0, 400.0
"""Reduction ratios of arms' gears: a column smaller than torque by so much is torque of the motor's side."""


@dataclasses.dataclass(frozen=True)
class Meaning:
    """A reading of a torque column other than the plain one, found with near certainty."""

    kind: str
    """One of `KINDS`."""
    joints: tuple[int, ...]
    """0-based; those that are read otherwise."""
    confidence: float
    """Posterior probability among all readings."""
    evidence: float
    """Over the plain reading [nats]."""
    factors: tuple[float, ...]
    """Column over torque, joint by joint; for signs, units and currents."""
    order: tuple[int, ...]
    """The joint, 0-based, that each column belongs to."""
    whole_order: bool
    """Whether q and dq are out of order as well."""
    gravity: tuple[float, float, float] | None
    """Of the mounting, in the base's frame [m/s²]."""
    rms: tuple[float, ...]
    """By how much the column differs from the torque it stands for, at each joint."""
    says: str
    """What the column is, in a sentence."""
    options: str
    """Of the commands that read recordings: by which this one is read as it is meant."""
    mend: str
    """The same in a sentence, with what else would do."""

    @property
    def summary(self) -> str:
        """Both sentences."""
        return f"{self.says} {self.mend}"

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


@dataclasses.dataclass(frozen=True)
class _Reading:
    """A hypothesis about a column, with its prior and evidence together [nats]."""

    kind: str
    score: float
    factors: np.ndarray
    order: np.ndarray
    whole_order: bool = False
    gravity: np.ndarray | None = None


@dataclasses.dataclass(frozen=True)
class _Samples:
    """Some samples of a recording, and the model's torque there, split by gravity."""

    time: Float[np.ndarray, " n"]
    q: Float[np.ndarray, "n dof"]
    qd: Float[np.ndarray, "n dof"]
    qdd: Float[np.ndarray, "n dof"]
    tau: Float[np.ndarray, "n dof"]
    """The column, low-passed."""
    moving: Int[np.ndarray, " moving"]
    """Joints that move."""

    @functools.cached_property
    def errors(self) -> list[tuple[Float[np.ndarray, "n n"], float]]:
        """For each correlation time of the error: what turns it into white noise, and the logarithm of its
        correlation's determinant."""
        apart, out = np.abs(self.time[:, None] - self.time), []
        least = min(float(np.median(np.diff(self.time))) / 3, _MEMORIES[-1])  # shorter ones are all white
        for memory in _MEMORIES[least <= _MEMORIES]:
            L = np.linalg.cholesky((1 - _WHITE) * np.exp(-apart / memory) + _WHITE * np.eye(len(apart)))
            white = scipy.linalg.solve_triangular(L, np.eye(len(L)), lower=True)
            out.append((white, float(2 * np.sum(np.log(np.diag(L))))))
        return out

    def every(self, step: int) -> "_Samples":
        """One sample of `step`."""
        time, q, qd, qdd, tau = (x[::step] for x in (self.time, self.q, self.qd, self.qdd, self.tau))
        return _Samples(time, q, qd, qdd, tau, self.moving)


def meaning(recording: Recording, arm: Arm) -> Meaning | None:
    """What the torque column is, where that is not the joint torque of this arm with near certainty; else None.

    Args:
        recording: with torque.
        arm: of the same robot.

    None as well where nothing can be told: no torque, too short a recording, fewer than two joints that move.
    """
    samples = _sampled(recording)
    if samples is None or len(samples.moving) < 2:
        return None
    model = _Model(arm, samples, np.arange(arm.dof))
    with threadpool_limits(limits=1, user_api="blas"):  # for small matrices several cost more than they save
        readings = _readings(model)
    plain = readings[0]
    scores = np.array([r.score - _needs(r) for r in readings])
    best = readings[int(np.argmax(scores))]
    kinds = np.array([r.kind for r in readings])
    alike = _logsumexp(scores[kinds == best.kind])
    confidence = float(np.exp(alike - _logsumexp(scores)))
    unlikely = plain.score - _logsumexp(scores)
    if not best.kind or unlikely > np.log(1 - SURE) or confidence < 0.5:
        return None
    gain = best.score - plain.score
    return _told(best, model, min(confidence, 0.995), float(gain))


def borne_out(found: Meaning, others: Sequence[Recording], arm: Arm) -> bool:
    """Whether what one recording tells holds beside others of the same arm.

    An arm stands as it stands, and recordings of one arm are mostly written alike: the reading is that of all of
    them together, or, unless it is a mounting, that of this one alone, which is one more choice.

    Args:
        found: what the recording tells by itself.
        others: with torque.
        arm: as for `meaning`.
    """
    reading = _Reading(
        found.kind,
        found.evidence,
        np.array(found.factors),
        np.array(found.order),
        found.whole_order,
        None if found.gravity is None else np.array(found.gravity),
    )
    enough = _needs(reading) - np.log(1 - SURE)
    if found.kind != "mounting" and found.evidence - _EACH + np.log(_PRIOR) > enough:
        return True
    gained = found.evidence
    for recording in others:
        if (samples := _sampled(recording)) is not None and len(samples.moving):
            with threadpool_limits(limits=1, user_api="blas"):
                gained += _gained(reading, _Model(arm, samples, np.arange(arm.dof)))
    return bool(gained > enough)


def _gained(reading: "_Reading", plain: "_Model") -> float:
    """Evidence of a reading over the plain one, its constants as they are [nats]."""
    arm, samples = plain.arm, plain.samples
    if reading.kind == "gravity_removed":
        return sum(one.score - np.log(_PRIOR) for one in _without_gravity(plain)) - plain.evidence()
    if reading.gravity is not None or reading.whole_order:
        return _Model(arm, samples, reading.order, reading.gravity).evidence() - plain.evidence()
    by_joint = (
        plain.joint_evidence(j, samples.tau[:, c], plain.torque[:, j], reading.factors[j : j + 1])[0]
        for j, c in enumerate(reading.order)
        if j in plain.moving
    )
    return float(sum(by_joint)) - plain.evidence()


def _needs(reading: "_Reading") -> float:
    """Evidence over the plain reading that one needs [nats], by its choices: which joints, a constant each.

    Of channels out of order every joint's torque is another's, and physics that no model holds may gain in each.
    """
    if not reading.kind:
        return 0.0
    altered = len(reading.factors) if reading.whole_order else len(_altered(reading))
    common = altered == len(reading.factors)
    usual = common and abs(float(reading.factors[0])) in _UNITS.values()
    choices = {
        "gravity_removed": 1,
        "sign": 1 if common else altered,
        "unit": 1 if usual else altered if common else 2 * altered,
        "mounting": _CHOICES_OF_MOUNTING,
    }
    return max(_NEEDS, _EACH * choices.get(reading.kind, altered))


def _altered(reading: "_Reading") -> Int[np.ndarray, " joints"]:
    """Joints, 0-based, whose column is read otherwise."""
    dof = len(reading.factors)
    return {
        "sign": np.flatnonzero(reading.factors < 0),
        "unit": np.flatnonzero(reading.factors != 1),
        "joint_order": np.flatnonzero(reading.order != np.arange(dof)),
    }.get(reading.kind, np.arange(dof))


def _readings(model: "_Model") -> list[_Reading]:
    """The plain reading, and the likeliest of each other kind."""
    plain = _Reading("", model.evidence(), np.ones(model.arm.dof), np.arange(model.arm.dof))
    out = [plain, *_without_gravity(model), *_signs(model), *_scales(model), *_mountings(model)]
    return [*out, *_orders(model, plain.score)]


def _sampled(recording: Recording) -> _Samples | None:
    """Low-passed samples, spread evenly over the recording."""
    duration = float(recording.time[-1] - recording.time[0])
    if recording.tau is None or duration < _FEWEST * _STEP or recording.rate < 5 * _CUTOFF:
        return None
    cutoff = min(_CUTOFF, 0.2 * recording.rate)
    signals = prepare(recording, cutoff=cutoff, derivative_cutoff=cutoff, trim=min(0.6, duration / 10))
    keep = signals.keep
    step = max(_STEP, float(signals.times[-1] - signals.times[0]) / _SAMPLES)
    at = np.searchsorted(signals.times, np.arange(signals.times[0], signals.times[-1], step))
    at = np.unique(np.minimum(at, len(signals.times) - 1))
    if len(at) < _FEWEST:
        return None
    q, qd, qdd = (x[keep[at]] for x in (signals.q, signals.qd, signals.qdd))
    assert signals.tau is not None
    tau = signals.lowpass(signals.tau)[at]
    spread = np.ptp(recording.tau, axis=0)
    moving = np.flatnonzero((np.ptp(q, axis=0) > _STILL) & (spread > 1e-6 * spread.max()))
    return _Samples(signals.times[at], q, qd, qdd, tau, moving)


class _Model:
    """The model's torque at the samples, and its evidence under a reading; computed once, when asked for."""

    def __init__(
        self, arm: Arm, samples: _Samples, order: Int[np.ndarray, " dof"], gravity: np.ndarray | None = None
    ):
        """`order`: the joint that each column of q belongs to; `gravity`: in place of the arm's [m/s²]."""
        self.arm, self.samples, self.order = arm, samples, order
        self.gravity = np.asarray(arm.chain.gravity, float) if gravity is None else gravity
        place = np.argsort(order)
        self.q, self.qd, self.qdd = (x[:, place] for x in (samples.q, samples.qd, samples.qdd))
        self.moving: list[int] = np.sort(order[samples.moving]).tolist()
        self._bases: dict[int, list[tuple[np.ndarray, np.ndarray, np.ndarray, float]]] = {}

    @functools.cached_property
    def parts(self) -> tuple[Float[np.ndarray, "n dof standard"], Float[np.ndarray, "3 n dof standard"]]:
        """Regressor without gravity, and that of a unit of gravity along each axis."""
        (parts,) = _parts([self])
        return parts

    @functools.cached_property
    def known(self) -> Float[np.ndarray, "n dof"]:
        """Torque of rotors, springs and friction that the model holds [N m]."""
        arm = self.arm
        known = np.asarray(arm.armature) * self.qdd + np.asarray(arm.damping) * self.qd
        known = known + np.asarray(arm.stiffness) * (self.q - np.asarray(arm.springref))
        return known + self.dry

    @functools.cached_property
    def sliding(self) -> Float[np.ndarray, "n dof"]:
        """Sign of each joint's velocity, smoothed."""
        return np.tanh(self.qd / 0.02)

    @functools.cached_property
    def dry(self) -> Float[np.ndarray, "n dof"]:
        """Torque of the dry friction that the model holds [N m]."""
        return np.asarray(self.arm.frictionloss) * self.sliding

    @functools.cached_property
    def inertial(self) -> Float[np.ndarray, "n dof"]:
        """Torque without gravity [N m]."""
        return self.parts[0] @ np.asarray(self.arm.standard).ravel() + self.known

    @functools.cached_property
    def weight(self) -> Float[np.ndarray, "n dof 3"]:
        """Torque of a unit of gravity along each axis of the base [N m s²/m]."""
        return np.moveaxis(self.parts[1] @ np.asarray(self.arm.standard).ravel(), 0, -1)

    @functools.cached_property
    def torque(self) -> Float[np.ndarray, "n dof"]:
        """Torque of the whole model [N m]."""
        return self.inertial + self.weight @ self.gravity

    @functools.cached_property
    def size(self) -> Float[np.ndarray, " dof"]:
        """Of each joint's torque, rms [N m]; no less than a share of the largest. The arm's drives are what they
        are, however it is mounted: by the model's own gravity."""
        torque = self.inertial + self.weight @ np.asarray(self.arm.chain.gravity, float)
        rms = np.sqrt(np.mean(torque**2, 0))
        return np.maximum(rms, max(_SMALL * rms.max(), 1e-6))

    @functools.cached_property
    def spread(self) -> Float[np.ndarray, "standard n"]:
        """Deviations of links and of a payload at the last one."""
        blocks = [_link_spread(phi) for phi in np.asarray(self.arm.standard)]
        share, reach = _LOAD
        mass = share * max(float(np.asarray(self.arm.standard)[:, 0].sum()), 1.0)
        payload = np.zeros((10 * self.arm.dof, 10))
        payload[-10:] = np.diag([mass, *3 * [mass * reach], *6 * [mass * reach**2]])
        return np.concatenate([np.asarray(scipy.linalg.block_diag(*blocks)), payload], 1)

    @property
    def frictions(self) -> Float[np.ndarray, " frictions"]:
        """Sizes that dry friction may have, F [N m]."""
        return _FRICTIONS * self.size.max()

    def columns(self, j: int) -> tuple[Float[np.ndarray, "n p"], Float[np.ndarray, "n r"]]:
        """B and C of joint j."""
        size, qd = self.size[j], self.qd[:, j]
        whole = self.parts[0][:, j] + np.tensordot(self.gravity, self.parts[1][:, :, j], 1)
        unit = lambda x: x / max(float(np.sqrt(np.mean(x**2))), 1e-9)
        joint = [
            unit(qd),
            unit(np.tanh(qd / 0.2)),
            np.ones(len(qd)),
            unit(self.qdd[:, j]),
            unit(self.q[:, j] - self.q[:, j].mean()),
            *(unit(other) for other in np.delete(self.qd, j, 1).T),
        ]
        slow = np.gradient(self.torque[:, j], self.samples.time)
        held = np.exp(-0.5 * (qd / _RESTS) ** 2)
        rest = np.where(held > _RESTING, np.cumsum(np.diff(held > _RESTING, prepend=False)), 0)
        samples = np.bincount(rest)
        longest = [k for k in np.argsort(-samples) if k and samples[k] > 1][:_LONGEST]
        in_rests = held[:, None] * (rest[:, None] == longest)
        short = np.diag(held)[:, (held > 1e-3) & ~np.isin(rest, longest)]
        g = float(np.linalg.norm(self.gravity))
        tilt = self.weight[:, j] @ _across(self.gravity) * (g * _TILT) if g > 0 else np.zeros((len(qd), 0))
        B = np.column_stack(
            [
                whole @ self.spread,
                _FREE * size * np.stack(joint, 1),
                _GAIN * self.torque[:, j],
                _DELAY * slow,
                tilt,
                _FREE * size * short,
            ]
        )
        return B, np.column_stack([_SLIDING * self.sliding[:, j], _HELD * in_rests])

    def bases(self, j: int) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, float]]:
        """For each correlation time of the error: what turns samples into ones that are independent but for dry
        friction, their variances by B, C turned, and the logarithm of the determinant."""
        if j in self._bases:
            return self._bases[j]
        (B, C), out = self.columns(j), []
        for white, determinant in self.samples.errors:
            X = white @ B
            variances, U = np.linalg.eigh(X @ X.T)
            turned = U.T @ white
            out.append((turned, np.maximum(variances, 0.0), turned @ C, determinant))
        self._bases[j] = out
        return out

    def products(self, j: int, vectors: Float[np.ndarray, "n k"]) -> tuple[np.ndarray, np.ndarray]:
        r"""$v_a^\top V^{-1} v_b$ of vectors and $\log\det V$, V the covariance of joint j's column.

        Returns:
            products `(memories, frictions, hypotheses, k, k)` and logarithms `(memories, frictions, hypotheses)`;
            by Woodbury's identity, as C has few columns.
        """
        F2 = np.square(self.frictions)[:, None, None]
        products, determinants = [], []
        for turned, variances, C, determinant in self.bases(j):
            w = 1 / _totals(variances, self.size[j])
            X = np.column_stack([turned @ vectors, C])
            k, n = vectors.shape[1], X.shape[1]
            XX = (np.einsum("na,nb->abn", X, X).reshape(n * n, -1) @ w).T.reshape(-1, n, n)
            sizes, U = np.linalg.eigh(XX[:, k:, k:])
            grows = F2 * np.maximum(sizes, 0.0)
            CX = np.swapaxes(U, 1, 2) @ XX[:, k:, :k]
            by_friction = np.swapaxes(CX, 1, 2) @ ((F2 / (1 + grows))[..., None] * CX)
            products.append(XX[:, :k, :k] - by_friction)
            determinants.append(determinant - np.sum(np.log(w), 0) + np.sum(np.log1p(grows), -1))
        return np.array(products), np.array(determinants)

    def joint_evidence(
        self, j: int, column: Float[np.ndarray, " n"], mean: Float[np.ndarray, " n"], factors: np.ndarray
    ) -> Float[np.ndarray, " factors"]:
        """Logarithm of the probability of a column, were it each factor times joint j's torque [nats].

        What the model holds beyond its links and dry friction may be a stand-in for nothing: it is there or not,
        alike likely. Of dry friction any size is, whatever the model holds.
        """
        plain = mean - self.dry[:, j]
        means = [plain]
        if np.any(self.known[:, j] != self.dry[:, j]):
            means.append(mean - self.known[:, j])
        P, determinants = self.products(j, np.column_stack([column, self.sliding[:, j], *means]))
        F, squares = self.frictions[:, None], []
        for m in range(2, 2 + len(means)):
            yy, ym = P[..., 0, 0], P[..., 0, m] + F * P[..., 0, 1]
            mm = P[..., m, m] + 2 * F * P[..., 1, m] + F**2 * P[..., 1, 1] + determinants
            squares.append(np.stack([yy.ravel(), ym.ravel(), mm.ravel()]))
        said = _mixed(np.concatenate(squares, 1), 1 / factors)
        n = len(column)
        return said - n * np.log(np.abs(factors)) - 0.5 * n * np.log(2 * np.pi)

    @functools.cached_property
    def tau(self) -> Float[np.ndarray, "n dof"]:
        """The column of each joint, in the order that q is read in."""
        return self.samples.tau[:, np.argsort(self.order)]

    def evidence(self, torque: np.ndarray | None = None) -> float:
        """Of the columns as they are, over all joints [nats]; `torque` in place of the model's."""
        mean = self.torque if torque is None else torque
        one = np.ones(1)
        return float(sum(self.joint_evidence(j, self.tau[:, j], mean[:, j], one)[0] for j in self.moving))

    @functools.cached_property
    def by_factor(self) -> tuple[np.ndarray, np.ndarray]:
        """Evidence of each joint's column by the factor, and by the same factor with the other sign."""
        both = np.r_[_FACTORS, -_FACTORS]
        said = np.zeros((self.arm.dof, len(both)))
        for j in self.moving:
            said[j] = self.joint_evidence(j, self.tau[:, j], self.torque[:, j], both)
        return said[:, : len(_FACTORS)], said[:, len(_FACTORS) :]

    @functools.cached_property
    def ratio(self) -> Float[np.ndarray, " dof"]:
        """Size of each joint's column over that of the model's torque, rms."""
        rms = [np.sqrt(np.mean(x**2, 0)) for x in (self.tau, self.torque)]
        return rms[0] / np.maximum(rms[1], 1e-12)

    @functools.cached_property
    def left(self) -> Float[np.ndarray, " dof"]:
        """Share of each joint's column that the model's torque leaves, rms."""
        rms = np.sqrt(np.mean(self.tau**2, 0))
        return np.sqrt(np.mean((self.tau - self.torque) ** 2, 0)) / np.maximum(rms, 1e-12)


def _parts(models: Sequence[_Model]) -> list[tuple[np.ndarray, np.ndarray]]:
    """`_Model.parts` of models with `_MOST` samples together, at most."""
    q, qd, qdd = (np.concatenate([getattr(m, name) for m in models]) for name in ("q", "qd", "qdd"))
    n, dof = q.shape
    gravity = np.repeat([[0, 0, 0], *np.eye(3).tolist()], _MOST, axis=0)
    q, qd, qdd = (np.pad(x, ((0, _MOST - n), (0, 0))) for x in (q, qd, qdd))
    at_rest = np.zeros((3 * _MOST, dof))
    motion = np.tile(q, (4, 1)), np.concatenate([qd, at_rest]), np.concatenate([qdd, at_rest])
    Y = np.asarray(_regressors(models[0].arm.chain, gravity, *motion)).reshape(4, _MOST, dof, -1)
    ends = np.cumsum([len(m.q) for m in models])
    return [(y[0], y[1:]) for y in np.split(Y, ends, axis=1)[:-1]]


_regressors = jax.jit(
    jax.vmap(
        lambda chain, gravity, q, qd, qdd: regressor(dataclasses.replace(chain, gravity=gravity), q, qd, qdd),
        in_axes=(None, 0, 0, 0, 0),
    )
)


def _mixed(squares: Float[np.ndarray, "3 hypotheses"], x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    r"""$\log$ of the mean over hypotheses of $\exp(-\tfrac12 (a x^2 - 2 b x + c))$; a, b, c: rows of `squares`.

    Over a stretch of x what is `_NOTHING` below another hypothesis throughout adds nothing there.
    """
    at = lambda squares, x: -0.5 * ((squares[0] * x - 2 * squares[1]) * x + squares[2])
    out = []
    for some in np.split(x, range(_TOGETHER, len(x), _TOGETHER)):
        ends = some.min(), some.max()
        peak = np.clip(squares[1] / np.maximum(squares[0], 1e-300), *ends)
        least = np.max(np.minimum(at(squares, ends[0]), at(squares, ends[1])))
        counts = squares[:, at(squares, peak) > least - _NOTHING]
        out.append(_logsumexp(at(counts[:, :, None], some), axis=0))
    return np.concatenate(out) - np.log(squares.shape[1])


def _logsumexp(x: np.ndarray, axis: int | None = None, keepdims: bool = False) -> Any:
    """scipy's, without what it takes to serve many kinds of array."""
    top = np.max(x, axis=axis, keepdims=True)
    said = top + np.log(np.sum(np.exp(x - top), axis=axis, keepdims=True))
    return said if keepdims else np.squeeze(said, axis)


def _totals(variances: Float[np.ndarray, " n"], size: float) -> Float[np.ndarray, "n hypotheses"]:
    """Variances of independent samples, for each scale of B and size of the error, the sizes running fastest."""
    scales, sizes = np.meshgrid(_SHARES, _SIZES * size, indexing="ij")
    return variances[:, None] * scales.ravel() ** 2 + sizes.ravel() ** 2


def _link_spread(phi: Float[np.ndarray, "10"]) -> Float[np.ndarray, "10 10"]:
    """Square root of a link's covariance: mass with all that goes with it, centre of mass, inertia."""
    share, shift, turn = _LINKS
    mass = max(abs(float(phi[0])), 0.1)
    block = np.zeros((10, 10))
    block[:, 0] = share * phi
    block[1:4, 1:4] = shift * mass * np.eye(3)
    block[4:, 4:] = (turn * float(np.abs(phi[[4, 6, 9]]).max()) + mass * shift**2) * np.eye(6)
    return block


def _across(gravity: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 2"]:
    """Two unit vectors across gravity."""
    return np.linalg.svd(gravity[None])[2][1:].T


def _without_gravity(model: _Model) -> list[_Reading]:
    dof = model.arm.dof
    if not np.any(model.gravity):
        return []
    zero = _Model(model.arm, model.samples, model.order, np.zeros(3))
    # what is taken out may be another model's gravity: links' errors then show in what is left of it
    score = np.log(_PRIOR) + float(np.logaddexp(model.evidence(model.inertial), zero.evidence()) - np.log(2))
    return [_Reading("gravity_removed", score, np.ones(dof), np.arange(dof))]


def _signs(model: _Model) -> list[_Reading]:
    """All joints reversed, or those that gain by it."""
    one = int(np.argmin(np.abs(np.log(_FACTORS))))
    plus, minus = (said[:, one] for said in model.by_factor)
    dof, out = model.arm.dof, []
    some = np.zeros(dof, bool)
    some[model.moving] = (minus - plus)[model.moving] > _EACH
    for flipped in [np.ones(dof, bool)] if some.all() else [np.ones(dof, bool), some]:
        count = int(flipped.sum())
        if count:
            prior = np.log(_PRIOR) - (0.0 if count == dof else np.log(dof * scipy.special.comb(dof, count)))
            score = prior + float(np.sum(np.where(flipped, minus, plus)))
            out.append(_Reading("sign", score, np.where(flipped, -1.0, 1.0), np.arange(dof)))
    return out


def _scales(model: _Model) -> list[_Reading]:
    """A common constant, one of a joint by itself, or a constant of each joint's own; of either sign."""
    dof, moving, out = model.arm.dof, model.moving, []
    plus, minus = model.by_factor
    logs = np.log(_FACTORS)
    far = np.abs(logs) > np.log(_FAR)
    units = np.log(list(_UNITS.values()))
    usual = far & (np.abs(logs[:, None] - units).min(1) < np.log(_NEAR))
    same = np.arange(dof)
    prior = np.log(_PRIOR) - np.log(far.sum())
    single = usual & (logs > np.log(_ALONE))
    for said, sign in ((plus, 1.0), (minus, -1.0)):
        total = np.where(far, said[moving].sum(0), -np.inf)
        k = int(np.argmax(total))
        score = prior + float(_logsumexp(total))
        common = float(np.exp(logs[k]))
        known = min(_UNITS.values(), key=lambda unit: abs(np.log(unit / common)))
        if usual[k]:
            score += np.log(far.sum() / 5)  # one of few usual units, not any number
        else:
            score += np.log(_RARE)
        common = known if usual[k] else common
        kind = "motor_side" if not usual[k] and 1 / _GEARS[1] < common < 1 / _GEARS[0] else "unit"
        out.append(_Reading(kind, score, np.full(dof, sign * common), same))
        # a motor's constant a joint, none near 1: each about a common one, of which all are equally likely
        apart = np.where(far, -0.5 * ((logs[:, None] - logs) / _OWN) ** 2, -np.inf)
        apart -= _logsumexp(apart, axis=1, keepdims=True)
        each = _logsumexp(said[moving][:, None] + apart, axis=2)
        total = np.where(far, each.sum(0), -np.inf)
        score = prior + float(_logsumexp(total))
        c = int(np.argmax(total))
        factors = np.full(dof, np.exp(logs[c]))
        factors[moving] = np.exp(logs[np.argmax(said[moving] + apart[c], 1)])
        median = float(np.median(factors[moving]))
        slow = factors[moving] < 1 / _GEARS[0] * 1.5  # friction may hide one joint's
        geared = 1 / _GEARS[1] < median < 1 / _GEARS[0] and int(np.sum(~slow)) <= 1
        out.append(_Reading("motor_side" if geared else "current", score, sign * factors, same))
    one = int(np.argmin(np.abs(logs)))
    factors, score, count = np.ones(dof), np.log(_PRIOR), 0
    for j in moving:
        # other numbers are likelier to be something else there, as is one that makes torque far too small
        may_be = single & (logs < 2 * np.log(max(model.ratio[j], 1e-12)))
        alone = np.where(may_be, plus[j], -1e9)
        gain = _logsumexp(alone) - plus[j, one] - np.log(dof * single.sum())
        if gain > 2 * _EACH:
            k = float(np.exp(logs[np.argmax(alone)]))
            factors[j], count = min(_UNITS.values(), key=lambda unit: abs(np.log(unit / k))), count + 1
        score += plus[j, one] + (gain if factors[j] != 1 else 0.0)
    if 0 < count < len(moving):
        out.append(_Reading("unit", float(score), factors, same))
    return out


def _orders(model: _Model, plain: float) -> list[_Reading]:
    """Columns of torque out of order; or those of all channels."""
    dof, moving = model.arm.dof, model.moving
    if len(moving) < dof:
        return []
    one = np.ones(1)
    apart = model.left > _OFF
    if apart.sum() < 2:
        return []
    said = np.array(
        [
            [model.joint_evidence(j, model.samples.tau[:, c], model.torque[:, j], one)[0] for j in range(dof)]
            for c in range(dof)
        ]
    )
    _, order = scipy.optimize.linear_sum_assignment(-said)
    out = []
    if _all(apart[order != np.arange(dof)]):
        score = _order_prior(order) + float(said[np.arange(dof), order].sum())
        out.append(_Reading("joint_order", score, np.ones(dof), order))
    best, score = np.arange(dof), plain
    tried, coarse = {tuple(best)}, model.samples.every(_COARSE)
    for _ in range(3):  # swaps, one upon the other, from the order that is best so far
        swaps = [_swapped(best, i, k) for i in range(dof) for k in range(i)]
        fresh = [o for o in (*swaps, best[::-1].copy()) if tuple(o) not in tried]
        tried |= {tuple(o) for o in fresh}
        rough = [_Model(model.arm, coarse, order) for order in fresh]
        room = _MOST // len(coarse.time)
        for together in (rough[i : i + room] for i in range(0, len(rough), room)):
            for one_of, parts in zip(together, _parts(together), strict=True):
                one_of.parts = parts
        order = max(rough, key=_Model.evidence).order
        top = _Model(model.arm, model.samples, order).evidence()
        if top < score + _BETTER:
            break
        best, score = order, top
    if _all(apart[best != np.arange(dof)]):
        total = _order_prior(best) + score
        out.append(_Reading("joint_order", total, np.ones(dof), best, whole_order=True))
    return out


def _all(apart: np.ndarray) -> bool:
    """Whether there are joints out of order, and the plain reading is wrong at each of them."""
    return len(apart) > 0 and bool(apart.all())


def _swapped(order: Int[np.ndarray, " dof"], i: int, k: int) -> Int[np.ndarray, " dof"]:
    out = order.copy()
    out[[i, k]] = out[[k, i]]
    return out


def _order_prior(order: Int[np.ndarray, " dof"]) -> float:
    """Two joints swapped, all in reverse, or any order at all."""
    dof = len(order)
    off = int(np.sum(order != np.arange(dof)))
    if off == 2:
        return float(np.log(_PRIOR / scipy.special.comb(dof, 2)))
    if np.all(order == np.arange(dof)[::-1]):
        return float(np.log(_PRIOR))
    return float(np.log(_PRIOR) - scipy.special.gammaln(dof + 1))


def _mountings(model: _Model) -> list[_Reading]:
    """Gravity of another direction, or the moon's along the model's: its size is known wherever an arm stands."""
    size, one, order = float(np.linalg.norm(model.gravity)), np.ones(model.arm.dof), np.arange(model.arm.dof)
    out = []
    if size:
        moon = _MOON / size * model.gravity
        score = np.log(_RARE * _PRIOR) + _Model(model.arm, model.samples, model.order, moon).evidence()
        out.append(_Reading("mounting", score, one, order, gravity=moon))
    if (turned := _turned(model, size or _EARTH)) is not None:
        g, evidence = turned
        out.append(_Reading("mounting", np.log(_PRIOR) + evidence, one, order, gravity=g))
    return out


def _turned(model: _Model, size: float) -> tuple[Float[np.ndarray, "3"], float] | None:
    r"""The likeliest gravity of some size [m/s²], all directions likely alike, and the evidence of that [nats];
    None where that is the model's.

    With links' errors turned along; by Laplace's method in the plane that touches the sphere there.
    """
    current, g, K = model, model.gravity, np.eye(3)
    for _ in range(3):
        H, h = np.zeros((3, 3)), np.zeros(3)
        for j in model.moving:
            H, h = _informed(current, j, H, h)
        g, K = _on_sphere(H, h, size)
        if np.any(model.gravity) and _angle(g, model.gravity) < 0.5 * _TOLD:
            return None
        current = _Model(model.arm, model.samples, model.order, g)
    if np.any(model.gravity) and _angle(g, model.gravity) < _TOLD:
        return None
    plane = _across(g)
    # of all directions, of 4 pi size², the recording leaves 2 pi / sqrt(det)
    left = -np.log(2 * size**2) - 0.5 * float(np.linalg.slogdet(plane.T @ K @ plane)[1])
    return g, current.evidence() + min(left, 0.0)


def _on_sphere(
    H: Float[np.ndarray, "3 3"], h: Float[np.ndarray, "3"], size: float
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    r"""The g of that size that maximises $h^\top g - \tfrac12 g^\top H g$, and $K = H + \mu$ with $K g = h$."""
    values, V = np.linalg.eigh(H)
    along = V.T @ h

    def beyond(step: float) -> float:  # |g| falls from infinity to nothing
        return float(np.linalg.norm(along / (values - values[0] + step)) - size)

    most = float(np.linalg.norm(along)) / size + 1e-9
    least = 1e-12 * max(most, float(values[-1]))
    step = scipy.optimize.brentq(beyond, least, most) if beyond(least) > 0 > beyond(most) else least
    g = V @ (along / (values - values[0] + step))
    return g * (size / max(float(np.linalg.norm(g)), 1e-300)), H + (step - values[0]) * np.eye(3)


def _informed(model: _Model, j: int, H: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What joint j tells of gravity, by its likeliest error."""
    r = model.tau[:, j] - model.inertial[:, j] + model.dry[:, j]
    P, determinants = model.products(j, np.column_stack([model.weight[:, j], r, model.sliding[:, j]]))
    F = model.frictions[:, None]
    HA, hA = P[..., :3, :3], P[..., :3, 3] - F[..., None] * P[..., :3, 4]
    rr = P[..., 3, 3] - 2 * F * P[..., 3, 4] + F**2 * P[..., 4, 4]
    K = HA + np.eye(3) / _EARTH**2
    fit = np.sum(hA * np.linalg.solve(K, hA[..., None])[..., 0], -1)
    said = fit - rr - determinants - np.linalg.slogdet(K)[1]
    likeliest = np.unravel_index(np.argmax(said), said.shape)
    return H + HA[likeliest], h + hA[likeliest]


def _angle(g: np.ndarray, other: np.ndarray) -> float:
    """Between two vectors [degrees]."""
    size = float(np.linalg.norm(g) * np.linalg.norm(other))
    return float(np.degrees(np.arccos(np.clip(g @ other / size, -1, 1)))) if size > 0 else 0.0


def _told(best: _Reading, model: _Model, confidence: float, gain: float) -> Meaning:
    """The reading in words."""
    joints = _altered(best)
    rms = np.sqrt(np.mean((model.samples.tau - model.torque) ** 2, 0))
    says, options, mend = _words(best, model, joints)
    return Meaning(
        kind=best.kind,
        joints=tuple(int(j) for j in joints),
        confidence=confidence,
        evidence=gain,
        factors=tuple(float(k) for k in best.factors),
        order=tuple(int(j) for j in best.order),
        whole_order=best.whole_order,
        gravity=None if best.gravity is None else tuple(map(float, best.gravity)),  # pyright: ignore
        rms=tuple(float(v) for v in rms),
        says=says,
        options=options,
        mend=mend,
    )


def _words(best: _Reading, model: _Model, joints: np.ndarray) -> tuple[str, str, str]:
    """What the column is, the options that read it so, and what mends it."""
    dof = model.arm.dof
    named = joints_named(joints.tolist())
    if best.kind == "gravity_removed":
        options = f"--gravity {REMOVED}"
        return (
            "The torque column holds no gravity: it agrees with the model's inertia and friction alone.",
            options,
            f"Give `{options}`, which adds the model's; or record torque with gravity in it.",
        )
    if best.kind == "sign":
        where = "of all joints" if len(joints) == dof else f"of {named}"
        options = _sign_option(best.factors)
        return (
            f"The torque column {where} has the wrong sign: positive is along the joint axis.",
            options,
            f"Give `{options}`.",
        )
    if best.kind in ("unit", "current", "motor_side"):
        return _scale_words(best, joints, named)
    if best.kind == "joint_order":
        order = " ".join(str(j + 1) for j in best.order)
        what = "All columns" if best.whole_order else "The torque columns"
        options = f"--joint-order {'' if best.whole_order else 'tau '}{order}"
        return f"{what} are out of order: they are those of joints {order}.", options, f"Give `{options}`."
    assert best.gravity is not None
    g = best.gravity
    size, expected = float(np.linalg.norm(g)), float(np.linalg.norm(model.gravity))
    if 0.8 < size / max(expected, 1e-9) < 1.25:
        g = g * expected / size  # its direction is what was found
    x, y, z = (f"{v + 0.0:.3g}" if abs(v) > 1e-3 * size else "0" for v in g)
    options = f"--gravity {x} {y} {z}"
    return (
        f"The arm is mounted otherwise than the model: {_mounted(best.gravity, model.gravity)}.",
        options,
        f'Give `{options}`, or set gravity="{x} {y} {z}" in the model\'s <option>.',
    )


def _scale_words(best: _Reading, joints: np.ndarray, named: str) -> tuple[str, str, str]:
    """`_words` of a column in another unit, or of current."""
    every = len(joints) == len(best.factors)
    sizes = np.abs(best.factors)
    listed = " ".join(f"{k:.3g}" for k in sizes)
    worth = " ".join(f"{1 / k:.3g}" for k in sizes)
    reverse = f" {_sign_option(best.factors)}" if np.any(best.factors < 0) else ""
    if best.kind == "unit":
        if not every:
            options = f"--torque-unit {worth}{reverse}"
            says = f"The torque column of {named} is in another unit: {listed} times the joint torque."
            return says, options, f"Give `{options}`."
        k = float(sizes[0])
        unit = next((name for name, size in _UNITS.items() if size == k), "")
        options = f"--torque-unit {unit or f'{1 / k:.3g}'}{reverse}"
        says = f"The torque column is {k:.4g} times the joint torque" + (f": {unit}." if unit else ".")
        return says, options, f"Give `{options}`."
    options = f"--torque-unit {worth}{reverse}"
    says = (
        f"The torque column is like motor current, with a constant a joint: {listed} A/(N·m)."
        if best.kind == "current"
        else f"The torque column is like torque on the motors' side of the gears: {listed} of the joint's."
    )
    return (
        says,
        options,
        f"Give the drives' own constants, N·m per unit of the column; as the model has it, about `{options}`.",
    )


def _sign_option(factors: np.ndarray) -> str:
    """`--torque-sign` for factors of these signs."""
    signs = ["-" if k < 0 else "+" for k in factors]
    return f"--torque-sign {' '.join(signs) if '+' in signs else '-'}"


def _mounted(g: np.ndarray, model: np.ndarray) -> str:
    """Wall, ceiling, tilt or moon."""
    size, expected, angle = float(np.linalg.norm(g)), float(np.linalg.norm(model)), _angle(g, model)
    vector = f"gravity is about ({g[0]:.2f}, {g[1]:.2f}, {g[2]:.2f}) m/s² in its base"
    if size < 0.5 * expected:
        return f"{vector}, {size:.2g} m/s² in size, as on the moon"
    if expected == 0:
        return f"{vector}, where the model has none"
    what = f"tilted by {angle:.0f} degrees"
    what = "on a ceiling" if angle > 150 else "on a wall" if 70 < angle < 110 else what
    return f"{vector}, as {what}"
