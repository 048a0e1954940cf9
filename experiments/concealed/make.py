"""Write a set of concealed cases: python make.py --seed 1 --count 100 --out DIR"""

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import effects as catalogue
import numpy as np
from cases import Case, Plan, Unstable

NASTY = ("", "narrow", "identified", "jitter", "friction", "clean")
SHARES = {"strong": 0.22, "medium": 0.22, "weak": 0.12, "null": 0.2, "pair": 0.14, "outside": 0.1}


def plans(seed, counts, kinds=None, nominal="", reference=False):
    """The plan of every case. Effects come in shuffled order and all before any twice.

    `kinds` names those that single effects are drawn from; `nominal` and `reference` are for every case.
    """
    rng = np.random.default_rng([seed, 0])
    some = [kind for kind in catalogue.CATALOGUE if kinds is None or kind.name in kinds]
    singles = {s: _cycle(rng, some) for s in ("strong", "medium", "weak")}
    outside = _cycle(rng, catalogue.OUTSIDE)
    drawn = []
    for strength, kinds in singles.items():
        drawn += [Plan("single", (next(kinds),), (strength,)) for _ in range(counts[strength])]
    for k in range(counts["null"]):
        drawn.append(Plan("null", (), (), NASTY[k % len(NASTY)]))
    for _ in range(counts["pair"]):
        drawn.append(Plan("pair", _pair(rng), tuple(str(rng.choice(["medium", "strong"])) for _ in range(2))))
    for k in range(counts["outside"]):
        drawn.append(Plan("outside", (next(outside),), (("strong", "medium")[k % 2],)))
    return [replace(plan, nominal=nominal, reference=reference) for plan in drawn]


def _cycle(rng, kinds):
    while True:
        yield from rng.permutation(np.array(kinds, dtype=object))


def _pair(rng):
    """Two kinds that are not two words for the same thing."""
    aliases = (
        {
            "viscous_friction",
            "coulomb_friction",
            "asymmetric_friction",
            "stribeck_friction",
            "presliding_hysteresis",
        },
        {"payload", "payload_change", "inertial_parameters", "external_contact"},
        {"backlash", "joint_elasticity", "encoder_offset"},
        {"torque_offset", "torque_drift"},
    )
    while True:
        a, b = rng.choice(np.array(catalogue.CATALOGUE, dtype=object), 2, replace=False)
        if not any(a.name in names and b.name in names for names in aliases):
            return (a, b)


def write_case(job):
    """Write one case. A draw of no use is drawn again, then with more slack, then at less strength."""
    seed, index, plan, folder = job
    reason = None
    for attempt in range(24):
        easier = {"strong": "medium", "medium": "weak", "weak": "weak"}
        strengths = plan.strengths if attempt < 12 else tuple(easier[s] for s in plan.strengths)
        try:
            case = Case((seed, index, attempt), replace(plan, strengths=strengths))
            return case.write(folder, slack=0.05 if attempt % 12 < 6 else 0.2)
        except Unstable as error:
            reason = str(error)
    raise RuntimeError(f"{folder}: {plan} failed: {reason}")


def shares(count):
    """How many cases of each kind make `count`."""
    counts = {name: round(share * count) for name, share in SHARES.items()}
    counts["strong"] += count - sum(counts.values())
    return counts


def make(seed, counts, out, jobs=1, **options):
    """Write all cases to folders of `out` that do not tell what is in them; returns the folders."""
    drawn = plans(seed, counts, **options)
    order = np.random.default_rng([seed, 1]).permutation(len(drawn))
    folders = [Path(out) / f"case_{k:03d}" for k in range(len(drawn))]
    work = [(seed, int(i), drawn[i], str(folder)) for i, folder in zip(order, folders, strict=True)]
    if jobs > 1:
        with ProcessPoolExecutor(jobs) as pool:
            list(pool.map(write_case, work))
    else:
        for job in work:
            write_case(job)
    return folders


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument(
        "--count", type=int, default=100, help="cases in all, in the proportions of the trial"
    )
    parser.add_argument("--counts", type=json.loads, help='instead: {"strong": 24, "null": 12, ...}')
    parser.add_argument("--kinds", nargs="+", help="names of the effects that single cases are drawn from")
    parser.add_argument(
        "--nominal", choices=["exact", "identified", "rough"], default="", help="of every model; else drawn"
    )
    parser.add_argument("--reference", action="store_true", help="add two recordings of each arm from before")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=1)
    args = parser.parse_args(argv)
    unknown = set(args.kinds or ()) - {kind.name for kind in catalogue.CATALOGUE}
    if unknown:
        parser.error(f"no such effects: {sorted(unknown)}")
    counts = {name: 0 for name in SHARES} | args.counts if args.counts else shares(args.count)
    options = {"kinds": args.kinds, "nominal": args.nominal, "reference": args.reference}
    folders = make(args.seed, counts, args.out, args.jobs, **options)
    print(f"{len(folders)} cases in {args.out}: {counts}")


if __name__ == "__main__":
    main()
