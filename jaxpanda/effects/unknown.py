"""What no named effect explains: a free function of a channel or two, so that it is still located and fitted."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels import link_poses
from jaxtyping import Array, Float

from ..arms.arm import Arm
from .effect import (
    UNNAMED,
    AbstractArmEffect,
    AbstractDryFriction,
    AbstractInstantEffect,
    Coefficient,
    Resistance,
    Shape,
    Sweep,
    counted,
    sign_over_velocity,
    smooth_sign,
)
from .motion import Channels, Joint, Motion, gravity_columns, wrench_columns
from .still import LawAtRest, Levels

FREE = -21.0
"""Prior of a torque that has no law."""
LAWFUL = 6.0
"""What is added to that of a law with no name of its own, so that it is as likely as a named one."""
_SHOWN = 0.9
"""Share missed up to which what a sensor shows tells the torque."""
SIGN_WIDTH = 0.01
"""Velocity over which friction without a law changes sign [rad/s]."""
FORMS = {
    "odd in dq": "an odd function of the joint's velocity",
    "even in dq": "an even function of the joint's velocity",
    "of q": "a function of the joint's position",
    "of load": "a function of the joint's load",
    "friction of q": "friction that depends on the joint's position",
    "friction of load": "friction that depends on the joint's load",
    "of ddq": "a function of the joint's acceleration",
    "of q_k": "a function of another joint's position",
    "odd in dq_k": "an odd function of another joint's velocity",
}
"""What the free function may depend on."""
_AGAINST = {
    "odd in dq": "velocity",
    "even in dq": "velocity",
    "of q": "position",
    "of load": "load",
    "friction of q": "position, turned by direction",
    "friction of load": "|load|, turned by direction",
    "of ddq": "acceleration",
    "of q_k": "source position",
    "odd in dq_k": "source velocity",
}
"""`seen_against` of each."""
_CHANNELS = {
    "odd in dq": lambda s, j: abs(s.qd[..., j]),
    "even in dq": lambda s, j: abs(s.qd[..., j]),
    "of q": lambda s, j: s.q[..., j],
    "of load": lambda s, j: s.load[..., j],
    "friction of q": lambda s, j: s.q[..., j],
    "friction of load": lambda s, j: abs(s.load[..., j]),
    "of ddq": lambda s, j: s.qdd[..., j],
    "of q_k": lambda s, j: s.q[..., j],
    "odd in dq_k": lambda s, j: abs(s.qd[..., j]),
}
"""What each is a function of, at an instant or over a motion; j: the joint, of the last two the source."""
_KNOTS, _FEW = {"odd in dq": 8, "even in dq": 8, "of q": 10, "friction of q": 9}, 6
"""How many knots each has, and the others."""
_NEARLY_ALL = (0.005, 0.995)
"""Quantiles of a channel between which a function of it is told."""
_VARIES = 1e-6
"""Range from which a channel can tell a function of it."""
_MOVES = 0.02
"""Travel from which a joint's position may count beside another's [rad]."""
_SLOW = 1e-3
"""What a product of two joints' velocities [rad²/s²], and the last link's [m/s], must exceed to tell anything."""
_OF_FASTEST, _REACHES = (0.15, 0.4, 0.7, 1.0), (0.0, 0.1, 0.2)
"""Knots of a drag, in the largest speed of the last link, and where beyond its frame it may act [m]."""
_LIMITS = np.geomspace(0.1, 0.98, 16)
"""Of a torque sensor, in the largest torque of its joint."""
_SPOTS, _PLACES = (0.03, 0.08), 64
"""Widths of a torque at one place [rad], and how many places are tried at most."""


def _ranges(motions: Sequence[Motion]) -> Float[np.ndarray, "2 dof"]:
    """Where the joints have been, but for the extremes [rad]."""
    return np.quantile(np.concatenate([m.q for m in motions]), _NEARLY_ALL, axis=0)


def _knots(form: str, x: Float[np.ndarray, " time"]) -> tuple[float, ...]:
    """Half by the range, half by where the samples are; none where the channel hardly varies."""
    share = np.linspace(0, 1, _KNOTS.get(form, _FEW))
    low, high = np.quantile(x, _NEARLY_ALL)
    if high - low < _VARIES:
        return ()
    evenly = low + share * (high - low)
    return tuple((0.5 * evenly + 0.5 * np.quantile(x, 0.005 + 0.99 * share)).tolist())


class Unknown(AbstractInstantEffect):
    r"""Structure that nothing named explains: $\tau_j = f(x)$ or $\tau_j = \tanh(\dot q_j/v_0)\,f(x)$.

    f is piecewise linear, with a coefficient for its value at each knot; beyond the outermost knots it is
    constant. `source` is the joint whose channel x is.
    """

    name: ClassVar[str] = UNNAMED
    prior: ClassVar[float] = FREE
    free: ClassVar[bool] = True
    repeats: ClassVar[bool] = True
    reveals: ClassVar[str] = "single-joint motions that vary the channel it depends on and nothing else"
    at_rest: ClassVar[str] = "torque that none of these explains"

    joint: Joint
    source: Joint
    knots: Float[Array, " n"] | tuple[float, ...]
    form: str = eqx.field(static=True)

    @property
    def seen_against(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return _AGAINST[self.form]

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["Unknown"]:
        return []

    @classmethod
    def from_motions(cls, motions: Sequence[Motion]) -> Sequence["Unknown"]:
        joints, out = range(motions[0].dof), []
        for form, j in itertools.product(FORMS, joints):
            others = form.endswith("_k")
            for k in [k for k in joints if (k != j) == others]:
                if knots := _knots(form, np.concatenate([_CHANNELS[form](m, k) for m in motions])):
                    out.append(cls(j, k, knots, form))
        return out

    @classmethod
    def while_still(cls, levels: Levels) -> Sequence[LawAtRest]:
        """Any torque, ten times as large as friction would be."""
        return [LawAtRest(10 * levels.free, 0.02 if levels.when == "throughout" else 0.05)]

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return tuple(Coefficient(f"value_at_knot_{k + 1}", "N·m") for k in range(np.shape(self.knots)[-1]))

    @property
    def equation(self) -> str:
        k = int(self.source) + 1
        x = {
            "odd in dq": "|dq|",
            "even in dq": "|dq|",
            "of load": "tau_load",
            "friction of load": "|tau_load|",
            "of q_k": f"q_{k}",
            "odd in dq_k": f"|dq_{k}|",
        }.get(self.form, self.form.split()[-1])
        sign = {"odd in dq_k": f"sign(dq_{k}) * "}.get(self.form, "sign(dq) * " if self._odd else "")
        return f"tau = {sign}f({x}), piecewise linear: {FORMS[self.form]}"

    @property
    def _odd(self) -> bool:
        return self.form.startswith("friction") or self.form.startswith("odd")

    @property
    def dry_width(self) -> Array | float | None:
        return SIGN_WIDTH if self._odd and self.form != "odd in dq_k" else None

    @property
    def feels(self) -> Literal["motion", "load", "acceleration"]:
        if self.form == "of ddq":
            return "acceleration"
        return "load" if self.form.endswith("load") else "motion"

    def _hats(self, s: Channels) -> Float[Array, " n"]:
        """Share of each knot."""
        x = _CHANNELS[self.form](s, self.source if self.form.endswith("_k") else self.joint)
        knots = jnp.asarray(self.knots)
        passed = jnp.clip((x - knots[:-1]) / jnp.diff(knots), 0.0, 1.0)  # share of each stretch below x
        return jnp.append(1.0, passed) - jnp.append(passed, 0.0)

    def at(self, s: Channels) -> Float[Array, " n"]:
        if not self._odd:
            return self._hats(s)
        source = self.source if self.form == "odd in dq_k" else self.joint
        return self._hats(s) * smooth_sign(s.qd[source], SIGN_WIDTH)

    def resist(self, c, arm, z, s, dt):
        if self.dry_width is None:
            return super().resist(c, arm, z, s, dt)
        damping = self._hats(s) @ c * sign_over_velocity(s.qd[self.joint], SIGN_WIDTH)
        return Resistance(jnp.zeros_like(s.q), self._here(damping, s), z)

    def parameters(self, c, covariance):
        knots = [
            {
                "name": f"knot_{k + 1}",
                "joint": int(self.joint) + 1,
                "value": float(x),
                "std": 0.0,
                "unit": "-",
            }
            for k, x in enumerate(np.asarray(self.knots))
        ]
        return super().parameters(c, covariance) + knots


class UnknownOfTwo(AbstractInstantEffect):
    r"""A torque that two joints' positions decide: $\tau_j = \sum_{m+n \le 3} c_{mn} P_m(u) P_n(v)$.

    u and v are the positions of the joint and of the other, from -1 to 1 between the ends of what was recorded
    and constant beyond; P are Legendre's polynomials. A cable or a hose led past both joints gives such a torque.
    """

    name: ClassVar[str] = UNNAMED
    seen_against: ClassVar[str] = "position"
    prior: ClassVar[float] = FREE
    free: ClassVar[bool] = True
    repeats: ClassVar[bool] = True
    reveals: ClassVar[str] = Unknown.reveals

    joint: Joint
    source: Joint
    low: Float[Array, "2"] | tuple[float, float]
    """Of both positions [rad]."""
    high: Float[Array, "2"] | tuple[float, float]

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["UnknownOfTwo"]:
        return []

    @classmethod
    def from_motions(cls, motions: Sequence[Motion]) -> Sequence["UnknownOfTwo"]:
        low, high = _ranges(motions)
        ends = lambda j, k: ((float(x[j]), float(x[k])) for x in (low, high))
        return [
            cls(j, k, *ends(j, k))
            for j, k in itertools.permutations(np.flatnonzero(high - low > _MOVES).tolist(), 2)
        ]

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return tuple(Coefficient(f"polynomial_{m}_{n}", "N·m") for m, n in _POWERS)

    @property
    def equation(self) -> str:
        j, k = int(self.joint) + 1, int(self.source) + 1
        return f"tau = f(q_{j}, q_{k}), a polynomial of third degree: a function of two joints' positions"

    def at(self, s: Channels) -> Float[Array, " n"]:
        x = jnp.stack([s.q[self.joint], s.q[self.source]])
        low, high = jnp.asarray(self.low), jnp.asarray(self.high)
        u, v = jnp.clip(2 * (x - low) / (high - low) - 1, -1.0, 1.0)
        legendre = lambda y: (jnp.ones_like(y), y, 1.5 * y * y - 0.5, (2.5 * y * y - 1.5) * y)
        of_u, of_v = legendre(u), legendre(v)
        return jnp.stack([of_u[m] * of_v[n] for m, n in _POWERS])


_POWERS = tuple((m, n) for m in range(4) for n in range(4 - m))


class UnknownOfSpeeds(AbstractInstantEffect):
    r"""A torque in proportion to the product of two joints' velocities, $\tau_j = c\,\dot q_i\,\dot q_k / p$.

    p is the largest product that was recorded, beyond which the torque is constant. Centrifugal and Coriolis
    torque of bodies that are elsewhere than in the model is like that, pose by pose.
    """

    name: ClassVar[str] = UNNAMED
    prior: ClassVar[float] = FREE
    free: ClassVar[bool] = True
    repeats: ClassVar[bool] = True
    reveals: ClassVar[str] = "each of the two joints moved fast alone, and both together"

    joint: Joint
    first: Joint
    second: Joint
    largest: Float[Array, ""] | float
    """[rad²/s²]."""

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["UnknownOfSpeeds"]:
        return []

    @classmethod
    def from_motions(cls, motions: Sequence[Motion]) -> Sequence["UnknownOfSpeeds"]:
        qd, out = np.concatenate([m.qd for m in motions]), []
        for i, k in itertools.combinations_with_replacement(range(qd.shape[1]), 2):
            largest = float(np.max(np.abs(qd[:, i] * qd[:, k])))
            if largest > _SLOW:
                out += [cls(j, i, k, largest) for j in range(qd.shape[1])]
        return out

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return (Coefficient("torque_at_largest", "N·m"),)

    @property
    def equation(self) -> str:
        i, k = int(self.first) + 1, int(self.second) + 1
        return (
            f"tau = torque_at_largest * dq_{i} * dq_{k} / {float(self.largest):.3g}, the fraction 1 at most:"
            " the product of two joints' velocities"
        )

    def at(self, s: Channels) -> Float[Array, " n"]:
        return jnp.clip(s.qd[self.first] * s.qd[self.second] / self.largest, -1.0, 1.0)[None]


class UnknownDrag(AbstractArmEffect):
    r"""A force on the last link against its velocity, $\tau = J_n(q)^\top f(|v|)\,v / |v|$.

    v is the velocity of the point at `reach` along the link's z axis [m]; f is piecewise linear, none at rest,
    with a coefficient for its value at each knot, constant beyond the last. A hose that is dragged along gives
    such a force, a fluid, and a tool that rubs. A last joint that turns does so about that axis, and feels none.
    """

    name: ClassVar[str] = UNNAMED
    prior: ClassVar[float] = FREE
    reveals: ClassVar[str] = "the same path at several speeds, and with nothing fastened to the flange"
    on_links: ClassVar[bool] = True

    dof: int = eqx.field(static=True)
    reach: float = eqx.field(static=True)
    knots: tuple[float, ...] = eqx.field(static=True)
    """Of the speed [m/s], from the first above rest."""
    slides: bool = eqx.field(static=True, default=False)
    """Whether the last joint does."""

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["UnknownDrag"]:
        return []

    @classmethod
    def from_motions(cls, motions: Sequence[Motion]) -> Sequence["UnknownDrag"]:
        knots = np.array(_OF_FASTEST) * _fastest(motions)
        slides = bool(motions[0].arm.chain.prismatic[-1])
        reaches = _REACHES if knots[0] > _SLOW else ()
        return [cls(motions[0].dof, reach, tuple(knots.tolist()), slides) for reach in reaches]

    @property
    def joints(self) -> tuple[int, ...]:
        return tuple(range(self.dof if self.slides else max(self.dof - 1, 1)))

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return tuple(Coefficient(f"force_at_knot_{k + 1}", "N", sign=1) for k in range(len(self.knots)))

    @property
    def equation(self) -> str:
        law = f"tau = J_{self.dof}(q)^T f(|v|) v / |v|, f piecewise linear"
        return f"{law}: a force on the last link against its velocity"

    def over(self, motion: Motion) -> Float[np.ndarray, "time dof n"]:
        W, R = motion.wrench_columns[:, -1], motion.link_axes[:, -1]
        force = W[..., :3] + np.cross(W[..., 3:], self.reach * R[:, None, :, 2])
        v = -np.einsum("tja,tj->ta", force, motion.qd)
        speed = np.linalg.norm(v, axis=1)
        against = -np.einsum("tja,ta->tj", force, v / np.maximum(speed, 1e-9)[:, None])
        return against[..., None] * np.stack(_from_rest(np.interp, speed, self.knots), 1)[:, None]

    def resist(self, c, arm, z, s, dt):
        q = jnp.asarray(s.q)
        W, R = wrench_columns(arm, q)[-1], link_poses(arm.chain, q)[0][-1]
        force = W[:, :3] + jnp.cross(W[:, 3:], self.reach * R[:, 2])
        v = -force.T @ s.qd
        speed = jnp.sqrt(v @ v + 1e-18)
        return Resistance(
            -force @ v / speed * (jnp.stack(_from_rest(jnp.interp, speed, self.knots)) @ c),
            jnp.zeros_like(s.q),
            z,
        )

    def parameters(self, c, covariance):
        knots = [
            {"name": f"knot_{k + 1}", "joint": None, "value": x, "std": 0.0, "unit": "m/s"}
            for k, x in enumerate(self.knots)
        ]
        return [{**p, "joint": None} for p in super().parameters(c, covariance)] + knots


class UnknownSpin(AbstractArmEffect):
    r"""A body that spins on the last link, $\tau = J_n(q)^\top (\omega \times R\,h)$.

    Its angular momentum h is constant along the link's axes, R: a spindle, a grinder, a fan. J and $\omega$ are
    the Jacobian and the velocity of the link's rotation.
    """

    name: ClassVar[str] = UNNAMED
    prior: ClassVar[float] = FREE
    reveals: ClassVar[str] = "the same motion with what turns on the last link switched off"
    on_links: ClassVar[bool] = True

    dof: int = eqx.field(static=True)

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["UnknownSpin"]:
        return []

    @classmethod
    def from_motions(cls, motions: Sequence[Motion]) -> Sequence["UnknownSpin"]:
        return [cls(motions[0].dof)] if _OF_FASTEST[0] * _fastest(motions) > _SLOW else []

    @property
    def joints(self) -> tuple[int, ...]:
        return tuple(range(self.dof))

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return tuple(Coefficient(f"momentum_{axis}", "kg·m²/s") for axis in "xyz")

    @property
    def equation(self) -> str:
        return f"tau = J_{self.dof}(q)^T (omega x momentum): a body that spins on the last link"

    def over(self, motion: Motion) -> Float[np.ndarray, "time dof n"]:
        W, R = motion.wrench_columns[:, -1, :, 3:], motion.link_axes[:, -1]
        omega = -np.einsum("tja,tj->ta", W, motion.qd)
        return -np.einsum("tja,tka->tjk", W, np.cross(omega[:, None], np.swapaxes(R, 1, 2)))

    def resist(self, c, arm, z, s, dt):
        q = jnp.asarray(s.q)
        W, R = wrench_columns(arm, q)[-1, :, 3:], link_poses(arm.chain, q)[0][-1]
        return Resistance(-W @ jnp.cross(-W.T @ s.qd, R @ c), jnp.zeros_like(s.q), z)

    def parameters(self, c, covariance):
        return [{**p, "joint": None} for p in super().parameters(c, covariance)]


class UnknownShaking(AbstractArmEffect):
    r"""A base that shakes at one frequency throughout recordings, as on a cart, or beside another machine.

    $$\tau = -\frac{\partial\tau}{\partial g}(q)\,(a \sin 2\pi f t + b \cos 2\pi f t)$$

    with the base's acceleration $a \sin 2\pi f t + b \cos 2\pi f t$ along its axes, of each recording another.
    """

    name: ClassVar[str] = UNNAMED
    prior: ClassVar[float] = FREE
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("frequency", "Hz", 0.1, 1e3),)
    reveals: ClassVar[str] = "a recording with the base at rest"
    swings: ClassVar[bool] = True
    on_links: ClassVar[bool] = True
    bound_to_recording: ClassVar[bool] = True
    throughout: ClassVar[bool] = True
    repeats: ClassVar[bool] = True

    dof: int = eqx.field(static=True)
    shaken: tuple[str, ...] = eqx.field(static=True)
    """Names of the recordings."""
    frequency: Float[Array, ""] | float
    now: str = eqx.field(static=True, default="")
    """Which of them `placed` was asked for."""
    since: float = 0.0
    """From when on t is counted [s]."""

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["UnknownShaking"]:
        return []

    @classmethod
    def swinging(cls, dof: int, recordings: tuple[str, ...], frequency: float) -> "UnknownShaking":
        return cls(dof, recordings, frequency)

    @classmethod
    def swung(cls, motion: Motion) -> Float[np.ndarray, "time dof n"]:
        return -motion.gravity_columns

    def counted_from(self, start: float) -> "UnknownShaking":
        return dataclasses.replace(self, since=start)

    @property
    def recordings(self) -> tuple[str, ...]:
        return self.shaken

    def placed(self, recording: str, later: bool | None) -> "UnknownShaking | None":
        return dataclasses.replace(self, now=recording) if recording in self.shaken else None

    @property
    def joints(self) -> tuple[int, ...]:
        return tuple(range(self.dof))

    @property
    def form_prior(self) -> float:
        return LAWFUL

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        ends = [f"_{k + 1}" for k in range(len(self.shaken))] if len(self.shaken) > 1 else [""]
        names = [f"{wave}_{axis}{end}" for end in ends for wave in ("sine", "cosine") for axis in "xyz"]
        return tuple(Coefficient(name, "m/s²", scale=0.3) for name in names)

    @property
    def equation(self) -> str:
        t = counted(self.since)
        a = f"(sine * sin(2 pi frequency {t}) + cosine * cos(2 pi frequency {t}))"
        return f"tau = -dtau/dg(q) * {a}: a base that shakes"

    @property
    def _own(self) -> slice:
        """Coefficients of the recording that is asked for."""
        k = self.shaken.index(self.now)
        return slice(6 * k, 6 * k + 6)

    def over(self, motion: Motion) -> Float[np.ndarray, "time dof n"]:
        out = np.zeros((motion.samples, self.dof, len(self.coefficients)))
        if self.now:
            angle = 2 * np.pi * float(self.frequency) * (motion.time - self.since)
            waves = (wave(angle)[:, None, None] for wave in (np.sin, np.cos))
            out[..., self._own] = np.concatenate([self.swung(motion) * wave for wave in waves], 2)
        return out

    def resist(self, c, arm, z, s, dt):
        angle, own = 2 * jnp.pi * self.frequency * (s.t - self.since), c[self._own]
        acceleration = jnp.sin(angle) * own[:3] + jnp.cos(angle) * own[3:]
        return Resistance(-gravity_columns(arm, jnp.asarray(s.q)) @ acceleration, jnp.zeros_like(s.q), z)

    def parameters(self, c, covariance):
        return [{**p, "joint": None} for p in super().parameters(c, covariance)]


def _fastest(motions: Sequence[Motion]) -> float:
    """Of the last link's frame [m/s]."""
    moved = lambda m: np.einsum("tja,tj->ta", m.wrench_columns[:, -1, :, :3], m.qd)
    return float(max(np.linalg.norm(moved(m), axis=1).max() for m in motions))


def _from_rest(interp: Any, x: Any, knots: Sequence[float]) -> list[Any]:
    """Share of each knot in a piecewise linear function of x that is zero at zero; `interp`: numpy's or JAX's."""
    ends = np.array([0.0, *knots])
    return [interp(x, ends, share) for share in np.eye(len(ends))[1:]]


class UnknownAt(AbstractDryFriction):
    r"""A torque at one place on a joint's way: a notch, a magnet, a worn tooth or a tight spot.

    $$\tau_j = \left(a + b\,x + c \tanh(\dot q_j/v_0)\right) e^{-x^2/2}, \qquad x = (q_j - q_0)/w$$
    """

    name: ClassVar[str] = UNNAMED
    seen_against: ClassVar[str] = "position"
    prior: ClassVar[float] = FREE
    free: ClassVar[bool] = True
    repeats: ClassVar[bool] = True
    shapes: ClassVar[tuple[Shape, ...]] = (
        Shape("place", "rad", -np.inf, np.inf, logarithmic=False),
        Shape("width", "rad", 0.01, 0.3),
    )
    reveals: ClassVar[str] = "slow motions of the joint past the place, in both directions"

    joint: Joint
    place: Float[Array, ""] | float
    width: Float[Array, ""] | float
    v0: Float[Array, ""] | float = SIGN_WIDTH

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["UnknownAt"]:
        return []

    @classmethod
    def sweep(cls, joint: int, motions: Sequence[Motion], cutoff: float) -> Sweep | None:
        low, high = _ranges(motions)[:, joint]
        widths = [max(w, (high - low) / _PLACES) for w in _SPOTS]
        tried = [(at, w) for w in widths for at in np.arange(low + w, high - w, w)]
        if not tried:
            return None
        place, width = np.transpose(tried)

        def columns(motion: Motion) -> Float[np.ndarray, "time shapes 3"]:
            x = (motion.q[:, joint, None] - place) / width
            sign = np.tanh(motion.qd[:, joint, None] / SIGN_WIDTH)
            bump = np.exp(-0.5 * x**2)
            return np.stack([bump, x * bump, sign * bump], 2)

        shape = lambda i: cls(joint, place=float(place[i]), width=float(width[i]))
        return Sweep(columns, shape, lambda i: (0.4 * float(width[i]), 0.3))

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return tuple(Coefficient(name, "N·m") for name in ("level", "slope", "friction"))

    @property
    def equation(self) -> str:
        return (
            "tau = (level + slope * x + friction * sign(dq)) * exp(-x^2 / 2), x = (q - place) / width: "
            "a torque at one place of the joint's way"
        )

    def levels(self, s: Channels) -> Float[Array, " n"]:
        return jnp.stack([0.0, 0.0, 1.0]) * self._bump(s)[1]

    def remainder(self, s: Channels) -> Float[Array, " n"]:
        x, bump = self._bump(s)
        return jnp.stack([1.0, x, 0.0]) * bump

    def _bump(self, s: Channels) -> tuple[Float[Array, ""], Float[Array, ""]]:
        x = (s.q[self.joint] - self.place) / self.width
        return x, jnp.exp(-0.5 * x * x)


class UnknownLimit(AbstractInstantEffect):
    r"""A torque sensor that saturates: of torque beyond $\pm L$ it misses a share, all of it where that is 1.

    $$\tau_j^{shown} = \tau_j - m\,(\tau_j - \mathrm{clip}(\tau_j, -L, L))$$
    """

    name: ClassVar[str] = UNNAMED
    seen_against: ClassVar[str] = "model torque"
    prior: ClassVar[float] = FREE
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("limit", "N·m", 1e-3, 1e6),)
    reveals: ClassVar[str] = "poses in which the joint bears known loads, small and large"
    acts_on: ClassVar[Literal["plant", "position", "torque"]] = "torque"

    joint: Joint
    limit: Float[Array, ""] | float

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["UnknownLimit"]:
        return []

    @classmethod
    def from_motions(cls, motions: Sequence[Motion]) -> Sequence["UnknownLimit"]:
        largest = np.max([np.abs(m.torque_shown).max(0) for m in motions], 0)
        return [cls(int(j), float(s * largest[j])) for j in np.flatnonzero(largest > 0) for s in _LIMITS]

    @property
    def form_prior(self) -> float:
        return LAWFUL

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return (Coefficient("share_missed", "1", sign=1, scale=1.0),)

    @property
    def equation(self) -> str:
        beyond = "(tau - clip(tau, -limit, limit))"
        return f"tau_measured = tau - share_missed * {beyond}: a torque sensor that saturates"

    def at(self, s: Channels) -> Float[Array, " n"]:
        return -self._beyond(s.torque[self.joint])[None]

    def sensed(self, c, t, tau):
        return tau.at[:, self.joint].add(-c[0] * self._beyond(tau[:, self.joint]))

    def true(self, c, t, tau):
        """What is missed altogether is not known."""
        kept = jnp.where(c[0] < _SHOWN, 1 - c[0], 1.0)
        return tau.at[:, self.joint].add(self._beyond(tau[:, self.joint]) * (1 / kept - 1))

    def _beyond(self, tau: Array) -> Array:
        return tau - jnp.clip(tau, -self.limit, self.limit)


EFFECTS = (
    Unknown,
    UnknownOfTwo,
    UnknownOfSpeeds,
    UnknownLimit,
    UnknownSpin,
    UnknownDrag,
    UnknownShaking,
    UnknownAt,
)
