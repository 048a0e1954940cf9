"""Speed of retrieval and diagnosis beside what a user could take instead, measured in one run. See README.md.

    python experiments/speed/run.py                  # the table, under ten minutes on two quiet cores
    python experiments/speed/run.py --quick          # fewer repeats and starts, one step of the slow peers
    python experiments/speed/run.py --baseline       # and replaces the committed baseline
    python experiments/speed/run.py --gpu            # retrieval on one GPU and, where there are more, on 2 and 4

Every measurement is a process of its own, bound to its cores before anything starts, one after the other. Starts
count as good when they end without violation within 1 % of the certified lower bound.
"""

import argparse
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from importlib import metadata, util
from pathlib import Path

HERE = Path(__file__).parent
BASELINE = HERE / "baseline.json"
GOOD = 1.01
OPTIMUM = 3.72619e-4
"""Certified by the convex solver (experiments/retrieval), for where that is not installed."""

REACHED = 1e-12
"""Share of the right-hand side's square that may be left where real links have it."""


# Measurements; each runs alone in a process, and prints one JSON document.


def _problem():
    import numpy as np

    from jaxpanda.arms.panda import published
    from jaxpanda.feasible import Bounds
    from jaxpanda.parameters import coefficient_matrix

    rows = [row for row in published()["coefficients"] if row["reliable"]]
    A = coefficient_matrix([row["terms"] for row in rows], 7)
    return A, np.array([row["value"] for row in rows]), Bounds.panda()


def _peer_problem():
    import numpy as np
    import peers

    A, b, bounds = _problem()
    boxes = np.concatenate([bounds.mass[:, None], bounds.com, bounds.inertia], 1)
    return peers.Problem(A, b, boxes, tuple(bounds.total_mass))


def _retrieve(starts: int, seed: int = 0, reachable: bool = False, **options) -> dict:
    from jaxpanda.arms.arm import Arm
    from jaxpanda.feasible import solve

    A, b, bounds = _problem()
    most = GOOD * OPTIMUM
    if reachable:
        b = A @ Arm.panda().standard.ravel()
        most = REACHED * b @ b
    wall, cpu = time.perf_counter(), time.process_time()
    found = solve(A, b, bounds, starts=starts, seed=seed, **options)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    good = int(((found.violation == 0) & (found.objective <= most)).sum())
    return {
        "starts": starts,
        "good": good,
        "best": float(found.objective[found.best]),
        "wall": wall,
        "cpu": cpu,
        "compile": found.compile_seconds,
        "run": found.run_seconds,
    }


def _peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # GiB


def ours(options: dict) -> dict:
    """Starts of the published retrieval: a first call, then repeats, then other numbers of starts."""
    from jaxpanda import session

    session.start()
    session.spread_over_cores()
    some = {"reachable": options.get("reachable", False)}
    first = _retrieve(options["starts"], **some)
    again = [_retrieve(options["starts"], seed, **some) for seed in range(1, options["repeats"] + 1)]
    curve = [_retrieve(starts, 99) for starts in options["curve"]]
    return {"first": first, "again": again, "curve": curve, "peak": _peak()}


def constrained(options: dict) -> dict:
    """The same under constraints of a user's own: what kind, how many margins, starts within 1 % of the best."""
    import jax.numpy as jnp

    from jaxpanda import session
    from jaxpanda.feasible import com_in_cylinder, mass_in_ellipsoid, solve

    session.start()
    session.spread_over_cores()
    kinds = {
        "one link heavier than the next": [lambda links: links.mass[1] - links.mass[2]],
        "two centres of mass outside spheres, not convex": [
            lambda links: jnp.sum(links.com[1] ** 2) - 0.05**2,
            lambda links: jnp.sum(links.com[3] ** 2) - 0.1**2,
        ],
        "every link's mass in an ellipsoid": [mass_in_ellipsoid(i, [0, 0, 0], [0.3] * 3) for i in range(7)],
        "every centre of mass in a cylinder, 21 margins": [
            com_in_cylinder(i, [0, 0, -0.15], [0, 0, 0.15], 0.09) for i in range(7)
        ],
    }
    results = {}
    for name, constraints in kinds.items():
        runs = []
        for seed in range(options["repeats"] + 1):
            found = solve(*_problem(), constraints=constraints, starts=options["starts"], seed=seed)
            fine = (found.violation == 0) & (found.objective <= GOOD * found.objective[found.best])
            runs.append({"starts": options["starts"], "good": int(fine.sum()), "run": found.run_seconds})
        results[name] = runs[1:]
    return {"kinds": results}


def ours_on_gpus(options: dict) -> dict:
    """The same on so many GPUs; the first call compiles and is not counted."""
    import jax

    from jaxpanda import session

    session.start()
    devices = jax.local_devices()
    if len(devices) < options["count"] or devices[0].platform == "cpu":
        return {"failed": f"{len(devices)} x {devices[0].device_kind} here"}
    some = {"devices": devices[: options["count"]], "reachable": options.get("reachable", False)}
    first = _retrieve(options["starts"], **some)
    again = [_retrieve(options["starts"], seed, **some) for seed in range(options["repeats"])]
    return {"device": devices[0].device_kind, "first": first, "again": again, "peak": _peak()}


def million(options: dict) -> dict:
    """One fresh process from nothing to all outcomes in a file, checkpoint included."""
    from jaxpanda import session
    from jaxpanda.arms.panda import published
    from jaxpanda.retrieval import Retrieval, retrieve

    began = time.perf_counter()
    session.start()
    with tempfile.TemporaryDirectory() as folder:
        found = retrieve(
            {"coefficients": published()["coefficients"]},
            starts=options["starts"],
            checkpoint=Path(folder) / "starts.partial",
            certificate=False,
        )
        assert isinstance(found, Retrieval)
        found.save(folder)
        size = (Path(folder) / "starts.npz").stat().st_size / 2**20
    return {
        "starts": options["starts"],
        "wall": time.perf_counter() - began,
        "compile": found.compile_seconds,
        "run": found.run_seconds,
        "objective": found.objective,
        "as_good": found.as_good,
        "peak": _peak(),
        "file_MiB": size,
    }


def peer(options: dict) -> dict:
    """Starts of somebody else's optimiser."""
    import jax
    import peers

    jax.config.update("jax_enable_x64", True)
    extra = {name: options[name] for name in ("steps", "iterations") if name in options}
    outcomes, seconds = peers.timed(
        getattr(peers, options["method"]),
        _peer_problem(),
        options["starts"],
        budget=options["budget"],
        **extra,
    )
    return {"outcomes": outcomes, "seconds": seconds, "share": options.get("share", 1.0)}


def convex(options: dict) -> dict:
    """The certificate: the same problem without what is not convex, once."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaxpanda.certificate import lower_bound

    problem = _problem()
    seconds = []
    for _ in range(options["repeats"] + 1):
        began = time.process_time()
        found = lower_bound(*problem)
        seconds.append(time.process_time() - began)
    return {"lower_bound": found.lower_bound, "seconds": seconds[1:]}


def algorithm_1(options: dict) -> dict:
    """The paper's whole retrieval: 100 starts, ten raises of the first-power penalty; from nothing."""
    from jaxpanda import session

    session.start()
    from jaxpanda.feasible import exact_penalty

    found = exact_penalty(*_problem(), starts=options["starts"])
    return {"best": float(found.objective[found.best]), "feasible": int((found.violation == 0).sum())}


def make_recordings(options: dict) -> dict:
    """Two recordings of 20 s at 1 kHz, of an arm that rubs where its model does not."""
    import jax
    import numpy as np

    from jaxpanda.arms.export import panda_mjcf
    from jaxpanda.recordings import save
    from jaxpanda.simulation import JointFriction, panda_sensors, random_trajectory, simulate

    jax.config.update("jax_enable_x64", True)
    folder, model = Path(options["folder"]), panda_mjcf()
    (folder / "model.xml").write_text(model, "utf-8")
    friction = JointFriction(
        coulomb=np.array([0, 0, 0, 0.8, 0, 0, 0]), viscous=np.array([0, 0.6, 0, 0, 0, 0, 0])
    )
    for k in range(2):
        motion = random_trajectory(model, seed=k)
        recording = simulate(model, motion, duration=20.0, friction=friction, sensors=panda_sensors(), seed=k)
        save(recording, folder / f"recording_{k}.csv")
    return {}


MEASUREMENTS = {
    one.__name__: one
    for one in (ours, constrained, ours_on_gpus, million, peer, convex, algorithm_1, make_recordings)
}


# The parent: one measurement after the other, the table, the plot.


def child(name: str, cores: set[int] | None, environment: dict[str, str] | None = None, **options) -> dict:
    """Run a measurement in a fresh process on these cores; what it printed, and its wall and processor time."""
    command = [sys.executable, str(HERE / "run.py"), "--measure", name, json.dumps(options)]
    return _fresh(command, cores, environment, lambda text: json.loads(text.splitlines()[-1]))


def command(cores: set[int], environment: dict[str, str], *arguments: str) -> dict:
    """The same of a command of jaxpanda's."""
    return _fresh([sys.executable, "-m", "jaxpanda", *arguments, "--json"], cores, environment, json.loads)


def _fresh(arguments, cores, environment, read) -> dict:
    bind = (lambda: os.sched_setaffinity(0, cores)) if cores and hasattr(os, "sched_setaffinity") else None
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(
        arguments,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"} | (environment or {}),
        preexec_fn=bind,
        stdout=subprocess.PIPE,
        text=True,
    )
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        return {"failed": f"status {done.returncode}"}
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"process": {"wall": wall, "cpu": cpu}} | read(done.stdout)


def spread(values: list[float], unit: str = "") -> str:
    return f"{statistics.median(values):.4g} ({min(values):.4g} to {max(values):.4g}){unit}"


def rate(runs: list[dict], per: str = "wall") -> list[float]:
    return [run["good"] / run[per] for run in runs]


class Table:
    def __init__(self):
        self.figures: dict = {}

    def row(self, name: str, text: str, **figures) -> None:
        print(f"{name:58s} {text}", flush=True)
        self.figures[name] = figures | {"text": text}


def on_processors(quick: bool, out: Path) -> dict:
    """Everything but the GPU."""
    table, cores = Table(), sorted(os.sched_getaffinity(0))[:2]
    one, two = {cores[0]}, set(cores)
    starts, repeats = (8192, 1) if quick else (8192, 3)
    curve = [64, 256, 1024, 4096] if quick else [64, 256, 1024, 4096, 16384]
    both = child("ours", two, starts=starts, repeats=repeats, curve=curve)
    alone = child("ours", one, starts=starts, repeats=max(2, repeats - 2), curve=[])
    ours_2, ours_1 = rate(both["again"]), rate(alone["again"], "cpu")
    table.row("retrieval, good starts a second, 2 cores", spread(ours_2), rate=ours_2)
    table.row("... one core, processor time", spread(ours_1), rate=ours_1)
    share = sum(run["good"] for run in both["again"]) / sum(run["starts"] for run in both["again"])
    table.row("... starts that end good", f"{share:.1%}", share=share)
    first = both["first"]
    table.row(
        "... first call, with compilation or its cache", f"{first['wall']:.1f} s for {starts} starts", **first
    )
    table.row("... peak memory", f"{both['peak']:.2f} GiB", peak=both["peak"])
    for name, runs in child("constrained", two, starts=2048, repeats=repeats)["kinds"].items():
        rates = rate(runs, "run")
        share = sum(run["good"] for run in runs) / sum(run["starts"] for run in runs)
        table.row(
            f"... under a user's constraints: {name}", f"{spread(rates)}, {share:.1%} end good", rate=rates
        )
    exact = child("ours", two, starts=starts, repeats=repeats, curve=[], reachable=True)
    rates, first = rate(exact["again"]), exact["first"]
    share = sum(run["good"] for run in exact["again"]) / sum(run["starts"] for run in exact["again"])
    text = f"{spread(rates)}, {share:.1%} end good; first call {first['wall']:.1f} s"
    table.row("... to coefficients that links of the Panda have", text, rate=rates)
    convex_run = child("convex", one, repeats=10)
    table.row(
        "convex solver (clarabel), once, to the certified optimum",
        spread([1e3 * s for s in convex_run["seconds"]], " ms"),
        **convex_run,
    )
    per_start = 1 / statistics.median(ours_1)
    for label, method, options in (
        ("scipy SLSQP, exact gradients, one core", "slsqp", {"starts": 3 if quick else 20, "budget": 60}),
        (
            "scipy L-BFGS-B in Algorithm 1, exact gradients, one core",
            "lbfgsb",
            {"starts": 5 if quick else 30, "budget": 30},
        ),
        (
            "scipy dual annealing in Algorithm 1, one core",
            "dual",
            {"starts": 1, "budget": 0, "steps": 1, "share": 0.1, **({"iterations": 100} if quick else {})},
        ),
        (
            "emulation of the paper's annealing, one core",
            "annealing",
            {"starts": 1, "budget": 0, **({"steps": 1, "share": 0.1} if quick else {})},
        ),
    ):
        found = child("peer", one, method=method, **options)
        if "failed" in found:
            table.row(label, found["failed"])
            continue
        seconds = [s / found["share"] for s in found["seconds"]]
        phis = [phi for phi, _ in found["outcomes"]]
        good = sum(phi <= GOOD * OPTIMUM and missed == 0 for phi, missed in found["outcomes"])
        nearly = sum(phi <= GOOD * OPTIMUM and missed <= 1e-5 for phi, missed in found["outcomes"])
        each = statistics.median(seconds)
        text = f"{spread(seconds, ' s')} a start, phi {min(phis):.3e} to {max(phis):.3e}, "
        text += f"{good} of {len(phis)} good"
        if nearly > good:
            text += f", {nearly} where 1e-5 may be missed"
        if found["share"] < 1:
            text += " (one of ten steps measured, times ten)"
        table.row(label, text, seconds=seconds, outcomes=found["outcomes"])
        ratio = (sum(seconds) / nearly if nearly else each) / per_start
        said = "one such start" if nearly else "any start of theirs"
        table.row("... over a good one of ours, one core each", f"{ratio:,.0f} x: {said}", ratio=ratio)
    with tempfile.TemporaryDirectory() as scratch:
        cold = {"JAXPANDA_CACHE": str(Path(scratch) / "cache")}
        (Path(scratch) / "table.json").write_text(_published_table(), "utf-8")
        arguments = ("retrieve", "--identification", f"{scratch}/table.json", "--starts", "100")
        found = command(two, cold, *arguments, "--out", f"{scratch}/retrieved")
        _cold_row(table, "the paper's 100 starts, `jaxpanda retrieve`, cold", found, "objective")
        found = child("algorithm_1", two, {"JAXPANDA_CACHE": ""}, starts=100)
        _cold_row(table, "... by Algorithm 1 itself (BFGS), 10 raises, cold", found, "best")
        made = child("make_recordings", two, folder=scratch)
        if "failed" not in made:
            files = [f"{scratch}/{name}" for name in ("recording_0.csv", "recording_1.csv")]
            arguments = ("diagnose", "--model", f"{scratch}/model.xml", "--recording", *files)
            for name in ("cold", "compilation cached"):
                found = command(two, cold, *arguments, "--out", f"{scratch}/diagnosed")
                _diagnosis_row(table, f"diagnosis of two 20 s recordings, 7 joints, {name}", found)
    plot(both["curve"], out / "starts.png")
    table.figures["curve"] = both["curve"]
    return table.figures


def _cold_row(table: Table, name: str, found: dict, objective: str) -> None:
    text = found.get("failed") or f"{found['process']['wall']:.1f} s, phi {found[objective]:.4e}"
    table.row(name, text, **found.get("process", {}))


def _diagnosis_row(table: Table, name: str, found: dict) -> None:
    if "failed" in found:
        table.row(name, found["failed"])
        return
    effects = ", ".join(f"{one['effect']} {one['joints']}" for one in found["findings"])
    seconds = found["process"]
    text = f"{seconds['wall']:.1f} s ({seconds['cpu']:.1f} s CPU); {found['verdict']}: {effects}"
    table.row(name, text, **seconds)


def _published_table() -> str:
    from jaxpanda.arms.panda import published

    return json.dumps({"coefficients": published()["coefficients"]})


def on_gpus(quick: bool) -> dict:
    """Retrieval on the GPUs of this machine."""
    table = Table()
    starts = 131072 if quick else 1 << 20
    single = None
    for count in (1, 2, 4):
        found = child("ours_on_gpus", None, starts=starts, count=count, repeats=2 if quick else 3)
        if "failed" in found:
            print(f"{count} GPUs: {found['failed']}", flush=True)
            break
        rates = rate(found["again"], "run")
        single = single or statistics.median(rates)
        text = f"{spread(rates)}, {statistics.median(rates) / single:.2f} x one; "
        text += f"compile {found['first']['compile']:.1f} s"
        name = f"good starts a second, {starts:,} starts, {count} x {found['device']}"
        table.row(name, text, rate=rates, **found)
    if single is None:
        return table.figures
    found = child("ours_on_gpus", None, starts=starts, count=1, repeats=2 if quick else 3, reachable=True)
    if "failed" not in found:
        rates = rate(found["again"], "run")
        name = f"... to coefficients that links of the Panda have, 1 x {found['device']}"
        table.row(name, spread(rates), rate=rates, **found)
    many = starts if quick else 1_000_000
    alone = {"JAXPANDA_CACHE": "", "CUDA_VISIBLE_DEVICES": "0"}
    whole = child("million", None, alone, starts=many)
    text = whole.get("failed") or (
        f"{whole['process']['wall']:.1f} s from nothing (compile {whole['compile']:.1f} s, run "
        f"{whole['run']:.1f} s), peak memory {whole['peak']:.2f} GiB, file {whole['file_MiB']:.0f} MiB, "
        f"phi {whole['objective']:.4e}"
    )
    table.row(f"{many:,} starts in one process, cold, one GPU", text, **whole)
    return table.figures


def plot(curve: list[dict], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    starts = [run["starts"] for run in curve]
    axes[0].loglog(starts, [run["run"] for run in curve], "o-", label="run, compiled")
    axes[0].loglog(
        starts,
        [run["starts"] / (curve[-1]["starts"] / curve[-1]["run"]) for run in curve],
        ":",
        label="in proportion",
    )
    axes[0].set(xlabel="starts", ylabel="wall time [s]", title="cost of the starts")
    axes[0].legend()
    axes[1].semilogx(starts, [run["good"] / run["run"] for run in curve], "o-")
    axes[1].set(
        xlabel="starts",
        ylabel="good starts a second",
        title="within 1 % of the optimum, no violation",
        ylim=(0, None),
    )
    for axis in axes:
        axis.grid(alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--gpu", action="store_true", help="retrieval on GPUs, and nothing else")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument(
        "--out", type=Path, default=Path("speed"), help="folder for figures.json and starts.png"
    )
    parser.add_argument("--baseline", action="store_true", help="replace the committed baseline")
    parser.add_argument("--measure", nargs=2, metavar=("NAME", "OPTIONS"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        name, given = options.measure
        print(json.dumps(MEASUREMENTS[name](json.loads(given))))
        return
    if util.find_spec("jaxpanda") is None:
        sys.exit("jaxpanda is not on this Python's path")
    versions = {name: metadata.version(name) for name in ("jax", "numpy", "scipy")}
    machine = {
        "machine": platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
    } | versions
    print(", ".join(f"{key} {value}" for key, value in machine.items()), f"load {os.getloadavg()[0]:.1f}")
    began = time.perf_counter()
    figures = on_gpus(options.quick) if options.gpu else on_processors(options.quick, options.out)
    print(f"all in {time.perf_counter() - began:.0f} s")
    written = (
        json.dumps({"machine": machine, "load": os.getloadavg()[0], "figures": figures}, indent=1) + "\n"
    )
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "figures.json").write_text(written, "utf-8")
    if options.baseline:
        stored = json.loads(BASELINE.read_text("utf-8")) if BASELINE.exists() else {}
        stored["gpu" if options.gpu else "cpu"] = json.loads(written)
        BASELINE.write_text(json.dumps(stored, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
