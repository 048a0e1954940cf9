"""Deviations of what a diagnosis fits: they hold the truth as often as they say, shapes included."""

import numpy as np
import pytest
from helpers import excitation, half_correlated

from jaxpanda import Arm, Recording
from jaxpanda.effects import AbstractEffect, Motion
from jaxpanda.effects.drive import TorqueRipple
from jaxpanda.effects.memory import PreslidingHysteresis
from jaxpanda.effects.stribeck import StribeckBristles, StribeckFriction
from jaxpanda.inference.state import places, start, with_terms
from jaxpanda.search.events import Proposal
from jaxpanda.search.premises import pose
from jaxpanda.search.shapes import first_steps, refine, score
from jaxpanda.search.uncertainty import covariances, leaning, polished
from jaxpanda.traces import prepare

ARM = Arm.panda()
NOISE, CORRELATED = 0.05, 0.9
COULOMB, EXCESS, VELOCITY = 0.2, 0.25, 0.1
AMPLITUDE, ORDER = 0.1, 101.0
REACH = 4e-3


def recording(seed: int, law) -> Recording:
    """One motion of the Panda with correlated noise of its own draw; `law` acts in the fifth joint."""
    t = np.arange(0, 10, 0.005)
    q, qd, qdd = excitation(ARM, t, 7)
    rng = np.random.default_rng(1000 + seed)
    noise = NOISE * half_correlated(rng, q.shape, CORRELATED)
    tau = Motion(ARM, t, q, qd, qdd, np.zeros_like(q)).load + noise
    tau[:, 4] += law(q[:, 4], qd[:, 4])
    return Recording("motion.csv", t, q + 1e-5 * rng.normal(size=q.shape), qd=qd, tau=tau)


def stribeck(q, qd):
    return np.sign(qd) * (COULOMB + EXCESS * np.exp(-np.abs(qd / VELOCITY)))


def ripple(q, qd):
    return AMPLITUDE * np.sin(ORDER * q)


def lugre(q, qd):
    """Five times that, through damped bristles that break away after 4 mrad at most: LuGre's own equations, in
    small steps."""
    most, stiff = 5 * (COULOMB + EXCESS), 5 * (COULOMB + EXCESS) / REACH
    z, out = 0.0, np.zeros_like(q)
    for i, v in enumerate(qd):
        level = most - 5 * EXCESS * (1 - np.exp(-((v / VELOCITY) ** 2)))
        for _ in range(100):
            rate = v - stiff * abs(v) / level * z
            z += rate * 0.005 / 100
        out[i] = stiff * z + 20.0 * rate
    return out


def found_from(effect: AbstractEffect, problem) -> Proposal:
    """What a refinement makes of it beside nothing."""
    nothing = start(problem)
    value, deviation = score(problem, nothing.design, nothing.noise, [effect])
    first = Proposal(effect, float(value[0]), float(value[0]), deviation[0], first_steps(effect))
    return refine(problem, nothing.design, nothing.noise, first)


def test_stribeck_s_friction_in_bristles_is_found_by_its_velocity_and_its_distance():
    """From what turns at once; bristles of one level had more evidence, and a drift of friction took the rest."""
    problem = pose((prepare(recording(0, lugre), ARM),), (True,), "exact").problem
    best = found_from(StribeckFriction(4, 0.1, 0.004, 2.0, "whole"), problem)
    assert isinstance(best.effect, StribeckBristles)
    assert best.effect.form == "lugre"
    assert float(best.effect.stribeck_velocity) == pytest.approx(VELOCITY, rel=0.4)
    assert REACH * COULOMB / (COULOMB + EXCESS) < float(best.effect.breakaway_distance) < REACH
    assert best.best > found_from(PreslidingHysteresis(4, 3e-3, "lugre only"), problem).best + 5


def fitted(seed: int, law, effect: AbstractEffect) -> dict[str, tuple[float, float]]:
    """Value and deviation of each parameter, the effect's shape sought from near the truth."""
    problem = pose((prepare(recording(seed, law), ARM),), (True,), "exact").problem
    best = found_from(effect, problem)
    state = polished(problem, with_terms(problem, [problem.term(best.effect, best.deviation)]))
    c = state.design.x[places(state)[0]]
    told = state.terms[0].effect.parameters(c, covariances(problem, state)[0])
    return {p["name"]: (p["value"], p["std"]) for p in told}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "effect", "truth"),
    [
        (
            stribeck,
            StribeckFriction(4, 0.1, 0.002, 1.0, "whole"),
            {"coulomb": COULOMB, "static_excess": EXCESS, "stribeck_velocity": VELOCITY},
        ),
        (ripple, TorqueRipple(4, ORDER, "one"), {"sine": AMPLITUDE, "order": ORDER}),
    ],
    ids=["stribeck", "ripple"],
)
def test_the_interval_of_a_parameter_holds_the_truth_as_often_as_it_says(law, effect, truth):
    """Of 24 intervals at 95 % at most 4 miss: right ones pass 99.4 times of 100, ones of 75 % 25 times and
    ones of 65 % 4 times."""
    draws = [fitted(seed, law, effect) for seed in range(24)]
    for name, true in truth.items():
        # in logarithms, in which positive numbers spread evenly about their estimate
        off = np.array([np.log(d[name][0] / true) * d[name][0] / d[name][1] for d in draws])
        assert np.sum(np.abs(off) > 1.96) <= 4, (name, off)
        assert off.std() > 0.4, (name, off)  # much too wide would be no better


def test_an_interval_allows_for_what_nobody_modelled_that_goes_along_with_the_law():
    """Torque of the same few motions as the law's, fitted by it in part: an interval by white noise misses it."""
    rng, t, noise = np.random.default_rng(0), np.arange(0, 20, 0.02), 0.05
    motion = lambda: sum(
        rng.normal() * np.sin(0.1 * k * 2 * np.pi * t) + rng.normal() * np.cos(0.1 * k * 2 * np.pi * t)
        for k in (1, 2, 3)
    )
    plain, wider = [], []
    for _ in range(400):
        law, other = motion(), rng.uniform(0, 0.5) * motion()
        tau = law + other + noise * rng.normal(size=len(t))  # of one N m a unit of the law
        held = np.zeros_like(tau)
        for block in np.array_split(np.arange(len(t)), 5):
            rest = np.setdiff1d(np.arange(len(t)), block)
            held[block] = tau[block] - law[block] * (law[rest] @ tau[rest]) / (law[rest] @ law[rest])
        found = (law @ tau) / (law @ law)
        std = noise / np.sqrt(law @ law)
        missed = np.sqrt(max(np.mean(held**2) - noise**2, 0.0))
        size = np.sqrt(np.mean(law**2))
        share = leaning(np.array([abs(found) * size]), np.array([missed]), np.array([noise]))
        plain.append(abs(found - 1) < 1.96 * std)
        wider.append(abs(found - 1) < 1.96 * np.hypot(std, share * found))
    assert np.mean(plain) < 0.3
    assert 0.9 < np.mean(wider) < 0.99


def test_where_nothing_is_missing_an_interval_is_as_it_was():
    law, noise = np.array([0.0, 2.0, 0.5]), np.full(3, 0.1)
    assert leaning(law, np.zeros(3), noise) == 0.0
    assert leaning(np.zeros(3), np.ones(3), noise) == 0.0
    one = leaning(np.array([0.0, 2.0, 0.0]), np.array([9.0, 0.2, 0.0]), noise)
    assert one == pytest.approx(0.5 * 0.2 / 2.0)
