"""Starts over devices and processes, and runs that are taken up where they stopped: the same answer each way."""

import csv
import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxpanda import pipeline
from jaxpanda.__main__ import main
from jaxpanda.errors import InputError
from jaxpanda.feasible import Bounds, Solutions, schedule, solve
from jaxpanda.feasible.checkpoint import identity
from jaxpanda.retrieval import Retrieval

FIELDS = ("phi", "extra", "objective", "violation", "converged", "iterations")
SMALL = {"starts": 40, "chunk": 8, "seed": 5}


def problem() -> tuple[np.ndarray, np.ndarray, Bounds]:
    """One link and one further unknown, fewer equations than unknowns, not all of them reachable."""
    A = np.random.default_rng(2).normal(size=(8, 11))
    bounds = Bounds(
        mass=np.array([[0.1, 5.0]]),
        com=np.tile([-0.2, 0.2], (1, 3, 1)),
        inertia=np.tile([[0.0, 1.0]] * 3 + [[-1.0, 1.0]] * 3, (1, 1, 1)),
    )
    return A, np.random.default_rng(3).normal(size=8), bounds


@pytest.fixture(scope="module")
def whole() -> Solutions:
    """The run that is never interrupted, on one device."""
    return solve(*problem(), **SMALL)


def require_same(found: Solutions, whole: Solutions) -> None:
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name), name)


class Stop(Exception):
    pass


def interrupted(path: Path, after: int = 16, **options) -> None:
    """A run that ends when so many starts are done."""

    def stop(done: int, total: int) -> None:
        if done >= after:
            raise Stop

    with pytest.raises(Stop):
        solve(*problem(), **(SMALL | options), checkpoint=path, progress=stop)


def test_chunks_that_are_fetched_in_pieces_come_whole_and_in_order():
    squares = lambda factor, numbers: (factor * numbers, numbers[:, None] ** 2)
    wide, starts = 3 * 16384 + 5, 2 * (3 * 16384 + 5) + 20000  # four pieces a chunk, the last chunk in part
    found, _, _ = schedule.run(squares, np.asarray(2), (), starts=starts, chunk=wide)
    np.testing.assert_array_equal(found[0], 2 * np.arange(starts))
    np.testing.assert_array_equal(found[1][:, 0], np.arange(starts) ** 2)


@pytest.mark.slow
def test_an_interrupted_run_goes_on_from_its_last_chunk_with_the_same_bits(whole, tmp_path):
    path, told = tmp_path / "starts.partial", []
    interrupted(path)
    found = solve(
        *problem(), **SMALL, checkpoint=path, progress=lambda done, total: told.append((done, total))
    )
    assert told == [(16, 40), (24, 40), (32, 40), (40, 40)]
    require_same(found, whole)


def test_a_finished_checkpoint_leaves_nothing_to_solve(whole, tmp_path):
    path, told = tmp_path / "starts.partial", []
    for _ in range(2):
        told.clear()
        found = solve(*problem(), **SMALL, checkpoint=path, progress=lambda done, _: told.append(done))
    assert told == [40]
    require_same(found, whole)


def test_a_run_may_go_on_with_more_starts(whole, tmp_path):
    path = tmp_path / "starts.partial"
    interrupted(path, starts=24)
    require_same(solve(*problem(), **SMALL, checkpoint=path), whole)


@pytest.mark.parametrize("damage", ["torn", "flipped"])
def test_a_damaged_last_chunk_is_solved_again(whole, tmp_path, damage):
    path, told = tmp_path / "starts.partial", []
    interrupted(path)
    content = bytearray(path.read_bytes())
    if damage == "torn":
        del content[-5:]
    else:
        content[-5] ^= 1
    path.write_bytes(content)
    for _ in range(2):  # the second time from a file that was repaired and finished
        found = solve(*problem(), **SMALL, checkpoint=path, progress=lambda done, _: told.append(done))
        require_same(found, whole)
    assert told == [8, 16, 24, 32, 40, 40]


def limit(most: float):
    return lambda links: most - links.mass


@pytest.mark.parametrize(
    ("change", "differing"),
    [
        ({"seed": 6}, "seed"),
        pytest.param({"constraints": [limit(3.0)]}, "constraints", marks=pytest.mark.slow),
        ({"extra_upper": np.array([0.2])}, "further unknowns"),
    ],
)
def test_a_checkpoint_of_another_run_is_refused_and_kept(tmp_path, change, differing):
    path = tmp_path / "starts.partial"
    interrupted(path)
    before = path.read_bytes()
    with pytest.raises(InputError, match=rf"starts\.partial.*other {differing}"):
        solve(*problem(), **SMALL | change, checkpoint=path)
    assert path.read_bytes() == before


def test_constraints_are_told_apart_by_what_they_compute():
    first, again, other = (
        identity(*problem(), [limit(most)], (), 0, ())["constraints"] for most in (4.0, 4.0, 3.0)
    )
    assert first == again
    assert first != other
    assert first != identity(*problem(), [limit(4.0), limit(4.0)], (), 0, ())["constraints"]


def test_a_file_that_is_no_checkpoint_is_refused_and_kept(tmp_path):
    path = tmp_path / "starts.partial"
    path.write_text("mine\n")
    with pytest.raises(InputError, match=r"starts\.partial: is no checkpoint"):
        solve(*problem(), **SMALL, checkpoint=path)
    assert path.read_text() == "mine\n"


# The command, on a table of its own.


@pytest.fixture
def table(tmp_path) -> list[str]:
    """Arguments that name a small problem's files."""
    A, b, bounds = problem()
    names = [
        "m1",
        *[f"m1c1{axis}" for axis in "xyz"],
        *[f"J1{e}" for e in ("xx", "xy", "yy", "xz", "yz", "zz")],
    ]
    rows = [
        {"terms": dict(zip(names, row[:10], strict=True)), "value": value, "reliable": True}
        for row, value in zip(A.tolist(), b.tolist(), strict=True)
    ]
    (tmp_path / "table.json").write_text(json.dumps({"coefficients": rows}))
    with (tmp_path / "bounds.csv").open("w", newline="") as file:
        csv.writer(file).writerows([("name", "lower", "upper"), *((n, *box) for n, box in bounds.boxes())])
    return [
        *("--identification", str(tmp_path / "table.json"), "--bounds", str(tmp_path / "bounds.csv")),
        *("--starts", "3000", "--seed", "5", "--json"),
    ]


def test_ctrl_c_keeps_what_is_done_and_the_same_command_finishes_it(table, tmp_path, monkeypatch, capsys):
    outs = [tmp_path / "whole", tmp_path / "interrupted"]
    assert main(["retrieve", *table, "--out", str(outs[0])]) == 0
    original = pipeline.retrieve

    def stopped(*arguments, progress, **options):
        def stop(done: int, total: int) -> None:
            progress(done, total)
            raise KeyboardInterrupt

        return original(*arguments, progress=stop, **options)

    monkeypatch.setattr(pipeline, "retrieve", stopped)
    assert main(["retrieve", *table, "--out", str(outs[1])]) == 1
    assert "the same command goes on" in capsys.readouterr().err
    assert [path.name for path in outs[1].iterdir()] == ["starts.partial"]
    monkeypatch.setattr(pipeline, "retrieve", original)
    assert main(["retrieve", *table, "--out", str(outs[1])]) == 0
    assert sorted(path.name for path in outs[1].iterdir()) == ["retrieval.json", "starts.npz"]
    found, whole = (Retrieval.load(out) for out in reversed(outs))
    np.testing.assert_array_equal(found.standard, whole.standard)
    require_same(found.solutions, whole.solutions)


def environment(**changes: str) -> dict[str, str]:
    root = Path(__file__).parents[1]
    own = [str(root), str(root / "kernels"), str(root / "tests")]
    paths = os.pathsep.join([*own, *filter(None, [os.environ.get("PYTHONPATH")])])
    return os.environ | {"PYTHONPATH": paths, "JAX_PLATFORMS": "cpu"} | changes


@pytest.mark.slow
def test_four_devices_give_the_answer_of_one(whole, tmp_path):
    code = (
        "import jax, numpy, test_scale; from jaxpanda import session; session.start();"
        "from jaxpanda.feasible import schedule; schedule._WORTH = 1; assert len(jax.devices()) == 4;"
        "found = test_scale.solve(*test_scale.problem(), **test_scale.SMALL);"
        f"numpy.savez({str(tmp_path / 'four.npz')!r}, **{{n: getattr(found, n) for n in test_scale.FIELDS}})"
    )
    flags = "--xla_force_host_platform_device_count=4"
    subprocess.run([sys.executable, "-c", code], env=environment(XLA_FLAGS=flags), check=True, timeout=300)
    with np.load(tmp_path / "four.npz") as four:
        for name in FIELDS:
            np.testing.assert_allclose(four[name], getattr(whole, name), rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_two_processes_share_the_starts_and_the_first_alone_writes(table, tmp_path):
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    outs = [tmp_path / "first", tmp_path / "second"]
    as_it_is = "import sys; from jaxpanda.__main__ import main; sys.exit(main(sys.argv[1:]))"
    # longer than a rank may be silent, and than ranks wait for each other at first
    late = "import time; from jaxpanda import pipeline; retrieve = pipeline.retrieve_files; "
    late += "pipeline.retrieve_files = lambda *a, **k: (time.sleep(15), retrieve(*a, **k))[1]; " + as_it_is
    running = [
        subprocess.Popen(
            [
                *(sys.executable, "-c", code, "retrieve", *table),
                *("--out", str(out), "--processes", f"{rank}/2@{address}"),
            ],
            env=environment(),
            stdout=subprocess.PIPE,
            text=True,
        )
        for rank, (code, out) in enumerate(zip((as_it_is, late), outs, strict=True))
    ]
    printed = [process.communicate(timeout=300)[0] for process in running]
    assert [process.returncode for process in running] == [0, 0]
    assert not outs[1].exists()
    assert printed[1] == ""
    assert main(["retrieve", *table, "--out", str(tmp_path / "alone")]) == 0
    both, alone = Retrieval.load(outs[0]), Retrieval.load(tmp_path / "alone")
    np.testing.assert_allclose(both.standard, alone.standard, rtol=1e-12, atol=1e-12)
    for name in FIELDS:
        np.testing.assert_allclose(
            getattr(both.solutions, name), getattr(alone.solutions, name), rtol=1e-12, atol=1e-12
        )


@pytest.mark.parametrize("processes", ["2/2@localhost:1", "0@localhost:1", "0/2", "0/2@localhost"])
def test_processes_that_make_no_sense_are_refused(table, tmp_path, capsys, processes):
    assert main(["retrieve", *table, "--out", str(tmp_path / "out"), "--processes", processes]) == 2
    assert "RANK/COUNT@HOST:PORT" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
