r"""Link parameters that could be built, straight from torque.

$$\min_{\phi, \theta}\;
  \frac{1}{c} \sum_j \frac{\lVert y_j - W_j K\phi - \Psi_j\theta_j\rVert^2}{\sigma_j^2}
  + \sum_k \frac{(\phi_k - \phi_{0k})^2}{s_k^2} + \sum_j \frac{b_j^2}{\tau_j^2} \quad
  \text{over feasible } \phi \text{ and friction that takes energy out}$$

Feasibility is a regulariser: it forbids what no robot could have, so that the fit in sample is worse and the
fit on held-out motion better. Torque leaves 27 of the Panda's 70 parameters open and others nearly so; for
those the second term says that links are as the arm's model has them, give or take `prior` times as much. Nor is
an offset $b_j$ of a torque sensor expected to be larger than its joint's torque $\tau_j$ (rms), lest links and
offsets that undo each other be found. $c$ correlated residuals tell as much as an independent one
(`statistics.samples_as_one`): all terms are in one unit.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from ..arms.arm import Arm
from ..feasible import Bounds, Constraint, Solutions, solve
from ..friction import least_beyond, linear
from ..parameters import Base, triangle
from .regression import Fit, Masks, Regression, least_squares, triangles
from .statistics import covariances, samples_as_one

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

    def distance(self, phi: Float[np.ndarray, "dof 10"]) -> float:
        """Squared, from what is expected, in its deviations."""
        return float(np.sum(((phi - self.phi) / self.std) ** 2))


def feasible_least_squares(
    regressions: Sequence[Regression],
    masks: Masks,
    weighting: str,
    base: Base,
    friction: str,
    bounds: Bounds,
    prior: Prior,
    *,
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
        known: what the model holds beyond rigid links, by name.
        constraints: further ones, as functions of `Links`.
        starts: of the solver.
        seed: same seed, same answer.
    """
    fit = least_squares(regressions, masks, weighting)
    sigma = fit.sigma
    if weighting == "none":  # one unit for all joints, which the prior needs
        rows = triangles(regressions, masks) @ np.append(-fit.x, 1.0)
        sigma = sigma * np.linalg.norm(rows) / np.sqrt(len(sigma) * sum(int(m.sum()) for m in masks))
    A, b = problem(regressions, masks, dataclasses.replace(fit, sigma=sigma), base, prior, friction)
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
    fit: Fit,
    base: Base,
    prior: Prior,
    friction: str,
) -> tuple[Float[np.ndarray, "rows columns"], Float[np.ndarray, " rows"]]:
    r"""The whole objective as $\lVert A(\phi, \theta) - b\rVert^2$, less what no parameter can explain.

    `fit` is the classical one.
    """
    R = triangle(np.concatenate(triangles(regressions, masks) / fit.sigma[:, None, None]))[:-1]
    R = R / np.sqrt(_correlation(regressions, masks, fit, R[:, :-1]))
    rank, extra = base.rank, R.shape[1] - 1 - base.rank
    data = np.concatenate([R[:, :rank] @ base.projection, R[:, rank : rank + extra]], axis=1)
    torque = np.sqrt(
        np.mean(np.concatenate([r.y[:, m] ** 2 for r, m in zip(regressions, masks, strict=True)], 1), 1)
    )
    own = np.array([[name == "offset" for name in linear(friction)]] * len(torque), float)
    own /= np.maximum(torque, np.finfo(float).tiny)[:, None]
    A = np.concatenate([data, np.diag(np.concatenate([1 / prior.std.ravel(), own.ravel()]))])
    return A, np.concatenate([R[:, -1], (prior.phi / prior.std).ravel(), np.zeros(extra)])


def _correlation(
    regressions: Sequence[Regression], masks: Masks, fit: Fit, T: Float[np.ndarray, "n n"]
) -> float:
    """How many of the residuals that the classical fit leaves tell as much as an independent one."""
    left = [r.only(m) for r, m in zip(regressions, masks, strict=True) if m.any()]
    e = np.concatenate([r.residual(fit.x) for r in left], 1) / fit.sigma[:, None]
    return samples_as_one(T, covariances(left, fit.x, fit.sigma)[2], float(np.mean(e**2)))


def friction_bounds(
    friction: str, dof: int, known: Mapping[str, Float[np.ndarray, " dof"]]
) -> tuple[Float[np.ndarray, " parameters"], Float[np.ndarray, " parameters"]]:
    """Bounds of the friction's linear parameters beyond what the model holds, in their columns' order."""
    lower = least_beyond(linear(friction), known, dof).ravel()
    return lower, np.full(len(lower), np.inf)
