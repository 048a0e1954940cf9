"""Coefficients of laws that must be a body's: whether the likeliest that can be built are found."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import least_squares

from jaxpanda import Arm
from jaxpanda.diagnosis.bodies import Body, body, likeliest
from jaxpanda.diagnosis.evidence import Design
from jaxpanda.diagnosis.problem import Term
from jaxpanda.effects.load import Payload, PayloadChange
from jaxpanda.feasible.nearest import are_buildable

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
    c, cost = likeliest(x, lambda y: root @ (root.T @ y), [(slice(0, 10), found)])
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
    c, cost = likeliest(found.begin, lambda y: root @ (root.T @ y), [(slice(0, 10), found)])
    assert cost == 0.0
    np.testing.assert_array_equal(c, found.begin)


def test_a_model_pays_for_what_cannot_be_built():
    """A body of negative mass fits best; with what can be built the fit is worse, and so is its evidence."""
    found, *_ = problem(0)
    rng = np.random.default_rng(1)
    A = rng.normal(size=(200, 12))
    r = A[:, 2:] @ (-found.begin) + 0.1 * rng.normal(size=200)
    term = lambda b: SimpleNamespace(width=10, deviation=np.ones(10), body=b)
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
