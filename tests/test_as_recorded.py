"""Whether a prediction says of friction at rest and of fast motion what the recordings' torque showed."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

from jaxpanda import Arm, Recording
from jaxpanda.corrected import Corrected
from jaxpanda.diagnosis.as_recorded import GEAR, as_recorded, misleading, predicted
from jaxpanda.diagnosis.traces import held_sign, prepare
from jaxpanda.effects.drive import Armature
from jaxpanda.effects.friction import ViscousFriction

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
    found = as_recorded([rubbing(arm, true)], corrected, NOISE)
    assert found.turning == told
    assert Corrected.from_json(found.to_json()).turning == told


def reversing(arm: Arm, filtered: tuple[int, ...], speed: float) -> Recording:
    """Triangular swings of the Panda with sharp turns; a first-order filter forward and backward of 5 Hz on the
    torque of some joints."""
    rng, time = np.random.default_rng(5), np.arange(0, 8.0, 2e-3)
    phase = speed * time[:, None] + np.arange(7)
    q = 0.5 * np.asarray(arm.lower + arm.upper) + 0.1 * np.arcsin(0.99 * np.sin(phase))
    still = Recording("swings.csv", time, q, tau=np.zeros((len(time), 7)))
    tau = prepare(still, arm, whole=True, noise=NOISE).motion.torque
    b, a = scipy.signal.butter(1, 5.0, fs=500.0)
    for joint in filtered:
        tau[:, joint] = scipy.signal.filtfilt(b, a, tau[:, joint])
    return Recording("swings.csv", time, q, tau=tau + NOISE * rng.normal(size=q.shape))


def test_prediction_takes_no_more_of_fast_motion_than_the_torque_showed():
    """At joints whose torque was filtered, and at no other; the next motion is faster."""
    arm = Arm.panda()
    zeros = jnp.zeros(7)
    plain = Corrected(arm, jnp.zeros((7, 10)), zeros, zeros, (), ())
    found = as_recorded([reversing(arm, (1, 3), 6.0)], plain, NOISE)
    assert [cutoff is not None for cutoff in found.cutoffs] == [j in (1, 3) for j in range(7)]
    assert Corrected.from_json(found.to_json()).cutoffs == found.cutoffs
    faster = reversing(arm, (1, 3), 8.0)
    error = lambda corrected: np.std(predicted(faster, corrected, NOISE)[1] - faster.tau, axis=0)
    assert np.all(error(found)[[1, 3]] < 0.8 * error(plain)[[1, 3]])
    np.testing.assert_array_equal(np.delete(error(found), [1, 3]), np.delete(error(plain), [1, 3]))


def test_of_a_long_recording_the_beginning_is_compared(monkeypatch):
    """Friction that turns otherwise in what follows, and is stronger there, decides nothing if left out."""
    arm, zeros = dataclasses.replace(Arm.panda(), frictionloss=jnp.full(7, 0.5)), jnp.zeros(7)
    corrected = Corrected(arm, jnp.zeros((7, 10)), zeros, zeros, (), ())
    first = rubbing(arm, 0.02)
    later = rubbing(dataclasses.replace(arm, frictionloss=jnp.full(7, 5.0)), None)
    half = len(first.time) // 2
    both = dataclasses.replace(first, tau=np.concatenate([first.tau[:half], later.tau[half:]]))
    assert as_recorded([both], corrected, NOISE).turning is None
    monkeypatch.setattr("jaxpanda.diagnosis.as_recorded.LONG", float(first.time[half - 1]))
    assert as_recorded([both], corrected, NOISE).turning == GEAR


def test_torque_of_changed_links_is_that_of_the_regressor():
    arm = Arm.panda()
    motion = prepare(reversing(arm, (), 6.0), arm).motion
    change = np.random.default_rng(7).normal(size=(7, 10))
    np.testing.assert_allclose(motion.of_links(change), motion.regressor @ change.ravel(), atol=1e-9)


def test_effects_that_make_the_recordings_own_torque_worse_are_named():
    """An armature that is not there follows the sharp turns; damping that is there stays beside it."""
    arm = dataclasses.replace(Arm.panda(), damping=jnp.full(7, 0.5))
    recording, zeros = reversing(arm, (), 6.0), jnp.zeros(7)
    lacking = Corrected(Arm.panda(), jnp.zeros((7, 10)), zeros, zeros, (), ())
    damped = tuple(ViscousFriction(j) for j in range(7)), (jnp.array([0.5]),) * 7
    right = dataclasses.replace(lacking, effects=damped[0], coefficients=damped[1])
    assert misleading([recording], right, NOISE, 7) == set()
    wrong = dataclasses.replace(
        right,
        effects=(*damped[0], Armature(5, "signed")),
        coefficients=(*damped[1], jnp.array([0.02])),
    )
    assert misleading([recording], wrong, NOISE, 8) == {7}
    assert misleading([recording], wrong, NOISE, 1) == {0}
    assert misleading([recording], lacking, NOISE, 0) == set()
