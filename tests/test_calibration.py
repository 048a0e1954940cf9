"""Confidence: from weights among models to how often such findings are right."""

import dataclasses

import numpy as np
import pytest

from jaxpanda.diagnosis.calibration import calibrated
from jaxpanda.diagnosis.finding import Finding, Fit

NOISE = np.array([0.1, 0.2])


def errors(held_out):
    """A fit that leaves so much where it was not fitted, in noise of `NOISE`."""
    return Fit(2 * held_out, held_out, 2 * held_out, held_out, NOISE)


def found(rms_torque, confidence=0.9, alternatives=(("armature", 0.08),), foretold: float | None = 30.0):
    return Finding(
        effect="viscous_friction",
        joints=(0,),
        recordings=("a.csv",),
        intervals=None,
        confidence=confidence,
        alternatives=alternatives,
        equation="tau = damping * dq",
        parameters=(),
        rms_torque=np.array(rms_torque),
        evidence=10.0,
        summary="",
        terms=(0,),
        foretold=foretold,
        torque_std=0.1 * np.array(rms_torque),
    )


def sure(findings, verdict="explained", held_out=NOISE):
    return [f.confidence for f in calibrated(findings, verdict, errors(held_out))]


def test_a_law_that_makes_up_its_joint_is_surer_than_one_that_is_small_beside_it():
    large, small = sure([found([1.0, 0.0]), found([0.05, 0.0])])
    assert large > 0.85
    assert small < large - 0.2


def test_nothing_is_as_sure_where_something_stays_unexplained():
    (explained,), (partly,) = sure([found([1.0, 0.0])]), sure([found([1.0, 0.0])], "partly_explained")
    assert 1 - partly > 1.5 * (1 - explained)


def test_what_acts_for_a_while_only_is_doubted():
    always = dataclasses.replace(found([1.0, 0.0]), parameters=({"name": "damping", "value": 1.0},))
    at_times = dataclasses.replace(always, intervals=((1.0, 2.0),))
    lasting, passing = sure([always, at_times])
    assert 1 - passing > 1.5 * (1 - lasting)


def test_torque_that_is_small_beside_what_stays_wrong_elsewhere_is_doubted():
    one = found([1.0, 0.0])
    # it may have taken in half of that
    unsure = lambda x: dataclasses.replace(one, torque_std=np.array([0.5 * x, 0.0]))
    clear, small = (sure([unsure(x)], held_out=np.array([x, 0.2]))[0] for x in (0.1, 1.0))
    assert small < clear - 0.3


def test_torque_that_is_not_clear_of_what_it_may_be_off_is_doubted():
    one = found([1.0, 0.0])
    clear, unclear, not_at_all = (
        sure([dataclasses.replace(one, torque_std=one.rms_torque / z)])[0] for z in (10.0, 2.0, 0.5)
    )
    assert 1 - unclear > 1.5 * (1 - clear)
    assert 1 - not_at_all > 1.5 * (1 - unclear)
    assert sure([dataclasses.replace(one, torque_std=None)])[0] < clear


def test_what_does_not_help_where_it_was_not_fitted_is_doubted():
    helps, nothing, misleads = (sure([found([1.0, 0.0], foretold=x)])[0] for x in (30.0, 0.0, -30.0))
    assert 1 - nothing > 1.5 * (1 - helps)
    assert 1 - misleads > 1.5 * (1 - nothing)


def test_of_what_foretells_nothing_the_evidence_counts():
    (of_evidence,), (foretold,) = (
        sure([found([1.0, 0.0], foretold=None)]),
        sure([found([1.0, 0.0], foretold=10.0)]),
    )
    assert of_evidence == foretold


def test_a_held_out_error_below_the_noise_counts_as_noise():
    below, at = (sure([found([1.0, 0.0])], held_out=x * NOISE) for x in (0.5, 1.0))
    assert below == at


def test_the_weight_is_kept_and_probabilities_of_a_place_add_up_to_one_at_most():
    for weight in (0.0, 0.1, 0.6, 0.995):
        before = found([1.0, 0.0], weight, (("armature", 1 - weight),))
        (after,) = calibrated([before], "explained", errors(NOISE))
        assert after.posterior == weight
        assert 0 < after.confidence <= 0.995
        assert after.confidence + sum(p for _, p in after.alternatives) <= 1 + 1e-12
        unchanged = dataclasses.replace(
            after, confidence=weight, posterior=None, alternatives=before.alternatives
        )
        assert unchanged == before


@pytest.mark.parametrize("verdict", ["explained", "partly_explained"])
def test_more_weight_and_more_torque_never_make_less_sure(verdict):
    by_weight = [sure([found([1.0, 0.0], w)], verdict)[0] for w in (0.01, 0.3, 0.7, 0.99)]
    by_torque = [sure([found([x, 0.0])], verdict)[0] for x in (0.01, 0.1, 1.0, 10.0)]
    assert by_weight == sorted(by_weight)
    assert by_torque == sorted(by_torque)


def test_nothing_found_stays_nothing():
    assert calibrated([], "consistent", errors(NOISE)) == []
