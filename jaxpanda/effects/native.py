"""What MuJoCo's joints hold natively, in place of laws that they do not hold."""

from ..arms.arm import Arm
from .drive import JointSpring
from .effect import AbstractEffect, AbstractJointEffect
from .friction import CoulombFriction, ViscousFriction

_TURNING = 1e-3
"""Velocity over which MuJoCo's `frictionloss` may be said to turn [rad/s]."""


def nearest(effect: AbstractEffect, arm: Arm) -> list[AbstractJointEffect]:
    """Effects with a native form that together, with coefficients of their own, come nearest to one that has
    none: of friction its mean level and slope, of a spring a linear one. Empty where MuJoCo has nothing like it.
    """
    if not isinstance(effect, AbstractJointEffect):
        return []
    joint = int(effect.joint)
    if effect.dry:
        return [ViscousFriction(joint), CoulombFriction(joint, _TURNING)]
    if isinstance(effect, JointSpring) and arm.stiffness[joint] == 0:
        return [JointSpring(joint, "linear", effect.around)]
    return []
