r"""Gaussian evidence of candidate columns, projected on what everything else could not have absorbed.

The whitened model is $r = A x + \Phi c + e$ with $e \sim N(0, 1)$, $x \sim N(0, P^{-1})$, $c \sim N(0, S)$. With
$H = A^\top A + P$,

$$b = \Phi^\top r - (A^\top\Phi)^\top H^{-1} A^\top r, \qquad
  G = \Phi^\top\Phi - (A^\top\Phi)^\top H^{-1} A^\top\Phi$$

$$\log B = \tfrac12\, b^\top (G + S^{-1})^{-1} b - \tfrac12 \log|1 + S^{1/2} G S^{1/2}|$$

is the log Bayes factor of the candidate. This is at once a score test with nuisance parameters, orthogonal
forward regression, and Bayesian model selection.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
import scipy.linalg
import scipy.special
from jaxtyping import Float

SCALES = (1.0, 4.0, 16.0)
"""Sizes of an effect over the noise, per sample, that are expected alike."""
PHYSICAL_SCALES = (0.03, 0.1, 0.3, 1.0, 3.0)
"""Sizes over the physically plausible one, where a coefficient has such."""


@dataclasses.dataclass(frozen=True)
class Noise:
    """Autoregressive noise of each joint: $e_t = r_t - \\sum_k a_k r_{t-k}$, with deviation `sigma` [N m]."""

    a: Float[np.ndarray, "dof order"]
    sigma: Float[np.ndarray, " dof"]
    std: Float[np.ndarray, " dof"]
    """Of the noise itself [N m]."""

    def whiten(self, x: Float[np.ndarray, "_time ..."], joint: int) -> Float[np.ndarray, "_time ..."]:
        """x with unit, uncorrelated noise; the first rows are zero."""
        a = self.a[joint]
        y = np.zeros_like(x)
        order = len(a)
        y[order:] = x[order:]
        for k in range(order):
            y[order:] -= a[k] * x[order - 1 - k : len(x) - 1 - k]
        y /= self.sigma[joint]
        return y


class Design:
    """What is in the model already: whitened columns for each joint, and their prior."""

    def __init__(
        self,
        columns: Sequence[Float[np.ndarray, "rows n"]],
        residual: Sequence[Float[np.ndarray, " rows"]],
        precision: Float[np.ndarray, " n"],
    ):
        self.columns, self.residual, self.precision = columns, residual, precision
        H = np.diag(precision).astype(float)
        g = np.zeros(len(precision))
        for A, r in zip(columns, residual, strict=True):
            H += A.T @ A
            g += A.T @ r
        self.factor = scipy.linalg.cho_factor(H, lower=True) if len(g) else None
        self.g = g
        self.x = self.solve(g)

    def solve(self, y: np.ndarray) -> np.ndarray:
        """$H^{-1} y$."""
        return y if self.factor is None else scipy.linalg.cho_solve(self.factor, y)

    @property
    def covariance(self) -> Float[np.ndarray, "n n"]:
        """Of the coefficients, given the data."""
        return self.solve(np.eye(len(self.g)))

    @property
    def log_evidence(self) -> float:
        """Log evidence of the whole model, up to a constant of the data."""
        if self.factor is None:
            return 0.0
        half_determinant = np.log(np.diag(self.factor[0])).sum()
        return float(0.5 * self.g @ self.x - half_determinant + 0.5 * np.log(self.precision).sum())

    def in_joint(
        self, joint: int, Phi: Float[np.ndarray, "rows m n"], G: Float[np.ndarray, "m n n"]
    ) -> tuple[Float[np.ndarray, "m n"], Float[np.ndarray, "m n n"]]:
        """b and G of m candidates that act in one joint, given their Gram matrices."""
        rows, m, n = Phi.shape
        flat = Phi.reshape(rows, m * n)
        b = (flat.T @ (self.residual[joint] - self.columns[joint] @ self.x)).reshape(m, n)
        if self.factor is not None:
            C = scipy.linalg.solve_triangular(self.factor[0], self.columns[joint].T @ flat, lower=True)
            G = G - gram(C.reshape(-1, m, n))
        return b, G

    def in_arm(
        self, Phi: Sequence[Float[np.ndarray, "rows m n"]], grams: Sequence[Float[np.ndarray, "m n n"]]
    ) -> tuple[Float[np.ndarray, "m n"], Float[np.ndarray, "m n n"]]:
        """b and G of m candidates that act in all joints, given their Gram matrices in each."""
        _, m, n = Phi[0].shape
        b, G, C = np.zeros((m, n)), np.zeros((m, n, n)), np.zeros((len(self.g), m * n))
        for A, r, F, Q in zip(self.columns, self.residual, Phi, grams, strict=True):
            if not Q.any():
                continue
            flat = F.reshape(len(F), m * n)
            b += (flat.T @ (r - A @ self.x)).reshape(m, n)
            G += Q
            C += A.T @ flat
        if self.factor is not None:
            C = scipy.linalg.solve_triangular(self.factor[0], C, lower=True)
            G = G - gram(C.reshape(-1, m, n))
        return b, G


def gram(F: Float[np.ndarray, "rows m n"]) -> Float[np.ndarray, "m n n"]:
    """$F_m^\\top F_m$ of each m."""
    stacked = np.moveaxis(F, 1, 0)
    return np.matmul(np.swapaxes(stacked, 1, 2), stacked)


def log_bayes(
    b: Float[np.ndarray, "m n"],
    G: Float[np.ndarray, "m n n"],
    deviation: Float[np.ndarray, "m n"],
    scales: Sequence[float],
    signs: Float[np.ndarray, " n"] | None = None,
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Log Bayes factor of each candidate, averaged over the scales, and the scale that is likeliest.

    Args:
        b: projections of the residual.
        G: Gram matrices.
        deviation: prior deviation of each coefficient, before the scale.
        scales: multiples of it.
        signs: where a coefficient cannot be negative (1) or positive (-1): its half-normal prior counts.
    """
    n = b.shape[1]
    out = np.empty((len(scales), len(b)))
    for i, scale in enumerate(scales):
        D = scale * deviation
        B = D[:, :, None] * G * D[:, None, :] + np.eye(n)
        Db = D * b
        L = np.linalg.cholesky(B)
        y = np.linalg.solve(L, Db[..., None])[..., 0]
        out[i] = 0.5 * (y**2).sum(1) - np.log(np.diagonal(L, axis1=1, axis2=2)).sum(1)
        if signs is not None and np.any(signs):
            inverse = np.linalg.inv(B)
            mean = np.einsum("mab,mb->ma", inverse, Db)
            spread = np.sqrt(np.maximum(np.diagonal(inverse, axis1=1, axis2=2), 1e-300))
            allowed = scipy.special.log_ndtr(signs * mean / spread) + np.log(2.0)
            out[i] += np.where(signs != 0, allowed, 0.0).sum(1)
    return scipy.special.logsumexp(out, axis=0) - np.log(len(scales)), np.asarray(scales)[out.argmax(0)]
