r"""Which effects, where, in which shape: the likeliest model that steps from one to the next lead to.

A model is a set of terms. Its probability is its evidence, every law with its discrepancy, times the prior odds
of its effects. Steps add a term, drop one, put another or two in its place, or one in the place of several; none
of them knows an effect. What is left is a local optimum, and its neighbours, which `posterior` weighs.
"""

import itertools
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import scipy.special

from ..effects import law_of
from ..inference.alike import TEMPERATURE, joints_with, one_more, shared
from ..inference.discrepancy import unresolved
from ..inference.evidence import Design, Noise
from ..inference.problem import Problem, Term
from ..inference.state import (
    State,
    beside,
    coefficients,
    evidence,
    gains,
    in_noise,
    likelier,
    paid,
    places,
    with_terms,
    without,
)
from .credible import fitted
from .events import Proposal
from .proposals import at_others, by_place, grids, plainer, ranked, with_prior
from .shapes import evidence_of, first_steps, refine

OPPOSED = 20.0
"""How many times the torque of a law its parts may be."""
LARGEST = 5.0
"""How many times what the user's model leaves of a joint a law may be: causes that do not know of each other add
up."""
WORTH = 1.03
"""By which the squared error of predicted torque must be smaller than with the user's model."""
BETTER = 1.0
"""By how much a model must be likelier to be worth a step [nats]."""
UNLIKELY = -10.0
"""Evidence of a proposal from which it is weighed in the noise that it would leave [nats]."""
_NEGATIVE = 2.0
"""Standard deviations by which a coefficient may be negative that cannot be."""
_TRIED = 5
"""Proposals at most that are weighed with their discrepancy."""
_WINDOW = 0.5
"""Share of the best proposal's log probability from which others are weighed beside it."""
_PAIRED, _FEW = 2, 8
"""Rivals of a term that are tried with another beside them; terms that act in its joints up to which they are."""
_ROUNDS, _MOST = 4, 60
"""Rounds of steps, and terms of a model: nothing that ends by itself comes near."""
_CROWDED = 4
"""Terms from which another beginning is tried."""
_OVERLAP, _FELT = 0.05, 0.02
_SETTLED = 4
_OTHERWISE, _REMADE = 2.0, 3
"""By how much more or less than it was taken in with a law explains where what it may be off is made again; and
how often, as each changes what the others explain."""


def laws(problem: Problem, log: list[str] | None = None, terms: Sequence[Term] = ()) -> State:
    """The likeliest model of laws alone that steps from one with these terms lead to.

    Where many laws are needed the arm may be one whose every joint rubs, as real ones do: other steps begin at
    what is common in every joint.
    """
    say = _said(log)
    first = with_terms(problem, terms)
    state = climb(problem, first, say, free=False)
    if len(state.terms) >= _CROWDED:
        common = with_terms(problem, everywhere(problem, state.noise))
        if names(common) == names(first):  # which would lead to the same
            return state
        say("another beginning: what is common, at all joints")
        other = climb(problem, common, say, free=False, met=names(state))
        if names(other) != names(state):
            best = _likelier(problem, state, other, say)
            state = crossed(problem, best, other if best is state else state, say)
    return state


def crossed(problem: Problem, state: State, other: State, say: Any) -> State:
    """With the terms of another model at each joint where the model is likelier with them, by the recordings and
    by what it predicts where it was not fitted too: steps that began elsewhere may have ended better at some
    joints though not on the whole."""
    at = lambda terms, joint: [t for t in terms if t.effect.joints == (joint,)]
    for joint in range(problem.dof):
        own, new = at(state.terms, joint), at(other.terms, joint)
        if sorted(map(name, own)) == sorted(map(name, new)):
            continue
        kept = [t for t in state.terms if all(t is not o for o in own)]
        changed = with_terms(problem, (*kept, *new))
        gained = changed.score - state.score
        if gained > BETTER and likelier((problem, state), (problem, changed)) > 0:
            said = [", ".join(map(name, some)) or "nothing" for some in (new, own)]
            say(f"{said[0]} for {said[1]}: {gained:.1f}")
            state = changed
    return state


def search(problem: Problem, log: list[str] | None = None, state: State | None = None) -> State:
    """The likeliest model that was found; `state`: where `laws` has ended already.

    Laws come before free forms, which fit what several laws do together and hold nowhere else.
    """
    say, state = _said(log), laws(problem, log) if state is None else state
    say("free forms")
    return _likelier(problem, state, climb(problem, state, say), say)


def _said(log: list[str] | None) -> Any:
    return (lambda _: None) if log is None else log.append


def _likelier(problem: Problem, state: State, other: State, say: Any) -> State:
    """Of two models the likelier one."""
    if {id(t) for t in state.terms} == {id(t) for t in other.terms}:
        return state
    gained = likelier((problem, state), (problem, other))
    say(f"which is likelier by {gained:.1f}")
    return other if gained > 0 else state


def climb(problem: Problem, state: State, say: Any, *, free: bool = True, met: Sequence[str] = ()) -> State:
    """Steps to a likelier model, as long as they lead to another; with free forms, or laws only.

    `met`: the laws that other steps have ended with. Where these come to the same they would lead on alike.
    """
    for _ in range(_ROUNDS):
        before = state
        state = prune(problem, grow(problem, state, say, free), say)
        if met and names(state) == list(met):
            break
        state = exchange(problem, state, say, free)
        state = merge(problem, state, say, free)
        state = prune(problem, state, say)
        if names(state) == names(before):
            break
    return state


def taken(problem: Problem, design: Design, noise: Noise, proposal: Proposal) -> Term:
    """A proposal as a term beside what a design holds, with its discrepancy."""
    c, _ = fitted(problem, design, noise, proposal)
    prior = proposal.evidence - proposal.shared - proposal.best + proposal.effect.form_prior
    prior += proposal.effect.beyond_normal(c, proposal.deviation)
    return problem.term(proposal.effect, proposal.deviation, c, noise.std, prior)


Choice = tuple[float, tuple[Term, ...]]
"""By how much a model gets likelier with some terms, and the terms."""


def choices(
    problem: Problem, terms: Sequence[Term], design: Design, noise: Noise, proposals: Sequence[Proposal]
) -> list[Choice]:
    """What the foremost proposals bring with their discrepancies, beside these terms; the likeliest first."""
    if not proposals:
        return []
    laws, out = [t.effect for t in terms], []
    own = evidence(problem, terms, design, noise) + shared(laws, problem.telling)
    counted: list[Proposal] = []
    for p in proposals:
        if not _is_weighed(p, counted):
            break
        possible = False
        for form in (p, *plainer(problem, design, noise, p)):
            term = taken(problem, design, noise, form)
            more = problem.design((*terms, term), noise)
            if is_possible(term, more) and not is_opposed(problem, term, more):
                found = evidence(problem, (*terms, term), more, noise)
                odds = term.prior + shared((*laws, term.effect), problem.telling)
                out.append((found - own + odds, (term,)))
                possible = True
            problem.forget(term)
        if possible:  # what cannot be gives way to what comes after it
            counted.append(p)
    return sorted(out, key=lambda choice: -choice[0])


def _is_weighed(proposal: Proposal, before: Sequence[Proposal]) -> bool:
    """Whether a proposal is weighed, after the likelier ones."""
    best = max((p.evidence for p in before[:1]), default=0.0)
    return len(before) < _TRIED and proposal.evidence > (_WINDOW * best if best > 0 else UNLIKELY)


def is_possible(term: Term, design: Design) -> bool:
    """Whether the coefficients of the last term of a design, with the numbers of the arm that they correct, have
    the signs that physics allows, but for noise."""
    first = len(design.precision) - term.width
    signed = [k for k, c in enumerate(term.effect.coefficients) if c.sign]
    held = [term.corrections[k].value if k in term.corrections else 0.0 for k in signed]
    at = [first + k for k in signed]
    unit = np.eye(len(design.precision))[:, at]
    deviation = np.sqrt(np.diag(unit.T @ design.solve(unit)))
    return bool(np.all(design.x[at] + held > -_NEGATIVE * deviation))


def is_opposed(problem: Problem, term: Term, design: Design) -> bool:
    """Whether the last term of a design is many times what the user's model leaves of a joint: then others oppose
    it, and each is what these recordings do not tell of it."""
    first = len(design.precision) - term.width
    c = design.x[first : first + len(term.deviation)]
    size = problem.weighed([columns @ c for columns in term.columns])
    return bool(np.any(size > LARGEST * problem.left_by_user))


def grow(problem: Problem, state: State, say: Any, free: bool = True) -> State:
    """Add the likeliest effect while it makes the model likelier, and with it the likeliest at other joints."""
    proposals, joints = [], None
    while len(state.terms) < _MOST:
        proposals = ranked(problem, state.design, state.noise, joints, proposals)
        say(f"{len(state.terms)} terms: " + describe(proposals[:6]))
        new = [p for p in _new(state.terms, proposals, free) if p.evidence > UNLIKELY]
        added = foremost(problem, state, new)
        if not added:
            return state
        for gained, (term,) in added:
            say(f"add {name(term)}: {gained:.1f}")
        state = with_terms(problem, (*state.terms, *(term for _, (term,) in added)))
        state = settle(problem, state, len(added))
        joints = set(np.flatnonzero(state.shares[-len(added) :].max(0) > _FELT).tolist())
    return state


def foremost(problem: Problem, state: State, proposals: Sequence[Proposal]) -> list[Choice]:
    """The choice that is likeliest; where it acts in one joint, with it those of other joints that come before
    any that acts in several: neither knows much of the other."""
    weigh = lambda some: choices(problem, state.terms, state.design, state.noise, some)[:1]
    first = weigh(proposals)
    if not first or first[0][0] < BETTER:
        return []
    term, out = first[0][1][0], list(first)
    if term.effect.one_joint:
        places = by_place(proposals)
        least = max((p.evidence for p in places.pop(None, [])), default=0.0)
        del places[term.effect.joints[0]]
        for alike in places.values():
            out += [choice for choice in weigh(alike) if choice[0] > max(least, BETTER)]
    return out


def prune(problem: Problem, state: State, say: Any) -> State:
    """Drop terms that the others have made needless, the weakest first.

    Friction may hold any load at rest, so that in its noise samples there tell little for it: without it the
    model must be likelier in a noise of its own.
    """
    needed: set[int] = set()
    while True:
        state = remade(problem, state)
        gained = gains(problem, state)
        for weakest in np.argsort(gained, kind="stable").tolist():
            term = state.terms[weakest]
            if gained[weakest] >= 0:
                return state
            if id(term) in needed:
                continue
            fewer = with_terms(problem, (*state.terms[:weakest], *state.terms[weakest + 1 :]))
            if term.at_rest is None or likelier((problem, state), (problem, fewer)) >= 0:
                say(f"drop {name(term)}: {gained[weakest]:.1f}")
                state = fewer
                break
            needed.add(id(term))
        else:
            return state


def exchange(problem: Problem, state: State, say: Any, free: bool = True) -> State:
    """Put in the place of each term what is likelier there, and in a noise of its own: in that of friction, which
    may hold any load at rest, samples there tell little against what comes in its place."""
    for i in range(len(state.terms)):
        step = Step(state, "exchange", (i,))
        if step.key(free) in problem.tried:
            continue
        found, barred = instead(problem, state, i, free)
        problem.tried.update(step.tried(free, barred, _told(found)))
        term = state.terms[i]
        own = next(gained for gained, terms in found if terms[0] is term)
        best = found[0]
        if best[0] <= own + BETTER:
            continue
        other = with_terms(problem, (*state.terms[:i], *best[1], *state.terms[i + 1 :]))
        if len(best[1]) > 1:
            other = shaped_together(problem, other, range(i, i + len(best[1])))
        if likelier((problem, state), (problem, other)) < 0:
            continue
        if [t.key for t in best[1]] != [term.key]:
            say(f"{', '.join(map(name, best[1]))} for {name(term)}: {best[0]:.1f} for {own:.1f}")
        state = other
    return state


Told = Sequence[tuple[float, tuple[str, ...]]]
"""By how much a model gets likelier with some terms, and their titles."""


def _told(found: Sequence[Choice]) -> Told:
    return [(gained, tuple(t.effect.title for t in terms)) for gained, terms in found]


class Step:
    """What tells one step of a search from another: its terms, those that act in the same joints, and how many
    joints have what joints have alike."""

    def __init__(self, state: State, kind: str, which: Sequence[int]):
        share = state.shares
        beside = (share @ share[list(which)].T).max(1) > _OVERLAP
        self.kind = kind
        self.terms = (
            [state.terms[i] for i in which],
            [t for t, on in zip(state.terms, beside, strict=True) if on],
        )
        elsewhere = [t.effect for t, on in zip(state.terms, beside, strict=True) if not on]
        self.elsewhere = joints_with(elsewhere)

    def key(self, free: bool) -> tuple:
        """By the terms' identities."""
        return self.kind, free, *(tuple(sorted(map(id, some))) for some in self.terms), self.elsewhere

    def tried(self, free: bool, barred: bool, found: Told = ()) -> dict[tuple, tuple["Step", Told]]:
        """For `Problem.tried`: the step, whose terms are kept lest their identities be used again, and what was
        found; with free forms too where none of them was `barred`."""
        return {self.key(one): (self, found) for one in ({free} if barred else {free, True})}


def merge(problem: Problem, state: State, say: Any, free: bool = True) -> State:
    """One term in the place of several that act together: of all in a joint, or of a pair.

    What joins it afterwards must make the whole likelier: else it may be what was just taken out, without end.
    """
    while True:
        groups = [
            tuple(i for i, t in enumerate(state.terms) if t.effect.joints == (j,)) for j in range(problem.dof)
        ]
        wide = [i for i, t in enumerate(state.terms) if not t.effect.one_joint]
        share = state.shares
        pairs = [(i, k) for i, k in itertools.combinations(wide, 2) if share[i] @ share[k] > _FELT]
        for group in dict.fromkeys((*(g for g in groups if len(g) > 1), *pairs)):
            step = Step(state, "merge", group)
            if step.key(free) in problem.tried:
                continue
            others = tuple(t for i, t in enumerate(state.terms) if i not in group)
            design = problem.design(others, state.noise)
            whole = evidence(problem, state.terms, state.design, state.noise)
            own = whole - beside(problem, state, group, design)
            acts = set(np.flatnonzero(state.shares[list(group)].max(0) > _FELT).tolist())
            proposals = ranked(problem, design, state.noise, acts)
            problem.tried.update(step.tried(free, not free and _lets_free_in(others, proposals)))
            found = choices(problem, others, design, state.noise, _new(others, proposals, free))
            if found and found[0][0] > own + BETTER:
                fewer = with_terms(problem, (*others, *found[0][1]))
                if likelier((problem, state), (problem, fewer)) < 0:
                    continue
                gone = ", ".join(name(state.terms[i]) for i in group)
                say(f"{name(found[0][1][0])} for {gone}: {found[0][0]:.1f} for {own:.1f}")
                state = _likelier(problem, fewer, grow(problem, fewer, say, free), say)
                break
        else:
            return state


def instead(problem: Problem, state: State, i: int, free: bool = True) -> tuple[list[Choice], bool]:
    """What each effect would bring in a term's place, where the term acts, the likeliest first; the term itself
    is among them. And whether free forms that were not let in would have been weighed."""
    others = tuple(t for k, t in enumerate(state.terms) if k != i)
    term, rest = state.terms[i], without(state, i)
    acts = set(term.effect.joints) if term.effect.one_joint else {
        int(j) for j in np.flatnonzero(state.shares[i] > _FELT)
    }  # fmt: skip
    proposals = ranked(problem, rest, state.noise, acts)
    found = choices(problem, others, rest, state.noise, _new(others, proposals, free))
    barred = not free and _lets_free_in(others, proposals)
    crowd = np.flatnonzero(state.shares @ state.shares[i] > _OVERLAP)
    if not term.effect.bound_to_recording and len(crowd) <= _FEW:
        for one in [choice for choice in found if choice[1][0].key != term.key][:_PAIRED]:
            terms = (*others, *one[1])
            design = problem.design(terms, state.noise)
            proposals = [p for p in ranked(problem, design, state.noise, acts) if p.evidence > 0]
            barred |= not free and _lets_free_in(terms, proposals)
            beside_it = choices(problem, terms, design, state.noise, _new(terms, proposals, free))
            if beside_it and beside_it[0][0] > 0:
                found.append((one[0] + beside_it[0][0], (*one[1], *beside_it[0][1])))
        found += _parts(problem, others, state.noise, term, acts, free)
    own = evidence(problem, state.terms, state.design, state.noise) - beside(problem, state, (i,), rest)
    return sorted([(own, (term,)), *found], key=lambda choice: -choice[0]), barred


def _lets_free_in(terms: Sequence[Term], proposals: Sequence[Proposal]) -> bool:
    """Whether free forms are among what is weighed of these."""
    let_in = _new(terms, proposals, free=True)
    return any(p.effect.free and _is_weighed(p, let_in[:k]) for k, p in enumerate(let_in))


def _parts(
    problem: Problem,
    others: Sequence[Term],
    noise: Noise,
    whole: Term,
    joints: Collection[int],
    free: bool,
) -> list[Choice]:
    """What a law is a sum of, each part a term of its own, and laws of the numbers that it corrects: what is left
    of the law without what makes it one."""
    corrected = [law_of(c.beyond) for c in whole.effect.coefficients if c.beyond]
    if len(laws := [*whole.effect.held, *corrected]) < 2:
        return []
    parts: tuple[Term, ...] = ()
    for part in laws:
        terms = (*others, *parts)
        design = problem.design(terms, noise)
        of_kind = [p for p in ranked(problem, design, noise, joints) if p.effect.name == part.name]
        found = choices(problem, terms, design, noise, _new(terms, of_kind, free))
        if not found:
            return []
        parts = (*parts, *found[0][1])
    rest = in_noise(problem, others, noise)
    both = in_noise(problem, (*others, *parts), noise)
    both = shaped_together(problem, both, range(len(others), len(both.terms)))
    likely = [evidence(problem, s.terms, s.design, noise) + paid(s.terms, s.joints) for s in (rest, both)]
    return [(likely[1] - likely[0], both.terms[len(others) :])]


def _new(terms: Sequence[Term], proposals: Sequence[Proposal], free: bool) -> list[Proposal]:
    """Proposals that may join these terms: free forms too, or laws only. One of them corrects a number of the
    user's model."""
    held = {t.key for t in terms}
    numbers = {(c.beyond, t.effect.joints) for t in terms for c in t.effect.coefficients if c.beyond}
    known = lambda effect: all((c.beyond, effect.joints) in numbers for c in effect.coefficients)
    return [
        p
        for p in proposals
        if (p.key not in held or p.effect.repeats) and (free or not p.effect.free) and not known(p.effect)
    ]


def posterior(problem: Problem, state: State, i: int) -> dict[str, float]:
    """Probability of each effect in a term's place, the other terms given: of models that have the term's effect,
    and of others by their first; none at all takes the rest."""
    step = Step(state, "exchange", (i,))
    if step.key(True) in problem.tried:
        _, found = problem.tried[step.key(True)]
    else:
        found = _told(instead(problem, state, i)[0])
    weights = np.array([0.0, *(gained for gained, _ in found)]) / TEMPERATURE
    shares_ = scipy.special.softmax(weights)
    out: dict[str, float] = {}
    own = state.terms[i].effect.title
    for (_, titles), p in zip(found, shares_[1:], strict=True):
        title = own if own in titles else titles[0]
        out[title] = out.get(title, 0.0) + float(p)
    return out


def everywhere(problem: Problem, noise: Noise) -> list[Term]:
    """For each joint what is common, where it makes the model likelier."""
    most = max(g.effects[0].prior for g in problem.library)
    common = {g.name for g in problem.library if g.effects[0].prior == most}
    terms: list[Term] = []
    for joint in range(problem.dof):
        groups = [g for g in problem.library if g.joint == joint and g.name in common]
        while True:
            design = problem.design(terms, noise)
            held = {t.key for t in terms}
            left = [g for g in groups if (g.name, g.effects[0].joints) not in held]
            found, beside_it = [], one_more([t.effect for t in terms], problem.telling)
            for p in grids(problem, design, noise, left) if left else []:
                p = at_others(with_prior(p, problem.dof), beside_it)
                p = refine(problem, design, noise, p)
                found += choices(problem, terms, design, noise, [p]) if p.evidence > 0 else []
            best = max(found, key=lambda choice: choice[0], default=None)
            if best is None or best[0] < BETTER:
                break
            terms += best[1]
    return terms


def remade(problem: Problem, state: State) -> State:
    """The model where each law may be off in proportion to what it explains beside the others, which may no more
    be what it was taken in with."""
    for _ in range(_REMADE):
        terms = list(state.terms)
        for i, term in enumerate(state.terms):
            if term.unresolved is None:
                continue
            c = coefficients(state, i)
            now = unresolved(problem.traces, [columns @ c for columns in term.columns])
            grown = np.sqrt(now.sum() / max(float(term.unresolved.sum()), 1e-300))
            if not 1 / _OTHERWISE < grown < _OTHERWISE:
                terms[i] = problem.term(term.effect, term.deviation, c, state.noise.std, term.prior)
        if all(new is old for new, old in zip(terms, state.terms, strict=True)):
            break
        state = with_terms(problem, terms)
    return state


def settle(problem: Problem, state: State, count: int = 1) -> State:
    """The newest terms refined again in their own noise, and the older ones that act where they do."""
    share = state.shares
    for newest in range(len(share) - count, len(share)):
        older = [i for i in range(len(share) - count) if share[i] @ share[newest] > _OVERLAP]
        for i in (newest, *older[::-1][: _SETTLED - 1]):
            state = reshaped(problem, state, i)
    return state


def shaped_together(problem: Problem, state: State, which: Collection[int]) -> State:
    """The model with the shapes of some terms refined beside each other, which were each shaped without."""
    for i in which:
        state = reshaped(problem, state, i)
    return state


def reshaped(problem: Problem, state: State, i: int) -> State:
    """The model with the shape of a term refined again, where that makes it likelier."""
    term = state.terms[i]
    if not term.effect.shapes:
        return state
    design = without(state, i)
    best, deviation = evidence_of(problem, design, state.noise, term.effect)
    steps = tuple(0.5 * x for x in first_steps(term.effect))
    paid = term.prior - term.effect.form_prior
    better = refine(problem, design, state.noise, Proposal(term.effect, best + paid, best, deviation, steps))
    if better.best < best + BETTER:
        return state
    terms = list(state.terms)
    terms[i] = taken(problem, design, state.noise, better)
    return in_noise(problem, terms, state.noise)


def transferable(problem: Problem, state: State) -> State:
    """Without the terms that make torque worse where their coefficients were not fitted; without all that can be
    tested so, where together they gain next to nothing.

    What stands in for physics that has no name fits where it was fitted, and misleads elsewhere. So does a law of
    friction whose parts these speeds do not tell apart.
    """
    state = with_terms(problem, [t for i, t in enumerate(state.terms) if not is_undetermined(state, i)])
    while lasting := [i for i, t in enumerate(state.terms) if not t.effect.bound_to_recording]:
        whole, users, _ = (float(x.sum()) for x in problem.predicted_error(state.design, state.noise))
        drifting = any(state.terms[i].effect.drifts for i in lasting)
        spread = problem.predicted_error(state.design, state.noise, spread=True)[0].sum() if drifting else 0.0
        harm = {}
        for i in lasting:
            drifts = state.terms[i].effect.drifts
            less = problem.predicted_error(without(state, i), state.noise, spread=drifts)[0]
            harm[i] = (float(spread) if drifts else whole) - float(less.sum())
        worst = max(harm, key=lambda i: harm[i])
        if harm[worst] > 0:
            state = with_terms(problem, (*state.terms[:worst], *state.terms[worst + 1 :]))
        elif users < WORTH * whole:
            return with_terms(problem, [t for t in state.terms if t.effect.bound_to_recording])
        else:
            break
    return state


def stand_ins(problem: Problem, state: State) -> list[Term]:
    """The free forms that leave more than half of what they are fitted to, beyond noise, where they were not
    fitted. A law would leave none: what they stand for is something else, and another motion is another one."""
    curves = [i for i, term in enumerate(state.terms) if term.effect.free]
    if not curves:
        return []
    whole, _, alone = problem.predicted_error(state.design, state.noise)
    beyond = lambda error, i: float(np.sum((error - alone)[state.terms[i].acts]))
    less = {i: problem.predicted_error(without(state, i), state.noise)[0] for i in curves}
    return [state.terms[i] for i in curves if beyond(whole, i) > 0.5 * beyond(less[i], i)]


def is_undetermined(state: State, i: int) -> bool:
    """Whether a term is friction whose parts are many times their sum: at other speeds they are not."""
    term = state.terms[i]
    if not term.effect.dry:
        return False
    parts = np.concatenate(term.columns) * state.design.x[places(state)[i]]
    rms = lambda torque: float(np.sqrt(np.mean(torque**2)))
    return max(rms(part) for part in np.moveaxis(parts, -1, 0)) > OPPOSED * rms(parts.sum(-1))


def names(state: State) -> list[str]:
    """Of its laws, whatever their numbers."""
    return sorted(map(name, state.terms))


def name(term: Term) -> str:
    """Law and joints."""
    form = getattr(term.effect, "form", "")
    return f"{term.key[0]}{[j + 1 for j in term.key[1]]}{form and f' ({form})'}"


def describe(proposals: Sequence[Proposal]) -> str:
    """For the log."""
    return "; ".join(f"{p.key[0]}{[j + 1 for j in p.key[1]]} {p.evidence:.1f}" for p in proposals)
