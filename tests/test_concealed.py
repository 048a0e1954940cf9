"""The blind trial itself is tried: its arms obey their own physics, and its scorer cannot be flattered."""

import ast
import json
import sys
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).parents[1] / "experiments" / "concealed"
NAMES = {
    "viscous_friction",
    "coulomb_friction",
    "asymmetric_friction",
    "stribeck_friction",
    "load_dependent_friction",
    "friction_drift",
    "presliding_hysteresis",
    "torque_ripple",
    "backlash",
    "joint_elasticity",
    "armature",
    "inertial_parameters",
    "payload",
    "payload_change",
    "gravity_direction",
    "joint_spring",
    "torque_offset",
    "torque_gain",
    "torque_drift",
    "torque_crosstalk",
    "encoder_offset",
    "time_delay",
    "external_contact",
}


@pytest.fixture(scope="module")
def trial():
    """The experiment's modules, which stand beside each other as scripts do."""
    sys.path.insert(0, str(FOLDER))
    import cases
    import effects
    import make
    import score

    sys.path.remove(str(FOLDER))
    return {"cases": cases, "effects": effects, "make": make, "score": score}


def simulated(trial, kinds, strengths, seed, nasty=""):
    cases = trial["cases"]
    stratum = ("null", "single", "pair")[len(kinds)]
    case = cases.Case((900, seed, 0), cases.Plan(stratum, kinds, strengths, nasty))
    case.simulate()
    return case


def test_the_trial_shares_no_code_with_the_analysis():
    paths = [*FOLDER.glob("*.py"), FOLDER.parent / "scoring.py"]
    own = {FOLDER.name, *(path.stem for path in paths)}
    allowed = set(sys.stdlib_module_names) | {"numpy", "scipy", "mujoco"} | own
    imported = set()
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in node.names}
            if isinstance(node, ast.ImportFrom):
                assert node.level == 0
                imported.add(node.module.split(".")[0])
    assert "numpy" in imported
    assert imported <= allowed


def test_every_effect_of_the_interface_is_concealed_and_none_twice(trial):
    names = [kind.name for kind in trial["effects"].CATALOGUE]
    assert len(names) == len(set(names))
    assert set(names) == NAMES
    outside = [kind.name for kind in trial["effects"].OUTSIDE]
    assert len(outside) >= 6
    assert all(name.startswith("outside:") for name in outside)


@pytest.mark.parametrize("nasty", ["friction", "narrow"])
def test_with_nothing_concealed_torque_is_inverse_dynamics(trial, nasty):
    case = simulated(trial, (), (), 3, nasty)
    plant, run = case.runs[0]
    engine_velocity = run.v - 0.5 * trial["cases"].STEP * run.a
    exact = plant.read(run.t, run.q, engine_velocity, run.a)
    assert np.max(np.abs(run.tau - exact)) < 1e-3
    # What the half step between the engine's velocity and the recorded one leaves, against the noise:
    error = run.tau - plant.read(run.t, run.q, run.v, run.a)
    assert np.all(trial["cases"].rmse(error) < 0.1 * case.noise_std)


@pytest.mark.parametrize("kind", ["Coulomb", "Presliding", "Elasticity", "Contact", "Gain"])
def test_the_true_model_explains_the_motion_and_the_users_does_not(trial, kind):
    cases = trial["cases"]
    case = simulated(trial, (getattr(trial["effects"], kind),), ("medium",), 5)
    record = case.records - 1
    plant, run = case.runs[record]
    q, tau = run.q, run.tau
    for effect in plant.effects:
        q, tau = effect.observe(run.t, q, tau)
    user = cases.Plant(case.user_arm, [], case.transition)
    joint = int(np.argmax(case.rms[0] / case.noise_std))
    left = cases.rmse(tau - plant.read(run.t, q, run.v, run.a))[joint]
    before = cases.rmse(tau - user.read(run.t, q, run.v, run.a))[joint]
    assert left < 0.35 * before
    assert case.strengths[0][0] == pytest.approx(5.0, rel=0.2)


def test_a_case_is_written_in_the_format_of_recordings_and_is_the_same_for_the_same_seed(trial, tmp_path):
    plan = trial["cases"].Plan("single", (trial["effects"].Viscous,), ("medium",))
    for name in ("one", "two"):
        trial["make"].write_case((901, 4, plan, str(tmp_path / name)))
    files = sorted(path.name for path in (tmp_path / "one").iterdir())
    assert {"model.xml", "truth.json", "train_0.csv", "heldout.csv", "heldout_motion.csv"} <= set(files)
    for name in files:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
    header = (tmp_path / "one" / "train_0.csv").read_text().splitlines()[0].split(",")
    channels = [f"{channel}_{j}" for channel in ("q", "dq", "tau") for j in range(1, 8)]
    assert header == ["time", *channels]
    table = np.loadtxt(tmp_path / "one" / "train_0.csv", delimiter=",", skiprows=1)
    assert np.all(np.isfinite(table))
    assert np.all(np.diff(table[:, 0]) > 0)
    truth = json.loads((tmp_path / "one" / "truth.json").read_text())
    assert truth["effects"][0]["effect"] == "viscous_friction"
    held = truth["heldout"]
    joint = truth["effects"][0]["joints"][0] - 1
    assert held["rmse_nominal"][joint] > 1.2 * held["rmse_true_model"][joint]


def finding(effect, joints, confidence=1.0, intervals=None):
    return {"effect": effect, "joints": joints, "confidence": confidence, "intervals": intervals}


def judged(score, folder, truth, findings, verdict, share):
    """Outcome of a hand-made answer whose prediction goes `share` of the way (of the error) to the truth."""
    case, out = folder / "case", folder / "out"
    case.mkdir(parents=True)
    out.mkdir()
    rng = np.random.default_rng(0)
    t = np.arange(0, 4, 0.01)
    noise = 0.1 * rng.standard_normal((len(t), 7))
    missing = np.zeros((len(t), 7))
    missing[:, 3] = np.sin(3 * t)
    inner = (t > 0.3) & (t < 3.69)
    rms = lambda x: np.sqrt(np.mean(x[inner] ** 2, axis=0)).tolist()
    truth = {
        "noise_std": [0.1] * 7,
        "family": "pick",
        "nominal": "exact",
        "heldout": {"rmse_nominal": rms(noise + missing), "rmse_true_model": rms(noise)},
        **truth,
    }
    (case / "truth.json").write_text(json.dumps(truth))
    header = "time," + ",".join(f"tau_{j}" for j in range(1, 8))
    for path, tau in ((case / "heldout.csv", noise + missing), (out / "heldout.csv", share * missing)):
        np.savetxt(path, np.column_stack([t, tau]), delimiter=",", header=header, comments="")
    (out / "diagnosis.json").write_text(json.dumps({"verdict": verdict, "findings": findings}))
    (out / "run.json").write_text(json.dumps({"case": "case", "status": 0, "seconds": 1.0, "message": ""}))
    return score.judge(case, out)


def truth_of(*effects, stratum="single", strengths=("medium",)):
    entries = [{"effect": e, "joints": j, "intervals": i} for e, j, i in effects]
    return {"effects": entries, "stratum": stratum, "strengths": list(strengths)}


def test_right_answers_score_full_marks(trial, tmp_path):
    score = trial["score"]
    results = [
        judged(
            score,
            tmp_path / "a",
            truth_of(("armature", [4], None)),
            [finding("armature", [4])],
            "explained",
            1.0,
        ),
        judged(
            score,
            tmp_path / "b",
            truth_of(("external_contact", [6], [[2.0, 3.0]])),
            [finding("external_contact", [6], 1.0, [[2.0, 3.0]])],
            "explained",
            1.0,
        ),
        judged(
            score,
            tmp_path / "c",
            truth_of(("armature", [4], None), ("torque_gain", [2], None), stratum="pair"),
            [finding("torque_gain", [2]), finding("armature", [4])],
            "explained",
            1.0,
        ),
        judged(score, tmp_path / "d", truth_of(stratum="null", strengths=()), [], "consistent", 0.0),
        judged(
            score,
            tmp_path / "e",
            truth_of(("outside:detent", [4], None), stratum="outside"),
            [finding("unknown", [4])],
            "partly_explained",
            1.0,
        ),
    ]
    table = score.figures(results)
    assert table["named right, medium"] == (1.0, 2)
    assert table["joints exact, medium"] == (1.0, 1)
    assert table["interval IoU, median"] == (1.0, 1)
    assert table["false alarms"] == (0.0, 1)
    assert table["pairs, recall"] == (1.0, 2)
    assert table["pairs, precision"] == (1.0, 2)
    assert table["outside, unknown or not fully explained"] == (1.0, 1)
    assert table["Brier score"] == (0.0, 4)
    assert table["gap closed, median"][0] == pytest.approx(1.0, abs=1e-3)
    assert "missed" not in score.as_text({k: v for k, v in table.items() if v[0] is not None})
    assert score.misses(results) == "none"


def test_wrong_answers_score_nothing_and_are_listed(trial, tmp_path):
    score = trial["score"]
    results = [
        judged(
            score,
            tmp_path / "a",
            truth_of(("armature", [4], None)),
            [finding("torque_gain", [4, 5], 0.9)],
            "explained",
            0.5,
        ),
        judged(
            score, tmp_path / "b", truth_of(("external_contact", [6], [[2.0, 3.0]])), [], "consistent", 0.0
        ),
        judged(
            score,
            tmp_path / "c",
            truth_of(stratum="null", strengths=()),
            [finding("armature", [1], 0.6)],
            "explained",
            -0.2,
        ),
        judged(
            score,
            tmp_path / "d",
            truth_of(("outside:detent", [4], None), stratum="outside"),
            [finding("joint_spring", [4], 1.0)],
            "explained",
            0.2,
        ),
    ]
    table = score.figures(results)
    assert table["named right, medium"] == (0.0, 2)
    assert table["joints exact, medium"] == (0.0, 1)
    assert table["interval IoU, median"] == (0.0, 1)
    assert table["false alarms"] == (1.0, 1)
    assert table["outside, unknown or not fully explained"] == (0.0, 1)
    assert table["Brier score"][0] == pytest.approx((0.81 + 0.36 + 1.0) / 3)
    assert results[0]["gap_closed"] == pytest.approx(0.75, abs=0.05)
    assert results[2]["harm"] > 1.1
    assert len(score.misses(results).splitlines()) == 4
    lines = score.confusion(results).splitlines()
    assert next(line for line in lines if line.startswith("armature")).split()[1:].count("1") == 1


def test_overlap_of_intervals_is_intersection_over_union(trial):
    overlap = trial["score"].overlap
    assert overlap([[0, 2]], [[1, 3]]) == pytest.approx(1 / 3)
    assert overlap([[0, 1], [2, 3]], [[0, 3]]) == pytest.approx(2 / 3)
    assert overlap([[0, 1]], [[2, 3]]) == 0.0


def test_no_alarm_in_a_hundred_cases_bounds_the_rate_at_three_per_cent(trial):
    assert trial["score"].at_most(0, 100) == pytest.approx(0.0295, abs=1e-4)
    assert trial["score"].at_most(3, 3) == 1.0


def test_the_tool_is_called_through_its_command_line_and_its_failures_are_outcomes(trial):
    status, printed = trial["score"].call(["predict", "--diagnosis", "nowhere", "--recording", "no.csv"])
    assert status == 2
    assert printed
