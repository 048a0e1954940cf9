"""Inputs that nobody means, and outputs that would destroy something: one sentence each."""

import dataclasses
import gc
import gzip
import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import jax
import numpy as np
import pytest
import scipy.io
from test_commands import MODELS, refused, shaken

import jaxpanda
from jaxpanda import __main__ as entry
from jaxpanda import report
from jaxpanda.__main__ import main
from jaxpanda.arms.export import write_document
from jaxpanda.arms.model_file import ModelFile, Part
from jaxpanda.arms.source import from_mjcf
from jaxpanda.errors import InputError
from jaxpanda.files import write_json
from jaxpanda.recordings import load, save

ARM = '<body><joint axis="0 0 1"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>'


@pytest.fixture
def diagnosed(tmp_path) -> Path:
    """A folder that `predict` reads, with a motion beside it."""
    arm = jaxpanda.Arm.from_mjcf(MODELS / "odd_axes.xml")
    zero = jax.numpy.zeros(arm.dof)
    nothing = jaxpanda.Corrected(arm, jax.numpy.zeros((arm.dof, 10)), zero, zero, (), ())
    write_json(tmp_path / "corrected.json", {**nothing.to_json(), "torque_noise": [0.05] * arm.dof})
    save(dataclasses.replace(shaken(arm, seconds=3.0), name="motion.csv"), tmp_path / "motion.csv")
    return tmp_path


@pytest.mark.parametrize(
    ("out", "said"),
    [
        ("motion.csv", "is an input"),
        ("other.csv", "no earlier result"),
        ("link.csv", "is a link"),
        ("tau.txt", "ending in .csv"),
        ("pipe.csv", "is a pipe"),
    ],
)
def test_a_prediction_replaces_no_file_of_the_user_s(capsys, diagnosed, out, said):
    """`predict --out same.csv` left its input without the motion."""
    (diagnosed / "other.csv").write_text("time,q_1\n0,0\n")
    (diagnosed / "link.csv").symlink_to(diagnosed / "other.csv")
    os.mkfifo(diagnosed / "pipe.csv")
    before = {p.name: p.lstat().st_mtime_ns for p in diagnosed.iterdir()}
    arguments = ["predict", "--diagnosis", str(diagnosed), "--recording", str(diagnosed / "motion.csv")]
    assert said in refused(capsys, *arguments, "--out", str(diagnosed / out))
    assert {p.name: p.lstat().st_mtime_ns for p in diagnosed.iterdir()} == before
    assert main([*arguments, "--out", str(diagnosed / "tau.csv")]) == 0
    assert main([*arguments, "--out", str(diagnosed / "tau.csv")]) == 0  # its own may be replaced


@pytest.mark.parametrize("name", ["own.xml", "own.pdf", "own"])
def test_an_export_replaces_no_model_of_the_user_s(tmp_path, name):
    shutil.copy(MODELS / "odd_axes.xml", tmp_path / name)
    arm, source = from_mjcf(MODELS / "odd_axes.xml")
    made = jaxpanda.Retrieval.__new__(jaxpanda.Retrieval)
    values = {"standard": source.standard, "friction": None, "known": {}, "arm": arm.name, "model_file": ""}
    for field, value in values.items():
        object.__setattr__(made, field, value)
    with pytest.raises(InputError, match=r"no earlier result of export|ending in \.xml"):
        jaxpanda.to_mjcf(made, tmp_path / name, MODELS / "odd_axes.xml")
    assert [p.name for p in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_bytes() == (MODELS / "odd_axes.xml").read_bytes()


def test_what_is_included_from_outside_is_written_inside(tmp_path):
    """It was written beside `--out`; and nothing outside is read unless that is allowed."""
    (tmp_path / "in").mkdir()
    (tmp_path / "common.xml").write_text(f"<mujoco><worldbody>{ARM}</worldbody></mujoco>")
    (tmp_path / "in" / "arm.xml").write_text(
        '<mujoco>\n  <include file="../common.xml"/> <!-- ours -->\n</mujoco>'
    )
    with pytest.raises(
        InputError, match=r"line 2: includes '\.\./common\.xml', which lies outside .* --outside"
    ):
        from_mjcf(tmp_path / "in" / "arm.xml")
    _, source = from_mjcf(ModelFile(tmp_path / "in" / "arm.xml", Part(outside=True)))
    write_document(source.document, tmp_path / "a" / "out" / "new.xml")
    assert sorted(p.name for p in (tmp_path / "a").rglob("*")) == ["common.xml", "new.xml", "out"]
    np.testing.assert_array_equal(from_mjcf(tmp_path / "a" / "out" / "new.xml")[1].standard, source.standard)
    assert "<!-- ours -->" in (tmp_path / "a" / "out" / "new.xml").read_text()


def test_a_seed_below_zero_is_refused(capsys, tmp_path):
    assert "--seed -1" in refused(capsys, "demo", "--out", str(tmp_path / "d"), "--seed", "-1")


MODELS_THAT_GROW = {
    "repeated": f'<worldbody><replicate count="1000000">{ARM}</replicate></worldbody>',
    "repeated thrice": "<worldbody>"
    + '<replicate count="999">' * 3
    + "<geom/>"
    + "</replicate>" * 3
    + "</worldbody>",
    "attributes": "<worldbody><body " + " ".join(f'a{i}="1"' for i in range(10**5)) + "/></worldbody>",
    "deep": "<worldbody>" + "<body>" * 10**4 + "</body>" * 10**4 + "</worldbody>",
    "flex": f'<worldbody>{ARM}<flexcomp name="f" type="grid" count="999 999 999" dim="3"/></worldbody>',
    "texture": '<asset><texture builtin="flat" width="60000" height="60000"/></asset>',
    "user data": f'<size nuserdata="2000000000"/><worldbody>{ARM}</worldbody>',
    "includes itself by others": '<include file="next.xml"/>',
    "a pipe as mesh": '<asset><mesh file="pipe.obj"/></asset><worldbody><body><joint axis="0 0 1"/>'
    '<geom type="mesh" mesh="pipe"/></body></worldbody>',
    "a pipe included": '<include file="pipe.obj"/>',
}


@pytest.mark.parametrize("case", MODELS_THAT_GROW)
def test_a_model_that_would_fill_the_machine_is_refused_at_once(tmp_path, case):
    os.mkfifo(tmp_path / "pipe.obj")
    (tmp_path / "arm.xml").write_text(f"<mujoco>{MODELS_THAT_GROW[case]}</mujoco>")
    if "includes" in case:
        for i in range(200):
            name = f"next{i or ''}.xml"
            (tmp_path / name).write_text(f'<mujoco><include file="next{i + 1}.xml"/></mujoco>')
    began = time.monotonic()
    with pytest.raises(InputError):
        from_mjcf(tmp_path / "arm.xml")
    assert time.monotonic() - began < 5


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.csv", b"time,q_99999999999999999999\n0,0\n1,1\n", "no columns q_1"),
        ("a.csv", b"time,q_1,q_99999999\n0,0,0\n", "q_2 is missing"),
        ("a.csv", (",".join(f"q_{i}" for i in range(10**6)) + "\n0\n").encode(), "1000000 columns"),
        ("a.csv.gz", gzip.compress(bytes(1 << 27), 1), "unpacks"),
        ("a.csv", None, "it is a pipe"),
        ("a.npz", None, "it is a pipe"),
        *(
            (f"a.{kind}", None, "it is a pipe")
            for kind in ("parquet", "mat", "h5", "bag", "mcap", "db3", "txt")
        ),
    ],
)
def test_a_recording_that_would_fill_the_machine_is_refused_at_once(tmp_path, name, content, said):
    os.mkfifo(tmp_path / name) if content is None else (tmp_path / name).write_bytes(content)
    began = time.monotonic()
    with pytest.raises(InputError, match=said):
        load(tmp_path / name)
    assert time.monotonic() - began < 5


def test_a_mat_file_that_would_fill_the_machine_is_refused_at_once(tmp_path):
    scipy.io.savemat(tmp_path / "a.mat", {"q": np.zeros((10**7, 1))}, do_compression=True)
    with pytest.raises(InputError, match="unpacks"):
        load(tmp_path / "a.mat")


def test_an_array_that_claims_to_be_huge_is_not_made_room_for(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in ("time", "q"):
            file.create_dataset(name, (10**9, 1), "f8", chunks=(1000, 1))
    with pytest.raises(InputError, match="1000000000 numbers"):
        load(tmp_path / "a.h5", columns={"time": "time", "q": "q"})


@pytest.mark.parametrize("kind", ["external", "virtual", "link"])
def test_an_hdf5_file_leads_to_no_other_file(tmp_path, kind):
    secret = tmp_path / "secret"
    secret.write_bytes(bytes(8 * 100))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        if kind == "external":
            file.create_dataset("q", (100,), "f8", external=[(str(secret), 0, 800)])
        elif kind == "virtual":
            layout = h5py.VirtualLayout((100,), "f8")
            layout[:] = h5py.VirtualSource(secret, "q", (100,))
            file.create_virtual_dataset("q", layout)
        else:
            file["data"] = h5py.ExternalLink(secret, "data")
    with pytest.raises(InputError, match=r"another file|is a link"):
        load(tmp_path / "a.h5")


@pytest.mark.parametrize("inside", ["metadata.yaml", "a.db3"])
def test_a_pipe_inside_a_bag_is_refused(tmp_path, inside):
    for name in ("metadata.yaml", "a.db3"):
        os.mkfifo(tmp_path / name) if name == inside else (tmp_path / name).write_text("")
    with pytest.raises(InputError, match="it is a pipe"):
        load(tmp_path, format="bag")


@pytest.mark.parametrize("signal_", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_a_command_that_is_told_to_stop_clears_up_and_says_so(tmp_path, signal_):
    """SIGTERM left a scratch folder and no word."""
    code = (
        "import sys, time; from jaxpanda import __main__ as m, pipeline\n"
        "def slow(*_, **__): print('ready', flush=True); time.sleep(60)\n"
        "pipeline.load_many = slow; sys.exit(m.main(sys.argv[1:]))"
    )
    arguments = ["identify", "--recording", "x.csv", "--out", str(tmp_path / "out")]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", code, *arguments], **pipes) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "ready\n"
        child.send_signal(signal_)
        _, said = child.communicate(timeout=30)
    assert child.returncode == 1
    assert said == "jaxpanda: interrupted; nothing was left half-written\n"
    assert not (tmp_path / "out").exists()


def test_a_command_that_is_told_to_stop_while_garbage_is_collected_stops(monkeypatch, capsys):
    """A rank went on: JAX has a callback there, and Python drops what one raises."""

    def during(phase, _):
        if phase == "stop":
            signal.raise_signal(signal.SIGTERM)

    def run(_):
        gc.callbacks.append(during)
        try:
            gc.collect()
        finally:
            gc.callbacks.remove(during)
        time.sleep(10.0)
        return 0

    monkeypatch.setattr(entry, "_run", run)
    assert entry.main(["inspect"]) == 1
    assert capsys.readouterr().err == "jaxpanda: interrupted; nothing was left half-written\n"
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


NAMES = ["$x$ ^_{.csv", "a\x1b[31m\n.csv", "<b>'\"&.csv", os.fsdecode(b"\xff.csv")]


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_text_in_figures_terminals_and_pages(tmp_path, capsys, name):
    """matplotlib took a dollar sign for a formula, and ended a diagnosis."""

    def draw(canvas):
        canvas.subplots().set_title(name)

    section = report.Section(
        name, [name], [report.Table([name], [[name]], name)], [report.Figure(draw, name)]
    )
    report.to_html(name, [section], tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text("utf-8")
    assert "<b>" not in page
    report.to_terminal([section])
    assert "\x1b[31m" not in capsys.readouterr().out
    assert json.loads(report_json(tmp_path, name))["name"] == name


def report_json(folder: Path, name: str) -> str:
    write_json(folder / "x.json", {"name": name})
    return (folder / "x.json").read_text("utf-8")


def test_what_nobody_foresaw_is_one_sentence(capsys, monkeypatch):
    from jaxpanda import pipeline

    for error, said in ((MemoryError(), "out of memory"), (RecursionError("deep"), "RecursionError: deep")):

        def fails(*_, error=error):
            raise error

        monkeypatch.setattr(pipeline, "inspect_files", fails)
        assert main(["inspect", "--recording", "x.csv"]) == 1
        out, err = capsys.readouterr()
        assert out == ""
        assert err.startswith("jaxpanda: ")
        assert said in err
        assert err.count("\n") == 1


def _experiment():
    file = Path(__file__).parents[1] / "experiments" / "hostile" / "run.py"
    spec = importlib.util.spec_from_file_location("hostile_run", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("format", ["csv"])
def test_a_few_mutated_inputs_of_a_format_are_read_or_refused(format):
    found = _experiment().work(format, 7, 15)
    assert set(found["found"]) <= {"accepted", "refused"}, found["examples"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "format",
    [
        *("csv.gz", "npz", "parquet", "raw_logs", "mat", "h5", "mcap", "db3", "lerobot"),
        *("mjcf", "urdf", "table", "corrected", "bounds", "mass_gravity"),
    ],
)
def test_many_mutated_inputs_of_a_format_are_read_or_refused(format):
    found = _experiment().work(format, 8, 60)
    assert set(found["found"]) <= {"accepted", "refused"}, found["examples"]
