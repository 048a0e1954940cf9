"""Menagerie's models as shipped, real logs, and another recording of the same arm: what does a diagnosis gain?

python run.py --data DATA --models MENAGERIE --out OUT [--only panda ur10e iiwa gen3] [--starts 256]
"""

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "real_arms"))
import recordings as real

import jaxpanda
from jaxpanda import session
from jaxpanda.diagnosis import Diagnosis, diagnose, predict
from jaxpanda.recordings import Recording, load
from jaxpanda.signals import prepare

Recordings = tuple[list[Recording], list[Recording]]


@dataclasses.dataclass(frozen=True)
class Case:
    """A file of the collection, and recordings of its arm: to diagnose, and another to judge by."""

    file: str
    recordings: Callable[[Path], Recordings]


def main() -> None:
    session.start()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, help="folder that holds gaz_panda, ur10e, …")
    parser.add_argument("--models", type=Path, required=True, help="a copy of MuJoCo Menagerie")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument("--starts", type=int, default=256, help="of retrieve")
    options = parser.parse_args()
    print("| arm | as shipped | corrected.xml | predict | exported | joints worse | gain of export's | s |")
    print("|---|---|---|---|---|---|---|---|")
    for name in options.only:
        case = CASES[name]
        train, test = case.recordings(options.data)
        row(name, options.models / case.file, train, test, options.out / name, options.starts)


def row(
    name: str, model: Path, train: Sequence[Recording], test: Sequence[Recording], out: Path, starts: int
) -> None:
    """One arm: the file as shipped, diagnosed, and identified; each judged on recordings that it has not seen."""
    out.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    found = diagnose(model, train)
    assert isinstance(found, Diagnosis)
    found.save(out)
    seconds = time.perf_counter() - started
    for f in found.findings:
        joints = ", ".join(str(j + 1) for j in f.joints)
        print(f"  {f.effect} at joints {joints}: {f.confidence:.2f}", file=sys.stderr)
    arm = jaxpanda.Arm.from_mjcf(model)
    links = jaxpanda.retrieve(jaxpanda.identify(list(train), arm), arm=arm, starts=starts)
    exported = out / "exported.xml"
    exported.unlink(missing_ok=True)
    jaxpanda.to_mjcf(links, exported, model)
    errors, rmse = {"predicted": predicted(out, test)}, {}
    files = {"shipped": model, "corrected": out / "corrected.xml", "exported": exported}
    for kind, file in files.items():
        judged = jaxpanda.validate(file, test, rollout=False, in_mjx=False)
        errors[kind], rmse[kind] = judged.relative_error_percent, judged.rmse
    most = np.sqrt(np.mean(np.concatenate([r.tau for r in test]) ** 2, 0))
    worse = np.flatnonzero(rmse["corrected"] > np.maximum(1.1 * rmse["shipped"], 0.005 * most))
    gain = (errors["shipped"] - errors["corrected"]) / (errors["shipped"] - errors["exported"])
    told = ", ".join(str(j + 1) for j in worse) or "-"
    shown = " | ".join(f"{errors[kind]:.2f}" for kind in ("shipped", "corrected", "predicted", "exported"))
    print(f"| {name} | {shown} | {told} | {gain:.2f} | {seconds:.0f} |", flush=True)
    detail = {kind: values.tolist() for kind, values in rmse.items()}
    (out / "errors.json").write_text(json.dumps({"relative_error_percent": errors, "rmse": detail}, indent=1))


def predicted(diagnosis: Path, test: Sequence[Recording]) -> float:
    """Relative error of `predict` on these recordings, low-passed as `validate` does it [%]."""
    wrong, torque = 0.0, 0.0
    for recording in test:
        left = dataclasses.replace(recording, tau=recording.tau - predict(diagnosis, recording))
        wrong, torque = wrong + energy(left), torque + energy(recording)
    return 100 * float(np.sqrt(wrong / torque))


def energy(recording: Recording) -> float:
    signals = prepare(recording)
    return float(np.sum(signals.lowpass(signals.tau) ** 2))


def panda(data: Path) -> Recordings:
    """The motion goes twice: two thirds of each repeat, and the last third of each."""
    for name in real.SOURCES["gaz_panda"]["files"]:
        real.content(data, "gaz_panda", name)
    whole = load(data / "gaz_panda")
    period = (whole.time[-1] - whole.time[0]) / 2
    train, test = [], []
    for k in (0, 1):
        begin = whole.time[0] + k * period
        train.append(between(whole, begin, begin + 0.65 * period))
        test.append(between(whole, begin + 0.65 * period, begin + period))
    return train, test


def ur10e(data: Path) -> Recordings:
    """Motor currents times the gains of `main.m`; two motions, and two others of which one is a week later."""
    of = lambda name: real.ur10e(data, name)
    return (
        [of("02_10-30sec_12harm"), of("02_12-40sec_12harm")],
        [of("02_12-50sec_12harm"), of("02_19_14harm50sec")],
    )


def iiwa(data: Path) -> Recordings:
    """One joint moves at a time, upright: sweeps of joints 1 and 6, and others of the same joints."""
    of = lambda joint, *speeds: [
        run for speed in speeds for run in real.iiwa(data, f"friction_joint{joint}_vel_{speed}")
    ]
    return [*of(1, "p15", "p6"), *of(6, "p1", "p6")], [*of(1, "p3"), *of(6, "p3", "1")]


def gen3(data: Path) -> Recordings:
    """The torque sensors of two short motions."""
    first, second = (real.kinova(data, f"opti_traj_testing{k}", "TorqueSm") for k in (1, 2))
    return [first], [second]


def between(recording: Recording, begin: float, end: float) -> Recording:
    """The part of a recording between two times [s]."""
    kept = (recording.time >= begin) & (recording.time <= end)
    rows = {
        name: getattr(recording, name)[kept]
        for name in ("q", "qd", "tau")
        if getattr(recording, name) is not None
    }
    time_ = recording.time[kept] - recording.time[kept][0]
    return Recording(f"{recording.name} {begin:.1f} to {end:.1f} s", time_, **rows)


CASES = {
    "panda": Case("franka_emika_panda/panda_nohand.xml", panda),
    "ur10e": Case("universal_robots_ur10e/ur10e.xml", ur10e),
    "iiwa": Case("kuka_iiwa_14/iiwa14.xml", iiwa),
    "gen3": Case("kinova_gen3/gen3.xml", gen3),
}


if __name__ == "__main__":
    main()
