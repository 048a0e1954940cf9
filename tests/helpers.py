"""Random arms and states, and the same arms in other people's engines."""

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jsonschema
import mujoco
import numpy as np
from jaxpanda_kernels import Chain, inertia
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from jaxpanda import Arm, Recording
from jaxpanda.effects import Motion

NOISE = 0.05
"""Of the torque that `record` makes [N m]."""


def result(path: Path) -> dict[str, Any]:
    """A result's document, held against its schema in `docs/schemas/`."""
    document = json.loads(path.read_text())
    schema = Path(__file__).parents[1] / "docs" / "schemas" / f"{path.stem}.schema.json"
    jsonschema.Draft202012Validator(json.loads(schema.read_text())).validate(document)
    return document


def run_script(folder: Path, *arguments: object) -> str:
    """What a script in a folder prints, which must succeed."""
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout


def random_chain(seed: int, dof: int) -> Chain:
    """A chain of revolute and prismatic joints in random poses under random gravity."""
    rng = np.random.default_rng(seed)
    return Chain(
        jnp.asarray(Rotation.random(dof, rng).as_matrix()),
        jnp.asarray(rng.uniform(-0.5, 0.5, (dof, 3))),
        jnp.asarray(rng.random(dof) < 0.4),
        jnp.asarray(rng.uniform(-10, 10, 3)),
    )


def random_bodies(seed: int, dof: int) -> jax.Array:
    """Inertial parameters [dof, 10] of bodies that could be built."""
    rng = np.random.default_rng(seed)
    centre = np.array([0.5, -2, -2, -2, 0, 0, 0, 0, 0, 0])
    spread = np.array([0.5, 0.5, 0.5, 0.5, 0.1, 0.1, 0.1, 0.3, 0.3, 0.3])
    return jax.vmap(inertia.from_log_cholesky)(jnp.asarray(centre + spread * rng.uniform(-1, 1, (dof, 10))))


def states(seed: int, count: int, dof: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Random positions, velocities and accelerations, each [count, dof]."""
    rng = np.random.default_rng(seed)
    scales = (np.pi, 2.0, 5.0)
    q, qd, qdd = (jnp.asarray(rng.uniform(-s, s, (count, dof))) for s in scales)
    return q, qd, qdd


def excitation(arm: Arm, t: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A sum of sines about the middle of the range, with its derivatives, each [time, dof]."""
    rng = np.random.default_rng(seed)
    w = 2 * np.pi * np.array([0.1, 0.2, 0.4])[:, None]
    a, b = rng.normal(0, 0.12, (2, 3, arm.dof))
    q = 0.5 * np.asarray(arm.lower + arm.upper) + np.sin(w * t).T @ a + np.cos(w * t).T @ b
    qd = (w * np.cos(w * t)).T @ a - (w * np.sin(w * t)).T @ b
    qdd = -(w**2 * np.sin(w * t)).T @ a - (w**2 * np.cos(w * t)).T @ b
    return q, qd, qdd


def record(
    seed: int,
    extra=None,
    *,
    seconds: float = 8.0,
    rate: float = 200.0,
    arm: Arm | None = None,
    still: Sequence[int] = (),
) -> Recording:
    """A Fourier motion of the project's Panda with noise of 0.05 N m; `extra` is added to the torque, and joints
    that are `still` never move."""
    arm, rng = arm or Arm.panda(), np.random.default_rng(seed)
    t = np.arange(int(seconds * rate)) / rate
    w = 2 * np.pi * np.array([0.1, 0.2, 0.3, 0.5])
    a, b = rng.normal(0, 0.12, (2, 4, 7)) / np.array([1, 1.5, 2, 3])[:, None]
    a[:, still], b[:, still] = 0.0, 0.0
    phase = w[:, None] * t
    q = 0.5 * np.asarray(arm.lower + arm.upper) + np.sin(phase).T @ a + np.cos(phase).T @ b
    qd = (w[:, None] * np.cos(phase)).T @ a - (w[:, None] * np.sin(phase)).T @ b
    qdd = -((w**2)[:, None] * np.sin(phase)).T @ a - ((w**2)[:, None] * np.cos(phase)).T @ b
    tau = Motion(arm, t, q, qd, qdd, np.zeros_like(q)).load + NOISE * rng.normal(size=q.shape)
    if extra is not None:
        tau = tau + extra(t, q, qd, qdd)
    read = q + 1e-5 * rng.normal(size=q.shape)
    read[:, still] = q[:, still]
    return Recording(f"motion_{seed}.csv", t, read, qd=qd, tau=tau)


def half_correlated(rng: np.random.Generator, shape: tuple[int, ...], keep: float) -> np.ndarray:
    """Noise of unit variance: half of it white, half keeps this share of itself from sample to sample."""
    slow = lfilter([np.sqrt(1 - keep**2)], [1, -keep], rng.normal(size=shape), axis=0)
    return np.sqrt(0.5) * (slow + rng.normal(size=shape))


def _numbers(values: Any) -> str:
    return " ".join(repr(float(v)) for v in np.ravel(values))


def to_mjcf(chain: Chain, phi: jax.Array, joint: str = "") -> str:
    """MJCF of a chain, every body's frame on its link's; `joint` is put into every joint's tag."""
    opening, closing = "", ""
    for i in range(chain.dof):
        x, y, z, w = Rotation.from_matrix(np.asarray(chain.R[i])).as_quat()
        mass, com, I = (np.asarray(v) for v in inertia.to_com(phi[i]))
        full = [I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2]]
        opening += (
            f'<body name="link{i + 1}" pos="{_numbers(chain.p[i])}" quat="{_numbers([w, x, y, z])}">'
            f'<inertial mass="{_numbers(mass)}" pos="{_numbers(com)}" fullinertia="{_numbers(full)}"/>'
            f'<joint name="joint{i + 1}" type="{"slide" if chain.prismatic[i] else "hinge"}" {joint}/>'
        )
        closing += "</body>"
    return (
        f'<mujoco><compiler angle="radian"/><option gravity="{_numbers(chain.gravity)}"/>'
        f"<worldbody>{opening}{closing}</worldbody></mujoco>"
    )


def to_mujoco(chain: Chain, phi: jax.Array) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(to_mjcf(chain, phi))


def to_pinocchio(chain: Chain, phi: jax.Array) -> Any:
    """The same chain as a pinocchio model; pinocchio's ten parameters of a body have our order."""
    import pinocchio

    model = pinocchio.Model()
    parent = 0
    for i in range(chain.dof):
        kind = pinocchio.JointModelPZ() if chain.prismatic[i] else pinocchio.JointModelRZ()
        pose = pinocchio.SE3(np.asarray(chain.R[i]), np.asarray(chain.p[i]))
        parent = model.addJoint(parent, kind, pose, f"joint{i + 1}")
        body = pinocchio.Inertia.FromDynamicParameters(np.asarray(phi[i]))
        model.appendBodyToJoint(parent, body, pinocchio.SE3.Identity())
    model.gravity.linear = np.asarray(chain.gravity)
    return model
