"""Friction that falls with speed near zero velocity."""

from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..arms.arm import Arm
from .effect import (
    AbstractDryFriction,
    AbstractEffect,
    AbstractMemoryEffect,
    Coefficient,
    Resistance,
    Seconds,
    Shape,
)
from .friction import LEVEL, SLOPE, CoulombFriction, ViscousFriction, has_friction
from .memory import bristle, turned
from .motion import Channels, Joint

_DISTANCES = (5e-4, 2e-3, 8e-3)
_VELOCITY = Shape("stribeck_velocity", "rad/s", 5e-3, 0.6)


class StribeckFriction(AbstractDryFriction):
    r"""Friction that falls with speed near zero velocity.

    $$\tau_j = \left(F_c + (F_s - F_c)\,e^{-(|\dot q_j|/v_s)^\delta}\right) \tanh(\dot q_j / v_0)$$

    Form "extra" leaves out $F_c$, for a joint whose model holds it already; "instead" has $F_c$ and a damping of
    either sign there, by which numbers fitted to a line are wrong for a curve.

    References:
        Armstrong-Hélouvry 1991; Olsson et al., European Journal of Control 1998.
    """

    name: ClassVar[str] = "stribeck_friction"
    family: ClassVar[str] = "friction"
    seen_against: ClassVar[str] = "velocity"
    shapes: ClassVar[tuple[Shape, ...]] = (
        _VELOCITY,
        Shape("v0", "rad/s", 1e-3, 0.05),
    )
    reveals: ClassVar[str] = "slow ramps through zero velocity, in several poses"
    prior: ClassVar[float] = -17.0

    joint: Joint
    stribeck_velocity: Float[Array, ""] | float
    v0: Float[Array, ""] | float
    exponent: Float[Array, ""] | float
    form: str = eqx.field(static=True)

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["StribeckFriction"]:
        return [
            cls(j, vs, v0, exponent, form)
            for form in ("whole", "extra", "viscous", "instead")
            for exponent in ((1.0, 2.0) if form in ("whole", "extra") else (2.0,))
            for vs in (0.02, 0.05, 0.1, 0.2, 0.35)
            for v0 in ((0.004, 0.02) if vs > 0.03 else (0.004,))
            for j in (has_friction(arm) if form == "instead" else range(arm.dof))
        ]

    def variants(self, arm: Arm) -> Sequence[AbstractEffect]:
        """With bristles, that turn over a distance."""
        if self.form != "whole":
            return []
        v, exponent = self.stribeck_velocity, self.exponent
        ways = [(x, form) for form in ("bristles", "lugre") for x in _DISTANCES]
        return [StribeckBristles(self.joint, v, x, exponent, form) for x, form in ways]

    @property
    def may_hold(self) -> frozenset[str]:
        return frozenset({CoulombFriction.name})

    @property
    def held(self) -> tuple[type[AbstractEffect], ...]:
        return {"whole": (CoulombFriction,), "viscous": (CoulombFriction, ViscousFriction)}.get(self.form, ())

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        level, excess = Coefficient("coulomb", "N·m", sign=1), Coefficient("static_excess", "N·m", sign=1)
        slope = Coefficient("damping", "N·m·s/rad", sign=1)
        return {
            "whole": (level, excess),
            "extra": (excess,),
            "viscous": (level, excess, slope),
            "instead": (LEVEL, excess, SLOPE),
        }[self.form]

    @property
    def equation(self) -> str:
        bump = "static_excess * exp(-(|dq| / stribeck_velocity)^exponent)"
        law = bump if self.form == "extra" else f"(coulomb + {bump})"
        return f"tau = {law} * tanh(dq / v0)" + (
            " + damping * dq" if self.form in ("viscous", "instead") else ""
        )

    def levels(self, s: Channels) -> Float[Array, " n"]:
        bump = _excess(self, s)
        one, none = jnp.ones_like(bump), jnp.zeros_like(bump)
        with_slope = [one, bump, none]
        parts = {"whole": [one, bump], "extra": [bump], "viscous": with_slope, "instead": with_slope}
        return jnp.stack(parts[self.form])

    def remainder(self, s: Channels) -> Float[Array, " n"]:
        qd = s.qd[self.joint]
        none = jnp.zeros_like(qd)
        with_slope = [none, none, qd]
        parts = {"whole": [none, none], "extra": [none], "viscous": with_slope, "instead": with_slope}
        return jnp.stack(parts[self.form])


class StribeckBristles(AbstractMemoryEffect):
    r"""Stribeck's friction that builds up over a distance after each reversal, as LuGre's does.

    $$\tau_j = \left(F_c + (F_s - F_c)\,e^{-(|\dot q_j|/v_s)^\delta}\right) z, \qquad
      dz = (\mathrm{sign}(\dot q_j) - z)\,|\dot q_j|\,dt / x_s$$

    LuGre's $\sigma_0 x_s$ is the level at the speed of the moment; here $x_s$ is the same at all speeds, which
    leaves the law linear in its levels. Form "lugre" has what the bristles' own rate damps, too,
    $\sigma_1 x_s \dot z = \sigma_1 (\dot q_j - z |\dot q_j|)$. A search comes to it from `StribeckFriction`.

    References:
        Canudas de Wit, Olsson, Åström, Lischinsky, IEEE TAC 1995, eqs. 1 to 4.
    """

    name: ClassVar[str] = StribeckFriction.name
    family: ClassVar[str] = "friction"
    shapes: ClassVar[tuple[Shape, ...]] = (_VELOCITY, Shape("breakaway_distance", "rad", 1e-4, 0.05))
    reveals: ClassVar[str] = StribeckFriction.reveals
    prior: ClassVar[float] = StribeckFriction.prior

    joint: Joint
    stribeck_velocity: Float[Array, ""] | float
    breakaway_distance: Float[Array, ""] | float
    exponent: Float[Array, ""] | float
    form: str = eqx.field(static=True)

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["StribeckBristles"]:
        return []

    @property
    def may_hold(self) -> frozenset[str]:
        return frozenset({CoulombFriction.name})

    @property
    def held(self) -> tuple[type[AbstractEffect], ...]:
        return (CoulombFriction,)

    @property
    def dry(self) -> bool:
        return True

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        levels = Coefficient("coulomb", "N·m", sign=1), Coefficient("static_excess", "N·m", sign=1)
        more = (Coefficient("micro_damping", "N·m·s/rad", sign=1),) if self.form == "lugre" else ()
        return *levels, *more

    @property
    def equation(self) -> str:
        return (
            "tau = (coulomb + static_excess * exp(-(|dq| / stribeck_velocity)^exponent)) * z"
            + (" + micro_damping * (dq - z * |dq|)" if self.form == "lugre" else "")
            + ", dz = (sign(dq) - z) * |dq| * dt / breakaway_distance"
        )

    @property
    def forgets(self) -> Array | float:
        return self.breakaway_distance

    def start(self, s: Channels) -> Float[Array, " states"]:
        return turned(s.qd[self.joint])[None]

    def step(
        self, z: Float[Array, " states"], s: Channels, dt: Seconds
    ) -> tuple[Float[Array, " states"], Float[Array, " n"]]:
        qd = s.qd[self.joint]
        z = bristle(z, qd * dt / self.breakaway_distance)
        rate = [qd - z * jnp.abs(qd)] if self.form == "lugre" else []
        return z, jnp.concatenate([z, _excess(self, s) * z, *rate])

    def resist(self, c, arm, z, s, dt):
        z, columns = self.step(z, s, dt)
        damping = c[2] * (1 - z[0] * jnp.sign(s.qd[self.joint])) if self.form == "lugre" else jnp.zeros(())
        return Resistance(self._here(columns[:2] @ c[:2], s), self._here(damping, s), z)


def _excess(effect: StribeckFriction | StribeckBristles, s: Channels) -> Float[Array, ""]:
    """Share of the static excess that is there at a speed."""
    speed = jnp.abs(s.qd[effect.joint])
    return jnp.exp(-((speed / effect.stribeck_velocity + 1e-12) ** effect.exponent))


EFFECTS = (StribeckFriction, StribeckBristles)
