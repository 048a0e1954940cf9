"""How long a diagnosis of two 20 s recordings of a 7-joint arm takes, and their identification.

    python experiments/speed/diagnosis.py                  # cold, from the compilation cache, warm
    python experiments/speed/diagnosis.py --platform cpu   # on a machine with a GPU: without it

The arm is the project's Panda in MuJoCo's C engine, with viscous friction in joint 4, Coulomb friction in joints
2 and 7 and an offset in joint 5 that its file does not know: four terms to find. Recordings are at 1 kHz.

- cold: a new process that compiles everything;
- cached: a new process that finds the compiled programs on disk; imports are counted apart;
- warm: the same recordings again in that process;
- other lengths: recordings of 18.3 s and 19.4 s in that process, and how many programs compile for them.
- identify: base parameters and friction from the first two recordings, five folds; the first compiles.

Prints one JSON document; times in seconds, process time beside wall time.
"""

import argparse
import contextlib
import io
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

LENGTHS = {"one": (20.0, 20.0), "other": (18.3, 19.4)}


def record(folder: Path) -> None:
    """Write model.xml and two pairs of recordings."""
    import numpy as np

    from jaxpanda.arms.export import panda_mjcf
    from jaxpanda.simulation import JointFriction, panda_sensors, random_trajectory, simulate

    text = panda_mjcf()
    (folder / "model.xml").write_text(text)
    friction = JointFriction(
        viscous=np.array([0, 0, 0, 0.6, 0, 0, 0]),
        coulomb=np.array([0, 0.8, 0, 0, 0, 0, 0.15]),
        offset=np.array([0, 0, 0, 0, 0.3, 0, 0]),
    )
    names = [f"{what}_{j + 1}" for what in ("q", "tau") for j in range(7)]
    for pair, lengths in LENGTHS.items():
        for k, seconds in enumerate(lengths):
            seed = 2 * list(LENGTHS).index(pair) + k
            log = simulate(text, random_trajectory(text, seed), duration=seconds, friction=friction,
                           sensors=panda_sensors(), seed=seed)  # fmt: skip
            table = np.column_stack([log.time, log.q, log.tau])
            head = ",".join(["time", *names])
            np.savetxt(folder / f"{pair}_{k}.csv", table, delimiter=",", header=head, comments="")


def timed(work):
    wall, process = time.perf_counter(), time.process_time()
    result = work()
    return result, {"wall": time.perf_counter() - wall, "process": time.process_time() - process}


def diagnoses(folder: Path, rounds: int) -> dict:
    """In this process: the first diagnosis, the same again, and one of other recordings."""

    def importing():
        from jaxpanda import session

        session.start()
        from jaxpanda.diagnosis import diagnose

        return diagnose

    diagnose, imports = timed(importing)
    import jax

    def run(pair):
        found, seconds = timed(
            lambda: diagnose(folder / "model.xml", [folder / f"{pair}_{k}.csv" for k in (0, 1)])
        )
        findings = [f"{f.effect} {[j + 1 for j in f.joints]}" for f in found.findings]
        return {**seconds, "findings": findings, "rankings": sum("terms:" in line for line in found.log)}

    out = {"imports": imports, "first": run("one"), "warm": [run("one") for _ in range(rounds)]}
    if rounds:
        compiled = []
        jax.monitoring.register_event_duration_secs_listener(
            lambda name, seconds, **_: compiled.append(name) if "backend_compile" in name else None
        )
        out["other lengths"] = run("other")
        out["other lengths"]["programs compiled"] = len(compiled)
        out["identify"] = identifications(folder, rounds + 1)
    return out | {"device": str(jax.devices()[0]), "jax": jax.__version__}


def identifications(folder: Path, rounds: int) -> list[dict]:
    """`identify` again and again."""
    from jaxpanda.arms.source import from_mjcf
    from jaxpanda.identification import identify
    from jaxpanda.recordings import load

    arm, _ = from_mjcf(folder / "model.xml")
    recordings = [load(folder / f"one_{k}.csv") for k in (0, 1)]
    return [timed(lambda: identify(recordings, arm))[1] for _ in range(rounds)]


def child(folder: Path, cache: Path, rounds: int, platform_: str | None) -> dict:
    # on a GPU another process of this script must find memory too
    environment = os.environ | {"JAXPANDA_CACHE": str(cache), "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    if platform_:
        environment["JAX_PLATFORMS"] = platform_
    command = [sys.executable, __file__, "--child", str(folder), "--rounds", str(rounds)]
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3, help="warm diagnoses")
    parser.add_argument("--platform", help="for JAX: cpu or cuda; its own choice by default")
    parser.add_argument("--recordings", type=Path, help="written here before, instead of simulated")
    parser.add_argument("--record", type=Path, help="only write the recordings here")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.record:
        args.record.mkdir(parents=True, exist_ok=True)
        record(args.record)
        return
    if args.child:
        with contextlib.redirect_stdout(io.StringIO()):
            result = diagnoses(args.child, args.rounds)
        print(json.dumps(result))
        return
    with tempfile.TemporaryDirectory() as name:
        folder = args.recordings or Path(name)
        if not args.recordings:
            record(folder)
        cache = Path(name) / "cache"
        cold = child(folder, cache, 0, args.platform)
        later = child(folder, cache, args.rounds, args.platform)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    machine = {"processor": platform.processor(), "cores": cores, "load": os.getloadavg()[0]}
    machine |= {key: later.pop(key) for key in ("device", "jax")}
    print(json.dumps({"machine": machine, "cold": cold["first"], "cached": later}, indent=1))


if __name__ == "__main__":
    main()
