"""A right model validates, a wrong one does not, and no engine leaves anything out in silence."""

import builtins
import dataclasses
import json
import pickle

import mujoco
import numpy as np
import pytest
from helpers import to_mjcf
from numpy.testing import assert_allclose

from jaxpanda import validation
from jaxpanda.arms.arm import Arm
from jaxpanda.arms.export import panda_mjcf
from jaxpanda.arms.panda import published
from jaxpanda.arms.source import from_mjcf
from jaxpanda.errors import InputError
from jaxpanda.friction import Friction
from jaxpanda.recordings import Recording
from jaxpanda.simulation import JointFriction, Sensors, fourier_trajectory, panda_sensors, simulate
from jaxpanda.validation import (
    arm_model,
    assert_mjx_supported,
    assert_versions_belong_together,
    feedback_gains,
    validate,
)

ARM = """<mujoco model="two">
  <option timestep="0.002" integrator="{integrator}"/>
  <worldbody><body name="base" pos="0 0 0.3" euler="20 0 0">
    <body name="upper" pos="0.1 0 0">
      <joint name="shoulder" axis="0 1 0" pos="0.02 0 0" armature="0.05" damping="0.4" {shoulder}/>
      <inertial mass="{mass}" pos="0.2 0.01 -0.1" fullinertia="0.05 0.06 0.04 0.001 0.002 -0.003"/>
      <body name="fore" pos="0.4 0 0" euler="10 20 30">
        <joint name="elbow" axis="0 1 0.2" stiffness="2" springref="15"/>
        <geom type="capsule" size="0.04" fromto="0 0 0 0.3 0 0" mass="1.2"/>
        <body name="hand" pos="0.3 0 0">
          <geom type="box" size="0.03 0.05 0.02" mass="0.4"/>
          <body name="left" pos="0 0.03 0.05"><joint name="left" type="slide" axis="0 1 0"/>
            <geom type="box" size="0.01 0.01 0.03" mass="0.1"/></body>
          <body name="right" pos="0 -0.03 0.05"><joint name="right" type="slide" axis="0 -1 0"/>
            <geom type="box" size="0.01 0.01 0.03" mass="0.1"/></body>
        </body></body></body></body>
    <body name="cube" pos="1 0 0.5"><freejoint/><geom type="box" size="0.02 0.02 0.02"/></body>
  </worldbody>
  <actuator><position joint="shoulder" kp="100" {actuator}/></actuator>
</mujoco>"""
FILLED = {"integrator": "implicitfast", "shoulder": "", "mass": "3", "actuator": ""}


@pytest.fixture(scope="module")
def write(tmp_path_factory):
    """Write the arm with some of it changed, and give its path."""

    def write(**changes: str):
        path = tmp_path_factory.mktemp("model") / "arm.xml"
        path.write_text(ARM.format(**{**FILLED, **changes}), "utf-8")
        return path

    return write


@pytest.fixture(scope="module")
def recorded(write):
    """Recordings of the arm as it is, by the virtual arm: (without, with) friction beyond the file."""
    bare = arm_model(from_mjcf(write())[1])
    motion = fourier_trajectory([[1.0, -0.6], [0.5, 0.9]], [[0.4, 0.8], [-1.0, 0.7]], [0.3, -0.2], 1.7)
    sensors = Sensors(torque_noise=0.01, position_noise=1e-6)
    friction = JointFriction(viscous=0.1, coulomb=np.array([0.5, 0.3]), offset=np.array([0.4, -0.3]))
    return tuple(
        simulate(bare, motion, duration=5.0, sensors=sensors, friction=f, name="motion.csv")
        for f in (None, friction)
    )


@pytest.fixture(scope="module")
def right(write, recorded):
    return validate(write(), [recorded[0]])


def test_nothing_is_factorised_as_sparse(write):
    """MuJoCo 4.0.0 does that wrongly (its issue 3767), whatever the file asks for."""
    path = write()
    path.write_text(path.read_text("utf-8").replace("<option ", '<option jacobian="sparse" '), "utf-8")
    assert arm_model(from_mjcf(path)[1]).opt.jacobian == mujoco.mjtJacobian.mjJAC_DENSE


def test_a_result_can_be_pickled(right):
    assert pickle.loads(pickle.dumps(right)).to_json() == right.to_json()


def test_three_engines_agree_on_inverse_dynamics(right):
    # an arm on a tilted base with oblique axes, a gripper, a loose cube, armature, damping and a spring
    assert right.kernel_vs_mujoco < 1e-10
    assert right.mjx_vs_mujoco < 1e-10
    assert right.agree


def test_the_right_model_explains_the_torque_down_to_the_noise(right):
    assert (right.rmse < 0.01).all()
    assert right.relative_error_percent < 0.2


def test_the_right_model_follows_the_recorded_motion_in_both_engines(right):
    assert (right.mjx.rmse < 2e-3).all()
    assert_allclose(right.mjx.rmse, right.mujoco.rmse, rtol=1e-6)
    assert right.rollout_difference < 1e-9
    assert (right.mjx.feedback_rms < 0.05).all()


def test_a_wrong_mass_shows_in_torque_and_in_motion(write, recorded, right, no_mjx):
    wrong = validate(write(mass="3.6"), [recorded[0]])
    assert wrong.kernel_vs_mujoco < 1e-10
    assert wrong.rmse[0] > 20 * right.rmse[0]
    assert wrong.mujoco.rmse[0] > 20 * right.mujoco.rmse[0]
    assert wrong.mujoco.feedback_rms[0] > 20 * right.mujoco.feedback_rms[0]
    # joint 2 does not carry the changed body, so its torque stays right
    assert_allclose(wrong.rmse[1], right.rmse[1], rtol=1e-6)


def test_friction_beyond_the_file_counts_where_it_is_given(write, recorded, no_mjx):
    parameters = {
        "viscous": np.full(2, 0.1),
        "coulomb": np.array([0.5, 0.3]),
        "offset": np.array([0.4, -0.3]),
    }
    friction = Friction("coulomb_viscous_offset", parameters)
    without = validate(write(), [recorded[1]])
    known = validate(write(), [recorded[1]], friction=friction)
    assert (without.rmse > 0.2).all()
    assert (known.rmse < 0.02).all()
    assert (known.mujoco.rmse < 0.2 * without.mujoco.rmse).all()


def test_frictionloss_in_the_file_counts_as_coulomb_friction(write, recorded, no_mjx):
    offset = Friction(
        "coulomb_viscous_offset",
        {"viscous": np.full(2, 0.1), "coulomb": np.array([0.0, 0.3]), "offset": np.array([0.4, -0.3])},
    )
    held = validate(write(shoulder='frictionloss="0.5"'), [recorded[1]], friction=offset, rollout=False)
    assert (held.rmse < 0.02).all()
    assert held.kernel_vs_mujoco < 1e-10
    assert any("frictionloss" in note for note in held.notes)


@pytest.fixture
def no_mjx(monkeypatch):
    """An environment without MJX; also for tests that need not wait for it."""
    importing = builtins.__import__

    def refuse(name, globals=None, locals=None, fromlist=(), level=0):
        if name.startswith("mujoco.mjx") or (name == "mujoco" and "mjx" in (fromlist or ())):
            raise ImportError("no MJX here")
        return importing(name, globals, locals, fromlist, level)

    monkeypatch.setattr(builtins, "__import__", refuse)


def test_without_mjx_its_fields_are_null_and_a_note_says_why(write, recorded, no_mjx):
    document = validate(write(), [recorded[0]]).to_json()
    assert document["mjx_vs_mujoco"] is None
    assert document["rollout_rmse_rad"] is None
    assert document["rollout"]["mujoco"]["rmse_rad"]
    assert any("no MJX here" in note for note in document["notes"])


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"actuator": 'delay="0.01" nsample="6"'}, "a delay of actuator"),
        ({"actuator": 'damping="2"'}, "damping of actuator"),
        ({"actuator": 'armature="0.3"'}, "armature of actuator"),
        ({"shoulder": 'stiffness="1 0.5"'}, "polynomial stiffness of joint 'shoulder'"),
    ],
)
def test_what_mjx_leaves_out_in_silence_is_refused_by_name(write, changes, said):
    path = write(**changes)
    with pytest.raises(InputError, match=said):
        assert_mjx_supported(mujoco.MjModel.from_xml_path(str(path)))


def test_polynomial_damping_is_refused_by_name(write):
    text = write().read_text("utf-8").replace('damping="0.4"', 'damping="0.4 0.1"')
    with pytest.raises(InputError, match="polynomial damping of joint 'shoulder'"):
        assert_mjx_supported(mujoco.MjModel.from_xml_string(text))


def test_a_plain_model_is_supported_by_mjx(write):
    assert_mjx_supported(mujoco.MjModel.from_xml_path(str(write())))


def test_a_model_that_mjx_would_run_differently_is_checked_in_c_only(write, recorded):
    checked = validate(write(actuator='delay="0.01" nsample="6"'), [recorded[0]])
    assert checked.mjx is None
    assert checked.mujoco is not None
    assert any("a delay of actuator" in note for note in checked.notes)


def test_the_arm_alone_moves_as_in_the_users_file(write):
    source = from_mjcf(write())[1]
    bare = arm_model(source)
    assert (bare.nv, bare.ngeom, bare.nu) == (2, 0, 0)
    data = mujoco.MjData(bare)
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.uniform(-1, 1, (3, 10, 2))
    theirs = validation.mujoco_inverse(source, q, qd, qdd)
    for i in range(10):
        data.qpos, data.qvel, data.qacc = q[i], qd[i], qdd[i]
        mujoco.mj_inverse(bare, data)
        assert_allclose(data.qfrc_inverse, theirs[i], atol=1e-12)


def test_options_of_the_users_file_hold_in_the_rollout(write):
    rk4 = arm_model(from_mjcf(write(integrator="RK4"))[1])
    assert rk4.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    assert rk4.opt.timestep == 0.002
    # MJX has no fully implicit integrator
    implicit = arm_model(from_mjcf(write(integrator="implicit"))[1])
    assert implicit.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST


def test_feedback_gains_come_from_the_recording_only():
    stiffness, damping = feedback_gains(np.array([[1.0, 0.0], [-20.0, 0.0]]))
    assert_allclose(stiffness, [40, 0.04])
    assert_allclose(damping, [4, 0.004])


def test_errors_of_several_recordings_are_pooled(write, recorded, no_mjx):
    both = validate(write(), recorded, rollout=False)
    first, second = both.torque
    assert_allclose(both.rmse, np.sqrt((first.rmse**2 + second.rmse**2) / 2))
    assert first.relative_error_percent < both.relative_error_percent < second.relative_error_percent
    assert both.mujoco is None


def test_the_document_has_the_fixed_fields_and_is_written_whole(right, tmp_path):
    path = right.save(tmp_path / "out")
    assert path.name == "validation.json"
    document = json.loads(path.read_text("utf-8"))
    assert document["schema"] == "jaxpanda.validation/1"
    fixed = ("kernel_vs_mujoco", "mjx_vs_mujoco", "rmse", "relative_error_percent", "rollout_rmse_rad")
    assert all(field in document for field in fixed)
    assert document["rmse"] == right.rmse.tolist()
    assert len(document["rollout_rmse_rad"]) == 2
    assert [p.name for p in path.parent.iterdir()] == ["validation.json"]


def test_bad_input_is_named(write, recorded):
    with pytest.raises(InputError, match="at least one recording"):
        validate(write(), [])
    with pytest.raises(InputError, match=r"motion\.csv: has no torque"):
        validate(write(), [dataclasses.replace(recorded[0], tau=None)])
    one_joint = Recording("one.csv", recorded[0].time, recorded[0].q[:, :1], tau=recorded[0].tau[:, :1])
    with pytest.raises(InputError, match=r"one\.csv: has 1 joints, but the model's arm has 2"):
        validate(write(), [one_joint])
    with pytest.raises(InputError, match="nowhere"):
        validate("nowhere.xml", [recorded[0]])


@pytest.mark.slow
def test_the_panda_validates_in_every_engine(tmp_path):
    arm = Arm.panda()
    path = tmp_path / "panda.xml"
    path.write_text(to_mjcf(arm.chain, arm.standard, 'frictionloss="0.2" damping="0.05"'), "utf-8")
    table = published()["exciting_trajectory"]
    motion = fourier_trajectory(table["a"], table["b"], table["q0"])
    found = validate(path, [simulate(path, motion, duration=4.0, sensors=panda_sensors())])
    assert found.kernel_vs_mujoco < 1e-9
    assert found.mjx_vs_mujoco < 1e-9
    assert found.relative_error_percent < 0.3
    assert found.rollout_difference < 1e-8
    assert (found.mjx.rmse < 0.05).all()


def test_an_mjx_that_is_newer_than_mujoco_is_refused_with_what_mends_it():
    for together in (("3.17.0", "3.17.0"), ("4.0.1", "3.17.0")):
        assert_versions_belong_together(*together)
    with pytest.raises(InputError, match=r"mujoco-mjx 4\.1\.0 needs MuJoCo 4\.1 or newer.*'mujoco>=4\.1'"):
        assert_versions_belong_together("4.0.1", "4.1.0")


def test_what_is_stepped_has_a_dense_jacobian_whatever_its_file_asks_for(tmp_path):
    """MuJoCo 4.0.0 factorises a sparse one wrongly."""
    path = tmp_path / "sparse.xml"
    path.write_text(panda_mjcf().replace("<option ", '<option jacobian="sparse" ', 1))
    source = from_mjcf(path)[1]
    assert source.model.opt.jacobian == mujoco.mjtJacobian.mjJAC_SPARSE
    assert arm_model(source).opt.jacobian == mujoco.mjtJacobian.mjJAC_DENSE
