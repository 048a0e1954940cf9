"""Both ways to factor and solve, by the library (the platform's, here) and by blocks, give what NumPy gives."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxpanda.feasible import definite

WAYS = {
    "blocks": (definite.by_blocks, definite.substitute_by_blocks),
    "platform": (definite.factor, definite.solve),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("n", [3, 14, 15, 70])
def test_a_system_is_solved_whatever_its_size(way, n):
    factor, solve = WAYS[way]
    rng = np.random.default_rng(n)
    X = rng.normal(size=(5, n, n))
    H, rhs = X @ X.transpose(0, 2, 1) + np.eye(n), rng.normal(size=(5, n))
    np.testing.assert_allclose(
        solve(factor(jnp.asarray(H)), jnp.asarray(rhs)),
        np.linalg.solve(H, rhs[..., None])[..., 0],
        rtol=1e-9,
        atol=1e-11,
    )


@pytest.mark.parametrize("way", WAYS)
def test_an_indefinite_matrix_gives_no_number_and_leaves_the_others_alone(way):
    factor, solve = WAYS[way]
    H = np.stack([np.eye(20), np.diag([*np.ones(17), -1.0, 1.0, 1.0])])
    found = np.asarray(solve(factor(jnp.asarray(H)), jnp.ones((2, 20))))
    np.testing.assert_allclose(found[0], 1.0)
    assert np.isnan(found[1]).any()
