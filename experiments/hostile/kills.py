"""Commands that are killed while they replace their own earlier result: is a set ever left half-written?

    python experiments/hostile/kills.py --seed 1 --count 15 [--only identify fleet ...]

Every command runs twice undisturbed, then `count` times over its result, ended by SIGKILL, SIGTERM or SIGINT:
half of the times at some moment of its second half, half within its last second, where it writes. Then the set
must be one run's, by the list of digests that it holds; a single file must be what the undisturbed run left.
SIGTERM and SIGINT must end in one sentence. After a last undisturbed run nothing of a killed one may be left.
"""

import argparse
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from run import material, thinned

from jaxpanda import session
from jaxpanda.demo import record
from jaxpanda.files import settle
from jaxpanda.inputs import digest
from jaxpanda.recordings import save

LATE = 1.0  # seconds, in which a command writes


def commands(folder: Path) -> dict[str, tuple[list[str], Path]]:
    """What each command is given, and where its result is; a later one may read an earlier one's."""
    log, model = str(folder / "arm.csv"), str(folder / "arm.xml")
    at = {
        name: folder / name for name in ("identify", "retrieve", "diagnose", "excite", "compare", "payload")
    }
    out = {
        name: folder / f"{name}_out" for name in ("validate", "ensemble", "rehearse", "fleet", "demo")
    } | at
    exported, tau, converted = folder / "export.xml", folder / "tau.csv", folder / "arm_again.npz"
    table = folder / "fleet.csv"
    table.write_text(f"recording,arm\n{log},first\n")
    given: dict[str, tuple[list[str], Path]] = {
        "identify": (["--recording", log, "--folds", "0"], out["identify"]),
        "retrieve": (
            ["--identification", str(at["identify"] / "identification.json"), "--starts", "64"],
            out["retrieve"],
        ),
        "export": (["--retrieval", str(at["retrieve"]), "--model", model], exported),
        "validate": (["--model", model, "--recording", log, "--no-mjx"], out["validate"]),
        "diagnose": (["--recording", log], out["diagnose"]),
        "predict": (["--diagnosis", str(at["diagnose"]), "--recording", log], tau),
        "payload": (["--without", log, "--with", str(folder / "other.csv")], out["payload"]),
        "convert": ([log], converted),
        "excite": (["--seconds", "5", "--starts", "1", "--no-collisions"], out["excite"]),
        "ensemble": (["--retrieval", str(at["retrieve"]), "--count", "20"], out["ensemble"]),
        "compare": ([str(at["identify"]), str(at["identify"])], out["compare"]),
        "rehearse": (["--motion", log, "--draws", "2"], out["rehearse"]),
        "fleet": ([str(table), "--workers", "0"], out["fleet"]),
        "demo": (["--recording", log, "--starts", "64"], out["demo"]),
    }
    return {name: ([*words, "--out", str(where)], where) for name, (words, where) in given.items()}


def whole(out: Path) -> str:
    """What is wrong with a set, by its own list; nothing where all is of one run."""
    settle(out)
    runs = {file.name: json.loads(file.read_text()).get("run") for file in out.glob("*.json")}
    if not runs or not all(runs.values()):
        return "no file says its run"
    lists = {
        name: (value, run["id"]) for run in runs.values() for name, value in run.get("files", {}).items()
    }
    for name, (value, run) in lists.items():
        if not (out / name).is_file():
            return f"{name} is missing"
        if digest(out / name) != value:
            return f"{name} is of another run"
        if name in runs and runs[name]["id"] != run:
            return f"{name} has another run's id"
    return ""


def scratch(out: Path) -> int:
    where = out if out.is_dir() else out.parent
    return sum(path.name.startswith(".jaxpanda.") for path in where.iterdir())


def killed(name: str, words: list[str], out: Path, rng: random.Random, count: int) -> Counter[str]:
    """How often a command's result was whole, and how it ended."""
    line, found = [sys.executable, "-m", "jaxpanda", name, *words], Counter[str]()
    for _ in range(2):
        began = time.monotonic()
        done = subprocess.run(line, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{name}: {done.stderr}")
        lasts = time.monotonic() - began
    before = out.read_bytes() if out.is_file() else b""
    for k in range(count):
        kind = rng.choice([signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
        with subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as child:
            late = k % 2 == 1
            time.sleep(max(0.0, lasts - rng.uniform(0, LATE)) if late else rng.uniform(0.5, 1.0) * lasts)
            child.send_signal(kind)
            said = child.communicate()[1]
        found["ended before" if child.returncode == 0 else kind.name] += 1
        if kind != signal.SIGKILL and child.returncode not in (
            0,
            1,
            -signal.SIGINT,
        ):  # Python's own, after the sentence
            found["before it had begun" if child.returncode == -kind else f"status {child.returncode}"] += 1
        if kind != signal.SIGKILL and child.returncode == 1 and said.strip().count("\n"):
            found["no sentence"] += 1
            print(said, file=sys.stderr)
        wrong = whole(out) if out.is_dir() else "" if out.read_bytes() == before else "another file"
        found[wrong or "whole"] += 1
    subprocess.run(line, check=True, capture_output=True)
    found["scratch folders left at the end"] = scratch(out)
    return found


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--count", type=int, default=15, help="of each command")
    options.add_argument("--only", nargs="*", default=())
    given = options.parse_args()
    rng, bad = random.Random(given.seed), 0
    signal.signal(signal.SIGINT, signal.default_int_handler)  # else a script in the background ignores it
    session.start()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        material(folder)
        save(thinned(record(seed=4, duration=2.0).recording), folder / "other.csv")
        every = commands(folder)
        for command, (words, out) in every.items():
            count = given.count if not given.only or command in given.only else 0
            found = killed(command, words, out, rng, count)
            bad += count - found["whole"] + found["no sentence"] + found["scratch folders left at the end"]
            print(f"{command}: {dict(found)}", flush=True)
    print(f"{bad} defects")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
