"""What both solvers answer with, and by how much a start misses what was asked of it."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..errors import InputError
from .bounds import Bounds
from .constraints import Constraint, Links, less_lumped, triangle_inequality

# The order xx, yy, zz, xy, xz, yz of tables.
XYZ_ROW = np.array([0, 1, 2, 0, 0, 1])
XYZ_COLUMN = np.array([0, 1, 2, 1, 2, 2])
XYZ_MATRIX = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])
ROUNDING = 1e-12
"""Share of a number by which it may miss its box: masses, centres and inertias are computed from phi."""
TRIANGLE_INSET = 1e-8
"""How far from the triangle inequality's boundary to stay [kg m²]."""


def extra_box(
    A: Float[np.ndarray, "rows columns"],
    b: Float[np.ndarray, " rows"],
    bounds: Bounds,
    lower: Float[np.ndarray, " extra"] | None,
    upper: Float[np.ndarray, " extra"] | None,
) -> tuple[Float[np.ndarray, " extra"], Float[np.ndarray, " extra"]]:
    """Check the input; bounds of the unknowns beside the links, infinite where there are none."""
    dof = bounds.dof
    extra = A.shape[1] - 10 * dof
    if extra < 0:
        raise InputError(
            f"A has {A.shape[1]} columns, fewer than the ten of each of {dof} links in the bounds"
        )
    if not (np.all(np.isfinite(A)) and np.all(np.isfinite(b))):
        raise InputError("A or b holds a number that is not finite")
    low = np.full(extra, -np.inf) if lower is None else np.asarray(lower, float)
    high = np.full(extra, np.inf) if upper is None else np.asarray(upper, float)
    if low.shape != (extra,) or high.shape != (extra,):
        raise InputError(f"bounds of the extra unknowns: expected {extra}, got {low.size} and {high.size}")
    return low, high


def inertia_inset(bounds: Bounds) -> Float[np.ndarray, "dof 6"]:
    """How far inside boxes on inertias to aim [kg m²]: a millionth of a link's largest bound, and inside."""
    width = bounds.inertia[..., 1] - bounds.inertia[..., 0]
    return np.minimum(1e-6 * _largest_inertia(bounds)[:, None], width / 4)


def inertia_unit(bounds: Bounds, A: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, " dof"]:
    r"""In what to measure by how much boxes on inertias are missed [kg m²].

    A link's largest bound, or what changes $\lVert A\phi\rVert^2$ by about one where that is less: boxes
    would give way to a steeper objective.
    """
    steepest = np.sum(A**2, 0)[: 10 * bounds.dof].reshape(-1, 10)[:, 4:].max(-1)
    return np.minimum(_largest_inertia(bounds), (2 * np.maximum(steepest, 1e-300)) ** -0.5)


def _largest_inertia(bounds: Bounds) -> Float[np.ndarray, " dof"]:
    """Of a link's bounds [kg m²]; one where it has none."""
    found = np.max(np.where(np.isfinite(bounds.inertia), np.abs(bounds.inertia), 0.0), (1, 2))
    return np.where(found > 0, found, 1.0)


def extra_unit(
    columns: Float[np.ndarray, "rows extra"],
    b: Float[np.ndarray, " rows"],
    low: Float[np.ndarray, " extra"],
    high: Float[np.ndarray, " extra"],
) -> Float[np.ndarray, " extra"]:
    """A typical size of each unknown beside the links: what alone would explain b, or its box if narrower."""
    norms = np.linalg.norm(columns, axis=0)
    unit = np.where(norms > 0, np.linalg.norm(b) / np.where(norms > 0, norms, 1), 0)
    unit = np.minimum(unit, np.where(high > low, high - low, np.inf))
    return np.where(unit > 0, unit, 1.0)


class Limits(eqx.Module):
    """What the links must meet, in SI units."""

    mass: Float[Array, "dof 2"]
    com: Float[Array, "dof 3 2"]
    inertia: Float[Array, "dof 6 2"]
    total_mass: Float[Array, " 2"]
    constraints: tuple[Constraint, ...] = eqx.field(static=True)
    carried: Float[Array, "dof 10"] | None = None
    """Of each link, what belongs to bodies that stay as they are: the rest must be a body too."""


def limits_of(
    bounds: Bounds,
    constraints: tuple[Constraint, ...],
    carried: Float[np.ndarray, "dof 10"] | None = None,
) -> Limits:
    return Limits(
        mass=jnp.asarray(bounds.mass),
        com=jnp.asarray(bounds.com),
        inertia=jnp.asarray(bounds.inertia),
        total_mass=jnp.asarray([-np.inf, np.inf] if bounds.total_mass is None else bounds.total_mass),
        constraints=constraints,
        carried=None if carried is None else jnp.asarray(carried),
    )


def largest_violation(limits: Limits, phi: Float[Array, "dof 10"]) -> Float[Array, ""]:
    """The largest amount by which anything is missed; from `phi` alone, as any other program would see it."""
    links = Links.from_phi(phi)
    of_I = links.I_com[:, XYZ_ROW, XYZ_COLUMN]
    total = jnp.sum(links.mass)
    of_origin = ROUNDING * jnp.max(jnp.abs(phi[:, 4:]), 1)  # what I_com is the difference of
    boxes = (
        (links.mass, limits.mass, ROUNDING * links.mass),
        (links.com, limits.com, ROUNDING),
        (of_I, limits.inertia, of_origin[:, None]),
        (total, limits.total_mass, ROUNDING * total),
    )
    margins = [
        margin
        for value, box, least in boxes
        for margin in (value - box[..., 0] + least, box[..., 1] - value + least)
    ]
    margins += [constraint(links) for constraint in limits.constraints]
    margins += [triangle_inequality(links) + of_origin]
    if limits.carried is not None:
        margins += [less_lumped(limits.carried)(links)]
    least = jnp.min(jnp.stack([jnp.min(margin, initial=jnp.inf) for margin in margins]))
    return jnp.where(jnp.isfinite(phi).all(), jnp.maximum(0.0, -least), jnp.inf)


class Outcome(eqx.Module):
    """What the starts of a chunk came to."""

    phi: Float[Array, "starts dof 10"]
    extra: Float[Array, "starts extra"]
    violation: Float[Array, " starts"]
    converged: Bool[Array, " starts"]
    iterations: Int[Array, " starts"]
