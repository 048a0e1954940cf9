"""Which effects, where, in which shape: greedy selection by evidence, everything refitted at every step."""

import dataclasses
import itertools
from collections import Counter, defaultdict
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ..effects import AbstractEffect, AbstractJointEffect
from ..effects.contact import ExternalContact
from ..effects.drive import Backlash, JointElasticity, TorqueRipple
from ..effects.effect import AbstractDryFriction
from ..effects.friction import AsymmetricFriction, FrictionDrift
from ..effects.load import EVER, InertialParameters, Payload, PayloadChange
from ..effects.sensing import TorqueDrift
from ..effects.unknown import Unknown, UnknownOfTwo
from .events import BIN, Proposal, ripple, slowest, spots, windows
from .evidence import Design, Noise, gram, log_bayes, log_mean_exp
from .host import parallel
from .library import Candidates, form_of
from .problem import Problem, Term
from .rivals import ACCEPT, called, odds
from .scan import scales_of

SWAP = 3.0
"""Evidence that another effect must win by to take an accepted one's place [nats]."""
SHADOW, EVENT_SHADOW = 0.03, 0.5
"""Share of a stronger term's evidence, in the joints and at the times where a weaker one acts, below which
the weaker is taken for its shadow: for what the stronger's shape, never quite right, leaves over. Events in
time, which fit any such leftover somewhere, need a larger share."""
BRIEF = 0.3
"""Duration below which a contact may be what a law leaves of a reversal or an impact [s]."""
SECOND_JOINT = 0.03
"""Share of its torque, squared over noise, that a contact must show beside the joint that feels it most: a
force on a link turns several joints, while what is left of a joint's own effect stays in that joint."""
LASTING = 0.8
"""Share of its recording that a contact takes at most."""
HELD_OUT = 6.0
"""By which a term must lower the squared held-out error, in units of the noise's variance."""
WORTH = 1.03
"""By which the squared error of predicted torque must be smaller than with the user's model."""
OPPOSED = 20.0
"""How many times the torque of a law its parts may be."""
UNKNOWN_MARGIN, UNKNOWN_SHARE = 10.0, 0.06
"""What a free form must win by [nats, share]."""
TWO_JOINTS = 1.1
"""How many times the evidence of any form of one channel a form of two joints' positions must have."""
USUAL = {
    "asymmetric_friction": -3.0,
    "stribeck_friction": -3.0,
    "load_dependent_friction": -3.0,
    "friction_drift": -3.0,
    "joint_spring": -3.0,
    "torque_drift": -3.0,
    "external_contact": -12.0,
    "backlash": -6.0,
    "joint_elasticity": -15.0,
    "time_delay": -20.0,
}
"""Prior over that of the others [nats]. Laws that hold a simpler one as a special case must earn what they add;
what moves a link by its load or in time is made of the same noise of q, differentiated twice, as the residual."""
_RICHER = ("asymmetric_friction", "stribeck_friction", "load_dependent_friction", "friction_drift")
RICHER_SHARE = 0.001
"""Share of the evidence that laws which hold Coulomb's as a special case must win by: the real one is neither."""
MOST_SWAPPED = 6
MOST_TERMS, MOST_NAMES, MOST_ADDED = 10, 5, 8
_REFINED = 7
_ROUNDS = 4
_TRIED = 8
_SETTLED = 4
_OVERLAP, _FELT = 0.05, 0.02
_CLOSE = 0.5
LIKELIER, ELECTIONS = 3.0, 3
"""How many times as likely a rival takes a term's place, and how often one does in a row."""
CROWDED, BEGUN = 6, 50.0
"""Terms from which another beginning is tried, and what it must win by where it was not fitted [nats]."""
_SIMPLE = ("viscous_friction", "coulomb_friction", "presliding_hysteresis", "torque_offset")
_BEGINNINGS = 2
"""Simpler effects from which a joint is built up again."""
_GIVEN = 0.2
_PAID = 8.0  # [nats]: for the search of when a body changes hands
CLEAR = 4.0
"""Standard deviations by which a gap must differ from none."""
AFRESH = 0.1
"""What of a drift differs at least between two repeats of a motion, as a share of what comes again."""


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
    """Add the likeliest effect while one has evidence; then see if another does better in its place.

    Where many are needed, the arm may be one whose every joint rubs, sticks and has an offset, as real ones do: a
    search that begins with that is made as well, and taken if the recordings are likelier by it.
    """
    say = log.append if log is not None else (lambda _: None)
    state = divided(problem, finish(problem, grow(problem, start(problem), say), say), say)
    for _ in range(ELECTIONS if len(state.terms) <= MOST_SWAPPED else 0):
        other = elected(problem, state, say)
        if other is state:
            break
        other = finish(problem, grow(problem, other, say), say)
        gained, more = gained_over(problem, other, state), len(other.terms) - len(state.terms)
        say(f"which brings {gained:.0f}, with {more} terms more")
        if more > 0 and gained < ACCEPT * more:
            break
        state = other
    if len(state.terms) < CROWDED:
        return state
    say("another beginning: friction and offset at all joints")
    other = with_terms(problem, everywhere(problem, state.noise))
    other = finish(problem, grow(problem, other, say, lasting=True), say)
    helped = helped_over(problem, other, state)
    gained = gained_over(problem, other, state)
    say(f"which brings {gained:.0f} over the other, and {helped:.0f} where not fitted")
    return other if helped > BEGUN else state


def divided(problem: Problem, state: State, say: Any) -> State:
    """With effects of single joints in the place of a wrong link, where the recordings are likelier by them.

    A link weighs on every joint before it: it has most evidence where two of them have something of their own.
    """
    if not any(isinstance(t.effect, InertialParameters) for t in state.terms):
        return state
    say("another beginning: no link is wrong")
    other = finish(problem, grow(problem, start(problem), say, links=False), say)
    gained, more = gained_over(problem, other, state), len(other.terms) - len(state.terms)
    helped = helped_over(problem, other, state)
    say(
        f"which brings {gained:.0f} over the other, with {more} terms more, and {helped:.0f} where not fitted"
    )
    return other if gained > SWAP + ACCEPT * max(more, 0) and helped > HELD_OUT else state


def gained_over(problem: Problem, state: State, other: State) -> float:
    """Evidence of a state over that of another, both in the first one's noise [nats]."""
    return state.design.log_evidence - problem.design(other.terms, state.noise).log_evidence


def helped_over(problem: Problem, state: State, other: State) -> float:
    """By how much half the squared error of a state, where it was not fitted, is below that of another [nats].

    Both in the other's noise, and where neither has what happened once, which cannot be tested so.
    """
    here = State(state.terms, other.noise, problem.design(state.terms, other.noise))
    counts = np.ones(len(other.design.residual[0]), bool)
    for one in (here, other):
        once = [t.effect.bound_to_recording for t in one.terms]
        if any(once):
            counts &= energies(one)[once].sum((0, 1)) <= 0
    before, after = (problem.held_out_error(one.design, counts) for one in (other, here))
    return 0.5 * (before - after)


def elected(problem: Problem, state: State, say: Any) -> State:
    """With the likeliest effects in the places of those that have a rival much likelier than they are.

    What others brought while a term was chosen may be gone since, and a law that holds a simpler one has a little
    more evidence where the simpler one is right.
    """
    terms = list(state.terms)
    for i, term in enumerate(terms):
        if term.effect.name == "unknown":
            continue
        likely = odds(instead(problem, state, i))
        own = likely.get(called(term.effect), (0.0, None))[0]
        probability, best = max(likely.values(), key=lambda pair: pair[0])
        if best is not None and probability > LIKELIER * own:
            say(f"{describe([best])} is likelier than {term.key}: {probability:.2g} to {own:.2g}")
            terms[i] = problem.term(best.effect, best.deviation)
            return with_terms(problem, terms)
    return state


def finish(problem: Problem, state: State, say: Any) -> State:
    """Drop, exchange and test terms until the rest stands."""
    state = swap(problem, handed_over(problem, prune(problem, state, say), say), say)
    state = handed_over(problem, prune(problem, state, say), say)
    return gate(problem, contest(problem, state, say), say)


def everywhere(problem: Problem, noise: Noise) -> list[Term]:
    """For each joint what simple effects explain of it together."""
    base = State((), noise, problem.design((), noise))
    evidence = lambda chain: problem.design(chain, noise).log_evidence
    found = [max(_chains(problem, base, joint), key=evidence, default=()) for joint in range(problem.dof)]
    return [term for chain in found for term in chain]


def grow(problem: Problem, state: State, say: Any, *, lasting: bool = False, links: bool = True) -> State:
    """Add the likeliest effect while one has evidence; only what does not happen once, if `lasting`, and no wrong
    link unless `links`."""
    proposals, joints = [], None
    most = max(MOST_TERMS, len(state.terms) + MOST_ADDED * (1 + lasting))
    most_names = MOST_NAMES + len({t.effect.name for t in state.terms})
    while len(state.terms) < most:
        proposals = ranked(problem, state.design, state.noise, joints, proposals)
        say(f"{len(state.terms)} terms: " + describe(proposals[:6]))
        held, names = {t.key for t in state.terms}, {t.effect.name for t in state.terms}
        new = [p for p in proposals if p.key not in held or p.effect.repeats]
        new = [p for p in new if p.key[0] in names or len(names) < most_names]
        new = [p for p in new if links or not isinstance(p.effect, InertialParameters)]
        if lasting:
            new = [p for p in new if not p.effect.bound_to_recording]
            worthy = most_helpful(problem, state, new, say)
        else:
            worthy = next((p for p in new[:_TRIED] if is_worthy(problem, state, p, say)), None)
        if worthy is None:
            break
        state = with_terms(problem, (*state.terms, problem.term(worthy.effect, worthy.deviation)))
        state = handed_over(problem, settle(problem, state), say)
        joints = set(np.flatnonzero(shares(state)[-1] > _FELT).tolist())
    return state


def _chains(problem: Problem, base: State, joint: int) -> list[tuple[Term, ...]]:
    """Sets of simple effects of a joint, each grown greedily from another beginning."""
    groups = [g for g in problem.library if g.joint == joint and g.name in _SIMPLE]

    def likeliest(state: State, count: int) -> list[Proposal]:
        held = {t.effect.name for t in state.terms if t.effect.joints == (joint,)}
        tried = grids(problem, state.design, state.noise, [g for g in groups if g.name not in held])
        tried = sorted(tried, key=lambda p: -p.evidence)[:count]
        tried = [refine(problem, state.design, state.noise, p) for p in tried if p.evidence > ACCEPT]
        return [p for p in tried if is_dissipative(problem, state.design, state.noise, p)]

    chains = []
    for proposal in likeliest(base, _BEGINNINGS):
        state, strongest = base, proposal.evidence
        while proposal is not None and proposal.evidence > max(ACCEPT, SHADOW * strongest):
            terms = (*state.terms, problem.term(proposal.effect, proposal.deviation))
            state = State(terms, base.noise, problem.design(terms, base.noise))
            strongest = max(strongest, proposal.evidence)
            proposal = next(iter(likeliest(state, 2)), None)
        chains.append(state.terms[len(base.terms) :])
    return chains


def is_worthy(problem: Problem, state: State, proposal: Proposal, say: Any) -> bool:
    """Whether a proposal has evidence, and more than the shadow of what is in the model already."""
    if proposal.evidence < ACCEPT:
        return False
    terms = (*state.terms, problem.term(proposal.effect, proposal.deviation))
    grown = State(terms, state.noise, problem.design(terms, state.noise))
    # an earlier scan's evidence, at a joint that was not scanned again, may have gone since
    evidence = min(proposal.evidence, grown.design.log_evidence - state.design.log_evidence)
    least = floors(grown, [*gains(state), evidence])[-1]
    if evidence < least:
        say(f"{describe([proposal])} brings {evidence:.0f}, less than {least:.0f}: a shadow")
    return bool(evidence >= least)


def most_helpful(problem: Problem, state: State, proposals: Sequence[Proposal], say: Any) -> Proposal | None:
    """Of the worthy proposals with about as much evidence as any, the one that helps most where not fitted.

    Beside many laws a free curve may have most evidence and mislead. One cause of what several joints show comes
    before a cause for each. None if none helps.
    """
    reference = problem.held_out_error(state.design)

    def likeliest(some: Sequence[Proposal]) -> Proposal | None:
        helped = []
        for p in some:
            if is_worthy(problem, state, p, say):
                terms = (*state.terms, problem.term(p.effect, p.deviation))
                gained = reference - problem.held_out_error(problem.design(terms, state.noise))
                helped += [(gained, p)] if gained > HELD_OUT else []
        most = max((p.evidence for _, p in helped), default=0.0)
        close = [pair for pair in helped if pair[1].evidence >= _CLOSE * most]
        return max(close, key=lambda pair: pair[0])[1] if close else None

    wide = [p for p in proposals if len(p.effect.joints) > 1]
    return likeliest(wide) or likeliest([p for p in proposals[:_TRIED] if len(p.effect.joints) == 1])


def settle(problem: Problem, state: State) -> State:
    """The newest term refined again in its own noise, then the older ones beside it that act where it does."""
    share = shares(state)
    overlapping = [i for i in range(len(share)) if share[i] @ share[-1] > _OVERLAP]
    for i in overlapping[::-1][:_SETTLED]:
        term = state.terms[i]
        if not term.effect.shapes:
            continue
        design = without(state, i)
        best, deviation = _single(problem, design, state.noise, term.effect)
        steps = tuple(0.5 * x for x in first_steps(term.effect))
        proposal = Proposal(term.effect, best, best, deviation, steps)
        better = refine(problem, design, state.noise, proposal)
        if better.best > best + 1.0:
            terms = list(state.terms)
            terms[i] = problem.term(better.effect, better.deviation)
            state = State(tuple(terms), state.noise, problem.design(terms, state.noise))
    return state


def places(state: State) -> list[slice]:
    """Where each term's coefficients are among those of the design."""
    sizes = [len(t.deviation) for t in state.terms]
    ends = len(state.design.precision) - sum(sizes) + np.cumsum([0, *sizes])
    return [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]


def without(state: State, i: int) -> Design:
    """The model less one of its terms."""
    return state.design.without(i)


def gains(state: State) -> list[float]:
    """Evidence of each term beside the others [nats]."""
    return [state.design.log_evidence - without(state, i).log_evidence for i in range(len(state.terms))]


def leftover(state: State) -> tuple[Float[np.ndarray, " dof"], Float[np.ndarray, " dof"]]:
    """Mean square of each joint's whitened residual beyond the noise's, before the terms and after them."""
    design, terms = state.design, places(state)
    kept = np.arange(len(design.precision)) < (terms[0].start if terms else len(design.precision))
    bare = Design([A[:, kept] for A in design.columns], design.residual, design.precision[kept])
    out = []
    for d in (bare, design):
        left = [r - A @ d.x for A, r in zip(d.columns, d.residual, strict=True)]
        out.append(np.array([np.sum(e**2) / max(np.count_nonzero(e), 1) - 1 for e in left]))
    return out[0], out[1]


def energies(state: State) -> Float[np.ndarray, "terms dof rows"]:
    """Half the square of each term's torque over the noise: about the evidence that each sample could give."""
    x = state.design.x
    columns = state.design.columns
    return np.array([[0.5 * (A[:, at] @ x[at]) ** 2 for A in columns] for at in places(state)]).reshape(
        len(state.terms), len(columns), len(columns[0])
    )


def shares(state: State) -> Float[np.ndarray, "terms dof"]:
    """Share of each term's torque, squared over noise, that acts in each joint."""
    energy = energies(state).sum(2)
    return energy / np.maximum(energy.sum(1, keepdims=True), 1e-300)


def floors(state: State, gained: Sequence[float]) -> list[float]:
    r"""Evidence that each term needs beside the stronger ones [nats].

    $\max(\text{ACCEPT}, \epsilon \sum_k g_k \sum_j s_{ij} s_{kj})$ with the evidence $g_k$ of each
    stronger term, the share $s_{ij}$ of the term's torque (squared, over noise) that acts in joint j, and the
    share $s_{kj}$ of the stronger one's that acts in joint j while the term does. What is strong in one joint
    casts no shadow on another. A soft joint's swings and a gap's impacts come at moments that the fitted law has
    elsewhere: their shadow falls on all times. A contact as brief as the reversal of a joint could be all that a
    stronger law has wrong there. A free form of another joint's motion stands in that joint's shadow too.
    """
    energy = energies(state)
    total = np.maximum(energy.sum((1, 2)), 1e-300)
    out = []
    for i, term in enumerate(state.terms):
        where = energy[i].sum(1) / total[i]
        if isinstance(term.effect, Unknown | UnknownOfTwo):
            where[int(term.effect.source)] = 1.0
        once = term.effect.bound_to_recording
        rows = energy[i].any(0) if once else np.ones(energy.shape[2], bool)
        share = EVENT_SHADOW if once else SHADOW
        brief = isinstance(term.effect, ExternalContact) and term.effect.stop - term.effect.start < BRIEF
        beside = 0.0
        for k in range(len(total)):
            if gained[k] > gained[i]:
                other = state.terms[k].effect
                swings = isinstance(other, Backlash | JointElasticity)
                felt = energy[k].sum(1) if swings else energy[k][:, rows].sum(1)
                whole = brief and not other.bound_to_recording
                beside += (1.0 if whole else share) * gained[k] * float(where @ felt) / total[k]
        least = max(ACCEPT, beside)
        if isinstance(term.effect, ExternalContact):
            beyond = total[i] * (1 - where.max())
            if beyond < max(SECOND_JOINT * total[i], 0.5 * ACCEPT):
                least = np.inf
        out.append(least)
    return out


def gate(problem: Problem, state: State, say: Any) -> State:
    """Drop what does not help where it was not fitted; what happened once cannot be tested so, and stays."""
    while True:
        once = [t.effect.bound_to_recording for t in state.terms]
        energy = energies(state)[once].sum((0, 1)) if any(once) else np.zeros(len(state.design.residual[0]))
        counts = energy <= 0
        reference = problem.held_out_error(state.design, counts)
        for i in np.argsort(gains(state)):
            if once[i]:
                continue
            helped = problem.held_out_error(without(state, int(i)), counts) - reference
            if helped < HELD_OUT:
                say(f"gate {state.terms[i].key}: held-out error falls by {helped:.1f} only")
                state = with_terms(problem, (*state.terms[:i], *state.terms[i + 1 :]))
                break
        else:
            return state


def transferable(problem: Problem, state: State) -> State:
    """Without the terms that make torque worse where their coefficients were not fitted; without all that can be
    tested so, where together they gain next to nothing.

    What stands in for physics that has no name fits where it was fitted, and misleads elsewhere. So does a law of
    friction whose parts these speeds do not tell apart.
    """
    state = with_terms(problem, [t for i, t in enumerate(state.terms) if not is_undetermined(state, i)])
    while lasting := [i for i, t in enumerate(state.terms) if not t.effect.bound_to_recording]:
        whole, users = problem.predicted_error(state.design, state.noise)
        harm = {i: whole - problem.predicted_error(without(state, i), state.noise)[0] for i in lasting}
        worst = max(harm, key=lambda i: harm[i])
        if harm[worst] > 0:
            state = with_terms(problem, (*state.terms[:worst], *state.terms[worst + 1 :]))
        elif users < WORTH * whole:
            return with_terms(problem, [t for t in state.terms if t.effect.bound_to_recording])
        else:
            break
    return state


def is_undetermined(state: State, i: int) -> bool:
    """Whether a term is friction whose parts are many times their sum: at other speeds they are not."""
    term = state.terms[i]
    if not isinstance(term.effect, AbstractDryFriction):
        return False
    parts = np.concatenate(term.columns) * state.design.x[places(state)[i]]
    rms = lambda torque: float(np.sqrt(np.mean(torque**2)))
    return max(rms(part) for part in np.moveaxis(parts, -1, 0)) > OPPOSED * rms(parts.sum(-1))


def contest(problem: Problem, state: State, say: Any) -> State:
    """At joints that took two named terms and more, see if one free form does better than all of them; or, where
    one of them is a ripple, a ripple of lower order."""
    for joint in range(problem.dof):
        here = [t for t in state.terms if t.effect.joints == (joint,) and t.effect.name != "unknown"]
        if len(here) < 2:
            continue
        others = [t for t in state.terms if all(t is not h for h in here)]
        design = problem.design(others, state.noise)
        gained = state.design.log_evidence - design.log_evidence
        at_joint = [c for c in problem.catchalls if c.joint == joint]
        forms = free_forms(problem, design, state.noise, at_joint)
        if any(isinstance(t.effect, TorqueRipple) for t in here):
            forms += slow_ripple(problem, design, state.noise, joint)
        best = max(forms, key=lambda p: p.best)
        say(f"joint {joint + 1}: {len(here)} terms {gained:.1f}, {best.best:.1f}: {best.effect.equation}")
        if best.best > gained:
            state = with_terms(problem, (*others, problem.term(best.effect, best.deviation)))
    return state


def slow_ripple(problem: Problem, design: Design, noise: Noise, joint: int) -> list[Proposal]:
    """The likeliest ripple of which the joint shows too few periods for `ripple`, told by its second harmonic."""
    travel = max(float(np.ptp(t.motion.q[:, joint])) for t in problem.traces)
    first, last = slowest(2 * travel), slowest(travel)
    if first >= last:
        return []
    effects = [TorqueRipple(joint, float(n), "two") for n in np.geomspace(first, last, _TRIED)]
    effect, _, _ = _likeliest(problem, design, noise, effects)
    steps = first_steps(effect)
    effect, best, deviation = _climbed(problem, design, noise, effect, steps)
    return [Proposal(effect, best, best, deviation, steps)]


def swap(problem: Problem, state: State, say: Any) -> State:
    """Take out each term in turn, and put in what then has most evidence."""
    for i in range(len(state.terms) if len(state.terms) <= MOST_SWAPPED else 0):
        term = state.terms[i]
        proposals = instead(problem, state, i)
        held = next((p.evidence for p in proposals if p.key == term.key), -np.inf)
        best = proposals[0]
        if best.key == term.key:
            changed = best.evidence > 1.0 + held_evidence(problem, state, i)
        else:
            changed = best.evidence > held + SWAP
            if changed:
                say(f"swap {term.key} for " + describe([best]))
        if changed:
            terms = list(state.terms)
            terms[i] = problem.term(best.effect, best.deviation)
            state = with_terms(problem, terms)
    return state


def handed_over(problem: Problem, state: State, say: Any) -> State:
    """A body at the flange that something happens to was put down or taken up, where that explains both."""
    last = problem.dof - 1
    while True:
        bodies = [
            i
            for i, t in enumerate(state.terms)
            if isinstance(t.effect, Payload | InertialParameters) and t.effect.link == last
        ]
        events = [
            (k, t.effect)
            for k, t in enumerate(state.terms)
            if isinstance(t.effect, PayloadChange | ExternalContact)
        ]
        for i, (k, event) in itertools.product(bodies, events):
            others = tuple(t for n, t in enumerate(state.terms) if n not in (i, k))
            design = problem.design(others, state.noise)
            tried = []
            for form, at in (("lost", event.start), ("gained", event.stop), ("lost", event.stop)):
                if abs(float(at)) >= EVER:
                    continue
                start, stop = (float(at), EVER) if form == "gained" else (-EVER, float(at))
                effect = PayloadChange(last, start, stop, event.recording, form)
                best, deviation = _single(problem, design, state.noise, effect)
                proposal = Proposal(effect, best, best, deviation, first_steps(effect))
                tried.append(refine(problem, design, state.noise, proposal))
            best = max(tried, key=lambda p: p.best, default=None)
            if best is None or design.log_evidence + best.best < state.design.log_evidence:
                continue
            say(f"{state.terms[i].key} and {state.terms[k].key} are one: " + describe([best]))
            state = with_terms(problem, (*others, problem.term(best.effect, best.deviation)))
            break
        else:
            return state


def held_evidence(problem: Problem, state: State, i: int) -> float:
    """Evidence of a term's own shape in its place [nats]."""
    return _single(problem, without(state, i), state.noise, state.terms[i].effect)[0]


def instead(problem: Problem, state: State, i: int) -> list[Proposal]:
    """What each effect would bring in a term's place, where the term acts; most evidence first."""
    others = tuple(t for k, t in enumerate(state.terms) if k != i)
    key = ("instead", *map(id, others), id(state.terms[i]), id(state.noise))
    cache = problem._cache
    if key not in cache:
        effect = state.terms[i].effect
        acts = set(effect.joints) if isinstance(effect, AbstractJointEffect) else {
            int(j) for j in np.flatnonzero(shares(state)[i] > _FELT)
        }  # fmt: skip
        rest = without(state, i)
        scanned = ranked(problem, rest, state.noise, acts)
        own = _own(problem, rest, state.noise, effect, scanned)
        if own is not None:
            scanned = sorted([own, *(p for p in scanned if p.key != own.key)], key=lambda p: -p.evidence)
        cache[key] = (scanned, state)  # the state is kept, lest its parts' identities be used again
    held = {t.key for t in others if not t.effect.repeats}
    return [p for p in cache[key][0] if p.key not in held]


def _own(
    problem: Problem, rest: Design, noise: Noise, effect: AbstractEffect, scanned: Sequence[Proposal]
) -> Proposal | None:
    """A term's own shape in its place, if it is likelier than what the scan found of its kind.

    What the scan finds is refined among the first only, and a gap's or a change of payload's best shape may lie
    far from those of the grid.
    """
    best, deviation = _single(problem, rest, noise, effect)
    found = next((p for p in scanned if p.key == (effect.name, effect.joints)), None)
    if found is not None and found.best >= best:
        return None
    evidence = best - _PAID if found is None else found.evidence + best - found.best
    own = Proposal(effect, evidence, best, deviation, first_steps(effect))
    tests = is_dissipative, has_play, is_of_time
    stands = all(test(problem, rest, noise, own) for test in tests)
    return own if stands and is_event(problem, effect) else None


def prune(problem: Problem, state: State, say: Any) -> State:
    """Drop terms that the others have made needless, the weakest first."""
    while state.terms:
        gained = gains(state)
        lacking = [g - least for g, least in zip(gained, floors(state, gained), strict=True)]
        weakest = int(np.argmin(lacking))
        if lacking[weakest] >= 0:
            break
        say(f"prune {state.terms[weakest].key}: {gained[weakest]:.1f}")
        state = with_terms(problem, (*state.terms[:weakest], *state.terms[weakest + 1 :]))
    return state


def describe(proposals: Sequence[Proposal]) -> str:
    """For the log."""
    return "; ".join(f"{p.key[0]}{[j + 1 for j in p.key[1]]} {p.evidence:.1f}" for p in proposals)


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
    close = sum(p.evidence > max(_CLOSE * order[0].evidence, 4.0) for p in order[:_REFINED])
    refined = parallel(lambda p: refine(problem, design, noise, p), order[:close])
    refined = [p for p in refined if is_dissipative(problem, design, noise, p)]
    found = [p for p in (*refined, *order[close:]) if has_play(problem, design, noise, p)]
    found = [p for p in found if is_of_time(problem, design, noise, p)]
    return sorted((p for p in found if is_event(problem, p.effect)), key=lambda p: -p.evidence)


def is_event(problem: Problem, effect: AbstractEffect) -> bool:
    """Whether what calls itself a contact leaves some of its recording alone: a force that is always there says
    nothing of when, and takes what several joints' own effects explain together for one."""
    if not isinstance(effect, ExternalContact):
        return True
    time = clock(problem, effect.recording)
    return float(effect.stop) - float(effect.start) < LASTING * float(time[-1] - time[0])


def clock(problem: Problem, recording: str) -> Float[np.ndarray, " time"]:
    """Times of a recording, by its name [s]."""
    return next(t.motion.time for t in problem.traces if t.name == recording)


def is_dissipative(problem: Problem, design: Design, noise: Noise, proposal: Proposal) -> bool:
    """Whether what calls itself friction that depends on the direction takes energy, whatever the direction.

    Its even part may have either sign, but not exceed the odd one, with what the model has of friction: or it is
    a torque that does not know the direction, and no friction.
    """
    effect = proposal.effect
    if not isinstance(effect, AsymmetricFriction):
        return True
    j, (c, _) = effect.joints[0], _fitted(problem, design, noise, proposal)
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
    if not isinstance(proposal.effect, Backlash) or proposal.evidence < ACCEPT:
        return True
    c, covariance = _fitted(problem, design, noise, proposal)
    return bool(c[0] > CLEAR * np.sqrt(covariance[0, 0]))


def is_of_time(problem: Problem, design: Design, noise: Noise, proposal: Proposal) -> bool:
    """Whether what calls itself a drift tells one repeat of a motion from the next, where there are repeats.

    What comes again with the motion, and is no steady law of the drift's kind, is some function of the motion.
    """
    effect = proposal.effect
    if not isinstance(effect, TorqueDrift | FrictionDrift) or proposal.evidence < ACCEPT:
        return True
    shifts = [round(t.signals.period / t.motion.dt) if t.signals.period else 0 for t in problem.traces]
    if not any(shifts):
        return True
    j, (c, _) = effect.joints[0], _fitted(problem, design, noise, proposal)
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


def _fitted(
    problem: Problem, design: Design, noise: Noise, proposal: Proposal
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n n"]]:
    """A proposal's coefficients beside what is in the model, and their covariance."""
    effects = [proposal.effect]
    b, G = _projected(problem, design, noise, effects, problem.columns(effects))
    covariance = np.linalg.inv(G[0] + np.diag(proposal.deviation**-2.0))
    return covariance @ b[0], covariance


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
    signs = np.array([float(k.sign) for k in coefficients])
    b, G = _projected(problem, design, noise, effects, columns)
    if isinstance(effects[0], AbstractJointEffect):
        unit = float(noise.std[effects[0].joints[0]])
        deviation = _deviation(coefficients, np.concatenate(columns), unit)
    else:
        deviation = _deviation(coefficients, np.concatenate(columns) / noise.std[:, None, None], 1.0)
    value, scale = log_bayes(b, G, deviation, scales_of(effects[0]), signs)
    return value, scale, deviation


def _projected(problem: Problem, design: Design, noise: Noise, effects, columns):
    """b and G of single shapes of one form at one place."""

    def prepared(j, parts):
        Phi = problem.whitened(parts, noise, j)
        return Phi, gram(Phi)

    if isinstance(effects[0], AbstractJointEffect):
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
    effect, best, deviation = _climbed(problem, design, noise, proposal.effect, steps)
    variants = sorted(effect.variants(arm), key=form_of)
    for _, alike in itertools.groupby(variants, form_of):
        other = _likeliest(problem, design, noise, list(alike))
        if other[0].shapes and not effect.shapes:
            other = _climbed(problem, design, noise, other[0], first_steps(other[0]))
        if other[1] > best:
            effect, best, deviation = other
    gained = best - proposal.best
    return dataclasses.replace(
        proposal, effect=effect, best=best, deviation=deviation, evidence=proposal.evidence + gained
    )


Shaped = tuple[AbstractEffect, float, Float[np.ndarray, " n"]]
"""An effect, its evidence, and the prior deviations of its coefficients."""


def _climbed(
    problem: Problem, design: Design, noise: Noise, effect: AbstractEffect, steps: Sequence[float]
) -> Shaped:
    """The shape near this one with the most evidence."""
    best, deviation = _single(problem, design, noise, effect)
    if not steps:
        return effect, best, deviation
    scale = np.array(steps)
    for _ in range(_ROUNDS if len(steps) == 1 else _ROUNDS + 3):
        moves = [m * e for e in np.diag(scale) for m in (-1.0, 1.0, -0.4, 0.4)]
        if len(steps) > 1:
            moves += [np.array([a, b]) * scale[:2] for a in (-1, 1) for b in (-1, 1)]
        tried = _likeliest(problem, design, noise, [within(problem, moved(effect, move)) for move in moves])
        if tried[1] > best:
            gained = tried[1] - best
            effect, best, deviation = tried
            if gained < 0.05:
                break
        else:
            scale = scale * 0.35
    return effect, best, deviation


def _likeliest(problem: Problem, design: Design, noise: Noise, effects: Sequence[AbstractEffect]) -> Shaped:
    """Of single shapes of one form at one place."""
    values, deviations = score(problem, design, noise, effects)
    top = int(values.argmax())
    return effects[top], float(values[top]), deviations[top]


def _single(problem: Problem, design: Design, noise: Noise, effect: AbstractEffect):
    return _likeliest(problem, design, noise, [effect])[1:]


def within(problem: Problem, effect: AbstractEffect) -> AbstractEffect:
    """A change of payload kept inside its recording: beyond, it is a payload that was there throughout.

    And a contact kept longer than what the filters of motion and torque resolve.
    """
    if isinstance(effect, ExternalContact) and effect.stop - effect.start < BIN:
        middle = 0.5 * (float(effect.start) + float(effect.stop))
        return dataclasses.replace(effect, start=middle - 0.5 * BIN, stop=middle + 0.5 * BIN)
    if not isinstance(effect, PayloadChange):
        return effect
    time = clock(problem, effect.recording)
    inside = lambda at: at if abs(at) >= EVER else float(np.clip(at, time[0] + 3 * BIN, time[-1] - 3 * BIN))
    return dataclasses.replace(effect, start=inside(float(effect.start)), stop=inside(float(effect.stop)))


def moved(effect: AbstractEffect, move: Float[np.ndarray, " shapes"]) -> AbstractEffect:
    """The effect with its shape parameters moved, within their bounds."""
    changes = {}
    for shape, step in zip(effect.shapes, move, strict=False):
        value = float(getattr(effect, shape.name))
        value = value * np.exp(step) if shape.logarithmic else value + step
        changes[shape.name] = float(np.clip(value, shape.lower, shape.upper))
    return dataclasses.replace(effect, **changes)
