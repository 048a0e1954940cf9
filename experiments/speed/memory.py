"""Does a process that diagnoses again and again grow, and how much does a result hold?

    python experiments/speed/memory.py --cases DIR … --count 30 [--arm NAME]

Diagnoses the recordings of so many cases of ../outside or ../concealed (arms, rates and lengths differ, so that
what is compiled differs too; with `--arm`, those of one) in one process, and prints its resident memory after
each, without the result and what more it was with it [MiB].
"""

import argparse
import json
import time
from pathlib import Path

import jaxpanda
from jaxpanda import session
from jaxpanda.host import return_freed


def resident() -> float:
    """Of this process, what is free given back [MiB]."""
    return_freed()
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1024


def main():
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--cases", type=Path, required=True, nargs="+")
    options.add_argument("--count", type=int, default=30)
    options.add_argument("--arm")
    given = options.parse_args()
    session.start()
    of_arm = lambda path: given.arm in (None, json.loads(path.read_text())["arm"])
    truths = [path for folder in given.cases for path in sorted(folder.glob("*/truth.json"))]
    cases = [path.parent for path in truths if of_arm(path)][: given.count]
    print("| diagnosis | recordings | s | memory, MiB | with its result, more |\n|---|---|---|---|---|")
    print(f"| 0 | | | {resident():.0f} | |")
    for number, case in enumerate(cases, 1):
        began = time.monotonic()
        logs = [jaxpanda.load(path) for path in sorted(case.glob("train_*.csv"))]
        found = jaxpanda.diagnose(case / "model.xml", logs)
        took, held = time.monotonic() - began, resident()
        del found
        left = resident()
        print(f"| {number} | {len(logs)} | {took:.0f} | {left:.0f} | {held - left:.0f} |", flush=True)


if __name__ == "__main__":
    main()
