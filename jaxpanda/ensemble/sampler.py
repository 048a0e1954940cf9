r"""Draws of links and friction from a posterior, by hit-and-run with many chains at once.

$$p(\phi, f) \propto \exp\bigl(-\tfrac12 \lVert G(\phi, f) - \mu\rVert^2_{C^{-1}}\bigr)\,
   1[\text{every link can be built, all within bounds}]$$

In coordinates $y = (r, z)$ the told part is $r \sim N(0, 1)$ and nothing tells of z, so that p is flat in it. A
move takes a random line through where a chain stands, and draws the next point from p on that line: a Gaussian,
or a uniform, cut to the line's feasible part. Bounds that are linear cut it at once; the others (pseudo-inertias,
bounds on inertias about the centre of mass, a user's constraints) by shrinking: a draw that is not feasible ends
the line there, on its side, and the draw is made again. A sweep has four kinds of move:

- two neighbouring links, along what nothing tells: mass, first moment and inertia about their common joint's axis
  that one may have instead of the other. A line that moves two links is cut by the constraints of two;
- two neighbouring links, along anything, by the Gaussian on that line;
- everything, along what nothing tells; what is told, in one direction, z following; or what is beside the links;
- everything that is told at once, on an ellipse $r\cos\theta + \nu\sin\theta$ with $\nu \sim N(0, 1)$, z
  following as it does in the draws so far. How it does is learnt in rounds that are thrown away; then it stays.

Arrays have the chains as their last, contiguous axis: the small algebra of many links is written out entry by
entry.

References:
    Smith, "Efficient Monte Carlo procedures for generating points uniformly distributed over bounded regions",
    Operations Research 1984 (hit-and-run); Neal, "Slice sampling", Annals of Statistics 2003 (shrinkage);
    Murray, Adams, MacKay, "Elliptical slice sampling", AISTATS 2010; Vehtari et al., "Rank-normalization,
    folding, and localization: an improved R-hat", Bayesian Analysis 2021.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..errors import InputError
from ..feasible import Constraint, Links
from ..feasible.small import is_positive
from ..posterior import Posterior

_RANK = 1e-10
"""Singular values of what is told that count, as a share of the largest, link parameters by their size."""
_INSIDE = (0.0, 0.02, 0.1, 0.3, 0.6, 0.9)
"""Shares of the way towards the middle of all starts by which one on the boundary is moved inside."""
CHAINS, SWEEPS = 256, 400
"""Of chains side by side, and of sweeps that count of each."""
_LEARNING = 2
"""Rounds in which the spread of the draws is learnt, together half as long as the one that counts."""
_LINES = 3
"""Times in a sweep that lines of all links are taken: one of what is told, two of what is not, one beside."""
_TRIES = 10
"""Draws on one line; after as many a chain stays where it is, which leaves the distribution as it is too."""


@dataclasses.dataclass(frozen=True)
class Draws:
    """Points of the posterior."""

    standard: Float[np.ndarray, "draws dof 10"]
    extra: Float[np.ndarray, "draws extra"]
    chains: int
    sweeps: int
    """Of each chain that counted."""
    rhat: float
    """Largest split R-hat over all parameters, their ranks normalised; 1 where chains agree."""
    effective: float
    """Least effective number of independent draws over all parameters."""


class Region(eqx.Module):
    """What is feasible, the coordinates of the draws, and the lines of neighbouring links."""

    Q: Float[Array, "unknowns unknowns"]
    """point = origin + Q (r, z)."""
    origin: Float[Array, " unknowns"]
    rows: Float[Array, "linear unknowns"]
    """Feasible points have rows @ point >= limits."""
    limits: Float[Array, " linear"]
    carried: Float[Array, "dof 10"]
    has_carried: Bool[Array, " dof"]
    low: Float[Array, "dof 6"]
    """Bounds of xx, xy, yy, xz, yz, zz about the centre of mass."""
    high: Float[Array, "dof 6"]
    pairs: tuple[Float[Array, "pairs wide _lines"], ...]
    """For each kind of line, the parameters of two neighbours that its random numbers move."""
    felt: tuple[Float[Array, "pairs told _lines"], ...]
    """The same in r."""
    beside: Float[Array, "unknowns extra"]
    """Lines of the unknowns beside the links."""
    beside_felt: Float[Array, "told extra"]
    told: int = eqx.field(static=True)
    constraints: tuple[Constraint, ...] = eqx.field(static=True)

    def is_feasible(self, point: Float[Array, "unknowns lanes"]) -> Bool[Array, " lanes"]:
        """What is not linear: whether links can be built, and their inertias lie in their boxes."""
        dof = len(self.carried)
        phi = point[: 10 * dof].reshape(dof, 10, -1)
        return self._are_feasible(phi, 0) & self._is_wanted(phi)

    def _are_feasible(self, phi: Float[Array, "some 10 lanes"], first: Any) -> Bool[Array, " lanes"]:
        """Of some neighbouring links."""
        some = phi.shape[0]
        part = lambda values: jax.lax.dynamic_slice_in_dim(values, first, some)
        good = _are_bodies(phi)
        own = _are_bodies(phi - part(self.carried)[:, :, None])
        good &= own | ~part(self.has_carried)[:, None]
        m, x, y, z = (phi[:, k] for k in range(4))
        over = 1 / jnp.where(m > 0, m, 1.0)
        moved = (y * y + z * z, -x * y, x * x + z * z, -x * z, -y * z, x * x + y * y)
        low, high = part(self.low), part(self.high)
        for k, shift in enumerate(moved):
            about = phi[:, 4 + k] - shift * over
            good &= (about >= low[:, k, None]) & (about <= high[:, k, None])
        return jnp.all(good, 0)

    def _is_wanted(self, phi: Float[Array, "dof 10 lanes"]) -> Bool[Array, " lanes"] | bool:
        good = True
        for constraint in self.constraints:
            margin = lambda one, held=constraint: jnp.min(held(Links.from_phi(one)))
            good &= jax.vmap(margin, in_axes=2)(phi) >= 0
        return good


def _are_bodies(phi: Float[Array, "dof 10 lanes"]) -> Bool[Array, "dof lanes"]:
    m, x, y, z, xx, xy, yy, xz, yz, zz = (phi[:, k] for k in range(10))
    half = 0.5 * (xx + yy + zz)
    return is_positive([half - xx, -xy, -xz, x, half - yy, -yz, y, half - zz, z, m])


def region_of(posterior: Posterior, constraints: Sequence[Constraint] = ()) -> Region:
    """Coordinates in which what is told is a standard normal, and what is not told apart."""
    dof, unknowns = posterior.dof, posterior.told.shape[1]
    size = _sizes(posterior)
    values, vectors = np.linalg.eigh(posterior.covariance / _outer(posterior.covariance))
    root = np.sqrt(np.maximum(values, 1e-14 * values[-1]))
    whiten = (vectors / root).T / np.sqrt(np.diag(posterior.covariance))
    B = whiten @ posterior.told * size
    U, s, Vt = np.linalg.svd(B, full_matrices=True)
    rank = int(np.sum(s > _RANK * s[0])) if s.size else 0
    # r = U' B (p - origin)/size, exactly a standard normal where the rank is full
    Q = size[:, None] * np.concatenate([Vt[:rank].T / s[:rank] if rank else Vt[:0].T, Vt[rank:].T], 1)
    target = whiten @ posterior.mean
    origin = Q[:, :rank] @ (U[:, :rank].T @ target) if rank else np.zeros(unknowns)
    rows, limits = _linear(posterior)
    box = posterior.bounds.inertia[:, [0, 3, 1, 4, 5, 2]]
    pairs, felt = _of_pairs(U[:, :rank].T @ B, size, dof)
    beside = np.zeros((unknowns, unknowns - 10 * dof))
    _, s, Vt = np.linalg.svd((U[:, :rank].T @ B)[:, 10 * dof :], full_matrices=False)
    beside[10 * dof :] = size[10 * dof :, None] * (Vt.T / np.maximum(s, 1e-6))
    return Region(
        Q=jnp.asarray(Q),
        origin=jnp.asarray(origin),
        rows=jnp.asarray(rows),
        limits=jnp.asarray(limits),
        carried=jnp.asarray(posterior.carried),
        has_carried=jnp.asarray(np.any(posterior.carried != 0, 1)),
        low=jnp.asarray(box[..., 0]),
        high=jnp.asarray(box[..., 1]),
        pairs=tuple(jnp.asarray(lines) for lines in pairs),
        felt=tuple(jnp.asarray(lines) for lines in felt),
        beside=jnp.asarray(beside),
        beside_felt=jnp.asarray(U[:, :rank].T @ B @ (beside / size[:, None])),
        told=rank,
        constraints=tuple(constraints),
    )


def _of_pairs(
    B: Float[np.ndarray, "told unknowns"], size: Float[np.ndarray, " unknowns"], dof: int
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Lines of every two neighbouring links: what nothing tells, and everything as far as it is told.

    Args:
        B: r of the unknowns, each over its size.
        size: of the unknowns.
        dof: links.
    """
    wide = 10 * min(2, dof)
    free, told = [], []
    for first in range(0, 10 * dof - wide + 1, 10):
        here = slice(first, first + wide)
        _, s, Vt = np.linalg.svd(B[:, here], full_matrices=True)
        s = np.concatenate([s, np.zeros(wide - len(s))]) if len(s) < wide else s[:wide]
        null = s <= _RANK * max(s[0], 1.0) * 1e3
        lines = np.zeros((wide, wide))
        lines[:, : null.sum()] = Vt[null].T
        free.append(size[here, None] * lines)
        told.append(size[here, None] * Vt.T / np.sqrt(1 + s**2))
    most = max(1, max(int(np.any(lines, 0).sum()) for lines in free))
    pairs = [np.stack(free)[:, :, :most], np.stack(told)]
    blocks = [slice(first, first + wide) for first in range(0, 10 * dof - wide + 1, 10)]
    felt = [
        np.stack([(B / size)[:, here] @ lines for here, lines in zip(blocks, kind, strict=True)])
        for kind in pairs
    ]
    felt[0][:] = 0.0
    return pairs, felt


def _outer(C: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    scale = np.sqrt(np.diag(C))
    return np.outer(scale, scale)


def _sizes(posterior: Posterior) -> Float[np.ndarray, " unknowns"]:
    """Of every unknown: links by their bounds, the others by what they are known to."""
    box, dof = posterior.bounds, posterior.dof
    mass = np.maximum(box.mass[:, 1], 1e-6)
    if box.total_mass is not None:
        mass = np.minimum(mass, max(float(box.total_mass[1]), 1e-6))
    length = np.maximum(np.abs(box.com).max((1, 2)), 0.02)
    links = np.stack([mass, *[mass * length] * 3, *[mass * length**2] * 6], 1)
    G = posterior.told[:, 10 * dof :]
    known = np.sqrt(np.diag(posterior.covariance))
    extra = [float(np.min(known[G[:, k] != 0], initial=1.0)) for k in range(G.shape[1])]
    return np.concatenate([links.ravel(), np.maximum(extra, 1e-12)])


def _linear(posterior: Posterior) -> tuple[np.ndarray, np.ndarray]:
    """Boxes on masses and centres of mass, the total mass, and the least of the other unknowns."""
    dof, unknowns = posterior.dof, posterior.told.shape[1]
    box = posterior.bounds
    rows, limits = [], []

    def at_least(limit: float, **columns: float) -> None:
        row = np.zeros(unknowns)
        for column, value in columns.items():
            row[int(column[1:])] = value
        rows.append(row)
        limits.append(limit)

    for i in range(dof):
        m = f"_{10 * i}"
        at_least(float(box.mass[i, 0]), **{m: 1.0})
        at_least(-float(box.mass[i, 1]), **{m: -1.0})
        for k in range(3):
            c = f"_{10 * i + 1 + k}"
            at_least(0.0, **{c: 1.0, m: -float(box.com[i, k, 0])})
            at_least(0.0, **{c: -1.0, m: float(box.com[i, k, 1])})
    if box.total_mass is not None:
        at_least(float(box.total_mass[0]), **{f"_{10 * i}": 1.0 for i in range(dof)})
        at_least(-float(box.total_mass[1]), **{f"_{10 * i}": -1.0 for i in range(dof)})
    for k, least in enumerate(posterior.least):
        if np.isfinite(least):
            at_least(float(least), **{f"_{10 * dof + k}": 1.0})
    return np.array(rows), np.array(limits)


def draw(
    posterior: Posterior,
    starts: Float[np.ndarray, "starts dof 10"],
    count: int,
    seed: int,
    *,
    constraints: Sequence[Constraint] = (),
    chains: int = CHAINS,
    sweeps: int = SWEEPS,
    progress: Callable[[int, int], None] | None = None,
) -> Draws:
    """Links and what else the posterior speaks of.

    Args:
        posterior: what is known.
        starts: feasible links, far from each other if possible, where chains begin.
        count: draws.
        seed: of the random numbers.
        constraints: further ones on the links, as `jaxpanda.retrieve` takes them.
        chains: that run side by side.
        sweeps: of each chain that count; half as many are thrown away before.
        progress: called with (parts done, parts).

    Raises:
        InputError: no start can be moved inside everything that is asked for.
    """
    region = region_of(posterior, constraints)
    rng = np.random.default_rng(seed)
    y = _inside(region, posterior, starts, chains, rng)
    kept = max(10, -(-count // chains))
    thin = max(1, -(-sweeps // kept))
    keys = jax.random.split(jax.random.key(seed), _LEARNING + 1)
    L = _spread(np.asarray(y), region.told)
    tick = progress or (lambda done, total: None)
    for part in range(_LEARNING):
        tick(part, _LEARNING + 1)
        trace = _run(region, jnp.asarray(L), y, keys[part], kept, max(1, thin // (2 * _LEARNING)))
        y, recent = trace[-1], np.asarray(trace)[kept // 2 :]
        L = _spread(np.moveaxis(recent, 1, 0).reshape(len(L), -1), region.told)
    tick(_LEARNING, _LEARNING + 1)
    trace = np.asarray(_run(region, jnp.asarray(L), y, keys[-1], kept, thin))
    tick(_LEARNING + 1, _LEARNING + 1)
    rhat, effective = mixing(trace)
    chosen = np.linspace(kept - 1, 0, min(kept, -(-count // chains))).round().astype(int)
    y = np.moveaxis(trace[chosen], 1, 2).reshape(-1, trace.shape[1])[:count]
    points = np.asarray(region.origin) + y @ np.asarray(region.Q).T
    dof = posterior.dof
    return Draws(
        standard=points[:, : 10 * dof].reshape(-1, dof, 10),
        extra=points[:, 10 * dof :],
        chains=chains,
        sweeps=kept * thin,
        rhat=rhat,
        effective=effective,
    )


def _inside(
    region: Region,
    posterior: Posterior,
    starts: Float[np.ndarray, "starts dof 10"],
    chains: int,
    rng: np.random.Generator,
) -> Float[Array, "unknowns chains"]:
    """Where chains begin, each strictly inside, in the region's coordinates."""
    dof = posterior.dof
    extra = np.zeros(len(posterior.least))
    if len(extra):
        left = posterior.mean - posterior.told[:, : 10 * dof] @ starts[0].ravel()
        extra = np.linalg.lstsq(posterior.told[:, 10 * dof :], left, rcond=None)[0]
    extra = np.maximum(extra, np.where(np.isfinite(posterior.least), posterior.least + 1e-9, -np.inf))
    flat = starts.reshape(len(starts), -1)
    middle = flat.mean(0)
    found = []
    for share in _INSIDE:
        moved = flat + share * (middle - flat)
        points = np.concatenate([moved, np.broadcast_to(extra, (len(moved), len(extra)))], 1).T
        # within the least and the largest of a double's steps, that rounding undoes nothing
        linear = np.asarray(region.rows) @ points - np.asarray(region.limits)[:, None]
        good = np.all(linear > 0, 0) & np.asarray(_feasible(region, jnp.asarray(points)))
        found.append(points[:, good])
        if sum(part.shape[1] for part in found) >= chains or good.all():
            break
    every = np.concatenate(found, 1)
    if every.shape[1] == 0:
        raise InputError(
            "no start lies inside all bounds and constraints, so that nothing can be drawn: some of them leave a"
            " single value; widen them, or retrieve from more starts"
        )
    chosen = every[:, rng.permutation(every.shape[1])[np.arange(chains) % every.shape[1]]]
    return jnp.linalg.solve(region.Q, jnp.asarray(chosen) - region.origin[:, None])


@eqx.filter_jit
def _feasible(region: Region, points: Float[Array, "unknowns lanes"]) -> Bool[Array, " lanes"]:
    return region.is_feasible(points)


def _spread(y: Float[np.ndarray, "unknowns draws"], told: int) -> Float[np.ndarray, "unknowns unknowns"]:
    """Lower triangular root of the draws' covariance; a floor keeps directions that they do not have."""
    n = len(y)
    scale = np.maximum(y.std(1), 1e-12)
    correlation = (y - y.mean(1, keepdims=True)) / scale[:, None]
    C = correlation @ correlation.T / y.shape[1]
    share = n / (n + y.shape[1])  # as many draws as unknowns tell half of a covariance
    C = (1 - share) * C + share * np.eye(n)
    scale[:told] = np.where(scale[:told] > 1e-6, scale[:told], 1.0)
    return scale[:, None] * np.linalg.cholesky(C + 1e-9 * np.eye(n))


class _Lines(eqx.Module):
    """Directions: what their random numbers move."""

    point: Float[Array, "*pairs some lines"]
    """Of the unknowns, or of two neighbouring links'."""
    r: Float[Array, "*pairs told lines"]
    margin: Float[Array, "*pairs linear lines"]

    def along(self, u: Float[Array, "lines lanes"]) -> tuple[Array, Array, Array]:
        return self.point @ u, self.r @ u, self.margin @ u


@eqx.filter_jit
def _run(
    region: Region, L: Array, y: Array, key: Array, kept: int, thin: int
) -> Float[Array, "kept unknowns chains"]:
    """Sweeps of all chains, every `thin`-th state kept."""
    m, dof = region.told, len(region.carried)
    follow = jnp.zeros_like(L[:, :m])
    if m:
        follow = jax.scipy.linalg.solve_triangular(L[:m, :m].T, L[:, :m].T, lower=False).T
    told, root, wide = region.Q @ follow, L[:m, :m], 10 * min(2, dof)
    no_r = lambda lines: jnp.zeros((m, lines.shape[1]))
    free = region.Q @ L[:, m:]
    parts = [(told @ root, root), (free, no_r(free)), (free, no_r(free))]
    whole = _stacked(
        [_Lines(points, felt, region.rows @ points) for points, felt in parts if points.shape[1]]
    )
    beside = _Lines(region.beside, region.beside_felt, region.rows @ region.beside)
    blocks = jnp.stack([region.rows[:, 10 * i : 10 * i + wide] for i in range(max(1, dof - 1))])
    neighbours = [
        _Lines(points[k], felt[k], blocks[k] @ points[k])
        for points, felt in zip(region.pairs, region.felt, strict=True)
        for k in range(len(blocks))
    ]
    places = jnp.tile(jnp.arange(len(blocks)), len(region.pairs))
    pairs, counts = _stacked(neighbours)

    def sweep(state, key):
        keys = jax.random.split(key, 3)
        now = (places, pairs, counts, jax.random.split(keys[0], len(places)))
        state = jax.lax.scan(lambda state, now: (_pair(region, *now, state), None), state, now)[0]

        def once(state, key):
            each = jax.random.split(key, len(whole[1]) + 1)
            line = lambda state, now: (_line(region, now[0], now[1], now[2], state), None)
            state = jax.lax.scan(line, state, (*whole, each[1:]))[0]
            return (_beside(beside, each[0], state) if beside.point.shape[1] else state), None

        state = jax.lax.scan(once, state, jax.random.split(keys[1], _LINES))[0]
        return (_ellipse(region, told, region.rows @ told, state, keys[2]) if m else state), None

    def round_(state, key):
        _r, point, _ = jax.lax.scan(sweep, state, jax.random.split(key, thin))[0]
        y = jnp.linalg.solve(region.Q, point - region.origin[:, None])  # rounding does not add up
        return (y[:m], point, region.rows @ point - region.limits[:, None]), y

    point = region.origin[:, None] + region.Q @ y
    start = (y[:m], point, region.rows @ point - region.limits[:, None])
    return jax.lax.scan(round_, start, jax.random.split(key, kept))[1]


def _stacked(families: Sequence[_Lines]) -> tuple[_Lines, Array]:
    """All in one, padded to as many lines each, and how many each had."""
    most = max(lines.point.shape[1] for lines in families)
    counts = [lines.point.shape[1] for lines in families]
    wide = [jax.tree.map(lambda x: jnp.pad(x, ((0, 0), (0, most - x.shape[1]))), lines) for lines in families]
    return jax.tree.map(lambda *parts: jnp.stack(parts), *wide), jnp.asarray(counts)


def _directions(key: Array, lines: int, used: Any, lanes: int) -> Float[Array, "lines lanes"]:
    """Half of them along one random number only, half along all together."""
    k_all, k_one, k_which = jax.random.split(key, 3)
    every = jax.random.uniform(k_all, (lines, lanes), minval=-1.0)
    one = jax.nn.one_hot(jax.random.randint(k_one, (lanes,), 0, used), lines, axis=0)
    return jnp.where(jax.random.uniform(k_which, (lanes,)) < 0.5, every, one * every)


_State = tuple[Array, Array, Array]
"""r, the point, and the margins of what is linear; chains last."""


def _line(region: Region, lines: _Lines, used: Array, key: Array, state: _State) -> _State:
    """A line of everything."""
    r, point, margin = state
    dp, dr, rate = lines.along(_directions(key, lines.point.shape[1], used, point.shape[1]))
    low, high = _linear_ends(margin, rate)
    good = lambda t: region.is_feasible(point + t * dp)
    t = _along(good, low, high, jnp.sum(dr**2, 0), jnp.sum(r * dr, 0), jax.random.fold_in(key, 1))
    return r + t * dr, point + t * dp, margin + t * rate


def _beside(lines: _Lines, key: Array, state: _State) -> _State:
    """A line of the unknowns beside the links, of which all that is asked is linear."""
    r, point, margin = state
    k = lines.point.shape[1]
    dp, dr, rate = lines.along(_directions(key, k, k, point.shape[1]))
    low, high = _linear_ends(margin, rate)
    a, b = jnp.sum(dr**2, 0), jnp.sum(r * dr, 0)
    t = _along(lambda t: t == t, low, high, a, b, jax.random.fold_in(key, 1))
    return r + t * dr, point + t * dp, margin + t * rate


def _pair(region: Region, i: Array, lines: _Lines, used: Array, key: Array, state: _State) -> _State:
    """A line in two neighbouring links, the first of them the i-th."""
    r, point, margin = state
    wide, k = lines.point.shape
    dof = len(region.carried)
    dp, dr, rate = lines.along(_directions(key, k, used, point.shape[1]))
    low, high = _linear_ends(margin, rate)
    here = jax.lax.dynamic_slice_in_dim(point, 10 * i, wide)

    def good(t):
        moved = here + t * dp
        fits = region._are_feasible(moved.reshape(wide // 10, 10, -1), i)
        if region.constraints:
            whole = jax.lax.dynamic_update_slice_in_dim(point, moved, 10 * i, 0)
            fits &= region._is_wanted(whole[: 10 * dof].reshape(dof, 10, -1))
        return fits

    t = _along(good, low, high, jnp.sum(dr**2, 0), jnp.sum(r * dr, 0), jax.random.fold_in(key, 1))
    point = jax.lax.dynamic_update_slice_in_dim(point, here + t * dp, 10 * i, 0)
    return r + t * dr, point, margin + t * rate


def _ellipse(region: Region, told: Array, felt: Array, state: _State, key: Array) -> _State:
    """All that is told, and what follows it; `felt`: what the linear margins feel of r."""
    r, point, margin = state
    k_nu, k_angle = jax.random.split(key)
    nu = jax.random.normal(k_nu, r.shape)
    along, across = told @ r, told @ nu
    rate = felt @ r, felt @ nu
    moved = lambda angle: point + (jnp.cos(angle) - 1) * along + jnp.sin(angle) * across
    margins = lambda angle: margin + (jnp.cos(angle) - 1) * rate[0] + jnp.sin(angle) * rate[1]

    def search(state):
        angle, left, right, done, i = state
        new = left + (right - left) * jax.random.uniform(jax.random.fold_in(k_angle, i), left.shape)
        good = region.is_feasible(moved(new)) & jnp.all(margins(new) >= 0, 0)
        angle = jnp.where(~done & good, new, angle)
        left = jnp.where(~done & ~good & (new < 0), new, left)
        right = jnp.where(~done & ~good & (new >= 0), new, right)
        return angle, left, right, done | good, i + 1

    zero = jnp.zeros(r.shape[1])
    first = 2 * jnp.pi * jax.random.uniform(jax.random.fold_in(k_angle, _TRIES), zero.shape)
    start = (zero, first - 2 * jnp.pi, first, zero > 0, 0)
    angle = jax.lax.while_loop(lambda s: ~jnp.all(s[3]) & (s[4] < _TRIES), search, start)[0]
    return r * jnp.cos(angle) + nu * jnp.sin(angle), moved(angle), margins(angle)


def _linear_ends(
    margin: Float[Array, "linear lanes"], rate: Float[Array, "linear lanes"]
) -> tuple[Array, Array]:
    """Between which steps a line stays within what is linear."""
    at = -jnp.maximum(margin, 0.0) / jnp.where(rate == 0, 1.0, rate)
    low = jnp.max(jnp.where(rate > 0, at, -jnp.inf), 0)
    high = jnp.min(jnp.where(rate < 0, at, jnp.inf), 0)
    return low, high


def _along(
    good: Callable[[Array], Array], low: Array, high: Array, a: Any, b: Any, key: Array
) -> Float[Array, " chains"]:
    """A step of each chain along its line, by $\\exp(-at^2/2 - bt)$ on the line's feasible part.

    Shares of the line are counted by that distribution's own measure, in which every draw is uniform.
    """
    a, b = jnp.broadcast_to(a, low.shape), jnp.broadcast_to(b, low.shape)
    flat = a < 1e-12
    width = 1 / jnp.sqrt(jnp.where(flat, 1.0, a))
    centre = jnp.where(flat, 0.0, -b / jnp.where(flat, 1.0, a))
    low, high = jnp.where(flat, jnp.maximum(low, -1e6), low), jnp.where(flat, jnp.minimum(high, 1e6), high)
    # in the tail where the line lies, so that shares are told apart there
    side = jnp.where(low > centre, -1.0, 1.0)
    cdf = lambda t: jnp.where(flat, t, side * jax.scipy.special.ndtr(side * (t - centre) / width))
    inverse = lambda p: jnp.where(flat, p, centre + side * width * jax.scipy.special.ndtri(side * p))
    here = cdf(jnp.zeros_like(a))

    def search(state):
        t, left, right, done, i = state
        p = left + (right - left) * jax.random.uniform(jax.random.fold_in(key, i), a.shape)
        new = inverse(p)
        new = jnp.where(jnp.isfinite(new), new, 0.0)
        fits = good(new) & (new >= low) & (new <= high)
        t = jnp.where(~done & fits, new, t)
        left = jnp.where(~done & ~fits & (p < here), p, left)
        right = jnp.where(~done & ~fits & (p >= here), p, right)
        return t, left, right, done | fits, i + 1

    start = (jnp.zeros_like(a), cdf(low), cdf(high), jnp.zeros(a.shape, bool), 0)
    return jax.lax.while_loop(lambda s: ~jnp.all(s[3]) & (s[4] < _TRIES), search, start)[0]


def mixing(trace: Float[np.ndarray, "kept unknowns chains"]) -> tuple[float, float]:
    """Largest split R-hat of ranks, and least effective number of draws, over all coordinates."""
    import scipy.special
    import scipy.stats

    kept, n, chains = trace.shape
    half = kept // 2
    halves = np.concatenate([trace[:half], trace[kept - half :]], 2)  # (half, n, 2 chains)
    ranks = scipy.stats.rankdata(np.moveaxis(halves, 1, 0).reshape(n, -1), axis=1)
    z = scipy.special.ndtri((ranks - 0.375) / (ranks.shape[1] + 0.25)).reshape(n, half, 2 * chains)
    within = z.var(1, ddof=1).mean(1) if half > 1 else np.full(n, np.nan)
    between = half * z.mean(1).var(1, ddof=1)
    total = (half - 1) / half * within + between / half
    rhat = np.sqrt(total / np.maximum(within, 1e-300))
    # variance of the mean of all draws, from how far means of the chains scatter
    effective = 2 * chains * total / np.maximum(between / half, 1e-300)
    return float(np.max(rhat)), float(np.min(np.minimum(effective, 2 * half * chains)))
