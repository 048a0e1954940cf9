"""Coefficients of laws that must be a body's: whether the likeliest that can be built are found."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import least_squares

from jaxpanda import Arm
from jaxpanda.diagnosis.bodies import Body, body, likeliest
from jaxpanda.diagnosis.evidence import Design
from jaxpanda.effects.load import InertialParameters, Payload
from jaxpanda.feasible.nearest import are_buildable

LAWS = {"a link": InertialParameters, "a body held": Payload}


def problem(law: str, seed: int) -> tuple[Body, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The body that a law of the Panda's last link is, the likeliest coefficients, a root of their covariance,
    and the law's D and what is there before."""
    effect = LAWS[law].grid(Arm.panda())[-1]
    phi, D = effect.body
    found = body(phi, D)
    assert found is not None
    rng = np.random.default_rng(seed)
    scale = np.array([k.scale for k in effect.coefficients])
    root = scale[:, None] * rng.normal(size=(10, 10)) * 10.0 ** rng.uniform(-2, 0, 10)
    return found, 3 * scale * rng.normal(size=10), root, D, phi


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("law", LAWS)
def test_no_body_that_can_be_built_is_likelier(law, seed):
    """Against a search over factors of pseudo-inertias, which are always a body's."""
    found, x, root, D, phi = problem(law, seed)
    c, cost = likeliest(x, lambda y: root @ (root.T @ y), [(slice(0, 10), found)])
    away = np.linalg.solve(root, c - x)
    assert cost > 0.1
    np.testing.assert_allclose(0.5 * away @ away, cost, rtol=1e-3)
    assert are_buildable((phi + D @ c)[None])

    upper, to_coefficients = np.triu_indices(4), np.linalg.pinv(found.steps.reshape(10, 16).T)

    def residual(entries: np.ndarray) -> np.ndarray:
        U = np.zeros((4, 4))
        U[upper] = entries
        return np.linalg.solve(root, to_coefficients @ (U @ U.T - found.constant).ravel() - x)

    begin = np.linalg.cholesky(found.at(found.begin)[::-1, ::-1])[::-1, ::-1][upper]
    other = least_squares(residual, begin, method="lm", x_scale="jac", max_nfev=3000)
    assert cost < other.cost * 1.01 + 0.1


@pytest.mark.parametrize("law", LAWS)
def test_what_can_be_built_stays(law):
    found, _, root, *_ = problem(law, 0)
    c, cost = likeliest(found.begin, lambda y: root @ (root.T @ y), [(slice(0, 10), found)])
    assert cost == 0.0
    np.testing.assert_array_equal(c, found.begin)


def test_link_that_could_not_be_built_itself_bounds_nothing():
    """A file's own links may be rough: then nothing is known of what the changed link must be."""
    phi = np.array([1.0, 0, 0, 0, 1e-3, 0, 1e-3, 0, 0, 1e-2])
    assert body(phi, np.eye(10)) is None
    assert body(np.zeros(10), np.zeros((10, 10))) is None  # a link without mass


def test_a_model_pays_for_what_cannot_be_built():
    """A body of negative mass fits best; with what can be built the fit is worse, and so is its evidence."""
    found, _, _, D, _ = problem("a body held", 0)
    rng = np.random.default_rng(1)
    A = rng.normal(size=(200, 12))
    r = A[:, 2:] @ (-found.begin) + 0.1 * rng.normal(size=200)
    term = lambda b: SimpleNamespace(width=10, deviation=np.ones(10), body=b)
    free, held = (Design([A], [r], np.full(12, 1e-4), terms=[term(b)]) for b in (None, found))
    assert not are_buildable((D @ free.x[2:])[None])
    assert are_buildable((D @ held.x[2:])[None])
    squares = [np.sum(d.left[0] ** 2) + 1e-4 * d.x @ d.x for d in (free, held)]
    np.testing.assert_allclose(
        free.log_evidence - held.log_evidence, 0.5 * (squares[1] - squares[0]), rtol=1e-6
    )
    np.testing.assert_allclose(
        (held.information @ held.x - held.g)[:2], 0.0, atol=1e-6 * np.abs(held.g).max()
    )
