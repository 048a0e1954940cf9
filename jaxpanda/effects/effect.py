r"""The interface of an effect: what the diagnosis, the corrected model and the export need to know of it.

An effect is linear in its `coefficients` once its shape is given:

$$\tau = \sum_k c_k\,\Phi_k(\psi)$$

The coefficients are solved for in closed form; the shape $\psi$ (the float fields of the class) is searched over
`grid()` and refined. One class holds one effect; a `form` is a variant of it with columns of its own, as in
Stribeck friction with and without the Coulomb level that the model already holds.
"""

import abc
import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..arms.arm import Arm
from ..xla import filled
from .motion import Channels, Motion
from .still import LawAtRest, Levels

Numbers = Float[Array, " n"] | Float[np.ndarray, " n"]
"""Coefficients, which may be traced."""


@dataclasses.dataclass(frozen=True)
class Coefficient:
    """A linear parameter of an effect: its name, unit, and which signs physics allows."""

    name: str
    unit: str
    sign: int = 0
    """1: not negative; 0: either."""
    beyond: str = ""
    """The arm's number that it corrects: what has a sign is their sum."""
    scale: float | None = None
    """Size that is physically plausible; None: what shows in the noise decides."""


@dataclasses.dataclass(frozen=True)
class Shape:
    """A nonlinear parameter of an effect: its name, unit and bounds."""

    name: str
    unit: str
    lower: float
    upper: float
    logarithmic: bool = True
    pivot: bool = False
    """Whether columns are linearised about it: the first coefficient says the same, and is the unknown."""


class Resistance(eqx.Module):
    r"""What an effect does to the joints of a simulated arm: the motion takes $r + d \circ \dot q$ more torque.

    `damping` is friction that changes sign with the velocity, divided by it. At rest its slope is too steep for
    an explicit step; as damping a simulator takes it implicitly, $(M + h\,\mathrm{diag}\,d)\,\dot q^+ = \ldots$,
    which is stable at any step and neither reverses a joint nor lets it chatter.
    """

    torque: Float[Array, " dof"]
    """r [N m]."""
    damping: Float[Array, " dof"]
    """d [N m s/rad]."""
    state: Float[Array, " states"]
    """Hidden state after the step."""


COMMON = -9.0
"""Prior of what nearly every arm has: friction of its gears, offsets of its torque sensors."""
UNNAMED = "unknown"
"""Name, in the interface, of what has no law."""
EVER = 1e12
"""Seconds that no clock reaches, that of Unix included."""


class AbstractEffect(eqx.Module):
    """Physics that a rigid-body model leaves out; the class is one effect, an instance one shape of it."""

    # Equinox's makes a pytree of each method that is read, which nobody needs here; a diagnosis reads a million
    # attributes.
    __getattribute__ = object.__getattribute__

    name: ClassVar[str]
    """Name in the interface's table of effects."""
    family: ClassVar[str] = "unknown"
    """Part of the arm, or of its recording: friction, drive, load, sensor, clock, contact or unknown."""
    shapes: ClassVar[tuple[Shape, ...]] = ()
    reveals: ClassVar[str] = ""
    """The motion that shows the effect, and tells it from what it is confounded with."""
    seen_against: ClassVar[str] = "time"
    """What its torque is drawn against."""
    prior: ClassVar[float] = -15.0
    """Logarithm of the odds, beforehand, that it is somewhere where it is not in the model."""
    discrepancy: ClassVar[float] = 0.02
    """Share by which the torque of such physics differs from the law of this class, as a standard deviation."""
    varies_with: ClassVar[tuple[str, ...]] = ("q", "qd", "t")
    """What that share varies with: the joint's position, its velocity, the clock; "moments" is a clock of short
    periods, for what comes and goes."""
    free: ClassVar[bool] = False
    """Whether it is a curve that fits what has no law."""
    alike: ClassVar[bool] = False
    """Whether joints of an arm have it alike, as gears of one make: found in one, it is likelier in others."""
    repeats: ClassVar[bool] = False
    """Whether it can act several times over at one place."""
    acts_on: ClassVar[Literal["plant", "position", "torque"]] = "plant"
    """What it changes in a simulation under given torque: how the arm moves (`resist`), what the position sensors
    show (`shift`), or what the torque sensors show (`sensed`)."""
    takes_shown: ClassVar[bool] = False
    """Whether it is a function of torque that the sensors show, and so of every other effect."""
    drifts: ClassVar[bool] = False
    """Whether it changes with the clock; nobody knows how it goes on after what was recorded (`beyond`)."""
    bound_to_recording: ClassVar[bool] = False
    """Whether it belongs to a recording; `placed` says what that means for others."""
    throughout: ClassVar[bool] = False
    """Whether it then lasts as long as that does: one part of it tells what is to be seen in another."""
    longest: ClassVar[float] = 1.0
    """Share of its recording that an event takes at most: what is always there says nothing of when."""
    dissipates: ClassVar[bool] = False
    """Whether it must take energy whatever the direction, or is none: a torque that knows no direction."""
    clear_of_none: ClassVar[float] = 0.0
    """Standard deviations by which its first coefficient must exceed zero; else it is another effect."""
    size_of: ClassVar[tuple[str, int]] = ("", 1)
    """Of the smallest size that recordings show: its name ("": that of the first coefficient), and how many
    coefficients, the first ones, are components of it."""
    weakest_counts: ClassVar[bool] = False
    """Whether that size is told of the component that shows least, not of the middle one."""
    at_rest: ClassVar[str] = ""
    """What it is, as a sentence about an arm that holds still has it; of those that `while_still` tells of."""
    commonplace: ClassVar[bool] = False
    """Whether anybody would ask for it first: where nothing is found, how much of it could be there is told."""
    one_joint: ClassVar[bool] = False
    """Whether it acts in the torque of one joint, by columns in time alone."""
    swings: ClassVar[bool] = False
    """Whether it swings at one frequency throughout recordings."""
    on_links: ClassVar[bool] = False
    """Whether it acts on the links, behind every drive."""
    number: ClassVar[str] = ""
    """The number that is wrong where it is found: "damping", "frictionloss" or "armature" of a joint of the
    user's model, its links' "standard" parameters, or the "scale" of a torque sensor."""

    @classmethod
    @abc.abstractmethod
    def grid(cls, arm: Arm) -> Sequence["AbstractEffect"]:
        """Shapes and forms to try, for every joint or link it may act at."""

    @classmethod
    def from_motions(cls, motions: Sequence[Motion]) -> Sequence["AbstractEffect"]:
        """Shapes and forms to try that depend on where recordings have been."""
        return ()

    @classmethod
    def sweep(cls, joint: int, motions: Sequence[Motion], cutoff: float) -> "Sweep | None":
        """Shapes to try that are too many for a grid; None where the motions show none at this joint.

        Args:
            joint: where.
            motions: in all recordings.
            cutoff: up to which torque is compared [Hz].
        """
        return None

    @classmethod
    def at_some_time(cls, dof: int, recording: str) -> Sequence[Sequence["AbstractEffect"]]:
        """Of what begins or ends within a recording, at each place its forms, there throughout and with the same
        columns: when it acts is searched for, and `placed_between` makes one that acts for a while. Their
        coefficients have each a `scale`: noise may be as slow."""
        return ()

    @classmethod
    def swinging(cls, dof: int, recordings: tuple[str, ...], frequency: float) -> "AbstractEffect":
        """Of what `swings`, that with this frequency [Hz], which is searched for. Of each recording in turn its
        coefficients are those of `swung` times a sine, then a cosine."""
        raise NotImplementedError(f"{cls.name} does not swing")

    @classmethod
    def swung(cls, motion: Motion) -> Float[np.ndarray, "time dof n"]:
        """What such an effect multiplies by its sine and its cosine."""
        raise NotImplementedError(f"{cls.name} does not swing")

    @classmethod
    def typical(cls, recordings: Mapping[str, Motion]) -> Sequence[Sequence["AbstractEffect"]]:
        """Of an effect that `grid` has no shapes of, those of each place that the smallest size is told of which
        recordings show; `recordings` by their names."""
        return ()

    @classmethod
    def while_still(cls, levels: Levels) -> Sequence[LawAtRest]:
        """What it may be in the torque of an arm that holds still; none where nothing shows it."""
        return ()

    @property
    @abc.abstractmethod
    def joints(self) -> tuple[int, ...]:
        """0-based joints that the effect is reported at."""

    @property
    @abc.abstractmethod
    def coefficients(self) -> tuple[Coefficient, ...]:
        """What the columns are multiplied by, in their order."""

    @property
    @abc.abstractmethod
    def equation(self) -> str:
        """Readable equation in the symbols of the parameters."""

    @property
    def is_event(self) -> bool:
        """Whether it happened at some time in a recording, from `start` to `stop`."""
        return self.bound_to_recording and not self.throughout

    @property
    def recordings(self) -> tuple[str, ...]:
        """Names of those it is bound to."""
        return (self.recording,) if self.bound_to_recording else ()  # pyright: ignore

    @property
    def ends(self) -> tuple[bool, bool]:
        """Of `at_some_time`: whether this form begins, and whether it ends, within its recording."""
        return True, True

    def placed_between(self, start: float, stop: float) -> "AbstractEffect":
        """The same from `start` to `stop` [s], those of its `ends` that are within its recording."""
        begins, ceases = self.ends
        times = start if begins else -EVER, stop if ceases else EVER
        return dataclasses.replace(self, start=times[0], stop=times[1])  # pyright: ignore

    def within(self, first: float, last: float, step: float) -> "AbstractEffect":
        """The same, as a recording from `first` to `last` can tell it that resolves times of `step` [s]."""
        return self

    @property
    def period(self) -> float:
        """Of what wanders [s]; it is tried where a recording has half of it."""
        return 0.0

    def counted_from(self, start: float) -> "AbstractEffect":
        """The same in recordings that begin at `start` [s]: where a clock is zero means nothing."""
        return self

    @property
    def passes(self) -> bool:
        """Whether it is over with the session in which it was recorded: a drift of a sensor."""
        return self.drifts and self.acts_on == "torque"

    def beyond(self, recorded: Sequence[Channels]) -> "AbstractEffect":
        """The same where it was recorded, and as it may go on beyond that."""
        return self

    @property
    def body(self) -> Float[np.ndarray, "10 n"] | None:
        """Standard parameters of each coefficient, of a law that adds a body: the first one's are a body's. A
        change of a link is none: it stands for what torque tells of several links."""
        return None

    @property
    def plainer(self) -> tuple["AbstractEffect", ...]:
        """Forms with fewer numbers that may do as well, where what the law may be off is allowed for."""
        return ()

    @property
    def steady(self) -> tuple["AbstractEffect", ...]:
        """Of an effect that drifts, the laws that it would be if it did not."""
        return ()

    @property
    def held(self) -> tuple[type["AbstractEffect"], ...]:
        """Effects whose laws this form holds besides its own: it is a sum of parts, and pays for each."""
        return ()

    @property
    def may_hold(self) -> frozenset[str]:
        """Names of the effects that some form of it holds."""
        return frozenset()

    @property
    def form_prior(self) -> float:
        """What the form adds to `prior`."""
        return sum((part.prior for part in self.held), 0.0)

    def beyond_normal(self, c: Float[np.ndarray, " n"], deviation: Float[np.ndarray, " n"]) -> float:
        """Logarithm of how much likelier these coefficients are, beforehand, than with a normal prior of these
        deviations [nats]."""
        return 0.0

    @property
    def title(self) -> str:
        """Name of what it is: a law whose shape is that of another is called so."""
        return self.name

    def variants(self, arm: Arm) -> Sequence["AbstractEffect"]:
        """Other forms of the same shape that a refinement should try."""
        return ()

    def corrected(self, arm: Arm) -> tuple[float, ...]:
        """Of each coefficient, the arm's number that it corrects; 0 for none."""
        number = lambda name: float(np.asarray(getattr(arm, name))[self.joints[0]])
        return tuple(number(c.beyond) if c.beyond else 0.0 for c in self.coefficients)

    def signs(self, arm: Arm) -> tuple[int, ...]:
        """Which signs the coefficients may have on an arm: either, where they correct a number that it has."""
        numbers = self.corrected(arm)
        return tuple(0 if n else c.sign for c, n in zip(self.coefficients, numbers, strict=True))

    def placed(self, recording: str, later: bool | None) -> "AbstractEffect | None":
        """What of the effect acts in a recording: itself, or None.

        Args:
            recording: its name.
            later: than the recording that the effect is bound to; None where that is not known.
        """
        return self

    def parameters(
        self, c: Float[np.ndarray, " n"], covariance: Float[np.ndarray, "all all"]
    ) -> list[dict[str, Any]]:
        """Parameters as people know them: name, 1-based joint, value, std, unit.

        `covariance` is that of the coefficients and, after them, of the shapes; of pivots there is none, and they
        are not told.
        """
        joint = self.joints[0] + 1 if self.joints else None
        deviation = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        out = [
            {"name": k.name, "joint": joint, "value": float(v), "std": float(s), "unit": k.unit}
            for k, v, s in zip(self.coefficients, c, deviation[: len(c)], strict=True)
        ]
        unknown = [shape for shape in self.shapes if not shape.pivot]
        for shape, s in zip(unknown, deviation[len(c) :], strict=True):
            value = float(getattr(self, shape.name))
            out.append(
                {"name": shape.name, "joint": joint, "value": value, "std": float(s), "unit": shape.unit}
            )
        return out

    @property
    def remark(self) -> str:
        """A sentence that a finding of it needs beside its equation."""
        return ""

    def unit(self, turning: str, arm: Arm) -> str:
        """Unit of one of its numbers; of those in a joint's coordinate, by whether the joint slides."""
        return arm.unit(turning, self.joints[0]) if hasattr(self, "joint") else turning

    def standard_change(self, c: Numbers) -> tuple[int, Float[Array, "10"] | Float[np.ndarray, "10"]] | None:
        """Link, and what is added to its standard parameters, of a law that adds that throughout and no more."""
        return None

    def mjcf(self, c: Numbers, arm: Arm) -> Mapping[str, Any]:
        """Changes that reproduce the effect in MuJoCo natively, by joint attribute; empty if none can."""
        return {}

    def lasting(self, c: Float[np.ndarray, " n"]) -> tuple["AbstractEffect", Float[np.ndarray, " n"]]:
        """The effect, and its coefficients, as they go on after the recordings."""
        return self, c

    @property
    def dry_width(self) -> Array | float | None:
        """Velocity over which its dry friction changes sign [rad/s]; None where it has no dry friction."""
        return None

    @property
    def dry(self) -> bool:
        """Whether it is friction that may carry any load up to its level while its joint rests."""
        return self.dry_width is not None

    @property
    def forgets(self) -> Array | float | None:
        """Distance of its joint over which it forgets how it began [rad]; None where it has no such memory."""
        return None

    @property
    def feels(self) -> Literal["motion", "load", "acceleration"]:
        """What its torque follows besides position, velocity and time. A simulator takes the load of the step
        before, but solves for the acceleration: torque in its proportion is inertia, and bears no lag."""
        return "motion"

    def carried(self, c: Numbers) -> tuple[int, Float[Array, "10"]] | None:
        """Link, and the body on it that a simulator's model holds throughout; `resist` takes it off meanwhile.

        Taking off inertia by the acceleration of the step before is stable; adding it is not.
        """
        return None

    def begin(self, c: Float[Array, " n"], arm: Arm, s: Channels) -> Float[Array, " states"]:
        """Hidden state of `resist` or `shift` at the first instant."""
        return jnp.zeros(0)

    def resist(
        self, c: Float[Array, " n"], arm: Arm, z: Float[Array, " states"], s: Channels, dt: float
    ) -> Resistance:
        """What it does to the joints over a step of `dt` [s] of a simulation; `arm` is the nominal one.

        `s.load` is the torque of the nominal rigid arm at the acceleration `s.qdd`.
        """
        raise NotImplementedError(f"{self.name} acts on the {self.acts_on} sensors")

    def shift(
        self, c: Float[Array, " n"], arm: Arm, z: Float[Array, " states"], s: Channels, dt: float
    ) -> tuple[Float[Array, " dof"], Float[Array, " states"]]:
        """How much more than the links' positions the position sensors show [rad], and the state after the step.

        `s.load` is the torque that the joints transmit.
        """
        raise NotImplementedError(f"{self.name} does not act on the position sensors")

    def sensed(
        self, c: Float[Array, " n"], t: Float[Array, " time"], tau: Float[Array, "time dof"]
    ) -> Float[Array, "time dof"]:
        """What the torque sensors show of the torque [N m] over a whole roll-out."""
        raise NotImplementedError(f"{self.name} does not act on the torque sensors")

    def true(
        self, c: Float[Array, " n"], t: Float[Array, " time"], tau: Float[Array, "time dof"]
    ) -> Float[Array, "time dof"]:
        """The torque behind what the sensors show: the inverse of `sensed`."""
        raise NotImplementedError(f"{self.name} does not act on the torque sensors")

    def to_json(self) -> dict[str, Any]:
        """Class, shape and form, from which `from_json` makes the effect again."""
        fields = {f.name: _plain(getattr(self, f.name)) for f in dataclasses.fields(self)}
        return {"class": type(self).__name__, **fields}


@dataclasses.dataclass(frozen=True)
class Sweep:
    """Very many shapes of an effect at one joint, evaluated together."""

    columns: Callable[[Motion], Float[np.ndarray, "time shapes n"]]
    shape: Callable[[int], AbstractEffect]
    """The effect with one of the shapes."""
    steps: Callable[[int], tuple[float, ...]]
    """First steps of a refinement from there, one a shape parameter."""


def _plain(value: Any) -> Any:
    if isinstance(value, str | tuple | list | int | float) or value is None:
        return value
    array = np.asarray(value)
    return array.item() if array.ndim == 0 else array.tolist()


Seconds = Float[Array, ""] | float


class AbstractJointEffect(AbstractEffect):
    """An effect in the torque of one joint, that depends on channels at one instant or on their past."""

    one_joint: ClassVar[bool] = True

    joint: Any

    @property
    def joints(self) -> tuple[int, ...]:
        return (int(self.joint),)

    @abc.abstractmethod
    def start(self, s: Channels) -> Float[Array, " states"]:
        """State at the first instant."""

    @abc.abstractmethod
    def advance(
        self, z: Float[Array, " states"], s: Channels, dt: Seconds
    ) -> tuple[Float[Array, " states"], Float[Array, "time n"]]:
        """State after a stretch of a recording, and the columns in it; `dt` is its time step [s]."""

    def columns(self, s: Channels, dt: Seconds) -> Float[Array, "time n"]:
        """Columns over a recording."""
        return self.advance(self.start(jax.tree.map(lambda a: a[0], s)), s, dt)[1]

    def _here(self, value: Array, s: Channels) -> Float[Array, " dof"]:
        """A number of this joint among zeros."""
        return jnp.zeros_like(s.q).at[self.joint].set(value)


class AbstractInstantEffect(AbstractJointEffect):
    """An effect without memory."""

    @abc.abstractmethod
    def at(self, s: Channels) -> Float[Array, " n"]:
        """Columns at one instant."""

    def start(self, s: Channels) -> Float[Array, " states"]:
        return jnp.zeros(0)

    def advance(
        self, z: Float[Array, " states"], s: Channels, dt: Seconds
    ) -> tuple[Float[Array, " states"], Float[Array, "time n"]]:
        return z, jax.vmap(self.at)(s)

    def resist(self, c, arm, z, s, dt):
        return Resistance(self._here(self.at(s) @ c, s), jnp.zeros_like(s.q), z)


class AbstractDryFriction(AbstractInstantEffect):
    r"""Friction of Coulomb's kind: levels times a smoothed sign of the velocity, and a remainder.

    $$\tau_j = \ell(s)^\top c\,\tanh(\dot q_j / v_0) + m(s)^\top c$$
    """

    v0: eqx.AbstractVar[Float[Array, ""] | float]

    @abc.abstractmethod
    def levels(self, s: Channels) -> Float[Array, " n"]:
        """What multiplies the sign of the velocity."""

    def remainder(self, s: Channels) -> Float[Array, " n"]:
        """What does not jump where the velocity changes sign."""
        return jnp.zeros(len(self.coefficients))

    def at(self, s: Channels) -> Float[Array, " n"]:
        return self.levels(s) * smooth_sign(jnp.asarray(s.qd)[self.joint], self.v0) + self.remainder(s)

    @property
    def dry_width(self) -> Array | float | None:
        return self.v0

    def resist(self, c, arm, z, s, dt):
        damping = self.levels(s) @ c * sign_over_velocity(s.qd[self.joint], self.v0)
        return Resistance(self._here(self.remainder(s) @ c, s), self._here(damping, s), z)


class AbstractMemoryEffect(AbstractJointEffect):
    """An effect with a hidden state, stepped through the recording."""

    @abc.abstractmethod
    def step(
        self, z: Float[Array, " states"], s: Channels, dt: Seconds
    ) -> tuple[Float[Array, " states"], Float[Array, " n"]]:
        """State after an instant, and the columns in it."""

    def advance(
        self, z: Float[Array, " states"], s: Channels, dt: Seconds
    ) -> tuple[Float[Array, " states"], Float[Array, "time n"]]:
        return jax.lax.scan(lambda z, now: self.step(z, now, dt), z, s)

    def begin(self, c, arm, s):
        return self.start(s)

    def resist(self, c, arm, z, s, dt):
        z, columns = self.step(z, s, dt)
        return Resistance(self._here(columns @ c, s), jnp.zeros_like(s.q), z)


class AbstractArmEffect(AbstractEffect):
    """An effect in several joints at once, smooth in time: evaluated on a whole motion."""

    @abc.abstractmethod
    def over(self, motion: Motion) -> Float[np.ndarray, "time dof n"]:
        """Columns over a motion."""

    @classmethod
    def over_many(cls, effects: Sequence[Any], motion: Motion) -> Float[np.ndarray, "time dof effects n"]:
        """Columns of many shapes of one form; a class overrides it where together is faster."""
        return np.stack([effect.over(motion) for effect in effects], 2)


_STRETCH = 8192
"""Samples that one compiled call takes: recordings of any length share its compilation."""


class Stretches:
    """Channels of a recording in stretches of one length, the last one filled up; cut once, for many shapes."""

    def __init__(self, channels: Channels):
        whole = jax.tree.map(np.asarray, channels)
        self.samples, self.dof = channels.q.shape
        self.parts = [
            jax.tree.map(lambda a, i=begin: jax.device_put(filled(a[i : i + _STRETCH], _STRETCH)), whole)
            for begin in range(0, self.samples, _STRETCH)
        ]


def joint_columns(
    effects: Sequence[AbstractJointEffect], stretches: Stretches, dt: float
) -> Float[np.ndarray, "time effects n"]:
    """Columns of many shapes of one form at once, a stretch after the other."""
    stacked = jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *effects)
    leaves, structure = jax.tree.flatten(stacked)
    z = np.zeros(_states(structure, tuple((a.shape, a.dtype) for a in leaves), stretches.dof))
    out = []
    for i, part in enumerate(stretches.parts):
        z, columns = _advance(stacked, z, np.asarray(i == 0), part, dt)
        out.append(columns)
    return np.concatenate([np.asarray(columns) for columns in out])[: stretches.samples]


@functools.cache
def _states(structure: Any, leaves: tuple[tuple, ...], dof: int) -> tuple[int, ...]:
    """Shape of the hidden states of some shapes of one form, given shape and dtype of what they consist of."""
    effects = jax.tree.unflatten(structure, [jnp.zeros(*leaf) for leaf in leaves])
    q = jnp.zeros((1, dof))
    return jax.eval_shape(_starts, effects, Channels(q[:, 0], q, q, q, q, q)).shape


def _starts(effects, channels):
    return jax.vmap(lambda effect: effect.start(jax.tree.map(lambda a: a[0], channels)))(effects)


@jax.jit
def _advance(effects, z, first, channels, dt):
    z = jnp.where(first, _starts(effects, channels), z)
    return jax.vmap(lambda effect, z: effect.advance(z, channels, dt), out_axes=(0, 1))(effects, z)


def settling(
    t: Array | np.ndarray, time_constant: Array | float, since: Array | float, until: Array | float
) -> Array:
    r"""$1 - e^{-(t - t_0)/T}$ of what was recorded from `since`, t₀, to `until` [s]; before that 0.

    Where less than T was, that is a trend whose end nobody has seen: what it came to is held.
    """
    seen = jnp.where(time_constant > until - since, jnp.minimum(t, until), t) - since
    return -jnp.expm1(-jnp.maximum(seen, 0.0) / time_constant)


def counted(since: float) -> str:
    """Time since then [s], in an equation."""
    return f"(t - {since:.12g})" if since else "t"


def smooth_sign(qd: Array, width: Array | float) -> Array:
    r"""$\tanh(\dot q / v_0)$: the sign of a velocity, for simulators and for velocities that carry noise."""
    return jnp.tanh(qd / width)


def sign_over_velocity(qd: Array, width: Array | float) -> Array:
    r"""$\tanh(\dot q / v_0) / \dot q$ [s/rad], whose limit at rest is $1/v_0$; smooth there too."""
    x = qd / width
    near = jnp.abs(x) < 1e-3
    away = jnp.where(near, 1.0, x)
    return jnp.where(near, 1 - x**2 / 3, jnp.tanh(away) / away) / width


_NEIGHBOUR = 0.5, 0.1, 0.05
"""How far a neighbouring shape is: of a logarithm, as a share of the bounds, of an instant [s]."""


def neighbours(effect: AbstractEffect) -> list[AbstractEffect]:
    """The effect with one number of its shape larger or smaller, within its bounds."""
    out = []
    for shape in effect.shapes:
        value, wide = float(getattr(effect, shape.name)), shape.upper - shape.lower
        for side in (-1.0, 1.0):
            log, share, instant = (side * x for x in _NEIGHBOUR)
            moved = (
                value * np.exp(log)
                if shape.logarithmic
                else value + (share * wide if np.isfinite(wide) else instant)
            )
            inside = float(np.clip(moved, shape.lower, shape.upper))
            if inside != value and not shape.pivot:
                out.append(dataclasses.replace(effect, **{shape.name: inside}))
    return out
