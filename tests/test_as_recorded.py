"""Whether a prediction says of friction at rest and of fast motion what the recordings' torque showed."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

from jaxpanda import Arm, Recording
from jaxpanda.corrected import Corrected, Recorded
from jaxpanda.effects import Turn
from jaxpanda.effects.drive import Armature
from jaxpanda.effects.effect import EVER
from jaxpanda.effects.friction import FrictionDrift, ViscousFriction
from jaxpanda.effects.load import PayloadChange
from jaxpanda.effects.sensing import TorqueDrift
from jaxpanda.prediction.as_recorded import as_recorded, misleading
from jaxpanda.prediction.predict import predicted
from jaxpanda.traces import held_sign, prepare, trajectory

NOISE, JUDGED = np.full(7, 0.02), [True] * 7


SPEED, BRISTLES = Turn("speed", 0.01), Turn("distance", 1.5e-3)


def rubbing(arm: Arm, turns: Sequence[Turn | None]) -> Recording:
    """Slow swings of the Panda, the friction of each joint turning in its way."""
    rng, time = np.random.default_rng(3), np.arange(0, 8.0, 2e-3)
    phase = 0.7 * time[:, None] + np.arange(7)
    qd = 0.05 * np.cos(phase)
    q = 0.5 * np.asarray(arm.lower + arm.upper) + 0.05 / 0.7 * np.sin(phase)
    frictionless = dataclasses.replace(arm, frictionloss=jnp.zeros(7))
    still = Recording("slow.csv", time, q, tau=np.zeros((len(time), 7)))
    load = trajectory(still).trace(frictionless).motion.torque
    sign = held_sign(arm, qd, -0.05 * 0.7 * np.sin(phase), np.full(7, 1e-6))
    for joint, turn in enumerate(turns):
        if turn == SPEED:
            sign[:, joint] = np.tanh(qd[:, joint] / 0.01)
        elif turn == BRISTLES:
            sign[:, joint] = dahl(q[:, joint], 1.5e-3, np.sign(qd[0, joint]))
    tau = load + np.asarray(arm.frictionloss) * sign + NOISE * rng.normal(size=q.shape)
    return Recording("slow.csv", time, q, tau=tau)


def dahl(q: np.ndarray, distance: float, z: float) -> np.ndarray:
    """Bristles by small steps of dz = (sign(dq) - z) |dq| / distance."""
    out = [z]
    for moved in np.diff(q):
        for _ in range(20):
            z += (np.sign(moved) - z) * abs(moved) / 20 / distance
        out.append(z)
    return np.array(out)


@pytest.mark.parametrize("turns", [(), (SPEED,) * 7, (BRISTLES, SPEED, None) * 2 + (BRISTLES,)])
def test_friction_of_the_model_turns_in_predictions_as_it_did_in_the_recordings(turns):
    """Each joint's in its own way; the prediction is then right to the noise."""
    arm = dataclasses.replace(Arm.panda(), frictionloss=jnp.full(7, 0.5))
    corrected = Corrected.of(arm)
    recording = rubbing(arm, turns)
    found = as_recorded([trajectory(recording)], corrected, JUDGED)
    assert found.turns == turns
    assert Corrected.from_json(found.to_json()).turns == turns
    error = predicted(trajectory(recording), found)[1] - recording.tau
    assert np.all(np.std(error, axis=0) < 1.1 * NOISE)
    # of joints that differ none tells of another
    of_arm = turns[0] if len(set(turns)) == 1 else None
    unheard = as_recorded([trajectory(recording)], corrected, [j != 1 for j in range(7)]).turns
    assert unheard == ((turns[0], of_arm, *turns[2:]) if turns else ())


def test_bristles_that_the_joints_of_an_arm_show_together_are_those_of_one_whose_noise_hides_them():
    arm = dataclasses.replace(Arm.panda(), frictionloss=jnp.full(7, 0.5))
    recording = rubbing(arm, (BRISTLES,) * 7)
    noisy = 20.0 * np.random.default_rng(5).normal(size=recording.q.shape) * np.eye(7)[4]
    heard = dataclasses.replace(recording, tau=recording.tau + noisy)
    alone = as_recorded([trajectory(heard)], Corrected.of(arm), [j == 4 for j in range(7)])
    assert alone.turns == ()
    assert as_recorded([trajectory(heard)], Corrected.of(arm), JUDGED).turns == (BRISTLES,) * 7


def test_bristles_that_one_moment_shows_and_the_rest_of_a_recording_does_not_are_not_taken():
    """In sum they are nearer; a motion with other moments had been predicted worse with them."""
    rng, time = np.random.default_rng(7), np.arange(0, 12.0, 2e-3)
    arm = dataclasses.replace(Arm.panda(), frictionloss=jnp.zeros(7).at[2].set(0.5))
    shakes = (time > 4.2) & (time < 5.8)
    qd = np.where(shakes, 0.06 * np.sin(2 * np.pi * 2.5 * (time - 4.2)), 0.01)
    q = np.tile(0.5 * np.asarray(arm.lower + arm.upper), (len(time), 1))
    q += 0.05 * np.cos(0.7 * time[:, None] + np.arange(7))
    q[:, 2] = 2e-3 * np.cumsum(qd)
    still = Recording("shaken.csv", time, q, tau=np.zeros_like(q))
    tau = trajectory(still).trace(dataclasses.replace(arm, frictionloss=jnp.zeros(7))).motion.torque
    tau[:, 2] += 0.5 * np.where(shakes, dahl(q[:, 2], 1.5e-3, 1.0), np.tanh(qd / 0.01))
    moved = [trajectory(dataclasses.replace(still, tau=tau + NOISE * rng.normal(size=q.shape)))]
    corrected = Corrected.of(arm)
    turning = lambda turn: dataclasses.replace(corrected, turns=(None, None, turn, *[None] * 4))
    error = [np.std((predicted(moved[0], turning(turn))[1] - tau)[:, 2]) for turn in (SPEED, BRISTLES)]
    assert error[1] < 0.9 * error[0]
    assert as_recorded(moved, corrected, JUDGED).turns[2] == SPEED


def test_a_speed_over_which_friction_turns_in_all_joints_is_still_read():
    """As earlier versions wrote it."""
    document = Corrected.of(Arm.panda()).to_json()
    del document["turns"]
    assert Corrected.from_json({**document, "turning": 0.01}).turns == (SPEED,) * 7
    assert Corrected.from_json({**document, "turning": None}).turns == ()


def reversing(arm: Arm, filtered: tuple[int, ...], speed: float) -> Recording:
    """Triangular swings of the Panda with sharp turns; a first-order filter forward and backward of 5 Hz on the
    torque of some joints."""
    rng, time = np.random.default_rng(5), np.arange(0, 8.0, 2e-3)
    phase = speed * time[:, None] + np.arange(7)
    q = 0.5 * np.asarray(arm.lower + arm.upper) + 0.1 * np.arcsin(0.99 * np.sin(phase))
    still = Recording("swings.csv", time, q, tau=np.zeros((len(time), 7)))
    tau = trajectory(still).trace(arm).motion.torque
    b, a = scipy.signal.butter(1, 5.0, fs=500.0)
    for joint in filtered:
        tau[:, joint] = scipy.signal.filtfilt(b, a, tau[:, joint])
    return Recording("swings.csv", time, q, tau=tau + NOISE * rng.normal(size=q.shape))


def test_prediction_takes_no_more_of_fast_motion_than_the_torque_showed():
    """At joints whose torque was filtered, and at no other; the next motion is faster."""
    arm = Arm.panda()
    plain = Corrected.of(arm)
    found = as_recorded([trajectory(reversing(arm, (1, 3), 6.0))], plain, JUDGED)
    assert [cutoff is not None for cutoff in found.cutoffs] == [j in (1, 3) for j in range(7)]
    assert Corrected.from_json(found.to_json()).cutoffs == found.cutoffs
    faster = reversing(arm, (1, 3), 8.0)
    error = lambda corrected: np.std(predicted(trajectory(faster), corrected)[1] - faster.tau, axis=0)
    assert np.all(error(found)[[1, 3]] < 0.8 * error(plain)[[1, 3]])
    np.testing.assert_array_equal(np.delete(error(found), [1, 3]), np.delete(error(plain), [1, 3]))


@pytest.mark.parametrize(
    ("judged", "others_are"), [((1,), True), ((0, 1, 3), True), ((0, 1, 2), False), ((), False)]
)
def test_torque_of_a_joint_that_was_not_judged_is_filtered_as_it_shows_or_as_that_of_most_others(
    judged, others_are
):
    """The iiwa's joints that rest while one moves fast showed less of that than its own torque did."""
    arm = Arm.panda()
    plain = Corrected.of(arm)
    swings = trajectory(reversing(arm, (1, 3), 6.0))
    found = as_recorded([swings], plain, [j in judged for j in range(7)])
    below = found.cutoffs or (None,) * 7
    assert [cutoff is not None for cutoff in below] == [
        j in (1, 3) or (j not in judged and others_are) for j in range(7)
    ]
    if others_are:
        assert below[6] in (below[1], below[3])


def test_of_a_long_recording_the_beginning_is_compared(monkeypatch):
    """Friction that turns otherwise in what follows, and is stronger there, decides nothing if left out."""
    arm = dataclasses.replace(Arm.panda(), frictionloss=jnp.full(7, 0.5))
    corrected = Corrected.of(arm)
    first = rubbing(arm, (SPEED,) * 7)
    later = rubbing(dataclasses.replace(arm, frictionloss=jnp.full(7, 5.0)), ())
    half = len(first.time) // 2
    both = dataclasses.replace(first, tau=np.concatenate([first.tau[:half], later.tau[half:]]))
    assert as_recorded([trajectory(both)], corrected, JUDGED).turns != (SPEED,) * 7
    monkeypatch.setattr("jaxpanda.prediction.as_recorded.LONG", float(first.time[half - 1]))
    assert as_recorded([trajectory(both)], corrected, JUDGED).turns == (SPEED,) * 7


def test_torque_of_changed_links_is_that_of_the_regressor():
    arm = Arm.panda()
    motion = prepare(reversing(arm, (), 6.0), arm).motion
    change = np.random.default_rng(7).normal(size=(7, 10))
    np.testing.assert_allclose(motion.of_links(change), motion.regressor @ change.ravel(), atol=1e-9)


def test_effects_that_make_the_recordings_own_torque_worse_are_named():
    """An armature that is not there follows the sharp turns; damping that is there stays beside it."""
    arm = dataclasses.replace(Arm.panda(), damping=jnp.full(7, 0.5))
    recording = reversing(arm, (), 6.0)
    lacking = Corrected.of(Arm.panda())
    damped = tuple(ViscousFriction(j) for j in range(7)), (jnp.array([0.5]),) * 7
    right = dataclasses.replace(lacking, effects=damped[0], coefficients=damped[1])
    assert misleading([trajectory(recording)], right, 7) == set()
    wrong = dataclasses.replace(
        right,
        effects=(*damped[0], Armature(5, "signed")),
        coefficients=(*damped[1], jnp.array([0.02])),
    )
    assert misleading([trajectory(recording)], wrong, 8) == {7}
    assert misleading([trajectory(recording)], wrong, 1) == {0}
    assert misleading([trajectory(recording)], lacking, 0) == set()


def test_what_happened_in_a_recording_is_judged_where_it_happened():
    """A body taken up late was taken for one that had been there all along, and so left out of the model."""
    arm = Arm.panda()
    slow = rubbing(arm, ())
    assert slow.tau is not None
    effect, c = PayloadChange(6, 6.0, EVER, "slow.csv", "gained"), np.eye(10)[0]
    links = np.concatenate([np.zeros((6, 10)), (effect.body @ c)[None]])
    weight = trajectory(slow).trace(arm).motion.of_links(links)
    taken_up = dataclasses.replace(slow, tau=slow.tau + np.where(slow.time < 6.0, 0.0, 1.0)[:, None] * weight)
    late = dataclasses.replace(slow, name="late.csv", time=slow.time + 20.0, tau=slow.tau + weight)
    early = dataclasses.replace(slow, name="early.csv", time=slow.time - 20.0)
    found = dataclasses.replace(Corrected.of(arm), effects=(effect,), coefficients=(jnp.asarray(c),))
    whole = [trajectory(one) for one in (early, taken_up, late)]
    assert misleading(whole, found, 1) == set()
    for one, names in zip(
        whole, (["early.csv"], ["early.csv", "slow.csv"], ["slow.csv", "late.csv"]), strict=True
    ):
        trace, torque = predicted(one, found, names)
        away = np.abs(trace.motion.time - 6.0) > 0.3  # a low-pass rounds the step
        assert np.all(np.std((trace.tau - torque)[away], axis=0) < 1.1 * NOISE)


def test_a_motion_whose_clock_is_its_own_comes_after_the_recordings():
    """A drift that had settled began anew with it; a motion by the recordings' clock keeps its time."""
    first = rubbing(Arm.panda(), ())
    at = lambda start, q=first.q: dataclasses.replace(first, time=first.time + start, q=q)
    recorded = Recorded.of([at(0.0), at(20.0)])
    assert (recorded.start, recorded.stop) == (0.0, 20.0 + first.time[-1])
    assert Recorded.from_json(dataclasses.asdict(recorded)) == recorded
    other = first.q + 1e-3
    np.testing.assert_allclose(recorded.after(at(5.0, other)).time, first.time + recorded.stop)
    for own in (at(20.0), at(40.0, other), at(-9.0, other)):
        assert recorded.after(own) is own
    assert Recorded.of([at(0.0), at(3.0)]) is None
    logged, designed = Recorded.of([at(1.7e9)]), at(0.0, other)
    assert logged is not None
    np.testing.assert_allclose(logged.after(designed).time, first.time + logged.stop)
    for own in (at(1.7e9 - 60), at(1.7e9 + 60)):
        assert logged.after(own) is own


def test_friction_goes_on_from_what_it_had_come_to_and_a_sensor_is_tared():
    """In a motion with a clock of its own; the recording itself is predicted by its own time."""
    arm = Arm.panda()
    recording = rubbing(arm, ())
    channels = [prepare(recording, arm).channels]
    bias = TorqueDrift(2, 1.0, "extra").beyond(channels)
    warmth = FrictionDrift(0, 1.0, 0.001, "level extra").beyond(channels)
    drifting = (bias, warmth), (jnp.array([2.0]), jnp.array([3.0]))
    found = dataclasses.replace(Corrected.of(arm), effects=drifting[0], coefficients=drifting[1])
    found = as_recorded([trajectory(recording)], found, JUDGED)
    plain = dataclasses.replace(found, effects=(), coefficients=())
    for q, sensor, friction in ((recording.q, 0.0, 0.0), (recording.q + 1e-3, 0.0, 3.0)):
        arms = [one.for_motion(dataclasses.replace(recording, q=q)) for one in (found, plain)]
        shown = [predicted(trajectory(motion), one)[1] for one, motion in arms]
        changed = (shown[0] - shown[1])[1]
        assert changed[2] == pytest.approx(sensor, abs=0.02)
        assert changed[0] == pytest.approx(friction, abs=0.05)
    end = predicted(trajectory(recording), found)[1] - predicted(trajectory(recording), plain)[1]
    assert end[-1, 2] == pytest.approx(2.0, abs=0.01)
