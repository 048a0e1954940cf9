"""What a sample of a recording is worth, and what its encoders put into it."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers import record
from mjcf_cases import chain_of
from scipy.interpolate import CubicSpline

from jaxpanda import Arm, Recording
from jaxpanda.arms.export import panda_mjcf
from jaxpanda.effects import Turn, joint_columns
from jaxpanda.effects.friction import FrictionDrift, LoadDependentFriction
from jaxpanda.effects.memory import PreslidingHysteresis
from jaxpanda.effects.motion import Channels
from jaxpanda.effects.sensing import TorqueDrift
from jaxpanda.errors import InputError
from jaxpanda.traces import WORK_RATE, held_sign, prepare, trajectory, work_rate

RATE, NOISE = 500.0, 0.05


def moved(q: np.ndarray, seed: int = 0) -> Recording:
    """The project's Panda with all joints offset by q(t), and torque that is noise."""
    rng, arm = np.random.default_rng(seed), Arm.panda()
    t = np.arange(len(q)) / RATE
    q = 0.5 * np.asarray(arm.lower + arm.upper) + q[:, None] + 1e-5 * rng.normal(size=(len(q), 7))
    return Recording("moved.csv", t, q, tau=NOISE * rng.normal(size=q.shape))


def steps() -> np.ndarray:
    """Two seconds at rest, two of a smooth step, two at rest."""
    x = np.clip((np.arange(int(6 * RATE)) / RATE - 2) / 2, 0, 1)
    return 0.6 * (10 * x**3 - 15 * x**4 + 6 * x**5)


def test_samples_weigh_less_where_known_friction_has_no_known_sign():
    rubs = dataclasses.replace(Arm.panda(), frictionloss=jnp.array([0.5, 0, 0, 0, 0, 0, 0]))
    trace = prepare(moved(steps()), rubs)
    t = trace.motion.time
    assert np.all(trace.trust[(t > 2.4) & (t < 3.6), 0] == 1)  # it moves
    assert np.all(trace.trust[(t < 1.8) | (t > 4.2), 0] < 0.4)  # it rests
    assert np.all(trace.trust[(t < 1.8) | (t > 4.2), 1:] == 1)  # no friction is known there


def test_noise_of_a_joint_at_rest_does_not_wear_away_what_its_bristles_hold():
    q = np.concatenate([steps(), np.full(int(10 * RATE), 0.6)])
    recording = moved(q)
    noise = 2e-5 * np.random.default_rng(3).normal(size=recording.q.shape)
    recording = dataclasses.replace(recording, q=1e-4 * np.round((recording.q + noise) / 1e-4))
    bristles = PreslidingHysteresis(0, 7e-4, "dahl only")
    predicted = trajectory(recording).trace(Arm.panda(), (Turn("distance", 7e-4),) * 7)
    assert np.all(predicted.sign[predicted.channels.t > 5.0, 0] > 0.98)
    for trace in (predicted, prepare(recording, Arm.panda())):
        held = joint_columns([bristles], trace.stretches, trace.dt)[:, 0, 0]
        assert np.all(held[trace.channels.t > 5.0] > 0.98)
        assert np.all(np.abs(held[trace.channels.t < 1.5]) < 0.2)  # nor does it bend any


def test_bristles_turn_where_the_joint_does_however_noisy_its_encoder():
    t = np.arange(int(6 * RATE)) / RATE
    sweeps = 0.3 * np.sin(np.pi * t)
    true = Turn("distance", 1e-3).share(sweeps, np.gradient(sweeps, t))
    recording = moved(sweeps)
    noise = 2e-4 * np.random.default_rng(4).normal(size=recording.q.shape)
    recording = dataclasses.replace(recording, q=recording.q + noise)
    trace = trajectory(recording).trace(Arm.panda(), (Turn("distance", 1e-3),) * 7)
    assert np.all(trace.channels.qd[[0, -1]] != 0)  # at the ends too
    off = trace.sign[:, 0] - np.interp(trace.channels.t, t, true)
    assert np.sqrt(np.mean(off[trace.channels.t > 0.3] ** 2)) < 0.01


def test_samples_weigh_less_where_motion_is_sharper_than_its_filter():
    t = np.arange(int(6 * RATE)) / RATE
    trace = prepare(moved(0.5 * np.abs(np.sin(0.5 * np.pi * t))), Arm.panda())  # speed jumps at 2 s and 4 s
    jump = np.minimum(np.abs(trace.motion.time - 2), np.abs(trace.motion.time - 4))
    assert np.all(trace.trust[jump < 0.02, 0] < 0.2)
    assert np.all(trace.trust[jump > 0.4] == 1)


def test_positions_that_jump_are_no_sharp_motion():
    """Where a row repeats the one before, samples weigh by what the filter leaves of the jump, not by what it
    takes away."""
    t = np.arange(int(6 * RATE)) / RATE
    late = np.cumsum(np.arange(len(t)) == len(t) // 2) / RATE
    arm, truth = Arm.panda(), lambda t: -0.5 * np.pi**2 * np.sin(np.pi * t)
    trace = prepare(moved(0.5 * np.sin(np.pi * (t - late))), arm)
    time = trace.motion.time
    near = np.abs(time - 3) < 0.05
    off = np.abs(trace.motion.qdd[near] - truth(time[near, None] - (time[near, None] >= 3) / RATE)).max()
    torque = NOISE * np.sqrt(1 / trace.trust[near] ** 2 - 1)
    told = (torque / np.abs(trace.motion.mass[near]).sum(2)).max(0)
    assert np.all(told > 0.5 * off), (told, off)
    assert np.all(told < 2 * off), (told, off)
    assert np.all(trace.trust[np.abs(time - 3) > 0.4] == 1)


def test_a_joint_that_never_moves_tells_nothing():
    """Friction at rest may carry its load."""
    recording = moved(steps())
    q = recording.q.copy()
    q[:, 2] = 0.3 + 1e-5 * np.random.default_rng(5).normal(size=len(q))
    trace = prepare(dataclasses.replace(recording, q=q), Arm.panda())
    assert not trace.weights[:, 2].any()
    assert trace.weights[:, [0, 1, 3, 4, 5, 6]].all()


def test_shaken_columns_are_the_inertial_torque_of_fast_accelerations():
    """Their sum over joints and bands is half of M times the acceleration of a vibration, without that of the
    motion; the last, of a sharp motion, is the torque less what it was a row's deviation
    earlier."""
    t = np.arange(int(6 * RATE)) / RATE
    slow, fast = 0.5 * np.sin(2 * np.pi * 0.3 * t), 1e-3 * np.sin(2 * np.pi * 7.0 * t)
    trace = prepare(moved(slow + fast), Arm.panda())
    motion = trace.motion
    vibration = -1e-3 * (2 * np.pi * 7.0) ** 2 * np.sin(2 * np.pi * 7.0 * motion.time)
    expected = motion.mass.sum(2) * vibration[:, None]
    assert trace.shaken.shape == (motion.samples, 7, 15)
    inner = slice(30, -30)
    difference = (2 * trace.shaken[:, :, :14].sum(2) - expected)[inner]
    assert np.sqrt(np.mean(difference**2)) < 0.15 * np.sqrt(np.mean(expected[inner] ** 2))
    assert not trace.shaken[:, :, 14].any()
    trace = dataclasses.replace(trace, sharp=True)
    earlier = CubicSpline(motion.time, motion.load)(motion.time - 1 / RATE / np.sqrt(12))
    apart = motion.load - earlier
    error = (trace.shaken[:, :, 14] - apart)[inner]
    assert np.sqrt(np.mean(error**2)) < 0.1 * np.sqrt(np.mean(apart[inner] ** 2))


def test_long_recordings_are_taken_at_a_lower_rate_together():
    """Six minutes of an arm took 16 GB: as many samples are enough, and motion beyond them is left out."""
    recording = record(0, seconds=80.0, rate=100.0)
    rows = [len(prepare(recording, Arm.panda(), coarse=work_rate([recording] * n)).tau) for n in (1, 2, 9)]
    assert rows == pytest.approx([4000, 2000, 1600], rel=0.05)
    short = [record(0, seconds=20.0)] * 2
    assert work_rate(short) == WORK_RATE
    one_row = Recording("one.csv", np.zeros(1), np.zeros((1, 7)), tau=np.zeros((1, 7)))
    assert work_rate([one_row]) == WORK_RATE  # how short it is says who reads it


@pytest.mark.parametrize("felt", [True, False])
def test_a_diagnosis_keeps_fast_motion_that_the_torque_shows(felt):
    """Of a heavy arm that set out sharply the low-pass of q left 20 times the noise of its torque; but what only
    the encoders show is no motion."""
    t = np.arange(int(12 * RATE)) / RATE
    slow, fast = 2 * np.pi * 0.3, 2 * np.pi * 9.0
    wave, shaken = 0.5 * np.sin(slow * t), 2e-3 * np.sin(fast * t)
    one = moved(wave + shaken)
    noisy = one.q + 2e-4 * np.random.default_rng(1).normal(size=one.q.shape)
    true = -(slow**2) * wave - (fast**2 * shaken if felt else 0.0)
    model = mujoco.MjModel.from_xml_string(panda_mjcf())
    data, torque = mujoco.MjData(model), []
    for q, qd, qdd in zip(one.q, slow * 0.5 * np.cos(slow * t), true, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, qd, qdd
        mujoco.mj_inverse(model, data)
        torque.append(data.qfrc_inverse.copy())
    found = prepare(dataclasses.replace(one, q=noisy, tau=one.tau + np.array(torque)), Arm.panda())
    error = found.motion.qdd - np.interp(found.motion.time, t, true)[:, None]
    assert np.sqrt(np.mean(error**2)) < (0.6 if felt else 0.3) * np.std(fast**2 * shaken)


def test_a_prediction_keeps_motion_that_is_fast_but_above_the_noise_of_q():
    """A diagnosis weighs such samples down; a prediction has to have their torque."""
    t = np.arange(int(8 * RATE)) / RATE
    one = moved(0.5 * np.sin(2 * np.pi * 0.3 * t) + 2e-3 * np.sin(2 * np.pi * 9.0 * t))
    noisy = dataclasses.replace(one, q=one.q + 5e-5 * np.random.default_rng(1).normal(size=one.q.shape))
    fast = -2e-3 * (2 * np.pi * 9.0) ** 2 * np.sin(2 * np.pi * 9.0 * t)
    slow = -0.5 * (2 * np.pi * 0.3) ** 2 * np.sin(2 * np.pi * 0.3 * t)
    qdd = predicted_acceleration(noisy)
    error = (qdd - (slow + fast)[:, None])[100:-100]
    assert np.sqrt(np.mean(error**2)) < 0.6 * np.std(fast)  # 0.99 with the filter of a diagnosis


def test_a_prediction_is_not_shaken_by_rows_that_were_lost():
    """The low-pass stood at 64 Hz on a real arm: what lost rows do to the spectrum of q looked like motion."""
    lost = np.random.default_rng(2).random(int(8 * RATE)) < 0.02
    t = (np.arange(len(lost)) + np.cumsum(lost)) / RATE
    wave = 0.5 * np.sin(2 * np.pi * 0.3 * t)
    true = -((2 * np.pi * 0.3) ** 2) * wave
    qdd = predicted_acceleration(moved(wave))
    error = (qdd - true[:, None])[100:-100]
    assert np.sqrt(np.mean(error**2)) < 0.5 * np.std(true)


def test_a_prediction_is_not_shaken_by_a_coarse_encoder():
    """Also where each joint stands most of the time, so that its noise is not seen."""
    t = np.arange(int(24 * RATE)) / RATE
    turns = (np.floor(t / 3)[:, None] == np.arange(7)) * 0.3 * np.sin(2 * np.pi * t / 3)[:, None] ** 3
    q = 0.5 * np.asarray(Arm.panda().lower + Arm.panda().upper) + turns
    written = dataclasses.replace(moved(0 * t), q=np.round(q / 1.5e-3) * 1.5e-3)
    error = predicted_acceleration(written) - predicted_acceleration(dataclasses.replace(written, q=q))
    assert np.sqrt(np.mean(error**2)) < 0.03  # 0.07 with the filter of a diagnosis


def test_a_prediction_keeps_a_fast_motion_in_the_last_second():
    """Windows of the spectrum that left out what did not fill one put the low-pass below it."""
    t = np.arange(int(9.8 * RATE)) / RATE
    late = np.clip(t - 9.0, 0, None)
    wave = 0.5 * np.sin(2 * np.pi * 0.3 * t) + 0.01 * np.sin(2 * np.pi * 7.0 * late) ** 3
    one = moved(wave)
    noisy = dataclasses.replace(one, q=one.q + 5e-5 * np.random.default_rng(1).normal(size=one.q.shape))
    true = np.gradient(np.gradient(wave, 1 / RATE), 1 / RATE)
    last = (t > 9.1) & (t < 9.7)
    error = (predicted_acceleration(noisy) - true[:, None])[last]
    assert np.sqrt(np.mean(error**2)) < 0.5 * np.std(true[last])


def predicted_acceleration(recording: Recording) -> np.ndarray:
    """On the recording's own times [rad/s²]."""
    trace = trajectory(recording).trace(Arm.panda())
    return np.stack([np.interp(recording.time, trace.motion.time, x) for x in trace.motion.qdd.T], 1)


def test_friction_that_gear_teeth_carry_is_load_dependent_and_directed():
    r"""$F = \mu |\tau + F \operatorname{sign} \dot q|$, solved exactly."""
    rng, mu = np.random.default_rng(0), 0.15
    load, qd = rng.uniform(-20, 20, 400), rng.choice([-1.0, 1.0], 400)
    drives = load * qd > 0
    friction = qd * np.abs(load) * np.where(drives, mu / (1 - mu), mu / (1 + mu))
    wide = lambda x: jnp.zeros((400, 2)).at[:, 0].set(x)
    s = Channels(jnp.zeros(400), wide(0), wide(qd), wide(0), wide(load), wide(load))

    def left(form: str) -> float:
        law = LoadDependentFriction(0, 0.001, 1.0, form)
        A = np.asarray(jax.vmap(law.at)(s))
        c = np.linalg.lstsq(A, friction, rcond=None)[0]
        return float(np.linalg.norm(A @ c - friction) / np.linalg.norm(friction))

    assert left("") > 0.1
    assert left("directed") < 1e-6


@pytest.mark.parametrize(
    "drift", [FrictionDrift(0, 50.0, 0.01, "both", until=10.0), TorqueDrift(0, 50.0, "offset", until=10.0)]
)
def test_a_drift_holds_where_the_recording_ended_before_it_settled(drift):
    at = lambda t: drift.at(Channels(jnp.asarray(t), *(jnp.ones(2),) * 5))
    np.testing.assert_array_equal(at(10.0), at(30.0))
    assert np.abs(at(9.0) - at(10.0)).max() > 1e-3


@pytest.mark.parametrize(
    "drift", [FrictionDrift(0, 5.0, 0.01, "both", until=10.0), TorqueDrift(0, 5.0, "offset", until=10.0)]
)
def test_a_drift_seen_for_its_time_constant_goes_on_to_where_it_settles(drift):
    """Held at what it had come to, the rest of a warm-up was missing from every later motion."""
    at = lambda t: drift.at(Channels(jnp.asarray(t), *(jnp.ones(2),) * 5))
    free = dataclasses.replace(drift, until=1e9)
    for t in (3.0, 10.0, 30.0):
        np.testing.assert_allclose(at(t), free.at(Channels(jnp.asarray(t), *(jnp.ones(2),) * 5)), rtol=1e-12)
    np.testing.assert_allclose(at(30.0)[0], -np.expm1(-6.0), rtol=1e-6)


@pytest.mark.parametrize("form", ["level", "both"])
def test_a_drift_counts_from_where_the_recordings_began_and_was_not_there_before(form):
    """By the clock's own zero, that of Unix left nothing of it in any recording."""
    begun = 1.7e9
    for plain in (FrictionDrift(0, 5.0, 0.01, form), TorqueDrift(0, 5.0, "offset")):
        later = plain.counted_from(begun)
        at = lambda drift, t: drift.at(Channels(jnp.asarray(t), *(jnp.ones(2),) * 5))
        for t in (0.0, 3.0, 40.0):
            np.testing.assert_allclose(at(later, begun + t), at(plain, t), rtol=1e-6)
        np.testing.assert_array_equal(at(later, begun - 40.0), at(later, begun))
        assert "(t - 1700000000)" in later.equation


RUBS = '<joint name="second" axis="0 1 0" armature="0.01" frictionloss="0.3" ref="20"'


@pytest.mark.parametrize(
    ("joint", "before"),
    [
        (RUBS + "/>", ""),
        (RUBS + ' solreffriction="0.004 1" solimpfriction="0.99 0.999 0.001"/>', ""),
        (RUBS + ' solreffriction="0.001 1"/>', ""),  # less than two steps: `refsafe` lifts it
        (RUBS + ' solreffriction="0.003 1"/>', '<option><flag refsafe="disable"/></option>'),
        (RUBS + ' solreffriction="-300 -40" solimpfriction="0.5 0.8 0.01"/>', ""),
        (
            RUBS + ' solreffriction="0.05 1" solimpfriction="0.5 0.8 0"/>',
            "",
        ),  # a width of nothing: their mean
        (RUBS + ' solimpfriction="1 1"/>', ""),  # clipped
        (
            RUBS + ' class="gear"/>',
            '<default><default class="gear"><joint solreffriction="0.03 1" solimpfriction="0.7"/></default>'
            "</default>",
        ),
        (RUBS + "/>", '<default><joint frictionloss="0.1" solimpfriction="0.6 0.9"/></default>'),
    ],
)
def test_known_friction_turns_as_mujoco_has_it_turn(joint, before, tmp_path):
    """The file's own `solreffriction` and `solimpfriction`; MuJoCo's defaults stood for every file."""
    file = tmp_path / "arm.xml"
    file.write_text(chain_of(joint, before=before))
    arm, model = Arm.from_mjcf(file), mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    model.opt.gravity[:] = 0.0
    start = data.qpos.copy()
    states, friction = [], []
    for k in range(2000):
        wanted = start + 0.1 * np.sin(np.array([9e-3, 7e-3]) * k)
        data.qfrc_applied[:] = 40 * (wanted - data.qpos) - 2 * data.qvel
        mujoco.mj_forward(model, data)
        states.append((data.qvel.copy(), data.qacc.copy()))
        friction.append(-data.qfrc_constraint)
        mujoco.mj_step(model, data)
    (qd, qdd), friction = np.moveaxis(np.array(states), 1, 0), np.array(friction)
    share = held_sign(arm, qd, qdd, np.zeros(2))
    turning = np.mean(np.abs(share[:, 1]) < 0.99)
    assert 0.02 < turning < 0.98
    np.testing.assert_allclose(np.asarray(arm.frictionloss) * share, friction, atol=1e-5)


def test_bristles_in_the_place_of_known_friction_take_off_what_the_model_has_of_it():
    """MuJoCo's constraint creeps, on a light joint at any speed: bristles took off a sign of the velocity."""
    rubs = dataclasses.replace(Arm.panda(), frictionloss=jnp.full(7, 2.0))
    trace = prepare(record(0), rubs)
    held, moving = trace.channels.held, np.abs(trace.channels.qd[:, 6]) > 0.05
    assert np.median(np.abs(held[moving, 6])) < 0.5
    only, extra = (
        joint_columns([PreslidingHysteresis(6, 0.01, f"dahl {extent}")], trace.stretches, trace.dt)[:, 0, 0]
        for extent in ("only", "extra")
    )
    np.testing.assert_allclose(held[:, 6] + extra, only, atol=1e-12)


def test_friction_of_an_arm_that_has_no_mass_is_refused():
    arm = dataclasses.replace(Arm.panda(), standard=jnp.zeros((7, 10)), armature=jnp.zeros(7))
    with pytest.raises(InputError, match="mass matrix is singular"):
        held_sign(arm, np.zeros((3, 7)), np.zeros((3, 7)), np.zeros(7))


@pytest.mark.parametrize("wrong", [["a"] * 7, [{"a": 1}] * 7, {"a": 1}])
def test_what_are_no_numbers_in_a_saved_arm_is_refused(wrong):
    """Texts of one letter were taken for a deprecated type of numpy's."""
    with pytest.raises((TypeError, ValueError)):
        Arm.from_json({**Arm.panda().to_json(), "damping": wrong})
