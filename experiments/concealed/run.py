"""The whole trial in one command: python run.py --seed 1 --count 100 --jobs 2 --out DIR"""

import argparse
from pathlib import Path

from make import SHARES, make, shares
from score import cases_in, run_tool, score


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args(argv)
    print({name: shares(args.count)[name] for name in SHARES})
    make(args.seed, shares(args.count), args.out / "cases", args.jobs)
    cases = cases_in(args.out / "cases")
    run_tool(cases, args.out / "answers", args.jobs)
    score(cases, args.out / "answers")


if __name__ == "__main__":
    main()
