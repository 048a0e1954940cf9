"""What comes in and what goes out: caps, sets that appear whole, and nothing replaced that is not its own."""

import ast
import dataclasses
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from test_commands import MODELS, shaken

import jaxpanda
from jaxpanda import corrected, files, inputs, retrieval, validation
from jaxpanda.__main__ import main
from jaxpanda.errors import InputError, OutputError
from jaxpanda.excitation import result as excitation
from jaxpanda.files import Kind, output_folder, write_json, write_text
from jaxpanda.fleet import result as fleet
from jaxpanda.identification import result as identification
from jaxpanda.payload import result as payload
from jaxpanda.recordings import save

ROOT = Path(__file__).parents[1]
KIND = Kind("test", ("main.json", "page.html"))


# One way in, one way out

METHODS = {"open", "read_text", "read_bytes", "write_text", "write_bytes", "unlink", "rmdir", "touch"}
"""Of `Path`."""
FUNCTIONS = {
    "os": {"open", "fdopen", "replace", "rename", "remove", "unlink", "link"},
    "shutil": {"copy", "copy2", "copyfile", "move", "rmtree"},
    "tempfile": {"mkstemp", "mkdtemp", "TemporaryDirectory", "NamedTemporaryFile"},
    "np": {"load", "save", "loadz", "savez", "genfromtxt", "savetxt", "fromfile", "memmap"},
    "json": {"load", "dump"},
    "gzip": {"open"},
}
LIBRARIES = {"File", "ParquetFile", "read_table", "read_schema", "loadmat", "AnyReader"}
"""Of h5py, pyarrow, SciPy and rosbags, which open what they are given: `inputs` has looked at it, or read it."""
LOOKED_AT = ("inputs.in_place(", "BytesIO(", "BufferReader(")
ALLOWED = {
    "files.py": "the way out",
    "inputs.py": "the way in",
    "feasible/checkpoint.py": "finished starts, appended in place and read back with checksums",
    "session.py": "standard output under another number",
    "__main__.py": "standard output where its reader is gone",
}


def opened(path: Path) -> list[str]:
    """Calls in a module that open, replace or remove a file."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.Call):
            continue
        called = node.func
        name = ast.unparse(called)
        if name.rpartition(".")[2] in LIBRARIES and not any(
            where in ast.unparse(node.args[0]) for where in LOOKED_AT
        ):
            found.append(f"line {node.lineno}: {name}")
        if isinstance(called, ast.Name) and called.id == "open":
            found.append(f"line {node.lineno}: open")
        elif isinstance(called, ast.Attribute):
            owner = called.value.id if isinstance(called.value, ast.Name) else ""
            of_path = called.attr in METHODS and owner not in {"inputs", "files"}
            if called.attr in FUNCTIONS.get(owner, ()) or (
                of_path and "resources" not in ast.dump(called.value)
            ):
                found.append(f"line {node.lineno}: {owner}.{called.attr}")
    return found


def test_no_other_module_opens_a_file():
    package = ROOT / "jaxpanda"
    assert opened(package / "files.py")
    assert opened(package / "inputs.py")
    offenders = {
        str(path.relative_to(package)): calls
        for path in package.rglob("*.py")
        if str(path.relative_to(package)) not in ALLOWED and (calls := opened(path))
    }
    assert offenders == {}


# Sets


def leave(folder: Path, **contents: str) -> None:
    with output_folder(folder, KIND) as scratch:
        write_json(scratch / "main.json", {"schema": "jaxpanda.test/1"})
        for name, text in contents.items():
            write_text(scratch / name.replace("_", "."), text)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_every_file_of_a_set_has_its_run_and_stale_ones_go(tmp_path):
    (tmp_path / "mine.txt").write_text("1")
    leave(
        tmp_path,
        page_html="<html><head></head></html>",
        more_csv="1",
        other_json='{"schema": "jaxpanda.x/1"}',
    )
    main_file = json.loads((tmp_path / "main.json").read_text())
    assert set(main_file["run"]["files"]) == {"page.html", "more.csv", "other.json"}
    assert json.loads((tmp_path / "other.json").read_text())["run"]["id"] == main_file["run"]["id"]
    assert main_file["run"]["id"] in (tmp_path / "page.html").read_text()
    assert main_file["run"]["files"]["more.csv"] == inputs.digest(tmp_path / "more.csv")
    leave(tmp_path, page_html="<html><head>new</head></html>")
    assert names(tmp_path) == ["main.json", "mine.txt", "page.html"]


@pytest.mark.parametrize(
    ("stands", "said"),
    [
        (lambda at: at.write_text("a user's"), "no earlier result of test"),
        (lambda at: at.mkdir(), "is a folder"),
        (lambda at: at.symlink_to(at.parent / "target"), "is a link"),
        (lambda at: os.mkfifo(at), "is a pipe"),
    ],
    ids=["a file", "a folder", "a link", "a pipe"],
)
def test_what_is_not_of_an_earlier_set_is_not_replaced(tmp_path, stands, said):
    stands(tmp_path / "page.html")
    before = os.lstat(tmp_path / "page.html").st_ino
    with pytest.raises(InputError, match=said):
        leave(tmp_path, page_html="<html>")
    assert os.lstat(tmp_path / "page.html").st_ino == before
    assert names(tmp_path) == ["page.html"]


def test_a_result_that_was_changed_by_hand_is_not_replaced(tmp_path):
    leave(tmp_path, page_html="<head>")
    (tmp_path / "page.html").write_text("with my remarks")
    with pytest.raises(InputError, match="was changed since test wrote it"):
        leave(tmp_path, page_html="<head>")


def test_another_command_s_result_is_not_replaced(tmp_path):
    leave(tmp_path)
    with (
        pytest.raises(InputError, match="is a result of `test`"),
        output_folder(tmp_path, Kind("other", ("main.json",))),
    ):
        raise AssertionError


def test_a_folder_that_is_a_link_is_no_way_out_of_the_set(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out" / "page").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="lies outside"):
        leave(tmp_path / "out", **{"page/x.xml": "1"})
    assert names(tmp_path / "elsewhere") == []


@pytest.mark.parametrize("calls", range(1, 7))
def test_a_disk_that_fills_leaves_the_old_set(tmp_path, monkeypatch, calls):
    leave(tmp_path, page_html="<head>old", more_csv="old")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    left, real = [calls], os.fsync

    def full(handle):
        left[0] -= 1
        if left[0] == 0:
            raise OSError(28, "No space left on device")
        real(handle)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match="No space left"):
        leave(tmp_path, page_html="<head>new", more_csv="new")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("moves", range(3))
def test_renaming_that_fails_is_taken_back(tmp_path, monkeypatch, moves):
    leave(tmp_path, page_html="<head>old", more_csv="old")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    left, real = [moves], os.replace

    def denied(source, target):
        left[0] -= 1
        if left[0] == -1:
            raise PermissionError(1, "Operation not permitted")
        real(source, target)

    monkeypatch.setattr(os, "replace", denied)
    with pytest.raises(InputError, match="not permitted"):
        leave(tmp_path, page_html="<head>new", more_csv="new")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


KILLED = """
import os, signal, sys
from jaxpanda.files import Kind, output_folder, write_json, write_text
left, real = [{moves}], {real}
def dies(*arguments):
    left[0] -= 1
    if left[0] < 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return real(*arguments)
{real} = dies
with output_folder(sys.argv[1], Kind("test", ("main.json", "page.html"))) as scratch:
    write_json(scratch / "main.json", {{"schema": "jaxpanda.test/1"}})
    write_text(scratch / "page.html", "<head>new")
    write_text(scratch / "more.csv", "new")
"""


@pytest.mark.parametrize(("real", "moves"), [("os.fsync", 3), ("os.replace", 0), ("os.replace", 1)])
def test_a_kill_leaves_the_old_set_or_the_new_one(tmp_path, real, moves):
    leave(tmp_path, page_html="<head>old", more_csv="old", gone_csv="old")
    code = KILLED.format(real=real, moves=moves)
    ended = subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    assert ended.returncode == -signal.SIGKILL
    assert any(name.startswith(".jaxpanda.") for name in names(tmp_path))
    files.settle(tmp_path)
    old = real == "os.fsync"
    assert names(tmp_path) == ["gone.csv", "main.json", "more.csv", "page.html"][0 if old else 1 :]
    assert (tmp_path / "more.csv").read_text() == ("old" if old else "new")
    listed = json.loads((tmp_path / "main.json").read_text())["run"]["files"]
    assert all(inputs.digest(tmp_path / name) == digest for name, digest in listed.items())


def test_the_scratch_folder_of_a_process_that_lives_stays(tmp_path):
    code = (
        "import sys, time; from jaxpanda.files import output_folder\n"
        "with output_folder(sys.argv[1]): print('ready', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        files.settle(tmp_path)
        assert len(names(tmp_path)) == 1
        other.kill()
        other.wait()
    files.settle(tmp_path)
    assert names(tmp_path) == []


@pytest.fixture(scope="module")
def one_folder(tmp_path_factory) -> tuple[Path, list[list[str]]]:
    """Recordings of a small arm, moving and at rest, and the commands that leave their results in one folder."""
    folder = tmp_path_factory.mktemp("one")
    arm = jaxpanda.Arm.from_mjcf(MODELS / "odd_axes.xml")
    log, out, model = shaken(arm, seconds=4.0), str(folder / "out"), str(MODELS / "odd_axes.xml")
    still = {"q": log.q[:1] + 0 * log.q, "qd": 0 * log.q, "tau": log.tau[:1] + 1e-3 * log.q}
    save(log, folder / "arm.csv")
    save(dataclasses.replace(log, **still), folder / "still.csv")
    recording = ["--recording", str(folder / "arm.csv")]
    found, exported = f"{out}/identification.json", f"{out}/found.xml"
    return folder, [
        ["identify", *recording, "--model", model, "--folds", "0", "--out", out],
        ["retrieve", "--identification", found, "--starts", "2", "--out", out],
        ["export", "--retrieval", out, "--out", exported],
        ["validate", "--model", exported, *recording, "--no-mjx", "--out", out],
        ["diagnose", "--model", model, "--recording", str(folder / "still.csv"), "--out", out],
        ["predict", "--diagnosis", out, *recording, "--out", f"{out}/tau.csv"],
    ]


KINDS = [identification.KIND, retrieval.KIND, validation.KIND, corrected.KIND, payload.KIND, excitation.KIND]
KINDS += [fleet.KIND]


def without_run(folder: Path) -> None:
    """As versions left results that gave no run an id."""
    for file in folder.glob("*.json"):
        document = json.loads(file.read_text())
        document.pop("run")
        file.write_text(json.dumps(document))


def test_the_results_of_all_commands_fit_into_one_folder(tmp_path):
    def leave_all(text: str) -> None:
        for kind in KINDS:
            with output_folder(tmp_path, kind) as scratch:
                for name in kind.names:
                    if name.endswith(".json"):
                        write_json(scratch / name, {"schema": f"jaxpanda.{kind.command}/1", "text": text})
                    else:
                        write_text(scratch / name, f"<head>{text}")

    leave_all("first")
    leave_all("second")
    without_run(tmp_path)
    leave_all("third")
    assert names(tmp_path) == sorted(name for kind in KINDS for name in kind.names)
    for file in tmp_path.iterdir():
        assert "third" in file.read_text()
        assert file.suffix != ".json" or "run" in json.loads(file.read_text())


@pytest.mark.slow
def test_commands_share_a_folder_and_replace_their_own(one_folder, capsys):
    folder, commands = one_folder
    out = folder / "out"
    for _ in range(2):
        for command in commands:
            assert main(command) == 0, capsys.readouterr().err
    first = names(out)
    without_run(out)
    for command in commands:
        assert main(command) == 0, capsys.readouterr().err
    assert names(out) == first
    assert all("run" in json.loads(file.read_text()) for file in out.glob("*.json"))


def test_a_true_collision_is_refused_with_status_2(one_folder, capsys):
    folder, (identify, *_) = one_folder
    out = folder / "taken"
    out.mkdir()
    (out / "identification.json").write_text("a user's")
    assert main([*identify[:-1], str(out)]) == 2
    assert "no earlier result of identify" in capsys.readouterr().err
    assert names(out) == ["identification.json"]
    document = {"schema": "jaxpanda.identification/1", "run": {"command": "demo"}}
    (out / "identification.json").write_text(json.dumps(document))
    assert main([*identify[:-1], str(out)]) == 2
    assert "is a result of `demo`" in capsys.readouterr().err
    assert json.loads((out / "identification.json").read_text()) == document
