"""What two torques of one joint say without any model: motor minus sensor, by least squares.

    python gap.py --cases CASES --joint J

Columns: dry friction and offset [N m], viscous friction [N m s/rad], rotor [kg m²], rms left [N m].
"""

import argparse
from pathlib import Path

import numpy as np

SLOW = 0.02
"""Speed over which dry friction sets in [rad/s]."""


def losses(path: Path, joint: int) -> np.ndarray:
    """(5,) dry, offset, viscous, rotor and rms left of a recording with both torques."""
    table = np.genfromtxt(path, delimiter=",", names=True)
    t, qd = table["time"], table[f"dq_{joint}"]
    gap = table[f"tau_motor_{joint}"] - table[f"tau_{joint}"]
    A = np.stack([np.tanh(qd / SLOW), np.ones_like(t), qd, np.gradient(qd, t)], 1)
    x = np.linalg.lstsq(A, gap)[0]
    return np.append(x, np.sqrt(np.mean((gap - A @ x) ** 2)))


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=Path, required=True)
    parser.add_argument("--joint", type=int, required=True)
    options = parser.parse_args()
    print(f"{'':48s} {'dry':>7s} {'offset':>7s} {'viscous':>7s} {'rotor':>7s} {'left':>7s}")
    for path in sorted(options.cases.glob("*/*.csv")):
        with path.open() as file:
            both = f"tau_motor_{options.joint}," in file.readline().replace("\n", ",")
        if both:
            row = " ".join(f"{v:7.2f}" for v in losses(path, options.joint))
            print(f"{path.parent.name + '/' + path.name:48s} {row}")


if __name__ == "__main__":
    main()
