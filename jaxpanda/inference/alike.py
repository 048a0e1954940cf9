r"""Prior odds of what joints have alike.

Gears and motors of an arm are mostly of one make: where a model lacks the friction of one joint it lacks that of
others. So the share of joints that an effect is at is unknown, and the same for all: with a flat prior over it,
one more than k of n joints has odds of k : n - k beforehand, n those that move, as the others could not show it.
The first has the odds of the effect's class. What a sensor is off by is its own.

The curves of friction over speed and load (Stribeck's, a power, the load itself) are each joint's, beside the
lines that they hold: what lines leave of bristles and warm grease leans the same way in every joint, is no
evidence of its own in each, and would add up to a curve that fits none of them. Bristles are what they are, and
shared.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping

import numpy as np

from ..effects import AbstractEffect

TEMPERATURE = 3.0
"""By which differences of log probability are divided where models are weighed against each other: noise is not
quite what it is taken for, and counts as evidence what is none."""


def shared(effects: Iterable[AbstractEffect], joints: int) -> float:
    """By how much likelier several effects are together, beforehand, than the odds of each by itself, where so
    many joints could show them [nats]."""
    return float(sum(_gained(of_joints, joints) for of_joints in _by_law(effects).values()))


def one_more(effects: Iterable[AbstractEffect], joints: int) -> Callable[[AbstractEffect], float]:
    """By how much likelier another effect is, beforehand, beside these than by itself [nats]: what it adds to
    `shared`."""
    held = _by_law(effects)

    def gained(effect: AbstractEffect) -> float:
        out = 0.0
        for law, own in _by_law([effect]).items():
            before = held.get(law, {})
            after = before | {joint: min(prior, before.get(joint, 0.0)) for joint, prior in own.items()}
            out += _gained(after, joints) - _gained(before, joints)
        return out

    return gained


def _gained(of_joints: Mapping[int, float], joints: int) -> float:
    """By how much likelier a law is together, given its prior at each joint that has it."""
    gained = 0.0
    for k, prior in enumerate(sorted(of_joints.values())[1:], 1):
        odds = TEMPERATURE * float(np.log(k / max(joints - k, k)))
        gained += max(odds - prior, 0.0)
    return gained


def joints_with(effects: Iterable[AbstractEffect]) -> frozenset[tuple[str, int]]:
    """How many joints have each law that joints have alike: what the odds of one more depend on."""
    return frozenset((law, len(joints)) for law, joints in _by_law(effects).items())


def _by_law(effects: Iterable[AbstractEffect]) -> dict[str, dict[int, float]]:
    """The prior of each law that joints have alike, at each joint that has it."""
    out: dict[str, dict[int, float]] = defaultdict(dict)
    for effect in effects:
        if effect.one_joint:
            joint = effect.joints[0]
            for law, prior in _laws(effect):
                out[law][joint] = min(prior, out[law].get(joint, 0.0))
    return out


def _laws(effect: AbstractEffect) -> list[tuple[str, float]]:
    """The laws that an effect is a sum of and that joints have alike, each with its own prior."""
    parts = [(part.name, part.prior) for part in effect.held]
    own = effect.prior + effect.form_prior - sum(prior for _, prior in parts)
    alike = [(part.name, part.prior) for part in effect.held if part.alike]
    return [*alike, (effect.title, own)] if effect.alike else alike
