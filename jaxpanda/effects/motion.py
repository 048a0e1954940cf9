"""What effects are evaluated on: the motion of an arm on a uniform grid, and the nominal model's torque in it."""

import copy
import dataclasses
import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels import batched, link_poses, mass_matrix, regressor, rnea
from jaxtyping import Array, Float, Int

from ..arms.arm import Arm
from ..xla import chunked


class Channels(eqx.Module):
    """Joint-wise channels; at one instant `(dof,)`, over a recording `(time, dof)`."""

    t: Float[Array, "*time"] | Float[np.ndarray, "*time"]
    """Clock of the recording [s]."""
    q: Float[Array, "*time dof"] | Float[np.ndarray, "*time dof"]
    qd: Float[Array, "*time dof"] | Float[np.ndarray, "*time dof"]
    qdd: Float[Array, "*time dof"] | Float[np.ndarray, "*time dof"]
    load: Float[Array, "*time dof"] | Float[np.ndarray, "*time dof"]
    """Torque that the nominal rigid arm transmits [N m]."""
    torque: Float[Array, "*time dof"] | Float[np.ndarray, "*time dof"]
    """Torque of the nominal model with the friction that recordings show, as sensors scale and delay it [N m]."""
    shown: Float[Array, "*time dof"] | Float[np.ndarray, "*time dof"] | None = None
    """Torque that the sensors show [N m]; None where they tell nothing, and the model's is the best there is."""
    held: Float[Array, "*time dof"] | Float[np.ndarray, "*time dof"] | None = None
    """Share of its level at which the model's Coulomb friction stands, -1 to 1; None where laws take it over."""


class Motion:
    """A motion on a uniform grid; what the nominal arm says about it is computed once, when asked for.

    `friction` is the torque of the friction that the nominal model holds [N m], `friction_shown` of that which
    recordings show, the nominal one where none was estimated; `transmitted` what the drives pass on to the links,
    where that was measured and the arm's links are left to it.
    """

    def __init__(
        self,
        arm: Arm,
        time: Float[np.ndarray, " time"],
        q: Float[np.ndarray, "time dof"],
        qd: Float[np.ndarray, "time dof"],
        qdd: Float[np.ndarray, "time dof"],
        friction: Float[np.ndarray, "time dof"],
        transmitted: Float[np.ndarray, "time dof"] | None = None,
    ):
        self.arm, self.time, self.q, self.qd, self.qdd, self.friction = arm, time, q, qd, qdd, friction
        self.friction_shown, self.transmitted = friction, transmitted
        self.dt = float(time[1] - time[0])

    @property
    def samples(self) -> int:
        return len(self.time)

    @property
    def dof(self) -> int:
        return self.q.shape[1]

    @functools.cached_property
    def load(self) -> Float[np.ndarray, "time dof"]:
        """Torque of the nominal rigid arm with armature and springs [N m]: all of the model that is smooth."""
        arm = self.arm
        rigid = self.transmitted
        if rigid is None:
            rigid = self._over(_rigid_torque, self.q, self.qd, self.qdd)
        armature, stiffness, springref = (np.asarray(x) for x in (arm.armature, arm.stiffness, arm.springref))
        return rigid + armature * self.qdd + stiffness * (self.q - springref)

    @functools.cached_property
    def regressor(self) -> Float[np.ndarray, "time dof standard"]:
        """Regressor of the standard parameters, ten a link."""
        return self._over(_regressor, self.q, self.qd, self.qdd)

    def of_links(self, standard: Float[np.ndarray, "dof 10"]) -> Float[np.ndarray, "time dof"]:
        """Torque of the links alone, were these their standard parameters, or a change of them [N m]: the
        regressor times them, without its time and memory."""
        arm = dataclasses.replace(self.arm, standard=jnp.asarray(standard))
        return chunked(_rigid_torque, arm.nameless, self.q, self.qd, self.qdd)

    @functools.cached_property
    def gravity_columns(self) -> Float[np.ndarray, "time dof 3"]:
        """Derivative of the torque by the gravity vector in the base frame [N m s²/m]."""
        return self._over(_gravity_columns, self.q)

    @functools.cached_property
    def wrench_columns(self) -> Float[np.ndarray, "time links dof 6"]:
        """Torque of the motors that a unit force (3) and moment (3) at each link's origin, along the base's axes,
        calls for: $-J_i^\\top$."""
        return self._over(_wrench_columns, self.q)

    @functools.cached_property
    def link_axes(self) -> Float[np.ndarray, "time links 3 3"]:
        """Axes of every link in the base frame."""
        return self._over(_link_axes, self.q)

    @functools.cached_property
    def mass(self) -> Float[np.ndarray, "time dof dof"]:
        """The mass matrix with armature [kg m²]."""
        return masses(self.arm, self.q)

    @property
    def inertia(self) -> Float[np.ndarray, "time dof"]:
        """What each joint turns [kg m²]: the diagonal of the mass matrix."""
        return np.diagonal(self.mass, axis1=1, axis2=2)

    @functools.cached_property
    def slope(self) -> Float[np.ndarray, "time dof"]:
        """Derivative of each joint's smooth torque by its own position [N m/rad]."""
        return np.diagonal(slopes(self.arm, self.q, self.qd, self.qdd), axis1=1, axis2=2)

    @functools.cached_property
    def mean_inertia(self) -> Float[np.ndarray, " dof"]:
        """What each joint turns, in the mean over some poses of the motion [kg m²]."""
        return np.diagonal(masses(self.arm, self.q[:: max(1, self.samples // 16)][:16]).mean(0))

    def sensitivity(self, dq: Float[np.ndarray, "time dof"]) -> Float[np.ndarray, "time dof"]:
        """Change of the smooth torque [N m] for a small change `dq(t)` of the joint positions, to first order."""
        dqd = np.gradient(dq, self.dt, axis=0)
        dqdd = np.gradient(dqd, self.dt, axis=0)
        return self._over(_sensitivity, self.q, self.qd, self.qdd, dq, dqd, dqdd)

    def moved(self, dq: Float[np.ndarray, "time dof"]) -> "Motion":
        """The motion with `dq(t)` added to the joint positions."""
        dqd = np.gradient(dq, self.dt, axis=0)
        dqdd = np.gradient(dqd, self.dt, axis=0)
        return Motion(self.arm, self.time, self.q + dq, self.qd + dqd, self.qdd + dqdd, self.friction)

    @property
    def torque(self) -> Float[np.ndarray, "time dof"]:
        """Torque of the whole nominal model [N m]."""
        return self.load + self.friction

    @property
    def torque_shown(self) -> Float[np.ndarray, "time dof"]:
        """The same with the friction that recordings show [N m]."""
        return self.load + self.friction_shown

    def showing(self, more: Float[np.ndarray, "time dof"]) -> "Motion":
        """The motion, where recordings show so much more friction than the nominal model has [N m]."""
        motion = copy.copy(self)
        motion.friction_shown = self.friction + more
        return motion

    def _over(self, function: Callable, *arrays: np.ndarray) -> np.ndarray:
        return chunked(function, self.arm.nameless, *arrays)


def masses(arm: Arm, q: Float[np.ndarray, "poses dof"]) -> Float[np.ndarray, "poses dof dof"]:
    """The mass matrix with armature in some poses [kg m²]."""
    return chunked(_masses, arm.nameless, q)


def slopes(
    arm: Arm,
    q: Float[np.ndarray, "states dof"],
    qd: Float[np.ndarray, "states dof"],
    qdd: Float[np.ndarray, "states dof"],
) -> Float[np.ndarray, "states dof dof"]:
    """Derivative of the smooth torque by the joint positions [N m/rad]."""
    return chunked(_slopes, arm.nameless, q, qd, qdd)


def smooth_torque(arm: Arm, q: Array, qd: Array, qdd: Array) -> Array:
    """`Motion.load` at one instant [N m]."""
    rigid = rnea(arm.chain, arm.standard, q, qd, qdd)
    return rigid + arm.armature * qdd + arm.stiffness * (q - arm.springref)


def _rigid_torque(arm, *states):
    return batched.rnea(arm.chain, arm.standard, *map(jnp.asarray, states))


@jax.jit
def _regressor(arm, q, qd, qdd):
    Y = jax.vmap(lambda *s: regressor(arm.chain, *s))(q, qd, qdd)
    return Y.reshape(*Y.shape[:2], -1)


def gravity_columns(arm: Arm, q: Float[Array, " dof"]) -> Float[Array, "dof 3"]:
    """`Motion.gravity_columns` of one pose."""

    def torque(g):
        chain = eqx.tree_at(lambda c: c.gravity, arm.chain, g)
        return rnea(chain, arm.standard, q, jnp.zeros_like(q), jnp.zeros_like(q))

    return jax.jacfwd(torque)(arm.chain.gravity)


@jax.jit
def _gravity_columns(arm, q):
    return jax.vmap(lambda q: gravity_columns(arm, q))(q)


@jax.jit
def _sensitivity(arm, q, qd, qdd, dq, dqd, dqdd):
    def one(q, qd, qdd, dq, dqd, dqdd):
        return jax.jvp(lambda *s: smooth_torque(arm, *s), (q, qd, qdd), (dq, dqd, dqdd))[1]

    return jax.vmap(one)(q, qd, qdd, dq, dqd, dqdd)


@jax.jit
def _slopes(arm, q, qd, qdd):
    return jax.vmap(jax.jacfwd(lambda q, *rates: smooth_torque(arm, q, *rates)))(q, qd, qdd)


@jax.jit
def _masses(arm, q):
    return jax.vmap(lambda q: mass_matrix(arm.chain, arm.standard, q) + jnp.diag(arm.armature))(q)


def wrench_columns(arm: Arm, q: Float[Array, " dof"]) -> Float[Array, "links dof 6"]:
    """`Motion.wrench_columns` of one pose."""
    R, p = link_poses(arm.chain, q)
    z = R[:, :, 2]
    turns = ~arm.chain.prismatic

    def at(link):
        linear = jnp.where(turns[:, None], jnp.cross(z, p[link] - p), z)
        angular = jnp.where(turns[:, None], z, 0.0)
        carried = (jnp.arange(q.shape[0]) <= link)[:, None]
        return -jnp.where(carried, jnp.concatenate([linear, angular], 1), 0.0)

    return jax.vmap(at)(jnp.arange(q.shape[0]))


@jax.jit
def _wrench_columns(arm, q):
    return jax.vmap(lambda q: wrench_columns(arm, q))(q)


@jax.jit
def _link_axes(arm, q):
    return jax.vmap(lambda q: link_poses(arm.chain, q)[0])(q)


Joint = Int[Array, ""] | int
