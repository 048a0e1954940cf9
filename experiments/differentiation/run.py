"""What differentiation of q leaves in torque: a low-pass that follows the motion beside constant ones.

    python run.py CASES [--step STEP]

CASES is a folder that ../outside/make.py or ../in_service/make.py left: each case has its held-out motion as it
was written down and as it was. The torque of the user's links along both is compared. `--step` [rad] writes the
true positions down once more, as an encoder of such steps does, without noise.
"""

import argparse
import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
from scipy.interpolate import CubicSpline

from jaxpanda import Arm, load
from jaxpanda.effects import Motion
from jaxpanda.recordings import Recording
from jaxpanda.smoothing import Smoothed, continued_derivatives
from jaxpanda.traces import trajectory

EDGE = 0.3
"""Left out at both ends [s], as in the trials."""
CUTOFFS = (3.0, 5.0, 8.0, 12.0, 20.0)
"""Constant low-passes [Hz]."""


def torque(arm: Arm, time: np.ndarray, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """Of the links, without friction [N m]."""
    return Motion(arm, time, q, qd, qdd, np.zeros_like(q)).load


def left(arm: Arm, motion: Recording, true: np.ndarray) -> dict[str, np.ndarray]:
    """Mean square error of each joint's torque [N² m²], by the way of differentiating."""
    inside = (motion.time > motion.time[0] + EDGE) & (motion.time < motion.time[-1] - EDGE)
    expected = torque(arm, motion.time, *true)
    whole = trajectory(motion)
    rate, ways = whole.signals.rate, {"follows the motion": whole}
    for cutoff in CUTOFFS:
        if cutoff <= 0.25 * rate:
            # what the spline through the rows is, before any low-pass
            q = CubicSpline(motion.time, motion.q)(np.clip(whole.signals.time, *motion.time[[0, -1]]))
            same = Smoothed(*continued_derivatives(q, cutoff, rate), np.full(q.shape, cutoff))
            ways[f"{cutoff:g} Hz"] = dataclasses.replace(whole, smoothed=same)
    out = {}
    for name, one in ways.items():
        moved = one.trace(arm).motion
        rows = np.stack([np.interp(motion.time, moved.time, x) for x in moved.load.T], 1)
        out[name] = np.mean((rows - expected)[inside] ** 2, 0)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("cases", type=Path)
    parser.add_argument("--step", type=float, default=0.0)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    found: dict[str, list[np.ndarray]] = {}
    for case in sorted(options.cases.iterdir()):
        true = np.load(case / "hidden.npz")["heldout_motion"]
        noise = np.array(json.loads((case / "truth.json").read_text())["noise_std"])
        motion = load(case / "heldout_motion.csv")
        if options.step:
            motion = dataclasses.replace(motion, q=np.round(true[0] / options.step) * options.step)
        for name, squares in left(Arm.from_mjcf(case / "model.xml"), motion, true).items():
            found.setdefault(name, []).append(squares / noise**2)
    print("error of torque over the noise, mean square of joints\n")
    print(f"{'low-pass':20s}{'mean':>10s}{'median':>10s}{'90 %':>10s}{'above 1':>10s}")
    for name, parts in found.items():
        x = np.concatenate(parts)
        print(
            f"{name:20s}{x.mean():10.3f}{np.median(x):10.4f}{np.quantile(x, 0.9):10.3f}{np.mean(x > 1):10.3f}"
        )


if __name__ == "__main__":
    main()
