"""Friction without memory: of velocity, of load, of time."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..arms.arm import Arm
from .effect import (
    COMMON,
    EVER,
    AbstractDryFriction,
    AbstractEffect,
    AbstractInstantEffect,
    Coefficient,
    Numbers,
    Shape,
    counted,
    settling,
    smooth_sign,
)
from .motion import Channels, Joint
from .still import LawAtRest, Levels

_WIDTH = Shape("v0", "rad/s", 1e-3, 0.3)


CORRECTED = -10.0
"""Prior of a number of the user's model that is wrong: many are round, and nobody measured them."""
PROPORTIONAL = 1.25
"""Exponent of the speed, or one over it, up to which friction is called proportional to it."""


LEVEL = Coefficient("coulomb", "N·m", sign=1, beyond="frictionloss")
SLOPE = Coefficient("damping", "N·m·s/rad", sign=1, beyond="damping")
"""Of a law that has friction of the user's model in it: by how much that is off."""


def has_friction(arm: Arm) -> list[int]:
    """Joints whose friction the user's model holds already."""
    held = (np.asarray(arm.frictionloss) > 0) | (np.asarray(arm.damping) > 0)
    return np.flatnonzero(held).tolist()


class ViscousFriction(AbstractInstantEffect):
    r"""Friction proportional to velocity, $\tau_j = F_v\,\dot q_j$.

    References:
        Armstrong-Hélouvry, Dupont, Canudas de Wit, Automatica 1994.
    """

    name: ClassVar[str] = "viscous_friction"
    family: ClassVar[str] = "friction"
    alike: ClassVar[bool] = True
    seen_against: ClassVar[str] = "velocity"
    reveals: ClassVar[str] = "runs at four or more constant speeds, in both directions"
    prior: ClassVar[float] = COMMON
    number: ClassVar[str] = SLOPE.beyond
    commonplace: ClassVar[bool] = True

    joint: Joint
    form: str = eqx.field(static=True, default="")
    """"signed" where the model has some already: there may be less of it."""

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["ViscousFriction"]:
        return [cls(j, "signed" if arm.damping[j] > 0 else "") for j in range(arm.dof)]

    @property
    def form_prior(self) -> float:
        return CORRECTED - self.prior if self.form else 0.0

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        sign, beyond = (0, SLOPE.beyond) if self.form else (1, "")
        return (Coefficient(SLOPE.name, SLOPE.unit, sign, beyond),)

    @property
    def equation(self) -> str:
        return "tau = damping * dq"

    def at(self, s: Channels) -> Float[Array, " n"]:
        return s.qd[self.joint][None]

    def mjcf(self, c: Numbers, arm: Arm) -> Mapping[str, Any]:
        return {"damping": {int(self.joint): c[0]}}


class CoulombFriction(AbstractDryFriction):
    r"""Friction of constant magnitude, $\tau_j = F_c \tanh(\dot q_j / v_0)$."""

    name: ClassVar[str] = "coulomb_friction"
    family: ClassVar[str] = "friction"
    alike: ClassVar[bool] = True
    seen_against: ClassVar[str] = "velocity"
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("v0", "rad/s", 1e-3, 0.06),)
    reveals: ClassVar[str] = "reversals, with dwells between them"
    at_rest: ClassVar[str] = "friction that the model does not have, and that carries a load at rest"
    prior: ClassVar[float] = COMMON
    number: ClassVar[str] = LEVEL.beyond
    commonplace: ClassVar[bool] = True

    joint: Joint
    v0: Float[Array, ""] | float
    form: str = eqx.field(static=True, default="")
    """"signed" where the model has some already: there may be less of it."""

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["CoulombFriction"]:
        form = ["signed" if level > 0 else "" for level in np.asarray(arm.frictionloss)]
        return [cls(j, v0, form[j]) for v0 in (0.003, 0.01, 0.03, 0.06) for j in range(arm.dof)]

    @classmethod
    def while_still(cls, levels: Levels) -> Sequence[LawAtRest]:
        """Another load in every pose: at all joints, or at one."""
        return levels.of_all_or_one(levels.free, 0.1) if levels.when == "throughout" else []

    @property
    def form_prior(self) -> float:
        return CORRECTED - self.prior if self.form else 0.0

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        sign, beyond = (0, LEVEL.beyond) if self.form else (1, "")
        return (Coefficient(LEVEL.name, LEVEL.unit, sign, beyond),)

    @property
    def equation(self) -> str:
        return "tau = coulomb * tanh(dq / v0)"

    def levels(self, s: Channels) -> Float[Array, " n"]:
        return jnp.ones(1)

    def mjcf(self, c: Numbers, arm: Arm) -> Mapping[str, Any]:
        return {"frictionloss": {int(self.joint): c[0]}}


class PowerLawFriction(AbstractDryFriction):
    r"""Friction that grows with a power of the speed, $\tau_j = F_p\,|\dot q_j|^p \tanh(\dot q_j / v_0)$.

    Churned oil takes p near 2, a warm film of grease p below 1; with p near 1 it is viscous friction, and called
    so. Form "instead" is for a joint whose model holds friction already: numbers fitted to a line are wrong for a
    curve, so it comes with corrections of both, $F_c \tanh(\dot q_j / v_0) + F_v\,\dot q_j$.

    References:
        Olsson, Åström, Canudas de Wit, Gäfvert, Lischinsky, European Journal of Control 1998.
    """

    name: ClassVar[str] = "power_law_friction"
    family: ClassVar[str] = "friction"
    seen_against: ClassVar[str] = "velocity"
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("exponent", "1", 0.35, 3.0),)
    reveals: ClassVar[str] = ViscousFriction.reveals
    prior: ClassVar[float] = -17.0

    joint: Joint
    exponent: Float[Array, ""] | float
    v0: Float[Array, ""] | float = 0.005
    form: str = eqx.field(static=True, default="")

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["PowerLawFriction"]:
        exponents = (0.5, 0.7, 1.5, 2.0, 2.5)
        alone = [cls(joint=j, exponent=p) for p in exponents for j in range(arm.dof)]
        return alone + [
            cls(joint=j, exponent=p, form="instead") for p in exponents for j in has_friction(arm)
        ]

    @property
    def title(self) -> str:
        proportional = 1 / PROPORTIONAL < float(self.exponent) < PROPORTIONAL
        return ViscousFriction.name if proportional and not self.form else self.name

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        law = Coefficient("friction_at_unit_speed", "N·m", sign=1)
        return (law, LEVEL, SLOPE) if self.form else (law,)

    @property
    def equation(self) -> str:
        law = "friction_at_unit_speed * |dq|^exponent * sign(dq)"
        return f"tau = {law}" + (" + coulomb * sign(dq) + damping * dq" if self.form else "")

    def levels(self, s: Channels) -> Float[Array, " n"]:
        level = (jnp.abs(s.qd[self.joint]) + 1e-9) ** self.exponent
        return jnp.stack([level, jnp.ones_like(level), jnp.zeros_like(level)] if self.form else [level])

    def remainder(self, s: Channels) -> Float[Array, " n"]:
        qd = s.qd[self.joint]
        none = jnp.zeros_like(qd)
        return jnp.stack([none, none, qd] if self.form else [none])


class AsymmetricFriction(AbstractDryFriction):
    r"""Friction that differs between the directions.

    $$\tau_j = F_c \tanh(\dot q_j / v_0) + \Delta_c \tanh^2(\dot q_j / v_0)
      + F_v \dot q_j + \Delta_v |\dot q_j|$$

    Zero at rest, which is what tells it from the offset of a torque sensor. Form "whole" has the first two parts,
    "viscous" the last two, "full" all and "both" all but damping; "... extra" leaves out the symmetric part, for
    a joint whose model holds it already. `grid` has no "full", which would take Coulomb's and viscous friction
    for one law: it is tried where "both" was found.
    """

    name: ClassVar[str] = "asymmetric_friction"
    family: ClassVar[str] = "friction"
    seen_against: ClassVar[str] = "velocity"
    dissipates: ClassVar[bool] = True
    shapes: ClassVar[tuple[Shape, ...]] = (_WIDTH,)
    reveals: ClassVar[str] = "rests of 0.3 s and more, and motion in both directions"
    prior: ClassVar[float] = -17.0

    joint: Joint
    v0: Float[Array, ""] | float
    form: str = eqx.field(static=True)

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["AsymmetricFriction"]:
        forms = [("whole", 0.005), ("whole", 0.03), ("extra", 0.005), ("extra", 0.03)]
        forms += [("viscous", 0.01), ("viscous extra", 0.01), ("both", 0.005), ("both", 0.03)]
        return [cls(j, v0, form) for form, v0 in forms for j in range(arm.dof)]

    def variants(self, arm: Arm) -> Sequence["AsymmetricFriction"]:
        """With damping common to both directions."""
        return [dataclasses.replace(self, form="full")] if self.form == "both" else []

    @property
    def may_hold(self) -> frozenset[str]:
        return frozenset({CoulombFriction.name})

    @property
    def held(self) -> tuple[type[AbstractEffect], ...]:
        return {
            "whole": (CoulombFriction,),
            "viscous": (ViscousFriction,),
            "both": (CoulombFriction,),
            "full": (CoulombFriction, ViscousFriction),
        }.get(self.form, ())

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        level = Coefficient("coulomb", "N·m", sign=1)
        difference = Coefficient("coulomb_asymmetry", "N·m")
        slope = Coefficient("damping", "N·m·s/rad", sign=1)
        bend = Coefficient("damping_asymmetry", "N·m·s/rad")
        return {
            "whole": (level, difference),
            "extra": (difference,),
            "viscous": (slope, bend),
            "viscous extra": (bend,),
            "both": (level, difference, bend),
            "full": (level, difference, bend, slope),
        }[self.form]

    @property
    def equation(self) -> str:
        return (
            "tau = "
            + {
                "whole": "coulomb * tanh(dq / v0) + coulomb_asymmetry * tanh(dq / v0)^2",
                "extra": "coulomb_asymmetry * tanh(dq / v0)^2",
                "viscous": "damping * dq + damping_asymmetry * |dq|",
                "viscous extra": "damping_asymmetry * |dq|",
                "both": "coulomb * tanh(dq / v0) + coulomb_asymmetry * tanh(dq / v0)^2"
                " + damping_asymmetry * |dq|",
                "full": "coulomb * tanh(dq / v0) + coulomb_asymmetry * tanh(dq / v0)^2"
                " + damping * dq + damping_asymmetry * |dq|",
            }[self.form]
        )

    def levels(self, s: Channels) -> Float[Array, " n"]:
        sign = smooth_sign(s.qd[self.joint], self.v0)
        one, none = jnp.ones_like(sign), jnp.zeros_like(sign)
        return jnp.stack(
            {
                "whole": [one, sign],
                "extra": [sign],
                "viscous": [none, none],
                "viscous extra": [none],
                "both": [one, sign, none],
                "full": [one, sign, none, none],
            }[self.form]
        )

    def remainder(self, s: Channels) -> Float[Array, " n"]:
        qd = s.qd[self.joint]
        bend, none = qd * smooth_sign(qd, self.v0), jnp.zeros_like(qd)
        return jnp.stack(
            {
                "whole": [none, none],
                "extra": [none],
                "viscous": [qd, bend],
                "viscous extra": [bend],
                "both": [none, none, bend],
                "full": [none, none, bend, qd],
            }[self.form]
        )


class LoadDependentFriction(AbstractDryFriction):
    r"""Friction that grows with the transmitted torque.

    $$\tau_j = \left(F_c + |\tau_{load}|^p\,(\mu + \kappa \operatorname{sign}(\tau_{load}\,\dot q_j))\right)
      \tanh(\dot q_j / v_0) + \nu\,|\tau_{load}|^p\,\dot q_j$$

    $\tau_{load}$ is the torque of the rigid arm at the joint, p is near 1. A gear's teeth carry the friction as
    well as the load, $F = \mu\,|\tau_{load} + F|$: more where the motor drives the load ($\mu/(1 - \mu)$) than
    where the load drives the motor ($\mu/(1 + \mu)$), which is $\kappa$. The words of `form` say what is there
    beside $\mu$: "coulomb" $F_c$, "instead" the same of either sign for a joint whose model holds some,
    "directed" $\kappa$, "viscous" $\nu$.

    References:
        Bittencourt et al., IROS 2010; Duclusaud et al., arXiv 2410.08650.
    """

    name: ClassVar[str] = "load_dependent_friction"
    family: ClassVar[str] = "friction"
    seen_against: ClassVar[str] = "|load|, turned by direction"
    shapes: ClassVar[tuple[Shape, ...]] = (_WIDTH, Shape("exponent", "1", 0.6, 1.6))
    reveals: ClassVar[str] = "the same speed in loaded and unloaded poses; with and without payload"
    prior: ClassVar[float] = -17.0

    joint: Joint
    v0: Float[Array, ""] | float
    exponent: Float[Array, ""] | float
    form: str = eqx.field(static=True)

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["LoadDependentFriction"]:
        return [
            cls(j, v0, 1.0, form)
            for form in ("", "coulomb", "instead")
            for v0 in (0.004, 0.02, 0.06)
            for j in (has_friction(arm) if form == "instead" else range(arm.dof))
        ]

    @property
    def may_hold(self) -> frozenset[str]:
        return frozenset({CoulombFriction.name})

    @property
    def held(self) -> tuple[type[AbstractEffect], ...]:
        of_words = {"coulomb": CoulombFriction, "viscous": ViscousFriction}
        return tuple(of_words[w] for w in self.form.split() if w in of_words)

    def variants(self, arm: Arm) -> Sequence["LoadDependentFriction"]:
        forms = ["directed", "coulomb directed", "viscous", "directed viscous"]
        if self.joint in has_friction(arm):
            forms.append("instead directed")
        return [dataclasses.replace(self, form=form) for form in forms if form != self.form]

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        of_words = {
            "coulomb": Coefficient("coulomb", "N·m", sign=1),
            "instead": LEVEL,
            "directed": Coefficient("load_asymmetry", "1"),
            "viscous": Coefficient("load_damping", "s/rad"),
        }
        return (Coefficient("load_coefficient", "1", sign=1), *(of_words[w] for w in self.form.split()))

    @property
    def equation(self) -> str:
        words = self.form.split()
        level = "coulomb + " if {"coulomb", "instead"} & set(words) else ""
        factor = (
            "(load_coefficient + load_asymmetry * sign(tau_load * dq))"
            if "directed" in words
            else "load_coefficient"
        )
        slope = " + load_damping * |tau_load|^exponent * dq" if "viscous" in words else ""
        return f"tau = ({level}{factor} * |tau_load|^exponent) * tanh(dq / v0){slope}"

    @property
    def feels(self) -> Literal["motion", "load", "acceleration"]:
        return "load"

    def _loaded(self, s: Channels) -> Array:
        return (jnp.abs(s.load[self.joint]) + 1e-9) ** self.exponent

    def levels(self, s: Channels) -> Float[Array, " n"]:
        loaded = self._loaded(s)
        of_words = {
            "coulomb": jnp.ones_like(loaded),
            "instead": jnp.ones_like(loaded),
            "directed": loaded * jnp.sign(s.load[self.joint]) * smooth_sign(s.qd[self.joint], self.v0),
            "viscous": jnp.zeros_like(loaded),
        }
        return jnp.stack([loaded, *(of_words[w] for w in self.form.split())])

    def remainder(self, s: Channels) -> Float[Array, " n"]:
        slope = self._loaded(s) * s.qd[self.joint]
        return jnp.stack([0 * slope, *(slope * (w == "viscous") for w in self.form.split())])


class FrictionDrift(AbstractDryFriction):
    r"""Friction that changes slowly over a recording, as when a joint warms up.

    $$\tau_j = g(t)\,(a \tanh(\dot q_j / v_0) + b\,\dot q_j) + F_c \tanh(\dot q_j / v_0) + F_v \dot q_j, \qquad
      g(t) = 1 - e^{-(t - t_0)/T}$$

    From `since` to `until` [s] was recorded; before and after, it goes on as `settling` says. Form "level" has a
    and `F_c` only, "slope" `b` and `F_v`, "both" all; "... extra" leaves out the constant part.

    References:
        Simoni et al., Robotica 2017; Wolf and Iskandar, ICRA 2018.
    """

    name: ClassVar[str] = "friction_drift"
    family: ClassVar[str] = "friction"
    seen_against: ClassVar[str] = "time, turned by direction"
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("time_constant", "s", 0.5, 2000.0), _WIDTH)
    reveals: ClassVar[str] = "the same motion cold and warm"
    prior: ClassVar[float] = -17.0
    drifts: ClassVar[bool] = True

    joint: Joint
    time_constant: Float[Array, ""] | float
    v0: Float[Array, ""] | float
    form: str = eqx.field(static=True)
    until: float = EVER
    since: float = 0.0

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["FrictionDrift"]:
        forms = ("level extra", "level", "slope extra", "slope", "both extra")
        return [
            cls(j, T, v0, form)
            for form in forms
            for T in (2.0, 6.0, 20.0, 300.0)
            for v0 in ((0.005, 0.03) if form.startswith("level") else (0.01,))
            for j in range(arm.dof)
        ]

    def counted_from(self, start: float) -> "FrictionDrift":
        return dataclasses.replace(self, since=start)

    def beyond(self, recorded: Sequence[Channels]) -> "FrictionDrift":
        return dataclasses.replace(self, until=max(float(s.t[-1]) for s in recorded))

    def lasting(self, c: Float[np.ndarray, " n"]) -> tuple["FrictionDrift", Float[np.ndarray, " n"]]:
        end = float(settling(jnp.asarray(jnp.inf), self.time_constant, self.since, self.until))
        changes = np.array([k.name.endswith("_change") for k in self.coefficients])
        return dataclasses.replace(self, time_constant=1e-6, since=-EVER), np.where(changes, end * c, c)

    @property
    def steady(self) -> tuple[AbstractDryFriction | ViscousFriction, ...]:
        """The friction that does not change."""
        level, slope = CoulombFriction(self.joint, self.v0), ViscousFriction(self.joint)
        return {"level": (level,), "slope": (slope,), "both": (level, slope)}[
            self.form.removesuffix(" extra")
        ]

    @property
    def may_hold(self) -> frozenset[str]:
        return frozenset({CoulombFriction.name})

    @property
    def held(self) -> tuple[type[AbstractEffect], ...]:
        return tuple(type(law) for law in self.steady)

    def variants(self, arm: Arm) -> Sequence["FrictionDrift"]:
        return [dataclasses.replace(self, form=form) for form in ("both", "both extra") if form != self.form]

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        level, slope = Coefficient("coulomb_change", "N·m"), Coefficient("damping_change", "N·m·s/rad")
        return {
            "level extra": (level,),
            "level": (level, LEVEL),
            "slope extra": (slope,),
            "slope": (slope, SLOPE),
            "both extra": (level, slope),
            "both": (level, slope, LEVEL, SLOPE),
        }[self.form]

    @property
    def equation(self) -> str:
        g = f"(1 - exp(-{counted(self.since)} / time_constant))"
        return (
            "tau = "
            + {
                "level extra": f"coulomb_change * {g} * tanh(dq / v0)",
                "level": f"(coulomb + coulomb_change * {g}) * tanh(dq / v0)",
                "slope extra": f"damping_change * {g} * dq",
                "slope": f"(damping + damping_change * {g}) * dq",
                "both extra": f"{g} * (coulomb_change * tanh(dq / v0) + damping_change * dq)",
                "both": f"(coulomb + coulomb_change * {g}) * tanh(dq / v0)"
                f" + (damping + damping_change * {g}) * dq",
            }[self.form]
        )

    def _share(self, s: Channels) -> Float[Array, ""]:
        return settling(s.t, self.time_constant, self.since, self.until)

    def levels(self, s: Channels) -> Float[Array, " n"]:
        g = self._share(s)
        one, none = jnp.ones_like(g), jnp.zeros_like(g)
        return jnp.stack(
            {
                "level extra": [g],
                "level": [g, one],
                "slope extra": [none],
                "slope": [none, none],
                "both extra": [g, none],
                "both": [g, none, one, none],
            }[self.form]
        )

    def remainder(self, s: Channels) -> Float[Array, " n"]:
        qd = s.qd[self.joint]
        slope, none = self._share(s) * qd, jnp.zeros_like(qd)
        return jnp.stack(
            {
                "level extra": [none],
                "level": [none, none],
                "slope extra": [slope],
                "slope": [slope, qd],
                "both extra": [none, slope],
                "both": [none, slope, none, qd],
            }[self.form]
        )


EFFECTS = (
    ViscousFriction,
    CoulombFriction,
    PowerLawFriction,
    AsymmetricFriction,
    LoadDependentFriction,
    FrictionDrift,
)
