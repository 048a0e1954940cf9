"""Processes that share a computation: they exchange, refuse to mix, and end together."""

import contextlib
import importlib.util
import json
import random
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxpanda import ranks
from jaxpanda.errors import InputError, RankError
from jaxpanda.ranks import Ranks, joined


@pytest.fixture
def port() -> int:
    with socket.socket() as free:
        free.bind(("localhost", 0))
        return free.getsockname()[1]


def together(port: int, count: int, work: Callable[[Ranks], object], without: int = -1) -> list[Any]:
    """What each rank came to, or the error that ended it; a thread stands for a process."""

    def one(rank: int) -> Any:
        try:
            with joined(f"{rank}/{count}@localhost:{port}") as found:
                return work(found)
        except Exception as error:
            return error

    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(one, (rank for rank in range(count) if rank != without)))


def test_every_rank_has_the_arrays_of_all(port):
    def work(found: Ranks) -> list[list[np.ndarray]]:
        found.gather([np.asarray(found.rank)])
        return found.gather([np.full((found.rank, 2), 1.5), np.array([True, False]), np.arange(found.rank)])

    for held in together(port, 3, work):
        assert [[part.shape for part in one] for one in held] == [[(r, 2), (2,), (r,)] for r in range(3)]
        assert held[2][0].dtype == float
        assert held[0][1].tolist() == [True, False]
        assert held[2][2].tolist() == [0, 1]


def test_a_process_alone_is_the_first_of_one():
    for given in ("", "0/1@localhost:1"):
        with joined(given) as alone:
            assert (alone.rank, alone.count) == (0, 1)
            alone.require_same({"seed": "1"})
            assert alone.gather([np.ones(2)])[0][0].tolist() == [1, 1]


def test_ranks_that_were_given_different_things_say_which(port):
    def work(found: Ranks) -> None:
        found.require_same({"seed": "5" if found.rank < 2 else "6", "bounds": "a"})

    for error in together(port, 3, work):
        assert isinstance(error, InputError)
        assert "rank 2 has other seed than rank 0" in str(error)


@pytest.mark.parametrize("whose", [0, 2])
def test_bad_input_at_one_rank_ends_all_with_its_sentence(port, whose):
    def work(found: Ranks) -> None:
        if found.rank == whose:
            raise InputError("bounds.csv: row 3 is empty")
        found.gather([np.ones(1)])

    answers = together(port, 3, work)
    assert [isinstance(answer, InputError) for answer in answers] == [True] * 3
    assert all("bounds.csv: row 3 is empty" in str(answer) for answer in answers)


def test_a_failure_after_the_last_exchange_still_ends_all(port):
    def work(found: Ranks) -> None:
        if found.rank == 0:
            raise OSError("disk full")

    first, second = together(port, 2, work)
    assert isinstance(first, OSError)
    assert isinstance(second, RankError)
    assert "rank 0: disk full" in str(second)


def test_a_rank_that_is_gone_ends_all(port):
    def work(found: Ranks) -> None:
        if found.rank == 1:
            found.close()  # type: ignore[attr-defined]  # as the system does when a process is killed
            raise SystemError
        found.gather([np.ones(1)])

    first, _, third = together(port, 3, work)
    for error in (first, third):
        assert isinstance(error, RankError)
        assert "rank 1 ended before the work was done" in str(error)


def test_a_rank_that_falls_silent_ends_all(port, monkeypatch):
    monkeypatch.setattr(ranks, "SILENCE", 0.5)
    monkeypatch.setattr(ranks, "_BEAT", 60.0)
    first, second = together(port, 2, lambda found: found.rank == 0 or time.sleep(2))
    assert first is True  # rank 0 was done before
    assert second is None

    def work(found: Ranks) -> None:
        if found.rank == 0:
            found.gather([np.ones(1)])
        time.sleep(2)

    first, _ = together(port, 2, work)
    assert isinstance(first, RankError)
    assert "rank 1 has said nothing for 0.5 s" in str(first)


@pytest.mark.parametrize(
    ("without", "said"), [(0, "rank 0 was not found"), (1, "rank 1 of 3 did not come within 1 s")]
)
def test_a_missing_rank_ends_all(port, monkeypatch, without, said):
    monkeypatch.setattr(ranks, "WAIT", 1.0)
    for error in together(port, 3, lambda found: None, without):
        assert isinstance(error, InputError)
        assert said in str(error)


@pytest.mark.parametrize(
    ("third", "said"), [("1/3", "there are two ranks 1"), ("1/4", "rank 1 says 4 processes, rank 0 3")]
)
def test_ranks_that_do_not_fit_are_refused(port, third, said):
    def one(given: str) -> str:
        try:
            with joined(f"{given}@localhost:{port}"):
                return "joined"
        except InputError as error:
            return str(error)

    with ThreadPoolExecutor(3) as pool:
        answers = list(pool.map(one, ["0/3", "1/3" if third == "1/3" else "2/3", third]))
    assert said in answers[0]
    assert said in answers[2]  # the other may come when all is over


@contextlib.contextmanager
def serving(port: int, says: bytes) -> Iterator[None]:
    """Another program at the port."""
    held = []
    with socket.create_server(("localhost", port)) as server:

        def serve() -> None:
            with contextlib.suppress(OSError):
                while True:
                    held.append(server.accept()[0])
                    held[-1].sendall(says)

        threading.Thread(target=serve, daemon=True).start()
        yield


@pytest.mark.parametrize("says", [b"", b"SSH-2.0-OpenSSH_9.6\r\n" * 20])
def test_a_port_that_another_program_uses_is_told_at_every_rank(port, says):
    with serving(port, says):
        first, second = together(port, 2, lambda found: None)
    assert "cannot listen at localhost" in str(first)
    assert "is not rank 0 of this run" in str(second)
    assert isinstance(first, InputError)
    assert isinstance(second, InputError)


def test_a_stranger_at_the_port_is_ignored(port):
    def knock() -> None:
        until = time.monotonic() + 10
        while time.monotonic() < until and not heard.is_set():
            with contextlib.suppress(OSError), socket.create_connection(("localhost", port), 1) as one:
                one.sendall(b"GET / HTTP/1.1\r\n\r\n" * 3)
                heard.set()

    heard = threading.Event()
    stranger = threading.Thread(target=knock)
    stranger.start()

    def late(rank: int) -> str:
        if rank:
            heard.wait(10)
        with joined(f"{rank}/2@localhost:{port}") as found:
            return str(found.gather([np.asarray(rank)])[1][0])

    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(late, range(2))) == ["1", "1"]
    assert heard.is_set()


@pytest.mark.parametrize(
    ("nodes", "host"), [("gpu[07-09,12],other", "gpu07"), ("one,two", "one"), ("a-b3", "a-b3")]
)
def test_slurm_says_rank_count_and_the_first_node(monkeypatch, nodes, host):
    given = {"PROCID": "2", "STEP_NUM_TASKS": "4", "STEP_NODELIST": nodes, "JOB_ID": "4098", "STEP_ID": "1"}
    for name, value in given.items():
        monkeypatch.setenv(f"SLURM_{name}", value)
    assert ranks._address("auto") == (2, 4, host, 61440 + 3)
    monkeypatch.delenv("SLURM_PROCID")
    with pytest.raises(InputError, match=r"no task of Slurm.*RANK/COUNT"):
        ranks._address("auto")


def test_an_unknown_host_is_one_sentence():
    for rank in range(2):
        with (
            pytest.raises(InputError, match=r"no-such-host\.invalid"),
            joined(f"{rank}/2@no-such-host.invalid:9"),
        ):
            pass


@pytest.mark.parametrize("late", [0.0, 1.0])
@pytest.mark.parametrize("work", ["exchanging", "computing"])
def test_an_interrupt_says_what_the_other_rank_said_however_late_it_comes(port, monkeypatch, late, work):
    kill = ranks.signal.pthread_kill
    monkeypatch.setattr(ranks.signal, "pthread_kill", lambda *given: time.sleep(late) or kill(*given))
    came: list[object] = []
    before = ranks.signal.signal(ranks._INTERRUPT, lambda *_: came.append("too late"))

    def other() -> None:
        with contextlib.suppress(InputError), joined(f"0/2@localhost:{port}"):
            raise InputError("the third row is empty")

    first = threading.Thread(target=other)
    first.start()
    try:
        with (
            pytest.raises(InputError, match="rank 0: the third row"),
            joined(f"1/2@localhost:{port}") as here,
        ):
            here.gather([np.ones(1)]) if work == "exchanging" else time.sleep(30.0)
    except KeyboardInterrupt:  # it would end all tests
        pytest.fail("an interrupt came through")
    finally:
        first.join()
        time.sleep(late)
        ranks.signal.signal(ranks._INTERRUPT, before)
    assert not came


# Whole commands

PATH = Path(__file__).parents[1] / "experiments" / "hostile" / "ranks.py"


def experiment():
    spec = importlib.util.spec_from_file_location("hostile_ranks", PATH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_commands_end_with_a_sentence_when_a_rank_is_killed_or_given_something_else(tmp_path):
    faults = experiment()
    faults.material(tmp_path)
    wanted = {"SIGKILL to a rank", "SIGTERM to a rank", "other seed", "no_folder"}
    chosen = {fault.__name__: fault for fault in faults.FAULTS if fault.__name__ in wanted}
    assert chosen.keys() == wanted
    for fault in chosen.values():
        run = faults.Run(tmp_path, 2, random.Random(4))
        assert faults.tried(fault, run) == []


def test_the_faults_material_is_what_retrieve_reads(tmp_path):
    experiment().material(tmp_path)
    assert len(json.loads((tmp_path / "table.json").read_text())["coefficients"]) == 20
