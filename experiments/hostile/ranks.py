"""Faults of one rank among several that share a `retrieve`: does every rank end, in time, with one sentence?

    python experiments/hostile/ranks.py --seed 1 --count 40

Ranks run on this machine. The clock starts when the fault happens: for one that is there from the start, when the
last rank was started; a killed rank is given a moment between that and about when the result is there. After each
fault that left a checkpoint, one process finishes the run, whose answer must have the bits of a run that nothing
disturbed.
"""

import argparse
import contextlib
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

LIMIT = 20.0
STARTS = 60000
JUNK = b"GET / HTTP/1.1\r\nHost: here\r\n\r\n"


@dataclass
class Run:
    """One `retrieve` by several ranks, with a fault in it."""

    folder: Path
    count: int
    rng: random.Random
    out: Path = field(init=False)
    port: int = field(init=False)
    ranks: dict[int, subprocess.Popen[str]] = field(default_factory=dict)
    since: float = 0.0
    may_end_well: bool = False

    def __post_init__(self):
        self.out = self.folder / f"out{self.rng.randrange(10**9)}"
        with socket.socket() as free:
            free.bind(("localhost", 0))
            self.port = free.getsockname()[1]

    @property
    def other(self) -> int:
        """A rank that is not the first."""
        return self.rng.randrange(1, self.count)

    def start(self, rank: int, *changes: str, **more: str) -> None:
        """`more` replaces options of the command by name; `changes` are added."""
        options = {
            "identification": str(self.folder / "table.json"),
            "bounds": str(self.folder / "bounds.csv"),
            "starts": str(STARTS),
            "seed": "5",
            "out": str(self.out if rank == 0 else self.folder / "none"),
            "processes": f"{rank}/{self.count}@localhost:{self.port}",
        } | more
        words = [word for name, value in options.items() for word in (f"--{name}", value)]
        self.ranks[len(self.ranks)] = subprocess.Popen(
            [sys.executable, "-m", "jaxpanda", "retrieve", *words, *changes],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def start_all(self, without: int = -1) -> None:
        for rank in range(self.count):
            if rank != without:
                self.start(rank)
        self.since = time.monotonic()


def missing(run: Run) -> None:
    run.start_all(without=run.rng.randrange(run.count))


def twice(run: Run) -> None:
    """Two processes with one rank, and none with another."""
    run.count = max(run.count, 3)
    rank, again = run.rng.sample(range(1, run.count), 2)
    for one in range(run.count):
        run.start(again if one == rank else one)


def miscounted(run: Run) -> None:
    wrong = run.other
    for rank in range(run.count):
        count = run.count + (rank == wrong)
        run.start(rank, processes=f"{rank}/{count}@localhost:{run.port}")


def given_otherwise(**options: str) -> Callable[[Run], None]:
    def fault(run: Run) -> None:
        wrong = run.rng.randrange(run.count)
        for rank in range(run.count):
            more = {name: value.format(folder=run.folder) for name, value in options.items()}
            run.start(rank, **(more if rank == wrong else {}))

    fault.__name__ = "other " + ", ".join(options)
    return fault


def misspelled(run: Run) -> None:
    wrong = run.rng.randrange(run.count)
    for rank in range(run.count):
        run.start(rank, *(["--startz", "4"] if rank == wrong else []))


def signalled(kind: signal.Signals) -> Callable[[Run], None]:
    def fault(run: Run) -> None:
        run.start_all()
        whose = run.rng.randrange(run.count)
        time.sleep(run.rng.uniform(1.0, 20.0))
        run.since, run.may_end_well = time.monotonic(), run.ranks[0].poll() is not None
        run.ranks[whose].send_signal(kind)
        if kind == signal.SIGSTOP:
            later = threading.Timer(LIMIT, run.ranks[whose].send_signal, [signal.SIGCONT])
            later.start()
            run.ranks[-1] = run.ranks.pop(whose)

    fault.__name__ = f"{kind.name} to a rank"
    return fault


@contextlib.contextmanager
def listening(port: int, says: bytes) -> Iterator[None]:
    """Another program at the port."""
    with socket.create_server(("localhost", port)) as server:
        held = []

        def serve() -> None:
            with contextlib.suppress(OSError):
                while True:
                    connection, _ = server.accept()
                    held.append(connection)
                    if says:
                        connection.sendall(says)

        threading.Thread(target=serve, daemon=True).start()
        yield


def used_port(says: bytes) -> Callable[[Run], None]:
    def fault(run: Run) -> None:
        with listening(run.port, says):
            run.start_all()
            ended(run, LIMIT)

    fault.__name__ = "the port is used by a server that " + ("answers" if says else "is silent")
    return fault


def strangers(run: Run) -> None:
    """A scanner connects all the while; nothing may come of it."""
    run.start_all()
    run.may_end_well = True
    until = time.monotonic() + 8
    while time.monotonic() < until:
        with contextlib.suppress(OSError), socket.create_connection(("localhost", run.port), 1) as one:
            one.sendall(run.rng.choice([JUNK, os.urandom(200), b""]))
            time.sleep(0.05)
        time.sleep(0.1)
    run.since = time.monotonic() + 60  # it may take its time


def unknown_host(run: Run) -> None:
    for rank in range(run.count):
        run.start(rank, processes=f"{rank}/{run.count}@no-such-host.invalid:{run.port}")


def no_folder(run: Run) -> None:
    """Rank 0 cannot write."""
    for rank in range(run.count):
        run.start(rank, **({"out": "/proc/jaxpanda"} if rank == 0 else {}))


FAULTS: list[Callable[[Run], None]] = [
    missing,
    twice,
    miscounted,
    misspelled,
    unknown_host,
    no_folder,
    strangers,
    used_port(b""),
    used_port(JUNK),
    given_otherwise(seed="6"),
    given_otherwise(starts="7000"),
    given_otherwise(bounds="{folder}/wider.csv"),
    given_otherwise(identification="{folder}/other.json"),
    given_otherwise(bounds="{folder}/broken.csv"),
    given_otherwise(identification="{folder}/absent.json"),
    signalled(signal.SIGKILL),
    signalled(signal.SIGKILL),
    signalled(signal.SIGTERM),
    signalled(signal.SIGINT),
    signalled(signal.SIGSTOP),
]


def ended(run: Run, within: float) -> bool:
    watched = {number: process for number, process in run.ranks.items() if number >= 0}
    for process in watched.values():
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(max(0.05, run.since + within - time.monotonic()))
    return all(process.poll() is not None for process in watched.values())


def tried(fault: Callable[[Run], None], run: Run) -> list[str]:
    """What is wrong with how the ranks ended; prints what they said."""
    run.since = 0.0
    fault(run)
    run.since = run.since or time.monotonic()
    in_time, wrong = ended(run, LIMIT), []
    took = time.monotonic() - run.since
    if not in_time:
        wrong.append(f"not all ended within {LIMIT:g} s")
    said = []
    for number, process in run.ranks.items():
        if number < 0:  # was stopped; goes on and finds the others gone
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(LIMIT + 10)
        if process.poll() is None:
            process.kill()
        error = process.communicate()[1].strip()
        said.append(f"    [{process.returncode}] {error}")
        killed = process.returncode == -signal.SIGKILL and "SIGKILL" in fault.__name__
        if process.returncode == 0:
            if not run.may_end_well and number >= 0 and "SIG" not in fault.__name__:
                wrong.append("a rank ended well")
        elif not killed and (
            process.returncode not in (1, 2) or error.count("\n") or not error.startswith("jaxpanda: ")
        ):
            wrong.append(f"ended with {process.returncode}, and no sentence")
    print(f"{'; '.join(wrong) or 'ok':10} {took:5.1f} s  {fault.__name__}, {run.count} ranks", flush=True)
    print("\n".join(said), flush=True)
    return wrong


def finished(run: Run, whole: Path) -> list[str]:
    """Whether one process goes on from what is left, with the same bits."""
    if not (run.out / "starts.partial").exists():
        return []
    subprocess.run(command(run.folder, run.out), check=True, capture_output=True)
    with np.load(run.out / "starts.npz") as ours, np.load(whole / "starts.npz") as theirs:
        starts = [name for name in theirs.files if not name.endswith("_seconds")]
        same = all(np.array_equal(ours[name], theirs[name]) for name in starts)
    print(f"    finished from the checkpoint: {'the same bits' if same else 'OTHER BITS'}", flush=True)
    return [] if same else ["other bits"]


def command(folder: Path, out: Path) -> list[str]:
    words = [sys.executable, "-m", "jaxpanda", "retrieve", "--identification", str(folder / "table.json")]
    words += ["--bounds", str(folder / "bounds.csv"), "--starts", str(STARTS), "--seed", "5"]
    return [*words, "--out", str(out)]


def material(folder: Path) -> None:
    """A table of coefficients of three links, and bounds; wider ones, broken ones, another table."""
    rng = np.random.default_rng(2)
    names = [
        name.format(i)
        for i in (1, 2, 3)
        for name in (
            "m{}",
            "m{0}c{0}x",
            "m{0}c{0}y",
            "m{0}c{0}z",
            *(f"J{{0}}{e}" for e in ("xx", "xy", "yy", "xz", "yz", "zz")),
        )
    ]
    for file in ("table.json", "other.json"):
        rows = [
            {"terms": dict(zip(names, row.tolist(), strict=True)), "value": value, "reliable": True}
            for row, value in zip(rng.normal(size=(20, 30)), rng.normal(size=20).tolist(), strict=True)
        ]
        (folder / file).write_text(json.dumps({"coefficients": rows}))
    for file, most in (("bounds.csv", 5), ("wider.csv", 6)):
        lines = ["name,lower,upper"]
        for i in (1, 2, 3):
            lines += [f"m{i},0.1,{most}", *(f"c{i}{axis},-0.2,0.2" for axis in "xyz")]
            lines += [f"I{i}{e},{0 if e[0] == e[1] else -1},1" for e in ("xx", "yy", "zz", "xy", "xz", "yz")]
        (folder / file).write_text("\n".join(lines) + "\n")
    (folder / "broken.csv").write_text("name,lower,upper\nm1,nan,5\n")


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--count", type=int, default=40)
    options.add_argument("--only", default="", help="faults whose name has this in it")
    given = options.parse_args()
    rng, bad = random.Random(given.seed), 0
    signal.signal(signal.SIGINT, signal.default_int_handler)  # else a script in the background ignores it
    faults = [fault for fault in FAULTS if given.only in fault.__name__]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        material(folder)
        whole = folder / "whole"
        began = time.monotonic()
        subprocess.run(command(folder, whole), check=True)
        print(f"undisturbed, one process: {time.monotonic() - began:.1f} s")
        for number in range(given.count):
            run = Run(folder, 2 + rng.randrange(3), rng)
            wrong = tried(faults[number % len(faults)], run)
            wrong += finished(run, whole)
            bad += bool(wrong)
            shutil.rmtree(run.out, ignore_errors=True)
    print(f"{given.count} faults, {bad} of them not ended as they should")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
