"""More figures of a blind trial: what is said at which joint, how sure, and what it does to a prediction.

    python scoring.py --cases DIR ... --out ANSWERS ...

With several folders of cases, and as many of their answers, the figures are those of all together.

Reads the truths and the answers that `concealed/score.py` leaves (which prints these figures too). A *place* is
an effect at a joint; effects of the whole arm have one place without a joint. Truths count for recall where they
make at least the torque noise and are not `optional`. A claim is right where name (or an equally right one,
`also` in the truth) and joint agree with a truth of any size, and left out where the truth calls it `allowed`.
Families: INTERFACE.md.
"""

import argparse
import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from concealed.score import EDGE, SAME, WHOLE, read_table

FAMILIES = {
    "friction": "viscous_friction coulomb_friction asymmetric_friction stribeck_friction load_dependent_friction "
    "friction_drift presliding_hysteresis power_law_friction",
    "drive": "torque_ripple backlash joint_elasticity armature",
    "load": "inertial_parameters payload payload_change gravity_direction joint_spring",
    "sensor": "torque_offset torque_gain torque_drift torque_crosstalk encoder_offset",
    "clock": "time_delay",
    "contact": "external_contact",
    "meaning": "torque_meaning",
    "unknown": "unknown",
}
FAMILY_OF = {name: family for family, names in FAMILIES.items() for name in names.split()}
EVERYWHERE = WHOLE | {"torque_meaning"}
SURE = 0.9
MISSED = 1.5  # times the noise: what an `explained` verdict may not leave out
BINS = (0.0, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0)
DRAWN = 500


@dataclass(frozen=True)
class Place:
    """An effect at a joint (1-based; 0 for the whole arm), in the truth or in an answer."""

    effect: str
    joint: int
    family: str
    also: tuple[str, ...] = ()
    ratio: float = np.inf  # RMS torque over noise


def plain(name: str) -> str:
    return "unknown" if name.startswith("outside:") else name


def truth_places(truth: dict) -> list[Place]:
    """Every effect at every joint that the truth lists."""
    noise = np.array(truth["noise_std"])
    places = []
    for entry in truth["effects"]:
        name, also = plain(entry["effect"]), tuple(entry.get("also", ()))
        counts = not entry.get("optional", False)
        ratio = counts * np.array(entry["rms_torque"]) / noise
        if name in EVERYWHERE:
            places.append(Place(name, 0, FAMILY_OF[name], also, float(np.max(ratio))))
        else:
            places += [Place(name, j, FAMILY_OF[name], also, float(ratio[j - 1])) for j in entry["joints"]]
    return places


def claims_of(finding: dict) -> list[Place]:
    name = finding["effect"]
    family = FAMILY_OF.get(name, "unknown")
    if name == "unknown":
        family = finding.get("family") or "unknown"
    joints = [0] if name in EVERYWHERE else finding["joints"] or [0]
    return [Place(name, j, family) for j in joints]


def same_joint(truth: Place, claim: Place) -> bool:
    """Joints agree, or one of the two is said of the whole arm."""
    return claim.joint == truth.joint or 0 in (claim.joint, truth.joint)


def names_it(truth: Place, claim: Place) -> bool:
    return claim.effect in (truth.effect, *truth.also) and same_joint(truth, claim)


def same_family(truth: Place, claim: Place) -> bool:
    families = {truth.family, *(FAMILY_OF[name] for name in truth.also)}
    return names_it(truth, claim) or (claim.family in families and same_joint(truth, claim))


def is_allowed(truth: dict, claim: Place) -> bool:
    """Does the truth call the claim neither right nor wrong? Entries are names or {effect, joints}."""
    for entry in truth.get("allowed", ()):
        entry = {"effect": entry, "joints": None} if isinstance(entry, str) else entry
        if claim.effect == entry["effect"] and (
            entry["joints"] is None or claim.joint in (0, *entry["joints"])
        ):
            return True
    return False


def is_right(places: list[Place], finding: dict) -> bool:
    """Right at half of its joints or more."""
    claims = claims_of(finding)
    right = [any(names_it(place, claim) for place in places) for claim in claims]
    return bool(right) and 2 * sum(right) >= len(right)


def count(places: list[Place], claims: list[Place], truth: dict, agree, by) -> tuple[int, int, int, int]:
    """(truths found, truths, claims right, claims), each `by` (name or family, joint) counted once."""
    wanted: dict = {}
    for place in places:
        if place.ratio >= 1:
            found = any(agree(place, claim) for claim in claims)
            wanted[by(place)] = wanted.get(by(place), False) or found
    made: dict = {}
    for claim in claims:
        right = any(agree(place, claim) for place in places)
        if right or not is_allowed(truth, claim):
            made[by(claim)] = made.get(by(claim), False) or right
    return sum(wanted.values()), len(wanted), sum(made.values()), len(made)


def inside_interval(truth: dict, findings: list[dict]) -> list[bool]:
    """For every number that truth and answer share: is the truth's within 1.96 standard deviations?"""
    found = []
    for entry in truth["effects"]:
        for told_name, called, truth_of in SAME.get(entry["effect"], []):
            for told in (p for p in entry["parameters"] if p["name"] == told_name):
                p = answer_for(told, called, entry["effect"], findings)
                if p is not None and p.get("std") is not None:
                    value, wanted = truth_of(p["value"]), told["value"]
                    if entry["effect"] == "time_delay":  # the sign is a convention
                        value, wanted = abs(value), abs(wanted)
                    std = abs(truth_of(p["value"] + p["std"]) - truth_of(p["value"]))
                    found.append(bool(abs(value - wanted) <= 1.96 * max(std, 1e-12)))
    return found


def answer_for(told: dict, called: str, effect: str, findings: list[dict]) -> dict | None:
    """The answer's parameter of that name, at that joint where the effect belongs to joints."""
    for finding in findings:
        for p in finding.get("parameters", ()):
            anywhere = effect in EVERYWHERE or told["joint"] is None
            if (
                finding["effect"] == effect
                and p["name"] == called
                and (anywhere or p["joint"] == told["joint"])
            ):
                return p
    return None


def held_out(truth: dict, case: Path, predicted: Path) -> tuple[bool, float | None]:
    """Does the prediction do harm, and what share of the gap does it close (None where there is none)?

    Harm: at some joint RMSE is 10 % above that of the user's model, and the error that came on top (in
    quadrature) is larger than the torque noise.
    """
    noise = np.array(truth["noise_std"])
    nominal, oracle = (np.array(truth["heldout"][key]) for key in ("rmse_nominal", "rmse_true_model"))
    t, tau = read_table(case / "heldout.csv")
    t_said, said = read_table(predicted)
    gap = np.sum((nominal / noise) ** 2) - np.sum((oracle / noise) ** 2)
    has_gap = gap > 0.1 * np.sum((oracle / noise) ** 2)
    if t_said.shape != t.shape or not np.all(np.isfinite(said)):
        return True, None
    rows = (t > t[0] + EDGE) & (t < t[-1] - EDGE)
    reached = np.sqrt(np.mean((tau - said)[rows] ** 2, axis=0))
    share = (
        float((np.sum((nominal / noise) ** 2) - np.sum((reached / noise) ** 2)) / gap) if has_gap else None
    )
    return does_harm(reached, nominal, noise), share


def does_harm(reached, nominal, noise) -> bool:
    return bool(np.any((reached > 1.1 * nominal) & (reached**2 - nominal**2 > noise**2)))


def judge(truth: dict, diagnosis: dict) -> dict:
    """What the figures need of one case, but for the held-out motion."""
    places = truth_places(truth)
    findings = diagnosis["findings"]
    claims = [claim for finding in findings for claim in claims_of(finding)]
    scored = [
        f for f in findings if is_right(places, f) or not all(is_allowed(truth, c) for c in claims_of(f))
    ]
    missed = [p for p in places if p.ratio >= MISSED and not any(same_family(p, c) for c in claims)]
    return {
        "kind": truth.get("kind", truth.get("stratum", "")),
        "effect, joint": count(places, claims, truth, names_it, lambda p: (p.effect, p.joint)),
        "family, joint": count(places, claims, truth, same_family, lambda p: (p.family, p.joint)),
        "findings": [(f["confidence"], is_right(places, f)) for f in scored],
        "verdict": diagnosis["verdict"],
        "missed": [(p.effect, p.joint) for p in missed],
        "covered": inside_interval(truth, findings),
        "null": all(entry.get("optional") for entry in truth["effects"]),
    }


# -------------------------------------------------------------------------------- the figures


def bins(sure: np.ndarray) -> np.ndarray:
    """Which of BINS each confidence is in."""
    return np.clip(np.searchsorted(BINS, sure, side="right") - 1, 0, len(BINS) - 2)


def reliability(findings: list[tuple[float, bool]]) -> list[tuple[float, float, int, float, float]]:
    """(from, to, findings, mean confidence, share that is right) of every bin that has some."""
    if not findings:
        return []
    sure, right = np.array([c for c, _ in findings]), np.array([r for _, r in findings], float)
    which = bins(sure)
    return [
        (
            BINS[b],
            BINS[b + 1],
            int(np.sum(which == b)),
            float(sure[which == b].mean()),
            float(right[which == b].mean()),
        )
        for b in range(len(BINS) - 1)
        if np.any(which == b)
    ]


def calibration_error(findings: list[tuple[float, bool]]) -> float | None:
    """Mean distance of confidence from the share that is right, over the bins by their size."""
    if not findings:
        return None
    return float(sum(n * abs(said - right) for _, _, n, said, right in reliability(findings)) / len(findings))


def calibration_error_by_chance(findings: list[tuple[float, bool]]) -> float | None:
    """What the calibration error is in the mean where confidence is right: shares of few findings scatter."""
    if not findings:
        return None
    sure = np.array([c for c, _ in findings])
    off = sure - (np.random.default_rng(0).random((DRAWN, len(sure))) < sure)
    return float(np.mean(np.abs(off @ np.eye(len(BINS))[bins(sure)]).sum(1)) / len(sure))


def share(part: float, whole: float) -> float | None:
    return part / whole if whole else None


def figures(results: list[dict]) -> dict[str, tuple[float | None, int]]:
    """Name -> (value, on how many it rests)."""
    table = {}
    for by in ("family, joint", "effect, joint"):
        found, wanted, right, made = np.sum([r[by] for r in results], axis=0).tolist()
        table[f"recall ({by})"] = (share(found, wanted), wanted)
        table[f"precision ({by})"] = (share(right, made), made)
    findings = [f for r in results for f in r["findings"]]
    false = sum(c >= SURE and not right for c, right in findings)
    table["false claims at 0.9 or more, a case"] = (share(false, len(results)), len(results))
    sure = [right for c, right in findings if c >= SURE]
    table["right of the claims at 0.9 or more"] = (share(sum(sure), len(sure)), len(sure))
    table["expected calibration error"] = (calibration_error(findings), len(findings))
    table["... if confidence were right"] = (calibration_error_by_chance(findings), len(findings))
    brier = float(np.mean([(c - r) ** 2 for c, r in findings])) if findings else None
    table["Brier score, all findings"] = (brier, len(findings))
    nulls = [bool(r["findings"]) for r in results if r["null"]]
    table["nulls with a finding that is not allowed"] = (share(sum(nulls), len(nulls)), len(nulls))
    harm = [r["harm"] for r in results if "harm" in r]
    table["harm on the held-out motion"] = (share(sum(harm), len(harm)), len(harm))
    closed = [r["closed"] for r in results if r.get("closed") is not None]
    table["held-out gap closed, median"] = (float(np.median(closed)) if closed else None, len(closed))
    explained = [bool(r["missed"]) for r in results if r["verdict"] == "explained"]
    table["explained, but 1.5x noise is missing"] = (share(sum(explained), len(explained)), len(explained))
    covered = [x for r in results for x in r["covered"]]
    table["truth within the 95 % interval"] = (share(sum(covered), len(covered)), len(covered))
    return table


def by_kind(results: list[dict]) -> list[tuple]:
    """(kind, cases, recall and precision by family and joint, false sure claims a case, harm, verdicts)."""
    rows = []
    for kind in sorted({r["kind"] for r in results}):
        some = [r for r in results if r["kind"] == kind]
        table = figures(some)
        values = [
            table[name][0]
            for name in (
                "recall (family, joint)",
                "precision (family, joint)",
                "false claims at 0.9 or more, a case",
                "harm on the held-out motion",
                "held-out gap closed, median",
            )
        ]
        rows.append((kind, len(some), *values, Counter(r["verdict"] for r in some)))
    return rows


def shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def as_text(results: list[dict]) -> str:
    lines = [f"{'figure':44s} {'value':>8s} {'n':>6s}"]
    lines += [f"{name:44s} {shown(value):>8s} {n:6d}" for name, (value, n) in figures(results).items()]
    lines += ["", f"{'confidence':14s} {'findings':>8s} {'said':>8s} {'right':>8s}"]
    for low, high, n, said, right in reliability([f for r in results for f in r["findings"]]):
        lines.append(f"{low:.2f} .. {high:.2f}   {n:8d} {said:8.3f} {right:8.3f}")
    head = ("kind", "cases", "recall", "prec.", "false/c", "harm", "closed", "verdicts")
    lines += ["", f"{head[0]:18s} " + " ".join(f"{x:>7s}" for x in head[1:7]) + f"  {head[7]}"]
    for kind, n, *values, verdicts in by_kind(results):
        said = ", ".join(f"{count} {name}" for name, count in sorted(verdicts.items()))
        lines.append(f"{kind:18s} {n:7d} " + " ".join(f"{shown(v):>7s}" for v in values) + f"  {said}")
    return "\n".join(lines)


def judge_case(case: Path, out: Path) -> dict:
    truth = json.loads((case / "truth.json").read_text())
    run = json.loads((out / "run.json").read_text())
    if run["status"] != 0:
        return {"case": case.name, **judge(truth, {"verdict": "failed", "findings": []})}
    result = judge(truth, json.loads((out / "diagnosis.json").read_text()))
    result["harm"], result["closed"] = held_out(truth, case, out / "heldout.csv")
    return {"case": case.name, **result}


def report(cases: list[Path], out: Path) -> str:
    """The figures of all cases as text; also left in `out` as places.txt and places.json."""
    results = [judge_case(case, out / case.name) for case in cases]
    text = as_text(results)
    (out / "places.json").write_text(json.dumps({"figures": figures(results), "cases": results}, indent=1))
    (out / "places.txt").write_text(text + "\n")
    return text


def answered(cases: Path, out: Path) -> list[Path]:
    """The cases of a folder that have an answer."""
    found = sorted(path.parent for path in cases.glob("*/truth.json"))
    found = [case for case in found if (out / case.name / "run.json").exists()]
    if not found:
        raise SystemExit(f"no answers to {cases} in {out}")
    return found


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=Path, nargs="+", required=True)
    parser.add_argument("--out", type=Path, nargs="+", required=True)
    args = parser.parse_args()
    if len(args.cases) != len(args.out):
        parser.error(f"{len(args.cases)} folders of cases and {len(args.out)} of answers")
    pairs = list(zip(args.cases, args.out, strict=True))
    if len(pairs) == 1:
        (cases, out), *_ = pairs
        print(report(answered(cases, out), out))
    else:
        print(
            as_text(
                [judge_case(case, out / case.name) for cases, out in pairs for case in answered(cases, out)]
            )
        )


if __name__ == "__main__":
    main()
