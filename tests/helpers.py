"""Random arms and states, and the same arms in other people's engines."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxpanda_kernels import Chain, inertia
from scipy.spatial.transform import Rotation


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
