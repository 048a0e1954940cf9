"""Systems with many symmetric positive definite matrices, a batch at a time: by the library on a processor, by
blocks on a GPU.

A GPU's library factors matrices of an arm's size, and solves with one right-hand side, one after the other within
a thread block; a few products of their blocks for all matrices at once take half as long.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_BLOCK = 14


def factor(H: Float[Array, "lanes n n"]) -> Float[Array, "lanes n n"]:
    """What `solve` needs of H; not a number where H is not positive definite."""
    return jax.lax.platform_dependent(H, cpu=cholesky, default=by_blocks)


def solve(factor: Float[Array, "lanes n n"], rhs: Float[Array, "lanes n"]) -> Float[Array, "lanes n"]:
    """$H^{-1}$ rhs."""
    return jax.lax.platform_dependent(factor, rhs, cpu=substitute, default=substitute_by_blocks)


def cholesky(H):
    return jax.lax.linalg.cholesky(H, symmetrize_input=False)


def substitute(L, rhs):
    x = rhs[..., None]
    for transpose in (False, True):
        x = jax.lax.linalg.triangular_solve(L, x, left_side=True, lower=True, transpose_a=transpose)
    return x[..., 0]


def _ranges(n: int) -> list[tuple[slice, slice]]:
    """Each block of columns, and the rows below it."""
    starts = range(0, n, _BLOCK)
    return [(slice(i, min(i + _BLOCK, n)), slice(min(i + _BLOCK, n), n)) for i in starts]


def by_blocks(H):
    """The Cholesky factor, but for the blocks on the diagonal: those are inverted."""
    columns, rest = [], H
    for here, _ in _ranges(H.shape[1]):
        w = here.stop - here.start
        L = cholesky(rest[:, :w, :w])
        unit = jnp.broadcast_to(jnp.eye(w, dtype=H.dtype), L.shape)
        inverse = jax.lax.linalg.triangular_solve(L, unit, left_side=True, lower=True)
        below = rest[:, w:, :w] @ jnp.swapaxes(inverse, 1, 2)
        columns.append(jnp.pad(jnp.concatenate([inverse, below], 1), ((0, 0), (here.start, 0), (0, 0))))
        rest = rest[:, w:, w:] - below @ jnp.swapaxes(below, 1, 2)
    return jnp.concatenate(columns, 2)


def substitute_by_blocks(factor, rhs):
    blocks = [(here, factor[:, here, here], factor[:, below, here]) for here, below in _ranges(rhs.shape[1])]
    y = []
    for here, inverse, below in blocks:
        y.append(jnp.einsum("bij,bj->bi", inverse, rhs[:, : here.stop - here.start]))
        rhs = rhs[:, here.stop - here.start :] - jnp.einsum("bij,bj->bi", below, y[-1])
    x = rhs
    for (_, inverse, below), part in zip(reversed(blocks), reversed(y), strict=True):
        left = part - jnp.einsum("bij,bi->bj", below, x)
        x = jnp.concatenate([jnp.einsum("bij,bi->bj", inverse, left), x], 1)
    return x
