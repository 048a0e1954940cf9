"""The whole chain on one recording: the user's, or a virtual Panda's whose truth is known."""

import dataclasses
import platform
import sys
import time
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from . import report, summaries
from .arm import Arm
from .errors import require_x64
from .export import panda_mjcf
from .files import output_folder
from .friction import Friction
from .identification import Identification, identify
from .inspection import inspect
from .mjcf import standard_from_com
from .panda import published
from .pipeline import arm_of, recordings_of, to_mjcf
from .recordings import Recording, save
from .report import Section, number
from .retrieval import Retrieval, retrieve
from .session import progress
from .simulation import (
    JointFriction,
    body_inertias,
    fourier_trajectory,
    panda_sensors,
    perturbed,
    random_trajectory,
    simulate,
)
from .validation import Validation, validate

MODEL = "panda.xml"
REPORT = "report.html"


@dataclasses.dataclass(frozen=True)
class Virtual:
    """A virtual Panda's log, another one held out, and the parameters that made them."""

    recording: Recording
    held_out: Recording
    standard: np.ndarray
    """(dof, 10), as in `jaxpanda_kernels.inertia`."""


@dataclasses.dataclass(frozen=True)
class Demonstration:
    """What the chain found, stage by stage."""

    folder: Path
    identification: Identification
    retrieval: Retrieval
    validation: Validation
    sections: Sequence[Section]
    seconds: float

    def to_json(self) -> dict[str, Any]:
        return {
            "schema": "jaxpanda.demo/1",
            "folder": str(self.folder),
            "model": MODEL,
            "report": REPORT,
            "relative_error_percent": self.identification.relative_error_percent,
            "cross_validated_relative_error_percent": self.identification.cross_validated_relative_error_percent,
            "objective": self.retrieval.objective,
            "max_violation": self.retrieval.max_violation,
            "validation": self.validation.to_json(),
            "seconds": self.seconds,
        }


def demonstrate(
    out: str | Path,
    *,
    recordings: Sequence[Path] = (),
    model: Path | None = None,
    starts: int = 1024,
    seed: int = 0,
) -> Demonstration:
    """Record (virtually, unless recordings are given), identify, retrieve, export, validate, report.

    Args:
        out: folder for everything that the single commands leave, `panda.xml` and `report.html`.
        recordings: files or folders; none for a virtual Panda.
        model: the user's MJCF; the project's Panda without it.
        starts: random starts of the retrieval.
        seed: of the virtual arm and of the starts.

    Raises:
        InputError: as the stages do; nothing is left in `out` then.
    """
    require_x64("demonstrate")
    began = time.perf_counter()
    arm = arm_of(model)
    with output_folder(out) as folder:
        if recordings:
            virtual = None
            training = recordings_of(recordings, arm)
            testing = training
        else:
            with progress("recording a virtual arm"):
                virtual = record(seed, None if model is None else Path(model).read_text("utf-8"))
            save(virtual.recording, folder / "recording.csv")
            save(virtual.held_out, folder / "held_out.csv")
            training, testing = [virtual.recording], [virtual.held_out]
        inspected = [inspect(recording, arm) for recording in training]
        with progress("identifying") as tick:
            found = identify(training, arm, progress=tick)
        found.save(folder)
        with progress("random starts") as tick:
            links = retrieve(
                found, arm=None if model is None else arm, weighting="covariance", starts=starts, seed=seed, progress=tick
            )
        links.save(folder)
        with progress("exporting and validating"):
            written = to_mjcf(links, folder / MODEL, model)
            checked = validate(folder / MODEL, testing, friction=offset_of(links.friction))
        checked.save(folder)
        held_out = "the held-out recording" if virtual else "the recording itself"
        headline = Section(
            "In short",
            [
                f"Torque error {number(found.cross_validated_relative_error_percent, 3)} % on motion that the fit had "
                f"not seen (cross-validated); {number(checked.relative_error_percent, 3)} % by {MODEL} on {held_out}.",
                f"{MODEL} holds links that could be built: largest violation {links.max_violation:g}, total mass "
                f"{links.standard[:, 0].sum():.2f} kg.",
                *(_against_truth(found, virtual.standard) if virtual else ()),
            ],
        )
        sections = [
            headline,
            *(summaries.inspection(one) for one in inspected),
            *summaries.identification(found),
            *summaries.retrieval(links),
            *summaries.export(dataclasses.replace(written, path=Path(MODEL))),
            *summaries.validation(checked),
            _provenance(training, starts, seed),
        ]
        report.to_html(f"jaxpanda: {arm.name}", sections, folder / REPORT)
    closing = Section("Written", [f"{Path(out) / name}" for name in (MODEL, REPORT)])
    return Demonstration(
        Path(out), found, links, checked, [*sections[:-1], closing], time.perf_counter() - began
    )


def record(seed: int, mjcf: str | None = None) -> Virtual:
    """Let MuJoCo's C engine move an arm whose parameters differ from its model's by about a tenth.

    The Panda follows the published exciting trajectory; any other arm, and the held-out recording, a random one.
    Friction has the published sizes on a Panda, and none elsewhere.
    """
    text = mjcf or panda_mjcf()
    truth = perturbed(text, seed)
    friction = None
    trajectory = random_trajectory(truth, seed)
    if mjcf is None:
        table = published()
        trajectory = fourier_trajectory(**{k: table["exciting_trajectory"][k] for k in ("a", "b", "q0")})
        law = table["classical_friction"]
        viscous = np.maximum(np.array(law["viscous"]), 0.0)
        friction = JointFriction(viscous, np.array(law["coulomb"]), np.array(law["offset"]))
    sensors = panda_sensors() if mjcf is None else None
    held_out = random_trajectory(truth, seed + 1)
    return Virtual(
        simulate(truth, trajectory, friction=friction, sensors=sensors, seed=seed, name="recording.csv"),
        simulate(truth, held_out, duration=10.0, friction=friction, sensors=sensors, seed=seed + 1, name="held_out.csv"),
        np.array([standard_from_com(*body) for body in zip(*body_inertias(truth), strict=True)])[-truth.nv :],
    )


def offset_of(friction: Friction | None) -> Friction | None:
    """What of the friction found an MJCF has no place for."""
    if friction is None or not np.any(friction.offset):
        return None
    zero = np.zeros_like(friction.offset)
    return Friction("coulomb_viscous_offset", {"viscous": zero, "coulomb": zero, "offset": friction.offset})


def _against_truth(found: Identification, standard: np.ndarray) -> list[str]:
    """How far identified coefficients are from the virtual arm's own, in standard deviations."""
    if found.std is None:
        return []
    distance = np.abs(found.beta - found.projection @ standard.ravel()) / found.std
    inside = int(np.sum(distance <= 2))
    return [
        f"The virtual arm's own {len(distance)} coefficients are known: {inside} were found within two standard "
        f"deviations (about {0.95 * len(distance):.0f} should be), the farthest {distance.max():.1f} away."
    ]


def _provenance(recordings: Sequence[Recording], starts: int, seed: int) -> Section:
    packages = ("jaxpanda", "jax", "mujoco", "mujoco-mjx", "numpy", "scipy")
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in packages)
    return Section(
        "Provenance",
        [
            f"Recordings: {', '.join(recording.name for recording in recordings)}; {starts} starts, seed {seed}.",
            f"Python {platform.python_version()} on {platform.platform()}; {versions}.",
            f"Command: {' '.join(Path(word).name if i == 0 else word for i, word in enumerate(sys.argv))}",
        ],
    )
