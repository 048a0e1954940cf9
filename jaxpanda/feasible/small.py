"""Algebra of many symmetric 4x4 matrices at once: axes (links, 4, 4, lanes), the batch last and contiguous.

Written out entry by entry, because a library's decompositions under `vmap` handle one small matrix at a time.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

Matrices = Float[Array, "links 4 4 lanes"]

BISECTIONS = 7
# The ten entries of a symmetric matrix, row by row.
PAIRS = [(i, k) for i in range(4) for k in range(i, 4)]


def symmetric(entries: Float[Array, "links 10 lanes"]) -> Matrices:
    """The matrices with these entries, in the order of `PAIRS`."""
    at = lambda i, k: entries[:, PAIRS.index((min(i, k), max(i, k)))]
    return jnp.stack([jnp.stack([at(i, k) for k in range(4)], 1) for i in range(4)], 1)


def entries(matrices: Matrices) -> Float[Array, "links 10 lanes"]:
    """The inverse of `symmetric`."""
    return jnp.concatenate([matrices[:, i, i:] for i in range(4)], 1)


def adjoint(matrices: Matrices) -> Float[Array, "links 10 lanes"]:
    r"""$\langle E_q, Z\rangle$ with $S = \sum_q s_q E_q$: entries, those off the diagonal twice."""
    parts = [p for i in range(4) for p in (matrices[:, i, i : i + 1], 2 * matrices[:, i, i + 1 :])]
    return jnp.concatenate(parts, 1)


def product(M: Matrices, N: Matrices) -> Matrices:
    return sum((M[:, :, j, None] * N[:, None, j] for j in range(1, 4)), M[:, :, 0, None] * N[:, None, 0])


def symmetric_part(M: Matrices) -> Matrices:
    return 0.5 * (M + jnp.swapaxes(M, 1, 2))


def inner(M: Matrices, N: Matrices) -> Float[Array, " lanes"]:
    """Sum of the traces of M N over the links."""
    return jnp.sum(M * N, (0, 1, 2))


def _cholesky(M: Matrices) -> list[list[Array]]:
    """Lower triangular factor, by rows; not a number where M is not positive definite."""
    L: list[list[Array]] = []
    for i in range(4):
        row: list[Array] = []
        for k in range(i):
            rest = sum((row[j] * L[k][j] for j in range(k)), jnp.zeros_like(M[:, 0, 0]))
            row.append((M[:, i, k] - rest) / L[k][k])
        row.append(jnp.sqrt(M[:, i, i] - sum((x * x for x in row), jnp.zeros_like(M[:, 0, 0]))))
        L.append(row)
    return L


def inverse(M: Matrices) -> Matrices:
    """Of positive definite matrices."""
    L = _cholesky(M)
    W: list[list[Array]] = []  # the factor's inverse
    for i in range(4):
        d = 1 / L[i][i]
        W.append(
            [-d * sum((L[i][j] * W[j][k] for j in range(k + 1, i)), L[i][k] * W[k][k]) for k in range(i)]
            + [d]
        )
    found = [sum((W[j][i] * W[j][k] for j in range(k + 1, 4)), W[k][i] * W[k][k]) for i, k in PAIRS]
    # Without the barrier, the compiler computes everything above anew for each entry that is stacked.
    found = jax.lax.optimization_barrier(found)
    return symmetric(jnp.stack(found, 1))


def is_positive(M: list[Array] | Matrices) -> Bool[Array, "links lanes"]:
    """Whether the matrices are positive definite, by their pivots."""
    a, b, c, d, e, f, g, h, i, j = M if isinstance(M, list) else [M[:, r, k] for r, k in PAIRS]
    r = 1 / a
    B, C, D = b * r, c * r, d * r
    e, f, g, h, i, j = e - b * B, f - b * C, g - b * D, h - c * C, i - c * D, j - d * D
    r = 1 / e
    F, G = f * r, g * r
    h2, i, j2 = h - f * F, i - f * G, j - g * G
    return (a > 0) & (e > 0) & (h2 > 0) & (j2 * h2 > i * i) & (j2 > 0)


def longest_step(M: Matrices, D: Matrices) -> Float[Array, " lanes"]:
    r"""The largest $\alpha \le 1$, to a hundredth, with $M + \alpha D$ positive definite in every link.

    By bisection in $\sqrt\alpha$: relative precision where short steps are all there is.
    """
    at = lambda t: is_positive([M[:, i, k] + t * t * D[:, i, k] for i, k in PAIRS])
    one = jnp.ones_like(M[:, 0, 0])
    low, high = jnp.where(at(one), one, 0.0), one
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        inside = at(middle)
        low, high = jnp.where(inside, middle, low), jnp.where(inside, high, middle)
    return jnp.min(low, 0) ** 2


def curvature(M: Matrices, N: Matrices) -> Float[Array, "links 10 10 lanes"]:
    r"""$\mathrm{tr}(E_q M E_r N)$ made symmetric; with $M = N = S^{-1}$ the Hessian of $-\log\det S$."""
    rows, columns = lambda X: X[:, :, None, :, None], lambda X: X[:, None, :, None, :]
    crossed = lambda X: X[:, :, None, None, :], lambda X: X[:, None, :, :, None]
    straight = rows(M) * columns(N) + rows(N) * columns(M)
    K = straight + crossed[0](M) * crossed[1](N) + crossed[0](N) * crossed[1](M)  # (links, i, k, j, l, lanes)
    half = jnp.where(jnp.eye(4, dtype=bool), 0.5, 1.0)
    K = K * half[:, :, None, None, None] * half[:, :, None]
    K = jnp.concatenate([K[:, i, i:] for i in range(4)], 1)
    return jnp.concatenate([K[:, :, i, i:] for i in range(4)], 2)
