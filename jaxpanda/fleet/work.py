"""One shard of a fleet: a recording diagnosed, from files to a document that says the same whoever makes it.

A shard is named by what it is made of: the contents of the recording, its model and its references, the options
and the software. So whoever finds one that is there need not make it again, and two that make it make the same
bits.
"""

import dataclasses
import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jaxpanda_kernels
import mujoco
import numpy as np

from .. import inputs
from ..arms.source import from_mjcf
from ..convention import PLAIN, Convention
from ..diagnosis import Diagnosis
from ..diagnosis.entry import diagnosed
from ..errors import InputError
from ..files import to_json
from ..host import on_host, return_freed
from ..inference.knowledge import Knowledge
from ..reading import Reading
from ..recordings import distinct, load_many
from .levels import estimates

SCHEMA = "jaxpanda.shard/1"
DIAGNOSED, UNREADABLE, FAILED, LOST = "diagnosed", "unreadable", "failed", "lost"
"""What can become of a recording: told; refused, in a sentence; ended in a defect; took its workers with it."""
KEPT = (DIAGNOSED, UNREADABLE)
"""What a rerun does not try again."""


@dataclasses.dataclass(frozen=True)
class Options:
    """What holds for all recordings of a fleet."""

    knowledge: Knowledge = "identified"
    reading: Reading = dataclasses.field(default_factory=Reading)
    convention: Convention = PLAIN


@dataclasses.dataclass(frozen=True)
class Task:
    """A recording to diagnose. Every path must lead to the same file on all machines."""

    key: str
    recording: Path
    model: Path | None
    references: tuple[Path, ...]
    options: Options


def shard(task: Task) -> str:
    """Diagnose a recording; whatever becomes of it is a document in JSON, with the field `status`."""
    try:
        return to_json({"schema": SCHEMA, "key": task.key, "status": DIAGNOSED, **_diagnosed(task)})
    except InputError as error:
        return to_json(refused(task.key, UNREADABLE, str(error)))
    except Exception as error:
        said = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
        return to_json(refused(task.key, FAILED, f"{task.recording.name}: {said}"))


def refused(key: str, status: str, message: str) -> dict[str, Any]:
    """The document of a recording that was not diagnosed."""
    return {"schema": SCHEMA, "key": key, "status": status, "message": message}


@on_host
def _diagnosed(task: Task) -> dict[str, Any]:
    options = task.options
    suspect, healthy = (
        options.convention.applied(load_many(paths, options.reading), task.model)
        for paths in ([task.recording], task.references)
    )
    every = distinct([*suspect, *healthy])
    cut, gravity = len(suspect), options.convention.mounting
    found = diagnosed(task.model, every[:cut], every[cut:], options.knowledge, gravity)
    fit = found.fit
    torque = np.sqrt(sum((np.square(f.rms_torque) for f in found.findings), np.zeros_like(fit.noise_floor)))
    return {
        "verdict": found.verdict,
        "findings": [finding.to_json() for finding in found.findings],
        "fit": fit.to_json(),
        "off_by_noise": float(np.max(torque / np.maximum(fit.noise_floor, 1e-300))),
        "notes": list(found.notes),
        "estimates": [
            one.to_json()
            for one in (estimates(found, options.knowledge) if isinstance(found, Diagnosis) else [])
        ],
    }


class Keys:
    """Names of shards; what many recordings have in common is read once."""

    def __init__(self, options: Options):
        self._common = json.dumps(
            [SCHEMA, options.knowledge, repr(options.reading), repr(options.convention), software()]
        )
        self._digests: dict[Path, str] = {}

    def of(self, recording: Path, model: Path | None, references: Sequence[Path]) -> str:
        """The name of a recording's shard.

        Raises:
            InputError: a file cannot be read.
        """
        parts = [
            self._common,
            recording.name,
            self._content(recording),
            "" if model is None else self._model(model),
            *(f"{path.name} {self._content(path)}" for path in references),
        ]
        paths = [recording, *references]
        if len({path.name for path in paths}) < len(paths):  # their folders then belong to their names
            parts += [str(path.resolve()) for path in paths]
        return hashlib.sha256("\n".join(parts).encode("utf-8", "surrogateescape")).hexdigest()[:32]

    def _content(self, path: Path) -> str:
        if path not in self._digests:
            files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
            names = json.dumps([p.relative_to(path).as_posix() for p in files])
            self._digests[path] = names + inputs.digest(*files)
        return self._digests[path]

    def _model(self, path: Path) -> str:
        """Of the file and what it includes."""
        if path not in self._digests:
            document = from_mjcf(path)[1].document
            text = json.dumps([path.name, dict(document.texts)])
            self._digests[path] = hashlib.sha256(text.encode()).hexdigest()
        return self._digests[path]


def software() -> str:
    """What computes: versions, and the sources of both packages; of this one, not who computes or tells of it."""
    here = Path(__file__).parents[1]
    kernels = Path(str(jaxpanda_kernels.__file__)).parent
    own = {Path(__file__), Path(__file__).with_name("levels.py")}
    every = [path for root in (here, kernels) for path in sorted(root.rglob("*.py"))]
    sources = [path for path in every if path.parent != Path(__file__).parent or path in own]
    versions = [jax.__version__, mujoco.__version__, np.__version__]
    return " ".join([*versions, inputs.digest(*sources)])


def relieve() -> None:
    """Give back what compiled programs take; the next recordings compile, or read from the cache, again."""
    jax.clear_caches()
    return_freed()


def memory() -> int:
    """Of this process, resident [bytes]; 0 where the system does not say."""
    try:
        return int(inputs.read_bytes("/proc/self/statm").split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (InputError, IndexError, ValueError):
        return 0
