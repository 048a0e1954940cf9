"""Whether a proposal is what it calls itself, beyond having evidence."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..effects import AbstractEffect
from ..inference.evidence import Design, Noise
from ..inference.problem import Problem
from ..inference.state import left_over
from .events import Proposal
from .shapes import clock, projection

_GIVEN = 0.2
AFRESH = 0.1
"""What of a drift differs at least between two repeats of a motion, as a share of what comes again."""
AFRESH_EVENT = 0.5
"""What recordings show of the difference that an event makes between two repeats, at least."""


def is_credible(problem: Problem, design: Design, noise: Noise, proposal: Proposal) -> bool:
    """Whether a proposal is what it calls itself."""
    tests = is_dissipative, is_clear, changes, is_of_time
    return is_event(problem, proposal.effect) and all(
        test(problem, design, noise, proposal) for test in tests
    )


def is_event(problem: Problem, effect: AbstractEffect) -> bool:
    """Whether what calls itself an event leaves some of its recording alone: a force that is always there says
    nothing of when, and takes what several joints' own effects explain together for one."""
    if effect.longest >= 1:
        return True
    time = clock(problem, effect.recording)  # pyright: ignore
    lasts = float(effect.stop) - float(effect.start)  # pyright: ignore
    return lasts < effect.longest * float(time[-1] - time[0])


def is_dissipative(problem: Problem, design: Design, noise: Noise, proposal: Proposal) -> bool:
    """Whether what must take energy does so, whatever the direction.

    Its even part may have either sign, but not exceed the odd one, with what the model has of friction: or it is
    a torque that does not know the direction, and no friction.
    """
    effect = proposal.effect
    if not effect.dissipates:
        return True
    j, (c, _) = effect.joints[0], fitted(problem, design, noise, proposal)
    power = [
        (x[:, 0] @ c + t.motion.friction[:, j]) * t.motion.qd[:, j]
        for x, t in zip(problem.columns([effect]), problem.traces, strict=True)
    ]
    power = np.concatenate(power)
    return bool(-power[power < 0].sum() < _GIVEN * power[power > 0].sum())


def is_clear(problem: Problem, design: Design, noise: Noise, proposal: Proposal) -> bool:
    """Whether the first coefficient, without which an effect is another one, differs from none.

    Backlash moves across its gap; swings alone, with no motion lost, are what an elastic joint makes of noise.
    """
    least = proposal.effect.clear_of_none
    if not least or proposal.evidence < 0:
        return True
    c, covariance = fitted(problem, design, noise, proposal)
    return bool(c[0] > least * np.sqrt(covariance[0, 0]))


def changes(problem: Problem, design: Design, noise: Noise, proposal: Proposal) -> bool:
    """Whether a drift is likelier than the steady laws of its kind, whatever their signs, by what their prior
    odds are better: one that is over at once, or hardly changes, is only called a drift."""
    effect = proposal.effect
    if not effect.drifts or not effect.steady or proposal.evidence < 0:
        return True
    parts = [problem.columns([one]) for one in (*effect.steady, effect)]
    columns = [np.concatenate(of_one, -1) for of_one in zip(*parts, strict=True)]
    b, G = (x[0] for x in projection(problem, design, noise, [effect], columns))
    laws = slice(0, sum(len(law.coefficients) for law in effect.steady))
    told = lambda at: 0.5 * float(b[at] @ np.linalg.lstsq(G[at, at], b[at])[0])
    return told(slice(None)) - told(laws) > max(law.prior for law in effect.steady) - effect.prior


def is_of_time(problem: Problem, design: Design, noise: Noise, proposal: Proposal) -> bool:
    """Whether what calls itself a drift or an event tells one repeat of a motion from the next, where there are
    repeats.

    What comes again with the motion, and is no steady law of the drift's kind, is some function of the motion.
    """
    effect = proposal.effect
    if not (effect.drifts or effect.is_event) or proposal.evidence < 0:
        return True
    shifts = [round(t.signals.period / t.motion.dt) if t.signals.period else 0 for t in problem.traces]
    if not any(shifts):
        return True
    c, _ = fitted(problem, design, noise, proposal)
    noise = dataclasses.replace(noise, slow=None)  # how a repeat differs is all of it, however slow
    told = apart = beyond = 0.0
    for j in effect.joints if effect.one_joint else range(problem.dof):
        whitened = lambda one, j=j: problem.whitened([x[:, j] for x in problem.full_columns(one)], noise, j)
        law = np.column_stack([np.zeros((problem.rows[-1].stop, 0)), *map(whitened, effect.steady)])
        own = whitened(effect) @ c
        (left,) = left_over(problem, noise, design.terms, design.x, [j])
        differ, alike = _between_repeats(
            problem, j, shifts, np.column_stack([np.concatenate(left), own, law])
        )
        left, own = differ.T[:2]
        told += 0.25 * float(left @ left - (left - own) @ (left - own))
        apart += 0.25 * float(own @ own)
        own, law = alike[:, 1], alike[:, 2:]
        beyond += float(np.sum((own - law @ np.linalg.lstsq(law, own)[0]) ** 2))
    return told >= (AFRESH * beyond if effect.drifts else AFRESH_EVENT * apart)


def _between_repeats(
    problem: Problem, joint: int, shifts: Sequence[int], x: Float[np.ndarray, "rows n"]
) -> tuple[Float[np.ndarray, "_pairs n"], Float[np.ndarray, "_pairs n"]]:
    """Difference of one repeat and the next, and their mean, in the rows of a joint that count in both."""
    apart, alike = [np.zeros((0, x.shape[1]))], [np.zeros((0, x.shape[1]))]
    for rows, trace, shift in zip(problem.rows, problem.traces, shifts, strict=True):
        part = x[rows]
        if 0 < shift < len(part):
            counts = (trace.weights[shift:, joint] > 0) & (trace.weights[:-shift, joint] > 0)
            apart.append((part[shift:] - part[:-shift])[counts])
            alike.append(0.5 * (part[shift:] + part[:-shift])[counts])
    return np.concatenate(apart), np.concatenate(alike)


def fitted(
    problem: Problem, design: Design, noise: Noise, proposal: Proposal
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n n"]]:
    """A proposal's coefficients beside what is in the model, and their covariance."""
    effects = [proposal.effect]
    b, G = projection(problem, design, noise, effects, problem.columns(effects))
    covariance = np.linalg.inv(G[0] + np.diag(proposal.deviation**-2.0))
    return covariance @ b[0], covariance
