r"""Links that have given coefficients exactly, one for each start: where real links can, nothing is traded.

$$\min_u\; B(u) - \langle\nabla B(u_0), u\rangle \quad\text{subject to}\quad Au = b,
\qquad B = -\textstyle\sum\log\det S_l - \sum\log s$$

is the start's projection in the barrier's Bregman distance, which is where `interior`'s path ends as well, but
for its $\kappa$. What the coefficients fix is solved for once for all, so that a step costs one factor of the
size of what they leave free (29 of a Panda's 70 unknowns, where they are the published 41), and one solution.

**Step.** Newton's on $SZ = 1$, $sz = 1$ along the direction of Helmberg, Rendl, Vanderbei, Wolkowicz (1996), from
$Z = S^{-1}$ at the start: there all holds but $Au = b$, of which a step of length $\alpha$ meets the share
$\alpha$. Primal and dual lengths are chosen apart. A start that meets the coefficients is done: more steps would
only bring it nearer to where it began. What is not linear in u is not looked at before the end: this is for where
that seldom binds.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from . import convex, definite, interior, small
from .interior import Problem
from .outcome import Outcome
from .turns import AbstractSteps, in_turns

MOST = 40
"""Steps; most starts need seven."""

_TO_BOUNDARY = 0.9
_RANK = 1e-9  # least singular value of the equations that counts, as a share of the largest


class Origin(eqx.Module):
    """Where starts come from, and what the equations leave free."""

    start: convex.Origin
    free: Float[Array, "columns free"]
    """Orthonormal; A free = 0."""
    lift: Float[Array, "columns rows"]
    """The pseudo-inverse of A."""


class State(AbstractSteps):
    u: Float[Array, "columns lanes"]
    Z: small.Matrices
    z: Float[Array, "linear lanes"]
    pull: Float[Array, "columns lanes"]
    """The barrier's gradient at the start, negative."""
    steps: Int[Array, " lanes"]
    done: Bool[Array, " lanes"]


def origin_of(start: convex.Origin) -> Origin | None:
    """None where the equations leave nothing free."""
    left, values, right = np.linalg.svd(np.asarray(start.problem.A), full_matrices=True)
    rank = int(np.sum(values > _RANK * values[0]))
    if rank == right.shape[0]:
        return None
    lift = right[:rank].T / values[:rank] @ left[:, :rank].T
    return Origin(start, jnp.asarray(right[rank:].T), jnp.asarray(lift))


def solve_starts(origin: Origin, numbers: Int[Array, " chunk"], lanes: tuple[int, ...]) -> Outcome:
    """Every start's projection; converged where that has the coefficients and violates nothing."""
    problem = origin.start.problem
    x0 = jax.vmap(lambda number: convex.start(origin.start, number))(numbers)
    state = initialise(problem, x0.T, idle=numbers < 0)
    state = in_turns(lambda state: step(origin, state), state, MOST, lanes)
    return convex.outcome(problem, state.u, state.done, state.steps)


def initialise(problem: Problem, u: Float[Array, "columns lanes"], idle: Bool[Array, " lanes"]) -> State:
    """On the start itself."""
    Z, z, pull = interior.barrier(problem, u)
    return State(u, Z, z, pull, jnp.zeros(u.shape[1], int), idle)


def step(origin: Origin, state: State) -> State:
    """One step of every lane that is not done."""
    problem, free = origin.start.problem, origin.free
    n, lanes = 10 * problem.dof, state.u.shape[1]
    active = ~state.done & (state.steps < MOST)
    G, Z, z = problem.G, state.Z, state.z
    S, s = interior.matrices(problem, state.u), G @ state.u + problem.d[:, None]
    S_inverse, _, gradient = interior.barrier(problem, state.u)
    ratio = z / s
    blocks = small.curvature(S_inverse, Z) + interior.of_link_boxes(problem, ratio)
    blocks = jax.lax.optimization_barrier(jnp.moveaxis(blocks, -1, 0))
    rows = slice(interior.PER_LINK * problem.dof, None)  # of G, beyond the links' own

    # H = blocks + Gᵀ (z/s) G, applied to the free directions, and to the step that meets the equations.
    of_links = free[:n].reshape(problem.dof, 10, -1)
    applied = jnp.einsum("blpq,lqf->blpf", blocks, of_links).reshape(lanes, n, -1)
    H = jnp.einsum("pf,bpg->bfg", free[:n], applied)
    G_free = G[rows] @ free
    H = H + jnp.einsum("kf,kb,kg->bfg", G_free, ratio[rows], G_free)
    to_meet = origin.lift @ (problem.b[:, None] - problem.A @ state.u)
    H_to_meet = jnp.einsum("blpq,lqb->blp", blocks, to_meet[:n].reshape(problem.dof, 10, lanes)).reshape(
        lanes, n
    )
    H_to_meet = free[:n].T @ H_to_meet.T + G_free.T @ (ratio[rows] * (G[rows] @ to_meet))

    rhs = free.T @ (gradient - state.pull) - H_to_meet
    du = to_meet + free @ definite.solve(definite.factor(H), rhs.T).T
    dS, ds = small.symmetric(interior.of_links(problem, du)), G @ du
    dZ = S_inverse - Z - small.symmetric_part(small.product(small.product(S_inverse, dS), Z))
    dz = 1 / s - z - ratio * ds
    dS, dZ = jax.lax.optimization_barrier((dS, dZ))

    def length(M, dM, x, dx):
        longest = jnp.minimum(small.longest_step(M, dM), 1 / jnp.maximum(1.0, -jnp.min(dx / x, 0)))
        return jnp.where(longest < 1, _TO_BOUNDARY * longest, 1.0)

    primal, dual = length(S, dS, s, ds), length(Z, dZ, z, dz)
    move = lambda old, alpha, by: jnp.where(active & jnp.all(jnp.isfinite(du), 0), old + alpha * by, old)
    u = move(state.u, primal, du)
    left = jnp.sum((problem.A @ u - problem.b[:, None]) ** 2, 0)
    return State(
        u=u,
        Z=move(Z, dual, dZ),
        z=move(z, dual, dz),
        pull=state.pull,
        steps=state.steps + active,
        done=state.done | (active & (left <= interior.MET * jnp.sum(problem.b**2))),
    )
