"""What laws are off, and what a model is worth with that: the parts of the decision, each by itself."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import NOISE, record

from jaxpanda import Arm
from jaxpanda.effects import CATALOGUE, neighbours
from jaxpanda.effects.drive import Armature, JointSpring, TorqueRipple
from jaxpanda.effects.friction import (
    AsymmetricFriction,
    CoulombFriction,
    FrictionDrift,
    LoadDependentFriction,
    PowerLawFriction,
    ViscousFriction,
)
from jaxpanda.effects.memory import PreslidingHysteresis
from jaxpanda.effects.sensing import TorqueOffset
from jaxpanda.effects.stribeck import StribeckFriction
from jaxpanda.inference.discrepancy import at_rest, of_known, of_law, unresolved
from jaxpanda.inference.evidence import Design, Noise
from jaxpanda.inference.state import (
    State,
    evidence,
    gains,
    in_noise,
    likelier,
    places,
    start,
    with_terms,
    without,
)
from jaxpanda.search.events import swept
from jaxpanda.search.premises import pose
from jaxpanda.search.proposals import grids
from jaxpanda.search.steps import exchange, posterior, prune, remade, search
from jaxpanda.traces import prepare, trajectory

DAMPING = 20.0


def posed(*extras, arm=None, seconds=8.0):
    own = arm or Arm.panda()
    traces = tuple(
        prepare(record(k, extra, arm=arm, seconds=seconds), own) for k, extra in enumerate(extras, 30)
    )
    return pose(traces, (True,) * len(traces), "exact").problem


@pytest.fixture(scope="module")
def quiet():
    """Of a recording in which nothing is missing."""
    return posed(None)


@pytest.fixture(scope="module")
def damped():
    """Of an arm whose fourth joint has strong damping that is 2 % off, more at some speeds than at others."""

    def off(t, q, qd, qdd):
        smooth = DAMPING * qd[:, 3] * (1 + 0.02 * np.cos(2 * np.pi * qd[:, 3] / np.ptp(qd[:, 3])))
        return smooth[:, None] * np.eye(7)[3]

    return posed(off)


@pytest.fixture(scope="module")
def rippled():
    """The same damping with a ripple of 2 % of its torque beside it."""

    def off(t, q, qd, qdd):
        tau = DAMPING * qd[:, 3]
        return (tau + 0.02 * np.sqrt(2) * tau.std() * np.sin(60 * q[:, 3]))[:, None] * np.eye(7)[3]

    return posed(off)


def of(problem, effect, c, std=None):
    """The discrepancy's columns of an effect with coefficients."""
    evaluate = lambda other: [x @ c for x in problem.full_columns(other)]
    std = problem.noise(()).std if std is None else std
    return of_law(problem.traces, effect, evaluate(effect), std, evaluate)


def believed(problem, effect, c):
    """A state with the effect as a term with its discrepancy, and one with the law alone."""
    std = problem.noise(()).std
    term = problem.term(effect, np.abs(c), np.asarray(c), std, prior=-20.0)
    return with_terms(problem, [term]), with_terms(problem, [term.law])


def best(problem, state, name, joint=3):
    """Evidence, prior included, of the likeliest shape of an effect beside a state, at one joint."""
    library = [g for g in problem.library if (g.name, g.joint) == (name, joint)]
    proposals = [
        *grids(problem, state.design, state.noise, library),
        *swept(problem, state.design, state.noise, [joint]),
    ]
    (found,) = (p for p in proposals if p.effect.name == name)
    return found.evidence + found.effect.prior


def test_a_law_far_below_the_noise_has_no_discrepancy(quiet):
    law = ViscousFriction(3)
    assert of(quiet, law, np.array([1e-3 * NOISE])) == []
    columns = of(quiet, law, np.array([1e3 * NOISE]))
    assert columns[0].shape[2] > 0
    assert not np.any(np.delete(columns[0], 3, 1))  # it is off where it acts, and nowhere else


def test_discrepancy_grows_with_the_law(quiet):
    one, ten = (of(quiet, JointSpring(3, "linear", -1.5), np.array([c, 0.0])) for c in (100.0, 1000.0))
    np.testing.assert_allclose(ten[0], 10 * one[0], rtol=1e-9, atol=1e-12)
    spread = np.sqrt(np.sum(one[0][:, 3] ** 2, 1))
    torque = np.abs(quiet.full_columns(JointSpring(3, "linear", -1.5))[0][:, 3] @ [100.0, 0.0])
    assert np.all(spread < 0.1 * torque + 1e-9)  # 2 % along each of three channels, hats overlapping
    assert spread.max() > 0.01 * torque.max()


def test_dry_friction_may_turn_in_other_ways(quiet):
    """Over other speeds, or over a distance: then it would be none of the catalogue's other laws."""
    (columns,) = of(quiet, CoulombFriction(3, 0.01), np.array([100 * NOISE]))
    (smooth,) = of(quiet, ViscousFriction(3), np.array([100 * NOISE]))
    slow = quiet.full_columns(CoulombFriction(3, 0.03))[0][:, 3, 0]
    fast = quiet.full_columns(CoulombFriction(3, 0.01))[0][:, 3, 0]
    left = lambda A: np.linalg.norm((slow - fast) - A @ np.linalg.lstsq(A, slow - fast)[0])
    assert left(columns[:, 3]) < 0.05 * np.linalg.norm(slow - fast)
    assert left(smooth[:, 3]) > 0.5 * np.linalg.norm(slow - fast)


def test_known_friction_far_below_the_noise_has_no_discrepancy():
    level = jnp.zeros(7).at[3].set(0.5)
    trace = prepare(record(30), dataclasses.replace(Arm.panda(), frictionloss=level))
    (some,), (none,) = of_known([trace], np.full(7, NOISE)), of_known([trace], np.full(7, 1e4 * NOISE))
    assert some.shape[2] > 0
    assert not np.any(np.delete(some, 3, 1))
    assert none.shape[2] == 0


def test_known_damping_is_a_law_like_known_friction_of_coulombs_kind():
    """Off by more at one speed than at another, in proportion to what it is there."""
    arm = dataclasses.replace(Arm.panda(), damping=jnp.zeros(7).at[3].set(DAMPING))
    trace = prepare(record(30), arm)
    (off,) = of_known([trace], np.full(7, NOISE))
    assert off.shape[2] > 0
    assert not np.any(np.delete(off, 3, 1))
    spread, torque = np.sqrt(np.sum(off[:, 3] ** 2, 1)), DAMPING * np.abs(trace.motion.qd[:, 3])
    share = spread[torque > 10 * NOISE] / torque[torque > 10 * NOISE]
    assert share.min() > 0.01
    assert share.max() < 0.05


def test_what_no_column_describes_is_a_share_of_the_torque_and_of_its_rate(quiet):
    trace = quiet.traces[0]
    steady = np.full((trace.motion.samples, 7), 2.0)
    np.testing.assert_allclose(unresolved([trace], [steady]), 0.06**2)
    ramp = np.outer(trace.motion.time, np.eye(7)[3])
    off = unresolved([trace], [ramp])
    np.testing.assert_allclose(off[:, 3], (0.03 * trace.motion.time) ** 2 + 0.005**2, rtol=1e-6)
    assert not off[:, :3].any()


def test_dry_friction_is_not_known_where_its_joint_rests(quiet):
    trace = quiet.traces[0]
    rests = np.zeros((trace.motion.samples, 7))
    rests[:20, 3] = 1.0
    trace = dataclasses.replace(trace, unsure=rests)
    torque = [np.sign(trace.motion.qd) * np.eye(7)[3]]
    dry = at_rest([trace], CoulombFriction(3, 0.01), torque)
    np.testing.assert_allclose(dry, rests, rtol=1e-9)
    assert at_rest([trace], ViscousFriction(3), torque) is None


def test_two_hundredths_of_a_strong_law_that_vary_with_speed_are_no_second_effect(damped):
    """Believed to the last digit, the damping left what would be called another friction."""
    state, exact = believed(damped, ViscousFriction(3), np.array([DAMPING]))
    rest = [n for n in ("stribeck_friction", "power_law_friction", "coulomb_friction", "torque_ripple")]
    sure = in_noise(damped, exact.terms, damped.noise(exact.terms))
    assert max(best(damped, sure, name) for name in rest) > 20
    assert max(best(damped, state, name) for name in rest) < 0


def test_two_hundredths_of_a_strong_law_of_another_shape_are_a_second_effect(rippled):
    state, _ = believed(rippled, ViscousFriction(3), np.array([DAMPING]))
    assert best(rippled, state, "torque_ripple") > 20


def test_a_term_s_law_has_no_columns_of_a_discrepancy_and_trusts_no_more_samples(damped):
    state, exact = believed(damped, CoulombFriction(3, 0.01), np.array([DAMPING]))
    (term,), (law,) = state.terms, exact.terms
    assert term.width > len(term.deviation) == law.width == 1
    assert law.discrepancy == ()
    assert law.unresolved is term.unresolved
    assert law.at_rest is term.at_rest
    assert term.unresolved is not None
    assert (term.exact.discrepancy, term.exact.unresolved, term.exact.at_rest) == ((), None, None)
    assert law.effect is term.effect
    assert law.columns is term.columns
    assert law.prior == term.prior
    assert term.law.law.width == 1


def test_a_term_without_known_coefficients_is_its_law(quiet):
    term = quiet.term(ViscousFriction(3), np.ones(1))
    assert (term.width, term.discrepancy, term.unresolved) == (1, (), None)


def test_white_noise_is_likeliest_in_its_own_deviation():
    rng = np.random.default_rng(0)
    found = {}
    x = 0.3 * rng.normal(size=4000)
    for sigma in (0.2, 0.3, 0.45):
        design = Design([np.zeros((4000, 0))], [x / sigma], np.zeros(0))
        noise = Noise(np.zeros((1, 3)), np.array([sigma]), np.array([sigma]))
        found[sigma] = State((), noise, design, 1).score
    assert max(found, key=lambda s: found[s]) == 0.3
    density = {s: -0.5 * np.sum(x**2) / s**2 - 4000 * np.log(s) for s in found}
    for s in found:
        assert found[s] - found[0.3] == pytest.approx(density[s] - density[0.3], rel=1e-9)


def test_samples_of_which_laws_tell_less_are_worth_what_they_are_likely_in_their_noise():
    """White noise whose deviation doubles half-way: less trust in that half is likelier."""
    rng = np.random.default_rng(1)
    width = np.repeat([1.0, 2.0], 1000)
    x, score = width * rng.normal(size=2000), {}
    for name, trust in (("right", 1 / width), ("wrong", width / 2), ("all", np.ones(2000))):
        design = Design([np.zeros((2000, 0))], [x * trust], np.zeros(0))
        noise = Noise(np.zeros((1, 3)), np.ones(1), np.ones(1), trust[:, None])
        score[name] = State((), noise, design, 1).score
    assert score["right"] > score["all"] + 100
    assert score["all"] > score["wrong"] + 100


@pytest.mark.parametrize(("unresolved", "quiet"), [(0.0, 1.0), (1.0, 1.0), (0.5, 0.3)])
def test_what_a_rest_holds_is_one_number_however_many_samples_it_lasts(unresolved, quiet):
    """Against the density of noise about a level that nobody knows; as one of each sample it cost 460 nats.

    Noise may be less than at other times, and less than what laws may be off from sample to sample.
    """
    count, variance = 200, 100.0
    x = np.sqrt(quiet) * np.random.default_rng(2).normal(size=count)
    stays = np.full((count, 1), variance)
    trust = 1 / np.sqrt(1 + unresolved + stays)
    noise = Noise(np.zeros((1, 3)), np.ones(1), np.ones(1), trust, stays, quiet=np.array([quiet]))
    score = State((), noise, Design([np.zeros((count, 0))], [x * trust[:, 0]], np.zeros(0)), 1).score
    wide = (1 + unresolved) * np.eye(count) + variance
    exact = -0.5 * (x @ np.linalg.solve(wide, x) + np.linalg.slogdet(wide)[1])
    assert score == pytest.approx(exact, abs=10)
    of_each = dataclasses.replace(noise, at_rest=None)
    apart = 0.5 * count * np.log(1 + unresolved + variance)
    assert of_each.widened(0, np.ones(count, bool)) == pytest.approx(apart)


def test_each_rest_has_a_number_of_its_own():
    stays = np.zeros((30, 1))
    stays[[*range(5), *range(10, 20)]] = 9.0
    noise = Noise(np.zeros((1, 3)), np.ones(1), np.ones(1), 1 / np.sqrt(1 + stays), stays)
    counts = np.arange(30) != 15  # a gap in the second rest
    rests = np.log1p(45) + np.log1p(45) + np.log1p(36)
    assert noise.widened(0, counts) == pytest.approx(0.5 * (rests + 14 * 0.9))


def test_whitened_products_take_what_stays_for_a_rest_as_one_number():
    """Against the inverse of the covariance: of the samples, and of a level in each rest."""
    rng, rows = np.random.default_rng(3), 90
    weights, stays = rng.uniform(0.2, 1.0, rows), np.zeros((rows, 1))
    stays[10:40], stays[41:44], stays[80:90] = 100.0, 4.0, rng.uniform(1.0, 9.0, (10, 1))
    noise = Noise(np.zeros((1, 3)), np.ones(1), np.ones(1), stays=stays)
    covariance = np.diag(weights**-2)
    for rest in (slice(10, 40), slice(41, 44), slice(80, 90)):
        level = np.zeros(rows)
        level[rest] = np.sqrt(stays[rest, 0])
        covariance += np.outer(level, level)
    x = rng.normal(size=(rows, 4))
    x[:3] = 0.0  # which have no past
    found = noise.whiten(x, 0, weights, slice(0, rows))
    np.testing.assert_allclose(found.T @ found, x.T @ np.linalg.solve(covariance, x), rtol=1e-9)
    held = np.where(stays[:, 0] == 100, 8.0, 0.0)
    assert np.sum(noise.whiten(held, 0, weights, slice(0, rows)) ** 2) < 0.65  # 8^2 / 100, not 8^2 a sample


def test_products_with_what_is_whitened_are_those_of_the_transposed_with_what_is_not():
    rng, rows = np.random.default_rng(5), 120
    weights = rng.uniform(0.2, 1.0, rows) * (np.arange(rows) % 50 != 0)
    stays = np.zeros((rows, 1))
    stays[20:60], stays[90:95] = 100.0, 4.0
    a, slow = np.array([[0.6, -0.2, 0.1]]), np.array([[0.99, 0.9]])
    x, y = rng.normal(size=(rows, 3)), rng.normal(size=(rows, 2))
    for noise in (
        Noise(a, np.full(1, 0.3), np.ones(1)),
        Noise(a, np.full(1, 0.3), np.ones(1), stays=stays),
        Noise(a, np.full(1, 0.3), np.ones(1), stays=stays, slow=slow),
    ):
        here = 0, weights, slice(0, rows)
        np.testing.assert_allclose(
            noise.whiten(x, *here).T @ y, x.T @ noise.transposed(y, *here), rtol=1e-9, atol=1e-12
        )


def resting(level: float, held: float, seconds: float = 30.0):
    """A recording in which the fourth joint rests for all but 7 s, held there by so much of its friction."""
    r = record(33, seconds=seconds)
    moves = np.clip(np.maximum(4.5 - r.time, r.time - seconds + 3) / 0.5, 0, 1)
    rng = np.random.default_rng(4)
    q = r.q.copy()
    q[:, 3] = -1.5 + 0.5 * np.sin(6 * np.pi * np.cumsum(moves) / len(moves))
    q += 1e-5 * rng.normal(size=q.shape)
    motion = trajectory(dataclasses.replace(r, q=q, tau=None)).trace(Arm.panda()).motion
    tau, speed = (
        np.stack([np.interp(r.time, motion.time, x) for x in channel.T], 1)
        for channel in (motion.torque, motion.qd)
    )
    tau[:, 3] += np.where(np.abs(speed[:, 3]) > 2e-3, level * np.sign(speed[:, 3]), held)
    return dataclasses.replace(r, q=q, tau=tau + NOISE * rng.normal(size=q.shape))


@pytest.mark.slow
def test_what_known_friction_holds_through_a_long_rest_is_no_law_of_its_own():
    """Nearly its level, for 22 s: of each sample by itself it made a contact or a drift likelier by 500 nats."""
    arm, steps = dataclasses.replace(Arm.panda(), frictionloss=jnp.zeros(7).at[3].set(2.0)), []
    search(pose((prepare(resting(2.0, 1.9), arm),), (True,), "exact").problem, steps)
    assert not [step for step in steps if step.startswith("add")]


@pytest.mark.slow
@pytest.mark.parametrize("held", [0.5, 0.2, -0.3])
def test_friction_that_holds_a_load_through_a_long_rest_is_friction_alone(held):
    """What it holds is no offset beside it."""
    problem = pose((prepare(resting(0.5, held), Arm.panda()),), (True,), "exact").problem
    (term,) = search(problem).terms
    assert (term.effect.family, term.effect.joints) == ("friction", (3,))


def test_what_a_law_may_be_off_follows_what_it_explains(damped):
    """A law taken in alone, whose torque others explain now, kept samples and columns that it might be off by for
    that torque, and with them its place."""
    c, std = np.array([3.0]), np.full(7, NOISE)
    alone = damped.term(CoulombFriction(3, 0.01), c, c, std)
    beside = damped.term(ViscousFriction(3), np.array([DAMPING]), np.array([DAMPING]), std)
    state = with_terms(damped, [alone, beside])
    found = remade(damped, state)
    assert found.terms[1] is beside
    left = found.design.x[places(found)[0]]
    assert abs(left[0]) < 0.2 * c[0]
    share = found.terms[0].at_rest.sum() / alone.at_rest.sum()
    assert share < 4 * (left[0] / c[0]) ** 2 + 1e-9
    assert remade(damped, found).terms == found.terms


@pytest.mark.slow
def test_friction_is_neither_exchanged_nor_dropped_for_what_is_less_likely_in_its_own_noise(monkeypatch):
    """In friction's noise a rest tells little for it: an offset in its place looked likelier, then went."""
    problem = pose((prepare(resting(0.5, 0.5), Arm.panda()),), (True,), "exact").problem
    state = with_terms(
        problem,
        [problem.term(CoulombFriction(3, 0.003), np.array([0.5]), np.array([0.5]), np.full(7, NOISE))],
    )
    offset = problem.term(TorqueOffset(3), np.array([0.5]))
    other = with_terms(problem, [offset])
    assert likelier((problem, state), (problem, other)) < 0
    tempting = lambda *_: ([(1e6, (offset,)), (0.0, (state.terms[0],))], False)
    monkeypatch.setattr("jaxpanda.search.steps.instead", tempting)
    monkeypatch.setattr("jaxpanda.search.steps.gains", lambda *_: [-1e6])
    assert exchange(problem, state, lambda _: None) is state
    assert prune(problem, state, lambda _: None) is state


def test_the_noise_of_a_joint_takes_what_nothing_explains_yet(damped, quiet):
    before, after = start(damped), believed(damped, ViscousFriction(3), np.array([DAMPING]))[0]
    own = damped.noise(()).sigma
    assert before.noise.sigma[3] > 3 * own[3]
    np.testing.assert_allclose(before.noise.sigma[[0, 1, 2, 4, 5, 6]], own[[0, 1, 2, 4, 5, 6]], rtol=0.25)
    assert after.noise.sigma[3] < 0.5 * before.noise.sigma[3]
    assert after.score > before.score + 100
    np.testing.assert_allclose(start(quiet).noise.sigma, quiet.noise(()).sigma, rtol=0.25)


def test_coefficients_are_found_whatever_the_discrepancy_beside_them_is_wide(damped):
    state, _ = believed(damped, ViscousFriction(3), np.array([DAMPING]))
    offset = damped.term(TorqueOffset(1), np.array([0.2]))
    both = in_noise(damped, [*state.terms, offset], state.noise)
    first, second = places(both)
    assert both.terms[0].width > 1
    assert (first.stop - first.start, second.stop - second.start) == (1, 1)
    assert second.stop == len(both.design.precision)
    assert second.start == first.start + both.terms[0].width
    assert both.design.x[first] == pytest.approx([DAMPING], rel=0.05)
    assert both.design.precision[second] == pytest.approx([25.0])


def test_a_gain_is_what_the_model_loses_without_the_term_and_its_discrepancy(damped):
    state, _ = believed(damped, ViscousFriction(3), np.array([DAMPING]))
    offset = damped.term(TorqueOffset(1), np.array([0.2]), prior=-30.0)
    both = in_noise(damped, [*state.terms, offset], state.noise)
    for i in range(2):
        others = [t for k, t in enumerate(both.terms) if k != i]
        less = in_noise(damped, others, state.noise)
        lost = (
            evidence(damped, both.terms, both.design, both.noise)
            - evidence(damped, others, less.design, less.noise)
            + both.terms[i].prior
        )
        assert gains(damped, both)[i] == pytest.approx(lost, rel=1e-6, abs=1e-6)
        assert without(both, i).log_evidence == pytest.approx(less.design.log_evidence, rel=1e-9)


def test_what_is_explained_leaves_out_what_belongs_to_a_recording():
    """Encoders' noise, how known friction turned and what laws are off are no model's."""
    arm = dataclasses.replace(Arm.panda(), frictionloss=jnp.zeros(7).at[3].set(0.5))
    rubs = lambda t, q, qd, qdd: (0.5 * np.tanh(qd[:, 3] / 0.01) + DAMPING * qd[:, 3])[:, None] * np.eye(7)[3]
    trace = prepare(record(30, rubs), arm)
    problem = pose((trace,), (True,), "identified").problem
    n = problem.nuisance[0].shape[2]
    assert problem.shaken.stop == n
    assert problem.known_off.stop == problem.shaken.start > problem.known_off.start
    state, _ = believed(problem, ViscousFriction(3), np.array([DAMPING]))
    term = state.terms[0]
    x = 1.0 + np.arange(n + term.width)
    kept = problem.explained(x, state.terms)
    assert len(kept) == n + len(term.deviation)
    np.testing.assert_array_equal(kept[: problem.known_off.start], x[: problem.known_off.start])
    assert not kept[problem.known_off].any()
    assert not kept[problem.shaken].any()
    np.testing.assert_array_equal(kept[n:], x[n : n + 1])
    assert x[0] == 1.0  # what was given stays as it was
    assert x[problem.shaken].all()


@pytest.mark.parametrize("cls", CATALOGUE, ids=lambda cls: cls.name)
def test_neighbouring_shapes_stay_within_bounds(cls):
    for effect in cls.grid(Arm.panda())[::17]:
        corners = [effect]
        for shape in effect.shapes:
            corners += [
                dataclasses.replace(effect, **{shape.name: x})
                for x in (shape.lower, shape.upper)
                if np.isfinite(x)
            ]
        for one in corners:
            for other in neighbours(one):
                moved = [s for s in one.shapes if getattr(other, s.name) != getattr(one, s.name)]
                assert len(moved) == 1
                (shape,) = moved
                assert not shape.pivot
                assert shape.lower <= getattr(other, shape.name) <= shape.upper


def test_a_form_that_holds_other_laws_pays_for_each_of_them():
    coulomb, viscous = CoulombFriction.prior, ViscousFriction.prior
    for form, parts in (
        (StribeckFriction(3, 0.1, 0.01, 2.0, "extra"), 0.0),
        (StribeckFriction(3, 0.1, 0.01, 2.0, "whole"), coulomb),
        (StribeckFriction(3, 0.1, 0.01, 2.0, "viscous"), coulomb + viscous),
        (AsymmetricFriction(3, 0.01, "full"), coulomb + viscous),
        (AsymmetricFriction(3, 0.01, "viscous"), viscous),
        (LoadDependentFriction(3, 0.01, 1.0, "coulomb directed"), coulomb),
        (LoadDependentFriction(3, 0.01, 1.0, "directed"), 0.0),
        (PreslidingHysteresis(3, 0.01, "dahl whole"), coulomb),
        (PreslidingHysteresis(3, 0.01, "dahl extra"), 0.0),
    ):
        assert form.form_prior == pytest.approx(parts), form
        assert form.form_prior == pytest.approx(sum(part.prior for part in form.held))
        # rarer than its parts alone: it is chosen only where it explains more than they
        assert form.prior + form.form_prior < parts + CoulombFriction.prior


@pytest.mark.parametrize("form", ["both", "both extra"])
def test_friction_that_drifts_pays_for_the_steady_laws_that_it_holds(form):
    drift = FrictionDrift(3, 5.0, 0.01, form)
    steady = [type(law) for law in drift.steady]
    assert list(drift.held) == steady
    assert drift.form_prior == pytest.approx(sum(law.prior for law in steady))


def test_hysteresis_over_a_hair_s_breadth_is_coulomb_s_friction_unless_that_is_known():
    fine, coarse = 0.7e-3, 3e-3  # rad
    titles = {
        (form, x): PreslidingHysteresis(2, x, f"dahl {form}").title
        for form in ("only", "whole", "extra")
        for x in (fine, coarse)
    }
    assert titles["only", fine] == titles["whole", fine] == "coulomb_friction"
    assert {titles[form, coarse] for form in ("only", "whole")} == {"presliding_hysteresis"}
    assert titles["extra", fine] == titles["extra", coarse] == "presliding_hysteresis"


@pytest.mark.parametrize(
    ("exponent", "title"),
    [(0.5, "power_law_friction"), (0.9, "viscous_friction"), (1.1, "viscous_friction"),
     (1.5, "power_law_friction"), (2.0, "power_law_friction")],
)  # fmt: skip
def test_friction_nearly_proportional_to_the_speed_is_viscous(exponent, title):
    assert PowerLawFriction(2, exponent).title == title


@pytest.mark.parametrize(
    ("cls", "number"),
    [(ViscousFriction, "damping"), (CoulombFriction, "frictionloss"), (Armature, "armature")],
)
def test_there_may_be_less_of_a_number_that_the_model_has_and_no_less_than_none(cls, number):
    plain, joints = Arm.panda(), jnp.zeros(7).at[2].set(0.3)
    arm = dataclasses.replace(plain, **{number: joints})
    assert {e.form for e in cls.grid(plain)} == {""}
    forms = {e.joints[0]: e for e in cls.grid(arm)}
    assert [forms[j].form for j in range(7)] == ["", "", "signed", "", "", "", ""]
    assert forms[2].coefficients[0].sign == 0
    assert forms[3].coefficients[0].sign == 1
    assert forms[2].prior + forms[2].form_prior == pytest.approx(-10.0)
    assert forms[3].form_prior == 0.0


@pytest.mark.slow
def test_damping_that_the_model_has_too_much_of_is_a_negative_correction():
    arm = dataclasses.replace(Arm.panda(), damping=jnp.zeros(7).at[3].set(2.0))
    less = lambda t, q, qd, qdd: 0.5 * qd[:, [3]] * np.eye(7)[3]  # `record` makes none of the arm's own
    problem = pose((prepare(record(30, less), arm),), (True,), "identified").problem
    state = search(problem)
    (term,) = state.terms
    assert (term.effect.name, term.effect.joints, term.effect.form) == ("viscous_friction", (3,), "signed")
    assert state.design.x[places(state)[0]] == pytest.approx([-1.5], rel=0.05)
    own = posterior(problem, state, 0)
    assert sum(own.values()) <= 1 + 1e-9
    assert min(own.values()) >= 0
    assert own["viscous_friction"] > 0.9


def test_of_a_term_that_explains_nothing_none_at_all_takes_most(quiet):
    noise = in_noise(
        quiet, [quiet.term(TorqueRipple(3, 60.0, "one"), np.ones(2), prior=-25.0)], quiet.noise(())
    )
    probability = posterior(quiet, noise, 0)
    assert sum(probability.values()) < 0.1
