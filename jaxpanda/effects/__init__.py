"""The catalogue of physics beyond rigid bodies: one class an effect, one file a family."""

from . import contact, drive, friction, load, memory, sensing, stribeck, unknown
from .effect import AbstractArmEffect as AbstractArmEffect
from .effect import AbstractEffect as AbstractEffect
from .effect import AbstractInstantEffect as AbstractInstantEffect
from .effect import AbstractJointEffect as AbstractJointEffect
from .effect import AbstractMemoryEffect as AbstractMemoryEffect
from .effect import Coefficient as Coefficient
from .effect import Shape as Shape
from .effect import Stretches as Stretches
from .effect import joint_columns as joint_columns
from .effect import neighbours as neighbours
from .effect import sign_over_velocity as sign_over_velocity
from .memory import turns as turns
from .motion import Channels as Channels
from .motion import Motion as Motion
from .motion import masses as masses
from .motion import slopes as slopes
from .motion import smooth_torque as smooth_torque

CATALOGUE = (
    *friction.EFFECTS,
    *stribeck.EFFECTS,
    *memory.EFFECTS,
    *drive.EFFECTS,
    *load.EFFECTS,
    *sensing.EFFECTS,
    *contact.EFFECTS,
    *unknown.EFFECTS,
)
