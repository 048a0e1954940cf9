"""Many lanes that take steps, some of them at a time, until all are done."""

import functools
from collections.abc import Callable, Sequence
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

_SEGMENT = 3  # steps between two choices of who goes on


class AbstractSteps(eqx.Module):
    """State of lanes; every array has the lanes last."""

    steps: eqx.AbstractVar[Int[Array, " lanes"]]
    """How many each has taken."""
    done: eqx.AbstractVar[Bool[Array, " lanes"]]


_State = TypeVar("_State", bound=AbstractSteps)


def in_turns(step: Callable[[_State], _State], state: _State, most: int, lanes: Sequence[int]) -> _State:
    """Let so many lanes at a time take a few steps, those that have taken the fewest first.

    Until all are done or have taken the most: what is done costs nothing more, and no lane waits for the slowest.
    Where several numbers are given, fewer take part from when no more than so many are left.
    """
    left = lambda state: ~state.done & (state.steps < most)

    def go_on(many: int, state: _State) -> _State:
        chosen = jnp.argsort(jnp.where(left(state), state.steps, most + 1))[: min(many, len(state.steps))]
        part = jax.tree.map(lambda leaf: leaf[..., chosen], state)
        part = jax.lax.fori_loop(0, _SEGMENT, lambda _, part: step(part), part)
        return jax.tree.map(lambda whole, new: whole.at[..., chosen].set(new), state, part)

    for many, few in zip(lanes, (*lanes[1:], 0), strict=True):
        state = jax.lax.while_loop(
            lambda state, few=few: jnp.sum(left(state)) > few, functools.partial(go_on, many), state
        )
    return state
