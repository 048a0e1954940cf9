import dataclasses
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxpanda_kernels import gravity_torque

from jaxpanda.arms.arm import Arm
from jaxpanda.errors import InputError
from jaxpanda.inspection import Inspection, inspect
from jaxpanda.recordings import Origin, Recording, load

CENTRE = np.array([0.0, -0.3, 0.0, -1.8, 0.0, 1.8, 0.0])


def excitation(time: np.ndarray) -> np.ndarray:
    """A motion of all joints within the Panda's limits."""
    rng = np.random.default_rng(0)
    frequency, phase = rng.uniform(1.0, 5.0, (5, 7)), rng.uniform(0, 6, (5, 7))
    return CENTRE + 0.4 * np.sum(np.sin(time[:, None, None] * frequency + phase) / frequency, axis=1)


nominal = jax.jit(jax.vmap(Arm.panda().inverse_dynamics))


def virtual(q=excitation, *, late: float = 0.0, noise: float = 0.02, rate: float = 250.0) -> Recording:
    """What the Panda's own model would record of a motion, with velocities logged late."""
    time = np.arange(round(12 * rate)) / rate
    h = 1e-4
    qd = (q(time + h) - q(time - h)) / (2 * h)
    qdd = (q(time + h) - 2 * q(time) + q(time - h)) / h**2
    tau = np.array(nominal(*map(jnp.asarray, (q(time), qd, qdd))))
    tau += noise * np.random.default_rng(1).normal(size=tau.shape) + 0.2 * np.tanh(qd / 0.05)
    logged = (q(time - late + h) - q(time - late - h)) / (2 * h)
    return Recording("virtual", time, q(time), logged, tau)


def said(found: Inspection) -> str:
    return "\n".join(found.verdicts)


def test_a_joint_that_slides_is_told_in_metres():
    arm = Arm.panda()
    assert inspect(virtual(), arm).table()[0][1] == "range rad"
    arm = eqx.tree_at(lambda a: a.chain.prismatic, arm, arm.chain.prismatic.at[6].set(True))
    found = inspect(virtual(), arm)
    assert [joint.slides for joint in found.joints] == [False] * 6 + [True]
    assert found.table()[0][1] == "range rad or m"


def test_a_clean_recording_is_found_right_in_every_respect():
    found = inspect(virtual(late=5e-3), Arm.panda())
    assert found.channels == ("q", "dq", "tau")
    assert (found.dof, found.samples, found.missing, found.repeated_rows, found.gaps) == (7, 3000, 0, 0, ())
    assert found.rate == pytest.approx(250.0)
    assert found.velocity_scale == pytest.approx(1.0, abs=0.02)
    assert found.identifiable is not None
    assert (found.identifiable.rank, found.identifiable.structural_rank) == (43, 43)
    assert (found.identifiable.gravity_rank, found.identifiable.gravity_structural_rank) == (12, 12)
    assert found.identifiable.coulomb_joints == tuple(range(1, 8))
    assert "torque in N m, positive along the joint axis" in said(found)
    assert "gravity is in the torque" in said(found)
    for joint in found.joints:
        assert joint.velocity_lag == pytest.approx(5e-3, abs=2e-4)
        assert joint.noise == pytest.approx(0.02, rel=0.1)
        assert joint.reversals > 3
        assert joint.torque_scale is None or joint.torque_scale == pytest.approx(1.0, abs=0.03)
    assert sum(joint.torque_scale is not None for joint in found.joints) >= 4


def test_a_reversed_torque_is_noticed():
    good = virtual()
    assert good.tau is not None
    found = inspect(Recording("reversed", good.time, good.q, good.qd, -good.tau), Arm.panda())
    assert "torque column of all joints has the wrong sign" in said(found)
    assert "torque in N m, positive" not in said(found)


def test_one_reversed_joint_is_named():
    good = virtual()
    assert good.tau is not None
    found = inspect(
        Recording("one", good.time, good.q, good.qd, good.tau * [1, 1, 1, -1, 1, 1, 1]), Arm.panda()
    )
    assert "torque column of joint 4 has the wrong sign" in said(found)


def test_a_torque_in_other_units_is_noticed():
    good = virtual()
    assert good.tau is not None
    found = inspect(Recording("millinewtons", good.time, good.q, good.qd, 1000 * good.tau), Arm.panda())
    assert "1000 times the joint torque: mNm. Give `--torque-unit mNm`." in said(found)


def test_gravity_taken_out_by_the_controller_is_noticed():
    good, arm = virtual(), Arm.panda()
    assert good.tau is not None
    gravity = jax.vmap(lambda q: gravity_torque(arm.chain, arm.standard, q))(jnp.asarray(good.q))
    found = inspect(Recording("free", good.time, good.q, good.qd, good.tau - np.asarray(gravity)), arm)
    assert "torque column holds no gravity" in said(found)


@pytest.mark.parametrize("declared", ["measured", "gravity_removed", "unstated"])
@pytest.mark.parametrize("without", [True, False])
def test_what_a_source_says_of_gravity_is_tested_by_the_motion(declared, without):
    """UR's `effort` changed from current to torque without gravity within one driver."""
    recording = virtual()
    assert recording.tau is not None
    if without:
        arm = Arm.panda()
        weight = jax.vmap(lambda q: gravity_torque(arm.chain, arm.standard, q))(jnp.asarray(recording.q))
        recording = dataclasses.replace(recording, tau=recording.tau - np.asarray(weight))
    origin = Origin("somebody's driver", {"q": "position"}, declared, "what it says")
    found = inspect(dataclasses.replace(recording, origin=origin), Arm.panda())
    wrong = declared != "unstated" and without != (declared == "gravity_removed")
    assert ("somebody's driver says that its torque" in said(found)) == wrong
    assert "its source says: what it says" in " ".join(found.lines())


def test_a_joint_that_rests_is_named_and_shows_less():
    def held(time):
        return np.where(np.arange(7) == 2, CENTRE, excitation(time))

    found = inspect(virtual(held), Arm.panda())
    assert found.joints[2].rest == 1.0
    assert found.joints[2].reversals == 0
    assert "joints 3 hardly move" in said(found)
    assert found.identifiable is not None
    assert 3 not in found.identifiable.coulomb_joints
    assert found.identifiable.rank < 43


def test_a_motion_outside_the_model_s_limits_is_noticed():
    found = inspect(virtual(lambda t: excitation(t) + 2.5 * np.eye(7)[3]), Arm.panda())
    assert "joint 4 goes from" in said(found)


def test_a_motion_and_a_missing_model_are_said():
    good = virtual()
    assert "a motion, which can be predicted for" in said(
        inspect(Recording("m", good.time, good.q), Arm.panda())
    )
    found = inspect(good)
    assert found.identifiable is None
    assert "cannot be told without a model" in said(found)


def test_gaps_repeats_and_jitter_are_counted():
    good = virtual()
    assert good.tau is not None
    rows = np.r_[0:1000, 1060:3000]
    q, tau = good.q[rows].copy(), good.tau[rows].copy()
    q[500:600:2], tau[500:600:2] = q[499:599:2], tau[499:599:2]
    found = inspect(Recording("gappy", good.time[rows], q, None, tau), Arm.panda())
    assert found.missing == 60
    assert found.repeated_rows == 50
    assert found.gaps[0] == (pytest.approx(3.996), pytest.approx(0.244))
    assert "gaps longer than 0.1 s, the longest 0.244 s at 3.996 s" in said(found)
    assert "rows repeat the one before" in said(found)
    assert "time is not uniform" in said(found)


def test_an_arm_with_another_number_of_joints_is_refused():
    good = virtual()
    with pytest.raises(InputError, match=r"6 joints .* where the model has 7"):
        inspect(Recording("six", good.time, good.q[:, :6]), Arm.panda())


def test_everything_is_plain_json_and_fits_a_table():
    found = inspect(virtual(), Arm.panda())
    document = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert document["schema"] == "jaxpanda.inspection/1"
    assert len(document["joints"]) == 7
    heads, rows = found.table()
    assert len(rows) == 7
    assert all(len(row) == len(heads) for row in rows)
    assert all(verdict in found.lines() for verdict in found.verdicts)


def test_velocities_of_the_other_sign_are_told_as_such():
    recording = virtual()
    assert recording.qd is not None
    signs = np.where(np.arange(7) == 2, -1.0, 1.0)
    found = inspect(dataclasses.replace(recording, qd=signs * recording.qd), Arm.panda())
    assert "dq of joint 3 has the opposite sign of d(q)/dt" in said(found)
    assert found.joints[2].velocity_scale == pytest.approx(-1.0, abs=0.02)
    as_it_was = inspect(recording, Arm.panda()).joints[2]
    assert found.joints[2].velocity_lag == pytest.approx(as_it_was.velocity_lag, abs=1e-9)


def test_the_log_of_gaz_et_al_is_what_the_notes_say(data):
    found = inspect(load(data / "gaz_panda"), Arm.panda())
    assert found.identifiable is not None
    assert found.identifiable.rank == 43
    lags = [joint.velocity_lag for joint in found.joints]
    assert all(lag is not None and 4.3e-3 < lag < 6.2e-3 for lag in lags)
    steps = [joint.torque_step for joint in found.joints]
    assert np.allclose(steps, [0.0357] * 4 + [0.0055, 0.0064, 0.0064], atol=2e-4)
    assert all(joint.torque_scale is None or 0.9 < joint.torque_scale < 1.1 for joint in found.joints)
    assert found.period == pytest.approx(13.3335, abs=1e-3)
    assert "gravity is in the torque" in said(found)


def test_a_scale_that_parts_of_the_motion_disagree_on_is_not_told():
    """A UR5's third joint, by its motor's current, had the wrong sign, and a Doosan's first another scale."""
    recording, rng = virtual(), np.random.default_rng(0)
    held = np.repeat(rng.normal(0, 8.0, 12), 250)  # as friction that a joint's rests leave behind
    found = inspect(
        dataclasses.replace(recording, tau=recording.tau + np.eye(7)[2] * held[:, None]), Arm.panda()
    )
    own = inspect(recording, Arm.panda())
    assert own.joints[2].torque_scale == pytest.approx(1.0, abs=0.03)
    assert found.joints[2].torque_scale is None
    assert [j.torque_scale for j in found.joints[:2]] == [j.torque_scale for j in own.joints[:2]]
    assert "scale" not in said(found)
    assert "sign" not in said(found)


def test_a_torque_that_never_changes_has_no_scale():
    recording = virtual()
    found = inspect(
        dataclasses.replace(recording, tau=np.where(np.eye(7)[1], 5.0, recording.tau)), Arm.panda()
    )
    assert found.joints[1].torque_scale is None
    assert found.joints[1].gravity_scale is None
    assert "torque of joints 2 never changes: no sensor speaks there" in said(found)
    dead = inspect(dataclasses.replace(recording, tau=5.0 + 0 * recording.q), Arm.panda())
    assert "times what the model needs" not in said(dead)


def test_an_arm_at_rest_has_no_scale_and_no_inertia():
    """Noise of q, differentiated twice, is no motion: a Doosan at rest had 0.0002 times its model's torque."""
    recording, rng = virtual(), np.random.default_rng(0)
    q = recording.q[:1] + rng.normal(0, 1e-5, recording.q.shape)
    tau = recording.tau[:1] + rng.normal(0, 0.1, recording.q.shape)
    found = inspect(dataclasses.replace(recording, q=q, qd=None, tau=tau), Arm.panda())
    assert [joint.torque_scale for joint in found.joints] == [None] * 7
    assert "unit and sign cannot be told" in said(found)
    assert found.identifiable is not None
    assert found.identifiable.rank == found.identifiable.gravity_rank


def test_noise_of_q_makes_no_scale_smaller():
    """The model's torque is low-passed as the measured one is: a UR10e's first joint had 0.40 of its model's."""
    recording, rng = virtual(), np.random.default_rng(0)
    q = recording.q + rng.normal(0, 3e-4, recording.q.shape)
    found = inspect(dataclasses.replace(recording, q=q, qd=None), Arm.panda())
    heavy = [found.joints[j] for j in (0, 1, 2, 3, 5)]
    assert [joint.torque_scale for joint in heavy] == pytest.approx([1.0] * 5, abs=0.01)
    assert [joint.gravity_scale for joint in heavy[1:]] == pytest.approx([1.0] * 4, abs=0.01)
