"""MJX on a CPU as XLA compiles it by default, and as jaxpanda does (`jaxpanda.xla.options`).

    python mjx_on_cpu.py [--joints N ...] [--states N] [--steps N] [--repeats N]

Seconds for inverse dynamics of many states, and for steps one after another, of chains with so many joints.
"""

import argparse
import platform
import statistics
import time

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from jaxpanda.versions import version
from jaxpanda.xla import options as compiler_options

jax.config.update("jax_enable_x64", True)

COLUMNS = ("joints", "compiled by", "compiling", "inverse dynamics", "compiling", "steps")


def chain(joints: int) -> mujoco.MjModel:
    """Links of 1 kg and 0.2 m, each turning about another axis than the one before."""
    spec = mujoco.MjSpec()
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    body = spec.worldbody
    for i in range(joints):
        body = body.add_body(pos=[0, 0, 0.2])
        body.add_joint(axis=[i % 2, 1 - i % 2, 0])
        body.mass, body.inertia, body.ipos = 1.0, [0.01, 0.01, 0.005], [0, 0, 0.1]
        body.explicitinertial = True
    return spec.compile()


def seconds(function, arguments, options, repeats: int) -> tuple[float, float]:
    """Compiling, and the median of running it."""
    start = time.perf_counter()
    compiled = jax.jit(function, compiler_options=options).lower(*arguments).compile()
    took = time.perf_counter() - start
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        jax.block_until_ready(compiled(*arguments))
        times.append(time.perf_counter() - start)
    return took, statistics.median(times[1:])


def row(joints: int, name: str, options, states: int, steps: int, repeats: int) -> tuple:
    compiled = mjx.put_model(chain(joints))
    blank = mjx.make_data(compiled)

    def inverse(q, qd, qdd):
        return mjx.inverse(compiled, blank.replace(qpos=q, qvel=qd, qacc=qdd)).qfrc_inverse

    def rollout(q, qd):
        def step(state, _):
            data = mjx.step(compiled, blank.replace(qpos=state[0], qvel=state[1]))
            return (data.qpos, data.qvel), None

        return jax.lax.scan(step, (q, qd), length=steps)[0]

    many, one = jnp.full((states, joints), 0.1), jnp.full(joints, 0.1)
    return (
        *(joints, name),
        *seconds(jax.vmap(inverse), (many, many, many), options, repeats),
        *seconds(rollout, (one, one), options, repeats),
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--joints", type=int, nargs="+", default=[3, 5, 7, 9])
    parser.add_argument("--states", type=int, default=100)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    versions = ", ".join(f"{name} {version(name)}" for name in ("jax", "mujoco", "mujoco-mjx"))
    print(
        f"{platform.machine()}, {platform.system()}, {versions}; {args.states} states, {args.steps} steps [s]"
    )
    print("".join(f"{name:>20}" for name in COLUMNS))
    for joints in args.joints:
        for name, options in (("default", None), ("jaxpanda", compiler_options())):
            cells = row(joints, name, options, args.states, args.steps, args.repeats)
            print("".join(f"{c:>20.4g}" if isinstance(c, float) else f"{c:>20}" for c in cells), flush=True)


if __name__ == "__main__":
    main()
