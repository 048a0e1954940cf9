"""What a diagnosis starts from: the known may be widened, and what healthy recordings show counts everywhere."""

import re

import numpy as np
import pytest

from jaxpanda import Arm, diagnose
from jaxpanda.arms.export import panda_mjcf
from jaxpanda.diagnosis import diagnosis
from jaxpanda.diagnosis.correction import Correction
from jaxpanda.effects.sensing import TorqueOffset
from jaxpanda.inference.problem import Problem
from jaxpanda.inference.state import start, with_terms
from jaxpanda.search import premises
from jaxpanda.search.premises import pose
from jaxpanda.simulation import JointFriction, Sensors, random_trajectory, simulate
from jaxpanda.traces import prepare


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("comes_again", [True, False])
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
    lasting = found.background if comes_again else ()
    assert len(Correction(Arm.panda(), found, state, lasting, moved=True).model.effects) == comes_again


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


@pytest.mark.parametrize("healthy", [pytest.param(False, marks=pytest.mark.slow), True])
def test_numbers_that_healthy_recordings_show_too_are_no_news(monkeypatch, tmp_path, healthy):
    """An arm that differed from its model all the time had its links and rotors told at 0.93 to 0.98."""
    heavier = re.sub(r'(?<= mass=")[0-9.e-]+', lambda found: repr(1.2 * float(found[0])), panda_mjcf())
    (model := tmp_path / "heavier.xml").write_text(heavier)
    made = [
        simulate(panda_mjcf(), random_trajectory(panda_mjcf(), k, period=3.0), duration=3.0, rate=200.0,
                 sensors=Sensors(torque_noise=0.05), seed=k, name=f"{k}.csv")
        for k in range(2)
    ]  # fmt: skip

    def roughly(traces, active, *_, **__):
        posed = pose(traces, active, "rough")
        return posed, start(posed.problem)

    monkeypatch.setattr(diagnosis, "settled", roughly)
    found = diagnose(model, made[:1], reference=made[1:] if healthy else ())
    told = {f.effect for f in found.findings}
    notes = [
        n for n in found.notes if n.startswith("numbers of the model were refitted to recordings of ref")
    ]
    assert ("inertial_parameters" in told) != healthy
    assert bool(notes) == healthy
