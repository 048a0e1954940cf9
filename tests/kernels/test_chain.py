"""Where the links of a chain are."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers import random_bodies, random_chain, states, to_mujoco
from jaxpanda_kernels import from_modified_dh, link_poses
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from jaxpanda.arms.arm import Arm

POSES = jax.jit(link_poses)


def _numbers(values) -> str:
    return " ".join(repr(float(v)) for v in values)


def mujoco_poses(model: mujoco.MjModel, q) -> tuple[np.ndarray, np.ndarray]:
    data = mujoco.MjData(model)
    data.qpos = q
    mujoco.mj_kinematics(model, data)
    return data.xmat[1:].reshape(-1, 3, 3), data.xpos[1:]


@pytest.mark.parametrize("seed", range(3))
def test_link_poses_equal_mujoco(seed):
    chain = random_chain(seed, 4)
    q = states(seed, 1, 4)[0][0]
    R, p = mujoco_poses(to_mujoco(chain, random_bodies(seed, 4)), q)
    ours = POSES(chain, q)
    assert_allclose(ours[0], R, atol=1e-13)
    assert_allclose(ours[1], p, atol=1e-13)


def elementary_mjcf(a, alpha, d, theta, prismatic) -> str:
    """Modified Denavit-Hartenberg rows, each as nested elementary bodies of which the last has the joint."""
    opening = ""
    for row in zip(a, alpha, d, theta, prismatic, strict=True):
        a_i, alpha_i, d_i, theta_i, slides = row
        opening += (
            f'<body euler="{_numbers([alpha_i, 0, 0])}"><body pos="{_numbers([a_i, 0, 0])}">'
            f'<body pos="{_numbers([0, 0, d_i])}" euler="{_numbers([0, 0, theta_i])}">'
            f'<joint type="{"slide" if slides else "hinge"}"/>'
            f'<inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>'
        )
    closing = "</body>" * 3 * len(a)
    return f'<mujoco><compiler angle="radian"/><worldbody>{opening}{closing}</worldbody></mujoco>'


def test_modified_dh_table_places_links_as_elementary_motions_do():
    rng = np.random.default_rng(0)
    table = [rng.uniform(-1, 1, 5) for _ in range(4)]
    prismatic = np.array([False, True, False, False, True])
    chain = from_modified_dh(*map(jnp.asarray, table), jnp.asarray(prismatic), jnp.zeros(3))
    q = rng.uniform(-2, 2, 5)
    R, p = mujoco_poses(mujoco.MjModel.from_xml_string(elementary_mjcf(*table, prismatic)), q)
    ours = POSES(chain, jnp.asarray(q))
    assert_allclose(ours[0], R[2::3], atol=1e-13)
    assert_allclose(ours[1], p[2::3], atol=1e-13)


def test_a_stretched_panda_stands_where_its_table_says():
    R, p = link_poses(Arm.panda().chain, jnp.zeros(7))
    assert_allclose(p[-1], [0.088, 0, 0.333 + 0.316 + 0.384], atol=1e-15)
    assert_allclose(R[-1], Rotation.from_euler("x", 180, degrees=True).as_matrix(), atol=1e-15)


def test_velocity_of_a_link_is_the_derivative_of_its_place():
    chain, q = random_chain(3, 4), states(3, 1, 4)[0][0]
    J = jax.jit(jax.jacfwd(lambda q: link_poses(chain, q)[1]))(q)
    step = 1e-6 * jnp.eye(4)
    finite = jnp.stack([(POSES(chain, q + s)[1] - POSES(chain, q - s)[1]) / 2e-6 for s in step], -1)
    assert_allclose(J, finite, atol=1e-8)
