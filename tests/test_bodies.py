"""Coefficients of laws that must be a body's: whether the likeliest that can be built are found."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import least_squares, minimize

from jaxpanda import Arm
from jaxpanda.effects.load import Payload, PayloadChange
from jaxpanda.feasible.nearest import are_buildable
from jaxpanda.inference.bodies import Body, Correction, at_bounds, body, likeliest
from jaxpanda.inference.evidence import Design, gram
from jaxpanda.inference.problem import Term

DIRECTIONS = Payload.grid(Arm.panda())[-1].body


def problem(seed: int) -> tuple[Body, np.ndarray, np.ndarray]:
    """The body that a payload is, the likeliest coefficients, and a root of their covariance."""
    effect = Payload.grid(Arm.panda())[-1]
    rng = np.random.default_rng(seed)
    scale = np.array([k.scale for k in effect.coefficients])
    root = scale[:, None] * rng.normal(size=(10, 10)) * 10.0 ** rng.uniform(-2, 0, 10)
    return body(effect.body), 3 * scale * rng.normal(size=10), root


@pytest.mark.parametrize("seed", range(4))
def test_no_body_that_can_be_built_is_likelier(seed):
    """Against a search over factors of pseudo-inertias, which are always a body's."""
    found, x, root = problem(seed)
    c, cost, _ = likeliest(x, lambda y: root @ (root.T @ y), [(slice(0, 10), found)])
    away = np.linalg.solve(root, c - x)
    assert cost > 0.1
    np.testing.assert_allclose(0.5 * away @ away, cost, rtol=1e-3)
    assert are_buildable((DIRECTIONS @ c)[None])

    upper, to_coefficients = np.triu_indices(4), np.linalg.pinv(found.steps.reshape(10, 16).T)

    def residual(entries: np.ndarray) -> np.ndarray:
        U = np.zeros((4, 4))
        U[upper] = entries
        return np.linalg.solve(root, to_coefficients @ (U @ U.T).ravel() - x)

    begin = np.linalg.cholesky(found.at(found.begin)[::-1, ::-1])[::-1, ::-1][upper]
    other = least_squares(residual, begin, method="lm", x_scale="jac", max_nfev=3000)
    assert cost < other.cost * 1.01 + 0.1


def test_what_can_be_built_stays():
    found, _, root = problem(0)
    c, cost, kept = likeliest(found.begin, lambda y: root @ (root.T @ y), [(slice(0, 10), found)])
    assert (cost, kept) == (0.0, [])
    np.testing.assert_array_equal(c, found.begin)


def test_a_model_pays_for_what_cannot_be_built():
    """A body of negative mass fits best; with what can be built the fit is worse, and so is its evidence."""
    found, *_ = problem(0)
    rng = np.random.default_rng(1)
    A = rng.normal(size=(200, 12))
    r = A[:, 2:] @ (-found.begin) + 0.1 * rng.normal(size=200)
    term = lambda b: SimpleNamespace(width=10, deviation=np.ones(10), body=b, corrections={})
    free, held = (Design([A], [r], np.full(12, 1e-4), terms=[term(b)]) for b in (None, found))
    assert not are_buildable((DIRECTIONS @ free.x[2:])[None])
    assert are_buildable((DIRECTIONS @ held.x[2:])[None])
    squares = [np.sum(d.left[0] ** 2) + 1e-4 * d.x @ d.x for d in (free, held)]
    np.testing.assert_allclose(
        free.log_evidence - held.log_evidence, 0.5 * (squares[1] - squares[0]), rtol=1e-6
    )
    np.testing.assert_allclose(
        (held.information @ held.x - held.g)[:2], 0.0, atol=1e-6 * np.abs(held.g).max()
    )


def test_only_a_law_is_a_body():
    """Not the slope of its torque in when it begins, which is a column of its own while shapes are refined."""
    change = PayloadChange(6, 2.0, 1e9, "one.csv", "gained")
    assert Term(change, (), np.ones(10)).body is not None
    assert Term(change, (), np.ones(1)).body is None


RNG = np.random.default_rng(3)
SIZES = RNG.uniform(0.5, 2, 5)
NUMBERS = [
    {0: Correction(("damping", 0), 0.3, SIZES[0]), 3: Correction(("damping", 0), 0.3, SIZES[3])},
    {1: Correction(("armature", 0), 0.1, SIZES[1])},
    {4: Correction(("armature", 1), 0.2, SIZES[4])},
]
"""Of one two coefficients correct the same; of the third none does."""


@pytest.mark.parametrize("seed", range(4))
def test_numbers_are_not_negative_and_none_such_is_likelier(seed):
    """Against a solver that knows of no active set."""
    rng = np.random.default_rng(seed)
    root, x = rng.normal(size=(5, 5)), np.array([-1.0, -0.5, 0.3, -0.8, 1.0]) + 0.2 * rng.normal(size=5)
    covariance = root @ root.T
    rows = np.zeros((3, 5))
    for row, parts in zip(rows, NUMBERS, strict=True):
        row[[*parts]] = SIZES[[*parts]]
    values = np.array([0.3, 0.1, 0.2])
    c, cost, among, (kept,) = at_bounds(x, lambda y: covariance @ y, NUMBERS)
    inverse = np.linalg.inv(covariance)
    far = lambda c: 0.5 * (c - x) @ inverse @ (c - x)
    other = minimize(
        far, np.zeros(5), jac=lambda c: inverse @ (c - x), method="SLSQP",
        constraints={"type": "ineq", "fun": lambda c: values + rows @ c, "jac": lambda _: rows},
        options={"maxiter": 500, "ftol": 1e-14},
    )  # fmt: skip
    assert cost > 0
    assert np.all(values + rows @ c > -1e-7)
    np.testing.assert_allclose([cost, far(c)], other.fun, rtol=1e-5)
    np.testing.assert_allclose(c, other.x, atol=1e-4)
    zero = np.abs(values + rows @ c) < 1e-6
    np.testing.assert_allclose(rows[zero] @ among(np.eye(5)), 0.0, atol=1e-6)
    assert set(kept.at.tolist()) == set(np.flatnonzero(np.any(rows[zero] != 0, 0)).tolist())


def test_numbers_that_are_not_negative_stay():
    x = np.array([0.1, 0.1, -9.0, 0.1, 0.1])
    c, cost, _, kept = at_bounds(x, lambda y: y, NUMBERS)
    assert (cost, kept) == (0.0, [])
    np.testing.assert_array_equal(c, x)


def test_a_number_below_zero_by_rounding_is_zero():
    x = np.array([0.0, -0.1 / SIZES[1] * (1 + 1e-15), 0.0, 0.0, 0.0])
    c, cost, *_ = at_bounds(x, lambda y: y, NUMBERS)
    assert cost < 1e-20
    np.testing.assert_allclose(c, x, atol=1e-12)


def test_what_another_law_brings_beside_a_number_at_zero():
    """It was weighed as if the number went on falling: laws that explain next to nothing had evidence of
    thousands of nats, as what a bound leaves of a residual is not orthogonal to the columns of what it holds."""
    rng = np.random.default_rng(4)
    A, law = rng.normal(size=(400, 3)), rng.normal(size=(400, 1))
    law += 0.9 * A[:, 1:2]  # much alike what the number multiplies
    r = A @ [0.5, -3.0, 0.2] + 0.3 * law[:, 0] + rng.normal(size=400)
    held = {1: Correction(("armature", 0), 0.1)}
    one = Design([A], [r], np.ones(3), corrections=held)
    assert one.x[1] == pytest.approx(-0.1, abs=1e-8)
    two = Design([np.hstack([A, law])], [r], np.ones(4), corrections=held)
    assert two.x[1] == pytest.approx(-0.1, abs=1e-8)
    b, G = one.in_joint(0, law[:, None], gram(law[:, None]))
    expected = 0.5 * b[0] @ np.linalg.solve(G[0] + np.eye(1), b[0])
    assert two.fitted - one.fitted == pytest.approx(expected, rel=1e-4)
    free = Design([A], [r], np.ones(3))
    assert one.log_evidence < free.log_evidence
