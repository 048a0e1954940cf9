"""A rehearsal recovers what it planted within what it says, and says what a motion cannot tell."""

import json

import numpy as np
import pytest
from helpers import result
from test_excitation import ARM

from jaxpanda import Arm, Recording, rehearse
from jaxpanda.__main__ import main
from jaxpanda.recordings import save
from jaxpanda.simulation import Sensors, SplineTrajectory, random_trajectory, simulate, with_sensors


def motion(seconds=12.0, joints=(0, 1, 2)):
    time = np.arange(int(100 * seconds)) / 100
    q, qd, _ = random_trajectory(ARM, 1, period=seconds / 2)(time)
    still = [j for j in range(3) if j not in joints]
    q[:, still], qd[:, still] = q[0, still], 0.0
    return Recording("motion", time, q, qd=qd)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "arm.xml"
    path.write_text(ARM)
    return path


@pytest.mark.slow
def test_what_is_planted_comes_back_within_its_deviation(model, tmp_path, capsys):
    save(motion(), tmp_path / "motion.csv")
    given = ["--model", str(model), "--motion", str(tmp_path / "motion.csv"), "--draws", "2", "--json"]
    assert main(["rehearse", *given, "--out", str(tmp_path / "out")]) == 0
    document = json.loads(capsys.readouterr().out)
    assert result(tmp_path / "out" / "rehearsal.json")["rank"] == document["rank"] == 15
    rows = document["parameters"] + document["friction"]
    assert {row["unit"] for row in document["parameters"]} == {"kg m", "kg m²"}
    assert document["unit"] == "N m"
    off = np.array([abs(row["mean"] - row["truth"]) / row["std"] for row in rows])
    assert np.mean(off < 3) > 0.8
    assert sum(row["told"] for row in document["parameters"]) >= 10
    nominal = np.asarray(Arm.from_mjcf(model).standard)
    assert nominal[2, 1] != pytest.approx(  # m3c3x is a base parameter of this arm, and was not left as it is
        next(row["truth"] for row in rows if row["name"] == "m3c3x"), rel=1e-3
    )
    least = {(row["effect"], row["joint"]): row for row in document["faults"]}
    assert 0 < least["coulomb_friction", 3]["rms_torque"] < 0.1


@pytest.mark.slow
def test_a_joint_that_rests_tells_less(model):
    found = rehearse(model, motion(joints=(1, 2)), draws=2)
    resting = {row.name: row for row in found.friction if row.joint == 1}
    assert not resting["viscous"].told
    assert "viscous of joint 1" in found.to_json()["not_told"]


@pytest.mark.parametrize(
    ("change", "said"),
    [({"q": np.zeros((100, 3))}, "no joint moves"), ({"q": np.zeros((100, 4))}, "4 joints")],
)
def test_motions_that_tell_nothing_are_refused(model, tmp_path, capsys, change, said):
    time = np.arange(100) / 50
    save(Recording("still", time, change["q"]), tmp_path / "still.csv")
    given = ["rehearse", "--model", str(model), "--motion", str(tmp_path / "still.csv")]
    assert main([*given, "--out", str(tmp_path / "out")]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_spline_goes_through_the_motion_and_its_derivatives():
    time = np.arange(400) / 100
    path = SplineTrajectory.through(time, np.stack([np.sin(time), np.cos(2 * time)], 1))
    q, qd, qdd = path(np.linspace(0.5, 3.5, 50))
    at = np.linspace(0.5, 3.5, 50)
    assert np.allclose(q, np.stack([np.sin(at), np.cos(2 * at)], 1), atol=1e-8)
    assert np.allclose(qd[:, 0], np.cos(at), atol=1e-6)
    assert np.allclose(qdd[:, 1], -4 * np.cos(2 * at), atol=1e-4)
    assert path.dof == 2


def test_sensors_show_a_perfect_log_with_noise_of_their_own():
    exact = simulate(ARM, random_trajectory(ARM, 1), duration=0.5, rate=100.0)
    noisy = [with_sensors(exact, Sensors(torque_noise=0.1), seed) for seed in (1, 1, 2)]
    first, again, other = (np.asarray(one.tau) for one in noisy)
    assert np.array_equal(first, again)
    assert np.std(first - other) == pytest.approx(0.1 * np.sqrt(2), rel=0.2)
    assert np.array_equal(noisy[0].q, exact.q)
