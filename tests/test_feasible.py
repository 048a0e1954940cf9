"""Bounds, constraints and the many-start solver."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxpanda_kernels import inertia

from jaxpanda.arms.arm import Arm
from jaxpanda.arms.panda import published
from jaxpanda.certificate import lower_bound
from jaxpanda.errors import InputError
from jaxpanda.feasible import (
    Bounds,
    Links,
    com_in_cylinder,
    com_in_hull,
    interior,
    mass_in_ellipsoid,
    small,
    solve,
    total_mass,
    triangle_inequality,
    when,
)
from jaxpanda.feasible.convex import scaled_problem, solve_chunk, starting_points
from jaxpanda.feasible.nearest import nearest_buildable
from jaxpanda.feasible.outcome import XYZ_COLUMN, XYZ_ROW
from jaxpanda.parameters import coefficient_matrix, random_regressor


def boxes(dof: int, total: tuple[float, float] | None = None) -> Bounds:
    return Bounds(
        mass=np.tile([0.1, 10.0], (dof, 1)),
        com=np.tile([-0.2, 0.2], (dof, 3, 1)),
        inertia=np.tile([[0.0, 1.0]] * 3 + [[-1.0, 1.0]] * 3, (dof, 1, 1)),
        total_mass=None if total is None else np.array(total),
    )


def published_problem() -> tuple[np.ndarray, np.ndarray, Bounds]:
    """The 41 coefficients that the paper calls reliable."""
    rows = [row for row in published()["coefficients"] if row["reliable"]]
    A = coefficient_matrix([row["terms"] for row in rows], 7)
    return A, np.array([row["value"] for row in rows]), Bounds.panda()


def least_eigenvalue(phi: np.ndarray) -> float:
    """Least eigenvalue of the second moment about the centre of mass, in plain numpy."""
    m, h, (xx, xy, yy, xz, yz, zz) = phi[0], phi[1:4], phi[4:]
    I = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return np.linalg.eigvalsh(0.5 * np.trace(I) * np.eye(3) - I - np.outer(h, h) / m)[0]


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    """Two real bodies."""
    eta = 0.3 * jax.random.normal(jax.random.key(3), (2, 10)) + jnp.array([0.3, *[-3.0] * 3, *[0.0] * 6])
    eta = eta.at[:, 4:].multiply(0.1)
    return np.asarray(jax.vmap(inertia.from_log_cholesky)(eta))


@pytest.fixture(scope="module")
def reachable(truth):
    """Fewer equations than unknowns, which two real bodies and one friction coefficient satisfy."""
    A = np.random.default_rng(0).normal(size=(12, 21))
    A[:, 20] *= 0.1
    b = A @ np.append(truth.ravel(), 0.5)
    bounds = boxes(2, (1.0, 6.0))
    options = {"extra_lower": np.array([0.3]), "extra_upper": np.array([0.7]), "initial": truth[None]}
    told = []
    found = solve(
        A, b, bounds, starts=64, chunk=24, progress=lambda done, of: told.append((done, of)), **options
    )
    assert told == [(24, 64), (48, 64), (64, 64)]
    return A, b, bounds, found


@pytest.mark.slow
def test_a_reachable_right_hand_side_is_reached_from_most_starts(reachable):
    A, b, _, found = reachable
    assert np.mean((found.objective < 1e-10) & (found.violation == 0)) > 0.9
    x = np.concatenate([found.phi.reshape(64, -1), found.extra], 1)
    np.testing.assert_allclose(np.sum((x @ A.T - b) ** 2, 1), found.objective, atol=1e-20)


@pytest.mark.slow
def test_what_links_of_the_panda_have_is_met_by_nearly_all_starts_each_in_its_own_way():
    """41 coefficients of 70 parameters: the exact solutions are a space of 29 dimensions, boxes allowing."""
    A, _, bounds = published_problem()
    b = A @ np.asarray(Arm.panda().standard).ravel()
    found = solve(A, b, bounds, starts=128)
    met = (found.violation == 0) & (found.objective <= 1e-14 * b @ b)
    assert np.mean(met) > 0.95
    np.testing.assert_array_equal(found.converged, met)
    assert np.median(found.iterations[met]) < 10
    assert np.linalg.matrix_rank(found.phi[met].reshape(met.sum(), -1) - found.phi[met][0].ravel()) == 29
    for phi in found.phi[met][:8]:
        assert all(least_eigenvalue(link) > 0 for link in phi)


@pytest.mark.slow
def test_where_boxes_on_inertias_bind_exact_coefficients_are_met_all_the_same():
    A, _, bounds = published_problem()
    truth = Arm.panda()
    boxes = np.asarray(jax.vmap(inertia.to_com)(truth.standard)[2])[:, XYZ_ROW, XYZ_COLUMN]
    width = 0.3 * np.abs(boxes).max(1, keepdims=True)
    tight = dataclasses.replace(bounds, inertia=np.stack([boxes - width, boxes + width], -1))
    b = A @ np.asarray(truth.standard).ravel()
    found = solve(A, b, tight, starts=64)
    assert np.mean((found.violation == 0) & (found.objective <= 1e-10 * b @ b)) > 0.8


def test_no_violation_means_that_numpy_finds_none_either(reachable):
    _, _, bounds, found = reachable
    for phi in found.phi[found.violation == 0]:
        mass, com = phi[:, 0], phi[:, 1:4] / phi[:, :1]
        assert np.all((mass >= bounds.mass[:, 0]) & (mass <= bounds.mass[:, 1]))
        assert np.all((com >= bounds.com[..., 0]) & (com <= bounds.com[..., 1]))
        assert 1.0 <= mass.sum() <= 6.0
        assert all(least_eigenvalue(link) > 0 for link in phi)


def test_extra_unknowns_stay_in_their_bounds(reachable):
    found = reachable[-1]
    assert np.all((found.extra >= 0.3) & (found.extra <= 0.7))


@pytest.mark.slow
def test_the_same_seed_gives_the_same_starts_whatever_the_chunk():
    A, b = np.eye(10)[:1], np.array([5.0])
    found = [solve(A, b, boxes(1), starts=6, chunk=chunk, rounds=1, iterations=1) for chunk in (6, 4)]
    for other in found[1:]:
        np.testing.assert_allclose(other.phi, found[0].phi, rtol=1e-9)
    assert len(np.unique(found[0].phi[:, 0, 3])) == 6


def test_a_user_constraint_binds_where_it_should_and_is_not_violated():
    """min (m - 5)² under m <= 3: the answer is m = 3 and 4."""
    A = np.eye(10)[:1]
    found = solve(A, np.array([5.0]), boxes(1), constraints=[lambda links: 3.0 - links.mass], starts=8)
    assert np.all(found.violation == 0)
    np.testing.assert_allclose(found.objective, 4.0, rtol=1e-4)


@pytest.mark.slow
def test_non_convex_and_conditional_constraints_are_kept(truth):
    A = np.random.default_rng(1).normal(size=(8, 20))
    hull = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    constraints = [
        com_in_hull(0, hull),
        com_in_cylinder(1, [0, 0, -0.1], [0, 0, 0.1], 0.03),
        when(lambda links: links.mass[0] > links.mass[1], lambda links: links.com[1, 2]),
        # outside a sphere: not convex
        lambda links: jnp.sum(links.com[0] ** 2) - 0.03**2,
        mass_in_ellipsoid(1, [0, 0, 0], [0.3, 0.3, 0.3]),
    ]
    found = solve(A, A @ truth.ravel(), boxes(2), constraints=constraints, starts=32)
    kept = found.phi[found.violation == 0]
    assert len(kept) > 16
    mass, com = kept[..., 0], kept[..., 1:4] / kept[..., :1]
    assert np.all(com[:, 0] >= 0)
    assert np.all(com[:, 0].sum(-1) <= 0.1)
    assert np.all(np.linalg.norm(com[:, 1, :2], axis=-1) <= 0.03)
    assert np.all((mass[:, 0] <= mass[:, 1]) | (com[:, 1, 2] >= 0))
    assert np.all(np.linalg.norm(com[:, 0], axis=-1) >= 0.03)


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0.03, 0.1])
def test_constraints_that_the_path_cannot_follow_are_met_by_newton(radius):
    """Light links and data far out of reach press centres of mass against cylinders, where they bend most."""
    A = np.random.default_rng(4).normal(size=(18, 20))
    constraints = [com_in_cylinder(l, [0, 0, -0.05], [0, 0, 0.05], radius) for l in (0, 1)]
    found = solve(A, np.ones(18), boxes(2), constraints=constraints, starts=32)
    met = found.violation == 0
    assert np.mean(met & (found.objective <= 1.01 * found.objective[found.best])) > 0.8


@pytest.mark.slow
def test_most_starts_reach_the_optimum_under_constraints_of_the_users_own():
    """The published coefficients with each centre of mass in a cylinder, some of which bind."""
    constraints = [com_in_cylinder(i, [0, 0, -0.15], [0, 0, 0.15], 0.09) for i in range(7)]
    found = solve(*published_problem(), constraints=constraints, starts=128)
    best = found.objective[found.best]
    assert 3.7262e-4 < best < 3.735e-4
    assert np.mean((found.violation == 0) & (found.objective <= 1.01 * best)) > 0.9


@pytest.mark.slow
def test_what_cannot_be_met_is_reported_as_violated():
    found = solve(np.eye(10)[:1], np.array([5.0]), boxes(1), constraints=[lambda l: l.mass - 11.0], starts=4)
    np.testing.assert_allclose(found.violation, 1.0, atol=1e-3)
    assert not found.converged.any()


def test_given_parameters_are_the_first_start(reachable, truth):
    """What is given solves the problem already, so that no step can lower it much."""
    found = reachable[-1]
    np.testing.assert_allclose(found.phi[0], truth, atol=0.05)
    assert np.abs(found.phi[1] - truth).max() > 0.05


def test_the_triangle_margin_of_a_plate_is_zero_and_of_a_cube_is_not():
    plate = Links(jnp.ones(1), jnp.zeros((1, 3)), jnp.diag(jnp.array([1.0, 2.0, 3.0]))[None])
    cube = Links(jnp.ones(1), jnp.zeros((1, 3)), jnp.eye(3)[None])
    np.testing.assert_allclose(triangle_inequality(plate), [0.0], atol=1e-15)
    np.testing.assert_allclose(triangle_inequality(cube), [0.5])


def test_margins_of_the_ready_made_constraints_are_distances():
    links = Links(jnp.array([2.0]), jnp.array([[0.1, 0.0, 0.3]]), jnp.eye(3)[None])
    np.testing.assert_allclose(total_mass(1.0, 5.0)(links), [1, 3])
    np.testing.assert_allclose(
        com_in_cylinder(0, [0, 0, 0], [0, 0, 1], 0.1)(links), [0.3, 0.7, 0], atol=1e-15
    )
    cube = [[x, y, z] for x in (0, 1) for y in (-1, 1) for z in (0, 1)]
    assert np.min(com_in_hull(0, cube)(links)) == pytest.approx(0.1)
    # The shell of an ellipsoid about its own centre: m - tr(D^-2 Sigma) is zero for Sigma = m D²/3.
    D = np.array([0.1, 0.2, 0.3])
    shell = Links(jnp.array([2.0]), jnp.zeros((1, 3)), inertia.inertia(jnp.diag(2 * D**2 / 3))[None])
    np.testing.assert_allclose(mass_in_ellipsoid(0, [0, 0, 0], D)(shell), 0, atol=1e-14)


def test_a_condition_that_does_not_hold_leaves_the_constraint_satisfied():
    links = Links(jnp.array([2.0]), jnp.zeros((1, 3)), jnp.eye(3)[None])
    light = when(lambda l: l.mass[0] < 1, lambda l: -l.mass)
    heavy = when(lambda l: l.mass[0] > 1, lambda l: -l.mass)
    assert np.all(light(links) >= 0)
    np.testing.assert_allclose(heavy(links), [-2])


def test_a_flat_hull_is_refused():
    with pytest.raises(InputError, match="no volume"):
        com_in_hull(0, [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])


def test_the_published_bounds_are_read_with_their_total_mass():
    bounds = Bounds.panda()
    assert bounds.dof == 7
    np.testing.assert_allclose(bounds.com[6, 2], [0.04, 0.15])
    np.testing.assert_allclose(bounds.total_mass, [16, 20])


def test_bounds_around_an_arm_hold_that_arm():
    arm = Arm.panda()
    bounds = Bounds.around(arm)
    mass, com, I_com = jax.vmap(inertia.to_com)(arm.standard)
    six = I_com[:, [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    for value, box in ((mass, bounds.mass), (com, bounds.com), (six, bounds.inertia)):
        assert np.all((value >= box[..., 0]) & (value <= box[..., 1]))
    assert bounds.total_mass[0] < mass.sum() < bounds.total_mass[1]


GOOD = "name,lower,upper\nm1,0,5\nc1x,-1,1\nc1y,-1,1\nc1z,-1,1\n"


def test_inertia_and_total_mass_may_be_absent_from_a_table(tmp_path):
    (tmp_path / "b.csv").write_text(GOOD)
    bounds = Bounds.from_csv(tmp_path / "b.csv")
    assert bounds.total_mass is None
    np.testing.assert_array_equal(bounds.inertia[0, :, 0], [0, 0, 0, -np.inf, -np.inf, -np.inf])


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (GOOD.replace("m1,0,5", "m1,0,heavy"), "row 2, column upper: 'heavy'"),
        (GOOD.replace("m1,0,5", "m1,6,5"), r"m1: \[6, 5\] is empty"),
        (GOOD.replace("m1,0,5", "m1,nan,5"), "bounds of m1"),
        (GOOD.replace("m1,0,5", "m1,0,inf"), "must be finite"),
        (GOOD.replace("m1,0,5", "mass1,0,5"), "row 2, column name: 'mass1'"),
        (GOOD + "m99999999,0,5\n", "row 6, column name: 'm99999999'"),
        (GOOD + "m0,0,5\n", "row 6, column name: 'm0'"),
        (GOOD.replace("c1z,-1,1\n", ""), "no row for c1z"),
        (GOOD + "m1,0,5\n", "row 6, column name: 'm1' occurs twice"),
        (GOOD + "total_mass,7,8\n", "total_mass"),
        (GOOD + "m3,0,1\n", "no row for m2"),
        ("name;lower;upper\n", "no columns name,lower,upper"),
        ("", "empty"),
    ],
)
def test_a_malformed_table_of_bounds_is_refused_by_row_and_column(tmp_path, text, complaint):
    (tmp_path / "b.csv").write_text(text)
    with pytest.raises(InputError, match=complaint):
        Bounds.from_csv(tmp_path / "b.csv")


def test_binary_garbage_is_no_table_of_bounds(tmp_path):
    (tmp_path / "b.csv").write_bytes(b"\xff\xfe\x00\x80" * 9)
    with pytest.raises(InputError, match=r"b\.csv"):
        Bounds.from_csv(tmp_path / "b.csv")


@pytest.mark.parametrize(
    ("A", "b", "complaint"),
    [
        (np.eye(9), np.ones(9), "fewer than the ten"),
        (np.full((1, 10), np.nan), np.ones(1), "not finite"),
    ],
)
def test_equations_that_make_no_sense_are_refused(A, b, complaint):
    with pytest.raises(InputError, match=complaint):
        solve(A, b, boxes(1))


@pytest.fixture(scope="module")
def bodies() -> small.Matrices:
    """Positive definite 4x4 matrices of 3 links and 5 lanes, of condition 1 to 1e4."""
    X = np.random.default_rng(4).normal(size=(3, 5, 4, 4)) * np.logspace(0, -2, 5)[:, None, None]
    return jnp.moveaxis(jnp.asarray(X @ np.swapaxes(X, -1, -2) + 1e-4 * np.eye(4)), 1, -1)


def test_small_inverses_products_and_entries_agree_with_numpy(bodies):
    one_by_one = np.moveaxis(np.asarray(bodies), -1, 1)
    inverse = np.moveaxis(np.asarray(small.inverse(bodies)), -1, 1)
    np.testing.assert_allclose(inverse @ one_by_one, np.broadcast_to(np.eye(4), inverse.shape), atol=1e-9)
    both = np.moveaxis(np.asarray(small.product(bodies, bodies)), -1, 1)
    np.testing.assert_allclose(both, one_by_one @ one_by_one, rtol=1e-12)
    np.testing.assert_array_equal(small.symmetric(small.entries(bodies)), bodies)
    # <S(s), Z> = s . adjoint(Z)
    Z = jnp.roll(bodies, 1, 0)
    np.testing.assert_allclose(
        small.inner(bodies, Z), jnp.sum(small.entries(bodies) * small.adjoint(Z), (0, 1)), rtol=1e-12
    )


def test_the_small_curvature_is_the_hessian_of_minus_log_det(bodies):
    at = lambda s: -jnp.linalg.slogdet(small.symmetric(s[None, :, None])[0, :, :, 0])[1]
    S = bodies[1:2, :, :, 2:3]
    inverse = small.inverse(S)
    expected = jax.hessian(at)(small.entries(S)[0, :, 0])
    found = small.curvature(inverse, inverse)[0, :, :, 0]
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8 * float(jnp.abs(expected).max()))


def test_the_longest_step_ends_at_the_boundary(bodies):
    one_by_one = np.moveaxis(np.asarray(bodies), -1, 0)
    D = -3.0 * jnp.roll(bodies, 1, -1)
    found = small.longest_step(bodies, D)
    for lane, alpha in enumerate(np.asarray(found)):
        least = lambda a, lane=lane: np.linalg.eigvalsh(one_by_one[lane] + a * np.asarray(D)[..., lane]).min()
        assert least(0.999 * alpha) > 0
        assert alpha == 1.0 or least(alpha + 0.02) < 0


@pytest.fixture(scope="module")
def begun(reachable):
    """A problem, and where 40 starts of it begin."""
    A, b, bounds, _ = reachable
    problem = scaled_problem(A, b, bounds, np.array([0.3]), np.array([0.7]))
    return problem, starting_points(problem, 40, 5)


@pytest.mark.slow
def test_starts_that_leave_when_done_end_where_they_would_have_ended(begun):
    """When all 40, when 16 of them at a time, and when the last four at a time take their steps."""
    whole, *others = (
        jax.jit(lambda p, x, n=n: solve_chunk(p, x, iterations=100, lanes=n))(*begun)
        for n in ((40,), (16,), (16, 4))
    )
    # Another number of lanes sums in another order, which long ways magnify.
    for few in others:
        apart = np.abs(few.phi - whole.phi).max((1, 2))
        assert np.all(apart[whole.iterations <= 30] < 1e-9)
        assert np.all(apart < 1e-2)
    assert np.mean(whole.iterations <= 30) > 0.9
    assert len(np.unique(whole.iterations)) > 1


def test_every_start_begins_strictly_inside_and_apart_from_the_others(begun):
    problem, x0 = begun
    assert np.all(problem.G @ x0.T + problem.d[:, None] > 0)
    S = np.moveaxis(np.asarray(interior.matrices(problem, x0.T)), -1, 0)
    assert np.linalg.eigvalsh(S).min() > 0
    assert len(np.unique(x0[:, 0])) == len(x0)


def test_a_converged_start_is_as_close_to_the_certified_optimum_as_it_claims():
    """Two real bodies cannot have these: the lower bound is far from zero."""
    clarabel = pytest.importorskip("clarabel")
    assert clarabel
    A, b = np.random.default_rng(2).normal(size=(18, 20)), 3 * np.random.default_rng(3).normal(size=18)
    bound = lower_bound(A, b, boxes(2)).lower_bound
    found = solve(A, b, boxes(2), starts=16)
    assert bound > 1.0
    assert found.converged.all()
    assert np.all(found.objective >= bound * (1 - 1e-6))
    np.testing.assert_allclose(found.objective, bound, rtol=1e-4)


@pytest.mark.slow
def test_boxes_that_are_points_are_kept():
    mass = np.array([[2.0, 2.0]])
    com = np.array([[[0.0, 0.0], [-0.1, 0.1], [-0.1, 0.1]]])
    bounds = Bounds(mass, com, boxes(1).inertia, np.array([1.0, 3.0]))
    found = solve(np.eye(10)[:4], np.array([3.0, 0.1, 0.1, 0.0]), bounds, starts=4)
    assert np.all(found.violation == 0)
    np.testing.assert_array_equal(found.phi[:, 0, 0], 2.0)
    np.testing.assert_array_equal(found.phi[:, 0, 1], 0.0)
    np.testing.assert_allclose(found.objective, 1.01, rtol=1e-4)


@pytest.mark.parametrize("width", [*(pytest.param(w, marks=pytest.mark.slow) for w in (0.0, 0.01)), 0.1])
def test_a_box_on_the_inertia_binds_where_it_should(width):
    """min (Ixx - 0.5)² under Ixx <= 0.1 about the centre of mass, which may lie off the origin."""
    box = np.array([[0.0, 0.1], [0, 1.0], [0, 1.0], [-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]])
    com = np.tile([-width, width], (1, 3, 1))
    bounds = Bounds(np.array([[1.0, 2.0]]), com, box[None])
    found = solve(np.eye(10)[4:5], np.array([0.5]), bounds, starts=64)
    best = (0.5 - 0.1 - 2.0 * 2 * width**2) ** 2
    # A start in fifty is still on its way after the most steps, and says so; which one hangs on the processor.
    assert np.mean(found.converged) > 0.9
    assert np.all(found.violation[found.converged] == 0)
    assert np.all(found.violation < 1e-5)
    assert found.objective[found.best] == pytest.approx(best, rel=1e-4)
    assert np.mean(found.objective < 1.03 * best) > 0.8


@pytest.mark.parametrize("width", [1e-3, 0.1])
@pytest.mark.parametrize("inertia", [0.5, 0.002])
def test_links_much_larger_than_the_box_of_their_centre_of_mass_are_found(width, inertia):
    """Only the mass is out of reach, by 1 kg."""
    free = np.tile([-np.inf, np.inf], (1, 6, 1))
    bounds = Bounds(np.array([[1.0, 2.0]]), np.tile([-width, width], (1, 3, 1)), free)
    A, b = np.eye(10)[[0, 4, 6, 9]], np.array([3.0, inertia, inertia, 1.5 * inertia])
    found = solve(A, b, bounds, starts=64)
    assert np.all(found.violation == 0)
    assert np.mean(found.converged) > 0.6
    np.testing.assert_allclose(found.objective[:16], 1.0, rtol=1e-4)
    # Once, what damping and the start's pull held back was taken for the optimum.
    assert np.all(found.objective[found.converged] < 1.01)


def test_the_nearest_links_that_can_be_built_give_the_torque_of_those_that_cannot():
    """What the torque does not show makes link 7 impossible, and is taken off; what it shows stays."""
    arm = Arm.panda()
    W = np.asarray(random_regressor(arm, 300)).reshape(-1, 70) / 0.05
    _, root = np.linalg.qr(W)
    begin = np.asarray(arm.standard)
    payload = np.asarray(inertia.from_com(jnp.array(1.0), jnp.array([0.03, 0.02, 0.1]), 0.002 * jnp.eye(3)))
    real = begin.copy()
    real[6] += payload
    _, values, directions = np.linalg.svd(W)
    unfelt = directions[np.sum(values > 1e-8 * values[0]) :]
    impossible = real + min(
        ((sign * 0.05 * d / np.abs(d).max()).reshape(7, 10) for d in unfelt for sign in (-1, 1)),
        key=lambda change: min(least_eigenvalue(link) for link in (real + change)),
    )
    assert min(least_eigenvalue(link) for link in impossible) < -1e-3
    np.testing.assert_allclose(W @ (impossible - real).ravel(), 0.0, atol=1e-6)

    found = nearest_buildable(impossible, np.zeros_like(real), begin, root, range(7))
    assert min(least_eigenvalue(link) for link in found) > -1e-9
    assert np.all(found[:, 0] > 0)
    off, at_all = (np.sqrt(np.mean((W @ (one - real).ravel()) ** 2)) for one in (found, begin))
    assert off < 0.1  # of the noise
    assert off < 0.01 * at_all


def test_of_links_that_carry_others_only_their_own_part_moves():
    arm = Arm.panda()
    _, root = np.linalg.qr(np.asarray(random_regressor(arm, 100)).reshape(-1, 70) / 0.05)
    begin, carried = np.asarray(arm.standard), np.zeros((7, 10))
    carried[6] = 0.5 * begin[6]
    wanted = begin.copy()
    wanted[6, 0] = 0.4 * begin[6, 0]  # less than it carries
    found = nearest_buildable(wanted, carried, begin, root, [6])
    np.testing.assert_array_equal(found[:6], wanted[:6])
    assert found[6, 0] > carried[6, 0]
    assert least_eigenvalue(found[6] - carried[6]) > -1e-9
