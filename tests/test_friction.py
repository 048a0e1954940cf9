"""Friction of the joints."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxpanda.arms.panda import published
from jaxpanda.errors import InputError
from jaxpanda.friction import LINEAR, MODELS, Friction, columns, sigmoid


def drawn(model: str, dof: int = 3) -> Friction:
    random = np.random.default_rng(1)
    return Friction(model, {name: random.uniform(0.1, 2.0, dof) for name in MODELS[model]})


@pytest.mark.parametrize("model", LINEAR)
def test_a_linear_model_is_its_columns_times_its_parameters(model):
    friction = drawn(model)
    qd = jnp.array([[0.5, -1.0, 0.0], [2.0, 0.1, -0.3]])
    by_hand = (
        friction.viscous * qd + friction.coulomb * jnp.sign(qd) + friction.offset
        if friction.parameters
        else 0 * qd
    )
    assert np.allclose(friction.torque(qd), by_hand, atol=1e-15)
    assert columns(model, qd).shape == (2, 3, len(MODELS[model]))


@pytest.mark.parametrize("model", ["none", "viscous", "coulomb_viscous", "sigmoid"])
def test_a_joint_at_rest_has_no_friction_torque(model):
    assert np.all(np.asarray(drawn(model).torque(jnp.zeros(3))) == 0)


def test_the_published_sigmoid_equals_its_equation_written_out():
    table = published()["sigmoid_friction"]
    phi1, phi2, phi3 = (np.array(table[name]) for name in ("phi1", "phi2", "phi3"))
    friction = Friction("sigmoid", {"phi1": phi1, "phi2": phi2, "phi3": phi3})
    qd = np.linspace(-2, 2, 7)
    expected = phi1 / (1 + np.exp(-phi2 * (qd + phi3))) - phi1 / (1 + np.exp(-phi2 * phi3))
    assert np.allclose(friction.torque(jnp.asarray(qd)), expected, atol=1e-14)


def test_a_steep_sigmoid_at_high_speed_is_finite():
    assert np.all(np.isfinite(sigmoid(jnp.array([1e4, -1e4]), jnp.array([1e4, 1e4]), jnp.array([0.0, 0.0]))))


@pytest.mark.parametrize("model", ["viscous", "coulomb_viscous_offset", "sigmoid"])
def test_friction_comes_back_from_json(model):
    friction = drawn(model)
    again = Friction.from_json(friction.to_json())
    assert again.model == model
    for name in MODELS[model]:
        assert np.array_equal(again.parameters[name], friction.parameters[name])


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ([{"joint": 1, "model": "dahl", "parameters": {}}], "unknown friction model 'dahl'"),
        ([{"joint": 2, "model": "viscous", "parameters": {"viscous": 1}}], r"friction\[0\].joint"),
        (
            [{"joint": 1, "model": "viscous", "parameters": {"viscous": "much"}}],
            r"parameters.viscous: 'much'",
        ),
        ([{"joint": 1, "model": "viscous", "parameters": {}}], r"parameters.viscous"),
        ([3], r"friction\[0\]"),
        (
            [
                {"joint": 1, "model": "viscous", "parameters": {"viscous": 1}},
                {"joint": 2, "model": "none", "parameters": {}},
            ],
            "one model for all joints",
        ),
    ],
)
def test_a_malformed_friction_table_is_refused(entries, message):
    with pytest.raises(InputError, match=message):
        Friction.from_json(entries)
