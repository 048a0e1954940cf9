"""The demo: the whole chain on a virtual arm, and what it leaves."""

import json
import re

import numpy as np
import pytest

from jaxpanda import files, inputs
from jaxpanda.demo import demonstrate, record
from jaxpanda.errors import InputError
from jaxpanda.report import Figure, Section, Table, to_html, to_terminal


@pytest.mark.slow
def test_the_demo_finds_the_virtual_arm_and_leaves_its_files(tmp_path):
    done = demonstrate(tmp_path / "demo", starts=64)
    left = {path.name for path in (tmp_path / "demo").iterdir()}
    assert left == {
        "recording.csv",
        "held_out.csv",
        "identification.json",
        "identification.npz",
        "posterior.npz",
        "retrieval.json",
        "starts.npz",
        "panda.xml",
        "panda.jaxpanda.json",
        "validation.json",
        "report.html",
    }
    truth = record(0).standard
    found = done.identification
    distance = np.abs(found.beta - found.projection @ truth.ravel()) / found.std
    assert np.mean(distance < 2) > 0.8
    assert found.cross_validated_relative_error_percent < 0.3
    assert done.retrieval.max_violation == 0
    assert done.validation.relative_error_percent < 0.3  # on a motion that nothing was fitted to
    assert done.validation.kernel_vs_mujoco < 1e-9
    assert done.validation.mjx_vs_mujoco < 1e-9
    page = (tmp_path / "demo" / "report.html").read_text("utf-8")
    assert not re.findall(r'(?:src|href)="(?!#)|url\((?!#)|<script|<link', page)  # nothing to fetch
    assert page.count("<svg") == 2
    assert json.loads(files.to_json(done.to_json()))["model"] == "panda.xml"


def test_a_page_escapes_names_and_holds_its_figures(tmp_path):
    def draw(canvas):
        canvas.subplots().plot([0, 1], [0, 1])

    sections = [
        Section(
            "a <b> & c", ["name <script>"], [Table(["x", "y"], [["1", "<2>"]], "t")], [Figure(draw, "line")]
        )
    ]
    to_html("title <1>", sections, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text("utf-8")
    assert "<script>" not in page
    assert "&lt;2&gt;" in page
    assert page.count("<svg") == 1


def test_sections_read_on_a_terminal_with_brackets_kept(capsys):
    to_terminal([Section("head [N m]", ["one [rad]"], [Table(["a [s]"], [["[1, 2]"]])])])
    out = capsys.readouterr().out
    for text in ("head [N m]", "one [rad]", "a [s]", "[1, 2]"):
        assert text in out


def fail_after_writing(folder, name: str) -> None:
    with files.output_folder(folder) as scratch:
        (scratch / name).write_text("2")
        raise RuntimeError


def test_an_output_folder_appears_only_when_the_work_ends_well(tmp_path):
    with pytest.raises(RuntimeError):
        fail_after_writing(tmp_path / "a" / "b", "half")
    assert not (tmp_path / "a").exists()
    with files.output_folder(tmp_path / "a") as folder:
        (folder / "whole").write_text("x")
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["whole"]


def test_an_existing_folder_keeps_its_files_when_the_work_fails(tmp_path):
    (tmp_path / "mine").write_text("1")
    with pytest.raises(RuntimeError):
        fail_after_writing(tmp_path, "mine")
    assert (tmp_path / "mine").read_text() == "1"


def test_json_refuses_what_is_not_finite(tmp_path):
    with pytest.raises(ValueError, match="Out of range"):
        files.to_json({"x": float("nan")})
    (tmp_path / "x.json").write_text('{"x": NaN}')
    with pytest.raises(InputError, match="NaN"):
        inputs.read_json(tmp_path / "x.json")
