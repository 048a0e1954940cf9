"""Put the tool on trial with the cases that make.py leaves: diagnose, predict, compare with the truth.

    python score.py --cases CASES --out ANSWERS [--jobs N] [--limit SECONDS] [--only PREFIX ...]

Every case is a process of its own (`python -m jaxpanda`); cases that have an answer in ANSWERS are kept. Needs
the cases and the tool, and none of the recordings. Figures by family and joint are those of ../scoring.py.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import scoring
from concealed.score import EDGE, read_table

LIMIT = 1800.0
SAID = 0.5
"""Confidence from which a claim on a control counts as an alarm."""
CRASHED, LATE = "crashed", "over the time limit"


# -------------------------------------------------------------------------------- running the tool


def call(arguments, limit):
    """(exit status, what it printed); 124 where it took longer than `limit` seconds."""
    command = [sys.executable, "-m", "jaxpanda", *map(str, arguments)]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )
    try:
        printed, _ = process.communicate(timeout=limit)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)  # its own session, so only what it started
        return 124, process.communicate()[0] + f"\nlonger than {limit:.0f} s"
    return process.returncode, printed


def answer(case: Path, out: Path, limit: float):
    """Diagnosis and prediction of one case, kept in `out`; what it took."""
    out.mkdir(parents=True, exist_ok=True)
    options = json.loads((case / "truth.json").read_text()).get("options", [])
    arguments = ["diagnose", "--model", case / "model.xml", "--recording", *sorted(case.glob("train_*.csv"))]
    if before := sorted(case.glob("reference_*.csv")):
        arguments += ["--reference", *before]
    start = time.perf_counter()
    status, printed = call([*arguments, *options, "--out", out], limit)
    seconds = time.perf_counter() - start
    if status == 0:
        motion = ["--recording", case / "heldout_motion.csv", "--out", out / "heldout.csv"]
        status, more = call(["predict", "--diagnosis", out, *motion], limit)
        printed += more
    message = "" if status == 0 else printed[-800:]
    run = {"case": case.name, "status": status, "seconds": seconds, "message": message}
    (out / "run.json").write_text(json.dumps(run))
    return run


def run_tool(cases, out, jobs, limit):
    todo = [case for case in cases if not (out / case.name / "run.json").exists()]
    with ThreadPoolExecutor(jobs) as pool:
        for done in pool.map(lambda case: answer(case, out / case.name, limit), todo):
            failed = f"  status {done['status']}: {done['message'].strip()[-160:]}" if done["status"] else ""
            print(f"{done['case']}: {done['seconds']:.0f} s{failed}", flush=True)


# -------------------------------------------------------------------------------- judging


def overall(rmse, noise):
    """One number of an arm's errors: root mean square over joints, in units of the noise."""
    return float(np.sqrt(np.mean((np.asarray(rmse) / noise) ** 2)))


def reached(case: Path, predicted: Path):
    """(n,) RMSE on the held-out recording, or None."""
    t, tau = read_table(case / "heldout.csv")
    t_said, said = read_table(predicted)
    if t_said.shape != t.shape or not np.all(np.isfinite(said)):
        return None
    rows = (t > t[0] + EDGE) & (t < t[-1] - EDGE)
    return np.sqrt(np.mean((tau - said)[rows] ** 2, axis=0))


def first_right(places, finding, agree):
    """Right at half of its joints or more, in the sense of `agree`."""
    claims = scoring.claims_of(finding)
    right = [any(agree(place, claim) for place in places) for claim in claims]
    return 2 * sum(right) >= len(right)


def alarms(truth, findings, noise):
    """Findings of a control that are said at SAID or more and not allowed: (all, those larger than the noise)."""
    said = [
        f
        for f in findings
        if f["confidence"] >= SAID
        and not all(scoring.is_allowed(truth, claim) for claim in scoring.claims_of(f))
    ]
    large = [f for f in said if np.any(np.array(f.get("rms_torque") or noise) > noise)]
    return len(said), len(large)


def judge(case: Path, out: Path):
    """Everything that the figures need about one case."""
    truth = json.loads((case / "truth.json").read_text())
    run = json.loads((out / "run.json").read_text())
    result = scoring.judge_case(case, out)
    noise = np.array(truth["noise_std"])
    places = scoring.truth_places(truth)
    diagnosis = {"verdict": "failed", "findings": []}
    after = None
    if run["status"] == 0:
        diagnosis = json.loads((out / "diagnosis.json").read_text())
        after = reached(case, out / "heldout.csv")
    findings = diagnosis["findings"]
    result |= {
        "arm": truth["family"],
        "title": truth["title"],
        "status": run["status"],
        "message": run["message"],
        "seconds": run["seconds"],
        "verdict": diagnosis["verdict"],
        "said": [(f["effect"], f["joints"], f["confidence"]) for f in findings],
        "truth": [(e["effect"], e["joints"]) for e in truth["effects"]],
        "before": overall(truth["heldout"]["rmse_nominal"], noise),
        "after": None if after is None else overall(after, noise),
        "oracle": overall(truth["heldout"]["rmse_true_model"], noise),
        "alarms": alarms(truth, findings, noise) if not truth["effects"] else (0, 0),
    }
    if findings:
        first = findings[0]
        family = {p.family for p in places} | {scoring.FAMILY_OF[n] for p in places for n in p.also}
        result["first"] = {
            "confidence": first["confidence"],
            "name": first_right(places, first, scoring.names_it),
            "family_joint": first_right(places, first, scoring.same_family),
            "family": any(claim.family in family for claim in scoring.claims_of(first)),
            "allowed": all(scoring.is_allowed(truth, claim) for claim in scoring.claims_of(first)),
        }
    return result


# -------------------------------------------------------------------------------- the figures


def mean(values):
    return float(np.mean(values)) if len(values) else None


def figures(results):
    """Name -> (value, on how many it rests)."""
    table = {}
    concealed = [r for r in results if not r["null"]]
    controls = [r for r in results if r["null"]]
    for kind in ("real", "semi", "all"):
        some = [r for r in concealed if kind in (r["kind"], "all")]
        for what in ("family", "family_joint", "name"):
            right = [bool(r.get("first", {}).get(what)) for r in some]
            table[f"first finding, {what.replace('_', ' and ')} right, {kind}"] = (mean(right), len(right))
    table["crashed, refused or over the limit"] = (mean([r["status"] != 0 for r in results]), len(results))
    for k, what in enumerate(("", ", larger than the noise")):
        some = [r["alarms"][k] > 0 for r in controls]
        table[f"controls with a claim at {SAID} not allowed{what}"] = (mean(some), len(some))
    table["controls that are harmed"] = _harmed(controls)
    table["concealed cases that are harmed"] = _harmed(concealed)
    gain = [r["closed"] for r in concealed if r.get("closed") is not None]
    table["held-out gain over the oracle's, median"] = (float(np.median(gain)) if gain else None, len(gain))
    table["held-out gain over the oracle's, 10 % quantile"] = (
        float(np.quantile(gain, 0.1)) if gain else None,
        len(gain),
    )
    firsts = [r["first"] for r in results if "first" in r]
    firsts = [f for f in firsts if f["name"] or not f["allowed"]]
    sure = [(f["confidence"] - f["name"]) ** 2 for f in firsts]
    table["Brier score of the first finding"] = (mean(sure), len(sure))
    seconds = [r["seconds"] for r in results]
    table["seconds a diagnosis, median"] = (float(np.median(seconds)), len(seconds))
    table["seconds a diagnosis, slowest"] = (float(np.max(seconds)), len(seconds))
    return table


def _harmed(results):
    some = [r["harm"] for r in results if "harm" in r]
    return mean(some), len(some)


def line(r):
    """truth | what was said | held-out error before, after, oracle."""
    joints = lambda x: ",".join(map(str, x))
    truth = "; ".join(f"{name} {joints(where)}" for name, where in r["truth"]) or "nothing"
    said = "; ".join(f"{name} {joints(where)} ({sure:.2f})" for name, where, sure in r["said"])
    if r["status"]:
        said = LATE if r["status"] == 124 else f"{CRASHED}: {r['message'].strip()[-100:]!r}"
    after = "-" if r["after"] is None else f"{r['after']:.2f}"
    marks = "".join(
        mark for mark, on in (("!", r.get("harm")), ("?", r["alarms"][0]), ("x", r["status"])) if on
    )
    right = ""
    if not r["null"]:
        first = r.get("first", {})
        right = "name" if first.get("name") else "family" if first.get("family") else "wrong"
    return (
        f"{r['case']} {r['kind']} {right} {marks}| {truth} | {r['verdict']}: {said or 'nothing'} | "
        f"{r['before']:.2f} -> {after} (oracle {r['oracle']:.2f}) | {r['seconds']:.0f} s"
    )


def report(cases, out):
    """The figures as text; also left in `out` as report.txt and results.json."""
    results = [judge(case, out / case.name) for case in cases]
    table = figures(results)
    lines = [f"{'figure':58s} {'value':>8s} {'n':>5s}"]
    lines += [f"{name:58s} {scoring.shown(value):>8s} {n:5d}" for name, (value, n) in table.items()]
    lines += ["", scoring.as_text(results), "", "held-out error: RMS over joints, in units of the noise;"]
    lines += ["! harm, ? alarm on a control, x no answer", "", *map(line, results)]
    text = "\n".join(lines)
    (out / "results.json").write_text(
        json.dumps({"figures": table, "cases": results}, indent=1, default=float)
    )
    (out / "report.txt").write_text(text + "\n")
    return text


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--limit", type=float, default=LIMIT, help="seconds a case")
    parser.add_argument("--only", nargs="*", default=None, help="cases whose names begin so")
    options = parser.parse_args()
    cases = sorted(path.parent for path in options.cases.glob("*/truth.json"))
    cases = [c for c in cases if options.only is None or c.name.startswith(tuple(options.only))]
    if not cases:
        raise SystemExit(f"no cases in {options.cases}")
    options.out.mkdir(parents=True, exist_ok=True)
    run_tool(cases, options.out, options.jobs, options.limit)
    print(report(cases, options.out))


if __name__ == "__main__":
    main()
