"""What each effect would bring at each place, beside what is in the model."""

import dataclasses
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Sequence

import numpy as np

from ..effects import AbstractEffect
from ..host import parallel
from ..inference.alike import one_more
from ..inference.evidence import Design, Noise, log_mean_exp
from ..inference.library import Candidates
from ..inference.problem import Problem
from .credible import is_credible
from .events import Proposal, swept, swinging, windows
from .shapes import evidence_of, first_steps, refine

_REFINED = 4
_CLOSE, _HOPELESS = 0.5, 5.0
"""Proposals of a joint that are refined at most; from which share of its best one's evidence they are,
and how much less it may be [nats]."""
_AHEAD = 2.0
"""How many times the evidence of earlier events another effect's must be for their scan to wait."""


def ranked(
    problem: Problem,
    design: Design,
    noise: Noise,
    joints: Collection[int] | None = None,
    before: Sequence[Proposal] = (),
) -> list[Proposal]:
    """What each effect at each place would bring, what was thought of it beforehand included, the best of them
    refined; the likeliest first.

    Args:
        problem: whose library is tried.
        design: what is in the model.
        noise: to weigh by.
        joints: where effects of single joints are scanned; None for all.
        before: an earlier scan's, to be taken for other joints as they are.
    """
    where = range(problem.dof) if joints is None else sorted(joints)
    here = [g for g in (*problem.library, *problem.catchalls) if g.joint is None or g.joint in where]
    scanned = [*grids(problem, design, noise, here), *swept(problem, design, noise, where)]
    beside = one_more([t.effect for t in design.terms], problem.telling)
    kept = [at_others(p, beside) for p in before if is_elsewhere(p.effect, where)]
    events = [p for p in before if p.effect.bound_to_recording]
    likeliest = max((p.evidence for p in scanned), default=0.0)
    if events and likeliest > _AHEAD * max(0.0, *(p.evidence for p in events)):
        kept += events
    elif len(where) > 1 or joints is None or before:
        found = (*windows(problem, design, noise), *swinging(problem, design, noise))
        scanned += [_weighed(problem, design, noise, p) for p in found]
    many = problem.places
    held = Counter(t.effect.name for t in design.terms)
    best: dict[tuple, Proposal] = {}
    for p in scanned:
        times = 1 + (
            held[p.key[0]] if p.effect.repeats else 0
        )  # the third push is less likely than the first
        p = at_others(with_prior(p, many[p.key[0]], times), beside)
        if p.key not in best or p.evidence > best[p.key].evidence:
            best[p.key] = p
    first, rest = [], kept
    for alike in by_place(sorted(best.values(), key=lambda p: -p.evidence)).values():
        close = sum(p.evidence > _CLOSE * alike[0].evidence - _HOPELESS for p in alike[:_REFINED])
        first += alike[:close]
        rest += alike[close:]
    refined = parallel(lambda p: refine(problem, design, noise, p), first)
    found = [p for p in (*refined, *rest) if is_credible(problem, design, noise, p)]
    return sorted(found, key=lambda p: -p.evidence)


def _weighed(problem: Problem, design: Design, noise: Noise, proposal: Proposal) -> Proposal:
    """A proposal with its own evidence: scans leave out slow errors, or what the model could take."""
    best, deviation = evidence_of(problem, design, noise, proposal.effect)
    gained = best - proposal.best
    return dataclasses.replace(proposal, best=best, deviation=deviation, evidence=proposal.evidence + gained)


def by_place(proposals: Sequence[Proposal]) -> dict[int | None, list[Proposal]]:
    """Those of each joint, in their order; under None those that act in several."""
    out: dict[int | None, list[Proposal]] = {}
    for p in proposals:
        joint = p.effect.joints[0] if p.effect.one_joint else None
        out.setdefault(joint, []).append(p)
    return out


def plainer(problem: Problem, design: Design, noise: Noise, proposal: Proposal) -> list[Proposal]:
    """A proposal in its plainer forms, which have no shape to be searched for."""
    out, places = [], problem.places
    for effect in proposal.effect.plainer:
        best, deviation = evidence_of(problem, design, noise, effect)
        out.append(with_prior(Proposal(effect, best, best, deviation, ()), places[effect.name]))
    return out


def with_prior(proposal: Proposal, places: int, times: int = 1) -> Proposal:
    """A proposal with what was thought of it beforehand, at one of so many places and for so many times."""
    prior = times * proposal.effect.prior - float(np.log(places))
    return dataclasses.replace(proposal, evidence=proposal.evidence + prior)


def at_others(proposal: Proposal, beside: Callable[[AbstractEffect], float]) -> Proposal:
    """A proposal with what the effects `beside` it say of it beforehand."""
    gained = beside(proposal.effect)
    evidence = proposal.evidence - proposal.shared + gained
    return dataclasses.replace(proposal, evidence=evidence, shared=gained)


def is_elsewhere(effect: AbstractEffect, joints: Collection[int]) -> bool:
    """Whether an effect acts in a single joint that is none of these."""
    return effect.one_joint and effect.joints[0] not in joints


def grids(problem: Problem, design: Design, noise: Noise, groups: Sequence[Candidates]) -> list[Proposal]:
    """For each effect and place in a library, the likeliest shape and the evidence over all."""
    scores: dict[tuple, list] = defaultdict(list)
    scanned = problem.scan(design, noise, groups)
    for group in groups:
        score, deviation = scanned[id(group)]
        scores[group.name, group.effects[0].joints].append((group, score + group.form_priors, deviation))
    out = []
    for parts in scores.values():
        everything = np.concatenate([score for _, score, _ in parts])
        group, score, deviation = max(parts, key=lambda part: part[1].max())
        top = int(score.argmax())
        out.append(
            Proposal(
                group.effects[top],
                float(log_mean_exp(everything)),
                float(score[top]),
                deviation[top],
                first_steps(group.effects[top]),
            )
        )
    return out
