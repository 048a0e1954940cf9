"""The ways to factor and solve, by the library (the platform's, here), by blocks and by a GPU's threads."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxpanda.feasible import definite, threads

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


@pytest.mark.parametrize("rows", [0, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("n", [10, pytest.param(23, marks=pytest.mark.slow)])
def test_threads_solve_with_sums_that_are_never_written_down(n, rows):
    """Without a GPU, by Pallas' interpreter; lanes and unknowns that fill no whole group or block."""
    rng, lanes = np.random.default_rng(n), 33
    X, of_block = rng.normal(size=(n, n)), rng.normal(size=(n // 10, 10, 10, lanes))
    H = definite.Summed(
        constant=jnp.asarray(X @ X.T),
        common=jnp.asarray(rng.normal(size=n)),
        weight=jnp.asarray(rng.uniform(size=lanes)),
        blocks=jnp.einsum("lijb,lkjb->likb", of_block, of_block),
        rows=jnp.asarray(rng.normal(size=(rows, n, lanes))),
        diagonal=jnp.asarray(rng.uniform(1, 2, size=(n, lanes))),
    )
    rhs = rng.normal(size=(n, lanes))
    x = threads.solve(threads.factor_of_sum(*H, interpret=True), jnp.asarray(rhs), interpret=True)
    written = np.array(H.constant) + np.asarray(H.weight)[:, None, None] * np.outer(H.common, H.common)
    written = written + np.einsum("kpb,kqb->bpq", H.rows, H.rows)
    for lane in range(lanes):
        for block in range(n // 10):
            here = slice(10 * block, 10 * block + 10)
            written[lane][here, here] += H.blocks[block, :, :, lane]
        written[lane] += np.diag(H.diagonal[:, lane])
    np.testing.assert_allclose(definite.dense(H), written, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(np.einsum("bij,jb->ib", written, x), rhs, atol=1e-9)


@pytest.mark.slow
def test_threads_solve_with_matrices_that_are_written_down_and_say_which_are_not_definite():
    rng, n = np.random.default_rng(0), 13
    X = rng.normal(size=(4, n, n))
    H = X @ X.transpose(0, 2, 1) + np.eye(n)
    H[2, 7, 7] = -1.0
    factor = threads.factor(jnp.asarray(H.transpose(1, 2, 0)), interpret=True)
    x = np.asarray(threads.solve(factor, jnp.ones((n, 4)), interpret=True)).T
    fine = [0, 1, 3]
    np.testing.assert_allclose(np.einsum("bij,bj->bi", H[fine], x[fine]), 1.0, atol=1e-9)
    assert np.isnan(x[2]).any()
