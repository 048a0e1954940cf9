"""Two recordings of one arm agree; a changed friction or a payload is told, and by its name."""

import dataclasses
import json

import mujoco
import numpy as np
import pytest
from helpers import result
from test_excitation import ARM

from jaxpanda import InputError, compare, identify
from jaxpanda.__main__ import main
from jaxpanda.arms.source import from_mjcf
from jaxpanda.comparison.compare import holm, overall
from jaxpanda.simulation import JointFriction, Sensors, perturbed, random_trajectory, simulate

FRICTION = JointFriction(viscous=np.full(3, 0.5), coulomb=np.full(3, 0.3), offset=0.1)
SENSORS = Sensors(torque_noise=0.05, torque_correlation_time=0.02, velocity_noise=1e-3)


def identified(folder, seed, friction=FRICTION, truth=None):
    """What `identify` leaves of a motion and noise of its own."""
    path = folder.parent / "arm.xml"
    path.write_text(ARM)
    arm, _ = from_mjcf(path)
    recording = simulate(
        perturbed(ARM, 1) if truth is None else truth,
        random_trajectory(ARM, seed, period=8.0),
        duration=12.0,
        rate=200.0,
        friction=friction,
        sensors=SENSORS,
        seed=seed,
        name=f"recording {seed}",
    )
    identify(recording, arm, folds=0).save(folder)
    return folder


def loaded(mass):
    """The arm with a ball on its last link."""
    model = perturbed(ARM, 1)
    body = model.body("three").id
    at = np.array([0.0, 0.0, 0.25])
    before, com = float(model.body_mass[body]), model.body_ipos[body].copy()
    model.body_mass[body] = before + mass
    model.body_ipos[body] = (before * com + mass * at) / (before + mass)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


@pytest.fixture(scope="module")
def healthy(tmp_path_factory):
    return identified(tmp_path_factory.mktemp("compared") / "healthy", 1)


@pytest.mark.slow
def test_two_recordings_of_one_arm_agree(healthy, tmp_path):
    found = compare(healthy, identified(tmp_path / "again", 2))
    assert found.verdict == "agree"
    assert not found.explanations
    assert max(found.torque["rms_difference"]) < 0.1
    assert "agree within" in found.sections()[0].sentences[0]


@pytest.mark.slow
def test_false_alarms_are_rare(healthy, tmp_path):
    verdicts = [compare(healthy, identified(tmp_path / f"{seed}", seed)).verdict for seed in range(10, 22)]
    assert verdicts.count("agree") >= 11


@pytest.mark.slow
def test_a_changed_friction_is_told_at_its_joint(healthy, tmp_path):
    coulomb = np.array([0.3, 0.5, 0.3])
    found = compare(healthy, identified(tmp_path / "worn", 3, dataclasses.replace(FRICTION, coulomb=coulomb)))
    assert found.verdict == "differ"
    first = found.explanations[0]
    assert (first.what, first.joint) == ("friction", 2)
    (level,) = [p for p in first.parameters if p["name"] == "coulomb"]
    assert level["change"] == pytest.approx(0.2, abs=0.06)
    (row,) = [p for p in found.parameters if p.name == "coulomb" and p.joint == 2]
    assert row.differs
    assert row.p_corrected >= row.p


@pytest.mark.slow
def test_a_payload_is_told(healthy, tmp_path, capsys):
    other = identified(tmp_path / "loaded", 4, truth=loaded(0.4))
    assert main(["compare", str(healthy), str(other), "--out", str(tmp_path / "out"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["verdict"] == "differ"
    assert document["explanations"][0]["what"] == "payload"
    assert result(tmp_path / "out" / "comparison.json")["count"] == document["count"]
    page = (tmp_path / "out" / "comparison.html").read_text()
    assert "differ beyond their uncertainty" in page
    assert "http" not in page.replace("http://www.w3.org", "")


@pytest.mark.slow
def test_settings_that_differ_are_listed(healthy, tmp_path):
    document = json.loads((healthy / "identification.json").read_text())
    document["settings"]["cutoff"] = 3.0
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "identification.json").write_text(json.dumps(document))
    found = compare(healthy, tmp_path / "other")
    assert {"setting": "cutoff", "a": 5.0, "b": 3.0} in found.settings
    assert found.verdict == "agree"
    assert found.chi_squared == pytest.approx(0.0, abs=1e-9)
    assert any("same names" in note for note in found.notes)


def test_what_cannot_be_compared_is_refused(healthy, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    assert main(["compare", str(healthy), str(tmp_path / "empty"), "--out", str(tmp_path / "out")]) == 2
    assert str(tmp_path / "empty") in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    document = json.loads((healthy / "identification.json").read_text())
    document["model"]["chain"]["p"][1][0] += 0.3
    (tmp_path / "longer").mkdir()
    (tmp_path / "longer" / "identification.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match="different geometry"):
        compare(healthy, tmp_path / "longer")


def test_holm_by_hand():
    assert np.allclose(holm(np.array([0.04, 0.01, 0.03])), [0.06, 0.03, 0.06])


def test_correlated_differences_are_weighed_by_their_covariance():
    S = np.array([[1.0, 0.99], [0.99, 1.0]])
    along, across = overall(np.array([2.0, 2.0]), S), overall(np.array([2.0, -2.0]), S)
    assert along[0] == pytest.approx(8 / 1.99, rel=1e-6)
    assert across[0] == pytest.approx(8 / 0.01, rel=1e-4)
    assert across[1] < 1e-6 < along[1]
