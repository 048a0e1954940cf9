"""The published retrieval, by this library, by the paper's penalty, and as certified. See README.md."""

import argparse
import json
import os
import platform
import resource
import time
from pathlib import Path

import jax
import numpy as np
from jaxpanda_kernels import inertia

from jaxpanda.arms.arm import Arm
from jaxpanda.arms.panda import published
from jaxpanda.feasible.solver import STARTS
from jaxpanda.parameters import coefficient_matrix
from jaxpanda.retrieval import Retrieval, retrieve

TABLE = {"coefficients": published()["coefficients"]}
ROWS = [row for row in TABLE["coefficients"] if row["reliable"]]


def objective(standard: np.ndarray) -> float:
    """Sum of squared differences from the 41 reliable coefficients."""
    A = coefficient_matrix([row["terms"] for row in ROWS], len(standard))
    return float(np.sum((A @ standard.ravel() - [row["value"] for row in ROWS]) ** 2))


def published_objectives() -> tuple[float, float]:
    """Of the published parameters, as printed and with c6z corrected."""
    corrected = np.asarray(Arm.panda().standard)
    printed = corrected.copy()
    mass, com, I_com = inertia.to_com(Arm.panda().standard[5])
    printed[5] = inertia.from_com(mass, com.at[2].set(-0.010517), I_com)
    return objective(printed), objective(corrected)


def timed(**options) -> tuple[Retrieval, float, float]:
    wall, cpu = time.perf_counter(), time.process_time()
    found = retrieve(TABLE, **options)
    return found, time.perf_counter() - wall, time.process_time() - cpu


def peak_memory() -> int:
    """Bytes: of the accelerator where there is one, else of this process."""
    statistics = jax.local_devices()[0].memory_stats() or {}
    process = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return statistics.get("peak_bytes_in_use", process)


def row(name: str, found: Retrieval, wall: float, cpu: float) -> dict:
    outcome = found.solutions
    feasible = outcome.violation == 0
    near = feasible & (outcome.objective <= 1.01 * found.lower_bound)
    print(
        f"{name:28s} {found.starts:5d} starts  phi {found.objective:.4e}  "
        f"violation {found.max_violation:.1e}  feasible {feasible.mean():6.1%}  "
        f"within 1 % of the bound {near.mean():6.1%}  compile {found.compile_seconds:5.1f} s  "
        f"run {found.run_seconds:5.1f} s  all {wall:5.1f} s ({cpu:.1f} s CPU)\n"
        f"{'':28s} {found.starts / found.run_seconds:.0f} starts/s, "
        f"{near.sum() / found.run_seconds:.0f} of them within 1 % of the bound, without violation; "
        f"peak memory so far {peak_memory() / 2**30:.2f} GiB"
    )
    return {
        "starts": found.starts,
        "objective": found.objective,
        "max_violation": found.max_violation,
        "feasible": float(feasible.mean()),
        "within_1_percent": float(near.mean()),
        "starts_per_second": found.starts / found.run_seconds,
        "starts_per_second_within_1_percent": float(near.sum() / found.run_seconds),
        "peak_memory_bytes": peak_memory(),
        "seconds": {"compile": found.compile_seconds, "run": found.run_seconds, "wall": wall, "cpu": cpu},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=STARTS)
    parser.add_argument("--exact-starts", type=int, default=100, help="starts of the paper's penalty; its Q")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="write the figures as JSON")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(
        f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, "
        f"NumPy {np.__version__}, JAX {jax.__version__} on {jax.local_devices()[0].device_kind}"
    )

    best, *seconds = timed(starts=options.starts, seed=options.seed, certificate=True)
    figures = {"smooth": row("feasible by construction", best, *seconds)}
    exact, *seconds = timed(starts=options.exact_starts, seed=options.seed, certificate=True, penalty="exact")
    figures["exact_penalty"] = row("exact penalty (Algorithm 1)", exact, *seconds)
    printed, corrected = published_objectives()
    figures |= {"lower_bound": best.lower_bound, "published": [printed, corrected]}
    print(f"{'published set':28s} phi {printed:.4e} as printed, {corrected:.4e} with c6z corrected")
    print(f"{'certified lower bound':28s} phi {best.lower_bound:.5e}")
    print(f"least triangle margin {min(best.margins['triangle']):.1e} kg m²")
    print(f"total mass {best.standard[:, 0].sum():.3f} kg, of 16 to 20")
    print(f"active: {', '.join(best.active)}")
    print(f"spread over the {best.as_good} starts within 1 % of the best:")
    for name in [f"m{i}" for i in range(1, best.dof + 1)] + ["total_mass"]:
        low, high = best.spread[name]
        print(f"  {name:10s} {low:7.3f} ... {high:7.3f} kg")
    figures["spread"] = {name: best.spread[name] for name in best.spread if name[0] in "mt"}
    if options.out is not None:
        options.out.write_text(json.dumps(figures, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
