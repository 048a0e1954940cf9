"""The fast forms against the plain definitions, and what makes them fast."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_bodies, random_chain, states
from jaxpanda_kernels import Chain, batched, columns, dynamics
from jaxpanda_kernels.trigonometry import sincos
from numpy.testing import assert_allclose

from jaxpanda.arms.arm import Arm

CHAINS = {"panda": None, "chain of 1": (1, 1), "chain of 3": (2, 3)}
TOLERANCE = {jnp.float64: 1e-12, jnp.float32: 1e-5}


@functools.cache
def arm(name: str) -> tuple[Chain, jax.Array]:
    if name == "panda":
        return Arm.panda().chain, Arm.panda().standard
    return random_chain(*CHAINS[name]), random_bodies(*CHAINS[name])


@functools.cache
def plain(name: str):
    """Torque, regressor, mass matrix and acceleration of ten samples by the plain definitions, in float64."""
    chain, phi = arm(name)
    q, qd, qdd = states(0, 10, chain.dof)
    armature = jnp.linspace(0.1, 0.3, chain.dof)

    @jax.jit
    @jax.vmap
    def everything(q, qd, qdd):
        tau = dynamics.rnea(chain, phi, q, qd, qdd)
        Y = dynamics.regressor(chain, q, qd, qdd)
        M = dynamics.mass_matrix(chain, phi, q)
        return tau, Y, M, dynamics.forward_dynamics(chain, phi, q, qd, tau + 1, armature)

    return (q, qd, qdd, armature), everything(q, qd, qdd)


def close(ours, theirs, tolerance: float):
    assert_allclose(ours, theirs, rtol=0, atol=tolerance * max(1.0, np.abs(theirs).max()))


@pytest.fixture(params=CHAINS)
def name(request) -> str:
    return request.param


@pytest.fixture(params=[jnp.float64, jnp.float32], ids=["float64", "float32"])
def dtype(request):
    return request.param


@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        ("panda", jnp.float64),
        ("chain of 1", jnp.float64),
        ("chain of 3", jnp.float64),
        ("chain of 3", jnp.float32),
        ("chain of 1", jnp.float32),
        pytest.param("panda", jnp.float32, marks=pytest.mark.slow),
    ],
)
def test_fast_forms_equal_the_plain_definitions(name, dtype):
    (q, qd, qdd, armature), (tau, Y, M, acceleration) = plain(name)
    chain, phi = arm(name)
    q, qd, qdd, torque = (x.astype(dtype) for x in (q, qd, qdd, tau + 1))
    for ours, theirs, slack in [
        (batched.rnea(chain, phi, q, qd, qdd), tau, 1),
        (batched.regressor(chain, q, qd, qdd), Y, 1),
        (batched.mass_matrix(chain, phi, q), M, 1),
        (batched.forward_dynamics(chain, phi, q, qd, torque, armature), acceleration, 10),
    ]:
        assert ours.dtype == dtype
        close(ours, theirs, slack * TOLERANCE[dtype])


def test_regrouped_bodies_take_the_same_torques(name):
    (q, qd, qdd, _), (tau, *_) = plain(name)
    chain, phi = arm(name)
    other = columns.regrouping(columns.specialise(chain)) @ np.ravel(phi)
    assert (other == 0).sum() >= 3 * chain.dof
    torque = jax.jit(jax.vmap(functools.partial(dynamics.rnea, chain, jnp.asarray(other.reshape(phi.shape)))))
    close(torque(q, qd, qdd), tau, 1e-12)


@pytest.mark.parametrize("shape", [pytest.param((), marks=pytest.mark.slow), (0,), (5, 1, 2)])
def test_any_leading_shape_is_that_many_samples(shape):
    (*motion, armature), theirs = plain("chain of 3")
    chain, phi = arm("chain of 3")
    count = int(np.prod(shape))
    q, qd, qdd = (x[:count].reshape(*shape, 3) for x in motion)
    tau, Y, M, acceleration = (x[:count].reshape(*shape, *x.shape[1:]) for x in theirs)
    for ours, expected in [
        (batched.rnea(chain, phi, q, qd, qdd), tau),
        (batched.regressor(chain, q, qd, qdd), Y),
        (batched.mass_matrix(chain, phi, q), M),
        (batched.forward_dynamics(chain, phi, q, qd, tau + 1, armature), acceleration),
    ]:
        assert ours.shape == expected.shape
        assert_allclose(ours, expected, rtol=0, atol=1e-11)


def test_mapped_and_within_jit_the_answers_stay():
    (q, qd, qdd, _), (tau, *_) = plain("chain of 3")
    chain, phi = arm("chain of 3")
    close(jax.jit(jax.vmap(functools.partial(batched.rnea, chain, phi)))(q, qd, qdd), tau, 1e-12)
    twice = jax.vmap(batched.rnea, (None, 0, None, None, None))(chain, jnp.stack([phi, 2 * phi]), q, qd, qdd)
    close(twice, jnp.stack([tau, 2 * tau]), 1e-12)


def test_entries_left_out_are_zero_whatever_the_motion(name):
    (q, qd, qdd, _), (_, Y, *_) = plain(name)
    chain, _ = arm(name)
    kept = columns.regressor(columns.specialise(chain), q.T, qd.T, qdd.T)
    left_out = np.ones(Y.shape[1:], bool)
    left_out[tuple(np.array(list(kept)).T)] = False
    assert left_out.any()
    assert jnp.abs(Y[:, left_out]).max() < 1e-13
    if name == "panda":
        assert len(kept) == 255


def test_parameters_known_while_tracing_are_folded():
    (q, qd, qdd, _), _ = plain("panda")
    chain, phi = arm("panda")
    geometry = columns.specialise(chain)
    point = phi.at[:, 4:].set(0)

    def size(bodies):
        return len(jax.make_jaxpr(functools.partial(columns.rnea, geometry, bodies))(q.T, qd.T, qdd.T).eqns)

    known = [[float(v) for v in body] for body in point]
    assert size(known) < 0.8 * size([list(body) for body in point])
    close(
        jnp.stack(columns.rnea(geometry, known, q.T, qd.T, qdd.T), -1),
        batched.rnea(chain, point, q, qd, qdd),
        1e-13,
    )


@pytest.mark.parametrize(
    "name", ["chain of 1", *(pytest.param(name, marks=pytest.mark.slow) for name in ("chain of 3", "panda"))]
)
def test_derivatives_of_the_fast_forms_equal_those_of_the_plain_ones(name):
    (q, qd, qdd, armature), _ = plain(name)
    chain, phi = arm(name)
    x = phi, q, qd, qdd
    rng = np.random.default_rng(1)
    tangent = jax.tree.map(lambda v: jnp.asarray(rng.normal(size=v.shape)), x)

    def fast(phi, q, qd, qdd):
        tau = batched.rnea(chain, phi, q, qd, qdd)
        return tau, batched.forward_dynamics(chain, phi, q, qd, tau + 1, armature)

    @functools.partial(jax.vmap, in_axes=(None, 0, 0, 0))
    def slow(phi, q, qd, qdd):
        tau = dynamics.rnea(chain, phi, q, qd, qdd)
        return tau, dynamics.forward_dynamics(chain, phi, q, qd, tau + 1, armature)

    def both_modes(f):
        y, forward = jax.jvp(f, x, tangent)
        return forward, jax.vjp(f, *x)[1](y)

    for ours, theirs in zip(
        *(jax.tree.leaves(jax.jit(both_modes, static_argnums=0)(f)) for f in (fast, slow)), strict=True
    ):
        close(ours, theirs, 1e-10)


@pytest.mark.slow
def test_second_derivatives_are_there():
    (q, qd, qdd, _), _ = plain("chain of 1")
    chain, phi = arm("chain of 1")
    fast = jax.hessian(lambda q: batched.rnea(chain, phi, q, qd[0], qdd[0]).sum())(q[0])
    slow = jax.hessian(lambda q: dynamics.rnea(chain, phi, q, qd[0], qdd[0]).sum())(q[0])
    close(fast, slow, 1e-12)


@pytest.mark.parametrize("chunk", [1, 4, 4096])
def test_normal_equations_are_those_of_the_whole_regressor(chunk):
    (q, qd, qdd, _), (tau, Y, *_) = plain("chain of 3")
    weights = 1 + jnp.arange(3.0)
    W = Y.reshape(10, 3, 30)
    normal = batched.gram(arm("chain of 3")[0], q, qd, qdd, weights, tau, chunk=chunk)
    close(normal.matrix, jnp.einsum("tip,i,tir->pr", W, weights, W), 1e-13)
    close(normal.vector, jnp.einsum("tip,i,ti->p", W, weights, tau), 1e-13)
    close(normal.energy, jnp.sum(weights * tau**2), 1e-13)


def test_normal_equations_take_a_weight_for_each_sample():
    (q, qd, qdd, _), (tau, Y, *_) = plain("chain of 3")
    weights = jnp.asarray(np.random.default_rng(2).uniform(0, 2, tau.shape)).at[3].set(0)
    normal = batched.gram(arm("chain of 3")[0], q, qd, qdd, weights, tau, chunk=4)
    W = Y.reshape(10, 3, 30)
    close(normal.matrix, jnp.einsum("tip,ti,tir->pr", W, weights, W), 1e-13)
    close(normal.matrix @ arm("chain of 3")[1].reshape(-1), normal.vector, 1e-12)


def test_states_that_do_not_fit_the_arm_are_refused():
    (q, qd, qdd, _), _ = plain("chain of 3")
    with pytest.raises(ValueError, match=r"one shape \('\.\.\.', 7\); got"):
        batched.regressor(arm("panda")[0], q, qd, qdd)


def test_a_traced_chain_is_refused():
    chain, phi = arm("chain of 1")
    motion = [x[0] for x in states(0, 1, 1)]
    with pytest.raises(jax.errors.TracerArrayConversionError):
        jax.jit(batched.rnea)(chain, phi, *motion)


def test_one_compilation_serves_equal_chains():
    chain, phi = arm("chain of 1")
    copy = jax.tree.map(jnp.array, chain)
    motion = states(0, 3, 1)
    batched.rnea(chain, phi, *motion)
    before = batched._rnea._cache_size()
    batched.rnea(copy, phi, *motion)
    assert batched._rnea._cache_size() == before


# --- what makes them fast ---


def operations(name: str) -> int:
    """Arithmetic of one sample's torque, as the program is written."""
    chain, phi = arm(name)
    column = [jax.ShapeDtypeStruct((), jnp.float64)] * chain.dof
    torque = functools.partial(columns.rnea, columns.specialise(chain), [list(body) for body in phi])
    program = jax.make_jaxpr(torque)(column, column, column)
    return sum(e.primitive.name in ("mul", "add", "sub", "neg") for e in program.eqns)


def test_torque_is_compiled_into_a_few_loops_that_keep_little():
    chain, phi = arm("panda")
    geometry = columns.specialise(chain)
    column = [jax.ShapeDtypeStruct((1000,), jnp.float64)] * 7

    @jax.jit
    def torque(phi, q, qd, qdd):
        return columns.rnea(geometry, [list(body) for body in phi], q, qd, qdd)

    program = torque.lower(phi, column, column, column).compile()
    entry = program.as_text().split("ENTRY")[1]
    assert entry.count(" fusion(") + entry.count(" call(") < 24
    assert program.memory_analysis().temp_size_in_bytes < 16 * 1000 * 8


def test_torque_is_not_computed_again_for_every_element_of_the_stack():
    chain, phi = arm("panda")
    motion = [jax.ShapeDtypeStruct((1000, 7), jnp.float64)] * 3
    program = batched._rnea.lower(columns.specialise(chain), phi, *motion).compile()
    once = operations("panda")
    assert 900 < once < 1100
    # XLA on CPUs has no loop with several results: each of seven computes what it shares with the others
    assert program.cost_analysis()["flops"] / 1000 < 5 * once


# --- sine and cosine ---


@pytest.mark.parametrize("reach", [1.0, 100.0, 5000.0])
def test_sine_and_cosine_are_within_two_units_in_the_last_place(reach, dtype):
    x = np.random.default_rng(3).uniform(-reach, reach, 20_000).astype(dtype)
    exact = x.astype(np.longdouble)
    for ours, theirs in zip(jax.jit(sincos)(x), (np.sin(exact), np.cos(exact)), strict=True):
        assert ours.dtype == dtype
        unit = np.spacing(np.abs(theirs).astype(dtype))
        assert np.max(np.abs(np.asarray(ours) - theirs) / unit) <= 2


def test_sine_and_cosine_at_special_angles(dtype):
    x = jnp.array([0, np.inf, np.nan, 1e-30, -1e-30], dtype)
    s, c = sincos(x)
    assert_allclose(s, [0, np.nan, np.nan, 1e-30, -1e-30], rtol=1e-6)
    assert_allclose(c, [1, np.nan, np.nan, 1, 1])


def test_sine_and_cosine_differentiate_into_each_other():
    x = jnp.linspace(-4, 4, 9)
    derivative = jax.vmap(jax.grad(lambda x: sincos(x)[0]))(x)
    second = jax.vmap(jax.hessian(lambda x: sincos(x)[1]))(x)
    assert_allclose(derivative, jnp.cos(x), atol=1e-15)
    assert_allclose(second, -jnp.cos(x), atol=1e-15)


def test_sine_takes_single_and_double_precision_only():
    with pytest.raises(TypeError, match="float16"):
        sincos(jnp.zeros(3, jnp.float16))
