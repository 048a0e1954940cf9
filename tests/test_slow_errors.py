"""What no law explains is not credited to several laws together: the model may have slow errors of its own."""

import numpy as np
import pytest
import scipy.ndimage
from helpers import NOISE, record

from jaxpanda import Arm
from jaxpanda.diagnosis.premises import RUNGS, pose
from jaxpanda.diagnosis.state import start
from jaxpanda.diagnosis.traces import prepare


def wandering(t, q, qd, qdd):
    """Smooth torque without a law, three times the noise, other in each recording."""
    rng = np.random.default_rng(int(1e6 * abs(q[0, 0])))
    slow = scipy.ndimage.gaussian_filter1d(rng.normal(size=q.shape), len(t) / t[-1], axis=0)
    return 3 * NOISE * slow / slow.std(0)


@pytest.mark.parametrize(("extra", "are_there"), [(None, False), (wandering, True)])
def test_slow_errors_are_supposed_where_the_recordings_have_them(extra, are_there):
    traces = tuple(prepare(record(seed, extra), Arm.panda()) for seed in (5, 6))
    log_odds = {slow: price for known, scale, slow, price in RUNGS if (known, scale) == ("identified", 1.0)}

    def score(slow):
        return start(pose(traces, (True, True), "identified", slow=slow).problem).score + log_odds[slow]

    scores = {slow: score(slow) for slow in (0.0, 3.0)}
    assert (scores[3.0] > scores[0.0]) == are_there
    assert abs(scores[3.0] - scores[0.0]) > 5.0


def test_slow_errors_are_not_predicted():
    traces = (prepare(record(5, wandering), Arm.panda()),)
    problem = pose(traces, (True,), "identified", slow=3.0).problem
    state = start(problem)
    at = problem.slow_errors
    assert at.stop - at.start > 7
    assert np.any(state.design.x[at] != 0)
    assert not np.any(problem.explained(state.design.x)[at])
