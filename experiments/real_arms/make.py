"""Make the cases of the blind trial on real recordings.

    python make.py --data DATA --out CASES --seed S [--only ARM ...]

Each case is a folder: model.xml (the simulation as its user has it), train_*.csv, reference_*.csv in some,
heldout_motion.csv and heldout.csv, and truth.json. How truth is defined: README.md, "The blind trial".
"""

import os

# small matrices: threads only get in each other's way
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
from pathlib import Path

import chain as c
import mujoco
import numpy as np
from cases import ARMS
from conceal import Secret, Split, errors, left
from known import known_structure
from reference import Log, inner, lowpass, motion

LARGE_ENOUGH = 0.15
"""Share of the error (squares over noise) that what is concealed must explain on train."""


def oracle(secret: Secret, noise):
    """(said on the held-out log, RMS up to BAND): the best of the true model and of its form fitted on train."""
    weight = 1 / noise
    sayers = [secret.truth_said]
    if secret.forms is not None:
        rows = [secret.forms(log) for log in secret.train]
        A = np.concatenate([lowpass(r, x.rate)[inner(x)] for r, x in zip(rows, secret.train, strict=True)])
        b = np.concatenate([errors(x, c.torque(secret.user, *motion(x))) for x in secret.train])
        A, b = (A * weight[:, None]).reshape(-1, A.shape[2]), (b * weight).ravel()
        scale = np.sqrt(np.mean(A**2, 0)) + 1e-9
        k = len(scale)
        for ridge in (1e-3, 1e-1):
            x = (
                np.linalg.lstsq(
                    np.concatenate([A / scale, np.sqrt(ridge * len(A) / k) * 0.03 * np.eye(k)]),
                    np.concatenate([b, np.zeros(k)]),
                    rcond=None,
                )[0]
                / scale
            )
            sayers.append(lambda log, x=x: c.torque(secret.user, *motion(log)) + secret.forms(log) @ x)
    if secret.fitted is not None:
        factors = np.linspace(0.6, 1.4, 17)
        cost = [np.sum((left(None, secret.train, predicted=secret.fitted(k)) * weight) ** 2) for k in factors]
        sayers.append(secret.fitted(factors[int(np.argmin(cost))]))
    said = [say(secret.held) for say in sayers]
    band = [np.sqrt(np.mean(errors(secret.held, x) ** 2, 0)) for x in said]
    best = int(np.argmin([np.sum((x * weight) ** 2) for x in band]))
    return said[best], band[best]


def write_csv(path: Path, log: Log, torque=True):
    n = log.q.shape[1]
    names = [f"{what}_{j + 1}" for what in ("q", "dq", "tau")[: 2 + torque] for j in range(n)]
    columns = [log.time[:, None], log.q, log.qd] + [log.tau] * torque
    formats = ["%.4f"] + ["%.6f"] * n + ["%.5f"] * n + ["%.5g"] * n * torque
    np.savetxt(
        path,
        np.concatenate(columns, 1),
        formats,
        delimiter=",",
        header=",".join(["time", *names]),
        comments="",
    )


def rounded(values):
    return [float(f"{v:.5g}") for v in values]


def explained(secret: Secret, noise):
    """Share of the user's model's error (squares over noise) that the truth explains, on train and held out."""
    shares = []
    for logs in (secret.train, [secret.held]):
        user, true = (
            np.sum((x / noise) ** 2)
            for x in (
                left(secret.user, logs),
                left(None, logs, predicted=secret.truth_said),
            )
        )
        shares.append(float(1 - true / user))
    return shares


def write(folder: Path, s: Split, secret: Secret):
    """Writes the case, or not where the recordings do not show what is concealed; whether it did."""
    shares = explained(secret, s.noise)
    lasts = np.any(
        np.abs(c.torque(secret.user, *motion(secret.held)) - secret.truth_said(secret.held)) > 1e-6
    )
    if secret.kind != "control" and (
        shares[0] < LARGE_ENOUGH or (lasts and shares[1] < 0) or not secret.effects
    ):
        print(
            f"left out: {s.arm}, {secret.title}: explains {shares[0]:.2f} on train, {shares[1]:.2f} held out"
        )
        return False
    folder.mkdir(parents=True)
    (folder / "model.xml").write_text(c.mjcf(secret.user))
    mujoco.MjModel.from_xml_path(str(folder / "model.xml"))  # refuses links that nobody could build
    for i, log in enumerate(secret.train):
        write_csv(folder / f"train_{i}.csv", log)
    for i, log in enumerate(secret.reference):
        write_csv(folder / f"reference_{i}.csv", log)
    write_csv(folder / "heldout.csv", secret.held)
    write_csv(folder / "heldout_motion.csv", secret.held, torque=False)
    held = secret.held
    user = c.torque(secret.user, *motion(held))
    best, best_band = oracle(secret, s.noise)
    full = lambda said: rounded(np.sqrt(np.mean(errors(held, said, None) ** 2, 0)))
    band = lambda said: rounded(np.sqrt(np.mean(errors(held, said) ** 2, 0)))
    size = np.sqrt(np.mean(held.tau[inner(held)] ** 2, 0))
    true = [errors(x, secret.truth_said(x)) for x in secret.train]
    user_left = left(secret.user, secret.train)
    true_left = np.sqrt(np.mean(np.concatenate(true) ** 2, 0))
    allowed = [{"effect": name, "joints": None} for name in secret.allowed] + list(secret.more_allowed)
    allowed += known_structure(secret.train, held, secret.truth_said, s.ref.chain, s.noise)
    truth = {
        "effects": [{**e, "rms_torque": rounded(e["rms_torque"])} for e in secret.effects],
        "allowed": allowed,
        "noise_std": rounded(s.noise),
        "nominal": "identified",
        "family": s.arm,
        "kind": secret.kind,
        "title": secret.title,
        "note": secret.note,
        "options": list(secret.options),
        "sensors": {"fs": round(held.rate, 3)},
        "recordings": {
            "identified_on": [f"{x.name} {x.time[0]:.2f}..{x.time[-1]:.2f} s" for x in s.identified_on],
            "train": [f"{x.name} {x.time[0]:.2f}..{x.time[-1]:.2f} s" for x in secret.train],
            "heldout": f"{held.name} {held.time[0]:.2f}..{held.time[-1]:.2f} s",
        },
        "heldout": {
            "rmse_nominal": full(user),
            "rmse_user_model": full(user),
            "rmse_true_model": full(best),
            "rmse_reference_model": full(secret.truth_said(held)),
            "rmse_up_to_10_hz": {
                "user_model": band(user),
                "oracle": rounded(best_band),
                "reference_model": band(secret.truth_said(held)),
            },
        },
        "train": {
            "user_model": rounded(user_left),
            "reference_model": rounded(true_left),
        },
        "explained": {"train": round(shares[0], 3), "heldout": round(shares[1], 3)},
        "reference_model": {
            "relative_error_percent": float(f"{100 * np.linalg.norm(s.noise) / np.linalg.norm(size):.3g}"),
            "fitted_rmse": rounded(s.ref.std),
            "offset_tared": rounded(s.ref.offset),
        },
    }
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")
    row = lambda v: " ".join(f"{x:.3g}" for x in v)
    print(f"{folder.name}: {secret.kind}, {secret.title}")
    for e in truth["effects"]:
        told = ", ".join(f"{p['name']}[{p['joint']}]={p['value']:.3g}" for p in e["parameters"][:4])
        print(f"  {e['effect']} {e['joints']} {told}; over noise: {row(np.array(e['rms_torque']) / s.noise)}")
    print(f"  noise {row(s.noise)} ({truth['reference_model']['relative_error_percent']} % of the torque)")
    h = truth["heldout"]["rmse_up_to_10_hz"]
    print(
        f"  held out to 10 Hz: user {row(h['user_model'])}; oracle {row(h['oracle'])};"
        f" reference {row(h['reference_model'])}"
    )
    if secret.kind != "control":
        print(f"  explains of the model's error: {shares[0]:.2f} on train, {shares[1]:.2f} held out")
    for why in dict.fromkeys(e["why"] for e in allowed if "why" in e):
        some = [e for e in allowed if e.get("why") == why]
        print(f"  allowed: {', '.join(e['effect'] for e in some)} {some[0]['joints'] or ''} ({why})")
    return True


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--data",
        type=Path,
        required=True,
        help="folder that holds gaz_panda, ur10e, ...",
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--only", nargs="*", default=None, choices=list(ARMS))
    options = parser.parse_args()
    for k, (arm, cases) in enumerate(ARMS.items()):
        if options.only and arm not in options.only:
            continue
        rng = np.random.default_rng([options.seed, k])
        count = 0
        for s, secret in cases(options.data, rng):
            count += write(options.out / f"{arm}_{count:02d}", s, secret)


if __name__ == "__main__":
    main()
