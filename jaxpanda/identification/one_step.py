r"""Link parameters that could be built, straight from torque.

$$\min_{\phi, \theta}\;
  \frac{N_e}{N} \sum_j \frac{\lVert y_j - W_j K\phi - \Psi_j\theta_j\rVert^2}{\sigma_j^2}
  + \sum_k \frac{(\phi_k - \phi_{0k})^2}{s_k^2} \quad
  \text{over feasible } \phi \text{ and friction that takes energy out}$$

Feasibility is a regulariser: it forbids what no robot could have, so that the fit in sample is worse and the
fit on held-out motion better. Torque leaves 27 of the Panda's 70 parameters open and others nearly so; for
those the second term says that links are as the arm's model has them, give or take `prior` times as much. The
$N$ residuals count as $N_e$ independent ones, two a period of the cutoff: both terms are in one unit.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from ..arm import Arm
from ..feasible import Bounds, Constraint, Solutions, solve
from ..friction import MODELS, least_beyond
from ..parameters import Base
from .regression import Fit, Masks, Regression, least_squares, triangle, triangles

PRIOR = 1.0
"""Default width of the expectation around nominal links, as a share of them."""
_LIGHT = 0.1  # of the mean mass: lighter links are taken to be uncertain by this much


@dataclasses.dataclass(frozen=True)
class Prior:
    """What links are expected to be, before any torque."""

    phi: Float[np.ndarray, "dof 10"]
    std: Float[np.ndarray, "dof 10"]
    """[kg, kg m, kg m²]; infinite for no expectation."""
    carried: Float[np.ndarray, "dof 10"] | None = None
    """Of the links, what belongs to bodies that are fixed to them and stay as they are."""

    @classmethod
    def around(cls, arm: Arm, bounds: Bounds, width: float = PRIOR) -> "Prior":
        """Nominal links, uncertain by `width` times their mass within half the box of their centre."""
        phi = np.asarray(arm.standard)
        mass = np.maximum(phi[:, 0], _LIGHT * phi[:, 0].mean())
        radius = 0.5 * np.linalg.norm(bounds.com[..., 1] - bounds.com[..., 0], axis=-1)
        std = width * mass[:, None] * radius[:, None] ** np.array([0, 1, 1, 1, 2, 2, 2, 2, 2, 2])
        carried = None if arm.lumped is None else np.asarray(arm.lumped)
        return cls(phi, np.where(std > 0, std, np.inf), carried)


def feasible_least_squares(
    regressions: Sequence[Regression],
    masks: Masks,
    weighting: str,
    base: Base,
    friction: str,
    bounds: Bounds,
    prior: Prior,
    *,
    cutoff: float,
    known: Mapping[str, Float[np.ndarray, " dof"]],
    constraints: Sequence[Constraint] = (),
    starts: int,
    seed: int = 0,
) -> tuple[Fit, Solutions]:
    """The feasible links and friction nearest to the torque; joints weighted as the classical fit finds them.

    Args:
        regressions: the data, with the friction's columns.
        masks: which samples to use.
        weighting: as for `least_squares`.
        base: what the rigid columns are.
        friction: the model behind the friction's columns.
        bounds: boxes on the links' parameters.
        prior: what links are expected to be; the first start as well.
        cutoff: of the low-pass behind the regressions [Hz].
        known: what the model holds beyond rigid links, by name.
        constraints: further ones, as functions of `Links`.
        starts: of the solver.
        seed: same seed, same answer.
    """
    sigma = least_squares(regressions, masks, weighting).sigma
    if weighting == "none":  # one unit for all joints, which the prior needs
        rows = triangles(regressions, masks) @ np.append(-least_squares(regressions, masks, weighting).x, 1.0)
        sigma = sigma * np.linalg.norm(rows) / np.sqrt(len(sigma) * sum(int(m.sum()) for m in masks))
    A, b = problem(regressions, masks, sigma, base, prior, cutoff)
    low, high = friction_bounds(friction, len(sigma), known)
    found = solve(
        A,
        b,
        bounds,
        constraints=constraints,
        carried=prior.carried,
        extra_lower=low,
        extra_upper=high,
        initial=prior.phi[None],
        starts=starts,
        seed=seed,
    )
    phi, theta = found.phi[found.best], found.extra[found.best]
    return Fit(np.concatenate([base.projection @ phi.ravel(), theta]), sigma, phi), found


def problem(
    regressions: Sequence[Regression],
    masks: Masks,
    sigma: Float[np.ndarray, " dof"],
    base: Base,
    prior: Prior,
    cutoff: float,
) -> tuple[Float[np.ndarray, "rows columns"], Float[np.ndarray, " rows"]]:
    r"""The whole objective as $\lVert A(\phi, \theta) - b\rVert^2$, less what no parameter can explain."""
    duration = sum(r.duration * mask.mean() for r, mask in zip(regressions, masks, strict=True))
    samples = sum(int(mask.sum()) for mask in masks)
    weight = np.sqrt(min(1.0, 2 * cutoff * duration / samples))
    rows = np.concatenate(triangles(regressions, masks) / sigma[:, None, None]) * weight
    R = triangle(rows)[:-1]
    rank, extra = base.rank, R.shape[1] - 1 - base.rank
    data = np.concatenate([R[:, :rank] @ base.projection, R[:, rank : rank + extra]], axis=1)
    expected = np.diag(1 / prior.std.ravel())
    A = np.concatenate([data, np.pad(expected, ((0, 0), (0, extra)))])
    return A, np.concatenate([R[:, -1], (prior.phi / prior.std).ravel()])


def friction_bounds(
    friction: str, dof: int, known: Mapping[str, Float[np.ndarray, " dof"]]
) -> tuple[Float[np.ndarray, " parameters"], Float[np.ndarray, " parameters"]]:
    """Bounds of the friction's linear parameters beyond what the model holds, in their columns' order."""
    linear = ("phi1",) if friction == "sigmoid" else MODELS[friction]
    lower = least_beyond(linear, known, dof).ravel()
    return lower, np.full(len(lower), np.inf)
