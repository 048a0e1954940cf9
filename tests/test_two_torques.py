"""The trial `experiments/two_torques`: the same cases for one seed, and the parts of their torque add up."""

from pathlib import Path

import pytest
from helpers import run_script

FOLDER = Path(__file__).resolve().parents[1] / "experiments" / "two_torques"


@pytest.mark.slow
def test_cases_are_the_same_for_one_seed_and_their_torques_are_what_the_truth_says(tmp_path):
    for folder in ("a", "b"):
        run_script(FOLDER, "make.py", "--seed", 7, "--count", 4, "--out", tmp_path / folder)
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*.csv"))
    assert {"train_1.csv", "heldout.csv", "heldout_motion.csv"} <= {f.name for f in files}
    assert all((tmp_path / "a" / f).read_bytes() == (tmp_path / "b" / f).read_bytes() for f in files)
    trained = next(f for f in files if f.name == "train_1.csv")
    header = (tmp_path / "a" / trained).read_text().split("\n", 1)[0]
    assert {"tau_1", "tau_motor_1"} <= set(header.split(","))
    run_script(FOLDER, "check.py", "--cases", tmp_path / "a")  # ends with status 1 where anything is unsound
