"""An arm that holds still: what is beyond friction at rest is told, what is within it is not."""

import dataclasses
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import result
from scipy.signal import lfilter

from jaxpanda import Arm, Recording
from jaxpanda.__main__ import main
from jaxpanda.arms.export import panda_mjcf
from jaxpanda.arms.source import from_mjcf
from jaxpanda.diagnosis import diagnose, predict
from jaxpanda.diagnosis.resting import AtRest, judge
from jaxpanda.effects import AbstractInstantEffect, Channels, Coefficient, LawAtRest, Levels, Motion
from jaxpanda.errors import InputError
from jaxpanda.recordings import save
from jaxpanda.traces import prepare

LOSS = 0.4
"""Of every joint [N m]."""
SECONDS, RATE = 8.0, 100.0


@pytest.fixture(scope="module")
def rubbing(tmp_path_factory):
    """The project's Panda with frictionloss, as a file."""
    path = tmp_path_factory.mktemp("model") / "panda.xml"
    path.write_text(panda_mjcf().replace("<joint name=", f'<joint frictionloss="{LOSS}" name='))
    return path


def rest(
    seed: int, extra=None, *, slow: bool = False, pose: int | None = None, gives: float = 0.0
) -> Recording:
    """A pose held with noise of 0.05 N m; friction at rest carries what it likes. `extra(t, pose)` is added."""
    rng, arm = np.random.default_rng(seed), Arm.panda()
    t = np.arange(int(SECONDS * RATE)) / RATE
    lower, upper = np.asarray(arm.lower), np.asarray(arm.upper)
    way = np.random.default_rng(seed if pose is None else pose).uniform(-0.3, 0.3, 7)
    q = 0.5 * (lower + upper) + (upper - lower) * way
    at = Motion(arm, np.array([0.0, 1.0]), np.stack([q, q]), *np.zeros((3, 2, 7)))
    keep = np.exp(-1 / (0.15 * RATE)) if slow else 0.0
    noise = lfilter([np.sqrt(1 - keep**2)], [1, -keep], rng.normal(size=(len(t), 7)), axis=0)
    tau = at.load[0] + 0.05 * noise + LOSS * rng.uniform(-1, 1, 7)
    tau = tau + (0.0 if extra is None else extra(t, at))
    yields = gives * ((t > 3) & (t < 5))[:, None]
    return Recording(f"rest_{seed}.csv", t, q + yields + 1e-5 * rng.normal(size=(len(t), 7)), tau=tau)


def push(newtons: float, start: float = 3.0, stop: float = 5.0):
    """On the last link, sideways."""
    wrench = np.array([0.6, 0.8, 0, 0, 0, 0]) * newtons
    return lambda t, at: ((t >= start) & (t < stop))[:, None] * (at.wrench_columns[0, 6] @ wrench)


def hung(kilograms: float, start: float = -1.0):
    """0.15 m before the flange's frame."""
    phi = kilograms * np.array([1, 0, 0, 0.15])
    return lambda t, at: (t >= start)[:, None] * (at.regressor[0][:, 60:64] @ phi)


def judged(rubbing, *recordings: Recording, reference=()) -> AtRest:
    arm, source = from_mjcf(rubbing)
    ready = lambda some: [prepare(one, arm) for one in some]
    return judge(ready(recordings), ready(reference), source, "identified")


def test_an_arm_at_rest_is_answered_and_its_prediction_is_the_users_model(rubbing, tmp_path):
    """It was refused with status 2, whatever its torque said."""
    save(rest(0), tmp_path / "rest.csv")
    out = tmp_path / "out"
    command = [
        "diagnose",
        "--model",
        str(rubbing),
        "--recording",
        str(tmp_path / "rest.csv"),
        "--out",
        str(out),
    ]
    assert main(command) == 0
    document = result(out / "diagnosis.json")
    assert (document["verdict"], document["findings"]) == ("consistent", [])
    assert any("no joint moves, so that none was judged" in note for note in document["notes"])
    assert (out / "corrected.xml").read_text() == rubbing.read_text()
    assert "No joint moved" in (out / "report.html").read_text()
    arm, motion = from_mjcf(rubbing)[0], rest(1)
    held = Motion(arm, motion.time, motion.q, *np.zeros((3, *motion.q.shape))).load
    assert np.abs(predict(out, motion) - held).max() < LOSS + 0.05


@pytest.mark.parametrize("slow", [pytest.param(False, marks=pytest.mark.slow), True])
def test_noise_and_friction_at_rest_raise_no_alarm(rubbing, slow):
    found = [judged(rubbing, rest(seed, slow=slow)) for seed in range(12)]
    assert [one.verdict for one in found] == ["consistent"] * 12


def test_what_friction_at_rest_may_carry_is_not_told(rubbing):
    within = lambda t, at: 0.3 * LOSS * np.eye(7)[3] * (t[:, None] > 4)
    assert not judged(rubbing, rest(3, within)).findings


def test_a_push_is_told_with_its_time(rubbing):
    found = judged(rubbing, rest(4, push(40.0)))
    (one,) = [f for f in found.findings if f.intervals]
    assert one.effect == "external_contact"
    np.testing.assert_allclose(one.intervals, [(3.0, 5.0)], atol=0.25)
    assert one.confidence > 0.6
    assert one.confidence + sum(p for _, p in one.alternatives) <= 1 + 1e-9
    assert found.verdict == "partly_explained"


def test_an_arm_that_gives_way_by_milliradians_is_pushed_and_has_no_spring(rubbing):
    found = judged(rubbing, rest(4, push(40.0), gives=6e-3))
    assert [f.effect for f in found.findings if f.intervals] == ["external_contact"]
    assert any("gave way by" in note for note in found.notes)


def test_a_body_hung_on_while_the_arm_holds_still(rubbing):
    (one,) = [f for f in judged(rubbing, rest(5, hung(2.5, 4.0))).findings if f.intervals]
    assert one.effect == "payload_change"
    np.testing.assert_allclose(one.intervals[0][0], 4.0, atol=0.25)
    mass = next(p for p in one.parameters if p["name"] == "mass")
    assert abs(mass["value"] - 2.5) < 2.5 * mass["std"]


def test_a_body_held_in_several_poses_is_a_payload(rubbing):
    found = judged(rubbing, *(rest(k, hung(2.5), pose=k) for k in (10, 11, 12, 13)))
    (one,) = found.findings
    assert one.effect == "payload"
    assert one.intervals is None


def test_what_healthy_recordings_of_the_same_pose_show_is_not_told(rubbing):
    biased = lambda t, at: 6.0 * np.eye(7)[2] * np.ones((len(t), 1))
    assert judged(rubbing, rest(20, biased)).findings
    healthy = rest(21, biased, pose=20)
    assert not judged(rubbing, rest(20, biased), reference=[healthy]).findings


class BeltTension(AbstractInstantEffect):
    """A belt that pulls at joints 3 and 5 alike, whatever the pose."""

    name: ClassVar[str] = "belt_tension"
    family: ClassVar[str] = "drive"
    at_rest: ClassVar[str] = "a belt that is too tight"
    joint: int = 4

    @classmethod
    def grid(cls, arm: Arm):
        return [cls()]

    @classmethod
    def while_still(cls, levels: Levels):
        pull = np.tile(5.0 * (np.eye(7)[2] + np.eye(7)[4]), len(levels.poses))[:, None]
        return [LawAtRest(pull, 0.06, 4, (("tension", "N·m", 5.0),))]

    @property
    def coefficients(self):
        return (Coefficient("tension", "N·m"),)

    @property
    def equation(self) -> str:
        return "tau = tension"

    def at(self, s: Channels):
        return jnp.ones(1)


def test_an_effect_of_the_users_own_speaks_of_an_arm_that_holds_still(rubbing):
    tight = lambda t, at: 6.0 * (np.eye(7)[2] + np.eye(7)[4]) * np.ones((len(t), 1))
    recordings = [rest(k, tight, pose=k) for k in (30, 31, 32, 33)]
    (known,) = judged(rubbing, *recordings).findings
    assert known.effect == "unknown"
    (one,) = diagnose(rubbing, recordings, effects=[BeltTension]).findings
    assert (one.effect, one.family, one.joints) == ("belt_tension", "drive", (4,))
    assert "a belt that is too tight" in one.summary
    (pull,) = one.parameters
    assert abs(pull["value"] - 6.0) < 3 * pull["std"]


def sets_out(seed: int, seconds: float) -> Recording:
    """An arm at rest, which sets out 0.3 s before the recording ends; what accelerates it is in the torque."""
    still = rest(seed)
    rows = slice(0, round(seconds * RATE))
    t = still.time[rows]
    ahead = np.maximum(t - (t[-1] - 0.3), 0)[:, None] * (np.arange(7) == 0)
    return Recording(still.name, t, still.q[rows] + 5 * ahead**2, tau=still.tau[rows] + 12 * (ahead > 0))


def test_an_arm_that_sets_out_at_the_end_is_judged_while_it_rests(rubbing):
    """What accelerates it was told as a drift of sensors, at 1.00."""
    found = diagnose(rubbing, [sets_out(31, SECONDS)])
    assert isinstance(found, AtRest)
    assert (found.verdict, found.findings) == ("consistent", ())
    assert any("judged where the arm holds still, 0.00 to 7.7" in note for note in found.notes)


def test_one_wrong_sample_of_position_does_not_end_a_rest(rubbing):
    still = rest(33)
    q = still.q.copy()
    q[400, 2] += 0.05
    found = diagnose(rubbing, [dataclasses.replace(still, q=q)])
    assert found.verdict == "consistent"
    assert not any("judged where" in note for note in found.notes)


def test_too_little_rest_beside_a_motion_that_filters_cut_off_is_refused(rubbing):
    with pytest.raises(
        InputError, match=r"rest_32.csv: the arm moves only within 0.4 s of an end.*0.80 s beside"
    ):
        diagnose(rubbing, [sets_out(32, 1.05)])


def test_a_torque_that_never_changes_says_nothing_at_rest(rubbing):
    one = rest(22)
    tau = one.tau.copy()
    tau[:, 2] = 7.0
    assert diagnose(rubbing, [dataclasses.replace(one, tau=tau)]).verdict == "consistent"


def test_without_frictionloss_in_the_model_friction_is_one_of_the_explanations():
    biased = lambda t, at: 1.5 * np.eye(7)[2] * np.ones((len(t), 1))
    found = diagnose(None, [rest(23, biased)], knowledge="exact")
    (one,) = found.findings
    assert "coulomb_friction" in {one.effect, *(name for name, _ in one.alternatives)}
    assert found.verdict == "partly_explained"
    assert jnp.all(found.corrected.frictionloss_change == 0)
