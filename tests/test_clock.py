"""Samples that were uniform are on their ticks, whatever their stamps say; others stay where they are."""

import dataclasses

import numpy as np
import pytest
from test_excitation import ARM

from jaxpanda.diagnosis import diagnose
from jaxpanda.errors import InputError
from jaxpanda.inspection import inspect
from jaxpanda.recordings import Recording, load, save
from jaxpanda.recordings.clock import on_clock
from jaxpanda.rollout import compare
from jaxpanda.signals import prepare
from jaxpanda.simulation import Sensors, random_trajectory, simulate

DOF = 4


def motion(t: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A sum of sines up to 1 Hz, and its second derivative."""
    rng = np.random.default_rng(seed)
    w = 2 * np.pi * rng.uniform(0.1, 1.0, (5, DOF))
    a = rng.normal(0, 0.15, (5, DOF)) / (0.5 + w / 2)
    angle = w * t[:, None, None] + rng.uniform(0, 6, (5, DOF))
    return np.sum(a * np.sin(angle), 1), -np.sum(a * w**2 * np.sin(angle), 1)


def stamped(stamps: np.ndarray, taken: np.ndarray, noise: float = 1e-5) -> Recording:
    q = motion(taken)[0]
    return Recording("arm.csv", stamps, q + noise * np.random.default_rng(9).normal(size=q.shape))


def jittery(rate: float, jitter: float, missing: float = 0.0, true: bool = False, seconds: float = 12.0):
    """Uniform samples with stamps off by up to so many periods; or, if `true`, samples taken at those stamps."""
    rng = np.random.default_rng(1)
    s = np.arange(int(seconds * rate)) / rate
    t = s + rng.uniform(-jitter, jitter, len(s)) / rate
    kept = rng.random(len(s)) >= missing
    s, t = s[kept], t[kept]
    return stamped(t, t if true else s), s


def acceleration_error(recording: Recording) -> float:
    """rms over the acceleration's own."""
    made = prepare(recording, derivative_cutoff=12.0)
    true = motion(made.times)[1]
    return float(np.sqrt(np.mean((made.qdd[made.keep] - true) ** 2) / np.mean(true**2)))


@pytest.mark.parametrize("rate", [1000.0, 250.0, 50.0])
@pytest.mark.parametrize("jitter", [0.05, 0.1, 0.45])
def test_uniform_samples_are_put_on_their_ticks(rate, jitter):
    """Half a sample of jitter at 50 Hz made the acceleration twice too large, in silence."""
    recording, ticks = jittery(rate, jitter)
    made = on_clock(recording)
    np.testing.assert_allclose(np.diff(made.time), 1 / rate, rtol=1e-3)
    np.testing.assert_allclose(made.time, ticks, atol=0.1 * max(jitter, 0.1) / rate)
    np.testing.assert_array_equal(made.stamps, recording.time)
    assert acceleration_error(made) < 0.02
    assert made.repairs["rows moved from their stamp to their tick"] == len(ticks)
    assert "samples were uniform and their stamps were not" in made.notes[-1]


@pytest.mark.parametrize("jitter", [0.008, 0.015])
def test_less_than_a_hundredth_of_a_sample_matters_at_a_low_rate(jitter):
    """Encoders of 10 µrad show it at 20 ms: such a file was refused as off, and a clock fits it."""
    recording, ticks = jittery(50.0, jitter)
    made = on_clock(recording)
    np.testing.assert_allclose(made.time, ticks, atol=0.1 * jitter / 50.0)
    assert acceleration_error(made) < 0.6 * acceleration_error(recording)


def test_the_error_that_jitter_makes_is_one_that_matters():
    assert acceleration_error(jittery(50.0, 0.1)[0]) > 0.2
    assert acceleration_error(jittery(50.0, 0.45)[0]) > 1.0


@pytest.mark.parametrize(("rate", "jitter"), [(1000.0, 0.3), (250.0, 0.45), (100.0, 0.45)])
def test_ticks_without_a_row_are_told(rate, jitter):
    recording, ticks = jittery(rate, jitter, missing=0.05)
    made = on_clock(recording)
    lost = round((ticks[-1] - ticks[0]) * rate) + 1 - len(ticks)
    assert abs(made.repairs["ticks missing between rows"] - lost) <= 2
    assert np.mean(np.abs(made.time - ticks) > 0.5 / rate) < 0.02
    assert acceleration_error(made) < 0.02


@pytest.mark.parametrize("rate", [1000.0, 250.0, 50.0])
@pytest.mark.parametrize("jitter", [0.05, 0.45])
def test_samples_taken_at_their_stamps_stay_there(rate, jitter):
    recording, _ = jittery(rate, jitter, missing=0.05, true=True)
    made = on_clock(recording)
    assert made.stamps is None
    np.testing.assert_array_equal(made.time, recording.time)
    assert not made.repairs
    assert "the stamps say when samples were taken" in made.notes[-1]


def test_samples_at_random_intervals_stay_there():
    t = np.cumsum(np.random.default_rng(2).uniform(0.5, 1.5, 4000)) / 300
    made = on_clock(stamped(t, t))
    np.testing.assert_array_equal(made.time, t)


def test_stamps_rounded_to_milliseconds_are_finer_again():
    s = np.arange(3600) / 300
    made = on_clock(stamped(np.round(s, 3), s))
    np.testing.assert_allclose(np.diff(made.time), 1 / 300, rtol=1e-4)


def test_stamps_in_32_bits_after_hours_are_no_clock_of_their_own():
    """Steps of 3.9 and 7.8 ms had been a clock of 256 Hz that misses rows."""
    s = np.arange(3000) / 250
    made = on_clock(stamped((60000 + s).astype(np.float32).astype(float), s))
    np.testing.assert_allclose(np.diff(made.time), 1 / 250, rtol=1e-3)
    assert "ticks missing between rows" not in made.repairs
    assert acceleration_error(dataclasses.replace(made, time=made.time - 60000)) < 0.02


def test_ticks_go_on_beyond_a_gap():
    recording, s = jittery(250.0, 0.3)
    inside = (s < 4) | (s > 8)
    made = on_clock(stamped(recording.time[inside], s[inside]))
    np.testing.assert_allclose(made.time, s[inside], atol=0.05 / 250)


def test_a_row_for_every_tick_that_came_late_by_several():
    s = np.arange(4000) / 400
    late = s + np.random.default_rng(3).exponential(0.5, len(s)) / 400
    late = np.maximum.accumulate(late) + 1e-6 * np.arange(len(s))
    made = on_clock(stamped(late, s))
    np.testing.assert_allclose(np.diff(made.time), 1 / 400, rtol=1e-3)


def test_jitter_that_encoders_hide_is_left_as_it_is():
    """Nothing tells, and nothing depends on it."""
    rng = np.random.default_rng(4)
    s = np.arange(2000) / 200
    t = s + rng.uniform(-0.1, 0.1, len(s)) / 200
    rest = Recording("arm.csv", t, 1e-4 * rng.normal(size=(len(s), DOF)))
    assert on_clock(rest) is rest
    noisy = stamped(t, t, noise=3e-2)
    np.testing.assert_array_equal(on_clock(noisy).time, t)


def test_stamps_that_decide_the_acceleration_are_refused_where_no_clock_is_found():
    rng = np.random.default_rng(5)
    s = np.arange(2400) / 200
    s = s[rng.random(len(s)) > 0.1]
    t = np.sort(s + rng.normal(0, 1.0, len(s)) / 200) + 1e-7 * np.arange(len(s))
    with pytest.raises(
        InputError, match=r"arm.csv: column time is off by .* ms \(rms\) from when samples were"
    ):
        on_clock(stamped(t, s))


def test_every_format_is_put_on_ticks_and_inspect_tells(tmp_path):
    recording, _ = jittery(250.0, 0.3)
    for name in ("arm.csv", "arm.npz", "arm.csv.gz"):
        save(recording, tmp_path / name)
        made = load(tmp_path / name)
        assert made.repairs["rows moved from their stamp to their tick"] == made.samples
        lines = "\n".join(inspect(made).lines())
        assert "samples were uniform and their stamps were not" in lines
        assert "time is not uniform" not in lines


def rubbed(t, qd):
    """Friction that comes with warmth [N m]."""
    return (0.3 + 0.8 * (1 - np.exp(-t / 6))) * np.tanh(qd / 0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "added"),
    [
        ("friction_drift", rubbed),
        ("torque_drift", lambda t, _: 0.8 * (1 - np.exp(-t / 6))),
        ("external_contact", lambda t, _: 1.0 * ((t > 9) & (t < 11))),
    ],
)
def test_what_changes_with_time_is_found_by_any_clock(effect, added, tmp_path):
    """By that of Unix a contact was not seen, a drift of a sensor had no name, one of friction was constant."""
    (tmp_path / "arm.xml").write_text(ARM)
    trajectory = random_trajectory(ARM, 3, period=8.0)
    sensors = Sensors(torque_noise=0.05, torque_correlation_time=0.02, velocity_noise=1e-3)
    plain = simulate(ARM, trajectory, duration=20.0, rate=200.0, sensors=sensors, seed=3, name="run.csv")
    tau = np.array(plain.tau)
    tau[:, 1] += added(plain.time, plain.qd[:, 1])
    logged = dataclasses.replace(plain, time=plain.time + 1.7e9, tau=tau)
    told = diagnose(tmp_path / "arm.xml", [logged])
    (found,) = told.findings
    assert (found.effect, found.joints) == (effect, (1,))
    assert found.confidence > 0.5
    if found.intervals is None:
        (lasts,) = [p["value"] for p in found.parameters if p["name"] == "time_constant"]
        assert lasts == pytest.approx(6.0, rel=0.1)
    else:
        ((start, stop),) = np.subtract(found.intervals, 1.7e9)
        assert 8 < start < 9.1
        assert stop == pytest.approx(11.0, abs=0.1)
        window = compare(told.corrected, told.source, logged)["window"]
        assert window[0] < 1.7e9 + start < 1.7e9 + stop < window[1]
