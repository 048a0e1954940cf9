"""Make the cases of the blind trial on real recordings.

    python make.py --data DATA --out CASES --seed S [--only ARM ...]

Each case is a folder: model.xml (the simulation as its user has it), train_*.csv, reference_*.csv in some,
heldout_motion.csv and heldout.csv, and truth.json. How truth is defined: README.md, "The blind trial".
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # small matrices: threads only get in each other's way
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import added
import chain as c
import numpy as np
import scoring
from added import FRICTION, number, other_friction
from known import known_structure
from reference import BAND, Log, Reference, factor_of, identify, inner, lowpass, motion, of_factor, shifted

STRONG, WEAK = 14.0, 2.5  # RMS of an addition over the noise, at the joint where it shows most
COUNTS = 0.7  # of the noise: what an effect must make at a joint to be listed there
BORNE_OUT = 1.05  # how much worse than the reference model the user's must be at a joint that is listed
LARGE_ENOUGH = 0.15  # share of the error (squares over noise) that what is concealed must explain on train
PROBE = {"torque_gain": 0.05, "encoder_offset": 0.01, "time_delay": 0.004, "gravity_direction": 0.01}
"""Sizes at which effects that are not linear are measured first."""
EITHER_WAY = {
    "torque_gain",
    "encoder_offset",
    "torque_offset",
    "torque_drift",
    "torque_crosstalk",
    "gravity_direction",
}


@dataclasses.dataclass(frozen=True)
class Split:
    """What a case is made of: recordings of the reference model, recordings that the tool gets, and a test."""

    arm: str
    ref: Reference
    identified_on: list
    train: list
    held: Log
    """It shares no sample with the others."""
    noise: np.ndarray
    spare: list = ()
    """Further recordings of the arm, for --reference."""


def tared(log: Log, ref: Reference):
    """Without the constant torque that the reference model needs beside links and friction."""
    return log.but(tau=log.tau - ref.offset)


def split(arm, nominal, identified_on, train, held, spare=(), tare=True, **how) -> Split:
    ref = identify(nominal, identified_on, **how)
    if tare:
        train, spare = [tared(x, ref) for x in train], [tared(x, ref) for x in spare]
        held = tared(held, ref)
    noise = left(ref.chain, [held])
    return Split(arm, ref, list(identified_on), list(train), held, noise, list(spare))


def errors(log, said, band=BAND):
    e = log.tau - said
    e = e if band is None else lowpass(e, log.rate, band)
    return e[inner(log)]


def left(chain, logs, band=BAND, predicted=None):
    """(n,) RMS [N m] of what the model leaves of the recorded torque up to `band`."""
    say = predicted or (lambda log: c.torque(chain, *motion(log)))
    return np.sqrt(np.mean(np.concatenate([errors(log, say(log), band) for log in logs]) ** 2, 0))


# ------------------------------------------------------------------------------------ what is concealed


@dataclasses.dataclass(frozen=True)
class Secret:
    """A case before it is written."""

    kind: str  # control, real, semi
    title: str
    user: c.Chain
    train: list
    held: Log
    effects: list
    truth_said: Callable
    """log -> torque by the true model."""
    forms: Callable | None = None
    """log -> (T, n, k): columns of the concealed thing's true form, to be fitted beside the user's model."""
    fitted: Callable | None = None
    """size factor -> (log -> torque): where the true form is one number."""
    reference: list = ()
    options: tuple = ()
    allowed: tuple = ()
    more_allowed: tuple = ()
    note: str = ""


def control(s: Split, reference=False, note="") -> Secret:
    say = lambda log: c.torque(s.ref.chain, *motion(log))
    return Secret(
        "control",
        "nothing",
        s.ref.chain,
        s.train,
        s.held,
        [],
        say,
        reference=s.spare if reference else [],
        note=note,
    )


def semi(s: Split, what: added.Added, ratio, rng, reference=False) -> Secret:
    """A known effect in the real log, as large as `ratio` times the noise or as large as makes sense."""
    chain = s.ref.chain
    probe = PROBE.get(what.name, 1.0)
    size = min(probe * ratio / np.max(what.rms(chain, s.train, probe) / s.noise), what.most)
    if rng.random() < 0.5 and what.name in EITHER_WAY:
        size = -size
    size = float(f"{size:.3g}")
    rms = what.rms(chain, s.train, size)
    train = [what.into(log, size) for log in s.train]
    held = what.into(s.held, size) if what.lasts else s.held
    joints = what.joints or [int(np.argmax(rms / s.noise)) + 1]
    effect = {
        "effect": what.name,
        "joints": joints,
        "intervals": what.intervals,
        "parameters": what.told(size),
        "rms_torque": rms,
        "also": list(what.also),
    }

    def says(k):
        """The true model; what does not last is not in the held-out recording, whatever its stamps."""
        absent = lambda log: log is held and not what.lasts
        with_it = lambda log: what.predicted(chain, log, k * size)
        return lambda log: c.torque(chain, *motion(log)) if absent(log) else with_it(log)

    return Secret(
        "semi",
        f"{what.name} {joints}",
        chain,
        train,
        held,
        [effect],
        says(1.0),
        fitted=says if what.lasts else None,
        reference=s.spare if reference else [],
        allowed=tuple(FRICTION) if what.name in FRICTION else (),
    )


def lost(
    s: Split, title, user, effects, forms, options=(), reference=(), note="", held=None, train=None, say=None
):
    """The model lacks (or has too much of) what the real arm has.

    Joints count where the recordings bear it out: the true model (`say`, else the reference model) is better
    there than the user's, in what the tool gets and held out. Elsewhere the claim is neither right nor wrong.
    """
    train, held = train or s.train, held or s.held
    say = say or (lambda log: c.torque(s.ref.chain, *motion(log)))
    worse = np.ones(s.ref.chain.dof, bool)
    for logs in (train, [held]):
        worse &= left(user, logs) > BORNE_OUT * left(None, logs, predicted=say)
    doubtful = []
    for e in effects:
        if e["effect"] not in scoring.EVERYWHERE:
            out = [j for j in e["joints"] if not worse[j - 1]]
            e["joints"] = [j for j in e["joints"] if worse[j - 1]]
            e["parameters"] = [x for x in e["parameters"] if x["joint"] in e["joints"]]
            names = [e["effect"], *e["also"]] if out else []
            doubtful += [{"effect": name, "joints": out, "why": "not borne out there"} for name in names]
    effects = [e for e in effects if e["joints"]]
    touched = any(e["effect"] in FRICTION for e in effects)
    return Secret(
        "real",
        title,
        user,
        train,
        held,
        effects,
        say,
        forms=forms,
        options=options,
        reference=list(reference),
        note=note,
        allowed=tuple(FRICTION) if touched else (),
        more_allowed=tuple(doubtful),
    )


def difference(s: Split, name, values, unit, parameter, column, also=()):
    """The entry of a number of the model (n,) that differs: real minus the user's."""
    made = np.concatenate([(values * column(*motion(log)))[inner(log)] for log in s.train])
    rms = np.sqrt(np.mean(made**2, 0))
    joints = [int(j) + 1 for j in np.flatnonzero(rms > COUNTS * s.noise)]
    told = [number(parameter, j, values[j - 1], unit) for j in joints]
    return {
        "effect": name,
        "joints": joints,
        "intervals": None,
        "parameters": told,
        "rms_torque": rms,
        "also": list(also),
    }


def _dry(s, user):
    values = s.ref.chain.frictionloss - user.frictionloss
    column = lambda q, v, a: np.tanh(v / c.STILL)
    return difference(
        s, "coulomb_friction", values, "N·m", "coulomb", column, other_friction("coulomb_friction")
    )


def _viscous(s, user):
    values = s.ref.chain.damping - user.damping
    column = lambda q, v, a: v
    also = other_friction("viscous_friction")
    return difference(s, "viscous_friction", values, "N·m·s/rad", "damping", column, also)


def _rotor(s, user):
    values = s.ref.chain.armature - user.armature
    return difference(s, "armature", values, "kg·m²", "armature", lambda q, v, a: a, ("inertial_parameters",))


def diagonal(*columns):
    """(T, n, k n) from k arrays (T, n), one of each a joint."""
    n = columns[0].shape[1]
    return np.concatenate([np.einsum("tj,ji->tji", x, np.eye(n)) for x in columns], 2)


def friction_forms(log):
    q, v, _ = motion(log)
    return diagonal(v, np.tanh(v / c.STILL), *presliding(q))


def presliding(q, distances=(2e-3, 1e-2)):
    """(T, n) Dahl's bristle for each distance."""
    out = []
    for distance in distances:
        z = np.zeros_like(q)
        d = np.diff(q, axis=0)
        decay = np.exp(-np.abs(d) / distance)
        for t in range(1, len(q)):
            side = np.sign(d[t - 1])
            z[t] = side + (z[t - 1] - side) * decay[t - 1]
        out.append(z)
    return out


def friction_lost(s, joints=None, **how):
    """No friction at some joints, or at all."""
    n = s.ref.chain.dof
    gone = np.zeros(n, bool)
    gone[np.array(joints if joints is not None else range(1, n + 1)) - 1] = True
    user = s.ref.chain.but(
        damping=np.where(gone, 0, s.ref.chain.damping),
        frictionloss=np.where(gone, 0, s.ref.chain.frictionloss),
    )
    title = "friction of " + ("all joints" if joints is None else f"joints {joints}")
    forms = lambda log: friction_forms(log)[:, :, np.tile(gone, 4)]
    return lost(s, title, user, [_dry(s, user), _viscous(s, user)], forms, **how)


def rotors_lost(s, **how):
    user = s.ref.chain.but(armature=np.zeros(s.ref.chain.dof))
    forms = lambda log: diagonal(motion(log)[2])
    return lost(s, "rotor inertias", user, [_rotor(s, user)], forms, **how)


def placeholders(s, **how):
    """Numbers as simulations ship them: armature 0.1, damping 1, no dry friction."""
    one = np.ones(s.ref.chain.dof)
    user = s.ref.chain.but(armature=0.1 * one, damping=one, frictionloss=0 * one)
    effects = [_dry(s, user), _viscous(s, user), _rotor(s, user)]
    forms = lambda log: np.concatenate([friction_forms(log), diagonal(motion(log)[2])], 2)
    return lost(s, "placeholders: armature 0.1, damping 1, no dry friction", user, effects, forms, **how)


def too_much_damping(s, joints, ratio):
    """Damping larger than the real one by so much that it makes `ratio` times the noise."""
    speed = np.sqrt(np.mean(np.concatenate([motion(x)[1] for x in s.train]) ** 2, 0))
    more = np.zeros(s.ref.chain.dof)
    for j in joints:
        more[j - 1] = float(f"{ratio * s.noise[j - 1] / speed[j - 1]:.3g}")
    user = s.ref.chain.but(damping=s.ref.chain.damping + more)
    forms = lambda log: diagonal(motion(log)[1])[:, :, np.array(joints) - 1]
    return lost(s, f"damping too large at joints {joints}", user, [_viscous(s, user)], forms)


def nominal_links(s, nominal, options=()):
    """Links as somebody guessed or drew them; friction and rotors as identified."""
    user = s.ref.chain.but(phi=nominal.phi)
    other = s.ref.chain.phi - nominal.phi
    say = lambda log: c.regressor(s.ref.chain, *motion(log)) @ other.ravel()
    rms = np.sqrt(np.mean(np.concatenate([say(x)[inner(x)] for x in s.train]) ** 2, 0))
    effect = {
        "effect": "inertial_parameters",
        "joints": [int(j) + 1 for j in np.flatnonzero(rms > COUNTS * s.noise)],
        "intervals": None,
        "parameters": [],
        "rms_torque": rms,
        "also": ["payload", "armature"],
    }
    size = 0.3 * np.abs(nominal.phi).max(1, keepdims=True) * np.ones(10)
    forms = lambda log: c.regressor(s.ref.chain, *motion(log)) * size.ravel()
    return lost(s, "links are nominal", user, [effect], forms, options)


def tilt_lost(s):
    """The model's base is level."""
    level = np.array([0, 0, -9.81])
    user = s.ref.chain.but(gravity=level)
    say = lambda log: c.torque(s.ref.chain, *motion(log)) - c.torque(user, *motion(log))
    rms = np.sqrt(np.mean(np.concatenate([say(x)[inner(x)] for x in s.train]) ** 2, 0))
    lean = s.ref.chain.gravity - level
    told = [number(f"gravity_{k}", None, x, "m/s²") for k, x in zip("xy", lean[:2], strict=True)]
    effect = {
        "effect": "gravity_direction",
        "joints": [int(np.argmax(rms / s.noise)) + 1],
        "intervals": None,
        "parameters": told,
        "rms_torque": rms,
        "also": [],
    }

    def forms(log):
        at = motion(log)
        base = c.regressor(user, *at) @ user.phi.ravel()
        columns = [c.regressor(user, *at, level + d) @ user.phi.ravel() - base for d in np.eye(3)[:2]]
        return np.stack(columns, -1)

    return lost(s, "tilt of the base", user, [effect], forms)


def untared(s: Split):
    """The sensors' offsets are left in the log; MJCF cannot hold them."""
    offset = s.ref.offset
    effect = difference(
        s,
        "torque_offset",
        offset,
        "N·m",
        "offset",
        lambda q, v, a: np.ones_like(q),
        ("asymmetric_friction", "torque_drift"),
    )
    back = lambda log: log.but(tau=log.tau + offset)
    say = lambda log: c.torque(s.ref.chain, *motion(log)) + offset
    forms = lambda log: diagonal(np.ones_like(log.q))
    return lost(
        s,
        "offsets of the sensors",
        s.ref.chain,
        [effect],
        forms,
        train=[back(x) for x in s.train],
        held=back(s.held),
        say=say,
    )


def real_shift(log, lag):
    return shifted(log.tau, lag * log.rate)


def late(s: Split, lag, as_recorded):
    """The log as recorded, torque behind motion by `lag`; the model is of logs put right."""
    train, held = as_recorded
    back = lambda log: tared(log, s.ref)
    say = lambda log: shifted(c.torque(s.ref.chain, *motion(log)), -lag * log.rate)
    made = [(say(x) - c.torque(s.ref.chain, *motion(x)))[inner(x)] for x in train]
    rms = np.sqrt(np.mean(np.concatenate(made) ** 2, 0))
    effect = {
        "effect": "time_delay",
        "joints": [int(np.argmax(rms / s.noise)) + 1],
        "intervals": None,
        "parameters": [number("delay", None, lag, "s")],
        "rms_torque": rms,
        "also": [],
    }
    return Secret(
        "real",
        f"torque late by {1e3 * lag:.0f} ms",
        s.ref.chain,
        [back(x) for x in train],
        back(held),
        [effect],
        say,
        fitted=lambda k: lambda log: shifted(c.torque(s.ref.chain, *motion(log)), -k * lag * log.rate),
    )


def before_the_gear(s: Split, sensors: Split):
    """Motor currents, by a model of what the sensors behind the gears measure: it lacks their friction."""
    chain = s.ref.chain
    user = sensors.ref.chain
    true = chain
    effects = [_dry(s, user), _viscous(s, user), _rotor(s, user)]
    forms = lambda log: np.concatenate(
        [friction_forms(log), diagonal(motion(log)[2], np.ones_like(log.q))], 2
    )
    say = lambda log: c.torque(true, *motion(log))
    secret = lost(s, "friction and rotors before the gears", user, effects, forms)
    offset = [{"effect": "torque_offset", "joints": None}, {"effect": "inertial_parameters", "joints": None}]
    return dataclasses.replace(secret, truth_said=say, more_allowed=(*secret.more_allowed, *offset))


def load_taken_out(s: Split, body):
    """A mounted body (its ten numbers) that the identification knew of, taken out of the model's last link."""
    phi = s.ref.chain.phi.copy()
    phi[-1] = of_factor(factor_of(phi[-1] - body, 1e-4 * body[0]))
    gone = s.ref.chain.phi[-1] - phi[-1]
    user = s.ref.chain.but(phi=phi)
    forms = lambda log: c.regressor(s.ref.chain, *motion(log))[:, :, -10:]
    made = np.concatenate([(forms(x) @ gone)[inner(x)] for x in s.train])
    effect = {
        "effect": "payload",
        "joints": [s.ref.chain.dof],
        "intervals": None,
        "parameters": [number("mass", None, gone[0], "kg")],
        "rms_torque": np.sqrt(np.mean(made**2, 0)),
        "also": ["inertial_parameters", "payload_change"],
    }
    return lost(s, f"a held body of {gone[0]:.3g} kg", user, [effect], forms)


# ------------------------------------------------------------------------------------------- writing


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
            for x in (left(secret.user, logs), left(None, logs, predicted=secret.truth_said))
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
        "train": {"user_model": rounded(user_left), "reference_model": rounded(true_left)},
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
    parser.add_argument("--data", type=Path, required=True, help="folder that holds gaz_panda, ur10e, ...")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--only", nargs="*", default=None)
    options = parser.parse_args()
    sys.modules["make"] = sys.modules[__name__]
    from cases import ARMS

    for k, (arm, cases) in enumerate(ARMS.items()):
        if options.only and arm not in options.only:
            continue
        rng = np.random.default_rng([options.seed, k])
        count = 0
        for s, secret in cases(options.data, rng):
            count += write(options.out / f"{arm}_{count:02d}", s, secret)


if __name__ == "__main__":
    main()
