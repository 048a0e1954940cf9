"""The command `fleet`: between files and files."""

import contextlib
import time
from pathlib import Path
from typing import Any

from ..arms.source import from_mjcf
from ..convention import PLAIN, Convention
from ..errors import InputError, require_x64
from ..files import output_folder
from ..inference.knowledge import Knowledge, check
from ..reading import Reading
from ..session import Tick, progress
from .crew import crew, ray
from .result import KIND, Fleet, require_parquet
from .run import run
from .table import Table, load_table
from .work import Options

MEMORY = 3.0
"""Of a worker, beyond which it is replaced [GB]."""


def diagnose_fleet(
    table: str | Path | Table,
    out: str | Path,
    *,
    model: str | Path | None = None,
    knowledge: Knowledge = "identified",
    reading: Reading | None = None,
    convention: Convention = PLAIN,
    workers: int | None = 0,
    address: str | None = None,
    memory: float = MEMORY,
    tick: Tick = lambda done, total: None,
) -> Fleet:
    """Diagnose the recordings of many arms, one by one, and each arm's together.

    Args:
        table: CSV with a row a recording (`docs/files.md`).
        out: folder; its `shards` hold what is finished, which is not made again.
        model: of rows that name none (MJCF); None for the project's own Panda.
        knowledge: how well the models' numbers are known.
        reading: which part of each file is read, and what its columns are.
        convention: signs, units, order and gravity of all recordings.
        workers: processes of Ray, None for as many as there are cores; 0 for this process alone, without Ray.
        address: of a Ray cluster, "auto" for that of this machine; None to start one here.
        memory: of a worker, beyond which it is replaced [GB].
        tick: called with how many recordings are finished, and of how many.

    Raises:
        InputError: a bad table or model, or no cluster. Of a bad recording the result tells.
        MissingExtraError: Ray or pyarrow is not installed.
    """
    require_x64("a fleet")
    check(knowledge)
    require_parquet()
    if workers is not None and workers < 0:
        raise InputError(
            f"--workers {workers}: a number from 0 is needed; 0 works in this process, without Ray"
        )
    if workers == 0 and address:
        raise InputError(f"--address {address}: --workers 0 works in this process, which needs no cluster")
    if not memory > 0:
        raise InputError(f"--worker-memory {memory:g}: a size in GB is needed")
    if workers != 0:
        ray()
    out, reading = Path(out), Reading() if reading is None else reading
    read = (
        table if isinstance(table, Table) else load_table(Path(table), None if model is None else Path(model))
    )
    models: dict[Path, int] = {}
    for row in read.rows:
        if row.model is not None:
            models.setdefault(row.model, row.number)
    for path, number in models.items():
        if not path.exists() and path != Path(model or ""):
            raise InputError(f"{read.path.name}: row {number}: column model: {path}: no such file")
        from_mjcf(path, convention.mounting)
    options = Options(knowledge, reading, convention)
    _require_place(out)
    began = time.monotonic()
    with crew(workers, address or None, round(memory * 1e9)) as outcomes:
        told, made = run(read, out, options, outcomes, tick)
    found = Fleet(read, told, made, time.monotonic() - began, knowledge)
    found.save(out)
    return found


class _FitsError(Exception):
    """What the set needs is free; nothing is to be put there yet."""


def _require_place(out: Path) -> None:
    """Refuse what stands in the way of the result before hours of work."""
    with contextlib.suppress(_FitsError), output_folder(out, KIND):
        raise _FitsError


def fleet_files(out: Path, table: Path, **options: Any) -> Fleet:
    """`jaxpanda fleet`."""
    with progress("diagnosing") as tick:
        return diagnose_fleet(table, out, tick=tick, **options)
