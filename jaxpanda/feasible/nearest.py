r"""Of links that could be built, those whose torque is nearest to that of links that could not.

$$\min_U\; \sum_t \lVert Y_t\,(\phi(U U^\top) - \hat\phi)\rVert^2
   + \sum_l \lVert U_l - U_l^0\rVert^2 / \lVert U_l^0\rVert^2$$

with the pseudo-inertias $J_l = U_l U_l^\top$ of the links, upper triangular $U_l$, and Y over the noise: what
the torque does not decide stays with the links that the search begins from.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels.inertia import from_pseudo_inertia, pseudo_inertia
from jaxtyping import Float
from scipy.optimize import least_squares

_STEPS = 200
"""On the boundary the last per cent of the misfit takes thousands."""
_INSIDE = 1e-6
"""Least eigenvalue of a pseudo-inertia where the search begins, as a share of the largest."""
_ROUNDING = 1e-9
_UPPER = np.triu_indices(4)
_BASIS = np.eye(16).reshape(16, 4, 4)


def are_buildable(links: Float[np.ndarray, "links 10"]) -> bool:
    """Whether every one is a body: whether its pseudo-inertia has no negative eigenvalue."""
    J = np.stack([np.asarray(pseudo_inertia(jnp.asarray(phi))) for phi in links])
    values = np.linalg.eigvalsh(J)
    return bool(np.all(values[:, 0] >= -_ROUNDING * values[:, -1]))


def nearest_buildable(
    found: Float[np.ndarray, "links 10"],
    carried: Float[np.ndarray, "links 10"],
    begin: Float[np.ndarray, "links 10"],
    root: Float[np.ndarray, "rows standard"],
    links: Sequence[int],
) -> Float[np.ndarray, "links 10"]:
    r"""The parameters of some links moved to where they can be built, the others as they were found.

    Args:
        found: standard parameters.
        carried: what of them belongs to bodies that stay as they are.
        begin: links that can be built, for the search to begin from.
        root: $R$ with $R^\top R = Y^\top Y$ of a motion, in units of the noise.
        links: those that may move.
    """
    moving = list(links)
    triangles = np.stack([_triangle(phi) for phi in (begin - carried)[moving]])
    size = np.linalg.norm(triangles, axis=1, keepdims=True)
    linear = np.stack([np.asarray(from_pseudo_inertia(jnp.asarray(0.5 * (E + E.T)))) for E in _BASIS], 1)
    felt = root.reshape(len(root), -1, 10)[:, moving]
    target = np.einsum("rlp,lp->r", felt, (found - carried)[moving])

    def factors(x: np.ndarray) -> np.ndarray:
        U = np.zeros((len(moving), 4, 4))
        U[:, *_UPPER] = x.reshape(len(moving), -1)
        return U

    def bodies(x: np.ndarray) -> np.ndarray:
        U = factors(x)
        return (U @ np.swapaxes(U, 1, 2)).reshape(len(moving), 16) @ linear.T

    def residual(x: np.ndarray) -> np.ndarray:
        away = (x.reshape(triangles.shape) - triangles) / size
        return np.concatenate([np.einsum("rlp,lp->r", felt, bodies(x)) - target, away.ravel()])

    def jacobian(x: np.ndarray) -> np.ndarray:
        steps = np.zeros((len(_UPPER[0]), 4, 4))
        steps[np.arange(len(steps)), *_UPPER] = 1.0
        turned = steps @ np.swapaxes(factors(x), 1, 2)[:, None]
        dphi = (turned + np.swapaxes(turned, 2, 3)).reshape(len(moving), len(steps), 16) @ linear.T
        torque = np.einsum("rlp,lkp->rlk", felt, dphi).reshape(len(felt), -1)
        return np.concatenate([torque, np.diag(np.repeat(1 / size, len(steps)))])

    solved = least_squares(
        residual,
        triangles.ravel(),
        jacobian,  # pyright: ignore[reportArgumentType]
        method="lm",
        x_scale="jac",
        max_nfev=_STEPS,
    )
    out = np.array(found, float)
    out[moving] = bodies(solved.x) + carried[moving]
    return out


def _triangle(phi: Float[np.ndarray, "10"]) -> Float[np.ndarray, "10"]:
    """The entries of U, where bodies on the boundary are moved inside."""
    values, vectors = np.linalg.eigh(np.asarray(pseudo_inertia(jnp.asarray(phi))))
    inside = (vectors * np.maximum(values, _INSIDE * max(values.max(), _INSIDE))) @ vectors.T
    return np.linalg.cholesky(inside[::-1, ::-1])[::-1, ::-1][_UPPER]
