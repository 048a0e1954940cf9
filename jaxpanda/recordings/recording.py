"""`Recording`: what an arm's log says, in SI units, with an account of what reading it took."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class Recording:
    """Channels of one motion of an arm, as logged; nothing in it is filtered or resampled.

    `time` increases strictly but need not be uniform.
    """

    name: str
    """File or folder name, as messages and `diagnosis.json` call it."""
    time: Float[np.ndarray, " time"]
    """[s]"""
    q: Float[np.ndarray, "time dof"]
    """Joint positions [rad]."""
    qd: Float[np.ndarray, "time dof"] | None = None
    """Joint velocities as logged [rad/s], often late and filtered."""
    tau: Float[np.ndarray, "time dof"] | None = None
    """Measured joint torque [N m], gravity included; None for a motion."""
    path: Path | None = None
    repairs: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """How many rows or values reading dropped, filled or moved, by what was done; empty if none."""

    @property
    def dof(self) -> int:
        return self.q.shape[1]

    @property
    def samples(self) -> int:
        return len(self.time)
