"""Whether laws of sensors act on torque as the recordings show it, where the file's friction is a placeholder."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest

from jaxpanda import Arm, Recording
from jaxpanda.corrected import Corrected
from jaxpanda.effects.sensing import TimeDelay, TorqueGain
from jaxpanda.errors import InputError
from jaxpanda.inference.friction_shown import friction_shown
from jaxpanda.prediction.predict import predicted
from jaxpanda.traces import prepare, trajectory

NOISE = 0.05
VISCOUS = np.array([8.0, 6.0, 5.0, 4.0, 2.0, 1.0, 0.0])


def swings(arm: Arm, moves: np.ndarray) -> Recording:
    """Some of the Panda's joints swing, with its torque and noise."""
    rng, time = np.random.default_rng(5), np.arange(0, 12.0, 4e-3)
    middle = 0.5 * np.asarray(arm.lower + arm.upper)
    q = middle + moves * 0.4 * np.sin(1.3 * time[:, None] + np.arange(7))
    still = Recording("swings.csv", time, q, tau=np.zeros((len(time), 7)))
    tau = trajectory(still).trace(arm).motion.torque
    return Recording("swings.csv", time, q, tau=tau + NOISE * rng.normal(size=q.shape))


@pytest.fixture(scope="module")
def true_arm() -> Arm:
    return dataclasses.replace(Arm.panda(), damping=jnp.asarray(VISCOUS))


@pytest.fixture(scope="module")
def placeholder(true_arm) -> Arm:
    return dataclasses.replace(true_arm, damping=jnp.full(7, 100.0))


def test_friction_is_that_of_the_recordings_and_not_of_the_file(true_arm, placeholder):
    shown = friction_shown([prepare(swings(true_arm, np.ones(7)), placeholder)])
    assert np.abs(100 + shown[0] - VISCOUS).max() < 0.3
    assert np.all(100 + shown[0] >= 0)
    assert np.abs(shown[1]).max() < 0.1
    exact = friction_shown([prepare(swings(true_arm, np.ones(7)), true_arm)])
    assert np.abs(exact).max() < 0.1


def test_weight_that_is_felt_late_is_no_friction(true_arm):
    """Of gravity that changes as a joint turns, a delay makes what looks like viscous friction, 2 N m s/rad here.
    Delayed with the rest, it had rotors of 0.17 kg m² beside it."""
    on_time = swings(true_arm, np.ones(7))
    assert on_time.tau is not None
    late = np.stack([np.interp(on_time.time - 0.05, on_time.time, tau) for tau in on_time.tau.T], 1)
    shown = friction_shown([prepare(dataclasses.replace(on_time, tau=late), true_arm)])
    assert np.abs(shown).max() < 0.5


def test_joints_that_hold_still_keep_the_files_friction(true_arm, placeholder):
    moves = np.array([1.0, 0, 1, 1, 0, 1, 1])
    shown = friction_shown([prepare(swings(true_arm, moves), placeholder)])
    assert np.all(shown[:, moves == 0] == 0)
    assert np.abs(100 + shown[0] - VISCOUS)[moves == 1].max() < 0.3


def test_predictions_scale_and_delay_the_torque_that_was_shown(true_arm, placeholder):
    """With the file's damping of 100 a gain of 5 % would be off by more than all of the true friction."""
    recording = swings(true_arm, np.ones(7))
    zeros, change = jnp.zeros(7), jnp.asarray(VISCOUS - 100)
    law = TorqueGain(0), TimeDelay(7, 0.02, "whole", 1)
    values = jnp.array([0.05]), jnp.array([0.02])
    corrected = Corrected(
        placeholder, jnp.zeros((7, 10)), change, zeros, law, values, friction_shown=jnp.stack([change, zeros])
    )
    again = Corrected.from_json(corrected.to_json())
    trace, tau = predicted(trajectory(recording), again)
    torque = trajectory(recording).trace(true_arm).motion.torque
    time = trace.motion.time
    late = np.interp(time - 0.02, time, torque[:, 1])
    assert np.abs(tau[:, 0] - 1.05 * torque[:, 0]).max() < 1e-6 * np.abs(torque[:, 0]).max()
    assert np.abs(tau[:, 1] - late).max() < 1e-6 * np.abs(torque[:, 1]).max()
    assert np.abs(tau[:, 2:] - torque[:, 2:]).max() < 1e-6 * np.abs(torque).max()
    unaware = dataclasses.replace(again, friction_shown=None)
    wrong = predicted(trajectory(recording), unaware)[1] - tau
    assert np.sqrt(np.mean(wrong[:, 0] ** 2)) > 0.3 * np.sqrt(
        np.mean((VISCOUS[0] * trace.motion.qd[:, 0]) ** 2)
    )


def test_a_document_without_it_is_read_and_a_wrong_one_refused(tmp_path, placeholder):
    zeros = jnp.zeros(7)
    plain = Corrected(placeholder, jnp.zeros((7, 10)), zeros, zeros, (), ())
    document = plain.to_json()
    del document["friction_shown"]
    assert Corrected.from_json(document).friction_shown is None
    document |= {"friction_shown": [[0.0] * 6] * 2, "torque_noise": [0.1] * 7}
    (tmp_path / "corrected.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match="friction_shown"):
        Corrected.load(tmp_path)
