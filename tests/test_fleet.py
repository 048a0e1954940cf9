"""A fleet: its table, its shards whoever makes them, what is left when workers die, and the page."""

import csv
import json
import os
import re
import signal
import socket
import types
from collections import Counter
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
from fleets import fleet
from helpers import result

from jaxpanda import InputError, Recording
from jaxpanda.__main__ import main
from jaxpanda.fleet import crew, diagnose_fleet, run, work
from jaxpanda.fleet.table import load_table
from jaxpanda.fleet.work import Options, Task
from jaxpanda.recordings import save
from jaxpanda.simulation import JointFriction, Sensors, random_trajectory, simulate

ARM = """<mujoco><compiler angle="radian"/><worldbody>
<body pos="0 0 0.3"><joint name="pan" axis="0 0 1" range="-2 2"/>
<inertial pos="0 0 0.1" mass="3" diaginertia="0.02 0.02 0.01"/>
<body pos="0 0 0.2"><joint name="lift" axis="0 1 0" range="-2 2"/>
<inertial pos="0.15 0 0" mass="2" diaginertia="0.004 0.02 0.02"/></body></body></worldbody></mujoco>"""
SET = ("fleet.json", "fleet.html", "recordings.parquet", "findings.parquet", "estimates.parquet")
WEIGHT = 2 * 9.81 * 0.15


def still(name: str, seed: int, extra: float = 0.0) -> Recording:
    """The arm at rest, its second joint loaded with `extra` beyond the model [N m]."""
    rng, t = np.random.default_rng(seed), np.arange(400) / 200
    load = np.array([0.0, -WEIGHT + extra])
    return Recording(name, t, 0.0 * t[:, None] + [[0.1, 0.0]], tau=load + 0.02 * rng.normal(size=(400, 2)))


def write_table(
    folder: Path, rows: list[list[str]], header=("recording", "arm", "day", "reference", "site")
) -> Path:
    with (folder / "fleet.csv").open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])
    return folder / "fleet.csv"


@pytest.fixture(scope="module")
def resting(tmp_path_factory) -> Path:
    """Two arms at rest, one of them carrying something; one file damaged, one absent."""
    folder = tmp_path_factory.mktemp("fleet")
    (folder / "arm.xml").write_text(ARM)
    rows = []
    for i, (arm, extra) in enumerate([("left", 0.0), ("left", 0.0), ("right", -1.5), ("right", -1.5)]):
        save(still("", i, extra), folder / f"{arm}_{i}.csv")
        rows.append([f"{arm}_{i}.csv", arm, f"2026-03-0{i + 1}", "", "lab, 2"])
    (folder / "cut.csv").write_text((folder / "left_0.csv").read_text()[:3000])
    rows += [["cut.csv", "left", "2026-03-08", "no", ""], ["gone.csv", "right", "2026-03-09", "", ""]]
    write_table(folder, rows)
    return folder


@pytest.fixture(scope="module")
def answered(resting) -> tuple[list[str], Path]:
    """The command, and the folder that it has filled."""
    out = resting / "out"
    command = ["fleet", str(resting / "fleet.csv"), "--model", str(resting / "arm.xml"), "--workers", "0"]
    assert main([*command, "--out", str(out)]) == 0
    return command, out


def contents(out: Path) -> dict[str, bytes]:
    return {str(p.relative_to(out)): p.read_bytes() for p in sorted(out.rglob("*")) if p.is_file()}


def test_what_cannot_be_read_is_named_and_the_others_finish(answered):
    _, out = answered
    told = result(out / "fleet.json")
    assert told["statuses"] == {"diagnosed": 4, "unreadable": 2}
    (cut, gone) = told["not_diagnosed"]
    assert (cut["recording"], cut["row"]) == ("cut.csv", 5)
    assert "cut.csv: column tau_2, row" in cut["message"]
    assert "gone.csv: cannot be read (no such file)" in gone["message"]
    left, right = sorted(told["arms"], key=lambda arm: arm["arm"])
    assert left["findings"] == []
    assert right["findings"][0]["seen_in"] == 2
    assert told["arms"][0]["arm"] == "right"  # the worst first


def test_the_tables_have_a_row_a_recording_and_a_row_a_finding(answered):
    _, out = answered
    recordings = pyarrow.parquet.read_table(str(out / "recordings.parquet")).to_pylist()
    assert [row["row"] for row in recordings] == [1, 2, 3, 4, 5, 6]
    assert recordings[0]["site"] == "lab, 2"
    assert recordings[1]["when"] - recordings[0]["when"] == 1.0
    assert [row["verdict"] is None for row in recordings] == [
        row["status"] != "diagnosed" for row in recordings
    ]
    findings = pyarrow.parquet.read_table(str(out / "findings.parquet")).to_pylist()
    assert len(findings) == sum(row["findings"] for row in recordings)
    assert {row["arm"] for row in findings} == {"right"}
    assert all(len(row["rms_torque"]) == 2 for row in findings)


def test_a_rerun_makes_only_what_is_missing_and_the_same_bits(answered, monkeypatch, capsys):
    command, out = answered
    before = contents(out)
    made = []
    own = work.shard
    monkeypatch.setattr(work, "shard", lambda task: (made.append(task.recording.name), own(task))[1])
    assert main([*command, "--out", str(out)]) == 0
    assert made == []
    recordings = pyarrow.parquet.read_table(str(out / "recordings.parquet")).to_pylist()
    (out / "shards" / f"{recordings[2]['key']}.json").unlink()
    (out / "shards" / f"{recordings[3]['key']}.json").write_text("{")  # a broken disk
    capsys.readouterr()
    assert main([*command, "--out", str(out), "--json"]) == 0
    assert made == ["right_2.csv", "right_3.csv"]
    assert contents(out) == before
    assert json.loads(capsys.readouterr().out) == json.loads(before["fleet.json"])


def test_other_options_are_other_shards(answered, resting, monkeypatch):
    keys = work.Keys(Options())
    file, model = resting / "left_0.csv", resting / "arm.xml"
    key = keys.of(file, model, ())
    assert key == work.Keys(Options()).of(file, model, ())
    assert key != work.Keys(Options("rough")).of(file, model, ())
    assert key != keys.of(file, model, (resting / "left_1.csv",))
    assert key != keys.of(resting / "left_1.csv", model, ())
    assert key != keys.of(file, None, ())
    monkeypatch.setattr(work, "software", lambda: "another version")
    assert key != work.Keys(Options()).of(file, model, ())


def test_a_defect_is_told_and_tried_again(resting, monkeypatch, tmp_path):
    def fails(*_, **__):
        raise ZeroDivisionError("of a library")

    monkeypatch.setattr(work, "diagnosed", fails)
    found = diagnose_fleet(resting / "fleet.csv", tmp_path, model=resting / "arm.xml")
    assert Counter(d["status"] for d in found.told.values()) == {"failed": 4, "unreadable": 2}
    assert found.told[1]["message"] == "left_0.csv: ZeroDivisionError: of a library"
    monkeypatch.undo()
    assert diagnose_fleet(resting / "fleet.csv", tmp_path, model=resting / "arm.xml").made == 4


def test_what_stands_in_the_way_is_refused_before_any_work(resting, tmp_path, capsys, monkeypatch):
    (tmp_path / "fleet.html").write_text("mine")
    monkeypatch.setattr(work, "shard", lambda task: pytest.fail("worked"))
    command = ["fleet", str(resting / "fleet.csv"), "--model", str(resting / "arm.xml"), "--workers", "0"]
    assert main([*command, "--out", str(tmp_path)]) == 2
    assert "fleet.html: stands there already" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["fleet.html"]


# The table


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("file,arm\na.csv,x\n", "no column recording"),
        ("recording\n", "a header but no rows"),
        ("recording,arm\na.csv\n", "row 1 (line 2) has 1 cells, where the columns are 2"),
        ("recording,arm\n,x\n", "row 1 (line 2): column recording is empty"),
        ("recording,arm,arm\na.csv,x,y\n", "column arm is there twice"),
        ("recording,verdict\na.csv,x\n", "column verdict: results have a column of that name"),
        ("recording,time,day\na.csv,1,2\n", "has both columns time and day"),
        ("recording,day\na.csv,soon\n", "'soon' is neither a number nor a date"),
        ("recording,day\na.csv,nan\n", "'nan' is no finite number"),
        ("recording,day\na.csv,3\nb.csv,2026-03-01\n", "has dates and numbers (row 2)"),
        ("recording,reference\na.csv,perhaps\n", "'perhaps' is neither yes nor no"),
        ("recording\na.csv\nx/../a.csv\n", "row 2: x/../a.csv stands in row 1 already"),
        ("recording,arm,model\na.csv,x,m.xml\nb.csv,x,n.xml\n", "row 2: arm x has the model"),
        ('recording\n"a.csv\n', "no CSV"),
        ("", "the file is empty"),
    ],
)
def test_a_bad_table_is_one_sentence(tmp_path, capsys, text, said):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(InputError, match=re.escape(said)):
        load_table(tmp_path / "t.csv", None)
    assert main(["fleet", str(tmp_path / "t.csv"), "--out", str(tmp_path / "out"), "--workers", "0"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_table_as_a_spreadsheet_writes_it(tmp_path):
    lines = [
        "\ufeffrecording;model;time;Reference",
        '"a;b.csv";sub/x.xml;2026-03-01T12:00;yes',
        ";;;",
        "c.csv;;;",
    ]
    (tmp_path / "t.csv").write_text("\r\n".join(lines) + "\r\n")
    table = load_table(tmp_path / "t.csv", tmp_path / "own.xml")
    first, second = table.rows
    assert first.path == tmp_path / "a;b.csv"
    assert (first.arm, second.arm) == ("x", "own")
    assert first.when == 20513.5
    assert second.when is None
    assert table.dated
    assert table.columns == ("Reference",)
    assert dict(first.extra) == {"Reference": "yes"}


def test_the_first_and_the_last_healthy_recording_go_beside_the_others(tmp_path):
    header = ("recording", "arm", "day", "reference")
    days = {"a.csv": 5, "b.csv": 1, "c.csv": 3, "d.csv": 2}
    rows = [[name, "x", str(day), "yes"] for name, day in days.items()]
    rows += [["other.csv", "y", "0", "1"], ["suspect.csv", "x", "9", ""]]
    table = load_table(write_table(tmp_path, rows, header), None)
    told = {row.number: {"estimates": [1]} for row in table.rows}
    beside = lambda: [row.recording for row in run._beside(table.rows[-1], table, told)]
    assert beside() == ["b.csv", "a.csv"]
    told[2] = {"status": "unreadable"}  # b.csv
    assert beside() == ["d.csv", "a.csv"]


# Workers


class Ref:
    """A call of a worker's, whose result is not there yet."""

    def __init__(self, what):
        self.what = what


class FakeRay:
    """Ray as far as a crew needs it, in this process: workers that die when they are told to."""

    class exceptions:
        class RayError(Exception):
            pass

        class RayActorError(RayError):
            pass

        class RayTaskError(RayError):
            pass

    def __init__(self, dies, uses=lambda task: 1, begins=lambda: True):
        self.dies, self.uses, self.begins = dies, uses, begins
        self.hired, self.killed, self.places = 0, 0, []

    def remote(self, **_):
        call = lambda make: types.SimpleNamespace(remote=make)
        api = self

        class Actor:
            node, settle, shard = call(lambda: Ref("node")), call(api.places.append), call(Ref)

            def __init__(self):
                api.hired += 1

        return lambda _: call(Actor)

    def get(self, reference):
        what = reference.what
        if what == "node" and self.begins():
            return "node"
        if what == "node" or self.dies(what):
            raise self.exceptions.RayActorError("The actor died. And more.")
        return json.dumps({"key": what.key, "status": "diagnosed"}), self.uses(what)

    def wait(self, references, num_returns):
        return references[-num_returns:], references[:-num_returns]

    def kill(self, worker):
        self.killed += 1


def tasks(count: int) -> list[Task]:
    return [Task(f"k{i}", Path(f"r{i}.csv"), None, (), Options()) for i in range(count)]


def test_a_worker_that_dies_costs_its_shard_which_another_makes():
    left = {3: 1, 7: 2}

    def dies(task):
        number = int(task.key[1:])
        left[number] = left.get(number, 0) - 1
        return left[number] >= 0

    api = FakeRay(dies)
    made = dict(crew._Crew(api, 2, None, 10).outcomes(tasks(10)))
    assert sorted(made) == list(range(10))
    assert all(json.loads(text)["status"] == "diagnosed" for text in made.values())
    assert api.killed == 3
    assert set(api.places) == {0, 1}  # each has a core of its own, a dead one's is taken


def test_a_recording_that_no_worker_survives_is_named_and_the_others_finish():
    api = FakeRay(lambda task: task.key == "k1")
    made = {i: json.loads(text) for i, text in crew._Crew(api, 2, None, 10).outcomes(tasks(6))}
    assert Counter(d["status"] for d in made.values()) == {"diagnosed": 5, "lost": 1}
    assert made[1]["message"] == "r1.csv: 3 workers ended while they were at it, the last as The actor died"
    assert api.killed == crew.ATTEMPTS


def test_workers_that_never_begin_are_given_up_on():
    api = FakeRay(lambda task: False, begins=lambda: False)
    with pytest.raises(InputError, match="no worker begins \\(The actor died"):
        dict(crew._Crew(api, 2, None, 10).outcomes(tasks(6)))
    assert api.hired < 20


def test_a_worker_is_replaced_when_its_memory_passes_the_limit():
    api = FakeRay(lambda task: False, uses=lambda task: 11 if task.key in ("k2", "k5") else 3)
    assert len(dict(crew._Crew(api, 1, None, 10).outcomes(tasks(8)))) == 8
    assert (api.hired, api.killed) == (3, 2)


def test_a_model_that_is_not_there_is_told_by_its_row(resting, tmp_path):
    table = tmp_path / "fleet.csv"
    table.write_text(
        f"recording,arm,model\n{resting / 'left_0.csv'},a,{resting / 'arm.xml'}\nb.csv,b,none.xml\n"
    )
    with pytest.raises(InputError, match=r"fleet\.csv: row 2: column model: .*none\.xml: no such file"):
        diagnose_fleet(table, tmp_path / "o", workers=0)
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--workers", "-1"], "--workers -1: a number from 0 is needed"),
        (["--workers", "0", "--address", "auto"], "--workers 0 works in this process"),
        (["--workers", "0", "--worker-memory", "0"], "--worker-memory 0: a size in GB is needed"),
        (["--workers", "0", "--model", "none.xml"], "none.xml: cannot be read (no such file)"),
    ],
)
def test_bad_usage_is_one_sentence(resting, tmp_path, capsys, given, said):
    model = [] if "--model" in given else ["--model", str(resting / "arm.xml")]
    assert main(["fleet", str(resting / "fleet.csv"), *model, "--out", str(tmp_path / "o"), *given]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert err.count("\n") == 1
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize("address", ["nowhere", "127.0.0.1:port", "127.0.0.1:99999"])
def test_an_address_where_nobody_is_is_one_sentence(address):
    with pytest.raises(InputError, match=f"--address {address}: no cluster answers"):
        crew.require_answer(address)


def test_an_address_where_nobody_listens_is_one_sentence():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # and does not listen
        with pytest.raises(InputError, match="no cluster answers"):
            crew.require_answer(f"127.0.0.1:{taken.getsockname()[1]}")


def test_without_ray_one_sentence_says_what_to_install(resting, tmp_path, capsys, monkeypatch):
    def absent(name):
        raise ImportError(name)

    monkeypatch.setattr(crew, "importlib", types.SimpleNamespace(import_module=absent))
    command = ["fleet", str(resting / "fleet.csv"), "--model", str(resting / "arm.xml")]
    assert main([*command, "--out", str(tmp_path / "o")]) == 2
    assert "needs the extra [fleet]: pip install 'jaxpanda[fleet]'" in capsys.readouterr().err


# The page


def test_the_page_is_one_offline_file_and_shows_the_worst_first(tmp_path):
    found = fleet(1, 3, 15, drift=(1,), once=(2,), found=True)
    odd = found.table.rows[0]
    object.__setattr__(odd, "recording", "<script>alert(1)</script>\x1b[2J")
    found.save(tmp_path)
    result(tmp_path / "fleet.json")
    page = (tmp_path / "fleet.html").read_text()
    assert not re.search(r"https?:|<script|url\(|@import|src=", page)
    assert "&lt;script&gt;alert(1)&lt;/script&gt;\\x1b[2J" in page
    order = re.findall(r'<a href="#a\d">(arm \d+)</a>', page)
    off = {arm.name: arm.off_by_noise for arm in found.arms}
    assert order == sorted(order, key=lambda name: -off[name])
    assert "coulomb friction, joint 1: drifts by +0.0" in page
    assert 'class="once"' in page


@pytest.mark.slow
@pytest.mark.parametrize(("arms", "recordings"), [(25, 40), (200, 5)])
def test_the_page_of_a_thousand_recordings_is_small(tmp_path, arms, recordings):
    fleet(2, arms, recordings, joints=3, drift=(1, 2), found=True).save(tmp_path)
    assert (tmp_path / "fleet.html").stat().st_size < 3_000_000


# Moving arms, and Ray


@pytest.fixture(scope="module")
def moving(tmp_path_factory) -> Path:
    """Two days of an arm with friction that its model lacks, by MuJoCo's C engine."""
    folder = tmp_path_factory.mktemp("moving")
    (folder / "arm.xml").write_text(ARM)
    sensors = Sensors(torque_noise=0.05, position_noise=5e-6, velocity_noise=1e-3)
    friction = JointFriction(
        viscous=np.array([0.2, 0.1]), coulomb=np.array([0.6, 0.0]), offset=np.array([0.3, 0.0])
    )
    rows = []
    for i in range(3):
        motion = random_trajectory(folder / "arm.xml", i, period=3.0, speed=2.0, acceleration=12.0)
        log = simulate(
            folder / "arm.xml", motion, duration=3.0, rate=200.0, friction=friction, sensors=sensors, seed=i
        )
        save(log, folder / f"day_{i}.csv")
        rows.append([f"day_{i}.csv", str(i)])
    write_table(folder, rows, ("recording", "day"))
    return folder


@pytest.mark.slow
def test_levels_of_every_recording_are_the_truth_within_their_deviations(moving):
    found = diagnose_fleet(moving / "fleet.csv", moving / "here", model=moving / "arm.xml")
    assert found.made == 3
    truth = {
        ("viscous_friction", 1): 0.2, ("viscous_friction", 2): 0.1, ("coulomb_friction", 1): 0.6,
        ("coulomb_friction", 2): 0.0, ("torque_offset", 1): 0.3,
    }  # fmt: skip
    for document in found.told.values():
        told = {(e["quantity"], e["joint"]): e for e in document["estimates"]}
        assert truth.keys() <= told.keys()
        for key, value in truth.items():
            assert abs(told[key]["value"] - value) < 4 * told[key]["std"], key
        # a smooth transition of 0.02 rad/s is what was simulated and what is fitted: nothing of the law is left
        assert told["held_out_error", 1]["value"] < 0.2 * told["error_of_model", 1]["value"]
    mean = {(q.name, q.joint): q.history.mean for q in found.arms[0].quantities if q.history is not None}
    assert abs(mean["coulomb_friction", 1].value - 0.6) < 0.05


@pytest.mark.slow
def test_ray_s_workers_make_the_same_bits_though_one_is_killed(moving, tmp_path, monkeypatch, capsys):
    """Needs Ray, which the extra [fleet] brings."""
    ray = pytest.importorskip("ray", reason="the extra [fleet] is not installed")
    monkeypatch.setenv("JAXPANDA_CACHE", str(tmp_path / "cache"))
    killed = []

    class Mortal(crew._Crew):
        """The first worker that begins is killed when it has been given something."""

        def _begin(self, where, *, alone):
            worker = self.called[where]
            super()._begin(where, alone=alone)
            if not killed and worker in self.places:
                killed.append(os.kill(ray.get(worker.process.remote()), signal.SIGKILL))

    monkeypatch.setattr(crew, "_Crew", Mortal)
    out = tmp_path / "ray"
    found = diagnose_fleet(moving / "fleet.csv", out, model=moving / "arm.xml", workers=2)
    assert len(killed) == 1
    assert found.made == 3
    assert not ray.is_initialized()
    assert capsys.readouterr().out == ""  # Ray tells of the dead there
    here = moving / "here"
    diagnose_fleet(moving / "fleet.csv", here, model=moving / "arm.xml")
    assert {name: (out / name).read_bytes() for name in SET} == {
        name: (here / name).read_bytes() for name in SET
    }
    assert contents(out / "shards") == contents(here / "shards")


def test_ray_is_told_to_send_nothing_home(monkeypatch):
    monkeypatch.delenv("RAY_USAGE_STATS_ENABLED", raising=False)
    told = []
    imported = lambda name: told.append(os.environ["RAY_USAGE_STATS_ENABLED"])
    monkeypatch.setattr(crew, "importlib", types.SimpleNamespace(import_module=imported))
    crew.ray()
    assert told == ["0"]
