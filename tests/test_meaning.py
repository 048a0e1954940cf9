"""What a torque column is: other readings are named, and models that are merely poor are not taken for them.

The recordings are those of `experiments/torque_meaning`: torque is MuJoCo's, nothing of it is our own dynamics.
"""

import dataclasses
import importlib
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import result

from jaxpanda import Recording
from jaxpanda.__main__ import main
from jaxpanda.arms.source import from_mjcf
from jaxpanda.diagnosis.finding import FAMILIES
from jaxpanda.effects import CATALOGUE
from jaxpanda.meaning import borne_out, meaning
from jaxpanda.recordings import save

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
_MODULES = "run", "arms", "motion", "plant"
CASE = 1000, 12.0, 200.0, "panda_like"
"""Seed, seconds, rate and arm of the recordings."""


@pytest.fixture(scope="module")
def trial():
    """The experiment; other experiments have modules of the same names."""
    others = {name: sys.modules.pop(name, None) for name in _MODULES}
    path = list(sys.path)
    sys.path.insert(0, str(EXPERIMENTS / "torque_meaning"))
    yield importlib.import_module("run")
    sys.path[:] = path
    for name, module in others.items():
        sys.modules.pop(name, None)
        if module is not None:
            sys.modules[name] = module


def named(trial, case: str):
    """What is said of a case, which must be right, and be mended by the options that come with it."""
    text, recording = trial.made(case, *CASE)
    found, _ = trial.read(text, recording)
    assert found is not None
    assert found.kind == trial.WRONG[case]
    assert f"`{found.options}`" in found.summary
    assert trial.read(text, recording, found.options)[0] is None
    return found


def test_torque_without_gravity_is_named(trial):
    assert named(trial, "gravity_removed").options == "--gravity removed"


def test_a_reversed_sign_is_named_with_its_joint(trial):
    found = named(trial, "sign of one")
    (joint,) = found.joints
    assert found.options.split()[1:] == ["-" if j == joint else "+" for j in range(7)]


def arm_of(text, folder):
    (folder / "arm.xml").write_text(text)
    return from_mjcf(folder / "arm.xml")[0]


@pytest.mark.slow
def test_all_signs_reversed_are_one_sign(trial):
    assert named(trial, "sign of all").options == "--torque-sign -"


def test_a_unit_is_named(trial):
    assert named(trial, "N mm").options == "--torque-unit mNm"


@pytest.mark.slow
def test_currents_are_named_with_what_they_are_worth(trial):
    found = named(trial, "current")
    worth = 1 / np.array(found.factors)  # 5 to 18 N·m/A; friction hides some of it
    assert 5 < np.median(worth) < 18
    assert np.all(worth < 30)


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", ["motor side", "one in N mm", "two torques swapped", "tilt", "moon", "ceiling"]
)
def test_other_meanings_are_named(trial, case):
    named(trial, case)


@pytest.mark.slow
def test_columns_out_of_order_are_put_in_order(trial):
    found = named(trial, "two joints swapped")
    assert found.whole_order
    assert len(found.joints) == 2


def test_another_mounting_is_named(trial):
    found = named(trial, "wall")
    assert "on a wall" in found.says
    assert np.linalg.norm(found.gravity) == pytest.approx(9.81, abs=1.0)


def test_a_mounting_is_one_of_all_recordings(trial, tmp_path):
    """Friction of one recording may look like another gravity; the arm stands as the other recording shows it."""
    text, turned = trial.made("wall", *CASE)
    arm = arm_of(text, tmp_path)
    found = meaning(turned, arm)
    assert found is not None
    seeming = dataclasses.replace(found, evidence=40.0)
    assert borne_out(seeming, [], arm)
    assert borne_out(seeming, [turned], arm)
    assert not borne_out(seeming, [trial.made("exact", *CASE)[1]], arm)


@pytest.mark.slow
def test_a_unit_of_one_recording_alone_takes_more_than_that_of_all(trial, tmp_path):
    """Friction that sticks may look like another unit for a while; the same logger wrote the other recording."""
    text, scaled = trial.made("N mm", *CASE)
    arm = arm_of(text, tmp_path)
    found = meaning(scaled, arm)
    assert found is not None
    plain = trial.made("exact", *CASE)[1]
    assert borne_out(found, [plain], arm)  # whoever mixes loggers is told
    seeming = dataclasses.replace(found, evidence=22.0)
    assert borne_out(seeming, [scaled], arm)
    assert not borne_out(seeming, [plain], arm)


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", ["exact", "friction", "links", "payload", "gain", "level", "offset", "delay"]
)
def test_what_is_missing_in_a_model_is_no_fault_of_the_column(trial, case):
    """Each of these is physics, or a number that is somewhat off."""
    assert trial.read(*trial.made(case, *CASE))[0] is None


def test_friction_that_stands_in_the_file_for_nothing_is_no_unit(trial, tmp_path):
    """Joints without a load had "another unit" where the file's damping was a hundred times too large."""
    text, recording = trial.made("exact", *CASE)
    arm = arm_of(text, tmp_path)
    heavy = dataclasses.replace(arm, damping=arm.damping + 10.0, frictionloss=arm.frictionloss + 3.0)
    assert meaning(recording, heavy) is None


def test_too_little_to_tell_is_told_nothing(trial, tmp_path):
    text, whole = trial.made("N mm", *CASE)
    arm = arm_of(text, tmp_path)
    short = Recording("short", whole.time[:400], whole.q[:400], whole.qd[:400], whole.tau[:400])
    assert meaning(short, arm) is None
    assert meaning(Recording("motion", whole.time, whole.q, whole.qd), arm) is None
    still = Recording("rest", whole.time, 0 * whole.q + whole.q[0], 0 * whole.qd, whole.tau)
    assert meaning(still, arm) is None


@pytest.mark.slow
def test_samples_on_either_side_of_a_gap_at_the_end_are_read(trial):
    """The last of the samples that are compared lay behind the end of the recording."""
    text, recording = trial.made("N mm", *CASE)
    keep = np.r_[0:2000, 2200:2400]
    parts = (x[keep] for x in (recording.time, recording.q, recording.qd, recording.tau))
    found, _ = trial.read(text, Recording("gap", *parts))
    assert found is not None
    assert found.kind == "unit"


@pytest.fixture
def files(trial, tmp_path):
    """A model and a recording whose torque is without gravity, and the command to diagnose it."""
    text, recording = trial.made("gravity_removed", *CASE)
    (tmp_path / "arm.xml").write_text(text)
    save(recording, tmp_path / "free.csv")
    return tmp_path, ["--model", str(tmp_path / "arm.xml"), "--recording", str(tmp_path / "free.csv")]


@pytest.mark.slow
def test_diagnose_says_what_the_column_is_and_seeks_no_physics_in_it(files):
    folder, given = files
    assert main(["diagnose", *given, "--out", str(folder / "out")]) == 0
    document = result(folder / "out" / "diagnosis.json")
    (finding,) = document["findings"]
    assert (finding["effect"], finding["family"]) == ("torque_meaning", "meaning")
    assert finding["kind"] == "gravity_removed"
    assert "--gravity removed" in finding["summary"]
    assert document["verdict"] in ("unexplained", "partly_explained")
    assert (folder / "out" / "corrected.xml").read_text() == (folder / "arm.xml").read_text()
    assert "--gravity removed" in (folder / "out" / "report.html").read_text()


def test_every_effect_of_the_catalogue_has_a_family():
    words = {"friction", "drive", "load", "sensor", "clock", "contact", "meaning", "unknown"}
    assert set(FAMILIES.values()) == words
    assert {effect.name for effect in CATALOGUE} - {"unknown"} <= set(FAMILIES)
