"""Loaders of public sets with known faults: units, columns, truth, and one sentence where a file is another."""

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

FOLDER = Path(__file__).parents[1] / "experiments" / "real_faults"
OURS = ("recording", "arms", "ur", "voraus", "nist", "graabaek", "contact", "gap", "make", "score")


@pytest.fixture(scope="module")
def here():
    """The modules as `python make.py` imports them; other experiments have files of the same names."""
    kept = {name: sys.modules.pop(name, None) for name in OURS}
    sys.path.insert(0, str(FOLDER))
    yield SimpleNamespace(**{name: importlib.import_module(name) for name in OURS})
    sys.path.remove(str(FOLDER))
    for name, before in kept.items():
        sys.modules.pop(name, None)
        if before is not None:
            sys.modules[name] = before


def motion(n, rate=125.0, seconds=2.0, still=0.4):
    """(time, q [rad], qd [rad/s]): at rest first, then sines, joint after joint of another speed."""
    t = np.arange(0, seconds, 1 / rate)
    s = np.maximum(t - still, 0)[:, None]
    w = np.linspace(1.0, 2.0, n)
    return t, 0.3 * (1 - np.cos(w * s)) - 0.5, 0.3 * w * np.sin(w * s)


# ---------------------------------------------------------------------------------------------- the arms


@pytest.mark.parametrize(("arm", "mass"), [("ur5", 3.7 + 8.393 + 2.33 + 2 * 1.219 + 0.1879), ("ur5e", 17.7)])
def test_an_arm_has_the_kinematics_of_its_dh_table_and_its_mass(here, arm, mass):
    model = mujoco.MjModel.from_xml_string(getattr(here.arms, arm)())
    data = mujoco.MjData(model)
    q = np.array([0.3, -1.1, 0.8, 0.4, -0.7, 1.2])
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    a, d = (getattr(here.arms, f"{arm.upper()}_{k}") for k in "AD")
    np.testing.assert_allclose(data.site("flange").xpos, flange(a, d, q)[:3, 3], atol=1e-8)
    np.testing.assert_allclose(data.site("flange").xmat.reshape(3, 3), flange(a, d, q)[:3, :3], atol=1e-8)
    assert model.body_mass.sum() == pytest.approx(mass)


def flange(a, d, q):
    """Pose by $R_z(q) T_z(d) T_x(a) R_x(\\alpha)$, joint after joint."""
    T, h = np.eye(4), np.pi / 2
    for ai, di, al, qi in zip(a, d, (h, 0, 0, h, -h, 0), q, strict=True):
        c, s, ca, sa = np.cos(qi), np.sin(qi), np.cos(al), np.sin(al)
        T = T @ [[c, -s * ca, s * sa, ai * c], [s, c * ca, -c * sa, ai * s], [0, sa, ca, di], [0, 0, 0, 1]]
    return T


def test_the_stand_in_says_that_it_is_none(here):
    assert "NOT the Yu-Cobot" in here.arms.stand_in()
    assert mujoco.MjModel.from_xml_string(here.arms.stand_in()).nv == 6


# ------------------------------------------------------------------------------------------------ voraus


def voraus_file(folder, episodes, without=None, **changed):
    """A parquet file with these (sample, category, setting), below one another."""
    t, q, qd = motion(6, rate=100.0, seconds=1.0)
    parts: dict = {}
    add = lambda name, values: parts.setdefault(name, []).append(values)
    for sample, category, setting in episodes:
        add("time", t)
        for name, value in (("sample", sample), ("category", category), ("setting", setting)):
            add(name, np.full(len(t), value))
        add("anomaly", np.full(len(t), category != 12))
        for j in range(6):
            add(f"joint_position_{j + 1}", q[:, j])
            add(f"joint_velocity_{j + 1}", qd[:, j])
            add(f"torque_sensor_a_{j + 1}", 10.0 * (j + 1) + 0 * t)
            add(f"motor_torque_{j + 1}", 20.0 * (j + 1) + sample + 0 * t)
    table = {name: np.concatenate(values) for name, values in parts.items()} | changed
    table.pop(without, None)
    (folder / "voraus").mkdir(parents=True, exist_ok=True)
    path = folder / "voraus" / "some.parquet"
    pq.write_table(pa.table(table), path)
    return path


EPISODES = [(755, 12, 72), (1702, 12, 72), (1703, 12, 73), (12, 0, 1), (40, 2, 32), (41, 10, 62), (42, 9, 61)]


def test_voraus_episodes_are_cases_with_two_torques_and_the_axis_of_the_fault(here, tmp_path):
    voraus_file(tmp_path, EPISODES)
    cases = {case.name: case for case in here.voraus.cases(tmp_path)}
    assert set(cases) == {"voraus_control_1703", "voraus_fault_0012", "voraus_fault_0041"}
    case = cases["voraus_fault_0012"]
    assert (case.truth["families"], case.truth["joints"]) == (["friction"], [1])
    assert case.truth["side"] == "drive"  # by the stand-in nothing can be said of the links
    assert [r.source["sample"] for r in case.references] == [755, 1702]
    np.testing.assert_allclose(case.recording.tau[:, 2], 30)
    np.testing.assert_allclose(case.recording.tau_motor[:, 2], 72)
    assert cases["voraus_control_1703"].truth["families"] == []


def test_with_the_arm_s_own_file_contacts_are_cases_too(here, tmp_path):
    voraus_file(tmp_path, EPISODES)
    cases = {case.name: case for case in here.voraus.cases(tmp_path, yu="<mujoco/>")}
    assert cases["voraus_fault_0040"].truth["effects"] == ["external_contact"]
    assert cases["voraus_fault_0040"].truth["side"] is None
    assert "voraus_fault_0042" not in cases  # a wrong position is no fault of an arm


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"without": "torque_sensor_a_4"}, "has no column 'torque_sensor_a_4'"),
        ({"setting": np.arange(700) % 70}, "setting changes within sample"),
        ({"joint_position_2": np.full(700, 90.0)}, "not rad"),
        ({"time": np.zeros(700)}, "time of sample .* does not increase in row 2"),
        ({"motor_torque_1": np.full(700, np.nan)}, "tau_motor of sample .* is no number in row 1"),
    ],
)
def test_another_parquet_file_is_refused_in_a_sentence(here, tmp_path, change, message):
    voraus_file(tmp_path, EPISODES, **change)
    with pytest.raises(here.recording.BadFile, match=message):
        list(here.voraus.cases(tmp_path))


def test_motor_minus_sensor_gives_what_the_drive_lost(here, tmp_path):
    t, q, qd = motion(1)
    lost = 3 * np.tanh(qd / here.gap.SLOW) + 2 * qd + 0.5 * np.gradient(qd, t, axis=0) - 1
    log = here.recording.Recording("made here", t, q, qd, 0 * q, lost)
    here.recording.write_csv(tmp_path / "recording.csv", log)
    found = here.gap.losses(tmp_path / "recording.csv", 1)
    np.testing.assert_allclose(found, [3, -1, 2, 0.5, 0], atol=1e-5)


# -------------------------------------------------------------------------------------------------- NIST


def nist_file(here, folder, name, degrees=True, header=False, cells=None):
    """A trial as NIST has it: vectors in brackets, no header."""
    t, q, qd = motion(6)
    rows = np.zeros((len(t), 73))
    at = lambda what: slice(*(here.nist.COLUMNS.index(f"{here.nist.SIX[what]} (J1)") + k for k in (0, 6)))
    rows[:, 0] = 10_578.16 + t
    rows[:, at("q")] = np.rad2deg(q) if degrees else q
    rows[:, at("qd")] = rows[:, at("target_qd")] = qd
    rows[:, at("target_current")] = [0, -2.0, -1.5, 0.3, 0, 0]
    rows[:, at("target_torque")] = [0, -23.2, -17.4, 2.532, 0, 0]
    rows[:, at("current")] = [1.0, -2.0, 0, 0.5, 0, 0]
    lines = [",".join(here.nist.COLUMNS)] if header else []
    for row in rows[:, :cells]:
        said = [f"{x:.10g}" for x in row]
        said[1], said[6] = f'"({said[1]}', f'{said[6]})"'
        lines.append(",".join(said))
    path = folder / "nist_ur5" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")
    return path


TRIAL = "ur5testresult_halfspeed_payload1.6lb_1.csv"


@pytest.mark.parametrize("degrees", [True, False])
def test_nist_s_trial_is_read_in_radians_and_in_torque(here, tmp_path, degrees):
    log = here.nist.load(nist_file(here, tmp_path, TRIAL, degrees, header=degrees))
    t, q, qd = motion(6)
    np.testing.assert_allclose(log.time, t, atol=1e-6)
    np.testing.assert_allclose(log.q, q, atol=1e-8)
    np.testing.assert_allclose(log.qd, qd, atol=1e-8)
    np.testing.assert_allclose(log.tau[:, [0, 1, 3]], np.tile([11.6, -23.2, 4.22], (len(t), 1)))


def test_nist_s_names_say_what_changed(here, tmp_path):
    for name in (
        TRIAL,
        TRIAL.replace("lb_1", "lb_2"),
        TRIAL.replace("1.6", "4.5"),
        "ur5testresult_coldstart_halfspeed_payload4.5lb_1.csv",
        "ur5testresult_fullspeed_payload1.6lb_1.csv",
    ):
        nist_file(here, tmp_path, name)
    cases = {case.name: case for case in here.nist.cases(tmp_path)}
    kinds = {name: case.truth["kind"] for name, case in cases.items()}
    load = cases["nist_warm_half_1p6_to_warm_half_4p5"]
    assert load.truth["size"]["value"] == pytest.approx(2.9 * 0.45359237, abs=1e-4)
    assert cases["nist_warm_half_4p5_to_cold_half_4p5"].truth["families"] == ["friction"]
    assert kinds["nist_warm_half_1p6_to_warm_full_1p6"] == "control"
    assert kinds["nist_warm_half_1p6_repeat2"] == "control"
    assert cases["nist_warm_half_1p6_payload_rough"].truth["size"]["value"] == pytest.approx(0.7257)
    assert "nist_warm_half_4p5_to_warm_half_1p6" not in cases  # a body taken off is the same, once more
    halves = cases["nist_warm_half_1p6_halves"]
    assert halves.references[0].time[-1] < halves.recording.time[0]


def test_another_file_of_nist_s_is_refused_in_a_sentence(here, tmp_path):
    bad = here.recording.BadFile
    with pytest.raises(bad, match="row 1 has 70 columns, not 73"):
        here.nist.load(nist_file(here, tmp_path, TRIAL, cells=70))
    path = nist_file(here, tmp_path, TRIAL)
    path.write_text(path.read_text().replace("10578.17", "ten", 1))
    with pytest.raises(bad, match="row 3 holds a cell that is no number"):
        here.nist.load(path)
    with pytest.raises(bad, match="does not say speed, payload and trial"):
        here.nist.condition(path.with_name("some.csv"))
    copy = path.with_name(here.nist.COPY)
    copy.write_bytes(b"something else")
    with pytest.raises(bad, match=r"its sha256 begins with .* that of doi\.org"):
        here.nist.load(copy)


def test_torque_a_current_is_taken_at_rest_or_the_log_is_refused(here):
    qd = np.zeros((10, 6))
    current = np.tile([0.0, -2.0, -1.5, 0.3, 0.0, 0.0], (10, 1))
    constants = np.array([11.6] * 3 + [8.44] * 3)
    torque = current * constants
    found = here.ur.torque_constants("log", qd, current, torque)
    np.testing.assert_allclose(found, constants)
    torque[:, 1] *= 1.4
    with pytest.raises(here.recording.BadFile, match="is not target current times a number"):
        here.ur.torque_constants("log", qd, current, torque)
    with pytest.raises(here.recording.BadFile, match="no load of joints 4 to 6"):
        here.ur.torque_constants("log", qd, current * [1, 1, 1, 0, 0, 0], current * 11.6)


# ------------------------------------------------------------------------------- Graabaek's, and contacts


def graabaek_file(folder, name, label=None, without=None):
    t, q, qd = motion(6, rate=100.0)
    columns = {"timestamp": 5.0 + t}
    for j, (current, torque) in enumerate([(0, 0), (-2, -24), (-1, -12), (0.5, 4.5), (0, 0), (0, 0)]):
        columns |= {f"actual_q_{j}": q[:, j], f"actual_qd_{j}": qd[:, j], f"target_qd_{j}": qd[:, j]}
        columns |= {f"actual_current_{j}": 1 + 0 * t, f"target_current_{j}": current + 0 * t}
        columns |= {f"target_moment_{j}": torque + 0 * t, f"actual_TCP_force_{j}": 0 * t}
    columns.pop(without, None)
    path = folder / "graabaek_ur5e" / "data" / "stochastic_PnP" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, np.stack(list(columns.values()), 1), header=" ".join(columns), comments="")
    if label is not None:
        np.save(path.with_name(f"{path.stem}_label.npy"), label)
    return path


def test_graabaek_s_runs_are_cases_with_the_time_of_the_anomaly(here, tmp_path):
    for k in range(4):
        graabaek_file(tmp_path, f"normal/normal_r{k}.csv")
    label = np.zeros(200)
    label[50:100] = 32.0
    graabaek_file(tmp_path, "push/test/push_r0.csv", label)
    graabaek_file(tmp_path, "long_wait/test/long_wait_r0.csv", label)
    cases = {case.name: case for case in here.graabaek.cases(tmp_path)}
    assert set(cases) == {"graabaek_push", "graabaek_long_wait", "graabaek_normal_normal_r3"}
    push = cases["graabaek_push"]
    assert push.truth["intervals"] == [[pytest.approx(0.5), pytest.approx(0.99)]]
    assert (push.truth["families"], len(push.references)) == (["contact"], 3)
    np.testing.assert_allclose(push.recording.tau[0], [12, 12, 12, 9, 9, 9])
    np.testing.assert_allclose(push.recording.q, motion(6, rate=100.0)[1], atol=1e-12)
    assert cases["graabaek_long_wait"].truth["kind"] == "control"


def test_another_file_of_graabaek_s_is_refused_in_a_sentence(here, tmp_path):
    with pytest.raises(here.recording.BadFile, match="has no column 'actual_current_3' between blanks"):
        here.graabaek.load(graabaek_file(tmp_path, "push/a.csv", without="actual_current_3"))
    path = graabaek_file(tmp_path, "push/b.csv")
    with pytest.raises(here.recording.BadFile, match=r"has no b_label\.npy beside it"):
        here.graabaek.labelled(path)
    np.save(path.with_name("b_label.npy"), np.zeros(3))
    with pytest.raises(here.recording.BadFile, match="3 labels for 200 rows"):
        here.graabaek.labelled(path)


def contact_file(folder, without=None, factor=1.0):
    t, q, qd = motion(7, rate=200.0, seconds=8.0)
    columns = {"index": np.arange(len(t)), "time": t}
    for j in range(7):
        columns |= {f"tau_J{j}": j + 0.5 + 0 * t, f"q{j}": factor * q[:, j], f"dq{j}": qd[:, j]}
    columns["label"] = (t >= 6) & (t < 7)
    columns.pop(without, None)
    path = folder / "contact_panda" / "labeled_data" / "link3" / "e1.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(
        path, np.stack(list(columns.values()), 1), delimiter=",", header=",".join(columns), comments=""
    )
    return path


def test_a_touched_panda_is_a_case_and_what_comes_before_a_control(here, tmp_path):
    contact_file(tmp_path)
    touched, before = here.contact.cases(tmp_path)
    assert touched.truth["intervals"] == [[pytest.approx(6.0), pytest.approx(6.995)]]
    assert touched.model is None  # the project's own Panda
    np.testing.assert_allclose(touched.recording.tau[0], np.arange(7) + 0.5)
    assert (before.truth["kind"], before.recording.time[-1] < 6) == ("control", True)


def test_another_file_of_contacts_is_refused_in_a_sentence(here, tmp_path):
    with pytest.raises(here.recording.BadFile, match="has no column 'label'"):
        here.contact.load(contact_file(tmp_path, without="label"))
    with pytest.raises(here.recording.BadFile, match="not rad"):
        here.contact.load(contact_file(tmp_path, factor=57.3))


# ----------------------------------------------------------------------------------------- the two commands


def run(script, *arguments):
    command = [sys.executable, script, *map(str, arguments)]
    return subprocess.run(command, cwd=FOLDER, capture_output=True, text=True, check=False)


def test_make_writes_cases_and_says_what_is_not_here(here, tmp_path):
    voraus_file(tmp_path, EPISODES)
    done = run("make.py", "--data", tmp_path, "--out", tmp_path / "cases")
    assert done.returncode == 0, done.stderr
    assert "nist_ur5: not under" in done.stdout
    assert "zenodo.org/records/5849300" in done.stdout
    case = tmp_path / "cases" / "voraus_fault_0012"
    head = (case / "recording.csv").read_text().splitlines()[0].split(",")
    assert head == ["time"] + [f"{k}_{j}" for k in ("q", "dq", "tau", "tau_motor") for j in range(1, 7)]
    assert (case / "reference_1.csv").exists()
    told = json.loads((case / "truth.json").read_text())
    assert told["sources"]["recording"]["upstream"] == "github.com/vorausrobotik/voraus-ad-dataset"


def test_make_ends_with_2_and_one_sentence_where_a_file_is_another(here, tmp_path):
    voraus_file(tmp_path, EPISODES, without="motor_torque_6")
    done = run("make.py", "--data", tmp_path, "--out", tmp_path / "cases", "--only", "voraus")
    assert done.returncode == 2
    assert done.stderr.strip().count("\n") == 0
    assert "has no column 'motor_torque_6'" in done.stderr
    assert run("make.py", "--data", tmp_path / "no", "--out", tmp_path / "cases").returncode == 2


def answered(here, folder, name, truth, findings, status=0):
    """A case with its answer, as make.py and `jaxpanda diagnose` leave them."""
    case, out = folder / "cases" / name, folder / "answers" / name
    case.mkdir(parents=True)
    out.mkdir(parents=True)
    sources = {"recording": {"set": "some"}}
    (case / "truth.json").write_text(json.dumps({**truth, "sources": sources}))
    (out / "run.json").write_text(json.dumps({"status": status, "seconds": 1.0}))
    (out / "log.txt").write_text("why not\n")
    fit = {"held_out_rmse_before": [3.0, 4.0], "held_out_rmse_after": [0.3, 0.4]}
    said = {"verdict": "explained", "findings": findings, "fit": fit, "fit_motor": None}
    (out / "diagnosis.json").write_text(json.dumps(said))
    return here.score.judge(case, out)


def finding(effect, joints, confidence, **more):
    blank = {"intervals": None, "family": "", "parameters": []}
    return {"effect": effect, "joints": joints, "confidence": confidence, **blank, **more}


def test_score_counts_family_joint_time_and_alarms(here, tmp_path):
    truth = here.recording.truth
    friction = truth("fault", "friction", ["friction"], (), [1], side="drive")
    said = [finding("coulomb_friction", [1], 0.7, side="drive"), finding("payload", [6], 0.95, side="link")]
    located = answered(here, tmp_path, "a", friction, said)
    assert (located["family_joint"], located["other"], located["name"]) == (0.7, 0.0, None)
    elsewhere = answered(here, tmp_path, "b", friction, [finding("coulomb_friction", [2], 0.7, side="drive")])
    assert (elsewhere["family"], elsewhere["family_joint"]) == (0.7, 0.0)
    push = truth("fault", "push", ["contact"], ["external_contact"], None, intervals=[[1.0, 2.0]])
    late = answered(
        here, tmp_path, "c", push, [finding("external_contact", [3], 0.9, intervals=[[3.0, 4.0]])]
    )
    assert late["family"] == 0.0
    size = {"name": "mass", "value": 0.7, "unit": "kg"}
    load = truth("fault", "load", ["load"], ["payload"], None, size=size, beside=["friction"])
    mass = [{"name": "mass", "joint": None, "value": 0.8, "std": 0.1, "unit": "kg"}]
    said = [finding("payload", [6], 0.9, parameters=mass), finding("viscous_friction", [1], 0.99)]
    found = answered(here, tmp_path, "d", load, said)
    assert (found["name"], found["mass"], found["other"]) == (0.9, (0.8, 0.1), 0.0)
    assert found["before"] == pytest.approx(12.5**0.5)
    alarm = answered(here, tmp_path, "e", truth("control", "none"), [finding("torque_drift", [1], 0.6)])
    refused = answered(here, tmp_path, "f", truth("control", "none"), [], status=2)
    table = here.score.figures([located, elsewhere, late, found, alarm, refused])
    assert table["answered"] == (5, 6)
    assert table["faults with the right family and joint at 0.5"] == (1, 2)
    assert table["faults with the right family at 0.5"] == (3, 4)
    assert table["controls with a claim at 0.5"] == (1, 1)
    assert table["controls with a claim at 0.9"] == (0, 1)
    assert "no answer, status 2: why not" in here.score.report([found, refused])


# ------------------------------------------------------------------------------------------ real samples


@pytest.mark.slow
@pytest.mark.skipif("JAXPANDA_DATA" not in os.environ, reason="JAXPANDA_DATA is not set")
def test_the_real_samples_are_what_upstream_says(here):
    data = Path(os.environ["JAXPANDA_DATA"])
    if not here.voraus.files(data) or not here.nist.files(data):
        pytest.skip("neither voraus nor nist_ur5 under JAXPANDA_DATA")
    names = {case.name for case in here.voraus.cases(data)}
    assert names == {"voraus_control_1703", "voraus_fault_0012"}
    (path,) = here.nist.files(data)
    log = here.nist.load(path)
    np.testing.assert_allclose(log.source["N m/A"], [11.6] * 3 + [8.44] * 3, atol=0.01)
    # the UR5's DH parameters put a tool 0.19 m long where the controller says that it is
    q, place = here.nist.tool(path)
    poses = [flange(here.arms.UR5_A, here.arms.UR5_D, x) for x in q[::50]]
    A, b = (np.concatenate(x) for x in ([T[:3, :3] for T in poses], place[::50] - [T[:3, 3] for T in poses]))
    offset, *_ = np.linalg.lstsq(A, b, rcond=None)
    assert np.sqrt(np.mean((A @ offset - b) ** 2)) < 1e-3
    np.testing.assert_allclose(offset, [0, 0, 0.186], atol=2e-3)
