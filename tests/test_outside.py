"""The figures of `experiments/scoring.py`, on answers made by hand."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

EXPERIMENTS = Path(__file__).resolve().parents[1] / "experiments"


@pytest.fixture(scope="module")
def scoring():
    sys.path.insert(0, str(EXPERIMENTS))
    yield importlib.import_module("scoring")
    sys.path.remove(str(EXPERIMENTS))


def entry(effect, joints, rms, **more):
    return {
        "effect": effect,
        "joints": joints,
        "rms_torque": rms,
        "parameters": [],
        "intervals": None,
        **more,
    }


def truth(*effects, **more):
    return {"effects": list(effects), "noise_std": [0.1, 0.1], "kind": "hand-made", **more}


def finding(effect, joints, confidence=0.95, **more):
    return {"effect": effect, "joints": joints, "confidence": confidence, **more}


def answer(*findings, verdict="explained"):
    return {"findings": list(findings), "verdict": verdict}


def test_a_truth_below_the_noise_does_not_count_for_recall_but_a_claim_of_it_is_right(scoring):
    told = truth(entry("viscous_friction", [1, 2], [1.0, 0.05]))
    result = scoring.judge(told, answer(finding("viscous_friction", [2])))
    assert result["effect, joint"] == (0, 1, 1, 1)


def test_what_is_optional_in_a_truth_may_be_said_or_left_out(scoring):
    told = truth(entry("presliding_hysteresis", [1], [1.0, 0.0], optional=True))
    assert scoring.judge(told, answer())["effect, joint"] == (0, 0, 0, 0)
    assert scoring.judge(told, answer(finding("presliding_hysteresis", [1])))["effect, joint"] == (0, 0, 1, 1)


def test_a_wrong_name_of_the_right_family_counts_for_the_family_only(scoring):
    told = truth(entry("coulomb_friction", [1], [1.0, 0.0]))
    result = scoring.judge(told, answer(finding("viscous_friction", [1])))
    assert result["effect, joint"] == (0, 1, 0, 1)
    assert result["family, joint"] == (1, 1, 1, 1)
    assert result["missed"] == []


def test_an_equally_right_name_is_right_at_the_same_joint_only(scoring):
    told = truth(entry("coulomb_friction", [1], [1.0, 0.0], also=["presliding_hysteresis"]))
    assert scoring.judge(told, answer(finding("presliding_hysteresis", [1])))["effect, joint"] == (1, 1, 1, 1)
    assert scoring.judge(told, answer(finding("presliding_hysteresis", [2])))["effect, joint"] == (0, 1, 0, 1)


def test_the_joint_of_an_effect_of_the_whole_arm_is_not_asked(scoring):
    told = truth(entry("payload", [2], [1.0, 1.0], also=["inertial_parameters"]))
    assert scoring.judge(told, answer(finding("inertial_parameters", [1])))["effect, joint"] == (1, 1, 1, 1)


def test_what_is_allowed_is_neither_right_nor_wrong(scoring):
    told = truth(allowed=[{"effect": "presliding_hysteresis", "joints": [1]}])
    at_one = scoring.judge(told, answer(finding("presliding_hysteresis", [1])))
    assert at_one["effect, joint"] == (0, 0, 0, 0)
    assert at_one["findings"] == []
    at_two = scoring.judge(told, answer(finding("presliding_hysteresis", [2])))
    assert at_two["effect, joint"] == (0, 0, 0, 1)
    assert at_two["findings"] == [(0.95, False)]


def test_an_unknown_with_a_family_is_of_that_family(scoring):
    told = truth(entry("coulomb_friction", [1], [1.0, 0.0]))
    result = scoring.judge(told, answer(finding("unknown", [1], family="friction")))
    assert result["effect, joint"] == (0, 1, 0, 1)
    assert result["family, joint"] == (1, 1, 1, 1)


def test_names_of_the_other_trial_for_what_is_outside_are_unknown(scoring):
    told = truth(entry("outside:something", [1], [1.0, 0.0]))
    assert scoring.judge(told, answer(finding("unknown", [1], family="load")))["effect, joint"] == (
        1,
        1,
        1,
        1,
    )


def test_a_finding_is_right_at_half_of_its_joints(scoring):
    places = scoring.truth_places(truth(entry("armature", [1], [1.0, 0.0])))
    assert scoring.is_right(places, finding("armature", [1, 2]))
    assert not scoring.is_right(places, finding("armature", [2]))


def test_explained_with_something_missing_is_counted(scoring):
    told = truth(entry("armature", [1], [0.16, 0.0]), entry("torque_offset", [2], [0.0, 0.14]))
    result = scoring.judge(told, answer())
    assert result["missed"] == [("armature", 1)]
    table = scoring.figures([result, scoring.judge(told, answer(finding("armature", [1])))])
    assert table["explained, but 1.5x noise is missing"] == (0.5, 2)


def test_calibration_error_of_a_known_table(scoring):
    findings = [(0.95, True)] * 3 + [(0.95, False)] + [(0.55, True)] * 2
    # four at 0.95 of which 0.75 are right, two at 0.55 that all are
    assert scoring.calibration_error(findings) == pytest.approx((4 * 0.2 + 2 * 0.45) / 6)
    assert [row[2] for row in scoring.reliability(findings)] == [2, 4]
    assert scoring.reliability([(1.0, True)])[0][:3] == (0.95, 1.0, 1)


def test_false_claims_are_counted_a_case_and_brier_over_all_findings(scoring):
    told = truth(entry("armature", [1], [1.0, 0.0]))
    false = finding("backlash", [2], 0.9)
    results = [
        scoring.judge(told, answer(finding("armature", [1], 1.0), false)),
        scoring.judge(told, answer()),
    ]
    table = scoring.figures(results)
    assert table["false claims at 0.9 or more, a case"] == (0.5, 2)
    assert table["right of the claims at 0.9 or more"] == (0.5, 2)
    assert table["Brier score, all findings"][0] == pytest.approx(0.81 / 2)
    assert table["recall (effect, joint)"] == (0.5, 2)
    assert table["precision (effect, joint)"] == (0.5, 2)


def test_harm_needs_both_ten_percent_and_the_noise(scoring):
    noise = np.array([1.0, 1.0])
    assert not scoring.does_harm(np.array([1.3, 1.0]), np.array([1.0, 1.0]), noise)
    assert scoring.does_harm(np.array([1.0, 1.5]), np.array([1.0, 1.0]), noise)
    assert not scoring.does_harm(np.array([20.5, 1.0]), np.array([20.0, 1.0]), noise)


def test_coverage_compares_numbers_of_one_joint(scoring):
    def number(name, joint, value, **more):
        return {"name": name, "joint": joint, "value": value, **more}

    told = truth(entry("viscous_friction", [1, 2], [1.0, 1.0]))
    told["effects"][0]["parameters"] = [number("damping", 1, 1.0), number("damping", 2, 2.0)]
    said = finding("viscous_friction", [1], parameters=[number("damping", 1, 1.1, std=0.1)])
    assert scoring.judge(told, answer(said))["covered"] == [True]
    said = finding("viscous_friction", [2], parameters=[number("damping", 2, 1.0, std=0.1)])
    assert scoring.judge(told, answer(said))["covered"] == [False]


def test_the_held_out_gap(scoring, tmp_path):
    t = np.arange(0, 10, 0.01)
    motion = np.sin(t)
    header = "time,tau_1"
    for name, tau in (("heldout.csv", motion), ("half.csv", 0.5 * motion)):
        np.savetxt(tmp_path / name, np.column_stack([t, tau]), delimiter=",", header=header, comments="")
    rows = (t > 0.3) & (t < t[-1] - 0.3)
    nominal = float(np.sqrt(np.mean(motion[rows] ** 2)))
    told = {"noise_std": [0.1], "heldout": {"rmse_nominal": [nominal], "rmse_true_model": [0.0]}}
    harm, closed = scoring.held_out(told, tmp_path, tmp_path / "half.csv")
    assert not harm
    assert closed == pytest.approx(0.75)


def test_no_figure_fails_on_silence(scoring):
    result = scoring.judge(truth(), answer(verdict="consistent"))
    assert "recall" in scoring.as_text([result])
    assert scoring.figures([result])["nulls with a finding that is not allowed"] == (0.0, 1)
