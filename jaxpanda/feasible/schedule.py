"""Starts in chunks: spread over devices and machines, fetched as they finish, kept in a checkpoint.

Every device solves chunks of one size with one and the same program for a single device. So a start's answer has
the same bits on one device as on many, and wherever a run was interrupted. A program partitioned over a mesh
(`jax.shard_map`) would not give that: XLA fuses it otherwise, and where coefficients leave directions open,
rounding moves an answer along them by 1e-4 at the same objective.
"""

import collections
import contextlib
import functools
import time
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import SingleDeviceSharding
from jaxtyping import Array, Int, PyTree

from ..ranks import ALONE, Ranks
from ..xla import options_of_solver
from .checkpoint import Checkpoint

Chunk = Callable[..., PyTree[Array]]
"""(problem, numbers of the starts, *options) -> arrays with a row for each of these starts.

A negative number fills a place that no start is left for; its row is not looked at.
"""

Device = Any
"""A `jax.Device`, which type checkers do not know."""

_PIECE = 16384
"""Starts fetched at once: memory for a large chunk would be new to the process every time, page after page."""
_COPIERS = 4
"""Threads that copy them, for each device: one finds pages more slowly than a GPU sends rows."""
_WORTH = 4  # chunks a further CPU device must get: it shares the cores, and compiling for it costs as much


def run(
    solve: Chunk,
    problem: PyTree,
    options: tuple[Hashable, ...],
    *,
    starts: int,
    chunk: int,
    devices: Sequence[Device] | None = None,
    ranks: Ranks = ALONE,
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
        devices: to spread the chunks over; those of this process when None.
        ranks: processes that make this same call: each solves its share and all return everything.
        checkpoint: kept by rank 0; starts found in it are not solved again.
        progress: called with (starts done, starts) as chunks finish.
    """
    if ranks.rank > 0:
        checkpoint = None
    if checkpoint is not None:
        checkpoint.require_same()
    mine = list(jax.local_devices() if devices is None else devices)
    on_cpu = mine[0].platform == "cpu"
    worth = -(-starts // chunk) // (_WORTH if on_cpu else 1) // ranks.count
    mine = mine[: max(1, worth)]
    share = max(int(count) for [count] in ranks.gather([np.asarray(len(mine))]))  # chunks of a rank at a time
    began = time.perf_counter()
    leaves, structure = jax.tree.flatten(problem)
    shapes = tuple((leaf.shape, leaf.dtype) for leaf in leaves)
    programs, like = _compiled(solve, options, structure, shapes, chunk, tuple(mine))
    placed = [jax.device_put(leaves, device) for device in mine]
    compiled = time.perf_counter()
    rows, form = jax.tree.flatten(like)
    outcome = tuple(np.empty((starts, *one.shape[1:]), one.dtype) for one in rows)
    done = _taken_up(checkpoint, outcome, ranks)
    if progress is not None and done:
        progress(done, starts)

    def solved(device: int, first: int) -> list[list[Array]]:
        numbers = np.arange(first, first + chunk)
        numbers[numbers >= starts] = -1
        pieces = programs[device](placed[device], jax.device_put(numbers, mine[device]))
        return [jax.tree.leaves(piece) for piece in pieces]

    def begin(first: int) -> list[Future[list[list[Array]]]]:
        """This rank's chunks from this start on."""
        first += ranks.rank * share * chunk
        return [hands[k % len(mine)].submit(solved, k % len(mine), first + k * chunk) for k in range(share)]

    def copy(at: int, one: Future[list[list[Array]]], k: int) -> None:
        """What is wanted of a chunk's piece k into the outcome, from this start on."""
        pieces = one.result()
        piece, pieces[k] = pieces[k], []  # an array keeps its copy on the host as long as it lives
        for whole, part in zip(outcome, piece, strict=True):
            whole[at : at + len(part)] = np.asarray(part)[: starts - at]

    def finish(first: int, chunks: list[Future[list[list[Array]]]]) -> None:
        last = min(first + wave, starts)
        if ranks.count > 1:
            fetched = jax.device_get([piece for one in chunks for piece in one.result()])
            everywhere = ranks.gather([np.concatenate(part) for part in zip(*fetched, strict=True)])
            for whole, *parts in zip(outcome, *everywhere, strict=True):
                whole[first:last] = np.concatenate(parts)[: last - first]
        else:
            within = enumerate(range(0, chunk, _PIECE))  # the devices by turns, all of which send at once
            each = [(first + i * chunk + at, one, k) for k, at in within for i, one in enumerate(chunks)]
            list(copiers.map(lambda part: copy(*part), [part for part in each if part[0] < starts]))
        if checkpoint is not None:
            checkpoint.append(first, tuple(whole[first:last] for whole in outcome))
        if progress is not None:
            progress(last, starts)

    wave = share * chunk * ranks.count
    ahead = 0 if on_cpu else 1  # waves under way while one is fetched
    under_way: collections.deque[tuple[int, list[Future[list[list[Array]]]]]] = collections.deque()
    with contextlib.ExitStack() as stack:
        # A GPU's program asks the host whether to go round its loop again, and holds the thread that called it.
        hands = [stack.enter_context(ThreadPoolExecutor(1)) for _ in mine]
        copiers = stack.enter_context(ThreadPoolExecutor(_COPIERS * len(mine)))
        for first in range(done, starts, wave):
            under_way.append((first, begin(first)))
            if len(under_way) > ahead:
                finish(*under_way.popleft())
        while under_way:
            finish(*under_way.popleft())
    return (
        jax.tree.unflatten(form, outcome),
        compiled - began,
        time.perf_counter() - compiled,
    )


def _compiled(
    solve: Chunk,
    options: tuple[Hashable, ...],
    structure: Any,
    shapes: tuple[tuple[tuple[int, ...], Any], ...],
    chunk: int,
    devices: tuple[Device, ...],
) -> tuple[list[Callable[..., list[PyTree[Array]]]], PyTree[jax.ShapeDtypeStruct]]:
    """The program for a chunk on each device, which returns it piece by piece, and what a piece is like."""
    of_one = functools.partial(_program, _jitted(solve, options, structure), shapes, chunk)
    # Where there is a compilation cache, it has the program for all GPUs from the first on.
    alone = [] if devices[0].platform == "cpu" else [of_one(devices[0])]
    with ThreadPoolExecutor(len(devices)) as pool:
        programs = [*alone, *pool.map(of_one, devices[len(alone) :])]
    return [program for program, _ in programs], programs[0][1]


@functools.lru_cache(maxsize=16)
def _jitted(solve: Chunk, options: tuple[Hashable, ...], structure: Any) -> Any:
    def of_chunk(leaves: list[Array], numbers: Int[Array, " chunk"]) -> list[PyTree[Array]]:
        found = solve(jax.tree.unflatten(structure, leaves), numbers, *options)
        piece = lambda first: jax.tree.map(lambda rows: rows[first : first + _PIECE], found)
        return [piece(first) for first in range(0, len(numbers), _PIECE)]

    return jax.jit(of_chunk)


@functools.lru_cache(maxsize=64)
def _program(
    jitted: Any, shapes: tuple[tuple[tuple[int, ...], Any], ...], chunk: int, device: Device
) -> tuple[Callable[..., list[PyTree[Array]]], PyTree[jax.ShapeDtypeStruct]]:
    """Kept, because cross-validation solves one shape many times."""
    where = SingleDeviceSharding(device)
    shaped = lambda shape, dtype: jax.ShapeDtypeStruct(shape, dtype, sharding=where)
    leaves = [shaped(shape, dtype) for shape, dtype in shapes]
    lowered = jitted.lower(leaves, shaped((chunk,), jnp.asarray(0).dtype))
    return lowered.compile(compiler_options=options_of_solver(device.platform)), lowered.out_info[0]


def _taken_up(checkpoint: Checkpoint | None, outcome: tuple[np.ndarray, ...], ranks: Ranks) -> int:
    """Copy what a checkpoint holds into the outcome; how many starts that is."""
    done = 0 if checkpoint is None else checkpoint.restore(outcome)
    if ranks.count > 1:
        finished, *rows = ranks.gather([np.asarray(done), *(whole[:done] for whole in outcome)])[0]
        done = int(finished)
        for whole, part in zip(outcome, rows, strict=True):
            whole[:done] = part
    return done
