r"""Is a model what it says, in every engine, and does it move like the arm in the recording?

Four questions of one MJCF:

1. Does our inverse dynamics equal C MuJoCo's and MJX's, on the states that were recorded?
2. How far is its torque from the recorded one, joint by joint, both filtered alike?
3. Where does the model go under the recorded torque, with weak feedback, in MJX and in C MuJoCo?
4. Does it hold anything that MJX leaves out without saying so?

Of two models the better has the smaller `rmse` on a recording that neither was fitted to. The roll-out is the
same question in radians: feedback hides errors of the model, a stiff one all of them, so its tracking error
is only comparable between models under the same gains, which come from the recording and not from the
model; `feedback_rms`, the torque that feedback had to add, is the model's error as the simulator felt it.
"""

import contextlib
import copy
import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import scipy.interpolate
from jaxtyping import Array, Float

from . import files
from .arms.arm import Arm
from .arms.engine_log import own_log
from .arms.mjcf import MjcfSource
from .arms.model_file import Model
from .arms.source import from_mjcf
from .errors import InputError, require_x64
from .friction import Friction
from .recordings import Recording
from .signals import Signals, derivatives, prepare, zero_phase
from .xla import options

FILE = "validation.json"
KIND = files.Kind("validate", (FILE,))

AGREEMENT = 1e-9
"""How far engines may differ, as a share of the largest torque or of 1 N m."""
STATES = 500
"""Recorded states on which the engines are compared, at most."""
ROLLOUT_SECONDS = 10.0
"""Length of the roll-out of each recording, at most."""

_SILENT_IN_MJX = (
    ("dof_dampingpoly", "polynomial damping", mujoco.mjtObj.mjOBJ_JOINT),
    ("jnt_stiffnesspoly", "polynomial stiffness", mujoco.mjtObj.mjOBJ_JOINT),
    ("tendon_dampingpoly", "polynomial damping", mujoco.mjtObj.mjOBJ_TENDON),
    ("tendon_stiffnesspoly", "polynomial stiffness", mujoco.mjtObj.mjOBJ_TENDON),
    ("actuator_damping", "damping", mujoco.mjtObj.mjOBJ_ACTUATOR),
    ("actuator_dampingpoly", "polynomial damping", mujoco.mjtObj.mjOBJ_ACTUATOR),
    ("actuator_armature", "armature", mujoco.mjtObj.mjOBJ_ACTUATOR),
    ("actuator_delay", "a delay", mujoco.mjtObj.mjOBJ_ACTUATOR),
    ("actuator_history", "a history of samples", mujoco.mjtObj.mjOBJ_ACTUATOR),
)
"""What C MuJoCo honours and MJX-JAX ignores without a word: field of MjModel, its name, whose it is."""


@dataclasses.dataclass(frozen=True)
class Rollout:
    """What one engine made of the recorded torque and motion."""

    rmse: Float[np.ndarray, " dof"]
    """Tracking error, rms over all recordings [rad]."""
    feedback_rms: Float[np.ndarray, " dof"]
    """Torque that feedback added to the recorded one [N m]."""
    seconds: float
    """Of computation, compilation included."""
    q: tuple[Float[np.ndarray, "time dof"], ...] = dataclasses.field(repr=False)
    """Motion of each recording's roll-out [rad], for comparison of engines and for plots."""


@dataclasses.dataclass(frozen=True)
class TorqueError:
    """A model's torque on one recording, both sides filtered alike."""

    name: str
    rmse: Float[np.ndarray, " dof"]
    """[N m]"""
    relative_error_percent: float
    r"""$100\,\lVert\tau - \hat\tau\rVert / \lVert\tau\rVert$ over all joints."""
    times: Float[np.ndarray, " kept"] = dataclasses.field(repr=False)
    """[s]"""
    measured: Float[np.ndarray, "kept dof"] = dataclasses.field(repr=False)
    """[N m]"""
    modelled: Float[np.ndarray, "kept dof"] = dataclasses.field(repr=False)
    """[N m]"""


@dataclasses.dataclass(frozen=True)
class Validation:
    """How one MJCF fares; see the module's docstring for how to read it."""

    model: str
    arm: Arm = dataclasses.field(repr=False)
    """What the file says of it."""
    cutoff: float
    """Of the low-pass on both sides of the torque [Hz]."""
    kernel_vs_mujoco: float
    """Largest difference of inverse dynamics [N m], frictionloss left out on both sides."""
    mjx_vs_mujoco: float | None
    """The same for MJX; None where MJX cannot run the model."""
    agree: bool
    """Whether those differences are within `AGREEMENT` of the largest torque."""
    rmse: Float[np.ndarray, " dof"]
    """Torque error over all recordings [N m]."""
    relative_error_percent: float
    torque: tuple[TorqueError, ...]
    """The same for each recording, with the torques."""
    stiffness: Float[np.ndarray, " dof"]
    """Feedback gain of the roll-outs [N m/rad]."""
    damping: Float[np.ndarray, " dof"]
    """Feedback gain of the roll-outs [N m s/rad]."""
    mjx: Rollout | None
    mujoco: Rollout | None
    rollout_difference: float | None
    """Largest difference between the two engines' roll-outs [rad]."""
    notes: tuple[str, ...]

    @property
    def joints(self) -> tuple[str, ...]:
        """Their names."""
        return self.arm.joint_names

    def to_json(self) -> dict[str, Any]:
        """The document that `validation.json` holds; null where an engine could not run."""
        return {
            "schema": "jaxpanda.validation/1",
            "model": self.model,
            "joints": list(self.joints),
            "kernel_vs_mujoco": self.kernel_vs_mujoco,
            "mjx_vs_mujoco": self.mjx_vs_mujoco,
            "agree": self.agree,
            "cutoff": self.cutoff,
            "rmse": self.rmse.tolist(),
            "relative_error_percent": self.relative_error_percent,
            "recordings": [
                {"name": e.name, "rmse": e.rmse.tolist(), "relative_error_percent": e.relative_error_percent}
                for e in self.torque
            ],
            "rollout_rmse_rad": None if self.mjx is None else self.mjx.rmse.tolist(),
            "rollout": {
                "stiffness": self.stiffness.tolist(),
                "damping": self.damping.tolist(),
                "mjx": _rollout_json(self.mjx),
                "mujoco": _rollout_json(self.mujoco),
                "largest_difference_rad": self.rollout_difference,
            },
            "notes": list(self.notes),
        }

    def save(self, folder: str | Path) -> Path:
        """Write `validation.json` into a folder, whole or not at all."""
        with files.output_folder(folder, KIND) as scratch:
            files.write_json(scratch / FILE, self.to_json())
        return Path(folder) / FILE


def _rollout_json(rollout: Rollout | None) -> dict[str, Any] | None:
    if rollout is None:
        return None
    return {
        "rmse_rad": rollout.rmse.tolist(),
        "feedback_rms": rollout.feedback_rms.tolist(),
        "seconds": rollout.seconds,
    }


def validate(
    model: Model,
    recordings: Sequence[Recording],
    *,
    cutoff: float = 5.0,
    rollout: bool = True,
    in_mjx: bool = True,
    friction: Friction | None = None,
    gravity: Sequence[float] | None = None,
) -> Validation:
    """Check an MJCF in MuJoCo and MJX, and against recordings.

    Args:
        model: MJCF file with a serial arm.
        recordings: of that arm, with torque; best such as the model was not fitted to.
        cutoff: of the zero-phase low-pass on both sides of the torque [Hz].
        rollout: whether to run the model forward too.
        in_mjx: whether to ask MJX as well, which on a CPU takes most of the time.
        friction: of the joints beyond what the file holds (what MJCF has no place for: an offset, a
            sigmoid); counts in `rmse` and in the roll-out, where it acts as an external torque.
        gravity: in place of the file's, in the frame of its world [m/s²].

    Raises:
        InputError: no such model or none of a serial arm, no recording, or one of another arm or without
            torque.
    """
    require_x64("validate")
    arm, source = from_mjcf(model, gravity)
    motions = [_prepared(recording, arm, cutoff) for recording in recordings]
    if not motions:
        raise InputError(f"{model}: nothing to validate against; give at least one recording")
    bare = arm_model(source)
    mjx, notes = mjx_package(source.model) if in_mjx else (None, ["not checked in MJX, as asked"])
    notes = [*source.notes, *notes]

    states = _states(motions)
    reference = mujoco_inverse(source, *states)
    kernel = _difference(_kernel_inverse(arm, *states), reference)
    jax_apart = None if mjx is None else _difference(_mjx_inverse(mjx, bare, *states), reference)
    limit = AGREEMENT * max(1.0, float(np.abs(reference).max()))
    agree = max(kernel, jax_apart or 0.0) <= limit
    if not agree:
        notes.append(
            f"inverse dynamics differs between engines by more than {limit:.1e} {arm.unit('N m')}: trust none"
            " of them here"
        )
    if np.any(arm.frictionloss):
        notes.append(
            "frictionloss is left out where engines are compared (in MuJoCo it is a soft constraint), "
            "and counted as Coulomb friction in the torque error"
        )

    torque = tuple(_torque_error(arm, friction, signals) for signals in motions)
    errors = np.concatenate([e.measured - e.modelled for e in torque])
    measured = np.concatenate([e.measured for e in torque])

    tasks = [_task(signals, bare.opt.timestep) for signals in motions] if rollout else []
    stiffness, damping = feedback_gains(measured)
    law = _Feedback(stiffness, damping, friction)
    in_c = _rollout_mujoco(bare, tasks, law) if rollout else None
    in_jax = _rollout_mjx(mjx, bare, tasks, law) if rollout and mjx is not None else None
    return Validation(
        model=str(model),
        arm=arm,
        cutoff=cutoff,
        kernel_vs_mujoco=kernel,
        mjx_vs_mujoco=jax_apart,
        agree=agree,
        rmse=_rms(errors),
        relative_error_percent=_relative(errors, measured),
        torque=torque,
        stiffness=stiffness,
        damping=damping,
        mjx=in_jax,
        mujoco=in_c,
        rollout_difference=_apart(in_jax, in_c),
        notes=tuple(notes),
    )


def assert_mjx_supported(model: mujoco.MjModel) -> None:
    """Refuse a model of which MJX-JAX would silently leave something out.

    Polynomial damping and stiffness, and an actuator's own damping, armature or delay act in C MuJoCo
    and not in MJX 3.17, where nothing says so: a roll-out there would be one of another model.

    Raises:
        InputError: names what is left out and where.
    """
    found = []
    for field, feature, kind in _SILENT_IN_MJX:
        values = np.asarray(getattr(model, field))
        if not len(values):
            continue
        for i in np.flatnonzero(np.any(values.reshape(len(values), -1) != 0, axis=1)):
            owner = int(model.dof_jntid[i]) if field.startswith("dof_") else int(i)
            name = mujoco.mj_id2name(model, kind, owner) or f"number {owner + 1}"
            found.append(f"{feature} of {_KIND[kind]} {name!r}")
    if found:
        raise InputError(
            f"MJX silently ignores {', '.join(found)}; C MuJoCo honours it, so the two would differ"
        )


_KIND = {
    mujoco.mjtObj.mjOBJ_JOINT: "joint",
    mujoco.mjtObj.mjOBJ_TENDON: "tendon",
    mujoco.mjtObj.mjOBJ_ACTUATOR: "actuator",
}


@own_log()
def arm_model(source: MjcfSource) -> mujoco.MjModel:
    """The arm of a file and nothing else: no geometry, actuators, sensors or scene, grippers locked.

    Bodies, joints and options keep the compiled numbers of the user's model, bit for bit, so this is its
    mechanics in a form that MJX compiles in seconds. Joint limits are off. The solver is Newton's and the
    integrator implicitfast where the file asks for one that MJX lacks.
    """
    full = source.model
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.compiler.autolimits = False
    spec.compiler.fusestatic = False
    joints: dict[int, list[int]] = {}  # a body may have several
    for link in source.links:
        joints.setdefault(link.body_id, []).append(link.joint_id)
    root = int(full.body_rootid[source.links[0].body_id])
    made = {0: spec.worldbody}
    for i in range(1, full.nbody):
        if full.body_rootid[i] != root:
            continue
        body = made[i] = made[int(full.body_parentid[i])].add_body(
            name=f"body{i}",
            pos=full.body_pos[i],
            quat=full.body_quat[i],
            explicitinertial=True,
            mass=full.body_mass[i],
            ipos=full.body_ipos[i],
            iquat=full.body_iquat[i],
            inertia=full.body_inertia[i],
        )
        for joint in joints.get(i, []):
            _add_joint(body, full, joint)
    bare = spec.compile()
    _copy_options(full, bare)
    return bare


def _add_joint(body: Any, full: mujoco.MjModel, joint: int) -> None:
    dof, qpos = full.jnt_dofadr[joint], full.jnt_qposadr[joint]
    added = body.add_joint(
        name=full.joint(joint).name or f"joint{joint + 1}",
        type=mujoco.mjtJoint(int(full.jnt_type[joint])),
        axis=full.jnt_axis[joint],
        pos=full.jnt_pos[joint],
        ref=full.qpos0[qpos],
        springref=full.qpos_spring[qpos],
        armature=full.dof_armature[dof],
        frictionloss=full.dof_frictionloss[dof],
        solref_friction=full.dof_solref[dof],
        solimp_friction=full.dof_solimp[dof],
    )
    added.damping[0] = full.dof_damping[dof]
    added.stiffness[0] = full.jnt_stiffness[joint]


def _copy_options(full: mujoco.MjModel, bare: mujoco.MjModel) -> None:
    for option in (
        "timestep",
        "gravity",
        "impratio",
        "iterations",
        "ls_iterations",
        "tolerance",
        "ls_tolerance",
    ):
        setattr(bare.opt, option, getattr(full.opt, option))
    kinds = mujoco.mjtIntegrator
    runs_in_mjx = (kinds.mjINT_EULER, kinds.mjINT_RK4, kinds.mjINT_IMPLICITFAST)
    integrator = full.opt.integrator
    bare.opt.integrator = integrator if integrator in runs_in_mjx else kinds.mjINT_IMPLICITFAST
    bare.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    off = mujoco.mjtDisableBit
    bare.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE  # MuJoCo 4.0.0 factorises a sparse one wrongly
    bare.opt.disableflags = full.opt.disableflags | off.mjDSBL_CONTACT | off.mjDSBL_ACTUATION


def feedback_gains(
    measured: Float[np.ndarray, "time dof"],
) -> tuple[Float[np.ndarray, " dof"], Float[np.ndarray, " dof"]]:
    """Stiffness [N m/rad] and damping [N m s/rad] of the roll-outs, from the recorded torque alone.

    The largest torque of a joint answers to an error of 0.5 rad, and to a speed of 5 rad/s: too weak to
    hide a wrong model, enough to keep a good one near the motion. All joints get at least a thousandth of
    the largest gain.
    """
    largest = np.abs(measured).max(0)
    stiffness = np.maximum(largest, 1e-3 * largest.max()) / 0.5
    return stiffness, 0.1 * stiffness


def _prepared(recording: Recording, arm: Arm, cutoff: float) -> Signals:
    if recording.dof != arm.dof:
        raise InputError(f"{recording.name}: has {recording.dof} joints, but the model's arm has {arm.dof}")
    if recording.tau is None:
        raise InputError(f"{recording.name}: has no torque columns, so there is nothing to validate against")
    return prepare(recording, cutoff=cutoff)


def _states(motions: Sequence[Signals]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Recorded positions, velocities and accelerations, evenly picked."""
    q, qd, qdd = (
        np.concatenate([getattr(signals, channel)[signals.keep] for signals in motions])
        for channel in ("q", "qd", "qdd")
    )
    picked = np.unique(np.linspace(0, len(q) - 1, STATES).astype(int))
    return q[picked], qd[picked], qdd[picked]


def _difference(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.abs(one - other).max())


def _rms(x: Float[np.ndarray, "time dof"]) -> Float[np.ndarray, " dof"]:
    return np.sqrt(np.mean(x**2, axis=0))


def _relative(errors: np.ndarray, measured: np.ndarray) -> float:
    return float(100 * np.linalg.norm(errors) / np.linalg.norm(measured))


def _kernel_inverse(arm: Arm, q, qd, qdd) -> Float[np.ndarray, "time dof"]:
    smooth = dataclasses.replace(arm, frictionloss=jnp.zeros(arm.dof))
    return smooth.inverse_dynamics_of_many(q, qd, qdd)


@own_log()
def mujoco_inverse(source: MjcfSource, q, qd, qdd) -> Float[np.ndarray, "time dof"]:
    """`mj_inverse` of the user's whole model, gripper and scene included, with only smooth forces on."""
    model = _smooth(source.model)
    data = mujoco.MjData(model)
    dofs = [link.dof for link in source.links]
    tau = np.empty(q.shape)
    for i, row in enumerate(zip(source.qpos(q), source.qvel(qd), source.qvel(qdd), strict=True)):
        data.qpos, data.qvel, data.qacc = row
        mujoco.mj_inverse(model, data)
        tau[i] = data.qfrc_inverse[dofs]
    return tau


def _smooth(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy without constraints, and without the forces that no joint's torque feels."""
    model = copy.copy(model)
    off = mujoco.mjtDisableBit
    model.opt.disableflags |= off.mjDSBL_CONSTRAINT | off.mjDSBL_CONTACT | off.mjDSBL_ACTUATION
    model.opt.enableflags = 0
    model.opt.density = model.opt.viscosity = 0.0
    model.body_gravcomp[:] = 0
    return model


def mjx_package(model: mujoco.MjModel) -> tuple[Any, list[str]]:
    """The MJX package, or a note why the model cannot be checked in it."""
    try:
        with contextlib.redirect_stdout(None):  # it prints which backends it has not got
            from mujoco import mjx
    except ImportError as error:
        return None, [f"not checked in MJX, which cannot be imported ({error}): pip install mujoco-mjx"]
    try:
        assert_versions_belong_together(*(metadata.version(name) for name in ("mujoco", "mujoco-mjx")))
        assert_mjx_supported(model)
    except InputError as error:
        return None, [f"not checked in MJX: {error}"]
    return mjx, []


def assert_versions_belong_together(mujoco_version: str, mjx_version: str) -> None:
    """Refuse an MJX that is newer than MuJoCo, whose models it may not know how to read.

    Raises:
        InputError: with the command that mends it.
    """
    engine, mjx = (tuple(map(int, v.split(".")[:2])) for v in (mujoco_version, mjx_version))
    if mjx > engine:
        needed = ".".join(map(str, mjx))
        raise InputError(
            f"mujoco-mjx {mjx_version} needs MuJoCo {needed} or newer, and {mujoco_version} is installed:"
            f" pip install 'mujoco>={needed}'"
        )


def jit_mjx(function: Callable[..., Any]) -> Callable[..., Any]:
    """`jax.jit`, with what suits MJX on a CPU."""
    return jax.jit(function, compiler_options=options())


def _mjx_inverse(mjx: Any, bare: mujoco.MjModel, q, qd, qdd) -> Float[np.ndarray, "time dof"]:
    model = mjx.put_model(_smooth(bare))
    return np.asarray(_mjx_torque(mjx)(model, mjx.make_data(model), *map(jnp.asarray, (q, qd, qdd))))


@functools.cache
def _mjx_torque(mjx: Any) -> Callable[..., Any]:
    """Inverse dynamics of many states, for any model of a kind."""

    def torque(model: Any, blank: Any, q: Array, qd: Array, qdd: Array) -> Array:
        return mjx.inverse(model, blank.replace(qpos=q, qvel=qd, qacc=qdd)).qfrc_inverse

    return jit_mjx(jax.vmap(torque, in_axes=(None, None, 0, 0, 0)))


def torque_rmse(arm: Arm, recordings: Sequence[Recording], cutoff: float = 5.0) -> Float[np.ndarray, " dof"]:
    """Error of an arm's torque over some recordings, both sides low-passed alike, as `validate` has it [N m]."""
    errors = [_torque_error(arm, None, _prepared(r, arm, cutoff)) for r in recordings]
    return _rms(np.concatenate([e.measured - e.modelled for e in errors]))


def _torque_error(arm: Arm, friction: Friction | None, signals: Signals) -> TorqueError:
    assert signals.tau is not None
    tau = arm.inverse_dynamics_of_many(signals.q, signals.qd, signals.qdd)
    if friction is not None:
        tau = tau + np.asarray(friction.torque(jnp.asarray(signals.qd)))
    measured, modelled = signals.lowpass(signals.tau), signals.lowpass(tau)
    return TorqueError(
        name=signals.name,
        rmse=_rms(measured - modelled),
        relative_error_percent=_relative(measured - modelled, measured),
        times=signals.times,
        measured=measured,
        modelled=modelled,
    )


@dataclasses.dataclass(frozen=True)
class _Task:
    """A recorded motion on the simulator's time steps: where to go and the torque that went there."""

    q: Float[np.ndarray, "steps dof"]
    qd: Float[np.ndarray, "steps dof"]
    tau: Float[np.ndarray, "steps dof"]


def _task(signals: Signals, timestep: float) -> _Task:
    """Motion and torque low-passed alike, from where the filter's start-up is over."""
    assert signals.tau is not None
    q, qd, _ = derivatives(signals.q, signals.cutoff, signals.rate)
    tau = zero_phase(signals.tau, signals.cutoff, signals.rate)
    begin, end = signals.times[0], min(signals.times[-1], signals.times[0] + ROLLOUT_SECONDS)
    steps = begin + timestep * np.arange(int((end - begin) / timestep))
    onto = lambda x: scipy.interpolate.CubicSpline(signals.time, x)(steps)
    return _Task(onto(q), onto(qd), onto(tau))


@dataclasses.dataclass(frozen=True)
class _Feedback:
    r"""$u = \tau + K (q_r - q) + D (\dot q_r - \dot q)$, less friction that the model does not hold."""

    stiffness: Float[np.ndarray, " dof"]
    damping: Float[np.ndarray, " dof"]
    friction: Friction | None

    def __call__(self, q_r: Any, qd_r: Any, q: Any, qd: Any) -> Any:
        """The torque that feedback adds [N m]."""
        return self.stiffness * (q_r - q) + self.damping * (qd_r - qd)

    def resistance(self, qd: Float[Array, " dof"]) -> Float[Array, " dof"]:
        return jnp.zeros_like(qd) if self.friction is None else self.friction.torque(qd)


def _result(
    motions: Sequence[np.ndarray], feedback: Sequence[np.ndarray], tasks, seconds: float
) -> Rollout | None:
    """None where a motion ran away."""
    errors = np.concatenate([q - task.q for q, task in zip(motions, tasks, strict=True)])
    if not np.isfinite(errors).all():
        return None
    return Rollout(_rms(errors), _rms(np.concatenate(feedback)), seconds, tuple(motions))


def has_run_away(data: mujoco.MjData) -> bool:
    """Whether the last step met numbers that are no motion: MuJoCo would start over where it began, and go on."""
    bad = mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC
    return any(data.warning[int(one)].number for one in bad)


@own_log()
def _rollout_mujoco(bare: mujoco.MjModel, tasks: Sequence[_Task], law: _Feedback) -> Rollout | None:
    """The model under the recorded torque in C MuJoCo."""
    start = time.perf_counter()
    data = mujoco.MjData(bare)
    resistance = jax.jit(law.resistance)
    motions, feedback = [], []
    for task in tasks:
        mujoco.mj_resetData(bare, data)
        data.qpos, data.qvel = task.q[0], task.qd[0]
        q, added = np.empty(task.q.shape), np.empty(task.q.shape)
        for k in range(len(q)):
            q[k] = data.qpos
            added[k] = law(task.q[k], task.qd[k], data.qpos, data.qvel)
            friction = np.asarray(resistance(jnp.array(data.qvel)))
            data.qfrc_applied = task.tau[k] + added[k] - friction
            mujoco.mj_step(bare, data)
            if has_run_away(data):
                return None
        motions.append(q)
        feedback.append(added)
    return _result(motions, feedback, tasks, time.perf_counter() - start)


_CHUNK = 1000
"""Steps of MJX that are compiled as one, so that what was compiled serves motions of any length."""


def _rollout_mjx(mjx: Any, bare: mujoco.MjModel, tasks: Sequence[_Task], law: _Feedback) -> Rollout | None:
    """The same in MJX, compiled once for all recordings.

    The model's numbers are constants of what is compiled: as arguments they make a step three times as long, and
    steps of several roll-outs at once are longer still.
    """
    start = time.perf_counter()
    model = mjx.put_model(bare)
    blank = mjx.make_data(model)

    def step(data, task):
        q_r, qd_r, tau = task
        added = law(q_r, qd_r, data.qpos, data.qvel)
        applied = tau + added - law.resistance(data.qvel)
        return mjx.step(model, data.replace(qfrc_applied=applied)), (data.qpos, added)

    @jit_mjx
    def run(data, q, qd, tau):
        return jax.lax.scan(step, data, (q, qd, tau))

    # a motion is held at its end until a chunk is full, and what comes after it is dropped
    hold = lambda x: jnp.asarray(np.pad(x, ((0, -len(x) % _CHUNK), (0, 0)), mode="edge"))
    motions, feedback = [], []
    for task in tasks:
        q, qd, tau = (hold(x) for x in (task.q, task.qd, task.tau))
        # where MJX put the rest: arrays bound to a device and arrays that are not are compiled for apart
        data, parts = jax.device_put(blank.replace(qpos=q[0], qvel=qd[0]), blank.qpos.sharding), []
        for first in range(0, len(q), _CHUNK):
            here = slice(first, first + _CHUNK)
            data, part = run(data, q[here], qd[here], tau[here])
            parts.append(part)
        moved, added = (np.concatenate(x)[: len(task.q)] for x in zip(*parts, strict=True))
        motions.append(moved)
        feedback.append(added)
    return _result(motions, feedback, tasks, time.perf_counter() - start)


def _apart(one: Rollout | None, other: Rollout | None) -> float | None:
    if one is None or other is None:
        return None
    return max(_difference(a, b) for a, b in zip(one.q, other.q, strict=True))
