"""Cost of inverse dynamics and of the regressor: ours and what else a user could take, measured in one run.

    python kernels/benchmarks/rnea.py                      # prints the table
    python kernels/benchmarks/rnea.py --baseline           # and replaces the committed baseline
    python kernels/benchmarks/rnea.py --gpu --batch 16777215          # ours on a GPU, and the plain definition
    python kernels/benchmarks/rnea.py --gpu --mjx --batch 16777215    # and mjx.inverse at batch 1e6
    python kernels/benchmarks/rnea.py --gpu --batch 16777215 --peers mujoco_warp newton frax   # and theirs

One process for each number of cores, bound to them before anything starts; warm-up first; contenders take
turns, so that a busy machine is unfair to all of them; results are waited for, on a GPU those of eight calls
together. Figures are nanoseconds of wall time an evaluation, median and range over the rounds, and process
time beside it, which other people's load inflates less: ratios on processors are of that (and of the C++ loops
it alone is taken).

pinocchio from C++ and MuJoCo from C are built with g++ where it and their headers are found (`--include` adds
a folder, for Eigen); what could not be measured is said.
"""

import argparse
import contextlib
import functools
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from importlib import metadata, util
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
BASELINE = HERE / "rnea.json"
PINOCCHIO_FLAGS = [
    "-DBOOST_MPL_LIMIT_LIST_SIZE=30",
    "-DBOOST_MPL_LIMIT_VECTOR_SIZE=30",
    "-DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS",
    "-DBOOST_FUSION_INVOKE_MAX_ARITY=12",
]


def build(source: str, target: Path, includes: list[str], flags: list[str], library: Path) -> str | None:
    """Compile one C++ file against one library; the reason if that failed."""
    command = ["g++", "-std=c++17", "-O3", "-march=native", "-DNDEBUG", str(HERE / source), "-o", str(target)]
    command += [f"-I{i}" for i in includes] + flags
    command += [str(library), f"-Wl,-rpath,{library.parent}", f"-Wl,-rpath-link,{library.parent}", "-pthread"]
    try:
        done = subprocess.run(command, capture_output=True, text=True)
    except FileNotFoundError:
        return "no g++ here"
    if done.returncode == 0:
        return None
    return next((line for line in done.stderr.splitlines() if "error" in line), done.stderr[:200])


def build_peers(folder: Path, extra: list[str]) -> dict[str, str]:
    """The two C++ loops, where their headers are; the reason for each that is missing."""
    reasons = {}
    cmeel = next((Path(p) / "cmeel.prefix" for p in sys.path if (Path(p) / "cmeel.prefix").is_dir()), None)
    if cmeel is None:
        reasons["pinocchio C++"] = "no pinocchio headers here"
    else:
        includes = [*extra, str(cmeel / "include"), str(cmeel / "include/eigen3"), "/usr/include/eigen3"]
        library = cmeel / "lib/libpinocchio_default.so"
        if reason := build("pinocchio_loop.cc", folder / "pinocchio", includes, PINOCCHIO_FLAGS, library):
            reasons["pinocchio C++"] = reason
    spec = util.find_spec("mujoco")
    if spec is None or spec.origin is None:
        reasons["mujoco C"] = "no mujoco here"
    else:
        home = Path(spec.origin).parent
        library = next(home.glob("libmujoco.so*"))
        if reason := build("mujoco_loop.cc", folder / "mujoco", [str(home / "include")], [], library):
            reasons["mujoco C"] = reason
    return reasons


WORLDS = 8_192, 32_768, 131_072
"""Of engines on Warp, which are made for thousands of them: their best is to be told."""
MODELS = """
import sys, pathlib
from jaxpanda.arms.arm import Arm
from jaxpanda.arms.export import panda_mjcf
from jaxpanda.arms.urdf import to_urdf
folder = pathlib.Path(sys.argv[1])
(folder / "panda.xml").write_text(panda_mjcf())
body = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
urdf = to_urdf(Arm.panda()).replace('<link name="base_link"/>', f'<link name="base_link">{body}</link>')
(folder / "panda.urdf").write_text(urdf)
"""
"""Writes the Panda for the peers; frax reads no base without inertia."""
Contender = Callable[[], tuple[float, float]]
"""Runs once; nanoseconds an evaluation of wall time and of process time."""


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """While no other process measures that shares the file `$JAXPANDA_TURNS` with this one."""
    if path := os.environ.get("JAXPANDA_TURNS"):
        import fcntl  # not on Windows

        with open(path, "a") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield
    else:
        yield


def copied(batch: int, rounds: int) -> float:
    """Bytes a second that this device reads and writes while it adds 1 to an array: what bounds all else."""
    import jax
    import jax.numpy as jnp

    words, calls = min(2**28, max(2**16, 16 * batch)), 8
    big, f = jnp.ones(words, jnp.float32), jax.jit(lambda x: x + 1)
    jax.block_until_ready(f(big))

    run = timed(together(calls, f, big), 8 * words * calls)
    with undisturbed():
        return 1e9 / min(run()[0] for _ in range(rounds))


def together(calls: int, f: Callable, *arguments: Any) -> Callable[[], None]:
    """So many calls of a function of JAX's, waited for together."""
    import jax

    def run() -> None:
        for _ in range(calls - 1):
            f(*arguments)
        jax.block_until_ready(f(*arguments))

    return run


def timed(f: Callable[[], object], evaluations: int) -> Contender:
    def run() -> tuple[float, float]:
        wall, process = time.perf_counter_ns(), time.process_time_ns()
        f()
        return (time.perf_counter_ns() - wall) / evaluations, (time.process_time_ns() - process) / evaluations

    return run


def ours(batch: int, note: Callable[[str, float], None], all_forms: bool) -> dict[str, Contender]:
    """Compile our kernels for the Panda; `note` is told the seconds each took."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    from jaxpanda_kernels import batched, columns, dynamics

    from jaxpanda.arms.arm import Arm

    jax.config.update("jax_enable_x64", True)
    arm = Arm.panda()
    geometry = columns.specialise(arm.chain)
    bodies = columns.regrouped(geometry, [[float(v) for v in body] for body in arm.standard])
    rng = np.random.default_rng(0)
    cpu = jax.default_backend() == "cpu"
    in_flight = 1 if cpu else 8
    contenders = {}

    def add(name: str, f: Callable, *arguments, evaluations: int = batch) -> None:
        start = time.perf_counter()
        jax.block_until_ready(f(*arguments))
        note(name, time.perf_counter() - start)

        contenders[name] = timed(together(in_flight, f, *arguments), in_flight * evaluations)

    torque = jax.jit(functools.partial(columns.rnea, geometry, bodies))
    plain = jax.jit(jax.vmap(functools.partial(dynamics.rnea, arm.chain), (None, 0, 0, 0)))
    for dtype in (jnp.float64, jnp.float32):
        kind, phi = dtype.__name__, arm.standard.astype(dtype)
        q, qd, qdd = (jnp.asarray(rng.uniform(-s, s, (batch, 7)), dtype) for s in (np.pi, 2, 5))
        lists = [[jnp.array(x[:, i]) for i in range(7)] for x in (q, qd, qdd)]
        add(f"rnea, columns, {kind}", torque, *lists)
        add(f"regressor, columns, {kind}", functools.partial(batched.entries, geometry), *lists)
        if all_forms:
            add(f"rnea, any shape, {kind}", functools.partial(batched.rnea, geometry, phi), q, qd, qdd)
            few = min(batch, 2000 if cpu else 2**22)
            add(f"rnea, plain definition, {kind}", plain, phi, q[:few], qd[:few], qdd[:few], evaluations=few)
    return contenders


def pinocchio_loops(folder: Path) -> dict[str, Contender]:
    """pinocchio from Python and, where it was built, from C++."""
    import numpy as np
    import pinocchio

    from jaxpanda.arms.arm import Arm

    arm = Arm.panda()
    model = pinocchio.Model()
    parent = 0
    numbers = [[arm.dof], np.ravel(arm.chain.gravity)]
    for i in range(arm.dof):
        R, p, phi = (np.asarray(x) for x in (arm.chain.R[i], arm.chain.p[i], arm.standard[i]))
        parent = model.addJoint(parent, pinocchio.JointModelRZ(), pinocchio.SE3(R, p), f"joint{i}")
        model.appendBodyToJoint(
            parent, pinocchio.Inertia.FromDynamicParameters(phi), pinocchio.SE3.Identity()
        )
        numbers += [np.ravel(R), p, phi]
    text = " ".join(repr(float(v)) for row in numbers for v in row).replace("7.0 ", "7 ", 1)
    data = model.createData()
    states = np.random.default_rng(0).uniform(-2, 2, (5000, 3, 7))
    found = {}
    for name, f in (
        ("rnea", pinocchio.rnea),
        ("regressor", pinocchio.computeJointTorqueRegressor),
    ):

        def loop(f=f):
            for q, qd, qdd in states:
                f(model, data, q, qd, qdd)

        found[f"{name}, pinocchio from Python, float64"] = timed(loop, len(states))
    if (folder / "pinocchio").exists():
        for place, name in enumerate(("rnea", "regressor")):

            def run(place=place) -> tuple[float, float]:
                command = [str(folder / "pinocchio"), "20000"]
                done = subprocess.run(command, input=text, capture_output=True, text=True, check=True)
                value = float(done.stdout.split()[place])
                return value, value

            found[f"{name}, pinocchio C++, float64"] = run
    return found


def mujoco_threads(folder: Path, cores: int) -> dict[str, Contender]:
    if not (folder / "mujoco").exists():
        return {}

    def run() -> tuple[float, float]:
        command = [str(folder / "mujoco"), str(folder / "panda.xml"), "100000", str(cores)]
        value = float(subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()[0])
        return value / cores, value

    return {f"rnea, mj_inverse on {cores} threads, float64": run}


def mjx(folder: Path, batch: int, note: Callable[[str, float], None]) -> dict[str, Contender]:
    import jax
    import jax.numpy as jnp
    import mujoco
    from mujoco import mjx as mujoco_x

    model = mujoco.MjModel.from_xml_path(str(folder / "panda.xml"))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    device = mujoco_x.put_model(model)
    blank = mujoco_x.make_data(device)

    # as XLA compiles it for a CPU by default, MJX computes the pose of a link anew for each one behind it
    options = {"xla_cpu_use_fusion_emitters": False} if jax.default_backend() == "cpu" else None

    @functools.partial(jax.jit, compiler_options=options)
    @jax.vmap
    def torque(q, qd, qdd):
        return mujoco_x.inverse(device, blank.replace(qpos=q, qvel=qd, qacc=qdd)).qfrc_inverse

    states = [s * jnp.ones((batch, 7), jnp.float32) for s in (0.3, 0.2, 0.1)]
    start = time.perf_counter()
    jax.block_until_ready(torque(*states))
    name = f"rnea, mjx.inverse vmapped over {batch}, float32"
    note(name, time.perf_counter() - start)
    return {name: timed(lambda: jax.block_until_ready(torque(*states)), batch)}


def known_torque(folder: Path) -> tuple[Any, Any]:
    """The model, and MuJoCo's inverse dynamics of all joints at 0.3 rad, 0.2 rad/s and 0.1 rad/s²."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(folder / "panda.xml"))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    known = mujoco.MjData(model)
    known.qpos[:], known.qvel[:], known.qacc[:] = 0.3, 0.2, 0.1
    mujoco.mj_inverse(model, known)
    return model, known.qfrc_inverse


def recorded(launch: Callable[[], object], tau: Any, known: Any, worlds: int) -> tuple[float, Contender]:
    """Seconds of the first call, and calls of it by a CUDA graph, as Warp's documentation has it."""
    import numpy as np
    import warp as wp

    start = time.perf_counter()
    launch()
    wp.synchronize()
    first = time.perf_counter() - start
    np.testing.assert_allclose(
        tau.numpy().reshape(worlds, -1), np.tile(known, (worlds, 1)), rtol=1e-3, atol=1e-3
    )
    with wp.ScopedCapture() as capture:
        launch()

    def calls(keeps: object = launch) -> None:  # the arrays that the graph has recorded
        for _ in range(8):
            wp.capture_launch(capture.graph)
        wp.synchronize()

    return first, timed(calls, 8 * worlds)


def mujoco_warp(folder: Path, note: Callable[[str, float], None]) -> dict[str, Contender]:
    """MuJoCo Warp's inverse dynamics."""
    import mujoco_warp

    model, known = known_torque(folder)
    device, contenders = mujoco_warp.put_model(model), {}
    for worlds in WORLDS:
        states = mujoco_warp.make_data(model, nworld=worlds, nconmax=1, njmax=1)
        for state, value in (("qpos", 0.3), ("qvel", 0.2), ("qacc", 0.1)):
            getattr(states, state).fill_(value)
        name = f"rnea, mujoco_warp.inverse of {worlds} worlds, float32"
        launch = functools.partial(mujoco_warp.inverse, device, states)
        first, contenders[name] = recorded(launch, states.qfrc_inverse, known, worlds)
        note(name, first)
    return contenders


def newton(folder: Path, note: Callable[[str, float], None]) -> dict[str, Contender]:
    """Newton's: mass matrix, Coriolis and gravity force, and their sum; no recursion has accelerations."""
    import newton
    import warp as wp

    _, known = known_torque(folder)
    arm, contenders = newton.ModelBuilder(), {}
    arm.add_mjcf(str(folder / "panda.xml"), enable_self_collisions=False)
    for worlds in WORLDS:
        scene = newton.ModelBuilder()
        scene.replicate(arm, worlds)
        model = scene.finalize()
        state = model.state()
        state.joint_q.fill_(0.3)
        state.joint_qd.fill_(0.2)
        count, dof = model.articulation_count, model.max_dofs_per_articulation
        M = wp.zeros((count, dof, dof), dtype=float)
        gravity, coriolis, tau, qdd = (wp.zeros(model.joint_dof_count, dtype=float) for _ in range(4))
        qdd.fill_(0.1)

        def launch(model=model, state=state, M=M, g=gravity, c=coriolis, tau=tau, qdd=qdd) -> None:
            newton.eval_fk(model, state.joint_q, state.joint_qd, state)
            newton.eval_inverse_dynamics_passive(
                model, state, mass_matrix=M, gravity_force=g, coriolis_force=c
            )
            newton.eval_inverse_dynamics_force(
                model, state, mass_matrix=M, joint_qdd=qdd, coriolis_force=c, gravity_force=g, joint_f=tau
            )

        name = f"rnea, newton's of {worlds} worlds, float32"
        first, contenders[name] = recorded(launch, tau, known, worlds)
        note(name, first)
    return contenders


def frax(folder: Path, note: Callable[[str, float], None]) -> dict[str, Contender]:
    """frax's, vmapped, of a batch as large as MJX's."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    from frax.core.robot import Robot

    _, known = known_torque(folder)
    robot, batch = Robot(str(folder / "panda.urdf")), 1_000_000
    up = jnp.asarray([0, 0, 9.81, 0, 0, 0], jnp.float32)
    torque = jax.jit(jax.vmap(lambda q, qd, qdd: robot.rnea(q, qd, qdd, up, None)))
    states = [s * jnp.ones((batch, 7), jnp.float32) for s in (0.3, 0.2, 0.1)]
    start = time.perf_counter()
    found = jax.block_until_ready(torque(*states))
    name = f"rnea, frax vmapped over {batch}, float32"
    note(name, time.perf_counter() - start)
    np.testing.assert_allclose(found[0], known, rtol=5e-3, atol=1e-3)  # its products are of TF32
    return {name: timed(together(8, torque, *states), 8 * batch)}


PEERS = {"mujoco_warp": mujoco_warp, "newton": newton, "frax": frax}
"""Of a GPU, by their packages; each in a process of its own, as JAX keeps most of a card's memory."""


def measure(cores: int, batch: int, rounds: int, folder: Path) -> dict:
    """All contenders on `cores` cores (0: a GPU); run in a process of its own."""
    if cores:
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
    compilation = {}

    def note(name: str, seconds: float) -> None:
        compilation[name] = seconds
        print(f"{name}: first call {seconds:.1f} s", file=sys.stderr, flush=True)

    if (folder / "peer").exists():
        return rows_of(PEERS[(folder / "peer").read_text()](folder, note), rounds, compilation)
    contenders = ours(batch, note, all_forms=cores != 1)
    if cores == 1:
        contenders |= pinocchio_loops(folder)
    elif cores == 0 and (folder / "mjx").exists():
        contenders |= mjx(folder, 1_000_000, note)
    elif cores:
        contenders |= mujoco_threads(folder, cores)
        contenders |= mjx(folder, 32, note)
    rows = rows_of(contenders, rounds, compilation)
    if cores == 0:
        from jaxpanda_kernels import batched, columns

        from jaxpanda.arms.arm import Arm

        rate = copied(batch, rounds)
        entries = sum(map(len, batched._groups(columns.specialise(Arm.panda().chain))))
        for name, row in rows.items():
            words = {"rnea, columns": 28, "regressor, columns": 21 + entries}.get(name.rpartition(",")[0])
            if words:
                row["floor_ns"] = words * (8 if name.endswith("64") else 4) * 1e9 / rate
                row["of_floor"] = row["floor_ns"] / row["wall_ns"]
    return rows


def rows_of(contenders: dict[str, Contender], rounds: int, compilation: dict[str, float]) -> dict:
    """Contenders in turn, some rounds of it."""
    samples: dict[str, list] = {name: [] for name in contenders}
    with undisturbed():
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


def machine() -> dict:
    names = [
        "jax",
        "jaxlib",
        "pin",
        "mujoco",
        "mujoco-mjx",
        "mujoco-warp",
        "warp-lang",
        "newton",
        "frax",
        "numpy",
    ]
    versions = {}
    for name in names:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = None
    info = Path("/proc/cpuinfo")
    models = (
        [x.split(":")[1].strip() for x in info.read_text().splitlines() if "model name" in x]
        if info.exists()
        else []
    )
    return {
        "processor": models[0] if models else platform.processor(),
        "cores": len(os.sched_getaffinity(0)),
        "load": os.getloadavg()[0],
        "python": platform.python_version(),
        "versions": versions,
    }


def show(title: str, rows: dict) -> None:
    print(
        f"\n{title}\n{'':52}{'wall ns':>10}{'range':>22}{'process ns':>12}{'evals/s':>11}{'first call s':>14}"
    )
    for name, row in rows.items():
        low, high = row["wall_ns_range"]
        first = f"{row['first_call_s']:.1f}" if row["first_call_s"] else ""
        wall = row["wall_ns"]
        told = f"  {row['of_floor']:.0%} of what copying takes" if "of_floor" in row else ""
        print(
            f"{name:52}{wall:10.4g}{f'{low:.4g} - {high:.4g}':>22}"
            f"{row['process_ns']:12.4g}{1e9 / wall:11.2e}{first:>14}{told}"
        )


RATIOS = [
    (1, "rnea, pinocchio C++, float64", "rnea, columns, float64", 5),
    (1, "rnea, pinocchio C++, float64", "rnea, columns, float32", 10),
    (1, "regressor, pinocchio C++, float64", "regressor, columns, float64", 2),
    (2, "rnea, mj_inverse on 2 threads, float64", "rnea, columns, float64", 10),
    (2, "rnea, mjx.inverse vmapped over 32, float32", "rnea, columns, float32", 20),
    (0, "rnea, plain definition, float32", "rnea, columns, float32", 10),
    (0, "rnea, mjx.inverse vmapped over 1000000, float32", "rnea, columns, float32", 200),
    *((0, f"rnea, mujoco_warp.inverse of {n} worlds, float32", "rnea, columns, float32", 10) for n in WORLDS),
    *((0, f"rnea, newton's of {n} worlds, float32", "rnea, columns, float32", 10) for n in WORLDS),
    (0, "rnea, frax vmapped over 1000000, float32", "rnea, columns, float32", 10),
]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--batch", type=int, default=100_000, help="samples a call")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--gpu", action="store_true", help="measure JAX's GPU in place of the processor")
    parser.add_argument("--mjx", action="store_true", help="on a GPU: mjx.inverse beside it, at batch 1e6")
    parser.add_argument("--peers", nargs="*", default=[], choices=PEERS, help="on a GPU: these beside it")
    parser.add_argument(
        "--include", action="append", default=[], help="folder of further C++ headers (Eigen)"
    )
    parser.add_argument("--baseline", action="store_true", help=f"replace {BASELINE.name}")
    parser.add_argument("--child", nargs=2, metavar=("CORES", "FOLDER"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    absent = [peer for peer in args.peers if not (args.gpu and util.find_spec(peer))]
    if absent:
        parser.error(f"--peers needs --gpu and the packages {', '.join(absent)}")
    if args.child:
        print(json.dumps(measure(int(args.child[0]), args.batch, args.rounds, Path(args.child[1]))))
        return

    result: dict = {"machine": machine(), "batch": args.batch, "rounds": args.rounds}
    print(json.dumps(result, indent=1))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        reasons = {}
        if args.mjx or args.peers or not args.gpu:
            # in a process of its own, and on the processor: JAX keeps most of a card's memory
            on_host = {**os.environ, "JAX_PLATFORMS": "cpu"}
            subprocess.run([sys.executable, "-c", MODELS, name], env=on_host, check=True)
        if args.mjx:
            (folder / "mjx").touch()
        if not args.gpu:
            reasons = build_peers(folder, args.include)
        for cores in [0] if args.gpu else [1, result["machine"]["cores"]]:
            command = [sys.executable, __file__, "--child", str(cores), name]
            command += ["--batch", str(args.batch), "--rounds", str(args.rounds)]
            child = functools.partial(subprocess.run, command, stdout=subprocess.PIPE, text=True, check=True)
            rows = json.loads(child().stdout.splitlines()[-1])
            for peer in args.peers:
                (folder / "peer").write_text(peer)
                rows |= json.loads(child().stdout.splitlines()[-1])
            result["gpu" if cores == 0 else f"cores {cores}"] = rows
            show("on a GPU" if cores == 0 else f"on {cores} core(s)", rows)
            for of, peer, fast, target in RATIOS:
                if of == cores and peer in rows:
                    figure = "process_ns" if cores else "wall_ns"
                    ratio = rows[peer][figure] / rows[fast][figure]
                    print(f"  {fast}: {ratio:.1f} times as fast as {peer} (target {target})")
    for peer, reason in reasons.items():
        print(f"not measured: {peer}: {reason}")
    if args.baseline:
        BASELINE.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
