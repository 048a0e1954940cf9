"""What is said of real recordings as they are, and with their torque column spoilt: `real.py --data DATA`."""

import argparse
import dataclasses
import sys
import tempfile
from pathlib import Path

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "real_arms"))

import arms
import recordings as real

jax.config.update("jax_enable_x64", True)

from jaxpanda import Arm, Recording, load  # noqa: E402
from jaxpanda.meaning import meaning  # noqa: E402


def arm_of(text: str) -> Arm:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.xml"
        path.write_text(text)
        return Arm.from_mjcf(path)


def tell(what: str, recording: Recording, arm: Arm) -> None:
    found = meaning(recording, arm)
    print(f"{what:40s} {'read plainly' if found is None else f'{found.kind}: {found.options}'}", flush=True)


def panda(data: Path) -> None:
    arm, log = Arm.panda(), load(data / "gaz_panda")
    swapped = [0, 3, 2, 1, 4, 5, 6]
    fourth = np.where(np.arange(7) == 3, -1, 1)
    with_tau = lambda tau: dataclasses.replace(log, tau=tau)
    zero = np.zeros(7)
    gravity = np.asarray(jax.vmap(lambda q: arm.inverse_dynamics(q, zero, zero))(log.q))
    tell("Panda", log, arm)
    tell("Panda, reversed", with_tau(-log.tau), arm)
    tell("Panda, joint 4 reversed", with_tau(fourth * log.tau), arm)
    tell("Panda, N mm", with_tau(1000 * log.tau), arm)
    tell("Panda, without gravity", with_tau(log.tau - gravity), arm)
    tell("Panda, torques 2 and 4 swapped", with_tau(log.tau[:, swapped]), arm)
    channels = {"q": log.q[:, swapped], "qd": log.qd[:, swapped], "tau": log.tau[:, swapped]}
    tell("Panda, joints 2 and 4 swapped", dataclasses.replace(log, **channels), arm)


def ur10e(data: Path) -> None:
    arm, gains = arm_of(arms.ur10e()), np.array(real.UR10E_GAINS["main.m"])
    for name in ("02_10-30sec_12harm", "02_19_14harm50sec", "02_19_14harm50secLoad", "01_17-ptp_10_points"):
        log = real.ur10e(data, name)
        tell(f"UR10e {name}", log, arm)
        tell(f"UR10e {name}, currents", dataclasses.replace(log, tau=log.tau / gains), arm)


def kinova(data: Path) -> None:
    arm = arm_of(arms.kinova_gen3())
    for name in ("opti_traj_testing1", "opti_traj_testing2"):
        for torque in ("TorqueSm", "TorqueCur"):
            log = real.kinova(data, name, torque)
            tell(f"Kinova {log.name}", log, arm)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    folder = parser.parse_args().data
    for trial in (panda, ur10e, kinova):
        trial(folder)
