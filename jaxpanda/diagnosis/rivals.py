"""How likely each effect is in the place of another."""

from collections.abc import Sequence

import numpy as np
import scipy.special

from ..effects import AbstractEffect
from ..effects.friction import CoulombFriction, PowerLawFriction, ViscousFriction
from ..effects.memory import PreslidingHysteresis
from .events import Proposal

ACCEPT = 25.0
"""Evidence that an effect needs, its search over shapes paid for [nats]."""
TEMPERATURE, RELATIVE_TEMPERATURE = 3.0, 0.0003
"""By which differences of evidence are divided [nats, share of the evidence]: laws are never quite right, so that
evidence overstates, the more the stronger the effect."""
HOLDS = {
    "payload_change": ("payload",),
    "inertial_parameters": ("payload",),
    "torque_drift": ("torque_offset",),
    "joint_spring": ("torque_offset",),
    "power_law_friction": ("viscous_friction",),
    **dict.fromkeys(
        ("asymmetric_friction", "stribeck_friction", "load_dependent_friction", "friction_drift"),
        ("viscous_friction", "coulomb_friction"),
    ),
}
"""Effects of which others are special cases; whoever sees as much of either takes the special one."""
SPECIAL = 2.0
"""By how much, as a logarithm: what richer laws pay for in evidence, the temperature takes from them."""


def called(effect: AbstractEffect) -> str:
    """The name of what an effect is: friction that builds up over a hair's breadth is Coulomb's, and sticks; with
    about the first power of the speed it is viscous."""
    if isinstance(effect, PreslidingHysteresis) and effect.sticks:
        return CoulombFriction.name
    if isinstance(effect, PowerLawFriction) and effect.is_viscous:
        return ViscousFriction.name
    return effect.name


def odds(
    proposals: Sequence[Proposal], unknown: float | None = None
) -> dict[str, tuple[float, Proposal | None]]:
    """Probability of each effect in one place, and the likeliest proposal of its name.

    Args:
        proposals: what each would bring there.
        unknown: evidence of the free form that is there, which has met its margin already [nats].
    """
    best: dict[str, Proposal] = {}
    for proposal in proposals:
        name = called(proposal.effect)
        if name not in best or proposal.evidence > best[name].evidence:
            best[name] = proposal
    evidence = {name: p.evidence for name, p in best.items()}
    if unknown is not None:
        evidence["unknown"] = max(evidence.get("unknown", -np.inf), unknown)
    weights = np.array([*evidence.values(), 0.5 * ACCEPT])
    weights = weights / (TEMPERATURE + RELATIVE_TEMPERATURE * max(float(weights.max()), 0.0))
    joints = {name: p.effect.joints for name, p in best.items()}
    for k, name in enumerate(evidence):
        if any(joints.get(simple) == joints.get(name) for simple in HOLDS.get(name, ())):
            weights[k] -= SPECIAL
    posterior = np.exp(weights - scipy.special.logsumexp(weights))
    return {name: (float(p), best.get(name)) for name, p in zip(evidence, posterior, strict=False)}
