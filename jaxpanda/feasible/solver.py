r"""Many-start least squares over physically feasible links.

$$\min_{x}\ \lVert A\,(\phi, \theta) - b\rVert^2 \quad\text{over links that could be built}$$

Under bounds alone the problem is convex in the right coordinates, but for boxes on inertias: an interior-point
method carries every start to the optimum (`convex`), and under further constraints, which need not be convex, to
one as a rule. Where few starts get there, or a box is a point, Newton steps in other coordinates are taken
(`newton`), ten times as long. Where links can meet the equations exactly, starts are projected on those that do
(`projection`), in a fraction of the time.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import lsq_linear

from ..errors import InputError, require_x64
from ..ranks import ALONE, Ranks
from . import convex, newton, projection, schedule
from .bounds import Bounds
from .checkpoint import Checkpoint, identity
from .constraints import Constraint, less_lumped
from .known import Known, require_numbers
from .outcome import extra_box

STARTS = 2048
"""Default number of random starts."""
NOTHING = 1e-12
"""Share of the right-hand side's square that may be left where links meet the equations exactly."""
_TRIED = 64  # starts that tell whether a way suits the problem
_ENOUGH, _ALMOST_ALL = 0.5, 0.9  # share of them that must converge; where there is a sure way as well
_BLOCK = 4096  # starts whose objective is evaluated at once


class _Way(NamedTuple):
    """How to solve a problem: the chunk's program, where starts come from, its static options, its size."""

    solve_starts: schedule.Chunk
    origin: Any
    options: tuple[Any, ...]
    chunk: int


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
    """Feasible, and near the optimum: by the estimate of the step that aims at it (`convex.TOLERANCE`), or as the
    last round's second half gained less than 0.1 % (`newton`)."""
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
    carried: Float[np.ndarray, "dof 10"] | None = None,
    extra_lower: Float[np.ndarray, " extra"] | None = None,
    extra_upper: Float[np.ndarray, " extra"] | None = None,
    initial: Float[np.ndarray, "given dof 10"] | None = None,
    starts: int = STARTS,
    seed: int = 0,
    chunk: int | None = None,
    rounds: int = newton.ROUNDS,
    iterations: int = newton.ITERATIONS,
    devices: Sequence[schedule.Device] | None = None,
    ranks: Ranks = ALONE,
    checkpoint: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Solutions:
    """Minimise the sum of squares from many random starts at once.

    Args:
        A: one row an equation; columns are the ten parameters of each link in turn, then the extra unknowns.
        b: right-hand side.
        bounds: boxes, from which the random starts are drawn as well; points where a number is known.
        constraints: further ones, as functions of `Links`.
        carried: of each link, what belongs to bodies that are fixed to it and stay as they are: the rest must
            be a body that can be built, too.
        extra_lower: lower bounds of the extra unknowns; unbounded where None.
        extra_upper: upper bounds of the extra unknowns; unbounded where None.
        initial: parameters to start from in place of as many random starts; moved into the boxes.
        starts: number of starts.
        seed: same seed, same answer, whatever the chunk.
        chunk: how many starts a device is given at once, which bounds the memory; what suits the solver and the
            platform when None.
        rounds: how often `newton` updates the constraints' multipliers.
        iterations: Newton steps a round; `convex` takes at most `rounds` times as many, and fewer as a rule.
        devices: over which the starts are spread; see `schedule.run`.
        ranks: processes that make this same call and share the starts; all return all of them.
        checkpoint: file that keeps the starts as they finish. Where it holds starts of this same problem from a
            run that was interrupted, they are not solved again, and the answer has the same bits. The caller
            removes it.
        progress: called with (starts done, starts) after every chunk.

    Raises:
        InputError: shapes do not fit each other, a number is not finite, a constraint is no number, bodies
            that are carried outweigh a bound, the checkpoint is of another problem, or ranks were given others.
        RankError: another rank failed.
    """
    require_x64("feasible.solve")
    if starts < 1:
        raise InputError(f"starts: {starts} is too few; at least 1")
    constraints = tuple(constraints)
    require_numbers(constraints, bounds)
    _require_room(bounds, carried)
    known = Known.of(bounds)
    if not known.nothing:
        low, high = extra_box(A, b, bounds, extra_lower, extra_upper)
        if not len(known.free):
            return _all_known(A, b, known, low, high, constraints, starts)
        columns = np.concatenate([np.arange(10) + 10 * link for link in known.free])
        further = np.arange(10 * bounds.dof, A.shape[1])
        found = _solve(
            A[:, np.concatenate([columns, further]).astype(int)],
            b - A[:, : 10 * bounds.dof] @ known.phi.ravel(),
            known.reduced(),
            tuple(known.constraint(one) for one in constraints),
            known.carried(carried),
            extra_lower,
            extra_upper,
            None if initial is None else initial[:, known.free],
            starts,
            seed,
            chunk,
            rounds,
            iterations,
            devices,
            ranks,
            checkpoint,
            progress,
        )
        phi, violation = known.settled(found.phi, constraints)
        return dataclasses.replace(
            found,
            phi=phi,
            objective=_objectives(A, b, phi, found.extra),
            violation=violation,
            converged=found.converged & (violation == 0),
        )
    return _solve(
        A,
        b,
        bounds,
        constraints,
        carried,
        extra_lower,
        extra_upper,
        initial,
        starts,
        seed,
        chunk,
        rounds,
        iterations,
        devices,
        ranks,
        checkpoint,
        progress,
    )


def _all_known(
    A: Float[np.ndarray, "rows columns"],
    b: Float[np.ndarray, " rows"],
    known: Known,
    low: Float[np.ndarray, " extra"],
    high: Float[np.ndarray, " extra"],
    constraints: tuple[Constraint, ...],
    starts: int,
) -> Solutions:
    """Every start is the links that are known; what is unknown beside them is linear."""
    n, extra = 10 * known.bounds.dof, np.zeros(len(low))
    if len(extra):
        extra = lsq_linear(A[:, n:], b - A[:, :n] @ known.phi.ravel(), (low, high)).x
    phi, violation = known.settled(np.zeros((starts, 0, 10)), constraints)
    extra = np.tile(extra, (starts, 1))
    none = np.zeros(starts, int)
    return Solutions(phi, extra, _objectives(A, b, phi, extra), violation, violation == 0, none, 0.0, 0.0)


def _require_room(bounds: Bounds, carried: Float[np.ndarray, "dof 10"] | None) -> None:
    if carried is None:
        return
    for i in np.flatnonzero((carried[:, 0] > 0) & (bounds.mass[:, 1] <= carried[:, 0])):
        raise InputError(
            f"bounds of m{i + 1}: at most {bounds.mass[i, 1]:g} kg, but bodies that the model fixes to that link"
            f" weigh {carried[i, 0]:g} kg; raise the bound"
        )


def _solve(
    A: Float[np.ndarray, "rows columns"],
    b: Float[np.ndarray, " rows"],
    bounds: Bounds,
    constraints: tuple[Constraint, ...],
    carried: Float[np.ndarray, "dof 10"] | None,
    extra_lower: Float[np.ndarray, " extra"] | None,
    extra_upper: Float[np.ndarray, " extra"] | None,
    initial: Float[np.ndarray, "given dof 10"] | None,
    starts: int,
    seed: int,
    chunk: int | None,
    rounds: int,
    iterations: int,
    devices: Sequence[schedule.Device] | None,
    ranks: Ranks,
    checkpoint: str | Path | None,
    progress: Callable[[int, int], None] | None,
) -> Solutions:
    """`solve` where no box is a point."""
    extra = np.stack(extra_box(A, b, bounds, extra_lower, extra_upper), -1)
    device = (jax.local_devices() if devices is None else devices)[0]
    further = (extra_lower, extra_upper)

    def along_the_path() -> _Way:
        problem = convex.scaled_problem(A, b, bounds, *further, constraints, carried)
        size, lanes = convex.sizes(device.platform, starts)
        origin = convex.origin_of(problem, seed, initial)
        return _Way(convex.solve_starts, origin, (rounds * iterations, lanes), size)

    def by_newton() -> _Way:
        held = constraints if carried is None else (*constraints, less_lumped(carried))
        problem = newton.scaled_problem(A, b, bounds, held, *further)
        origin = newton.origin_of(problem, bounds, seed, initial)
        return _Way(newton.solve_starts, origin, (rounds, iterations), min(newton.CHUNK, starts))

    seconds = []  # of compiling and of running

    def go(way: _Way, starts: int, **options: Any) -> Any:
        size = way.chunk if chunk is None else chunk
        found, *spent = schedule.run(
            *way[:3], starts=starts, chunk=size, devices=devices, ranks=ranks, **options
        )
        seconds.append(spent)
        return found

    def projected(path: _Way) -> _Way | None:
        origin = projection.origin_of(path.origin)
        if origin is None:
            return None
        return path._replace(solve_starts=projection.solve_starts, origin=origin, options=path.options[1:])

    def share_of(tried: Any, most: float = np.inf) -> float:
        """How many of a few starts converged, to an objective of no more than this."""
        return float(np.mean(tried.converged & (_objectives(A, b, tried.phi, tried.extra) <= most)))

    identified = partial(identity, A, b, bounds, constraints, (*further, initial, carried), seed)
    if ranks.count > 1:
        ranks.require_same({"starts": str(starts), **identified((rounds, iterations, chunk or 0))})
    way, few = along_the_path() if convex.suits(bounds, extra, carried) else by_newton(), min(starts, _TRIED)
    if way.solve_starts is convex.solve_starts:
        nothing, exact = NOTHING * float(b @ b), projected(way)
        tried = go(way, few) if constraints or exact is not None else None
        if constraints and share_of(tried) < _ENOUGH:
            way = by_newton()
        elif exact is not None and share_of(tried, nothing) >= _ENOUGH:
            way = exact if share_of(go(exact, few), nothing) >= _ALMOST_ALL else way
    kept = None
    if checkpoint is not None:
        kept = Checkpoint(checkpoint, identified(way.options))
    found = go(way, starts, checkpoint=kept, progress=progress)
    compile_seconds, run_seconds = np.sum(seconds, 0).tolist()
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
