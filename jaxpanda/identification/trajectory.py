"""Identification from recordings of a moving arm: classical, and in one step to feasible links."""

import dataclasses
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels.batched import mass_matrix
from jaxtyping import Bool, Float

from ..arms.arm import Arm
from ..errors import InputError, require_x64
from ..feasible import Bounds, Constraint
from ..friction import LINEAR, MODELS, Friction, check_model
from ..parameters import Base, arm_base_parameters, triangle
from ..recordings import Recording
from ..signals import Signals, blocks_many, prepare, repeatability
from .condensed import Condensed, Evidence
from .one_step import PRIOR, Prior, feasible_least_squares
from .regression import (
    Fit,
    Masks,
    Regression,
    doubting_rest,
    everything,
    excited,
    least_squares,
    regression,
)
from .result import RELIABLE, Identification, check_folds, of_model
from .sigmoid import Shape, fit_shape, linearised, with_shape
from .statistics import covariances, determined

STARTS = 16
"""Starts of the one-step fit, the nominal links first: its problem has one basin, so that few are enough."""
_POSES = 100  # of a recording, in which the inertia at a joint is averaged
_SHAPE_ROUNDS = 2  # the sigmoid's shape depends on the joints' weights, and these on the shape


def identify(
    recordings: Recording | Sequence[Recording],
    arm: Arm,
    *,
    method: str = "trajectory",
    friction: str = "coulomb_viscous_offset",
    weighting: str = "joint",
    cutoff: float = 5.0,
    folds: int = 5,
    bounds: Bounds | None = None,
    constraints: Sequence[Constraint] = (),
    prior: float = PRIOR,
    starts: int = STARTS,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Identification:
    """Base parameters and friction of an arm from recordings of its motion and torque.

    What the arm's model holds beyond rigid links (armature, damping, frictionloss, springs) counts as known:
    the friction found comes on top of it.

    Args:
        recordings: one or more, of the same arm.
        arm: for its geometry and what is known.
        method: `trajectory`, classical least squares in base parameters, or `one_step`, link parameters that
            could be built straight from torque.
        friction: a model of `jaxpanda.friction`.
        weighting: `joint`, each joint by its residual, or `none`.
        cutoff: of the zero-phase low-pass on both sides [Hz].
        folds: of the cross-validation; blocks never split a repeat of the motion. 0 leaves it out.
        bounds: of the links' parameters (`one_step`); published ones for the Panda, else around the arm's.
        constraints: further ones (`one_step`), as functions of `jaxpanda.feasible.Links`.
        prior: how far links are expected from the arm's nominal ones, as a share of them (`one_step`);
            infinite for no expectation.
        starts: random starts of the one-step fit.
        seed: of those starts.
        progress: called with (fits done, fits).

    Raises:
        InputError: bad recordings or an unknown option.
    """
    require_x64("identification")
    check_model(friction)
    for name, value, known in (
        ("method", method, ("trajectory", "one_step")),
        ("weighting", weighting, ("joint", "none")),
    ):
        if value not in known:
            raise InputError(f"{name}: {value!r} is none of {', '.join(known)}")
    check_folds(folds)
    recordings = [recordings] if isinstance(recordings, Recording) else list(recordings)
    if not recordings:
        raise InputError("recordings: none given; identification needs at least one")
    signals = [prepare(recording, cutoff=cutoff) for recording in recordings]
    _check_alive(recordings, signals, friction)
    problem = _pose(signals, arm, friction, weighting)
    if method == "one_step":
        bounds = bounds or Bounds.of(arm)
        if bounds.dof != arm.dof:
            raise InputError(f"bounds: of {bounds.dof} links, but the arm {arm.name} has {arm.dof}")
        if not prior > 0:
            raise InputError(f"prior: {prior!r} is no positive share of the nominal parameters")
        expected = Prior.around(arm, bounds, prior)
        options = {"bounds": bounds, "prior": expected, "known": of_model(arm)}
        solver = partial(_feasible, problem, constraints=constraints, starts=starts, seed=seed, **options)
    else:
        solver = partial(_classical, problem)

    tick = progress or (lambda done, total: None)
    tick(0, 1 + folds)
    whole = solver(everything(problem.rigid))
    tick(1, 1 + folds)
    held_out, halves = _cross_validate(problem, solver, folds, tick) if folds else (None, [])
    entire = Condensed.of(whole.regressions, everything(problem.rigid), problem.base.rank)
    return _result(
        problem,
        whole,
        held_out,
        Evidence(entire, tuple(halves)),
        arm,
        method,
        recordings,
        {
            "friction": friction,
            "weighting": weighting,
            "cutoff": cutoff,
            "folds": folds,
            "derivative_cutoff": [s.derivative_cutoff for s in signals],
            "samples": sum(len(s.keep) for s in signals),
            "output_rate": [s.output_rate for s in signals],
            "period": [s.period for s in signals],
        },
    )


def _check_alive(recordings: Sequence[Recording], signals: Sequence[Signals], friction: str) -> None:
    """Refuse a torque sensor that is stuck, and friction where nothing moves.

    At rest friction may carry any load; without any, one pose tells as much of gravity as it shows.
    """
    moves = [s.moves for s in signals]
    for recording, moving in zip(recordings, moves, strict=True):
        constant = recording.tau is not None and np.ptp(recording.tau, axis=0) == 0
        if np.any(stuck := moving & constant):
            raise InputError(
                f"{recording.name}: column tau_{np.argmax(stuck) + 1} never changes while its joint moves, where"
                " measured torque is needed"
            )
    if friction != "none" and not np.any(moves):
        raise InputError(
            f"{', '.join(s.name for s in signals)}: no joint moves; friction at rest may carry any load, so that"
            " identification needs motion"
        )


@dataclasses.dataclass(frozen=True)
class _Problem:
    """All recordings, filtered once."""

    signals: Sequence[Signals]
    rigid: Sequence[Regression]
    """Without friction where its columns are yet to be found, else with it."""
    base: Base
    of_arm: int
    """Rank of the arm itself: as many base parameters as the best motion could tell."""
    friction: str
    weighting: str


@dataclasses.dataclass(frozen=True)
class _Solved:
    """A fit, and the linear problem it solves."""

    fit: Fit
    regressions: Sequence[Regression]
    shape: Shape | None = None
    settings: dict[str, Any] = dataclasses.field(default_factory=dict)
    notes: tuple[str, ...] = ()


_Solver = Callable[[Masks], _Solved]


def _pose(signals: Sequence[Signals], arm: Arm, friction: str, weighting: str) -> _Problem:
    whole = arm_base_parameters(arm)
    linear = friction if friction in LINEAR else "none"
    rigid, base = excited([regression(s, arm, whole, linear) for s in signals], whole)
    rigid = doubting_rest(rigid, base, friction, np.asarray(arm.frictionloss))
    return _Problem(signals, rigid, base, whole.rank, friction, weighting)


def _linear(problem: _Problem, masks: Masks) -> tuple[Sequence[Regression], Shape | None]:
    """The problem with all friction columns, the sigmoid's shape found from the masked samples only."""
    if problem.friction in LINEAR:
        return problem.rigid, None
    shape, regressions = None, problem.rigid
    for _ in range(_SHAPE_ROUNDS):
        sigma = least_squares(regressions, masks, problem.weighting).sigma
        shape = fit_shape(problem.rigid, problem.signals, masks, sigma, shape)
        regressions = with_shape(problem.rigid, problem.signals, shape)
    return regressions, shape


def _classical(problem: _Problem, masks: Masks) -> _Solved:
    regressions, shape = _linear(problem, masks)
    return _Solved(least_squares(regressions, masks, problem.weighting), regressions, shape)


def _feasible(problem: _Problem, masks: Masks, **options: Any) -> _Solved:
    regressions, shape = _linear(problem, masks)
    fit, found = feasible_least_squares(
        regressions, masks, problem.weighting, problem.base, problem.friction, **options
    )
    best = found.best
    settings = {
        "starts": len(found.objective),
        "converged": int(found.converged.sum()),
        "objective": float(found.objective[best]),
        "max_violation": float(found.violation[best]),
    }
    notes = ()
    if found.violation[best] > 0:
        notes = (
            f"no start met every bound and constraint; the best misses one by {found.violation[best]:.2g}",
        )
    return _Solved(fit, regressions, shape, settings, notes)


def _cross_validate(
    problem: _Problem, solver: _Solver, folds: int, tick: Callable[[int, int], None]
) -> tuple[
    list[tuple[Float[np.ndarray, "dof time"], Bool[np.ndarray, " time"]]], list[tuple[Condensed, Condensed]]
]:
    """For each recording, residuals of samples that their fit has not seen, and which samples those are.

    And for each fold what was seen and what was not.
    """
    halves = []
    residuals = [np.zeros_like(r.y) for r in problem.rigid]
    seen = [np.zeros(r.y.shape[1], bool) for r in problem.rigid]
    for k, splits in enumerate(blocks_many(problem.signals, folds)):
        solved = solver([train for train, _ in splits])
        for r, residual, done, (_, test) in zip(solved.regressions, residuals, seen, splits, strict=True):
            residual[:, test] = r.error(solved.fit.x)[:, test]
            done |= test
        train, test = ([split[i] for split in splits] for i in (0, 1))
        halves.append(tuple(Condensed.of(solved.regressions, m, problem.base.rank) for m in (train, test)))
        tick(2 + k, 1 + folds)
    return list(zip(residuals, seen, strict=True)), halves


def _result(
    problem: _Problem,
    solved: _Solved,
    held_out: list[tuple[np.ndarray, np.ndarray]] | None,
    evidence: Evidence,
    arm: Arm,
    method: str,
    recordings: Sequence[Recording],
    settings: dict[str, Any],
) -> Identification:
    fit, base, regressions = solved.fit, problem.base, solved.regressions
    beta = fit.x[: base.rank]
    robust, classical, joint, std, textbook = _uncertainty(problem, solved)
    e = np.concatenate([r.error(fit.x) for r in regressions], 1)
    unseen = unseen_percent = None
    if held_out is not None:
        unseen = np.concatenate([residual[:, done] for residual, done in held_out], 1)
        tau = [r.tau[:, done] for r, (_, done) in zip(regressions, held_out, strict=True)]
        unseen_percent = _percent(unseen, np.concatenate(tau, 1))
    floors = [floor for s in problem.signals if (floor := repeatability(s)) is not None]
    notes = [note for s in problem.signals for note in s.notes] + list(solved.notes)
    if base.rank < problem.of_arm:
        notes.append(f"the motion tells {base.rank} of the arm's {problem.of_arm} base parameters")
    if not np.all(np.isfinite(std[base.rank :])):
        notes.append("the motion does not tell all friction parameters; their standard deviation is null")
    if method == "trajectory":
        notes += _armature_doubts(arm, base.projection, beta, problem.signals)
    repairs = Counter()
    for s in problem.signals:
        repairs.update(s.repairs)
    return Identification(
        method=method,
        projection=base.projection,
        beta=beta,
        reliable=std[: base.rank] <= RELIABLE * np.abs(beta),
        expressions=tuple(base.expressions),
        std=std[: base.rank],
        classical_std=textbook[: base.rank],
        covariance=robust[: base.rank, : base.rank],
        classical_covariance=classical[: base.rank, : base.rank],
        joint_covariance=joint,
        friction=_friction(problem, solved, std, arm.dof),
        standard=fit.phi,
        rank=base.rank,
        condition_number=_condition(regressions),
        relative_error_percent=_percent(e, np.concatenate([r.tau for r in regressions], 1)),
        rmse=np.sqrt(np.mean(e**2, 1)),
        cross_validated_rmse=None if unseen is None else np.sqrt(np.mean(unseen**2, 1)),
        cross_validated_relative_error_percent=unseen_percent,
        noise=np.sqrt(np.mean(np.square(floors), 0)) if floors else None,
        known=of_model(arm),
        evidence=evidence,
        arm=arm.name,
        model=arm,
        link_names=arm.link_names,
        joint_names=arm.joint_names,
        recordings=tuple(recording.name for recording in recordings),
        settings={**settings, **solved.settings},
        repairs=dict(repairs),
        notes=tuple(notes),
    )


def _armature_doubts(
    arm: Arm,
    projection: Float[np.ndarray, "base standard"],
    beta: Float[np.ndarray, " base"],
    signals: Sequence[Signals],
) -> list[str]:
    """A sentence on joints whose armature, which counts as known, is most of the inertia that was recorded:
    perhaps no links that could be built have as little as it leaves."""
    links = (np.linalg.pinv(projection) @ beta).reshape(arm.dof, 10)
    poses = np.concatenate([s.q[:: max(1, len(s.q) // _POSES)] for s in signals])
    M = mass_matrix(arm.chain, jnp.asarray(links), jnp.asarray(poses))
    inertia, armature = np.diagonal(np.asarray(M), axis1=1, axis2=2).mean(0), np.asarray(arm.armature)
    joints = np.flatnonzero((inertia < armature) & (armature > 0))
    if not len(joints):
        return []
    each = [f"{inertia[j]:.2g} beside {armature[j]:.2g} at {arm.joint_names[j]}" for j in joints]
    return [
        f"the model's armature is most of the inertia that was recorded, or more [kg m²]: {', '.join(each)};"
        " if nobody measured it, identify with armature 0, which counts it to the links, or links that could be"
        " built may not explain the torque"
    ]


def _uncertainty(
    problem: _Problem, solved: _Solved
) -> tuple[
    Float[np.ndarray, "n n"],
    Float[np.ndarray, "n n"],
    Float[np.ndarray, "n n"],
    Float[np.ndarray, " n"],
    Float[np.ndarray, " n"],
]:
    """Robust and textbook covariance, the one between them, and the deviations of the first two; infinite where
    the data do not tell."""
    regressions, x = solved.regressions, solved.fit.x
    if solved.shape is not None:
        phi1 = x[problem.base.rank :]
        regressions = linearised(problem.rigid, problem.signals, solved.shape, phi1)
        rates = np.stack([phi1, np.zeros_like(phi1), np.zeros_like(phi1)], -1)  # the residual stays as it is
        x = np.concatenate([x[: problem.base.rank], rates.ravel()])
    robust, classical, joint = covariances(regressions, x, solved.fit.sigma)
    known = determined(regressions, solved.fit.sigma)
    std, textbook = (np.where(known, np.sqrt(np.diag(C)), np.inf) for C in (robust, classical))
    return robust, classical, joint, std, textbook


def _friction(problem: _Problem, solved: _Solved, std: Float[np.ndarray, " n"], dof: int) -> Friction | None:
    names = MODELS[problem.friction]
    if not names:
        return None
    values = solved.fit.x[problem.base.rank :].reshape(dof, -1).T
    if solved.shape is not None:
        values = np.concatenate([values, solved.shape])
    deviations = std[problem.base.rank :].reshape(dof, -1).T
    return Friction(
        problem.friction,
        dict(zip(names, values, strict=True)),
        dict(zip(names, deviations, strict=True)),
    )


def _condition(regressions: Sequence[Regression]) -> float | None:
    """Condition number of the stacked columns, all joints alike; None where a column is zero."""
    columns = np.concatenate([r.A.reshape(-1, r.A.shape[2]) for r in regressions])
    s = np.linalg.svd(triangle(columns), compute_uv=False)
    return float(s[0] / s[-1]) if s[-1] > 1e-14 * s[0] else None


def _percent(e: Float[np.ndarray, "dof time"], tau: Float[np.ndarray, "dof time"]) -> float:
    size = np.linalg.norm(tau)
    return float(100 * np.linalg.norm(e) / size) if size else 0.0
