"""Localisation: noise alone shows nothing, however correlated; what is planted shows where it was planted."""

import dataclasses

import numpy as np
import pytest

from jaxpanda import Arm, Recording
from jaxpanda.diagnosis.localise import change_points, localise, since_reversal, unbiased
from jaxpanda.effects import Motion
from jaxpanda.inference.problem import Problem
from jaxpanda.search.premises import pose
from jaxpanda.traces import prepare

AR = np.array([0.7, -0.2, 0.1])
INNOVATION = 0.04


def coloured(rng, shape):
    e = INNOVATION * rng.normal(size=shape)
    for k in range(3, len(e)):
        e[k] += AR @ e[k - 3 : k][::-1]
    return e


@pytest.fixture(scope="module")
def posed():
    """Two Fourier motions whose torque is the model's."""
    arm, traces = Arm.panda(), []
    for seed in range(2):
        rng, t = np.random.default_rng(seed), np.arange(1600) / 100
        w = 2 * np.pi * np.array([0.1, 0.2, 0.35])
        a = rng.normal(0, 0.2, (3, 7)) / np.array([1, 1.5, 2.5])[:, None]
        phase = w[:, None] * t + rng.uniform(0, 6, (3, 1))
        q = 0.5 * np.asarray(arm.lower + arm.upper) + np.sin(phase).T @ a
        qd = (w[:, None] * np.cos(phase)).T @ a
        qdd = -((w**2)[:, None] * np.sin(phase)).T @ a
        tau = Motion(arm, t, q, qd, qdd, np.zeros_like(q)).load
        noisy = q + 1e-6 * rng.normal(size=q.shape)
        traces.append(
            prepare(Recording(f"{seed}.csv", t, noisy, qd=qd, tau=tau + coloured(rng, tau.shape)), arm)
        )
    return pose(tuple(traces), (True, True), "identified").problem


def with_noise(problem: Problem, seed: int, planted=None) -> Problem:
    """Other noise on the same motions, with some torque added to it."""
    rng, traces = np.random.default_rng([7, seed]), []
    for r, trace in enumerate(problem.traces):
        tau = trace.motion.torque + coloured(rng, (trace.motion.samples, 7))
        if planted is not None:
            planted(r, trace.motion, tau)
        traces.append(dataclasses.replace(trace, tau=tau))
    return Problem(tuple(traces), problem.active, problem.nuisance)


def found_in(problem: Problem):
    noise = unbiased(problem, (), problem.noise(()))
    return localise(problem, problem.design((), noise), noise)


@pytest.mark.slow
def test_correlated_noise_shows_nothing_and_its_probabilities_are_uniform(posed):
    """As estimated, the noise is too white: a sixth of the probabilities were below 0.05."""
    results = [found_in(with_noise(posed, seed)) for seed in range(6)]
    assert sum(r.beyond_noise for r in results) <= 1
    p = np.array([one.p for r in results for one in r.regimes])
    assert 0.015 < np.mean(p < 0.05) < 0.09
    assert 0.4 < np.mean(p < 0.5) < 0.6


def test_what_the_saturated_model_took_of_the_noise_is_put_back(posed):
    problem = with_noise(posed, 3)
    estimated = problem.noise(())
    found = unbiased(problem, (), estimated)
    slow = INNOVATION / (1 - AR.sum())
    share = np.median(found.sigma / (1 - found.a.sum(1))) / slow
    assert share == pytest.approx(1.0, abs=0.1)
    assert np.median(estimated.sigma / (1 - estimated.a.sum(1))) / slow < 0.88


def test_white_noise_would_be_the_wrong_yardstick(posed):
    """The same data, tested as if its samples were independent: structure everywhere."""
    problem = with_noise(posed, 0)
    noise = problem.noise(())
    naive = dataclasses.replace(noise, a=np.zeros_like(noise.a), sigma=noise.std)
    assert localise(problem, problem.design((), naive), naive).beyond_noise
    found = found_in(problem)
    assert (found.effective_samples < 0.5 * found.samples).all()


def test_friction_shows_at_its_joint_as_friction(posed):
    def planted(r, motion, tau):
        tau[:, 4] += 0.06 * np.tanh(motion.qd[:, 4] / 0.02)

    shown = [one for one in found_in(with_noise(posed, 1, planted)).regimes if one.beyond]
    assert {one.joint for one in shown} == {4}
    assert max(shown, key=lambda one: one.share).name == "speed, odd"


def test_a_ripple_shows_as_its_order(posed):
    def planted(r, motion, tau):
        tau[:, 2] += 0.05 * np.sin(23 * motion.q[:, 2] + 1.0)

    (order,) = [one for one in found_in(with_noise(posed, 2, planted)).orders if one.beyond]
    assert order.joint == 2
    assert order.order == pytest.approx(23, abs=1.0)
    assert order.amplitude == pytest.approx(0.05, rel=0.3)


def test_late_torque_shows_as_a_lag(posed):
    def planted(r, motion, tau):
        tau[:, 3] += np.interp(motion.time - 0.012, motion.time, motion.torque[:, 3]) - motion.torque[:, 3]

    found = found_in(with_noise(posed, 3, planted)).lags[3]
    assert found.beyond
    assert found.lag == pytest.approx(0.012, abs=4 * found.std)


def test_what_no_lag_explains_has_none_with_a_deviation(posed):
    """A strong spring was told as torque late by 100 ms, give or take 5000 s."""

    def planted(r, motion, tau):
        tau[:, 3] += np.interp(motion.time - 0.25, motion.time, motion.torque[:, 3]) - motion.torque[:, 3]

    found = found_in(with_noise(posed, 3, planted)).lags[3]
    assert (found.beyond, found.lag, found.std) == (True, pytest.approx(0.1), None)


def test_a_push_shows_as_two_change_points_in_its_recording(posed):
    def planted(r, motion, tau):
        tau[:, 5] += 0.3 * ((motion.time > 4) & (motion.time < 6)) * r

    changes = found_in(with_noise(posed, 4, planted)).changes
    assert {(c.joint, c.recording) for c in changes} == {(5, "1.csv")}
    for edge in (4.0, 6.0):
        assert min(abs(c.time - edge) for c in changes) < 0.1


def test_change_points_are_as_rare_in_noise_as_they_claim():
    rng = np.random.default_rng(0)
    heavy = [rng.standard_t(3, size=600) for _ in range(150)]
    assert sum(bool(change_points(x, 0.05)) for x in heavy) <= 13  # 0.05 * 150, and 2 deviations
    x = rng.normal(size=600)
    x[200:260] += 2.0
    (first, last) = [k for k, _ in change_points(x, 0.01)]
    assert abs(first - 200) < 6
    assert abs(last - 260) < 6


def test_distance_since_the_last_reversal_grows_from_zero(posed):
    trace = posed.traces[0]
    away = since_reversal(trace, 0)
    turns = np.flatnonzero(np.diff(np.sign(trace.motion.qd[:, 0]))) + 1
    assert (away[turns[1:] + 4] < 0.02).all()
    assert (away[: turns[0] - 2] > np.ptp(trace.motion.q[:, 0])).all()
