"""Which effects, where, in which shape: greedy selection by evidence, everything refitted at every step."""

import dataclasses
from collections import Counter, defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.special
from jaxtyping import Float

from ..effects import AbstractEffect, AbstractJointEffect
from .events import Proposal, ripple, windows
from .evidence import PHYSICAL_SCALES, SCALES, Design, Noise, gram, log_bayes
from .library import Candidates, columns_of
from .problem import Problem, Term

ACCEPT = 25.0
"""Evidence that an effect needs, its search over shapes paid for [nats]."""
SWAP = 3.0
"""Evidence that another effect must win by to take an accepted one's place [nats]."""
SHADOW, EVENT_SHADOW = 0.012, 0.06
"""Share of the strongest term's evidence below which others are taken for its shadows: for what its shape, never
quite right, leaves over. Events in time, which fit any such leftover somewhere, need a larger share."""
HELD_OUT = 6.0
"""By which a term must lower the squared held-out error, in units of the noise's variance."""
UNKNOWN_MARGIN, UNKNOWN_SHARE = 10.0, 0.06
"""What a free form must win by [nats, share]."""
USUAL = {
    "asymmetric_friction": -3.0,
    "stribeck_friction": -3.0,
    "load_dependent_friction": -3.0,
    "friction_drift": -3.0,
    "joint_spring": -3.0,
    "torque_drift": -3.0,
    "backlash": -6.0,
    "joint_elasticity": -15.0,
    "time_delay": -20.0,
}
"""Prior over that of the others [nats]. Laws that hold a simpler one as a special case must earn what they add;
what moves a link by its load or in time is made of the same noise of q, differentiated twice, as the residual."""
MOST_SWAPPED = 6
MOST_TERMS = 12
_REFINED = 7
_ROUNDS = 4


@dataclasses.dataclass(frozen=True)
class State:
    """Accepted terms, the noise beside them, and what every rival would bring now."""

    terms: tuple[Term, ...]
    noise: Noise
    design: Design


def start(problem: Problem) -> State:
    """Nothing accepted yet."""
    return with_terms(problem, ())


def with_terms(problem: Problem, terms: Sequence[Term]) -> State:
    """The model with these terms, its noise estimated anew."""
    noise = problem.noise(terms)
    return State(tuple(terms), noise, problem.design(terms, noise))


def search(problem: Problem, log: list[str] | None = None) -> State:
    """Add the likeliest effect while one has evidence; then see if another does better in its place."""
    say = log.append if log is not None else (lambda _: None)
    state, strongest = start(problem), 0.0
    while len(state.terms) < MOST_TERMS:
        proposals = ranked(problem, state.design, state.noise)
        say(f"{len(state.terms)} terms: " + describe(proposals[:6]))
        held = {t.key for t in state.terms}
        new = [p for p in proposals if p.key not in held or p.effect.repeats]
        worthy = [p for p in new if p.evidence >= floor(p.effect, strongest)]
        if not worthy:
            break
        state = with_terms(problem, (*state.terms, problem.term(worthy[0].effect, worthy[0].deviation)))
        strongest = max(strongest, worthy[0].evidence, gain(problem, state, -1))
    state = prune(problem, swap(problem, prune(problem, state, say), say), say)
    return gate(problem, contest(problem, state, say), say)


def gate(problem: Problem, state: State, say: Any) -> State:
    """Drop what does not help where it was not fitted; what happened once cannot be tested so, and stays."""
    while True:
        reference = problem.held_out_error(state.design)
        for i in sorted(range(len(state.terms)), key=lambda i: gain(problem, state, i)):
            if state.terms[i].effect.bound_to_recording:
                continue
            others = (*state.terms[:i], *state.terms[i + 1 :])
            helped = problem.held_out_error(problem.design(others, state.noise)) - reference
            if helped < HELD_OUT:
                say(f"gate {state.terms[i].key}: held-out error falls by {helped:.1f} only")
                state = with_terms(problem, others)
                break
        else:
            return state


def floor(effect: AbstractEffect, strongest: float) -> float:
    """Evidence that an effect needs beside a stronger one [nats]."""
    return max(ACCEPT, (EVENT_SHADOW if effect.bound_to_recording else SHADOW) * strongest)


def contest(problem: Problem, state: State, say: Any) -> State:
    """At joints that took two named terms and more, see if one free form does better than all of them."""
    for joint in range(problem.dof):
        here = [t for t in state.terms if t.effect.joints == (joint,) and t.effect.name != "unknown"]
        if len(here) < 2:
            continue
        others = [t for t in state.terms if all(t is not h for h in here)]
        design = problem.design(others, state.noise)
        gained = state.design.log_evidence - design.log_evidence
        at_joint = [c for c in problem.catchalls if c.joint == joint]
        best = max((*grids(problem, design, state.noise, at_joint),), key=lambda p: p.best)
        say(f"joint {joint + 1}: {len(here)} terms {gained:.1f}, {best.best:.1f}: {best.effect.equation}")
        if best.best > gained:
            state = with_terms(problem, (*others, problem.term(best.effect, best.deviation)))
    return state


def swap(problem: Problem, state: State, say: Any) -> State:
    """Take out each term in turn, and put in what then has most evidence."""
    for i in range(len(state.terms) if 1 < len(state.terms) <= MOST_SWAPPED else 0):
        others = (*state.terms[:i], *state.terms[i + 1 :])
        design = problem.design(others, state.noise)
        proposals = ranked(problem, design, state.noise)
        held = next((p.evidence for p in proposals if p.key == state.terms[i].key), -np.inf)
        best = proposals[0]
        if best.key == state.terms[i].key or best.evidence > held + SWAP:
            if best.key != state.terms[i].key:
                say(f"swap {state.terms[i].key} for " + describe([best]))
            terms = list(state.terms)
            terms[i] = problem.term(best.effect, best.deviation)
            state = with_terms(problem, terms)
    return state


def prune(problem: Problem, state: State, say: Any) -> State:
    """Drop terms that the others have made needless, the weakest first."""
    while state.terms:
        gains = [gain(problem, state, i) for i in range(len(state.terms))]
        lacking = [g - floor(t.effect, max(gains)) for g, t in zip(gains, state.terms, strict=True)]
        weakest = int(np.argmin(lacking))
        if lacking[weakest] >= 0:
            break
        say(f"prune {state.terms[weakest].key}: {gains[weakest]:.1f}")
        state = with_terms(problem, (*state.terms[:weakest], *state.terms[weakest + 1 :]))
    return state


def gain(problem: Problem, state: State, i: int) -> float:
    """Evidence of a term beside the others [nats]."""
    others = [t for t in state.terms if t is not state.terms[i]]
    return state.design.log_evidence - problem.design(others, state.noise).log_evidence


def describe(proposals: Sequence[Proposal]) -> str:
    """For the log."""
    return "; ".join(f"{p.key[0]}{[j + 1 for j in p.key[1]]} {p.evidence:.1f}" for p in proposals)


def ranked(problem: Problem, design: Design, noise: Noise) -> list[Proposal]:
    """What each effect at each place would bring, the best of them refined; most evidence first.

    A free form must beat the best named effect by a margin, since no named law is quite the real one.
    """
    proposals = [
        *(handicapped(p) for p in grids(problem, design, noise, problem.catchalls)),
        *grids(problem, design, noise, problem.library),
        *ripple(problem, design, noise),
        *windows(problem, design, noise),
    ]
    places = Counter(name for name, _ in {p.key for p in proposals})
    best: dict[tuple, Proposal] = {}
    for p in proposals:
        p = dataclasses.replace(p, evidence=p.evidence - np.log(places[p.key[0]]) + USUAL.get(p.key[0], 0.0))
        if p.key not in best or p.evidence > best[p.key].evidence:
            best[p.key] = p
    order = sorted(best.values(), key=lambda p: -p.evidence)
    close = sum(p.evidence > max(0.4 * order[0].evidence, 4.0) for p in order[:_REFINED])
    refined = [refine(problem, design, noise, p) for p in order[:close]]
    return sorted([*refined, *order[close:]], key=lambda p: -p.evidence)


def handicapped(proposal: Proposal) -> Proposal:
    """A free form with its margin taken off."""
    margin = max(UNKNOWN_MARGIN, UNKNOWN_SHARE * proposal.evidence)
    return dataclasses.replace(proposal, evidence=proposal.evidence - margin)


def grids(problem: Problem, design: Design, noise: Noise, groups: Sequence[Candidates]) -> list[Proposal]:
    """For each effect and place in a library, the likeliest shape and the evidence over all."""
    scores: dict[tuple, list] = defaultdict(list)
    for group in groups:
        value, scale, deviation = _score(problem, design, noise, group.effects, group.columns, (id(group),))
        scores[group.name, group.effects[0].joints].append((group, value, scale, deviation))
    out = []
    for parts in scores.values():
        everything = np.concatenate([score for _, score, _, _ in parts])
        group, score, scale, deviation = max(parts, key=lambda part: part[1].max())
        top = int(score.argmax())
        out.append(
            Proposal(
                group.effects[top],
                float(scipy.special.logsumexp(everything) - np.log(len(everything))),
                float(score[top]),
                deviation[top] * scale[top],
                tuple(
                    0.3 if s.logarithmic else 0.03 * (s.upper - s.lower) for s in group.effects[top].shapes
                ),
            )
        )
    return out


def _scales(coefficients) -> tuple[float, ...]:
    return SCALES if coefficients[0].scale is None else PHYSICAL_SCALES


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
    columns = []
    for r, trace in enumerate(problem.traces):
        here = problem.placed(effects, r)
        columns.append(columns_of(here, trace) if here else 0.0 * columns_of(effects, trace))
    value, scale, deviation = _score(problem, design, noise, effects, columns)
    return value, deviation * scale[:, None]


def _score(problem: Problem, design: Design, noise: Noise, effects, columns, key=None):
    """Evidence, likeliest scale, and prior deviations before the scale; `key` names columns that come again."""
    coefficients = effects[0].coefficients
    signs = np.array([float(k.sign) for k in coefficients])

    def prepared(j, make):
        if key is not None:
            return problem.prepared(key, make, noise, j)
        Phi = problem.whitened(make(), noise, j)
        return Phi, gram(Phi)

    if isinstance(effects[0], AbstractJointEffect):
        j = effects[0].joints[0]
        b, G = design.in_joint(j, *prepared(j, lambda: columns))
        deviation = _deviation(coefficients, np.concatenate(columns), float(noise.std[j]))
    else:
        parts = [prepared(j, lambda j=j: [c[:, j] for c in columns]) for j in range(problem.dof)]
        b, G = design.in_arm([p[0] for p in parts], [p[1] for p in parts])
        deviation = _deviation(coefficients, np.concatenate(columns) / noise.std[:, None, None], 1.0)
    value, scale = log_bayes(b, G, deviation, _scales(coefficients), signs)
    return value, scale, deviation


def refine(problem: Problem, design: Design, noise: Noise, proposal: Proposal) -> Proposal:
    """Move the shape to where the evidence is highest, and see if another form does better there.

    A pattern search whose every round is one batch.
    """
    shapes = proposal.effect.shapes
    if not shapes:
        return proposal
    effect, steps = proposal.effect, np.array(proposal.steps[: len(shapes)])
    best, deviation = _single(problem, design, noise, effect)
    for _ in range(_ROUNDS if len(shapes) == 1 else _ROUNDS + 3):
        moves = [m * e for e in np.diag(steps) for m in (-1.0, 1.0, -0.4, 0.4)]
        if len(shapes) > 1:
            moves += [np.array([a, b]) * steps[:2] for a in (-1, 1) for b in (-1, 1)]
        tried = [moved(effect, move) for move in moves]
        values, deviations = score(problem, design, noise, tried)
        top = int(values.argmax())
        if values[top] > best:
            gained = values[top] - best
            effect, best, deviation = tried[top], float(values[top]), deviations[top]
            if gained < 0.05:
                break
        else:
            steps = steps * 0.35
    for variant in effect.variants(problem.traces[0].motion.arm):
        value, its_deviation = _single(problem, design, noise, variant)
        if value > best:
            effect, best, deviation = variant, value, its_deviation
    gained = best - proposal.best
    return dataclasses.replace(
        proposal, effect=effect, best=best, deviation=deviation, evidence=proposal.evidence + gained
    )


def _single(problem: Problem, design: Design, noise: Noise, effect: AbstractEffect):
    values, deviations = score(problem, design, noise, [effect])
    return float(values[0]), deviations[0]


def moved(effect: AbstractEffect, move: Float[np.ndarray, " shapes"]) -> AbstractEffect:
    """The effect with its shape parameters moved, within their bounds."""
    changes = {}
    for shape, step in zip(effect.shapes, move, strict=False):
        value = float(getattr(effect, shape.name))
        value = value * np.exp(step) if shape.logarithmic else value + step
        changes[shape.name] = float(np.clip(value, shape.lower, shape.upper))
    return dataclasses.replace(effect, **changes)
