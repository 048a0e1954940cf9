"""Noise of short recordings: a model with everything in it must not take it for structure."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from helpers import excitation
from jaxpanda_kernels import rnea

from jaxpanda import Arm, InputError, Recording
from jaxpanda.diagnosis import diagnose
from jaxpanda.diagnosis.diagnosis import _unheard
from jaxpanda.inference.evidence import Noise, levelled
from jaxpanda.inference.noise import DETAILS, as_sharp_as_shown, borne_out
from jaxpanda.inference.state import _levelled_squares, beyond, mean_squares, slow_errors, start
from jaxpanda.search.premises import pose
from jaxpanda.traces import prepare

ARM = Arm.panda()
LOAD = jax.jit(jax.vmap(lambda q, qd, qdd: rnea(ARM.chain, ARM.standard, q, qd, qdd)))
RATE, NOISE = 1000.0, 0.05


def still_right(seconds: float, seed: int, noise: float = NOISE) -> Recording:
    """The first seconds of a motion, and torque of which nothing is missing."""
    rng, t = np.random.default_rng(seed), np.arange(0, 12, 1 / RATE)
    q, qd, qdd = excitation(ARM, t, seed)
    tau = np.asarray(LOAD(q, qd, qdd)) + noise * rng.normal(size=q.shape)
    count = round(seconds * RATE)
    return Recording("r.csv", t[:count], (q + 1e-5 * rng.normal(size=q.shape))[:count], tau=tau[:count])


def noise_of(seconds: float, seed: int):
    return pose((prepare(still_right(seconds, seed), ARM),), (True,), "exact").problem.noise(())


@pytest.mark.slow
def test_a_simulation_without_noise_is_consistent():
    """Over so little noise a prior was less than what rounding takes off a product: nothing could be solved."""
    t = np.arange(0, 8, 1 / 200)
    for seed, noise in ((0, 1e-6), (1, 0.0)):
        q, *rates = excitation(ARM, t, seed)
        tau = np.asarray(LOAD(q, *rates)) + noise * np.random.default_rng(0).normal(size=q.shape)
        found = diagnose(None, [Recording("simulated.csv", t, q, tau=tau)])
        assert found.verdict == "consistent"


def test_noise_of_a_short_recording_is_that_of_a_long_one():
    long = noise_of(12.0, 0)
    short = [noise_of(2.4, seed) for seed in range(4)]
    sigma = np.mean([n.sigma for n in short], 0)
    np.testing.assert_allclose(sigma, long.sigma, rtol=0.15)
    slow = lambda n: n.sigma / (1 - n.a.sum(1))  # deviation of what is slow, where physics is looked for
    np.testing.assert_allclose(np.mean([slow(n) for n in short], 0), slow(long), rtol=0.35)


@pytest.mark.slow
@pytest.mark.parametrize(("seconds", "seed"), [(1.7, 5), (1.79, 46), (2.0, 0), (2.5, 1), (3.0, 2)])
def test_a_short_recording_raises_no_false_alarm(seconds, seed):
    """At 1.7 s and 1.79 s, chance makes one joint's noise look a third quieter than it is."""
    result = diagnose(None, [still_right(seconds, seed)], knowledge="exact")
    assert (result.verdict, result.findings) == ("consistent", ())


def test_a_joint_with_few_samples_that_tell_gets_a_coarser_model_and_is_judged():
    trace = prepare(still_right(6.0, 0), ARM)
    trust = trace.trust.copy()
    trust[:, 4] = np.where(np.arange(len(trust)) < 90, 1.0, 1e-3)  # as where friction may hold it
    saturation = pose((dataclasses.replace(trace, trust=trust),), (True,), "exact").problem.saturation
    assert all(saturation.tells(j) for j in range(7))
    assert saturation.columns(4).shape[1] < saturation.columns(4, detail=DETAILS[0]).shape[1]
    assert saturation.columns(3).shape == saturation.columns(3, detail=DETAILS[0]).shape


def test_what_other_joints_velocities_do_is_no_noise():
    """A torque by the product of two joints' velocities had passed for noise of several times the size."""
    seed, t = 0, np.arange(0, 12, 1 / RATE)
    _, qd, _ = excitation(ARM, t, seed)
    one = still_right(12.0, seed)
    assert one.tau is not None
    bodies = (3.0 * qd[:, 1] * qd[:, 3] + 1.0 * qd[:, 4])[:, None] * np.eye(7)[0]
    problem = pose((prepare(dataclasses.replace(one, tau=one.tau + bodies), ARM),), (True,), "exact").problem
    np.testing.assert_allclose(problem.noise(()).std, noise_of(12.0, seed).std, rtol=0.1)


def test_too_short_a_recording_is_refused_with_what_would_do():
    with pytest.raises(InputError, match=r"r\.csv: 30 samples .* record longer"):
        diagnose(None, [still_right(1.1, 0)], knowledge="exact")


def test_a_joint_of_which_too_little_counts_is_not_judged_and_that_is_said():
    trace = prepare(still_right(4.0, 0), ARM)
    trust = trace.trust.copy()
    trust[20:, 4] = 0.0
    problem = pose((dataclasses.replace(trace, trust=trust),), (True,), "exact").problem
    assert [problem.saturation.tells(j) for j in range(7)] == [j != 4 for j in range(7)]
    sigma = problem.noise(()).sigma
    assert sigma[4] > 1e6 * np.delete(sigma, 4).max()
    (said,) = _unheard(problem)
    assert said.startswith("too few samples of joint 5 can be used")


def with_slow_errors(seed: int, size: float) -> Recording:
    """A motion, and torque whose model is off by what wanders within a second and a half."""
    right, rng = still_right(12.0, seed), np.random.default_rng([seed, 1])
    keep = np.exp(-1 / (1.5 * RATE))
    steps = rng.normal(size=right.q.shape) * np.sqrt(1 - keep**2)
    error = np.asarray(scipy.signal.lfilter([1.0], [1.0, -keep], steps, axis=0))
    return dataclasses.replace(right, tau=right.tau + size * NOISE * error)


def stop_and_go(seed: int, friction: float) -> Recording:
    """Motion and rests of 1.5 s by turns; the fourth joint's bristles yield by 1 mrad and hold what they held."""
    rng, t = np.random.default_rng(seed), np.arange(0, 24, 1 / RATE)
    w = 2 * np.pi / 3
    going = np.clip(np.sin(w * t), 0, None)
    speed, change = 2 * going**2, 4 * going * w * np.cos(w * t)
    q, along, bend = excitation(ARM, np.cumsum(speed) / RATE, seed)
    qd = along * speed[:, None]
    qdd = bend * (speed**2)[:, None] + along * change[:, None]
    z = np.zeros(len(t))
    for k in range(1, len(t)):
        moved = (q[k, 3] - q[k - 1, 3]) / 1e-3
        z[k] = np.sign(moved) + (z[k - 1] - np.sign(moved)) * np.exp(-abs(moved))
    tau = np.asarray(LOAD(q, qd, qdd)) + NOISE * rng.normal(size=q.shape)
    tau[:, 3] += friction * z
    return Recording("r.csv", t, q + 1e-5 * rng.normal(size=q.shape), tau=tau)


def test_what_a_joint_holds_that_sticks_is_no_noise():
    """To a model that knows where a joint is, and not where it came from, what the joint holds is noise."""
    noise = lambda level: pose((prepare(stop_and_go(3, level), ARM),), (True,), "exact").problem.noise(()).std
    np.testing.assert_allclose(noise(1.0), noise(0.0), rtol=0.5)


@pytest.mark.parametrize(("seed", "level"), [(3, 1.0), (4, 0.3)])
def test_rests_do_not_dilute_what_a_model_leaves_while_its_joint_moves(seed, level):
    """Half of the time friction may hold any load, and samples weigh next to nothing: of what a right model left
    the mean square had been half of the noise's, and errors of a wrong one were not seen."""
    rubs = dataclasses.replace(ARM, frictionloss=jnp.zeros(ARM.dof).at[3].set(level))
    problem = pose((prepare(stop_and_go(seed, level), rubs),), (True,), "exact").problem
    state = start(problem)
    assert state.counts[3] < 0.5 * state.counts[4]
    np.testing.assert_allclose(mean_squares(problem, problem.noise(()), (), state.design.x), 1.0, atol=0.2)


def test_what_is_beyond_noise_is_told_by_the_samples_that_tell():
    weight = np.where(np.arange(4000) < 2500, 0.02, 1.0)
    left = 1.5 * weight * np.random.default_rng(0).normal(size=4000)
    assert beyond([left], float(np.sum(weight**2)), 0.02).scale == pytest.approx(1.5, rel=0.1)


@pytest.mark.parametrize("shape", slow_errors(0.02))
def test_whitening_undoes_what_makes_noise_slow(shape):
    pole, zero = shape
    assert 0 <= zero < pole < 1
    noise = Noise(np.zeros((1, 3)), np.ones(1), np.ones(1), slow=np.array([shape]))
    white = np.random.default_rng(0).normal(size=(2600, 2))
    slow = np.asarray(scipy.signal.lfilter([1, -zero], [1, -pole], white, axis=0))
    counts = ~np.isin(np.arange(2600), [0, 1300, 1500, 1501])  # gaps
    found = noise.level(slow, 0, counts)
    assert not found[~counts].any()
    for part in (slice(1, 1300), slice(1301, 1500), slice(1502, 2600)):
        np.testing.assert_allclose(found[part], levelled(slow[part], (pole, zero))[0], atol=1e-9)
    counts = np.arange(2600) != 1300
    np.testing.assert_allclose(noise.level(slow, 0, counts)[:1300], white[:1300], atol=1e-9)
    assert noise.level(np.ones(2600), 0, counts)[1299] == pytest.approx((1 - pole) / (1 - zero), rel=0.01)


@pytest.mark.parametrize("count", [1, 7, 2600, 9000])
def test_the_likeliest_slow_error_is_that_of_the_least_innovations(count):
    y = np.cumsum(np.random.default_rng(0).normal(size=count))
    each = [y, y[: count // 2 + 1], y[count // 3 :], y[-1:]]
    squares = [sum(np.sum(levelled(part, slow)[0] ** 2) for part in each) for slow in slow_errors(0.02)]
    np.testing.assert_allclose(_levelled_squares(each, 0.02), squares, rtol=1e-9)
    assert not slow_errors(1.5)  # at samples so far apart none is told
    assert beyond([2.0 * y], float(count), 1.5).slow == (0.0, 0.0)


def test_a_slow_error_of_the_model_is_seen_where_there_is_one():
    noise = lambda recording: start(pose((prepare(recording, ARM),), (True,), "exact").problem).noise
    wandering, right = noise(with_slow_errors(0, 4.0)), noise(still_right(12.0, 0))
    assert all(wandering.has_slow(j) for j in range(7))
    assert not any(right.has_slow(j) for j in range(7))
    np.testing.assert_array_less(wandering.sigma, 2 * right.sigma)  # what is fast is as it was


@pytest.mark.slow
def test_slow_errors_of_a_model_are_no_effects():
    """Their size is not known beforehand. Taken for noise as fast as the rest they were drifts, springs and
    ripples at nearly every joint."""
    sure = [
        f
        for seed in range(4)
        for f in diagnose(None, [with_slow_errors(seed, 4.0)], knowledge="exact").findings
        if f.confidence > 0.5 and f.effect != "unknown"
    ]
    assert len(sure) <= 1


def test_an_arm_is_quieter_at_rest_where_it_is():
    rng, still = np.random.default_rng(4), 4000
    t = np.arange(0, 10, 1 / RATE)
    q, qd, qdd = excitation(ARM, t, 4)
    ease = np.clip((np.arange(len(t)) - still) / 2000, 0, 1)
    ease = ease**3 * (10 - 15 * ease + 6 * ease**2)
    q = q[still] + ease[:, None] * (q - q[still])
    qd, qdd = (np.gradient(q, t, axis=0), np.gradient(np.gradient(q, t, axis=0), t, axis=0))
    found = {}
    for share in (1.0, 0.3):
        std = np.where(np.arange(len(t)) < still, share * NOISE, NOISE)
        tau = np.asarray(LOAD(q, qd, qdd)) + std[:, None] * rng.normal(size=q.shape)
        recording = Recording("r.csv", t, q + 1e-6 * rng.normal(size=q.shape), tau=tau)
        found[share] = pose((prepare(recording, ARM),), (True,), "exact").problem.noise(()).quiet
    np.testing.assert_allclose(found[1.0], 1.0, rtol=0.2)
    assert np.all(found[0.3] < 0.5)  # 0.14 of what all have, but for reversals, where nobody is quiet


@pytest.mark.parametrize("share", [0.0, 0.001, 0.01, 0.1, 1.0])
def test_what_laws_are_off_from_sample_to_sample_is_as_much_as_innovations_show(share):
    rng = np.random.default_rng(0)
    off = 300 * np.sin(np.linspace(0, 40, 20_000)) ** 2
    left = rng.normal(size=len(off)) * np.sqrt(1 + share * off)
    told, deviation = borne_out(left, off, np.ones(len(off)))
    assert told == share
    assert deviation * np.std(left) == pytest.approx(1.0, rel=0.03)


@pytest.mark.parametrize("off", [3.0, 3.0 * np.sin(np.linspace(0, 40, 100)) ** 2])
def test_white_noise_bears_out_nothing_that_laws_are_off(off):
    rng = np.random.default_rng(1)
    told = [borne_out(rng.normal(size=100), off * np.ones(100), np.ones(100))[0] for _ in range(400)]
    assert np.mean(np.array(told) > 0) < 0.05


@pytest.mark.parametrize("share", [0.01, 0.1, 1.0])
def test_samples_of_sharp_motion_are_trusted_as_far_as_they_are_right(share):
    """Taken for missing whole, what the filter may have taken away silenced samples of which little was."""
    trace, exact = prepare(still_right(12.0, 0), ARM), prepare(still_right(12.0, 0, 0.0), ARM)
    assert trace.tau is not None
    off = 80 * np.maximum(np.sin(np.linspace(0, 30, len(trace.tau))), 0)[:, None] ** 4 * np.ones(7)
    trust = 1 / np.sqrt(1 + off)
    tau = exact.tau + (trace.tau - exact.tau) * np.sqrt(1 + share * off)
    (shown,) = as_sharp_as_shown([dataclasses.replace(trace, tau=tau, trust=trust, moving=trust)])
    told = shown.too_sharp.max(0) / off.max()
    assert np.all((told >= (1 - 1e-12) * share) & (told < 5 * share))
    noise = lambda t: pose((t,), (True,), "exact").problem.noise(())
    np.testing.assert_allclose(noise(shown).sigma, noise(trace).sigma, rtol=0.15)


def test_trust_in_sharp_samples_leaves_what_friction_may_hold():
    trace = prepare(still_right(3.0, 0), ARM)
    unsure, off = (
        np.full(trace.trust.shape, 50.0),
        np.linspace(0, 9, trace.trust.size).reshape(trace.trust.shape),
    )
    trust = 1 / np.sqrt(1 + unsure + off)
    trust[0] = 0.0  # stuck
    sharp = dataclasses.replace(trace, trust=trust, moving=1 / np.sqrt(1 + off))
    np.testing.assert_allclose(sharp.as_sharp_as(np.ones(7)).trust, trust, atol=1e-12)
    half = sharp.as_sharp_as(np.full(7, 0.5))
    np.testing.assert_allclose(half.trust[1:], 1 / np.sqrt(1 + unsure + off / 2)[1:])
    np.testing.assert_allclose(half.too_sharp, off / 2, atol=1e-12)
    assert not half.trust[0].any()


@pytest.mark.parametrize("seed", [0, 1])
def test_friction_that_the_model_has_too_much_of_is_no_noise(seed):
    """Went wrong: of what it left at reversals 17 times the noise was taken for noise."""
    rubs = dataclasses.replace(ARM, frictionloss=jnp.full(ARM.dof, 20.0))
    noise = pose((prepare(still_right(6.0, seed), rubs),), (True,), "exact").problem.noise(())
    assert noise.std == pytest.approx(noise_of(6.0, seed).std, rel=0.05)
