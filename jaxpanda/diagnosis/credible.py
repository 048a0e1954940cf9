"""Whether a proposal is what it calls itself, beyond having evidence."""

import numpy as np
from jaxtyping import Float

from ..effects import AbstractEffect
from ..effects.contact import ExternalContact
from ..effects.drive import Backlash
from ..effects.friction import AsymmetricFriction, FrictionDrift
from ..effects.sensing import TorqueDrift
from .events import Proposal
from .evidence import Design, Noise
from .problem import Problem
from .shapes import clock, projection

LASTING = 0.8
"""Share of its recording that a contact takes at most."""
_GIVEN = 0.2
CLEAR = 4.0
"""Standard deviations by which a gap must differ from none."""
AFRESH = 0.1
"""What of a drift differs at least between two repeats of a motion, as a share of what comes again."""


def is_credible(problem: Problem, design: Design, noise: Noise, proposal: Proposal) -> bool:
    """Whether a proposal is what it calls itself."""
    tests = is_dissipative, has_play, is_of_time
    return is_event(problem, proposal.effect) and all(
        test(problem, design, noise, proposal) for test in tests
    )


def is_event(problem: Problem, effect: AbstractEffect) -> bool:
    """Whether what calls itself a contact leaves some of its recording alone: a force that is always there says
    nothing of when, and takes what several joints' own effects explain together for one."""
    if not isinstance(effect, ExternalContact):
        return True
    time = clock(problem, effect.recording)
    return float(effect.stop) - float(effect.start) < LASTING * float(time[-1] - time[0])


def is_dissipative(problem: Problem, design: Design, noise: Noise, proposal: Proposal) -> bool:
    """Whether what calls itself friction that depends on the direction takes energy, whatever the direction.

    Its even part may have either sign, but not exceed the odd one, with what the model has of friction: or it is
    a torque that does not know the direction, and no friction.
    """
    effect = proposal.effect
    if not isinstance(effect, AsymmetricFriction):
        return True
    j, (c, _) = effect.joints[0], fitted(problem, design, noise, proposal)
    power = [
        (x[:, 0] @ c + t.motion.friction[:, j]) * t.motion.qd[:, j]
        for x, t in zip(problem.columns([effect]), problem.traces, strict=True)
    ]
    power = np.concatenate(power)
    return bool(-power[power < 0].sum() < _GIVEN * power[power > 0].sum())


def has_play(problem: Problem, design: Design, noise: Noise, proposal: Proposal) -> bool:
    """Whether what calls itself backlash moves across its gap, and does not only swing at its stops.

    Swings alone, with no motion lost, are what an elastic joint makes of noise.
    """
    if not isinstance(proposal.effect, Backlash) or proposal.evidence < 0:
        return True
    c, covariance = fitted(problem, design, noise, proposal)
    return bool(c[0] > CLEAR * np.sqrt(covariance[0, 0]))


def is_of_time(problem: Problem, design: Design, noise: Noise, proposal: Proposal) -> bool:
    """Whether what calls itself a drift tells one repeat of a motion from the next, where there are repeats.

    What comes again with the motion, and is no steady law of the drift's kind, is some function of the motion.
    """
    effect = proposal.effect
    if not isinstance(effect, TorqueDrift | FrictionDrift) or proposal.evidence < 0:
        return True
    shifts = [round(t.signals.period / t.motion.dt) if t.signals.period else 0 for t in problem.traces]
    if not any(shifts):
        return True
    j, (c, _) = effect.joints[0], fitted(problem, design, noise, proposal)
    whitened = lambda one: problem.whitened(problem.columns([one]), noise, j)[:, 0]
    steady = [whitened(law) for law in effect.steady]
    parts = np.column_stack([design.left[j], whitened(effect) @ c, *steady])
    ends = np.cumsum([t.motion.samples for t in problem.traces])
    apart, alike = [np.zeros((0, parts.shape[1]))], [np.zeros((0, parts.shape[1]))]
    for part, trace, shift in zip(np.split(parts, ends[:-1]), problem.traces, shifts, strict=True):
        if 0 < shift < len(part):
            counts = (trace.weights[shift:, j] > 0) & (trace.weights[:-shift, j] > 0)
            apart.append((part[shift:] - part[:-shift])[counts])
            alike.append(0.5 * (part[shift:] + part[:-shift])[counts])
    left, drift, *_ = np.concatenate(apart).T
    told = 0.25 * float(left @ left - (left - drift) @ (left - drift))
    _, drift, *steady = np.concatenate(alike).T
    law = np.column_stack(steady)
    return told >= AFRESH * float(np.sum((drift - law @ np.linalg.lstsq(law, drift)[0]) ** 2))


def fitted(
    problem: Problem, design: Design, noise: Noise, proposal: Proposal
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n n"]]:
    """A proposal's coefficients beside what is in the model, and their covariance."""
    effects = [proposal.effect]
    b, G = projection(problem, design, noise, effects, problem.columns(effects))
    covariance = np.linalg.inv(G[0] + np.diag(proposal.deviation**-2.0))
    return covariance @ b[0], covariance
