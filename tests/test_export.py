"""What goes into a file comes out of MuJoCo, and no other byte of the file moves."""

import dataclasses
import difflib
import json
import re
import shutil
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jaxpanda_kernels import rnea
from mjcf_cases import CASES, FILES, MODELS, chain_of, mujoco_torque, random_states

from jaxpanda.arms import export, markup
from jaxpanda.arms.arm import Arm
from jaxpanda.arms.export import edit_mjcf, not_held, panda_mjcf, sidecar, write_parameters
from jaxpanda.arms.mjcf import standard_from_com
from jaxpanda.arms.panda import published
from jaxpanda.arms.source import from_document, from_mjcf
from jaxpanda.arms.urdf import to_urdf
from jaxpanda.errors import InputError
from jaxpanda.friction import Friction

WRITTEN = ("pos", "mass", "fullinertia", "damping", "frictionloss", "solreffriction", "solimpfriction")
REPLACED = ("diaginertia", "quat", "axisangle", "euler")


def friction_of(dof: int, seed: int = 3) -> Friction:
    rng = np.random.default_rng(seed)
    names = ("viscous", "coulomb", "offset")
    return Friction("coulomb_viscous_offset", {name: rng.uniform(0.1, 1, dof) for name in names})


def other_links(source) -> np.ndarray:
    """Feasible parameters that differ from the file's: own bodies a tenth heavier, and a rod each."""
    own = source.standard - np.array([link.lumped_standard for link in source.links])
    rod = standard_from_com(0.3, np.array([0.01, -0.02, 0.03]), np.diag([0.002, 0.003, 0.004]))
    return source.standard + 0.1 * own + rod


def rigid_torque(arm, phi: np.ndarray, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    states = map(jnp.asarray, (q, qd, qdd))
    return np.asarray(jax.vmap(rnea, (None, None, 0, 0, 0))(arm.chain, jnp.asarray(phi), *states))


def without(text: str, attributes: tuple[str, ...]) -> str:
    return re.sub(rf"""\s+(?:{"|".join(attributes)})\s*=\s*("[^"]*"|'[^']*')""", "", text)


@pytest.mark.parametrize("path", CASES, ids=lambda path: path.stem)
def test_mujoco_moves_the_written_file_as_the_parameters_say(path, tmp_path):
    arm, source = from_mjcf(path)
    phi, friction = other_links(source), friction_of(arm.dof)
    write_parameters(source, arm, phi, friction).save(tmp_path / "out.xml")

    _, written = from_mjcf(tmp_path / "out.xml")
    q, qd, qdd = random_states(written)
    theirs = mujoco_torque(written, q, qd, qdd)
    rigid = rigid_torque(arm, phi, q, qd, qdd)
    damping = np.maximum(arm.damping + friction.viscous, 0)
    ours = rigid + arm.armature * qdd + damping * qd + arm.stiffness * (q - arm.springref)
    np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-11 * np.abs(ours).max())
    np.testing.assert_allclose(
        written.model.dof_frictionloss[[link.dof for link in written.links]],
        arm.frictionloss + friction.coulomb,
    )


@pytest.mark.parametrize("path", CASES, ids=lambda path: path.stem)
def test_only_the_changed_attributes_of_a_file_differ(path):
    arm, source = from_mjcf(path)
    result = write_parameters(source, arm, other_links(source), friction_of(arm.dof))
    for name, before in source.document.texts.items():
        after = result.document.texts[name]
        lines = difflib.ndiff(before.splitlines(keepends=True), after.splitlines(keepends=True))
        changed = [line[2:] for line in lines if line[0] in "+-"]
        assert all("inertia" in line or "joint" in line for line in changed)
        stripped = [without(text, WRITTEN + REPLACED) for text in (before, after)]
        stripped[1] = re.sub(r"\s*<inertial/>", "", stripped[1])
        assert re.sub(r"\s*<inertial */>", "", stripped[0]) == re.sub(r"\s*<inertial */>", "", stripped[1])
    assert {change.attribute for change in result.changes} <= {*WRITTEN, *REPLACED, "inertial"}


@pytest.mark.parametrize("path", CASES, ids=lambda path: path.stem)
def test_the_parameters_a_file_holds_already_leave_it_byte_for_byte(path):
    arm, source = from_mjcf(path)
    result = write_parameters(source, arm, arm.standard)
    assert result.document.texts == source.document.texts
    assert result.changes == ()


def test_one_link_changes_one_element(tmp_path):
    arm, source = from_mjcf(MODELS / "menagerie_like.xml")
    phi = source.standard.copy()
    phi[2] *= 1.01
    result = write_parameters(source, arm, phi)
    assert {change.element for change in result.changes} == {"inertial of link3"}
    (line,) = {change.line for change in result.changes}
    assert 'mass="3.2"' in source.text.splitlines()[line - 1]


def test_line_ends_comments_quotes_and_byte_order_mark_survive(tmp_path):
    text = (
        '\ufeff<?xml version="1.0" encoding="utf-8"?>\r\n<!-- a -- b: é -->\r\n'
        + chain_of("<joint name='second' \t axis = '0 1 0'\r\n\t damping\t= '0.1'   />").replace("\n", "\r\n")
        + "<!-- <joint name='second' damping='9'/> -->\r\n"
    )
    file = tmp_path / "arm.xml"
    file.write_bytes(text.encode())
    arm, source = from_mjcf(file)
    assert source.text == text
    extra = Friction("viscous", {"viscous": np.array([0.5, 0.25])})
    result = write_parameters(source, arm, None, extra)
    expected = text.replace("= '0.1'", "= '0.35'").replace('axis="0 0 1"/>', 'axis="0 0 1" damping="0.5"/>')
    assert result.text == expected
    result.save(tmp_path / "out" / "arm.xml")
    assert (tmp_path / "out" / "arm.xml").read_bytes() == expected.encode()


def test_a_link_lighter_than_what_it_carries_is_refused():
    arm, source = from_mjcf(MODELS / "menagerie_like.xml")
    phi = source.standard.copy()
    phi[6] *= 0.4
    with pytest.raises(
        InputError, match=r"'link7' would weigh -0\.\d+ kg, once hand, left_finger, right_finger on it"
    ):
        write_parameters(source, arm, phi)


def test_an_impossible_inertia_is_refused_and_one_on_the_edge_still_compiles():
    arm, source = from_mjcf(MODELS / "dm_like.xml")
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    com = np.array([0.02, 0.05, -0.04])
    for excess, on_edge in ((0.0, True), (1e-11, True), (1e-6, False)):
        phi = source.standard.copy()
        flat = turn @ np.diag([0.03, 0.01, 0.04 * (1 + excess)]) @ turn.T
        phi[2] = standard_from_com(3.0, com, flat)
        if not on_edge:
            with pytest.raises(InputError, match=r"'panda_link3' would have a principal moment .* exceeds"):
                write_parameters(source, arm, phi)
            continue
        result = write_parameters(source, arm, phi)
        assert any("lies on the triangle inequality" in warning for warning in result.warnings)
        body = source.links[2].body_id
        moments = from_document(result.document)[1].model.body_inertia[body]
        np.testing.assert_allclose(np.sort(moments), [0.01, 0.03, 0.04], rtol=1e-10)


def test_what_mujoco_cannot_hold_goes_into_the_sidecar(tmp_path):
    arm, source = from_mjcf(MODELS / "dm_like.xml")
    found = published()["classical_friction"]
    friction = Friction("coulomb_viscous_offset", {name: np.array(found[name]) for name in found})
    bare = eqx.tree_at(lambda a: (a.damping, a.frictionloss), arm, (jnp.zeros(7), jnp.zeros(7)))
    result = write_parameters(source, bare, None, friction)
    result.save(tmp_path / "out.xml")
    held = json.loads((tmp_path / "out.jaxpanda.json").read_text())
    assert held["torque_offset"] == found["offset"]
    assert held["friction"][5]["parameters"]["viscous"] == -0.0132
    assert from_document(result.document)[0].damping[5] == 0
    assert len(result.warnings) == 2
    assert any("damping of panda_joint6 came out as -0.0132" in warning for warning in result.warnings)


def test_a_sigmoid_is_written_as_its_level_at_speed_and_its_offset_kept():
    arm = Arm.panda()
    values = published()["sigmoid_friction"]
    friction = Friction("sigmoid", {name: np.array(values[name]) for name in ("phi1", "phi2", "phi3")})
    model = mujoco.MjModel.from_xml_string(panda_mjcf(friction=friction))
    for speed in (-50.0, 50.0):
        held = model.dof_frictionloss * np.sign(speed) + np.array(sidecar(arm, friction)["torque_offset"])
        np.testing.assert_allclose(held, friction.torque(jnp.full(7, speed)), rtol=1e-12)
    assert any("no sigmoid" in sentence for sentence in not_held(arm, friction))


def test_the_arm_that_was_identified_decides_the_rest_of_the_joints():
    _, source = from_mjcf(MODELS / "menagerie_like.xml")
    other = dataclasses.replace(Arm.panda(), armature=jnp.full(7, 0.02))
    written = from_document(write_parameters(source, other).document)[0]
    np.testing.assert_array_equal(written.armature, np.full(7, 0.02))
    np.testing.assert_array_equal(written.damping, np.zeros(7))


def test_springs_are_written_in_the_units_of_the_file():
    arm, source = from_mjcf(MODELS / "odd_axes.xml")
    sprung = dataclasses.replace(arm, stiffness=arm.stiffness + 1, springref=jnp.full(6, 0.25))
    written = from_document(write_parameters(source, sprung).document)[0]
    np.testing.assert_allclose(written.springref, np.full(6, 0.25), rtol=1e-15)
    np.testing.assert_allclose(written.stiffness, arm.stiffness + 1)


def test_an_export_has_all_digits_where_jax_has_float32():
    with jax.enable_x64(False):
        arm, source = from_mjcf(MODELS / "odd_axes.xml")
        assert write_parameters(source, arm, arm.standard).text == source.text
        phi, friction = other_links(source), friction_of(6)
        result = write_parameters(source, arm, phi, friction)
    assert from_document(result.document)[1].standard == pytest.approx(phi, rel=1e-12, abs=1e-15)


def test_an_arm_of_another_geometry_is_refused():
    _, source = from_mjcf(MODELS / "dm_like.xml")
    moved = eqx.tree_at(lambda a: a.chain.p, Arm.panda(), Arm.panda().chain.p.at[3, 0].add(0.01))
    with pytest.raises(InputError, match="its joint axes stand elsewhere"):
        write_parameters(source, moved, Arm.panda().standard)
    short = from_mjcf(MODELS / "including.xml")[0]
    with pytest.raises(InputError, match="has 7 arm joints, the parameters are for 3"):
        write_parameters(source, short)


@pytest.mark.parametrize(
    ("setting", "reason"),
    [
        ('<compiler inertiafromgeom="true"/>', "inertiafromgeom='true' overrides every <inertial>"),
        ('<compiler settotalmass="5"/>', "settotalmass='5' overrides every <inertial>"),
        ('<compiler boundmass="2.5"/>', "does not compile body 'two' to the inertia"),
    ],
)
def test_compiler_settings_that_overrule_an_inertial_are_refused(setting, reason, tmp_path):
    file = tmp_path / "arm.xml"
    geom = '<joint name="second"/><geom size="0.1"/>'
    file.write_text(chain_of(geom, before=setting).replace("<inertial", '<geom size="0.2"/><inertial', 1))
    arm, source = from_mjcf(file)
    with pytest.raises(InputError, match=reason):
        write_parameters(source, arm, source.standard * np.array([[1.1], [0.9]]))


def test_a_file_that_takes_every_inertia_from_geoms_gets_those_of_the_arm(tmp_path):
    file = tmp_path / "arm.xml"
    text = chain_of('<joint name="second"/><geom size="0.1"/>', before='<compiler inertiafromgeom="true"/>')
    file.write_text(re.sub("<inertial[^>]*/>", '<geom size="0.2"/>', text))
    arm, source = from_mjcf(file)
    assert write_parameters(source, arm, source.standard).text == file.read_text()
    wanted = source.standard * np.array([[1.1], [1.0]])
    result = write_parameters(source, arm, wanted)
    assert [c.attribute for c in result.changes] == ["inertial", "inertiafromgeom"]
    np.testing.assert_allclose(from_document(result.document)[1].standard, wanted, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("before", ['<option><flag damper="disable"/></option>', ""])
def test_damping_that_something_else_decides_is_refused(before, tmp_path):
    file = tmp_path / "arm.xml"
    joint = '<joint name="second" axis="0 0 1"/>' if before else '<joint name="second" springdamper="1 1"/>'
    file.write_text(chain_of(joint, before=before))
    arm, source = from_mjcf(file)
    with pytest.raises(InputError, match=r"joint '\w+' compiles to damping"):
        write_parameters(source, arm, None, Friction("viscous", {"viscous": np.array([0.0, 0.5])}))


def test_an_included_file_takes_the_change_and_is_never_overwritten(tmp_path):
    shutil.copytree(MODELS, tmp_path / "in")
    arm, source = from_mjcf(tmp_path / "in" / "including.xml")
    phi = source.standard.copy()
    phi[1] *= 1.1
    result = write_parameters(source, arm, phi)
    assert result.text == source.text
    assert {change.file for change in result.changes} == {str(tmp_path / "in" / "parts" / "arm.xml")}
    with pytest.raises(InputError, match=r"arm\.xml: stands there already"):
        result.save(tmp_path / "in" / "new.xml")
    assert not (tmp_path / "in" / "new.xml").exists()
    result.save(tmp_path / "out" / "new.xml")
    np.testing.assert_allclose(from_mjcf(tmp_path / "out" / "new.xml")[1].standard, phi, rtol=1e-12)


def test_a_body_may_trade_the_inertia_of_its_mesh_for_a_written_one(tmp_path):
    obj = "v 0 0 0\nv 0.1 0 0\nv 0 0.2 0\nv 0 0 0.3\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "rock.obj").write_text(obj)
    (tmp_path / "arm.xml").write_text(
        '<mujoco><asset><mesh file="rock.obj"/></asset><worldbody><body name="one">\n  <joint/>\n'
        '  <geom type="mesh" mesh="rock"/>\n</body></worldbody></mujoco>\n'
    )
    arm, source = from_mjcf(tmp_path / "arm.xml")
    result = write_parameters(source, arm, 2 * source.standard)
    assert re.sub(r"\n  <inertial [^>]*/>", "", result.text) == source.text
    np.testing.assert_allclose(from_document(result.document)[1].standard, 2 * source.standard, rtol=1e-12)


def test_meshes_that_the_new_file_will_not_find_are_said(tmp_path):
    (tmp_path / "assets").mkdir()
    (tmp_path / "assets" / "hand.obj").write_text("")
    shutil.copy(MODELS / "menagerie_like.xml", tmp_path / "arm.xml")
    arm, source = from_mjcf(tmp_path / "arm.xml")
    result = write_parameters(source, arm)
    assert result.save(tmp_path / "beside.xml") == ()
    (warning,) = result.save(tmp_path / "elsewhere" / "arm.xml")
    assert warning.startswith("1 meshes, textures or attached models (assets/hand.obj")


def test_generated_bodies_are_refused(tmp_path):
    part = tmp_path / "part.xml"
    part.write_text(chain_of('<joint name="second"/>'))
    whole = tmp_path / "arm.xml"
    whole.write_text(
        '<mujoco><asset><model name="part" file="part.xml"/></asset><worldbody>'
        '<attach model="part" body="one" prefix="p_"/></worldbody></mujoco>'
    )
    arm, source = from_mjcf(whole)
    assert arm.dof == 2
    with pytest.raises(InputError, match="body 'p_one' is not written in this file"):
        write_parameters(source, arm, source.standard * 1.1)


def test_the_attribute_editor_sets_adds_and_takes_away():
    text = "<mujoco><worldbody> <body name='b' pos='1 2 3'><joint\n name=\"j\"/></body></worldbody></mujoco>"
    changes = {("body", "b"): {"pos": None, "quat": "1 0 0 0"}, ("joint", "j"): {"user": '"<&'}}
    document = markup.parse(text, "mujoco", Path("model.xml"))
    assert edit_mjcf(document, changes).text == (
        "<mujoco><worldbody> <body name='b' quat=\"1 0 0 0\"><joint\n"
        ' name="j" user="&quot;&lt;&amp;"/></body></worldbody></mujoco>'
    )


@pytest.mark.parametrize(
    ("key", "reason"),
    [(("joint", "nobody"), "holds no <joint> named 'nobody'"), (("joint", "turn"), "stands in the included")],
)
def test_the_attribute_editor_names_what_it_cannot_reach(key, reason):
    with pytest.raises(InputError, match=reason):
        edit_mjcf(markup.read(MODELS / "including.xml", "mujoco"), {key: {"damping": "1"}})


def test_the_own_panda_is_the_published_one():
    model = mujoco.MjModel.from_xml_string(panda_mjcf())
    assert (model.nq, model.nu, model.nmesh) == (7, 7, 0)
    np.testing.assert_array_equal(model.actuator_ctrlrange[:, 1], [87, 87, 87, 87, 12, 12, 12])
    document = markup.parse(panda_mjcf(), "mujoco", MODELS / "panda.xml")
    arm, source = from_document(document)
    q, qd, qdd = random_states(source)
    ours = jax.vmap(Arm.panda().inverse_dynamics)(*map(jnp.asarray, (q, qd, qdd)))
    np.testing.assert_allclose(mujoco_torque(source, q, qd, qdd), ours, rtol=0, atol=1e-11)
    assert arm.joint_names == Arm.panda().joint_names


def test_the_own_panda_refuses_what_is_no_body():
    phi = Arm.panda().standard.at[3, 0].set(-1.0)
    with pytest.raises(InputError, match="panda: body 'link4' would weigh -1 kg"):
        panda_mjcf(phi)


def friction_errors(stiff: bool) -> np.ndarray:
    """Largest error of `mj_inverse`'s friction torque at slow motion, as a share of the Coulomb level."""
    coulomb = np.array(published()["one_step_friction"]["coulomb"])
    text = panda_mjcf(friction=Friction("coulomb_viscous", {"viscous": np.zeros(7), "coulomb": coulomb}))
    if not stiff:
        text = without(text, ("solreffriction", "solimpfriction"))
    source = from_document(markup.parse(text, "mujoco", MODELS / "panda.xml"))[1]
    rng = np.random.default_rng(0)
    q, qdd = rng.uniform(-1, 1, (50, 7)), rng.uniform(-3, 3, (50, 7))
    qd = rng.uniform(0.02, 0.2, (50, 7)) * rng.choice([-1, 1], (50, 7))
    with_friction = mujoco_torque(source, q, qd, qdd, keep=("FRICTIONLOSS",))
    source.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
    error = with_friction - mujoco_torque(source, q, qd, qdd) - coulomb * np.sign(qd)
    return np.abs(error).max(0) / coulomb


def test_frictionloss_is_coulombs_law_with_the_solver_settings_written():
    assert np.all(friction_errors(stiff=False)[4:] > 0.5)  # the wrist, with MuJoCo's defaults
    assert np.all(friction_errors(stiff=True) < 0.01)


def test_the_way_friction_turns_in_a_file_stays_as_it_is(tmp_path):
    """A changed level came with the stiff settings of an export, whatever the user had written."""
    file = tmp_path / "arm.xml"
    own = 'frictionloss="0.3" solreffriction="0.004 1" solimpfriction="0.99 0.999 0.001"'
    file.write_text(chain_of(f'<joint name="second" axis="0 1 0" {own}/>'))
    arm, source = from_mjcf(file)
    found = Friction("coulomb_viscous", {"viscous": np.zeros(2), "coulomb": np.array([0.2, 0.2])})
    text = write_parameters(source, arm, None, found).text
    assert own.replace('"0.3"', '"0.5"') in text
    assert text.count("solreffriction") == 2  # the other joint had no friction and gets the stiff settings


@pytest.mark.slow
def test_the_own_panda_runs_in_mjx():
    from mujoco import mjx

    model = mujoco.MjModel.from_xml_string(panda_mjcf())
    rng = np.random.default_rng(5)
    q = rng.uniform(*model.jnt_range.T)
    qd, qdd = rng.uniform(-1, 1, (2, 7))
    data = mjx.make_data(model).replace(qpos=jnp.asarray(q), qvel=jnp.asarray(qd), qacc=jnp.asarray(qdd))
    torque = jax.jit(lambda data: mjx.inverse(mjx.put_model(model), data).qfrc_inverse)(data)
    ours = Arm.panda().inverse_dynamics(*map(jnp.asarray, (q, qd, qdd)))
    np.testing.assert_allclose(torque, ours, atol=1e-10)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_pinocchio_reads_the_urdf_as_the_same_arm(path):
    import pinocchio

    arm, source = from_mjcf(path)
    friction = friction_of(arm.dof)
    model = pinocchio.buildModelFromXML(to_urdf(arm, other_links(source), friction))
    data = model.createData()
    model.gravity.linear = np.asarray(arm.chain.gravity)
    np.testing.assert_allclose(model.damping, arm.damping + friction.viscous)
    states = random_states(source)
    turns = [model.joints[model.getJointId(name)].nq == 2 for name in arm.joint_names]
    theirs = []
    for q, qd, qdd in zip(*states, strict=True):
        turned = [[np.cos(x), np.sin(x)] if turn else [x] for x, turn in zip(q, turns, strict=True)]
        theirs.append(pinocchio.rnea(model, data, np.concatenate(turned), qd, qdd))
    ours = rigid_torque(arm, other_links(source), *states)
    np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-12 * np.abs(ours).max())


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-9, 0.3])
def test_roll_pitch_yaw_give_the_rotation_back_even_where_two_of_them_are_one(pitch):
    from scipy.spatial.transform import Rotation

    from jaxpanda.arms.urdf import roll_pitch_yaw

    R = Rotation.from_euler("ZYX", [0.4, pitch, -1.1]).as_matrix()
    roll, pitch, yaw = roll_pitch_yaw(R)
    np.testing.assert_allclose(Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix(), R, atol=1e-15)


def test_what_urdf_cannot_hold_is_said_in_it():
    text = to_urdf(from_mjcf(MODELS / "odd_axes.xml")[0], friction=friction_of(6))
    assert re.search(r"<!-- not in this file: armature .*; joint springs .*; torque offsets .* -->", text)


def test_friction_below_zero_is_not_written_and_said():
    """pinocchio refuses it, and so do others."""
    arm = from_mjcf(MODELS / "odd_axes.xml")[0]
    less = {"viscous": -2 * np.asarray(arm.damping) - 0.1, "coulomb": -9 - np.asarray(arm.frictionloss)}
    text = to_urdf(arm, friction=Friction("coulomb_viscous", less))
    assert set(re.findall(r'<dynamics damping="(.*)" friction="(.*)"', text)) == {("0.0", "0.0")}
    comment = re.search(r"<!-- not in this file: (.*) -->", text)
    assert comment is not None
    assert "damping -0.1" in comment[1]
    assert comment[1].count("friction -9 of joint") == 6


def test_no_array_of_the_model_is_named_that_mujoco_does_not_have():
    model = mujoco.MjModel.from_xml_string(panda_mjcf())
    named = [*export._FOLLOWS, *(name for names in export._WRITTEN.values() for name in names)]
    assert [name for name in named if not hasattr(model, name)] == []
