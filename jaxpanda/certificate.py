r"""How low the objective can get: the convex problem behind retrieval.

In $(m, mc, J)$ the coefficients are linear, and a link is real where its pseudo-inertia is positive
semidefinite. With boxes that are linear in these numbers the problem is a semidefinite programme, whose dual
value no feasible set of links can be below.
"""

import dataclasses
import importlib
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels import inertia
from jaxtyping import Float
from scipy import sparse

from .errors import InputError, MissingExtraError
from .feasible import Bounds
from .feasible.known import Known

# Entries of the upper triangle of the 4x4 pseudo-inertia, column by column, as the solver's cone wants them.
_ROW = np.array([0, 0, 1, 0, 1, 2, 0, 1, 2, 3])
_COLUMN = np.array([0, 1, 1, 2, 2, 2, 3, 3, 3, 3])


@dataclasses.dataclass(frozen=True)
class Certificate:
    """A lower bound, and the point that shows it is not far off."""

    lower_bound: float
    r"""Dual value: no feasible links have $\lVert A x - b\rVert^2$ below it, up to the solver's 1e-9."""
    phi: Float[np.ndarray, "dof 10"]
    """The optimiser; feasible to the solver's precision, not strictly."""
    extra: Float[np.ndarray, " extra"]
    seconds: float


def lower_bound(
    A: Float[np.ndarray, "rows columns"],
    b: Float[np.ndarray, " rows"],
    bounds: Bounds,
    *,
    extra_lower: Float[np.ndarray, " extra"] | None = None,
    extra_upper: Float[np.ndarray, " extra"] | None = None,
) -> Certificate:
    r"""Certified lower bound of `feasible.solve`'s objective.

    Kept exactly: pseudo-inertia, masses, centres of mass ($m\,c_{lo} \le mc \le m\,c_{hi}$), total mass,
    extra unknowns. Inertia boxes about the centre of mass are not convex; their upper bounds are kept as
    $J_{xx} \le I_{hi} + m \max(c_y^2 + c_z^2)$ and the rest is left out, as are a user's constraints.
    Leaving out can only lower the bound, so it stays one.

    Args:
        A: as for `feasible.solve`.
        b: as for `feasible.solve`.
        bounds: boxes on the links.
        extra_lower: lower bounds of the extra unknowns; unbounded where None.
        extra_upper: upper bounds of the extra unknowns; unbounded where None.

    Raises:
        MissingExtraError: clarabel is not installed.
        InputError: the solver finds no optimum, because nothing satisfies the bounds.
    """
    try:
        clarabel: Any = importlib.import_module("clarabel")  # publishes no types
    except ImportError:
        raise MissingExtraError("the certificate of optimality", "sdp") from None
    began = time.perf_counter()
    known, every = Known.of(bounds), bounds.dof
    if not known.nothing:  # what is known is no unknown; boxes that are points are opened, if anything
        b = b - A[:, : 10 * every] @ known.phi.ravel()
        unknown = np.repeat(np.isin(np.arange(every), known.free), 10)
        unknown = np.concatenate([unknown, np.ones(A.shape[1] - 10 * every, bool)])
        A, bounds = A[:, unknown], known.reduced()
    rows, columns = A.shape
    norm = float(np.linalg.norm(b)) or 1.0
    G, h = _linear(bounds, columns, extra_lower, extra_upper)
    # Unknowns: x, then the residual r = (A x - b) / |b|, of which the squares are summed.
    residual = sparse.hstack([sparse.csc_matrix(A / norm), -sparse.eye(rows)])
    inequalities = sparse.hstack([sparse.csc_matrix(G), sparse.csc_matrix((len(h), rows))])
    cone = -_pseudo_inertias(bounds.dof)
    semidefinite = sparse.hstack([cone, sparse.csc_matrix((len(cone), columns - cone.shape[1] + rows))])
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs, settings.tol_gap_rel, settings.tol_feas = 1e-12, 1e-10, 1e-10
    solution = clarabel.DefaultSolver(
        sparse.block_diag([sparse.csc_matrix((columns, columns)), 2 * sparse.eye(rows)], format="csc"),
        np.zeros(columns + rows),
        sparse.vstack([residual, inequalities, semidefinite], format="csc"),
        np.concatenate([b / norm, h, np.zeros(len(cone))]),
        [
            clarabel.ZeroConeT(rows),
            clarabel.NonnegativeConeT(len(h)),
            *[clarabel.PSDTriangleConeT(4)] * bounds.dof,
        ],
        settings,
    ).solve()
    status = str(solution.status)
    if status not in ("Solved", "AlmostSolved"):
        raise InputError(f"the convex problem has no optimum (solver says {status}); widen the bounds")
    x = np.array(solution.x)
    links = 10 * bounds.dof
    return Certificate(
        lower_bound=max(0.0, solution.obj_val_dual * norm**2),
        phi=known.filled(x[:links].reshape(-1, 10)),
        extra=x[links:columns],
        seconds=time.perf_counter() - began,
    )


def _pseudo_inertias(dof: int) -> np.ndarray:
    """From phi to the pseudo-inertias' stacked upper triangles, off-diagonal entries times sqrt 2."""
    of_units = np.asarray(jax.jit(jax.vmap(inertia.pseudo_inertia))(jnp.eye(10)))
    one = of_units[:, _ROW, _COLUMN].T
    return np.kron(np.eye(dof), np.where(_ROW == _COLUMN, 1.0, np.sqrt(2.0))[:, None] * one)


def _linear(
    bounds: Bounds,
    columns: int,
    extra_lower: Float[np.ndarray, " extra"] | None,
    extra_upper: Float[np.ndarray, " extra"] | None,
) -> tuple[Float[np.ndarray, "inequalities columns"], Float[np.ndarray, " inequalities"]]:
    """G x <= h for all bounds that are linear in (m, mc, J)."""
    unit = np.eye(columns)
    G, h = [], []

    def at_most(row: np.ndarray, value: float) -> None:
        if np.isfinite(value):
            G.append(row)
            h.append(value)

    for i in range(bounds.dof):
        m, *rest = unit[10 * i : 10 * i + 10]
        at_most(-m, -bounds.mass[i, 0])
        at_most(m, bounds.mass[i, 1])
        for mc, (low, high) in zip(rest[:3], bounds.com[i], strict=True):
            at_most(low * m - mc, 0.0)
            at_most(mc - high * m, 0.0)
        farthest = np.max(bounds.com[i] ** 2, -1)
        # Ixx, Iyy, Izz in the kernels' order xx xy yy xz yz zz
        for k, row in enumerate((rest[3], rest[5], rest[8])):
            at_most(row - (farthest.sum() - farthest[k]) * m, bounds.inertia[i, k, 1])
    if bounds.total_mass is not None:
        total = unit[0 : 10 * bounds.dof : 10].sum(0)
        at_most(-total, -bounds.total_mass[0])
        at_most(total, bounds.total_mass[1])
    for k, row in enumerate(unit[10 * bounds.dof :]):
        at_most(-row, np.inf if extra_lower is None else -extra_lower[k])
        at_most(row, np.inf if extra_upper is None else extra_upper[k])
    return np.array(G), np.array(h)
