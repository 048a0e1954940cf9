"""`Rehearsal`: what a motion would tell."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..files import Kind, output_folder, write_json
from ..report import Section, Table, number

SCHEMA = "jaxpanda.rehearsal/1"
FILE = "rehearsal.json"
KIND = Kind("rehearse", (FILE,))


@dataclasses.dataclass(frozen=True)
class Row:
    """One parameter: planted, and recovered."""

    name: str
    joint: int | None
    """From 1; None for a base parameter."""
    unit: str
    truth: float
    mean: float
    """Over the draws of noise."""
    std: float | None
    """That the identification says of itself; None for what the motion does not tell."""
    error: float
    """Rms of what is off, over the draws."""
    told: bool
    """The deviation is within 30 % of what was planted."""


@dataclasses.dataclass(frozen=True)
class Fault:
    """The least size of an effect that a diagnosis would find."""

    effect: str
    joint: int | None
    parameter: str
    size: float | None
    """None where nothing of it would show."""
    unit: str
    rms_torque: float | None
    """The same at the joint that feels it most [N m]."""


@dataclasses.dataclass(frozen=True)
class Rehearsal:
    """A simulated run of a motion, and what the tool made of it."""

    motion: str
    seconds: float
    arm: str
    unit: str
    """Of torque."""
    joints: tuple[str, ...]
    draws: int
    seed: int
    rank: int
    condition_number: float | None
    relative_error_percent: float
    parameters: tuple[Row, ...]
    friction: tuple[Row, ...]
    faults: tuple[Fault, ...]
    torque_noise: list[float]
    diagnosed: Mapping[str, Any] | None
    """A planted fault, and what a diagnosis said; None where none was asked for."""
    notes: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """As `rehearsal.json` holds it."""
        rows = lambda several: [dataclasses.asdict(one) for one in several]
        return {
            "schema": SCHEMA,
            "motion": self.motion,
            "seconds": self.seconds,
            "arm": self.arm,
            "unit": self.unit,
            "joints": list(self.joints),
            "draws": self.draws,
            "seed": self.seed,
            "rank": self.rank,
            "condition_number": self.condition_number,
            "relative_error_percent": self.relative_error_percent,
            "parameters": rows(self.parameters),
            "friction": rows(self.friction),
            "not_told": [one.name for one in self.parameters if not one.told]
            + [f"{one.name} of joint {one.joint}" for one in self.friction if not one.told],
            "faults": rows(self.faults),
            "torque_noise": self.torque_noise,
            "diagnosed": None if self.diagnosed is None else dict(self.diagnosed),
            "notes": list(self.notes),
        }

    def save(self, folder: str | Path) -> Path:
        """Write `rehearsal.json`."""
        with output_folder(folder, KIND) as scratch:
            write_json(scratch / FILE, self.to_json())
        return Path(folder) / FILE

    def sections(self) -> Sequence[Section]:
        """As a terminal shows it."""
        told = sum(one.told for one in self.parameters)
        sentences = [
            f"{self.motion}, {self.seconds:.1f} s, simulated with links and friction that the analysis was not "
            f"told: {told} of {len(self.parameters)} base parameters would be known to 30 % or better (rank "
            f"{self.rank}, condition number with friction columns {number(self.condition_number)}), "
            f"{self.relative_error_percent:.2g} % of torque left.",
        ]
        if self.diagnosed is not None and (planted := self.diagnosed["planted"]):
            found = "was found" if self.diagnosed["found"] else "was not found"
            sentences.append(
                f"{planted['effect'].replace('_', ' ')} of {planted['size']:.3g} {planted['unit']} planted at "
                f"joint {planted['joint']} {found} by a diagnosis."
            )
        row = lambda one: [
            one.name if one.joint is None else f"{one.name} of joint {one.joint}",
            f"{one.truth:.4g}",
            f"{one.mean:.4g}",
            number(one.std, 2),
            f"{one.error:.2g}",
            "" if one.told else "not told",
        ]
        heads = ["parameter", "planted", "recovered", "std", "off, rms", ""]
        by_effect: dict[str, list[Fault]] = {}
        for fault in self.faults:
            by_effect.setdefault(fault.effect, []).append(fault)
        faults = [[effect.replace("_", " "), *self._least(several)] for effect, several in by_effect.items()]
        tables = [
            Table(heads, [row(one) for one in self.parameters], "Base parameters [kg m², kg m]"),
            Table(heads, [row(one) for one in self.friction], "Friction"),
            Table(
                ["effect", "least seen", "at joint", "most needed", "at joint", "never at joints"],
                faults,
                f"Rms torque [{self.unit}] from which a fault would be seen, at its best and its worst joint",
            ),
        ]
        return [Section("Rehearsal", [*sentences, *self.notes], tables)]

    def _least(self, several: Sequence[Fault]) -> list[str]:
        shown = sorted(
            (one for one in several if one.rms_torque is not None), key=lambda one: one.rms_torque or 0.0
        )
        never = ", ".join(
            "arm" if one.joint is None else str(one.joint) for one in several if one.rms_torque is None
        )
        if not shown:
            return ["–", "", "–", "", never]
        name = lambda one: "arm" if one.joint is None else str(one.joint)
        return [
            number(shown[0].rms_torque, 2),
            name(shown[0]),
            number(shown[-1].rms_torque, 2),
            name(shown[-1]),
            never,
        ]
