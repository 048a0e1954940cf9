"""What a case conceals from the model's user, and what of it the recordings bear out."""

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import added
import chain as c
import numpy as np
import scoring
from added import FRICTION, number, other_friction
from reference import (
    BAND,
    Log,
    Reference,
    factor_of,
    identify,
    inner,
    lowpass,
    motion,
    of_factor,
    shifted,
)

STRONG, WEAK = (
    14.0,
    2.5,
)  # RMS of an addition over the noise, at the joint where it shows most
COUNTS = 0.7  # of the noise: what an effect must make at a joint to be listed there
BORNE_OUT = 1.05  # how much worse than the reference model the user's must be at a joint that is listed
PROBE = {
    "torque_gain": 0.05,
    "encoder_offset": 0.01,
    "time_delay": 0.004,
    "gravity_direction": 0.01,
}
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
    s: Split,
    title,
    user,
    effects,
    forms,
    options=(),
    reference=(),
    note="",
    held=None,
    train=None,
    say=None,
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
        s,
        "coulomb_friction",
        values,
        "N·m",
        "coulomb",
        column,
        other_friction("coulomb_friction"),
    )


def _viscous(s, user):
    values = s.ref.chain.damping - user.damping
    column = lambda q, v, a: v
    also = other_friction("viscous_friction")
    return difference(s, "viscous_friction", values, "N·m·s/rad", "damping", column, also)


def _rotor(s, user):
    values = s.ref.chain.armature - user.armature
    return difference(
        s,
        "armature",
        values,
        "kg·m²",
        "armature",
        lambda q, v, a: a,
        ("inertial_parameters",),
    )


def diagonal(*columns):
    """(T, n, k n) from k arrays (T, n), one of each a joint."""
    n = columns[0].shape[1]
    return np.concatenate([np.einsum("tj,ji->tji", x, np.eye(n)) for x in columns], 2)


def friction_forms(log):
    q, v, _ = motion(log)
    return diagonal(v, np.tanh(v / c.STILL), added.bristle(q, 2e-3), added.bristle(q, 1e-2))


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
    return lost(
        s,
        "placeholders: armature 0.1, damping 1, no dry friction",
        user,
        effects,
        forms,
        **how,
    )


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


def put_right(log: Log, lag):
    """The log with its torque moved back by a lag [s]."""
    return log.but(tau=shifted(log.tau, lag * log.rate))


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
    offset = [
        {"effect": "torque_offset", "joints": None},
        {"effect": "inertial_parameters", "joints": None},
    ]
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
