"""How often a finding is right, by what is told of it: the weights of `jaxpanda.diagnosis.calibration`.

    python calibrate.py --cases CASES ... --out ANSWERS ...

One folder of answers (`concealed/score.py --out`) for each of cases. Prints the weights, and the figures that
they give on cases that they were not fitted to (ten folds). Seeds whose figures are reported must not be among
those that the weights come from.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy.special
from scipy.optimize import minimize
from scoring import SURE, calibration_error, claims_of, is_allowed, is_right, truth_places

from jaxpanda.diagnosis.calibration import UNTOLD, WEIGHTS, features, weight_of

FOLDS = 10
RIDGE = 3.0
"""On what the weights differ by from those of today, which are of hundreds of findings: a few dozen cases correct
them."""
SIGNS = (0, 1, 1, 1, -1, -1, 1)
"""Of the weights: more of what speaks for a finding never makes less sure."""


def judged(case: Path, answer: Path) -> tuple[np.ndarray, np.ndarray]:
    """(features, right) of each finding that the trial judges."""
    truth = json.loads((case / "truth.json").read_text())
    said = json.loads((answer / "diagnosis.json").read_text())
    findings, places = said["findings"], truth_places(truth)
    if not findings:
        return np.zeros((0, len(WEIGHTS))), np.zeros(0)
    fit = said["fit"]
    error = np.maximum(fit["held_out_rmse_after"], fit["noise_floor"])
    sizes = np.array([f["rms_torque"] for f in findings]) / error
    foretold = [f["evidence_nats"] if f["held_out_nats"] is None else f["held_out_nats"] for f in findings]
    at_times = np.array([bool(f["parameters"]) and f["intervals"] is not None for f in findings])
    told = [f.get("rms_torque_std") or np.array(f["rms_torque"]) / UNTOLD for f in findings]
    first, *others = features(
        sizes, np.array(foretold), said["verdict"] == "explained", at_times, np.array(told) / error
    ).T
    weight = [weight_of(f["confidence"] if f.get("posterior") is None else f["posterior"]) for f in findings]
    right = np.array([is_right(places, f) for f in findings])
    allowed = [all(is_allowed(truth, claim) for claim in claims_of(f)) for f in findings]
    counts = right | ~np.array(allowed)
    return np.stack([first, weight, *others], 1)[counts], right[counts].astype(float)


def fitted(x: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Weights of the logistic regression, near those of today."""
    way, today = 2 * right - 1, np.array(WEIGHTS)

    def loss(w: np.ndarray) -> float:
        return float(np.logaddexp(0, -way * (x @ w)).sum() + RIDGE * np.sum((w - today) ** 2))

    bounds = [(0.0 if sign > 0 else None, 0.0 if sign < 0 else None) for sign in SIGNS]
    return minimize(loss, today, bounds=bounds).x


def report(parts: Sequence[tuple[np.ndarray, np.ndarray]]) -> str:
    """The weights, and what they do out of sample."""
    x, right = (np.concatenate(part) for part in zip(*parts, strict=True))
    case = np.repeat(np.arange(len(parts)), [len(r) for _, r in parts])
    fold = np.random.default_rng(0).permutation(len(parts))[case] % FOLDS
    said = np.zeros(len(x))
    for k in range(FOLDS):
        said[fold == k] = scipy.special.expit(x[fold == k] @ fitted(x[fold != k], right[fold != k]))
    lines = [f"{len(x)} findings of {len(parts)} cases, {right.mean():.3f} right"]
    lines.append("weights: " + ", ".join(f"{w:.2f}" for w in fitted(x, right)))
    for name, p in (("posterior", scipy.special.expit(x[:, 1])), ("cross-validated", said)):
        pairs = [(float(a), bool(b)) for a, b in zip(p, right, strict=True)]
        sure = p >= SURE
        lines.append(
            f"{name}: calibration error {calibration_error(pairs):.3f}, Brier {np.mean((p - right) ** 2):.3f},"
            f" of {sure.sum()} claims at {SURE} or more {right[sure].mean():.3f} right,"
            f" {np.sum(sure & (right == 0)) / len(parts):.3f} false ones a case"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=Path, nargs="+", required=True)
    parser.add_argument("--out", type=Path, nargs="+", required=True)
    args = parser.parse_args()
    parts = []
    for cases, answers in zip(args.cases, args.out, strict=True):
        both = [(path.parent, cases / path.parent.name) for path in sorted(answers.glob("*/diagnosis.json"))]
        parts += [judged(case, answer) for answer, case in both]
    print(report(parts))


if __name__ == "__main__":
    main()
