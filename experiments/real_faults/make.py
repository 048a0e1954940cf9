"""Turn downloads of public sets with known faults into cases.

    python make.py --data DATA --out CASES [--only SET ...] [--yu MODEL.xml]

A case is a folder: recording.csv, model.xml (none for the project's own Panda), reference_*.csv from when nothing
was wrong (in some), and truth.json. What is not under DATA is said, with where to get it.
"""

import argparse
import sys
from pathlib import Path

import contact
import graabaek
import nist
import numpy as np
import voraus
from recording import SOURCES, BadFile, write_case

SETS = {"voraus": voraus, "nist_ur5": nist, "graabaek_ur5e": graabaek, "contact_panda": contact}


def make(data: Path, out: Path, only=None, yu: str | None = None) -> int:
    """Cases written."""
    count = 0
    for name, loader in SETS.items():
        if only and name not in only:
            continue
        if not loader.files(data):
            source = SOURCES[name]
            print(f"{name}: not under {data}; {source['url']}: {source['where']}")
            continue
        options = {"yu": yu} if loader is voraus else {}
        for case in loader.cases(data, **options):
            write_case(out / case.name, case)
            count += 1
            told, log = case.truth, case.recording
            print(
                f"{case.name}: {told['kind']}, {told['title']}; {len(log.time)} rows, {np.ptp(log.time):.1f} s"
            )
            for what, rows in log.source["dropped"].items():
                if rows:
                    print(f"  dropped: {rows} {what}")
    return count


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="*", choices=list(SETS))
    parser.add_argument("--yu", type=Path, help="an MJCF of the Yu-Cobot, of which none was found published")
    options = parser.parse_args()
    try:
        yu = options.yu.read_text() if options.yu else None
        count = make(options.data, options.out, options.only, yu)
    except (BadFile, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    if not count:
        print(f"nothing to make under {options.data}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
