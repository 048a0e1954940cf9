"""What no law explains is not credited to several laws together: the model may have slow errors of its own."""

import numpy as np
import pytest
import scipy.ndimage
from helpers import record

from jaxpanda.diagnosis import diagnose


@pytest.fixture(scope="module")
def wandering():
    """A recording whose torque is off by smooth noise, five times the sensors', in joints 2 and 4."""

    def off(t, q, qd, qdd):
        rng, out = np.random.default_rng(4), np.zeros_like(q)
        for j in (1, 3):
            slow = scipy.ndimage.gaussian_filter1d(rng.normal(size=len(t)), 1.0 * len(t) / t[-1])
            out[:, j] = 0.25 * slow / slow.std()
        return out

    return off


@pytest.mark.slow
def test_slow_errors_of_the_model_are_no_physics(wandering):
    found = diagnose(None, [record(5, wandering), record(6, wandering)])
    assert any("slow errors" in note for note in found.notes)
    assert found.verdict != "explained"
    assert not any(f.confidence > 0.5 for f in found.findings if f.effect != "unknown")
