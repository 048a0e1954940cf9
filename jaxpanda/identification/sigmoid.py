r"""The sigmoid friction of eq. 25: what is nonlinear in it, by variable projection.

$$\min_{\varphi_2, \varphi_3}\ \min_{\beta, \varphi_1} \sum_j
  \lVert F\tau_j - F Y_j\beta - \varphi_{1j} F s(\dot q_j; \varphi_{2j}, \varphi_{3j})\rVert^2/\sigma_j^2$$

For given steepness and shift the model is linear, so the outer problem has two unknowns a joint. Its
Jacobian is Kaufman's: derivatives of the sigmoid columns, less what the linear columns can follow.

References:
    Golub and Pereyra, SIAM J. Numerical Analysis 1973; Kaufman, BIT 1975.
"""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Array, Float

from ..friction import sigmoid
from ..signals import Signals
from .regression import Masks, Regression, moving, with_columns

_STEEPNESS = (1.0, 300.0)  # [s/rad]: from a line over the whole range of speeds to a step
_FIRST_STEEPNESS = 30.0  # [s/rad]
_SHIFT = 0.2  # [rad/s]: largest
_EVALUATIONS = 40

Shape = Float[np.ndarray, "2 dof"]
"""Steepness phi2 [s/rad] and shift phi3 [rad/s] of each joint."""


@jax.jit
@jax.vmap
@jax.vmap
def _column(qd: Float[Array, ""], log_phi2: Float[Array, ""], phi3: Float[Array, ""]) -> Float[Array, "3"]:
    """The sigmoid and its derivatives in log phi2 and phi3."""

    def f(a, b):
        return sigmoid(qd, jnp.exp(a), b)

    return jnp.stack([f(log_phi2, phi3), *jax.grad(f, (0, 1))(log_phi2, phi3)])


def _columns(signals: Signals, unknowns: Float[np.ndarray, "2 dof"]) -> Float[np.ndarray, "3 dof time"]:
    """Filtered sigmoid columns, and their derivatives."""
    qd = jnp.asarray(moving(signals))
    a, b = (jnp.broadcast_to(jnp.asarray(row), qd.shape) for row in unknowns)
    return np.moveaxis(signals.lowpass(np.asarray(_column(qd, a, b))), (2, 1), (0, 1))


def with_shape(rigid: Sequence[Regression], signals: Sequence[Signals], shape: Shape) -> list[Regression]:
    """The rigid problem with one more column a joint: the sigmoid of that shape."""
    unknowns = np.stack([np.log(shape[0]), shape[1]])
    return [
        dataclasses.replace(r, A=with_columns(r.A, _columns(s, unknowns)[0][:, :, None]))
        for r, s in zip(rigid, signals, strict=True)
    ]


def linearised(
    rigid: Sequence[Regression], signals: Sequence[Signals], shape: Shape, phi1: Float[np.ndarray, " dof"]
) -> list[Regression]:
    """The rigid problem with three more columns a joint: derivatives of its torque in phi1, phi2 and phi3.

    For standard deviations: around the solution the model is this.
    """
    unknowns = np.stack([np.log(shape[0]), shape[1]])
    factors = np.stack([np.ones_like(phi1), phi1 / shape[0], phi1])
    return [
        dataclasses.replace(
            r, A=with_columns(r.A, np.moveaxis(_columns(s, unknowns) * factors[:, :, None], 0, -1))
        )
        for r, s in zip(rigid, signals, strict=True)
    ]


def fit_shape(
    rigid: Sequence[Regression],
    signals: Sequence[Signals],
    masks: Masks,
    sigma: Float[np.ndarray, " dof"],
    first: Shape | None = None,
) -> Shape:
    """Steepness and shift of every joint's sigmoid.

    Args:
        rigid: the problem without friction columns.
        signals: the same recordings, for their velocities and filter.
        masks: which samples to use.
        sigma: residual each joint is weighted by [N m].
        first: where to start.
    """
    dof = len(sigma)
    A = np.concatenate([r.A[:, mask] for r, mask in zip(rigid, masks, strict=True)], 1) / sigma[:, None, None]
    y = np.concatenate([r.y[:, mask] for r, mask in zip(rigid, masks, strict=True)], 1) / sigma[:, None]
    norms = np.linalg.norm(A.reshape(-1, A.shape[2]), axis=0)
    Q = np.linalg.qr((A / np.where(norms > 0, norms, 1)).reshape(-1, A.shape[2]))[0]

    def project(columns: np.ndarray) -> np.ndarray:
        return columns - Q @ (Q.T @ columns)

    target = project(y.reshape(-1, 1))

    def spread(columns: Float[np.ndarray, "dof time"]) -> np.ndarray:
        return np.moveaxis(with_columns(np.zeros((*columns.shape, 0)), columns[:, :, None]), 2, -1).reshape(
            -1, dof
        )

    cache: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    def evaluate(unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        key = unknowns.tobytes()
        if key not in cache:
            cache.clear()
            parts = [
                _columns(s, unknowns.reshape(2, dof))[:, :, mask]
                for s, mask in zip(signals, masks, strict=True)
            ]
            S, by_log_phi2, by_phi3 = (
                np.concatenate([p[k] for p in parts], 1) / sigma[:, None] for k in range(3)
            )
            basis, triangle = np.linalg.qr(project(spread(S)))
            phi1 = np.linalg.lstsq(triangle, basis.T @ target, rcond=1e-12)[0][:, 0]
            residual = target - basis @ (basis.T @ target)
            slopes = project(np.concatenate([spread(by_log_phi2) * phi1, spread(by_phi3) * phi1], 1))
            cache[key] = residual[:, 0], -(slopes - basis @ (basis.T @ slopes))
        return cache[key]

    start = np.stack([np.full(dof, _FIRST_STEEPNESS), np.zeros(dof)]) if first is None else first
    low, high = np.log(_STEEPNESS)
    found = scipy.optimize.least_squares(
        lambda u: evaluate(u)[0],
        np.concatenate([np.log(start[0]), start[1]]),
        jac=lambda u: evaluate(u)[1],  # pyright: ignore[reportArgumentType]
        bounds=(np.repeat([low, -_SHIFT], dof), np.repeat([high, _SHIFT], dof)),
        x_scale=np.repeat([1.0, 0.05], dof),
        max_nfev=_EVALUATIONS,
        ftol=1e-5,
        xtol=1e-4,
    )
    return np.stack([np.exp(found.x[:dof]), found.x[dof:]])
