"""Recordings whose torque column is something else, and such where it is not: what does `jaxpanda` say of them?

See README.md. Nothing of the analysis makes the recordings: arms and motions are those of ../outside, torque is
MuJoCo's. `jaxpanda.meaning` is called at the end, once a recording.
"""

import argparse
import collections
import json
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "outside"))

import arms
import motion

jax.config.update("jax_enable_x64", True)

from jaxpanda import Recording, load  # noqa: E402
from jaxpanda.arms.source import from_mjcf  # noqa: E402
from jaxpanda.convention import Convention  # noqa: E402
from jaxpanda.meaning import meaning  # noqa: E402

G = 9.81
WRONG = {
    "gravity_removed": "gravity_removed",
    "sign of all": "sign",
    "sign of one": "sign",
    "sign of three": "sign",
    "N mm": "unit",
    "one in N mm": "unit",
    "current": "current",
    "two torques swapped": "joint_order",
    "two joints swapped": "joint_order",
    "joints reversed": "joint_order",
    "motor side": "motor_side",
    "wall": "mounting",
    "ceiling": "mounting",
    "tilt": "mounting",
    "moon": "mounting",
}
PLAIN = ("exact", "friction", "links", "payload", "gain", "level", "offset", "delay")


def torque(arm, rng, q, qd, qdd):
    """Of MuJoCo, with dry friction and noise that the user's model lacks [N m]."""
    tau = arms.inverse(arm, q, qd, qdd)
    return tau + arm.noise * rng.standard_normal(tau.shape)


def made(case: str, seed: int, seconds: float, rate: float, arm: str | None = None):
    """A case: the user's file as text, and the columns of the recording; of any arm, unless one is named."""
    rng = np.random.default_rng([seed, *case.encode()])
    user = arms.draw_arm(rng, arm)
    n = user.n
    family = str(rng.choice(["fourier", "pick", "reversals", "mixed", "slow"]))
    step = round(1 / rate / motion.DT)
    q, qd, qdd = (x[::step] for x in motion.draw_motion(user, rng, seconds, family))
    t = np.arange(len(q)) * step * motion.DT
    truth = user.with_joint(
        frictionloss=user.friction * rng.uniform(0.3, 1.2, n),
        damping=user.friction * rng.uniform(0.2, 1.0, n),
    )
    truth = arms.perturb_links(truth, rng, mass=0.05, com=0.004, inertia=0.1)
    order, tau_order = np.arange(n), np.arange(n)
    factors, gravity = np.ones(n), user.gravity
    j, k = rng.choice(n, 2, replace=False)
    if case == "gravity_removed":
        gravity = np.zeros(3)
    elif case == "sign of all":
        factors = -factors
    elif case == "sign of one":
        factors[rng.integers(1, n)] = -1
    elif case == "sign of three":
        factors[rng.choice(n, 3, replace=False)] = -1
    elif case == "N mm":
        factors = factors * 1000
    elif case == "one in N mm":
        factors[1] = 1000
    elif case == "current":
        factors = 1 / rng.uniform(5, 18, n)
    elif case == "motor side":
        factors = 1 / rng.choice([50.0, 100.0, 101.0, 121.0, 160.0], n)
    elif case == "two torques swapped":
        tau_order[[j, k]] = tau_order[[k, j]]
    elif case == "two joints swapped":
        order[[j, k]] = order[[k, j]]
    elif case == "joints reversed":
        order = order[::-1].copy()
    elif case == "wall":
        a = rng.uniform(0, 2 * np.pi)
        gravity = G * np.array([np.cos(a), np.sin(a), 0])
    elif case == "ceiling":
        gravity = np.array([0, 0, G])
    elif case == "tilt":
        a, b = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(25, 60))
        gravity = G * np.array([np.sin(b) * np.cos(a), np.sin(b) * np.sin(a), -np.cos(b)])
    elif case == "moon":
        gravity = np.array([0, 0, -1.62])
    elif case == "exact":
        truth = user
    elif case == "links":
        truth = arms.perturb_links(truth, rng, mass=0.2, com=0.015, inertia=0.3)
    elif case == "payload":
        truth = replace(truth, tool=arms.draw_body(rng, user, 2.0, 3.0))
    elif case == "gain":
        factors[rng.integers(n)] = rng.uniform(0.75, 1.3)
    elif case == "level":
        b = np.radians(5.0)
        gravity = G * np.array([np.sin(b), 0, -np.cos(b)])
    tau = factors * torque(replace(truth, gravity=gravity), rng, q, qd, qdd)
    if case == "offset":
        tau = tau + 2 * user.friction * rng.uniform(-1, 1, n)
    elif case == "delay":
        tau = np.roll(tau, round(0.03 * rate), axis=0)
    q = q + 2e-5 * rng.standard_normal(q.shape)
    columns = q[:, order], qd[:, order], tau[:, order][:, tau_order]
    return arms.mjcf(user), Recording(f"{case} {seed}", t, *columns)


def read(text: str, recording: Recording, options: str = ""):
    """What is said of a recording under the file, read by the options; and in how many seconds of one core."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.xml"
        path.write_text(text)
        said = parsed(options)
        arm, _ = from_mjcf(path, said.mounting)
        (recording,) = said.applied([recording], path)
    began = time.process_time()
    found = meaning(recording, arm)
    return found, time.process_time() - began


def parsed(options: str) -> Convention:
    """Options as the command line takes them."""
    given: dict[str, list[str]] = collections.defaultdict(list)
    for word in options.split():
        if word.startswith("--"):
            name = word[2:].replace("-", "_")
        else:
            given[name].append(word)
    return Convention(**{name: tuple(words) for name, words in given.items()})


def trial(seed: int, rounds: int, seconds: float, rate: float) -> list[dict]:
    """Every case, `rounds` times."""
    rows = []
    for case in (*WRONG, *PLAIN):
        for k in range(rounds):
            text, recording = made(case, 1000 * seed + k, seconds, rate)
            found, took = read(text, recording)
            again = None if found is None else read(text, recording, found.options)[0]
            rows.append(
                {
                    "case": case,
                    "recording": recording.name,
                    "meant": WRONG.get(case, ""),
                    "said": "" if found is None else found.kind,
                    "options": "" if found is None else found.options,
                    "confidence": None if found is None else found.confidence,
                    "again": "" if again is None else again.kind,
                    "seconds": took,
                }
            )
            print(json.dumps(rows[-1]), flush=True)
    return rows


def others(folders: list[Path]) -> list[dict]:
    """Recordings of the other trials, in none of which the column is anything but torque."""
    rows = []
    for folder in folders:
        for case in sorted(p.parent for p in folder.glob("case_*/model.xml")):
            arm, _ = from_mjcf(case / "model.xml")
            for path in sorted(case.glob("train_*.csv")):
                recording = load(path)
                began = time.process_time()
                found = meaning(recording, arm)
                rows.append(
                    {
                        "case": folder.name,
                        "recording": f"{case.name}/{path.name}",
                        "meant": "",
                        "said": "" if found is None else found.kind,
                        "options": "" if found is None else found.options,
                        "again": "",
                        "seconds": time.process_time() - began,
                    }
                )
                print(json.dumps(rows[-1]), flush=True)
    return rows


def table(rows: list[dict]) -> str:
    """A row a case."""
    lines = ["| case | recordings | right | silent | otherwise | well read then | CPU s, median / most |"]
    lines += ["|---|---|---|---|---|---|---|"]
    for case in dict.fromkeys(row["case"] for row in rows):
        those = [row for row in rows if row["case"] == case]
        right = [r for r in those if r["said"] == r["meant"]]
        silent = sum(not r["said"] for r in those)
        otherwise = [r["said"] for r in those if r["said"] not in ("", r["meant"])]
        mended = f"{sum(not r['again'] for r in right)}" if those[0]["meant"] else "-"
        took = [r["seconds"] for r in those]
        named = ", ".join(otherwise) or "-"
        figures = f"{len(those)} | {len(right)} | {silent} | {named} | {mended}"
        lines.append(f"| {case} | {figures} | {np.median(took):.2f} / {max(took):.2f} |")
    wrong = [r for r in rows if r["meant"]]
    plain = [r for r in rows if not r["meant"]]
    for name, those in (("something else", wrong), ("joint torque", plain)):
        if those:
            right = sum(r["said"] == r["meant"] for r in those)
            took = [r["seconds"] for r in those]
            lines.append(
                f"\n{name}: {right} of {len(those)} right; {np.median(took):.2f} CPU s a recording, at most"
                f" {max(took):.2f} s"
            )
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=4, help="recordings of each case")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--rate", type=float, default=1000.0)
    parser.add_argument(
        "--plain", type=Path, nargs="*", default=[], help="folders of cases of the other trials"
    )
    options = parser.parse_args()
    rows = trial(options.seed, options.rounds, options.seconds, options.rate) if options.rounds else []
    print(table(rows + others(options.plain)))
