"""Arms as people have them: URDF, one arm of a larger model, several joints on one body, files in folders."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jaxpanda_kernels import rnea
from mjcf_cases import chain_of, mujoco_torque, random_states

from jaxpanda.__main__ import main
from jaxpanda.arms.export import write_parameters
from jaxpanda.arms.lint import lint
from jaxpanda.arms.model_file import ModelFile, Part
from jaxpanda.arms.source import file_with, from_mjcf
from jaxpanda.arms.urdf import to_urdf
from jaxpanda.errors import InputError
from jaxpanda.validation import arm_model


def written(tmp_path, text, name="arm.xml"):
    file = tmp_path / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    return file


def refused(path, **part):
    with pytest.raises(InputError) as refusal:
        from_mjcf(ModelFile(path, Part(**part)))
    return str(refusal.value)


def assert_torques_are_mujocos(arm, source):
    q, qd, qdd = random_states(source)
    ours = jax.vmap(arm.inverse_dynamics)(*map(jnp.asarray, (q, qd, qdd)))
    theirs = mujoco_torque(source, q, qd, qdd) + np.asarray(arm.frictionloss) * np.sign(qd)
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12 * np.abs(theirs).max())


# One arm of a larger model


def arm_at(name: str, x: float) -> str:
    parts = "".join(
        f'<body name="{name}/link{i}" pos="0 0.1 0.2"><joint name="{name}/j{i}" axis="{i % 2} {1 - i % 2} 0"/>'
        f'<inertial pos="0.01 0 0.1" mass="{4 - i}" diaginertia="0.03 0.03 0.02"/>'
        for i in (1, 2, 3)
    )
    return f'<body name="{name}/base" pos="{x} 0 0"><geom size="0.1"/>{parts}{"</body>" * 4}'


TWO = f"""<mujoco><worldbody>{arm_at("left", -1)}{arm_at("right", 1)}
  <body name="cup"><freejoint/><geom size="0.1"/></body></worldbody></mujoco>"""
WHEELED = f"""<mujoco><worldbody><body name="chassis"><freejoint/><geom size="0.3"/>
  <body name="wheel"><joint name="turns"/><geom size="0.1"/></body>
  {arm_at("a", 0.2)}</body></worldbody></mujoco>"""


@pytest.mark.parametrize("name", ["left", "right"])
def test_an_arm_of_two_is_chosen_by_what_it_stands_on(name, tmp_path):
    arm, source = from_mjcf(ModelFile(written(tmp_path, TWO), Part(root=f"{name}/base")))
    assert arm.joint_names == (f"{name}/j1", f"{name}/j2", f"{name}/j3")
    assert_torques_are_mujocos(arm, source)


def test_a_refusal_names_the_options_that_work(tmp_path):
    file = written(tmp_path, TWO)
    said = refused(file)
    assert "choose one by --root left/base (3 joints), --root right/base (3 joints)" in said
    assert "did you mean 'left/base'?" in refused(file, root="left_base")
    assert "does not lie beyond --root right/base" in refused(file, root="right/base", tip="left/link2")
    assert "nothing moves beyond --root left/link3" in refused(file, root="left/link3")


def test_an_arm_on_wheels_stands_where_the_file_has_it(tmp_path):
    file = written(tmp_path, WHEELED)
    assert "--root a/base (3 joints)" in refused(file)
    arm, source = from_mjcf(ModelFile(file, Part(root="a/base")))
    assert_torques_are_mujocos(arm, source)
    assert any("on which the arm stands, are held" in note for note in source.notes)


def test_beyond_the_tip_everything_is_locked(tmp_path):
    file = written(tmp_path, TWO)
    arm, source = from_mjcf(ModelFile(file, Part(tip="left/link2")))
    assert arm.joint_names == ("left/j1", "left/j2")
    assert source.links[-1].lumped == ("left/link3",)
    assert_torques_are_mujocos(arm, source)


def test_an_export_changes_the_chosen_arm_alone(tmp_path):
    arm, source = from_mjcf(ModelFile(written(tmp_path, TWO), Part(root="right/base")))
    heavier = np.asarray(arm.standard) * np.array([[1.0], [1.0], [1.1]])
    result = write_parameters(source, arm, heavier)
    assert {change.element for change in result.changes} == {"inertial of right/link3"}


def test_a_chosen_arm_is_found_again_by_its_joints(tmp_path):
    """`replay` reads corrected.xml, which says nothing of what was chosen."""
    for text, part in ((TWO, Part(root="right/base")), (WHEELED, Part(root="a/base", tip="a/link2"))):
        arm, _ = from_mjcf(ModelFile(written(tmp_path, text), part))
        again, _ = from_mjcf(file_with(arm, tmp_path / "arm.xml"))
        assert again.joint_names == arm.joint_names
        np.testing.assert_array_equal(again.standard, arm.standard)


# Several joints on one body


def test_joints_of_one_body_have_links_without_mass_between_them(tmp_path):
    text = chain_of(
        '<joint name="x" axis="1 0 0" pos="0 0 0.05"/><joint name="y" axis="0 1 0" damping="0.2"/>'
    )
    arm, source = from_mjcf(written(tmp_path, text))
    assert arm.joint_names == ("first", "x", "y")
    assert arm.link_names == ("one", "two/x", "two")
    assert not np.any(arm.standard[1])
    assert_torques_are_mujocos(arm, source)
    assert [arm_model(source).joint(i).name for i in range(3)] == ["first", "x", "y"]
    lighter = np.asarray(arm.standard) * 0.9
    result = write_parameters(
        source, arm.__class__.from_json({**arm.to_json(), "damping": [0, 0, 0.3]}), lighter
    )
    assert [(c.element, c.attribute) for c in result.changes if c.new == "0.3"] == [("joint of y", "damping")]


# URDF


def link(
    name: str,
    mass: float | None,
    I: str = 'ixx="0.02" iyy="0.03" izz="0.025" ixy="0.001" ixz="0" iyz="-0.002"',
):
    place = '<origin xyz="0 0.02 0.1" rpy="0.1 -0.2 0.3"/>'
    inner = f'<inertial>{place}<mass value="{mass}"/><inertia {I}/></inertial>'
    looks = '<visual><geometry><mesh filename="package://no/where.dae"/></geometry></visual>'
    body = '<collision><geometry><mesh filename="package://no/hull.stl"/></geometry></collision>'
    return f'<link name="{name}">{inner if mass is not None else ""}{looks}{body}</link>'


def joint(name: str, kind: str, parent: str, child: str, more: str = "") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0.05 0 0.2" rpy="0.3 0 1.2"/><axis xyz="0 0.6 0.8"/>{more}</joint>'
    )


LIMIT = '<limit lower="-1.5" upper="2" effort="30" velocity="3"/>'
URDF = (
    '<robot name="toy">'
    + link("base", 3, 'ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"')
    + link("upper", 2)
    + link("lower", 1.2)
    + link("flange", None)
    + link("tool", 0.4, 'ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"')
    + joint("shoulder", "revolute", "base", "upper", LIMIT + '<dynamics damping="0.7" friction="0.4"/>')
    + joint("elbow", "continuous", "upper", "lower")
    + joint("mount", "fixed", "lower", "flange")
    + joint("grip", "fixed", "flange", "tool")
    + "</robot>"
)


def test_a_urdf_has_mujocos_torques_whatever_became_of_its_meshes(tmp_path):
    arm, source = from_mjcf(written(tmp_path, URDF, "toy.urdf"))
    assert (arm.name, arm.joint_names, arm.link_names) == ("toy", ("shoulder", "elbow"), ("upper", "lower"))
    assert_torques_are_mujocos(arm, source)
    np.testing.assert_allclose(arm.standard[:, 0], [2, 1.6])
    np.testing.assert_array_equal([arm.lower[0], arm.upper[0]], [-1.5, 2])
    assert np.isinf(arm.lower[1])
    np.testing.assert_array_equal(arm.damping, [0.7, 0])
    np.testing.assert_array_equal(arm.frictionloss, [0.4, 0])
    np.testing.assert_array_equal(source.model.actuator_ctrlrange, [[-30, 30]])
    assert source.links[1].lumped == ("flange", "tool")
    assert [finding.message for finding in lint(source.path) if finding.severity == "error"] == []


def test_a_urdf_is_read_to_the_last_digit(tmp_path):
    """MuJoCo's own writer keeps six."""
    arm, _ = from_mjcf(written(tmp_path, URDF.replace("0.02 0.1", "0.0212345678901 0.1"), "toy.urdf"))
    spec = mujoco.MjSpec.from_string((tmp_path / "toy.urdf").read_text())
    spec.meshdir = str(tmp_path)
    np.testing.assert_allclose(float(spec.body("upper").ipos[1]), 0.0212345678901, rtol=1e-15)
    there = to_urdf(arm)
    again, _ = from_mjcf(written(tmp_path, there, "again.urdf"))
    q = jnp.array([0.3, -1.0])
    torque = [rnea(a.chain, a.standard, q, q, q) for a in (arm, again)]
    np.testing.assert_allclose(*torque, rtol=1e-12)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda text: text.replace("inertial>", "nothing>"), "none of its links has an <inertial>"),
        (lambda text: text.replace('value="1.2"', 'value="0"').replace('"0.4"', '"0"'), "links 'lower' move"),
        (lambda text: text.replace("</robot>", '<xacro:arm xmlns:xacro="x"/></robot>'), "run xacro"),
        (lambda text: text.replace('child link="lower"', 'child link="lowest"'), "MuJoCo refuses it"),
        (lambda text: text.replace('ixz="0"', 'ixz="nan"'), "its inertia is no finite number"),
    ],
    ids=["no inertials", "a link without mass", "xacro", "a link that is not there", "an inertia of nan"],
)
def test_a_urdf_that_is_no_arm_is_refused_in_a_sentence(change, reason, tmp_path):
    said = refused(written(tmp_path, change(URDF), "toy.urdf"))
    assert reason in said
    assert "\n" not in said


def test_an_inertia_that_is_no_bodys_is_told(tmp_path):
    impossible = URDF.replace('ixx="0.02" iyy="0.03" izz="0.025"', 'ixx="0.02" iyy="0.03" izz="0.25"')
    assert any(
        "inertia of upper, lower is no body's" in n for n in from_mjcf(written(tmp_path, impossible))[1].notes
    )


def test_fingers_that_weigh_nothing_are_fixed(tmp_path):
    fingers = link("f1", None) + link("f2", None)
    fingers += joint("g1", "prismatic", "tool", "f1", LIMIT)
    fingers += joint("g2", "prismatic", "tool", "f2", LIMIT + '<mimic joint="g1"/>')
    arm, source = from_mjcf(written(tmp_path, URDF.replace("</robot>", f"{fingers}</robot>")))
    assert arm.dof == 2
    assert any("g1, g2 move nothing that weighs" in note for note in source.notes)


def test_a_urdf_goes_through_the_commands(tmp_path, capsys):
    """It was refused for its first element."""
    file = written(tmp_path, URDF, "toy.urdf")
    t = np.arange(0, 4, 0.005)
    q = np.stack([0.8 * np.sin(1.7 * t) + 0.2, 0.9 * np.sin(2.3 * t + 1)], 1)
    np.savetxt(
        tmp_path / "log.csv",
        np.column_stack([t, q, np.gradient(q, t, axis=0), np.ones_like(q)]),
        delimiter=",",
        header="time,q_1,q_2,dq_1,dq_2,tau_1,tau_2",
        comments="",
    )
    status = main(
        [
            "inspect",
            "--model",
            str(file),
            "--tip",
            "lower",
            "--recording",
            str(tmp_path / "log.csv"),
            "--json",
        ]
    )
    assert status == 0
    assert main(["inspect", "--recording", str(tmp_path / "log.csv"), "--root", "base"]) == 2
    assert "--root: is about a model" in capsys.readouterr().err


# Files in folders


def stl(path):
    """A tetrahedron."""
    corners = np.array([[0, 0, 0], [0.2, 0, 0], [0, 0.2, 0], [0, 0, 0.2]], "<f4")
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    rows = [
        np.concatenate([np.zeros(3, "<f4"), corners[list(face)].ravel()]).tobytes() + b"\0\0"
        for face in faces
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b" " * 80 + np.uint32(4).tobytes() + b"".join(rows))


@pytest.mark.parametrize("place", ["model/parts/m.stl", "model/meshes/m.stl"])
def test_meshes_are_where_mujoco_finds_them(place, tmp_path, monkeypatch):
    """MuJoCo, reading from a string, looks from the folder that it is called from."""
    monkeypatch.chdir("/")
    stl(tmp_path / place)
    main_file = written(
        tmp_path,
        '<mujoco><compiler meshdir="meshes"/><include file="parts/arm.xml"/></mujoco>',
        "model/arm.xml",
    )
    written(
        tmp_path,
        '<mujoco><asset><mesh name="m" file="m.stl"/></asset><worldbody><body><joint/>'
        '<geom type="mesh" mesh="m"/></body></worldbody></mujoco>',
        "model/parts/arm.xml",
    )
    mass = mujoco.MjModel.from_xml_path(str(main_file)).body_mass[1]
    np.testing.assert_allclose(from_mjcf(main_file)[0].standard[0, 0], mass, rtol=1e-12)


def test_a_mesh_outside_of_the_models_folder_is_read_where_that_is_allowed(tmp_path):
    stl(tmp_path / "m.stl")
    text = (
        '<mujoco><asset><mesh name="m" file="../m.stl"/></asset><worldbody><body><joint/>'
        '<geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
    )
    file = written(tmp_path, text, "model/arm.xml")
    assert "lies outside of the model's folder; --outside allows" in refused(file)
    assert from_mjcf(ModelFile(file, Part(outside=True)))[0].dof == 1
