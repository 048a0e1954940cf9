"""Does a process that diagnoses again and again grow?

    python experiments/speed/memory.py --cases DIR --count 30

Diagnoses the recordings of so many cases of ../outside or ../concealed (arms, rates and lengths differ, so that
what is compiled differs too) in one process, and prints its resident memory after each [MiB].
"""

import argparse
import gc
import time
from pathlib import Path

import jaxpanda
from jaxpanda import session


def resident() -> float:
    """Of this process [MiB]."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1024


def main():
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--cases", type=Path, required=True)
    options.add_argument("--count", type=int, default=30)
    given = options.parse_args()
    session.start()
    cases = sorted(path.parent for path in given.cases.glob("*/truth.json"))[: given.count]
    print(f"| diagnosis | recordings | s | memory, MiB |\n|---|---|---|---|\n| 0 | | | {resident():.0f} |")
    for number, case in enumerate(cases, 1):
        began = time.monotonic()
        logs = [jaxpanda.load(path) for path in sorted(case.glob("train_*.csv"))]
        jaxpanda.diagnose(case / "model.xml", logs)
        took = time.monotonic() - began
        gc.collect()
        print(f"| {number} | {len(logs)} | {took:.0f} | {resident():.0f} |", flush=True)


if __name__ == "__main__":
    main()
