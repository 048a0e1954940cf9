"""What no effect explains: lines in the spectrum of the torque, found where they are and nowhere else."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers import excitation, half_correlated, record, to_mujoco
from jaxpanda_kernels import rnea

from jaxpanda import Arm, Recording
from jaxpanda.diagnosis import diagnose
from jaxpanda.diagnosis.calibration import calibrated
from jaxpanda.diagnosis.diagnosis import fit
from jaxpanda.diagnosis.unnamed import held_off, hum, standing_off, stuck
from jaxpanda.inference.state import start
from jaxpanda.search.events import swinging
from jaxpanda.search.premises import pose
from jaxpanda.signals import prepare
from jaxpanda.traces import prepare as prepare_trace

ARM = Arm.panda()
LOAD = jax.jit(jax.vmap(lambda q, qd, qdd: rnea(ARM.chain, ARM.standard, q, qd, qdd)))
RATE, SECONDS, NOISE = 250.0, 16.0, 0.05


def recording(seed: int = 0, added=lambda t, q, qd: 0.0, name: str = "motion.csv") -> Recording:
    """One motion with coloured noise of the torque, and what is added to it."""
    t = np.arange(0, SECONDS, 1 / RATE)
    q, qd, qdd = excitation(ARM, t, 3)
    rng = np.random.default_rng(100 + seed)
    noise = NOISE * half_correlated(rng, q.shape, 0.9)
    tau = np.asarray(LOAD(q, qd, qdd)) + noise + added(t[:, None], q, qd)
    return Recording(name, t, q + 1e-5 * rng.normal(size=q.shape), qd=qd, tau=tau)


def heard(*recordings: Recording, active: tuple[bool, ...] | None = None):
    return hum([prepare(one) for one in recordings], active or (True,) * len(recordings), np.full(7, NOISE))


def at_joints(amplitude, frequency, *joints):
    where = np.isin(np.arange(7), joints)
    return lambda t, q, qd: amplitude * np.sin(2 * np.pi * frequency * t + 1.0) * where


@pytest.mark.parametrize("frequency", [7.3, 60.02])
def test_a_hum_is_heard_where_it_is_in_and_beyond_the_band(frequency):
    found = heard(recording(added=at_joints(0.1, frequency, 1, 4)))
    assert found is not None
    assert found.joints == (1, 4)
    told = [(p["value"], p["std"]) for p in found.parameters]
    for (value, std), true in zip(told, (frequency, 0.1, 0.1), strict=True):
        assert abs(value - true) < 4 * std
        assert std < 0.05 * true
    np.testing.assert_allclose(found.rms_torque[[1, 4]], 0.1 / np.sqrt(2), rtol=0.1)


def test_its_deviations_hold_the_truth():
    """Of 30 intervals at 95 % at most 5 miss: right ones pass 99.7 times of 100, ones of 65 % 2 times of 100."""
    errors = []
    for seed in range(30):
        found = heard(recording(seed, at_joints(0.08, 31.0 + 0.37 * seed, 2)))
        assert found is not None
        frequency, amplitude = found.parameters
        errors.append(
            [
                (frequency["value"] - 31.0 - 0.37 * seed) / frequency["std"],
                (amplitude["value"] - 0.08) / amplitude["std"],
            ]
        )
    assert np.all(np.sum(np.abs(errors) > 1.96, 0) <= 5)


def test_noise_is_no_hum():
    assert [heard(recording(seed)) for seed in range(12)] == [None] * 12


def test_what_depends_on_the_motion_is_no_hum():
    ripple = lambda t, q, qd: 0.5 * np.sin(160 * q) * (np.arange(7) == 3)
    assert heard(recording(added=ripple)) is None
    rubs = lambda t, q, qd: 2.0 * np.sign(qd)
    assert heard(recording(added=rubs)) is None


@pytest.mark.parametrize(("off", "holds", "told"), [(8.0, 0.0, True), (8.0, 10.0, False), (0.5, 0.0, False)])
def test_a_joint_that_holds_still_is_off_by_no_more_than_friction_carries(off, holds, told):
    """A sensor at its limit on a joint that never moved, 55 times its noise off, had been called consistent."""
    arm = dataclasses.replace(ARM, frictionloss=jnp.zeros(7).at[3].set(holds))
    limit = lambda t, q, qd, qdd: off * np.eye(7)[3] * np.ones_like(q)
    one = record(0, limit, arm=arm, still=[3])
    problem = pose((prepare_trace(one, arm),), (True,), "exact").problem
    found = held_off(problem, start(problem))
    if not told:
        assert found is None
        return
    assert found is not None
    assert (found.effect, found.joints) == ("unknown", (3,))
    assert found.rms_torque[3] == pytest.approx(off, rel=0.05)
    assert found.confidence > 0.9


def test_a_joint_that_stands_off_its_noise_foretells_nothing_and_is_doubted():
    """Models of healthy arms are two to seven times their noise off, which had been told at 0.7."""
    rubs = lambda t, q, qd: 0.2 * np.sign(qd) * (np.arange(7) == 3)
    problem = pose((prepare_trace(recording(added=rubs), ARM),), (True,), "exact").problem
    nothing = start(problem)
    (found,) = standing_off(problem, nothing, ())
    assert (found.effect, found.joints, found.foretold) == ("unknown", (3,), 0.0)
    assert 2 < found.rms_torque[3] / NOISE < 7
    (told,) = calibrated([found], "unexplained", fit(problem, nothing))
    assert told.confidence < 0.4
    (law,) = calibrated([dataclasses.replace(found, foretold=300.0)], "unexplained", fit(problem, nothing))
    assert law.confidence > 0.5


def test_what_a_healthy_arm_hummed_before_is_not_missing():
    hums, healthy = at_joints(0.1, 50.0, 1), recording(1, at_joints(0.1, 50.0, 1), "healthy.csv")
    assert heard(recording(0, hums), healthy, active=(True, False)) is None
    assert heard(recording(0, hums), recording(1, name="healthy.csv"), active=(True, False)) is not None


@pytest.mark.slow
def test_a_diagnosis_says_that_it_hums_beside_what_it_finds(tmp_path):
    from jaxpanda.arms.export import panda_mjcf

    (tmp_path / "arm.xml").write_text(panda_mjcf(), "utf-8")
    rubs, hums = (lambda t, q, qd: 0.5 * np.sign(qd) * (np.arange(7) == 3)), at_joints(0.1, 50.0, 1)
    both = recording(added=lambda t, q, qd: rubs(t, q, qd) + hums(t, q, qd))
    found = diagnose(tmp_path / "arm.xml", [both])
    assert [(one.effect, one.joints) for one in found.findings] == [
        ("coulomb_friction", (3,)),
        ("unknown", (1,)),
    ]
    assert found.verdict == "partly_explained"
    assert "50.0" in found.findings[1].summary


def shaken(frequency: float, size: float, seed: int = 0) -> Recording:
    """A motion on a base that shakes along a slanting line, by MuJoCo."""
    one = recording(seed)
    model = to_mujoco(ARM.chain, ARM.standard)
    data, still = mujoco.MjData(model), model.opt.gravity.copy()
    q, qd, qdd = excitation(ARM, one.time, 3)
    tau = np.zeros_like(q)
    for k, t in enumerate(one.time):
        base = size * np.sin(2 * np.pi * frequency * t + 0.5) * np.array([0.6, -0.5, 0.62])
        model.opt.gravity[:] = still - base
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], qd[k], qdd[k]
        mujoco.mj_inverse(model, data)
        tau[k] = data.qfrc_inverse
    return dataclasses.replace(one, tau=one.tau + tau - np.asarray(LOAD(q, qd, qdd)))


def test_a_base_that_shakes_is_found_at_its_frequency_and_no_other_is():
    def proposed(one: Recording):
        problem = pose((prepare_trace(one, ARM),), (True,), "exact").problem
        state = start(problem)
        return swinging(problem, state.design, state.noise)[0]

    assert proposed(recording()).evidence < 0
    found = proposed(shaken(5.3, 0.2))
    assert found.evidence > 100
    assert float(found.effect.frequency) == pytest.approx(5.3, abs=0.5 / SECONDS)


@pytest.mark.slow
def test_a_diagnosis_says_that_the_base_shakes(tmp_path):
    from jaxpanda.arms.export import panda_mjcf

    (tmp_path / "arm.xml").write_text(panda_mjcf(), "utf-8")
    found = diagnose(
        tmp_path / "arm.xml", [shaken(5.3, 0.2), dataclasses.replace(shaken(5.3, 0.1, 1), name="b")]
    )
    assert [(one.effect, one.joints) for one in found.findings] == [("unknown", tuple(range(7)))]
    assert found.findings[0].recordings == ("motion.csv", "b")
    assert found.findings[0].intervals is None
    told = {p["name"]: p for p in found.findings[0].parameters}
    assert abs(told["frequency"]["value"] - 5.3) < 4 * told["frequency"]["std"]
    size = lambda k: np.linalg.norm(
        [told[f"{w}_{x}_{k}"]["value"] for w in ("sine", "cosine") for x in "xyz"]
    )
    assert [size(1), size(2)] == pytest.approx([0.2, 0.1], rel=0.1)
    assert np.all(found.fit.held_out_rmse_after < 1.2 * found.fit.noise_floor)


def test_a_torque_that_repeats_itself_while_the_arm_moves_is_told_with_its_times():
    one = recording()
    frozen = [(3.0, 3.6), (9.0, 9.5)]
    for begin, stop in frozen:
        inside = (one.time >= begin) & (one.time <= stop)
        one.tau[inside, 1] = one.tau[np.argmax(inside), 1]
    trace = prepare_trace(one, ARM)
    found = stuck(pose((trace,), (True,), "exact").problem, np.full(7, NOISE))
    assert found is not None
    assert (found.effect, found.joints) == ("unknown", (1,))
    np.testing.assert_allclose(found.intervals, frozen, atol=2 / RATE)
    assert found.rms_torque[1] > 3 * NOISE
    for begin, stop in frozen:
        inside = (trace.motion.time > begin) & (trace.motion.time < stop)
        assert not trace.trust[inside, 1].any()
        assert trace.trust[inside, 4].any()


def test_coarse_torque_of_an_arm_at_rest_is_not_stuck():
    t = np.arange(0, SECONDS, 1 / RATE)
    pace = 1 - np.exp(-(((t - 8.0) / 2.0) ** 8))  # stands for some seconds
    clock = np.cumsum(pace) / RATE
    q = excitation(ARM, clock, 3)[0]
    qd = np.gradient(q, t, axis=0)
    tau = 0.5 * np.round(np.asarray(LOAD(q, qd, np.gradient(qd, t, axis=0))) / 0.5)
    assert np.ptp(tau[(t > 7.0) & (t < 9.0)], axis=0).max() == 0.0
    assert prepare_trace(Recording("rest.csv", t, q, tau=tau), ARM).stuck == ()
