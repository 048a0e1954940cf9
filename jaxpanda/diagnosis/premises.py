"""What a diagnosis starts from, and whether the recordings bear it out.

Two premises come from the user: how well the model's numbers are known, and recordings of the healthy arm.

- What healthy recordings show beyond the model is no news. It is searched for in them alone first, and joins
  what may be refitted: else an effect that may act only in the suspect recordings would be credited with
  explaining half of something that both show.
- Numbers may be known worse than the user says: a model that was identified without friction, or on another
  arm, is off by far more than the noise of an identification. If the recordings are likelier by `CONTRADICTION`
  under a wider word of `knowledge`, beside all effects found, the search is repeated with that word. So it is if
  that word alone does better than the inertial parameters of several links that were found to be wrong, or of
  one by less than the noise.
- "Identified" says not by which motion, and a poor one leaves more. If the recordings are as likely with less
  found and `LOOSE` times an identification's uncertainty, that is what is supposed.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..effects.load import InertialParameters, Payload
from . import knowledge as knowledge_
from .noise import Saturation
from .problem import Problem, Term, posed
from .rivals import ACCEPT
from .search import search
from .state import State, gains, places
from .traces import Trace

CONTRADICTION, SHARE = 100.0, 0.03
"""Evidence by which recordings contradict what is said to be known: nats, and as a share of what the effects
explain, whose shapes are never quite right and leave something for any freedom to take."""

LOOSE = 20.0
"""Multiple of the uncertainty of a model that was identified, where its motion excited the arm less."""
_SEVERAL = 2


@dataclasses.dataclass(frozen=True)
class Premises:
    """A problem posed, and what it was posed with."""

    problem: Problem
    spread: Float[np.ndarray, "standard n"]
    """Square root of the covariance of the inertial parameters."""
    knowledge: knowledge_.Knowledge
    background: tuple[Term, ...] = ()
    """What the healthy recordings show; its columns, each times its deviation, end the nuisance."""
    notes: tuple[str, ...] = ()

    def changes(
        self, x: Float[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, "dof 10"], Float[np.ndarray, " dof"], Float[np.ndarray, " dof"]]:
        """What coefficients of the nuisance change: standard parameters, damping and frictionloss."""
        return knowledge_.changes(self.problem.arm, x, self.spread, self.knowledge)


def pose(
    traces: tuple[Trace, ...],
    active: tuple[bool, ...],
    knowledge: knowledge_.Knowledge,
    background: Sequence[Term] = (),
    saturated: Saturation | None = None,
    scale: float = 1.0,
) -> Premises:
    """The problem of these recordings under what is known; `scale` multiplies the uncertainty of the inertias."""
    arm = traces[0].motion.arm
    nothing = tuple(t.motion.q[:, :, None][:, :, :0] for t in traces)
    empty = Problem(traces, active, nothing, saturated=saturated)
    spread = scale * knowledge_.inertial_spread(arm, knowledge, empty.noise(()).std)
    columns = knowledge_.nuisance(traces, spread, knowledge)
    problem = posed(traces, active, columns, background, empty.saturation)
    return Premises(problem, spread, knowledge, problem.background)


def settled(
    traces: tuple[Trace, ...], active: tuple[bool, ...], knowledge: knowledge_.Knowledge, log: list[str]
) -> tuple[Premises, State]:
    """Effects found under premises that the recordings do not contradict."""
    background: tuple[Term, ...] = ()
    notes: tuple[str, ...] = ()
    healthy = tuple(t for t, on in zip(traces, active, strict=True) if not on)
    if healthy:
        log.append("healthy recordings alone")
        premises, state = settled(healthy, (True,) * len(healthy), knowledge, log)
        knowledge, notes = premises.knowledge, premises.notes
        background = tuple(t for t in state.terms if not t.effect.bound_to_recording)
        log.append("suspect recordings beside them")
    looser: tuple[Premises, State] | None = None
    while True:
        premises = dataclasses.replace(pose(traces, active, knowledge, background), notes=notes)
        state = search(premises.problem, log)
        wider = _contradicted(premises, state)
        if wider is None and looser is None:
            looser, wider = _loosened(premises, state, log), _bodiless(premises, state)
        if wider is None:
            return (premises, state) if looser is None or _likelier(premises, state, looser[1]) else looser
        notes = (*notes, f"the recordings contradict that the model's numbers are known as {knowledge!r}:"
                 f" they were taken as {wider!r}")  # fmt: skip
        log.append(notes[-1])
        knowledge = wider


def _loosened(premises: Premises, state: State, log: list[str]) -> tuple[Premises, State] | None:
    """What an identification by a poorer motion leaves to find, if the recordings are likelier with that."""
    if premises.knowledge != "identified" or not state.terms:
        return None
    problem = premises.problem
    loose = pose(problem.traces, problem.active, "identified", premises.background, problem.saturation, LOOSE)
    loose = dataclasses.replace(loose, notes=premises.notes)
    fewer = _needed(loose.problem, state)
    if _credit(fewer) <= _credit(state):
        return None
    if len(fewer.terms) == len(state.terms):
        return loose, fewer
    log.append(f"the model's numbers may have been identified {LOOSE:g} times less well: searched again so")
    other = search(loose.problem, log)
    return None if _likelier(premises, state, other) else (loose, other)


def _likelier(premises: Premises, state: State, other: State) -> bool:
    """Whether the recordings, claims paid for, are likelier by a state than by another, in the other's noise."""
    here = State(state.terms, other.noise, premises.problem.design(state.terms, other.noise))
    return _credit(here) > _credit(other)


def _needed(problem: Problem, state: State) -> State:
    """The terms that still have evidence in another problem, the weakest dropped first."""
    terms = list(state.terms)
    while True:
        whole = State(tuple(terms), state.noise, problem.design(terms, state.noise))
        gained = gains(whole)
        if not terms or min(gained) > ACCEPT:
            return whole
        del terms[int(np.argmin(gained))]


def _credit(state: State) -> float:
    """Evidence, less what every claim must earn [nats]."""
    return state.design.log_evidence - ACCEPT * len(state.terms)


def _contradicted(premises: Premises, state: State) -> knowledge_.Knowledge | None:
    """The wider word, if the recordings are likelier under it beside the effects found, by enough."""
    word = knowledge_.wider(premises.knowledge)
    if word is None:
        return None
    problem = premises.problem
    explained = state.design.log_evidence - problem.design((), state.noise).log_evidence
    other = pose(problem.traces, problem.active, word, premises.background, problem.saturation).problem
    gained = other.design(state.terms, state.noise).log_evidence - state.design.log_evidence
    return word if gained > max(CONTRADICTION, SHARE * explained) else None


def _bodiless(premises: Premises, state: State) -> knowledge_.Knowledge | None:
    """The wider word, if it does better than bodies found to be wrong.

    Several bodies that are not what the model says are one model whose numbers are not known; so is one whose
    difference drowns in the noise.
    """
    word = knowledge_.wider(premises.knowledge)
    bodies = [t for t in state.terms if isinstance(t.effect, InertialParameters | Payload)]
    if word is None or not bodies:
        return None
    if len({t.key for t in bodies}) < _SEVERAL and not _faint(state, bodies[0]):
        return None
    problem = premises.problem
    other = pose(problem.traces, problem.active, word, premises.background, problem.saturation).problem
    others = tuple(t for t in state.terms if all(t is not b for b in bodies))
    return word if other.design(others, state.noise).log_evidence > state.design.log_evidence else None


def _faint(state: State, term: Term) -> bool:
    """Whether a term's torque is below the noise's deviation at every joint."""
    at = places(state)[next(i for i, t in enumerate(state.terms) if t is term)]
    torque = np.concatenate([columns @ state.design.x[at] for columns in term.columns])
    return bool(np.all(np.sqrt(np.mean(torque**2, 0)) < state.noise.std))
