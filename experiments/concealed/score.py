"""Put the tool on trial: run its command line on every case, compare with the truth, print the figures.

    python score.py --cases DIR --out DIR [--jobs N]

The tool is called as a user calls it (`jaxpanda diagnose`, `jaxpanda predict`) in a process that stays alive
between the cases, so that starting Python is not counted; nothing of it is imported here.
"""

import argparse
import contextlib
import io
import json
import runpy
import sys
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from scipy.stats import beta

# Effects that belong to the whole arm, a link or a signal rather than to joints: their joints are not scored.
WHOLE = {
    "payload",
    "payload_change",
    "inertial_parameters",
    "gravity_direction",
    "time_delay",
    "external_contact",
}
EDGE = 0.3  # [s] at either end of the held-out motion that is not scored, as in truth.json
RATIOS = {"strong": 15.0, "medium": 5.0, "weak": 1.5}  # RMS of the effect over torque noise
TARGETS = {
    "named right, strong": 0.95,
    "named right, medium": 0.90,
    "named right, weak": 0.60,
    "joints exact, strong": 0.95,
    "joints exact, medium": 0.90,
    "interval IoU, median": 0.7,
    "false alarms": 0.03,
    "pairs, recall": 0.85,
    "pairs, precision": 0.90,
    "outside, unknown or not fully explained": 0.90,
    "gap closed, median": 0.90,
    "Brier score": 0.1,
}


# Where truth and answer have a number of the same meaning: name in the truth, name in the answer, and what of the
# answer's value is the truth's.
SAME = {
    "viscous_friction": [("damping", "damping", lambda x: x)],
    "coulomb_friction": [("coulomb", "coulomb", lambda x: x)],
    "armature": [("armature", "armature", lambda x: x)],
    "torque_offset": [("offset", "offset", lambda x: x)],
    "torque_gain": [("gain", "gain_error", lambda x: 1 + x)],
    "torque_ripple": [("order", "order", lambda x: x)],
    "encoder_offset": [("offset", "offset", lambda x: x)],
    "time_delay": [("delay", "delay", lambda x: x)],
    "joint_elasticity": [("stiffness", "stiffness", lambda x: x)],
    "backlash": [("gap", "half_width", lambda x: 2 * x)],
    "payload": [("mass", "mass", lambda x: x)],
    "payload_change": [("mass", "mass", lambda x: x)],
    "external_contact": [("force", "force", lambda x: x)],
}


# -------------------------------------------------------------------------------- running the tool


def call(arguments):
    """`jaxpanda ...` in this process; exit status and what it printed."""
    printed = io.StringIO()
    before = sys.argv
    sys.argv = ["jaxpanda", *map(str, arguments)]
    status = 0
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed), warnings.catch_warnings():
        # runpy warns where the module was imported before, which does no harm here
        warnings.filterwarnings("ignore", message=".*found in sys.modules", category=RuntimeWarning)
        try:
            runpy.run_module("jaxpanda", run_name="__main__")
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else int(end.code is not None)
        except Exception as error:  # a crash of the tool is an outcome of the trial, not the end of it
            print(f"{type(error).__name__}: {error}")
            status = 1
        finally:
            sys.argv = before
    return status, printed.getvalue()


def diagnose(job):
    """Diagnosis and prediction of one case, kept in `out`; returns what it took."""
    case, out = map(Path, job)
    out.mkdir(parents=True, exist_ok=True)
    recordings = sorted(case.glob("train_*.csv"))
    arguments = ["diagnose", "--model", case / "model.xml", "--recording", *recordings, "--out", out]
    if before := sorted(case.glob("reference_*.csv")):
        arguments += ["--reference", *before]
    # What a user knows of where the model's numbers are from; nothing is said of exact or identified ones.
    if json.loads((case / "truth.json").read_text())["nominal"] == "rough":
        arguments += ["--knowledge", "rough"]
    start = time.perf_counter()
    status, printed = call(arguments)
    seconds = time.perf_counter() - start
    if status == 0:
        predicted = ["--recording", case / "heldout_motion.csv", "--out", out / "heldout.csv"]
        status, more = call(["predict", "--diagnosis", out, *predicted])
        printed += more
    message = "" if status == 0 else printed[-500:]
    run = {"case": case.name, "status": status, "seconds": seconds, "message": message}
    (out / "run.json").write_text(json.dumps(run))
    return run


def run_tool(cases, out, jobs=1):
    """Diagnose all cases; those already in `out` are kept."""
    todo = [(str(c), str(out / c.name)) for c in cases if not (out / c.name / "run.json").exists()]
    # A process keeps every program it compiled: after some ninety cases the system grants it no more memory maps.
    # So each lot of cases has processes of its own. (With `max_tasks_per_child`, Python 3.11 hung.)
    lot = 30 * jobs
    for first in range(0, len(todo), lot):
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
            for done in pool.map(diagnose, todo[first : first + lot]):
                print(f"{done['case']}: {done['seconds']:.1f} s{done['message'] and '  FAILED'}", flush=True)


# -------------------------------------------------------------------------------- judging one answer


def read_table(path):
    with open(path) as file:
        names = file.readline().strip().split(",")
        table = np.loadtxt(file, delimiter=",", ndmin=2)
    return table[:, 0], table[:, [k for k, name in enumerate(names) if name.startswith("tau_")]]


def overlap(a, b):
    """Length of intersection over length of union of two lists of intervals."""
    edges = np.unique(np.concatenate([np.ravel(a), np.ravel(b)]))
    middle = 0.5 * (edges[1:] + edges[:-1])
    inside = [np.any([(lo <= middle) & (middle <= hi) for lo, hi in x], axis=0) for x in (a, b)]
    length = np.diff(edges)
    return float(np.sum(length[inside[0] & inside[1]]) / max(np.sum(length[inside[0] | inside[1]]), 1e-12))


def interval_overlap(entry, finding):
    """IoU of a time-local effect with the finding of its name; 0 where there is none."""
    if finding is None or not finding.get("intervals"):
        return 0.0
    return overlap(entry["intervals"], finding["intervals"])


def deviations(entry, finding):
    """How many standard deviations the answer's numbers are from the truth's, where they mean the same."""
    found = []
    for name, called, truth_of in SAME.get(entry["effect"], []):
        for told in (p for p in entry.get("parameters", ()) if p["name"] == name):
            ours = [p for p in finding.get("parameters", ()) if p["name"] == called]
            if len(ours) > 1:
                ours = [p for p in ours if p["joint"] == told["joint"]]
            for p in ours[:1]:
                std = abs(truth_of(p["value"] + p["std"]) - truth_of(p["value"]))
                found.append((truth_of(p["value"]) - told["value"]) / max(std, 1e-12))
    return found


def gap_closed(truth, case, predicted):
    """Share of the way from the user's simulation to the true model, in squared error over noise.

    None where there is no gap to close. Also the largest ratio of any joint's error to that of the user's
    simulation: above 1, the answer does harm.
    """
    noise = np.array(truth["noise_std"])
    nominal, oracle = (np.array(truth["heldout"][key]) / noise for key in ("rmse_nominal", "rmse_true_model"))
    t, tau = read_table(case / "heldout.csv")
    t_predicted, tau_predicted = read_table(predicted)
    if t_predicted.shape != t.shape or not np.all(np.isfinite(tau_predicted)):
        return None, np.inf
    rows = (t > t[0] + EDGE) & (t < t[-1] - EDGE)
    reached = np.sqrt(np.mean((tau - tau_predicted)[rows] ** 2, axis=0)) / noise
    gap = np.sum(nominal**2) - np.sum(oracle**2)
    share = None
    if gap > 0.1 * np.sum(oracle**2):
        share = float((np.sum(nominal**2) - np.sum(reached**2)) / gap)
    return share, float(np.max(reached / nominal))


def strength(entry, noise_std):
    """Name of the nearest strength of the trial, for sets whose truth does not say it."""
    ratio = max(np.max(np.array(entry["rms_torque"]) / noise_std), 1e-9)
    return min(RATIOS, key=lambda name: abs(np.log(RATIOS[name] / ratio)))


def judge(case, out):
    """Everything that the figures need about one case."""
    truth = json.loads((case / "truth.json").read_text())
    run = json.loads((out / "run.json").read_text())
    effects = truth["effects"]
    result = {
        "case": case.name,
        "stratum": truth.get("stratum", ("null", "single", "pair")[min(len(effects), 2)]),
        "strengths": truth.get("strengths") or [strength(entry, truth["noise_std"]) for entry in effects],
        "nasty": truth.get("nasty", ""),
        "family": truth["family"],
        "nominal": truth["nominal"],
        "truth": [entry["effect"] for entry in effects],
        "truth_joints": [entry["joints"] for entry in effects],
        "seconds": run["seconds"],
        "status": run["status"],
        "message": run["message"],
    }
    diagnosis = {"verdict": "failed", "findings": []}
    if run["status"] == 0:
        diagnosis = json.loads((out / "diagnosis.json").read_text())
        result["gap_closed"], result["harm"] = gap_closed(truth, case, out / "heldout.csv")
    allowed = [name for name in truth.get("allowed", ()) if isinstance(name, str)]  # not of some joints alone
    findings = [f for f in diagnosis["findings"] if f["effect"] not in allowed]
    result["only_allowed"] = bool(diagnosis["findings"]) and not findings
    result["verdict"] = diagnosis["verdict"]
    result["answer"] = [f["effect"] for f in findings]
    result["answer_joints"] = [f["joints"] for f in findings]
    result["confidence"] = [f["confidence"] for f in findings]
    if findings:
        first = findings[0]
        outside = any(name.startswith("outside:") for name in result["truth"])
        right = first["effect"] == "unknown" if outside else first["effect"] in result["truth"]
        result["first_right"] = bool(right)
    result["iou"] = [
        interval_overlap(entry, next((f for f in findings if f["effect"] == entry["effect"]), None))
        for entry in effects
        if entry["intervals"] is not None
    ]
    result["deviations"] = [
        [entry["effect"], z]
        for entry in effects
        for finding in findings
        if finding["effect"] == entry["effect"]
        for z in deviations(entry, finding)
    ]
    return result


# -------------------------------------------------------------------------------- the figures


def matched(truth, answer):
    """How many names two lists share, each used once."""
    left = list(answer)
    count = 0
    for name in truth:
        if name in left:
            left.remove(name)
            count += 1
    return count


def at_most(events, count, level=0.95):
    """One-sided Clopper-Pearson bound on the rate."""
    return 1.0 if events >= count else float(beta.ppf(level, events + 1, count - events))


def _mean(values):
    return float(np.mean(values)) if len(values) else None


def figures(results):
    """The table of the trial: name -> (value, number of cases or answers it rests on)."""
    of = {
        name: [r for r in results if r["stratum"] == name] for name in ("single", "pair", "outside", "null")
    }
    table = {}
    for size in RATIOS:
        some = [r for r in of["single"] if r["strengths"] == [size]]
        named = [r["answer"][:1] == r["truth"] for r in some]
        table[f"named right, {size}"] = (_mean(named), len(named))
        local = [r for r in some if r["truth"][0] not in WHOLE]
        exact = [
            bool(r["answer"]) and sorted(r["answer_joints"][0]) == sorted(r["truth_joints"][0]) for r in local
        ]
        table[f"joints exact, {size}"] = (_mean(exact), len(exact))
    iou = [x for r in of["single"] + of["pair"] for x in r["iou"]]
    table["interval IoU, median"] = (float(np.median(iou)) if iou else None, len(iou))
    alarms = [
        bool(r["answer"]) or (r["verdict"] != "consistent" and not r["only_allowed"]) for r in of["null"]
    ]
    table["false alarms"] = (_mean(alarms), len(alarms))
    table["false alarms, 95 % bound"] = (at_most(sum(alarms), len(alarms)) if alarms else None, len(alarms))
    hits = [matched(r["truth"], r["answer"]) for r in of["pair"]]
    said = sum(len(r["answer"]) for r in of["pair"])
    table["pairs, recall"] = (_mean([h / 2 for h in hits]), 2 * len(hits))
    table["pairs, precision"] = (sum(hits) / said if said else None, said)
    table["pairs, both and nothing else"] = (
        _mean([sorted(r["answer"]) == sorted(r["truth"]) for r in of["pair"]]),
        len(hits),
    )
    extra = [max(0, len(r["answer"]) - 1) for r in of["single"]]
    table["singles, further findings a case"] = (_mean(extra), len(extra))
    unknown = [
        "unknown" in r["answer"] or r["verdict"] in ("partly_explained", "unexplained") for r in of["outside"]
    ]
    table["outside, unknown or not fully explained"] = (_mean(unknown), len(unknown))
    closed = [r["gap_closed"] for r in results if r.get("gap_closed") is not None]
    table["gap closed, median"] = (float(np.median(closed)) if closed else None, len(closed))
    table["gap closed, 10 % quantile"] = (float(np.quantile(closed, 0.1)) if closed else None, len(closed))
    table["gap closed, negative"] = (_mean([x < 0 for x in closed]), len(closed))
    harm = [r["harm"] for r in results if "harm" in r]
    table["any joint > 10 % worse than nominal"] = (_mean([h > 1.1 for h in harm]), len(harm))
    off = [abs(z) for r in results for _, z in r["deviations"]]
    table["truth within 95 % interval"] = (_mean([z < 1.96 for z in off]), len(off))
    sure = [(r["confidence"][0] - r["first_right"]) ** 2 for r in results if r["answer"]]
    table["Brier score"] = (_mean(sure), len(sure))
    seconds = [r["seconds"] for r in results]
    table["seconds a diagnosis, median"] = (float(np.median(seconds)), len(seconds))
    table["seconds a diagnosis, slowest"] = (float(np.max(seconds)), len(seconds))
    table["failures of the tool"] = (_mean([r["status"] != 0 for r in results]), len(results))
    return table


def as_text(table):
    lines = [f"{'figure':42s} {'value':>8s} {'target':>8s} {'n':>5s}"]
    for name, (value, count) in table.items():
        target = TARGETS.get(name)
        mark = ""
        if target is not None and value is not None:
            low_is_good = name in ("false alarms", "Brier score")
            mark = "" if (value <= target if low_is_good else value >= target) else "  missed"
        shown = "-" if value is None else f"{value:.3f}"
        lines.append(
            f"{name:42s} {shown:>8s} {'' if target is None else f'{target:.2f}':>8s} {count:5d}{mark}"
        )
    return "\n".join(lines)


def confusion(results):
    """Truth (rows) by first answer (columns, numbered; 0 is silence), for everything but pairs."""
    some = [r for r in results if r["stratum"] != "pair"]
    rows = sorted({(r["truth"] or ["(nothing)"])[0] for r in some})
    said = sorted({r["answer"][0] for r in some if r["answer"]})
    columns = ["(silence)", *said]
    counts = {(row, column): 0 for row in rows for column in columns}
    for r in some:
        counts[(r["truth"] or ["(nothing)"])[0], (r["answer"] or ["(silence)"])[0]] += 1
    lines = [" ".join([" " * 36, *(f"{k:3d}" for k in range(len(columns)))])]
    for row in rows:
        cells = [f"{counts[row, c] or '.':>3}" for c in columns]
        lines.append(" ".join([f"{row:36s}", *cells]))
    return "\n".join([*lines, "", *(f"{k:3d} {name}" for k, name in enumerate(columns))])


def misses(results):
    """One line for each case whose answer is not the whole truth."""
    lines = []
    for r in results:
        if r["stratum"] == "outside":
            right = "unknown" in r["answer"] or r["verdict"] in ("partly_explained", "unexplained")
        else:
            right = sorted(r["answer"]) == sorted(r["truth"]) and r["status"] == 0
        if not right:
            truth = (
                ", ".join(f"{n} {j}" for n, j in zip(r["truth"], r["truth_joints"], strict=True)) or "nothing"
            )
            said = ", ".join(
                f"{n} {j} ({c:.2f})"
                for n, j, c in zip(r["answer"], r["answer_joints"], r["confidence"], strict=True)
            )
            kind = "/".join(r["strengths"]) or r["nasty"]
            said = said or (r["message"].strip().splitlines() or [r["verdict"]])[-1]
            lines.append(
                f"{r['case']} {r['stratum']} {kind} [{r['family']}, {r['nominal']}]: {truth}  ->  {said}"
            )
    return "\n".join(lines) or "none"


def score(cases, out):
    """Judge all cases; prints the report and writes it beside the answers."""
    results = [judge(case, out / case.name) for case in cases]
    table = figures(results)
    report = "\n\n".join([as_text(table), confusion(results), "Misses\n" + misses(results)])
    (out / "results.json").write_text(json.dumps({"figures": table, "cases": results}, indent=1))
    (out / "report.txt").write_text(report + "\n")
    print(report)
    return table


def by_place(cases, out):
    """The further figures of `experiments/scoring.py`, which imports this file."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    from scoring import report

    return report(cases, out)


def cases_in(folder):
    found = sorted(path.parent for path in Path(folder).glob("*/truth.json"))
    if not found:
        raise SystemExit(f"no cases in {folder}")
    return found


def main(argv=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=1)
    args = parser.parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    cases = cases_in(args.cases)
    run_tool(cases, args.out, args.jobs)
    score(cases, args.out)
    print("\n" + by_place(cases, args.out))


if __name__ == "__main__":
    main()
