"""Which effects, where, in which shape: greedy selection by evidence, everything refitted at every step."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..effects import AbstractEffect, AbstractJointEffect
from ..effects.contact import ExternalContact
from ..effects.drive import TorqueRipple
from ..effects.effect import AbstractDryFriction
from ..effects.friction import AsymmetricFriction, CoulombFriction, ViscousFriction
from ..effects.load import EVER, InertialParameters, Payload, PayloadChange
from ..effects.sensing import TorqueOffset
from .credible import has_play, is_dissipative, is_event, is_of_time
from .events import Proposal
from .evidence import Design, Noise
from .problem import Problem, Term
from .proposals import CLOSE, RICHER_SHARE, free_forms, grids, ranked, slow_ripple
from .rivals import ACCEPT, HOLDS, SPECIAL, TEMPERATURE, called, odds
from .shapes import evidence_of, first_steps, refine
from .state import (
    SHADOW,
    State,
    energies,
    floors,
    gained_over,
    gains,
    helped_over,
    places,
    shares,
    start,
    with_terms,
    without,
)

SWAP = 3.0
"""Evidence that another effect must win by to take an accepted one's place [nats]."""
HELD_OUT = 6.0
"""By which a term must lower the squared held-out error, in units of the noise's variance."""
WORTH = 1.03
"""By which the squared error of predicted torque must be smaller than with the user's model."""
OPPOSED = 20.0
"""How many times the torque of a law its parts may be."""
MOST_SWAPPED = 6
MOST_TERMS, MOST_NAMES, MOST_ADDED = 10, 5, 8
_TRIED = 8
_SETTLED = 4
_OVERLAP, _FELT = 0.05, 0.02
LIKELIER, ELECTIONS = 3.0, 3
"""How many times as likely a rival takes a term's place, and how often one does in a row."""
CROWDED, BEGUN = 6, 50.0
"""Terms from which another beginning is tried, and what it must win by where it was not fitted [nats]."""
_SIMPLE = ("viscous_friction", "coulomb_friction", "presliding_hysteresis", "torque_offset")
_BEGINNINGS = 2
"""Simpler effects from which a joint is built up again."""
_PAID = 8.0  # [nats]: for the search of when a body changes hands


def search(problem: Problem, log: list[str] | None = None) -> State:
    """Add the likeliest effect while one has evidence; then see if another does better in its place.

    Where many are needed, the arm may be one whose every joint rubs, sticks and has an offset, as real ones do: a
    search that begins with that is made as well, and taken if it does better where it was not fitted.
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
        alike = sorted(t.key for t in other.terms) == sorted(t.key for t in state.terms)
        state = other
        if alike:  # what was elected was replaced again
            break
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
    state = taken_apart(problem, handed_over(problem, prune(problem, state, say), say), say)
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
        state = handed_over(problem, settle(problem, completed(problem, state)), say)
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
        close = [pair for pair in helped if pair[1].evidence >= CLOSE * most]
        return max(close, key=lambda pair: pair[0])[1] if close else None

    wide = [p for p in proposals if len(p.effect.joints) > 1]
    return likeliest(wide) or likeliest([p for p in proposals[:_TRIED] if len(p.effect.joints) == 1])


def completed(problem: Problem, state: State) -> State:
    """Damping common to both directions joins friction that differs between them, where it has evidence."""
    term = state.terms[-1]
    if not isinstance(term.effect, AsymmetricFriction) or term.effect.form != "both":
        return state
    full = dataclasses.replace(term.effect, form="full")
    _, deviation = evidence_of(problem, without(state, len(state.terms) - 1), state.noise, full)
    other = with_terms(problem, (*state.terms[:-1], problem.term(full, deviation)))
    return other if gained_over(problem, other, state) > ACCEPT else state


def settle(problem: Problem, state: State) -> State:
    """The newest term refined again in its own noise, then the older ones beside it that act where it does."""
    share = shares(state)
    overlapping = [i for i in range(len(share)) if share[i] @ share[-1] > _OVERLAP]
    for i in overlapping[::-1][:_SETTLED]:
        term = state.terms[i]
        if not term.effect.shapes:
            continue
        design = without(state, i)
        best, deviation = evidence_of(problem, design, state.noise, term.effect)
        steps = tuple(0.5 * x for x in first_steps(term.effect))
        proposal = Proposal(term.effect, best, best, deviation, steps)
        better = refine(problem, design, state.noise, proposal)
        if better.best > best + 1.0:
            terms = list(state.terms)
            terms[i] = problem.term(better.effect, better.deviation)
            state = State(tuple(terms), state.noise, problem.design(terms, state.noise))
    return state


def gate(problem: Problem, state: State, say: Any) -> State:
    """Drop what does not help where it was not fitted; what happened once cannot be tested so, and stays."""
    while True:
        once = [t.effect.bound_to_recording for t in state.terms]
        energy = energies(state)[once].sum((0, 1)) if any(once) else np.zeros(len(state.design.residual[0]))
        counts = energy <= 0
        kinds = {t.effect.drifts for t in state.terms}
        reference = {x: problem.held_out_error(state.design, counts, spread=x) for x in kinds}
        for i in np.argsort(gains(state)):
            if once[i]:
                continue
            drifts = state.terms[i].effect.drifts
            helped = problem.held_out_error(without(state, int(i)), counts, spread=drifts) - reference[drifts]
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
        drifting = any(state.terms[i].effect.drifts for i in lasting)
        all_over = problem.predicted_error(state.design, state.noise, spread=True)[0] if drifting else whole
        harm = {}
        for i in lasting:
            drifts = state.terms[i].effect.drifts
            less, _ = problem.predicted_error(without(state, i), state.noise, spread=drifts)
            harm[i] = (all_over if drifts else whole) - less
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
                best, deviation = evidence_of(problem, design, state.noise, effect)
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


def taken_apart(problem: Problem, state: State, say: Any) -> State:
    """Coulomb's and viscous friction in the place of a law that holds both, where they do about as well; and of
    friction that differs between the directions where they do better with an offset.

    No rival of that law shows that it is not needed: each of them alone lacks the others.
    """
    plain = (CoulombFriction.name, ViscousFriction.name)
    for i, term in enumerate(state.terms):
        if not set(plain) <= set(HOLDS.get(term.effect.name, ())):
            continue
        whole = state.design.log_evidence - without(state, i).log_evidence
        ways: list[tuple[tuple[str, ...], float]] = [
            (plain, max(SPECIAL * TEMPERATURE, RICHER_SHARE * whole))
        ]
        if isinstance(term.effect, AsymmetricFriction):
            ways.append(((*plain, TorqueOffset.name), -0.5 * ACCEPT))
        for names, allowed in ways:
            terms = _parts(problem, state, i, names)
            gained = problem.design(terms, state.noise).log_evidence - state.design.log_evidence
            if gained > -allowed:
                say(f"{term.key} taken apart into {', '.join(names)}: {gained:.1f}")
                return taken_apart(problem, prune(problem, with_terms(problem, terms), say), say)
    return state


def _parts(problem: Problem, state: State, i: int, names: Sequence[str]) -> list[Term]:
    """The terms with effects of these names, fitted beside each other, in the place of one at its joint."""
    others, parts = (*state.terms[:i], *state.terms[i + 1 :]), dict[str, Term]()
    joints = state.terms[i].effect.joints
    groups = [g for g in problem.library if (g.joint,) == joints]
    new = [name for name in names if all(t.key != (name, joints) for t in others)]
    for name in (*new, *new[:1]):  # the first once more, beside the rest
        beside = problem.design((*others, *(p for n, p in parts.items() if n != name)), state.noise)
        (best,) = grids(problem, beside, state.noise, [g for g in groups if g.name == name])
        best = refine(problem, beside, state.noise, best)
        parts[name] = problem.term(best.effect, best.deviation)
    return [*others, *parts.values()]


def held_evidence(problem: Problem, state: State, i: int) -> float:
    """Evidence of a term's own shape in its place [nats]."""
    return evidence_of(problem, without(state, i), state.noise, state.terms[i].effect)[0]


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
    best, deviation = evidence_of(problem, rest, noise, effect)
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
