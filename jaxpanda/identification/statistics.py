r"""How sure a least-squares estimate is, where its residuals are not white.

With weights $w_j = 1/\sigma_j^2$ and $H = \sum_j w_j A_j^\top A_j$ the textbook covariance is $s^2 H^{-1}$:
every sample of every joint counts as independent. Filtered samples are not, and what a rigid model leaves is
mostly missing physics, smooth in time and common to several joints: those deviations are several times too
small.

The delete-a-block jackknife asks the data instead. With block b left out the estimate moves by

$$\Delta_b = -(H - H_b)^{-1} \sum_{t \in b} \sum_j w_j\, a_{jt} e_{jt}, \qquad
  \mathrm{cov} = \frac{B - 1}{B} \sum_b (\Delta_b - \bar\Delta)(\Delta_b - \bar\Delta)^\top .$$

It needs blocks longer than the correlation of the residual and no model of it. On the Panda's exciting
trajectory with noise of known parameters (white, correlated over 0.2 s, common to all joints; low-passed at 2
and 5 Hz) its 95 % intervals held the truth 93 to 96 % of the time, the textbook's 25 to 45 %, and those of a
long-run covariance (Newey and West's) 80 to 93 %: residuals of 64 fitted parameters are smaller than errors.

References:
    Künsch, "The jackknife and the bootstrap for general stationary observations", Annals of Statistics 1989;
    MacKinnon and White, J. Econometrics 1985 (the jackknife and leverage).
"""

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from .regression import UNDETERMINED, Regression

BLOCKS = 20
"""Blocks of the jackknife: a second each in a recording of 20 s."""
_TOLD = 1e-13
"""Information that counts, as a share of the largest, unknowns in units of their own."""
_UNTOLD = 1e14
"""Variance that stands for no information, in the same units."""


def covariances(
    regressions: Sequence[Regression], x: Float[np.ndarray, " unknowns"], sigma: Float[np.ndarray, " dof"]
) -> tuple[
    Float[np.ndarray, "unknowns unknowns"],
    Float[np.ndarray, "unknowns unknowns"],
    Float[np.ndarray, "unknowns unknowns"],
]:
    """Covariance of weighted least squares: by the jackknife, by the textbook, and `shrunk` between them."""
    weights = 1 / sigma**2
    H = np.zeros((len(x), len(x)))
    informations, scores, total, squares = [], [], 0, 0.0
    for r in regressions:
        e = r.residual(x)
        total += e.size
        squares += float(np.sum(weights[:, None] * e**2))
        for block in cut(
            e.shape[1], max(2, round(BLOCKS * e.shape[1] / sum(s.y.shape[1] for s in regressions)))
        ):
            A = r.A[:, block]
            informations.append(np.einsum("j,jta,jtb->ab", weights, A, A, optimize=True))
            scores.append(np.einsum("j,jta,jt->a", weights, A, e[:, block], optimize=True))
            H += informations[-1]
    scale = _units(H)
    scaling = np.outer(scale, scale)
    classical = squares / max(total - len(x), 1) * _inverse(H / scaling)
    moves = _moves(H, informations, scores)
    return _spread(moves) / scaling, classical / scaling, shrunk(H, informations, scores)


def jackknife(
    H: Float[np.ndarray, "n n"],
    informations: Sequence[Float[np.ndarray, "n n"]],
    scores: Sequence[Float[np.ndarray, " n"]],
) -> Float[np.ndarray, "n n"]:
    """Covariance of estimated unknowns, by leaving out one block after another.

    Args:
        H: information of all blocks, and of a prior if there is one.
        informations: what each block adds to it.
        scores: $A_b^\\top e_b$ of each block, with the weighted residual of the estimate.
    """
    scale = _units(H)
    return _spread(_moves(H, informations, scores)) / np.outer(scale, scale)


def shrunk(
    H: Float[np.ndarray, "n n"],
    informations: Sequence[Float[np.ndarray, "n n"]],
    scores: Sequence[Float[np.ndarray, " n"]],
) -> Float[np.ndarray, "n n"]:
    r"""The jackknife's covariance, drawn towards the shape of $H^{-1}$ as far as its few blocks require.

    B blocks span B - 1 directions of the unknowns: of the others the jackknife says that they are known exactly.
    Where $H = 1$, with $z_b = \sqrt{B - 1}\,(\Delta_b - \bar\Delta)$ and $S = \sum z_b z_b^\top / B$,

    $$\mathrm{cov} = (1 - \rho)\,S + \rho\,\tfrac{\mathrm{tr} S}{n}\,1, \qquad
      \rho = \min\Bigl(1, \frac{\sum_b \lVert z_b z_b^\top - S\rVert^2 / B^2}
                             {\lVert S - \tfrac{\mathrm{tr} S}{n} 1\rVert^2}\Bigr).$$

    It has full rank, so that parameters can be drawn from it and differences of them weighed by it.

    References:
        Ledoit and Wolf, "A well-conditioned estimator for large-dimensional covariance matrices", J. Multivariate
        Analysis 2004.
    """
    scale = _units(H)
    values, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    told = values > _TOLD * values[-1]
    root = vectors[:, told] * np.sqrt(values[told])
    z = np.sqrt(len(scores) - 1) * _moves(H, informations, scores) @ root
    count, n = z.shape
    S = z.T @ z / count
    mean = np.trace(S) / n
    own, away = np.sum(z**2, 1), float(np.sum((S - mean * np.eye(n)) ** 2))
    sampled = float(np.sum(own**2) / count - np.sum(S**2)) / count
    rho = min(1.0, sampled / away) if away > 0 else 1.0
    back = vectors[:, told] / np.sqrt(values[told]) / scale[:, None]
    untold = vectors[:, ~told] / scale[:, None]
    return back @ ((1 - rho) * S + rho * mean * np.eye(n)) @ back.T + _UNTOLD * untold @ untold.T


def samples_as_one(
    T: Float[np.ndarray, "n n"], covariance: Float[np.ndarray, "n n"], square: float = 1.0
) -> float:
    r"""How many samples of correlated residuals tell as much as an independent one.

    The mean, over the directions that $T^\top T$ tells of, of the variance of an estimate over the textbook's.

    Args:
        T: a root of the information of independent samples, as weighted.
        covariance: of the estimate, robust.
        square: mean square of a weighted residual.

    Returns:
        At least one; not finite where the covariance is none of finite variances.
    """
    scale = np.linalg.norm(T, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    _, s, directions = np.linalg.svd(T / scale)
    told = s > np.sqrt(_TOLD) * s[0]
    moved = s[told, None] * directions[told] * scale
    with np.errstate(over="ignore", invalid="ignore"):
        variance = np.mean(np.einsum("ia,ab,ib->i", moved, covariance, moved))
    return float(np.maximum(1.0, variance / max(square, np.finfo(float).tiny)))


def _moves(
    H: Float[np.ndarray, "n n"],
    informations: Sequence[Float[np.ndarray, "n n"]],
    scores: Sequence[Float[np.ndarray, " n"]],
) -> Float[np.ndarray, "blocks n"]:
    """By how much the unknowns, in `_units`, move without each block, less the mean of that."""
    scale = _units(H)
    scaling = np.outer(scale, scale)
    moves = np.stack(
        [-_inverse((H - Hb) / scaling) @ (s / scale) for Hb, s in zip(informations, scores, strict=True)]
    )
    return moves - moves.mean(0)


def _spread(moves: Float[np.ndarray, "blocks n"]) -> Float[np.ndarray, "n n"]:
    return (len(moves) - 1) / len(moves) * moves.T @ moves


def _units(H: Float[np.ndarray, "n n"]) -> Float[np.ndarray, " n"]:
    """In which the information of every unknown is one."""
    return np.sqrt(np.where(np.diag(H) > 0, np.diag(H), 1.0))


def determined(
    regressions: Sequence[Regression], sigma: Float[np.ndarray, " dof"]
) -> Bool[np.ndarray, " unknowns"]:
    """Which unknowns the data tell at all: those without part in any direction that moves no torque."""
    H = np.sum([np.einsum("j,jta,jtb->ab", 1 / sigma**2, r.A, r.A, optimize=True) for r in regressions], 0)
    scale = _units(H)
    values, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    null = vectors[:, values < UNDETERMINED**2 * values[-1] + 1e-14 * len(H)]
    return np.sum(null**2, axis=1) < 1e-6


def cut(samples: int, blocks: int) -> list[slice]:
    """Stretches of about as many samples each."""
    edges = np.linspace(0, samples, min(blocks, samples) + 1).round().astype(int)
    return [slice(a, b) for a, b in itertools.pairwise(edges)]


def _inverse(H: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Inverse of an information matrix; enormous, but finite, where there is none."""
    values, vectors = np.linalg.eigh(H)
    return (vectors / np.maximum(values, 1 / _UNTOLD)) @ vectors.T
