"""Numbers that every recording of an arm has, whatever was found in it: what a history can be made of.

A finding is there in one recording and not in the next, as chance has it near the threshold; a history of
findings alone would be one of chance. So the same few laws are fitted to every recording: viscous and Coulomb
friction and a constant at each joint, and a body at the flange, all at once, beside what the model's numbers may
be off. They are corrections to the user's model, with deviations as the diagnosis makes them
(`search.uncertainty`). What a recording does not tell is left out.
"""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from ..diagnosis import Diagnosis
from ..effects import AbstractEffect
from ..effects.friction import CoulombFriction, ViscousFriction
from ..effects.load import Payload
from ..effects.sensing import TorqueOffset
from ..inference.knowledge import Knowledge
from ..inference.problem import Problem
from ..inference.state import independent, places, with_terms
from ..search.premises import pose
from ..search.uncertainty import covariances

TURNS = 0.02
"""Speed over which the Coulomb level builds up [rad/s]."""
_WIDE = 10.0
"""Deviation of a level before the recording, as a multiple of the torque that moves the joint."""
_MASS = 30.0
"""Deviation of the mass at the flange before the recording, in `Coefficient.scale`; of its shape, a tenth."""
_TOLD = 0.1
"""Share of the deviation before the recording that may be left of it after: what is more was not told."""


@dataclasses.dataclass(frozen=True)
class Estimate:
    """One number of one recording."""

    quantity: str
    """An effect's name, with the parameter's where the effect has several; or an error's."""
    joint: int | None
    """1-based; None where it belongs to none."""
    value: float
    std: float
    unit: str

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def estimates(found: Diagnosis, knowledge: Knowledge) -> list[Estimate]:
    """Levels, errors and coefficients of the laws that were found, of the recordings in question.

    Args:
        found: a diagnosis.
        knowledge: of the model's numbers, as it was given; not what the recordings made of it, for the estimates
            of all recordings to mean the same.
    """
    return [*_levels(found, knowledge), *_errors(found), *_coefficients(found)]


def _levels(found: Diagnosis, knowledge: Knowledge) -> list[Estimate]:
    whole = found.problem
    traces = tuple(t for t, on in zip(whole.traces, whole.active, strict=True) if on)
    same = whole.saturation if len(traces) == len(whole.traces) else None
    problem = pose(traces, (True,) * len(traces), knowledge, saturated=same).problem
    arm = problem.arm
    laws: list[AbstractEffect] = [
        law
        for j in range(arm.dof)
        if any(t.trust[:, j].any() for t in traces) and problem.saturation.tells(j)
        for law in (ViscousFriction(j), CoulombFriction(j, TURNS), TorqueOffset(j))
    ]
    laws.append(Payload(arm.dof - 1))
    terms = []
    for law in laws:
        columns = problem.full_columns(law)
        wide = _prior(law, problem, columns)
        if np.all(np.isfinite(wide)):
            terms.append(problem.term(law, wide))
    state = with_terms(problem, terms)
    return [
        one
        for term, place, C in zip(terms, places(state), covariances(problem, state), strict=True)
        for one in _told(term.effect, term.deviation, state.design.x[place], C, problem)
    ]


def _prior(
    law: AbstractEffect, problem: Problem, columns: list[Float[np.ndarray, "_time dof n"]]
) -> Float[np.ndarray, " n"]:
    """Deviations of a law's coefficients before the recording; infinite where nothing shows it."""
    if isinstance(law, Payload):
        scales = np.array([c.scale or 1.0 for c in law.coefficients])
        return _MASS * scales * np.where(np.arange(len(scales)) == 0, 1.0, 0.1)
    j = law.joints[0]
    moved = np.concatenate([t.tau[:, j] for t in problem.traces if t.tau is not None])
    shown = np.sqrt(np.mean(np.concatenate([c[:, j] for c in columns]) ** 2, 0))
    torque = max(float(np.sqrt(np.mean(moved**2))), float(problem.noise(()).std[j]))
    return np.where(shown > 0, _WIDE * torque / np.maximum(shown, 1e-300), np.inf)


def _told(
    law: AbstractEffect,
    prior: Float[np.ndarray, " n"],
    c: Float[np.ndarray, " n"],
    covariance: Float[np.ndarray, "all all"],
    problem: Problem,
) -> list[Estimate]:
    """The first coefficient, where the recording tells it."""
    std = float(np.sqrt(max(covariance[0, 0], 0.0)))
    if not 0 < std < _TOLD * prior[0] or not np.isfinite(c[0]):
        return []
    unit = law.unit(law.coefficients[0].unit, problem.arm)
    joint = None if isinstance(law, Payload) else law.joints[0] + 1
    return [Estimate(law.name, joint, float(c[0]), std, unit)]


def _errors(found: Diagnosis) -> list[Estimate]:
    r"""Held-out error at each joint of the user's model and of the corrected one, rms.

    Of the rms of n independent normal errors the deviation is its $1/\sqrt{2n}$; of correlated ones, as many
    count as tell of their mean square.
    """
    problem, out = found.problem, []
    before, after = [], []
    for r, (e, counts), on in zip(problem.residual, found.held_out, problem.active, strict=True):
        if on:
            before.append(np.where(counts[:, None], r, 0.0))
            after.append(np.where(counts[:, None], e, 0.0))
    active = [t for t, on in zip(problem.traces, problem.active, strict=True) if on]
    moved = np.any([t.trust.any(0) for t in active], 0)
    for name, parts in (("error_of_model", before), ("held_out_error", after)):
        errors = np.concatenate(parts)
        count = independent(errors)
        rms = np.sqrt(np.sum(errors**2, 0) / max(np.count_nonzero(np.any(errors, 1)), 1))
        for j in np.flatnonzero(moved & (rms > 0) & (count >= 1)):
            std = float(rms[j] / np.sqrt(2 * count[j]))
            out.append(Estimate(name, int(j) + 1, float(rms[j]), std, problem.arm.unit("N·m", int(j))))
    return out


def _coefficients(found: Diagnosis) -> list[Estimate]:
    """Of laws that act throughout; of what acts twice at a place, neither: they would be mixed up."""
    told: dict[tuple[str, int | None], list[Estimate]] = {}
    for finding in found.findings:
        if finding.intervals is not None or finding.effect == "unknown":
            continue
        for p in finding.parameters:
            std = p.get("std")
            if std is None or not std > 0 or not np.isfinite(p["value"]) or not np.isfinite(std):
                continue
            name = f"{finding.effect}.{p['name']}"
            one = Estimate(name, p.get("joint"), float(p["value"]), float(std), str(p["unit"]))
            told.setdefault((name, one.joint), []).append(one)
    return [many[0] for many in told.values() if len(many) == 1]
