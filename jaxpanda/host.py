"""The processor's cores, for work that is many small products."""

import contextlib
import ctypes
import functools
import gc
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ParamSpec, TypeVar

import jax
from threadpoolctl import threadpool_limits

P = ParamSpec("P")
R = TypeVar("R")
_THREADS = 4
"""At most: more wait for Python's lock, and slow down those that hold it."""


def on_host(work: Callable[P, R]) -> Callable[P, R]:
    """Decorates what makes many small products: on the processor's cores, with no threads but ours (`parallel`).

    BLAS's own threads would wait for each other and for ours; a GPU, for the next of a thousand small programs.
    What such work has freed is given back when it ends.
    """

    @functools.wraps(work)
    def alone(*args: P.args, **kwargs: P.kwargs) -> R:
        with contextlib.ExitStack() as stack:
            stack.enter_context(threadpool_limits(limits=1, user_api="blas"))
            if jax.default_backend() != "cpu":
                with contextlib.suppress(RuntimeError):  # JAX_PLATFORMS leaves the processor out
                    stack.enter_context(jax.default_device(jax.local_devices(backend="cpu")[0]))
            try:
                return work(*args, **kwargs)
            finally:
                return_freed()

    return alone


def return_freed() -> None:
    """Hand memory that is free back to the system, which glibc does not by itself once it lies in pieces.

    A process that diagnosed again and again held 2.4 GB, of which 0.6 were in use.
    """
    gc.collect()  # arrays of objects that refer to each other
    with contextlib.suppress(AttributeError, OSError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)


def parallel(work: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
    """`work` on each item, on some of the cores at once: large products let go of Python's lock."""
    items, cores = list(items), len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    if cores == 1 or len(items) < 2:
        return [work(item) for item in items]
    # A thread of its own would not know what `on_host` has chosen.
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]

    def elsewhere(item: Any) -> Any:
        with jax.default_device(device):
            return work(item)

    with ThreadPoolExecutor(min(cores, len(items), _THREADS)) as pool:
        return list(pool.map(elsewhere, items))
