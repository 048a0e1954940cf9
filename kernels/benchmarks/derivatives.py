"""Cost of the derivatives of inverse and forward dynamics: ours and what else there is, measured in one run.

    python kernels/benchmarks/derivatives.py                # prints the table
    python kernels/benchmarks/derivatives.py --baseline     # and replaces the committed baseline
    python kernels/benchmarks/derivatives.py --fusion       # with XLA's fusion of several results, by a flag
    python kernels/benchmarks/derivatives.py --gpu --batch 16777215 --mjx

As `rnea.py`: a process for each number of cores, bound to them before anything starts, warm-up first, contenders
in turn, results waited for. On processors ratios are of process time. pinocchio from C++ is built with g++ where
it and its headers are found (`--include` adds a folder, for Eigen; `pip install --no-deps --target EIGEN
cmeel-eigen` has them). Agreement is the largest difference from pinocchio, over the largest entry.

On a GPU each figure stands beside the floor: what its arguments and results take at the rate at which this GPU
copies, measured in the same run. `--groups` are the numbers of programs that the entries are divided over.
"""

import argparse
import functools
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import rnea
from rnea import PINOCCHIO_FLAGS, Contender, copied, machine, show, timed, undisturbed

HERE = Path(__file__).parent
BASELINE = HERE / "derivatives.json"
FUSION = "--xla_backend_extra_options=xla_cpu_use_multi_output_fusion"


def build_pinocchio(folder: Path, extra: list[str]) -> str | None:
    """The C++ loop; the reason where it could not be had."""
    cmeel = next((Path(p) / "cmeel.prefix" for p in sys.path if (Path(p) / "cmeel.prefix").is_dir()), None)
    if cmeel is None:
        return "no pinocchio headers here"
    includes = [*extra, str(cmeel / "include"), str(cmeel / "include/eigen3"), "/usr/include/eigen3"]
    library = cmeel / "lib/libpinocchio_default.so"
    return rnea.build(
        "pinocchio_derivatives_loop.cc", folder / "pinocchio", includes, PINOCCHIO_FLAGS, library
    )


def states(batch: int, dtype):
    import jax.numpy as jnp
    import numpy as np

    rng = np.random.default_rng(0)
    return [jnp.asarray(rng.uniform(-s, s, (batch, 7)), dtype) for s in (np.pi, 2, 5)]


def contender(f: Callable, arguments: tuple, evaluations: int, in_flight: int) -> tuple[Contender, float]:
    """A contender and the seconds of its first call."""
    import jax

    start = time.perf_counter()
    jax.block_until_ready(f(*arguments))
    first = time.perf_counter() - start

    def calls() -> None:
        for _ in range(in_flight - 1):
            f(*arguments)
        jax.block_until_ready(f(*arguments))

    return timed(calls, in_flight * evaluations), first


def on_processor(batch: int, note: Callable[[str, float], None], peers: bool) -> dict[str, Contender]:
    import jax
    import jax.numpy as jnp
    from jaxpanda_kernels import columns, derivatives

    from jaxpanda.arms.arm import Arm

    jax.config.update("jax_enable_x64", True)
    arm, found = Arm.panda(), {}
    geometry = columns.specialise(arm.chain)
    zero = jnp.zeros(7)

    def add(name: str, f: Callable, *arguments, evaluations: int = batch) -> None:
        found[name], first = contender(f, arguments, evaluations, 1)
        note(name, first)

    plain = jax.jit(jax.vmap(functools.partial(derivatives.plain_inverse, arm.chain), (None, 0, 0, 0)))
    for dtype in (jnp.float64, jnp.float32):
        kind, phi = dtype.__name__, arm.standard.astype(dtype)
        q, qd, last = states(batch, dtype)
        lists = [[jnp.array(x[:, i]) for i in range(7)] for x in (q, qd, last)]
        add(f"inverse, columns, {kind}", functools.partial(derivatives.entries, geometry, phi), *lists)
        if peers or dtype == jnp.float64:
            forward = functools.partial(derivatives.forward_entries, geometry, phi)
            add(f"forward, columns, {kind}", lambda *x, f=forward: f(*x, zero), *lists)
        if peers:
            few = min(batch, 2048)
            shape = functools.partial(derivatives.inverse, geometry, phi)
            add(f"inverse, any shape, {kind}", shape, q, qd, last)
            small = q[:few], qd[:few], last[:few]
            add(f"inverse, jacfwd of the plain definition, {kind}", plain, phi, *small, evaluations=few)
    return found


def pinocchio_model(arm):
    """The arm in pinocchio, and the numbers that the C++ loop reads."""
    import numpy as np
    import pinocchio

    model, parent = pinocchio.Model(), 0
    numbers = [np.ravel(arm.chain.gravity)]
    for i in range(arm.dof):
        R, p, phi = (np.asarray(x) for x in (arm.chain.R[i], arm.chain.p[i], arm.standard[i]))
        parent = model.addJoint(parent, pinocchio.JointModelRZ(), pinocchio.SE3(R, p), f"joint{i}")
        model.appendBodyToJoint(
            parent, pinocchio.Inertia.FromDynamicParameters(phi), pinocchio.SE3.Identity()
        )
        numbers += [np.ravel(R), p, phi]
    return model, " ".join([str(arm.dof), *(repr(float(v)) for row in numbers for v in row)])


def pinocchio_loop(folder: Path, text: str) -> dict[str, Contender]:
    if not (folder / "pinocchio").exists():
        return {}

    def run(place: int) -> tuple[float, float]:
        command = [str(folder / "pinocchio"), "20000"]
        done = subprocess.run(command, input=text, capture_output=True, text=True, check=True)
        value = float(done.stdout.split()[place])
        return value, value

    names = ("inverse, pinocchio C++, float64", "forward, pinocchio C++, float64")
    return {name: functools.partial(run, place) for place, name in enumerate(names)}


def agreement(samples: int = 64) -> dict[str, float]:
    """Largest difference of ours from pinocchio, relative to the largest entry, float64."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    import pinocchio
    from jaxpanda_kernels import derivatives

    from jaxpanda.arms.arm import Arm

    jax.config.update("jax_enable_x64", True)
    arm = Arm.panda()
    model, _ = pinocchio_model(arm)
    data, motion = model.createData(), states(samples, jnp.float64)
    ours = {
        "inverse": derivatives.inverse(arm.chain, arm.standard, *motion),
        "forward": derivatives.forward(arm.chain, arm.standard, *motion, jnp.zeros(7)),
    }
    worst = {}
    for name, f in (
        ("inverse", pinocchio.computeRNEADerivatives),
        ("forward", pinocchio.computeABADerivatives),
    ):
        rows = [
            [x.copy() for x in f(model, data, *row)] for row in zip(*map(np.asarray, motion), strict=True)
        ]
        differences = []
        for place, mine in enumerate(ours[name]):
            theirs = np.array([row[place] for row in rows])
            if place == 2:  # pinocchio fills the upper triangle of a symmetric matrix
                theirs = np.triu(theirs) + np.swapaxes(np.triu(theirs, 1), 1, 2)
            differences.append(float(np.abs(np.asarray(mine) - theirs).max() / np.abs(theirs).max()))
        worst[name] = max(differences)
    return worst


def on_gpu(
    batch: int,
    groups: list[int],
    dtypes: list[str],
    rounds: int,
    with_mjx: bool,
    save: Callable[[dict], None],
) -> dict:
    """Rates a second on JAX's default device, beside the floor that copying sets."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    from jaxpanda_kernels import columns, derivatives, staging

    from jaxpanda.arms.arm import Arm

    jax.config.update("jax_enable_x64", True)
    arm = Arm.panda()
    geometry = columns.specialise(arm.chain)
    zero = jnp.zeros(7)
    cpu = jax.default_backend() == "cpu"
    result: dict = {"device": jax.devices()[0].device_kind, "rows": {}}

    def rate(name: str, f: Callable, *arguments, evaluations: int, words: int = 0, size: int = 4) -> None:
        row: dict = {"batch": evaluations}
        try:
            run, row["first_call_s"] = contender(f, arguments, evaluations, 1 if evaluations > 2**22 else 4)
            with undisturbed():
                wall = [run()[0] for _ in range(rounds)]
        except Exception as error:  # memory, or a compiler that gives up: said, and the rest goes on
            row["failed"] = str(error)[:300]
            print(f"{name:60} failed: {row['failed'][:100]}", flush=True)
        else:
            row |= {
                "ns": statistics.median(wall),
                "range_ns": [min(wall), max(wall)],
                "a_second": 1e9 / min(wall),
            }
            told = ""
            if words:
                row |= {
                    "bytes": words * size,
                    "floor_a_second": result["copy_bytes_a_second"] / (words * size),
                }
                row["of_floor"] = row["a_second"] / row["floor_a_second"]
                told = f"{row['of_floor']:6.1%} of the floor {row['floor_a_second']:.2e}"
            print(
                f"{name:60}{row['a_second']:11.2e}/s  {told}  first call {row['first_call_s']:.1f} s",
                flush=True,
            )
        result["rows"][name] = row
        save(result)

    if with_mjx:
        mjx_peer(rate, 64 if cpu else 65536)
    if not groups:
        return result
    result["copy_bytes_a_second"] = copied(batch, rounds)
    print(f"copies {result['copy_bytes_a_second']:.3g} bytes a second", flush=True)
    for kind in dtypes:
        dtype, phi, size = np.dtype(kind), arm.standard.astype(kind), np.dtype(kind).itemsize
        q, qd, last = states(batch, dtype)
        lists = [[jnp.array(x[:, i]) for i in range(7)] for x in (q, qd, last)]
        several = {"evaluations": batch, "size": size}
        for place, count in enumerate(groups):
            f = functools.partial(derivatives._in_groups, geometry, phi, count=count)
            rate(f"inverse, {count} programs, {kind}", f, *lists, words=21 + 119, **several)
            if place == 0:
                rate(f"inverse without M, {count} programs, {kind}", functools.partial(f, mass=False),
                     *lists, words=21 + 91, **several)  # fmt: skip
                xla = functools.partial(f, program=staging.alone)
                rate(f"inverse, {count} programs cut by XLA, {kind}", xla, *lists, words=21 + 119, **several)
        forward = functools.partial(derivatives.forward_entries, geometry, phi)
        rate(f"forward, {kind}", lambda *x, f=forward: f(*x, zero), *lists, words=21 + 28 + 91, **several)
        few = min(batch, 2**10 if cpu else 2**20)
        plain = jax.jit(jax.vmap(functools.partial(derivatives.plain_inverse, arm.chain), (None, 0, 0, 0)))
        small = q[:few], qd[:few], last[:few]
        rate(f"inverse, jacfwd of the plain definition, {kind}", plain, phi, *small, evaluations=few)
        del q, qd, last, lists
    both = (
        (derivatives.inverse, derivatives.plain_inverse, ()),
        (derivatives.forward, derivatives.plain_forward, (zero,)),
    )
    for kind in dtypes:
        worst = []
        for ours, plain, more in both:
            with jax.default_matmul_precision("highest"):
                one = jax.vmap(lambda *x, f=plain, more=more: f(arm.chain, arm.standard, *x, *more))
                defined = jax.jit(one)(*states(256, jnp.float64))
            found = ours(geometry, arm.standard, *states(256, kind), *more)
            worst += [
                float(jnp.abs(a - b).max() / jnp.abs(b).max()) for a, b in zip(found, defined, strict=True)
            ]
        result[f"error_{kind}"] = max(worst)
        print(f"largest error over largest entry, {kind}: {max(worst):.1e}")
    return result


def mjx_peer(rate: Callable, batch: int) -> None:
    import jax
    import jax.numpy as jnp
    import mujoco
    from mujoco import mjx

    from jaxpanda.arms.export import panda_mjcf

    model = mujoco.MjModel.from_xml_string(panda_mjcf())
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    device = mjx.put_model(model)
    blank = mjx.make_data(device)

    def torque(q, qd, qdd):
        return mjx.inverse(device, blank.replace(qpos=q, qvel=qd, qacc=qdd)).qfrc_inverse

    f = jax.jit(jax.vmap(jax.jacfwd(torque, (0, 1, 2))))
    dtype = blank.qpos.dtype
    name = f"inverse, jacfwd of mjx.inverse, {dtype}"
    rate(name, f, *(s * jnp.ones((batch, 7), dtype) for s in (0.3, 0.2, 0.1)), evaluations=batch)


def measure(cores: int, batch: int, rounds: int, folder: Path) -> dict:
    """All contenders on `cores` cores; run in a process of its own."""
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
    from jaxpanda.arms.arm import Arm

    compilation: dict[str, float] = {}
    contenders = on_processor(batch, compilation.__setitem__, peers=cores != 1)
    if cores == 1:
        contenders |= pinocchio_loop(folder, pinocchio_model(Arm.panda())[1])
    samples: dict[str, list] = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, run in contenders.items():
            samples[name].append(run())
    return {
        name: {
            "wall_ns": statistics.median(w for w, _ in values),
            "wall_ns_range": [min(w for w, _ in values), max(w for w, _ in values)],
            "process_ns": statistics.median(p for _, p in values),
            "process_ns_least": min(p for _, p in values),
            "first_call_s": compilation.get(name),
        }
        for name, values in samples.items()
    }


RATIOS = [
    ("inverse, pinocchio C++, float64", "inverse, columns, float64", 3),
    ("inverse, pinocchio C++, float64", "inverse, columns, float32", 5),
    ("forward, pinocchio C++, float64", "forward, columns, float64", 3),
    ("inverse, jacfwd of the plain definition, float64", "inverse, columns, float64", 10),
]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--batch", type=int, default=102_400, help="samples a call")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument(
        "--cores", type=int, nargs="+", default=[1, 2], help="a process for each number of cores"
    )
    parser.add_argument("--fusion", action="store_true", help=f"with XLA_FLAGS={FUSION}")
    parser.add_argument(
        "--gpu", action="store_true", help="measure JAX's default device in place of the processor"
    )
    parser.add_argument("--groups", type=int, nargs="*", default=[3], help="on a GPU: numbers of programs")
    parser.add_argument(
        "--dtypes", nargs="+", default=["float32", "float64"], help="on a GPU: of what to take"
    )
    parser.add_argument("--mjx", action="store_true", help="on a GPU: mjx.inverse differentiated beside it")
    parser.add_argument("--out", type=Path, help="on a GPU: file for the figures (JSON)")
    parser.add_argument(
        "--include", action="append", default=[], help="folder of further C++ headers (Eigen)"
    )
    parser.add_argument("--baseline", action="store_true", help=f"replace {BASELINE.name}")
    parser.add_argument("--child", nargs=2, metavar=("CORES", "FOLDER"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        print(json.dumps(measure(int(args.child[0]), args.batch, args.rounds, Path(args.child[1]))))
        return

    result: dict = {"machine": machine(), "batch": args.batch, "rounds": args.rounds, "fusion": args.fusion}
    print(json.dumps(result, indent=1))
    if args.gpu:

        def save(found: dict) -> None:
            result["gpu"] = found
            if args.out:
                args.out.write_text(json.dumps(result, indent=1) + "\n")

        save(on_gpu(args.batch, args.groups, args.dtypes, args.rounds, args.mjx, save))
        return
    environment = os.environ | ({"XLA_FLAGS": FUSION} if args.fusion else {})
    with tempfile.TemporaryDirectory() as name:
        reason = build_pinocchio(Path(name), args.include)
        for cores in args.cores:
            command = [sys.executable, __file__, "--child", str(cores), name]
            command += ["--batch", str(args.batch), "--rounds", str(args.rounds)]
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=environment)
            rows = json.loads(done.stdout.splitlines()[-1])
            result[f"cores {cores}"] = rows
            show(f"on {cores} core(s)", rows)
            for peer, fast, target in RATIOS:
                if peer in rows:
                    ratio = rows[peer]["process_ns"] / rows[fast]["process_ns"]
                    print(f"  {fast}: {ratio:.1f} times as fast as {peer} (target {target})")
    if reason:
        print(f"not measured: pinocchio C++: {reason}")
    result["agreement"] = agreement()
    print(f"agreement with pinocchio: {result['agreement']}")
    if args.baseline:
        BASELINE.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
