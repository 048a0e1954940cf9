r"""Interior-point steps of many starts at once: arrays with the starts ("lanes") last and contiguous.

$$\min_u\ \lVert Au - b\rVert^2 + P(u) \quad\text{subject to}\quad S_l(u) \succ 0,\quad s(u) = Gu + d > 0$$

$S_l$ is link $l$'s pseudo-inertia (linear in $u$) less that of the bodies it carries, $G$ holds the boxes and
the total mass, $P$ the augmented Lagrangian of what is not linear in $u$: boxes on inertias about the centre of
mass, and the user's constraints.

**Path.** Primal and dual, $S Z = \mu 1$ and $s z = \mu$, with

$$\nabla(\lVert Au-b\rVert^2 + P) + \mu\,\nabla\bigl(B(u) - \langle\nabla B(u_0), u\rangle\bigr) = 0,
\qquad B = -\textstyle\sum\log\det S_l - \sum\log s + \tfrac{\kappa}{2}\lVert u\rVert^2 .$$

The term in the start $u_0$ makes $u_0$ the path's own beginning ($\mu \to \infty$) and its end, of all optimal
$u$, the one nearest to $u_0$ in the barrier's Bregman distance: where the optimum is not unique, the ends differ
as the starts do.

**Step.** Predictor and corrector (Mehrotra 1992) along the direction of Helmberg, Rendl, Vanderbei, Wolkowicz
(1996) and Kojima, Shindoh, Hara (1997): its matrix, $\mathrm{tr}(E_q S^{-1} E_r Z)$, needs no eigenvalues. $P$
enters by its Gauss-Newton matrix; a step that raises the objective by more than the duality gap is shortened,
else taken back and damped (Levenberg).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from . import definite, small
from .constraints import Links
from .outcome import XYZ_COLUMN, XYZ_ROW, Limits
from .turns import AbstractSteps

# Where m, h and Sigma stand among the ten entries of a link's scaled pseudo-inertia, `small.PAIRS`.
MASS = small.PAIRS.index((3, 3))
FIRST = [small.PAIRS.index((k, 3)) for k in range(3)]
PER_LINK = 8
"""Linear constraints of a link: its mass and its centre of mass, from below and above."""
MET = 1e-14
"""Share of the right-hand side's square that counts as nothing left."""

_TO_BOUNDARY = 0.95
_CENTRING = 6  # the target is mu times what the predictor leaves of the gap, to this power
_FIRST = 0.1  # mu at first, over what would make the gap all of the objective
_LEAST_DAMPING, _SLIGHT_DAMPING = 1e-12, 1e-3
_NEARNESS = 150.0  # kappa: how much an end resembles its start, where the optimum leaves that open
_WEIGHT = 3.0  # of what is not linear, at first; in its units
_INSET = 1e-6  # how far inside the user's constraints to aim; in their units
_MOST_WEIGHT = 1e6  # as a multiple of the first
_SHORTER = (1.0, 0.5, 0.2, 0.05)
_PATIENCE = 8  # steps between two updates of the multipliers


class Problem(eqx.Module):
    """One problem in scaled form; unknowns u: ten entries of each link's S, then the extra unknowns."""

    A: Float[Array, "rows columns"]
    """Scaled so that the Hessian's diagonal is about one."""
    b: Float[Array, " rows"]
    Q: Float[Array, "columns columns"]
    """2 AᵀA."""
    G: Float[Array, "linear columns"]
    """Rows: eight a link, two of the total mass, the extra unknowns' lower and upper. What is absent is zero."""
    d: Float[Array, " linear"]
    to_phi: Float[Array, "dof 10 10"]
    """From u of a link to phi."""
    shift: Float[Array, " dof"]
    """Subtracted from the diagonal of Sigma in S: how far from the boundary to stay."""
    carried: Float[Array, "dof 10"]
    """Entries of what belongs to bodies that a link carries and that stay as they are: S is that of the rest."""
    unit: Float[Array, "dof 2"]
    """Unit of mass [kg] and length [m] of each link."""
    centre: Float[Array, "dof 3"]
    """Origin of a link's h and Sigma: the middle of the box of its centre of mass [m]."""
    extra_unit: Float[Array, " extra"]
    limits: Limits
    inertia_box: Float[Array, "dof 6 2"]
    """In a unit of its own for each link (`outcome.inertia_unit`)."""
    inset: Float[Array, "dof 6 1 1"]
    """How far inside it to aim."""
    inertia_unit: Float[Array, " dof"]
    """From the unit of S to that unit."""
    user_unit: Float[Array, " user"]
    """Of the margins of `limits.constraints`: how much a step of one in u changes them."""
    mass_box: Float[Array, "dof 2"]
    """Scaled, as G holds them; for the starts."""
    com_box: Float[Array, "dof 3 2"]
    total_box: Float[Array, " 2"]
    """[kg]"""
    extra_box: Float[Array, "extra 2"]
    dof: int = eqx.field(static=True)
    boxed: bool = eqx.field(static=True)
    """Whether any inertia is bounded by more than the triangle inequality."""

    @property
    def bent(self) -> bool:
        """Whether anything is not linear in u."""
        return self.boxed or bool(self.limits.constraints)


class Margins(eqx.Module):
    """Of what is not linear in u; or its multipliers, or pressures ("hinges")."""

    boxes: Float[Array, "dof 6 sides lanes"]
    """On inertias, in `Problem.inertia_unit`'s unit; no sides where there are none."""
    user: Float[Array, "user lanes"]


class State(AbstractSteps):
    u: Float[Array, "columns lanes"]
    start: Float[Array, "columns lanes"]
    tolerance: Float[Array, " lanes"]
    Z: Float[Array, "dof 4 4 lanes"]
    z: Float[Array, "linear lanes"]
    pull: Float[Array, "columns lanes"]
    """The barrier's gradient at the start, negative."""
    pulled: Float[Array, " lanes"]
    """What it is weighed with at present: the path's mu, on the path."""
    multipliers: Margins
    weight: Float[Array, " lanes"]
    missed: Float[Array, " lanes"]
    """Largest violation of the constraints that are not linear, at the last update of their multipliers."""
    waited: Int[Array, " lanes"]
    damping: Float[Array, " lanes"]
    accepted: Int[Array, " lanes"]
    steps: Int[Array, " lanes"]
    done: Bool[Array, " lanes"]


def matrices(problem: Problem, u: Float[Array, "columns lanes"]) -> small.Matrices:
    """S of every link, less what it carries."""
    inset = jnp.asarray(np.diag([1.0, 1.0, 1.0, 0.0]))[:, :, None] * problem.shift[:, None, None, None]
    return small.symmetric(of_links(problem, u) - problem.carried[..., None]) - inset


def of_links(problem: Problem, u: Float[Array, "columns lanes"]) -> Float[Array, "dof 10 lanes"]:
    return u[: 10 * problem.dof].reshape(problem.dof, 10, -1)


def _second_moment(link: Float[Array, "dof 10 lanes"]) -> list[list[Array]]:
    """Scaled Sigma about the centre of mass: entry by entry, lower triangle included."""
    at = lambda i, k: link[:, small.PAIRS.index((min(i, k), max(i, k)))]
    return [[at(i, k) - at(i, 3) * at(k, 3) / at(3, 3) for k in range(3)] for i in range(3)]


def _inertia_entries(link: Float[Array, "dof 10 lanes"]) -> Float[Array, "dof 6 lanes"]:
    """Scaled xx, yy, zz, xy, xz, yz of the inertia about the centre of mass."""
    Sigma = _second_moment(link)
    trace = Sigma[0][0] + Sigma[1][1] + Sigma[2][2]
    return jnp.stack(
        [(trace if i == k else 0.0) - Sigma[i][k] for i, k in zip(XYZ_ROW, XYZ_COLUMN, strict=True)], 1
    )


def user_margins(problem: Problem, u: Float[Array, " columns"]) -> Float[Array, " user"]:
    """Of one start, in their own units."""
    phi = jnp.einsum("lpq,lq->lp", problem.to_phi, u[: 10 * problem.dof].reshape(problem.dof, 10))
    links = Links.from_phi(phi)
    return jnp.concatenate([jnp.zeros(0), *(jnp.ravel(c(links)) for c in problem.limits.constraints)])


def _margins(problem: Problem, u: Float[Array, "columns lanes"]) -> Margins:
    boxes = jnp.zeros((problem.dof, 6, 0, u.shape[1]), u.dtype)
    if problem.boxed:
        six = _inertia_entries(of_links(problem, u)) * problem.inertia_unit[:, None, None]
        box = problem.inertia_box[..., None]
        boxes = jnp.stack([six - box[:, :, 0], box[:, :, 1] - six], 2)
    user = jax.vmap(lambda u: user_margins(problem, u) / problem.user_unit, -1, -1)(u)
    return Margins(boxes, user)


def _inset(problem: Problem) -> Margins:
    """How far inside to aim."""
    return Margins(problem.inset, jnp.full((len(problem.user_unit), 1), _INSET))


def _sums(*trees: Margins, of) -> Float[Array, " lanes"]:
    """Over all margins of a lane, what `of` makes of them."""
    parts = jax.tree.map(of, *trees)
    return jnp.sum(parts.boxes, (0, 1, 2)) + jnp.sum(parts.user, 0)


def _pressed(hinges: Margins) -> Bool[Array, " lanes"]:
    return _sums(hinges, of=lambda hinge: hinge) > 0


class _Value(NamedTuple):
    objective: Float[Array, " lanes"]
    """Sum of squares and augmented Lagrangian."""
    residual: Float[Array, "rows lanes"]
    margins: Margins
    hinges: Margins
    """Pressures: not negative, zero where a margin is ample."""


def _evaluate(problem: Problem, u: Float[Array, "columns lanes"], state: State) -> _Value:
    residual = problem.A @ u - problem.b[:, None]
    margins = _margins(problem, u)
    hinges = jax.tree.map(
        lambda y, inset, margin: jnp.maximum(0.0, y + state.weight * (inset - margin)),
        state.multipliers,
        _inset(problem),
        margins,
    )
    penalty = _sums(hinges, of=jnp.square) / (2 * state.weight)
    return _Value(jnp.sum(residual**2, 0) + penalty, residual, margins, hinges)


def _model(problem: Problem, state: State, value: _Value):
    """Gradient of the objective; its Hessian beyond Q, as blocks of the links and as rows whose squares it is."""
    n = 10 * problem.dof
    gradient = 2 * problem.A.T @ value.residual
    blocks = jnp.zeros(())
    link = of_links(problem, state.u)
    if problem.boxed:
        along = lambda e: jax.jvp(_inertia_entries, (link,), (jnp.broadcast_to(e[:, None], link.shape),))[1]
        E = (
            jnp.moveaxis(jax.vmap(along)(jnp.eye(10, dtype=link.dtype)), 0, 2)
            * problem.inertia_unit[:, None, None, None]
        )  # (dof, 6, 10, lanes)
        E = jax.lax.optimization_barrier(E)
        hinges = value.hinges.boxes
        pressure = hinges[:, :, 1] - hinges[:, :, 0]
        gradient = gradient.at[:n].add(jnp.sum(E * pressure[:, :, None], 1).reshape(n, -1))
        pressed = state.weight * jnp.sum(hinges > 0, 2)
        blocks = jnp.sum(E[:, :, :, None] * (E * pressed[:, :, None])[:, :, None], 1)
    rows = jnp.zeros((0, *state.u.shape))
    if problem.limits.constraints:
        J = jax.vmap(jax.jacrev(lambda u: user_margins(problem, u) / problem.user_unit), -1, -1)(state.u)
        hinges = value.hinges.user
        gradient = gradient - jnp.sum(J * hinges[:, None], 0)
        rows = J * jnp.sqrt(jnp.where(hinges > 0, state.weight, 0.0))[:, None]
    return gradient, blocks, rows


def of_link_boxes(problem: Problem, ratio: Float[Array, "linear lanes"]) -> Float[Array, "dof 10 10 lanes"]:
    """What the boxes of each link add to the matrix of its unknowns: Gᵀ ratio G."""
    dof, first = problem.dof, PER_LINK * problem.dof
    each = np.arange(dof)
    of_boxes = problem.G[:first, : 10 * dof].reshape(dof, PER_LINK, dof, 10)[each, :, each]
    squares = of_boxes[:, :, :, None] * of_boxes[:, :, None]
    return jnp.einsum("lcqr,lcb->lqrb", squares, ratio[:first].reshape(dof, PER_LINK, -1))


def _assemble(problem: Problem, blocks, rows, ratio, damping) -> definite.Summed:
    """The step's matrix."""
    n, first, columns = 10 * problem.dof, PER_LINK * problem.dof, len(problem.Q)
    diagonal = jnp.broadcast_to(damping, (columns, len(damping)))
    if columns > n:
        diagonal = diagonal.at[n:].add((problem.G[first + 2 :, n:] ** 2).T @ ratio[first + 2 :])
    total = problem.G[first : first + 2]  # the same row with either sign, or zero
    return definite.Summed(
        constant=problem.Q,
        common=jnp.max(jnp.abs(total), 0),
        weight=jnp.where(jnp.any(total != 0, 1), 1.0, 0.0) @ ratio[first : first + 2],
        blocks=blocks + of_link_boxes(problem, ratio),
        rows=rows,
        diagonal=diagonal,
    )


def barrier(
    problem: Problem, u: Float[Array, "columns lanes"]
) -> tuple[small.Matrices, Float[Array, "linear lanes"], Float[Array, "columns lanes"]]:
    """$S^{-1}$, 1/s, and the barrier's gradient, negative."""
    S_inverse = small.inverse(matrices(problem, u))
    of_linear = 1 / (problem.G @ u + problem.d[:, None])
    gradient = problem.G.T @ of_linear
    gradient = gradient.at[: 10 * problem.dof].add(small.adjoint(S_inverse).reshape(-1, u.shape[1]))
    return S_inverse, of_linear, gradient


def initialise(
    problem: Problem, u: Float[Array, "columns lanes"], tolerance: Float[Array, " lanes"]
) -> State:
    """On the path's beginning."""
    lanes = u.shape[1]
    S_inverse, of_linear, pull = barrier(problem, u)
    margins = _margins(problem, u)
    fresh = jnp.zeros(lanes, int)
    state = State(
        u=u,
        start=u,
        tolerance=tolerance,
        Z=S_inverse,
        z=of_linear,
        pull=pull,
        pulled=jnp.ones(lanes),
        multipliers=jax.tree.map(jnp.zeros_like, margins),
        weight=jnp.full(lanes, _WEIGHT),
        missed=jnp.full(lanes, jnp.inf),
        waited=fresh,
        damping=jnp.full(lanes, _LEAST_DAMPING),
        accepted=fresh,
        steps=fresh,
        done=jnp.zeros(lanes, bool),
    )
    mu = _FIRST * _evaluate(problem, u, state).objective / _order(problem)
    return eqx.tree_at(lambda s: (s.Z, s.z, s.pulled), state, (mu * state.Z, mu * state.z, mu))


def _order(problem: Problem) -> int:
    """Of the barrier: the duality gap on the path is this many mu."""
    return 4 * problem.dof + len(problem.d)


def step(problem: Problem, state: State, most: int) -> State:
    """One predictor-corrector step of every lane that is not done and has taken less than `most`."""
    active = ~state.done & (state.steps < most)
    n, order = 10 * problem.dof, _order(problem)
    G = problem.G
    S, s = matrices(problem, state.u), problem.G @ state.u + problem.d[:, None]
    S_inverse = small.inverse(S)
    gap = small.inner(S, state.Z) + jnp.sum(s * state.z, 0)
    mu = gap / order
    value = _evaluate(problem, state.u, state)
    gradient, blocks, rows = _model(problem, state, value)
    away = state.pull + _NEARNESS * (state.u - state.start)  # what the target's mu is multiplied with
    unbalanced = gradient - G.T @ state.z + state.pulled * away
    unbalanced = unbalanced.at[:n].add(-small.adjoint(state.Z).reshape(n, -1))
    pressed = _pressed(value.hinges)
    blocks = blocks + small.curvature(S_inverse, state.Z)
    # The next target is not known yet; a tenth of mu is about right.
    nearness = 0.1 * _NEARNESS * mu
    H = _assemble(problem, blocks, rows, state.z / s, state.damping + nearness)
    factor = definite.factor_of_sum(H)
    solve = lambda rhs: definite.solve(factor, rhs.T).T
    nothing_left = MET * jnp.sum(problem.b**2)
    solved = state.tolerance * value.objective + nothing_left

    def direction(corrects, before):
        """Predictor, then the corrector: towards S Z = target 1, with the predictor's second order."""
        _, dS, dZ, ds, dz, alpha, _, within_reach = before
        alpha = _TO_BOUNDARY * alpha
        left = small.inner(S + alpha * dS, state.Z + alpha * dZ)
        left = left + jnp.sum((s + alpha * ds) * (state.z + alpha * dz), 0)
        target = corrects * jnp.maximum(
            mu * jnp.clip((left / gap) ** _CENTRING, 1e-4, 1.0), 0.01 * solved / order
        )
        of_S = target * S_inverse - small.symmetric_part(small.product(small.product(S_inverse, dS), dZ))
        of_s = (target - ds * dz) / s
        rhs = G.T @ of_s - gradient - target * away
        du = solve(rhs.at[:n].add(small.adjoint(of_S).reshape(n, -1)))
        dS, ds = small.symmetric(of_links(problem, du)), G @ du
        dZ = of_S - state.Z - small.symmetric_part(small.product(small.product(S_inverse, dS), state.Z))
        dz = of_s - state.z - state.z / s * ds
        dS, dZ = jax.lax.optimization_barrier((dS, dZ))
        ratio = jnp.minimum(jnp.min(ds / s, 0), jnp.min(dz / state.z, 0))
        longest = small.longest_step(jnp.concatenate([S, state.Z]), jnp.concatenate([dS, dZ]))
        # The predictor aims at the optimum: what it would gain is how far that is.
        gain = -jnp.sum(du * (gradient + 0.5 * problem.Q @ du), 0)
        within_reach = jnp.where(corrects, within_reach, gain)
        return du, dS, dZ, ds, dz, jnp.minimum(longest, 1 / jnp.maximum(1.0, -ratio)), target, within_reach

    nothing = jax.tree.map(jnp.zeros_like, (state.u, S, S, s, s, gap, gap, gap))
    du, _, dZ, _, dz, alpha, target, within_reach = jax.lax.fori_loop(0, 2, direction, nothing)
    alpha = jnp.where(alpha < 1, _TO_BOUNDARY * alpha, 1.0)

    # Where a constraint bends, the whole step may lead astray: the longest of a few that does not.
    def objective(share: float) -> Float[Array, " lanes"]:
        return _evaluate(problem, state.u + share * alpha * du, state).objective

    if problem.bent:
        fine = jnp.stack([objective(share) for share in _SHORTER]) <= value.objective + gap
        alpha = alpha * jnp.asarray(_SHORTER)[jnp.argmax(fine, 0)]
    u = state.u + alpha * du
    new = _evaluate(problem, u, state)
    better = new.objective <= value.objective + gap  # false for what is not a number
    move = better & active
    pick = lambda new, old: jnp.where(move, new, old)
    Z, z = pick(state.Z + alpha * dZ, state.Z), pick(state.z + alpha * dz, state.z)
    value = jax.tree.map(pick, new, value)
    u = pick(u, state.u)
    left = small.inner(matrices(problem, u), Z) + jnp.sum((G @ u + problem.d[:, None]) * z, 0)

    # What is not linear: whether it holds, and whether its multipliers have settled.
    least = jnp.min(value.margins.boxes, (0, 1, 2), initial=0.0)
    missed = -jnp.minimum(least, jnp.min(value.margins.user, 0, initial=0.0))
    slack = lambda hinge, margin, inset: jnp.where(hinge > 0, hinge * jnp.abs(margin - inset), 0.0)
    unsettled = _sums(value.hinges, value.margins, _inset(problem), of=slack)
    solved = state.tolerance * value.objective
    nothing_left = value.objective <= nothing_left
    # What is unbalanced after the step, where the objective is quadratic; elsewhere it is looked at again.
    pressed = pressed | _pressed(value.hinges)
    taken = jnp.where(pressed | ~better, 0.0, alpha)
    unbalanced = (1 - taken) * unbalanced + taken * (_NEARNESS * target - nearness - state.damping) * du
    unbalanced = jnp.max(jnp.abs(unbalanced), 0)
    pulled = pick(state.pulled + alpha * (target - state.pulled), state.pulled)
    within_reach = jnp.abs(within_reach) * jnp.maximum(pulled / state.pulled, left / gap)
    close = (within_reach <= solved) & (left <= jnp.minimum(0.5 * value.objective, 3 * solved))
    # What the start still pulls, and damping, hide how far the optimum is.
    close = close & (pulled * jnp.max(jnp.abs(away), 0) <= 3 * solved) & (state.damping <= _SLIGHT_DAMPING)
    on_path = (close & (unbalanced <= 0.01 * jnp.sqrt(solved))) | nothing_left
    done = state.done | (active & on_path & (missed <= 0) & ((unsettled <= solved) | nothing_left))
    update = active & ((state.waited >= _PATIENCE) | on_path)
    # Heavier only where the objective has been solved: a heavy constraint that bends leaves short steps alone.
    stuck = on_path & (missed > 0.25 * state.missed)
    heavier = jnp.minimum(jnp.where(stuck, 10.0, 1.0) * state.weight, _MOST_WEIGHT * _WEIGHT)
    return State(
        u=u,
        start=state.start,
        tolerance=state.tolerance,
        Z=Z,
        z=z,
        pull=state.pull,
        pulled=pulled,
        multipliers=jax.tree.map(
            lambda new, old: jnp.where(update, new, old), value.hinges, state.multipliers
        ),
        weight=jnp.where(update, heavier, state.weight),
        missed=jnp.where(update, missed, state.missed),
        waited=jnp.where(update, 0, state.waited + 1),
        damping=jnp.where(
            better,
            jnp.maximum(0.1 * state.damping, _LEAST_DAMPING),
            jnp.clip(10 * state.damping, 1e-4, 1e12),
        ),
        accepted=state.accepted + move,
        steps=state.steps + active,
        done=done,
    )
