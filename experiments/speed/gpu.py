"""On a GPU, in one command: derivatives, RNEA and regressor, ensembles in MJX.

    python experiments/speed/gpu.py --out figures.json
    JAX_PLATFORMS=cpu python experiments/speed/gpu.py --tiny --out tiny.json      # a rehearsal on a processor

Parts are processes of their own, so that one that fails or runs out of memory leaves the others. They compile
a few at a time and measure in turn; figures are written after each. The last two need MuJoCo and mujoco-mjx.

- derivatives: `kernels/benchmarks/derivatives.py --gpu`, float32 and float64, beside the floor of copying;
- rnea: `kernels/benchmarks/rnea.py`, inverse dynamics and regressor, on the same card;
- both once more where the compiler may fuse a product and a sum;
- ensemble: arms whose masses, centres of mass and inertias differ from the Panda's by up to a tenth, rolled out
  for ten seconds in one program of MJX's public functions; and the gradient of their tracking error in gains and
  masses through a hundred steps, in reverse;
- mjx: the derivative of `mjx.inverse` by forward differentiation.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from importlib import metadata, util
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BENCHMARKS = ROOT / "kernels" / "benchmarks"
STIFFNESS = [600.0, 600.0, 600.0, 600.0, 250.0, 150.0, 50.0]
DAMPING = [50.0, 50.0, 50.0, 50.0, 30.0, 25.0, 15.0]
"""Gains of the ensemble's controller [N m/rad, N m s/rad], a joint each."""
AMPLITUDE, FREQUENCY = 0.3, 0.4
"""Of every joint's motion [rad, Hz]."""
FUSED = "--xla_backend_extra_options=-nvptx-fma-level=2"
"""Lets the compiler make one instruction of a product and a sum, which JAX's does not on its own."""


def ensemble(arms: int, seconds: float, limit: float, steps_of_gradient: int) -> dict:
    """Roll-outs of an ensemble in MJX, float32, and the gradient through some steps of them."""
    import jax
    import jax.numpy as jnp
    import mujoco
    from mujoco import mjx

    sys.path.insert(0, str(BENCHMARKS))
    from rnea import undisturbed

    from jaxpanda.arms.export import panda_mjcf

    model = mujoco.MjModel.from_xml_string(panda_mjcf())
    model.opt.timestep, model.opt.integrator = 2e-3, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    off = mujoco.mjtDisableBit
    model.opt.disableflags |= off.mjDSBL_CONTACT | off.mjDSBL_CONSTRAINT
    dt, base = float(model.opt.timestep), mjx.put_model(model)
    blank, middle = mjx.make_data(base), jnp.asarray(model.jnt_range.mean(1), jnp.float32)
    kind = jnp.float32

    def vary(key):
        """Factors of mass and inertia and shifts of the centre of mass, drawn within a tenth."""
        a, b, c = jax.random.split(key, 3)
        n = (arms, model.nbody)
        mass = base.body_mass * jax.random.uniform(a, n, kind, 0.9, 1.1)
        com = base.body_ipos * jax.random.uniform(b, (*n, 3), kind, 0.9, 1.1)
        # one factor a body keeps the triangle inequality of its principal moments
        inertia = base.body_inertia * jax.random.uniform(c, (*n, 1), kind, 0.9, 1.1)
        return mass, com, inertia

    def wanted(t):
        speed = 2 * jnp.pi * FREQUENCY
        velocity = AMPLITUDE * speed * jnp.cos(speed * t)
        return middle + AMPLITUDE * jnp.sin(speed * t), velocity * jnp.ones(7)

    def step(gains, arm, state, k):
        """State: position, velocity, and the bias force of the step before, which the controller adds."""
        mass, com, inertia = arm
        # The gain on velocity is the model's damping, which the integrator takes implicitly: as a torque held for
        # a step it is unstable on links this light (stable.py).
        one = base.replace(body_mass=mass, body_ipos=com, body_inertia=inertia, dof_damping=gains[1])
        (q, qd), (x, v, bias) = wanted(k * dt), state
        u = gains[0] * (q - x) + gains[1] * qd + bias
        data = mjx.step(one, blank.replace(qpos=x, qvel=v, qfrc_applied=u))
        error = jnp.mean((wanted((k + 1) * dt)[0] - data.qpos) ** 2)
        return (data.qpos, data.qvel, data.qfrc_bias), error

    def begin():
        return (*(x.astype(kind) for x in wanted(0.0)), jnp.zeros(7, kind))

    @jax.jit
    def run(gains, arm, steps):
        def one(arm):
            def body(k, state):
                now, total = state
                now, error = step(gains, arm, now, k)
                return now, total + error

            (q, *_), total = jax.lax.fori_loop(0, steps, body, (begin(), jnp.zeros((), kind)))
            return q, jnp.sqrt(total / steps)

        return jax.vmap(one)(arm)

    gains = jnp.array(STIFFNESS, kind), jnp.array(DAMPING, kind)
    arm = vary(jax.random.PRNGKey(0))
    device = jax.devices()[0]

    def memory() -> float | None:
        found = device.memory_stats() or {}
        return found["peak_bytes_in_use"] / 2**30 if "peak_bytes_in_use" in found else None

    result: dict = {"arms": arms, "device": device.device_kind, "time_step_s": dt}
    began = time.perf_counter()
    jax.block_until_ready(run(gains, arm, 1))
    result["first_call_s"] = time.perf_counter() - began
    whole, few = round(seconds / dt), 100
    with undisturbed():
        began = time.perf_counter()
        jax.block_until_ready(run(gains, arm, few))
        a_step = (time.perf_counter() - began) / few
        steps = min(whole, max(few, int(limit / a_step)))
        began = time.perf_counter()
        q, error = jax.block_until_ready(run(gains, arm, steps))
        wall = time.perf_counter() - began
    result |= {
        "simulated_s_each": steps * dt,
        "wall_s": wall,
        "arm_steps_a_second": arms * steps / wall,
        "real_time_factor": arms * steps * dt / wall,
        "peak_memory_GiB": memory(),
        "tracking_error_rad": [float(jnp.min(error)), float(jnp.median(error)), float(jnp.max(error))],
        "finite": bool(jnp.isfinite(q).all()),
    }
    print(json.dumps(result), flush=True)

    def cost(gains, arm):
        def one(arm):
            ahead = jax.checkpoint(lambda state, k: step(gains, arm, state, k))
            return jnp.mean(jax.lax.scan(ahead, begin(), jnp.arange(steps_of_gradient))[1])

        return jnp.mean(jax.vmap(one)(arm))

    gradient = jax.jit(jax.value_and_grad(cost, (0, 1)))
    for count in (arms, arms // 4, arms // 16):
        some = jax.tree.map(lambda x, n=count: x[:n], arm)
        try:
            began = time.perf_counter()
            value, (by_gain, by_arm) = jax.block_until_ready(gradient(gains, some))
            first = time.perf_counter() - began
            with undisturbed():
                began = time.perf_counter()
                jax.block_until_ready(gradient(gains, some))
                wall = time.perf_counter() - began
        except Exception as error:  # memory: fewer arms
            result.setdefault("gradient_failed", {})[count] = str(error)[:200]
            continue
        h = 0.01 * gains[0]
        difference = jax.jit(cost)((gains[0] + h, gains[1]), some) - jax.jit(cost)(
            (gains[0] - h, gains[1]), some
        )
        result["gradient"] = {
            "arms": count,
            "steps": steps_of_gradient,
            "first_call_s": first,
            "wall_s": wall,
            "peak_memory_GiB": memory(),
            "cost": float(value),
            "along_stiffness": float(jnp.sum(by_gain[0] * h)),
            "along_stiffness_by_difference": float(difference / 2),
            "finite": all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves((by_gain, by_arm))),
        }
        break
    return result


def machine() -> dict:
    versions = {}
    for name in ("jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy", "equinox"):
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = None
    try:
        card = subprocess.run(
            ["nvidia-smi", "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"],
            capture_output=True, text=True, check=True,
        ).stdout.splitlines()  # fmt: skip
    except (FileNotFoundError, subprocess.CalledProcessError):
        card = []
    return {"card": card, "cores": os.cpu_count(), "python": platform.python_version(), "versions": versions}


def run(command: list[str], limit: float, own: dict[str, str] | None = None) -> dict:
    """A part's process: what it said last and how long it took."""
    paths = os.pathsep.join([str(ROOT), str(ROOT / "kernels"), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": paths} | (own or {})
    began = time.perf_counter()
    try:
        done = subprocess.run(
            [sys.executable, *command], capture_output=True, text=True, timeout=limit, env=environment
        )
        found = {"output": done.stdout, "status": done.returncode, "error": done.stderr[-600:]}
    except subprocess.TimeoutExpired as error:
        said = error.stdout.decode() if isinstance(error.stdout, bytes) else error.stdout or ""
        found = {"output": said, "status": None, "error": f"stopped after {limit:.0f} s"}
    return found | {"seconds": time.perf_counter() - began}


def last_json(output: str) -> dict | None:
    lines = [line for line in output.splitlines() if line.startswith("{")]
    try:
        return json.loads(lines[-1]) if lines else None
    except ValueError:
        return None


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="file for the figures (JSON)")
    parser.add_argument("--seconds", type=float, default=600, help="for all parts")
    parser.add_argument("--batch", type=int, default=2**23 - 1)
    parser.add_argument("--arms", type=int, default=10_000)
    parser.add_argument(
        "--tiny", action="store_true", help="sizes that a processor bears, one part at a time"
    )
    parser.add_argument("--only", nargs="+", help="parts whose name begins so")
    parser.add_argument("--ensemble", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.ensemble:
        print(json.dumps(ensemble(**json.loads(args.ensemble))))
        return
    batch, rounds, arms, lasts = (257, "1", 4, 0.2) if args.tiny else (args.batch, "5", args.arms, 10.0)
    engine = util.find_spec("mujoco") is not None and util.find_spec("mujoco.mjx") is not None
    result: dict = {"machine": machine(), "batch": batch, "arms": arms, "parts": {}}
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        shared = {
            "JAXPANDA_TURNS": str(Path(folder) / "turns"),
            "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
        }
        options = {"arms": arms, "seconds": lasts, "limit": 60, "steps_of_gradient": 100}
        if args.tiny:
            options |= {"limit": 5, "steps_of_gradient": 10}
        parts: dict[str, tuple[list[str], dict[str, str]]] = {}
        if engine:
            parts["ensemble"] = [__file__, "--out", str(args.out), "--ensemble", json.dumps(options)], {}
        else:
            result["not measured"] = "ensemble, mjx: mujoco and mujoco-mjx are not installed"
        derivatives = [str(BENCHMARKS / "derivatives.py"), "--gpu", "--rounds", rounds]
        for name, own in (("", {}), (", fused multiply-adds", {"XLA_FLAGS": FUSED})):
            rnea = ["--batch", str(batch), "--rounds", rounds, "--child", "0", folder]
            parts["rnea" + name] = [str(BENCHMARKS / "rnea.py"), *rnea], own
            for kind in ("float32", "float64"):
                more = ["--batch", str(batch // 2 | 1), "--dtypes", kind]
                parts[f"derivatives {kind}{name}"] = [*derivatives, *more], own
            if engine and not name:
                parts["mjx"] = [*derivatives, "--groups", "--mjx"], {}

        def measured(name: str) -> dict:
            command, own = parts[name]
            file = Path(folder) / f"{name}.json"
            if "derivatives.py" in command[0]:
                command = [*command, "--out", str(file)]
            found = run(command, max(1, args.seconds - (time.perf_counter() - began)), shared | own)
            figures = json.loads(file.read_text()) if file.exists() else last_json(found["output"])
            if figures is not None:
                found["figures"] = figures
                found.pop("output")
            return found

        chosen = [name for name in parts if not args.only or name.startswith(tuple(args.only))]
        # The compiler takes most of the time, on the host: parts go together and measure in turn. Their arrays
        # must all find room: three parts hold up to 60 GiB; ten ran out of the 80 of an H100.
        with ThreadPoolExecutor(1 if args.tiny else 3) as pool:
            waiting = {pool.submit(measured, name): name for name in chosen}
            for done in as_completed(waiting):
                result["parts"][waiting[done]] = found = done.result()
                print(waiting[done], json.dumps(found)[-3000:], flush=True)
                args.out.parent.mkdir(parents=True, exist_ok=True)
                args.out.write_text(json.dumps(result, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
