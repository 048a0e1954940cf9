"""The commands: what they leave, what they print, and how they refuse."""

import dataclasses
import json
import pickle
import re
import shutil
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest
from helpers import excitation, result

import jaxpanda
from jaxpanda.__main__ import main
from jaxpanda.diagnosis.commands import plainly
from jaxpanda.files import write_json
from jaxpanda.recordings import save
from jaxpanda.recordings.recording import Recording


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    """Four seconds of the virtual Panda."""
    from jaxpanda.demo import record

    path = tmp_path_factory.mktemp("recordings") / "arm.csv"
    log = record(seed=3, duration=4.0).recording
    save(log, path)
    return path


ROOT = Path(__file__).parents[1]
MODELS = ROOT / "tests" / "models"


def shaken(arm, extra=None, seconds: float = 8.0) -> Recording:
    """A motion of every joint of an arm, with a little noise on its torque; `extra(qd)` is added to that."""
    rng, t = np.random.default_rng(0), np.arange(int(200 * seconds)) / 200
    q, qd, qdd = excitation(eqx.tree_at(lambda a: (a.lower, a.upper), arm, 2 * (np.zeros(arm.dof),)), t, 0)
    tau = np.asarray(jax.vmap(arm.inverse_dynamics)(q, qd, qdd)) + 0.05 * rng.normal(size=q.shape)
    return Recording("shaken.csv", t, q, qd, tau if extra is None else tau + extra(qd))


def refused(capsys, *arguments: str) -> str:
    """The one line that a refused command leaves on standard error."""
    assert main(list(arguments)) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("jaxpanda: ")
    assert err.count("\n") == 1
    return err


def test_help_needs_no_jax():
    code = (
        "import sys; sys.argv = ['jaxpanda', '--help']\n"
        "from jaxpanda.__main__ import main\n"
        "try: main()\n"
        "except SystemExit as stop: assert not stop.code\n"
        "assert not {'jax', 'numpy', 'mujoco', 'scipy'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "identify" in done.stdout


def test_the_terminal_is_told_of_a_command_before_jax_is_imported():
    """A diagnosis was silent for its first seconds, and for as long as it took."""
    code = (
        "import io, sys\n"
        "class Terminal(io.StringIO):\n"
        "    def isatty(self): return True\n"
        "    def write(self, text):\n"
        "        if not self.getvalue(): seen.append((text, 'jax' in sys.modules))\n"
        "        return super().write(text)\n"
        "seen, sys.stderr = [], Terminal()\n"
        "from jaxpanda.__main__ import main\n"
        "assert main(['diagnose', '--recording', 'missing.csv', '--out', 'never']) == 2\n"
        "print(seen)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "[('jaxpanda diagnose: starting', False)]\n", done.stderr


def test_every_public_name_resolves():
    for name in dir(jaxpanda):
        assert getattr(jaxpanda, name) is not None
    with pytest.raises(AttributeError, match="identify"):
        jaxpanda.identity  # noqa: B018


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["inspect"],
        ["inspekt"],
        ["inspect", "--recordin", "a.csv"],
        ["demo", "--out", "d", "--starts", "many"],
    ],
)
def test_bad_usage_is_one_line_and_status_2(capsys, arguments):
    assert "--help" in refused(capsys, *arguments)


def test_inspect_prints_one_json_document_and_nothing_else(capsys, recording):
    assert main(["inspect", "--recording", str(recording), "--json"]) == 0
    out, _ = capsys.readouterr()
    (one,) = json.loads(out)["recordings"]
    assert one["dof"] == 7
    assert one["rate"] == pytest.approx(1000, rel=1e-3)
    assert main(["inspect", str(recording), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["recordings"] == [one]


def test_the_chain_of_commands_leaves_what_the_interface_promises(capsys, recording, tmp_path):
    run, model = tmp_path / "run", tmp_path / "found.xml"
    assert main(["identify", "--recording", str(recording), "--out", str(run), "--folds", "0"]) == 0
    found = result(run / "identification.json")
    assert found["schema"] == "jaxpanda.identification/1"
    assert found["method"] == "trajectory"
    assert len(found["coefficients"]) == found["rank"]
    assert len(found["friction"]) == 7

    file = str(run / "identification.json")
    assert main(["retrieve", "--identification", file, "--starts", "8", "--out", str(run)]) == 0
    links = result(run / "retrieval.json")
    assert links["max_violation"] == 0
    assert len(links["links"]) == 7

    assert main(["export", "--retrieval", str(run), "--out", str(model)]) == 0
    assert main(["export", "--retrieval", str(run), "--out", str(tmp_path / "found.urdf")]) == 0
    capsys.readouterr()
    given = ["--model", str(model), "--recording", str(recording), "--out", str(run), "--json"]
    assert main(["validate", *given, "--no-mjx"]) == 0
    out, _ = capsys.readouterr()
    checked = json.loads(out)
    assert checked == result(run / "validation.json")
    assert checked["kernel_vs_mujoco"] < 1e-9
    assert checked["mjx_vs_mujoco"] is None
    assert checked["relative_error_percent"] < 5
    assert max(checked["rollout"]["mujoco"]["rmse_rad"]) < 0.2


@pytest.mark.slow
@pytest.mark.parametrize(
    "own",
    [
        pytest.param(True, id="the project's Panda"),
        pytest.param(False, id="an arm of the user's"),
    ],
)
def test_the_readme_s_example_runs_for_any_arm(own, recording, tmp_path, monkeypatch):
    """Of a user's arm it ended in "bounds: none are known for the arm"."""
    monkeypatch.chdir(tmp_path)
    code = re.search(r"```python\n(import jax\n.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert code is not None
    text = code[1].replace("starts=2048", "starts=16")
    if own:
        shutil.copy(recording, "arm.csv")
    else:
        shutil.copy(MODELS / "robosuite_like.xml", "arm.xml")  # three joints
        save(shaken(jaxpanda.Arm.from_mjcf("arm.xml")), Path("arm.csv"))
        text = re.sub(r"^(arm = |)\S.*# or (.*\))$", r"\1\2", text, flags=re.MULTILINE)
        assert text.count('"arm.xml"') == 2
    exec(text, {})
    assert Path("found.xml").exists()


def test_a_failed_stage_leaves_nothing(capsys, recording, tmp_path):
    text = recording.read_text().splitlines()
    cells = text[50].split(",")
    cells[4] = "nan"
    text[50] = ",".join(cells)
    bad = tmp_path / "bad.csv"
    bad.write_text("\n".join(text))
    line = refused(capsys, "identify", "--recording", str(bad), "--out", str(tmp_path / "new" / "run"))
    assert "bad.csv" in line
    assert "q_4" in line
    assert "50" in line or "51" in line
    assert not (tmp_path / "new").exists()


def test_files_that_are_nobodys_are_refused(capsys, recording, tmp_path):
    garbage = tmp_path / "garbage.csv"
    garbage.write_bytes(bytes(range(256)) * 8)
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco><worldbody><body></worldbody></mujoco>")
    text = tmp_path / "note.json"
    text.write_text('{"coefficients": "none"}')
    out = str(tmp_path / "out")
    missing = str(tmp_path / "missing.csv")
    for arguments, word in [
        (["inspect", "--recording", missing], "missing.csv"),
        (["inspect", "--recording", str(garbage)], "garbage.csv"),
        (["inspect", "--recording", str(recording), "--model", str(broken)], "broken.xml"),
        (
            ["identify", "--recording", str(recording), "--mass-gravity", str(garbage), "--out", out],
            "one of the two",
        ),
        (["identify", "--mass-gravity", str(garbage), "--out", out], "garbage.csv"),
        (["identify", "--recording", str(recording), "--out", str(garbage)], "garbage.csv"),
        (["retrieve", "--identification", str(text), "--out", out], "note.json"),
        (["retrieve", "--identification", missing, "--out", out], "missing.csv"),
        (["export", "--retrieval", str(tmp_path), "--out", out], "retrieval.json"),
        (["validate", "--model", str(broken), "--recording", str(recording), "--out", out], "broken.xml"),
    ]:
        assert word in refused(capsys, *arguments), arguments
        assert not Path(out).exists()


def test_a_recording_of_another_arm_is_refused(capsys, tmp_path):
    time = np.arange(2000) / 500
    other = tmp_path / "six.csv"
    wave = np.sin(time[:, None] + np.arange(6))
    save(Recording("six.csv", time, wave, None, wave), other)
    line = refused(capsys, "identify", "--recording", str(other), "--out", str(tmp_path / "run"))
    assert "six.csv" in line
    assert "6 joints" in line


def test_a_prediction_says_how_far_it_is_from_torque_that_was_recorded(capsys, tmp_path):
    """A user had to work out the error of a prediction from two files."""
    arm = jaxpanda.Arm.from_mjcf(MODELS / "odd_axes.xml")
    nothing = jaxpanda.Corrected.of(arm)
    write_json(tmp_path / "corrected.json", {**nothing.to_json(), "torque_noise": [0.05] * arm.dof})
    recorded = shaken(arm, lambda qd: 0.3 * qd)
    said = {}
    for name, tau in (("motion", None), ("recorded", recorded.tau), ("dead", 0 * recorded.q)):
        save(dataclasses.replace(recorded, tau=tau), tmp_path / f"{name}.csv")
        files = ["--recording", str(tmp_path / f"{name}.csv"), "--out", str(tmp_path / f"{name}_tau.csv")]
        command = ["predict", "--diagnosis", str(tmp_path), *files]
        assert main([*command, "--json"]) == 0
        said[name] = json.loads(capsys.readouterr().out)
    assert said["motion"]["rmse"] is said["motion"]["relative_error_percent"] is None
    assert (tmp_path / "motion_tau.csv").read_bytes() == (tmp_path / "recorded_tau.csv").read_bytes()
    error = np.loadtxt(tmp_path / "recorded_tau.csv", delimiter=",", skiprows=1)[:, 1:] - recorded.tau
    np.testing.assert_allclose(said["recorded"]["rmse"], np.sqrt(np.mean(error**2, 0)), rtol=1e-9)
    share = 100 * np.sqrt(np.sum(error**2) / np.sum(recorded.tau**2))
    assert said["recorded"]["relative_error_percent"] == pytest.approx(share, rel=1e-9)
    assert said["dead"]["relative_error_percent"] is None

    command[4] = str(tmp_path / "recorded.csv")
    assert main(command) == 0
    out = capsys.readouterr().out
    assert f"its noise included: {share:.4g} %." in out
    assert all(f"{rmse:.4g}" in out for rmse in said["recorded"]["rmse"])
    assert not re.search(r"\d\.\d{7}", out)


@pytest.mark.slow
def test_the_corrected_file_loads_though_the_user_s_includes_others(capsys, monkeypatch, tmp_path):
    """A finding in such a model ended in "panda.xml: includes 'parts/defaults.xml', which cannot be read"."""
    shutil.copytree(MODELS, tmp_path / "in")
    model, out = tmp_path / "in" / "including.xml", tmp_path / "out"
    text = model.read_text().replace(
        '<geom name="floor"', '<geom type="mesh" mesh="hall"/>\n    <geom name="floor"'
    )
    model.write_text(text.replace("<worldbody>", '<asset><mesh file="hall.obj"/></asset>\n  <worldbody>'))
    (tmp_path / "in" / "hall.obj").write_text("")
    defaults = tmp_path / "in" / "parts" / "defaults.xml"
    defaults.write_text(re.sub(r' frictionloss="[\d.]+"', "", defaults.read_text()))
    arm, log = jaxpanda.Arm.from_mjcf(model), tmp_path / "log.csv"
    save(shaken(arm, lambda qd: 3 * qd * [0, 1, 0]), log)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert (
        main(["diagnose", "--model", str(model), "--recording", str(log), "--out", str(out), "--json"]) == 0
    )
    printed, told = capsys.readouterr()
    said = json.loads(printed)
    steps = [
        "reading 1 recording",
        "log.csv: ",
        "looking for",
        *map(plainly, said["log"]),
        "simulating",
        "writing",
    ]
    lines = iter(told.splitlines())
    for step in steps:  # in this order, the rest of a long one on the next line
        assert any(step[:40] in line for line in lines), step
    assert len(said["log"]) > 1
    assert [f["effect"] for f in said["findings"]] == ["viscous_friction"]
    assert said["replays"]
    assert any("1 meshes, textures or attached models (hall.obj, ...)" in note for note in said["notes"])
    corrected = jaxpanda.Arm.from_mjcf(out / "corrected.xml")
    np.testing.assert_allclose(corrected.damping, arm.damping + np.array([0, 3, 0]), atol=0.1)
    assert (tmp_path / "in" / "parts" / "arm.xml").read_bytes() == (MODELS / "parts" / "arm.xml").read_bytes()
    assert "parts/arm.xml" in (out / "report.html").read_text()
    assert jaxpanda.replay(out, log).rmse.max() < 0.1
    loaded = jaxpanda.Corrected.load(out)
    assert [effect.name for effect in loaded.effects] == ["viscous_friction"]
    assert pickle.loads(pickle.dumps(loaded)).to_json() == loaded.to_json()


@pytest.mark.parametrize(
    ("line", "told"),
    [
        (
            "0 terms: power_law_friction[4] 1082.5; joint_spring[2] -3.1",
            "tried every effect: power law friction at joint 4 is likeliest",
        ),
        (
            "1 terms: unknown[4] 9.1; backlash[1, 2] 3.0; armature[4] 2.0; joint_spring[4] 1.0",
            "tried every effect beside 1 found: unknown at joint 4; backlash at joints 1, 2; armature at joint 4"
            " are likeliest",
        ),
        ("2 terms: coulomb_friction[7] -20.0", "tried every effect beside 2 found: none helps"),
        ("3 terms: ", "tried every effect beside 3 found: none helps"),
        ("add joint_spring[2] (cubic): 12.0", "added joint spring at joint 2 (cubic)"),
        (
            "viscous_friction[4] for power_law_friction[4]: 598.1 for 576.9",
            "took viscous friction at joint 4 instead of power law friction at joint 4",
        ),
        ("suspect recordings beside them", "suspect recordings beside them"),
        ("free forms", "looking for torque that no named effect explains"),
    ],
)
def test_a_line_of_the_log_is_told_in_words(line, told):
    assert plainly(line) == told


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["inspekt"], "no command 'inspekt' (did you mean inspect?)"),
        (["inspect", "--recordin", "a.csv"], "inspect has no option --recordin (did you mean --recording?)"),
        (["retrieve", "--out", "x"], "retrieve needs --identification"),
        (["demo", "--out", "d", "--starts", "many"], "--starts: 'many' is no whole number"),
        (["identify", "--out", "d", "--cutoff", "five"], "--cutoff: 'five' is no number"),
        (["--verion"], "no command '--verion' (did you mean --version?)"),
        (["demo", "--out"], "--out has no value after it"),
        (["demo", "--out", "a", "b"], "demo: no option takes 'b'"),
        (["identify", "a.csv"], "identify: no option takes 'a.csv', and --out must be given"),
        (["inspect", "-recording", "a.csv"], "inspect has no option -recording (did you mean --recording?)"),
        (["predict", "--diagnosis", "a", "--recording", "b", "c", "--out", "d"], "no option takes 'c'"),
        (["demo", "--out", "d", "--json=true"], "demo: no option takes 'true'"),
        (
            ["retrieve", "--identification", "a", "--out", "b", "--weighting", "heavy"],
            "--weighting heavy: is none of auto, torque, none",
        ),
    ],
)
def test_a_slip_of_the_keyboard_is_answered_with_what_was_meant(capsys, arguments, said):
    line = refused(capsys, *arguments)
    assert said in line
    assert len(line) < 200


def test_the_version_is_that_of_the_package(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"jaxpanda {jaxpanda.__version__}\n"
    assert re.fullmatch(r"\d+\.\d+\.\d+.*", jaxpanda.__version__)


def test_both_packages_tell_type_checkers_that_they_are_typed():
    import jaxpanda_kernels

    for package in (jaxpanda, jaxpanda_kernels):
        assert (Path(package.__file__).parent / "py.typed").is_file()


def test_an_option_given_twice_is_refused(capsys):
    """The last one won, and the recordings of the first were left out in silence."""
    line = refused(capsys, "inspect", "--recording", "a.csv", "--recording", "b.csv")
    assert "--recording is given twice" in line


@pytest.mark.parametrize("width", [80, 100])
def test_an_error_is_broken_between_words_on_a_terminal(capsys, monkeypatch, width):
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert main(["export", "--retrieval", "a", "--out", "b", "--modle", "c"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) > 1 or width == 100
    assert max(map(len, lines)) <= width
    assert " ".join(lines) == (
        "jaxpanda: export has no option --modle (did you mean --model?); see jaxpanda export --help"
    )


@pytest.mark.parametrize("width", [80, 100])
def test_prose_is_broken_between_words(capsys, width):
    from jaxpanda.report import Section, to_terminal

    words = " ".join(f"word{i}" for i in range(60))
    to_terminal([Section("Head", [words])], width=width)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= width
    assert " ".join(line.strip() for line in lines[2:]).split() == words.split()


def test_a_table_wider_than_the_terminal_goes_on_below(capsys):
    """Its numbers were folded or cut off."""
    from jaxpanda.report import Section, Table, to_terminal

    heads = ["link", *(f"column {j}" for j in range(11))]
    rows = [[f"link{i}", *(f"{i}.{j:05d}" for j in range(11))] for i in range(3)]
    to_terminal([Section("Links", [], [Table(heads, rows, "Inertia")])], width=80)
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= 80
    words = re.findall(r"[\w.]+", out)
    assert [word for word in words if re.fullmatch(r"\d\.\d{5}", word)] == [
        cell for part in (slice(1, 7), slice(7, 12)) for row in rows for cell in row[part]
    ]
    assert words.count("link2") == out.count("link ") == 2
    assert words.count("Inertia") == 1


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (0.30064, 0.01, "0.3006"),
        (12.3456789, 1e-5, "12.345679"),
        (1700000010.123, 1e-3, "1700000010.12"),  # it was 1.7e+09
        (0.0, 0.1, "0"),
        (2.0, None, "2"),
        (None, None, "–"),
    ],
)
def test_an_estimate_has_the_digits_that_its_deviation_leaves_it(value, std, text):
    from jaxpanda.report import estimate

    assert estimate(value, std) == text


def test_long_names_of_rows_give_way_to_their_numbers(capsys):
    from jaxpanda.report import Section, Table, to_terminal

    name = " + ".join(f"0.1{i} m{i}c{i}z" for i in range(8))
    to_terminal(
        [Section("", [], [Table(["coefficient", "value", "std"], [[name, "0.0519807", "0.0018"]])])], 80
    )
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= 80
    assert out.count("coefficient") == out.count("0.0519807") == out.count("0.0018") == 1
    assert re.findall(r"m\dc\dz", out) == re.findall(r"m\dc\dz", name)


def test_an_export_s_table_has_six_digits_and_its_json_all():
    from jaxpanda.arms.export import Change
    from jaxpanda.pipeline import Export
    from jaxpanda.summaries import of

    change = Change("a.xml", 3, "inertial", "pos", "0.1 2 3", "0.12345678901234567 -1.2345678e-05 2")
    written = Export(Path("a.xml"), (change,), ())
    (row,) = of(written)[0].tables[0].rows
    assert row[-1] == "0.123457 -1.23457e-05 2"
    assert written.to_json()["changes"][0]["new"] == change.new


def test_a_log_is_converted_to_what_reads_back_the_same(capsys, recording, tmp_path):
    from jaxpanda.recordings import load

    log, mine = load(recording), tmp_path / "mine.csv"
    head, *rows = recording.read_text().splitlines()
    names = head.replace("time", "t").replace("dq_", "vel_").replace("tau_", "effort_").replace("q_", "pos_")
    mine.write_text("\n".join([names, *rows]) + "\n")
    columns = ("time=t", "q=pos_{j}", "dq=vel_{j}", "tau=effort_{j}")
    assert f"--columns {' '.join(columns)}" in refused(capsys, "inspect", "--recording", str(mine))
    out = tmp_path / "rec.csv"
    assert main(["convert", str(mine), "--columns", *columns, "--out", str(out)]) == 0
    assert "pos_1 … pos_7" in capsys.readouterr().out
    back = load(out)
    for ours, theirs in zip([back.time, *back.channels()], [log.time, *log.channels()], strict=True):
        assert np.array_equal(ours, theirs)
    assert main(["inspect", "--recording", str(mine), "--columns", *columns, "--to", "2", "--json"]) == 0
    (one,) = json.loads(capsys.readouterr().out)["recordings"]
    assert one["origin"]["channels"]["tau"] == "effort_1 … effort_7"
    assert one["duration"] == pytest.approx(2.0, abs=0.01)


def test_a_conversion_never_replaces_its_log(capsys, recording, tmp_path):
    log = tmp_path / "log.csv"
    log.write_bytes(recording.read_bytes())
    (tmp_path / "link.csv").symlink_to(log)
    (tmp_path / "hard.csv").hardlink_to(log)
    for out in ("log.csv", "link.csv", "hard.csv"):
        assert "is the log itself" in refused(capsys, "convert", str(log), "--out", str(tmp_path / out))
    assert "or lies in it" in refused(capsys, "convert", str(tmp_path), "--out", str(tmp_path / "new.csv"))
    assert log.read_bytes() == recording.read_bytes()
    assert not (tmp_path / "new.csv").exists()


@pytest.mark.parametrize("suffix", ["csv", "csv.gz", "npz", "parquet"])
def test_a_conversion_replaces_nothing_but_what_it_would_write(capsys, recording, tmp_path, suffix):
    mine, out = tmp_path / f"mine.{suffix}", tmp_path / f"out.{suffix}"
    mine.write_text("a user's")
    (tmp_path / f"link.{suffix}").symlink_to(mine)
    convert = ["convert", str(recording), "--out"]
    assert "no earlier result" in refused(capsys, *convert, str(mine))
    assert "is a link" in refused(capsys, *convert, str(tmp_path / f"link.{suffix}"))
    assert mine.read_text() == "a user's"
    assert main([*convert, str(out)]) == main([*convert, str(out)]) == 0
    capsys.readouterr()
    assert "no earlier result" in refused(capsys, *convert, str(out), "--to", "2")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["convert"], "needs FILE and --out"),
        (["convert", "a.csv"], "needs --out"),
        (["inspect", "--recording", "a.csv", "--columns", "t"], "CHANNEL=COLUMNS is needed"),
        (["inspect", "--recording", "a.csv", "--from", "x"], "--from: 'x' is no number"),
        (["inspect", "--recording", "a.csv", "--topics", "x"], "did you mean --topic?"),
    ],
)
def test_reading_options_are_refused_like_others(capsys, arguments, message):
    assert message in refused(capsys, *arguments)
