"""Base parameters and their names."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxpanda_kernels import from_modified_dh, rnea

from jaxpanda.arms.arm import Arm
from jaxpanda.arms.panda import published
from jaxpanda.errors import InputError
from jaxpanda.parameters import (
    arm_base_parameters,
    base_parameters,
    coefficient_matrix,
    expression,
    random_regressor,
    standard_names,
    unit_of_form,
)


@pytest.fixture(scope="module")
def table() -> np.ndarray:
    return coefficient_matrix([row["terms"] for row in published()["coefficients"]], 7)


def random_arm(prismatic: list[bool], seed: int) -> Arm:
    random = np.random.default_rng(seed)
    dof = len(prismatic)
    chain = from_modified_dh(
        *(jnp.asarray(random.uniform(-1, 1, dof)) for _ in range(4)),
        jnp.array(prismatic),
        jnp.asarray(random.normal(size=3) * 5),
    )
    zero, wide = jnp.zeros(dof), jnp.full(dof, jnp.inf)
    joints, links = (tuple(f"{part}{i}" for i in range(1, dof + 1)) for part in ("joint", "link"))
    return Arm(
        chain, jnp.zeros((dof, 10)), zero, zero, zero, zero, zero, -wide, wide, joints, links, "random"
    )


def test_the_standard_parameters_are_named_in_the_kernels_order():
    assert standard_names(3)[20:] == (
        *("m3", "m3c3x", "m3c3y", "m3c3z"),
        *("J3xx", "J3xy", "J3yy", "J3xz", "J3yz", "J3zz"),
    )


def test_the_pandas_base_parameters_are_the_43_of_table_iii(table):
    base = arm_base_parameters(Arm.panda())
    assert base.rank == 43
    assert np.max(np.abs(base.projection - table)) < 1e-9
    names = standard_names(7)
    assert [names[k] for k in base.independent] == [row["lead"] for row in published()["coefficients"]]


def test_base_parameters_do_not_depend_on_the_states_drawn():
    first, second = (arm_base_parameters(Arm.panda(), seed=seed) for seed in (1, 2))
    assert np.array_equal(first.projection, second.projection)


def test_expressions_read_as_the_paper_prints_them():
    base = arm_base_parameters(Arm.panda())
    expressions = base.expressions
    units = [unit_of_form(terms) for terms in base.terms]
    assert units[:2] == ["kg m²", "kg m²"]
    assert {unit for unit, text in zip(units, expressions, strict=True) if "J" not in text} == {"kg m"}
    assert unit_of_form(["m1"]) == "kg"
    assert expressions[0] == "J2yy + J1zz"
    assert expressions[1] == "J2xx - J2yy + J3yy + 0.0999 m3 + 0.632 m3c3z + 0.1067 (m4 + m5 + m6 + m7)"
    assert expressions[6] == "J3xx - J3yy + J4yy - 0.0068 m4"
    assert expressions[32] == "m2c2y - m3c3z - 0.316 (m3 + m4 + m5 + m6 + m7)"
    assert expression({"m2": -1e-6}) == "-1e-06 m2"


@pytest.mark.parametrize(
    "prismatic",
    [[False] * 3, [True, False, False], [False, True, False, True], [True, True, True], [False] * 6],
    ids=["RRR", "PRR", "RPRP", "PPP", "RRRRRR"],
)
def test_base_parameters_of_any_chain_give_the_torque(prismatic):
    arm = random_arm(prismatic, seed=len(prismatic))
    base = arm_base_parameters(arm)
    W = random_regressor(arm, 50, seed=7)
    phi = np.random.default_rng(3).normal(size=10 * arm.dof)
    error = W[:, base.independent] @ (base.projection @ phi) - W @ phi
    assert np.max(np.abs(error)) < 1e-9 * np.max(np.abs(W @ phi))
    assert (
        np.linalg.matrix_rank(base.projection)
        == base.rank
        == np.linalg.matrix_rank(W / (np.linalg.norm(W, axis=0) + 1e-30))
    )


def test_sliding_joints_feel_masses_only():
    arm = random_arm([True, True, True], 3)
    felt = {name for terms in arm_base_parameters(arm).terms for name in terms}
    assert felt == {"m1", "m2", "m3"}


def test_a_pendulum_has_its_inertia_and_two_moments():
    arm = random_arm([False], 4)
    assert arm_base_parameters(arm).expressions == ["J1zz", "m1c1x", "m1c1y"]


def test_an_upright_first_axis_leaves_gravity_out():
    arm = random_arm([False], 4)
    upright = dataclasses.replace(
        arm,
        chain=from_modified_dh(
            *(jnp.zeros(1) for _ in range(4)), jnp.array([False]), jnp.array([0, 0, -9.81])
        ),
    )
    assert arm_base_parameters(upright).expressions == ["J1zz"]


def test_null_directions_move_no_torque(table):
    arm = Arm.panda()
    null = np.linalg.svd(table)[2][43:]
    q = jax.random.normal(jax.random.key(0), (3, 7))
    moved = arm.standard + jnp.asarray(null.sum(0)).reshape(7, 10)
    for phi in (arm.standard, moved):
        torque = rnea(arm.chain, phi, *q)
        assert np.allclose(torque, rnea(arm.chain, arm.standard, *q), atol=1e-11)


def test_a_regressor_of_zeros_has_no_base_parameters():
    assert base_parameters(np.zeros((20, 20))).rank == 0


def test_a_rank_that_is_too_high_is_refused():
    with pytest.raises(RuntimeError, match="no clear rank"):
        base_parameters(np.eye(20)[:, :1] @ np.ones((1, 20)), independent=2)


@pytest.mark.parametrize(
    ("terms", "message"),
    [
        ({"J8zz": 1}, "names link 8, but the arm has 7"),
        ({"mass3": 1}, r"coefficients\[0\].terms: unknown parameter 'mass3'"),
        ({"m3c4x": 1}, "unknown parameter 'm3c4x'"),
        ({"m3": float("nan")}, "nan is no finite number"),
        ({"m3": True}, "True is no finite number"),
        ({}, "at least one standard parameter"),
    ],
)
def test_a_malformed_linear_form_is_refused(terms, message):
    with pytest.raises(InputError, match=message):
        coefficient_matrix([terms], 7)
