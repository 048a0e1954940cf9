"""Every recording of a table, diagnosed once: shards that are there are taken, the others are made."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .. import inputs
from ..errors import InputError
from ..files import write_text
from ..session import Tick
from .crew import Outcomes
from .table import Row, Table
from .work import KEPT, SCHEMA, UNREADABLE, Keys, Options, Task, refused

SHARDS = "shards"
REFERENCES = 2
"""Recordings of the healthy arm that are set beside each of its others, the first and the last: each takes as
long again."""


def run(
    table: Table, out: Path, options: Options, outcomes: Outcomes, tick: Tick
) -> tuple[dict[int, Mapping[str, Any]], int]:
    """The document of each recording by its row's number, and how many of them were made now.

    Recordings from when nothing was wrong come first: those that can be read go beside the others of their arm.
    """
    keys, done = Keys(options), [0]
    folder = out / SHARDS
    told: dict[int, Mapping[str, Any]] = {}
    made = 0
    for reference in (True, False):
        tasks: list[tuple[Row, Task]] = []
        for row in (row for row in table.rows if row.reference is reference):
            beside = () if reference else tuple(r.path for r in _beside(row, table, told))
            try:
                key = keys.of(row.path, row.model, beside)
            except InputError as error:
                told[row.number] = refused("", UNREADABLE, str(error))
                continue
            found = _kept(folder, key)
            if found is not None:
                told[row.number] = found
            else:
                tasks.append((row, Task(key, row.path.resolve(), _absolute(row.model),
                                        tuple(p.resolve() for p in beside), options)))  # fmt: skip
        done[0] = len(told)
        tick(done[0], len(table.rows))
        for i, text in outcomes([task for _, task in tasks]) if tasks else ():
            row, task = tasks[i]
            told[row.number] = json.loads(text)
            if told[row.number]["status"] in KEPT:
                write_text(folder / f"{task.key}.json", text)
            made += 1
            done[0] += 1
            tick(done[0], len(table.rows))
    return told, made


def _absolute(model: Path | None) -> Path | None:
    return None if model is None else model.resolve()


def _beside(row: Row, table: Table, told: Mapping[int, Mapping[str, Any]]) -> list[Row]:
    """The healthy recordings that go beside one of the same arm."""
    healthy = [
        other
        for other in table.rows
        if other.reference and other.arm == row.arm and told[other.number].get("estimates")
    ]
    healthy.sort(key=lambda other: (other.when is None, other.when or 0.0, other.number))
    return healthy if len(healthy) <= REFERENCES else [healthy[0], healthy[-1]]


def _kept(folder: Path, key: str) -> Mapping[str, Any] | None:
    """A shard that an earlier run has made; None where there is none, or one that nobody can read."""
    path = folder / f"{key}.json"
    if not path.is_file():
        return None
    with inputs.forgotten():
        try:
            found = inputs.read_json(path)
        except InputError:
            return None
    whole = isinstance(found, dict) and found.get("schema") == SCHEMA and found.get("key") == key
    return found if whole and found.get("status") in KEPT else None
