"""Forces from outside."""

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ..arm import Arm
from .effect import AbstractArmEffect, Coefficient, Shape
from .load import window
from .motion import Motion


class ExternalContact(AbstractArmEffect):
    r"""A force from outside on a link over an interval: $\tau = -J_i(q)^\top w$ for $t_0 \le t < t_1$.

    $w$ is a constant wrench at the origin of the link's frame; form "base" keeps it along the base's axes, "link"
    along the link's. Joints beyond the link do not feel it.

    References:
        Haddadin, De Luca, Albu-Schäffer, T-RO 2017.
    """

    name: ClassVar[str] = "external_contact"
    shapes: ClassVar[tuple[Shape, ...]] = (
        Shape("start", "s", -np.inf, np.inf, False),
        Shape("stop", "s", -np.inf, np.inf, False),
    )
    reveals: ClassVar[str] = "the same motion again: a contact does not come back with it"
    confounded_with: ClassVar[tuple[str, ...]] = ("payload_change", "torque_drift")
    bound_to_recording: ClassVar[bool] = True

    link: int = eqx.field(static=True)
    start: Float[Array, ""] | float
    stop: Float[Array, ""] | float
    recording: str = eqx.field(static=True)
    form: str = eqx.field(static=True)

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["ExternalContact"]:
        return []  # the event scan proposes them

    def variants(self) -> Sequence["ExternalContact"]:
        return [dataclasses.replace(self, form="link" if self.form == "base" else "base")]

    @property
    def joints(self) -> tuple[int, ...]:
        return (self.link,)

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        force = tuple(Coefficient(f"force_{axis}", "N", scale=10.0) for axis in "xyz")
        return force + tuple(Coefficient(f"moment_{axis}", "N·m", scale=1.5) for axis in "xyz")

    @property
    def equation(self) -> str:
        return f"tau = -J_{self.link + 1}(q)^T * (force, moment) while start <= t < stop"

    def over(self, motion: Motion) -> Float[np.ndarray, "time dof n"]:
        J = motion.wrench_columns[:, self.link]
        if self.form == "link":
            R = motion.link_axes[:, self.link]
            J = np.concatenate([J[..., :3] @ R, J[..., 3:] @ R], -1)
        return J * window(motion.time, float(self.start), float(self.stop), motion.dt)[:, None, None]

    def parameters(self, c, covariance) -> list[dict[str, Any]]:
        joint = self.link + 1
        out = super().parameters(c, covariance)
        size = float(np.linalg.norm(c[:3]))
        toward = c[:3] / max(size, 1e-12)
        std = float(np.sqrt(max(toward @ covariance[:3, :3] @ toward, 0.0)))
        return [{"name": "force", "joint": joint, "value": size, "std": std, "unit": "N"}, *out]


EFFECTS = (ExternalContact,)
