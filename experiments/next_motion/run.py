"""Does the motion that a diagnosis recommends decide what its recordings left open?

    python run.py --seed S --count N --out OUT [--answers ANSWERS] [--rounds R] [--jobs J]

Arms of ../in_service are diagnosed. Where next_motion.csv is written, the same arm, with what ails it and its
sensors, is told to make that motion, and all recordings are diagnosed together; so up to R times. Beside it, one
more recording of a random motion that is as long. A *statement* is an effect at a joint that the first diagnosis
left open; its probability is what a diagnosis says of it, its truth stands in truth.json.
"""

import argparse
import json
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent / "in_service")]

from concealed.score import call, diagnose  # noqa: E402
from make import case_list, make, prepare  # noqa: E402
from motions import motion  # noqa: E402
from plant import simulate  # noqa: E402
from scoring import FAMILY_OF, Place, is_allowed, names_it, truth_places  # noqa: E402
from sensors import measured, motion_columns, samples, write  # noqa: E402

from kinds import SHARES  # noqa: E402  # isort: skip

GRID = 1e-3
"""Step of a command [s]."""
PAUSE = 60.0
"""Between two recordings [s]."""
RANDOM, DESIGNED = "random", "designed"


def job_of(name: str, seed: int) -> tuple[int, int, str, int]:
    """Seed, place, kind and turn of a case by its name."""
    kind, index = name.rsplit("_", 1)
    count = int(index) + 1
    return seed, count - 1, kind, case_list(list(SHARES), count)[-1][1]


def perform(case: Path, seed: int, command: np.ndarray | float, turn: int, out: Path) -> None:
    """One more recording of a case's arm: of positions on the grid, or of a random motion of so many seconds."""
    plan, log, _, moves, small, _, _, _ = prepare(*job_of(case.name, seed))
    rng = np.random.default_rng([seed, job_of(case.name, seed)[1], turn, 77])
    if isinstance(command, float):
        move = motion("fourier", plan.arm, command, GRID, np.ones(plan.arm.n), rng)
    else:
        spline = CubicSpline(np.arange(len(command)) * GRID, command)
        move = tuple(spline(spline.x, k) for k in range(3))
    dt = 5e-4 if plan.stiffness or plan.play else GRID
    if dt != GRID:
        t, fine = np.arange(len(move[0])) * GRID, np.arange(2 * len(move[0]) - 1) * dt
        move = tuple(np.stack([np.interp(fine, t, column) for column in x.T], 1) for x in move)
    clock = sum(len(x[0]) * GRID + PAUSE for x in moves[:-1]) + (turn - 1) * (len(move[0]) * dt + PAUSE)
    run = simulate(plan, move, dt, len(moves) - 2 + turn, clock)
    if not np.isfinite(run.tau).all():
        raise ValueError(f"{case.name}: the arm does not follow its command")
    at = samples(log, run, rng)
    column, *_ = measured(plan, log, run, at, len(moves) - 2 + turn, small, rng)
    q, dq = motion_columns(plan, log, run, at, rng)
    write(out, run.t[at], q, dq, column)


def recommended(answer: Path) -> np.ndarray:
    """next_motion.csv on the grid of commands."""
    names = (answer / "next_motion.csv").open().readline().strip().split(",")
    table = np.loadtxt(answer / "next_motion.csv", delimiter=",", skiprows=1)
    q = table[:, [k for k, name in enumerate(names) if name.startswith("q_")]]
    t = np.arange(0.0, table[-1, 0] + 1e-9, GRID)
    return CubicSpline(table[:, 0], q)(t)


def again(case: Path, recordings: list[Path], out: Path) -> dict:
    """The diagnosis of the case's recordings and more; {} where the tool gave none."""
    if not (out / "diagnosis.json").exists():
        files = [*sorted(case.glob("train_*.csv")), *recordings]
        status, said = call(["diagnose", "--model", case / "model.xml", "--recording", *files, "--out", out])
        if status != 0:
            print(f"{case.name}: {said[-300:]}", flush=True)
            return {}
    return json.loads((out / "diagnosis.json").read_text())


def statements(diagnosis: dict, truth: dict) -> list[tuple[Place, bool]]:
    """Effects at joints that a diagnosis left open, and whether they are there; without what is neither."""
    places, out = truth_places(truth), {}
    for pair in diagnosis["next_experiment"]["pairs"]:
        for effect in (pair["finding"], pair["rival"]):
            if effect not in FAMILY_OF:
                continue  # nothing in its place
            claim = Place(effect, pair["joint"] or 0, FAMILY_OF[effect])
            there = any(names_it(place, claim) for place in places)
            if there or not is_allowed(truth, claim):
                out[effect, claim.joint] = claim, there
    return list(out.values())


def probability(diagnosis: dict, claim: Place) -> float:
    """What a diagnosis says of an effect at a joint."""
    said = [0.0]
    for finding in diagnosis["findings"]:
        if claim.joint and claim.joint not in finding["joints"]:
            continue
        if finding["effect"] == claim.effect:
            said.append(finding["confidence"])
        said += [a["confidence"] for a in finding["alternatives"] if a["effect"] == claim.effect]
    return max(said)


def decide(job: tuple[str, str, str, int, int]) -> dict | None:
    """One case: what is said of each open statement before, after each designed motion and after a random one."""
    case, answer, out, seed, rounds = Path(job[0]), Path(job[1]), Path(job[2]), job[3], job[4]
    if not (answer / "run.json").exists():
        diagnose((str(case), str(answer)))
    if not (answer / "next_motion.csv").exists():
        return None
    truth = json.loads((case / "truth.json").read_text())
    first = json.loads((answer / "diagnosis.json").read_text())
    asked = statements(first, truth)
    if not asked:
        return None
    out.mkdir(parents=True, exist_ok=True)
    said = {"before": first}
    command = recommended(answer)
    recording = out / f"{RANDOM}.csv"
    if not recording.exists():
        perform(case, seed, len(command) * GRID, 1, recording)
    said[RANDOM] = again(case, [recording], out / RANDOM)
    more, at = [], answer
    for turn in range(1, rounds + 1):
        if (at / "next_motion.csv").exists():
            more.append(out / f"{DESIGNED}_{turn}.csv")
            if not more[-1].exists():
                perform(case, seed, recommended(at), turn, more[-1])
            at = out / f"{DESIGNED}_{turn}"
            said[at.name] = again(case, more, at)
        else:
            said[f"{DESIGNED}_{turn}"] = said[at.name if more else "before"]
    return {
        "case": case.name,
        "statements": [[claim.effect, claim.joint, there] for claim, there in asked],
        "said": {
            when: [probability(diagnosis, claim) for claim, _ in asked] if diagnosis else None
            for when, diagnosis in said.items()
        },
    }


def report(results: list[dict]) -> str:
    """Shares of cases that are decided rightly, and Brier scores of the statements."""
    lines = [f"{len(results)} cases with a recommended motion; a case is right where all its statements are"]
    for when in dict.fromkeys(k for r in results for k in r["said"]):
        right, brier, sure = [], [], []
        for result in results:
            said = result["said"].get(when)
            truth = np.array([there for *_, there in result["statements"]], float)
            p = np.zeros_like(truth) + 0.5 if said is None else np.array(said)
            right.append(bool(np.all((p >= 0.5) == (truth > 0))))
            brier += list((p - truth) ** 2)
            sure += list(np.where(truth > 0, p, 1 - p))
        lines.append(
            f"{when:12s} right {np.mean(right):.2f}   Brier {np.mean(brier):.3f}   probability of what is true"
            f" {np.mean(sure):.2f}   ({len(brier)} statements)"
        )
    for result in results:
        lines.append(f"\n{result['case']}")
        for i, (effect, joint, there) in enumerate(result["statements"]):
            told = ", ".join(f"{when} {p[i]:.2f}" if p else f"{when} -" for when, p in result["said"].items())
            lines.append(f"  {effect} {joint or 'arm'} ({'true' if there else 'false'}): {told}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, required=True, help="of ../in_service")
    parser.add_argument("--count", type=int, required=True, help="cases that are made")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--answers", type=Path, help="what ../concealed/score.py left of these cases")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    folder, answers = options.out / "cases", options.answers or options.out / "answers"
    jobs = []
    for index, (kind, turn) in enumerate(case_list(list(SHARES), options.count)):
        case = folder / f"{kind}_{index:03d}"
        if not (case / "truth.json").exists():
            make((options.seed, index, kind, turn, str(folder)))
        jobs.append(
            (str(case), str(answers / case.name), str(options.out / case.name), options.seed, options.rounds)
        )
    results: list[dict] = []
    lot = 12 * options.jobs  # a process keeps every program that it compiled
    for first in range(0, len(jobs), lot):
        with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
            for done in pool.map(decide, jobs[first : first + lot]):
                if done is not None:
                    results.append(done)
                    print(report([done]).split("\n\n", 1)[1], flush=True)
    (options.out / "results.json").write_text(json.dumps(results, indent=1))
    text = report(results)
    (options.out / "report.txt").write_text(text + "\n")
    print("\n" + text)


if __name__ == "__main__":
    main()
