r"""Least squares over links that could be built: nearly convex, and starts that leave when they are done.

**Coordinates.** A link's pseudo-inertia $J$ holds $m$, $mc$ and the second moment about a point, in which $\phi$
is linear; $J \succ 0$ is positive mass, positive inertia and the triangle inequality at once, and boxes on $m$,
$c$ ($m\,c_{lo} \le mc \le m\,c_{hi}$), the total mass and $\theta$ are linear. So there is no valley to crawl
along, and each start's distance from the optimum is known. Only boxes on inertias about the centre of mass are
not convex; they are wide, as a rule. The user's own constraints may be anything (`interior`'s augmented
Lagrangian, as for those boxes).

**Work.** A step (`interior`) costs one Cholesky factor of all unknowns and four triangular solves a start; the
links' 4x4 matrices are handled entry by entry, the starts contiguous (`small`). A start that is done leaves
(`turns`).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels import inertia
from jaxtyping import Array, Bool, Float, Int, Key

from ..errors import InputError
from ..parameters import triangle
from . import interior, small
from .bounds import Bounds
from .constraints import Constraint
from .interior import FIRST, MASS, PER_LINK, Problem
from .outcome import (
    TRIANGLE_INSET,
    Outcome,
    extra_box,
    extra_unit,
    inertia_inset,
    inertia_unit,
    largest_violation,
    limits_of,
)
from .turns import in_turns


class Sizes(NamedTuple):
    """How the starts are handed to a device."""

    chunk: int
    """So many at once."""
    lanes: tuple[int, ...]
    """How many of them take their steps together, and how many when no more than these are left (`turns`)."""


CPU, GPU, GPU_MANY = Sizes(256, (16,)), Sizes(262144, (8192,)), Sizes(524288, (65536, 8192, 1024))
"""A processor's cache holds 16 of the steps' matrices, not 128; and few lanes for many starts wait little for the
slowest. On a GPU 65536 take half the time for each that 8192 do, and twice as long to compile."""
_MANY = 2**20  # starts that are worth that


def sizes(platform: str, starts: int) -> Sizes:
    if platform == "cpu":
        return CPU
    return GPU if starts < _MANY else GPU_MANY


TOLERANCE = 1e-2
"""A start has converged where no more than this share of its objective is left to gain."""
PRECISE = 16
"""The first so many starts converge to `_PRECISION`: of what all of them find, the best is known well."""
_PRECISION = 1e-5

_BOX_INSET = 1e-9  # [kg], [m]: m c / m need not give c to the last bit
_LEAST_MASS = 1e-3  # [kg]: a link without mass is no body, and MuJoCo refuses it
_ROOM = 2  # for given starts: one program serves with them and without
_BATCH = 65536
_SAMPLES = 16  # random starts that say in what unit to measure a constraint
_INWARDS = 0.02  # how far random starts keep from their boxes, as a share of the way to the middle

_ROW, _COLUMN = np.tril_indices(3)


def scaled_problem(
    A: Float[np.ndarray, "rows columns"],
    b: Float[np.ndarray, " rows"],
    bounds: Bounds,
    extra_lower: Float[np.ndarray, " extra"] | None,
    extra_upper: Float[np.ndarray, " extra"] | None,
    constraints: tuple[Constraint, ...] = (),
    carried: Float[np.ndarray, "dof 10"] | None = None,
) -> Problem:
    """Check the input and scale it; only where `suits`."""
    dof = bounds.dof
    low, high = extra_box(A, b, bounds, extra_lower, extra_upper)
    mass, com = _inset(_masses(bounds, carried)), _inset(bounds.com)
    inertia_box = _beyond_the_triangle(bounds.inertia)
    unit = _units(A, b, bounds, inertia_box)
    centre = bounds.com.mean(-1)
    to_phi = _to_phi(unit, centre)
    of_extra = extra_unit(A[:, 10 * dof :], b, low, high)
    scaled = np.concatenate(
        [
            _of_entries(A, to_phi),
            A[:, 10 * dof :] * of_extra,
        ],
        1,
    )
    sigma = np.sqrt(np.mean(np.sum(scaled**2, 0))) or 1.0
    G, d = _linear(
        mass / unit[:, :1], (com - centre[..., None]) / unit[:, 1:, None], low / of_extra, high / of_extra
    )
    total = _total_mass(bounds, mass)
    if total is not None:
        for row, sign, bound in ((PER_LINK * dof, 1, total[0]), (PER_LINK * dof + 1, -1, -total[1])):
            if np.isfinite(bound):
                weight = unit[:, 0].sum()
                G[row, MASS : 10 * dof : 10] = sign * unit[:, 0] / weight
                d[row] = -bound / weight
    size = unit[:, 0] * unit[:, 1] ** 2
    missed_in = inertia_unit(bounds, A / sigma)
    A_scaled, b_scaled = (jnp.asarray(part) for part in _compressed(scaled / sigma, b / sigma))
    problem = Problem(
        A=A_scaled,
        b=b_scaled,
        Q=2 * A_scaled.T @ A_scaled,
        G=jnp.asarray(G),
        d=jnp.asarray(d),
        to_phi=jnp.asarray(to_phi),
        shift=jnp.asarray(TRIANGLE_INSET / (unit[:, 0] * unit[:, 1] ** 2)),
        carried=jnp.asarray(_carried(to_phi, carried)),
        unit=jnp.asarray(unit),
        centre=jnp.asarray(centre),
        extra_unit=jnp.asarray(of_extra),
        extra_box=jnp.asarray(np.stack([low, high], -1) / of_extra[:, None]),
        mass_box=jnp.asarray(mass / unit[:, :1]),
        com_box=jnp.asarray((com - centre[..., None]) / unit[:, 1:, None]),
        total_box=jnp.asarray(np.array([-np.inf, np.inf]) if total is None else total),
        limits=limits_of(bounds, constraints, carried),
        inertia_box=jnp.asarray(inertia_box / missed_in[:, None, None]),
        inset=jnp.asarray(inertia_inset(bounds) / missed_in[:, None])[..., None, None],
        inertia_unit=jnp.asarray(size / missed_in),
        user_unit=jnp.zeros(0),
        dof=dof,
        boxed=bool(np.any(np.isfinite(inertia_box))),
    )
    return (
        eqx.tree_at(lambda problem: problem.user_unit, problem, _user_unit(problem))
        if constraints
        else problem
    )


def _user_unit(problem: Problem) -> Float[Array, " user"]:
    """The longest gradient of each margin among a few random starts, or one where there is none.

    Less where the objective bends more along it: a heavier constraint, that its pressure is soon found.
    """
    slopes = jax.jit(jax.vmap(jax.jacrev(lambda u: interior.user_margins(problem, u))))
    J = slopes(starting_points(problem, _SAMPLES, 0))
    lengths = jnp.linalg.norm(J, axis=-1)
    along = J / jnp.where(lengths > 0, lengths, 1.0)[..., None]
    bends = jnp.sum(along * (along @ problem.Q), -1)
    units = jnp.max(lengths / jnp.sqrt(jnp.maximum(1.0, bends)), 0)
    return jnp.where((units > 0) & jnp.isfinite(units), units, 1.0)


def _compressed(
    A: Float[np.ndarray, "rows columns"], b: Float[np.ndarray, " rows"]
) -> tuple[Float[np.ndarray, "least columns"], Float[np.ndarray, " least"]]:
    """The same sum of squares in one equation more than there are unknowns: one program serves any number."""
    both, least = np.column_stack([A, b]), A.shape[1] + 1
    both = triangle(both) if len(both) > least else np.pad(both, ((0, least - len(both)), (0, 0)))
    return both[:, :-1], both[:, -1]


def _units(
    A: Float[np.ndarray, "rows columns"],
    b: Float[np.ndarray, " rows"],
    bounds: Bounds,
    inertia_box: Float[np.ndarray, "dof 6 2"],
) -> Float[np.ndarray, "dof 2"]:
    """Of mass [kg] and length [m], in which a link's pseudo-inertia is of order one.

    The middling mass; for a radius of gyration half the box of the centre of mass, half of what the inertia may
    be, or what least squares need, whichever is largest: the way to the optimum is long in small units.
    """
    middling = bounds.mass.mean(-1)
    upper = inertia_box[:, :3, 1]
    most = np.max(upper, -1, initial=0.0, where=np.isfinite(upper))
    radius = 0.5 * np.linalg.norm(bounds.com[..., 1] - bounds.com[..., 0], axis=-1) + 0.02
    unit = np.stack([middling, np.maximum(radius, 0.5 * np.sqrt(most / middling))], -1)
    columns = np.concatenate([_of_entries(A, _to_phi(unit, bounds.com.mean(-1))), A[:, 10 * bounds.dof :]], 1)
    entries = np.linalg.lstsq(columns, b, rcond=1e-6)[0][: 10 * bounds.dof].reshape(-1, 10)
    needed = np.max(np.abs(np.delete(entries, [*FIRST, MASS], 1)), -1)
    return unit * np.stack([np.ones_like(needed), np.sqrt(np.clip(needed, 1.0, 1e4))], -1)


def _of_entries(
    A: Float[np.ndarray, "rows columns"], to_phi: Float[np.ndarray, "dof 10 10"]
) -> Float[np.ndarray, "rows links"]:
    """The links' columns, for the entries of scaled pseudo-inertias in place of phi."""
    dof = len(to_phi)
    return np.einsum("rli,lij->rlj", A[:, : 10 * dof].reshape(-1, dof, 10), to_phi).reshape(len(A), -1)


def _carried(
    to_phi: Float[np.ndarray, "dof 10 10"], carried: Float[np.ndarray, "dof 10"] | None
) -> Float[np.ndarray, "dof 10"]:
    """Scaled entries of the bodies that links carry."""
    if carried is None:
        return np.zeros(to_phi.shape[:2])
    return np.linalg.solve(to_phi, carried[..., None])[..., 0]


def suits(
    bounds: Bounds, extra: Float[np.ndarray, "extra 2"], carried: Float[np.ndarray, "dof 10"] | None = None
) -> bool:
    """Whether every box has an inside."""
    mass = _masses(bounds, carried)
    boxes = [mass, bounds.com.reshape(-1, 2), extra]
    if any(np.any(box[:, 1] - box[:, 0] <= 1e3 * _BOX_INSET) for box in boxes):
        return False
    return bounds.total_mass is None or _total_mass(bounds, _inset(mass)) is not None


def _masses(bounds: Bounds, carried: Float[np.ndarray, "dof 10"] | None) -> Float[np.ndarray, "dof 2"]:
    least = _LEAST_MASS + (0.0 if carried is None else carried[:, 0])
    return np.stack(
        [np.minimum(np.maximum(bounds.mass[:, 0], least), bounds.mass[:, 1]), bounds.mass[:, 1]], -1
    )


def _inset(box: Float[np.ndarray, "*shape 2"]) -> Float[np.ndarray, "*shape 2"]:
    return box + _BOX_INSET * np.array([1.0, -1.0])


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
) -> tuple[Float[np.ndarray, "linear columns"], Float[np.ndarray, " linear"]]:
    """`Problem.G` and `d` for scaled boxes, but for the total mass; an absent row is 0 u + 1 > 0."""
    dof, extra = len(mass), len(low)
    columns, first = 10 * dof + extra, PER_LINK * dof + 2
    G, d = np.zeros((first + 2 * extra, columns)), np.ones(first + 2 * extra)

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
        add(row, m, 1, mass[link, 0])
        add(row + 1, m, -1, mass[link, 1])
        for k in range(3):
            h = 10 * link + FIRST[k]
            add(row + 2 + 2 * k, h, 1, com[link, k, 0], m)
            add(row + 3 + 2 * k, h, -1, com[link, k, 1], m)
    for k in range(extra):
        add(first + k, 10 * dof + k, 1, low[k])
        add(first + extra + k, 10 * dof + k, -1, high[k])
    return G, d


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
    return _drawn(origin_of(problem, seed, initial), first + jnp.arange(starts))


class Origin(eqx.Module):
    """Where starts come from."""

    problem: Problem
    given: Float[Array, "room columns"]
    """Points to start from in place of random ones."""
    count: Int[Array, ""]
    """How many of them there are."""
    seed: Int[Array, ""]


def origin_of(problem: Problem, seed: int, initial: Float[np.ndarray, "given dof 10"] | None) -> Origin:
    given, count = jnp.zeros((_ROOM, len(problem.Q))), 0
    if initial is not None:
        if initial.shape[1:] != (problem.dof, 10):
            raise InputError(
                f"initial parameters: expected shape (n, {problem.dof}, 10), got {initial.shape}"
            )
        count = len(initial)
        points = np.concatenate([initial, np.tile(initial[:1], (max(0, _ROOM - count), 1, 1))])
        given = _given_starts(problem, jnp.asarray(points))
    return Origin(problem, given, jnp.asarray(count), jnp.asarray(seed))


def start(origin: Origin, number: Int[Array, ""]) -> Float[Array, " columns"]:
    """A given point where there is one of this number, else a random one."""
    given = origin.given[jnp.clip(number, 0, len(origin.given) - 1)]
    x0 = _random_start(origin.problem, jax.random.fold_in(jax.random.key(origin.seed), number))
    return jnp.where(number < origin.count, given, x0)


_drawn = jax.jit(jax.vmap(start, in_axes=(None, 0)))


def solve_starts(
    origin: Origin, numbers: Int[Array, " chunk"], iterations: int, lanes: tuple[int, ...]
) -> Outcome:
    x0 = jax.vmap(lambda number: start(origin, number))(numbers)
    share = jnp.where(numbers < PRECISE, _PRECISION, TOLERANCE)
    return solve_chunk(
        origin.problem, x0, iterations=iterations, tolerance=share, lanes=lanes, idle=numbers < 0
    )


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
    return _interior(problem, mass, com, Sigma, _INWARDS, drawn[-1])


def _given_start(problem: Problem, phi: Float[Array, "dof 10"]) -> Float[Array, " columns"]:
    """The real body inside the boxes that is near to a given one."""
    mass, com, _ = jax.vmap(inertia.to_com)(phi)
    own = phi - jnp.einsum("lpq,lq->lp", problem.to_phi, problem.carried)
    own = jnp.where(own[:, :1] > 0, own, phi)
    I_com = jax.vmap(inertia.to_com)(own)[2]
    values, vectors = jnp.linalg.eigh(jax.vmap(inertia.second_moment)(I_com))
    Sigma = (vectors * jnp.maximum(values, 0.0)[:, None]) @ jnp.swapaxes(vectors, 1, 2)
    unit, length = problem.unit[:, 0], problem.unit[:, 1:]
    mass = jnp.clip(mass / unit, *problem.mass_box.T)
    com = jnp.clip((com - problem.centre) / length, problem.com_box[..., 0], problem.com_box[..., 1])
    return _interior(problem, mass, com, Sigma / (unit * problem.unit[:, 1] ** 2)[:, None, None], 0.005, None)


_given_starts = jax.jit(jax.vmap(_given_start, in_axes=(None, 0)))


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
    m, h = m - problem.carried[:, MASS, None, None], mass[:, None] * com - problem.carried[:, np.array(FIRST)]
    S = jnp.concatenate([Sigma + h[:, :, None] * h[:, None] / m, h[:, :, None]], 2)
    S = jnp.concatenate([S, jnp.concatenate([h[:, None], m], 2)], 1)
    low, high = problem.extra_box.T
    width = jnp.where(jnp.isfinite(high - low), high - low, 1.0)
    extra = jnp.clip(0.0, low + 0.5 * share * width, high - 0.5 * share * width)
    u = jnp.stack([S[:, i, k] for i, k in small.PAIRS], 1) + problem.carried
    return jnp.concatenate([u.ravel(), extra])


def solve_chunk(
    problem: Problem,
    x0: Float[Array, "starts columns"],
    *,
    iterations: int,
    tolerance: float | Float[Array, " starts"] = TOLERANCE,
    lanes: tuple[int, ...] = CPU.lanes,
    idle: Bool[Array, " starts"] | None = None,
) -> Outcome:
    """Minimise from every point of `x0`; a pure function to be compiled, no start knows of another.

    `lanes` of them take steps at a time; `idle` ones stay where they are.
    """
    state = interior.initialise(problem, x0.T, jnp.broadcast_to(jnp.asarray(tolerance, float), len(x0)))
    if idle is not None:
        state = eqx.tree_at(lambda state: state.done, state, idle)
    take = lambda state: interior.step(problem, state, iterations)
    state = in_turns(take, state, iterations, lanes)
    return outcome(problem, state.u, state.done, state.accepted)


def outcome(
    problem: Problem,
    u: Float[Array, "columns starts"],
    done: Bool[Array, " starts"],
    iterations: Int[Array, " starts"],
) -> Outcome:
    """In SI units, with what is violated."""
    n = 10 * problem.dof
    phi = jnp.einsum("lpq,lqb->blp", problem.to_phi, u[:n].reshape(problem.dof, 10, -1))
    # in batches, as cuSOLVER takes so many matrices at once and no more
    violation = jax.lax.map(lambda phi: largest_violation(problem.limits, phi), phi, batch_size=_BATCH)
    extra = (u[n:] * problem.extra_unit[:, None]).T
    return Outcome(phi, extra, violation, done & (violation == 0), iterations)
