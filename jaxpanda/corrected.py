"""The corrected model: the user's arm, what is now known better of it, and the effects that were missing."""

import dataclasses
import hashlib
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels import Chain
from jaxtyping import Array, Float

from . import files
from .arms.arm import FRICTION_LAW, NUMBERS, Arm, numbers
from .effects import (
    AbstractEffect,
    AbstractJointEffect,
    Channels,
    Motion,
    Stretches,
    Turn,
    catalogue_with,
    joint_columns,
    sign_over_velocity,
    smooth_torque,
)
from .errors import InputError, reason
from .inputs import read_json, require_written
from .recordings import Recording

SCHEMA = "jaxpanda.corrected/1"
FILE, XML = "corrected.json", "corrected.xml"
"""Names that `diagnose` gives to the corrected arm and to the MJCF with what MuJoCo holds of it."""
_UNIX = 1e9
"""Clocks that say more count from 1970 [s]."""
KIND = files.Kind("diagnose", ("diagnosis.json", FILE, XML, "report.html"))


@dataclasses.dataclass(frozen=True)
class Recorded:
    """When recordings were made, by the one clock that they share, and which they are."""

    start: float
    stop: float
    """[s]"""
    digests: tuple[str, ...]
    """Of their positions."""

    @classmethod
    def of(cls, recordings: Sequence[Recording]) -> "Recorded | None":
        """None where two were made at once by their clocks: each began anew."""
        spans = sorted((float(r.time[0]), float(r.time[-1])) for r in recordings)
        if any(later[0] < first[1] for first, later in itertools.pairwise(spans)):
            return None
        return cls(spans[0][0], spans[-1][1], tuple(_digest(r) for r in recordings))

    def after(self, motion: Recording) -> Recording:
        """The motion; where it is another one and yet has the recordings' time, or either time is of Unix and the
        other is not, its clock is one of its own, and it is taken to begin when they ended."""
        at_once = motion.time[0] < self.stop and motion.time[-1] > self.start
        unlike = (motion.time[0] < _UNIX) != (self.start < _UNIX)
        if not (at_once or unlike) or _digest(motion) in self.digests:
            return motion
        return dataclasses.replace(motion, time=motion.time - motion.time[0] + self.stop)

    @classmethod
    def from_json(cls, document: Mapping[str, Any] | None) -> "Recorded | None":
        if document is None:
            return None
        start, stop = float(document["start"]), float(document["stop"])
        if not (np.isfinite([start, stop]).all() and start < stop):
            raise ValueError("recorded must have a start before its stop")
        return cls(start, stop, tuple(str(x) for x in document["digests"]))


def _placed(effect: AbstractEffect, recordings: Sequence[str] | None) -> AbstractEffect | None:
    """As it acts in the last of the recordings, or in a later one."""
    if recordings is None:
        return effect.placed("", later=True)
    return effect.placed(recordings[-1], later=any(name in recordings[:-1] for name in effect.recordings))


def _digest(recording: Recording) -> str:
    return hashlib.sha256(np.ascontiguousarray(recording.q, float).tobytes()).hexdigest()


class Corrected(eqx.Module):
    """An arm with the physics it was missing.

    `change` is what the recordings say beyond the nominal inertial parameters within the uncertainty they had;
    `friction_change` the same for the friction that the model holds.
    """

    arm: Arm
    change: Float[Array, "dof 10"]
    damping_change: Float[Array, " dof"]
    frictionloss_change: Float[Array, " dof"]
    effects: tuple[AbstractEffect, ...]
    coefficients: tuple[Float[Array, " _n"], ...]
    turns: tuple[Turn | None, ...] = eqx.field(default=(), static=True)
    """How a prediction lets the model's Coulomb friction turn in each joint, as it did in the recordings; None,
    or no entries: as MuJoCo's constraint does."""
    cutoffs: tuple[float | None, ...] = eqx.field(default=(), static=True)
    """Up to which a prediction takes motion into account in each joint's torque [Hz], as that of the recordings
    showed it; None, or no entries: as far as q shows it."""
    recorded: Recorded | None = eqx.field(default=None, static=True)
    """The recordings that told all this, for what changes with time; None where each began anew."""
    friction_shown: Float[Array, "2 dof"] | None = None
    """Viscous [N m s/rad] and Coulomb friction [N m] of the recordings beyond the model's: of the sensors' laws,
    those in proportion to torque were fitted to torque with this friction. None, where it is the model's."""

    @classmethod
    def of(cls, arm: Arm) -> "Corrected":
        """An arm that nothing was missing of."""
        zero = jnp.zeros(arm.dof)
        return cls(arm, jnp.zeros((arm.dof, 10)), zero, zero, (), ())

    @property
    def native(self) -> Arm:
        """The arm with every effect that MuJoCo's own attributes can hold, and the better-known numbers."""
        standard = self.arm.standard + self.change
        values = {
            "damping": self.arm.damping + self.damping_change,
            "frictionloss": self.arm.frictionloss + self.frictionloss_change,
            "armature": self.arm.armature,
            "stiffness": self.arm.stiffness,
            "springref": self.arm.springref,
        }
        gravity = self.arm.chain.gravity
        for effect, c in zip(self.effects, self.coefficients, strict=True):
            if effect.bound_to_recording:
                continue
            if (change := effect.standard_change(c)) is not None:
                link, more = change
                standard = standard.at[link].add(more)
            for attribute, value in effect.mjcf(c, self.arm).items():
                if attribute == "gravity":
                    gravity = jnp.asarray(value)
                    continue
                for joint, number in value.items():
                    place = values[attribute].at[joint]
                    values[attribute] = place.set(number) if attribute == "springref" else place.add(number)
        chain = Chain(self.arm.chain.R, self.arm.chain.p, self.arm.chain.prismatic, gravity)
        names = tuple(values)
        return eqx.tree_at(
            lambda a: (a.chain, a.standard, *(getattr(a, n) for n in names)),
            self.arm,
            (chain, standard, *(values[n] for n in names)),
        )

    def for_motion(self, motion: Recording) -> tuple["Corrected", Recording]:
        """The arm as it meets a motion, and the motion by the recordings' clock.

        Where its clock is one of its own (`Recorded.after`), what drifts in the plant has come to what it was at
        the end of the recordings; a sensor may have been tared since, and its drift is left out.
        """
        later = motion if self.recorded is None else self.recorded.after(motion)
        if later is motion:
            return self, motion
        kept = [i for i, effect in enumerate(self.effects) if not effect.passes]
        effects, coefficients = (tuple(x[i] for i in kept) for x in (self.effects, self.coefficients))
        return dataclasses.replace(self, effects=effects, coefficients=coefficients), later

    @property
    def as_written(self) -> "Corrected":
        """The same effects on the user's own numbers."""
        zeros = (
            jnp.zeros_like(self.change),
            jnp.zeros_like(self.damping_change),
            jnp.zeros_like(self.damping_change),
        )
        return eqx.tree_at(lambda c: (c.change, c.damping_change, c.frictionloss_change), self, zeros)

    @property
    def beyond(self) -> tuple[tuple[AbstractEffect, Float[Array, " _n"]], ...]:
        """Effects that act on the plant and that MuJoCo's attributes do not hold, with their coefficients."""
        return tuple((e, c) for e, c in self.acting(None) if e.acts_on == "plant")

    def acting(
        self, recording: str | None, later: bool | None = True
    ) -> tuple[tuple[AbstractEffect, Float[Array, " _n"]], ...]:
        """Effects beyond `native` that act in a recording, with their coefficients.

        Args:
            recording: its name; None for what is bound to none.
            later: whether it was made after those that the effects were found in.
        """
        out = []
        for effect, c in zip(self.effects, self.coefficients, strict=True):
            if effect.bound_to_recording:
                here = None if recording is None else effect.placed(recording, later)
            else:
                native = effect.standard_change(c) is not None or effect.mjcf(c, self.arm)
                here = None if native else effect
            if here is not None:
                out.append((here, c))
        return tuple(out)

    def plant(self, recording: str | None = None, later: bool | None = True) -> "Plant":
        """The arm that moves, in a recording; `acting` explains the arguments."""
        return Plant.of(self.native, self.arm, self.acting(recording, later))

    def start(self, q: Float[Array, " dof"], qd: Float[Array, " dof"]) -> tuple[Array, ...]:
        """Hidden states of the effects on the plant, for an arm at (q, qd)."""
        return self.plant().begin(jnp.zeros(()), q, qd, jnp.zeros_like(q))[0]

    def missing_torque(
        self, memory: tuple[Array, ...], t: Array, q: Array, qd: Array, qdd: Array, dt: float
    ) -> tuple[Float[Array, " dof"], tuple[Array, ...]]:
        """Torque [N m] that a motion takes beyond `native`, and the memory after a step of `dt` [s].

        What a simulator applies is its negative; `Plant.resist` splits it so that steep friction stays stable.
        """
        native, plant = self.native, self.plant()
        torque, damping, memory = plant.resist(memory, t, q, qd, qdd, dt)
        held = (native.frictionloss - plant.arm.frictionloss) * jnp.sign(qd)
        return torque + damping * qd - held, memory

    def inverse_dynamics(
        self,
        q: Array,
        qd: Array,
        qdd: Array,
        t: Array | float = 0.0,
        memory: tuple[Array, ...] = (),
        dt: float = 1e-3,
    ) -> Float[Array, " dof"]:
        """Torque [N m] of the plant in a motion, sensors' errors left out."""
        return self.plant().inverse_dynamics(memory or self.start(q, qd), jnp.asarray(t), q, qd, qdd, dt)

    def forward_dynamics(
        self,
        q: Array,
        qd: Array,
        tau: Array,
        t: Array | float = 0.0,
        memory: tuple[Array, ...] = (),
        dt: float = 1e-3,
    ) -> Float[Array, " dof"]:
        """Acceleration [rad/s²] under a torque: the inverse of `inverse_dynamics`, by Newton's method.

        One step is exact unless friction depends on the load, which depends on the acceleration.
        """
        plant, t = self.plant(), jnp.asarray(t)
        iterations = 4 if plant.feels("load") else 1
        guess = jnp.zeros_like(q)
        return plant.acceleration(
            memory or self.start(q, qd), t, q, qd, tau, dt, guess, iterations=iterations
        )

    def measured_torque(
        self,
        motion: Motion,
        channels: Channels,
        held_sign: Float[np.ndarray, "time dof"],
        recordings: Sequence[str] | None = None,
    ) -> Float[np.ndarray, "time dof"]:
        """What the torque sensors show over a motion [N m], both grids being the same.

        Args:
            motion: what the arm does.
            channels: the same on the fine grid.
            held_sign: of the model's Coulomb friction, -1 to 1.
            recordings: names of those that the effects were found in up to this one, in their order; None for a
                motion recorded later.
        """
        tau = (
            motion.torque
            + np.asarray(self.damping_change) * motion.qd
            + np.asarray(self.frictionloss_change) * held_sign
        )
        if np.any(np.asarray(self.change)):
            tau = tau + motion.of_links(np.asarray(self.change))
        pairs = list(zip(self.effects, self.coefficients, strict=True))
        for last in (False, True):
            stretches = Stretches(dataclasses.replace(channels, shown=tau.copy() if last else None))
            for bound, c in pairs:
                effect = _placed(bound, recordings)
                if effect is None or effect.takes_shown != last:
                    continue
                if isinstance(effect, AbstractJointEffect):
                    columns = joint_columns([effect], stretches, motion.dt)[:, 0]
                    tau[:, effect.joints[0]] += columns @ np.asarray(c)
                else:
                    tau = tau + effect.over(motion) @ np.asarray(c)  # pyright: ignore
        return tau

    def to_json(self) -> dict[str, Any]:
        """Everything, as numbers and names."""
        return {
            "schema": SCHEMA,
            "arm": self.arm.to_json(),
            "change": np.asarray(self.change).tolist(),
            "damping_change": np.asarray(self.damping_change).tolist(),
            "frictionloss_change": np.asarray(self.frictionloss_change).tolist(),
            "turns": [None if turn is None else {turn.over: turn.size} for turn in self.turns],
            "cutoffs": list(self.cutoffs),
            "friction_shown": None
            if self.friction_shown is None
            else np.asarray(self.friction_shown).tolist(),
            "recorded": None if self.recorded is None else dataclasses.asdict(self.recorded),
            "effects": [
                {**effect.to_json(), "coefficients": np.asarray(c).tolist()}
                for effect, c in zip(self.effects, self.coefficients, strict=True)
            ],
        }

    @classmethod
    def load(cls, folder: str | Path, effects: Sequence[type[AbstractEffect]] = ()) -> "Corrected":
        """The corrected arm in a folder that `diagnose` wrote; `effects`: classes of your own that it was given.

        Raises:
            InputError: there is none, or not as `diagnose` writes it, or an effect is of an unknown class.
        """
        return read(folder, effects)[0]

    @classmethod
    def from_json(
        cls, document: Mapping[str, Any], effects: Sequence[type[AbstractEffect]] = ()
    ) -> "Corrected":
        """The inverse of `to_json`; `effects`: classes beside those of the catalogue."""
        classes = {c.__name__: c for c in catalogue_with(effects)}
        found = [effect_from_json(e, classes) for e in document["effects"]]
        return cls(
            Arm.from_json(document["arm"]),
            numbers(document["change"]),
            numbers(document["damping_change"]),
            numbers(document["frictionloss_change"]),
            tuple(found),
            tuple(numbers(e["coefficients"]) for e in document["effects"]),
            _turns(document),
            tuple(None if x is None else float(x) for x in document.get("cutoffs") or ()),
            Recorded.from_json(document.get("recorded")),
            None if document.get("friction_shown") is None else numbers(document["friction_shown"]),
        )


def read(
    folder: str | Path, effects: Sequence[type[AbstractEffect]] = ()
) -> tuple[Corrected, Float[np.ndarray, " dof"]]:
    """The corrected arm that `diagnose` saved, and the noise of its torque [N m]; called like `Corrected.load`.

    Raises:
        InputError: there is none, or not as `diagnose` writes it, or an effect is of an unknown class.
    """
    document, path = _document(folder)
    return _of(document, path, effects)


def _document(folder: str | Path) -> tuple[Mapping[str, Any], Path]:
    """What `diagnose` saved of the corrected arm in a folder, and where."""
    path = Path(folder) / FILE
    files.settle(folder)
    require_written(path, "diagnose")
    document = read_json(path)
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        raise InputError(f"{path}: is no corrected model; a folder that `diagnose` wrote is needed")
    return document, path


def _of(
    document: Mapping[str, Any], path: Path, effects: Sequence[type[AbstractEffect]]
) -> tuple[Corrected, Float[np.ndarray, " dof"]]:
    """The arm and the noise that a document holds, checked."""
    try:
        found, noise = Corrected.from_json(document, effects), np.asarray(document["torque_noise"], float)
        _check_numbers(found, noise)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{path}: is not as `diagnose` writes it ({type(error).__name__}: {reason(error)}); diagnose again"
        ) from None
    return found, noise


def read_sides(
    folder: str | Path, effects: Sequence[type[AbstractEffect]] = ()
) -> tuple[tuple[Corrected, Float[np.ndarray, " dof"]], ...]:
    """What is behind the drives and what is in them, each with the noise of its torque [N m], where `diagnose`
    saw the torque of both sides; else nothing. Called like `Corrected.load`, which gives the whole arm.

    Raises:
        InputError: as `read`.
    """
    document, path = _document(folder)
    sides = document.get("sides")
    return () if not sides else tuple(_of(sides[side], path, effects) for side in ("link", "drive"))


def _turns(document: Mapping[str, Any]) -> tuple[Turn | None, ...]:
    """How friction turns in predictions; `turning`, a speed for all joints, stood in earlier documents."""
    if document.get("turning") is not None:
        return (Turn("speed", float(document["turning"])),) * len(document["damping_change"])
    told = [None if x is None else dict(x).popitem() for x in document.get("turns") or ()]
    if any(x is not None and x[0] not in ("speed", "distance") for x in told):
        raise ValueError("turns must be over a speed or a distance")
    return tuple(None if x is None else Turn(x[0], float(x[1])) for x in told)


def _check_numbers(found: Corrected, noise: np.ndarray) -> None:
    arm, n = found.arm, found.arm.dof
    told = [name for name in FRICTION_LAW if getattr(arm, name) is not None]
    named = {name: np.asarray(getattr(arm, name)) for name in (*NUMBERS, *told)} | {
        "change": np.asarray(found.change),
        "damping_change": np.asarray(found.damping_change),
        "frictionloss_change": np.asarray(found.frictionloss_change),
        "torque_noise": noise,
    }
    if found.friction_shown is not None:
        named["friction_shown"] = np.asarray(found.friction_shown)
    shapes = {"standard": (n, 10), "change": (n, 10), "friction_shown": (2, n)}
    for name, values in named.items():
        shape = shapes.get(name, (n,))
        if values.shape != shape or not (name in ("lower", "upper") or np.isfinite(values).all()):
            raise ValueError(f"{name} must hold {' x '.join(map(str, shape))} numbers")
    if len(found.cutoffs) not in (0, n) or not all(x is None or 0 < x < np.inf for x in found.cutoffs):
        raise ValueError(f"cutoffs must hold {n} positive numbers")
    sizes = [turn.size for turn in found.turns if turn is not None]
    if len(found.turns) not in (0, n) or not all(0 < x < np.inf for x in sizes):
        raise ValueError(f"turns must hold {n} positive numbers")


class Plant(eqx.Module):
    r"""An arm as an engine's model can hold it, and the laws that act on it beyond.

    $$\tau = \mathrm{ID}(q, \dot q, \ddot q) + r + d \circ \dot q$$

    A law that is dry friction takes over the Coulomb friction that its joint has already: two laws of one sign
    of velocity, one as an engine's constraint and one as a force, would hold the joint twice.
    """

    arm: Arm
    """What the engine's model holds."""
    nominal: Arm
    """The user's arm, whose torque is the load of the effects that depend on it."""
    laws: tuple[tuple[AbstractEffect, Float[Array, " _n"]], ...]
    """Effects on the joints, with their coefficients."""
    positions: tuple[tuple[AbstractEffect, Float[Array, " _n"]], ...]
    """Effects between the joints and the position sensors."""
    torques: tuple[tuple[AbstractEffect, Float[Array, " _n"]], ...]
    """Effects of the torque sensors."""
    level: Float[Array, " dof"]
    """Coulomb friction that laws have taken over [N m]."""
    width: Float[Array, " dof"]
    """Velocity over which it changes sign [rad/s]."""

    @classmethod
    def of(
        cls, native: Arm, nominal: Arm, acting: Sequence[tuple[AbstractEffect, Float[Array, " _n"]]]
    ) -> "Plant":
        """Sort effects by what they act on."""
        sides = {"plant": [], "position": [], "torque": []}
        for effect, c in acting:
            sides[effect.acts_on].append((effect, c))
        dry, width = np.zeros(native.dof, bool), jnp.full(native.dof, jnp.inf)
        for effect, _ in sides["plant"]:
            if effect.dry_width is not None:
                dry[np.array(effect.joints)] = True
                width = width.at[np.array(effect.joints)].min(effect.dry_width)
        level, standard = jnp.where(dry, native.frictionloss, 0.0), native.standard
        for effect, c in sides["plant"]:
            if (carried := effect.carried(c)) is not None:
                standard = standard.at[carried[0]].add(carried[1])
        arm = eqx.tree_at(
            lambda a: (a.frictionloss, a.standard), native, (native.frictionloss - level, standard)
        )
        laws, positions, torques = (tuple(side) for side in sides.values())
        return cls(arm, nominal, laws, positions, torques, level, jnp.where(dry, width, 1.0))

    @eqx.filter_jit
    def begin(self, t: Array, q: Array, qd: Array, tau: Array) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        """Hidden states of `laws` and of `positions`, for an arm at (q, qd) that transmits `tau`."""
        zero = jnp.zeros_like(q)
        s, shown = self._channels(t, q, qd, zero), Channels(t, q, qd, zero, tau, tau)
        return (
            tuple(e.begin(c, self.nominal, s) for e, c in self.laws),
            tuple(e.begin(c, self.nominal, shown) for e, c in self.positions),
        )

    def resist(
        self, memory: tuple[Array, ...], t: Array, q: Array, qd: Array, qdd: Array, dt: float
    ) -> tuple[Float[Array, " dof"], Float[Array, " dof"], tuple[Array, ...]]:
        """What the laws do over a step of `dt` [s]: r [N m], d [N m s/rad], and their states after it.

        d is never negative: dry friction that a law takes off is in d where there is as much, else in r.
        """
        s = self._channels(t, q, qd, qdd)
        done = [e.resist(c, self.nominal, z, s, dt) for (e, c), z in zip(self.laws, memory, strict=True)]
        torque = sum((d.torque for d in done), jnp.zeros_like(q))
        damping = sum((d.damping for d in done), self.level * sign_over_velocity(qd, self.width))
        torque = torque + jnp.minimum(damping, 0.0) * qd
        return torque, jnp.maximum(damping, 0.0), tuple(d.state for d in done)

    @eqx.filter_jit
    def inverse_dynamics(
        self, memory: tuple[Array, ...], t: Array, q: Array, qd: Array, qdd: Array, dt: float
    ) -> Float[Array, " dof"]:
        """Torque [N m] of a motion."""
        torque, damping, _ = self.resist(memory, t, q, qd, qdd, dt)
        return self.arm.inverse_dynamics(q, qd, qdd) + torque + damping * qd

    @eqx.filter_jit
    def acceleration(
        self,
        memory: tuple[Array, ...],
        t: Array,
        q: Array,
        qd: Array,
        tau: Array,
        dt: float,
        guess: Array,
        *,
        iterations: int = 1,
        implicit: bool = False,
    ) -> Float[Array, " dof"]:
        """Acceleration [rad/s²] under a torque, by Newton's method.

        Args:
            memory: states of the laws.
            t: [s].
            q: [rad].
            qd: [rad/s].
            tau: [N m].
            dt: time step of the laws [s].
            guess: where to start; matters only where a law depends on the load.
            iterations: of Newton's method; one is exact where the laws are linear in the acceleration.
            implicit: take damping at the velocity after the step, as an engine does.
        """

        def left(qdd):
            torque, damping, _ = self.resist(memory, t, q, qd, qdd, dt)
            later = (damping + self.arm.damping) * dt * qdd if implicit else 0.0
            return self.arm.inverse_dynamics(q, qd, qdd) + torque + damping * qd + later - tau

        qdd = guess
        for _ in range(iterations):
            qdd = qdd - jnp.linalg.solve(jax.jacfwd(left)(qdd), left(qdd))
        return qdd

    def shift(
        self, memory: tuple[Array, ...], t: Array, q: Array, qd: Array, tau: Array, dt: float
    ) -> tuple[Float[Array, " dof"], tuple[Array, ...]]:
        """How much more than q the position sensors show [rad] of an arm that transmits `tau`."""
        s = Channels(t, q, qd, jnp.zeros_like(q), tau, tau)
        total, states = jnp.zeros_like(q), []
        for (effect, c), z in zip(self.positions, memory, strict=True):
            ahead, z = effect.shift(c, self.nominal, z, s, dt)
            total = total + ahead
            states.append(z)
        return total, tuple(states)

    def sensed(self, t: Float[Array, " time"], tau: Float[Array, "time dof"]) -> Float[Array, "time dof"]:
        """What the torque sensors show over a roll-out [N m]."""
        for effect, c in self.torques:
            tau = effect.sensed(c, t, tau)
        return tau

    def true(self, t: Float[Array, " time"], tau: Float[Array, "time dof"]) -> Float[Array, "time dof"]:
        """The torque behind what the sensors show [N m]."""
        for effect, c in reversed(self.torques):
            tau = effect.true(c, t, tau)
        return tau

    def feels(self, what: str) -> bool:
        """Whether a law depends on that: "load" (or acceleration), "acceleration"."""
        return any(e.feels in (what, "acceleration") for e, _ in self.laws)

    def _channels(self, t: Array, q: Array, qd: Array, qdd: Array) -> Channels:
        load = smooth_torque(self.nominal, q, qd, qdd) if self.feels("load") else jnp.zeros_like(q)
        return Channels(t, q, qd, qdd, load, load)


def effect_from_json(
    document: Mapping[str, Any], classes: Mapping[str, type[AbstractEffect]]
) -> AbstractEffect:
    """The effect that `to_json` of it says, of one of these classes, by their names."""
    if (name := document["class"]) not in classes:
        raise InputError(
            f"no effect of jaxpanda is of class {name!r}; where it is your own, pass effects=[{name}] to"
            " Corrected.load, predict or replay in Python"
        )
    fields = {k: _tupled(v) for k, v in document.items() if k not in ("class", "coefficients")}
    return classes[name](**fields)


def _tupled(value: Any) -> Any:
    return (
        tuple(_tupled(v) for v in value)
        if isinstance(value, Sequence) and not isinstance(value, str)
        else value
    )
