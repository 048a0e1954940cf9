"""What a diagnosis of two torques finds, and on which side.  python score.py --cases CASES --out ANSWERS

Runs `jaxpanda diagnose` and `predict` on every case that has no answer yet. Places (an effect at a joint),
families, and what is right or allowed are those of ../scoring.py, each side for itself and with its own noise.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from check import on, table
from make import judged, rms_error
from scoring import SURE, claims_of, is_allowed, is_right, same_family, truth_places

SIDES = {"link": "noise_std", "drive": "noise_std_drive"}
LIKELY = 0.5
GAP = 1.0  # summed squares over joints, in units of the low-passed noise: less is none


def answer(case: Path, out: Path, timeout: float) -> dict:
    """Status and seconds of the two commands; kept in run.json, and not run again."""
    if (out / "run.json").exists():
        return json.loads((out / "run.json").read_text())
    out.mkdir(parents=True, exist_ok=True)
    tool = [sys.executable, "-m", "jaxpanda"]
    reference = sorted(case.glob("reference_*.csv"))
    said = ["--reference", *reference] if reference else []
    trained = sorted(case.glob("train_*.csv"))
    motion = case / "heldout_motion.csv"
    commands = (
        [*tool, "diagnose", "--model", case / "model.xml", "--recording", *trained, *said, "--out", out],
        [*tool, "predict", "--diagnosis", out, "--recording", motion, "--out", out / "heldout.csv"],
    )
    start, status = time.time(), 0
    with (out / "log.txt").open("w") as log:
        for command in commands:
            try:
                status = status or subprocess.run(command, stdout=log, stderr=log, timeout=timeout).returncode
            except subprocess.TimeoutExpired:
                status = 124
    run = {"status": status, "seconds": round(time.time() - start, 1)}
    (out / "run.json").write_text(json.dumps(run))
    return run


def of_side(truth: dict, side: str) -> dict:
    """The truth of one side, as ../scoring.py reads it."""
    effects, allowed = ([e for e in truth[key] if e["side"] == side] for key in ("effects", "allowed"))
    return {"noise_std": truth[SIDES[side]], "effects": effects, "allowed": allowed}


def judge(truth: dict, findings: list[dict]) -> dict:
    """Counts of one case. A place is found where family and joint agree, whatever side the finding names."""
    truths = {side: of_side(truth, side) for side in SIDES}
    places = {side: truth_places(truths[side]) for side in SIDES}
    wanted: dict = {}
    for side in SIDES:
        for place in (p for p in places[side] if p.ratio >= 1):
            named = {f.get("side") for f in findings if any(same_family(place, c) for c in claims_of(f))}
            key = side, place.family, place.joint
            found, on_side = wanted.get(key, (False, False))
            wanted[key] = found or bool(named), on_side or side in named
    clean, wrong, not_allowed = [], [], []
    for f in findings:
        side = f.get("side")
        known = side in SIDES
        right = known and is_right(places[side], f)
        allowed = known and all(is_allowed(truths[side], c) for c in claims_of(f))
        told = f"{side} {f['effect']} {f['joints']} {f['confidence']:.2f}"
        if right or allowed:
            continue
        not_allowed.append(told)
        missing = known and any(not e["optional"] for e in truths[side]["effects"])
        clean += [told] if f["confidence"] >= LIKELY and not missing else []
        wrong += [told] if f["confidence"] >= SURE else []
    null = truth["kind"] == "null"
    return {
        "wanted": len(wanted),
        "found": sum(found for found, _ in wanted.values()),
        "found on its side": sum(on_side for _, on_side in wanted.values()),
        "missed": [f"{s} {family} J{j}" for (s, family, j), (_, on_side) in wanted.items() if not on_side],
        "on a clean side": clean,
        "wrong and sure": wrong,
        "in a null": len(findings) if null else 0,
        "in a null, not allowed": len(not_allowed) if null else 0,
    }


def gap_closed(truth: dict, case: Path, out: Path) -> dict[str, float | None]:
    """Share of the held-out gap that the prediction closes; None where none is there to close."""
    effects = [e for e in truth["effects"] if not e["optional"]]
    missing = {"tau": [e for e in effects if e["side"] == "link"], "tau_motor": effects}
    measured, predicted = table(case / "heldout.csv"), table(out / "heldout.csv")
    with np.load(case / "hidden.npz") as hidden:
        t, qd, stick = (hidden[f"heldout.csv/{key}"] for key in ("t", "qd", "stick"))
    t = t.astype(float)
    rows = judged(measured["time"], on(measured["time"], t, qd), on(measured["time"], t, stick))
    closed = {}
    for channel, key, noise in (("tau", "", "noise_std"), ("tau_motor", "_motor", "noise_std_drive")):
        scale = np.array(truth[noise])
        nominal, best = (
            np.sum((np.array(truth["heldout"][f"rmse_{k}{key}"]) / scale) ** 2)
            for k in ("nominal", "true_model")
        )
        closed[channel] = None
        if missing[channel] and not truth["old"] and nominal - best > GAP:
            if channel not in predicted or predicted[channel].shape != measured[channel].shape:
                closed[channel] = 0.0  # no prediction: nothing closed
                continue
            off = rms_error(measured[channel] - predicted[channel], rows[channel]) / scale
            closed[channel] = float((nominal - np.sum(off**2)) / (nominal - best))
    return closed


def score(case: Path, out: Path, timeout: float) -> dict:
    truth, run = json.loads((case / "truth.json").read_text()), answer(case, out, timeout)
    failed = run["status"] != 0
    findings = [] if failed else json.loads((out / "diagnosis.json").read_text())["findings"]
    closed = {"tau": None, "tau_motor": None} if failed else gap_closed(truth, case, out)
    return {"case": case.name, "kind": truth["kind"], **run, **judge(truth, findings), "closed": closed}


def figures(results: list[dict]) -> dict:
    """Sums over the cases, and the medians of the shares."""
    closed = {
        key: [r["closed"][key] for r in results if r["closed"][key] is not None]
        for key in ("tau", "tau_motor")
    }
    return {
        "cases": len(results),
        "failed": sum(r["status"] != 0 for r in results),
        "detectable": sum(r["wanted"] for r in results),
        "found, right family and joint": sum(r["found"] for r in results),
        "found, and on the right side": sum(r["found on its side"] for r in results),
        "findings at 0.5 or more on a side where nothing is missing": sum(
            len(r["on a clean side"]) for r in results
        ),
        "findings in nulls": sum(r["in a null"] for r in results),
        "findings in nulls, not allowed": sum(r["in a null, not allowed"] for r in results),
        "wrong findings at 0.9 or more": sum(len(r["wrong and sure"]) for r in results),
        "held-out gap closed, tau, median": float(np.median(closed["tau"])) if closed["tau"] else None,
        "held-out gap closed, tau_motor, median": (
            float(np.median(closed["tau_motor"])) if closed["tau_motor"] else None
        ),
    }


def line(r: dict) -> str:
    """A case in a line."""
    shares = " ".join("    -" if share is None else f"{share:5.2f}" for share in r["closed"].values())
    counts = f"{r['found on its side']:2d}/{r['found']:2d}/{r['wanted']:2d}"
    notes = [
        f"{title}: {', '.join(r[key])}"
        for title, key in (
            ("missed", "missed"),
            ("clean side", "on a clean side"),
            ("sure", "wrong and sure"),
        )
        if r[key]
    ]
    failed = f" status {r['status']}" if r["status"] else ""
    return f"{r['case']} {r['kind']:5s} {counts} {shares} {r['seconds']:6.0f} s{failed}  {'; '.join(notes)}"


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--timeout", type=float, default=3600, help="seconds for one command")
    args = parser.parse_args()
    cases = sorted(path.parent for path in args.cases.glob("*/truth.json"))
    results = [score(case, args.out / case.name, args.timeout) for case in cases]
    totals = figures(results)
    for name, value in totals.items():
        print(f"{name:60s} {'-' if value is None else round(value, 3)}")
    print("\ncase     kind  on its side/found/detectable, gap closed of tau and tau_motor, time")
    print("\n".join(line(r) for r in results))
    if args.json:
        args.json.write_text(json.dumps({"figures": totals, "cases": results}, indent=1) + "\n")


if __name__ == "__main__":
    main()
