"""The dynamics of a serial chain, against two other engines, against themselves and at rest."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pinocchio
import pytest
from helpers import random_bodies, random_chain, states, to_mujoco, to_pinocchio
from jaxpanda_kernels import (
    Chain,
    coriolis_matrix,
    coriolis_torque,
    forward_dynamics,
    gravity_torque,
    link_poses,
    mass_matrix,
    regressor,
    rnea,
)
from numpy.testing import assert_allclose

from jaxpanda.arms.arm import Arm

ARMS = ["panda", "chain of 1", "chain of 4", "other chain of 4", "chain of 9"]
SAMPLES = 20

RNEA = jax.jit(jax.vmap(rnea, (None, None, 0, 0, 0)))


class Terms(NamedTuple):
    """Everything the kernels say about samples of a motion whose torque is `tau`."""

    tau: jax.Array
    Y: jax.Array
    M: jax.Array
    g: jax.Array
    c: jax.Array
    C: jax.Array
    qdd: jax.Array


# One compilation for each number of joints, whatever the joints and the geometry.
@jax.jit
@functools.partial(jax.vmap, in_axes=(None, None, 0, 0, 0, None))
def terms_of(chain, phi, q, qd, qdd, armature) -> Terms:
    tau = rnea(chain, phi, q, qd, qdd)
    return Terms(
        tau,
        regressor(chain, q, qd, qdd),
        mass_matrix(chain, phi, q),
        gravity_torque(chain, phi, q),
        coriolis_torque(chain, phi, q, qd),
        coriolis_matrix(chain, phi, q, qd),
        forward_dynamics(chain, phi, q, qd, tau, armature),
    )


def arm(name: str) -> tuple[Chain, jax.Array]:
    if name == "panda":
        return Arm.panda().chain, Arm.panda().standard
    seed, dof = ARMS.index(name), int(name[-1])
    return random_chain(seed, dof), random_bodies(seed, dof)


class Case(NamedTuple):
    """One arm, in the engines too, a motion of it, and what the kernels say about that."""

    chain: Chain
    phi: jax.Array
    motion: tuple[jax.Array, jax.Array, jax.Array]
    terms: Terms
    mujoco: mujoco.MjModel
    pinocchio: Any


@pytest.fixture(scope="module", params=[*ARMS[:-1], pytest.param(ARMS[-1], marks=pytest.mark.slow)])
def case(request) -> Case:
    chain, phi = arm(request.param)
    motion = states(ARMS.index(request.param), SAMPLES, chain.dof)
    terms = terms_of(chain, phi, *motion, jnp.zeros(chain.dof))
    return Case(chain, phi, motion, terms, to_mujoco(chain, phi), to_pinocchio(chain, phi))


def mj_inverse(model: mujoco.MjModel, q, qd, qdd) -> np.ndarray:
    data = mujoco.MjData(model)
    tau = []
    for data.qpos, data.qvel, data.qacc in zip(q, qd, qdd, strict=True):
        mujoco.mj_inverse(model, data)
        tau.append(data.qfrc_inverse.copy())
    return np.array(tau)


def by_pinocchio(function, case: Case, *vectors) -> np.ndarray:
    """What a function of pinocchio returns at each sample."""
    data = case.pinocchio.createData()
    samples = zip(*(np.asarray(v) for v in vectors), strict=True)
    return np.array([function(case.pinocchio, data, *sample).copy() for sample in samples])


def close(ours, theirs, tolerance: float = 1e-10):
    """Equal to `tolerance`, relative to the largest entry or 1."""
    scale = max(1.0, np.abs(theirs).max())
    assert_allclose(ours, theirs, rtol=0, atol=tolerance * scale)


def test_inverse_dynamics_equals_mujoco(case):
    close(case.terms.tau, mj_inverse(case.mujoco, *case.motion))


def test_inverse_dynamics_equals_pinocchio(case):
    close(case.terms.tau, by_pinocchio(pinocchio.rnea, case, *case.motion))


def test_regressor_equals_pinocchio(case):
    theirs = by_pinocchio(pinocchio.computeJointTorqueRegressor, case, *case.motion)
    close(case.terms.Y.reshape(theirs.shape), theirs)


def test_torque_is_regressor_times_parameters(case):
    error = jnp.einsum("tilk,lk->ti", case.terms.Y, case.phi) - case.terms.tau
    assert jnp.abs(error).max() <= 1e-12 * jnp.abs(case.terms.tau).max()


def test_a_joint_does_not_feel_the_links_before_it(case):
    for i in range(case.chain.dof):
        assert not case.terms.Y[:, i, :i].any()


def test_mass_matrix_equals_mujoco(case):
    data = mujoco.MjData(case.mujoco)
    theirs = np.zeros_like(case.terms.M)
    for data.qpos, M in zip(case.motion[0], theirs, strict=True):
        mujoco.mj_forward(case.mujoco, data)
        mujoco.mj_fullM(case.mujoco, data, M)
    close(case.terms.M, theirs)


def test_mass_matrix_is_symmetric_and_positive_definite(case):
    assert jnp.array_equal(case.terms.M, jnp.swapaxes(case.terms.M, 1, 2))
    assert (jnp.linalg.eigvalsh(case.terms.M) > 0).all()


def test_gravity_and_coriolis_torques_equal_mujoco(case):
    q, qd, _ = case.motion
    zero = jnp.zeros_like(q)
    g = mj_inverse(case.mujoco, q, zero, zero)
    close(case.terms.g, g)
    close(case.terms.c, mj_inverse(case.mujoco, q, qd, zero) - g)


def test_gravity_and_coriolis_torques_equal_pinocchio(case):
    q, qd, _ = case.motion
    close(case.terms.g, by_pinocchio(pinocchio.computeGeneralizedGravity, case, q))
    C = by_pinocchio(pinocchio.computeCoriolisMatrix, case, q, qd)
    close(case.terms.c, np.einsum("tij,tj->ti", C, qd))


def test_coriolis_matrix_gives_the_coriolis_torque(case):
    close(jnp.einsum("tij,tj->ti", case.terms.C, case.motion[1]), case.terms.c, 1e-12)


def test_rate_of_mass_matrix_less_twice_coriolis_is_skew_symmetric(case):
    q, qd, _ = case.motion
    mass = jax.vmap(mass_matrix, (None, None, 0))
    rate = jax.jit(lambda q, qd: jax.jvp(lambda q: mass(case.chain, case.phi, q), (q,), (qd,))[1])(q, qd)
    N = rate - 2 * case.terms.C
    close(N, -jnp.swapaxes(N, 1, 2), 1e-12)


def test_terms_of_the_equation_of_motion_add_up(case):
    tau = jnp.einsum("tij,tj->ti", case.terms.M, case.motion[2]) + case.terms.c + case.terms.g
    close(case.terms.tau, tau, 1e-12)


def energy(chain: Chain, phi, q, qd) -> jax.Array:
    """Kinetic plus potential energy [J], the latter from where the bodies are and nothing else."""
    R, p = link_poses(chain, q)
    potential = -jnp.einsum("lij,lj,i->", R, phi[:, 1:4], chain.gravity) - phi[:, 0] @ p @ chain.gravity
    return 0.5 * qd @ mass_matrix(chain, phi, q) @ qd + potential


def test_energy_grows_by_the_power_of_the_torque(case):
    q, qd, qdd = case.motion
    total = jax.vmap(functools.partial(energy, case.chain, case.phi))
    growth = jax.jit(lambda *x: jax.jvp(total, x[:2], x[1:])[1])(q, qd, qdd)
    close(growth, jnp.einsum("ti,ti->t", qd, case.terms.tau), 1e-12)


def test_forward_dynamics_undoes_inverse_dynamics(case):
    close(case.terms.qdd, case.motion[2], 1e-9)


def test_forward_dynamics_with_armature_equals_mujoco(case):
    armature = jnp.linspace(0.1, 1.0, case.chain.dof)
    qdd = terms_of(case.chain, case.phi, *case.motion, armature).qdd
    model = to_mujoco(case.chain, case.phi)
    model.dof_armature = armature
    data = mujoco.MjData(model)
    theirs = []
    for data.qpos, data.qvel, data.qfrc_applied in zip(*case.motion[:2], case.terms.tau, strict=True):
        mujoco.mj_forward(model, data)
        theirs.append(data.qacc.copy())
    close(qdd, np.array(theirs), 1e-9)
    assert jnp.abs(qdd - case.motion[2]).max() > 0.1


@pytest.mark.slow
def test_float32_in_gives_float32_out_close_to_float64():
    chain, phi = arm("panda")
    double = (chain, phi, *states(15, SAMPLES, chain.dof), jnp.full(chain.dof, 0.1))
    single = jax.tree.map(lambda x: x if x.dtype == bool else x.astype(jnp.float32), double)
    for kind, ours, theirs in zip(Terms._fields, terms_of(*single), terms_of(*double), strict=True):
        assert ours.dtype == jnp.float32
        close(ours, theirs, 1e-3 if kind == "qdd" else 2e-5)


@pytest.fixture(scope="module")
def mixed() -> tuple[Chain, jax.Array]:
    """Four joints of both kinds."""
    chain = random_chain(20, 4)
    kinds = jnp.array([False, True, False, False])
    return Chain(chain.R, chain.p, kinds, chain.gravity), random_bodies(20, 4)


def motions_at_rest() -> list[tuple[str, bool, float]]:
    return [("bodies", False, 1.0), ("no mass", False, 0.0), ("straight arm", True, 1.0)]


@pytest.mark.parametrize(("what", "straight", "mass"), motions_at_rest())
def test_gradients_are_finite_at_rest_in_every_input(mixed, what, straight, mass):
    chain, phi = mixed
    if straight:
        along_z = jnp.tile(jnp.array([0.0, 0, 0.3]), (4, 1))
        chain = Chain(jnp.tile(jnp.eye(3), (4, 1, 1)), along_z, chain.prismatic, chain.gravity)
    zero = jnp.zeros(4)

    def torque(R, p, gravity, phi, q, qd, qdd):
        chain_ = Chain(R, p, chain.prismatic, gravity)
        tau = rnea(chain_, phi, q, qd, qdd)
        return jnp.sum(tau**2) + jnp.sum(tau) + jnp.sum(coriolis_torque(chain_, phi, q, qd))

    point = (chain.R, chain.p, chain.gravity, mass * phi, zero, zero, zero)
    gradients = jax.jit(jax.grad(torque, argnums=tuple(range(7))))(*point)
    assert all(jnp.isfinite(g).all() for g in gradients)
    assert jnp.abs(gradients[3]).max() > 0


@pytest.mark.slow
def test_both_modes_of_differentiation_agree_with_finite_differences(mixed):
    chain, phi = mixed
    q, qd, qdd = (x[0] for x in states(21, 1, 4))
    armature = jnp.full(4, 0.1)

    def f(x):
        R, p, gravity, phi, q, qd, qdd = x
        chain_ = Chain(R, p, chain.prismatic, gravity)
        tau = rnea(chain_, phi, q, qd, qdd)
        Y = regressor(chain_, q, qd, qdd)
        return jnp.concatenate([tau, forward_dynamics(chain_, phi, q, qd, tau + 1, armature), Y.sum((1, 2))])

    x = (chain.R, chain.p, chain.gravity, phi, q, qd, qdd)
    rng = np.random.default_rng(22)
    tangent = jax.tree.map(lambda v: jnp.asarray(rng.normal(size=v.shape)), x)
    cotangent = jnp.asarray(rng.normal(size=12))
    f = jax.jit(f)
    forward = cotangent @ jax.jit(lambda x: jax.jvp(f, (x,), (tangent,))[1])(x)
    reverse = jax.jit(jax.grad(lambda x: cotangent @ f(x)))(x)
    backward = sum(jax.tree.leaves(jax.tree.map(jnp.vdot, reverse, tangent)))
    step = 1e-5
    ahead = f(jax.tree.map(lambda v, t: v + step * t, x, tangent))
    behind = f(jax.tree.map(lambda v, t: v - step * t, x, tangent))
    difference = cotangent @ (ahead - behind) / (2 * step)
    assert_allclose(backward, forward, rtol=1e-11)
    assert_allclose(forward, difference, rtol=1e-6)


def test_a_sample_of_another_arm_is_refused_with_both_shapes():
    """`scan` spoke of leading axis sizes."""
    q, qd, qdd = (x[0] for x in states(0, 1, 7))
    for dynamics in (rnea, jax.jit(rnea)):
        with pytest.raises(ValueError, match=r"q has shape \(7,\), where this chain needs \(4,\)"):
            dynamics(random_chain(0, 4), random_bodies(0, 7), q, qd, qdd)
    with pytest.raises(ValueError, match=r"q has shape \(7,\)"):
        regressor(random_chain(0, 4), q, qd, qdd)


def test_many_chains_and_many_samples_at_once():
    chains = [random_chain(seed, 3) for seed in range(3)]
    bodies = jnp.stack([random_bodies(seed, 3) for seed in range(3)])
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *chains)
    motion = [x.reshape(3, 5, 3) for x in states(23, 15, 3)]
    together = jax.jit(jax.vmap(jax.vmap(rnea, (None, None, 0, 0, 0))))(stacked, bodies, *motion)
    for i, chain in enumerate(chains):
        close(together[i], RNEA(chain, bodies[i], *(x[i] for x in motion)), 1e-13)


def test_one_trace_serves_every_arm_of_a_shape():
    traces = []

    @jax.jit
    def torque(chain, phi, q, qd, qdd):
        traces.append(1)
        return rnea(chain, phi, q, qd, qdd)

    for seed in range(3):
        torque(random_chain(seed, 3), random_bodies(seed, 3), *(x[0] for x in states(seed, 1, 3)))
    assert len(traces) == 1


@pytest.mark.slow
def test_inverse_dynamics_equals_mjx(mixed):
    # its compilation takes seconds a joint; the Panda's is in tests/test_validation.py (slow)
    from mujoco import mjx

    model = to_mujoco(*mixed)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    mx = mjx.put_model(model)
    blank = mjx.make_data(mx)

    @jax.jit
    @jax.vmap
    def torque(q, qd, qdd):
        return mjx.inverse(mx, blank.replace(qpos=q, qvel=qd, qacc=qdd)).qfrc_inverse

    motion = states(24, 5, 4)
    close(RNEA(*mixed, *motion), torque(*motion))
