"""Does the corrected simulation follow the recorded motion better than the user's? A table, a row a case.

Answers are those of score.py (`run.py` or `score.py --out ANSWERS`); cases without one are diagnosed here. The
tool runs in processes of its own.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

import numpy as np

CALL = """
import json, sys
from jaxpanda import session
session.start()
from jaxpanda.rollout import compare_files
print(json.dumps(compare_files(*sys.argv[1:])))
"""


def compared(case, out):
    """Figures of one case: before and after, over all joints [rad]; None where there is no answer."""
    recordings = sorted(case.glob("train_*.csv"))
    if not (out / "corrected.json").exists():
        command = [sys.executable, "-m", "jaxpanda", "diagnose", "--model", case / "model.xml", "--out", out]
        subprocess.run([*command, "--recording", *recordings], check=True, stdout=subprocess.DEVNULL)
    diagnosis = json.loads((out / "diagnosis.json").read_text())
    bound = [f["recordings"][0] for f in diagnosis["findings"] if f["intervals"]]
    recording = case / (bound[0] if bound else recordings[-1].name)
    done = subprocess.run(
        [sys.executable, "-c", CALL, out, case / "model.xml", recording],
        check=True,
        capture_output=True,
        text=True,
    )
    figures = json.loads(done.stdout)
    rms = {
        when: np.nan if figures[f"rmse_rad_{when}"] is None else np.linalg.norm(figures[f"rmse_rad_{when}"])
        for when in ("before", "after")
    }
    return rms["before"], rms["after"], [(f["effect"], f["joints"]) for f in diagnosis["findings"]]


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=Path, required=True)
    parser.add_argument(
        "--out", type=Path, required=True, help="folder of the answers, as score.py leaves them"
    )
    parser.add_argument("--only", nargs="*", help="names of cases, such as case_007; all by default")
    arguments = parser.parse_args(argv)
    ratios = []
    print(f"{'case':9} {'before':>7} {'after':>7}  mrad, rms over the motion and norm over the joints")
    for case in sorted(arguments.cases.glob("case_*")):
        if arguments.only and case.name not in arguments.only:
            continue
        before, after, found = compared(case, arguments.out / case.name)
        truth = [(e["effect"], e["joints"]) for e in json.loads((case / "truth.json").read_text())["effects"]]
        say = lambda effects: ", ".join(f"{n} {','.join(map(str, j))}" for n, j in effects) or "nothing"
        print(
            f"{case.name:9} {1e3 * before:7.1f} {1e3 * after:7.1f}  {say(truth)}; found: {say(found)}",
            flush=True,
        )
        if found:
            ratios.append(after / before)
    if ratios:
        better = np.mean(np.array(ratios) < 1)
        print(
            f"after / before: median {np.median(ratios):.2f}; better in {better:.0%} of {len(ratios)} found"
        )


if __name__ == "__main__":
    main()
