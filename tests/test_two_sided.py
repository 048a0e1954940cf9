"""Torque before and behind the drives: what acts on which side is found on that side, and predicted there."""

import dataclasses

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers import excitation, result

from jaxpanda import Arm, Corrected, Recording, compare, draw_ensemble, replay
from jaxpanda.__main__ import main
from jaxpanda.arms.export import panda_mjcf
from jaxpanda.diagnosis import Diagnosis, TwoSided, diagnose, predict_sides
from jaxpanda.diagnosis.resting import AtRest
from jaxpanda.errors import InputError
from jaxpanda.recordings import load, save

SECONDS, RATE = 12.0, 200.0
NOISE = 0.03
"""Of tau; of tau_motor twice that [N m]."""
COULOMB = np.array([0.8, 0.0, 0.0, 0.0, 0.0, 0.35, 0.0])
VISCOUS = np.array([1.5, 0.0, 0.0, 0.0, 0.0, 0.6, 0.0])
ROTORS = np.array([0.6, 0.0, 0.0, 0.0, 0.0, 0.2, 0.0])
LOSSY = np.flatnonzero(COULOMB)
"""Joints whose drives lose torque; two, as the time of a diagnosis grows with what is missing."""
ARM = Arm.panda()
LOAD = 1.2
"""Of the body at the flange [kg]."""


def way(t: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A motion twice as wide as `excitation`, about the middle of the range."""
    q, qd, qdd = excitation(ARM, t, seed)
    return 2 * q - 0.5 * np.asarray(ARM.lower + ARM.upper), 2 * qd, 2 * qdd


def engine(load: float = 0.0) -> mujoco.MjModel:
    """The project's Panda in MuJoCo, with a body at its end."""
    spec = mujoco.MjSpec.from_string(panda_mjcf())
    if load:
        body = spec.bodies[-1].add_body(name="load", pos=[0.02, 0.01, 0.15])
        body.mass, body.inertia, body.ipos, body.explicitinertial = load, [0.003] * 3, [0, 0, 0], True
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    return spec.compile()


def measured(
    seed: int, *, load: float = 0.0, drive: bool = True, offset: float = 0.0, gain: float = 1.0
) -> Recording:
    """A motion with the torque of both sides: MuJoCo's of the links, and what the drives lose on top of it."""
    rng, model = np.random.default_rng(seed), engine(load)
    t = np.arange(int(SECONDS * RATE)) / RATE
    q, qd, qdd = way(t, seed)
    data, tau = mujoco.MjData(model), np.zeros_like(q)
    for i in range(len(t)):
        data.qpos[:7], data.qvel[:7], data.qacc[:7] = q[i], qd[i], qdd[i]
        mujoco.mj_inverse(model, data)
        tau[i] = data.qfrc_inverse[:7]
    lost = COULOMB * np.tanh(qd / 0.005) + VISCOUS * qd + ROTORS * qdd
    motor = gain * (tau + lost * drive) + 2 * NOISE * rng.normal(size=q.shape)
    shown = tau + NOISE * rng.normal(size=q.shape)
    shown[:, 1] += offset
    return Recording(
        f"both_{seed}.csv", t, q + 2e-6 * rng.normal(size=q.shape), qd=qd, tau=shown, tau_motor=motor
    )


@pytest.fixture(scope="module")
def loaded(tmp_path_factory):
    """A load behind the drives, friction and rotors in them, by the command; and a later motion predicted."""
    folder = tmp_path_factory.mktemp("both")
    save(measured(1, load=LOAD), folder / "rec.csv")
    save(measured(2, load=LOAD), folder / "later.csv")
    (folder / "arm.xml").write_text(panda_mjcf())
    model, recording, out = (str(folder / name) for name in ("arm.xml", "rec.csv", "why"))
    assert main(["diagnose", "--model", model, "--recording", recording, "--out", out]) == 0
    command = ["predict", "--diagnosis", out, "--recording", str(folder / "later.csv")]
    assert main([*command, "--out", str(folder / "tau.csv")]) == 0
    return folder


@pytest.mark.slow
def test_each_cause_is_found_on_its_side_of_the_drives(loaded):
    document = result(loaded / "why" / "diagnosis.json")
    sides = {f["effect"]: f["side"] for f in document["findings"]}
    assert document["verdict"] == "explained"
    assert {sides[name] for name in ("coulomb_friction", "viscous_friction", "armature")} == {"drive"}
    (behind,) = [f for f in document["findings"] if f["side"] == "link"]
    assert behind["family"] == "load"
    assert set(sides) == {"coulomb_friction", "viscous_friction", "armature", behind["effect"]}
    by_joint = {(p["name"], p["joint"]): p["value"] for f in document["findings"] for p in f["parameters"]}
    assert all(set(f["joints"]) == {*(LOSSY + 1)} for f in document["findings"] if f["side"] == "drive")
    for j in LOSSY:
        assert by_joint["coulomb", j + 1] == pytest.approx(COULOMB[j], rel=0.05)
        assert by_joint["damping", j + 1] == pytest.approx(VISCOUS[j], rel=0.05)
        assert by_joint["armature", j + 1] == pytest.approx(ROTORS[j], rel=0.1)
    left = np.asarray(document["fit_motor"]["held_out_rmse_after"])
    assert np.all(left < 1.5 * np.asarray(document["fit_motor"]["noise_floor"]))


@pytest.mark.slow
def test_both_torques_of_another_motion_are_predicted(loaded):
    later = load(loaded / "later.csv")
    told = np.genfromtxt(loaded / "tau.csv", delimiter=",", names=True)
    for name, noise, torque in (("tau", NOISE, later.tau), ("tau_motor", 2 * NOISE, later.tau_motor)):
        error = np.stack([told[f"{name}_{j + 1}"] for j in range(7)], 1) - torque
        assert np.all(np.sqrt(np.mean(error**2, 0)) < 1.2 * noise)


@pytest.mark.slow
def test_the_corrected_arm_is_the_whole_one_as_its_motors_move_it(loaded):
    later, corrected = load(loaded / "later.csv"), Corrected.load(loaded / "why")
    model = mujoco.MjModel.from_xml_path(str(loaded / "why" / "corrected.xml"))
    np.testing.assert_allclose(model.dof_damping, VISCOUS, rtol=0.05)
    np.testing.assert_allclose(model.dof_armature, ROTORS, rtol=0.1)
    states = way(later.time, 2)
    moving = np.flatnonzero(np.min(np.abs(states[1]), 1) > 0.05)
    for i in moving[:: len(moving) // 8]:
        torque = corrected.inverse_dynamics(*(jnp.asarray(x[i]) for x in states))
        np.testing.assert_allclose(torque, later.tau_motor[i], atol=10 * NOISE)


@pytest.mark.slow
def test_an_ensemble_is_of_the_whole_arm(loaded):
    """Load behind the drives, friction and rotors in them, each as far apart as it is off."""
    members, corrected = draw_ensemble(loaded / "why", count=24, seed=0), Corrected.load(loaded / "why")
    told = [one for one in members.to_json()["effect_coefficients"] if one["effect"] == "coulomb_friction"]
    found = [
        c
        for e, c in zip(corrected.effects, corrected.coefficients, strict=True)
        if e.title == "coulomb_friction"
    ]
    assert len(told) == len(found) > 0
    for one, (level,) in zip(told, found, strict=True):
        low, middle, high = one["value"]
        assert low < middle < high
        assert low < float(level) < high
        assert one["unit"] == "N·m"
    truths = {"coulomb_friction": COULOMB, "viscous_friction": VISCOUS, "armature": ROTORS}
    columns = iter(members.effects.T)
    for effect, coefficients in zip(corrected.effects, corrected.coefficients, strict=True):
        first, *_ = [next(columns) for _ in coefficients]
        if effect.name not in truths:
            assert effect.family == "load"
            assert abs(first.mean() - LOAD) < 0.02
            continue
        assert abs(first.mean() - truths[effect.name][effect.joints[0]]) < 5 * first.std() + 0.002
        assert 0 < first.std() < 0.02


@pytest.mark.slow
def test_the_motors_move_the_arm_in_a_replay(loaded):
    later = load(loaded / "later.csv")
    replays = [replay(loaded / "why", one, seconds=3.0) for one in (later, later.of_link_side())]
    by_motors, by_links = (np.sqrt(np.mean(one.feedback**2, 0)) for one in replays)
    assert np.all(replays[0].rmse < 0.02)
    assert np.all(by_motors[LOSSY] < 0.3 * by_links[LOSSY])


@pytest.mark.slow
def test_where_nothing_is_missing_on_either_side_nothing_is_said():
    found = diagnose(None, [measured(3, drive=False)])
    assert isinstance(found, TwoSided)
    assert found.verdict == "consistent"
    assert not found.findings


@pytest.mark.slow
def test_a_bias_behind_the_drives_is_none_in_them(tmp_path):
    found = diagnose(None, [measured(4, offset=1.0)])
    assert [(f.effect, f.joints) for f in found.findings if f.side == "link"] == [("torque_offset", (1,))]
    assert {f.effect for f in found.findings if f.side == "drive"} == {
        "coulomb_friction",
        "viscous_friction",
        "armature",
    }


@pytest.mark.slow
def test_a_wrong_torque_constant_is_the_motors(tmp_path):
    found = diagnose(None, [measured(5, drive=False, gain=1.1)])
    assert {(f.effect, f.side) for f in found.findings} == {("torque_gain", "drive")}
    assert 1 in found.findings[0].joints


@pytest.mark.slow
def test_what_the_file_has_of_its_drives_is_known_of_them(tmp_path):
    """The file's friction and rotors are between the two torques: none is missing, and none too many behind."""
    path = tmp_path / "arm.xml"
    text = panda_mjcf()
    for j in range(7):
        numbers = f'damping="{VISCOUS[j]}" frictionloss="{COULOMB[j]}" armature="{ROTORS[j]}"'
        text = text.replace(f'<joint name="joint{j + 1}"', f'<joint {numbers} name="joint{j + 1}"')
    assert text.count("frictionloss") == 7
    path.write_text(text)
    found = diagnose(path, [measured(6)])
    assert found.verdict == "consistent"
    later = measured(7)
    found.save(tmp_path / "why")
    tau, motors = predict_sides(tmp_path / "why", dataclasses.replace(later, tau=None, tau_motor=None))
    assert motors is not None
    assert np.all(np.sqrt(np.mean((tau - later.tau) ** 2, 0)) < 1.2 * NOISE)
    assert np.all(np.sqrt(np.mean((motors - later.tau_motor) ** 2, 0)) < 0.2)
    same = compare(tmp_path / "why", tmp_path / "why")
    assert same.verdict == "agree"
    assert {p.joint for p in same.parameters} >= {*(LOSSY + 1)}


@pytest.mark.slow
def test_torque_of_the_motors_is_left_out_where_not_all_recordings_have_it():
    plain = dataclasses.replace(measured(8, drive=False), tau_motor=None)
    found = diagnose(None, [plain, measured(9)])
    assert isinstance(found, Diagnosis)
    assert found.verdict == "consistent"
    assert any("tau_motor is not used" in note for note in found.notes)


def test_an_arm_at_rest_keeps_the_friction_of_the_file(tmp_path):
    """No drive moves, so that tau alone tells; and the file stays what it is."""
    path = tmp_path / "arm.xml"
    path.write_text(panda_mjcf().replace("<joint name=", '<joint frictionloss="0.4" name='))
    moving, rng = measured(11, drive=False), np.random.default_rng(11)
    q = np.repeat(moving.q[:1], moving.samples, 0)
    data, model = mujoco.MjData(engine()), engine()
    data.qpos[:7] = q[0]
    mujoco.mj_inverse(model, data)
    tau = data.qfrc_inverse[:7] + NOISE * rng.normal(size=q.shape)
    still = dataclasses.replace(moving, q=q, qd=0 * q, tau=tau, tau_motor=tau + 0.3)
    found = diagnose(path, [still])
    assert isinstance(found, AtRest)
    assert found.verdict == "consistent"
    np.testing.assert_array_equal(found.corrected.arm.frictionloss, 0.4)


def test_torque_of_the_motors_alone_is_refused_with_what_would_take_it():
    alone = dataclasses.replace(measured(10), tau=None)
    with pytest.raises(InputError, match=r"--columns tau=tau_motor_\{j\}"):
        diagnose(None, [alone])


def test_torque_of_the_motors_that_never_changes_is_refused():
    recording = measured(10)
    stuck = recording.tau_motor.copy()
    stuck[:, 3] = 1.0
    with pytest.raises(InputError, match="column tau_motor_4 never changes"):
        diagnose(None, [dataclasses.replace(recording, tau_motor=stuck)])
