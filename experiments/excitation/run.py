"""What a designed motion tells about a Panda, against Gaz et al.'s motion and random ones."""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxpanda.arms.arm import Arm
from jaxpanda.arms.export import panda_mjcf
from jaxpanda.arms.mjcf import standard_from_com
from jaxpanda.arms.panda import published
from jaxpanda.excitation import excite
from jaxpanda.excitation.design import friction_columns, gram, rows
from jaxpanda.identification import identify
from jaxpanda.parameters import arm_base_parameters
from jaxpanda.simulation import (
    FourierTrajectory,
    JointFriction,
    body_inertias,
    fourier_trajectory,
    panda_sensors,
    perturbed,
    random_trajectory,
    simulate,
)

SECONDS = 20.0


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arms", type=int, default=3, help="virtual arms, each with other links and noise")
    parser.add_argument("--random", type=int, default=2, help="random Fourier motions")
    parser.add_argument("--out", type=Path, help="JSON with every number")
    options = parser.parse_args()
    motions = {"Gaz et al. 2019": gaz()}
    for criterion in ("logdet", "condition"):
        began, cpu = time.perf_counter(), time.process_time()
        found = excite(seconds=SECONDS, criterion=criterion)
        motions[f"designed, {criterion}"] = found.trajectory
        print(
            f"designed, {criterion}: {time.perf_counter() - began:.0f} s, {time.process_time() - cpu:.0f} s of "
            f"processor; {json.dumps({k: round(v, 1) for k, v in found.precision.conditions.items()})}",
            flush=True,
        )
    model = panda_mjcf()
    motions |= {f"random Fourier {k + 1}": random_trajectory(model, k) for k in range(options.random)}
    for name, motion in motions.items():
        print(f"{name}: condition numbers {conditions(motion)}", flush=True)
    results = {name: [one(seed, motion) for seed in range(options.arms)] for name, motion in motions.items()}
    table(results)
    if options.out:
        options.out.write_text(json.dumps(results, indent=1))


def gaz() -> FourierTrajectory:
    motion = published()["exciting_trajectory"]
    return fourier_trajectory(**{name: motion[name] for name in ("a", "b", "q0")})


def conditions(motion: FourierTrajectory) -> tuple[float, float]:
    """Of the regressor along a motion, all joints alike: base parameters; with friction columns."""
    arm = Arm.panda()
    base = arm_base_parameters(arm)
    q, qd, qdd = (jnp.asarray(x) for x in motion(np.arange(0, SECONDS, 0.01)))
    Y = rows(arm.chain, base.independent, q, qd, qdd)
    together = np.asarray(gram(Y, friction_columns(qd, 0.0), jnp.ones(arm.dof)))
    parts = together[: base.rank, : base.rank], together
    rigid, whole = (round(float(np.sqrt(np.linalg.cond(part))), 1) for part in parts)
    return rigid, whole


def one(seed: int, motion: FourierTrajectory) -> dict[str, Any]:
    """Record a virtual arm, identify it, and compare with what it is."""
    law = {name: np.array(values) for name, values in published()["classical_friction"].items()}
    friction = JointFriction(np.maximum(law["viscous"], 0.0), law["coulomb"], law["offset"])
    truth = perturbed(panda_mjcf(), seed)
    log = simulate(
        truth, motion, duration=SECONDS, friction=friction, sensors=panda_sensors(), seed=seed, rate=500.0
    )
    arm = Arm.panda()
    found = identify(log, arm, folds=0)
    standard = np.array([standard_from_com(*body) for body in zip(*body_inertias(truth), strict=True)])
    beta = found.projection @ standard[-arm.dof :].ravel()
    assert found.std is not None
    assert found.condition_number is not None
    return {
        "condition_number": found.condition_number,
        "std": found.std.tolist(),
        "error": (found.beta - beta).tolist(),
    }


def table(results: dict[str, list[dict[str, Any]]]) -> None:
    """Of every motion, against the first: medians over parameters."""
    against = next(iter(results.values()))
    print("| motion | condition number in `identify` | deviation, share of Gaz's | error, share of Gaz's |")
    print("|---|---|---|---|")
    for name, runs in results.items():
        condition = np.median([run["condition_number"] for run in runs])
        std = np.median(np.array([a["std"] for a in runs]) / np.array([b["std"] for b in against]))
        error = np.median(rms(runs) / rms(against))
        print(f"| {name} | {condition:.1f} | {std:.2f} | {error:.2f} |")


def rms(runs: list[dict[str, Any]]) -> np.ndarray:
    """Error of each parameter over the arms."""
    return np.sqrt(np.mean(np.square([run["error"] for run in runs]), axis=0))


if __name__ == "__main__":
    main()
