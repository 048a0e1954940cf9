"""A torque column that is not joint torque: one finding that says what it is, and no physics sought in it."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from .. import summaries
from ..arms.mjcf import MjcfSource
from ..corrected import Corrected
from ..inference.knowledge import Knowledge
from ..meaning import Meaning, borne_out, meaning
from ..recordings import Recording
from ..report import Section
from ..traces import Trace
from .finding import Finding, Fit
from .saved import AbstractAsItIs

EQUATIONS = {
    "gravity_removed": "column = tau - g(q)",
    "sign": "column = sign * tau",
    "unit": "column = factor * tau",
    "current": "column = factor_j * tau",
    "motor_side": "column = factor_j * tau",
    "joint_order": "column = tau of another joint",
    "mounting": "tau = M(q) ddq + c(q, dq) + g(q; gravity)",
}
"""What each kind of column holds, by the torque that inverse dynamics gives."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Misread(AbstractAsItIs):
    """Recordings whose torque is not what the model's inverse dynamics gives."""

    verdict: str = "unexplained"
    """No physics was sought, so that none is explained."""

    @property
    def opening(self) -> str:
        return "The torque in the recordings is not what inverse dynamics gives: no physics was sought in it."


def misread(
    recordings: Sequence[Recording], traces: Sequence[Trace], source: MjcfSource, knowledge: Knowledge
) -> Misread | None:
    """What the torque columns are, where that is not joint torque in one of the recordings; else None.

    Args:
        recordings: those in question.
        traces: of the same, in the same order.
        source: the simulation.
        knowledge: how well its numbers are known; passed on.
    """
    arm = traces[0].motion.arm
    read = [(one, meaning(one, arm)) for one in recordings]
    beside = lambda one: [other for other in recordings if other is not one]
    told = [(one.name, m) for one, m in read if m is not None and borne_out(m, beside(one), arm)]
    if not told:
        return None
    alike: dict[tuple[str, tuple[int, ...]], list[tuple[str, Meaning]]] = {}
    for name, found in told:
        alike.setdefault((found.kind, found.joints), []).append((name, found))
    findings = [_finding([name for name, _ in group], max((m for _, m in group), key=lambda m: m.evidence), arm)
                for group in alike.values()]  # fmt: skip
    rms = np.sqrt(np.mean(np.concatenate([t.residual * t.weight[:, None] for t in traces]) ** 2, 0))
    floors = [t.signals.noise for t in traces if t.signals.noise is not None]
    floor = np.maximum(np.mean(floors, 0), 1e-9) if floors else np.full(arm.dof, 1e-9)
    others = sorted({one.name for one in recordings} - {name for name, _ in told})
    notes = [f"torque is joint torque, or cannot be told, in {', '.join(others)}"] if others else []
    notes.append("corrected.xml and `predict` are your model as it is: mend the torque column first")
    return Misread(
        findings=tuple(sorted(findings, key=lambda f: -f.evidence)),
        fit=Fit(rms, rms, rms, rms, floor),
        corrected=Corrected.of(arm),
        source=source,
        notes=tuple(notes),
        knowledge=knowledge,
    )


def _finding(names: Sequence[str], found: Meaning, arm: Any) -> Finding:
    """A meaning as a finding."""
    parameters: list[dict[str, Any]] = []
    if found.gravity is not None:
        parameters = [
            {"name": f"gravity_{axis}", "joint": None, "value": value, "std": None, "unit": "m/s²"}
            for axis, value in zip("xyz", found.gravity, strict=True)
        ]
    elif found.kind == "joint_order":
        parameters = [
            {"name": "joint_of_column", "joint": c + 1, "value": float(j + 1), "std": None, "unit": ""}
            for c, j in enumerate(found.order)
        ]
    elif found.kind != "gravity_removed":
        parameters = [
            {"name": "factor", "joint": j + 1, "value": found.factors[j], "std": None, "unit": ""}
            for j in found.joints
        ]
    return Finding(
        effect="torque_meaning",
        joints=found.joints,
        recordings=tuple(names),
        confidence=found.confidence,
        equation=EQUATIONS[found.kind],
        parameters=tuple(parameters),
        rms_torque=np.asarray(found.rms),
        evidence=found.evidence,
        summary=f"In {', '.join(names)}: {found.summary}",
        kind=found.kind,
    )


def sections(found: Misread) -> list[Section]:
    """The page."""
    return [*summaries.diagnosis(found), Section("Your file", ["corrected.xml is your file as it was."])]
