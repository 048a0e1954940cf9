"""Real slips are found, and ordinary files are left in peace."""

import mujoco
import pytest
from mjcf_cases import FILES, MODELS, REAL, chain_of

from jaxpanda.arms.export import panda_mjcf, write_parameters
from jaxpanda.arms.lint import ignored_by_mjx, lint
from jaxpanda.arms.source import from_mjcf


def grave(model) -> list[tuple[str, str]]:
    return [(f.severity, f.where) for f in lint(model) if f.severity != "notice"]


SLIPS = [("error", "joint 'panda_joint6'"), ("warning", "joint 'panda_joint7'")]


@pytest.mark.parametrize(
    "path", [MODELS / "dm_like.xml", *(p for p in REAL if "dm_robotics" in str(p))], ids=str
)
def test_both_slips_of_a_published_file_are_found_and_nothing_else(path):
    assert grave(path) == SLIPS
    damping, dry = lint(path)[:2]
    assert "damping is -0.0132" in damping.message
    assert "frictionloss is 1.2109, 3.4 times the largest" in dry.message


@pytest.mark.parametrize("path", [p for p in FILES if p.stem != "dm_like"], ids=lambda path: path.stem)
def test_ordinary_files_give_notices_at_most(path):
    assert grave(path) == []


def test_the_own_panda_is_clean():
    assert lint(mujoco.MjModel.from_xml_string(panda_mjcf())) == []


def test_an_armature_that_hides_the_wrist_is_noticed():
    noticed = [f for f in lint(MODELS / "menagerie_like.xml") if "% of the joint's inertia" in f.message]
    assert [f.where for f in noticed] == ["joint 'joint5'", "joint 'joint6'", "joint 'joint7'"]


def test_one_value_for_all_joints_is_noticed_where_joints_differ_in_size():
    messages = [f.message for f in lint(MODELS / "menagerie_like.xml")]
    assert any("one armature of 0.1" in message for message in messages)
    assert any("one damping of 1" in message for message in messages)


@pytest.mark.parametrize("attribute", ["damping", "frictionloss", "armature"])
def test_negative_joint_physics_is_an_error(attribute):
    model = mujoco.MjModel.from_xml_string(chain_of(f'<joint name="j" {attribute}="-0.001"/>'))
    assert grave(model) == [("error", "joint 'j'")]


def test_impossible_inertias_are_all_named(tmp_path):
    text = (
        chain_of('<joint name="j"/>')
        .replace("0.01 0.01 0.01", "1 1 3")
        .replace("0.02 0.02 0.01", "0.02 0.02 0.05")
    )
    (tmp_path / "arm.xml").write_text(text)
    assert grave(tmp_path / "arm.xml") == [("error", "body 'one'"), ("error", "body 'two'")]


def test_an_inertia_on_the_edge_is_noticed():
    model = mujoco.MjModel.from_xml_string(
        chain_of('<joint name="j"/>').replace("0.01 0.01 0.01", "0.01 0.02 0.03")
    )
    assert [f.where for f in lint(model)] == ["body 'two'"]


JOINT = '<joint name="j" axis="0 0 1"/>'
IGNORED = {
    "polynomial joint damping": chain_of('<joint name="j" damping="1 2"/>'),
    "polynomial joint stiffness": chain_of('<joint name="j" stiffness="1 2"/>'),
    "polynomial tendon damping": chain_of(
        JOINT, after='<tendon><fixed damping="1 2"><joint joint="j" coef="1"/></fixed></tendon>'
    ),
    "polynomial tendon stiffness": chain_of(
        JOINT, after='<tendon><fixed stiffness="1 2"><joint joint="j" coef="1"/></fixed></tendon>'
    ),
    "actuator damping": chain_of(JOINT, after='<actuator><motor joint="j" damping="1"/></actuator>'),
    "actuator armature": chain_of(JOINT, after='<actuator><motor joint="j" armature="1"/></actuator>'),
    "actuator delay": chain_of(
        JOINT, after='<actuator><motor joint="j" delay="0.01" nsample="9"/></actuator>'
    ),
}


@pytest.mark.parametrize(("feature", "text"), IGNORED.items(), ids=IGNORED.keys())
def test_what_mjx_passes_over_is_named(feature, text):
    model = mujoco.MjModel.from_xml_string(text)
    assert f"{feature} is ignored by MJX" in ignored_by_mjx(model)
    assert ("warning", "MJX") in grave(model)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_an_export_writes_nothing_that_mjx_ignores(path):
    arm, source = from_mjcf(path)
    assert ignored_by_mjx(source.model) == ()
    assert write_parameters(source, arm).warnings == ()
