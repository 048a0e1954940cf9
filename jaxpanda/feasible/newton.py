r"""Newton steps for links under any constraints, convex or not.

$$\min_{x}\ \lVert A\,(\phi(x), \theta) - b\rVert^2 \quad\text{over links that could be built}$$

**Coordinates.** A link is $x = (m, c, L)$ with $\Sigma_c = LL^\top + \epsilon 1$ its second moment about the
centre of mass and $L$ lower triangular. Every $x$ is a real body: $\Sigma_c \succeq 0$ *is* the triangle
inequality. The boundary, where the optimum of real data lies, is at finite coordinates (log-Cholesky has it
at infinity and crawls). Boxes on $m$, $c$ and $\theta$ are kept exactly, by projection.

**Steps.** Newton with Levenberg's damping. With $D = \partial\phi/\partial x$ and $\Gamma$ the gradient with
respect to $\Sigma_c$, the Hessian is $2D^\top A^\top A D$ plus one block a link,
$\mathrm{diag}(0,\, 2m\Gamma,\, 2\,\Gamma \otimes 1)$, plus a coupling of $m$ and $c$ proportional to
$\partial f/\partial c$. At an optimum $\Gamma \succeq 0$ (the multiplier of the triangle inequality) and the
coupling vanishes for every free $c$. So $\Gamma$ is replaced by its positive part and the coupling left
out: each step's matrix is positive definite, and it is the exact Hessian where it matters. Gauss-Newton alone
would converge linearly, because the residual does not vanish. Valleys curve; each step is bent along
(`_bend`).

**Constraints** (inertia boxes, total mass, the user's) enter as squared hinges with multipliers (augmented
Lagrangian), aimed a little inside so that what is left is exactly no violation.

Every start does the same work, so that a batch of them is a batch of small dense algebra.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels import inertia
from jaxtyping import Array, Float, Int, Key

from ..errors import InputError
from .bounds import Bounds
from .constraints import Constraint, Links
from .outcome import (
    TRIANGLE_INSET,
    XYZ_COLUMN,
    XYZ_MATRIX,
    XYZ_ROW,
    Limits,
    Outcome,
    extra_box,
    extra_unit,
    inertia_inset,
    inertia_unit,
    largest_violation,
    limits_of,
)

CHUNK = 64
ROUNDS = 4
ITERATIONS = 25
"""Newton steps a round; after each round the multipliers of the constraints are updated."""

_COM_INSET = 1e-9  # [m]: m c / m need not give c to the last bit
_MARGIN_INSET = 1e-6  # in the constraint's own unit
_DAMPING = 1e-2
_MOST_BEND = 0.375
_WEIGHT = 1.0
_LEAST_MASS = 1e-3  # [kg]: a link without mass is no body, and MuJoCo refuses it

_ROW, _COLUMN = np.tril_indices(3)
_SAME_COLUMN = (_COLUMN[:, None] == _COLUMN).astype(float)


class Problem(eqx.Module):
    """One problem in scaled form; unknowns x = (m, c, L of each link; extra), flat."""

    A: Float[Array, "rows columns"]
    """Scaled so that the Hessian's diagonal is about one."""
    b: Float[Array, " rows"]
    Q: Float[Array, "columns columns"]
    """2 AᵀA."""
    lower: Float[Array, " columns"]
    upper: Float[Array, " columns"]
    scale: Float[Array, " columns"]
    """A typical size of each unknown."""
    limits: Limits
    inertia_box: Float[Array, "dof 6 2"]
    """A little inside the limits [kg m²]."""
    inertia_unit: Float[Array, " dof"]
    """In which it is missed [kg m²]."""
    dof: int = eqx.field(static=True)


def scaled_problem(
    A: Float[np.ndarray, "rows columns"],
    b: Float[np.ndarray, " rows"],
    bounds: Bounds,
    constraints: tuple[Constraint, ...],
    extra_lower: Float[np.ndarray, " extra"] | None,
    extra_upper: Float[np.ndarray, " extra"] | None,
) -> Problem:
    """Check the input and scale it."""
    dof = bounds.dof
    low, high = extra_box(A, b, bounds, extra_lower, extra_upper)
    least = np.minimum(np.maximum(bounds.mass[:, 0], _LEAST_MASS), bounds.mass[:, 1])
    com = _inset(bounds.com, _COM_INSET)
    unbounded = np.full((dof, 6), np.inf)
    lower = np.concatenate([least[:, None], com[..., 0], -unbounded], -1)
    upper = np.concatenate([bounds.mass[:, 1:], com[..., 1], unbounded], -1)
    scale = np.concatenate(
        [_width(bounds.mass)[:, None], _width(com), np.repeat(_root_inertia(bounds)[:, None], 6, 1)], -1
    )
    # phi is of the order of (m, m c, L Lᵀ): enough to bring the Hessian's diagonal to order one.
    size = scale[:, 1:4].max(-1)
    order = np.stack([scale[:, 0], scale[:, 0] * size, scale[:, 4] ** 2], -1)
    order = order[:, [0, 1, 1, 1, 2, 2, 2, 2, 2, 2]].ravel()
    norms = np.linalg.norm(A, axis=0)
    of_extra = extra_unit(A[:, 10 * dof :], b, low, high)
    sigma = np.sqrt(np.mean((norms * np.concatenate([order, of_extra])) ** 2)) or 1.0
    A_scaled, b_scaled = jnp.asarray(A / sigma), jnp.asarray(b / sigma)
    return Problem(
        A=A_scaled,
        b=b_scaled,
        Q=2 * A_scaled.T @ A_scaled,
        lower=jnp.asarray(np.concatenate([lower.ravel(), low])),
        upper=jnp.asarray(np.concatenate([upper.ravel(), high])),
        scale=jnp.asarray(np.concatenate([scale.ravel(), of_extra])),
        limits=limits_of(bounds, constraints),
        inertia_box=jnp.asarray(_inset(bounds.inertia, inertia_inset(bounds))),
        inertia_unit=jnp.asarray(inertia_unit(bounds, A / sigma)),
        dof=dof,
    )


def _inset(
    box: Float[np.ndarray, "*shape 2"], by: float | Float[np.ndarray, "*shape"]
) -> Float[np.ndarray, "*shape 2"]:
    """The box moved inwards, at most by a quarter of its width."""
    inset = np.minimum(by, (box[..., 1] - box[..., 0]) / 4)
    return np.stack([box[..., 0] + inset, box[..., 1] - inset], -1)


def _width(box: Float[np.ndarray, "*shape 2"]) -> Float[np.ndarray, "*shape"]:
    """Widths, one where the box is a point."""
    width = box[..., 1] - box[..., 0]
    return np.where(width > 0, width, 1.0)


def _root_inertia(bounds: Bounds) -> Float[np.ndarray, " dof"]:
    """Typical entry of L: what a link of middling mass with half its box for a radius of gyration has."""
    radius = 0.5 * np.linalg.norm(bounds.com[..., 1] - bounds.com[..., 0], axis=-1) + 0.02
    return radius * np.sqrt(bounds.mass.mean(-1))


class Origin(eqx.Module):
    """Where starts come from."""

    problem: Problem
    middling: Float[Array, " dof"]
    """Masses in the middle of their boxes [kg]."""
    given: Float[Array, "given links"]
    """Links' coordinates to start from in place of random ones."""
    seed: Int[Array, ""]


def origin_of(
    problem: Problem, bounds: Bounds, seed: int, initial: Float[np.ndarray, "given dof 10"] | None
) -> Origin:
    given = jnp.zeros((0, 10 * problem.dof))
    if initial is not None:
        if initial.shape[1:] != (problem.dof, 10):
            raise InputError(
                f"initial parameters: expected shape (n, {problem.dof}, 10), got {initial.shape}"
            )
        given = jax.jit(jax.vmap(jax.vmap(_coordinates)))(jnp.asarray(initial)).reshape(len(initial), -1)
    return Origin(problem, jnp.asarray(bounds.mass.mean(-1)), given, jnp.asarray(seed))


def _start(origin: Origin, number: Int[Array, ""]) -> Float[Array, " columns"]:
    """A given point where there is one of this number, else a random point of the box."""
    problem, given = origin.problem, origin.given
    x0 = _random_start(problem, origin.middling, jax.random.fold_in(jax.random.key(origin.seed), number))
    if not len(given):
        return x0
    replaced = x0.at[: given.shape[1]].set(given[jnp.minimum(number, len(given) - 1)])
    return jnp.where(number < len(given), jnp.clip(replaced, problem.lower, problem.upper), x0)


def solve_starts(origin: Origin, numbers: Int[Array, " chunk"], rounds: int, iterations: int) -> Outcome:
    x0 = jax.vmap(lambda number: _start(origin, number))(numbers)
    return solve_chunk(origin.problem, x0, rounds=rounds, iterations=iterations)


def _random_start(
    problem: Problem, middling: Float[Array, " dof"], key: Key[Array, ""]
) -> Float[Array, " columns"]:
    """Mass and centre of mass uniform in their boxes; L normal, of the size that suits the mass."""
    of_box, of_L = jax.random.split(key)
    links = 10 * problem.dof
    lower, upper, scale = (x[:links].reshape(-1, 10) for x in (problem.lower, problem.upper, problem.scale))
    boxes = jax.random.uniform(of_box, (problem.dof, 4), minval=lower[:, :4], maxval=upper[:, :4])
    L = (
        0.5
        * jax.random.normal(of_L, (problem.dof, 6))
        * scale[:, 4:]
        * jnp.sqrt(boxes[:, :1] / middling[:, None])
    )
    extra = jnp.clip(jnp.zeros_like(problem.scale[links:]), problem.lower[links:], problem.upper[links:])
    return jnp.concatenate([jnp.concatenate([boxes, L], -1).ravel(), extra])


# One link's coordinates x = (m, c, L) and what follows from them.


def _second_moment(x: Float[Array, "10"]) -> Float[Array, "3 3"]:
    L = jnp.zeros((3, 3), x.dtype).at[_ROW, _COLUMN].set(x[4:])
    return L @ L.T + TRIANGLE_INSET * jnp.eye(3)


def _phi_and_inertia(x: Float[Array, "10"]) -> Float[Array, "16"]:
    """`phi`, then xx, yy, zz, xy, xz, yz of the inertia about the centre of mass."""
    I_com = inertia.inertia(_second_moment(x))
    return jnp.concatenate([inertia.from_com(x[0], x[1:4], I_com), I_com[XYZ_ROW, XYZ_COLUMN]])


def _coordinates(phi: Float[Array, "10"]) -> Float[Array, "10"]:
    """x of a given body; the nearest real one where it is none."""
    mass, com, I_com = inertia.to_com(phi)
    values, vectors = jnp.linalg.eigh(inertia.second_moment(I_com))
    Sigma = (vectors * jnp.maximum(values - TRIANGLE_INSET, 1e-12)) @ vectors.T
    return jnp.concatenate([mass[None], com, jnp.linalg.cholesky(Sigma)[_ROW, _COLUMN]])


def _curvature(x: Float[Array, "10"], Gamma: Float[Array, "3 3"]) -> Float[Array, "10 10"]:
    """Second derivatives of the objective along a link's coordinates, given its gradient in Sigma."""
    of_L = 2 * _SAME_COLUMN * Gamma[_ROW][:, _ROW]
    return jnp.zeros((10, 10), x.dtype).at[1:4, 1:4].set(2 * x[0] * Gamma).at[4:, 4:].set(of_L)


def _gradient_in_Sigma(of_I: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Chain rule through I = tr(Sigma) 1 - Sigma."""
    return jnp.trace(of_I) * jnp.eye(3) - of_I


def _positive_part(S: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """The nearest positive semidefinite matrix, by Jacobi rotations: faster in a batch than LAPACK."""
    V = jnp.eye(3, dtype=S.dtype)
    for _ in range(4):
        for p, q in ((0, 1), (0, 2), (1, 2)):
            angle = 0.5 * jnp.arctan2(2 * S[p, q], S[q, q] - S[p, p])
            c, s = jnp.cos(angle), jnp.sin(angle)
            R = jnp.eye(3, dtype=S.dtype).at[[p, q, p, q], [p, q, q, p]].set(jnp.stack([c, c, s, -s]))
            S, V = R.T @ S @ R, V @ R
    return (V * jnp.maximum(jnp.diagonal(S), 0)) @ V.T


def _symmetric(xyz: Float[Array, "6"]) -> Float[Array, "3 3"]:
    """The matrix G with <G, I> = xyz . (Ixx, Iyy, Izz, Ixy, Ixz, Iyz)."""
    xx, yy, zz, xy, xz, yz = xyz
    return jnp.array([[xx, xy / 2, xz / 2], [xy / 2, yy, yz / 2], [xz / 2, yz / 2, zz]])


# Constraints other than boxes on the coordinates: margins, and the squared hinge with multipliers.


class _Margins(eqx.Module):
    """Margins, multipliers or hinges of all constraints, in this order everywhere."""

    inertia: Float[Array, "dof 6 2"]
    total: Float[Array, " 2"]
    user: Float[Array, " user"]


def _links(problem: Problem, x: Float[Array, " columns"], of_I: Float[Array, "dof 6"]) -> Links:
    link = x[: 10 * problem.dof].reshape(-1, 10)
    return Links(link[:, 0], link[:, 1:4], jax.vmap(lambda six: six[XYZ_MATRIX])(of_I))


def _user_margins(problem: Problem, links: Links) -> Float[Array, " user"]:
    return jnp.concatenate([jnp.zeros(0), *(jnp.ravel(c(links)) for c in problem.limits.constraints)])


def _margins(problem: Problem, links: Links, of_I: Float[Array, "dof 6"]) -> _Margins:
    total, box = jnp.sum(links.mass), problem.inertia_box
    return _Margins(
        inertia=jnp.stack([of_I - box[..., 0], box[..., 1] - of_I], -1) / problem.inertia_unit[:, None, None],
        total=jnp.stack([total - problem.limits.total_mass[0], problem.limits.total_mass[1] - total]),
        user=_user_margins(problem, links),
    )


def _hinges(margins: _Margins, multipliers: _Margins, weight: Float[Array, ""]) -> _Margins:
    """Pressure of each constraint: not negative, zero where it is amply satisfied."""
    return jax.tree.map(lambda g, y: jnp.maximum(0.0, y + weight * (_MARGIN_INSET - g)), margins, multipliers)


# The iteration.


class _State(eqx.Module):
    x: Float[Array, " columns"]
    value: Float[Array, ""]
    residual: Float[Array, " rows"]
    damping: Float[Array, ""]
    accepted: Int[Array, ""]


def _evaluate(
    problem: Problem, x: Float[Array, " columns"], multipliers: _Margins, weight: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, " rows"]]:
    """Scaled objective with the constraints' penalty, and the residual."""
    links = 10 * problem.dof
    both = jax.vmap(_phi_and_inertia)(x[:links].reshape(-1, 10))
    residual = problem.A @ jnp.concatenate([both[:, :10].ravel(), x[links:]]) - problem.b
    hinges = _hinges(_margins(problem, _links(problem, x, both[:, 10:]), both[:, 10:]), multipliers, weight)
    return residual @ residual + _sum_squares(hinges) / (2 * weight), residual


def _sum_squares(tree: _Margins) -> Float[Array, ""]:
    return sum((jnp.sum(leaf**2) for leaf in jax.tree.leaves(tree)), start=jnp.zeros(()))


def _quadratic_model(
    problem: Problem, state: _State, multipliers: _Margins, weight: Float[Array, ""]
) -> tuple[Float[Array, " columns"], Float[Array, "columns columns"]]:
    """Gradient and positive semidefinite Hessian in x."""
    n, dof = 10 * problem.dof, problem.dof
    each = jnp.arange(dof)
    x = state.x[:n].reshape(-1, 10)
    both, jacobian = jax.vmap(lambda x: (_phi_and_inertia(x), jax.jacfwd(_phi_and_inertia)(x)))(x)
    D, E, of_I = jacobian[:, :10], jacobian[:, 10:], both[:, 10:]
    links = _links(problem, state.x, of_I)
    hinges = _hinges(_margins(problem, links, of_I), multipliers, weight)
    # Gradients with respect to the quantities that x determines: phi, then I_com and the mass directly.
    of_A = 2 * problem.A.T @ state.residual
    of_phi = of_A[:n].reshape(-1, 10)
    unit = problem.inertia_unit[:, None]
    pressure = (hinges.inertia[..., 1] - hinges.inertia[..., 0]) / unit
    gradient = jnp.einsum("lja,lj->la", D, of_phi) + jnp.einsum("lja,lj->la", E, pressure)
    gradient = gradient.at[:, 0].add(hinges.total[1] - hinges.total[0])
    of_inertia = jax.vmap(_of_inertia)(of_phi[:, 4:]) + jax.vmap(_symmetric)(pressure)
    # Gauss-Newton part of the data and of the boxes.
    QD = jnp.einsum("nlj,ljb->nlb", problem.Q[:, :n].reshape(-1, dof, 10), D)
    H_links = jnp.einsum("lja,ljmb->lamb", D, QD[:n].reshape(dof, 10, dof, 10))
    pressed = weight * jnp.sum(hinges.inertia > 0, -1) / unit**2
    H_links = H_links.at[each, :, each].add(jnp.einsum("lja,lj,ljb->lab", E, pressed, E))
    H_links = H_links.at[:, 0, :, 0].add(weight * jnp.sum(hinges.total > 0))
    if problem.limits.constraints:
        jac = jax.jacrev(lambda links: _user_margins(problem, links))(links)
        of_I_user = 0.5 * (jac.I_com + jnp.swapaxes(jac.I_com, -1, -2))
        six = of_I_user[..., XYZ_ROW, XYZ_COLUMN] * jnp.array([1, 1, 1, 2, 2, 2])
        J = jnp.concatenate([jac.mass[..., None], jac.com, jnp.zeros((*jac.mass.shape, 6))], -1)
        J = J + jnp.einsum("klj,lja->kla", six, E)
        gradient = gradient - jnp.einsum("k,kla->la", hinges.user, J)
        of_inertia = of_inertia - jnp.einsum("k,klij->lij", hinges.user, of_I_user)
        H_links = H_links + weight * jnp.einsum("kla,k,kmb->lamb", J, hinges.user > 0, J)
    Gamma = jax.vmap(lambda G: _positive_part(_gradient_in_Sigma(G)))(of_inertia)
    H_links = H_links.at[each, :, each].add(jax.vmap(_curvature)(x, Gamma)).reshape(n, n)
    coupling = QD[n:].reshape(-1, n)
    H = jnp.block([[H_links, coupling.T], [coupling, problem.Q[n:, n:]]])
    return jnp.concatenate([gradient.ravel(), of_A[n:]]), H


def _bend(
    problem: Problem, x: Float[Array, " columns"], velocity: Float[Array, " columns"]
) -> Float[Array, " columns"]:
    r"""Gradient $D^\top 2A^\top A\,\phi''(v, v)$ that a straight step in x meets because phi is curved in x.

    References:
        Transtrum and Sethna, "Geodesic acceleration and the small-curvature approximation", 2012.
    """
    columns = lambda x: _columns(problem, x)
    along = lambda x: jax.jvp(columns, (x,), (velocity,))[1]
    second = jax.jvp(along, (x,), (velocity,))[1]
    return jax.vjp(columns, x)[1](problem.Q @ second)[0]


def _columns(problem: Problem, x: Float[Array, " columns"]) -> Float[Array, " columns"]:
    """What A multiplies: phi of every link, then the extra unknowns."""
    n = 10 * problem.dof
    return jnp.concatenate([jax.vmap(_phi_and_inertia)(x[:n].reshape(-1, 10))[:, :10].ravel(), x[n:]])


def _of_inertia(of_six: Float[Array, "6"]) -> Float[Array, "3 3"]:
    """The matrix G with <G, I> = of_six . (Ixx, Ixy, Iyy, Ixz, Iyz, Izz), the kernels' order."""
    return 0.5 * (inertia.symmetric(of_six) + jnp.diag(jnp.diagonal(inertia.symmetric(of_six))))


def _step(problem: Problem, state: _State, multipliers: _Margins, weight: Float[Array, ""]) -> _State:
    """One damped Newton step, kept if it lowers the objective."""
    gradient, H = _quadratic_model(problem, state, multipliers, weight)
    H = H * problem.scale[:, None] * problem.scale
    held = ((state.x <= problem.lower) & (gradient > 0)) | ((state.x >= problem.upper) & (gradient < 0))
    damped = jnp.where(held[:, None] | held, 0, H) + jnp.diag(jnp.where(held, 1.0, state.damping))
    factor = jnp.linalg.cholesky(damped)
    solve = lambda g: -jax.scipy.linalg.cho_solve((factor, True), jnp.where(held, 0, g * problem.scale))
    step = solve(gradient)
    bend = 0.5 * solve(_bend(problem, state.x, step * problem.scale))
    most = _MOST_BEND * jnp.linalg.norm(step)
    step = step + bend * jnp.minimum(1.0, most / jnp.maximum(jnp.linalg.norm(bend), 1e-300))
    x = jnp.clip(state.x + step * problem.scale, problem.lower, problem.upper)
    taken = (x - state.x) / problem.scale
    expected = -((gradient * problem.scale) @ taken + 0.5 * taken @ (H @ taken))
    value, residual = _evaluate(problem, x, multipliers, weight)
    better = value < state.value  # false for what is not a number
    gain = (state.value - value) / jnp.where(expected > 0, expected, 1.0)
    factor = jnp.where(gain > 0.75, 0.125, jnp.where(gain < 0.25, 4.0, 1.0))
    damping = state.damping * jnp.where(better, factor, 8.0)
    pick = lambda new, old: jnp.where(better, new, old)
    return _State(
        x=pick(x, state.x),
        value=pick(value, state.value),
        residual=pick(residual, state.residual),
        damping=jnp.clip(damping, 1e-12, 1e6),
        accepted=state.accepted + better,
    )


def solve_chunk(
    problem: Problem,
    x0: Float[Array, "starts columns"],
    *,
    rounds: int = ROUNDS,
    iterations: int = ITERATIONS,
) -> Outcome:
    """Minimise from every point of `x0`; a pure function to be compiled, no start knows of another."""
    run = jax.vmap(lambda x0: _run_one(problem, x0, rounds, iterations))
    return Outcome(*run(x0))


def _run_one(problem: Problem, x0: Float[Array, " columns"], rounds: int, iterations: int):
    """One start: Newton steps in rounds, with the multipliers updated after each."""
    n = 10 * problem.dof
    of_I = jax.vmap(_phi_and_inertia)(x0[:n].reshape(-1, 10))[:, 10:]
    multipliers = jax.tree.map(jnp.zeros_like, _margins(problem, _links(problem, x0, of_I), of_I))

    fresh = jnp.asarray(_DAMPING, x0.dtype)

    def one_round(carry, weight):
        state, multipliers = carry
        value, residual = _evaluate(problem, state.x, multipliers, weight)
        state = eqx.tree_at(lambda s: (s.value, s.residual, s.damping), state, (value, residual, fresh))

        def body(state, _):
            state = _step(problem, state, multipliers, weight)
            return state, state.value

        state, values = jax.lax.scan(body, state, None, length=iterations)
        of_I = jax.vmap(_phi_and_inertia)(state.x[:n].reshape(-1, 10))[:, 10:]
        margins = _margins(problem, _links(problem, state.x, of_I), of_I)
        return (state, _hinges(margins, multipliers, weight)), values

    state = _State(x0, jnp.zeros(()), jnp.zeros_like(problem.b), fresh, jnp.zeros((), int))
    weights = _WEIGHT * 10.0 ** jnp.arange(rounds)
    (state, _), values = jax.lax.scan(one_round, (state, multipliers), weights)
    phi = jax.vmap(_phi_and_inertia)(state.x[:n].reshape(-1, 10))[:, :10]
    violation = largest_violation(problem.limits, phi)
    late = values[-1, iterations // 2] - values[-1, -1]
    settled = late <= 1e-3 * values[-1, -1] + 1e-12 * problem.b @ problem.b
    return phi, state.x[n:], violation, settled & (violation == 0), state.accepted
