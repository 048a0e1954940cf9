"""Shapes of one effect at one place: the evidence of each, and where it is highest."""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..effects import AbstractEffect
from ..inference.evidence import Design, Noise, gram, log_bayes, log_mean_exp
from ..inference.library import form_of
from ..inference.problem import Problem
from ..inference.scan import scales_of
from .events import BIN, Proposal

_ROUNDS = 3
_SHORTER, _ENOUGH = 0.35, 0.05
"""Of a search over shapes: by what its steps get shorter, and the gain with which it ends [nats]."""


def clock(problem: Problem, recording: str) -> Float[np.ndarray, " time"]:
    """Times of a recording, by its name [s]."""
    return next(t.motion.time for t in problem.traces if t.name == recording)


def first_steps(effect: AbstractEffect) -> tuple[float, ...]:
    """Of a refinement: a factor where the shape is logarithmic, a tenth of a second for what happens in time."""
    ranges = [s.upper - s.lower for s in effect.shapes]
    return tuple(
        0.3 if s.logarithmic else 0.03 * r if np.isfinite(r) else BIN
        for s, r in zip(effect.shapes, ranges, strict=True)
    )


def _deviation(coefficients, columns: np.ndarray, unit: float) -> Float[np.ndarray, "m n"]:
    """Prior deviation of each coefficient: its plausible size, or that of an effect as large as the noise.

    Args:
        coefficients: of the effect.
        columns: `(time, m, n)`, or `(time, dof, m, n)` over the noise; the joint that feels most counts.
        unit: noise of the joint.
    """
    size = np.sqrt((columns**2).mean(0))
    if size.ndim == 3:
        size = size.max(0)
    deviation = unit / np.maximum(size, 1e-9 * max(float(size.max()), 1e-12))
    for k, coefficient in enumerate(coefficients):
        if coefficient.scale is not None:
            deviation[:, k] = coefficient.scale
    return deviation


def score(
    problem: Problem, design: Design, noise: Noise, effects: Sequence[AbstractEffect]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m n"]]:
    """Evidence of single shapes of one form at one place, and their prior deviations."""
    columns = problem.columns(effects)
    value, scale, deviation = _score(problem, design, noise, effects, columns)
    return value, deviation * scale[:, None]


def _score(problem: Problem, design: Design, noise: Noise, effects, columns):
    """Evidence, likeliest scale, and prior deviations before the scale."""
    coefficients = effects[0].coefficients
    signs = np.array(effects[0].signs(problem.arm), float)
    b, G = projection(problem, design, noise, effects, columns)
    if effects[0].one_joint:
        unit = float(noise.std[effects[0].joints[0]])
        deviation = _deviation(coefficients, np.concatenate(columns), unit)
    else:
        deviation = _deviation(coefficients, np.concatenate(columns) / noise.std[:, None, None], 1.0)
    value, scale = log_bayes(b, G, deviation, scales_of(effects[0]), signs)
    return value + [e.form_prior for e in effects], scale, deviation


def projection(problem: Problem, design: Design, noise: Noise, effects, columns):
    """b and G of single shapes of one form at one place."""

    def prepared(j, parts):
        Phi = problem.whitened(parts, noise, j)
        return Phi, gram(Phi)

    if effects[0].one_joint:
        j = effects[0].joints[0]
        return design.in_joint(j, *prepared(j, columns))
    parts = [prepared(j, [c[:, j] for c in columns]) for j in range(problem.dof)]
    return design.in_arm([p[0] for p in parts], [p[1] for p in parts])


def refine(problem: Problem, design: Design, noise: Noise, proposal: Proposal) -> Proposal:
    """Move the shape to where the evidence is highest, and see if another form does better there.

    A pattern search whose every round is one batch.
    """
    arm, shapes = problem.arm, proposal.effect.shapes
    if not shapes and not proposal.effect.variants(arm):
        return proposal
    steps = proposal.steps[: len(shapes)]
    effect, best, deviation = climbed(problem, design, noise, proposal.effect, steps)
    likeliest, paid = best, 0.0
    variants = sorted(effect.variants(arm), key=form_of)
    for _, group in itertools.groupby(variants, form_of):
        alike = list(group)
        values, deviations = score(problem, design, noise, alike)
        top = int(values.argmax())
        other = alike[top], float(values[top]), deviations[top]
        search = float(log_mean_exp(values)) - other[1]  # what the choice of a shape of this form costs
        if {shape.name for shape in other[0].shapes} - {shape.name for shape in shapes}:  # one never sought
            other = climbed(problem, design, noise, other[0], first_steps(other[0]))
        if other[1] + search > likeliest:
            (effect, best, deviation), likeliest, paid = other, other[1] + search, search
    gained = best - proposal.best + paid
    return dataclasses.replace(
        proposal, effect=effect, best=best, deviation=deviation, evidence=proposal.evidence + gained
    )


Shaped = tuple[AbstractEffect, float, Float[np.ndarray, " n"]]
"""An effect, its evidence, and the prior deviations of its coefficients."""


def climbed(
    problem: Problem, design: Design, noise: Noise, effect: AbstractEffect, steps: Sequence[float]
) -> Shaped:
    """The shape near this one with the most evidence.

    Where a search beside another model has ended is where this one begins, if that is likelier: shapes hardly
    move with what else is in the model.
    """
    best, deviation = evidence_of(problem, design, noise, effect)
    if not steps:
        return effect, best, deviation
    scale, rounds = np.array(steps), _ROUNDS if len(steps) == 1 else _ROUNDS + 1
    place = form_of(effect), effect.joints, effect.recordings
    if (before := problem.likeliest_shapes.get(place)) is not None:
        known, deviation_there = evidence_of(problem, design, noise, before)
        if known > best:
            effect, best, deviation = before, known, deviation_there
            scale, rounds = scale * _SHORTER, rounds - 1
    for _ in range(rounds):
        moves = [m * e for e in np.diag(scale) for m in (-1.0, 1.0)]
        sides = [within(problem, moved(effect, move)) for move in moves]
        values, deviations = score(problem, design, noise, sides)
        tops = [within(problem, moved(effect, move)) for move in _vertices(best, values, scale)]
        aside = int(values.argmax())
        tried = best_shape(problem, design, noise, tops)
        near = tried[1] > values[aside]
        if not near:
            tried = sides[aside], float(values[aside]), deviations[aside]
        gained = tried[1] - best
        if gained > 0:
            effect, best, deviation = tried
            if gained < _ENOUGH:
                break
        if near or gained <= 0:
            scale = scale * _SHORTER
    problem.likeliest_shapes[place] = effect
    return effect, best, deviation


def _vertices(
    best: float, sides: Float[np.ndarray, " twice"], scale: Float[np.ndarray, " n"]
) -> list[Float[np.ndarray, " n"]]:
    """Steps to where parabolas through a shape and its sides along each number are highest: all, half, each."""
    down, up = sides.reshape(-1, 2).T
    bend = 2 * best - down - up
    with np.errstate(divide="ignore", invalid="ignore"):
        step = np.where(bend > 0, 0.5 * (up - down) / bend, 2.0 * np.sign(up - down))
    step = np.clip(step, -2.0, 2.0) * scale
    return [step, 0.5 * step, *np.diag(step)]


def best_shape(problem: Problem, design: Design, noise: Noise, effects: Sequence[AbstractEffect]) -> Shaped:
    """Of single shapes of one form at one place."""
    values, deviations = score(problem, design, noise, effects)
    top = int(values.argmax())
    return effects[top], float(values[top]), deviations[top]


def evidence_of(problem: Problem, design: Design, noise: Noise, effect: AbstractEffect):
    return best_shape(problem, design, noise, [effect])[1:]


def within(problem: Problem, effect: AbstractEffect) -> AbstractEffect:
    """An effect as its recording can tell it."""
    if not effect.is_event:
        return effect
    time = clock(problem, effect.recordings[0])
    return effect.within(float(time[0]), float(time[-1]), BIN)


def moved(effect: AbstractEffect, move: Float[np.ndarray, " shapes"]) -> AbstractEffect:
    """The effect with its shape parameters moved, within their bounds."""
    changes = {}
    for shape, step in zip(effect.shapes, move, strict=False):
        value = float(getattr(effect, shape.name))
        value = value * np.exp(step) if shape.logarithmic else value + step
        changes[shape.name] = float(np.clip(value, shape.lower, shape.upper))
    return dataclasses.replace(effect, **changes)
