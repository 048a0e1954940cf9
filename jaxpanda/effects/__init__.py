"""The catalogue of physics beyond rigid bodies: one class an effect, one file a family."""

import dataclasses
import inspect
from collections.abc import Sequence

from ..errors import InputError
from . import contact, drive, friction, load, memory, sensing, stribeck, unknown
from .drive import least_order as least_order
from .effect import UNNAMED as UNNAMED
from .effect import AbstractArmEffect as AbstractArmEffect
from .effect import AbstractEffect as AbstractEffect
from .effect import AbstractInstantEffect as AbstractInstantEffect
from .effect import AbstractJointEffect as AbstractJointEffect
from .effect import AbstractMemoryEffect as AbstractMemoryEffect
from .effect import Coefficient as Coefficient
from .effect import Shape as Shape
from .effect import Stretches as Stretches
from .effect import Sweep as Sweep
from .effect import joint_columns as joint_columns
from .effect import neighbours as neighbours
from .effect import sign_over_velocity as sign_over_velocity
from .memory import Turn as Turn
from .memory import turns as turns
from .motion import Channels as Channels
from .motion import Motion as Motion
from .motion import masses as masses
from .motion import slopes as slopes
from .motion import smooth_torque as smooth_torque
from .still import LawAtRest as LawAtRest
from .still import Levels as Levels
from .still import may_carry as may_carry
from .unknown import SIGN_WIDTH as SIGN_WIDTH

CATALOGUE: tuple[type[AbstractEffect], ...] = (
    *friction.EFFECTS,
    *stribeck.EFFECTS,
    *memory.EFFECTS,
    *drive.EFFECTS,
    *load.EFFECTS,
    *sensing.EFFECTS,
    *contact.EFFECTS,
    *unknown.EFFECTS,
)


def law_of(number: str) -> type[AbstractEffect]:
    """The effect that says that a number of the user's model is wrong, by `AbstractEffect.number`."""
    return next(effect for effect in CATALOGUE if effect.number == number)


def catalogue_with(effects: Sequence[type[AbstractEffect]]) -> tuple[type[AbstractEffect], ...]:
    """The catalogue and a user's own effects after it.

    Raises:
        InputError: one that is no class of an effect, lacks a method, or goes by a name that is taken.
    """
    out = CATALOGUE
    for effect in effects:
        if not (isinstance(effect, type) and issubclass(effect, AbstractEffect)):
            raise InputError(f"effects: {effect!r} is no subclass of jaxpanda.effects.AbstractEffect")
        if inspect.isabstract(effect):
            lacking = ", ".join(sorted(effect.__abstractmethods__))
            raise InputError(f"effects: {effect.__name__} lacks {lacking}")
        if not isinstance(getattr(effect, "name", None), str):
            raise InputError(
                f"effects: {effect.__name__} lacks a name, such as name: ClassVar[str] = 'gear_slip'"
            )
        names_it = "recording" in {field.name for field in dataclasses.fields(effect)}
        if effect.bound_to_recording and effect.recordings is AbstractEffect.recordings and not names_it:
            raise InputError(
                f"effects: {effect.__name__} is bound to a recording, and lacks its name, a field recording: str"
            )
        at_some_time = (form for forms in effect.at_some_time(2, "") for form in forms)
        if any(k.scale is None for form in at_some_time for k in form.coefficients):
            raise InputError(
                f"effects: {effect.__name__} acts at some time, and its coefficients lack a plausible size:"
                " such as Coefficient('drag', 'N·m·s/rad', scale=1.0)"
            )
        taken = next((c for c in out if effect.name == c.name or effect.__name__ == c.__name__), None)
        if taken is not None:
            raise InputError(
                f"effects: {effect.__name__} ({effect.name!r}) needs a class name and a name of its own: there is"
                f" {taken.__name__} ({taken.name!r}) already"
            )
        out = (*out, effect)
    return out
