"""Algorithm 1 of Gaz et al. 2019: random starts under an exact first-power penalty, for comparison.

Its kinks stall descent methods far from the optimum; `solver.solve` is what to use.
"""

import time
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels import inertia
from jaxtyping import Array, Float

from ..errors import InputError, require_x64
from .bounds import Bounds
from .constraints import Constraint, Links, triangle_inequality
from .newton import Problem, scaled_problem
from .outcome import XYZ_MATRIX, largest_violation
from .solver import Solutions

STEPS = 10
"""The paper's kappa: how often the penalty is raised."""
XI = 10.0
"""Raise of the penalty coefficient: xi = 0, 10, 20, ... as in the authors' code."""


def exact_penalty(
    A: Float[np.ndarray, "rows columns"],
    b: Float[np.ndarray, " rows"],
    bounds: Bounds,
    *,
    constraints: Sequence[Constraint] = (),
    starts: int = 100,
    seed: int = 0,
    chunk: int = 64,
    steps: int = STEPS,
    iterations: int = 100,
    progress: Callable[[int, int], None] | None = None,
) -> Solutions:
    r"""Minimise $\lVert A\phi - b\rVert^2 + \xi_k \sum_\iota \max(0, -h_\iota)$ for growing $\xi_k$ (eq. 29).

    The boxes on mass, centre of mass and inertia hold by substitution, $p = l + (u - l)(1 + \sin z)/2$; the
    triangle inequality, the total mass and the user's constraints are penalised. Each step starts from
    the one before and runs BFGS, where the authors anneal.

    Args:
        A: columns are the ten parameters of each link; no extra unknowns.
        b: right-hand side.
        bounds: boxes, all finite.
        constraints: further ones, as functions of `Links`.
        starts: number of starts; the paper's Q.
        seed: same seed, same answer.
        chunk: how many starts are solved at once.
        steps: how often the penalty is raised; the paper's kappa.
        iterations: BFGS steps at each.
        progress: called with (starts done, starts).

    Raises:
        InputError: a box is not finite, or there are extra unknowns.
    """
    require_x64("feasible.exact_penalty")
    problem = scaled_problem(A, b, bounds, tuple(constraints), None, None)
    boxes = np.concatenate([bounds.mass[:, None], bounds.com, bounds.inertia], 1).reshape(-1, 2)
    if A.shape[1] != len(boxes):
        raise InputError(
            f"the exact penalty knows links only: A must have {len(boxes)} columns, not {A.shape[1]}"
        )
    if not np.all(np.isfinite(boxes)):
        raise InputError("the exact penalty draws every parameter from its box: all bounds must be finite")
    chunk = min(chunk, starts)
    keys = jax.vmap(lambda i: jax.random.fold_in(jax.random.key(seed), i))(
        jnp.arange(starts + (-starts) % chunk)
    )
    equations = (jnp.asarray(A), jnp.asarray(b), jnp.asarray(boxes))
    began = time.perf_counter()
    run = jax.jit(lambda keys: _run_chunk(problem, equations, keys, steps, iterations))
    run = run.lower(keys[:chunk]).compile()
    compiled = time.perf_counter()
    chunks = []
    for first in range(0, starts, chunk):
        chunks.append(jax.device_get(run(keys[first : first + chunk])))
        if progress is not None:
            progress(min(first + chunk, starts), starts)
    phi, violation, converged, count = (np.concatenate(part)[:starts] for part in zip(*chunks, strict=True))
    return Solutions(
        phi=phi,
        extra=np.zeros((starts, 0)),
        objective=np.sum((phi.reshape(starts, -1) @ A.T - b) ** 2, -1),
        violation=violation,
        converged=converged & (violation == 0),
        iterations=count,
        compile_seconds=compiled - began,
        run_seconds=time.perf_counter() - compiled,
    )


def _links(z: Float[Array, " p"], boxes: Float[Array, "p 2"]) -> Links:
    p = boxes[:, 0] + (boxes[:, 1] - boxes[:, 0]) * 0.5 * (1 + jnp.sin(z))
    each = p.reshape(-1, 10)
    return Links(each[:, 0], each[:, 1:4], jax.vmap(lambda six: six[XYZ_MATRIX])(each[:, 4:]))


def _penalised(z: Float[Array, " p"], args: tuple) -> Float[Array, ""]:
    problem, (A, b, boxes), xi = args
    links = _links(z, boxes)
    total = jnp.sum(links.mass)
    margins = [
        triangle_inequality(links),
        total - problem.limits.total_mass[:1],
        problem.limits.total_mass[1:] - total,
    ]
    margins += [jnp.ravel(constraint(links)) for constraint in problem.limits.constraints]
    missed = sum(jnp.sum(jnp.maximum(0.0, -margin)) for margin in margins)
    return jnp.sum((A @ links.phi.ravel() - b) ** 2) + xi * missed


def _run_chunk(problem: Problem, equations: tuple, keys: Array, steps: int, iterations: int):
    import optimistix as optx  # a third of a second, for every command

    boxes = equations[2]

    def one(key):
        z = jnp.arcsin(jax.random.uniform(key, (len(boxes),), minval=-1.0, maxval=1.0))

        def raised(z, xi):
            found = optx.minimise(
                _penalised,
                optx.BFGS(rtol=1e-9, atol=1e-12),
                z,
                (problem, equations, xi),
                max_steps=iterations,
                throw=False,
            )
            return found.value, (found.result == optx.RESULTS.successful, found.stats["num_steps"])

        z, (done, count) = jax.lax.scan(raised, z, XI * jnp.arange(steps))
        links = _links(z, boxes)
        phi = jax.vmap(inertia.from_com)(links.mass, links.com, links.I_com)
        return phi, largest_violation(problem.limits, phi), done[-1], jnp.sum(count)

    return jax.vmap(one)(keys)
