"""Parts of a program that XLA is kept from fusing with what consumes them."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax

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
    leaves, structure = jax.tree.flatten(arguments)
    places = [i for i, leaf in enumerate(leaves) if not isinstance(leaf, float)]
    folded: list[Any] = []

    @jax.jit  # traced once, though it is looked at several times
    def arrays(*values: jax.Array) -> list[jax.Array]:
        filled = list(leaves)
        for i, value in zip(places, values, strict=True):
            filled[i] = value
        results, results_structure = jax.tree.flatten(f(*jax.tree.unflatten(structure, filled)))
        folded[:] = [results_structure, [r if isinstance(r, float) else None for r in results]]
        return [r for r in results if not isinstance(r, float)]

    compute = jax.checkpoint(arrays)

    def looped(*values: jax.Array) -> list[jax.Array]:
        def round(carry, now):
            return lax.cond(now, lambda _: compute(*values), lambda same: same, carry), None

        empty = [jnp.zeros(s.shape, s.dtype) for s in jax.eval_shape(arrays, *values)]
        return lax.scan(round, empty, jnp.array([False, True]))[0]

    def fenced(*values: jax.Array) -> list[jax.Array]:
        return lax.optimization_barrier(compute(*values))

    values = [leaves[i] for i in places]
    results = iter(lax.platform_dependent(*values, cpu=looped, default=fenced))
    results_structure, known = folded
    return jax.tree.unflatten(results_structure, [next(results) if k is None else k for k in known])
