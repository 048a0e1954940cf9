"""Identification: what goes in comes back, within its error bars, and the published figures."""

import dataclasses
import json
import pickle
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from helpers import random_bodies, random_chain, record, to_mjcf
from jaxpanda_kernels import gravity_torque, inertia, mass_matrix

from jaxpanda.arms.arm import Arm
from jaxpanda.arms.panda import published
from jaxpanda.errors import InputError
from jaxpanda.feasible import Bounds
from jaxpanda.friction import Friction
from jaxpanda.identification import (
    Identification,
    MassGravity,
    configurations,
    identify,
    identify_mass_gravity,
    load_mass_gravity,
    mass_gravity_from_mujoco,
    sample_mass_gravity,
)
from jaxpanda.identification import one_step as feasible_fit
from jaxpanda.identification import regression as regression_module
from jaxpanda.identification.condensed import Condensed
from jaxpanda.identification.regression import (
    Regression,
    everything,
    least_squares,
    regression,
    triangle,
    triangles,
)
from jaxpanda.identification.statistics import covariances, samples_as_one
from jaxpanda.parameters import arm_base_parameters, standard_names
from jaxpanda.recordings import Recording, load
from jaxpanda.retrieval import retrieve
from jaxpanda.signals import prepare

FRICTION = Friction(
    "coulomb_viscous_offset",
    {
        "viscous": np.array([0.3, 0.4, 0.2, 0.3, 0.2, 0.1, 0.1]),
        "coulomb": np.array([0.3, 0.2, 0.25, 0.5, 0.25, 0.15, 0.2]),
        "offset": np.array([-0.1, 0.2, 0.1, -0.2, 0.0, 0.05, 0.1]),
    },
)
NOISE = np.array([0.1, 0.1, 0.1, 0.1, 0.03, 0.03, 0.03])


def exciting_motion(
    seconds: float, rate: float = 200.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Time, q, qd, qdd of the paper's exciting trajectory, which repeats itself after 13.3 s."""
    table = published()["exciting_trajectory"]
    a, b = np.array(table["a"]), np.array(table["b"])
    w = 0.15 * np.pi * np.arange(1, 6)
    t = np.arange(0, seconds, 1 / rate)
    s, c = np.sin(w[:, None] * t), np.cos(w[:, None] * t)
    q = (a / w) @ s - (b / w) @ c + np.array(table["q0"])[:, None]
    return t, q.T, (a @ c + b @ s).T, ((b * w) @ c - (a * w) @ s).T


def virtual(
    arm: Arm, seconds: float, friction: Friction = FRICTION, noise: np.ndarray = NOISE, seed: int = 0
) -> Recording:
    """What an arm with that friction would record."""
    t, q, qd, qdd = exciting_motion(seconds)
    rigid = jax.jit(jax.vmap(arm.inverse_dynamics))(jnp.asarray(q), jnp.asarray(qd), jnp.asarray(qdd))
    tau = np.asarray(rigid + friction.torque(jnp.asarray(qd)))
    tau = tau + noise * np.random.default_rng(seed).normal(size=tau.shape)
    return Recording("virtual.csv", t, q, qd, tau)


@pytest.fixture(scope="module")
def found() -> Identification:
    return identify(virtual(Arm.panda(), 20.0), Arm.panda())


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    return arm_base_parameters(Arm.panda()).projection @ np.asarray(Arm.panda().standard).ravel()


# --- from M(q) and g(q)


def exact_samples(arm: Arm, samples: int = 60) -> MassGravity:
    M = jax.jit(lambda q: mass_matrix(arm.chain, arm.standard, q))
    g = jax.jit(lambda q: gravity_torque(arm.chain, arm.standard, q))
    return sample_mass_gravity(lambda q: (M(q), g(q)), configurations(arm, samples))


@pytest.fixture(scope="module")
def samples() -> MassGravity:
    return exact_samples(Arm.panda())


@pytest.mark.parametrize(("kept", "rank"), [("Mg", 43), ("M", 39), ("g", 12)])
def test_mass_and_gravity_of_the_panda_have_the_published_ranks(samples, kept, rank):
    M, g = samples.M if "M" in kept else None, samples.g if "g" in kept else None
    assert identify_mass_gravity(MassGravity("model", samples.q, M, g), Arm.panda()).rank == rank


def test_reverse_engineering_finds_the_parameters_behind_a_model(samples, truth):
    result = identify_mass_gravity(samples, Arm.panda())
    assert np.allclose(result.beta, truth, rtol=0, atol=1e-10)
    assert result.relative_error_percent < 1e-10
    assert result.settings["preferred_gravity"] == pytest.approx(9.80665, abs=1e-4)


def test_samples_made_with_another_gravity_are_found_out():
    arm = Arm.panda()
    chain = dataclasses.replace(arm.chain, gravity=jnp.array([0.0, 0.0, -9.81]))
    samples = exact_samples(dataclasses.replace(arm, chain=chain))
    assert identify_mass_gravity(samples, arm).settings["preferred_gravity"] == pytest.approx(9.81, abs=1e-4)
    assert identify_mass_gravity(samples, arm, gravity=9.81).relative_error_percent < 1e-10


def test_the_published_table_has_the_papers_condition_number_and_less_than_its_error(data: Path):
    result = identify_mass_gravity(data / "gaz_panda" / "mass_gravity_1010.npz", Arm.panda())
    assert result.rank == 43
    assert result.condition_number == pytest.approx(48.906, abs=5e-4)
    assert result.relative_error_percent <= 0.0315
    assert result.cross_validated_relative_error_percent <= 0.0315
    assert result.settings["preferred_gravity"] == pytest.approx(9.81, abs=1e-3)
    values = np.array([row["value"] for row in published()["coefficients"]])
    assert np.allclose(result.beta, values, rtol=0, atol=2e-3)


def test_mass_and_gravity_come_from_a_users_mujoco_model(tmp_path: Path):
    chain, phi = random_chain(3, 4), random_bodies(3, 4)
    path = tmp_path / "arm.xml"
    path.write_text(to_mjcf(chain, phi, 'armature="0.3"'))
    arm = Arm.from_mjcf(path)
    samples = mass_gravity_from_mujoco(path, arm, configurations(arm, 40))
    result = identify_mass_gravity(samples, arm)
    assert result.relative_error_percent < 1e-9
    assert np.allclose(result.beta, result.projection @ np.asarray(phi).ravel(), rtol=0, atol=1e-8)


def test_a_coefficient_lost_in_noise_is_marked_unreliable(samples):
    noise = 0.02 * np.random.default_rng(0).normal(size=samples.M.shape)
    noisy = dataclasses.replace(samples, M=samples.M + noise + np.swapaxes(noise, 1, 2))
    result = identify_mass_gravity(noisy, Arm.panda())
    share = result.std / np.abs(result.beta)
    assert 0 < np.sum(~result.reliable) < 43
    assert np.array_equal(result.reliable, share <= 0.30)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"M": np.ones((4, 6, 6))}, "M has the shape"),
        ({"g": np.full((4, 7), np.nan)}, "g, sample 1, is not finite"),
        ({"M": np.triu(np.ones((4, 7, 7)))}, "M, sample 1, is not symmetric"),
        ({"M": None, "g": None}, "neither M nor g"),
        ({"q": np.zeros((0, 7)), "M": None, "g": np.zeros((0, 7))}, "no samples"),
        (
            {"q": np.zeros((4, 6)), "M": None, "g": np.zeros((4, 6))},
            "has 6 joints, but the arm panda has 7",
        ),
    ],
)
def test_a_malformed_table_of_mass_and_gravity_is_refused(tmp_path, change, message):
    table = {"q": np.zeros((4, 7)), "M": np.tile(np.eye(7), (4, 1, 1)), "g": np.zeros((4, 7)), **change}
    np.savez(tmp_path / "table.npz", **{name: value for name, value in table.items() if value is not None})
    with pytest.raises(InputError, match=message):
        identify_mass_gravity(tmp_path / "table.npz", Arm.panda())


@pytest.mark.parametrize("content", [b"", b"time,q_1\n0,0\n", b"PK\x03\x04 and nothing else"])
def test_a_file_that_is_no_table_is_refused(tmp_path, content):
    (tmp_path / "table.npz").write_bytes(content)
    with pytest.raises(InputError, match=r"table\.npz"):
        load_mass_gravity(tmp_path / "table.npz")


# --- from torque


def test_parameters_and_friction_come_back_within_their_error_bars(found, truth):
    z = (found.beta - truth) / found.std
    assert found.rank == 43
    assert np.mean(np.abs(z) < 2) > 0.85
    assert np.max(np.abs(z)) < 5
    for name, values in FRICTION.parameters.items():
        assert np.max(np.abs(found.friction.parameters[name] - values) / found.friction.std[name]) < 5
        assert np.max(np.abs(found.friction.parameters[name] - values)) < 0.1


def test_residuals_of_the_right_model_are_the_noise(found):
    share = NOISE * np.sqrt(2 * 5.0 / 200)  # what a low-pass at 5 Hz leaves of white noise at 200 Hz, about
    assert np.all(found.rmse < 1.1 * share)
    assert np.all(found.rmse > 0.7 * share)
    assert np.all(found.cross_validated_rmse >= found.rmse)


def test_a_repeat_of_the_motion_is_held_out_with_what_it_repeats(found):
    assert found.settings["period"] == [pytest.approx(13.333, abs=0.01)]


def test_what_the_model_already_holds_counts_as_known(truth):
    arm = Arm.panda()
    rich = dataclasses.replace(
        arm,
        armature=jnp.full(7, 0.2),
        damping=jnp.asarray(FRICTION.viscous),
        frictionloss=jnp.asarray(FRICTION.coulomb),
        stiffness=jnp.full(7, 2.0),
    )
    none = Friction("coulomb_viscous_offset", {name: np.zeros(7) for name in FRICTION.parameters})
    result = identify(virtual(rich, 14.0, none, 0 * NOISE), rich, folds=0)
    assert np.allclose(result.beta, truth, atol=2e-3)
    for values in result.friction.parameters.values():
        assert np.max(np.abs(values)) < 5e-3


def test_two_recordings_tell_more_than_one(found):
    pair = [
        virtual(Arm.panda(), 10.0),
        dataclasses.replace(virtual(Arm.panda(), 20.0, seed=1), name="second.csv"),
    ]
    both = identify(pair, Arm.panda(), folds=3)
    one = identify(pair[0], Arm.panda(), folds=0)
    assert both.recordings == ("virtual.csv", "second.csv")
    assert np.median(both.classical_std / one.classical_std) < 0.8


@pytest.mark.parametrize("joints", [1, 3])
def test_a_long_recording_is_filtered_some_joints_at_a_time(monkeypatch, joints):
    arm, signals = Arm.panda(), prepare(virtual(Arm.panda(), 4.0))
    base = arm_base_parameters(arm)
    at_once = regression(signals, arm, base, "none")
    monkeypatch.setattr(regression_module, "_AT_ONCE", joints * len(signals.q) * base.rank)
    np.testing.assert_array_equal(regression(signals, arm, base, "none").A, at_once.A)
    A, tau = at_once.A, at_once.y
    rigid = A @ (base.projection @ np.asarray(arm.standard).ravel())
    assert np.sqrt(np.mean((tau - rigid) ** 2, 1)) == pytest.approx(_filtered_friction(signals), rel=0.2)


def _filtered_friction(signals) -> np.ndarray:
    friction = FRICTION.torque(jnp.asarray(signals.qd))
    return np.sqrt(np.mean(signals.lowpass(np.asarray(friction)) ** 2, 0))


def test_a_joint_that_only_trembles_shows_no_friction():
    """An iiwa's upright joints yielded by 2 mrad as others moved, and got damping of 106 N m s/rad."""
    recording = virtual(Arm.panda(), 4.0)
    q = recording.q.copy()
    q[:, 1] = q[0, 1] + 1e-3 * np.sin(2 * np.pi * 3.0 * recording.time)  # up to 19 mrad/s
    arm, signals = Arm.panda(), prepare(dataclasses.replace(recording, q=q))
    base = arm_base_parameters(arm)
    own = regression(signals, arm, base, "coulomb_viscous").A[:, :, base.rank :]
    assert np.flatnonzero(~own.any(axis=(0, 1))).tolist() == [2, 3]


def test_an_arm_at_rest_tells_gravity_only_and_says_so():
    arm = Arm.panda()
    q = np.repeat(configurations(arm, 30, seed=1), 80, axis=0)
    t = np.arange(len(q)) / 50.0
    tau = np.asarray(jax.vmap(lambda q: gravity_torque(arm.chain, arm.standard, q))(jnp.asarray(q)))
    still = Recording("rest.csv", t, np.repeat(q[:1], len(q), 0), None, np.repeat(tau[:1], len(q), 0))
    result = identify(still, arm, friction="none", folds=0)
    assert result.rank < 12
    assert any("base parameters" in note for note in result.notes)
    assert np.all(np.isfinite(result.beta))


def test_a_recording_of_one_pose_is_fitted_in_parameters_that_it_shows():
    # The pose's independent columns need not be those that the arm's own base parameters are named after.
    arm = Arm.panda()
    q = np.full((1500, 7), 0.1)
    tau = np.asarray(gravity_torque(arm.chain, arm.standard, jnp.asarray(q[0])))
    still = Recording("still.csv", np.arange(1500) / 500.0, q, None, np.tile(tau, (1500, 1)))
    result = identify(still, arm, friction="none", folds=0)
    assert result.rank == np.count_nonzero(np.abs(tau) > 1e-9)
    assert result.relative_error_percent < 1e-6


@pytest.mark.parametrize("folds", [1, -3])
def test_folds_that_cannot_be_are_refused(folds):
    with pytest.raises(InputError, match="folds"):
        identify(virtual(Arm.panda(), 4.0), Arm.panda(), folds=folds)


def test_friction_of_a_joint_that_does_not_move_is_not_made_up():
    recording = virtual(Arm.panda(), 14.0)
    q = recording.q.copy()
    q[:, 6] = 0.3
    result = identify(dataclasses.replace(recording, q=q), Arm.panda(), folds=0)
    assert result.friction.std["viscous"][6] == np.inf
    assert any("friction" in note for note in result.notes)


def test_the_sigmoid_of_a_virtual_arm_comes_back():
    table = published()["sigmoid_friction"]
    sigmoid = Friction("sigmoid", {name: np.array(table[name]) for name in ("phi1", "phi2", "phi3")})
    result = identify(
        virtual(Arm.panda(), 14.0, sigmoid, 0.01 * NOISE), Arm.panda(), friction="sigmoid", folds=0
    )
    assert np.allclose(result.friction.parameters["phi1"], sigmoid.parameters["phi1"], rtol=0.02)
    assert np.allclose(result.friction.parameters["phi2"], sigmoid.parameters["phi2"], rtol=0.05)
    assert np.allclose(result.friction.parameters["phi3"], sigmoid.parameters["phi3"], atol=0.002)
    assert all(np.all(values > 0) for values in result.friction.std.values())


def test_unweighted_least_squares_minimises_the_plain_residual(found):
    plain = identify(virtual(Arm.panda(), 20.0), Arm.panda(), weighting="none", folds=0)
    assert plain.relative_error_percent <= found.relative_error_percent


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"friction": "dahl"}, "unknown friction model 'dahl'"),
        ({"method": "guess"}, "method: 'guess'"),
        ({"weighting": "heavy"}, "weighting: 'heavy'"),
        ({"method": "one_step", "prior": 0.0}, "prior"),
        ({"cutoff": 500.0}, "cutoff"),
    ],
)
def test_an_option_that_does_not_exist_is_refused(change, message):
    with pytest.raises(InputError, match=message):
        identify(virtual(Arm.panda(), 3.0), Arm.panda(), **change)


def test_a_stuck_sensor_and_an_arm_at_rest_are_refused():
    """Both ended well, with coefficients of 1e-24 or friction that undid the model's own."""
    moving = virtual(Arm.panda(), 3.0)
    stuck = dataclasses.replace(moving, tau=np.where(np.arange(7) == 2, 1.0, moving.tau))
    with pytest.raises(InputError, match=r"virtual\.csv: column tau_3 never changes while its joint moves"):
        identify([moving, stuck], Arm.panda())
    still = dataclasses.replace(
        moving, q=moving.q[:1] + 1e-5 * np.random.default_rng(0).normal(size=moving.q.shape)
    )
    with pytest.raises(InputError, match=r"virtual\.csv: no joint moves"):
        identify(still, Arm.panda())


def test_a_motion_without_torque_is_refused():
    with pytest.raises(InputError, match="needs the measured torque"):
        identify(dataclasses.replace(virtual(Arm.panda(), 3.0), tau=None), Arm.panda())


def test_a_recording_of_another_arm_is_refused():
    recording = virtual(Arm.panda(), 3.0)
    other = Recording("ur.csv", recording.time, recording.q[:, :6], None, recording.tau[:, :6])
    with pytest.raises(InputError, match=r"ur\.csv: has 6 joints"):
        identify(other, Arm.panda())


# --- error bars


def test_robust_intervals_hold_the_truth_where_noise_is_coloured_and_shared():
    random = np.random.default_rng(0)
    t = np.arange(2000) / 100
    frequency, phase = random.uniform(0.1, 2, (3, 1, 12)), random.uniform(0, 6, (3, 1, 12))
    A = np.sin(2 * np.pi * frequency * t[:, None] + phase)
    x = random.normal(size=12)
    sigma = np.array([0.3, 0.1, 0.03])
    lowpass = scipy.signal.butter(2, 1.0, fs=100, output="sos")
    held = {"robust": [], "textbook": [], "shrunk": []}
    for _ in range(60):
        own, common = random.normal(size=(3, 3000)), random.normal(size=3000)
        noise = scipy.signal.sosfilt(lowpass, own + 0.5 * common)[:, 1000:]
        y = A @ x + sigma[:, None] * noise / noise.std()
        problem = [Regression("noise", A, y, y, np.zeros_like(y), np.ones_like(y))]
        fit = least_squares(problem, everything(problem), "joint")
        for name, covariance in zip(held, covariances(problem, fit.x, fit.sigma), strict=True):
            held[name].append(np.abs(fit.x - x) < 1.96 * np.sqrt(np.diag(covariance)))
    assert 0.90 < np.mean(held["robust"]) < 0.99
    assert np.mean(held["textbook"]) < 0.7
    assert 0.90 < np.mean(held["shrunk"]) < 0.99


def test_on_white_noise_both_error_bars_agree():
    random = np.random.default_rng(1)
    A, x = random.normal(size=(3, 4000, 8)), random.normal(size=8)
    y = A @ x + random.normal(size=(3, 4000))
    problem = [Regression("white", A, y, y, np.zeros_like(y), np.ones_like(y))]
    fit = least_squares(problem, everything(problem), "joint")
    robust, textbook = (np.sqrt(np.diag(C)) for C in covariances(problem, fit.x, fit.sigma)[:2])
    assert np.allclose(textbook, 1 / np.sqrt(12000), rtol=0.1)
    assert np.median(robust / textbook) == pytest.approx(1, abs=0.25)


def test_correlated_samples_count_by_the_noise_that_they_share():
    """Of noise that keeps 0.8 of itself, (1 + 0.8) / (1 - 0.8) samples tell as much of slow columns as one."""
    random = np.random.default_rng(2)
    t = np.arange(6000) / 100
    A = np.sin(2 * np.pi * random.uniform(0.1, 0.5, (3, 1, 8)) * t[:, None] + random.uniform(0, 6, (3, 1, 8)))
    counted = []
    for _ in range(20):
        e = random.normal(size=(3, 6000))
        for noise in (e, scipy.signal.lfilter([1], [1, -0.8], e)):
            y = 100 * (A.sum(-1) + noise)
            problem = [Regression("noise", A, y, y, np.zeros_like(y), np.ones_like(y))]
            fit = least_squares(problem, everything(problem), "joint")
            T = triangle(np.concatenate(triangles(problem, everything(problem))[:, :, :-1] / fit.sigma[0]))
            counted.append(samples_as_one(T, covariances(problem, fit.x, fit.sigma)[2]))
    assert np.mean(counted[::2]) == pytest.approx(1, abs=0.3)
    assert np.mean(counted[1::2]) == pytest.approx(9, rel=0.3)


# --- feasible links in one step


def clarabel_optimum(A: np.ndarray, b: np.ndarray, bounds: Bounds, lower: np.ndarray) -> float:
    """The least of the same convex problem, by an interior-point solver."""
    clarabel = pytest.importorskip("clarabel")
    import scipy.sparse

    dof, n = bounds.dof, A.shape[1]
    rows: list[np.ndarray] = []
    limits: list[float] = []

    def at_most(limit: float, **coefficients: float) -> None:
        row = np.zeros(n)
        for name, value in coefficients.items():
            row[standard_names(dof).index(name)] = value
        rows.append(row)
        limits.append(limit)

    for i in range(dof):
        m = f"m{i + 1}"
        at_most(bounds.mass[i, 1], **{m: 1})
        at_most(-bounds.mass[i, 0], **{m: -1})
        for k, axis in enumerate("xyz"):
            at_most(0, **{f"{m}c{i + 1}{axis}": 1, m: -bounds.com[i, k, 1]})
            at_most(0, **{f"{m}c{i + 1}{axis}": -1, m: bounds.com[i, k, 0]})
    at_most(bounds.total_mass[1], **{f"m{i + 1}": 1 for i in range(dof)})
    at_most(-bounds.total_mass[0], **{f"m{i + 1}": -1 for i in range(dof)})
    for k in np.flatnonzero(np.isfinite(lower)):
        row = np.zeros(n)
        row[10 * dof + k] = -1
        rows.append(row)
        limits.append(-lower[k])
    cones: list[Any] = [clarabel.NonnegativeConeT(len(rows))]
    entries = [(i, j) for j in range(4) for i in range(j + 1)]
    J = np.stack([np.asarray(inertia.pseudo_inertia(e)) for e in jnp.eye(10)])
    S = np.array([[J[k, i, j] * (1 if i == j else np.sqrt(2)) for k in range(10)] for i, j in entries])
    for i in range(dof):
        block = np.zeros((10, n))
        block[:, 10 * i : 10 * i + 10] = -S
        rows += list(block)
        limits += [0.0] * 10
        cones.append(clarabel.PSDTriangleConeT(4))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    P, G = scipy.sparse.csc_matrix(np.triu(2 * A.T @ A)), scipy.sparse.csc_matrix(np.stack(rows))
    solution = clarabel.DefaultSolver(P, -2 * A.T @ b, G, np.array(limits), cones, settings).solve()
    assert str(solution.status) == "Solved"
    return float(np.sum((A @ np.array(solution.x) - b) ** 2))


@pytest.mark.slow
def test_one_step_finds_links_that_could_be_built_and_the_convex_optimum(monkeypatch):
    posed = {}
    original = feasible_fit.problem
    monkeypatch.setattr(feasible_fit, "problem", lambda *args: posed.setdefault("problem", original(*args)))
    recording = virtual(Arm.panda(), 14.0, noise=2 * NOISE)
    result = identify(recording, Arm.panda(), method="one_step", folds=0)
    lower, _ = feasible_fit.friction_bounds("coulomb_viscous_offset", 7, {})
    least = clarabel_optimum(*posed["problem"], Bounds.panda(), lower)
    assert result.settings["objective"] <= least * (1 + 1e-3)
    assert result.settings["max_violation"] == 0
    assert np.all(np.asarray(jax.vmap(inertia.triangle_margin)(jnp.asarray(result.standard))) >= 0)
    assert 16 <= result.standard[:, 0].sum() <= 20
    assert np.allclose(result.beta, result.projection @ result.standard.ravel())
    assert np.all(result.friction.viscous >= 0)
    assert np.all(result.friction.coulomb >= 0)


# --- the real recording


@pytest.fixture(scope="module")
def gaz(data: Path) -> Recording:
    return load(data / "gaz_panda")


def test_the_classical_model_explains_the_real_trajectory_as_well_as_the_reference(gaz):
    result = identify(gaz, Arm.panda())
    assert result.rank == 43
    assert result.cross_validated_relative_error_percent <= 1.52
    assert result.relative_error_percent < result.cross_validated_relative_error_percent
    assert np.all(result.noise < result.rmse)


@pytest.mark.slow
def test_the_feasible_model_explains_the_real_trajectory_better_than_the_classical(gaz):
    result = identify(gaz, Arm.panda(), method="one_step")
    assert result.cross_validated_relative_error_percent <= 1.30
    assert result.settings["max_violation"] == 0


# --- files


def test_an_identification_comes_back_from_its_file(found, tmp_path):
    path = found.save(tmp_path)
    again = Identification.load(tmp_path)
    assert json.loads(path.read_text())["schema"] == "jaxpanda.identification/1"
    assert np.array_equal(again.projection, found.projection)
    for name in ("beta", "std", "reliable", "covariance", "rmse", "cross_validated_rmse"):
        assert np.array_equal(getattr(again, name), getattr(found, name)), name
    assert again.to_json() == found.to_json()


def test_an_identification_can_be_pickled(found):
    again = pickle.loads(pickle.dumps(found))
    assert again.to_json() == found.to_json()
    assert np.array_equal(again.evidence.whole.R, found.evidence.whole.R)


def test_the_published_table_is_read_as_a_bare_table_of_coefficients(tmp_path):
    path = tmp_path / "coefficients.json"
    path.write_text(json.dumps({"coefficients": published()["coefficients"]}))
    table = Identification.load(path)
    assert table.method is None
    assert table.projection.shape == (43, 70)
    assert np.sum(~table.reliable) == 2
    assert np.array_equal(table.projection, arm_base_parameters(Arm.panda()).projection)


ROW = {"terms": {"m1": 1}, "value": 1.0}


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ([1], "holds no JSON object"),
        ({}, "needs 'coefficients'"),
        ({"coefficients": []}, "needs 'coefficients'"),
        ({"coefficients": [3]}, r"coefficients\[0\] is no object"),
        ({"coefficients": [{"terms": {"m1": 1}}]}, "no 'value'"),
        ({"coefficients": [{**ROW, "value": "heavy"}]}, r"coefficients\[0\].value is 'heavy'"),
        ({"coefficients": [{**ROW, "terms": {"M1": 1}}]}, "unknown parameter 'M1'"),
        ({"coefficients": [{**ROW, "terms": 3}]}, r"coefficients\[0\].terms"),
        ({"coefficients": [{**ROW, "reliable": "yes"}]}, r"coefficients\[0\].reliable"),
        ({"coefficients": [ROW], "schema": "jaxpanda.retrieval/1"}, "schema is 'jaxpanda.retrieval/1'"),
        ({"coefficients": [ROW], "method": "magic"}, "method is 'magic'"),
        ({"coefficients": [ROW], "rank": "many"}, "rank is 'many'"),
        ({"coefficients": [ROW], "rmse": [1, 2]}, "rmse must hold 1 finite numbers"),
        ({"coefficients": [ROW], "links": "link1"}, "links must be a list of texts"),
        ({"coefficients": [ROW], "friction": {"joint": 1}}, "friction is no list"),
        ({"coefficients": [ROW], "settings": 3}, "settings must be an object"),
        ({"coefficients": [ROW], "joint_covariance": [[-1.0]]}, "joint_covariance has a negative variance"),
    ],
)
def test_a_malformed_file_is_refused_with_the_field_named(tmp_path, document, message):
    path = tmp_path / "identification.json"
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=message) as error:
        Identification.load(path)
    assert "identification.json" in str(error.value)


@pytest.mark.parametrize("method", ["trajectory", "one_step"])
def test_a_model_with_too_much_damping_is_told_to_have_less(method):
    """Menagerie's Panda has damping 1 at each joint: friction was held above zero beside it, and links that could
    be built left 5.8 % of the real log's torque, where the coefficients left 1.2 %."""
    placed = dataclasses.replace(Arm.panda(), damping=jnp.full(7, 1.0))
    recordings = [record(seed, lambda t, q, qd, qdd: 0.1 * qd, seconds=12.0) for seed in (0, 1)]
    found = identify(recordings, placed, method=method, friction="coulomb_viscous", folds=0, starts=1)
    np.testing.assert_allclose(found.friction.viscous, -0.9, atol=0.1)
    if method == "trajectory":
        links = retrieve(found, arm=placed, starts=8, certificate=False)
        np.testing.assert_allclose(links.friction.viscous, -0.9, atol=0.1)
        assert links.relative_error_percent < 1.1 * found.relative_error_percent
        assert not any("contradict the recording" in note for note in links.notes)


def test_armature_that_leaves_the_links_no_inertia_is_told():
    placed = dataclasses.replace(Arm.panda(), armature=jnp.array([0, 0, 0, 0, 0, 0, 2.0]))
    recordings = [record(seed, seconds=12.0) for seed in (0, 1)]
    found = identify(recordings, placed, folds=0)
    (note,) = (n for n in found.notes if "armature" in n)
    assert "beside 2 at joint7;" in note
    assert note.count("beside") == 1
    assert not [n for n in identify(recordings, Arm.panda(), folds=0).notes if "armature" in n]


def test_links_that_explain_less_than_the_coefficients_are_told():
    arm = Arm.panda()
    found = identify([record(seed, seconds=12.0) for seed in (0, 1)], arm, folds=0)
    light = Bounds.of(dataclasses.replace(arm, standard=0.3 * arm.standard))
    links = retrieve(found, arm=arm, bounds=light, starts=8, certificate=False)
    (note,) = (n for n in links.notes if "contradict the recording" in n)
    assert f"leave {links.relative_error_percent:.2f} %" in note
    plain = retrieve(found, arm=arm, starts=8, certificate=False)
    assert not [n for n in plain.notes if "contradict the recording" in n]


def test_variances_that_overflow_are_refused(found):
    huge = dataclasses.replace(found, joint_covariance=1e300 * np.eye(len(found.joint_covariance)))
    with pytest.raises(InputError, match="joint_covariance: its variances are too large"):
        retrieve(huge, starts=2, certificate=False)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["trajectory", "one_step"])
def test_gravity_of_resting_joints_is_not_traded_for_offsets_of_their_sensors(method):
    """Of a real iiwa upright, whose joints 1 and 6 moved, links were 1.8 and 2.6 N m off at joints that rested,
    for a fit hardly better: offsets undid it, which an exported file does not have."""
    arm = dataclasses.replace(Arm.panda(), lower=jnp.full(7, -2.0), upper=jnp.full(7, 2.0))
    drift = lambda t, q, qd, qdd: np.outer(np.sin(0.9 * t), [0, 0.3, 0, 0.2, 0, 0.1, 0])
    still = [1, 2, 3, 4, 6]
    recordings = [record(seed, drift, seconds=20.0, still=still, arm=arm) for seed in (0, 1)]
    found = identify(recordings, arm, method=method, starts=4, folds=0)
    links = retrieve(found, arm=arm, starts=16, certificate=False)
    load = jax.vmap(lambda phi: gravity_torque(arm.chain, phi, jnp.asarray(recordings[0].q[0])))
    expected, held = load(jnp.stack([arm.standard, jnp.asarray(links.standard)]))
    assert np.all(np.abs(held - expected) < 0.6)


def test_a_joint_that_never_moved_gets_no_friction():
    """A joint of a real iiwa stood still but for 1e-294 rad/s, and was exported with frictionloss 3e293."""
    R = np.triu(np.ones((1, 4, 4)))
    R[0, :, 1], R[0, :, 2] = 1e-294, [1.0, 2.0, 0.0, 0.0]
    own = Condensed(R, R, 100, 1.0).following(np.zeros(1), np.array([[0.0, -np.inf]]))
    assert own[0, 0] == 0.0
    assert np.isfinite(own[0, 1])
