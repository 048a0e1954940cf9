"""The virtual arm obeys its own equation of motion, and its sensors do what they say."""

import ast
import dataclasses
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from helpers import random_bodies, random_chain, to_mjcf
from numpy.testing import assert_allclose

import jaxpanda.simulation
from jaxpanda.arms.arm import Arm
from jaxpanda.arms.panda import published
from jaxpanda.errors import InputError
from jaxpanda.simulation import (
    JointFriction,
    Sensors,
    body_inertias,
    fourier_trajectory,
    panda_sensors,
    perturbed,
    random_trajectory,
    simulate,
)

FRICTION = JointFriction(
    viscous=np.array([0.04, 0.03, 0.07, 0.05, 0.06, 0.03, 0.03]),
    coulomb=np.array([0.26, 0.24, 0.26, 0.55, 0.27, 0.19, 0.26]),
    offset=np.array([-0.17, -0.12, 0.07, -0.18, -0.01, 0.07, 0.01]),
)
PENDULUM = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0" {joint}/>
<inertial mass="2" pos="0 0 -0.5" diaginertia="0.1 0.1 0.1"/></body></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def xml() -> str:
    arm = Arm.panda()
    return to_mjcf(arm.chain, arm.standard)


@pytest.fixture(scope="module")
def exciting():
    table = published()["exciting_trajectory"]
    return fourier_trajectory(table["a"], table["b"], table["q0"])


@pytest.fixture(scope="module")
def perfect(xml, exciting):
    """Six seconds of the Panda without sensor errors."""
    return simulate(xml, exciting, duration=6.0, friction=FRICTION)


def derivatives(q: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """By central differences of eighth order, less four samples at each end."""
    first = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280]) / step
    second = (
        np.array([-1 / 560, 8 / 315, -1 / 5, 8 / 5, -205 / 72, 8 / 5, -1 / 5, 8 / 315, -1 / 560]) / step**2
    )
    windows = np.lib.stride_tricks.sliding_window_view(q, 9, axis=0)
    return q[4:-4], windows @ first, windows @ second


def inverse_dynamics(model: mujoco.MjModel, q, qd, qdd) -> np.ndarray:
    data = mujoco.MjData(model)
    tau = []
    for data.qpos, data.qvel, data.qacc in zip(q, qd, qdd, strict=True):
        mujoco.mj_inverse(model, data)
        tau.append(data.qfrc_inverse.copy())
    return np.array(tau)


def test_recorded_torque_is_what_inverse_dynamics_and_friction_ask_of_the_recorded_motion(xml, perfect):
    q, qd, qdd = derivatives(perfect.q, 1e-3)
    tau = inverse_dynamics(mujoco.MjModel.from_xml_string(xml), q, qd, qdd) + FRICTION.torque(qd)
    # the smallest torque noise of the Panda is thirty times this
    assert np.abs(tau - perfect.tau[4:-4]).max() < 1e-3
    assert np.sqrt(np.mean((tau - perfect.tau[4:-4]) ** 2)) < 1e-4


def test_energy_of_a_recording_is_what_the_joints_put_in(xml, perfect):
    model = mujoco.MjModel.from_xml_string(xml)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    data = mujoco.MjData(model)
    energy = []
    for data.qpos, data.qvel in zip(perfect.q, perfect.qd, strict=True):
        mujoco.mj_forward(model, data)
        energy.append(data.energy.sum())
    power = np.sum(perfect.qd * (perfect.tau - FRICTION.torque(perfect.qd)), 1)
    work = np.concatenate([[0], np.cumsum(power[1:] + power[:-1]) / 2 * 1e-3])
    assert np.ptp(energy) > 10
    assert_allclose(work, energy - energy[0], atol=1e-3)


def test_a_perfect_log_holds_the_velocity_of_its_positions(perfect):
    assert_allclose(derivatives(perfect.q, 1e-3)[1], perfect.qd[4:-4], atol=1e-5)


def test_the_arm_follows_its_reference_but_not_exactly(perfect, exciting):
    error = np.abs(perfect.q - exciting(perfect.time)[0])
    assert error.max() < 0.02
    assert (error.max(0) > 1e-5).all()


def test_the_panda_trajectory_is_the_published_one(exciting):
    q, qd, qdd = exciting(np.linspace(0, 20, 20001))
    limits = published()["joint_limits"]
    assert (q > limits["lower"]).all()
    assert (q < limits["upper"]).all()
    # largest speeds that the published log shows
    assert_allclose(np.abs(qd).max(0), [1.81, 1.58, 1.84, 1.22, 1.53, 1.78, 1.69], rtol=0.06)
    assert_allclose(np.gradient(q, 1e-3, axis=0)[1:-1], qd[1:-1], atol=1e-5)
    assert_allclose(np.gradient(qd, 1e-3, axis=0)[1:-1], qdd[1:-1], atol=1e-5)


def test_a_pendulum_held_still_shows_its_weight_and_its_offset():
    still = fourier_trajectory(np.zeros((1, 1)), np.zeros((1, 1)), [0.5])
    log = simulate(PENDULUM.format(joint=""), still, duration=3.0, friction=JointFriction(offset=0.3))
    # the weight of 2 kg at 0.5 m, where the arm rests after the offset has pushed it aside
    assert_allclose(log.tau[-1, 0], 2 * 9.81 * 0.5 * np.sin(log.q[-1, 0]) + 0.3, rtol=1e-6)
    assert 1e-5 < abs(log.q[-1, 0] - 0.5) < 0.01


def test_friction_that_the_file_holds_is_felt_too():
    swing = fourier_trajectory([[1.0]], [[0.0]], [0.0], 2.0)
    kwargs = {"duration": 1.0, "rate": 500.0}
    model = PENDULUM.format(joint='frictionloss="0.4" damping="0.1"')
    in_file = simulate(model, swing, **kwargs)
    given = simulate(PENDULUM.format(joint=""), swing, friction=JointFriction(0.1, 0.4), **kwargs)
    # the controller knows the damping of its file, so the two motions start a little differently
    assert_allclose(in_file.tau[25:], given.tau[25:], atol=0.02)
    assert np.abs(simulate(PENDULUM.format(joint=""), swing, **kwargs).tau - given.tau).max() > 0.3


def test_a_joint_too_light_for_its_friction_is_named():
    light = PENDULUM.replace('-0.5" diaginertia="0.1 0.1 0.1"', '0" diaginertia="1e-6 1e-6 1e-6"')
    with pytest.raises(InputError, match=r"'hinge', of 1e-06 kg·m² about its axis, rubs by 100 .* armature"):
        simulate(
            light.format(joint='frictionloss="2"'), fourier_trajectory([[1.0]], [[0.0]], [0.0]), duration=1.0
        )


def test_random_trajectories_stay_within_limits_of_any_arm():
    xml = to_mjcf(random_chain(1, 5), random_bodies(1, 5), joint='limited="true" range="-0.4 1.2"')
    one, other = (random_trajectory(xml, seed, speed=1.0, acceleration=3.0) for seed in (0, 1))
    for trajectory in (one, other):
        q, qd, qdd = trajectory(np.linspace(0, 40, 4000))
        assert -0.4 < q.min() < q.max() < 1.2
        assert np.abs(qd).max() < 1.01
        assert np.abs(qdd).max() < 3.03
        assert (np.ptp(q, axis=0) > 0.05).all()
    assert not np.allclose(one.a, other.a)


def test_arms_with_prismatic_joints_can_be_simulated():
    chain = random_chain(6, 4)
    assert chain.prismatic.any()
    assert not chain.prismatic.all()
    xml = to_mjcf(chain, random_bodies(6, 4))
    log = simulate(xml, random_trajectory(xml, 0), duration=1.0, friction=JointFriction(coulomb=0.1))
    q, qd, qdd = derivatives(log.q, 1e-3)
    width = np.where(chain.prismatic, 0.002, 0.02)  # m/s, rad/s
    tau = inverse_dynamics(mujoco.MjModel.from_xml_string(xml), q, qd, qdd) + 0.1 * np.tanh(qd / width)
    assert_allclose(tau, log.tau[4:-4], atol=1e-3)


def test_the_same_seed_gives_the_same_log_and_another_seed_another(exciting, xml):
    logs = [
        simulate(xml, exciting, duration=0.5, sensors=panda_sensors(), seed=seed).tau for seed in (0, 0, 1)
    ]
    assert np.array_equal(logs[0], logs[1])
    assert not np.array_equal(logs[0], logs[2])


@pytest.fixture(scope="module")
def resting():
    """How a pendulum that hangs still is logged: every change in it is the sensors'."""

    def log(**sensors):
        still = fourier_trajectory(np.zeros((1, 1)), np.zeros((1, 1)), [0.0])
        return simulate(PENDULUM.format(joint=""), still, duration=10.0, sensors=Sensors(**sensors))

    return log


def test_torque_noise_has_its_level_and_forgets_in_its_time(resting):
    noise = resting(torque_noise=0.05, torque_correlation_time=2e-3).tau[:, 0]
    assert_allclose(noise.std(), 0.05, rtol=0.05)
    for lag in (1, 2, 4):
        assert_allclose(np.mean(noise[lag:] * noise[:-lag]) / noise.var(), np.exp(-lag / 2), atol=0.05)


def test_readings_are_steps_of_their_resolution(resting):
    log = resting(torque_noise=0.1, torque_resolution=0.0357, position_noise=1e-4, position_resolution=3e-5)
    for values, step in ((log.tau, 0.0357), (log.q, 3e-5)):
        steps = values / step
        assert_allclose(steps, np.round(steps), atol=1e-9)
        assert len(np.unique(np.round(steps))) > 5


def test_logged_velocity_is_late(xml, exciting):
    kwargs = {"duration": 2.0, "friction": FRICTION}
    late = simulate(xml, exciting, sensors=Sensors(velocity_lag=5e-3), **kwargs).qd[200:]
    q, now, _ = derivatives(simulate(xml, exciting, **kwargs).q[196:], 1e-3)
    shifts = range(12)
    errors = [np.mean((late[4 + s : len(q) - 12 + s] - now[4 : len(q) - 12]) ** 2) for s in shifts]
    assert 4 <= np.argmin(errors) <= 6


def test_stamps_jitter_but_keep_their_order(resting):
    log = resting(jitter=5e-4)
    assert (np.diff(log.time) > 0).all()
    assert 2e-4 < np.std(np.diff(log.time)) < 1e-3


def test_missing_rows_are_missing(resting):
    log = resting(missing=0.1)
    assert_allclose(log.samples, 9000, rtol=0.03)
    assert log.time[0] == 0
    assert_allclose(log.time[-1], 9.999)


@pytest.mark.slow
def test_one_fault_less_leaves_the_others_as_they_were(resting):
    both = resting(torque_noise=0.05, position_noise=1e-4)
    one = resting(torque_noise=0.05)
    assert np.array_equal(both.tau, one.tau)
    assert not np.array_equal(both.q, one.q)


def test_a_perturbed_arm_is_another_that_could_be_built(xml):
    nominal = mujoco.MjModel.from_xml_string(xml)
    truth, again, other = perturbed(xml, 0), perturbed(xml, 0), perturbed(xml, 1)
    assert np.array_equal(truth.body_mass, again.body_mass)
    assert not np.array_equal(truth.body_mass, other.body_mass)
    change = truth.body_mass[1:] / nominal.body_mass[1:] - 1
    assert 0.02 < np.abs(change).max() < 0.5
    assert np.array_equal(truth.jnt_axis, nominal.jnt_axis)
    assert_allclose(truth.body_pos, nominal.body_pos)
    for mass, _, I in zip(*body_inertias(truth), strict=True):
        assert mass > 0
        assert np.linalg.eigvalsh(np.trace(I) / 2 * np.eye(3) - I)[0] > 0


def test_a_perturbation_of_no_width_is_the_nominal_arm(xml):
    for theirs, ours in zip(
        body_inertias(mujoco.MjModel.from_xml_string(xml)), body_inertias(perturbed(xml, 0, 0.0)), strict=True
    ):
        assert_allclose(ours, theirs, atol=1e-8)


def test_a_perturbed_arm_can_be_simulated(xml, exciting):
    nominal = simulate(xml, exciting, duration=0.2).tau
    assert np.abs(simulate(perturbed(xml, 0), exciting, duration=0.2).tau - nominal).max() > 0.1


def test_bad_input_is_named(xml, exciting):
    with pytest.raises(InputError, match="7 joints; the model has 1"):
        simulate(PENDULUM.format(joint=""), exciting)
    with pytest.raises(InputError, match=r"no_such_file\.xml cannot be simulated"):
        simulate("no_such_file.xml", exciting)
    with pytest.raises(InputError, match="cannot be simulated"):
        simulate("<mujoco><oops/></mujoco>", exciting)
    with pytest.raises(InputError, match="hinges and slides"):
        simulate(
            PENDULUM.format(joint="").replace("joint", "freejoint").replace('axis="0 1 0"', ""), exciting
        )
    with pytest.raises(InputError, match="fewer than two samples"):
        simulate(xml, exciting, duration=1e-4)
    with pytest.raises(InputError, match="shape"):
        fourier_trajectory([[1.0]], [[1.0, 2.0]], [0.0])


def test_the_simulator_shares_no_code_with_the_analysis():
    tree = ast.parse(Path(jaxpanda.simulation.__file__).read_text("utf-8"))
    imported = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add("." * node.level + (node.module or ""))
    standard = {"copy", "dataclasses", "pathlib", "typing"}
    assert imported - standard == {
        "mujoco",
        "numpy",
        "scipy.interpolate",
        "jaxtyping",
        ".errors",
        ".recordings.recording",
    }


def test_importing_the_simulator_loads_neither_jax_nor_the_kernels():
    code = "import jaxpanda.simulation, sys; print({'jax', 'jaxpanda_kernels'} & set(sys.modules))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "set()"


def test_sensor_defaults_are_perfect(perfect, xml, exciting):
    imperfections = dataclasses.asdict(Sensors())
    assert not any(imperfections.values())
    assert np.array_equal(simulate(xml, exciting, duration=0.1, friction=FRICTION).q, perfect.q[:100])
