import dataclasses

import numpy as np
import pytest

from jaxpanda.errors import InputError
from jaxpanda.recordings import Recording, load
from jaxpanda.signals import (
    blocks,
    blocks_many,
    derivatives,
    prepare,
    repeatability,
    repeats,
    time_split,
    white_noise,
    zero_phase,
)


def sweep(time: np.ndarray, seed: int = 0, dof: int = 3) -> np.ndarray:
    """A motion of incommensurate sines that does not repeat."""
    rng = np.random.default_rng(seed)
    frequency, phase = rng.uniform(0.5, 6.0, (6, dof)), rng.uniform(0, 6, (6, dof))
    return np.sum(np.sin(time[:, None, None] * frequency + phase) / frequency, axis=1)


def cycle(time: np.ndarray, period: float, seed: int = 0, dof: int = 3) -> np.ndarray:
    """A Fourier series of `period`."""
    rng = np.random.default_rng(seed)
    k = np.arange(1, 6)[:, None]
    phase = rng.uniform(0, 6, (5, dof))
    return np.sum(np.sin(2 * np.pi * k * time[:, None, None] / period + phase) / k, axis=1)


def recording(
    seconds: float = 10.0, rate: float = 200.0, q=sweep, name: str = "made", noise: float = 0.0
) -> Recording:
    time = np.arange(round(seconds * rate) + 1) / rate
    tau = 10 * q(time)
    return Recording(name, time, q(time), None, tau + noise * np.random.default_rng(1).normal(size=tau.shape))


@pytest.mark.parametrize("frequency", [0.5, 2.0, 5.0, 8.0])
def test_a_sine_passes_with_the_squared_gain_of_the_filter_and_no_phase(frequency):
    rate, cutoff = 500.0, 5.0
    time = np.arange(10000) / rate
    out = zero_phase(np.sin(2 * np.pi * frequency * time)[:, None], cutoff, rate)[2500:-2500, 0]
    t = time[2500:-2500]
    inphase = 2 * np.mean(out * np.sin(2 * np.pi * frequency * t))
    quadrature = 2 * np.mean(out * np.cos(2 * np.pi * frequency * t))
    warped = np.tan(np.pi * frequency / rate) / np.tan(np.pi * cutoff / rate)
    assert inphase == pytest.approx(1 / (1 + warped**8), abs=1e-6)
    assert quadrature == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("rate", [50.0, 250.0, 4000.0])
def test_derivatives_of_a_sine_are_right_at_every_rate(rate):
    time = np.arange(round(6 * rate)) / rate
    w = 2 * np.pi * 1.5
    _, qd, qdd = derivatives(np.sin(w * time)[:, None], 0.4 * rate, rate)
    middle = slice(round(2 * rate), -round(2 * rate))
    assert np.max(np.abs(qd[middle, 0] - w * np.cos(w * time[middle]))) < 1e-4 * w
    assert np.max(np.abs(qdd[middle, 0] + w**2 * np.sin(w * time[middle]))) < 1e-4 * w**2


def test_derivatives_of_a_cubic_are_exact_in_the_interior():
    time = np.arange(2000) / 200.0
    q, qd, qdd = derivatives((0.1 * time**3 - time)[:, None], 20.0, 200.0)
    middle = slice(400, -400)
    assert np.max(np.abs(q[middle, 0] - (0.1 * time**3 - time)[middle])) < 1e-6
    assert np.max(np.abs(qd[middle, 0] - (0.3 * time**2 - 1)[middle])) < 1e-6
    assert np.max(np.abs(qdd[middle, 0] - (0.6 * time)[middle])) < 1e-5


def test_both_sides_of_the_equation_pass_the_same_linear_filter():
    made = prepare(recording(noise=0.3))
    assert made.tau is not None
    W = np.random.default_rng(2).normal(size=(len(made.time), 3, 4))
    beta = np.array([1.0, -2.0, 0.5, 3.0])
    assert made.lowpass(W).shape == (len(made.keep), 3, 4)
    left = made.lowpass(made.tau) - made.lowpass(W) @ beta
    assert np.allclose(left, made.lowpass(made.tau - W @ beta), atol=1e-12)


def test_what_the_filter_makes_up_at_the_edges_is_trimmed():
    long = recording(20.0, 500.0, lambda t: sweep(t, dof=2))
    cut = Recording("cut", long.time[2500:7501], long.q[2500:7501], None, long.q[2500:7501])
    whole, part = prepare(long), prepare(cut)
    reference = zero_phase(long.q, 5.0, 500.0)
    assert part.tau is not None
    there = np.round(part.times * 500).astype(int)
    assert np.max(np.abs(part.lowpass(part.tau) - reference[there])) < 1e-4
    assert np.max(np.abs(part.qdd[part.keep] - whole.qdd[there])) < 1e-3


@pytest.mark.parametrize("rate", [50.0, 100.0, 250.0, 1000.0, 4000.0])
def test_every_usual_rate_gives_the_same_accelerations(rate):
    made = prepare(recording(6.0, rate, lambda t: 0.3 * np.sin(3 * t)[:, None]))
    assert made.output_rate <= 100.0
    assert made.rate == pytest.approx(rate)
    truth = -2.7 * np.sin(3 * made.times)
    assert np.max(np.abs(made.qdd[made.keep, 0] - truth)) < 2e-3


def test_a_slow_recording_lowers_the_low_pass_of_q_and_says_so():
    made = prepare(recording(6.0, 50.0))
    assert made.derivative_cutoff == pytest.approx(20.0)
    assert any("low-passed at 20 Hz" in note for note in made.notes)
    assert prepare(recording(6.0, 1000.0)).derivative_cutoff == 25.0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"cutoff": 100.0}, "cutoff 100 Hz, where a recording at 200 Hz allows"),
        ({"cutoff": 0.0}, "cutoff 0 Hz"),
        ({"derivative_cutoff": 120.0}, "derivative_cutoff 120 Hz"),
        ({"cutoff": 30.0, "derivative_cutoff": 25.0}, "above the low-pass of q"),
        ({"trim": 6.0}, "too short"),
        ({"trim": -1.0}, "trim -1 s"),
        ({"rate": 0.0}, "rate 0 Hz"),
    ],
)
def test_settings_that_the_rate_does_not_allow_are_refused(settings, message):
    with pytest.raises(InputError, match=rf"made: .*{message}"):
        prepare(recording(), **settings)


def test_a_recording_shorter_than_the_filter_s_edges_is_refused():
    with pytest.raises(InputError, match="too short"):
        prepare(recording(1.0))


def test_missing_rows_are_filled_and_counted():
    whole = recording(10.0, 500.0)
    gone = np.array([700, 701, 1500, 3000])
    rows = np.delete(np.arange(whole.samples), gone)
    assert whole.tau is not None
    made = prepare(Recording("gaps", whole.time[rows], whole.q[rows], None, whole.tau[rows]))
    assert made.repairs == {"grid points filled where rows are missing": 4}
    assert np.allclose(made.time, whole.time)
    assert made.tau is not None
    kept = np.setdiff1d(np.arange(whole.samples), gone)
    assert np.allclose(made.tau[kept], whole.tau[kept], rtol=0, atol=1e-9)
    assert np.max(np.abs(made.qdd - prepare(whole).qdd)[made.keep]) < 2e-3


def test_jittering_stamps_are_resampled_and_counted():
    rng = np.random.default_rng(0)
    t = np.sort(np.arange(2500) / 250.0 + rng.uniform(-1.5e-3, 1.5e-3, 2500))
    made = prepare(Recording("jitter", t, sweep(t), None, sweep(t)))
    assert made.rate == pytest.approx(250.0, rel=1e-3)
    assert made.repairs["rows moved to a uniform grid by interpolation"] > 2000
    steps = np.diff(made.time)
    assert np.allclose(steps, steps[0])
    exact = derivatives(sweep(made.time), made.derivative_cutoff, made.rate)[2]
    assert np.max(np.abs(made.qdd - exact)[made.keep]) < 0.05 * np.max(np.abs(exact))


def test_nothing_near_a_long_gap_is_kept():
    whole = recording(10.0)
    rows = (whole.time < 4.0) | (whole.time > 5.0)
    made = prepare(Recording("gap", whole.time[rows], whole.q[rows], None, whole.q[rows]))
    assert not np.any((made.times > 3.4 + 1e-6) & (made.times < 5.6 - 1e-6))
    assert made.times[0] < 1
    assert made.times[-1] > 9
    assert any("longer than 0.1 s" in note for note in made.notes)


def test_a_motion_without_torque_is_prepared_too():
    whole = recording()
    made = prepare(Recording("motion", whole.time, whole.q))
    assert made.tau is None
    assert made.noise is None
    assert repeatability(made) is None


def test_white_noise_is_measured_under_a_motion():
    made = recording(20.0, 500.0, noise=0.2)
    assert made.tau is not None
    assert np.allclose(white_noise(made.tau), 0.2, rtol=0.05)


@pytest.mark.parametrize(("period", "seconds"), [(5.0, 20.0), (7.3, 10.0), (2.5, 10.0)])
def test_a_period_is_found_from_a_part_of_its_repeat(period, seconds):
    made = prepare(recording(seconds, q=lambda t: cycle(t, period)))
    assert made.period == pytest.approx(period, abs=2e-3)


def test_a_motion_that_does_not_repeat_has_no_period():
    assert prepare(recording(20.0)).period is None
    assert prepare(recording(20.0, q=lambda t: cycle(t, 25.0))).period is None


def test_rest_is_no_repeat():
    def still(t):
        return sweep(np.clip(t, 3.0, 7.0))

    assert prepare(recording(10.0, q=still)).period is None


def test_repeated_motion_shows_the_noise_of_the_torque():
    made = prepare(recording(20.0, 1000.0, lambda t: cycle(t, 8.0), noise=0.3), cutoff=10.0)
    floor = repeatability(made)
    assert floor is not None
    bandwidth = (
        np.sum(np.abs(np.fft.rfft(zero_phase(np.eye(4001)[2000][:, None], 10.0, 1000.0)[:, 0])) ** 2) / 2001
    )
    assert np.allclose(floor, 0.3 * np.sqrt(bandwidth), rtol=0.25)


def test_phase_blocks_hold_out_every_repeat_of_a_block():
    made = prepare(recording(13.0, q=lambda t: cycle(t, 5.0)))
    assert made.period is not None
    tested = np.zeros(len(made.keep), int)
    for train, test in blocks(made, folds=5, guard=0.1):
        assert not np.any(train & test)
        tested += test
        phases = np.mod(made.times, made.period)
        apart = np.abs(phases[train][:, None] - phases[test][None, :])
        assert np.min(np.minimum(apart, made.period - apart)) > 0.09
        spans = made.times[test]
        assert spans[-1] - spans[0] > 4.0  # both repeats
    assert np.all(tested == 1)


def test_blocks_of_a_motion_that_does_not_repeat_are_contiguous():
    made = prepare(recording(20.0))
    tested = np.zeros(len(made.keep), int)
    for train, test in blocks(made, folds=4, guard=0.2):
        tested += test
        places = np.flatnonzero(test)
        assert np.all(np.diff(places) == 1)
        assert np.min(np.abs(made.times[train][:, None] - made.times[test][None, :])) > 0.19
    assert np.all(tested == 1)


@pytest.mark.parametrize(("seconds", "rounds"), [(20.0, 5), (3.0, 1)])
def test_blocks_in_rounds_leave_something_of_every_time_in_training(seconds, rounds):
    """In a recording too short for that a fold is one block, as without."""
    made = prepare(recording(seconds))
    tested = np.zeros(len(made.keep), int)
    for ((train, test),) in blocks_many([made], folds=5, guard=0.1, rounds=5):
        tested += test
        assert 1 + np.count_nonzero(np.diff(np.flatnonzero(test)) > 1) == rounds
        assert np.min(np.abs(made.times[train][:, None] - made.times[test][None, :])) > 0.09
    assert np.all(tested == 1)


def test_a_gap_takes_no_time_of_blocks():
    """A fifth of the recording would lie in it: that fold would be empty, and the others of unequal size."""
    whole = recording(12.0)
    rows = (whole.time < 5.0) | (whole.time > 8.0)
    made = prepare(dataclasses.replace(whole, time=whole.time[rows], q=whole.q[rows], tau=whole.tau[rows]))
    tested = np.zeros(len(made.keep), int)
    for train, test in blocks(made, folds=5, guard=0.1):
        tested += test
        assert np.sum(test) == pytest.approx(len(test) / 5, abs=2)
        assert np.min(np.abs(made.times[train][:, None] - made.times[test][None, :])) > 0.09
    assert np.all(tested == 1)


def test_more_folds_than_samples_are_refused():
    with pytest.raises(InputError, match="too few samples for 500 folds"):
        blocks(prepare(recording(2.0)), folds=500)


def test_a_split_in_time_that_tests_on_a_repeat_is_refused_by_name():
    periodic = prepare(recording(13.0, q=lambda t: cycle(t, 5.0)))
    with pytest.raises(InputError, match=r"made: the motion repeats itself after 5\.000 s"):
        time_split(periodic, 0.7)
    train, test = time_split(periodic, 0.7, allow_repeats=True)
    assert train.any()
    assert test.any()
    train, test = time_split(prepare(recording(20.0)), 0.7)
    assert train.sum() == pytest.approx(0.7 * len(train), abs=2)
    assert not np.any(train & test)


def test_a_recording_that_repeats_another_is_named():
    first = prepare(recording(10.0, name="first"))
    other = prepare(recording(10.0, q=lambda t: sweep(t, seed=5), name="other"))
    later = prepare(recording(8.0, 500.0, q=lambda t: sweep(t + 3.0), name="later"))
    (found,) = repeats([first, other, later])
    assert (found.first, found.second) == ("first", "later")
    assert found.shift == pytest.approx(-3.0, abs=2e-3)
    assert found.overlap == pytest.approx(7.0, abs=0.1)


def test_recordings_of_the_same_motion_share_their_blocks():
    first = prepare(recording(10.0, name="first"))
    second = prepare(recording(10.0, q=lambda t: sweep(t + 2.0), name="second"))
    for (train_1, test_1), (train_2, test_2) in blocks_many([first, second], folds=4, guard=0.1):
        clock_1, clock_2 = first.times, second.times + 2.0
        for train, test in ((clock_1[train_1], clock_2[test_2]), (clock_2[train_2], clock_1[test_1])):
            if len(train) and len(test):
                assert np.min(np.abs(train[:, None] - test[None, :])) > 0.09


def test_recordings_linked_by_a_third_share_their_blocks():
    starts = (0.0, 9.5, 5.0)
    made = [prepare(recording(10.0, q=lambda t, start=start: sweep(t + start))) for start in starts]
    clocks = [s.times + start for s, start in zip(made, starts, strict=True)]
    for splits in blocks_many(made, folds=3):
        trained = np.concatenate([clock[train] for clock, (train, _) in zip(clocks, splits, strict=True)])
        tested = np.concatenate([clock[test] for clock, (_, test) in zip(clocks, splits, strict=True)])
        assert np.min(np.abs(trained[:, None] - tested[None, :])) > 0.09


def test_the_log_of_gaz_et_al_repeats_and_shows_its_noise_floor(data):
    made = prepare(load(data / "gaz_panda"))
    assert made.repairs["grid points filled where rows are missing"] == 1688
    assert len(made.time) == 20979
    assert made.rate == pytest.approx(1000.0)
    assert made.period == pytest.approx(13.3335, abs=1e-3)
    floor = repeatability(made)
    assert floor is not None
    # the notes' model-free floor at 5 Hz [N m]
    assert np.allclose(floor, [0.036, 0.017, 0.020, 0.0086, 0.0045, 0.0064, 0.0044], rtol=0.1)
    with pytest.raises(InputError, match=r"repeats itself after 13\.33"):
        time_split(made, 0.7)
