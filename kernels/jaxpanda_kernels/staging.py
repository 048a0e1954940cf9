"""Parts of a program that XLA is kept from fusing with what consumes them."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax

T = TypeVar("T")


def alone(f: Callable[..., T], *arguments: Any) -> T:
    """`f(*arguments)`, compiled as if it were a program of its own.

    XLA on CPUs fuses producers into each of their consumers and computes them again for every element;
    through a `stack` that costs a factor of ten to ten thousand. It drops `lax.optimization_barrier` before
    it fuses, so this is a loop of two rounds, the first of which does nothing: fusion does not look across
    it, and neither `vmap`, `grad` nor sharding takes it apart.

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

    values = [leaves[i] for i in places]
    empty = [jnp.zeros(s.shape, s.dtype) for s in jax.eval_shape(arrays, *values)]
    compute = jax.checkpoint(arrays)

    def round(carry, now):
        return lax.cond(now, lambda _: compute(*values), lambda same: same, carry), None

    results = iter(lax.scan(round, empty, jnp.array([False, True]))[0])
    results_structure, known = folded
    return jax.tree.unflatten(results_structure, [next(results) if k is None else k for k in known])
