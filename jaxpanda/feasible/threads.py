"""Cholesky factors of many matrices on a GPU, a thread each: arrays with the matrices ("lanes") last.

A thread keeps one block of its matrix in registers, and takes off it what the blocks to the left contribute,
which it has finished before. So an entry of the factor is written once, and read once for each block below it and
beside it. A thread waits for most of what it reads: it takes some ten thousand of them to keep a GPU busy.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

_BLOCK = 5
"""Rows of a block. With 7, a factor takes a little less time, and many times as long to compile."""
_THREADS = 32
"""Of a group."""
_LOWER = [(r, s) for r in range(_BLOCK) for s in range(r + 1)]
_WHOLE = [(r, s) for r in range(_BLOCK) for s in range(_BLOCK)]


def factor(H: Float[Array, "n n lanes"], interpret: bool = False) -> Float[Array, "n n lanes"]:
    """The Cholesky factor, but for the blocks on the diagonal: those are inverted. Above them is anything.

    Args:
        H: symmetric; its lower triangle is read.
        interpret: run it without a GPU, slowly.
    """
    n, _, lanes = H.shape
    filled = _with_unit(H)
    return _launched(_factor, filled.shape, interpret, filled)[:n, :n, :lanes]


def factor_of_sum(
    constant: Float[Array, "n n"],
    common: Float[Array, " n"],
    weight: Float[Array, " lanes"],
    blocks: Float[Array, "blocks size size lanes"],
    rows: Float[Array, "rows n lanes"],
    diagonal: Float[Array, "n lanes"],
    interpret: bool = False,
) -> Float[Array, "n n lanes"]:
    """The same of `definite.Summed`, of which H is never written down."""
    n, lanes = diagonal.shape
    size, all_lanes = whole = _whole_blocks(n, lanes)
    parts = [
        _filled(constant, size, size) + _unit_beyond(n, size),
        _filled(common, size),
        _filled(weight, all_lanes),
        _filled(blocks, *blocks.shape[:3], all_lanes),
        *_filled(rows, len(rows), *whole),
        _filled(diagonal, *whole),
    ]
    return _launched(_factor_of_sum, (size, size, all_lanes), interpret, *parts)[:n, :n, :lanes]


def solve(
    factor: Float[Array, "n n lanes"], rhs: Float[Array, "n lanes"], interpret: bool = False
) -> Float[Array, "n lanes"]:
    """$H^{-1}$ rhs."""
    n, lanes = rhs.shape
    whole = _whole_blocks(n, lanes)
    return _launched(_solve, whole, interpret, _with_unit(factor), _filled(rhs, *whole))[:n, :lanes]


def _whole_blocks(n: int, lanes: int) -> tuple[int, int]:
    """Rows and lanes up to whole blocks and groups."""
    return n + -n % _BLOCK, lanes + -lanes % _THREADS


def _filled(x: Array, *shape: int) -> Array:
    return jnp.pad(x, [(0, whole - own) for own, whole in zip(x.shape, shape, strict=True)])


def _with_unit(H: Float[Array, "n n lanes"]) -> Float[Array, "rows rows all"]:
    n, _, lanes = H.shape
    rows, all_lanes = _whole_blocks(n, lanes)
    filled = _filled(H, rows, rows, all_lanes)
    return filled if rows == n else filled + _unit_beyond(n, rows)[..., None]


def _unit_beyond(n: int, rows: int) -> Float[Array, "rows rows"]:
    """Of the rows that only fill a block: a unit matrix, which leaves the others alone."""
    return jnp.diag(jnp.arange(rows) >= n).astype(float)


def _launched(kernel: Any, shape: tuple[int, ...], interpret: bool, *arrays: Array) -> Array:
    from jax.experimental import pallas as pl  # a third of a second, that only a GPU needs
    from jax.experimental.pallas import triton

    return pl.pallas_call(
        functools.partial(_with_blocks, kernel, shape[0] // _BLOCK),
        jax.ShapeDtypeStruct(shape, arrays[0].dtype),
        grid=(shape[-1] // _THREADS,),
        compiler_params=triton.CompilerParams(num_warps=_THREADS // 32),
        interpret=interpret,
    )(*arrays)


Axis = Any
"""Along an axis: a number, or a block's and that of an entry within it."""


def _with_blocks(kernel: Any, count: int, *refs: Any) -> None:
    """Call the kernel with what reads and writes its lane's numbers, and what reads those that lanes share."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    own = _THREADS * pl.program_id(0) + jnp.arange(_THREADS)

    def place(axes: tuple[Axis, ...]) -> tuple[Any, ...]:
        return tuple(_BLOCK * axis[0] + axis[1] if isinstance(axis, tuple) else axis for axis in axes)

    get = lambda ref, *axes: triton.load(ref.at[(*place(axes), own)])
    put = lambda ref, x, *axes: triton.store(ref.at[(*place(axes), own)], x)
    shared = lambda ref, *axes: ref[place(axes)]
    kernel(get, put, shared, count, *refs)


def _factor(get: Any, put: Any, _: Any, count: int, H: Any, F: Any) -> None:
    entries = lambda i, k, places: tuple(get(H, (i, r), (k, s)) for r, s in places)
    _factored(entries, get, put, count, F)


def _factor_of_sum(get: Any, put: Any, shared: Any, count: int, *refs: Any) -> None:
    constant, common, weight, blocks, *rows, diagonal, F = refs
    of_block = blocks.shape[1] // _BLOCK
    within = blocks.shape[0] * of_block

    def entries(i: Any, k: Any, places: list[tuple[int, int]]) -> tuple[Array, ...]:
        a = [shared(common, (i, r)) for r in range(_BLOCK)]
        b = [get(weight) * shared(common, (k, s)) for s in range(_BLOCK)]
        found = tuple(shared(constant, (i, r), (k, s)) + a[r] * b[s] for r, s in places)
        for row in rows:
            a = [get(row, (i, r)) for r in range(_BLOCK)]
            b = [get(row, (k, s)) for s in range(_BLOCK)]
            found = tuple(x + a[r] * b[s] for x, (r, s) in zip(found, places, strict=True))
        block = lax.div(i, jnp.asarray(of_block, i.dtype))
        in_row, in_column = i - block * of_block, k - block * of_block

        def with_block(found: tuple[Array, ...]) -> tuple[Array, ...]:
            own = (get(blocks, block, (in_row, r), (in_column, s)) for r, s in places)
            return tuple(x + y for x, y in zip(found, own, strict=True))

        found = lax.cond((in_column >= 0) & (i < within), with_block, lambda found: found, found)
        if places is _LOWER:  # on the diagonal
            found = tuple(
                x + get(diagonal, (k, r)) if r == s else x for x, (r, s) in zip(found, places, strict=True)
            )
        return found

    _factored(entries, get, put, count, F)


def _factored(entries: Any, get: Any, put: Any, count: int, F: Any) -> None:
    def less_left(i: Any, k: Any, places: list[tuple[int, int]]) -> dict[tuple[int, int], Array]:
        """Block (i, k) of H less what those to the left contribute."""

        def of_block(j: Any, left: tuple[Array, ...]) -> tuple[Array, ...]:
            for c in range(_BLOCK):
                a = [get(F, (i, r), (j, c)) for r in range(_BLOCK)]
                b = a if places is _LOWER else [get(F, (k, s), (j, c)) for s in range(_BLOCK)]
                left = tuple(x - a[r] * b[s] for x, (r, s) in zip(left, places, strict=True))
            return left

        return dict(zip(places, lax.fori_loop(0, k, of_block, entries(i, k, places)), strict=True))

    def column(k: Any, _: None) -> None:
        M, L, V = less_left(k, k, _LOWER), {}, {}
        for r in range(_BLOCK):
            for s in range(r):
                L[r, s] = (M[r, s] - sum(L[r, t] * L[s, t] for t in range(s))) * V[s, s]
            V[r, r] = lax.rsqrt(M[r, r] - sum(L[r, t] * L[r, t] for t in range(r)))
            for s in range(r):
                V[r, s] = -V[r, r] * sum(L[r, t] * V[t, s] for t in range(s, r))
        for r, s in _LOWER:
            put(F, V[r, s], (k, r), (k, s))

        def below(i: Any, _: None) -> None:
            M = less_left(i, k, _WHOLE)
            for s in range(_BLOCK):
                v = [get(F, (k, s), (k, t)) for t in range(s + 1)]
                for r in range(_BLOCK):
                    put(F, sum(M[r, t] * v[t] for t in range(s + 1)), (i, r), (k, s))

        lax.fori_loop(k + 1, count, below, None)

    lax.fori_loop(0, count, column, None)


def _solve(get: Any, put: Any, _: Any, count: int, F: Any, rhs: Any, x: Any) -> None:
    each = range(_BLOCK)
    block = lambda ref, k: tuple(get(ref, (k, r)) for r in each)

    def keep(k: Any, values: list[Any]) -> None:
        for r in each:
            put(x, values[r], (k, r))

    def forward(k: Any, _: None) -> None:
        def less(j: Any, left: tuple[Array, ...]) -> tuple[Array, ...]:
            y = block(x, j)
            return tuple(left[r] - sum(get(F, (k, r), (j, c)) * y[c] for c in each) for r in each)

        left = lax.fori_loop(0, k, less, block(rhs, k))
        keep(k, [sum(get(F, (k, r), (k, s)) * left[s] for s in range(r + 1)) for r in each])

    def backward(step: Any, _: None) -> None:
        k = count - 1 - step

        def less(i: Any, left: tuple[Array, ...]) -> tuple[Array, ...]:
            z = block(x, i)
            return tuple(left[c] - sum(get(F, (i, r), (k, c)) * z[r] for r in each) for c in each)

        left = lax.fori_loop(k + 1, count, less, block(x, k))
        keep(k, [sum(get(F, (k, r), (k, s)) * left[r] for r in range(s, _BLOCK)) for s in each])

    lax.fori_loop(0, count, forward, None)
    lax.fori_loop(0, count, backward, None)
