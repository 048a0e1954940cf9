"""The corrected simulation: the same in both engines, stable, true to its laws, and nearer to the recorded arm.

Recordings come from MuJoCo's C engine: the project's virtual arm, and the concealed trial, which share no code
with what is tested.
"""

import dataclasses
import json
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from jaxpanda import Arm, InputError, rollout
from jaxpanda.arms import markup
from jaxpanda.arms.mjcf import move_standard
from jaxpanda.arms.source import from_document
from jaxpanda.corrected import Corrected, Plant
from jaxpanda.effects.contact import ExternalContact
from jaxpanda.effects.drive import Backlash, JointElasticity
from jaxpanda.effects.friction import CoulombFriction, LoadDependentFriction
from jaxpanda.effects.load import Payload, PayloadChange
from jaxpanda.effects.memory import PreslidingHysteresis
from jaxpanda.effects.sensing import EncoderOffset, TorqueOffset
from jaxpanda.effects.stribeck import StribeckFriction
from jaxpanda.effects.unknown import (
    Unknown,
    UnknownAt,
    UnknownDrag,
    UnknownLimit,
    UnknownOfSpeeds,
    UnknownOfTwo,
    UnknownShaking,
    UnknownSpin,
)
from jaxpanda.recordings import Recording, save
from jaxpanda.simulation import JointFriction, Sensors, fourier_trajectory, simulate

TWO = """<mujoco><option timestep="0.002"/><worldbody><body name="upper" pos="0 0 0.3">
  <joint name="shoulder" axis="0 1 0" damping="0.4" frictionloss="{loss}"/>
  <inertial pos="0.2 0.01 -0.1" mass="3" fullinertia="0.05 0.06 0.04 0.001 0.002 -0.003"/>
  <body name="fore" pos="0.4 0 0" euler="10 20 30"><joint name="elbow" axis="0 1 0.2"/>
    <geom type="capsule" size="0.04" fromto="0 0 0 0.3 0 0" mass="1.2"/></body></body></worldbody></mujoco>"""
EVER = 1e9


def two_links(loss: float = 0.0):
    return from_document(markup.parse(TWO.format(loss=loss), "mujoco", Path("two.xml")))


def corrected(arm: Arm, *effects) -> Corrected:
    zeros = jnp.zeros(arm.dof)
    kinds, numbers = zip(*effects, strict=True) if effects else ((), ())
    coefficients = tuple(jnp.asarray(c, float) for c in numbers)
    return Corrected(arm, jnp.zeros((arm.dof, 10)), zeros, zeros, tuple(kinds), coefficients)


def every_kind(arm: Arm) -> Corrected:
    """An arm with a law of every sort, sensors included."""
    body = [0.4, 0.0, 0.0, 0.02, 0.002, 0.0, 0.002, 0.0, 0.0, 0.002]
    return corrected(
        arm,
        (StribeckFriction(0, 0.1, 0.01, 1.5, "whole"), [0.3, 0.3]),
        (PreslidingHysteresis(1, 0.01, "dahl extra"), [0.2]),
        (LoadDependentFriction(1, 0.02, 1.1, "coulomb"), [0.03, 0.1]),
        (Unknown(0, 1, (-1.0, 0.0, 1.0), "of q_k"), [0.2, -0.1, 0.1]),
        (UnknownOfTwo(1, 0, (-1.0, -1.0), (1.0, 1.0)), [0.02 * k for k in range(10)]),
        (UnknownOfSpeeds(0, 1, 0, 0.5), [0.2]),
        (UnknownDrag(arm.dof, 0.1, (0.1, 0.5)), [0.2, 1.0]),
        (UnknownSpin(arm.dof), [0.02, -0.01, 0.03]),
        (UnknownShaking(arm.dof, ("b.csv", "a.csv"), 3.0), [0.0] * 6 + [0.1, 0.3, -0.2, 0.2, 0.0, 0.1]),
        (UnknownAt(0, 0.2, 0.1), [0.1, -0.2, 0.2]),
        (PayloadChange(1, 1.0, EVER, "a.csv", "gained"), body),
        (ExternalContact(1, 0.7, 1.2, "a.csv", "point base", (0.1, 0.0, 0.0)), [3.0, 0.0, 5.0]),
        (JointElasticity(0, 800.0, 0.2), [1 / 800]),
        (Backlash(1, 0.004, 1e4), [0.004]),
        (EncoderOffset(1, 0.02), [0.03]),
        (TorqueOffset(0), [0.4]),
        (UnknownLimit(1, 0.5), [0.8]),
    )


@pytest.fixture(scope="module")
def moved() -> Recording:
    _, source = two_links()
    motion = fourier_trajectory([[1.0, -0.6], [0.5, 0.9]], [[0.4, 0.8], [-1.0, 0.7]], [0.3, -0.2], 1.7)
    friction = JointFriction(coulomb=np.array([1.5, 0.8]), width=0.01)
    sensors = Sensors(torque_noise=0.01, position_noise=1e-6)
    return simulate(
        source.model, motion, duration=4.0, rate=500.0, friction=friction, sensors=sensors, name="a.csv"
    )


def test_a_simulation_that_runs_away_leaves_nothing_where_it_was_called(moved, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    wild = dataclasses.replace(moved, tau=moved.tau + 5e8)
    arm, source = two_links()
    with pytest.raises(InputError, match="ran away"):
        rollout.replay(corrected(arm), wild, model=source)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_forward_dynamics_undoes_inverse_dynamics_for_every_law():
    arm = every_kind(two_links(0.3)[0])
    plant = arm.plant("a.csv")
    q, qd, qdd = jnp.array([0.4, -0.7]), jnp.array([0.05, -0.4]), jnp.array([2.0, -3.0])

    @jax.jit
    def there_and_back(t):
        memory, _ = plant.begin(t, q, qd, jnp.zeros(2))
        tau = plant.inverse_dynamics(memory, t, q, qd, qdd, 1e-3)
        return tau, plant.acceleration(memory, t, q, qd, tau, 1e-3, jnp.zeros(2), iterations=4)

    before, during, after = (there_and_back(jnp.asarray(t)) for t in (0.3, 1.0, 2.0))
    for _, back in (before, during, after):
        np.testing.assert_allclose(back, qdd, atol=1e-9)
    assert np.abs(before[0] - during[0]).max() > 0.1  # what happens in the recording is in it
    back = jax.jit(lambda: arm.forward_dynamics(q, qd, arm.inverse_dynamics(q, qd, qdd)))()
    np.testing.assert_allclose(back, qdd, atol=1e-9)


def test_forward_dynamics_is_differentiable_in_what_was_found():
    arm, _ = two_links()
    q, qd, tau = jnp.array([0.4, -0.7]), jnp.array([0.05, -0.4]), jnp.array([9.0, 2.0])

    @jax.jit
    def acceleration(x):
        found = corrected(
            arm, (StribeckFriction(0, x[0], 0.01, 1.5, "extra"), x[1:2]), (CoulombFriction(1, 0.01), x[2:])
        )
        return found.forward_dynamics(q, qd, tau)

    x, h = jnp.array([0.1, 0.3, 0.2]), 1e-6
    slope = jax.jit(jax.jacfwd(acceleration))(x)
    for k in range(3):
        step = h * jnp.eye(3)[k]
        expected = (acceleration(x + step) - acceleration(x - step)) / (2 * h)
        np.testing.assert_allclose(slope[:, k], expected, atol=1e-5 * np.abs(slope).max())


@pytest.mark.slow
def test_the_engines_agree_on_every_law_at_once(moved):
    arm, source = two_links(0.3)
    one, other = (
        rollout.replay(every_kind(arm), moved, model=source, engine=engine, seconds=1.5, start=0.6)
        for engine in ("mujoco", "mjx")
    )
    assert np.abs(one.q - one.q_recorded).max() > 1e-3  # they went somewhere of their own
    np.testing.assert_allclose(one.q, other.q, atol=1e-8)
    np.testing.assert_allclose(one.tau, other.tau, atol=1e-6)


@pytest.mark.slow
def test_a_roll_out_in_mjx_is_differentiable_in_a_law(moved):
    arm, source = two_links()
    plant = corrected(arm, (StribeckFriction(0, 0.1, 0.05, 1.0, "extra"), [0.5])).plant()
    bare = rollout.engine_model(source, plant.arm)
    task = rollout.make_task(moved, bare.opt.timestep, plant, 0.1, 1.0)
    gains, run = rollout.make_gains(moved, arm), rollout.mjx_rollout(bare)
    law = plant.laws[0][0]

    def end(c):
        return run(Plant.of(arm, arm, [(law, c[None])]), gains, task)[0][-1]

    c, h = jnp.asarray(0.5), 1e-5
    both = rollout.jit_mjx(jax.vmap(end))(jnp.array([c - h, c + h]))
    slope = rollout.jit_mjx(jax.jacfwd(end))(c)
    assert abs(float(slope[0])) > 1e-5
    np.testing.assert_allclose(slope, (both[1] - both[0]) / (2 * h), rtol=1e-5, atol=1e-9)


def test_a_joint_held_by_dry_friction_creeps_and_does_not_chatter():
    """Its slope at rest, 1 N m over 2 mrad/s on 1e-3 kg m², is 500 times what an explicit step of 2 ms bears."""
    text = """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody><body><joint name="j" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="1" diaginertia="1e-3 1e-3 1e-3"/></body></worldbody></mujoco>"""
    arm, source = from_document(markup.parse(text, "mujoco", Path("one.xml")))
    plant = corrected(arm, (StribeckFriction(0, 0.1, 0.002, 1.0, "whole"), [1.0, 0.0])).plant()
    time = jnp.arange(200) * 0.002
    hold, zero = jnp.full((200, 1), 0.5), jnp.zeros((200, 1))
    task, gains = rollout.Task(time, zero, zero, hold), rollout.Gains(jnp.zeros(1), jnp.zeros(1))
    q = rollout.in_mujoco(rollout.engine_model(source, plant.arm), plant, gains, task)[0]
    speed = np.diff(q[:, 0]) / 0.002
    assert (speed[1:] > 0).all()
    np.testing.assert_allclose(speed[50:], 0.002 * np.arctanh(0.5), rtol=1e-3)


def test_the_engine_s_model_has_the_numbers_of_the_arm():
    arm, source = two_links(0.2)
    found = corrected(arm, (Payload(1), [0.7, 0.02, 0.01, 0.03, 0.004, 0.0, 0.003, 0.0, 0.001, 0.002]))
    model = rollout.engine_model(source, found.native)
    data = mujoco.MjData(model)
    data.qpos, data.qvel, data.qacc = [0.3, -0.8], [0.5, 1.0], [-2.0, 4.0]
    model.dof_frictionloss[:] = 0
    mujoco.mj_inverse(model, data)
    rigid = found.native.inverse_dynamics(
        jnp.array([0.3, -0.8]), jnp.array([0.5, 1.0]), jnp.array([-2.0, 4.0])
    )
    np.testing.assert_allclose(data.qfrc_inverse, rigid - found.native.frictionloss, atol=1e-9)


def test_a_link_that_cannot_be_leaves_nothing_where_it_was_called(tmp_path, monkeypatch):
    """MuJoCo's warning of its inertia went to the terminal and into MUJOCO_LOG.TXT there."""
    monkeypatch.chdir(tmp_path)
    arm, source = two_links()
    less = jnp.asarray(move_standard(-source.standard[1], np.eye(3), np.zeros(3))).at[0].set(-1e-9)
    rollout.engine_model(source, eqx.tree_at(lambda a: a.standard, arm, arm.standard.at[1].add(less)))
    assert not list(tmp_path.iterdir())


def test_a_body_is_taken_up_and_a_push_is_felt_in_the_recording_they_happened_in(moved):
    arm, source = two_links()
    found = corrected(arm, (ExternalContact(1, 1.6, 2.0, "a.csv", "base"), [0.0, 0.0, -20.0, 0.0, 0.0, 0.0]))
    here = rollout.replay(found, moved, model=source, seconds=2.0)
    assert here.time[0] < 1.6
    assert here.time[-1] > 2.0
    nothing = rollout.replay(corrected(arm), moved, model=source, seconds=2.0, start=float(here.time[0]))
    apart = np.abs(here.q - nothing.q).max(1)
    assert apart[here.time < 1.5].max() < 1e-5  # rounding, which grows in an arm that nothing holds
    assert apart[(here.time > 1.7) & (here.time < 2.0)].min() > 1e-3


@pytest.mark.parametrize(("folder", "felt"), [("monday", True), ("tuesday", False)])
def test_a_push_is_felt_in_the_one_of_two_recordings_of_one_name(moved, tmp_path, folder, felt):
    arm, source = two_links()
    push = ExternalContact(1, 1.6, 2.0, "monday/a.csv", "base"), [0.0, 0.0, -20.0, 0.0, 0.0, 0.0]
    (tmp_path / folder).mkdir()
    save(moved, tmp_path / folder / "a.csv")
    found = rollout.replay(
        corrected(arm, push), tmp_path / folder / "a.csv", model=source, seconds=1.0, start=1.2
    )
    nothing = rollout.replay(corrected(arm), moved, model=source, seconds=1.0, start=float(found.time[0]))
    assert (np.abs(found.q - nothing.q).max() > 1e-3) == felt


def test_the_right_friction_brings_the_simulation_to_the_recorded_motion(moved):
    arm, source = two_links()
    laws = [(StribeckFriction(j, 0.1, 0.01, 1.0, "whole"), [level, 0.0]) for j, level in ((0, 1.5), (1, 0.8))]
    result = rollout.compare(corrected(arm, *laws), source, moved)
    before, after = np.array(result["rmse_rad_before"]), np.array(result["rmse_rad_after"])
    assert (after < 0.1 * before).all()
    assert (np.array(result["rmse_rad_per_s_after"]) < 0.3 * np.array(result["rmse_rad_per_s_before"])).all()
    assert json.dumps(result)


def test_what_sensors_add_is_undone_and_put_back(moved):
    """A recording with an offset of torque and position replays like the one without."""
    arm, source = two_links()
    assert moved.tau is not None
    found = corrected(arm, (TorqueOffset(0), [2.0]), (EncoderOffset(1, 0.05), [-0.05]))
    angle, torque = np.array([0.0, 0.05]), np.array([2.0, 0.0])
    wrong = Recording("b.csv", moved.time, moved.q + angle, tau=moved.tau + torque)
    gains = rollout.make_gains(moved, arm)
    done = []
    for name, arm_, recording in (("true", corrected(arm), moved), ("wrong", found, wrong)):
        plant = arm_.plant(name)
        bare = rollout.engine_model(source, plant.arm)
        task = rollout.make_task(recording, bare.opt.timestep, plant, 2.0, 0.0)
        done.append(rollout._replay(bare, plant, task, gains, name, "mujoco"))
    np.testing.assert_allclose(done[1].q, done[0].q + angle, atol=1e-9)
    np.testing.assert_allclose(done[1].tau, done[0].tau + torque, atol=1e-9)


def test_feedback_damps_no_more_than_an_explicit_step_bears(moved):
    arm, dt = two_links()[0], 0.002
    light = eqx.tree_at(lambda a: (a.standard, a.armature), arm, (1e-4 * arm.standard, 1e-4 * arm.armature))
    gains = rollout.make_gains(moved, arm)
    np.testing.assert_array_equal(rollout.stable(gains, moved, arm, dt).damping, gains.damping)
    fastest = []
    for some in (gains, rollout.stable(gains, moved, light, dt)):
        rates = np.linalg.solve(rollout.masses(light, moved.q[::50]), np.diag(some.damping)[None])
        fastest.append(dt * np.abs(np.linalg.eigvals(rates)).max())
    assert fastest[0] > 2 > 1 >= fastest[1]


def test_bad_calls_say_what_would_work(moved, tmp_path):
    arm = two_links()[0]
    with pytest.raises(InputError, match="model="):
        rollout.replay(corrected(arm), moved)
    with pytest.raises(InputError, match=r"corrected\.json"):
        rollout.replay(tmp_path, moved)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "share"), [("Stribeck", 0.65), ("Presliding", 0.65), ("PayloadChange", 0.4), ("Elasticity", 0.9)]
)
def test_a_concealed_effect_s_own_numbers_bring_the_simulation_to_the_recorded_motion(kind, share, tmp_path):
    """The trial's plant moves; the law of the catalogue with the true numbers has to follow it.

    A replay under recorded torque, noise and all, is some milliradians off where nothing is missing.
    """
    folder = Path(__file__).parents[1] / "experiments" / "concealed"
    sys.path.insert(0, str(folder))
    import cases
    import effects

    sys.path.remove(str(folder))
    case = cases.Case((900, 11, 0), cases.Plan("single", (getattr(effects, kind),), ("strong",), "clean"))
    truth = case.write(tmp_path)
    (entry,) = truth["effects"]
    number = {p["name"]: p["value"] for p in entry["parameters"]}
    joint, name = entry["joints"][0] - 1, f"train_{case.records - 1}.csv"
    if kind == "Stribeck":
        shape = StribeckFriction(joint, number["stribeck_velocity"], 0.005, number["exponent"], "whole")
        found = shape, [number["coulomb"], number["static"] - number["coulomb"]]
    elif kind == "Presliding":
        found = PreslidingHysteresis(joint, number["breakaway_distance"], "dahl only"), [number["coulomb"]]
    elif kind == "Elasticity":
        found = JointElasticity(joint, number["stiffness"], 0.15), [1 / number["stiffness"]]
    else:
        m, com = number["mass"], np.array([number[f"com_{axis}"] for axis in "xyz"]) + np.array([0, 0, 0.107])
        I = m * (com @ com * np.eye(3) - np.outer(com, com))
        phi = np.concatenate([[m], m * com, [I[0, 0], I[0, 1], I[1, 1], I[0, 2], I[1, 2], I[2, 2]]])
        start, stop = entry["intervals"][0]
        shape = PayloadChange(6, start, stop, name, "carried")
        found = shape, np.linalg.solve(shape._basis[0], phi)
    from jaxpanda import load
    from jaxpanda.arms.source import from_mjcf

    arm, source = from_mjcf(tmp_path / "model.xml")
    result = rollout.compare(corrected(arm, found), source, load(tmp_path / name))
    before, after = (np.linalg.norm(result[f"rmse_rad_{when}"]) for when in ("before", "after"))
    assert after < share * before


@pytest.mark.parametrize("laws", [(), ((CoulombFriction(0, 0.05), [0.3]),)])
def test_a_simulation_that_runs_away_ends_there_and_is_told(moved, laws, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves MUJOCO_LOG.TXT
    arm, source = two_links()
    wild = dataclasses.replace(moved, tau=5e8 * np.sign(moved.tau))
    compared = rollout.compare(corrected(arm, *laws), source, wild)
    assert compared["rmse_rad_before"] is None
    assert compared["rmse_rad_after"] is None
