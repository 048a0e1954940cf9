"""`Arm`: a serial arm with names, units, limits and the physics its model already holds."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels import Chain, rnea
from jaxtyping import Array, Float

from ..xla import chunked
from .mjcf import KNOWN, parts_of, read
from .model_file import Model
from .panda import published_parts

FRICTION_LAW = ("friction_rate", "friction_slack")
"""Fields of an `Arm` that say how the friction it holds turns with the velocity; None in both says nothing."""
NUMBERS = ("standard", *KNOWN, "lower", "upper")
"""Fields of an `Arm` that are arrays of its own."""
_OPTIONAL = ("lumped", *FRICTION_LAW)


class Arm(eqx.Module):
    """A serial arm: the numeric `Chain`, its nominal parameters, and what to call its parts.

    Everything rigidly fixed to a link (tool, gripper, locked fingers) is lumped into that link.
    """

    chain: Chain
    standard: Float[Array, "dof 10"]
    """Nominal inertial parameters, order and units as in `jaxpanda_kernels.inertia`."""
    armature: Float[Array, " dof"]
    """Reflected rotor inertia [kg m²]."""
    damping: Float[Array, " dof"]
    """Viscous friction that the model already holds [N m s/rad]."""
    frictionloss: Float[Array, " dof"]
    """Coulomb friction that the model already holds [N m]."""
    stiffness: Float[Array, " dof"]
    """Joint springs that the model already holds [N m/rad]."""
    springref: Float[Array, " dof"]
    """Where those springs rest [rad]."""
    lower: Float[Array, " dof"]
    """Joint limits [rad]; infinite where there are none."""
    upper: Float[Array, " dof"]
    joint_names: tuple[str, ...] = eqx.field(static=True)
    link_names: tuple[str, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)
    lumped: Float[Array, "dof 10"] | None = None
    """Of `standard`, what belongs to bodies that are fixed to a link; None where no link has such a body."""
    friction_rate: Float[Array, " dof"] | None = None
    r"""b of the soft constraint that MuJoCo makes of `frictionloss` [1/s], f = clip((q̈ + b q̇)/R, ±F_c)."""
    friction_slack: Float[Array, " dof"] | None = None
    """R of the same [1/(kg m²)]."""

    @classmethod
    def from_mjcf(cls, path: Model) -> "Arm":
        """The serial arm in a user's MJCF; `jaxpanda.arms.mjcf` says what can be represented.

        Raises:
            InputError: the file is no MJCF, or holds something that a serial arm cannot represent.
        """
        return cls(**parts_of(read(path))[0])

    @classmethod
    def panda(cls) -> "Arm":
        """The Franka Emika Panda, from published numbers; `jaxpanda.arms.panda` says which."""
        return cls(**published_parts())

    @property
    def dof(self) -> int:
        return self.chain.dof

    @property
    def nameless(self) -> "Arm":
        """What its torque goes by, without names and limits: arms of as many joints share what is compiled."""
        free = jnp.full(self.dof, jnp.inf)
        return Arm(
            **{name: getattr(self, name) for name in ("chain", "standard", *KNOWN)},
            lower=-free,
            upper=free,
            joint_names=(),
            link_names=(),
            name="",
        )

    def to_json(self) -> dict[str, Any]:
        """Everything, as numbers and names; null for a limit that is infinite."""
        return {
            "name": self.name,
            "joint_names": list(self.joint_names),
            "link_names": list(self.link_names),
            "chain": {name: np.asarray(getattr(self.chain, name)).tolist() for name in _CHAIN},
            **{name: _listed(getattr(self, name)) for name in NUMBERS},
            **{
                name: None if (x := getattr(self, name)) is None else np.asarray(x).tolist()
                for name in _OPTIONAL
            },
        }

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> "Arm":
        """The inverse of `to_json`; a document that is none raises LookupError, TypeError or ValueError."""
        names = [tuple(document[key]) for key in ("joint_names", "link_names")]
        dof = len(names[0])
        if (
            dof == 0
            or len(names[1]) != dof
            or not all(isinstance(one, str) for every in names for one in every)
        ):
            raise ValueError("joint_names and link_names must be as many texts as there are joints")
        shapes = {"R": (dof, 3, 3), "p": (dof, 3), "prismatic": (dof,), "gravity": (3,)}
        for name, shape in shapes.items():
            values = np.asarray(document["chain"][name], float)
            if values.shape != shape or not np.isfinite(values).all():
                raise ValueError(f"chain: {name} must hold {' x '.join(map(str, shape))} numbers")
        for name, shape in {"lumped": (dof, 10), **dict.fromkeys(FRICTION_LAW, (dof,))}.items():
            if document.get(name) is not None and np.asarray(document[name], float).shape != shape:
                raise ValueError(f"{name} must hold {' x '.join(map(str, shape))} numbers")
        R, p, prismatic, gravity = (document["chain"][name] for name in _CHAIN)
        chain = Chain(numbers(R), numbers(p), jnp.asarray(prismatic, bool), numbers(gravity))
        return cls(
            chain,
            **{name: numbers(_unlisted(document[name], name)) for name in NUMBERS},
            joint_names=names[0],
            link_names=names[1],
            name=str(document["name"]),
            **{name: numbers(document[name]) for name in _OPTIONAL if document.get(name) is not None},  # pyright: ignore[reportArgumentType]
        )

    def unit(self, turning: str, joint: int | None = None) -> str:
        """`unit_of` one joint, or of all."""
        prismatic = self.chain.prismatic if joint is None else self.chain.prismatic[joint : joint + 1]
        return unit_of(turning, prismatic.tolist())

    def known_torque(
        self, q: Float[Array, " dof"], qd: Float[Array, " dof"], qdd: Float[Array, " dof"]
    ) -> Float[Array, " dof"]:
        r"""Torque [N m] of what the model holds beyond rigid links.

        $I_a \ddot q + F_v \dot q + F_c\,\mathrm{sign}(\dot q) + k\,(q - q_0)$
        """
        return (
            self.armature * qdd
            + self.damping * qd
            + self.frictionloss * jnp.sign(qd)
            + self.stiffness * (q - self.springref)
        )

    def inverse_dynamics(
        self, q: Float[Array, " dof"], qd: Float[Array, " dof"], qdd: Float[Array, " dof"]
    ) -> Float[Array, " dof"]:
        """Joint torque [N m] of a motion under the model as it is."""
        return rnea(self.chain, self.standard, q, qd, qdd) + self.known_torque(q, qd, qdd)

    def inverse_dynamics_of_many(
        self,
        q: Float[np.ndarray, "time dof"],
        qd: Float[np.ndarray, "time dof"],
        qdd: Float[np.ndarray, "time dof"],
    ) -> Float[np.ndarray, "time dof"]:
        """`inverse_dynamics` of many states, compiled once for any number of them and for all arms of as many
        joints."""
        return chunked(_inverse_dynamics, self.nameless, q, qd, qdd)


@jax.jit
def _inverse_dynamics(arm: Arm, q: Array, qd: Array, qdd: Array) -> Array:
    return jax.vmap(arm.inverse_dynamics)(q, qd, qdd)


_CHAIN = ("R", "p", "prismatic", "gravity")


def numbers(values: Any) -> Array:
    """The numbers of a JSON document as an array; what is none raises TypeError or ValueError."""
    return jnp.asarray(np.asarray(values, float))


def _listed(values: Array) -> list[Any]:
    array = np.asarray(values)
    return (
        array.tolist() if np.isfinite(array).all() else [float(v) if np.isfinite(v) else None for v in array]
    )


def _unlisted(values: Sequence[Any], name: str) -> Sequence[Any]:
    missing = -np.inf if name == "lower" else np.inf
    return [missing if v is None else v for v in values]


def joints_named(joints: Sequence[int]) -> str:
    """`joint 3`, or `joints 1, 2`, of joints counted from 0."""
    return f"joint{'s' * (len(joints) > 1)} {', '.join(str(j + 1) for j in joints)}"


def unit_of(turning: str, prismatic: Iterable[bool]) -> str:
    """The unit that a number has at joints, some of which may slide, given the one that it has where they turn.

    m for rad, N for N·m, kg for kg·m²; "N·m or N" for joints of both kinds.
    """
    slides = set(prismatic)
    sliding = turning
    for old, new in (
        ("(N·m)", "N"),
        ("N·m", "N"),
        ("N m", "N"),
        ("kg·m²", "kg"),
        ("kg m²", "kg"),
        ("rad", "m"),
    ):
        sliding = sliding.replace(old, new)
    if slides == {False, True} and sliding != turning:
        return f"{turning} or {sliding}"
    return sliding if True in slides else turning
