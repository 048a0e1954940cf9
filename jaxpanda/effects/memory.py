"""Friction with memory around reversals, and the backlash of a gear."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float

from ..arms.arm import Arm
from .effect import (
    AbstractEffect,
    AbstractMemoryEffect,
    Coefficient,
    Numbers,
    Resistance,
    Seconds,
    Shape,
    sign_over_velocity,
    smooth_sign,
)
from .friction import LEVEL, CoulombFriction
from .motion import Channels, Joint

STICKS = 1.5e-3
"""Breakaway distance below which friction with memory is Coulomb's that sticks [rad]: a joint at rest holds any
load up to the level, which a sign of the velocity cannot say."""


class PreslidingHysteresis(AbstractMemoryEffect):
    r"""Friction that builds up over a distance after each reversal, whatever the speed.

    Dahl's form, $\tau_j = F_c z$ with $dz = (\mathrm{sign}(\dot q) - z)\,|\dot q|\,dt / x_s$, and the Jenkins
    element of Maxwell-slip models, $dz = \dot q\,dt / x_s$ with $|z| \le 1$. LuGre's form adds to Dahl's what
    the bristles' own rate damps, $\sigma_1 x_s \dot z = \sigma_1 (\dot q - z |\dot q|)$. Form "... extra" has
    $z - s$, for a joint whose model holds Coulomb friction at its full level already, with s the share at which
    the model has it: MuJoCo's constraint creeps, on a light joint far from a sign of the velocity
    (`traces.held_sign`). "... whole" has both levels free.

    References:
        Dahl 1968; Canudas de Wit, Olsson, Åström, Lischinsky, IEEE TAC 1995, eqs. 1 to 3; Al-Bender, Lampaert,
        Swevers, IEEE TAC 2005.
    """

    name: ClassVar[str] = "presliding_hysteresis"
    family: ClassVar[str] = "friction"
    alike: ClassVar[bool] = True
    seen_against: ClassVar[str] = "reversal, turned by direction"
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("breakaway_distance", "rad", 1e-4, 0.2),)
    reveals: ClassVar[str] = "slow reversals of half to five breakaway distances"

    joint: Joint
    breakaway_distance: Float[Array, ""] | float
    form: str = eqx.field(static=True)

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["PreslidingHysteresis"]:
        distances = (1e-3, 2.5e-3, 6e-3, 0.015, 0.035, 0.08)
        forms = [f"{law} {extent}" for law in ("dahl", "jenkins") for extent in ("only", "extra", "whole")]
        forms.append("lugre only")
        return [cls(j, x, form) for form in forms for x in distances for j in range(arm.dof)]

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        name = LEVEL.name if self._extent == "only" else "friction_level"
        level = Coefficient(name, LEVEL.unit, sign=1)
        if self._law == "lugre":
            return level, Coefficient("micro_damping", "N·m·s/rad", sign=1)
        return (level, LEVEL) if self._extent == "whole" else (level,)

    @property
    def equation(self) -> str:
        law = "dz = (sign(dq) - z) * |dq| * dt / breakaway_distance"
        if self._law == "jenkins":
            law = "dz = dq * dt / breakaway_distance, |z| <= 1"
        torque = {
            "only": "coulomb * z",
            "extra": "friction_level * (z - sign(dq) as the model turns it)",
            "whole": "friction_level * z + coulomb * sign(dq)",
        }[self._extent]
        if self._law == "lugre":
            torque += " + micro_damping * (dq - z * |dq|)"
        return f"tau = {torque}, {law}"

    @property
    def dry(self) -> bool:
        return True

    @property
    def held(self) -> tuple[type[AbstractEffect], ...]:
        return (CoulombFriction,) if self._extent == "whole" else ()

    @property
    def title(self) -> str:
        """Of a joint whose model has the level already, memory is all that it adds."""
        return CoulombFriction.name if self.sticks and self._extent != "extra" else self.name

    @property
    def remark(self) -> str:
        if self.title == self.name:
            return ""
        return "Its equation has it stick at rest, as MuJoCo's frictionloss does."

    @property
    def form_prior(self) -> float:
        """Dry friction that sticks is Coulomb's, and as likely beforehand."""
        if self.sticks and self._extent == "only":
            return CoulombFriction.prior - self.prior
        return super().form_prior

    @property
    def sticks(self) -> bool:
        """Whether it is Coulomb's friction, which holds a joint at rest."""
        return float(self.breakaway_distance) < STICKS

    def mjcf(self, c: Numbers, arm: Arm) -> Mapping[str, Any]:
        """MuJoCo's `frictionloss` holds a joint at rest too; where a form "... extra" is found, it is there."""
        if not self.sticks:
            return {}
        level = {"only": c[0], "extra": 0.0 * c[0], "whole": c[0] + c[-1]}[self._extent]
        return {"frictionloss": {int(self.joint): level}}

    @property
    def forgets(self) -> Array | float:
        return self.breakaway_distance

    def start(self, s: Channels) -> Float[Array, " states"]:
        return turned(s.qd[self.joint])[None]

    def step(
        self, z: Float[Array, " states"], s: Channels, dt: Seconds
    ) -> tuple[Float[Array, " states"], Float[Array, " n"]]:
        qd = s.qd[self.joint]
        moved = qd * dt / self.breakaway_distance
        z = jnp.clip(z + moved, -1.0, 1.0) if self._law == "jenkins" else bristle(z, moved)
        if self._law == "lugre":
            return z, jnp.concatenate([z, qd - z * jnp.abs(qd)])
        sign = smooth_sign(qd, _WIDTH)[None]
        held = sign if s.held is None else s.held[self.joint][None]
        return z, {"only": z, "extra": z - held, "whole": jnp.concatenate([z, sign])}[self._extent]

    @property
    def _law(self) -> str:
        return self.form.split()[0]

    @property
    def _extent(self) -> str:
        return self.form.split()[1]

    @property
    def dry_width(self) -> Array | float | None:
        return None if self._extent == "only" else _WIDTH

    def resist(self, c, arm, z, s, dt):
        z = self.step(z, s, dt)[0]
        if self._law == "lugre":
            damping = c[1] * (1 - z[0] * jnp.sign(s.qd[self.joint]))
        else:
            level = {"only": jnp.zeros_like(c[0]), "extra": -c[0], "whole": c[-1]}[self._extent]
            damping = level * sign_over_velocity(s.qd[self.joint], _WIDTH)
        return Resistance(self._here(c[0] * z[0], s), self._here(damping, s), z)


def bristle(z: Float[Array, " states"], moved: Float[Array, ""]) -> Float[Array, " states"]:
    """Dahl's bristles after a motion over so many breakaway distances: exact where the direction stays."""
    sign = jnp.sign(moved)
    return sign + (z - sign) * jnp.exp(-jnp.abs(moved))


def turned(qd: Float[Array, ""]) -> Float[Array, ""]:
    """What bristles are taken for at the first instant: turned all the way, unless the joint is at rest."""
    return smooth_sign(qd, 0.01)


class Turn(NamedTuple):
    """How the dry friction of a joint turns at a reversal."""

    over: Literal["speed", "distance"]
    """What it is a matter of: tanh of the velocity over `size`, or Dahl's bristles."""
    size: float
    """In `unit`."""

    @property
    def unit(self) -> str:
        return {"speed": "rad/s", "distance": "rad"}[self.over]

    def share(
        self, q: Float[np.ndarray, " time"], qd: Float[np.ndarray, " time"]
    ) -> Float[np.ndarray, " time"]:
        """Of the level, at each instant, -1 to 1."""
        if self.over == "speed":
            return np.tanh(qd / self.size)
        moved = np.diff(q) / self.size
        kept = np.exp(-np.abs(moved))
        bands = np.ones((2, len(q)))
        bands[1, :-1] = -kept
        gained = np.concatenate([[float(turned(jnp.asarray(qd[0])))], np.sign(moved) * (1 - kept)])
        return scipy.linalg.solve_banded((1, 0), bands, gained)


_WIDTH = 0.005
"""Velocity over which the sign changes that takes off, or adds, a Coulomb level [rad/s]."""


_SPEEDS = (0.003, 0.01, 0.03)
_DISTANCES = (5e-4, 2e-3, 6e-3)


def turns(joint: int) -> tuple[AbstractMemoryEffect | CoulombFriction, ...]:
    """Ways in which the dry friction of a joint may turn: over some speeds [rad/s], over some distances [rad]."""
    return (
        *(CoulombFriction(joint, v) for v in _SPEEDS),
        *(PreslidingHysteresis(joint, x, "dahl only") for x in _DISTANCES),
    )


EFFECTS = (PreslidingHysteresis,)
