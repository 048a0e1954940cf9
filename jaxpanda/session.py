"""What the commands switch on before they work: float64, a compilation cache, progress bars."""

import contextlib
import ctypes
import functools
import os
import re
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

_ARENA_MAX, _ARENAS = -8, 2
"""glibc's name for how many arenas threads take memory from, and how many: more hold on to what is free."""


def start() -> None:
    """Float64, compiled programs kept from one run to the next, and memory that threads share.

    The cache lies in `$JAXPANDA_CACHE`, or `~/.cache/jaxpanda`; an empty `JAXPANDA_CACHE` switches it off.
    """
    jax.config.update("jax_enable_x64", True)
    folder = os.environ.get("JAXPANDA_CACHE", str(Path.home() / ".cache" / "jaxpanda"))
    if folder and "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    _share_memory()


@functools.cache
def _share_memory() -> None:
    """Once, as glibc wants it set before threads go by it."""
    with contextlib.suppress(AttributeError, OSError):  # another C library
        ctypes.CDLL(None).mallopt(_ARENA_MAX, _ARENAS)


def spread_over_cores() -> None:
    """Make every processor core a device, so that many starts keep all of them busy; before any array is made.

    Where arrays were made already, nothing changes.

    jaxlib's batched LAPACK waits for its pool of threads inside that pool, and everything hangs once every thread
    of it waits. As many again as there are devices keep it going; XLA reads their number from `NPROC`.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    forced = re.search(r"xla_force_host_platform_device_count=(\d+)", os.environ.get("XLA_FLAGS", ""))
    devices = int(forced[1]) if forced else cores
    with contextlib.suppress(RuntimeError):
        if not forced:
            jax.config.update("jax_num_cpu_devices", devices)
        os.environ.setdefault("NPROC", str(2 * max(devices, cores)))


Tick = Callable[[int, int], None]
"""Called with (done, total) as a stage goes on."""


@contextlib.contextmanager
def progress(what: str) -> Iterator[Tick]:
    """A progress bar on a terminal; silent where standard error is none."""
    if not sys.stderr.isatty():
        yield lambda done, total: None
        return
    columns = (
        SpinnerColumn(),
        TextColumn(what),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


Say = Callable[[str], None]
"""Called with what a stage is doing now."""


def silent(_: str) -> None:
    """For who does not want to be told."""


@contextlib.contextmanager
def telling(what: str) -> Iterator[Say]:
    """What a stage does, on a terminal: each thing a line with the seconds since the start; else silent.

    For stages that do not know how much is left; `progress` is for those that count.
    """
    if not sys.stderr.isatty():
        yield silent
        return
    began, console = time.monotonic(), Console(stderr=True, highlight=False)

    def say(now: str) -> None:
        console.print(Text(f"{time.monotonic() - began:6.1f} s  {now}", style="dim"))

    with console.status(what):
        yield say
