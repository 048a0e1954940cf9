"""What the tool says of recordings whose fault is known.

    python score.py --cases CASES --out ANSWERS [--limit SECONDS] [--only PREFIX ...]

Runs `jaxpanda diagnose` on each case that has no answer in ANSWERS yet, one after the other; prints a table a set
and leaves it as report.txt, all figures as results.json. Needs the cases and the tool, and none of the downloads.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from real_arms.score import LIMIT, call
from scoring import FAMILY_OF

LEVELS = (0.5, 0.9)


# ------------------------------------------------------------------------------------ running the tool


def answer(case: Path, out: Path, limit: float) -> dict:
    """Runs the diagnosis; status and seconds are kept in run.json."""
    out.mkdir(parents=True, exist_ok=True)
    truth = json.loads((case / "truth.json").read_text())
    arguments = ["diagnose", "--recording", case / "recording.csv"]
    if (case / "model.xml").exists():
        arguments += ["--model", case / "model.xml"]
    if before := sorted(case.glob("reference_*.csv")):
        arguments += ["--reference", *before]
    start = time.perf_counter()
    status, printed = call([*arguments, *truth["arguments"], "--out", out], limit)
    (out / "log.txt").write_text(printed)
    run = {"status": status, "seconds": round(time.perf_counter() - start, 1)}
    (out / "run.json").write_text(json.dumps(run))
    return run


# -------------------------------------------------------------------------------------------- judging


def family(finding: dict) -> str:
    if finding["effect"] == "unknown":
        return finding.get("family") or "unknown"
    return FAMILY_OF.get(finding["effect"], "unknown")


def overlap(one, other) -> bool:
    """Does an interval of `one` meet one of `other`? None: throughout."""
    if one is None or other is None:
        return True
    return any(a[0] <= b[1] and b[0] <= a[1] for a in one for b in other)


def judged(truth: dict, diagnosis: dict) -> list[dict]:
    """Findings of the side that the case is about, and those that name none, as of an arm told to be at rest."""
    return [
        f for f in diagnosis["findings"] if truth["side"] is None or f.get("side") in (None, truth["side"])
    ]


def sure(findings, agrees) -> float:
    """The highest confidence among the findings that agree; 0 where none does."""
    return max((f["confidence"] for f in findings if agrees(f)), default=0.0)


def mass(truth: dict, findings) -> tuple[float, float] | None:
    """(value, deviation) that was found where the truth has a mass."""
    if truth["size"] is None:
        return None
    for finding in findings:
        if finding["effect"] in truth["effects"]:
            for p in finding["parameters"]:
                if p["name"] == truth["size"]["name"]:
                    return p["value"], p.get("std") or float("nan")
    return None


def rms(values) -> float | None:
    """Over the joints; None where the answer has none."""
    if not values or any(v is None for v in values):
        return None
    return float(np.sqrt(np.mean(np.square(values))))


def judge(case: Path, out: Path) -> dict:
    """What the tables need of one case."""
    truth = json.loads((case / "truth.json").read_text())
    run = json.loads((out / "run.json").read_text())
    result = {"case": case.name, "set": truth["sources"]["recording"].get("set", case.name), **run}
    result |= {key: truth[key] for key in ("kind", "title", "joints", "size")}
    if run["status"]:
        lines = (out / "log.txt").read_text().strip().splitlines()
        return result | {"message": lines[-1] if lines else "no message"}
    diagnosis = json.loads((out / "diagnosis.json").read_text())
    findings = judged(truth, diagnosis)
    right = lambda f: family(f) in truth["families"]
    there = lambda f: truth["joints"] is None or bool(set(truth["joints"]) & set(f["joints"]))
    named = lambda f: f["effect"] in truth["effects"]
    in_time = lambda f: overlap(truth["intervals"], f.get("intervals"))
    beside = truth.get("beside", [])
    wrong = [f for f in findings if not right(f) and family(f) not in beside]
    fit = diagnosis.get("fit_motor" if truth["side"] == "drive" else "fit") or {}
    return result | {
        "verdict": diagnosis["verdict"],
        "family": sure(findings, lambda f: right(f) and in_time(f)),
        "family_joint": sure(findings, lambda f: right(f) and there(f) and in_time(f)),
        "name": sure(findings, lambda f: right(f) and named(f) and in_time(f)) if truth["effects"] else None,
        "other": sure(wrong, lambda f: True),
        "mass": mass(truth, findings),
        "before": rms(fit.get("held_out_rmse_before")),
        "after": rms(fit.get("held_out_rmse_after")),
        "said": [(f["effect"], f["joints"], round(f["confidence"], 2), f.get("side")) for f in findings],
        "other_side": len(diagnosis["findings"]) - len(findings),
    }


def figures(results: list[dict]) -> dict[str, tuple[int, int]]:
    """Name -> (how many, of how many)."""
    answered = [r for r in results if not r["status"]]
    faults = [r for r in answered if r["kind"] == "fault"]
    controls = [r for r in answered if r["kind"] == "control"]
    located = [r for r in faults if r["joints"]]
    named = [r for r in faults if r["name"] is not None]
    table = {"answered": (len(answered), len(results))}
    for level in LEVELS:
        at = lambda rows, key, level=level: (sum(r[key] >= level for r in rows), len(rows))
        table[f"faults with the right family at {level}"] = at(faults, "family")
        table[f"faults with the right family and joint at {level}"] = at(located, "family_joint")
        table[f"faults with the right name at {level}"] = at(named, "name")
        table[f"faults with another claim at {level}"] = at(faults, "other")
        table[f"controls with a claim at {level}"] = at(controls, "other")
    return table


def line(r: dict) -> str:
    if r["status"]:
        return f"{r['case']} | {r['title']} | no answer, status {r['status']}: {r['message'][:120]}"
    said = "; ".join(f"{e} {','.join(map(str, j))} ({c:.2f})" for e, j, c, _ in r["said"]) or "nothing"
    error = "-" if r["before"] is None else f"{r['before']:.3g} -> {r['after']:.3g}"
    found = "" if r["kind"] == "control" else f" family {r['family']:.2f},"
    if r["size"]:
        told = "not found" if r["mass"] is None else f"{r['mass'][0]:.3g} ± {r['mass'][1]:.2g}"
        found += f" {r['size']['name']} {told} of {r['size']['value']:.3g} {r['size']['unit']},"
    if r["other_side"]:
        said += f" (and {r['other_side']} on the side that is not judged)"
    return f"{r['case']} | {r['title']} |{found} {r['verdict']}: {said} | {error} N·m | {r['seconds']:.0f} s"


def report(results: list[dict]) -> str:
    """A table a set."""
    parts = []
    for name in sorted({r["set"] for r in results}):
        some = [r for r in results if r["set"] == name]
        rows = [f"{what:46s} {k:3d} of {n}" for what, (k, n) in figures(some).items() if n]
        head = "case | what is true | what is said | held-out error, rms over joints, before -> after | time"
        parts.append("\n".join([name, *rows, "", head, *map(line, some)]))
    return "\n\n".join(parts)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--limit", type=float, default=LIMIT, help="seconds a case")
    parser.add_argument("--only", nargs="*", default=None, help="cases whose names begin so")
    options = parser.parse_args()
    cases = sorted(path.parent for path in options.cases.glob("*/truth.json"))
    cases = [c for c in cases if options.only is None or c.name.startswith(tuple(options.only))]
    if not cases:
        print(f"no cases in {options.cases}", file=sys.stderr)
        return 2
    options.out.mkdir(parents=True, exist_ok=True)
    for case in cases:
        if not (options.out / case.name / "run.json").exists():
            run = answer(case, options.out / case.name, options.limit)
            print(f"{case.name}: status {run['status']}, {run['seconds']:.0f} s", flush=True)
    results = [judge(case, options.out / case.name) for case in cases]
    text = report(results)
    (options.out / "report.txt").write_text(text + "\n")
    (options.out / "results.json").write_text(json.dumps(results, indent=1))
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
