"""Coverage of an ensemble's bands: how often torque of motions that were not identified lies within them.

Virtual Pandas with links that differ from the model's, friction and sensors like the real ones; each is
identified from one random motion and asked about another. README.md has the question and the answer.
"""

import argparse
import json
import time

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

from jaxpanda import Arm, draw_ensemble, identify, prepare, retrieve  # noqa: E402
from jaxpanda.arms.export import panda_mjcf  # noqa: E402
from jaxpanda.simulation import (  # noqa: E402
    JointFriction,
    Sensors,
    panda_sensors,
    perturbed,
    random_trajectory,
    simulate,
)


def main() -> None:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--arms", type=int, default=10)
    options.add_argument("--first", type=int, default=0, help="seed of the first arm")
    options.add_argument("--count", type=int, default=400, help="members")
    options.add_argument("--chains", type=int, default=64)
    options.add_argument("--sweeps", type=int, default=200)
    options.add_argument("--level", type=float, default=0.9)
    given = options.parse_args()
    rows = []
    for seed in range(given.first, given.first + given.arms):
        began = time.perf_counter()
        rows.append(one(seed, given))
        print(json.dumps({**rows[-1], "seconds": round(time.perf_counter() - began, 1)}), flush=True)
    for name in ("measured", "measured_of_mean", "true"):
        values = [row[name] for row in rows]
        print(
            f"{name}: {100 * np.mean(values):.1f} % of samples,"
            f" {100 * min(values):.1f} to {100 * max(values):.1f} by arm"
        )


def one(seed: int, given: argparse.Namespace) -> dict[str, float]:
    """Of one arm, the share of samples of all joints inside the band."""
    arm, truth = Arm.panda(), perturbed(panda_mjcf(), seed)
    random = np.random.default_rng(seed)
    friction = JointFriction(
        viscous=random.uniform(0.2, 1.0, 7),
        coulomb=random.uniform(0.2, 0.8, 7),
        offset=random.normal(0, 0.1, 7),
    )
    virtual = lambda motion, seconds, sensors: simulate(
        truth,
        random_trajectory(panda_mjcf(), 100 * seed + motion),
        duration=seconds,
        rate=200.0,
        friction=friction,
        sensors=sensors,
        seed=100 * seed + motion,
        name=f"motion {motion}",
    )
    found = identify(virtual(0, 20.0, panda_sensors()), arm, folds=3)
    links = retrieve(found, arm=arm, starts=128, seed=seed, certificate=False)
    members = draw_ensemble(links, count=given.count, seed=seed, chains=given.chains, sweeps=given.sweeps)
    motion, exact = virtual(1, 10.0, panda_sensors()), virtual(1, 10.0, Sensors())
    inside = lambda recording, low, high: float(np.mean((low <= recording) & (recording <= high)))
    recorded, noiseless = (signals.lowpass(signals.tau) for signals in map(prepare, (motion, exact)))
    _, low, high = members.band(motion, level=given.level)
    _, least, most = members.band(exact, level=given.level, measured=False)
    _, torque = members.torque(motion)
    gaussian = 1.6448536 * members.noise
    middle = torque.mean(0)
    return {
        "seed": seed,
        "measured": inside(recorded, low, high),
        "measured_of_mean": inside(recorded, middle - gaussian, middle + gaussian),
        "true": inside(noiseless, least, most),
        "rhat": round(members.rhat, 3),
        "relative_error_percent": round(found.relative_error_percent or 0.0, 3),
    }


if __name__ == "__main__":
    main()
