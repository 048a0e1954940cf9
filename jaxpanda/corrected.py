"""The corrected model: the user's arm, what is now known better of it, and the effects that were missing."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels import Chain, mass_matrix, rnea
from jaxtyping import Array, Float

from .arm import Arm
from .effects import (
    CATALOGUE,
    AbstractEffect,
    AbstractInstantEffect,
    AbstractJointEffect,
    AbstractMemoryEffect,
    Channels,
    Motion,
    joint_columns,
)

SCHEMA = "jaxpanda.corrected/1"
_ARM_FIELDS = ("standard", "armature", "damping", "frictionloss", "stiffness", "springref", "lower", "upper")


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
            if hasattr(effect, "standard_change"):
                link, more = effect.standard_change(np.asarray(c))  # pyright: ignore
                standard = standard.at[link].add(more)
            for attribute, value in effect.mjcf(np.asarray(c), self.arm).items():
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
        out = []
        for effect, c in zip(self.effects, self.coefficients, strict=True):
            held = hasattr(effect, "standard_change") or effect.mjcf(np.asarray(c), self.arm)
            if not held and effect.acts_on == "plant" and not effect.bound_to_recording:
                out.append((effect, c))
        return tuple(out)

    def start(self, q: Float[Array, " dof"], qd: Float[Array, " dof"]) -> tuple[Array, ...]:
        """Hidden states of the effects with memory, for an arm at (q, qd)."""
        s = self._instant(jnp.zeros(()), q, qd, jnp.zeros_like(q))
        return tuple(e.start(s) for e, _ in self.beyond if isinstance(e, AbstractMemoryEffect))

    def missing_torque(
        self, memory: tuple[Array, ...], t: Array, q: Array, qd: Array, qdd: Array, dt: float
    ) -> tuple[Float[Array, " dof"], tuple[Array, ...]]:
        """Torque [N m] that a motion takes beyond `native`, and the memory after a step of `dt` [s].

        What a simulator applies is its negative (`qfrc_applied`).
        """
        s = self._instant(t, q, qd, qdd)
        torque, states, left = jnp.zeros_like(q), [], list(memory)
        for effect, c in self.beyond:
            if isinstance(effect, AbstractMemoryEffect):
                z, columns = effect.step(left.pop(0), s, dt)
                states.append(z)
            elif isinstance(effect, AbstractInstantEffect):
                columns = effect.at(s)
            else:
                continue
            torque = torque.at[effect.joint].add(columns @ c)
        return torque, tuple(states)

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
        memory = memory or self.start(q, qd)
        return (
            self.native.inverse_dynamics(q, qd, qdd)
            + self.missing_torque(memory, jnp.asarray(t), q, qd, qdd, dt)[0]
        )

    def forward_dynamics(
        self,
        q: Array,
        qd: Array,
        tau: Array,
        t: Array | float = 0.0,
        memory: tuple[Array, ...] = (),
        dt: float = 1e-3,
    ) -> Float[Array, " dof"]:
        """Acceleration [rad/s²]; friction that depends on load takes the load of the arm at no acceleration."""
        memory = memory or self.start(q, qd)
        arm, zero = self.native, jnp.zeros_like(q)
        bias = (
            arm.inverse_dynamics(q, qd, zero)
            + self.missing_torque(memory, jnp.asarray(t), q, qd, zero, dt)[0]
        )
        M = mass_matrix(arm.chain, arm.standard, q) + jnp.diag(arm.armature)
        return jnp.linalg.solve(M, tau - bias)

    def _instant(self, t: Array, q: Array, qd: Array, qdd: Array) -> Channels:
        load = rnea(self.arm.chain, self.arm.standard, q, qd, qdd)
        return Channels(t, q, qd, qdd, load, load)

    def measured_torque(
        self, motion: Motion, channels: Channels, held_sign: Float[np.ndarray, "time dof"]
    ) -> Float[np.ndarray, "time dof"]:
        """What the torque sensors would show over a motion recorded later [N m], both grids being the same."""
        tau = (
            motion.torque
            + np.asarray(self.damping_change) * motion.qd
            + np.asarray(self.frictionloss_change) * held_sign
        )
        if np.any(np.asarray(self.change)):
            tau = tau + motion.regressor @ np.asarray(self.change).ravel()
        for bound, c in zip(self.effects, self.coefficients, strict=True):
            effect = bound.placed("", later=True)
            if effect is None:
                continue
            if isinstance(effect, AbstractJointEffect):
                tau[:, effect.joints[0]] += joint_columns([effect], channels, motion.dt)[0] @ np.asarray(c)
            else:
                tau = tau + effect.over(motion) @ np.asarray(c)  # pyright: ignore
        return tau

    def to_json(self) -> dict[str, Any]:
        """Everything, as numbers and names."""
        arm = {name: _numbers(getattr(self.arm, name)) for name in _ARM_FIELDS}
        chain = {
            name: np.asarray(getattr(self.arm.chain, name)).tolist()
            for name in ("R", "p", "prismatic", "gravity")
        }
        return {
            "schema": SCHEMA,
            "arm": {
                "name": self.arm.name,
                "joint_names": list(self.arm.joint_names),
                "link_names": list(self.arm.link_names),
                "chain": chain,
                **arm,
            },
            "change": np.asarray(self.change).tolist(),
            "damping_change": np.asarray(self.damping_change).tolist(),
            "frictionloss_change": np.asarray(self.frictionloss_change).tolist(),
            "effects": [
                {**effect.to_json(), "coefficients": np.asarray(c).tolist()}
                for effect, c in zip(self.effects, self.coefficients, strict=True)
            ],
        }

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> "Corrected":
        """The inverse of `to_json`."""
        arm = document["arm"]
        chain = Chain(
            jnp.asarray(arm["chain"]["R"]),
            jnp.asarray(arm["chain"]["p"]),
            jnp.asarray(arm["chain"]["prismatic"], bool),
            jnp.asarray(arm["chain"]["gravity"]),
        )
        fields = {name: jnp.asarray(_from_numbers(arm[name], name)) for name in _ARM_FIELDS}
        names = tuple(arm["joint_names"]), tuple(arm["link_names"]), arm["name"]
        effects = [effect_from_json(e) for e in document["effects"]]
        return cls(
            Arm(chain, **fields, joint_names=names[0], link_names=names[1], name=names[2]),
            jnp.asarray(document["change"]),
            jnp.asarray(document["damping_change"]),
            jnp.asarray(document["frictionloss_change"]),
            tuple(effects),
            tuple(jnp.asarray(e["coefficients"], float) for e in document["effects"]),
        )


def effect_from_json(document: Mapping[str, Any]) -> AbstractEffect:
    """The effect that `to_json` of it says."""
    classes = {c.__name__: c for c in CATALOGUE}
    fields = {k: _tupled(v) for k, v in document.items() if k not in ("class", "coefficients")}
    return classes[document["class"]](**fields)


def _tupled(value: Any) -> Any:
    return (
        tuple(_tupled(v) for v in value)
        if isinstance(value, Sequence) and not isinstance(value, str)
        else value
    )


def _numbers(values: Array) -> list[Any]:
    """As lists; infinite limits become null."""
    array = np.asarray(values)
    return (
        array.tolist() if np.isfinite(array).all() else [float(v) if np.isfinite(v) else None for v in array]
    )


def _from_numbers(values: Sequence[Any], name: str) -> Sequence[Any]:
    missing = -np.inf if name == "lower" else np.inf
    return [missing if v is None else v for v in values]
