"""What the sensors add: offsets, scales, drift, crosstalk, and clocks out of step."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.signal
from jaxtyping import Array, Float

from ..arms.arm import Arm
from .effect import (
    COMMON,
    EVER,
    AbstractArmEffect,
    AbstractInstantEffect,
    Coefficient,
    Shape,
    counted,
    settling,
)
from .motion import Channels, Joint, Motion
from .still import LawAtRest, Levels
from .twist import low_passed


class TorqueOffset(AbstractInstantEffect):
    r"""Constant bias of a torque sensor, $\tau_j = b$."""

    name: ClassVar[str] = "torque_offset"
    family: ClassVar[str] = "sensor"
    reveals: ClassVar[str] = "rests, and poses on both sides of the joint's zero of gravity"
    at_rest: ClassVar[str] = "a bias of the torque sensors"
    prior: ClassVar[float] = COMMON
    commonplace: ClassVar[bool] = True
    acts_on: ClassVar[Literal["plant", "position", "torque"]] = "torque"

    joint: Joint

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["TorqueOffset"]:
        return [cls(j) for j in range(arm.dof)]

    @classmethod
    def while_still(cls, levels: Levels) -> Sequence[LawAtRest]:
        """The same in every pose: of all sensors, or of one."""
        return levels.of_all_or_one(levels.alike, 0.06) if levels.when == "throughout" else []

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return (Coefficient("offset", "N·m"),)

    @property
    def equation(self) -> str:
        return "tau = offset"

    def at(self, s: Channels) -> Float[Array, " n"]:
        return jnp.ones_like(s.t)[None]

    def sensed(self, c, t, tau):
        return tau.at[:, self.joint].add(c[0])

    def true(self, c, t, tau):
        return tau.at[:, self.joint].add(-c[0])


class TorqueGain(AbstractInstantEffect):
    r"""Wrong scale of a torque sensor, $\tau_j = e\,\tau_j^{true}$.

    References:
        Gautier and Briot, IROS 2011: a gain common to all joints needs a known load.
    """

    name: ClassVar[str] = "torque_gain"
    family: ClassVar[str] = "sensor"
    seen_against: ClassVar[str] = "model torque"
    reveals: ClassVar[str] = "a known load at the flange"
    number: ClassVar[str] = "scale"
    acts_on: ClassVar[Literal["plant", "position", "torque"]] = "torque"

    joint: Joint

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["TorqueGain"]:
        return [cls(j) for j in range(arm.dof)]

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return (Coefficient("gain_error", "1", scale=0.1),)

    @property
    def equation(self) -> str:
        return "tau_measured = (1 + gain_error) * tau"

    def beyond_normal(self, c, deviation):
        """A gain is a factor, as likely halved as doubled: its logarithm is normal."""
        return 0.5 * float((c[0] ** 2 - np.log(max(1 + c[0], 1e-3)) ** 2) / deviation[0] ** 2)

    def at(self, s: Channels) -> Float[Array, " n"]:
        return s.torque[self.joint][None]

    def sensed(self, c, t, tau):
        return tau.at[:, self.joint].multiply(1 + c[0])

    def true(self, c, t, tau):
        return tau.at[:, self.joint].divide(1 + c[0])


class TorqueDrift(AbstractInstantEffect):
    r"""Bias of a torque sensor that changes over time, $\tau_j = a\,g(t) + b$ with $g = 1 - e^{-t/T}$.

    Time is counted from `since`, when the recordings began; they ended at `until` [s]. Before and after, it goes
    on as `settling` says. Form "extra" is without the constant; "wave" is $a\,t + b + s \sin(2\pi t/T)
    + c \cos(2\pi t/T)$, a bias that wanders; "wandering" adds half the period to it. What wanders came from and
    goes to nobody knows where: away from the recordings it is, within $T/2\pi$, its usual value, of which each
    period that was recorded tells as much as the user's model, which has none.
    """

    name: ClassVar[str] = "torque_drift"
    family: ClassVar[str] = "sensor"
    prior: ClassVar[float] = -17.0
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("time_constant", "s", 0.5, 2000.0),)
    reveals: ClassVar[str] = "the same poses early and late"
    at_rest: ClassVar[str] = "a torque sensor that drifts"
    drifts: ClassVar[bool] = True
    acts_on: ClassVar[Literal["plant", "position", "torque"]] = "torque"

    joint: Joint
    time_constant: Float[Array, ""] | float
    form: str = eqx.field(static=True)
    until: float = EVER
    since: float = 0.0

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["TorqueDrift"]:
        shapes = [(form, T) for form in ("extra", "offset") for T in (2.0, 6.0, 20.0, 500.0)]
        shapes += [(form, T) for form in ("wave", "wandering") for T in (6.0, 10.0, 16.0, 30.0, 60.0)]
        return [cls(j, T, form) for form, T in shapes for j in range(arm.dof)]

    @classmethod
    def while_still(cls, levels: Levels) -> Sequence[LawAtRest]:
        return [] if levels.when == "throughout" else [LawAtRest(levels.free, 0.05, told_by="sliding")]

    def counted_from(self, start: float) -> "TorqueDrift":
        return dataclasses.replace(self, since=start)

    def beyond(self, recorded: Sequence[Channels]) -> "TorqueDrift":
        return dataclasses.replace(self, until=max(float(s.t[-1]) for s in recorded))

    @property
    def period(self) -> float:
        return float(self.time_constant) if self.form in ("wave", "wandering") else 0.0

    @property
    def steady(self) -> tuple[TorqueOffset, ...]:
        """The bias that does not change."""
        return (TorqueOffset(self.joint),)

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        change, offset = Coefficient("change", "N·m"), Coefficient("offset", "N·m")
        wave = Coefficient("trend", "N·m/s"), offset, Coefficient("sine", "N·m"), Coefficient("cosine", "N·m")
        half = Coefficient("sine_2", "N·m"), Coefficient("cosine_2", "N·m")
        forms = {"extra": (change,), "offset": (change, offset), "wave": wave, "wandering": (*wave, *half)}
        return forms[self.form]

    @property
    def equation(self) -> str:
        t = counted(self.since)
        wave = f"offset + trend * {t} + sine * sin(w {t}) + cosine * cos(w {t})"
        return (
            "tau = "
            + {
                "extra": f"change * (1 - exp(-{t} / time_constant))",
                "offset": f"offset + change * (1 - exp(-{t} / time_constant))",
                "wave": f"{wave}, w = 2 pi / time_constant",
                "wandering": f"{wave} + sine_2 * sin(2 w {t}) + cosine_2 * cos(2 w {t}),"
                " w = 2 pi / time_constant",
            }[self.form]
        )

    def at(self, s: Channels) -> Float[Array, " n"]:
        lasted = self.until - self.since
        t = jnp.clip(s.t - self.since, 0.0, lasted)
        one = jnp.ones_like(t)
        if self.form in ("wave", "wandering"):
            w = 2 * jnp.pi / self.time_constant
            waves = (w,) if self.form == "wave" else (w, 2 * w)
            now = [t, one, *(f(k * t) for k in waves for f in (jnp.sin, jnp.cos))]
            ends = [k * lasted for k in waves]
            means = [m for x in ends for m in ((1 - jnp.cos(x)) / x, jnp.sin(x) / x)]
            mean = jnp.stack([0.5 * lasted * one, one, *means])
            usual = mean * lasted / (lasted + self.time_constant)
            away = jnp.abs(s.t - self.since - t)
            return usual + (jnp.stack(now) - usual) * jnp.exp(-w * away)
        g = settling(s.t, self.time_constant, self.since, self.until)
        return jnp.stack([g] if self.form == "extra" else [g, one])

    def sensed(self, c, t, tau):
        return tau.at[:, self.joint].add(self._bias(c, t))

    def true(self, c, t, tau):
        return tau.at[:, self.joint].add(-self._bias(c, t))

    def _bias(self, c: Array, t: Array) -> Array:
        nothing = jnp.zeros((t.shape[0], 1))
        return jax.vmap(self.at)(Channels(t, nothing, nothing, nothing, nothing, nothing)) @ c


class TorqueCrosstalk(AbstractInstantEffect):
    r"""Torque of one joint appearing in another's sensor, $\tau_j = e\,\tau_k$.

    $\tau_k$ is what joint k's own sensor shows; the nominal torque lacks whatever else is missing there.
    """

    name: ClassVar[str] = "torque_crosstalk"
    family: ClassVar[str] = "sensor"
    seen_against: ClassVar[str] = "source torque"
    reveals: ClassVar[str] = "poses in which the two joints' torques differ"
    acts_on: ClassVar[Literal["plant", "position", "torque"]] = "torque"
    takes_shown: ClassVar[bool] = True

    joint: Joint
    source: Joint

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["TorqueCrosstalk"]:
        return [cls(j, k) for j in range(arm.dof) for k in range(arm.dof) if j != k]

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return (Coefficient(f"crosstalk_from_{int(self.source) + 1}", "1", scale=0.1),)

    @property
    def equation(self) -> str:
        return f"tau = crosstalk_from_{int(self.source) + 1} * tau_{int(self.source) + 1}"

    def at(self, s: Channels) -> Float[Array, " n"]:
        return (s.torque if s.shown is None else s.shown)[self.source][None]

    def sensed(self, c, t, tau):
        return tau.at[:, self.joint].add(c[0] * tau[:, self.source])

    def true(self, c, t, tau):
        return tau.at[:, self.joint].add(-c[0] * tau[:, self.source])


class EncoderOffset(AbstractArmEffect):
    r"""Constant bias of a position sensor, $\tau(q + \Delta q_j) - \tau(q)$.

    Columns are $(\tau(q + a) - \tau(q))/a$ of the nominal torque, so that the coefficient is $\Delta q_j$ near a.
    What is told is the sensor's bias, $-\Delta q_j$.
    """

    name: ClassVar[str] = "encoder_offset"
    family: ClassVar[str] = "sensor"
    seen_against: ClassVar[str] = "position"
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("around", "rad", -0.6, 0.6, False, pivot=True),)
    reveals: ClassVar[str] = "the joint at rest over its range; with and without payload"
    acts_on: ClassVar[Literal["plant", "position", "torque"]] = "position"

    joint: Joint
    around: float

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["EncoderOffset"]:
        return [cls(j, a) for a in (-0.2, -0.06, 0.01, 0.06, 0.2) for j in range(arm.dof)]

    @property
    def joints(self) -> tuple[int, ...]:
        return (int(self.joint),)

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return (Coefficient("offset", "rad", scale=0.1),)

    @property
    def equation(self) -> str:
        return "q_measured = q_true + offset"

    def over(self, motion: Motion) -> Float[np.ndarray, "time dof n"]:
        a = np.copysign(max(abs(self.around), 1e-4), self.around)
        dq = np.zeros_like(motion.q)
        dq[:, int(self.joint)] = a
        return ((motion.moved(dq).load - motion.load) / a)[..., None]

    def shift(self, c, arm, z, s, dt):
        return jnp.zeros_like(s.q).at[self.joint].set(-c[0]), z

    def parameters(self, c, covariance):
        (offset,) = super().parameters(c, covariance)
        return [{**offset, "value": -offset["value"]}]


class TimeDelay(AbstractArmEffect):
    r"""Torque out of step with motion: $\tau_{measured}(t) = \tau(t - d)$, in all joints or in one.

    Torque sensors are filtered, so that torque is mostly late; it is ahead (forms that end in "ahead") where the
    positions come by a slower way. Columns are $(\tau(t - d_0) - \tau(t))/|d_0|$ of the nominal torque, so that
    the coefficient is $|d|$ near $|d_0|$. In form "smooth" the torque of the rigid arm is low-passed: the
    residual is made of the same noise of q, differentiated twice, and what is shifted by half of its period would
    cancel it. Form "whole", without, is tried where there is evidence of the smooth one.

    Form "lag" is a filter of first order, $\tau_{measured} = \tau + (d / d_0) (F \tau - \tau)$ with
    $d_0 \dot{F \tau} = \tau - F \tau$, which takes of fast torque also its size. It delays slow torque by d; with
    $d \ne d_0$ it is nearest to a filter of another order.
    """

    name: ClassVar[str] = "time_delay"
    family: ClassVar[str] = "clock"
    prior: ClassVar[float] = -27.0
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("around", "s", 1e-4, 0.2, pivot=True),)
    seen_against: ClassVar[str] = "lag"
    reveals: ClassVar[str] = "fast reversals"
    acts_on: ClassVar[Literal["plant", "position", "torque"]] = "torque"

    dof: int = eqx.field(static=True)
    around: float
    form: str = eqx.field(static=True, default="smooth")
    joint: int | None = eqx.field(static=True, default=None)
    """None for all."""

    def variants(self, arm: Arm) -> Sequence["TimeDelay"]:
        return [dataclasses.replace(self, form=self.form.replace("smooth", "whole"))]

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["TimeDelay"]:
        shifts = [(d, None) for d in (0.002, 0.005, 0.01, 0.02, 0.04)]
        shifts += [(d, j) for d in (0.004, 0.015) for j in range(arm.dof)]
        filters = [(T, j) for T in (0.01, 0.03, 0.1) for j in (None, *range(arm.dof))]
        forms = {"smooth": shifts, "smooth ahead": shifts, "smooth lag": filters}
        return [cls(arm.dof, d, form, j) for form, tried in forms.items() for d, j in tried]

    @property
    def joints(self) -> tuple[int, ...]:
        return tuple(range(self.dof)) if self.joint is None else (self.joint,)

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return (Coefficient("delay", "s", sign=1, scale=0.02),)

    @property
    def equation(self) -> str:
        if self._filters:
            return "tau_measured = tau past a low pass of first order, whose delay of slow torque is delay"
        return "tau_measured(t) = tau(t - delay)"

    @property
    def _filters(self) -> bool:
        return self.form.endswith("lag")

    @property
    def _sign(self) -> float:
        return -1.0 if self.form.endswith("ahead") else 1.0

    def over(self, motion: Motion) -> Float[np.ndarray, "time dof n"]:
        d, joints = float(self.around), list(self.joints)
        cutoff = _DELAY_CUTOFF if self.form.startswith("smooth") else np.inf
        load = low_passed(motion.load[:, joints], cutoff, motion.dt)
        torque, then = load + motion.friction_shown[:, joints], motion.time - self._sign * d
        if self._filters:
            kept, old, new = (float(x) for x in _low_pass(motion.dt, d))
            whole = _with_before(torque)
            settled = (1 - new) * whole[:1]
            late = scipy.signal.lfilter([new, old], [1, -kept], whole, axis=0, zi=settled)[0][-len(torque) :]
        else:
            late = np.stack([np.interp(then, motion.time, tau) for tau in torque.T], 1)
        out = np.zeros((motion.samples, motion.dof, 1))
        out[:, joints, 0] = (late - torque) / d
        return out

    def sensed(self, c, t, tau):
        return self._changed(tau, lambda x: self._late(t, x, c[0]))

    def true(self, c, t, tau):
        """Of a filter, with the derivative of what it gave, which has its noise."""
        if not self._filters:
            return self._changed(tau, lambda x: self._late(t, x, -c[0]))
        T, each = self.around, lambda x: jnp.asarray(jnp.gradient(x, axis=0))  # from row to row
        steeper = lambda y: y + T * each(y) / each(t)[:, None]
        return self._changed(tau, lambda y: _filtered(t, steeper(y), T - c[0]))

    def _late(self, t: Array, x: Float[Array, "time dof"], d: Array) -> Float[Array, "time dof"]:
        if self._filters:
            return x + d / self.around * (_filtered(t, x, self.around) - x)
        return _shifted(t, x, -self._sign * d)

    def _changed(self, tau, change: Callable[[Array], Array]):
        if self.joint is None:
            return change(tau)
        one = slice(self.joint, self.joint + 1)
        return jnp.asarray(tau).at[:, one].set(change(tau[:, one]))

    def parameters(self, c, covariance):
        (delay,) = super().parameters(c, covariance)
        joint = None if self.joint is None else self.joint + 1
        return [{**delay, "value": self._sign * delay["value"], "joint": joint}]


def _shifted(t: Array, x: Float[Array, "time dof"], by: Array) -> Float[Array, "time dof"]:
    """x(t + by), held at its ends."""
    return jax.vmap(lambda column: jnp.interp(t + by, t, column), 1, 1)(x)


def _with_before(x: Float[Array | np.ndarray, "time dof"]) -> Float[Array | np.ndarray, "2*time-1 dof"]:
    """With what was before, as far as that can be told: the slope at the start is kept, and rest stays rest."""
    xp = np if isinstance(x, np.ndarray) else jnp
    return xp.concatenate([2 * x[:1] - x[:0:-1], x])


def _low_pass(h: Array | float, T: Array | float) -> tuple[Array, Array, Array]:
    """What a step of h takes of the last value of a low pass of first order, and of its last and new argument,
    which is straight between."""
    T = jnp.maximum(T, 1e-9)
    kept = jnp.exp(-h / T)
    ramp = (1 - kept) * T / h
    return kept, ramp - kept, 1 - ramp


def _filtered(t: Array, x: Float[Array, "time dof"], T: Array | float) -> Float[Array, "time dof"]:
    """x past a low pass of first order."""
    h, whole = jnp.diff(t)[:, None], _with_before(x)
    kept, old, new = _low_pass(jnp.concatenate([h[::-1], h]), T)
    y = new * whole[1:] + old * whole[:-1]
    along = lambda a, b: (a[0] * b[0], b[0] * a[1] + b[1])
    fades, later = jax.lax.associative_scan(along, (jnp.broadcast_to(kept, y.shape), y))
    return jnp.concatenate([whole[:1], fades * whole[0] + later])[len(x) - 1 :]


_DELAY_CUTOFF = 6.0
"""Below it torque is that of the motion; above it, of the noise of q [Hz]."""


EFFECTS = (
    TorqueOffset,
    TorqueGain,
    TorqueDrift,
    TorqueCrosstalk,
    EncoderOffset,
    TimeDelay,
)
