"""What a diagnosis starts from: the known may be widened, and what healthy recordings show counts everywhere."""

import numpy as np
import pytest

from jaxpanda import Arm
from jaxpanda.arms.export import panda_mjcf
from jaxpanda.diagnosis import diagnosis, premises
from jaxpanda.diagnosis.premises import pose
from jaxpanda.diagnosis.problem import Problem
from jaxpanda.diagnosis.state import start, with_terms
from jaxpanda.diagnosis.traces import prepare
from jaxpanda.effects.sensing import TorqueOffset
from jaxpanda.simulation import JointFriction, Sensors, random_trajectory, simulate


def test_what_healthy_recordings_show_may_be_refitted_in_all_recordings():
    motion = random_trajectory(panda_mjcf(), 1, period=3.0)
    made = [
        simulate(panda_mjcf(), motion, duration=3.0, rate=200.0, friction=JointFriction(),
                 sensors=Sensors(torque_noise=0.05), seed=k, name=f"{k}.csv")
        for k in range(2)
    ]  # fmt: skip
    traces = tuple(prepare(one, Arm.panda()) for one in made)
    plain = Problem(traces, (True, True), tuple(t.motion.q[:, :, None][:, :, :0] for t in traces))
    known = plain.term(TorqueOffset(3), np.array([0.5]))
    problem = pose(traces, (True, False), "exact", (known,)).problem
    for columns in problem.nuisance:
        np.testing.assert_allclose(columns[:, 3, -1], 0.5, atol=1e-6)
        assert not np.any(columns[:, [0, 1, 2, 4, 5, 6], -1])
    news = problem.full_columns(TorqueOffset(3))
    assert np.any(news[0])
    assert not np.any(news[1])  # an effect that is searched for acts in the suspect recording alone


@pytest.mark.parametrize("comes_again", [pytest.param(True, marks=pytest.mark.slow), False])
def test_what_healthy_recordings_show_is_predicted_where_it_comes_again(monkeypatch, comes_again):
    """Two seconds of an arm had a crosstalk of 1.05, with which another motion was predicted 20 N·m off."""
    motion, made = random_trajectory(panda_mjcf(), 1, period=3.0), []
    for k in range(2):
        one = simulate(panda_mjcf(), motion, duration=6.0, rate=200.0, friction=JointFriction(),
                       sensors=Sensors(torque_noise=0.05), seed=k, name=f"{k}.csv")  # fmt: skip
        one.tau[:, 3] += 0.5 if comes_again else 0.5 * np.repeat([1, -1] * 6, 100)
        made.append(prepare(one, Arm.panda()))
    offset = lambda problem: problem.term(TorqueOffset(3), np.array([0.5]))
    monkeypatch.setattr(
        premises, "laws", lambda p, log, terms=(): with_terms(p, [offset(p)] * (len(p.traces) < 2))
    )
    monkeypatch.setattr(premises, "search", lambda problem, log, state: state)
    monkeypatch.setattr(premises, "_wider", lambda *_: None)
    found, state = premises.settled(tuple(made), (True, False), "exact", [])
    assert found.lasting == (comes_again,)
    corrected = diagnosis._corrected(
        Arm.panda(), found, found.background if comes_again else (), state, refitted=True
    )
    assert len(corrected.effects) == comes_again


@pytest.mark.parametrize("further", [False, True])
def test_premises_are_weighed_again_only_with_another_model(monkeypatch, further):
    trace = prepare(
        simulate(panda_mjcf(), random_trajectory(panda_mjcf(), 1, period=3.0), duration=3.0, rate=200.0,
                 friction=JointFriction(), sensors=Sensors(torque_noise=0.05)), Arm.panda())  # fmt: skip
    weighed = []
    monkeypatch.setattr(premises, "laws", lambda problem, log, terms=(): start(problem))
    monkeypatch.setattr(premises, "search", lambda problem, log, state: start(problem) if further else state)
    monkeypatch.setattr(premises, "_wider", lambda _, state: weighed.append(state))
    _, state = premises.settled((trace,), (True,), "identified", [])
    assert len(weighed) == (2 if further else 1)
    assert state is weighed[-1]
