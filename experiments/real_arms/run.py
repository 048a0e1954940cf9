"""Diagnosis on real arms: the tool gets a model without the effect, and says what is missing.

python run.py --data DATA --out OUT [--only panda ur10e iiwa kinova] [--nested]
"""

import argparse
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import arms
import models
import numpy as np
import recordings as real
from oracle import cross_validated, held_out_rmse, nested

from jaxpanda import session
from jaxpanda.diagnosis import Diagnosis, diagnose
from jaxpanda.effects import AbstractEffect
from jaxpanda.effects.friction import CoulombFriction, ViscousFriction
from jaxpanda.effects.load import GravityDirection, Payload
from jaxpanda.effects.memory import PreslidingHysteresis
from jaxpanda.effects.sensing import TimeDelay, TorqueOffset
from jaxpanda.inference.knowledge import Knowledge
from jaxpanda.recordings import Recording, load

Oracle = Callable[..., Sequence[AbstractEffect]]


def main() -> None:
    session.start()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--data", type=Path, required=True, help="folder that holds gaz_panda, ur10e, iiwa, kinova_gen3"
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="*", default=list(TRIALS), choices=list(TRIALS))
    parser.add_argument(
        "--nested", action="store_true", help="Panda: choose the structure anew in every fold"
    )
    options = parser.parse_args()
    for name in options.only:
        TRIALS[name](options.data, options.out, options.nested)


def trial(
    title: str,
    model: Path | None,
    recordings: Sequence[Recording],
    oracle: Oracle,
    out: Path,
    reference: Sequence[Recording] = (),
    knowledge: Knowledge = "identified",
) -> Diagnosis:
    """Diagnose, print, and keep what was found."""
    started = time.perf_counter(), time.process_time()
    found = diagnose(model, recordings, reference=reference, knowledge=knowledge)
    wall, cpu = time.perf_counter() - started[0], time.process_time() - started[1]
    print(f"\n## {title}\nverdict: {found.verdict} ({wall:.0f} s, of which {cpu:.0f} s of processor)")
    for note in found.notes:
        print(f"note: {note}")
    for f in found.findings:
        joints = ", ".join(str(j + 1) for j in f.joints)
        print(f"- {f.effect} at joints {joints}: confidence {f.confidence:.2f}, {f.evidence:.0f} nats")
        rivals = ", ".join(f"{name} {p:.2f}" for name, p in f.alternatives)
        print("  rms " + _row(f.rms_torque) + (f"; could be {rivals}" if rivals else ""))
        told = [p for p in f.parameters if not p["name"].startswith(("value_at", "knot", "inertia", "first"))]
        print("  " + "; ".join(f"{p['name']}[{p['joint']}] = {p['value']:.4g} {p['unit']}" for p in told))
    print(f"held out, before: {_row(found.fit.held_out_rmse_before)}")
    print(f"held out, after:  {_row(found.fit.held_out_rmse_after)}")
    arm = found.corrected.arm
    print(f"held out, oracle: {_row(held_out_rmse(found, oracle(arm)))}")
    print(f"noise floor:      {_row(found.fit.noise_floor)}")
    folder = out / title.split(":")[0].replace(" ", "_")
    folder.mkdir(parents=True, exist_ok=True)
    found.save(folder)
    (folder / "log.json").write_text(json.dumps(list(found.log), indent=1))
    return found


def _row(values: np.ndarray) -> str:
    return " ".join(f"{v:.3f}" for v in values)


def panda(data: Path, out: Path, choose_again: bool) -> None:
    """Published link parameters without friction, on a level base."""
    for name in real.SOURCES["gaz_panda"]["files"]:
        real.content(data, "gaz_panda", name)
    recording = load(data / "gaz_panda")

    def oracle(arm):
        laws = [
            (PreslidingHysteresis(j, 2e-3, "dahl only"), ViscousFriction(j), TorqueOffset(j))
            for j in range(7)
        ]
        return [*(e for law in laws for e in law), *GravityDirection.grid(arm)]

    found = trial("panda: friction and base tilt concealed", None, [recording], oracle, out)
    terms = found.state.terms
    for cutoff in (1.0, 5.0, 10.0):
        inside, held = cross_validated(found, terms, cutoff)
        print(f"relative error at {cutoff:g} Hz: in sample {inside:.2f} %, phase-blocked {held:.2f} %")
    print(
        f"the oracle's at 5 Hz: phase-blocked {cross_validated(found, oracle(found.corrected.arm), 5.0)[1]:.2f} %"
    )
    if choose_again:
        print(f"structure chosen anew in every fold, 5 Hz: {nested(found, 5.0):.2f} %")


def ur10e(data: Path, out: Path, _: bool) -> None:
    """A load of 2.805 kg, by the same motion without it; and another day's unloaded motion."""
    for gains in real.UR10E_GAINS:
        folder = out / f"ur10e_{Path(gains).stem}"
        folder.mkdir(parents=True, exist_ok=True)
        of = lambda name, gains=gains: real.ur10e(data, name, gains)
        healthy = [of("02_10-30sec_12harm"), of("02_12-40sec_12harm")]
        model = models.identified(arms.ur10e(), healthy, folder, rotors=True)
        oracle = lambda arm: Payload.grid(arm)
        reference = [of("02_19_14harm50sec")]
        title = f"ur10e {Path(gains).stem}: load of 2.805 kg concealed, the same motion unloaded as reference"
        found = trial(title, model, [of("02_19_14harm50secLoad")], oracle, out, reference)
        for f in found.findings:
            mass = next((p["value"] for p in f.parameters if p["name"] == "mass"), None)
            if mass is not None:
                print(f"{f.effect}: mass {mass:.2f} kg, {100 * (mass / 2.805 - 1):+.0f} % of 2.805 kg")
        if gains == "main.m":
            title = "ur10e null: nothing concealed, another day's unloaded motion as reference"
            trial(title, model, reference, lambda arm: [], out, [of("02_12-50sec_12harm")])


def iiwa(data: Path, out: Path, _: bool) -> None:
    """A log whose torque lags its motion; joint friction."""
    out.mkdir(parents=True, exist_ok=True)
    model = out / "iiwa14.xml"
    model.write_text(arms.iiwa14())
    for joint, chirp in ((6, "J6_chirp"), (5, "J5_chirp")):
        oracle = lambda arm, j=joint - 1: [
            TimeDelay(arm.dof, 0.04),
            CoulombFriction(j, 0.01),
            ViscousFriction(j),
        ]
        trial(
            f"iiwa J{joint} chirp: delay and friction concealed",
            model,
            real.iiwa(data, chirp),
            oracle,
            out,
            knowledge="rough",
        )
    sweeps = [
        run for name in ("friction_joint1_vel_p15", "friction_joint1_vel_p6") for run in real.iiwa(data, name)
    ]
    oracle = lambda arm: [CoulombFriction(0, 0.01), ViscousFriction(0), TorqueOffset(0)]
    trial("iiwa J1 sweeps: friction concealed", model, sweeps, oracle, out, knowledge="rough")


def kinova(data: Path, out: Path, _: bool) -> None:
    """Torque from motor currents, given a model that fits the torque sensors behind the gears."""
    folder = out / "kinova_model"
    folder.mkdir(parents=True, exist_ok=True)
    names = ("opti_traj_testing1", "opti_traj_testing2")
    sensors, currents = ([real.kinova(data, n, what) for n in names] for what in ("TorqueSm", "TorqueCur"))
    model = models.identified(arms.kinova_gen3(), sensors, folder, friction=False)

    def oracle(arm):
        return [e for j in range(7) for e in (CoulombFriction(j, 0.01), ViscousFriction(j), TorqueOffset(j))]

    title = "kinova: friction between motor and sensor concealed, the sensors' torque as reference"
    found = trial(title, model, currents, oracle, out, sensors)
    for c in currents:
        assert c.tau is not None
    felt = [
        np.mean((c.tau - s.tau) * np.sign(c.qd), axis=0, where=np.abs(c.qd) > 0.02)
        for c, s in zip(currents, sensors, strict=True)
    ]
    print(f"friction by the two torques themselves: {_row(felt[0])} and {_row(felt[1])}")
    print(f"friction found (rms): {_row(np.sqrt(sum(f.rms_torque**2 for f in found.findings)))}")


TRIALS = {"panda": panda, "ur10e": ur10e, "iiwa": iiwa, "kinova": kinova}


if __name__ == "__main__":
    main()
