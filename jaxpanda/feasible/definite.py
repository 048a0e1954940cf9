"""Systems with many symmetric positive definite matrices, a batch at a time: by the library on a processor; on a
GPU a thread each (`threads`) or, where there are too few to keep it busy, by blocks.

A GPU's library factors matrices of an arm's size, and solves with one right-hand side, one after the other within
a thread block; a few products of their blocks for all matrices at once take half as long.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from . import threads

_MANY = 16384
"""Matrices from which on a thread each takes less time than blocks do."""
_BLOCK = 14


class Summed(NamedTuple):
    r"""Matrices $C + w\,aa^\top + \sum_k r_k r_k^\top + D$ and blocks on the diagonal, from the first row on."""

    constant: Float[Array, "n n"]
    """C"""
    common: Float[Array, " n"]
    """a"""
    weight: Float[Array, " lanes"]
    """w"""
    blocks: Float[Array, "blocks size size lanes"]
    rows: Float[Array, "rows n lanes"]
    """r"""
    diagonal: Float[Array, "n lanes"]
    """D"""


def factor(H: Float[Array, "lanes n n"]) -> Float[Array, "lanes n n"]:
    """What `solve` needs of H; not a number where H is not positive definite."""
    if len(H) >= _MANY:
        by_threads = lambda H: jnp.moveaxis(threads.factor(jnp.moveaxis(H, 0, -1)), -1, 0)
        return jax.lax.platform_dependent(H, cpu=cholesky, cuda=by_threads, default=by_blocks)
    return jax.lax.platform_dependent(H, cpu=cholesky, default=by_blocks)


def factor_of_sum(H: Summed) -> Float[Array, "lanes n n"]:
    """The same of matrices that need not be written down where each thread has its own."""
    if len(H.weight) >= _MANY:
        by_threads = lambda *parts: jnp.moveaxis(threads.factor_of_sum(*parts), -1, 0)
        cpu, default = (lambda *parts, f=f: f(dense(Summed(*parts))) for f in (cholesky, by_blocks))
        return jax.lax.platform_dependent(*H, cpu=cpu, cuda=by_threads, default=default)
    return factor(dense(H))


def dense(H: Summed) -> Float[Array, "lanes n n"]:
    """Lanes first, as the library wants them."""
    count, size, _, lanes = H.blocks.shape
    n, columns = count * size, len(H.constant)
    blocks = jax.lax.optimization_barrier(jnp.moveaxis(H.blocks, -1, 0))
    spread = (blocks[:, :, :, None] * jnp.eye(count)[:, None, :, None]).reshape(lanes, n, n)
    if columns > n:
        spread = jnp.pad(spread, ((0, 0), (0, columns - n), (0, columns - n)))
    found = H.constant + spread + H.weight[:, None, None] * (H.common[:, None] * H.common)
    if len(H.rows):
        found = found + jnp.einsum("kpb,kqb->bpq", H.rows, H.rows)
    return found + H.diagonal.T[:, :, None] * jnp.eye(columns)


def solve(factor: Float[Array, "lanes n n"], rhs: Float[Array, "lanes n"]) -> Float[Array, "lanes n"]:
    """$H^{-1}$ rhs."""
    if len(rhs) >= _MANY:
        by_threads = lambda F, rhs: threads.solve(jnp.moveaxis(F, 0, -1), rhs.T).T
        return jax.lax.platform_dependent(
            factor, rhs, cpu=substitute, cuda=by_threads, default=substitute_by_blocks
        )
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
