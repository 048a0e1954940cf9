"""Parts of a program that XLA is kept from fusing with what consumes them."""

from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
from jax import lax

THREADS = 128
"""Of a block on a GPU."""

T = TypeVar("T")


def alone(f: Callable[..., T], *arguments: Any) -> T:
    """`f(*arguments)`, compiled as if it were a program of its own.

    XLA fuses producers into each of their consumers and computes them again for every element; through a
    `stack` that costs a factor of three on a GPU, and of ten to ten thousand on a CPU, where
    `lax.optimization_barrier` is dropped before anything is fused. There this is a loop of two rounds, the
    first of which does nothing: fusion does not look across it, and neither `vmap`, `grad` nor sharding takes
    it apart.

    Reverse mode keeps the arguments and computes `f` again, where it would otherwise keep each intermediate.
    Python floats, in and out, stay floats.
    """
    compute, values, restore = _of_arrays(f, arguments)
    compute = jax.checkpoint(compute)

    def looped(*values: jax.Array) -> list[jax.Array]:
        def round(carry, now):
            return lax.cond(now, lambda _: compute(*values), lambda same: same, carry), None

        empty = [jnp.zeros(s.shape, s.dtype) for s in jax.eval_shape(compute, *values)]
        return lax.scan(round, empty, jnp.array([False, True]))[0]

    def fenced(*values: jax.Array) -> list[jax.Array]:
        return lax.optimization_barrier(compute(*values))

    return restore(lax.platform_dependent(*values, cpu=looped, default=fenced))


def in_registers(f: Callable[..., T], *arguments: Any, interpret: bool = False) -> T:
    """`f(*arguments)` in one kernel of a GPU, a sample a thread: nothing but arguments and results moves.

    For programs with so many results that XLA cuts them into kernels which hand on more than they deliver. Triton
    takes a few primitives, among them all of plain arithmetic. As with `alone`, floats stay floats, and reverse
    mode computes `f` again.

    Args:
        f: gives arrays (samples,), each number by itself from those of the same sample.
        arguments: trees of arrays (samples,) and (), of one dtype.
        interpret: run it without a GPU, slowly.
    """
    from jax.experimental import pallas as pl  # a third of a second, that only a GPU needs
    from jax.experimental.pallas import triton

    compute, values, restore = _of_arrays(f, arguments)
    places = [k for k, x in enumerate(values) if x.ndim]
    single = [k for k, x in enumerate(values) if not x.ndim]  # handed over as one array
    count = values[places[0]].shape[0]

    def kernel(numbers: Any, *refs: Any) -> None:
        here = THREADS * pl.program_id(0) + jnp.arange(THREADS)
        filled = here < count
        own = {
            k: triton.load(ref.at[here], mask=filled, other=0) for k, ref in zip(places, refs, strict=False)
        }
        own |= {k: numbers[i] for i, k in enumerate(single)}
        results = compute(*(own[k] for k in range(len(values))))
        for ref, result in zip(refs[len(places) :], results, strict=True):
            triton.store(ref.at[here], result, mask=filled)

    @jax.custom_jvp
    def run(*values: jax.Array) -> list[jax.Array]:
        call = pl.pallas_call(
            kernel,
            jax.eval_shape(compute, *values),
            grid=(pl.cdiv(count, THREADS),),
            compiler_params=triton.CompilerParams(num_warps=THREADS // 32),
            interpret=interpret,
        )
        numbers = jnp.stack([*(values[k] for k in single), jnp.zeros_like(values[0], shape=())])
        return list(call(numbers, *(values[k] for k in places)))

    run.defjvp(lambda primals, tangents: jax.jvp(jax.checkpoint(compute), primals, tangents))
    return restore(run(*values))


Stage: TypeAlias = Callable[..., Any]
"""Calls its first argument with the rest, as `alone` does."""


def in_chunks(f: Callable[..., T], size: int, *columns: Any) -> T:
    """`f(stage, *columns)` for `size` samples at a time: what its stages hand on stays in the cache.

    For programs with so many results that on a CPU, where no loop has several, most of the arithmetic would be
    done again for each. Cut into stages, by `stage(g, ...)` in place of `g(...)`, it is done about once. Within
    the loop over chunks a stage is a branch that is always taken, cheaper than the loop that `alone` needs.

    Args:
        f: gives arrays with as many samples as its arguments.
        size: number of samples a chunk, which must divide theirs.
        columns: trees of arrays (samples,).
    """

    def chunk(now: jax.Array, values: Any) -> Any:
        def stage(g: Callable[..., Any], *arguments: Any) -> Any:
            compute, arrays, restore = _of_arrays(g, arguments)
            shapes = jax.eval_shape(compute, *arrays)

            def nothing(*_: jax.Array) -> list[jax.Array]:
                return [jnp.zeros(s.shape, s.dtype) for s in shapes]

            return restore(lax.cond(now, compute, nothing, *arrays))

        return f(stage, *values)

    chunks = jax.tree.map(lambda x: x.reshape(-1, size), columns)
    always = jnp.ones(len(jax.tree.leaves(chunks)[0]), bool)  # read in the loop: XLA does not know them there
    results = lax.scan(lambda _, x: (None, chunk(*x)), None, (always, chunks))[1]
    return jax.tree.map(lambda x: x.reshape(-1), results)


def _of_arrays(
    f: Callable[..., Any], arguments: tuple
) -> tuple[Callable[..., list[jax.Array]], list[jax.Array], Callable[[list[jax.Array]], Any]]:
    """`f` as a function of the arrays among its arguments, those arrays, and what makes results of its arrays.

    Python floats, in and out, stay floats.
    """
    leaves, structure = jax.tree.flatten(arguments)
    places = [i for i, leaf in enumerate(leaves) if not isinstance(leaf, float)]
    folded: list[Any] = []

    @jax.jit  # traced once, though it is looked at several times
    def compute(*values: jax.Array) -> list[jax.Array]:
        filled = list(leaves)
        for i, value in zip(places, values, strict=True):
            filled[i] = value
        results, results_structure = jax.tree.flatten(f(*jax.tree.unflatten(structure, filled)))
        folded[:] = [results_structure, [r if isinstance(r, float) else None for r in results]]
        return [r for r in results if not isinstance(r, float)]

    def restore(arrays: list[jax.Array]) -> Any:
        results = iter(arrays)
        results_structure, known = folded
        return jax.tree.unflatten(results_structure, [next(results) if k is None else k for k in known])

    return compute, [leaves[i] for i in places], restore
