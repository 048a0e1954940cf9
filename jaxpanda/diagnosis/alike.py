r"""Prior odds of what joints have alike.

Gears and motors of an arm are mostly of one make: where a model lacks the friction of one joint it lacks that of
others. So the share of joints that an effect is at is unknown, and the same for all: with a flat prior over it,
one more than k of n joints has odds of k : n - k beforehand. The first has the odds of the effect's class. What a
sensor is off by is its own.
"""

from collections import defaultdict
from collections.abc import Iterable

import numpy as np

from ..effects import AbstractEffect, AbstractJointEffect

TEMPERATURE = 3.0
"""By which differences of log probability are divided where models are weighed against each other: noise is not
quite what it is taken for, and counts as evidence what is none."""


def shared(effects: Iterable[AbstractEffect], dof: int) -> float:
    """By how much likelier several effects are together, beforehand, than the odds of each by itself [nats]."""
    paid: dict[str, dict[int, float]] = defaultdict(dict)
    for effect in effects:
        if isinstance(effect, AbstractJointEffect):
            joint = effect.joints[0]
            for name, prior in _laws(effect):
                paid[name][joint] = min(prior, paid[name].get(joint, 0.0))
    gained = 0.0
    for of_joints in paid.values():
        for k, prior in enumerate(sorted(of_joints.values())[1:], 1):
            odds = TEMPERATURE * float(np.log(k / (dof - k)))
            gained += max(min(odds, 0.0) - prior, 0.0)
    return gained


def _laws(effect: AbstractEffect) -> list[tuple[str, float]]:
    """The laws that an effect is a sum of and that joints have alike, each with its own prior."""
    parts = [(part.name, part.prior) for part in effect.held]
    own = effect.prior + effect.form_prior - sum(prior for _, prior in parts)
    alike = [(part.name, part.prior) for part in effect.held if part.alike]
    return [*alike, (effect.title, own)] if effect.alike else alike
