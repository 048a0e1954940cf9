"""Starts in chunks: spread over devices and machines, fetched as they finish, kept in a checkpoint.

Every device solves chunks of one size with one program, so a start's answer has the same bits on one device as on
many, wherever a run was interrupted. Lanes never exchange anything: the program is mapped over the devices
(`jax.shard_map`), each of which goes at its own pace.
"""

import collections
import functools
import time
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int, PyTree

from .checkpoint import Checkpoint

Chunk = Callable[..., PyTree[Array]]
"""(problem, numbers of the starts, *options) -> arrays with a row for each of these starts."""

Device = Any
"""A `jax.Device`, which type checkers do not know."""

_ROWS = PartitionSpec("starts")
_EVERYWHERE = PartitionSpec()


def run(
    solve: Chunk,
    problem: PyTree,
    options: tuple[Hashable, ...],
    *,
    starts: int,
    chunk: int,
    devices: Sequence[Device] | None = None,
    checkpoint: Checkpoint | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Any, float, float]:
    """What `solve` returns for starts 0 ... `starts` - 1, and the seconds of compiling and of running.

    Args:
        solve: pure; a start's rows depend on its number and the problem alone.
        problem: arrays, the same for all.
        options: further arguments, static.
        starts: how many.
        chunk: starts solved at once on each device.
        devices: to spread the chunks over; those of this process when None. Devices of other processes too
            (`jax.devices()` after `jax.distributed.initialize`) where every process makes this same call: each
            solves its share and all return everything.
        checkpoint: kept by process 0; starts found in it are not solved again.
        progress: called with (starts done, starts) as chunks finish.
    """
    if checkpoint is not None and jax.process_index() == 0:
        checkpoint.require_same()
    chunk = min(chunk, starts)
    mesh = _mesh(devices, -(-starts // chunk))
    shared = mesh.is_multi_process
    began = time.perf_counter()
    leaves, structure = jax.tree.flatten(problem)
    leaves = tuple(_placed(np.asarray(leaf), NamedSharding(mesh, _EVERYWHERE)) for leaf in leaves)
    shapes = tuple((leaf.shape, leaf.dtype) for leaf in leaves)
    program, like = _compiled(solve, options, structure, shapes, chunk, mesh)
    compiled = time.perf_counter()
    outcome = tuple(np.empty((starts, *one.shape[1:]), one.dtype) for one in jax.tree.leaves(like))
    done = _taken_up(checkpoint, outcome, shared)
    if progress is not None and done:
        progress(done, starts)

    def finish(first: int, pending: PyTree[Array]) -> None:
        fetched = (
            multihost_utils.process_allgather(pending, tiled=True) if shared else jax.device_get(pending)
        )
        last = min(first + wave, starts)
        for whole, part in zip(outcome, jax.tree.leaves(fetched), strict=True):
            whole[first:last] = part[: last - first]
        if checkpoint is not None and jax.process_index() == 0:
            checkpoint.append(first, tuple(whole[first:last] for whole in outcome))
        if progress is not None:
            progress(last, starts)

    wave = chunk * mesh.size
    ahead = 0 if mesh.devices.flat[0].platform == "cpu" else 1  # chunks under way while one is fetched
    under_way: collections.deque[tuple[int, PyTree[Array]]] = collections.deque()
    for first in range(done, starts, wave):
        numbers = np.minimum(np.arange(first, first + wave), starts - 1)
        under_way.append((first, program(leaves, _placed(numbers, NamedSharding(mesh, _ROWS)))))
        if len(under_way) > ahead:
            finish(*under_way.popleft())
    while under_way:
        finish(*under_way.popleft())
    return (
        jax.tree.unflatten(jax.tree.structure(like), outcome),
        compiled - began,
        time.perf_counter() - compiled,
    )


def _mesh(devices: Sequence[Device] | None, chunks: int) -> Mesh:
    """No more devices than chunks, unless they belong to several processes, which all must take part."""
    devices = list(jax.local_devices() if devices is None else devices)
    mesh = Mesh(np.array(devices), ("starts",))
    return (
        mesh
        if mesh.is_multi_process or chunks >= len(devices)
        else Mesh(np.array(devices[:chunks]), ("starts",))
    )


def _placed(x: np.ndarray, sharding: NamedSharding) -> Array:
    return jax.make_array_from_callback(x.shape, sharding, lambda index: x[index])


@functools.lru_cache(maxsize=16)
def _compiled(
    solve: Chunk,
    options: tuple[Hashable, ...],
    structure: Any,
    shapes: tuple[tuple[tuple[int, ...], Any], ...],
    chunk: int,
    mesh: Mesh,
) -> tuple[Callable[..., PyTree[Array]], PyTree[jax.ShapeDtypeStruct]]:
    """The program for a chunk on each device; kept, because cross-validation solves one shape many times."""

    def of_device(leaves: tuple[Array, ...], numbers: Int[Array, " chunk"]) -> PyTree[Array]:
        return solve(jax.tree.unflatten(structure, leaves), numbers, *options)

    mapped = jax.shard_map(
        of_device, mesh=mesh, in_specs=(_EVERYWHERE, _ROWS), out_specs=_ROWS, check_vma=False
    )
    shaped = lambda shape, dtype, spec: jax.ShapeDtypeStruct(shape, dtype, sharding=NamedSharding(mesh, spec))
    leaves = tuple(shaped(shape, dtype, _EVERYWHERE) for shape, dtype in shapes)
    numbers = shaped((chunk * mesh.size,), jnp.asarray(0).dtype, _ROWS)
    lowered = jax.jit(mapped).lower(leaves, numbers)
    return lowered.compile(), lowered.out_info


def _taken_up(checkpoint: Checkpoint | None, outcome: tuple[np.ndarray, ...], shared: bool) -> int:
    """Copy what a checkpoint holds into the outcome; how many starts that is."""
    done = 0
    if checkpoint is not None and jax.process_index() == 0:
        done = checkpoint.restore(outcome)
    if shared:
        done = int(multihost_utils.broadcast_one_to_all(np.asarray(done)))
        for whole in outcome:
            whole[:done] = multihost_utils.broadcast_one_to_all(whole[:done])
    return done
