"""What the commands switch on before they work: float64, a compilation cache, progress bars."""

import contextlib
import os
import sys
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
)


def start() -> None:
    """Float64, and compiled programs kept from one run to the next.

    The cache lies in `$JAXPANDA_CACHE`, or `~/.cache/jaxpanda`; an empty `JAXPANDA_CACHE` switches it off.
    """
    jax.config.update("jax_enable_x64", True)
    folder = os.environ.get("JAXPANDA_CACHE", str(Path.home() / ".cache" / "jaxpanda"))
    if folder and "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)


Tick = Callable[[int, int], None]
"""Called with (done, total) as a stage goes on."""


@contextlib.contextmanager
def progress(what: str) -> Iterator[Tick]:
    """A progress bar on a terminal; silent where standard error is none."""
    if not sys.stderr.isatty():
        yield lambda done, total: None
        return
    columns = (SpinnerColumn(), TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
