"""What an effect does to the torque of an arm that holds still: a law in the poses it holds."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from ..arms.arm import Arm
from .motion import Motion

_WEIGHS = 0.02
"""Deviation of friction that a model lacks, as a share of the weight beyond a joint at its lever."""
_LEAST = 0.2
"""The same where nothing weighs on the joint [N m]."""


@dataclasses.dataclass(frozen=True)
class Levels:
    """Levels of torque to be explained, those of a pose after those of another."""

    poses: Sequence[Motion]
    """The first instant of each is the pose."""
    when: Literal["throughout", "passing", "lasting"]
    """In the whole of every recording; in a part of one, which is over within it, or begins or ends with it."""
    links: Float[np.ndarray, "rows n"] | None = None
    """What links that are known roughly may be off, to one deviation [N m]; None where they do not change."""

    @property
    def dof(self) -> int:
        return self.poses[0].dof

    @functools.cached_property
    def free(self) -> Float[np.ndarray, "rows rows"]:
        """Torque of any joint in any pose, to one deviation of friction that a model lacks [N m]."""
        return np.kron(np.eye(len(self.poses)), np.diag(may_carry(self.poses[0].arm)))

    @functools.cached_property
    def alike(self) -> Float[np.ndarray, "rows dof"]:
        """Of any joint, the same in every pose [N m]."""
        return np.tile(np.diag(may_carry(self.poses[0].arm)), (len(self.poses), 1))

    def of_all_or_one(self, columns: Float[np.ndarray, "rows n"], odds: float) -> list["LawAtRest"]:
        """A torque that joints have a column of in their turn: of all of them, or, as likely, of one."""
        lone = [columns[:, joint :: self.dof] for joint in range(self.dof)]
        return [
            LawAtRest(columns, odds / 2),
            *(LawAtRest(column, odds / 2 / self.dof, joint) for joint, column in enumerate(lone)),
        ]


@dataclasses.dataclass(frozen=True)
class LawAtRest:
    """One explanation of levels of torque, linear in its parameters."""

    columns: Float[np.ndarray, "rows n"]
    """Torque of each parameter at its declared deviation [N m]."""
    odds: float
    """Beforehand, among all explanations."""
    link: int | None = None
    """Where it acts, 0-based; None: at joints that torque tells, or, with names, at the whole arm."""
    names: tuple[tuple[str, str, float], ...] = ()
    """Of the parameters: name, unit, deviation."""
    positive: bool = False
    """The first parameter is no less than 0."""
    told_by: Literal["", "keeping", "sliding"] = ""
    """What the course of torque says of it beside the level: noise as small during the event as before and after,
    as under a body and not under a hand; a slow change at its ends rather than a jump."""
    scale: float = 1.0
    """Of the columns, in those of the declared deviations."""

    def scaled(self, scale: float, share: float) -> "LawAtRest":
        """With columns smaller by `scale` and a share of the odds."""
        return dataclasses.replace(self, columns=scale * self.columns, odds=share * self.odds, scale=scale)


def may_carry(arm: Arm) -> Float[np.ndarray, " dof"]:
    """Deviation of friction that a model lacks, by what hangs beyond a joint [N m]."""
    mass = np.asarray(arm.standard[:, 0])
    steps = np.linalg.norm(np.asarray(arm.chain.p), axis=1)
    lever = np.array([0.5 * np.sum(steps[j + 1 :]) + 0.05 for j in range(arm.dof)])
    beyond = np.cumsum(mass[::-1])[::-1]
    return _LEAST + _WEIGHS * 9.81 * beyond * lever
