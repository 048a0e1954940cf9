"""What each effect would bring at each place, beside what is in the model."""

import dataclasses
from collections import Counter, defaultdict
from collections.abc import Collection, Sequence

import numpy as np

from ..effects import AbstractEffect, AbstractJointEffect
from ..effects.drive import TorqueRipple
from ..effects.friction import ViscousFriction
from ..effects.load import PayloadChange
from ..effects.unknown import UnknownOfTwo
from .credible import has_play, is_dissipative, is_event, is_of_time
from .events import Proposal, ripple, slowest, spots, windows
from .evidence import Design, Noise, log_mean_exp
from .host import parallel
from .library import Candidates
from .problem import Problem
from .rivals import HOLDS
from .shapes import best_shape, climbed, first_steps, refine

UNKNOWN_MARGIN, UNKNOWN_SHARE = 10.0, 0.06
"""What a free form must win by [nats, share]."""
TWO_JOINTS = 1.1
"""How many times the evidence of any form of one channel a form of two joints' positions must have."""
USUAL = {
    "asymmetric_friction": -3.0,
    "stribeck_friction": -3.0,
    "load_dependent_friction": -3.0,
    "friction_drift": -3.0,
    "power_law_friction": -3.0,
    "joint_spring": -3.0,
    "torque_drift": -3.0,
    "external_contact": -12.0,
    "backlash": -6.0,
    "joint_elasticity": -15.0,
    "time_delay": -20.0,
}
"""Prior over that of the others [nats]. Laws that hold a simpler one as a special case must earn what they add;
what moves a link by its load or in time is made of the same noise of q, differentiated twice, as the residual."""
_RICHER = tuple(name for name, held in HOLDS.items() if ViscousFriction.name in held)
RICHER_SHARE = 0.001
"""Share of the evidence that laws which hold a simpler one as a special case must win by: the real one is
neither."""
_REFINED = 7
_ORDERS = 8
CLOSE = 0.5


def slow_ripple(problem: Problem, design: Design, noise: Noise, joint: int) -> list[Proposal]:
    """The likeliest ripple of which the joint shows too few periods for `ripple`, told by its second harmonic."""
    travel = max(float(np.ptp(t.motion.q[:, joint])) for t in problem.traces)
    first, last = slowest(2 * travel), slowest(travel)
    if first >= last:
        return []
    effects = [TorqueRipple(joint, float(n), "two") for n in np.geomspace(first, last, _ORDERS)]
    effect, _, _ = best_shape(problem, design, noise, effects)
    steps = first_steps(effect)
    effect, best, deviation = climbed(problem, design, noise, effect, steps)
    return [Proposal(effect, best, best, deviation, steps)]


def ranked(
    problem: Problem,
    design: Design,
    noise: Noise,
    joints: Collection[int] | None = None,
    before: Sequence[Proposal] = (),
) -> list[Proposal]:
    """What each effect at each place would bring, the best of them refined; most evidence first.

    A free form must beat the best named effect by a margin, since no named law is quite the real one.

    Args:
        problem: whose library is tried.
        design: what is in the model.
        noise: to weigh by.
        joints: where effects of single joints are scanned; None for all.
        before: an earlier scan's, to be taken for other joints; those in front are weighed again.
    """
    where = range(problem.dof) if joints is None else sorted(joints)
    here = [g for g in problem.library if g.joint is None or g.joint in where]
    free = [g for g in problem.catchalls if g.joint in where]
    scanned = [
        *(handicapped(p) for p in free_forms(problem, design, noise, free)),
        *grids(problem, design, noise, here),
        *ripple(problem, design, noise, where),
        *(windows(problem, design, noise) if len(where) > 1 or joints is None or before else ()),
    ]
    many = _places(problem)
    best: dict[tuple, Proposal] = {p.key: p for p in before if is_elsewhere(p.effect, where)}
    for p in scanned:
        name = p.key[0]
        usual = USUAL.get(name, 0.0)
        if isinstance(p.effect, PayloadChange) and p.effect.form == "carried":
            usual = USUAL["external_contact"]  # any push may look like a body held for a while
        if name in _RICHER:
            usual = min(usual, -RICHER_SHARE * p.evidence)
        p = dataclasses.replace(p, evidence=p.evidence - np.log(many[name]) + usual)
        if p.key not in best or p.evidence > best[p.key].evidence:
            best[p.key] = p
    order = sorted(best.values(), key=lambda p: -p.evidence)
    close = sum(p.evidence > max(CLOSE * order[0].evidence, 4.0) for p in order[:_REFINED])
    refined = parallel(lambda p: refine(problem, design, noise, p), order[:close])
    refined = [p for p in refined if is_dissipative(problem, design, noise, p)]
    found = [p for p in (*refined, *order[close:]) if has_play(problem, design, noise, p)]
    found = [p for p in found if is_of_time(problem, design, noise, p)]
    return sorted((p for p in found if is_event(problem, p.effect)), key=lambda p: -p.evidence)


def is_elsewhere(effect: AbstractEffect, joints: Collection[int]) -> bool:
    """Whether an effect acts in a single joint that is none of these."""
    return isinstance(effect, AbstractJointEffect) and effect.joints[0] not in joints


def _places(problem: Problem) -> Counter[str]:
    """At how many places each effect is tried."""
    keys = {(g.name, g.effects[0].joints) for g in (*problem.library, *problem.catchalls)}
    events = {(name, (j,)) for name in ("torque_ripple", "external_contact") for j in range(problem.dof)}
    return Counter(name for name, _ in {*keys, *events, ("payload_change", ())})


def handicapped(proposal: Proposal) -> Proposal:
    """A free form with its margin taken off."""
    margin = max(UNKNOWN_MARGIN, UNKNOWN_SHARE * proposal.evidence)
    return dataclasses.replace(proposal, evidence=proposal.evidence - margin)


def grids(problem: Problem, design: Design, noise: Noise, groups: Sequence[Candidates]) -> list[Proposal]:
    """For each effect and place in a library, the likeliest shape and the evidence over all."""
    scores: dict[tuple, list] = defaultdict(list)
    scanned = problem.scan(design, noise)
    for group in groups:
        scores[group.name, group.effects[0].joints].append((group, *scanned[id(group)]))
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


def free_forms(
    problem: Problem, design: Design, noise: Noise, groups: Sequence[Candidates]
) -> list[Proposal]:
    """For each joint the likeliest free form: of two joints' positions only where it says much more than any of
    one channel, since it fits a little of everything."""
    of_one, of_two = (
        [g for g in groups if isinstance(g.effects[0], UnknownOfTwo) is two] for two in (False, True)
    )
    found = {p.key: p for p in grids(problem, design, noise, of_one)}
    for p in spots(problem, design, noise, sorted({g.joint for g in groups if g.joint is not None})):
        if p.key not in found or p.evidence > found[p.key].evidence:
            found[p.key] = p
    for p in grids(problem, design, noise, of_two):
        if p.key not in found or p.best > TWO_JOINTS * max(found[p.key].best, 0.0):
            found[p.key] = p
    return list(found.values())
