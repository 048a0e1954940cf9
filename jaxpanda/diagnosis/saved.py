"""The files that every diagnosis leaves, whatever it found."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from .. import files
from ..arms import markup
from ..arms.export import write_document
from ..corrected import FILE, KIND, XML, Corrected
from .finding import Fit


@runtime_checkable
class Answer(Protocol):
    """What a diagnosis has in common with that of an arm at rest, or of torque that is none."""

    @property
    def written(self) -> markup.Document: ...
    @property
    def corrected(self) -> Corrected: ...
    @property
    def fit(self) -> Fit: ...
    def to_json(self) -> dict[str, Any]: ...


def with_noise(corrected: Corrected, fit: Fit) -> dict[str, Any]:
    """corrected.json: the arm, and the noise of its torque."""
    return {**corrected.to_json(), "torque_noise": [float(v) for v in fit.noise_floor]}


def write(found: Answer, folder: str | Path, corrected: Mapping[str, Any] | None = None) -> None:
    """diagnosis.json, corrected.xml with what it includes, and corrected.json, as one set; `corrected`: the last,
    where it holds more than the corrected arm.

    Raises:
        InputError: a file of such a name stands there that no earlier diagnosis left; nothing is written.
    """
    with files.output_folder(folder, KIND) as scratch:
        write_document(found.written, scratch / XML)
        files.write_json(scratch / KIND.names[0], found.to_json())
        files.write_json(scratch / FILE, corrected or with_noise(found.corrected, found.fit))
