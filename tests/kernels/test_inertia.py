"""Ten numbers of a body: hand-computed bodies, and maps that undo each other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from jaxpanda_kernels import inertia
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

ETA = arrays(float, 10, elements=st.floats(-2, 2))
SEED = st.integers(0, 10_000)
quick = settings(max_examples=30, deadline=None)

# jitted once: hypothesis then runs at the speed of the arithmetic
from_eta = jax.jit(inertia.from_log_cholesky)
to_eta = jax.jit(inertia.to_log_cholesky)
from_com = jax.jit(inertia.from_com)
to_com = jax.jit(inertia.to_com)
pseudo = jax.jit(inertia.pseudo_inertia)
from_pseudo = jax.jit(inertia.from_pseudo_inertia)
move = jax.jit(inertia.move)
margin = jax.jit(inertia.triangle_margin)


def pose(seed: int) -> tuple[jax.Array, jax.Array]:
    rng = np.random.default_rng(seed)
    return jnp.asarray(Rotation.random(rng=rng).as_matrix()), jnp.asarray(rng.uniform(-1, 1, 3))


def close(a, b, tolerance=1e-12):
    assert_allclose(a, b, rtol=0, atol=tolerance * max(1.0, np.abs(b).max()))


def body(mass: float, com, I_com) -> jax.Array:
    return from_com(jnp.asarray(mass), jnp.asarray(com, float), jnp.asarray(I_com, float))


def test_a_point_mass_has_these_ten_numbers():
    # 2 kg at (1, 2, 3) m: Ixx = m (y² + z²) = 26, Ixy = -m x y = -4, ...
    assert_allclose(body(2.0, [1, 2, 3], np.zeros((3, 3))), [2, 2, 4, 6, 26, -4, 20, -6, -12, 10], atol=1e-14)


def test_a_rod_has_these_ten_numbers():
    # 3 kg, 2 m long, from the origin along x: m l²/3 about its end
    rod = body(3.0, [1, 0, 0], np.diag([0, 1, 1]))
    assert_allclose(rod, [3, 3, 0, 0, 0, 0, 4, 0, 0, 4], atol=1e-14)


def test_a_box_has_these_ten_numbers():
    # 12 kg, 1 x 2 x 3 m, one corner in the origin: Ixx = m (b² + c²)/3, Ixy = -m a b/4
    box = body(12.0, [0.5, 1, 1.5], np.diag([13, 10, 5]))
    assert_allclose(box, [12, 6, 12, 18, 52, -6, 40, -9, -18, 20], atol=1e-13)


def test_a_flat_plate_has_no_triangle_margin_and_a_ball_has_half_its_inertia():
    assert_allclose(margin(body(3.0, [0.1, 0.2, 0.3], np.diag([1, 2, 3]))), 0, atol=1e-14)
    assert_allclose(margin(body(3.0, [0.1, 0.2, 0.3], np.eye(3))), 0.5, atol=1e-14)


def test_the_triangle_margin_is_that_of_gaz_equation_27():
    # half of (smaller two - largest) = trace/2 - largest
    I = Rotation.random(rng=np.random.default_rng(0)).apply(np.diag([1.0, 1.5, 2.7]))
    I = I @ I.T
    largest = np.linalg.eigvalsh(I)[-1]
    assert_allclose(margin(body(1.0, [0.3, 0, 0.1], I)), np.trace(I) / 2 - largest, atol=1e-12)


def test_an_unreal_body_has_a_negative_triangle_margin():
    assert margin(body(1.0, [0, 0, 0], np.diag([1, 1, 2.1]))) < 0


@quick
@given(ETA)
def test_every_log_cholesky_point_is_a_real_body(eta):
    phi = from_eta(jnp.asarray(eta))
    assert phi[0] > 0
    assert (jnp.linalg.eigvalsh(pseudo(phi)) > -1e-12 * jnp.abs(phi).max()).all()
    assert margin(phi) > -1e-12 * jnp.abs(phi).max()


@quick
@given(ETA)
def test_log_cholesky_round_trips(eta):
    # the far corners of the box hold bodies too flat for ten digits
    eta = jnp.asarray(eta) * 0.5
    close(to_eta(from_eta(eta)), eta, 1e-9)


@quick
@given(ETA)
def test_forms_of_the_parameters_round_trip(eta):
    phi = from_eta(jnp.asarray(eta))
    close(from_com(*to_com(phi)), phi)
    close(from_pseudo(pseudo(phi)), phi)
    I = inertia.symmetric(phi[4:])
    close(inertia.six(I), phi[4:])
    close(inertia.inertia(inertia.second_moment(I)), I)


@quick
@given(ETA, SEED, SEED)
def test_moving_twice_is_moving_once_by_the_product(eta, first, second):
    phi = from_eta(jnp.asarray(eta))
    (R1, p1), (R2, p2) = pose(first), pose(second)
    close(move(move(phi, R1, p1), R2, p2), move(phi, R2 @ R1, R2 @ p1 + p2))


@quick
@given(ETA, SEED)
def test_moving_a_body_keeps_its_mass_shape_and_triangle_margin(eta, seed):
    phi, (R, p) = from_eta(jnp.asarray(eta)), pose(seed)
    moved = move(phi, R, p)
    mass, com, I = to_com(phi)
    mass_moved, com_moved, I_moved = to_com(moved)
    close(mass_moved, mass)
    close(com_moved, R @ com + p)
    close(I_moved, R @ I @ R.T, 1e-10)
    close(margin(moved), margin(phi), 1e-10)


@quick
@given(ETA, SEED)
def test_pseudo_inertia_is_the_mean_of_outer_products_of_points(eta, seed):
    # points of mass with the same moments as the body are the body, as far as torque can tell
    J = np.asarray(pseudo(from_eta(jnp.asarray(eta))))
    factor = np.linalg.cholesky(J + 1e-12 * np.abs(J).max() * np.eye(4))
    points = factor @ np.linalg.qr(np.random.default_rng(seed).normal(size=(4, 4)))[0]
    masses, places = points[3] ** 2, points[:3] / points[3]
    total = sum(body(m, x, np.zeros((3, 3))) for m, x in zip(masses, places.T, strict=True))
    close(total, from_pseudo(jnp.asarray(J)), 1e-9)


def test_skew_is_the_cross_product():
    u, v = jnp.array([1.0, 2, 3]), jnp.array([-4.0, 5, 6])
    assert_allclose(inertia.skew(u) @ v, np.cross(u, v), atol=1e-15)


@pytest.mark.parametrize("function", [inertia.from_pseudo_inertia, inertia.inertia])
def test_maps_keep_float32(function):
    size = 4 if function is inertia.from_pseudo_inertia else 3
    assert function(jnp.eye(size, dtype=jnp.float32)).dtype == jnp.float32


def test_gradients_are_finite_without_mass():
    def total(phi):
        mass, com, I = inertia.to_com(phi)
        return mass + com.sum() + I.sum()

    assert jnp.isfinite(jax.jit(jax.grad(total))(jnp.zeros(10))).all()
    assert jnp.isfinite(jax.jit(jax.grad(lambda phi: inertia.move(phi, *pose(0)).sum()))(jnp.zeros(10))).all()
