"""Is the trial itself sound? Recorded torque against the files' own inverse dynamics, over the torque noise.

    python check.py --cases DIR

Read back from the files: model.xml through MuJoCo's inverse dynamics, on q of train_0.csv behind the best of some
zero-phase filters. Median and largest ratio of RMS residual to noise over the joints, twice: `file` is the
user's model with its damping and frictionloss (at rest any torque up to the frictionloss agrees with it); `truth`
is what is left with the concealed torque of hidden.npz and the true state of the known friction. With nothing
concealed, `file` is near 1, more where known friction sticks (`sticks`: RMS of its difference from the sign law);
`truth` is always near 1, more only where the encoder is coarse or the bias walks (rows with spikes are left out).
`closure` is the largest difference between the sum of the causes' torques and the whole: rounding.
"""

import argparse
import json
from pathlib import Path

import mujoco
import numpy as np
from sensors import CUTS, smooth, usable


def load(path: Path):
    with open(path) as file:
        names = file.readline().strip().split(",")
        table = np.loadtxt(file, delimiter=",")
    pick = lambda name: table[:, [k for k, x in enumerate(names) if x.startswith(name + "_")]]
    return table[:, 0], pick("q"), pick("tau")


def inverse(model: mujoco.MjModel, q, qd, qdd) -> np.ndarray:
    """The file's inverse dynamics without dry friction."""
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data = mujoco.MjData(model)
    tau = np.empty_like(q)
    for k in range(len(q)):
        data.qpos, data.qvel, data.qacc = q[k], qd[k], qdd[k]
        mujoco.mj_inverse(model, data)
        tau[k] = data.qfrc_inverse
    return tau


def beyond_dry_friction(residual, qd, level) -> np.ndarray:
    """What is left of the residual with the file's dry friction: set-valued at rest, the sign law in motion."""
    return np.where(
        np.abs(qd) < 0.01, residual - np.clip(residual, -level, level), residual - level * np.tanh(qd / 0.01)
    )


def residuals(case: Path, noise: np.ndarray, spiky: bool):
    """RMS of the residual over noise with the user's model and with the truth, and the filter's cut."""
    model = mujoco.MjModel.from_xml_path(str(case / "model.xml"))
    t, q, tau = load(case / "train_0.csv")
    extra = np.load(case / "hidden.npz")["train_0"]
    keep = usable(t)
    tried = []
    for cut in CUTS:
        motion = smooth(t, q, cut)
        rest = tau - inverse(model, *motion)
        both = beyond_dry_friction(rest, motion[1], model.dof_frictionloss), rest - extra
        calm = keep[:, None] & (np.abs(both[1]) < 6 * noise if spiky else True)
        ratios = [np.sqrt(np.mean(x**2, axis=0, where=calm)) / noise for x in both]
        tried.append((np.sum(ratios[1] ** 2), ratios, cut))
    return min(tried, key=lambda x: x[0])[1:]


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=Path, required=True)
    args = parser.parse_args()
    print(
        f"{'case':9s}{'kind':40s}{'arm':12s}{'file':>12s}{'truth':>12s}{'sticks':>7s}{'cut':>5s}{'closure':>9s}"
    )
    worst = []
    for path in sorted(args.cases.glob("*/truth.json")):
        truth = json.loads(path.read_text())
        noise = np.array(truth["noise_std"])
        (before, after), cut = residuals(path.parent, noise, truth["sensors"]["spikes"] > 0)
        sticks = np.max(np.array(truth["unlisted_rms"]) / noise)
        kind = f"{truth['kind']} {truth['detail']}"
        shown = [f"{np.median(x):6.2f}{np.max(x):6.1f}" for x in (before, after)]
        line = f"{path.parent.name:9s}{kind:40s}{truth['arm']:12s}{shown[0]:>12s}{shown[1]:>12s}"
        print(f"{line}{sticks:7.2f}{cut:5.0f}{truth['closure']:9.0e}", flush=True)
        worst.append(np.max(after))
    worst = np.array(worst)
    print(
        f"largest ratio with the truth: median {np.median(worst):.2f}, below 1.2 in {np.mean(worst < 1.2):.0%}"
    )


if __name__ == "__main__":
    main()
