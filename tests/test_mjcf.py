"""A user's MJCF becomes an arm with MuJoCo's own torques, or one sentence says why not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxpanda_kernels import inertia
from mjcf_cases import CASES, MODELS, chain_of, mujoco_torque, random_states

from jaxpanda.arms import mjcf
from jaxpanda.arms.arm import Arm
from jaxpanda.arms.mjcf import load_model
from jaxpanda.arms.source import from_mjcf
from jaxpanda.errors import InputError


@pytest.mark.parametrize("path", CASES, ids=lambda path: path.stem)
def test_torques_are_those_of_mujoco(path):
    arm, source = from_mjcf(path)
    q, qd, qdd = random_states(source)
    ours = jax.vmap(arm.inverse_dynamics)(*map(jnp.asarray, (q, qd, qdd)))
    theirs = mujoco_torque(source, q, qd, qdd) + np.asarray(arm.frictionloss) * np.sign(qd)
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12 * np.abs(theirs).max())


def test_a_level_panda_file_has_the_frames_of_the_published_table():
    arm = from_mjcf(MODELS / "menagerie_like.xml")[0]
    np.testing.assert_allclose(arm.chain.R, Arm.panda().chain.R, atol=1e-15)
    np.testing.assert_allclose(arm.chain.p, Arm.panda().chain.p, atol=1e-15)


def test_joint_classes_give_armature_damping_and_limits():
    arm = from_mjcf(MODELS / "menagerie_like.xml")[0]
    np.testing.assert_array_equal(arm.armature, np.full(7, 0.1))
    np.testing.assert_array_equal(arm.damping, np.ones(7))
    assert arm.lower[3] == -3.07
    assert arm.upper[6] == 2.9


def test_degrees_become_radians_and_missing_limits_infinite():
    arm = from_mjcf(MODELS / "odd_axes.xml")[0]
    np.testing.assert_allclose([arm.lower[2], arm.upper[2]], np.deg2rad([-100, 120]))
    np.testing.assert_allclose(arm.springref[2], np.deg2rad(-10))
    assert np.isneginf(arm.lower[3])
    assert np.isposinf(arm.upper[3])
    np.testing.assert_array_equal(arm.chain.prismatic, [True, False, False, False, False, False])


def test_a_gripper_is_locked_and_lumped_into_the_last_link():
    arm, source = from_mjcf(MODELS / "menagerie_like.xml")
    assert arm.dof == 7
    assert source.links[-1].lumped == ("hand", "left_finger", "right_finger")
    np.testing.assert_allclose(arm.standard[6, 0], 0.74 + 0.73 + 2 * 0.015)
    assert any("finger_joint1, finger_joint2 are locked" in note for note in source.notes)


def test_what_is_left_aside_is_said():
    assert any("gravcomp is ignored" in note for note in from_mjcf(MODELS / "dm_like.xml")[1].notes)
    assert any("1 loose bodies" in note for note in from_mjcf(MODELS / "robosuite_like.xml")[1].notes)


def test_includes_and_unnamed_bodies_are_followed():
    arm, _ = from_mjcf(MODELS / "including.xml")
    assert arm.joint_names == ("turn", "joint2", "wrist")
    np.testing.assert_array_equal(arm.frictionloss, [0.5, 0.5, 0.1])


def test_the_models_flags_switch_its_physics_off(tmp_path):
    joint = '<joint name="second" axis="0 0 1" damping="1" frictionloss="2" stiffness="3"/>'
    flags = (
        '<option><flag damper="disable" spring="disable" frictionloss="disable" gravity="disable"/></option>'
    )
    (tmp_path / "arm.xml").write_text(chain_of(joint, before=flags))
    arm, _ = from_mjcf(tmp_path / "arm.xml")
    for value in (arm.damping, arm.frictionloss, arm.stiffness, arm.chain.gravity):
        assert not np.any(value)


@pytest.mark.parametrize(
    "axis", [[0, 0, 1], [0, 0, -1], [1, 0, 0], [1e-9, 0, -1], [0.3, -0.2, -0.9]], ids=str
)
def test_the_turn_that_brings_z_onto_an_axis_is_a_rotation_by_the_smallest_angle(axis):
    axis = np.array(axis) / np.linalg.norm(axis)
    R = mjcf.smallest_turn(axis)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(np.linalg.det(R), 1)
    np.testing.assert_allclose(R[:, 2], axis, atol=1e-15)
    np.testing.assert_allclose((np.trace(R) - 1) / 2, axis[2], atol=1e-15)  # cosine of the angle turned


def test_host_side_parameters_are_those_of_the_kernels():
    rng = np.random.default_rng(1)
    phi = np.asarray(inertia.from_log_cholesky(jnp.asarray(rng.normal(size=10) / 2)))
    R, p = mjcf.smallest_turn(rng.normal(size=3)), rng.normal(size=3)
    np.testing.assert_allclose(
        mjcf.move_standard(phi, R, p), inertia.move(*map(jnp.asarray, (phi, R, p))), rtol=1e-12
    )
    mass, com, I_com = mjcf.com_from_standard(phi)
    for ours, theirs in zip((mass, com, I_com), inertia.to_com(jnp.asarray(phi)), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12)
    np.testing.assert_allclose(mjcf.standard_from_com(mass, com, I_com), phi, rtol=1e-12)


HINGE = '<joint name="second" axis="0 0 1"/>'
LEAF = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
BRANCH = f'<body name="three"><joint/>{LEAF}</body><body name="four"><joint/>{LEAF}</body>'
REFUSED = {
    "a ball joint": (chain_of('<joint name="b" type="ball"/>'), "joint 'b' is a free or ball joint"),
    "polynomial damping": (chain_of('<joint name="d" damping="1 2"/>'), "joint 'd' has polynomial damping"),
    "polynomial stiffness": (
        chain_of('<joint name="k" stiffness="1 2"/>'),
        "joint 'k' has polynomial damping",
    ),
    "a branching arm": (
        f'<mujoco><worldbody><body name="one"><joint/>{LEAF}{BRANCH}</body></worldbody></mujoco>',
        "branches at body 'one' into body 'three' and body 'four'",
    ),
    "two arms": (
        f"<mujoco><worldbody>{BRANCH}</worldbody></mujoco>",
        "body 'three' and body 'four' both start",
    ),
    "no joints": (f'<mujoco><worldbody><body name="one">{LEAF}</body></worldbody></mujoco>', "has no joint"),
    "a floating base": (
        f'<mujoco><worldbody><body name="one"><freejoint name="f"/>{LEAF}</body></worldbody></mujoco>',
        "joint 'f' is a free or ball joint",
    ),
    "a floating arm": (
        f'<mujoco><worldbody><body name="one"><freejoint name="f"/>{LEAF}<body><joint/>{LEAF}</body></body>'
        "</worldbody></mujoco>",
        "joint 'f' is a free or ball joint",
    ),
    "a loop closed on the world": (
        chain_of(HINGE, after='<equality><connect name="loop" body1="two" anchor="0 0 0"/></equality>'),
        "equality 'loop' closes a loop",
    ),
    "coupled joints": (
        chain_of(HINGE, after='<equality><joint name="mimic" joint1="second" joint2="first"/></equality>'),
        "equality 'mimic' closes a loop",
    ),
    "a spring across joints": (
        chain_of(
            HINGE,
            after='<tendon><fixed name="t" stiffness="3"><joint joint="first" coef="1"/></fixed></tendon>',
        ),
        "tendon 't' puts stiffness",
    ),
    "armature of an actuator": (
        chain_of(HINGE, after='<actuator><motor name="m" joint="second" armature="0.1"/></actuator>'),
        "actuator 'm' has armature or damping of its own",
    ),
    "a damping that is none": (
        chain_of('<joint name="d" damping="nan"/>'),
        "body 'two' with joint 'd': the damping is no finite number",
    ),
    "a place that is none": (
        chain_of(HINGE).replace("0 0 0.3", "0 nan 0"),
        "body 'two' with joint 'second': the place is no finite number",
    ),
    "gravity that is none": (
        chain_of(HINGE).replace("<worldbody>", '<option gravity="0 0 nan"/><worldbody>'),
        "gravity is no finite number",
    ),
    "an unknown attribute": (
        "<mujoco>\n<worldbody>\n<body foo='1'/>\n</worldbody></mujoco>",
        "unrecognized attribute: 'foo' (Element 'body', line 3)",
    ),
    "an impossible inertia": (
        chain_of(HINGE).replace("0.01 0.01 0.01", "1 1 3"),
        "inertia must satisfy A + B >= C",
    ),
    "broken XML": (
        "<mujoco>\n<worldbody>\n<body>\n</worldbody></mujoco>",
        "line 4, column 3: mismatched tag",
    ),
    "URDF": (
        '<?xml version="1.0"?>\n<robot name="r"/>',
        "has no joint, so there is no arm in it",
    ),
    "nothing": ("", "is empty"),
    "a missing include": ('<mujoco>\n<include file="no.xml"/></mujoco>', "line 2: includes 'no.xml'"),
    "a missing mesh that gives inertia": (
        '<mujoco><asset><mesh name="m" file="m.stl"/></asset><worldbody><body name="one"><joint/>'
        '<geom type="mesh" mesh="m"/></body></worldbody></mujoco>',
        "body 'one' takes its inertia from mesh 'm'",
    ),
}


@pytest.mark.parametrize(("text", "reason"), REFUSED.values(), ids=REFUSED.keys())
def test_what_no_serial_arm_represents_is_refused_in_one_sentence(text, reason, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "arm.xml"
    file.write_text(text)
    with pytest.raises(InputError) as refusal:
        from_mjcf(file)
    message = str(refusal.value)
    assert str(file) in message
    assert reason in message
    assert "\n" not in message
    assert list(tmp_path.iterdir()) == [file]  # MuJoCo left a log of its warnings there


@pytest.mark.parametrize(
    "data", [b"\x00\x01\x02", b"\xff\xfe\x00<", bytes(range(256)), b"PK\x03\x04\x14"], ids=repr
)
def test_binary_files_are_refused_in_one_sentence(data, tmp_path):
    file = tmp_path / "arm.xml"
    file.write_bytes(data)
    with pytest.raises(InputError, match=r"arm\.xml: [^\n]+$"):
        from_mjcf(file)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(InputError, match=r"nowhere\.xml: cannot be read"):
        from_mjcf(tmp_path / "nowhere.xml")


def test_a_mesh_on_disk_still_gives_its_inertia(tmp_path):
    corners = [(0, 0, 0), (0.1, 0, 0), (0, 0.2, 0), (0, 0, 0.3)]
    faces = ["1 3 2", "1 2 4", "1 4 3", "2 3 4"]
    obj = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {face}" for face in faces]
    (tmp_path / "tetrahedron.obj").write_text("\n".join(obj) + "\n")
    (tmp_path / "arm.xml").write_text(
        '<mujoco><asset><mesh file="tetrahedron.obj"/></asset><worldbody><body><joint axis="0 0 1"/>'
        '<geom type="mesh" mesh="tetrahedron" density="1000"/></body></worldbody></mujoco>'
    )
    arm, _ = from_mjcf(tmp_path / "arm.xml")
    mass = 1000 * 0.1 * 0.2 * 0.3 / 6
    np.testing.assert_allclose(arm.standard[0, :4], mass * np.array([1, 0.025, 0.05, 0.075]), rtol=1e-6)


def test_a_compiled_model_keeps_every_geom_and_actuator_of_a_file_without_its_meshes():
    model = load_model(MODELS / "menagerie_like.xml")
    assert (model.ngeom, model.nu, model.nmesh) == (5, 4, 0)


def test_a_fixed_base_may_lack_both_inertia_and_mesh(tmp_path):
    base = '<body name="base"><geom type="mesh" mesh="m"/><frame pos="0 0 1"><body name="one">'
    text = chain_of(HINGE, before='<asset><mesh name="m" file="m.stl"/></asset>')
    text = text.replace('<body name="one">', base).replace("</worldbody>", "</frame></body></worldbody>")
    (tmp_path / "arm.xml").write_text(text)
    assert from_mjcf(tmp_path / "arm.xml")[0].dof == 2
