"""Whether a prediction turns the friction that a model holds as MuJoCo's constraint does, or as a gear."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxpanda import Arm, Recording
from jaxpanda.corrected import Corrected
from jaxpanda.diagnosis.traces import held_sign, prepare
from jaxpanda.diagnosis.turning import GEAR, turning_as

NOISE = np.full(7, 0.02)


def rubbing(arm: Arm, turning: float | None) -> Recording:
    """Slow swings of the Panda, whose friction turns over a velocity [rad/s], or as MuJoCo's constraint does."""
    rng, time = np.random.default_rng(3), np.arange(0, 8.0, 2e-3)
    phase = 0.7 * time[:, None] + np.arange(7)
    qd = 0.05 * np.cos(phase)
    q = 0.5 * np.asarray(arm.lower + arm.upper) + 0.05 / 0.7 * np.sin(phase)
    frictionless = dataclasses.replace(arm, frictionloss=jnp.zeros(7))
    still = Recording("slow.csv", time, q, tau=np.zeros((len(time), 7)))
    load = prepare(still, frictionless, whole=True, noise=NOISE).motion.torque
    qdd = -0.05 * 0.7 * np.sin(phase)
    sign = held_sign(arm, qd, qdd, np.full(7, 1e-6)) if turning is None else np.tanh(qd / turning)
    tau = load + np.asarray(arm.frictionloss) * sign + NOISE * rng.normal(size=q.shape)
    return Recording("slow.csv", time, q, tau=tau)


@pytest.mark.parametrize(("true", "told"), [(None, None), (0.02, GEAR)])
def test_friction_of_the_model_turns_in_predictions_as_it_did_in_the_recordings(true, told):
    arm = dataclasses.replace(Arm.panda(), frictionloss=jnp.full(7, 0.5))
    zeros = jnp.zeros(7)
    corrected = Corrected(arm, jnp.zeros((7, 10)), zeros, zeros, (), ())
    found = turning_as([rubbing(arm, true)], corrected, NOISE)
    assert found.turning == told
    assert Corrected.from_json(found.to_json()).turning == told
