"""What estimates of several recordings say together: covered as often as promised, and silent when nothing is."""

import numpy as np
import pytest
import scipy.optimize
from fleets import fleet

from jaxpanda.fleet.hierarchy import discoveries, history

DRAWS = 120
FOUR = 4 * np.sqrt(0.05 * 0.95 / DRAWS)
"""Deviations of a share of 0.05 or 0.95 in so many draws."""


def drawn(rng, count, scatter, drift=0.0):
    std = rng.uniform(0.5, 1.5, count)
    time = np.sort(rng.uniform(0, 30, count))
    value = 2 + drift * (time - time.mean()) + scatter * rng.normal(size=count) + std * rng.normal(size=count)
    return value, std, time


@pytest.mark.parametrize(("count", "scatter"), [(3, 3.0), (6, 1.0), (12, 0.0), (12, 3.0)])
def test_intervals_hold_the_truth_as_often_as_they_say(count, scatter):
    rng = np.random.default_rng(count)
    mean, between, drift = [], [], []
    for _ in range(DRAWS):
        value, std, time = drawn(rng, count, scatter, 0.1)
        h = history(value, std, time).drift
        drift += [] if h is None else [h.interval[0] < 0.1 < h.interval[1]]
        h = history(value - 0.1 * (time - time.mean()), std)
        mean.append(h.mean.interval[0] < 2 < h.mean.interval[1])
        between.append(h.between_interval[0] <= scatter <= h.between_interval[1])
    assert len(drift) == (0 if count == 3 else DRAWS)
    for held in filter(None, (mean, between, drift)):
        assert np.mean(held) > 0.95 - FOUR
        assert scatter < 3 or np.mean(held) < 0.99  # no wider than needed where recordings differ


@pytest.mark.parametrize("scatter", [0.0, 1.0, 5.0])
def test_a_quiet_arm_seldom_drifts_and_nothing_happens_to_it(scatter):
    rng = np.random.default_rng(7)
    told = [history(*drawn(rng, 15, scatter)) for _ in range(DRAWS)]
    drift = np.mean([h.drift is not None and h.drift.p < 0.05 for h in told])
    once = np.mean([h.p_once is not None and h.p_once < 0.05 for h in told])
    assert drift < 0.05 + FOUR
    assert once < 0.05 + FOUR
    assert np.mean([len(h.once) > 0 for h in told]) < 0.01 + 4 * np.sqrt(0.01 / DRAWS)


def test_what_happened_is_told_and_does_not_spoil_the_rest():
    rng = np.random.default_rng(1)
    found, spoiled = 0, 0
    for _ in range(30):
        value, std, time = drawn(rng, 12, 0.5)
        value[3] += 15
        value[8] -= 20
        h = history(value, std, time)
        found += {o.index for o in h.once} == {3, 8}
        spoiled += not abs(h.mean.value - 2) < 4 * h.mean.std
        assert h.count == 12 - len(h.once)
    assert found >= 27
    assert spoiled <= 2


def test_a_drift_is_told_with_its_size():
    rng = np.random.default_rng(2)
    told = [history(*drawn(rng, 15, 0.5, drift=0.2)).drift for _ in range(30)]
    assert sum(d is not None and d.p < 0.01 for d in told) >= 27
    assert abs(np.mean([d.value for d in told if d is not None]) - 0.2) < 0.01


def test_the_variance_solves_the_equation_that_defines_it():
    """Against SciPy's root of the generalised Q, written out on its own."""
    rng = np.random.default_rng(3)
    value, std, _ = drawn(rng, 9, 2.0)

    def excess(variance):
        w = 1 / (variance + std**2)
        return np.sum(w * (value - np.sum(w * value) / np.sum(w)) ** 2) - 8

    h = history(value, std)
    assert h.once == ()
    assert h.between**2 == pytest.approx(scipy.optimize.brentq(excess, 0, 100), rel=1e-8)


def test_units_do_not_matter():
    rng = np.random.default_rng(4)
    value, std, time = drawn(rng, 10, 1.0)
    value[2] += 30
    a, b = history(value, std, time), history(1e6 * value, 1e6 * std, time / 365)
    assert a.drift is not None
    assert b.drift is not None
    assert b.mean.value == pytest.approx(1e6 * a.mean.value)
    assert b.between == pytest.approx(1e6 * a.between)
    assert b.drift.value == pytest.approx(365e6 * a.drift.value)
    assert [o.index for o in b.once] == [o.index for o in a.once] == [2]
    assert b.once[0].expected == pytest.approx(1e6 * a.once[0].expected)


def test_two_recordings_alike_are_no_division_by_zero():
    h = history(np.array([1.0, 1.0]), np.array([0.1, 0.1]), np.array([0.0, 0.0]))
    assert h.between == 0
    assert h.drift is None
    assert h.mean.std == pytest.approx(0.1 / np.sqrt(2))


def test_discoveries_by_hand():
    p = np.array([0.001, 0.02, 0.03, 0.8])  # bounds 0.0125, 0.025, 0.0375, 0.05
    assert discoveries(p).tolist() == [True, True, True, False]
    assert discoveries(np.array([0.02, 0.9, 0.9])).tolist() == [False] * 3
    assert discoveries(np.array([])).tolist() == []


def test_a_quiet_fleet_is_silent_and_a_loud_one_is_heard():
    """False alarms of whole fleets, all quantities of all arms counted; and what is planted in two arms."""
    false, told, claims = 0, 0, 0
    for seed in range(8):
        false += any(q.claimed for arm in fleet(seed, 4, 10).arms for q in arm.quantities)
        loud = fleet(100 + seed, 5, 10, drift=(1,), once=(3,))
        for arm in loud.arms:
            for q in arm.quantities:
                planted = {
                    "arm 001": (q.name, q.joint) == ("coulomb_friction", 1) and q.drifts,
                    "arm 003": (q.name, q.joint) == ("torque_offset", 1) and len(q.apart) == 1,
                }.get(arm.name, False)
                told += planted
                claims += q.drifts + len(q.apart)
    assert false <= 4  # three kinds of claims at one in twenty: 1.2 expected, 5 with probability 0.01
    assert told >= 13
    assert claims - told <= 0.15 * claims
