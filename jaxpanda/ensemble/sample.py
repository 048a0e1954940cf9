"""`draw_ensemble`: arms drawn from what a retrieval or a diagnosis knows."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..arms.arm import Arm
from ..arms.source import is_panda
from ..corrected import FILE as CORRECTED
from ..corrected import XML, Corrected
from ..errors import InputError, require_x64
from ..feasible import Bounds, Constraint, solve
from ..posterior import Posterior
from ..retrieval import Retrieval
from .result import MIXED, Ensemble
from .sampler import CHAINS, SWEEPS, draw

_STARTS = 128
"""Links that a diagnosis' chains begin from."""
_MOST = 1_000_000
"""Members."""


def draw_ensemble(
    found: Retrieval | str | Path,
    *,
    count: int = 1000,
    seed: int = 0,
    constraints: Sequence[Constraint] = (),
    chains: int = CHAINS,
    sweeps: int = SWEEPS,
    progress: Callable[[int, int], None] | None = None,
) -> Ensemble:
    """Arms that the recordings cannot tell apart, each of which could be built.

    What was identified is drawn with its covariance, which allows for correlated residuals; what torque does not
    tell is uniform in the links' standard parameters over all that is feasible: positive definite
    pseudo-inertias, the bounds of the retrieval and its total mass, friction that brakes.

    Args:
        found: a retrieval, or the folder that `retrieve` or `diagnose` wrote.
        count: members.
        seed: of the random numbers.
        constraints: further ones on the links, as `retrieve` takes them; give those again that it was given.
        chains: that are run side by side; members are spread over them.
        sweeps: of each chain. More where the result says that chains did not mix.
        progress: called with (parts done, parts).

    Raises:
        InputError: nothing is known with its uncertainty, or no feasible start is.
    """
    require_x64("an ensemble")
    if not 1 <= count <= _MOST:
        raise InputError(f"count: {count}, where 1 to {_MOST} members can be drawn")
    began = time.perf_counter()
    chains = min(chains, max(16, count))
    options = {"constraints": constraints, "chains": chains, "sweeps": sweeps, "progress": progress}
    if not isinstance(found, Retrieval) and (Path(found) / CORRECTED).is_file():
        folder = Path(found)
        corrected, posterior = Corrected.load(folder), Posterior.load(folder)
        draws = draw(
            posterior, _starts(posterior, np.asarray(corrected.arm.standard), seed), count, seed, **options
        )
        arm, source, model = corrected.arm, "diagnosis", str((folder / XML).resolve())
        model_friction = "none"
    else:
        links = found if isinstance(found, Retrieval) else Retrieval.load(found)
        if links.posterior is None:
            raise InputError(
                "retrieval: the coefficients have no standard deviations, or were retrieved by an older version;"
                " identify and retrieve again"
            )
        posterior, corrected = links.posterior, None
        arm = links.model or (Arm.panda() if links.arm in ("", "panda") and links.dof == 7 else None)
        if arm is None:
            raise InputError(f"retrieval: does not hold the arm '{links.arm}'; identify and retrieve again")
        draws = draw(posterior, _of_retrieval(links), count, seed, **options)
        source, model = "retrieval", "" if is_panda(arm) and not links.model_file else links.model_file
        model_friction = links.friction.model if links.friction is not None else "none"
    notes = []
    if draws.rhat > MIXED:
        notes.append(
            f"chains have not mixed (R-hat {draws.rhat:.2f}, where {MIXED:g} is wanted): members may be nearer to"
            " the retrieval than what torque leaves open; give more --sweeps"
        )
    return Ensemble(
        arm=arm,
        standard=draws.standard,
        extra=draws.extra,
        names=posterior.names,
        friction=model_friction,
        corrected=corrected,
        noise=posterior.noise,
        source=source,
        model_file=model,
        seed=seed,
        chains=draws.chains,
        sweeps=draws.sweeps,
        rhat=draws.rhat,
        effective=draws.effective,
        seconds=time.perf_counter() - began,
        notes=tuple(notes),
    )


def _of_retrieval(links: Retrieval) -> Float[np.ndarray, "starts dof 10"]:
    """The links retrieved, and those of all starts that ended feasible."""
    own = links.standard[None]
    if links.solutions is None:
        return own
    return np.concatenate([own, links.solutions.phi[links.solutions.violation <= 0]])


def _starts(
    posterior: Posterior, nominal: Float[np.ndarray, "dof 10"], seed: int
) -> Float[np.ndarray, "starts dof 10"]:
    """Feasible links behind what is told of them, from random starts."""
    columns = 10 * posterior.dof
    rows = np.any(posterior.told[:, :columns] != 0, 1)
    C = posterior.covariance[np.ix_(rows, rows)]
    values, vectors = np.linalg.eigh(C)
    root = (vectors / np.sqrt(np.maximum(values, 1e-14 * max(values[-1], 1e-300)))).T
    bounds: Bounds = posterior.bounds
    found = solve(
        root @ posterior.told[rows][:, :columns],
        root @ posterior.mean[rows],
        bounds,
        starts=_STARTS,
        seed=seed,
    )
    feasible = found.phi[found.violation <= 0]
    return np.concatenate([nominal[None], feasible]) if len(feasible) else nominal[None]
