"""A serial chain of revolute and prismatic joints, as arrays."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class Chain(eqx.Module):
    """Geometry of a serial arm: what the kernels need, and nothing with a name.

    Link i's frame has its z axis along joint i and its origin on that axis (as modified
    Denavit-Hartenberg frames do). A revolute joint turns the link about its own z, a prismatic one
    slides it along. Frame 0 is the base's.
    """

    R: Float[Array, "dof 3 3"]
    """Axes of link i in link i-1, at q = 0."""
    p: Float[Array, "dof 3"]
    """Origin of link i in link i-1, at q = 0 [m]."""
    prismatic: Bool[Array, " dof"]
    gravity: Float[Array, "3"]
    """Gravitational acceleration in the base frame [m/s²]; (0, 0, -9.80665) for a level base."""

    @property
    def dof(self) -> int:
        return self.p.shape[0]


def from_modified_dh(
    a: Float[Array, " dof"],
    alpha: Float[Array, " dof"],
    d: Float[Array, " dof"],
    theta: Float[Array, " dof"],
    prismatic: Bool[Array, " dof"],
    gravity: Float[Array, "3"],
) -> Chain:
    r"""The chain with $T_i = R_x(\alpha_{i-1})\,T_x(a_{i-1})\,R_z(\theta_i + q_i)\,T_z(d_i)$.

    Args:
        a: $a_{i-1}$ [m].
        alpha: $\alpha_{i-1}$ [rad].
        d: [m]; a prismatic joint adds q to it.
        theta: offset of the joint angle [rad]; a revolute joint adds q to it.
        prismatic: which joints slide.
        gravity: in the base frame [m/s²].

    References:
        Craig, Introduction to Robotics, 3rd ed., eq. 3.6.
    """
    ca, sa, ct, st = jnp.cos(alpha), jnp.sin(alpha), jnp.cos(theta), jnp.sin(theta)
    zero = jnp.zeros_like(ca)
    R = jnp.stack(
        [
            jnp.stack([ct, -st, zero], -1),
            jnp.stack([st * ca, ct * ca, -sa], -1),
            jnp.stack([st * sa, ct * sa, ca], -1),
        ],
        -2,
    )
    p = jnp.stack([a, -sa * d, ca * d], -1)
    return Chain(R, p, prismatic, gravity)


def joint_placement(
    R: Float[Array, "3 3"], p: Float[Array, "3"], prismatic: Bool[Array, ""], q: Float[Array, ""]
) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
    """Pose of a link in its parent when its joint is at `q`."""
    angle = jnp.where(prismatic, jnp.zeros_like(q), q)
    slide = jnp.where(prismatic, q, jnp.zeros_like(q))
    c, s = jnp.cos(angle), jnp.sin(angle)
    x, y, z = R[:, 0], R[:, 1], R[:, 2]
    return jnp.stack([c * x + s * y, c * y - s * x, z], -1), p + slide * z


def link_poses(
    chain: Chain, q: Float[Array, " dof"]
) -> tuple[Float[Array, "dof 3 3"], Float[Array, "dof 3"]]:
    """Axes and origin of every link's frame in the base frame [-, m]."""
    R, p = jnp.eye(3, dtype=q.dtype), jnp.zeros(3, q.dtype)
    rotations, origins = [], []
    for i in range(chain.dof):
        E, r = joint_placement(chain.R[i], chain.p[i], chain.prismatic[i], q[i])
        R, p = R @ E, p + R @ r
        rotations.append(R)
        origins.append(p)
    return jnp.stack(rotations), jnp.stack(origins)
