r"""Many-start least squares over physically feasible links.

$$\min_{x}\ \lVert A\,(\phi, \theta) - b\rVert^2 \quad\text{over links that could be built}$$

**Coordinates.** A link's pseudo-inertia $J$ holds $m$, $mc$ and the second moment about a point, in which $\phi$
is linear; $J \succ 0$ is positive mass, positive inertia and the triangle inequality at once, and boxes on $m$,
$c$ ($m\,c_{lo} \le mc \le m\,c_{hi}$), the total mass and $\theta$ are linear. So the problem is convex but
for what the user adds: no valley to crawl along, and each start's distance from the optimum is known.

**Method.** `interior`: every start follows a path of its own inside the constraints, which therefore hold exactly
at its end. Boxes on inertias about the centre of mass and the user's constraints, convex or not, enter as squared
hinges with multipliers (augmented Lagrangian), aimed a little inside so that what is left is exactly no
violation.

**Work.** A step costs one Cholesky factor of all unknowns and four triangular solves a start; the links' 4x4
matrices are handled entry by entry, the starts contiguous (`small`). A start that is done leaves (`solve_chunk`).
"""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels import inertia
from jaxtyping import Array, Bool, Float, Int, Key

from ..errors import InputError, require_x64
from . import interior, schedule, small
from .bounds import Bounds
from .checkpoint import Checkpoint, identity
from .constraints import Constraint, Links, total_mass, triangle_inequality
from .interior import FIRST, MASS, PER_LINK, XYZ_COLUMN, XYZ_ROW, Problem

STARTS = 2048
"""Default number of random starts."""
CHUNK = {"cpu": 512, "gpu": 32768}
"""Starts handed to a device at once, by its platform."""
_BLOCK = 4096  # starts whose objective is evaluated at once
ITERATIONS = 80
"""Steps of a start at most."""
TOLERANCE = 3e-3
"""A start has converged where no more than this share of its objective is left to gain."""
PRECISE = 16
"""The first so many starts converge to `_PRECISION`: of what all of them find, the best is known well."""
_PRECISION = 1e-5

_TRIANGLE_INSET = 1e-8  # [kg m²]
_BOX_INSET = 1e-9  # [kg], [m]: m c / m need not give c to the last bit
_LEAST_MASS = 1e-3  # [kg]: a link without mass is no body, and MuJoCo refuses it
_SEGMENT, _LEAST_LANES = 3, 128

_ROW = np.array([0, 1, 1, 2, 2, 2])
_COLUMN = np.array([0, 0, 1, 0, 1, 2])


@dataclasses.dataclass(frozen=True)
class Solutions:
    """What every start came to."""

    phi: Float[np.ndarray, "starts dof 10"]
    """Inertial parameters, order and units as in `jaxpanda_kernels.inertia`."""
    extra: Float[np.ndarray, "starts extra"]
    """The unknowns beside the links, such as friction."""
    objective: Float[np.ndarray, " starts"]
    r"""$\lVert A x - b\rVert^2$ at the end."""
    violation: Float[np.ndarray, " starts"]
    """Largest amount by which a bound or constraint is missed, recomputed from `phi`; 0 where none is."""
    converged: Bool[np.ndarray, " starts"]
    """Feasible, and within the tolerance of the optimum (of a local one, where a constraint is not convex), as
    the step that aims at the optimum estimates it."""
    iterations: Int[np.ndarray, " starts"]
    """Steps that lowered the objective."""
    compile_seconds: float
    run_seconds: float

    @property
    def best(self) -> int:
        """The feasible start with the lowest objective; the least infeasible one where none is feasible."""
        if not np.any(self.violation == 0):
            return int(np.argmin(self.violation))
        return int(np.argmin(np.where(self.violation == 0, self.objective, np.inf)))


def solve(
    A: Float[np.ndarray, "rows columns"],
    b: Float[np.ndarray, " rows"],
    bounds: Bounds,
    *,
    constraints: Sequence[Constraint] = (),
    extra_lower: Float[np.ndarray, " extra"] | None = None,
    extra_upper: Float[np.ndarray, " extra"] | None = None,
    initial: Float[np.ndarray, "given dof 10"] | None = None,
    starts: int = STARTS,
    seed: int = 0,
    chunk: int | None = None,
    iterations: int = ITERATIONS,
    tolerance: float = TOLERANCE,
    devices: Sequence[schedule.Device] | None = None,
    checkpoint: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Solutions:
    """Minimise the sum of squares from many random starts at once.

    Args:
        A: one row an equation; columns are the ten parameters of each link in turn, then the extra unknowns.
        b: right-hand side.
        bounds: boxes, from which the random starts are drawn as well.
        constraints: further ones, as functions of `Links`.
        extra_lower: lower bounds of the extra unknowns; unbounded where None.
        extra_upper: upper bounds of the extra unknowns; unbounded where None.
        initial: parameters to start from in place of as many random starts; moved into the boxes.
        starts: number of starts.
        seed: same seed, same answer, whatever the chunk.
        chunk: how many starts are handed to a device at once, which bounds the memory; `CHUNK` when None.
        iterations: steps of a start at most.
        tolerance: a start has converged when no more than this share of its objective is left to gain (the first
            `PRECISE` go on to a hundred-thousandth). Where the optimum is not unique, each ends as near to
            where it began as this permits.
        devices: over which the starts are spread; see `schedule.run`.
        checkpoint: file that keeps the starts as they finish. Where it holds starts of this same problem from a
            run that was interrupted, they are not solved again, and the answer has the same bits. The caller
            removes it.
        progress: called with (starts done, starts) after every chunk.

    Raises:
        InputError: shapes do not fit each other, a number is not finite, or the checkpoint is of another problem.
    """
    require_x64("feasible.solve")
    problem = scaled_problem(A, b, bounds, tuple(constraints), extra_lower, extra_upper)
    if starts < 1:
        raise InputError(f"starts: {starts} is too few; at least 1")
    steps = (iterations, tolerance)
    if chunk is None:
        platform = (jax.local_devices() if devices is None else devices)[0].platform
        chunk = CHUNK.get(platform, CHUNK["gpu"])
    kept = None
    if checkpoint is not None:
        further = (extra_lower, extra_upper, initial)
        kept = Checkpoint(checkpoint, identity(A, b, bounds, constraints, further, seed, steps))
    found, compile_seconds, run_seconds = schedule.run(
        _solve_starts,
        _origin(problem, seed, initial),
        steps,
        starts=starts,
        chunk=chunk,
        devices=devices,
        checkpoint=kept,
        progress=progress,
    )
    return Solutions(
        phi=found.phi,
        extra=found.extra,
        objective=_objectives(A, b, found.phi, found.extra),
        violation=found.violation,
        converged=found.converged,
        iterations=found.iterations,
        compile_seconds=compile_seconds,
        run_seconds=run_seconds,
    )


def _objectives(
    A: Float[np.ndarray, "rows columns"],
    b: Float[np.ndarray, " rows"],
    phi: Float[np.ndarray, "starts dof 10"],
    extra: Float[np.ndarray, "starts extra"],
) -> Float[np.ndarray, " starts"]:
    """In blocks, which bounds the memory; always the same ones, for the same bits."""
    objective = np.empty(len(phi))
    for first in range(0, len(phi), _BLOCK):
        block = slice(first, first + _BLOCK)
        x = np.concatenate([phi[block].reshape(len(phi[block]), -1), extra[block]], -1)
        objective[block] = np.sum((x @ A.T - b) ** 2, -1)
    return objective


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
    extra = A.shape[1] - 10 * dof
    if extra < 0:
        raise InputError(
            f"A has {A.shape[1]} columns, fewer than the ten of each of {dof} links in the bounds"
        )
    if not (np.all(np.isfinite(A)) and np.all(np.isfinite(b))):
        raise InputError("A or b holds a number that is not finite")
    low = np.full(extra, -np.inf) if extra_lower is None else np.asarray(extra_lower, float)
    high = np.full(extra, np.inf) if extra_upper is None else np.asarray(extra_upper, float)
    if low.shape != (extra,) or high.shape != (extra,):
        raise InputError(f"bounds of the extra unknowns: expected {extra}, got {low.size} and {high.size}")
    mass = _inset(
        np.stack(
            [np.minimum(np.maximum(bounds.mass[:, 0], _LEAST_MASS), bounds.mass[:, 1]), bounds.mass[:, 1]], -1
        )
    )
    com = _inset(bounds.com)
    # Units of a link: its middling mass, and half its box for a radius of gyration.
    radius = 0.5 * np.linalg.norm(bounds.com[..., 1] - bounds.com[..., 0], axis=-1) + 0.02
    unit = np.stack([bounds.mass.mean(-1), radius], -1)
    centre = bounds.com.mean(-1)
    to_phi = _to_phi(unit, centre)
    norms = np.linalg.norm(A[:, 10 * dof :], axis=0)
    of_extra = np.where(norms > 0, np.linalg.norm(b) / np.where(norms > 0, norms, 1), 0)
    of_extra = np.minimum(of_extra, np.where(high > low, high - low, np.inf))
    of_extra = np.where(of_extra > 0, of_extra, 1.0)
    scaled = np.concatenate(
        [
            np.einsum("rli,lij->rlj", A[:, : 10 * dof].reshape(-1, dof, 10), to_phi).reshape(len(A), -1),
            A[:, 10 * dof :] * of_extra,
        ],
        1,
    )
    sigma = np.sqrt(np.mean(np.sum(scaled**2, 0))) or 1.0
    G, d, free = _linear(
        mass / unit[:, :1], (com - centre[..., None]) / unit[:, 1:, None], low / of_extra, high / of_extra
    )
    total = _total_mass(bounds, mass)
    if total is not None:
        for row, sign, bound in ((PER_LINK * dof, 1, total[0]), (PER_LINK * dof + 1, -1, -total[1])):
            if np.isfinite(bound):
                weight = unit[:, 0].sum()
                G[row, MASS : 10 * dof : 10] = sign * unit[:, 0] / weight
                d[row] = -bound / weight
    elif bounds.total_mass is not None:
        constraints = (*constraints, total_mass(*bounds.total_mass))
    A_scaled, b_scaled = jnp.asarray(scaled / sigma), jnp.asarray(b / sigma)
    return Problem(
        A=A_scaled,
        b=b_scaled,
        Q=2 * A_scaled.T @ A_scaled,
        G=jnp.asarray(G),
        d=jnp.asarray(d),
        free=jnp.asarray(free),
        to_phi=jnp.asarray(to_phi),
        shift=jnp.asarray(_TRIANGLE_INSET / (unit[:, 0] * unit[:, 1] ** 2)),
        unit=jnp.asarray(unit),
        centre=jnp.asarray(centre),
        extra_unit=jnp.asarray(of_extra),
        extra_box=jnp.asarray(np.stack([low, high], -1) / of_extra[:, None]),
        mass_box=jnp.asarray(mass / unit[:, :1]),
        com_box=jnp.asarray((com - centre[..., None]) / unit[:, 1:, None]),
        total_box=jnp.asarray(np.array([-np.inf, np.inf]) if total is None else total),
        mass=jnp.asarray(bounds.mass),
        com=jnp.asarray(bounds.com),
        inertia=jnp.asarray(bounds.inertia),
        total_mass=jnp.asarray([-np.inf, np.inf] if bounds.total_mass is None else bounds.total_mass),
        constraints=constraints,
        dof=dof,
        boxed=bool(np.any(np.isfinite(_beyond_the_triangle(bounds.inertia)))),
    )


def _inset(box: Float[np.ndarray, "*shape 2"]) -> Float[np.ndarray, "*shape 2"]:
    """The box moved inwards; one that is a point, or nearly, becomes a point."""
    width = box[..., 1] - box[..., 0]
    middle = box.mean(-1)
    low = np.where(width > 10 * _BOX_INSET, box[..., 0] + _BOX_INSET, middle)
    high = np.where(width > 10 * _BOX_INSET, box[..., 1] - _BOX_INSET, middle)
    return np.stack([low, high], -1)


def _beyond_the_triangle(box: Float[np.ndarray, "dof 6 2"]) -> Float[np.ndarray, "dof 6 2"]:
    r"""Bounds of xx, yy, zz, xy, xz, yz without those that a real body meets anyway.

    $I_{xx} \ge 0$, and $\lvert I_{xy}\rvert \le \tfrac12 I_{zz}$.
    """
    box = box.copy()
    diagonal, product = box[:, :3], box[:, 3:]
    diagonal[..., 0] = np.where(diagonal[..., 0] <= 0, -np.inf, diagonal[..., 0])
    most = 0.5 * diagonal[:, ::-1, 1]  # of zz, yy, xx
    product[..., 0] = np.where(product[..., 0] <= -most, -np.inf, product[..., 0])
    product[..., 1] = np.where(product[..., 1] >= most, np.inf, product[..., 1])
    return box


def _to_phi(
    unit: Float[np.ndarray, "dof 2"], centre: Float[np.ndarray, "dof 3"]
) -> Float[np.ndarray, "dof 10 10"]:
    """From the ten entries of a link's scaled pseudo-inertia about `centre` to phi."""
    found = np.zeros((len(unit), 10, 10))
    for l, ((mass, length), c) in enumerate(zip(unit, centre, strict=True)):
        X = np.eye(4)
        X[:3, 3] = c
        X = X @ np.diag([length, length, length, 1.0])
        for q, (i, k) in enumerate(small.PAIRS):
            E = np.zeros((4, 4))
            E[i, k] = E[k, i] = 1.0
            found[l, :, q] = mass * _phi(X @ E @ X.T)  # not its root twice: a fixed mass keeps its last bit
    return found


def _phi(J: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "10"]:
    I = np.trace(J[:3, :3]) * np.eye(3) - J[:3, :3]
    return np.concatenate([J[3:, 3], J[:3, 3], I[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]])


def _linear(
    mass: Float[np.ndarray, "dof 2"],
    com: Float[np.ndarray, "dof 3 2"],
    low: Float[np.ndarray, " extra"],
    high: Float[np.ndarray, " extra"],
) -> tuple[Float[np.ndarray, "linear columns"], Float[np.ndarray, " linear"], Float[np.ndarray, " columns"]]:
    """`Problem.G`, `d` and `free` for scaled boxes, but for the total mass; an absent row is 0 u + 1 > 0."""
    dof, extra = len(mass), len(low)
    columns, first = 10 * dof + extra, PER_LINK * dof + 2
    G, d, free = np.zeros((first + 2 * extra, columns)), np.ones(first + 2 * extra), np.ones(columns)

    def add(row: int, column: int, sign: int, bound: float, of_mass: int | None = None) -> None:
        """sign (u[column] - bound) > 0, or with the bound times a link's mass."""
        if np.isfinite(bound):
            G[row, column], d[row] = sign, 0.0
            if of_mass is None:
                d[row] = -sign * bound
            else:
                G[row, of_mass] = -sign * bound

    for link in range(dof):
        m, row = 10 * link + MASS, PER_LINK * link
        free[m] = mass[link, 0] < mass[link, 1]
        if free[m]:
            add(row, m, 1, mass[link, 0])
            add(row + 1, m, -1, mass[link, 1])
        for k in range(3):
            h = 10 * link + FIRST[k]
            free[h] = com[link, k, 0] < com[link, k, 1]
            if free[h]:
                add(row + 2 + 2 * k, h, 1, com[link, k, 0], m)
                add(row + 3 + 2 * k, h, -1, com[link, k, 1], m)
    for k in range(extra):
        free[10 * dof + k] = low[k] < high[k]
        if free[10 * dof + k]:
            add(first + k, 10 * dof + k, 1, low[k])
            add(first + extra + k, 10 * dof + k, -1, high[k])
    return G, d, free


def _total_mass(bounds: Bounds, mass: Float[np.ndarray, "dof 2"]) -> Float[np.ndarray, " 2"] | None:
    """The box of the total mass; an end is infinite where the links' own boxes imply it.

    None where nothing lies inside.
    """
    if bounds.total_mass is None:
        return None
    least, most = mass.sum(0)
    low, high = bounds.total_mass + np.array([_BOX_INSET, -_BOX_INSET])
    if min(high, most) - max(low, least) < 1e-6 * most:
        return None
    return np.array([low if low > least else -np.inf, high if high < most else np.inf])


def starting_points(
    problem: Problem,
    starts: int,
    seed: int,
    *,
    first: int = 0,
    initial: Float[np.ndarray, "given dof 10"] | None = None,
) -> Float[Array, "starts columns"]:
    """Starts number `first`, `first` + 1, ...: random bodies, the given ones in place of the first.

    A start depends on its number and the seed alone.
    """
    drawn = jax.jit(jax.vmap(_start, in_axes=(None, 0)))
    return drawn(_origin(problem, seed, initial), first + jnp.arange(starts))


class _Origin(eqx.Module):
    """Where starts come from."""

    problem: Problem
    given: Float[Array, "given columns"]
    """Points to start from in place of random ones."""
    seed: Int[Array, ""]


def _origin(problem: Problem, seed: int, initial: Float[np.ndarray, "given dof 10"] | None) -> _Origin:
    given = jnp.zeros((0, len(problem.free)))
    if initial is not None:
        if initial.shape[1:] != (problem.dof, 10):
            raise InputError(
                f"initial parameters: expected shape (n, {problem.dof}, 10), got {initial.shape}"
            )
        given = jax.jit(jax.vmap(_given_start, in_axes=(None, 0)))(problem, jnp.asarray(initial))
    return _Origin(problem, given, jnp.asarray(seed))


def _start(origin: _Origin, number: Int[Array, ""]) -> Float[Array, " columns"]:
    """A given point where there is one of this number, else a random one."""
    given = origin.given
    x0 = _random_start(origin.problem, jax.random.fold_in(jax.random.key(origin.seed), number))
    return (
        jnp.where(number < len(given), given[jnp.minimum(number, len(given) - 1)], x0) if len(given) else x0
    )


def _solve_starts(
    origin: _Origin, numbers: Int[Array, " chunk"], iterations: int, tolerance: float
) -> "Outcome":
    x0 = jax.vmap(lambda number: _start(origin, number))(numbers)
    share = jnp.where(numbers < PRECISE, jnp.minimum(tolerance, _PRECISION), tolerance)
    return solve_chunk(origin.problem, x0, iterations=iterations, tolerance=share)


def _random_start(problem: Problem, key: Key[Array, ""]) -> Float[Array, " columns"]:
    r"""Mass and centre of mass uniform in their boxes, the total mass in its own; Sigma Wishart, of the size that
    suits the mass."""
    dof = problem.dof
    drawn = jax.random.uniform(
        key, (10 * dof + 1,), minval=jnp.finfo(float).tiny
    )  # one draw: quick to compile
    between = lambda box, share: box[..., 0] + (box[..., 1] - box[..., 0]) * share
    mass = between(problem.mass_box, drawn[:dof])
    com = between(problem.com_box, drawn[dof : 4 * dof].reshape(dof, 3))
    normal = jax.scipy.special.ndtri(drawn[4 * dof : 10 * dof]).reshape(dof, 6)
    L = jnp.zeros((dof, 3, 3)).at[:, _ROW, _COLUMN].set(0.5 * normal)
    Sigma = mass[:, None, None] * (L @ jnp.swapaxes(L, 1, 2))
    return _interior(problem, mass, com, Sigma, 0.1, drawn[-1])


def _given_start(problem: Problem, phi: Float[Array, "dof 10"]) -> Float[Array, " columns"]:
    """The real body inside the boxes that is near to a given one."""
    mass, com, I_com = jax.vmap(inertia.to_com)(phi)
    values, vectors = jnp.linalg.eigh(jax.vmap(inertia.second_moment)(I_com))
    Sigma = (vectors * jnp.maximum(values, 0.0)[:, None]) @ jnp.swapaxes(vectors, 1, 2)
    unit, length = problem.unit[:, 0], problem.unit[:, 1:]
    mass = jnp.clip(mass / unit, *problem.mass_box.T)
    com = jnp.clip((com - problem.centre) / length, problem.com_box[..., 0], problem.com_box[..., 1])
    return _interior(problem, mass, com, Sigma / (unit * problem.unit[:, 1] ** 2)[:, None, None], 0.005, None)


def _interior(
    problem: Problem,
    mass: Float[Array, " dof"],
    com: Float[Array, "dof 3"],
    Sigma: Float[Array, "dof 3 3"],
    share: float,
    of_total: Float[Array, ""] | None,
) -> Float[Array, " columns"]:
    """Coordinates of scaled bodies, moved into the boxes by a share of the way to their middles.

    `of_total`: where in its box to bring the total mass, 0 to 1; None only moves it inside.
    """
    towards = lambda x, box: x + share * (box.mean(-1) - x)
    mass, com = towards(mass, problem.mass_box), towards(com, problem.com_box)
    unit = problem.unit[:, 0]
    least, most = problem.mass_box.T + share * (problem.mass_box.mean(-1) - problem.mass_box.T)
    total, ends = mass @ unit, jnp.stack([least @ unit, most @ unit])
    low, high = jnp.maximum(problem.total_box[0], ends[0]), jnp.minimum(problem.total_box[1], ends[1])
    inside = jnp.stack([low, high]) + share * 0.5 * (high - low) * jnp.array([1.0, -1.0])
    wanted = jnp.clip(total, *inside)
    if of_total is not None:
        bounded = jnp.isfinite(problem.total_box).any()
        wanted = jnp.where(bounded, inside[0] + of_total * (inside[1] - inside[0]), wanted)
    up = wanted > total
    end = jnp.where(up, most, least)
    way = (wanted - total) / jnp.where(end @ unit == total, 1.0, end @ unit - total)
    mass = mass + way * (end - mass)
    m = mass[:, None, None]
    Sigma = Sigma + (2 * share * m + problem.shift[:, None, None]) * jnp.eye(3)
    S = jnp.concatenate([Sigma + m * com[:, :, None] * com[:, None], m * com[:, :, None]], 2)
    S = jnp.concatenate([S, jnp.concatenate([m * com[:, None], m], 2)], 1)
    low, high = problem.extra_box.T
    width = jnp.where(jnp.isfinite(high - low), high - low, 1.0)
    extra = jnp.clip(0.0, low + 0.5 * share * width, high - 0.5 * share * width)
    u = jnp.stack([S[:, i, k] for i, k in small.PAIRS], 1)
    return jnp.concatenate([u.ravel(), extra])


def largest_violation(problem: Problem, phi: Float[Array, "dof 10"]) -> Float[Array, ""]:
    """The largest amount by which anything is missed; from `phi` alone, as any other program would see it."""
    links = Links.from_phi(phi)
    of_I = links.I_com[:, XYZ_ROW, XYZ_COLUMN]
    total = jnp.sum(links.mass)
    boxes = (
        (links.mass, problem.mass),
        (links.com, problem.com),
        (of_I, problem.inertia),
        (total, problem.total_mass),
    )
    margins = [margin for value, box in boxes for margin in (value - box[..., 0], box[..., 1] - value)]
    margins += [constraint(links) for constraint in problem.constraints]
    margins += [triangle_inequality(links)]
    least = jnp.min(jnp.stack([jnp.min(margin, initial=jnp.inf) for margin in margins]))
    return jnp.where(jnp.isfinite(phi).all(), jnp.maximum(0.0, -least), jnp.inf)


class Outcome(eqx.Module):
    """What the starts of a chunk came to."""

    phi: Float[Array, "starts dof 10"]
    extra: Float[Array, "starts extra"]
    violation: Float[Array, " starts"]
    converged: Bool[Array, " starts"]
    iterations: Int[Array, " starts"]


def solve_chunk(
    problem: Problem,
    x0: Float[Array, "starts columns"],
    *,
    iterations: int = ITERATIONS,
    tolerance: float | Float[Array, " starts"] = TOLERANCE,
    lanes: int | None = None,
) -> Outcome:
    """Minimise from every point of `x0`; a pure function to be compiled, no start knows of another.

    `lanes` of them (a quarter when None) take a few steps at a time, those that have taken the fewest first:
    what is done costs nothing more, and no start waits for the slowest.
    """
    lanes = max(_LEAST_LANES, len(x0) // 4) if lanes is None else lanes
    lanes, n = min(lanes, len(x0)), 10 * problem.dof
    left = lambda state: ~state.done & (state.steps < iterations)

    def go_on(state: interior.State) -> interior.State:
        chosen = jnp.argsort(jnp.where(left(state), state.steps, iterations + 1))[:lanes]
        part = jax.tree.map(lambda leaf: leaf[..., chosen], state)
        part = jax.lax.fori_loop(0, _SEGMENT, lambda _, part: interior.step(problem, part, iterations), part)
        return jax.tree.map(lambda whole, new: whole.at[..., chosen].set(new), state, part)

    state = interior.initialise(problem, x0.T, jnp.broadcast_to(jnp.asarray(tolerance, float), len(x0)))
    state = jax.lax.while_loop(lambda state: jnp.any(left(state)), go_on, state)
    phi = jnp.einsum("lpq,lqb->blp", problem.to_phi, state.u[:n].reshape(problem.dof, 10, -1))
    violation = jax.vmap(lambda phi: largest_violation(problem, phi))(phi)
    extra = (state.u[n:] * problem.extra_unit[:, None]).T
    return Outcome(phi, extra, violation, state.done & (violation == 0), state.accepted)
