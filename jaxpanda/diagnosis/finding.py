"""What a diagnosis says: one effect, where and when, how sure it is and what else it could be."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ..effects import CATALOGUE, UNNAMED

FAMILIES = {**{effect.name: effect.family for effect in CATALOGUE}, "torque_meaning": "meaning"}
"""The family of each effect that a finding may have."""

VERDICTS = {
    "consistent": "The simulation agrees with the recordings: what differs is within noise.",
    "explained": "The simulation is missing physics that explains the difference.",
    "partly_explained": "The simulation is missing physics, and part of it stays unexplained.",
    "unexplained": "The simulation differs from the recordings in a way that no effect explains.",
}
"""Each verdict as a sentence."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Finding:
    """One effect that the model was missing."""

    effect: str
    joints: tuple[int, ...]
    """0-based."""
    recordings: tuple[str, ...]
    intervals: tuple[tuple[float, float], ...] | None = None
    """When it acts [s]; None: throughout."""
    confidence: float
    """Probability that it is right."""
    alternatives: tuple[tuple[str, float], ...] = ()
    equation: str
    parameters: tuple[Mapping[str, Any], ...] = ()
    rms_torque: Float[np.ndarray, " dof"]
    evidence: float
    """Over the model without it [nats]."""
    summary: str
    terms: tuple[int, ...] = ()
    """Which terms of the model it consists of."""
    posterior: float | None = None
    """Weight among the models compared, of which `calibration` made the confidence."""
    kind: str = ""
    """Which form of the effect; "" where it has one."""
    foretold: float | None = None
    """By how much likelier it makes torque that its coefficients were not fitted to [nats]; None where it has
    none."""
    side: str = ""
    """Of the drives: "link", behind them, or "drive", in them; "" where torque was measured on one side."""
    torque_std: Float[np.ndarray, " dof"] | None = None
    """Standard deviation of its torque, by that of its coefficients, rms [N m]; None where it has none."""
    own_family: str = UNNAMED
    """Of an effect that `FAMILIES` does not have."""

    @property
    def family(self) -> str:
        """Which part of the arm, or of its recording, the effect belongs to: a word of `FAMILIES`' values."""
        return FAMILIES.get(self.effect, self.own_family)

    def to_json(self) -> dict[str, Any]:
        return {
            "effect": self.effect,
            "family": self.family,
            "kind": self.kind,
            "side": self.side or None,
            "joints": [j + 1 for j in self.joints],
            "recordings": list(self.recordings),
            "intervals": None if self.intervals is None else [list(pair) for pair in self.intervals],
            "confidence": self.confidence,
            "posterior": self.posterior,
            "alternatives": [{"effect": name, "confidence": p} for name, p in self.alternatives],
            "equation": self.equation,
            "parameters": [dict(p) for p in self.parameters],
            "rms_torque": [float(v) for v in self.rms_torque],
            "rms_torque_std": None if self.torque_std is None else [float(v) for v in self.torque_std],
            "evidence_nats": self.evidence,
            "held_out_nats": self.foretold,
            "summary": self.summary,
        }


@dataclasses.dataclass(frozen=True)
class Fit:
    """How well torque is reproduced, in the band of the diagnosis [N m]."""

    rmse_before: Float[np.ndarray, " dof"]
    rmse_after: Float[np.ndarray, " dof"]
    held_out_rmse_before: Float[np.ndarray, " dof"]
    held_out_rmse_after: Float[np.ndarray, " dof"]
    noise_floor: Float[np.ndarray, " dof"]

    @property
    def missed(self) -> Float[np.ndarray, " dof"]:
        """Of the torque that nothing was fitted to, what the model lacks beyond the noise, rms [N m]."""
        return np.sqrt(np.maximum(self.held_out_rmse_after**2 - self.noise_floor**2, 0.0))

    def to_json(self) -> dict[str, list[float]]:
        return {f.name: [float(v) for v in getattr(self, f.name)] for f in dataclasses.fields(self)}


def joined(spans: Sequence[tuple[float, float]], pause: float) -> tuple[tuple[float, float], ...]:
    """Spans in order, those with no longer a pause between them made one."""
    out = list(spans[:1])
    for start, stop in spans[1:]:
        if start <= out[-1][1] + pause:
            out[-1] = (out[-1][0], max(out[-1][1], stop))
        else:
            out.append((start, stop))
    return tuple(out)
