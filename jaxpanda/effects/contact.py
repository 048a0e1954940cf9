"""Forces from outside."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxpanda_kernels import link_poses
from jaxtyping import Array, Float

from ..arms.arm import Arm
from .effect import EVER, AbstractArmEffect, Coefficient, Resistance, Shape
from .load import body_at_rest, window
from .motion import Motion, wrench_columns
from .still import LawAtRest, Levels

_FORCE, _MOMENT = 30.0, 5.0
"""Deviations of a force from outside [N] and of its moment [N m] on an arm that holds still."""
_LEANS = 0.2
"""Share of such forces that point straight down, or up, as a weight does."""
_PUSH, _PUSHES = 1.0, 5
"""Length of the contact whose smallest size is told [s], and at how many times of a recording it is tried."""


class ExternalContact(AbstractArmEffect):
    r"""A force from outside on a link over an interval: $\tau = -J_i(q)^\top w$ for $t_0 \le t < t_1$.

    Form "base": w is a constant wrench at the origin of the link's frame, along the base's axes; form "link":
    along the link's. Forms "point base" and "point link" are a force alone, at `point` of the link [m]: three
    numbers where a wrench takes six. Joints beyond the link do not feel any.

    References:
        Haddadin, De Luca, Albu-Schäffer, T-RO 2017.
    """

    name: ClassVar[str] = "external_contact"
    family: ClassVar[str] = "contact"
    prior: ClassVar[float] = -17.0
    shapes: ClassVar[tuple[Shape, ...]] = (
        Shape("start", "s", -np.inf, np.inf, False),
        Shape("stop", "s", -np.inf, np.inf, False),
    )
    reveals: ClassVar[str] = "the same motion again: a contact does not come back with it"
    bound_to_recording: ClassVar[bool] = True
    longest: ClassVar[float] = 0.8
    size_of: ClassVar[tuple[str, int]] = ("force", 3)
    repeats: ClassVar[bool] = True
    at_rest: ClassVar[str] = "a force from outside"
    on_links: ClassVar[bool] = True

    link: int = eqx.field(static=True)
    start: Float[Array, ""] | float
    stop: Float[Array, ""] | float
    recording: str = eqx.field(static=True)
    form: str = eqx.field(static=True)
    point: tuple[float, ...] = eqx.field(static=True, default=(0.0, 0.0, 0.0))

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["ExternalContact"]:
        return []

    @classmethod
    def at_some_time(cls, dof: int, recording: str) -> Sequence[Sequence["ExternalContact"]]:
        return [[cls(link, -EVER, EVER, recording, "base")] for link in range(dof)]

    @classmethod
    def typical(cls, recordings: Mapping[str, Motion]) -> Sequence[Sequence["ExternalContact"]]:
        name, motion = next(iter(recordings.items()))
        first, last = float(motion.time[0]) + 1, float(motion.time[-1]) - 1
        starts = [float(s) for s in np.linspace(first, max(last - _PUSH, first + 0.1), _PUSHES)]
        return [[cls(link, s, s + _PUSH, name, "base") for s in starts] for link in range(motion.dof)]

    @classmethod
    def while_still(cls, levels: Levels) -> Sequence[LawAtRest]:
        """A force and a moment on each link, along the base's axes; one that lasts is another in every pose."""
        dof, poses = levels.dof, levels.poses
        deviations = np.repeat([_FORCE, _MOMENT], 3)
        on = [[pose.wrench_columns[0, link] * deviations for pose in poses] for link in range(dof)]
        if levels.when == "throughout":
            return [
                LawAtRest(np.asarray(scipy.linalg.block_diag(*on[link])), 0.08 / dof, link)
                for link in range(dof)
            ]
        odds = 0.3 if levels.when == "passing" else 0.2
        names = tuple(
            (f"{what}_{axis}", unit, size)
            for what, unit, size in (("force", "N", _FORCE), ("moment", "N·m", _MOMENT))
            for axis in "xyz"
        )
        pushes = [
            LawAtRest(np.concatenate(on[link]), (1 - _LEANS) * odds / dof, link, names) for link in range(dof)
        ]
        return [*pushes, body_at_rest(levels, _LEANS * odds)]

    def variants(self, arm: Arm) -> Sequence["ExternalContact"]:
        phi = np.asarray(arm.standard[self.link])
        com = phi[1:4] / phi[0] if phi[0] > 1e-3 else np.zeros(3)
        last = self.link == arm.dof - 1
        ends = [np.array([0, 0, z]) for z in (0.1, 0.2)] if last else [np.asarray(arm.chain.p[self.link + 1])]
        points = {tuple(float(v) for v in p) for p in (np.zeros(3), com, *ends)}
        wrenches = [dataclasses.replace(self, form=form) for form in ("base", "link")]
        forces = [
            dataclasses.replace(self, form=form, point=p)
            for form in ("point base", "point link")
            for p in sorted(points)
        ]
        return [v for v in (*wrenches, *forces) if (v.form, v.point) != (self.form, self.point)]

    def placed(self, recording: str, later: bool | None) -> "ExternalContact | None":
        return self if recording == self.recording else None

    def within(self, first: float, last: float, step: float) -> "ExternalContact":
        """Kept as long as what the filters of motion and torque resolve."""
        if self.stop - self.start >= step:
            return self
        middle = 0.5 * (float(self.start) + float(self.stop))
        return dataclasses.replace(self, start=middle - 0.5 * step, stop=middle + 0.5 * step)

    @property
    def joints(self) -> tuple[int, ...]:
        return (self.link,)

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        force = tuple(Coefficient(f"force_{axis}", "N", scale=10.0) for axis in "xyz")
        if self.form.startswith("point"):
            return force
        return force + tuple(Coefficient(f"moment_{axis}", "N·m", scale=1.5) for axis in "xyz")

    @property
    def equation(self) -> str:
        w = "force" if self.form.startswith("point") else "(force, moment)"
        return f"tau = -J_{self.link + 1}(q)^T * {w} while start <= t < stop"

    def over(self, motion: Motion) -> Float[np.ndarray, "time dof n"]:
        J, R = motion.wrench_columns[:, self.link], motion.link_axes[:, self.link]
        force, moment = J[..., :3], J[..., 3:]
        if self.form.startswith("point"):  # the moment of a force f at the point is arm x f
            lever = R @ np.array(self.point)
            force = force + np.cross(moment, lever[:, None])
            moment = moment[..., :0]
        if self.form.endswith("link"):
            force, moment = force @ R, moment @ R if moment.shape[-1] else moment
        columns = np.concatenate([force, moment], -1)
        return columns * window(motion.time, float(self.start), float(self.stop), motion.dt)[:, None, None]

    def resist(self, c, arm, z, s, dt):
        q = jnp.asarray(s.q)
        R = link_poses(arm.chain, q)[0][self.link]
        point = self.form.startswith("point")
        force, moment = c[:3], jnp.cross(jnp.array(self.point), c[:3]) if point else c[3:]
        if not self.form.endswith("link"):  # along the base's axes: only the lever turns with the link
            moment = jnp.cross(R @ jnp.array(self.point), force) if point else moment
        else:
            force, moment = R @ force, R @ moment
        torque = wrench_columns(arm, q)[self.link] @ jnp.concatenate([force, moment])
        return Resistance(torque * window(s.t, self.start, self.stop, dt), jnp.zeros_like(s.q), z)

    def parameters(self, c, covariance) -> list[dict[str, Any]]:
        joint = self.link + 1
        out = super().parameters(c, covariance)
        size = float(np.linalg.norm(c[:3]))
        toward = c[:3] / max(size, 1e-12)
        std = float(np.sqrt(max(toward @ covariance[:3, :3] @ toward, 0.0)))
        return [{"name": "force", "joint": joint, "value": size, "std": std, "unit": "N"}, *out]


EFFECTS = (ExternalContact,)
