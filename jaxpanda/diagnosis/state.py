"""The model at some point of a search, and what each of its terms is worth there."""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..effects import AbstractEffect, AbstractJointEffect
from ..effects.contact import ExternalContact
from ..effects.drive import Backlash, JointElasticity
from ..effects.friction import CoulombFriction, ViscousFriction
from ..effects.unknown import Unknown, UnknownOfTwo
from .evidence import Design, Noise
from .problem import Problem, Term
from .rivals import ACCEPT, called

SHADOW, EVENT_SHADOW = 0.03, 0.5
"""Share of a stronger term's evidence, in the joints and at the times where a weaker one acts, below which
the weaker is taken for its shadow: for what the stronger's shape, never quite right, leaves over. Events in
time, which fit any such leftover somewhere, need a larger share."""
UNEXPLAINED, CLEARED = 1.0, 0.15
"""Mean square beyond the noise's, over it, of what the others leave in a joint, and the share of that which is
left at most by a law that is no shadow: what a shape that is not quite right leaves has the shape of no law."""
BRIEF = 0.3
"""Duration below which a contact may be what a law leaves of a reversal or an impact [s]."""
SECOND_JOINT = 0.03
"""Share of its torque, squared over noise, that a contact must show beside the joint that feels it most: a
force on a link turns several joints, while what is left of a joint's own effect stays in that joint."""


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
    before, after = (np.array([_beyond(e) for e in d.left]) for d in (bare, design))
    return before, after


def _beyond(left: Float[np.ndarray, " rows"]) -> float:
    """Mean square of what is left of a joint, whitened, beyond the noise's; rows that do not count are zero."""
    return float(np.sum(left**2)) / max(np.count_nonzero(left), 1) - 1


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
    stronger law has wrong there. A free form of another joint's motion stands in that joint's shadow too. A law
    that takes away nearly all that the others leave in its joint stands in none, nor do Coulomb's and viscous
    friction, which every gear has, in that of each other.
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
            other = state.terms[k].effect
            if gained[k] > gained[i] and not are_plain(term.effect, other):
                swings = isinstance(other, Backlash | JointElasticity)
                felt = energy[k].sum(1) if swings else energy[k][:, rows].sum(1)
                whole = brief and not other.bound_to_recording
                beside += (1.0 if whole else share) * gained[k] * float(where @ felt) / total[k]
        least = max(ACCEPT, beside)
        if isinstance(term.effect, ExternalContact):
            beyond = total[i] * (1 - where.max())
            if beyond < max(SECOND_JOINT * total[i], 0.5 * ACCEPT):
                least = np.inf
        elif gained[i] < least and clears(state, i):
            least = ACCEPT
        out.append(least)
    return out


def are_plain(a: AbstractEffect, b: AbstractEffect) -> bool:
    """Whether two effects are Coulomb's and viscous friction of one joint."""
    return a.joints == b.joints and {called(a), called(b)} == {CoulombFriction.name, ViscousFriction.name}


def clears(state: State, i: int) -> bool:
    """Whether a law of one joint takes away nearly all that the other terms leave there."""
    effect = state.terms[i].effect
    if not isinstance(effect, AbstractJointEffect) or effect.bound_to_recording or effect.name == "unknown":
        return False
    j = effect.joints[0]
    left = [_beyond(d.left[j]) for d in (state.design, without(state, i))]
    return bool(left[1] > UNEXPLAINED and left[0] < CLEARED * left[1])
