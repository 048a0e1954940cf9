"""Whether positions are differentiated as exactly as their noise allows, wherever in a motion."""

import numpy as np
import pytest

from jaxpanda.smoothing import LEAST, continued_derivatives, smooth

RATE, MOST = 250.0, 25.0
CUTOFFS = np.geomspace(LEAST, MOST, 12)


def pick(seconds: float = 12.0) -> tuple[np.ndarray, np.ndarray]:
    """Moves of half a second of 0.3 rad with sharp bends, rests and one slow glide: q [rad] and qdd [rad/s²]."""
    t = np.arange(int(seconds * RATE)) / RATE
    qdd = np.zeros_like(t)
    for start in (1.0, 3.2, 6.4, 9.0):
        qdd += 6.0 * (np.abs(t - start - 0.125) < 0.125) - 6.0 * (np.abs(t - start - 0.375) < 0.125)
    qdd += -0.05 * np.sin(2 * np.pi * 0.1 * t)
    return np.cumsum(np.cumsum(qdd)) / RATE**2, qdd


def error(q: np.ndarray, step: float, qdd: np.ndarray) -> float:
    """Of the acceleration [rad/s²]."""
    found = smooth(q[:, None], np.array([step]), RATE, MOST).qdd[:, 0]
    return float(np.sqrt(np.mean((found - qdd)[50:-50] ** 2)))


def best(q: np.ndarray, qdd: np.ndarray) -> float:
    """The least error of one low-pass for all of it, as only the truth can choose it."""
    left = [continued_derivatives(q[:, None], c, RATE)[2][:, 0] - qdd for c in CUTOFFS]
    return float(np.min(np.sqrt(np.mean(np.square(left)[:, 50:-50], 1))))


@pytest.mark.parametrize("noise", [1e-5, 1e-4])
@pytest.mark.parametrize("step", [0.0, 1e-5, 3e-4, 2e-3])
def test_where_arm_sets_out_and_where_it_rests_have_their_own_low_pass(noise, step):
    """About as exact as the best of all low-passes, which nobody knows, or more so."""
    q, qdd = pick()
    read = q + noise * np.random.default_rng(0).normal(size=len(q))
    if step:
        read = np.round(read / step) * step
    assert error(read, step, qdd) < 1.1 * best(read, qdd)


def test_low_passes_follow_the_motion():
    q, qdd = pick()
    read = q + 1e-4 * np.random.default_rng(0).normal(size=len(q))
    cutoff = smooth(read[:, None], np.zeros(1), RATE, MOST).cutoff[:, 0]
    near = np.convolve(np.abs(np.diff(qdd, prepend=0)) > 1, np.ones(9), "same") > 0
    far = np.convolve(np.abs(np.diff(qdd, prepend=0)) > 1, np.ones(251), "same") == 0
    assert np.median(cutoff[near]) > 3 * np.median(cutoff[far])


def test_without_noise_the_highest_low_pass_is_taken():
    q, _ = pick()
    whole = smooth(q[:, None], np.zeros(1), RATE, MOST)
    assert np.sqrt(np.mean((whole.qdd - continued_derivatives(q[:, None], MOST, RATE)[2]) ** 2)) < 0.05


def test_a_joint_that_never_moves_has_no_acceleration():
    whole = smooth(np.full((600, 2), 0.3), np.zeros(2), RATE, MOST)
    np.testing.assert_allclose(whole.qdd, 0, atol=1e-8)
    np.testing.assert_allclose(whole.q, 0.3)
