"""What every diagnosis says and leaves in files, whatever it found."""

import abc
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from .. import files
from ..arms import markup
from ..arms.export import missing_assets, write_document
from ..arms.mjcf import MjcfSource
from ..corrected import FILE, KIND, XML, Corrected
from ..inference.knowledge import Knowledge
from .finding import Finding, Fit


@runtime_checkable
class Answer(Protocol):
    """What a diagnosis has in common with that of an arm at rest, or of torque that is none."""

    @property
    def verdict(self) -> str: ...
    @property
    def findings(self) -> tuple[Finding, ...]: ...
    @property
    def fit(self) -> Fit: ...
    @property
    def corrected(self) -> Corrected: ...
    @property
    def written(self) -> markup.Document: ...
    @property
    def notes(self) -> tuple[str, ...]: ...
    @property
    def sources(self) -> tuple[Mapping[str, str], ...]: ...
    @property
    def replays(self) -> tuple[Mapping[str, Any], ...]: ...
    def to_json(self) -> dict[str, Any]: ...


@dataclasses.dataclass(frozen=True, kw_only=True)
class AbstractAsItIs(abc.ABC):
    """A diagnosis that leaves the user's model as it is; fields as of `Diagnosis`, as far as they apply."""

    verdict: str
    findings: tuple[Finding, ...]
    fit: Fit
    """Of the user's model, before and after alike [N m]."""
    corrected: Corrected
    """The user's model as it is."""
    source: MjcfSource = dataclasses.field(repr=False)
    notes: tuple[str, ...]
    knowledge: Knowledge
    sources: tuple[Mapping[str, str], ...] = ()
    replays: tuple[Mapping[str, Any], ...] = ()

    @property
    @abc.abstractmethod
    def opening(self) -> str:
        """The verdict as a sentence."""

    @property
    def written(self) -> markup.Document:
        return self.source.document

    def to_json(self) -> dict[str, Any]:
        """diagnosis.json; null where something takes motion, or torque that is understood."""
        return document(self, self.knowledge)

    def lines(self) -> list[str]:
        """Verdict and findings in plain sentences."""
        return [self.opening, *sentences(self.findings)]

    def save(self, folder: str | Path) -> tuple[str, ...]:
        """Write diagnosis.json, corrected.xml and corrected.json."""
        write(self, folder)
        return missing_assets(self.written, Path(folder))


def sentences(findings: Sequence[Finding]) -> list[str]:
    """What was found, and how sure that is."""
    return [f"{f.summary} Confidence {f.confidence:.2f}." for f in findings]


def document(found: Answer, knowledge: Knowledge, **more: Any) -> dict[str, Any]:
    """diagnosis.json; `more`: what other diagnoses do not have."""
    return {
        "schema": "jaxpanda.diagnosis/1",
        "verdict": found.verdict,
        "findings": [f.to_json() for f in found.findings],
        "fit": found.fit.to_json(),
        "notes": list(found.notes),
        "localisation": None,
        "heat_map": None,
        "smallest_shown": [],
        "next_experiment": None,
        "replays": [dict(one) for one in found.replays],
        "knowledge": knowledge,
        "sources": [dict(one) for one in found.sources],
        "log": [],
        **more,
    }


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
