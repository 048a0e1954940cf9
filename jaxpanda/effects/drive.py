"""What the drive train adds: rotor inertia, ripple, springs, compliance, backlash."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels import mass_matrix
from jaxtyping import Array, Float

from ..arm import Arm
from .effect import AbstractArmEffect, AbstractInstantEffect, Coefficient, Shape, smooth_sign
from .motion import Channels, Joint, Motion


class Armature(AbstractInstantEffect):
    r"""Reflected inertia of the rotor, $\tau_j = I_a\,\ddot q_j$.

    References:
        Gautier and Khalil 1990.
    """

    name: ClassVar[str] = "armature"
    reveals: ClassVar[str] = "high accelerations in several poses of the joints beyond"
    confounded_with: ClassVar[tuple[str, ...]] = ("inertial_parameters", "joint_spring")

    joint: Joint

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["Armature"]:
        return [cls(j) for j in range(arm.dof)]

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return (Coefficient("armature", "kg·m²", sign=1),)

    @property
    def equation(self) -> str:
        return "tau = armature * ddq"

    def at(self, s: Channels) -> Float[Array, " n"]:
        return s.qdd[self.joint][None]

    def mjcf(self, c: Float[np.ndarray, " n"], arm: Arm) -> Mapping[str, Any]:
        return {"armature": {int(self.joint): c[0]}}


class JointSpring(AbstractInstantEffect):
    r"""Torque that depends on joint position: a cable, a hose, a balancing spring.

    $$\tau_j = k\,q_j + b, \qquad \text{at rest at } q_0 = -b/k$$

    Form "cubic" adds $k_2 q^2 + k_3 q^3$: a spring that stiffens away from where it rests. Form "centred" is
    without b.
    """

    name: ClassVar[str] = "joint_spring"
    reveals: ClassVar[str] = "the joint's full range at rest, in different poses of the arm"
    confounded_with: ClassVar[tuple[str, ...]] = ("torque_offset", "inertial_parameters", "encoder_offset")

    joint: Joint
    form: str = eqx.field(static=True)

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["JointSpring"]:
        return [cls(j, form) for form in ("linear", "centred", "cubic") for j in range(arm.dof)]

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        k, b = Coefficient("stiffness", "N·m/rad", sign=1), Coefficient("torque_at_zero", "N·m")
        return {
            "linear": (k, b),
            "centred": (k,),
            "cubic": (k, b, Coefficient("quadratic", "N·m/rad²"), Coefficient("cubic", "N·m/rad³")),
        }[self.form]

    @property
    def equation(self) -> str:
        return (
            "tau = "
            + {
                "linear": "stiffness * q + torque_at_zero",
                "centred": "stiffness * q",
                "cubic": "stiffness * q + torque_at_zero + quadratic * q^2 + cubic * q^3",
            }[self.form]
        )

    def at(self, s: Channels) -> Float[Array, " n"]:
        q = s.q[self.joint]
        one = jnp.ones_like(q)
        return jnp.stack({"linear": [q, one], "centred": [q], "cubic": [q, one, q**2, q**3]}[self.form])

    def mjcf(self, c: Float[np.ndarray, " n"], arm: Arm) -> Mapping[str, Any]:
        if self.form == "cubic" or arm.stiffness[int(self.joint)] != 0:
            return {}
        j = int(self.joint)
        return {"stiffness": {j: c[0]}, "springref": {j: -c[1] / c[0] if self.form == "linear" else 0.0}}


class TorqueRipple(AbstractInstantEffect):
    r"""Torque periodic in the position of the joint or of its motor.

    $$\tau_j = a \sin(n q_j) + b \cos(n q_j)$$

    The order n is per turn of the joint: 2N for the wave generator of a gear of ratio N; the second harmonic is
    in form "two". `grid` holds no order: the search scans them.

    References:
        Tuttle, MIT AI-TR 1365, 1992; Taghirad, Bélanger, Helmy 1998.
    """

    name: ClassVar[str] = "torque_ripple"
    repeats: ClassVar[bool] = True
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("order", "1/rad", 2.5, 600.0),)
    reveals: ClassVar[str] = "a sweep of speeds: the frequency moves with it, the order stays"
    confounded_with: ClassVar[tuple[str, ...]] = ("joint_spring", "inertial_parameters")

    joint: Joint
    order: Float[Array, ""] | float
    form: str = eqx.field(static=True)

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["TorqueRipple"]:
        return []

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

    $$\tau(q + \delta) = -K\,\delta, \qquad
      \delta(\omega) \approx
      \frac{-\tau(q)(\omega)}{K - \bar M_{jj}\omega^2 + 2 i \zeta \omega \sqrt{K \bar M_{jj}}}$$

    The link swings on its spring, which near its resonance is far from $-\tau/K$; the columns are
    $K\,(\tau(q + \delta) - \tau(q))$, so that the coefficient is the compliance where `stiffness` is right.
    $\delta$ is low-passed: its second derivative would otherwise be made of the same noise as the residual.

    References:
        Spong, ASME JDSMC 1987; Madsen et al., Math. Probl. Eng. 2020.
    """

    name: ClassVar[str] = "joint_elasticity"
    acts_on: ClassVar[Literal["plant", "position", "torque"]] = "position"
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("stiffness", "N·m/rad", 50.0, 1e6),)
    reveals: ClassVar[str] = (
        "heavy and light load in the same pose; bursts of high frequency; both encoders, if any"
    )
    confounded_with: ClassVar[tuple[str, ...]] = (
        "encoder_offset",
        "time_delay",
        "backlash",
        "inertial_parameters",
    )

    joint: Joint
    stiffness: Float[Array, ""] | float
    damping_ratio: Float[Array, ""] | float

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["JointElasticity"]:
        return [
            cls(j, K, zeta)
            for K in (300.0, 600.0, 1200.0, 3000.0, 15000.0)
            for zeta in ((0.1, 0.3) if K < 1000 else (0.2,))
            for j in range(arm.dof)
        ]

    @property
    def joints(self) -> tuple[int, ...]:
        return (int(self.joint),)

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return (Coefficient("compliance", "rad/(N·m)", sign=1),)

    @property
    def equation(self) -> str:
        return "q_link = q - compliance * tau"

    def over(self, motion: Motion) -> Float[np.ndarray, "time dof n"]:
        j, K, zeta = int(self.joint), float(self.stiffness), float(self.damping_ratio)
        inertia = max(motion.mean_inertia[j], 1e-6)
        load = np.concatenate(
            [motion.load[:, j], motion.load[::-1, j]]
        )  # mirrored: no step from end to start
        w = 2 * np.pi * np.fft.rfftfreq(len(load), motion.dt)
        spring = 1 - w**2 * inertia / K + 2j * zeta * w * np.sqrt(inertia / K)
        smooth = 1 / (1 + (w / (2 * np.pi * _DEFLECTION_CUTOFF)) ** 4)
        dq = np.zeros_like(motion.q)
        dq[:, j] = -np.fft.irfft(np.fft.rfft(load) * smooth / spring, len(load))[: motion.samples] / K
        return K * (motion.moved(dq).load - motion.load)[..., None]

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


_DEFLECTION_CUTOFF = 6.0
"""Low-pass of a joint's deflection [Hz]."""


class Backlash(AbstractArmEffect):
    r"""A dead band between motor and link: the link lies on one flank or the other.

    $$q_{link} = q_j - b\,p, \qquad p = \tanh(\tau_j/\tau_0)
      \quad\text{or}\quad p \leftarrow \mathrm{clip}(p + \dot q_j\,dt / b, -1, 1)$$

    Form "load-driven": the load pushes the link to a flank; "friction-driven": the link is dragged along. Columns
    are $(\tau(q - b p) - \tau(q))/b$, so that the coefficient is b near `half_width`. Where the load never
    changes sign this is an encoder offset.
    """

    name: ClassVar[str] = "backlash"
    acts_on: ClassVar[Literal["plant", "position", "torque"]] = "position"
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("half_width", "rad", 1e-4, 0.1),)
    reveals: ClassVar[str] = "slow motion through poses where the load changes sign"
    confounded_with: ClassVar[tuple[str, ...]] = (
        "encoder_offset",
        "presliding_hysteresis",
        "joint_elasticity",
    )

    joint: Joint
    half_width: Float[Array, ""] | float
    form: str = eqx.field(static=True)

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["Backlash"]:
        return [
            cls(j, b, form)
            for form in ("friction-driven", "load-driven")
            for b in (5e-4, 4e-3, 0.03)
            for j in range(arm.dof)
        ]

    @property
    def joints(self) -> tuple[int, ...]:
        return (int(self.joint),)

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return (Coefficient("lost_motion", "rad", sign=1, scale=0.02),)

    @property
    def equation(self) -> str:
        where = "tanh(tau / 0.2)" if self.form == "load-driven" else "clip(p + dq * dt / half_width, -1, 1)"
        return f"q_link = q - lost_motion * p, p = {where}"

    def over(self, motion: Motion) -> Float[np.ndarray, "time dof n"]:
        j, b = int(self.joint), float(self.half_width)
        if self.form == "friction-driven":
            p = np.empty(motion.samples)
            state = float(np.tanh(motion.qd[0, j] / 0.01))
            for i, moved in enumerate(motion.qd[:, j] * motion.dt / b):
                state = min(1.0, max(-1.0, state + moved))
                p[i] = state
        else:
            p = np.tanh(motion.load[:, j] / _FLANK)
        dq = np.zeros_like(motion.q)
        dq[:, j] = -b * p
        return ((motion.moved(dq).load - motion.load) / b)[..., None]

    def shift(self, c, arm, z, s, dt):
        """The sensor runs ahead of the link by the gap it has crossed: to the flank that pushes the link.

        How the motor crosses the gap is left out: it is on the other flank as soon as the load, or the link's
        velocity, has changed sign.
        """
        if self.form == "load-driven":
            p = jnp.tanh(s.load[self.joint] / _FLANK)
        else:
            p = smooth_sign(s.qd[self.joint], 0.01)
        return jnp.zeros_like(s.q).at[self.joint].set(c[0] * p), z


_FLANK = 0.2
"""Load that brings a link to its flank [N m]."""


EFFECTS = (Armature, JointSpring, TorqueRipple, JointElasticity, Backlash)
