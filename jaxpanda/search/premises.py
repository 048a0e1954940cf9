"""What a diagnosis starts from, and whether the recordings bear it out.

Two premises come from the user: how well the model's numbers are known, and recordings of the healthy arm.

- What healthy recordings show beyond the model is no news. It is searched for in them alone first, and joins
  what may be refitted: else an effect that may act only in the suspect recordings would be credited with
  explaining half of something that both show.
- Numbers may be known worse than the user says: a model that was identified by a poor motion, without friction,
  or on another arm. `RUNGS` are such suppositions, each with its prior odds; they are compared like everything
  else, and where one is likelier, with whatever effects it makes needless left out, the search is made again.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from ..effects import CATALOGUE, AbstractEffect
from ..inference import knowledge as knowledge_
from ..inference.grid import Grid
from ..inference.noise import Saturation
from ..inference.problem import Problem, Term, posed
from ..inference.state import State, gains, in_noise, likelier, with_terms
from ..traces import Trace
from .steps import laws, search, transferable

RUNGS: tuple[tuple[knowledge_.Knowledge, float, float], ...] = (
    ("identified", 1.0, 0.0),
    ("identified", 8.0, -5.0),
    ("identified", 20.0, -15.0),
    ("rough", 1.0, -50.0),
    ("rough", 5.0, -75.0),
)
"""How well the inertial parameters may be known, the multiple of that uncertainty, and the log prior odds."""


@dataclasses.dataclass(frozen=True)
class Premises:
    """A problem posed, and what it was posed with."""

    problem: Problem
    spread: Float[np.ndarray, "standard n"]
    """Square root of the covariance of the inertial parameters."""
    knowledge: knowledge_.Knowledge
    scale: float = 1.0
    """Multiple of the uncertainty that `knowledge` means."""
    background: tuple[Term, ...] = ()
    """What the healthy recordings show; its columns, each times its deviation, end the nuisance."""
    lasting: tuple[bool, ...] = ()
    """Which laws of the background predict torque that they were not fitted to."""
    notes: tuple[str, ...] = ()

    def changes(self, x: Float[np.ndarray, " n"]) -> tuple[np.ndarray, ...]:
        """What coefficients of the nuisance change: standard parameters, damping, frictionloss and armature."""
        return knowledge_.changes(self.problem.arm, x, self.spread, self.knowledge, self.scale)


def pose(
    traces: tuple[Trace, ...],
    active: tuple[bool, ...],
    knowledge: knowledge_.Knowledge,
    background: Sequence[Term] = (),
    saturated: Saturation | None = None,
    scale: float = 1.0,
    catalogue: tuple[type[AbstractEffect], ...] = CATALOGUE,
    shapes: Grid | None = None,
) -> Premises:
    """The problem of these recordings under what is known; `scale` multiplies the uncertainty of the inertias."""
    arm = traces[0].motion.arm
    nothing = tuple(t.motion.q[:, :, None][:, :, :0] for t in traces)
    empty = Problem(traces, active, nothing, saturated=saturated)
    std = empty.noise(()).std
    spread = scale * knowledge_.inertial_spread(arm, knowledge, std)
    columns, numbers, corrections = knowledge_.nuisance(traces, spread, knowledge, std, scale)
    known = background, empty.saturation, numbers, corrections
    problem = posed(traces, active, columns, *known, catalogue, shapes)
    return Premises(problem, spread, knowledge, scale, problem.background)


def settled(
    traces: tuple[Trace, ...],
    active: tuple[bool, ...],
    knowledge: knowledge_.Knowledge,
    log: list[str],
    scale: float = 1.0,
    catalogue: tuple[type[AbstractEffect], ...] = CATALOGUE,
) -> tuple[Premises, State]:
    """Effects found under premises that the recordings do not contradict."""
    background: tuple[Term, ...] = ()
    lasting: tuple[bool, ...] = ()
    notes: tuple[str, ...] = ()
    healthy = tuple(t for t, on in zip(traces, active, strict=True) if not on)
    if healthy:
        log.append("healthy recordings alone")
        premises, state = settled(healthy, (True,) * len(healthy), knowledge, log, scale, catalogue)
        knowledge, scale, notes = premises.knowledge, premises.scale, premises.notes
        background = tuple(t.exact for t in state.terms if not t.effect.bound_to_recording)
        kept = transferable(premises.problem, with_terms(premises.problem, background))
        lasting = tuple(any(t is k for k in kept.terms) for t in background)
        log.append("suspect recordings beside them")
    premises = pose(traces, active, knowledge, background, scale=scale, catalogue=catalogue)
    premises = dataclasses.replace(premises, lasting=lasting, notes=notes)
    premises, state = _stepped(premises, laws(premises.problem, log), laws, log)
    found = search(premises.problem, log, state)
    if found is state:  # other premises have been tried with it
        return premises, state
    return _stepped(premises, found, lambda problem, *by: search(problem, log, laws(problem, *by)), log)


def _stepped(
    premises: Premises, state: State, find: Callable[..., State], log: list[str]
) -> tuple[Premises, State]:
    """Premises under which the recordings are likelier, and the model that `find` comes to there, as long as
    there are such."""
    while (found := _wider(premises, state)) is not None:
        wider, terms = found
        log.append(f"the model's numbers as {wider.knowledge!r}, {wider.scale:g} times: searched on")
        other = find(wider.problem, log, terms)
        gained = (
            likelier((premises.problem, state), (wider.problem, other)) + _price(wider) - _price(premises)
        )
        log.append(f"which is likelier by {gained:.1f}")
        if gained <= 0:
            break
        premises, state = wider, other
    return premises, state


def _price(premises: Premises) -> float:
    """Log prior odds of what is supposed of the model's numbers."""
    return next((p for k, x, p in RUNGS if (k, x) == (premises.knowledge, premises.scale)), 0.0)


def _wider(premises: Premises, state: State) -> tuple[Premises, tuple[Term, ...]] | None:
    """The supposition under which the recordings are likeliest beside the effects found, if it is a wider one,
    and which of them are needed there."""
    at = [i for i, (k, x, _) in enumerate(RUNGS) if (k, x) == (premises.knowledge, premises.scale)]
    problem = premises.problem
    best, terms, likeliest = None, (), state.score + _price(premises)
    for k, x, price in RUNGS[at[0] + 1 :] if at else ():
        other = pose(
            problem.traces,
            problem.active,
            k,
            premises.background,
            problem.saturation,
            x,
            problem.catalogue,
            problem.grid,
        )
        needed = _needed(other.problem, state)
        if needed.score + price > likeliest:
            best, terms, likeliest = other, needed.terms, needed.score + price
    if best is None:
        return None
    told = f"{best.knowledge!r}"
    told += f", with deviations {best.scale:g} times as large" if best.scale != 1 else ""
    note = f"the recordings contradict that the model's numbers are known as {premises.knowledge!r}"
    # in the place of a step before, which went less far
    others = [one for one in premises.notes if not one.startswith(note)]
    notes = (*others, f"{note}: they were taken as {told}")
    return dataclasses.replace(best, lasting=premises.lasting, notes=notes), terms


def _needed(problem: Problem, state: State) -> State:
    """The terms that make another problem likelier, the weakest dropped first, in the state's noise."""
    terms = list(state.terms)
    while True:
        whole = in_noise(problem, terms, state.noise)
        gained = gains(problem, whole)
        if not terms or min(gained) > 0:
            return whole
        del terms[int(np.argmin(gained))]
