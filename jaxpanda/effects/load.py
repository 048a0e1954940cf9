"""What the arm carries and how it stands: inertias of links, payloads, gravity."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels import rnea
from jaxtyping import Array, Float

from ..arms.arm import Arm
from .effect import EVER, AbstractArmEffect, Coefficient, Numbers, Resistance, Shape
from .motion import Motion
from .still import LawAtRest, Levels

_MOMENTS = ("first_moment_x", "first_moment_y", "first_moment_z")
_INERTIAS = ("inertia_xx", "inertia_xy", "inertia_yy", "inertia_xz", "inertia_yz", "inertia_zz")
_REACH = 0.17
"""Where a payload's centre of mass is expected, along the last link's axis from its origin [m]."""
_MASS, _WITHIN = 2.0, 0.1
"""Deviations of a body's mass [kg] and of the place of its centre of mass [m], on an arm that holds still."""
_TILT = 0.03
"""Deviation of a base that is not level [rad]."""


def _body(
    base: Float[np.ndarray, "10"], mass: float, moment: float, inertia: float, sign: int
) -> tuple[Float[np.ndarray, "10 10"], tuple[Coefficient, ...]]:
    """Standard parameters of each coefficient, and the coefficients: a body like `base`, and departures."""
    directions = np.eye(10)
    directions[:, 0] = base
    coefficients = (
        Coefficient("mass", "kg", sign=sign, scale=mass),
        *(Coefficient(name, "kg·m", scale=moment) for name in _MOMENTS),
        *(Coefficient(name, "kg·m²", scale=inertia) for name in _INERTIAS),
    )
    return directions, coefficients


def _unit_payload() -> Float[np.ndarray, "10"]:
    return np.array([1.0, 0.0, 0.0, _REACH, _REACH**2, 0.0, _REACH**2, 0.0, 0.0, 0.0])


def _as_body(
    effect: AbstractArmEffect,
    directions: Float[np.ndarray, "10 10"],
    c: Float[np.ndarray, " n"],
    covariance: Float[np.ndarray, "all all"],
) -> list[dict[str, Any]]:
    """Standard parameters of the body, about the link's frame; its centre of mass where it has a mass."""
    covariance = covariance[: len(c), : len(c)]
    phi, deviation = directions @ c, np.sqrt(np.maximum(np.diag(directions @ covariance @ directions.T), 0))
    names = ("mass", *_MOMENTS, *_INERTIAS)
    units = ("kg", *("kg·m",) * 3, *("kg·m²",) * 6)
    joint = effect.joints[0] + 1
    out = [
        {"name": name, "joint": joint, "value": float(v), "std": float(s), "unit": unit}
        for name, v, s, unit in zip(names, phi, deviation, units, strict=True)
    ]
    if phi[0] > 2 * deviation[0]:
        for k, axis in enumerate("xyz"):
            value = phi[1 + k] / phi[0]
            row = directions[1 + k] - value * directions[0]
            std = float(np.sqrt(max(row @ covariance @ row, 0.0)) / phi[0])
            out.append(
                {"name": f"com_{axis}", "joint": joint, "value": float(value), "std": std, "unit": "m"}
            )
    return out


def body_at_rest(levels: Levels, odds: float, *, positive: bool = False, told_by: Any = "") -> LawAtRest:
    """A body on the last link: mass, and first moment about where it is fastened."""
    link = levels.dof - 1
    columns = np.concatenate([pose.regressor[0][:, 10 * link : 10 * link + 4] for pose in levels.poses])
    names = (("mass", "kg", _MASS), *((f"mass_times_{axis}", "kg·m", _MASS * _WITHIN) for axis in "xyz"))
    deviations = np.array([size for _, _, size in names])
    return LawAtRest(columns * deviations, odds, link, names, positive, told_by)


def _in(link: int) -> str:
    """The frame that a body's parameters are in, in words."""
    return f", in the modified Denavit-Hartenberg frame of link {link + 1}, inertia about its origin"


class InertialParameters(AbstractArmEffect):
    r"""Mass, centre of mass or inertia of a link differ from the model: $\tau = Y_i\,\Delta\phi_i$.

    The first coefficient is a change of mass that leaves the link's shape and centre of mass as they are.
    """

    name: ClassVar[str] = "inertial_parameters"
    family: ClassVar[str] = "load"
    seen_against: ClassVar[str] = "model torque"
    reveals: ClassVar[str] = "an identification motion; a reference recording from before"
    at_rest: ClassVar[str] = "links that differ from the model's"
    on_links: ClassVar[bool] = True
    number: ClassVar[str] = "standard"

    link: int = eqx.field(static=True)
    standard: tuple[float, ...] = eqx.field(static=True)

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["InertialParameters"]:
        return [cls(i, tuple(float(v) for v in np.asarray(arm.standard[i]))) for i in range(arm.dof)]

    @classmethod
    def while_still(cls, levels: Levels) -> Sequence[LawAtRest]:
        return [] if levels.links is None else [LawAtRest(levels.links, 0.08)]

    @property
    def joints(self) -> tuple[int, ...]:
        return (self.link,)

    @property
    def _basis(self):
        base = np.array(self.standard)
        mass = max(abs(base[0]), 0.2)
        size = np.sqrt(max(np.abs(base[[4, 6, 9]]).max(), 1e-4) / mass)
        return _body(
            base / mass, 0.3 * mass, 0.3 * mass * min(size, 0.15), 0.3 * mass * min(size, 0.2) ** 2, 0
        )

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return self._basis[1]

    @property
    def equation(self) -> str:
        return (
            f"tau = Y_{self.link + 1}(q, dq, ddq) * (change of its ten inertial parameters{_in(self.link)})"
        )

    def over(self, motion: Motion) -> Float[np.ndarray, "time dof n"]:
        return motion.regressor[:, :, 10 * self.link : 10 * self.link + 10] @ self._basis[0]

    def standard_change(self, c: Numbers) -> tuple[int, Float[Array, "10"] | Float[np.ndarray, "10"]]:
        """Link, and what is added to its standard parameters."""
        return self.link, self._basis[0] @ c

    def parameters(self, c, covariance) -> list[dict[str, Any]]:
        return _as_body(self, self._basis[0], c, covariance)


class Payload(AbstractArmEffect):
    r"""An unmodelled body at the flange, present throughout: $\tau = Y_n\,\phi_{payload}$ with positive mass.

    Told from a wrong last link by where its centre of mass is expected: beyond the flange.

    References:
        Khalil, Gautier, Lemoine, ICRA 2007; Gaz and De Luca, IROS 2017.
    """

    name: ClassVar[str] = "payload"
    family: ClassVar[str] = "load"
    seen_against: ClassVar[str] = "model torque"
    reveals: ClassVar[str] = "a recording without the load, of the same motion"
    at_rest: ClassVar[str] = "a body at the flange that the model does not have"
    commonplace: ClassVar[bool] = True
    on_links: ClassVar[bool] = True

    link: int = eqx.field(static=True)

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["Payload"]:
        return [cls(arm.dof - 1)]

    @classmethod
    def while_still(cls, levels: Levels) -> Sequence[LawAtRest]:
        return [body_at_rest(levels, 0.12, positive=True)] if levels.when == "throughout" else []

    @property
    def joints(self) -> tuple[int, ...]:
        return (self.link,)

    @property
    def _basis(self):
        return _body(_unit_payload(), 1.0, 0.05, 0.005, 1)

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return self._basis[1]

    @property
    def equation(self) -> str:
        return (
            f"tau = Y_{self.link + 1}(q, dq, ddq) * (ten inertial parameters of the payload{_in(self.link)})"
        )

    def over(self, motion: Motion) -> Float[np.ndarray, "time dof n"]:
        return motion.regressor[:, :, 10 * self.link : 10 * self.link + 10] @ self._basis[0]

    def standard_change(self, c: Numbers) -> tuple[int, Float[Array, "10"] | Float[np.ndarray, "10"]]:
        """Link, and what is added to its standard parameters."""
        return self.link, self._basis[0] @ c

    @property
    def body(self):
        return self._basis[0]

    def parameters(self, c, covariance) -> list[dict[str, Any]]:
        return _as_body(self, self._basis[0], c, covariance)


class PayloadChange(AbstractArmEffect):
    r"""A body at the flange, gained or lost at $t_0$ during a recording: $\tau = H(t - t_0)\,Y_n\,\phi$.

    Form "gained": there from `start` on. Form "lost": there until `stop`. Form "carried": from `start` to `stop`.
    The model is without it.
    """

    name: ClassVar[str] = "payload_change"
    family: ClassVar[str] = "load"
    prior: ClassVar[float] = -17.0
    reveals: ClassVar[str] = "the same poses before and after"
    at_rest: ClassVar[str] = "a body gained or lost at the flange"
    on_links: ClassVar[bool] = True
    bound_to_recording: ClassVar[bool] = True
    repeats: ClassVar[bool] = True

    link: int = eqx.field(static=True)
    start: Float[Array, ""] | float
    stop: Float[Array, ""] | float
    recording: str = eqx.field(static=True)
    form: str = eqx.field(static=True)

    @property
    def form_prior(self) -> float:
        """Any push may look like a body held for a while."""
        return -17.0 if self.form == "carried" else 0.0

    @property
    def shapes(self) -> tuple[Shape, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        names = {"gained": ("start",), "lost": ("stop",), "carried": ("start", "stop")}[self.form]
        return tuple(Shape(name, "s", -np.inf, np.inf, False) for name in names)

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["PayloadChange"]:
        return []

    @classmethod
    def at_some_time(cls, dof: int, recording: str) -> Sequence[Sequence["PayloadChange"]]:
        return [[cls(dof - 1, -EVER, EVER, recording, form) for form in ("gained", "lost", "carried")]]

    @classmethod
    def typical(cls, recordings: Mapping[str, Motion]) -> Sequence[Sequence["PayloadChange"]]:
        """Gained half-way."""
        name, motion = next(iter(recordings.items()))
        middle = 0.5 * float(motion.time[0] + motion.time[-1])
        return [[cls(motion.dof - 1, middle, EVER, name, "gained")]]

    @property
    def ends(self) -> tuple[bool, bool]:
        return self.form != "lost", self.form != "gained"

    def within(self, first: float, last: float, step: float) -> "PayloadChange":
        """Kept inside the recording: beyond, it is a payload that was there throughout."""
        inside = lambda at: at if abs(at) >= EVER else float(np.clip(at, first + 3 * step, last - 3 * step))
        return dataclasses.replace(self, start=inside(float(self.start)), stop=inside(float(self.stop)))

    @classmethod
    def while_still(cls, levels: Levels) -> Sequence[LawAtRest]:
        if levels.when == "throughout":
            return []
        passes = levels.when == "passing"
        return [body_at_rest(levels, 0.1 if passes else 0.2, positive=passes, told_by="keeping")]

    def variants(self, arm: Arm) -> Sequence["PayloadChange"]:
        """What begins or ends may also be where a body was gained or lost for good, other recordings included."""
        edges = [float(at) for at in (self.start, self.stop) if abs(float(at)) < EVER]
        lost = [dataclasses.replace(self, start=-EVER, stop=at, form="lost") for at in edges]
        gained = [dataclasses.replace(self, start=at, stop=EVER, form="gained") for at in edges]
        return [v for v in (*lost, *gained) if v.form != self.form]

    def placed(self, recording: str, later: bool | None) -> "PayloadChange | None":
        """A body gained stays for what is recorded later, one lost was there before."""
        if recording == self.recording:
            return self
        there = later is not None and self.form == ("gained" if later else "lost")
        return dataclasses.replace(self, start=-EVER, stop=EVER) if there else None

    @property
    def joints(self) -> tuple[int, ...]:
        return (self.link,)

    @property
    def _basis(self):
        return _body(_unit_payload(), 1.0, 0.05, 0.005, 1)

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return self._basis[1]

    @property
    def equation(self) -> str:
        when = {"gained": "t >= start", "lost": "t < stop", "carried": "start <= t < stop"}[self.form]
        body = f"ten inertial parameters of the body{_in(self.link)}"
        return f"tau = Y_{self.link + 1}(q, dq, ddq) * ({body}) while {when}"

    def over(self, motion: Motion) -> Float[np.ndarray, "time dof n"]:
        columns = motion.regressor[:, :, 10 * self.link : 10 * self.link + 10] @ self._basis[0]
        return columns * window(motion.time, float(self.start), float(self.stop), motion.dt)[:, None, None]

    @property
    def feels(self) -> Literal["motion", "load", "acceleration"]:
        return "load"

    @property
    def body(self):
        return self._basis[0]

    def carried(self, c: Numbers) -> tuple[int, Float[Array, "10"]] | None:
        return self.link, jnp.asarray(self._basis[0] @ c)

    def resist(self, c, arm, z, s, dt):
        """The body taken off while it is not there."""
        phi = jnp.zeros_like(arm.standard).at[self.link].set(self._basis[0] @ c)
        q, qd, qdd = (jnp.asarray(x) for x in (s.q, s.qd, s.qdd))
        gone = window(s.t, self.start, self.stop, dt) - 1
        return Resistance(rnea(arm.chain, phi, q, qd, qdd) * gone, jnp.zeros_like(q), z)

    def parameters(self, c, covariance) -> list[dict[str, Any]]:
        when = super().parameters(c, covariance)[len(c) :]
        return _as_body(self, self._basis[0], c, covariance) + when


class GravityDirection(AbstractArmEffect):
    r"""A base that is not level, or a wrong gravity vector.

    $$\tau = \frac{\partial \tau}{\partial g_x}\Delta g_x + \frac{\partial\tau}{\partial g_y}\Delta g_y$$

    across the direction that the model has; a tilt of 1 degree is 0.17 m/s².
    """

    name: ClassVar[str] = "gravity_direction"
    family: ClassVar[str] = "load"
    seen_against: ClassVar[str] = "first joint"
    size_of: ClassVar[tuple[str, int]] = ("gravity", 3)
    weakest_counts: ClassVar[bool] = True
    reveals: ClassVar[str] = "the first joint turned over 180 degrees"
    at_rest: ClassVar[str] = "a base that is not level"
    on_links: ClassVar[bool] = True

    across: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    dof: int = eqx.field(static=True)

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["GravityDirection"]:
        g = np.asarray(arm.chain.gravity, float)
        along = g / max(np.linalg.norm(g), 1e-9)
        axes = [e - along * along[k] for k, e in enumerate(np.eye(3))]
        kept = sorted(range(3), key=lambda k: abs(along[k]))[:2]
        rows = [axes[k] / np.linalg.norm(axes[k]) for k in sorted(kept)]
        return [cls(tuple(tuple(float(v) for v in row) for row in rows), arm.dof)]

    @classmethod
    def while_still(cls, levels: Levels) -> Sequence[LawAtRest]:
        """A tilt about two level axes."""
        if levels.when != "throughout":
            return []
        gravity = np.asarray(levels.poses[0].arm.chain.gravity)
        level = np.linalg.svd(gravity[None])[2][1:].T * np.linalg.norm(gravity)
        columns = np.concatenate([pose.gravity_columns[0] @ level for pose in levels.poses]) * _TILT
        return [LawAtRest(columns, 0.04, names=(("tilt_1", "rad", _TILT), ("tilt_2", "rad", _TILT)))]

    @property
    def joints(self) -> tuple[int, ...]:
        return tuple(range(self.dof))

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return tuple(Coefficient(f"gravity_{axis}", "m/s²", scale=0.3) for axis in "xy")

    @property
    def equation(self) -> str:
        return "tau = tau(g + gravity_x * e_x + gravity_y * e_y) - tau(g)"

    def over(self, motion: Motion) -> Float[np.ndarray, "time dof n"]:
        return motion.gravity_columns @ np.array(self.across).T

    def parameters(self, c, covariance):
        return [{**p, "joint": None} for p in super().parameters(c, covariance)]

    def gravity_change(self, c: Numbers) -> Float[Array, "3"] | Float[np.ndarray, "3"]:
        """What is added to the gravity vector [m/s²]."""
        return c @ np.array(self.across)

    def mjcf(self, c: Numbers, arm: Arm) -> Mapping[str, Any]:
        return {"gravity": np.asarray(arm.chain.gravity) + self.gravity_change(c)}


def window(time: Any, start: Any, stop: Any, dt: float) -> Any:
    """1 from `start` to `stop`, with edges one time step wide so that it changes smoothly with both."""
    return ((time - start) / dt + 0.5).clip(0, 1) * ((stop - time) / dt + 0.5).clip(0, 1)


EFFECTS = (InertialParameters, Payload, PayloadChange, GravityDirection)
