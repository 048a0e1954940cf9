"""`rehearse`: a simulated run of a motion with known links and friction, and what the tool makes of it.

The arm that moves is MuJoCo's (`jaxpanda.simulation`), with links, friction and sensors that the analysis is not
told of. What the analysis then says is held against what was planted.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels import inertia
from jaxtyping import Float

from ..arms import markup
from ..arms.arm import Arm
from ..arms.export import panda_mjcf
from ..arms.mjcf import MjcfSource
from ..arms.model_file import Model
from ..arms.source import from_document, from_mjcf, is_panda
from ..diagnosis import diagnose as diagnose_
from ..errors import InputError, require_x64
from ..feasible.nearest import are_buildable
from ..identification import identify
from ..identification.result import RELIABLE
from ..inference.state import start
from ..parameters import linear_forms, unit_of_form
from ..recordings import Recording
from ..rollout import engine_model
from ..search.coverage import least_shown
from ..search.premises import pose
from ..session import Say, silent
from ..signals import prepare
from ..simulation import JointFriction, Sensors, SplineTrajectory, panda_sensors, simulate, with_sensors
from ..traces import prepare as prepare_trace
from .result import Fault, Rehearsal, Row

SPREAD = 0.1
"""By which planted links differ from the model's: of mass and lengths, as a share."""
_LONGEST, _RATE = 120.0, 250.0
"""Of a motion [s], and of the simulated log [Hz]."""
_NOISE, _RUBS = 0.01, 0.05
"""Of the rms torque of a joint: noise of its sensor, and Coulomb friction that is planted."""
_PLANTED = 3.0
"""A fault that is planted to be diagnosed, over the least that would be seen."""


def rehearse(
    model: Model | None,
    motion: Recording,
    *,
    draws: int = 3,
    seed: int = 0,
    torque_noise: Sequence[float] = (),
    diagnose: bool = False,
    progress: Say = silent,
) -> Rehearsal:
    """What recording this motion would recover, to which precision, and what it could not.

    Args:
        model: the arm (MJCF); None for the project's own Panda.
        motion: positions over time; torque in it is not looked at.
        draws: of the sensors' noise, each identified.
        seed: of what is planted and of the noise.
        torque_noise: standard deviation of the torque sensors, one for all joints or one a joint [N m]; without
            it the Panda's, or a hundredth of each joint's rms torque.
        diagnose: plant one more friction, well above the least that would be seen, and diagnose it.
        progress: called with what is being done.

    Raises:
        InputError: the motion is of another arm, nothing moves, or it is too long.
    """
    require_x64("a rehearsal")
    if draws < 2:
        raise InputError(f"draws: {draws}, where at least 2 tell of a deviation")
    arm, source = _opened(model)
    motion.require_dof(arm.dof)
    seconds = float(np.ptp(motion.time))
    if seconds > _LONGEST:
        raise InputError(f"{motion.name}: lasts {seconds:.0f} s; a rehearsal takes up to {_LONGEST:.0f} s")
    if np.ptp(motion.q, axis=0).max() < 0.01:
        raise InputError(f"{motion.name}: no joint moves, so that there is nothing to identify")
    truth = _planted(arm, seed)
    size = _rms_torque(arm, motion)
    friction = _friction(size, motion, seed)
    sensors = _sensors(arm, size, torque_noise)
    path = SplineTrajectory.through(motion.time, motion.q)
    progress("simulating the motion in MuJoCo")
    exact = simulate(
        engine_model(source, truth),
        path,
        duration=seconds,
        rate=_RATE,
        friction=friction,
        name=motion.name,
    )
    found = []
    for k in range(draws):
        progress(f"identifying draw {k + 1} of {draws}")
        found.append(identify(with_sensors(exact, sensors, seed + k), arm, folds=0))
    rows = _rows(found, truth, friction)
    progress("looking at what faults would show")
    known = _as_known(truth, friction)
    faults = _faults(with_sensors(exact, sensors, seed), known)
    diagnosed = None
    if diagnose:
        progress("planting a fault and diagnosing it")
        diagnosed = _diagnosed(model, source, arm, path, seconds, sensors, faults, seed)
    first = found[0]
    notes = [note for note in first.notes if "deviation" not in note]
    return Rehearsal(
        motion=motion.name,
        seconds=seconds,
        arm=arm.name,
        unit=arm.unit("N m"),
        joints=arm.joint_names,
        draws=draws,
        seed=seed,
        rank=int(first.rank or 0),
        condition_number=first.condition_number,
        relative_error_percent=float(np.mean([one.relative_error_percent or 0.0 for one in found])),
        parameters=tuple(row for row in rows if row.joint is None),
        friction=tuple(row for row in rows if row.joint is not None),
        faults=tuple(faults),
        torque_noise=np.broadcast_to(sensors.torque_noise, arm.dof).tolist(),
        diagnosed=diagnosed,
        notes=tuple(notes),
    )


def _opened(model: Model | None) -> tuple[Arm, MjcfSource]:
    if model is None:
        return from_document(markup.parse(panda_mjcf(), "mujoco", Path("panda.xml")))
    return from_mjcf(model)


def _planted(arm: Arm, seed: int) -> Arm:
    """The arm with other links, each a body that could be built; what is fixed to them stays."""
    random = np.random.default_rng(seed)
    carried = np.zeros((arm.dof, 10)) if arm.lumped is None else np.asarray(arm.lumped)
    standard = np.array(arm.standard)
    for i in range(arm.dof):
        own = standard[i] - carried[i]
        if not np.any(own) or not are_buildable(own[None]):
            continue
        eta = np.asarray(inertia.to_log_cholesky(jnp.asarray(own)))
        if not np.isfinite(eta).all():
            continue
        length = np.exp(eta[1:4]).mean()
        step = SPREAD * random.normal(size=10) * np.array([0.5, 1, 1, 1, *[length] * 6])
        standard[i] = np.asarray(inertia.from_log_cholesky(jnp.asarray(eta + step))) + carried[i]
    return eqx.tree_at(lambda a: a.standard, arm, jnp.asarray(standard))


def _rms_torque(arm: Arm, motion: Recording) -> Float[np.ndarray, " dof"]:
    """Of the nominal arm over the motion [N m], at least a thousandth of the largest joint's."""
    signals = prepare(dataclasses.replace(motion, tau=None))
    tau = jax.vmap(arm.inverse_dynamics)(*(jnp.asarray(x) for x in (signals.q, signals.qd, signals.qdd)))
    rms = np.sqrt(np.mean(np.asarray(tau) ** 2, 0))
    return np.maximum(rms, 1e-3 * rms.max())


def _friction(size: Float[np.ndarray, " dof"], motion: Recording, seed: int) -> JointFriction:
    random = np.random.default_rng(seed + 1)
    speed = np.sqrt(np.mean(np.gradient(motion.q, motion.time, axis=0) ** 2, 0))
    coulomb = np.maximum(_RUBS * size, 0.02) * random.uniform(0.7, 1.3, len(size))
    viscous = coulomb / np.maximum(speed, 0.1) * random.uniform(0.3, 0.7, len(size))
    return JointFriction(viscous, coulomb, 0.2 * coulomb * random.normal(size=len(size)))


def _sensors(arm: Arm, size: Float[np.ndarray, " dof"], noise: Sequence[float]) -> Sensors:
    if noise:
        if len(noise) not in (1, arm.dof) or not all(np.isfinite(v) and v > 0 for v in noise):
            raise InputError(f"torque_noise: one positive number, or one for each of {arm.dof} joints [N m]")
        return Sensors(
            torque_noise=np.broadcast_to(np.asarray(noise, float), arm.dof),
            torque_correlation_time=2e-3,
            velocity_noise=1e-3,
        )
    if is_panda(arm):
        return panda_sensors()
    return Sensors(torque_noise=_NOISE * size, torque_correlation_time=2e-3, velocity_noise=1e-3)


def _rows(found: Sequence, truth: Arm, friction: JointFriction) -> list[Row]:
    """What was identified against what was planted."""
    phi, dof = np.asarray(truth.standard).ravel(), truth.dof
    first = found[0]
    rows = []
    if any(one.expressions != first.expressions for one in found):
        raise InputError(
            "the motion shows some parameters so weakly that their number changes with the noise"
        )
    for i, (text, terms) in enumerate(zip(first.expressions, linear_forms(first.projection), strict=True)):
        values = np.array([one.beta[i] for one in found])
        std = np.array([one.std[i] for one in found])
        rows.append(_row(text, None, unit_of_form(terms), float(first.projection[i] @ phi), values, std))
    if first.friction is not None:
        planted = {"viscous": friction.viscous, "coulomb": friction.coulomb, "offset": friction.offset}
        units = {"viscous": "N·m·s/rad", "coulomb": "N·m", "offset": "N·m"}
        for j in range(dof):
            for name in first.friction.parameters:
                values = np.array([one.friction.parameters[name][j] for one in found])
                std = np.array([one.friction.std[name][j] for one in found])
                true = float(np.broadcast_to(planted[name], dof)[j])
                rows.append(_row(name, j + 1, truth.unit(units[name], j), true, values, std))
    return rows


def _row(name: str, joint: int | None, unit: str, truth: float, values: np.ndarray, std: np.ndarray) -> Row:
    told = bool(np.isfinite(std).all())
    expected = float(np.sqrt(np.mean(std**2))) if told else None
    return Row(
        name=name,
        joint=joint,
        unit=unit,
        truth=truth,
        mean=float(values.mean()),
        std=expected,
        error=float(np.sqrt(np.mean((values - truth) ** 2))),
        told=expected is not None and expected <= RELIABLE * abs(truth),
    )


def _as_known(truth: Arm, friction: JointFriction) -> Arm:
    """The planted arm as a model that has been identified."""
    damping = truth.damping + jnp.asarray(friction.viscous)
    loss = truth.frictionloss + jnp.asarray(friction.coulomb)
    return eqx.tree_at(lambda a: (a.damping, a.frictionloss), truth, (damping, loss))


def _faults(recording: Recording, arm: Arm) -> list[Fault]:
    """The least size of every effect that a diagnosis of this recording would find, beside what it refits."""
    premises = pose((prepare_trace(recording, arm),), (True,), "identified")
    state = start(premises.problem)
    return [
        Fault(
            effect=one.effect,
            joint=None if one.joint is None else one.joint + 1,
            parameter=one.parameter,
            size=one.size,
            unit=one.unit,
            rms_torque=one.rms_torque,
        )
        for one in least_shown(premises.problem, state)
    ]


def _diagnosed(
    model: Model | None,
    source: MjcfSource,
    arm: Arm,
    path: SplineTrajectory,
    seconds: float,
    sensors: Sensors,
    faults: Sequence[Fault],
    seed: int,
) -> dict:
    """The user's arm with one more friction, and what a diagnosis says of it."""
    seen = [
        f for f in faults if f.effect == "coulomb_friction" and f.size is not None and f.joint is not None
    ]
    if not seen:
        return {"planted": None, "findings": [], "found": False}
    fault = sorted(seen, key=lambda f: f.size or 0.0)[len(seen) // 2]
    level = np.zeros(arm.dof)
    level[(fault.joint or 1) - 1] = _PLANTED * (fault.size or 0.0)
    recording = simulate(
        engine_model(source, arm),
        path,
        duration=seconds,
        rate=_RATE,
        friction=JointFriction(coulomb=level),
        sensors=sensors,
        seed=seed,
        name="planted",
    )
    found = diagnose_(model, [recording])
    findings = [
        {"effect": f.effect, "joints": [j + 1 for j in f.joints], "confidence": f.confidence}
        for f in getattr(found, "findings", ())
    ]
    return {
        "planted": {
            "effect": fault.effect,
            "joint": fault.joint,
            "size": float(level.max()),
            "unit": fault.unit,
        },
        "findings": findings,
        "found": any(f["effect"] == fault.effect and fault.joint in f["joints"] for f in findings),
    }
