"""The trial `experiments/in_service`: its cases are whole, the same for one seed, and what their truth says."""

import json
from pathlib import Path

import pytest
from helpers import run_script

FOLDER = Path(__file__).resolve().parents[1] / "experiments" / "in_service"


@pytest.mark.slow
def test_cases_are_the_same_for_one_seed_and_their_torque_is_what_the_truth_says(tmp_path):
    for folder in ("a", "b"):
        run_script(FOLDER, "make.py", "--seed", 7, "--count", 3, "--out", tmp_path / folder)
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*.*"))
    assert {"model.xml", "train_0.csv", "heldout.csv", "heldout_motion.csv"} <= {f.name for f in files}
    assert all((tmp_path / "a" / f).read_bytes() == (tmp_path / "b" / f).read_bytes() for f in files)
    truths = [json.loads(path.read_text()) for path in (tmp_path / "a").glob("*/truth.json")]
    assert any(not entry["optional"] for truth in truths for entry in truth["effects"])
    said = run_script(FOLDER, "check.py", tmp_path / "a")
    assert said.startswith("3 of 3 cases")
    assert "DIFFERS" not in said
