"""A designed motion keeps every limit by MuJoCo's account and tells more than others."""

import json
import os
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jaxpanda_kernels import regressor

from jaxpanda import Arm
from jaxpanda.__main__ import main
from jaxpanda.arms.source import from_mjcf
from jaxpanda.errors import InputError
from jaxpanda.excitation import excite
from jaxpanda.excitation.design import Fourier, Problem, Task, starts
from jaxpanda.excitation.excite import precision_of, verify
from jaxpanda.files import write_json
from jaxpanda.identification import identify
from jaxpanda.parameters import arm_base_parameters
from jaxpanda.recordings import load, save
from jaxpanda.simulation import FourierTrajectory, JointFriction, Sensors, random_trajectory, simulate
from jaxpanda.workspace.limits import is_franka_panda, limits_of
from jaxpanda.workspace.scene import probes_of, scene_of

ARM = """<mujoco model="three">
  <compiler angle="radian"/>
  <default><joint range="-2.5 2.5" limited="true"/></default>
  <worldbody>
    <geom name="wall" type="box" pos="0.45 0 0.5" size="0.02 0.5 0.5"/>
    <body name="one" pos="0 0 0.4">
      <joint name="first" axis="0 0 1"/>
      <inertial pos="0.02 0 0.1" mass="3" diaginertia="0.03 0.03 0.02"/>
      <geom type="capsule" fromto="0 0 -0.1 0 0 0.1" size="0.05"/>
      <body name="two" pos="0 0 0.2">
        <joint name="second" axis="0 1 0" range="-1.8 1.8"/>
        <inertial pos="0.01 0.02 0.15" mass="2" diaginertia="0.02 0.02 0.01"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.04"/>
        <body name="three" pos="0 0 0.3">
          <joint name="third" axis="0 1 0"/>
          <inertial pos="0.03 -0.01 0.1" mass="1" diaginertia="0.01 0.01 0.004"/>
          <geom type="capsule" fromto="0 0 0 0 0 0.25" size="0.03"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="first" forcerange="-30 30"/>
    <motor joint="second" ctrlrange="-3 3" gear="10"/>
    <general joint="third" gainprm="2" ctrlrange="-5 5"/>
  </actuator>
</mujoco>
"""
SHORT = {"seconds": 4.0, "highest_frequency": 1.0, "rate": 200.0, "count": 4}
CLEARANCE = 0.05


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("excitation") / "three.xml"
    path.write_text(ARM)
    return path


@pytest.fixture(scope="module")
def designed(file):
    return excite(file, **SHORT)


@pytest.fixture(scope="module")
def task(file) -> Task:
    arm, source = from_mjcf(file)
    scene = scene_of(arm, source, CLEARANCE, 0.0)
    base = arm_base_parameters(arm)
    limits = limits_of(arm, source, {}).within(0.05, 0.9)
    columns = base.rank + 9
    sigma = np.array([0.1, 0.2, 0.1])
    fourier = Fourier(4.0, 4)
    return Task(
        arm, base, limits, probes_of(scene, arm), fourier, sigma, 40.0, 1e-6 * np.eye(columns), "logdet"
    )


def test_limits_are_the_actuators_and_what_is_assumed_is_said(file):
    arm, source = from_mjcf(file)
    limits = limits_of(arm, source, {"velocity": [1.0, 2.0, 3.0]})
    np.testing.assert_allclose(limits.torque, [30, 30, 10])
    np.testing.assert_allclose(limits.velocity, [1, 2, 3])
    assert limits.sources["velocity"] == "given"
    assert limits.sources["acceleration"].startswith("assumed, 5 rad/s²")


def test_only_a_panda_gets_the_pandas_limits(file):
    assert is_franka_panda(Arm.panda())
    assert not is_franka_panda(from_mjcf(file)[0])


def test_coefficients_leave_the_arm_at_rest_where_it_starts(task):
    x = np.random.default_rng(0).normal(size=(3, task.fourier.free.shape[1]))
    trajectory = task.fourier.trajectory(x, np.zeros(3))
    _, qd, qdd = trajectory(np.array([0.0, 4.0]))
    np.testing.assert_allclose(qd, 0, atol=1e-12)
    np.testing.assert_allclose(qdd, 0, atol=1e-12)
    assert np.abs(trajectory(np.array([1.0]))[1]).min() > 0.01


@pytest.mark.slow
def test_gradients_are_exact(task):
    evaluate = Problem.of(task).evaluate
    u = jax.tree.map(lambda x: x[0], starts(task, 1, 0))

    def value(u):
        f, g = evaluate(u)
        return f + jnp.sum(g**2)

    both = jax.jit(jax.value_and_grad(value))
    gradient = both(u)[1]
    way = jax.tree.map(lambda x: jnp.cos(jnp.arange(x.size) + 1.0).reshape(x.shape), u)
    step = 1e-5
    ahead, behind = (both(jax.tree.map(lambda a, b, s=s: a + s * b, u, way))[0] for s in (step, -step))
    slope = sum(float(jnp.vdot(gradient[k], way[k])) for k in u)
    assert slope == pytest.approx(float(ahead - behind) / (2 * step), rel=1e-6)


def test_the_stand_ins_are_never_farther_than_mujocos_geoms(file, task):
    arm, source = from_mjcf(file)
    scene = scene_of(arm, source, CLEARANCE, 0.0)
    q = np.random.default_rng(1).uniform(-1.8, 1.8, (200, 3))
    data = mujoco.MjData(scene.model)
    truly = np.array([scene.distances(data, row, scene.pairs, 5.0).min() for row in q])
    guessed = CLEARANCE - np.asarray(task.probes.shortfall(arm.chain, jnp.asarray(q))).max(1)
    near = truly < 0.15
    assert near.sum() > 20
    assert np.all(guessed[near] <= truly[near] + 1e-6)
    assert np.median(truly[near] - guessed[near]) < 0.01


def test_the_motion_keeps_every_limit_by_finite_differences_and_mujoco(designed, file):
    time, q, _, _ = designed.sampled(1000.0)
    rates = [q]
    for _ in range(3):
        rates.append(np.gradient(rates[-1], time, axis=0))
    velocity, acceleration, jerk = (np.abs(x[5:-5]).max(0) for x in rates[1:])
    assert np.all(np.abs(q) <= np.array([2.45, 1.75, 2.45]))
    assert np.all(velocity <= 0.9 * 1.5 + 1e-3)
    assert np.all(acceleration <= 0.9 * 5.0 + 1e-2)
    assert np.all(jerk <= 0.9 * 50.0 + 0.5)
    assert velocity.max() > 0.8 * 1.5  # and uses them
    np.testing.assert_allclose(q[0], q[-1], atol=1e-9)

    model = mujoco.MjModel.from_xml_path(str(file))
    model.geom_margin[:] = (CLEARANCE - 1e-6) / 2
    free = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    data, touching, torque = mujoco.MjData(model), 0, np.zeros(3)
    for states in zip(*designed.sampled(250.0)[1:], strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = states
        model.opt.disableflags = free
        mujoco.mj_inverse(model, data)
        torque = np.maximum(torque, np.abs(data.qfrc_inverse))
        model.opt.disableflags = 0
        mujoco.mj_fwdPosition(model, data)
        touching += data.ncon
    assert np.all(torque <= 0.9 * np.array([30, 30, 10]))
    assert touching == 0
    assert designed.check.closest.distance >= CLEARANCE


def test_a_motion_through_the_wall_is_found_out(designed, file):
    arm, source = from_mjcf(file)
    scene = scene_of(arm, source, CLEARANCE, 0.0)
    still = np.zeros((3, 1))
    at_the_wall = FourierTrajectory(still, still, np.array([0.0, 1.3, 0.0]), 2 * np.pi)
    check = verify(scene, arm, designed.limits, at_the_wall)
    assert check.closest.distance < CLEARANCE
    assert "wall" in check.failed


def test_it_tells_more_than_random_motions_and_as_much_as_it_says(designed, file, task):
    random = [precision_of(task, random_trajectory(file, k, period=4.0, harmonics=4)) for k in range(3)]
    own = precision_of(task, designed.trajectory)
    for other in random:
        assert np.median(own.base / other.base) < 0.8
    time, q, qd, qdd = designed.sampled(100.0)
    arm, rows = task.arm, []
    every = jax.jit(jax.vmap(lambda *state: regressor(arm.chain, *state)))(q[:-1], qd[:-1], qdd[:-1])
    for Y, v in zip(np.asarray(every).reshape(-1, 3, 30), qd[:-1], strict=True):
        F = np.zeros((3, 9))
        for j in range(3):
            F[j, 3 * j : 3 * j + 3] = v[j], np.sign(v[j]), 1.0
        rows.append(np.hstack([Y[:, list(task.base.independent)], F]) / task.sigma[:, None])
    W = np.concatenate(rows) * np.sqrt(40 / (len(time) - 1))
    std = np.sqrt(np.diag(np.linalg.inv(W.T @ W)))
    np.testing.assert_allclose(own.base, std[: task.base.rank], rtol=1e-3)
    unweighted = np.concatenate([r * task.sigma[:, None] for r in rows])
    assert own.conditions["with_friction"] == pytest.approx(np.linalg.cond(unweighted), rel=1e-3)


@pytest.mark.slow
def test_the_next_motion_builds_on_what_an_identification_knows(designed, file, tmp_path, capsys):
    friction = JointFriction(viscous=0.3, coulomb=0.2)
    log = simulate(
        file, random_trajectory(file, 3), duration=4.0, rate=200.0, friction=friction,
        sensors=Sensors(torque_noise=0.05),
    )  # fmt: skip
    save(log, tmp_path / "log.csv")
    identify(load(tmp_path / "log.csv"), Arm.from_mjcf(file), folds=0).save(tmp_path)
    given = ["--seconds", "4", "--highest-frequency", "1", "--rate", "200", "--starts", "4"]
    out = tmp_path / "out"
    earlier = ["--identification", str(tmp_path / "identification.json")]
    assert main(["excite", "--model", str(file), *given, *earlier, "--out", str(out), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document == json.loads((out / "excitation.json").read_text())
    for row in document["parameters"]:
        assert row["std_before"] is None or row["std"] < row["std_before"]
    motion = load(out / "excitation.csv")
    assert motion.tau is None
    assert motion.q.shape == (801, 3)
    points = re.findall(
        r"^- \{positions: \[(.*?)\], velocities", (out / "joint_trajectory.yaml").read_text(), re.M
    )
    assert len(points) == 401
    np.testing.assert_allclose([float(v) for v in points[100].split(",")], motion.q[200], atol=1e-8)


def test_a_ur_program_moves_as_the_motion_does(designed):
    text = designed.ur_script()
    rows = re.findall(r"servoj\(\[(.*?)\], t=0.008", text)
    _, q, _, _ = designed.sampled(125.0)
    np.testing.assert_allclose([[float(v) for v in row.split(",")] for row in rows], q[1:], atol=1e-6)
    assert text.splitlines()[1].startswith("  movej([")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--share", "2"], "--share"),
        (["--velocity", "1", "2"], "--velocity"),
        (["--seconds", "0.5"], "--seconds"),
        (["--highest-frequency", "20"], "--highest-frequency"),
        (["--margin", "3"], "--margin"),
        (["--torque-noise", "0"], "--torque-noise"),
    ],
)
def test_bad_options_are_refused_in_one_line(options, said, file, tmp_path, capsys):
    assert main(["excite", "--model", str(file), "--out", str(tmp_path / "out"), *options]) == 2
    _, err = capsys.readouterr()
    assert said in err
    assert err.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_no_motion_is_written_where_none_keeps_the_limits(file, tmp_path):
    """The wall stands where the arm is."""
    inside = file.read_text().replace('pos="0.45 0 0.5"', 'pos="0.3 0 0.8"').replace("-2.5 2.5", "-0.2 0.2")
    inside = inside.replace('range="-1.8 1.8"', 'range="1.3 1.6"')
    (tmp_path / "inside.xml").write_text(inside)
    with pytest.raises(InputError, match="none of 4 starts"):
        excite(tmp_path / "inside.xml", **SHORT)


def test_an_identification_of_another_arm_is_refused(file, tmp_path):
    table = {"coefficients": [{"terms": {"m1": 1}, "value": 1.0, "std": 0.1}] * 3}
    write_json(tmp_path / "other.json", table)
    with pytest.raises(InputError, match="--identification"):
        excite(file, identification=tmp_path / "other.json", **SHORT)


def test_a_mesh_that_is_a_pipe_is_refused(file, tmp_path):
    os.mkfifo(tmp_path / "pipe.obj")
    mesh = '<asset><mesh name="m" file="pipe.obj"/></asset><worldbody><geom type="mesh" mesh="m"/>'
    (tmp_path / "arm.xml").write_text(ARM.replace("<worldbody>", mesh))
    with pytest.raises(InputError, match="it is a pipe"):
        scene_of(*from_mjcf(tmp_path / "arm.xml"), CLEARANCE, 0.0)


def test_a_motion_replaces_an_earlier_one_and_no_file_of_the_user_s(designed, tmp_path):
    designed.save(tmp_path)
    designed.save(tmp_path)
    (tmp_path / "excitation.csv").write_text("a user's")
    with pytest.raises(InputError, match="was changed since excite wrote it"):
        designed.save(tmp_path)
    assert (tmp_path / "excitation.csv").read_text() == "a user's"
