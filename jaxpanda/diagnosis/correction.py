"""Which of the laws that were found the corrected model has, and that model."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from ..arms.arm import Arm, joints_named
from ..corrected import Corrected
from ..effects import AbstractEffect, law_of
from ..inference.problem import Problem, Term
from ..inference.state import State, coefficients, with_terms
from ..prediction.as_recorded import misleading
from ..search.premises import Premises
from ..search.steps import stand_ins, transferable
from ..search.uncertainty import polished
from ..traces import Trajectory


@dataclasses.dataclass(frozen=True)
class Correction:
    """What of a diagnosis the corrected model has."""

    arm: Arm
    premises: Premises
    kept: State
    """The terms that were found and are kept."""
    lasting: tuple[Term, ...]
    """Terms of what healthy recordings show that are kept too."""
    moved: bool
    """Whether the user's numbers were refitted with what was found."""
    lost: tuple[Term, ...] = ()
    """Terms by which torque is predicted no better."""
    doubtful: tuple[Term, ...] = ()
    """Free curves that say little of torque that they were not fitted to."""

    @property
    def model(self) -> Corrected:
        """The arm with the terms and, where there are any or numbers moved, what they leave of the nuisance."""
        problem, premises = self.premises.problem, self.premises
        refitted = self.moved or bool(self.kept.terms)
        x = self.kept.design.x[: problem.nuisance[0].shape[2]] * (1.0 if refitted else 0.0)
        change, damping, level, rotors = premises.changes(x)
        joints = np.flatnonzero(rotors)
        rotor = law_of("armature")
        effects: list[AbstractEffect] = [rotor(int(j), "signed") for j in joints]  # pyright: ignore
        values = [jnp.asarray(rotors[j])[None] for j in joints]
        at = len(x) - sum(len(t.deviation) for t in premises.background)
        for term in premises.background if refitted else ():
            if any(term is t for t in self.lasting):
                effects.append(term.effect)
                values.append(jnp.asarray(x[at : at + len(term.deviation)] * term.deviation))
            at += len(term.deviation)
        recorded = [t.channels for t, on in zip(problem.traces, problem.active, strict=True) if on]
        for i, term in enumerate(self.kept.terms):
            effects.append(term.effect.beyond(recorded))
            values.append(jnp.asarray(coefficients(self.kept, i)))
        shown = problem.traces[0].friction_shown
        return Corrected(
            self.arm,
            jnp.asarray(change),
            jnp.asarray(damping),
            jnp.asarray(level),
            tuple(effects),
            tuple(values),
            friction_shown=None if shown is None else jnp.asarray(shown),
        )

    @property
    def left_out(self) -> list[str]:
        """Sentences about what was found and is not in the model, and why."""
        out = []
        if self.lost:
            out.append(
                "left out of the corrected model, as torque is predicted no better with it where it was not"
                f" fitted, or with all of the motion: {_laws_named(self.lost)}"
            )
        if self.doubtful:
            where = joints_named(sorted({j for t in self.doubtful for j in t.effect.joints}))
            out.append(
                f"left out of the corrected model: the free curve at {where}, which leaves more than half of what"
                " it is fitted to where it was not fitted"
            )
        return out


def correction(
    arm: Arm, premises: Premises, laws: State, motions: Sequence[Trajectory], *, moved: bool
) -> Correction:
    """What the corrected model has of the laws that were found.

    Args:
        arm: as the user gave it.
        premises: under which the laws were found.
        laws: what was found, without discrepancy.
        motions: the recordings in question, by which predictions are tested.
        moved: whether the user's numbers were refitted too.
    """
    problem = premises.problem
    kept = transferable(problem, laws)
    doubtful = stand_ins(problem, kept)
    if doubtful:
        kept = with_terms(problem, _beside(doubtful, kept.terms))
    background = premises.background if kept.terms or moved else ()
    lasting = [t for t, on in zip(premises.background, premises.lasting, strict=True) if background and on]
    made = Correction(arm, premises, kept, tuple(lasting), moved)
    added = [*lasting, *kept.terms]
    if worse := misleading(motions, made.model, len(added)):
        gone = [added[i] for i in worse]
        kept, lasting = with_terms(problem, _beside(gone, kept.terms)), _beside(gone, lasting)
        made = dataclasses.replace(made, kept=kept, lasting=tuple(lasting))
    lost = [*_beside([*kept.terms, *doubtful], laws.terms), *_beside(lasting, background)]
    return dataclasses.replace(made, lost=tuple(lost), doubtful=tuple(doubtful))


def fitted_laws(problem: Problem, state: State) -> State:
    """The laws of a model without discrepancy. Samples where a law may be off count as little as beside it, or in
    full: at each joint as torque is predicted better that nothing was fitted to. Bristles have a law for where a
    joint turns back; Coulomb's friction, which sticks there, has none."""
    each = [t.law for t in state.terms], [t.exact for t in state.terms]
    ways = [polished(problem, with_terms(problem, terms)) for terms in each]
    spread = any(t.effect.drifts for t in state.terms)
    left = [problem.predicted_error(s.design, ways[0].noise, spread=spread)[0] for s in ways]
    better = left[1] < left[0]
    which = [bool(np.all(better[t.acts])) for t in state.terms]
    if len(set(which)) < 2:
        return ways[bool(which) and which[0]]
    terms = [pair[k] for k, *pair in zip(which, ways[0].terms, ways[1].terms, strict=True)]
    return polished(problem, with_terms(problem, terms))


def _laws_named(terms: Sequence[Term]) -> str:
    """Which laws, and of which joints."""
    joints: dict[str, set[int]] = {}
    for term in terms:
        joints.setdefault(term.effect.name.replace("_", " "), set()).update(term.effect.joints)
    where = {law: f" at {joints_named(sorted(of))}" if of else "" for law, of in joints.items()}
    return "; ".join(law + where[law] for law in sorted(where))


def _beside(some: Sequence[Term], terms: Sequence[Term]) -> list[Term]:
    """Terms that are none of some."""
    return [t for t in terms if all(t is not one for one in some)]
