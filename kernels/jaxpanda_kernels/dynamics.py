r"""Rigid-body dynamics of a serial chain, one sample at a time.

$$\tau = M(q)\,\ddot q + C(q, \dot q)\,\dot q + g(q) = Y(q, \dot q, \ddot q)\,\phi$$

Every function is plain JAX: `vmap` it over samples, differentiate it in any input. Scalars come back in
the dtype they were given.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .chain import Chain, joint_placement
from .inertia import skew, symmetric


def _outward(
    chain: Chain,
    q: Float[Array, " dof"],
    qd: Float[Array, " dof"],
    qdd: Float[Array, " dof"],
):
    """Motion of every link's frame: its pose in the parent, and omega, alpha, a in its own axes.

    `a` is the acceleration of the frame's origin less gravity, so that a resting body carries its weight.
    """
    for name, x in (("q", q), ("qd", qd), ("qdd", qdd)):
        if x.shape != (chain.dof,):
            raise ValueError(f"{name} has shape {x.shape}, where this chain needs {(chain.dof,)}: one sample")
    z = jnp.array([0, 0, 1], q.dtype)

    def step(carry, joint):
        w_p, dw_p, a_p = carry
        R, p, prismatic, q_i, qd_i, qdd_i = joint
        E, r = joint_placement(R, p, prismatic, q_i)
        turn = jnp.where(prismatic, 0, 1).astype(q.dtype)
        slide = 1 - turn
        w_in = E.T @ w_p
        w = w_in + turn * qd_i * z
        dw = E.T @ dw_p + turn * (qdd_i * z + qd_i * jnp.cross(w_in, z))
        a = E.T @ (a_p + jnp.cross(dw_p, r) + jnp.cross(w_p, jnp.cross(w_p, r)))
        a = a + slide * (qdd_i * z + 2 * qd_i * jnp.cross(w_in, z))
        return (w, dw, a), (E, r, w, dw, a)

    base = (jnp.zeros(3, q.dtype), jnp.zeros(3, q.dtype), -chain.gravity.astype(q.dtype))
    joints = (chain.R.astype(q.dtype), chain.p.astype(q.dtype), chain.prismatic, q, qd, qdd)
    return jax.lax.scan(step, base, joints)[1]


def rnea(
    chain: Chain,
    phi: Float[Array, "dof 10"],
    q: Float[Array, " dof"],
    qd: Float[Array, " dof"],
    qdd: Float[Array, " dof"],
) -> Float[Array, " dof"]:
    """Joint torques [N m; N where the joint slides] of a motion, by recursive Newton-Euler.

    References:
        Luh, Walker, Paul, "On-Line Computational Scheme for Mechanical Manipulators", 1980.
    """
    E, r, w, dw, a = _outward(chain, q, qd, qdd)
    if phi.shape != (chain.dof, 10):
        raise ValueError(f"phi has shape {phi.shape}, where this chain needs {(chain.dof, 10)}")

    def inward(carry, link):
        f_c, n_c = carry
        E, r, prismatic, w, dw, a, phi = link
        h, I = phi[1:4], symmetric(phi[4:])
        f = phi[0] * a + jnp.cross(dw, h) + jnp.cross(w, jnp.cross(w, h)) + f_c
        n = I @ dw + jnp.cross(w, I @ w) + jnp.cross(h, a) + n_c
        f_p = E @ f
        return (f_p, E @ n + jnp.cross(r, f_p)), jnp.where(prismatic, f[2], n[2])

    zero = jnp.zeros(3, q.dtype)
    links = (E, r, chain.prismatic, w, dw, a, phi.astype(q.dtype))
    return jax.lax.scan(inward, (zero, zero), links, reverse=True)[1]


def _body_regressor(
    w: Float[Array, "3"], dw: Float[Array, "3"], a: Float[Array, "3"]
) -> Float[Array, "6 10"]:
    """Force and moment about the link's origin, as a matrix times `phi`."""

    def L(v):  # L(v) @ (xx, xy, yy, xz, yz, zz) = I v
        x, y, z = v
        o = jnp.zeros_like(x)
        return jnp.array([[x, y, o, z, o, o], [o, x, y, o, z, o], [o, o, o, x, y, z]])

    wx = skew(w)
    zero = jnp.zeros_like(a)
    force = jnp.concatenate([a[:, None], skew(dw) + wx @ wx, jnp.zeros((3, 6), a.dtype)], 1)
    moment = jnp.concatenate([zero[:, None], -skew(a), L(dw) + wx @ L(w)], 1)
    return jnp.concatenate([force, moment])


def regressor(
    chain: Chain,
    q: Float[Array, " dof"],
    qd: Float[Array, " dof"],
    qdd: Float[Array, " dof"],
) -> Float[Array, "dof dof 10"]:
    r"""$Y$ with $\tau_i = \sum_{l,k} Y_{ilk}\,\phi_{lk}$: analytic, by the same recursion as `rnea`.

    Row i, link l, parameter k; zero for l < i, since a joint carries only the links beyond it.
    """
    E, r, w, dw, a = _outward(chain, q, qd, qdd)
    dof = q.shape[0]

    def inward(wrench, link):
        i, E, r, prismatic, w, dw, a = link
        wrench = wrench.at[i].set(_body_regressor(w, dw, a))
        row = jnp.where(prismatic, wrench[:, 2], wrench[:, 5])
        force = jnp.einsum("ab,lbk->lak", E, wrench[:, :3])
        moment = jnp.einsum("ab,lbk->lak", E, wrench[:, 3:]) + jnp.einsum("ab,lbk->lak", skew(r), force)
        return jnp.concatenate([force, moment], 1), row

    links = (jnp.arange(dof), E, r, chain.prismatic, w, dw, a)
    empty = jnp.zeros((dof, 6, 10), q.dtype)
    return jax.lax.scan(inward, empty, links, reverse=True)[1]


def _floating(chain: Chain, q: Float[Array, " dof"]) -> Chain:
    return Chain(chain.R, chain.p, chain.prismatic, jnp.zeros(3, q.dtype))


def mass_matrix(
    chain: Chain, phi: Float[Array, "dof 10"], q: Float[Array, " dof"]
) -> Float[Array, "dof dof"]:
    """$M(q)$ [kg m²]: column j is the torque of a unit acceleration of joint j, without gravity."""
    zero = jnp.zeros_like(q)
    columns = jax.vmap(lambda e: rnea(_floating(chain, q), phi, q, zero, e))(
        jnp.eye(q.shape[0], dtype=q.dtype)
    )
    return 0.5 * (columns + columns.T)


def gravity_torque(
    chain: Chain, phi: Float[Array, "dof 10"], q: Float[Array, " dof"]
) -> Float[Array, " dof"]:
    """$g(q)$ [N m]."""
    zero = jnp.zeros_like(q)
    return rnea(chain, phi, q, zero, zero)


def coriolis_torque(
    chain: Chain, phi: Float[Array, "dof 10"], q: Float[Array, " dof"], qd: Float[Array, " dof"]
) -> Float[Array, " dof"]:
    r"""$C(q, \dot q)\,\dot q$ [N m]: centrifugal and Coriolis torques."""
    return rnea(_floating(chain, q), phi, q, qd, jnp.zeros_like(q))


def coriolis_matrix(
    chain: Chain, phi: Float[Array, "dof 10"], q: Float[Array, " dof"], qd: Float[Array, " dof"]
) -> Float[Array, "dof dof"]:
    r"""$C(q, \dot q)$ of the Christoffel symbols, for which $\dot M - 2C$ is skew-symmetric.

    $$C_{ij} = \tfrac12 \sum_k (\partial_k M_{ij} + \partial_j M_{ik} - \partial_i M_{jk})\,\dot q_k$$

    Many matrices give the same torque; take `coriolis_torque` where only that is needed.
    """
    dM = jax.jacfwd(lambda q: mass_matrix(chain, phi, q))(q)  # [i, j, k] = d M_ij / d q_k
    return 0.5 * (dM @ qd + jnp.einsum("ikj,k->ij", dM, qd) - jnp.einsum("jki,k->ij", dM, qd))


def forward_dynamics(
    chain: Chain,
    phi: Float[Array, "dof 10"],
    q: Float[Array, " dof"],
    qd: Float[Array, " dof"],
    tau: Float[Array, " dof"],
    armature: Float[Array, " dof"],
) -> Float[Array, " dof"]:
    r"""$\ddot q = (M + \mathrm{diag}(I_a))^{-1}(\tau - h)$ [rad/s²]; `armature` $I_a$ in [kg m²]."""
    h = rnea(chain, phi, q, qd, jnp.zeros_like(q))
    M = mass_matrix(chain, phi, q) + jnp.diag(armature.astype(q.dtype))
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(M), tau - h)
