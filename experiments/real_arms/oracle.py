"""How well a model with given effects does where it was not fitted; the effects are the tool's or an oracle's."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from jaxpanda import signals
from jaxpanda.diagnosis import Diagnosis
from jaxpanda.diagnosis.diagnosis import fit
from jaxpanda.effects import AbstractEffect
from jaxpanda.inference.problem import FOLDS, Problem, Term
from jaxpanda.inference.state import with_terms
from jaxpanda.search.steps import search

_LOOSE = 30.0
"""Prior deviation of an oracle's coefficients, in units of the noise: it is told which effects, not how large."""


def _terms(problem: Problem, effects: Sequence[AbstractEffect | Term]) -> list[Term]:
    noise = problem.noise(()).std
    out = []
    for effect in effects:
        if isinstance(effect, Term):
            out.append(effect)
            continue
        columns = np.concatenate(problem.full_columns(effect))
        size = np.sqrt(np.mean((columns / noise[:, None]) ** 2, 0)).max(0)
        physical = [np.inf if k.scale is None else 10 * k.scale for k in effect.coefficients]
        out.append(problem.term(effect, np.minimum(_LOOSE / np.maximum(size, 1e-9), physical)))
    return out


def held_out_rmse(found: Diagnosis, effects: Sequence[AbstractEffect | Term]) -> np.ndarray:
    """Each joint's error [N m] on blocks left out of the fit, in the band of the diagnosis."""
    return fit(found.problem, with_terms(found.problem, _terms(found.problem, effects))).held_out_rmse_after


def cross_validated(
    found: Diagnosis, effects: Sequence[AbstractEffect | Term], cutoff: float
) -> tuple[float, float]:
    """Relative error [%] of low-passed torque, in sample and on phase blocks that the coefficients have not seen.

    Which effects, and their shapes, were chosen on all samples; both repeats of a block are held out together,
    with 0.1 s around it.
    """
    problem = found.problem
    terms = _terms(problem, effects)
    noise = problem.noise(terms)
    fitted = [(problem.design(terms, noise).x, [t.weight > 0 for t in problem.traces])]
    inside = _relative(problem, terms, fitted, cutoff)
    held = []
    for splits in signals.blocks_many([t.signals for t in problem.traces], FOLDS):
        x = _without(problem, splits).design(terms, noise).x
        held.append((x, [test for _, test in splits]))
    return inside, _relative(problem, terms, held, cutoff)


def nested(found: Diagnosis, cutoff: float) -> float:
    """The same on held-out blocks, with the effects and shapes searched for anew without each block."""
    error, size = 0.0, 0.0
    problem = found.problem
    for splits in signals.blocks_many([t.signals for t in problem.traces], FOLDS):
        rest = _without(problem, splits)
        laws = with_terms(rest, [t.law for t in search(rest).terms])
        terms = [problem.term(t.effect, t.deviation) for t in laws.terms]
        tests = [test for _, test in splits]
        e, s = _squares(problem, terms, laws.design.x, tests, cutoff)
        error, size = error + e, size + s
    return 100 * float(np.sqrt(error / size))


def _without(problem: Problem, splits: Sequence[signals.Split]) -> Problem:
    traces = tuple(
        dataclasses.replace(t, weight=t.weight * train)
        for t, (train, _) in zip(problem.traces, splits, strict=True)
    )
    return dataclasses.replace(problem, traces=traces)


def _relative(problem: Problem, terms, fitted, cutoff: float) -> float:
    squares = [_squares(problem, terms, x, tests, cutoff) for x, tests in fitted]
    return 100 * float(np.sqrt(sum(e for e, _ in squares) / sum(s for _, s in squares)))


def _squares(problem: Problem, terms, x, tests, cutoff: float) -> tuple[float, float]:
    error, size, x = 0.0, 0.0, problem.explained(x, terms)
    for r, (trace, test) in enumerate(zip(problem.traces, tests, strict=True)):
        columns = np.concatenate([problem.nuisance[r], *(t.columns[r] for t in terms)], 2)
        assert trace.tau is not None
        smooth = lambda v, t=trace: signals.zero_phase(v, cutoff, 1 / t.motion.dt)
        edge = max(0.2, 1 / cutoff)
        time = trace.motion.time
        counts = test & (trace.weight > 0) & (time > time[0] + edge) & (time < time[-1] - edge)
        error += float(np.sum(smooth(problem.residual[r] - columns @ x)[counts] ** 2))
        size += float(np.sum(smooth(trace.tau)[counts] ** 2))
    return error, size
