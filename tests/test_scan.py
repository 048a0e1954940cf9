"""What makes a diagnosis fast changes none of its answers."""

import dataclasses

import jax
import numpy as np
import pytest
import scipy.linalg

from jaxpanda import Arm, Recording, validation
from jaxpanda import signals as signals_
from jaxpanda.arms import arm as arm_
from jaxpanda.effects import Channels, Motion, Stretches, joint_columns
from jaxpanda.effects import effect as effect_
from jaxpanda.effects import motion as motion_
from jaxpanda.effects.drive import TorqueRipple
from jaxpanda.effects.friction import CoulombFriction
from jaxpanda.effects.memory import PreslidingHysteresis
from jaxpanda.inference.problem import Problem
from jaxpanda.search import steps
from jaxpanda.search.events import Proposal
from jaxpanda.search.premises import pose
from jaxpanda.search.shapes import _score
from jaxpanda.traces import prepare


def recording(seed: int, seconds: float, rate: float = 400.0) -> Recording:
    rng, t = np.random.default_rng(seed), np.arange(0, seconds, 1 / rate)
    phase = np.array([0.6, 1.1, 1.9]) * t[:, None]
    q = np.array([0, -0.5, 0, -1.8, 0, 1.6, 0.5]) + np.sin(phase) @ rng.normal(0, 0.2, (3, 7))
    return Recording(f"{seed}.csv", t, q, tau=rng.normal(0, 1.0, q.shape))


@pytest.fixture(scope="module")
def problem() -> Problem:
    traces = tuple(prepare(recording(seed, seconds), Arm.panda()) for seed, seconds in ((0, 4.0), (1, 5.3)))
    return pose(traces, (True, True), "identified").problem


def channels(samples: int) -> Channels:
    rng = np.random.default_rng(samples)
    x = np.cumsum(rng.normal(size=(5, samples, 7)), 1) * 0.003
    return Channels(np.arange(samples) / 500, *x)


def test_a_recording_of_another_length_compiles_nothing_new():
    effects = [PreslidingHysteresis(2, 0.01, "dahl only"), PreslidingHysteresis(3, 0.02, "dahl only")]
    joint_columns(effects, Stretches(channels(4500)), 0.002)
    before = effect_._advance._cache_size()
    for samples in (50, 2048, 5000):
        assert joint_columns(effects, Stretches(channels(samples)), 0.002).shape == (samples, 2, 1)
    assert effect_._advance._cache_size() == before


def test_a_bias_wanders_over_periods_that_a_recording_tells_half_of(problem):
    """In two seconds of a Kinova a bias of 6 s stood for viscous friction."""
    periods = {e.period for g in problem.library if g.name == "torque_drift" for e in g.effects} - {0.0}
    assert periods == {6.0}  # of up to 60; of the longer recording less than 5 s are used


def test_another_arm_with_as_many_joints_compiles_its_dynamics_alone():
    def torques(arm: Arm, samples: int):
        s = channels(samples)
        motion = Motion(arm, s.t, s.q, s.qd, s.qdd, np.zeros_like(s.q))
        validation.torque_rmse(arm, [recording(samples, 4.0)])
        return motion.load, motion.regressor, motion.gravity_columns, motion.wrench_columns, motion.inertia

    shared = (
        motion_._regressor,
        motion_._gravity_columns,
        motion_._wrench_columns,
        arm_._inverse_dynamics,
    )
    arm = Arm.panda()
    torques(arm, 1500)
    before = [program._cache_size() for program in shared]
    other = dataclasses.replace(arm, name="another", joint_names=tuple("abcdefg"), lumped=0.1 * arm.standard)
    torques(dataclasses.replace(other, standard=1.1 * arm.standard, armature=arm.armature + 0.1), 700)
    assert [program._cache_size() for program in shared] == before


@pytest.mark.parametrize("effect", [CoulombFriction(1, 0.01), PreslidingHysteresis(1, 0.01, "jenkins whole")])
def test_columns_by_stretches_are_those_of_the_whole_recording(effect):
    s = channels(20000)
    whole = effect.columns(jax.tree.map(jax.numpy.asarray, s), 0.002)
    assert joint_columns([effect], Stretches(s), 0.002)[:, 0] == pytest.approx(np.asarray(whole), abs=1e-12)


def test_the_low_pass_by_products_is_the_recursive_one(problem: Problem):
    trace = problem.traces[0]
    x = np.sign(np.random.default_rng(0).normal(size=(len(trace.channels.t), 2, 3)))
    expected = signals_.zero_phase(x, trace.cutoff, 1 / trace.dt)[trace.keep]
    assert len(trace.keep) < len(x)
    assert np.max(np.abs(trace.down(x) - expected)) < 1e-9


@pytest.fixture(scope="module")
def rubbing() -> Problem:
    """With friction that the model has, and that may hold any load where a joint turns."""
    arm = dataclasses.replace(Arm.panda(), frictionloss=jax.numpy.full(7, 0.5))
    return pose((prepare(recording(0, 4.0), arm),), (True,), "identified").problem


@pytest.mark.parametrize("slow", [None, np.tile([0.98, 0.7], (7, 1))])
@pytest.mark.parametrize("which", ["problem", "rubbing"])
def test_the_scan_gives_each_shape_the_evidence_that_it_has_alone(which, slow, request):
    problem = request.getfixturevalue(which)
    coulomb = CoulombFriction(3, 0.01)
    terms = (problem.term(coulomb, np.array([0.3])),)
    noise = dataclasses.replace(problem.noise(terms), slow=slow)
    design = problem.design(terms, noise)
    groups = {(g.name, g.joint): g for g in (*problem.library, *problem.catchalls)}
    scanned = problem.scan(design, noise, list(groups.values()))
    for place in (("stribeck_friction", 3), ("torque_drift", 0), ("unknown", 3), ("encoder_offset", None)):
        group = groups[place]
        value, scale, deviation = _score(problem, design, noise, group.effects, group.columns)
        value = value - group.effects[0].form_prior  # which `grids` adds
        assert scanned[id(group)][0] == pytest.approx(value, rel=1e-8, abs=1e-8)
        assert scanned[id(group)][1] == pytest.approx(deviation * scale[:, None], rel=1e-9)


def test_held_out_errors_are_those_of_fits_without_the_block(problem: Problem):
    terms = (problem.term(CoulombFriction(3, 0.01), np.array([0.3])),)
    design = problem.design(terms, problem.noise(terms))
    error = 0.0
    for train, test in problem.folds:
        H, g = np.diag(design.precision), np.zeros(len(design.precision))
        for A, r in zip(design.columns, design.residual, strict=True):
            H, g = H + A[train].T @ A[train], g + A[train].T @ r[train]
        x = scipy.linalg.solve(H, g)
        pairs = zip(design.columns, design.residual, strict=True)
        error += sum(float(np.sum((r[test] - A[test] @ x) ** 2)) for A, r in pairs)
    assert problem.held_out_error(design) == pytest.approx(error, rel=1e-9)


def test_noise_is_estimated_anew_only_where_a_term_acts(problem: Problem):
    term = problem.term(CoulombFriction(3, 0.2), np.array([0.3]))
    without, beside = problem.noise(()), problem.noise((term,))
    assert np.array_equal(np.delete(without.sigma, 3), np.delete(beside.sigma, 3))
    assert without.sigma[3] != beside.sigma[3]


def test_a_term_defends_its_place_with_its_own_shape(problem: Problem):
    """What the scan finds of its kind is not always refined; the term's shape may be likelier by far."""
    state = steps.with_terms(problem, [problem.term(TorqueRipple(3, 33.7, "one"), np.array([1.0, 1.0]))])
    found, _ = steps.instead(problem, state, 0)
    (gained,) = [gained for gained, terms in found if terms == state.terms]
    assert gained == pytest.approx(steps.gains(problem, state)[0])


def test_laws_that_oppose_each_other_are_refused(problem: Problem, monkeypatch):
    """What two laws nearly alike leave of each other is a small torque, and both may be as large as one likes."""
    laws = [TorqueRipple(3, order, "one") for order in (33.7, 33.75)]
    rng, traces = np.random.default_rng(0), []
    for trace, *columns in zip(problem.traces, *map(problem.full_columns, laws), strict=True):
        torque = 100.0 * (columns[0] - columns[1])[:, :, 0] + rng.normal(0, 1e-3, trace.residual.shape)
        traces.append(dataclasses.replace(trace, tau=trace.motion.torque + torque))
    posed = pose(tuple(traces), (True, True), "identified").problem
    large = np.array([100.0, 100.0])
    terms, noise = (posed.term(laws[0], large),), posed.noise(())
    added = Proposal(laws[1], 0.0, 0.0, large, ())
    left = np.concatenate(posed.residual)[:, 3]
    assert np.sqrt(np.mean(left**2)) < 10.0
    chosen = lambda: steps.choices(posed, terms, posed.design(terms, noise), noise, [added])
    assert not chosen()
    monkeypatch.setattr(steps, "LARGEST", np.inf)
    ((gained, _),) = chosen()
    assert gained > 100.0


def test_what_cannot_be_gives_way_to_what_comes_after_it(problem: Problem, monkeypatch):
    """Bristles that damped themselves negatively came first at each joint, so that nothing was added at any:
    Stribeck's friction of four of six joints was not found."""
    noise, size = problem.noise(()), np.array([0.3, 0.3])
    first, second = (TorqueRipple(joint, 33.7, "one") for joint in (3, 1))
    proposals = [
        Proposal(law, evidence, evidence, size, ()) for law, evidence in ((first, 500.0), (second, 5.0))
    ]
    chosen = lambda: steps.choices(problem, (), problem.design((), noise), noise, proposals)
    assert {term.effect.joints for _, (term,) in chosen()} == {(3,)}  # the other is far less likely
    monkeypatch.setattr(steps, "is_possible", lambda term, _: term.effect.joints != (3,))
    assert {term.effect.joints for _, (term,) in chosen()} == {(1,)}


def test_what_a_model_explains_of_a_joints_candidates_takes_its_coefficients_there_alone(problem: Problem):
    terms = [problem.term(CoulombFriction(j, 0.01), np.array([0.3])) for j in (1, 3)]
    design = problem.design(terms, problem.noise(terms))
    Phi = np.random.default_rng(0).normal(size=(len(design.residual[3]), 4, 2))
    b, G = design.in_joint(3, Phi, np.einsum("tma,tmb->mab", Phi, Phi))
    A = design.columns[3]
    for m in range(4):
        left = Phi[:, m].T @ Phi[:, m] - Phi[:, m].T @ A @ design.solve(A.T @ Phi[:, m])
        assert G[m] == pytest.approx(left, rel=1e-9, abs=1e-9)
        assert b[m] == pytest.approx(Phi[:, m].T @ (design.residual[3] - A @ design.x), rel=1e-9, abs=1e-9)


def test_shapes_are_evaluated_once_for_all_premises(problem: Problem):
    wider = pose(problem.traces, problem.active, "rough", shapes=problem.grid).problem
    assert wider.library is problem.library
    (shape,) = problem.columns([CoulombFriction(2, 0.0123)])[:1]
    assert wider.columns([CoulombFriction(2, 0.0123)])[0] == pytest.approx(shape)
    assert wider.grid is problem.grid
