"""A fleet of virtual arms, its workers killed at random and some files corrupt: is anything lost or changed?"""

import argparse
import csv
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from jaxpanda.recordings import save
from jaxpanda.simulation import JointFriction, Sensors, random_trajectory, simulate

ARM = """<mujoco model="two joints"><compiler angle="radian"/><worldbody>
<body pos="0 0 0.3"><joint name="pan" axis="0 0 1" range="-2 2"/>
<inertial pos="0 0 0.1" mass="3" diaginertia="0.02 0.02 0.01"/>
<body pos="0 0 0.2"><joint name="lift" axis="0 1 0" range="-2 2"/>
<inertial pos="0.15 0 0" mass="2" diaginertia="0.004 0.02 0.02"/></body></body></worldbody></mujoco>"""
SENSORS = Sensors(torque_noise=0.05, torque_correlation_time=2e-3, position_noise=5e-6, velocity_noise=1e-3)
EACH = 8
"""Recordings of an arm, one a day."""
DRIFT, OFFSET = 0.03, 0.5
"""By which Coulomb friction of every third arm grows a day, and torque of the next is off on one day [N m]."""
RESULTS = ("fleet.json", "fleet.html", "recordings.parquet", "findings.parquet", "estimates.parquet")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder; what is in it is left")
    parser.add_argument("--count", type=int, default=24, help="recordings")
    parser.add_argument("--seconds", type=float, default=3.0, help="of a recording")
    parser.add_argument("--corrupt", type=int, default=2, help="files that are damaged")
    parser.add_argument("--kills", type=int, default=3, help="workers that are killed in the third run")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("JAXPANDA_CACHE", str(given.out / "cache"))
    table = make(given.out / "recordings", given)
    print(f"{given.count} recordings, {given.corrupt} of them corrupt", flush=True)

    figures: dict[str, Any] = {"count": given.count, "corrupt": given.corrupt}
    runs = {name: given.out / name for name in ("one", "two", "killed")}
    run(table.with_name("first.csv"), given.out / "first", 1)  # fills JAX's cache on disk
    for workers, name in ((1, "one"), (2, "two")):
        seconds = run(table, runs[name], workers)
        figures[name] = {"seconds": seconds, "a_minute_warm": pace(runs[name], workers)}
        print(
            f"{workers} worker(s): {seconds:.0f} s, warm {figures[name]['a_minute_warm']:.2f} a minute",
            flush=True,
        )
    figures["speed_up"] = figures["two"]["a_minute_warm"] / figures["one"]["a_minute_warm"]

    begun = start(table, runs["killed"], 2)
    killed = kill_at_random(begun, runs["killed"], given)
    stop_half_way(begun, runs["killed"], given.count)
    kept = len(list((runs["killed"] / "shards").glob("*.json")))
    run(table, runs["killed"], 2)
    figures["killed"] = {"workers_killed": killed[0], "finished_when_stopped": kept}

    whole = json.loads((runs["one"] / "fleet.json").read_text())
    figures["statuses"] = whole["statuses"]
    figures["others_all_finished"] = whole["statuses"].get("diagnosed", 0) == given.count - given.corrupt
    same = [contents(runs[name]) == contents(runs["one"]) for name in ("two", "killed")]
    figures["same_bits_two_workers"], figures["same_bits_after_kills"] = same

    before = contents(runs["one"])
    rng = random.Random(given.seed)
    shards = sorted((runs["one"] / "shards").glob("*.json"))
    for shard in rng.sample(shards, len(shards) // 3):
        shard.unlink()
    missing = len(shards) - len(list((runs["one"] / "shards").glob("*.json")))
    since = time.time()
    run(table, runs["one"], 2)
    again = sum(shard.stat().st_mtime > since for shard in (runs["one"] / "shards").glob("*.json"))
    figures["rerun"] = {"missing": missing, "made": again, "same_bits": contents(runs["one"]) == before}
    figures["rerun"]["seconds_when_nothing_is_missing"] = run(table, runs["one"], 2)
    figures["claims"] = [f"{claim['arm']}: {claim['sentence']}" for claim in whole["claims"]]
    figures["drifts_told"] = sorted(
        arm["arm"]
        for arm in whole["arms"]
        for q in arm["quantities"]
        if q["drift"] and q["drift"]["drifts"] and (q["quantity"], q["joint"]) == ("coulomb_friction", 1)
    )
    (given.out / "figures.json").write_text(json.dumps(figures, indent=1, ensure_ascii=False) + "\n")
    print(json.dumps(figures, indent=1, ensure_ascii=False))


def make(folder: Path, given: argparse.Namespace) -> Path:
    """Recordings, and the table of them."""
    folder.mkdir(exist_ok=True)
    (folder / "arm.xml").write_text(ARM)
    rows = []
    for i in range(given.count):
        arm, day = divmod(i, EACH)
        path = folder / f"arm{arm:03}_{day}.csv"
        rows.append([path.name, f"arm {arm:03}", f"2026-03-{day + 1:02}", "lab"])
        if not path.exists():
            save(record(folder / "arm.xml", given.seed, arm, day, given.seconds), path)
    for i in random.Random(given.seed).sample(range(given.count), given.corrupt):
        damage(folder / rows[i][0], i)
    for name, some in (("fleet.csv", rows), ("first.csv", rows[:1])):
        with (folder / name).open("w", newline="") as file:
            csv.writer(file).writerows([["recording", "arm", "day", "site"], *some])
    return folder / "fleet.csv"


def record(model: Path, seed: int, arm: int, day: int, seconds: float):
    """A day of an arm: every third has friction that grows, the next has torque that was off once."""
    rng = np.random.default_rng([seed, arm])
    coulomb = rng.uniform(0.3, 0.8) + (DRIFT * day if arm % 3 == 1 else 0.0)
    friction = JointFriction(
        viscous=rng.uniform(0.1, 0.3, 2),
        coulomb=np.array([coulomb, 0.0]),
        offset=np.array([OFFSET if arm % 3 == 2 and day == EACH // 2 else 0.0, 0.0]),
    )
    number = 1000 * (seed + 1) + EACH * arm + day
    motion = random_trajectory(model, number, period=seconds, speed=2.0, acceleration=12.0)
    return simulate(
        model, motion, duration=seconds, rate=200.0, friction=friction, sensors=SENSORS, seed=number
    )


def damage(path: Path, which: int) -> None:
    """Cut off, overwritten or emptied."""
    content = path.read_bytes()
    path.write_bytes(
        [content[: len(content) // 3], content[:2000] + b"\0\xff" + content[2002:], b""][which % 3]
    )


def start(table: Path, out: Path, workers: int) -> subprocess.Popen:
    command = [
        sys.executable,
        "-m",
        "jaxpanda",
        "fleet",
        str(table),
        "--model",
        str(table.with_name("arm.xml")),
    ]
    return subprocess.Popen(
        [*command, "--out", str(out), "--workers", str(workers)],
        stdout=subprocess.DEVNULL,
        start_new_session=True,
    )


def run(table: Path, out: Path, workers: int) -> float:
    """The command to its end; how long it took [s]."""
    since = time.monotonic()
    if start(table, out, workers).wait():
        raise SystemExit(f"the fleet in {out} was not finished")
    return time.monotonic() - since


def pace(out: Path, workers: int) -> float:
    """Recordings a minute once every worker has made its first two."""
    done = sorted(shard.stat().st_mtime for shard in (out / "shards").glob("*.json"))
    warm = min(2 * workers, len(done) - 2)
    return 60 * (len(done) - 1 - warm) / max(done[-1] - done[warm], 1e-3)


def kill_at_random(begun: subprocess.Popen, out: Path, given: argparse.Namespace) -> list[int]:
    """Have workers of a command killed at random instants while it works; how many were, so far."""
    count, rng = [0], random.Random(given.seed + 1)

    def killer() -> None:
        while count[0] < given.kills and begun.poll() is None:
            time.sleep(rng.uniform(2.0, 8.0))
            busy = [pid for pid, name in descendants(begun.pid) if name.startswith("ray::Worker")]
            if busy and any((out / "shards").glob("*.json")):
                os.kill(rng.choice(busy), signal.SIGKILL)
                count[0] += 1

    threading.Thread(target=killer, daemon=True).start()
    return count


def stop_half_way(begun: subprocess.Popen, out: Path, count: int) -> None:
    """End the command itself when half of the shards are there."""
    while begun.poll() is None and len(list((out / "shards").glob("*.json"))) < count // 2:
        time.sleep(0.2)
    begun.send_signal(signal.SIGTERM)
    begun.wait()


def descendants(root: int) -> list[tuple[int, str]]:
    """Processes below one, with their command lines."""
    parents, names = {}, {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            names[int(folder.name)] = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode()
        except (OSError, ValueError):
            continue
    found, new = set(), {root}
    while new:
        found |= new
        new = {pid for pid, parent in parents.items() if parent in found} - found
    return [(pid, names[pid]) for pid in found - {root} if pid in names]


def contents(out: Path) -> dict[str, bytes]:
    """Of all results and shards."""
    files = [*(out / name for name in RESULTS), *(out / "shards").glob("*.json")]
    return {file.name: file.read_bytes() for file in files}


if __name__ == "__main__":
    main()
