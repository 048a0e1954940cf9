"""Analytic derivatives of the dynamics against differentiation, pinocchio and finite differences of MuJoCo."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pinocchio
import pytest
from helpers import random_bodies, random_chain, states, to_mujoco, to_pinocchio
from jaxpanda_kernels import Chain, columns, derivatives
from jaxpanda_kernels.staging import alone, in_registers
from numpy.testing import assert_allclose

from jaxpanda.arms.arm import Arm

SAMPLES = 5
CHAINS = {"one turns": (1, 1), "turn, slide, slide": (3, 3), "panda": None}


def close(ours, theirs, tolerance: float = 1e-10):
    """Equal to `tolerance`, relative to the largest entry or 1."""
    assert_allclose(ours, theirs, rtol=0, atol=tolerance * max(1.0, np.abs(theirs).max()))


class Case(NamedTuple):
    chain: Chain
    phi: jax.Array
    motion: tuple[jax.Array, jax.Array, jax.Array]
    armature: jax.Array
    inverse: derivatives.Inverse
    forward: derivatives.Forward


# One compilation serves every arm with as many joints.
PLAIN_INVERSE = jax.jit(jax.vmap(derivatives.plain_inverse, (None, None, 0, 0, 0)))
PLAIN_FORWARD = jax.jit(jax.vmap(derivatives.plain_forward, (None, None, 0, 0, 0, None)))


@functools.cache
def case_of(name: str) -> Case:
    if CHAINS[name] is None:
        chain, phi = Arm.panda().chain, Arm.panda().standard
    else:
        seed, dof = CHAINS[name]
        chain, phi = random_chain(seed, dof), random_bodies(seed, dof)
    motion = states(7, SAMPLES, chain.dof)
    armature = jnp.linspace(0.1, 0.3, chain.dof)
    return Case(
        chain,
        phi,
        motion,
        armature,
        derivatives.inverse(chain, phi, *motion),
        derivatives.forward(chain, phi, *motion, armature),
    )


@pytest.fixture(params=["one turns", "turn, slide, slide", pytest.param("panda", marks=pytest.mark.slow)])
def case(request) -> Case:
    return case_of(request.param)


def test_the_arms_have_joints_of_both_kinds():
    assert not random_chain(*CHAINS["one turns"]).prismatic.any()
    assert random_chain(*CHAINS["turn, slide, slide"]).prismatic.tolist() == [False, True, True]


def test_of_inverse_dynamics_they_equal_forward_differentiation(case):
    for ours, theirs in zip(case.inverse, PLAIN_INVERSE(case.chain, case.phi, *case.motion), strict=True):
        close(ours, theirs)


def test_of_forward_dynamics_they_equal_forward_differentiation(case):
    theirs = PLAIN_FORWARD(case.chain, case.phi, *case.motion, case.armature)
    for ours, defined in zip(case.forward, theirs, strict=True):
        close(ours, defined)


def symmetric(upper: np.ndarray) -> np.ndarray:
    return np.triu(upper) + np.triu(upper, 1).T


def by_pinocchio(function, case: Case, armature) -> list[np.ndarray]:
    model = to_pinocchio(case.chain, case.phi)
    model.armature = np.asarray(armature)
    data = model.createData()
    rows = [
        [x.copy() for x in function(model, data, *sample)]
        for sample in zip(*(np.asarray(x) for x in case.motion), strict=True)
    ]
    return [np.array([by_q for by_q, _, _ in rows]), np.array([by_qd for _, by_qd, _ in rows]),
            np.array([symmetric(last) for _, _, last in rows])]  # fmt: skip


def test_of_inverse_dynamics_they_equal_pinocchio(case):
    theirs = by_pinocchio(pinocchio.computeRNEADerivatives, case, np.zeros(case.chain.dof))
    for ours, other in zip(case.inverse, theirs, strict=True):
        close(ours, other)


def test_of_forward_dynamics_they_equal_pinocchio(case):
    theirs = by_pinocchio(pinocchio.computeABADerivatives, case, case.armature)
    for ours, other in zip(case.forward, theirs, strict=True):
        close(ours, other)


def test_they_equal_finite_differences_of_mujoco(case):
    model, dof = to_mujoco(case.chain, case.phi), case.chain.dof
    data = mujoco.MjData(model)

    def torque(x):
        data.qpos, data.qvel, data.qacc = x
        mujoco.mj_inverse(model, data)
        return data.qfrc_inverse.copy()

    x, step = np.array([m[0] for m in case.motion]), 1e-6
    for which, ours in enumerate(case.inverse):
        for j in range(dof):
            ahead = np.zeros_like(x)
            ahead[which, j] = step
            theirs = (torque(x + ahead) - torque(x - ahead)) / (2 * step)
            assert_allclose(ours[0, :, j], theirs, rtol=0, atol=1e-7 * max(1, np.abs(torque(x)).max()))


def test_forward_is_the_inverse_of_inverse(case):
    """Along a change of state that keeps the torque, acceleration changes as forward dynamics says."""
    M = case.inverse.qdd + jnp.diag(case.armature)
    close(jnp.einsum("tij,tjk->tik", M, case.forward.tau), jnp.broadcast_to(jnp.eye(case.chain.dof), M.shape))


def test_at_rest_straight_and_without_mass_all_is_finite_and_right():
    chain, phi = case_of("turn, slide, slide")[:2]
    zero, light = jnp.zeros((2, 3)), jnp.zeros_like(phi)
    straight = derivatives.inverse(chain, phi, zero, zero, zero)
    for ours, theirs in zip(straight, PLAIN_INVERSE(chain, phi, zero, zero, zero), strict=True):
        close(ours, theirs)
    assert not np.any(straight.qd)
    for part in derivatives.inverse(chain, light, *(m[:2] for m in case_of("turn, slide, slide").motion)):
        assert not np.any(part)
    rotors_only = derivatives.forward(chain, light, zero, zero, zero, jnp.array([0.1, 0.2, 0.5]))
    close(rotors_only.tau, np.broadcast_to(np.diag([10.0, 5.0, 2.0]), (2, 3, 3)))


@pytest.mark.parametrize("shape", [(), (0,), (2, 1, 2)])
def test_any_leading_shape_is_that_many_samples(shape):
    case = case_of("one turns")
    count = int(np.prod(shape))
    motion = [x[:count].reshape(*shape, 1) for x in case.motion]
    for ours, theirs in zip(derivatives.inverse(case.chain, case.phi, *motion), case.inverse, strict=True):
        assert ours.shape == (*shape, 1, 1)
        close(ours, theirs[:count].reshape(*shape, 1, 1), 1e-13) if count else None


def test_more_samples_than_a_chunk_holds():
    chain, phi = case_of("one turns")[:2]
    motion = states(8, 2 * derivatives.CHUNK + 3, 1)
    for ours, theirs in zip(
        derivatives.inverse(chain, phi, *motion), PLAIN_INVERSE(chain, phi, *motion), strict=True
    ):
        close(ours, theirs)


def test_float32_in_gives_float32_out_close_to_float64():
    case = case_of("turn, slide, slide")
    motion = [x.astype(jnp.float32) for x in case.motion]
    for ours, theirs in zip(derivatives.inverse(case.chain, case.phi, *motion), case.inverse, strict=True):
        assert ours.dtype == jnp.float32
        close(ours, theirs, 1e-5)


def test_parameters_can_be_differentiated_and_mapped():
    case = case_of("one turns")
    twice = jax.vmap(lambda phi: derivatives.inverse(case.chain, phi, *case.motion))(
        jnp.stack([case.phi, 2 * case.phi])
    )
    for ours, theirs in zip(twice, case.inverse, strict=True):
        close(ours, np.stack([theirs, 2 * theirs]))

    def size(scale):
        return sum(jnp.sum(x) for x in derivatives.inverse(case.chain, scale * case.phi, *case.motion))

    close(jax.grad(size)(1.0), sum(np.sum(x) for x in case.inverse))


def test_the_panda_has_91_derivatives_beside_its_mass_matrix():
    arm = columns.specialise(Arm.panda().chain)
    pairs = [pair for group in derivatives._groups(arm, 3, mass=True) for pair in group]
    assert len(pairs) == len(set(pairs)) == 91 + 28
    assert sum(what == "q" for what, _, _ in pairs) == 42  # turning the base's joint changes nothing


def test_programs_of_a_gpu_are_the_same_numbers():
    case = case_of("turn, slide, slide")
    arm = columns.specialise(case.chain)
    state = [[x[:, i] for i in range(3)] for x in case.motion]
    for count, program in ((2, alone), (1, ONE_KERNEL)):
        found = derivatives._in_groups(arm, case.phi, *state, count=count, program=program)
        for (what, i, j), column in found.items():
            close(column, getattr(case.inverse, what)[:, i, j], 1e-12)
    inverse, qdd = derivatives._accelerations(arm, case.phi, *state, case.armature)
    torque = derivatives._in_groups(arm, case.phi, *state[:2], qdd, count=1, mass=False)
    for what in ("q", "qd"):
        for (_, i, j), column in derivatives._through(inverse, torque, what).items():
            close(column, getattr(case.forward, what)[:, i, j], 1e-12)


ONE_KERNEL = functools.partial(in_registers, interpret=True)


def test_one_kernel_can_be_differentiated_and_mapped_and_takes_any_number_of_samples():
    def f(numbers, x):
        return [numbers[0] * x[0] * x[1], jnp.sin(x[1]) - numbers[1], 2.0]

    x = [jnp.linspace(0, 1, 300), jnp.linspace(2, 3, 300)]

    def size(run, a):
        u, v, constant = run(f, [a, 0.5], x)
        return jnp.sum(u**2) + jnp.sum(v) + constant

    direct, kernel = (
        jax.jit(functools.partial(size, run)) for run in (lambda f, *given: f(*given), ONE_KERNEL)
    )
    a = jnp.array([0.3, 0.7])
    for transform in (lambda g: g, jax.grad, jax.jacfwd):
        close(jax.vmap(transform(kernel))(a), jax.vmap(transform(direct))(a), 1e-14)
