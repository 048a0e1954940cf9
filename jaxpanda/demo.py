"""The whole chain on one recording: the user's, or a virtual Panda's whose truth is known."""

import dataclasses
import platform
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from . import report, summaries
from .arms.export import panda_mjcf
from .arms.mjcf import standard_from_com
from .arms.model_file import Model, ModelFile, part_of
from .arms.panda import published
from .arms.source import from_mjcf
from .convention import PLAIN, Convention
from .errors import InputError, require_x64
from .files import Kind, output_folder
from .identification import Identification, identify
from .inspection import inspect
from .pipeline import arm_of, beyond_mjcf, recordings_of, to_mjcf
from .reading import Reading
from .recordings import Recording, save
from .report import Section, number
from .retrieval import Retrieval, retrieve
from .session import progress
from .simulation import (
    JointFriction,
    Sensors,
    body_inertias,
    fourier_trajectory,
    panda_sensors,
    perturbed,
    random_trajectory,
    simulate,
)
from .validation import Validation, arm_model, validate
from .versions import version

MODEL = "panda.xml"
REPORT = "report.html"
_LEAVES = ("validation.json", "identification.json", "retrieval.json", MODEL, REPORT)


@dataclasses.dataclass(frozen=True)
class Virtual:
    """A virtual Panda's log, another one held out, and the parameters that made them."""

    recording: Recording
    held_out: Recording
    standard: Float[np.ndarray, "dof 10"] | None
    """As in `jaxpanda_kernels.inertia`; None for a user's arm, whose bodies need not be its links."""


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
            "cross_validated_relative_error_percent": (
                self.identification.cross_validated_relative_error_percent
            ),
            "objective": self.retrieval.objective,
            "max_violation": self.retrieval.max_violation,
            "validation": self.validation.to_json(),
            "seconds": self.seconds,
        }


def demonstrate(
    out: str | Path,
    *,
    recordings: Sequence[Path] = (),
    model: Model | None = None,
    starts: int = 2048,
    seed: int = 0,
    reading: Reading | None = None,
    convention: Convention = PLAIN,
) -> Demonstration:
    """Record (virtually, unless recordings are given), identify, retrieve, export, validate, report.

    Args:
        out: folder for everything that the single commands leave, `panda.xml` and `report.html`.
        recordings: files or folders; none for a virtual Panda.
        model: the user's MJCF; the project's Panda without it.
        starts: random starts of the retrieval.
        seed: of the virtual arm and of the starts.
        reading: which topic, episode, columns and times of the recordings are meant.
        convention: sign, unit and order of their columns, and the gravity that the arm stands in.

    Raises:
        InputError: as the stages do; nothing is left in `out` then.
    """
    require_x64("demonstrate")
    began = time.perf_counter()
    if not recordings and (convention != PLAIN or reading not in (None, Reading())):
        raise InputError("demo: options that say how to read recordings need --recording")
    arm = arm_of(model, convention.mounting)
    made = () if recordings else ("recording.csv", "held_out.csv")
    with output_folder(out, Kind("demo", (*_LEAVES, *made))) as folder:
        if recordings:
            virtual = None
            training = recordings_of(recordings, arm, model=model, reading=reading, convention=convention)
            testing = training
        else:
            with progress("recording a virtual arm"):
                virtual = record(seed, model)
            save(virtual.recording, folder / "recording.csv")
            save(virtual.held_out, folder / "held_out.csv")
            training, testing = [virtual.recording], [virtual.held_out]
        inspected = [inspect(recording, arm) for recording in training]
        with progress("identifying") as tick:
            found = identify(training, arm, progress=tick)
        found.save(folder)
        with progress("random starts") as tick:
            links = retrieve(
                found,
                starts=starts,
                seed=seed,
                progress=tick,
            )
        links.save(folder)
        with progress("exporting and validating"):
            written = to_mjcf(links, folder / MODEL, model)
            beyond, beside = beyond_mjcf(folder / MODEL)
            corrected = folder / MODEL if model is None else ModelFile(folder / MODEL, part_of(model))
            checked = validate(corrected, testing, friction=beyond, gravity=convention.mounting)
            checked = dataclasses.replace(checked, model=MODEL, notes=(*checked.notes, *beside))
        checked.save(folder)
        held_out = "the held-out recording" if virtual else "the recording itself"
        headline = Section(
            "In short",
            [
                f"Torque error {number(found.cross_validated_relative_error_percent, 3)} % on motion that the "
                f"fit had not seen (cross-validated); {number(checked.relative_error_percent, 3)} % by {MODEL} "
                f"on {held_out}.",
                f"{MODEL} holds links that could be built: largest violation {links.max_violation:g}, total "
                f"mass {links.standard[:, 0].sum():.2f} kg.",
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


def record(seed: int, model: Model | None = None, duration: float = 20.0) -> Virtual:
    """Let MuJoCo's C engine move an arm whose parameters differ from its model's by about a tenth.

    The Panda follows the published exciting trajectory and has friction and sensors of published sizes; any
    other arm follows a random one, under noise of 0.02 N m. The held-out recording is of another motion.
    """
    if model is None:
        truth = perturbed(panda_mjcf(), seed)
        table = published()
        trajectory = fourier_trajectory(**{k: table["exciting_trajectory"][k] for k in ("a", "b", "q0")})
        law = {k: np.array(values) for k, values in table["classical_friction"].items()}
        world: dict[str, Any] = {
            "friction": JointFriction(np.maximum(law["viscous"], 0.0), law["coulomb"], law["offset"]),
            "sensors": panda_sensors(),
        }
    else:
        truth = perturbed(arm_model(from_mjcf(model)[1]), seed)
        trajectory = random_trajectory(truth, seed)
        world = {"sensors": Sensors(torque_noise=0.02)}
    held_out = random_trajectory(truth, seed + 1)
    standard = np.array([standard_from_com(*body) for body in zip(*body_inertias(truth), strict=True)])
    return Virtual(
        simulate(truth, trajectory, duration=duration, seed=seed, name="recording.csv", **world),
        simulate(truth, held_out, duration=duration / 2, seed=seed + 1, name="held_out.csv", **world),
        standard[-truth.nv :] if model is None else None,
    )


def _against_truth(found: Identification, standard: Float[np.ndarray, "dof 10"] | None) -> list[str]:
    """How far identified coefficients are from the virtual arm's own, in standard deviations."""
    if found.std is None or standard is None:
        return []
    distance = np.abs(found.beta - found.projection @ standard.ravel()) / found.std
    inside = int(np.sum(distance <= 2))
    return [
        f"The virtual arm's own {len(distance)} coefficients are known: {inside} were found within two "
        f"standard deviations (about {0.95 * len(distance):.0f} should be), the farthest "
        f"{distance.max():.1f} away."
    ]


def _provenance(recordings: Sequence[Recording], starts: int, seed: int) -> Section:
    packages = ("jaxpanda", "jax", "mujoco", "mujoco-mjx", "numpy", "scipy")
    versions = ", ".join(f"{name} {version(name)}" for name in packages)
    return Section(
        "Provenance",
        [
            f"Recordings: {', '.join(one.name for one in recordings)}; {starts} starts, seed {seed}.",
            f"Python {platform.python_version()} on {platform.platform()}; {versions}.",
            f"Command: {' '.join(Path(word).name if i == 0 else word for i, word in enumerate(sys.argv))}",
        ],
    )
