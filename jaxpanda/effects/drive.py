"""What the drive train adds: rotor inertia, ripple, springs, compliance, backlash."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels import mass_matrix
from jaxtyping import Array, Float

from ..arms.arm import Arm
from .effect import AbstractArmEffect, AbstractInstantEffect, Coefficient, Numbers, Shape, Sweep
from .friction import CORRECTED
from .motion import Channels, Joint, Motion
from .twist import Law, held_up, low_passed, twist_torque


class Armature(AbstractInstantEffect):
    r"""Reflected inertia of the rotor, $\tau_j = I_a\,\ddot q_j$.

    References:
        Gautier and Khalil 1990.
    """

    name: ClassVar[str] = "armature"
    family: ClassVar[str] = "drive"
    alike: ClassVar[bool] = True
    seen_against: ClassVar[str] = "acceleration"
    reveals: ClassVar[str] = "high accelerations in several poses of the joints beyond"
    number: ClassVar[str] = "armature"

    joint: Joint
    form: str = eqx.field(static=True, default="")
    """"signed" where the model has some already: there may be less of it."""

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["Armature"]:
        return [cls(j, "signed" if arm.armature[j] > 0 else "") for j in range(arm.dof)]

    @property
    def form_prior(self) -> float:
        return CORRECTED - self.prior if self.form else 0.0

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        sign, beyond = (0, "armature") if self.form else (1, "")
        return (Coefficient("armature", "kg·m²", sign, beyond),)

    @property
    def equation(self) -> str:
        return "tau = armature * ddq"

    def at(self, s: Channels) -> Float[Array, " n"]:
        return s.qdd[self.joint][None]

    def mjcf(self, c: Numbers, arm: Arm) -> Mapping[str, Any]:
        return {"armature": {int(self.joint): c[0]}}


_AROUND = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Where in its range a joint's cubic spring is told from."""


class JointSpring(AbstractInstantEffect):
    r"""Torque that depends on joint position: a cable, a hose, a balancing spring.

    $$\tau_j = k\,q_j + b, \qquad \text{at rest at } q_0 = -b/k$$

    Form "cubic" adds $k_2 x^2 + k_3 x^3$: a spring that stiffens away from where it rests. There $x = q - $
    `around`, which changes no torque: about zero a joint that moves far from it would need coefficients that
    cancel, and no prior has those. Form "linear" takes x for q where it comes from a cubic one, so that only what
    stiffens is weighed. A cubic grows without bounds, so that its torque stays what it is at the ends of what was
    recorded, `low` and `high` [rad]. Form "centred" is without b. Form "slack" pulls on one side of where it gets
    taut, or harder there than on the other: $\tau_j = k_+ w s(x/w) - k_- w s(-x/w) + b$ with
    $s(y) = \log(1 + e^y)$ and the width w over which it tightens.
    """

    name: ClassVar[str] = "joint_spring"
    family: ClassVar[str] = "load"
    seen_against: ClassVar[str] = "position"
    prior: ClassVar[float] = -17.0
    reveals: ClassVar[str] = "the joint's full range at rest, in different poses of the arm"
    on_links: ClassVar[bool] = True

    joint: Joint
    form: str = eqx.field(static=True)
    around: Float[Array, ""] | float = 0.0
    width: Float[Array, ""] | float = 0.05
    low: float = -1e9
    high: float = 1e9

    @property
    def shapes(self) -> tuple[Shape, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        if self.form != "slack":
            return ()
        return Shape("around", "rad", -np.pi, np.pi, False), Shape("width", "rad", 0.01, 0.5)

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["JointSpring"]:
        out = [cls(j, form) for form in ("linear", "centred") for j in range(arm.dof)]
        for j in range(arm.dof):
            low, high = (float(np.clip(x[j], -np.pi, np.pi)) for x in (arm.lower, arm.upper))
            out += [cls(j, "cubic", low + share * (high - low)) for share in _AROUND]
        return out

    def variants(self, arm: Arm) -> Sequence["JointSpring"]:
        """A spring that is found to stiffen may be slack on one side, or not stiffen at all."""
        if self.form != "cubic":
            return []
        low, high = (float(np.clip(x[self.joint], -np.pi, np.pi)) for x in (arm.lower, arm.upper))
        slack = [JointSpring(self.joint, "slack", low + x * (high - low), 0.1) for x in np.linspace(0, 1, 15)]
        return [dataclasses.replace(self, form="linear"), *slack]

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        k, b = Coefficient("stiffness", "N·m/rad", sign=1), Coefficient("torque_at_zero", "N·m")
        return {
            "linear": (k, b),
            "centred": (k,),
            "cubic": (k, b, Coefficient("quadratic", "N·m/rad²"), Coefficient("cubic", "N·m/rad³")),
            "slack": (
                Coefficient("stiffness_above", "N·m/rad", sign=1),
                Coefficient("stiffness_below", "N·m/rad", sign=1),
                Coefficient("torque_when_slack", "N·m"),
            ),
        }[self.form]

    def beyond(self, recorded: Sequence[Channels]) -> "JointSpring":
        if self.form != "cubic":
            return self
        q = np.concatenate([np.asarray(s.q)[:, int(self.joint)] for s in recorded])
        return dataclasses.replace(self, low=float(q.min()), high=float(q.max()))

    @property
    def form_prior(self) -> float:
        """One spring in twenty stiffens or gets slack where the joint moves."""
        return -3.0 if self.form in ("cubic", "slack") else 0.0

    @property
    def plainer(self) -> tuple["JointSpring", ...]:
        return (dataclasses.replace(self, form="linear"),) if self.form in ("cubic", "slack") else ()

    @property
    def equation(self) -> str:
        return (
            "tau = "
            + {
                "linear": "stiffness * q + torque_at_zero",
                "centred": "stiffness * q",
                "cubic": "stiffness * x + torque_at_zero + quadratic * x^2 + cubic * x^3, x = q"
                f" {-float(self.around):+.4g}",
                "slack": "width * (stiffness_above * log(1 + exp(x / width)) - stiffness_below * log(1 +"
                " exp(-x / width))) + torque_when_slack, x = q - around",
            }[self.form]
        )

    def parameters(self, c, covariance) -> list[dict[str, Any]]:
        """A linear spring's about zero, wherever it was fitted from."""
        if self.form != "linear":
            return super().parameters(c, covariance)
        about_zero = np.array([[1.0, 0.0], [-float(self.around), 1.0]])
        return super().parameters(about_zero @ c, about_zero @ covariance @ about_zero.T)

    def at(self, s: Channels) -> Float[Array, " n"]:
        q = jnp.clip(s.q[self.joint], self.low, self.high)
        x, one = q - self.around, jnp.ones_like(q)
        if self.form == "slack":
            pulled = [side * self.width * jax.nn.softplus(side * x / self.width) for side in (1.0, -1.0)]
            return jnp.stack([*pulled, one])
        return jnp.stack({"linear": [x, one], "centred": [q], "cubic": [x, one, x**2, x**3]}[self.form])

    def mjcf(self, c: Numbers, arm: Arm) -> Mapping[str, Any]:
        if self.form in ("cubic", "slack") or arm.stiffness[int(self.joint)] != 0:
            return {}
        j = int(self.joint)
        rest = self.around - c[1] / c[0] if self.form == "linear" else 0.0
        return {"stiffness": {j: c[0]}, "springref": {j: rest}}


_SLOWEST, _HIGHEST = 5.0, 400.0
"""Least and highest order of a ripple that is searched for [1/rad]."""
_TURNS, _MOVES = 0.1, 0.02
"""Least travel [rad] and speed [rad/s] of a joint whose ripple is."""
_TYPICAL = (12.0, 30.0, 60.0)
"""Orders that the smallest ripple is told of which recordings show [1/rad]."""


def least_order(travel: float) -> float:
    """The least order of which a travel [rad] shows a period and a half, lest it be a spring [1/rad]."""
    return max(_SLOWEST, 3 * np.pi / travel)


class TorqueRipple(AbstractInstantEffect):
    r"""Torque periodic in the position of the joint or of its motor.

    $$\tau_j = a \sin(n q_j) + b \cos(n q_j)$$

    The order n is per turn of the joint: 2N for the wave generator of a gear of ratio N; the second harmonic is
    in form "two". `grid` holds no order: `sweep` does.

    References:
        Tuttle, MIT AI-TR 1365, 1992; Taghirad, Bélanger, Helmy 1998.
    """

    name: ClassVar[str] = "torque_ripple"
    family: ClassVar[str] = "drive"
    seen_against: ClassVar[str] = "order"
    repeats: ClassVar[bool] = True
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("order", "1/rad", 2.5, 600.0),)
    reveals: ClassVar[str] = "a sweep of speeds: the frequency moves with it, the order stays"

    joint: Joint
    order: Float[Array, ""] | float
    form: str = eqx.field(static=True)

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["TorqueRipple"]:
        return []

    @classmethod
    def sweep(cls, joint: int, motions: Sequence[Motion], cutoff: float) -> Sweep | None:
        travel = max(np.ptp(m.q[:, joint]) for m in motions)
        speed = np.sqrt(np.mean(np.concatenate([m.qd[:, joint] for m in motions]) ** 2))
        if travel < _TURNS or speed < _MOVES:
            return None
        step = np.pi / (2 * travel)
        orders = np.arange(least_order(travel), min(_HIGHEST, 2 * np.pi * 0.9 * cutoff / speed), step)
        if not len(orders):
            return None

        def columns(motion: Motion) -> Float[np.ndarray, "time shapes 2"]:
            angle = motion.q[:, joint, None] * orders
            return np.stack([np.sin(angle), np.cos(angle)], 2)

        shape = lambda i: cls(joint, float(orders[i]), "one")
        return Sweep(columns, shape, lambda i: (0.4 * step / orders[i],))

    @classmethod
    def typical(cls, recordings: Mapping[str, Motion]) -> Sequence[Sequence["TorqueRipple"]]:
        motions = list(recordings.values())
        out = []
        for joint in range(motions[0].dof):
            travel = max(float(np.ptp(m.q[:, joint])) for m in motions)
            least = least_order(max(travel, 0.05))
            out.append([cls(joint, max(order, least), "one") for order in _TYPICAL])
        return out

    def variants(self, arm: Arm) -> Sequence["TorqueRipple"]:
        return [dataclasses.replace(self, form="two")] if self.form == "one" else []

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        one = (Coefficient("sine", "N·m"), Coefficient("cosine", "N·m"))
        two = (Coefficient("sine_2", "N·m"), Coefficient("cosine_2", "N·m"))
        return one if self.form == "one" else one + two

    @property
    def equation(self) -> str:
        one = "tau = sine * sin(order * q) + cosine * cos(order * q)"
        return (
            one
            if self.form == "one"
            else one + " + sine_2 * sin(2 * order * q) + cosine_2 * cos(2 * order * q)"
        )

    def at(self, s: Channels) -> Float[Array, " n"]:
        angle = self.order * s.q[self.joint]
        one = [jnp.sin(angle), jnp.cos(angle)]
        return jnp.stack(one if self.form == "one" else [*one, jnp.sin(2 * angle), jnp.cos(2 * angle)])


class JointElasticity(AbstractArmEffect):
    r"""Compliance between the position sensor and the link.

    The link swings on a spring of stiffness K: `jaxpanda.effects.twist` steps its equation of motion. Columns are
    $K\,(\tau(q + \delta) - \tau(q))$, so that the coefficient is the compliance 1/K where `stiffness` is right.
    `stiffening` s is that of a flexspline, whose stiffness rises with load: $T = -K\delta\,(1 + s\,(K\delta)^2)$.

    In form "smooth" the torque that twists is low-passed: the link above its resonance would otherwise take the
    noise of q, differentiated twice, out of the residual that is made of it. Form "whole", without, is tried
    where there is evidence of the smooth one. What is too soft to hold the link up is taken for as stiff as does.

    References:
        Spong, ASME JDSMC 1987; Madsen et al., Math. Probl. Eng. 2020; Tuttle, MIT AI-TR 1365, 1992.
    """

    name: ClassVar[str] = "joint_elasticity"
    family: ClassVar[str] = "drive"
    seen_against: ClassVar[str] = "load"
    prior: ClassVar[float] = -24.0
    discrepancy: ClassVar[float] = 0.15
    varies_with: ClassVar[tuple[str, ...]] = ("moments",)
    acts_on: ClassVar[Literal["plant", "position", "torque"]] = "position"
    shapes: ClassVar[tuple[Shape, ...]] = (
        Shape("stiffness", "N·m/rad", 50.0, 1e6, pivot=True),
        Shape("damping_ratio", "1", 0.02, 1.5),
    )
    reveals: ClassVar[str] = (
        "heavy and light load in the same pose; bursts of high frequency; both encoders, if any"
    )

    joint: Joint
    stiffness: Float[Array, ""] | float
    damping_ratio: Float[Array, ""] | float
    stiffening: Float[Array, ""] | float = 0.0
    form: str = eqx.field(static=True, default="smooth")

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["JointElasticity"]:
        return [
            cls(j, K, zeta)
            for K in (300.0, 600.0, 1200.0, 3000.0, 15000.0)
            for zeta in ((0.1, 0.3) if K < 1000 else (0.2,))
            for j in range(arm.dof)
        ]

    def variants(self, arm: Arm) -> Sequence["JointElasticity"]:
        changes = [(s, form) for s in (0.0, 1e-4, 4e-4) for form in ("smooth", "whole")]
        return [dataclasses.replace(self, stiffening=s, form=form) for s, form in changes]

    @property
    def joints(self) -> tuple[int, ...]:
        return (int(self.joint),)

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return (Coefficient("compliance", "rad/(N·m)", sign=1),)

    @property
    def equation(self) -> str:
        more = " * (1 + stiffening * (stiffness * x)^2)" if float(self.stiffening) else ""
        return f"q_link = q + x, M_jj * ddx + tau(q + x) = -stiffness * x{more} - damping * dx"

    def parameters(self, c, covariance) -> list[dict[str, Any]]:
        joint, deviation = int(self.joint) + 1, float(np.sqrt(max(covariance[0, 0], 0.0)))
        told = super().parameters(c, covariance)
        if c[0] > 0:
            value = {"name": "stiffness", "value": float(1 / c[0]), "std": float(deviation / c[0] ** 2)}
            told.append({**value, "joint": joint, "unit": "N·m/rad"})
        return told

    def over(self, motion: Motion) -> Float[np.ndarray, "time dof n"]:
        return self.over_many([self], motion)[:, :, 0]

    @classmethod
    def over_many(cls, effects: Sequence[Any], motion: Motion) -> Float[np.ndarray, "time dof effects n"]:
        laws = [
            Law(
                int(e.joint),
                held_up(float(e.stiffness), int(e.joint), motion),
                float(e.damping_ratio),
                stiffening=float(e.stiffening),
                cutoff=_TWIST_CUTOFF if e.form == "smooth" else np.inf,
            )
            for e in effects
        ]
        return (twist_torque(motion, laws) * np.array([law.stiffness for law in laws]))[..., None]

    def begin(self, c, arm, s):
        inertia = (
            mass_matrix(arm.chain, arm.standard, jnp.asarray(s.q))[self.joint, self.joint]
            + arm.armature[self.joint]
        )
        settling = 2 * self.damping_ratio * jnp.sqrt(inertia / self.stiffness)
        return jnp.stack([s.load[self.joint], settling])

    def shift(self, c, arm, z, s, dt):
        r"""The sensor runs ahead of the link by the spring's deflection under the torque it transmits.

        $d\,\dot\delta + K\,\delta = \tau$, solved exactly over the step. Nothing is left out where the torque is
        the one on the link's side; inertia between motor and sensor is taken for part of the link.
        """
        load, settling = z
        load = s.load[self.joint] + (load - s.load[self.joint]) * jnp.exp(-dt / settling)
        ahead = jnp.zeros_like(s.q).at[self.joint].set(c[0] * load)
        return ahead, jnp.stack([load, settling])


_TWIST_CUTOFF = 6.0
"""Below it a twist is that of the link's own motion; above it, of noise and impacts [Hz]."""


class Backlash(AbstractArmEffect):
    r"""A dead band between motor and link: the link lies on one stop or the other, or flies between them.

    The load pushes the link to a stop; when it changes sign the link leaves it, is free for the width of the gap
    ($M_{jj}\,\ddot q_{link} + \ldots = 0$: no torque is transmitted), and hits the other stop. The equation of
    motion is that of `jaxpanda.effects.twist`, stops and gear of stiffness `stop_stiffness`. With
    $\Delta = (\tau(q + \delta) - \tau(q))/b$ the columns are $\Delta$ below 6 Hz and what is above it: the first
    coefficient is near the half width b, the second less where impacts are not those of the recording.

    Forms "smooth" and "whole" are those of an elastic joint. It is for a position sensor on the motor's side. On
    the link's side the gap does not show in the torque on that side, and motor torque shows it only as the
    motor's own inertia and friction. Where the load never changes sign this is an encoder offset and an elastic
    gear; stops softer than a gear's would be one without a gap, and what is too soft to hold the link up is taken
    for as stiff as does.

    References:
        Nordin and Gutman, Automatica 2002.
    """

    name: ClassVar[str] = "backlash"
    family: ClassVar[str] = "drive"
    seen_against: ClassVar[str] = "load"
    discrepancy: ClassVar[float] = 0.3
    varies_with: ClassVar[tuple[str, ...]] = ("moments",)
    acts_on: ClassVar[Literal["plant", "position", "torque"]] = "position"
    clear_of_none: ClassVar[float] = 4.0
    shapes: ClassVar[tuple[Shape, ...]] = (
        Shape("half_width", "rad", 2e-4, 0.1, pivot=True),
        Shape("stop_stiffness", "N·m/rad", 2000.0, 1e5),
    )
    reveals: ClassVar[str] = "slow motion through poses where the load changes sign"

    joint: Joint
    half_width: Float[Array, ""] | float
    stop_stiffness: Float[Array, ""] | float
    damping_ratio: Float[Array, ""] | float = 0.2
    form: str = eqx.field(static=True, default="smooth")

    @property
    def may_hold(self) -> frozenset[str]:
        """The gear on either side of a gap is soft."""
        return frozenset({JointElasticity.name})

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["Backlash"]:
        return [cls(j, b, 2500.0) for b in (5e-4, 1.5e-3, 4e-3, 0.012, 0.035) for j in range(arm.dof)]

    def variants(self, arm: Arm) -> Sequence["Backlash"]:
        changes = [(r, form) for r in (0.1, 0.2, 0.4) for form in ("smooth", "whole")]
        return [dataclasses.replace(self, damping_ratio=r, form=form) for r, form in changes]

    @property
    def joints(self) -> tuple[int, ...]:
        return (int(self.joint),)

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return tuple(Coefficient(name, "rad", sign=1, scale=0.02) for name in ("half_width", "impact"))

    @property
    def equation(self) -> str:
        return (
            "q_link = q + x, M_jj * ddx + tau(q + x) = -stop_stiffness * (x - clip(x, -half_width, half_width))"
            " - damping * dx"
        )

    def over(self, motion: Motion) -> Float[np.ndarray, "time dof n"]:
        return self.over_many([self], motion)[:, :, 0]

    @classmethod
    def over_many(cls, effects: Sequence[Any], motion: Motion) -> Float[np.ndarray, "time dof effects n"]:
        laws = [
            Law(
                int(e.joint),
                held_up(float(e.stop_stiffness), int(e.joint), motion),
                float(e.damping_ratio),
                half_width=float(e.half_width),
                cutoff=_TWIST_CUTOFF if e.form == "smooth" else np.inf,
            )
            for e in effects
        ]
        whole = twist_torque(motion, laws) / np.array([law.half_width for law in laws])
        slow = low_passed(whole, _TWIST_CUTOFF, motion.dt)
        return np.stack([slow, whole - slow], -1)

    def shift(self, c, arm, z, s, dt):
        """The sensor runs ahead of the link by half the gap and what the stops give, the way the load pushes.

        How the motor crosses the gap is left out: it is at the other stop as soon as the load has changed sign.
        """
        load = s.load[self.joint]
        ahead = c[0] * jnp.tanh(load / _FLANK) + load / self.stop_stiffness
        return jnp.zeros_like(s.q).at[self.joint].set(ahead), z


_FLANK = 0.2
"""Load that brings a simulated link to its stop [N m]."""


EFFECTS = (Armature, JointSpring, TorqueRipple, JointElasticity, Backlash)
