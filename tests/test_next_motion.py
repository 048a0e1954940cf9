"""What recordings could show, and the motion that would decide, against what simulated recordings then say.

The arm is moved by MuJoCo's C engine, which shares no code with the analysis.
"""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import scipy.interpolate

from jaxpanda import Arm, Recording
from jaxpanda.arms.export import panda_mjcf
from jaxpanda.arms.markup import parse
from jaxpanda.arms.source import from_document
from jaxpanda.diagnosis.finding import Finding
from jaxpanda.diagnosis.motions import Surroundings, motions
from jaxpanda.diagnosis.next_motion import NOTHING, next_motion
from jaxpanda.effects.friction import ViscousFriction
from jaxpanda.effects.sensing import TorqueOffset
from jaxpanda.inference.problem import Problem
from jaxpanda.inference.state import with_terms
from jaxpanda.search.coverage import held_out_gains, least_shown
from jaxpanda.search.premises import pose
from jaxpanda.search.proposals import grids
from jaxpanda.simulation import FourierTrajectory, JointFriction, Sensors, random_trajectory, simulate
from jaxpanda.traces import prepare
from jaxpanda.workspace.scene import CLEARANCE, reach_of, scene_of

JOINT, OFFSET = 5, 0.03
SENSORS = Sensors(torque_noise=0.05, position_noise=1e-6)
SOURCE = from_document(parse(panda_mjcf(), "mujoco", Path("panda.xml")))[1]


class Spline(FourierTrajectory):
    """A tabled motion that the simulated arm can track."""

    def __init__(self, time, q):
        super().__init__(np.zeros((7, 1)), np.zeros((7, 1)), q[0], 2 * np.pi / time[-1])
        object.__setattr__(self, "spline", scipy.interpolate.CubicSpline(time, q))

    def __call__(self, time):
        at = np.minimum(time, self.spline.x[-1])  # pyright: ignore
        return tuple(self.spline(at, k) for k in range(3))  # pyright: ignore


def record(trajectory, seed: int, seconds: float = 10.0) -> Recording:
    friction = JointFriction(offset=OFFSET * np.eye(7)[JOINT])
    return simulate(
        panda_mjcf(),
        trajectory,
        duration=seconds,
        rate=200.0,
        friction=friction,
        sensors=SENSORS,
        seed=seed,
        name=f"{seed}.csv",
    )


def posed(*recordings: Recording) -> tuple[Problem, np.ndarray]:
    arm = Arm.panda()
    traces = tuple(prepare(one, arm) for one in recordings)
    premises = pose(traces, (True,) * len(traces), "exact")
    return premises.problem, premises.spread


@pytest.fixture(scope="module")
def recorded():
    return random_trajectory(panda_mjcf(), 3, period=8.0)


@pytest.fixture(scope="module")
def known(recorded):
    """A recording that shows a torque offset, and not that it is no asymmetric friction."""
    problem, spread = posed(record(recorded, 0))
    state = with_terms(problem, (problem.term(TorqueOffset(JOINT), np.array([0.05])),))
    finding = Finding(
        effect="torque_offset",
        joints=(JOINT,),
        recordings=("0.csv",),
        confidence=0.6,
        alternatives=(("asymmetric_friction", 0.4),),
        equation="",
        rms_torque=np.zeros(7),
        evidence=0.0,
        summary="",
        terms=(0,),
    )
    return problem, spread, state, finding


def margin(*recordings: Recording) -> float:
    """Evidence of the offset over the best asymmetric friction at its joint [nats]."""
    problem, _ = posed(*recordings)
    noise = problem.noise(())
    groups = [
        g for g in problem.library if g.joint == JOINT and g.name in ("torque_offset", "asymmetric_friction")
    ]
    best = {p.effect.name: p.best for p in grids(problem, problem.design((), noise), noise, groups)}
    return best["torque_offset"] - best["asymmetric_friction"]


@pytest.mark.slow
def test_the_recommended_motion_separates_what_the_recorded_one_does_not(known, recorded):
    problem, spread, state, finding = known
    motion = next_motion(problem, state, [finding], spread, "exact", SOURCE)
    assert motion is not None
    (told,) = motion.pairs
    assert told.nats > 2 * told.nats_repeated
    old = record(recorded, 0)
    new = record(Spline(motion.time, motion.q), 1, float(motion.time[-1]))
    before, repeated, after = margin(old), margin(old, record(recorded, 2)), margin(old, new)
    assert before < 8
    assert after - before > repeated - before + 3
    assert after - before == pytest.approx(told.nats, rel=0.6)


def test_motions_keep_to_limits_and_speeds_and_end_at_rest(known):
    problem = known[0]
    arm, trace = Arm.panda(), problem.traces[0]
    fastest = 1.1 * np.abs(trace.motion.qd).max(0)
    for kind, q in motions(problem, trace, [JOINT], Surroundings.around(problem, SOURCE))[1:]:
        assert len(q) == len(trace.channels.t)
        qd = np.gradient(q, trace.dt, axis=0)
        assert (q >= np.asarray(arm.lower)).all(), kind
        assert (q <= np.asarray(arm.upper)).all(), kind
        assert (np.abs(qd) <= 1.05 * np.maximum(fastest, 0.3)).all(), kind
        assert np.abs(qd[[0, -1]]).max() < 0.05, kind


def test_motions_keep_clear_of_what_the_file_holds(known):
    """A floor just below the recorded motion, as MuJoCo has it at every sample."""
    problem = known[0]
    floor = '<worldbody><geom type="plane" size="0 0 1" pos="0 0 {}" contype="1" conaffinity="1"/>'
    arm, trace = Arm.panda(), problem.traces[0]

    def of_file(height):
        text = panda_mjcf().replace("<worldbody>", floor.format(height), 1)
        return from_document(parse(text, "mujoco", Path("panda.xml")))[1]

    def closest(source, q):
        q, dt = q[::10], 10 * trace.dt
        speed = 2 * float(np.abs(np.gradient(q, dt, axis=0)).sum(1).max()) * reach_of(arm)
        return scene_of(arm, source, CLEARANCE, None).closest(np.arange(len(q)) * dt, q, speed).distance

    recorded = np.asarray(trace.channels.q)
    low, high = -1.0, 1.5
    while high - low > 0.01:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if closest(of_file(middle), recorded) > 0.02 else (low, middle)
    source = of_file(low)
    kept = closest(source, recorded)
    assert 0.02 < kept < 0.03
    free = dataclasses.replace(Surroundings.around(problem, source), are_clear=lambda q: True)
    assert min(closest(source, q) for _, q in motions(problem, trace, [JOINT], free)) < kept - 0.01
    for kind, q in motions(problem, trace, [JOINT], Surroundings.around(problem, source)):
        assert closest(source, q) > kept - 0.01, kind
        assert np.ptp(q, axis=0).max() > 0.1, kind


def test_where_meshes_are_missing_it_is_said_that_nobody_looked(known, tmp_path):
    text = panda_mjcf().replace(
        "<worldbody>", '<asset><mesh name="shell" file="none.stl"/></asset><worldbody>', 1
    )
    text = text.replace('<body name="link0">', '<body name="link0"><geom type="mesh" mesh="shell"/>', 1)
    source = from_document(parse(text, "mujoco", tmp_path / "panda.xml"))[1]
    assert Surroundings.around(known[0], source).said.startswith("Collisions were not checked: ")


def test_bodies_without_names_and_beside_the_arm_have_their_places(known):
    """Whatever stands before or beside the arm in the file, geoms belong to the links that carry them."""
    bodies = """<body name="post"><geom type="sphere" size="0.01"/><body/></body>"""
    text = panda_mjcf().replace("<worldbody>", f"<worldbody>{bodies}", 1)
    plain = scene_of(Arm.panda(), SOURCE, CLEARANCE, None)
    source = from_document(parse(text.replace('name="link4"', ""), "mujoco", Path("panda.xml")))[1]
    scene = scene_of(Arm.panda(), source, CLEARANCE, None)
    recorded = np.asarray(known[0].traces[0].channels.q)[::50]
    kept = [s.distance_kept(Arm.panda(), recorded) for s in (plain, scene)]
    assert len(scene.pairs) == len(plain.pairs)
    np.testing.assert_allclose(kept[1], kept[0], atol=1e-9)


def test_what_is_in_doubt_without_a_rival_is_looked_for_again(known):
    problem, spread, state, finding = known
    doubted = dataclasses.replace(finding, confidence=0.4, alternatives=())
    motion = next_motion(problem, state, [doubted], spread, "exact", SOURCE)
    assert motion is not None
    (told,) = motion.pairs
    assert told.rival == NOTHING
    assert told.nats > 1
    assert told.nats_repeated == 0
    assert motion.kind != motion.tried[0][0]
    believed = dataclasses.replace(finding, confidence=0.95, alternatives=())
    assert next_motion(problem, state, [believed], spread, "exact", SOURCE) is None


def test_nothing_is_recommended_where_nothing_is_in_doubt(known):
    problem, spread, state, finding = known
    sure = dataclasses.replace(finding, confidence=0.95, alternatives=(("asymmetric_friction", 0.01),))
    assert next_motion(problem, state, [sure], spread, "exact", SOURCE) is None


def test_a_rival_that_no_motion_rules_out_is_not_decided(known):
    """A spring may be as soft as it likes, and is an offset then."""
    problem, spread, state, finding = known
    either = dataclasses.replace(finding, alternatives=(("joint_spring", 0.4),))
    assert next_motion(problem, state, [either], spread, "exact", SOURCE) is None
    both = dataclasses.replace(finding, alternatives=(("asymmetric_friction", 0.4), ("joint_spring", 0.4)))
    motion = next_motion(problem, state, [both], spread, "exact", SOURCE)
    assert motion is not None
    assert [told.rival for told in motion.pairs] == ["asymmetric_friction"]


@pytest.mark.slow
def test_an_effect_of_the_size_that_would_have_shown_has_the_evidence_it_needs(known):
    problem = known[0]
    state = with_terms(problem, ())
    (row,) = [r for r in least_shown(problem, state) if (r.effect, r.joint) == ("viscous_friction", 2)]
    assert row.size is not None
    noise, found = state.noise, {}
    for share in (0.5, 1.0, 1.5):
        trace = problem.traces[0]
        assert trace.tau is not None
        tau = trace.tau + share * row.size * trace.motion.qd[:, 2:3] * np.eye(7)[2]
        planted = Problem((dataclasses.replace(trace, tau=tau),), (True,), problem.nuisance)
        groups = [g for g in planted.library if isinstance(g.effects[0], ViscousFriction) and g.joint == 2]
        (found[share],) = (p.evidence for p in grids(planted, planted.design((), noise), noise, groups))
    assert found[0.5] + ViscousFriction.prior < 0 < found[1.5] + ViscousFriction.prior
    assert found[1.0] == pytest.approx(-ViscousFriction.prior, abs=16)


def test_gains_are_those_of_refitting_every_fold(known):
    """One candidate added to a model, against the model with it fitted anew on every training block."""
    problem, _, state, _ = known
    noise, deviation = state.noise, np.array([0.05])
    term = problem.term(TorqueOffset(JOINT), deviation)
    nominal, whole = problem.design((), noise), problem.design((term,), noise)
    columns = {JOINT: problem.whitened([c[:, JOINT] for c in term.columns], noise, JOINT)}
    (gain,) = held_out_gains(problem, nominal, [columns], [deviation])
    expected = 0.5 * (problem.held_out_error(nominal) - problem.held_out_error(whole))
    assert gain.sum() == pytest.approx(expected, rel=1e-6)
    assert gain.sum() > 10
