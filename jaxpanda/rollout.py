r"""Replay a recording in simulation: under the recorded torque, where does the model go?

The loop is that of `validate`. The model gets the recorded torque and weak feedback about the recorded motion,

$$u = \tau_r + K (q_r - q_s) + D (\dot q_r - \dot q),$$

with gains from the recording and the user's arm, weak, so that what is missing from a model shows as a motion
that leaves the recorded one, and the same for both models. What the diagnosis found acts in three places:

- What MuJoCo's attributes hold is in the model: numbers of joints and links, gravity.
- Laws on the joints are forces: `qfrc_applied` less the law's torque, and dry friction as `dof_damping`,
  set anew at every step, $F(\dot q)/\dot q$, which the engine takes implicitly: stable at any step, it sticks to
  within the law's own creep, and needs nothing that MJX drops. A law takes over the `frictionloss` of its joint.
- Sensors are no part of the plant. Torque sensors are undone on the recorded torque before the roll-out, and put
  back on what it gives; position sensors (an offset, the spring or the gap between sensor and link) show
  $q_s = q + \delta$, and feedback acts on that.

Both engines step the same compiled function; C MuJoCo in a Python loop, MJX in a `lax.scan` that can be `vmap`ped
and differentiated in any number of the `Plant`.
"""

import copy
import dataclasses
import time as clock
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import scipy.interpolate
from jaxtyping import Array, Float

from .arms.arm import Arm
from .arms.export import dry_friction
from .arms.mjcf import (
    MjcfSource,
    com_from_standard,
    has_own_friction_law,
    move_standard,
    own_log,
    standard_from_com,
)
from .arms.model_file import Model
from .arms.source import file_with, from_mjcf
from .corrected import XML, Corrected, Plant, read
from .effects import AbstractEffect, masses, slopes
from .effects.effect import EVER
from .errors import InputError, require_x64
from .recordings import Recording
from .recordings import load as load_recording
from .signals import derivatives, prepare, zero_phase
from .validation import (
    arm_model,
    assert_mjx_supported,
    feedback_gains,
    has_run_away,
    jit_mjx,
    mjx_package,
)

CUTOFF = 20.0
"""Low-pass of motion and torque, recorded and simulated, at most [Hz]."""
SECONDS = 10.0
"""Length of a replay, at most, unless asked for otherwise."""

Engine = Literal["mujoco", "mjx"]


class Task(eqx.Module):
    """A recorded motion on the simulator's time steps, or one step of it; the torque is the true one."""

    time: Float[Array, "*steps"]
    """By the recording's clock [s]."""
    q: Float[Array, "*steps dof"]
    qd: Float[Array, "*steps dof"]
    tau: Float[Array, "*steps dof"]


class Gains(eqx.Module):
    """Of the feedback about the recorded motion."""

    stiffness: Float[Array, " dof"]
    """[N m/rad]"""
    damping: Float[Array, " dof"]
    """[N m s/rad]"""


@dataclasses.dataclass(frozen=True)
class Replay:
    """What a simulation made of a recording, on the simulator's time steps."""

    name: str
    engine: str
    time: Float[np.ndarray, " steps"]
    """By the recording's clock [s]."""
    q: Float[np.ndarray, "steps dof"]
    """What the position sensors would show [rad]."""
    qd: Float[np.ndarray, "steps dof"]
    """Its derivative [rad/s], low-passed like the recorded one."""
    tau: Float[np.ndarray, "steps dof"]
    """What the torque sensors would show [N m]."""
    feedback: Float[np.ndarray, "steps dof"]
    """Torque that feedback added [N m]."""
    q_recorded: Float[np.ndarray, "steps dof"]
    qd_recorded: Float[np.ndarray, "steps dof"]
    tau_recorded: Float[np.ndarray, "steps dof"]
    seconds: float
    """Of computation, compilation included."""

    @property
    def rmse(self) -> Float[np.ndarray, " dof"]:
        """Of the position [rad]."""
        return _rms(self.q - self.q_recorded)

    @property
    def rmse_velocity(self) -> Float[np.ndarray, " dof"]:
        """[rad/s]"""
        return _rms(self.qd - self.qd_recorded)

    @property
    def feedback_rms(self) -> Float[np.ndarray, " dof"]:
        """The model's error as the simulator felt it [N m]."""
        return _rms(self.feedback)


def replay(
    diagnosis: str | Path | Corrected,
    recording: str | Path | Recording,
    *,
    model: Model | MjcfSource | None = None,
    engine: Engine = "mujoco",
    seconds: float = SECONDS,
    start: float | None = None,
    effects: Sequence[type[AbstractEffect]] = (),
) -> Replay:
    """Replay a recording in the corrected simulation.

    Args:
        diagnosis: the folder that `diagnose` wrote, or the corrected arm.
        recording: with torque; that of the motors moves the arm where both were measured. What the diagnosis saw
            happen in a recording of this name, a contact or a change of payload, happens in the replay.
        model: MJCF of the arm, the user's or the corrected one; where a folder is given, its `corrected.xml`.
        engine: "mujoco" is C MuJoCo, "mjx" is MJX.
        seconds: length, at most.
        start: of the replay, by the recording's clock [s]; by default such that what happened in the recording is
            in it, or its beginning.
        effects: classes of your own that `diagnose` was given, where `diagnosis` is a folder.

    Raises:
        InputError: no diagnosis or model, a recording that does not fit, or a motion that ran away.
    """
    require_x64("a replay")
    corrected, source = _opened(diagnosis, model, effects)
    recording = recording if isinstance(recording, Recording) else load_recording(recording)
    recording.require_dof(corrected.arm.dof)
    recording.require_tau()
    if recording.tau_motor is not None:
        recording = recording.of_motor_side()
    plant = corrected.plant(_called(corrected, recording))
    bare = engine_model(source, plant.arm)
    task = make_task(
        recording, bare.opt.timestep, plant, seconds, _begin(plant, seconds) if start is None else start
    )
    gains = stable(make_gains(recording, corrected.arm), recording, plant.arm, bare.opt.timestep)
    return _replay(bare, plant, task, gains, recording.name, engine)


def compare(
    corrected: Corrected, source: Model | MjcfSource, recording: Recording, *, seconds: float = SECONDS
) -> dict[str, Any]:
    """The user's simulation and the corrected one replay a recording in C MuJoCo, under the same feedback.

    Args:
        corrected: the corrected arm.
        source: MJCF of the arm as the user has it.
        recording: with torque.
        seconds: length, at most.

    Returns:
        Numbers a joint, before and after: `rmse_rad_…`, `rmse_rad_per_s_…`, `feedback_rms_…` [N m]; null where
        a simulation ran away. With them the recording, the window [s] and the gains.
    """
    require_x64("a replay")
    arm, source = corrected.arm, _source(source)
    plants = [Plant.of(arm, arm, ()), corrected.plant(_called(corrected, recording))]
    gains, start = make_gains(recording, corrected.arm), _begin(plants[1], seconds)
    for plant in plants:
        gains = stable(gains, recording, plant.arm, engine_model(source, plant.arm).opt.timestep)
    out: dict[str, Any] = {"recording": recording.name}
    for when, plant in zip(("before", "after"), plants, strict=True):
        bare = engine_model(source, plant.arm)
        task = make_task(recording, bare.opt.timestep, plant, seconds, start)
        out["window"] = [float(task.time[0]), float(task.time[-1])]
        try:
            done = _replay(bare, plant, task, gains, recording.name, "mujoco")
        except InputError:
            done = None
        figures = None if done is None else (done.rmse, done.rmse_velocity, done.feedback_rms)
        for k, name in enumerate(("rmse_rad", "rmse_rad_per_s", "feedback_rms")):
            out[f"{name}_{when}"] = None if figures is None else figures[k].tolist()
    out["stiffness"], out["damping"] = (
        np.asarray(gains.stiffness).tolist(),
        np.asarray(gains.damping).tolist(),
    )
    return out


def compare_files(
    diagnosis: str | Path, model: Model, recording: str | Path, *, seconds: float = SECONDS
) -> dict[str, Any]:
    """`compare`, from the folder that `diagnose` wrote, the user's MJCF and a recording."""
    corrected, source = _opened(diagnosis, model)
    return compare(corrected, source, load_recording(recording), seconds=seconds)


def _called(corrected: Corrected, recording: Recording) -> str:
    """The recording's name, with the folders that the diagnosis may have put before it."""
    if recording.path is None:
        return recording.name
    parts = (*recording.path.resolve().parts[:-1], recording.name)
    names = [name for e in corrected.effects for name in e.recordings]
    return next(
        (name for name in names if parts[-len(Path(name).parts) :] == Path(name).parts), recording.name
    )


@own_log()
def engine_model(source: Model | MjcfSource, arm: Arm) -> mujoco.MjModel:
    """The arm of a file, stripped for a roll-out, with the numbers of `arm` in it.

    Integrated by `implicitfast`, which both engines have and which takes damping implicitly.
    """
    source = _source(source)
    bare = arm_model(source)
    off = mujoco.mjtDisableBit
    bare.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    bare.opt.disableflags &= ~int(
        off.mjDSBL_SPRING | off.mjDSBL_DAMPER | off.mjDSBL_FRICTIONLOSS | off.mjDSBL_GRAVITY
    )
    bare.opt.gravity = np.asarray(arm.chain.gravity)
    level = np.asarray(arm.frictionloss)
    own = np.array([has_own_friction_law(bare, j) for j in range(bare.nv)])
    for j in np.flatnonzero(~np.isclose(level, bare.dof_frictionloss) & (level > 0) & ~own):
        for text, place in zip(
            dry_friction(bare.opt.timestep).values(), (bare.dof_solref, bare.dof_solimp), strict=True
        ):
            numbers = [float(v) for v in text.split()]
            place[j, : len(numbers)] = numbers
    bare.dof_frictionloss[:] = np.maximum(level, 0.0)
    bare.dof_damping[:] = np.asarray(arm.damping)
    bare.dof_armature[:] = np.asarray(arm.armature)
    bare.jnt_stiffness[:] = np.asarray(arm.stiffness)
    bare.qpos_spring[:] = np.asarray(arm.springref)
    for link, change in zip(source.links, np.asarray(arm.standard) - source.standard, strict=True):
        if np.any(change):
            body = mujoco.mj_name2id(bare, mujoco.mjtObj.mjOBJ_BODY, f"body{link.body_id}")
            _add_inertia(bare, body, move_standard(change, link.R, link.p))
    # MuJoCo skips the offset of a centre of mass or the turn of its axes where the compiler found none
    bare.body_simple[:] = 0
    bare.body_sameframe[:] = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)
    mujoco.mj_setConst(bare, mujoco.MjData(bare))
    return bare


def _add_inertia(model: mujoco.MjModel, body: int, change: Float[np.ndarray, "10"]) -> None:
    """Add standard parameters in the body's frame; the sum need not be one that MuJoCo's compiler would take."""
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[body])
    R = axes.reshape(3, 3)
    own = standard_from_com(
        float(model.body_mass[body]), model.body_ipos[body], R @ np.diag(model.body_inertia[body]) @ R.T
    )
    mass, com, I_com = com_from_standard(own + change)
    if mass <= 0:
        raise InputError(f"a link would weigh {mass:.4g} kg: such an arm cannot be simulated")
    moments, R = np.linalg.eigh(I_com)
    R[:, 0] *= np.linalg.det(R)
    model.body_mass[body], model.body_ipos[body], model.body_inertia[body] = mass, com, moments
    mujoco.mju_mat2Quat(model.body_iquat[body], R.ravel())


def make_task(recording: Recording, timestep: float, plant: Plant, seconds: float, start: float) -> Task:
    """A recording on time steps, filtered alike, with what `plant` says of the torque sensors undone."""
    signals = prepare(recording, cutoff=min(CUTOFF, 0.2 * recording.rate))
    assert signals.tau is not None
    tau = np.asarray(plant.true(jnp.asarray(signals.time), jnp.asarray(signals.tau)))
    q, qd, _ = derivatives(signals.q, signals.cutoff, signals.rate)
    tau = zero_phase(tau, signals.cutoff, signals.rate)
    first, last = signals.times[0], signals.times[-1]
    first = float(np.clip(start, first, max(first, last - seconds)))
    steps = first + timestep * np.arange(int((min(last, first + seconds) - first) / timestep))
    onto = lambda x: jnp.asarray(scipy.interpolate.CubicSpline(signals.time, x)(steps))
    return Task(jnp.asarray(steps), onto(q), onto(qd), onto(tau))


def _begin(plant: Plant, seconds: float) -> float:
    """Start of a window in which what happened in the recording happens [s]."""
    edges = [float(v) for e, _ in plant.laws if e.is_event for v in (e.start, e.stop)]  # pyright: ignore
    edges = [v for v in edges if np.isfinite(v) and abs(v) < EVER]
    return 0.5 * (min(edges) + max(edges)) - 0.5 * seconds if edges else -np.inf


def make_gains(recording: Recording, arm: Arm) -> Gains:
    r"""Feedback that any model of the arm is compared under: that of `validate`, made to hold the arm up.

    The stiffness of `feedback_gains`, and what gravity takes off it in any pose of the motion, by Gershgorin's
    circles of the derivative of the torque at rest: else an arm that leans over falls, whatever its model is
    worth. Damping is a tenth of the stiffness, or half the critical one if that is more. `arm` is the user's for
    both models.
    """
    assert recording.tau is not None
    own = feedback_gains(recording.tau)[0]
    poses = recording.q[np.linspace(0, recording.samples - 1, 64).astype(int)]
    rest = np.zeros_like(poses)
    slope, inertia = slopes(arm, poses, rest, rest), np.diagonal(masses(arm, poses), axis1=1, axis2=2)
    diagonal = np.diagonal(slope, axis1=1, axis2=2)
    weakest = np.abs(slope).sum(2) - np.abs(diagonal) - diagonal
    stiffness = own + np.maximum(weakest.max(0), 0.0)
    damping = np.maximum(0.1 * stiffness, np.sqrt(stiffness * inertia.max(0)))
    return Gains(jnp.asarray(stiffness), jnp.asarray(damping))


def stable(gains: Gains, recording: Recording, arm: Arm, dt: float) -> Gains:
    r"""The gains with as much damping at most as an explicit step of so many seconds bears with this arm.

    $h\,\lambda_{max}(M^{-1} D) \le h \sum_j D_j (M^{-1})_{jj}$ is kept below one in any pose of the motion: links
    that a short recording has not told well may be light about some axis, and the feedback would shake them.
    """
    poses = recording.q[np.linspace(0, recording.samples - 1, 64).astype(int)]
    mobility = np.diagonal(np.linalg.inv(masses(arm, poses)), axis1=1, axis2=2).max(0)
    return Gains(gains.stiffness, jnp.minimum(gains.damping, 1 / (arm.dof * dt * jnp.asarray(mobility))))


def _opened(
    diagnosis: str | Path | Corrected,
    model: Model | MjcfSource | None,
    effects: Sequence[type[AbstractEffect]] = (),
) -> tuple[Corrected, MjcfSource]:
    if isinstance(diagnosis, Corrected):
        if model is None:
            raise InputError("a replay of a corrected arm needs the MJCF of the arm: give model=")
        corrected = diagnosis
    else:
        corrected = read(diagnosis, effects)[0]
        model = file_with(corrected.arm, Path(diagnosis) / XML) if model is None else model
    return corrected, _source(model)


def _source(model: Model | MjcfSource) -> MjcfSource:
    return model if isinstance(model, MjcfSource) else from_mjcf(model)[1]


def control(
    plant: Plant, gains: Gains, dt: float, carry: Any, now: Task, q: Array, qd: Array
) -> tuple[Any, tuple[Array, ...]]:
    """One time step outside of the engine.

    Args:
        plant: that moves.
        gains: of the feedback.
        dt: time step [s].
        carry: hidden states, velocity and transmitted torque of the step before.
        now: one row of the task.
        q: of the engine [rad].
        qd: of the engine [rad/s].

    Returns:
        The next carry; and `qfrc_applied`, `dof_damping`, what the position sensors show, the transmitted torque
        and the feedback in it.
    """
    laws, positions, before, tau = carry
    ahead, positions = plant.shift(positions, now.time, q, qd, tau, dt)
    shown = q + ahead
    added = gains.stiffness * (now.q - shown) + gains.damping * (now.qd - qd)
    tau = now.tau + added
    qdd = (qd - before) / dt
    if plant.feels("acceleration"):
        qdd = plant.acceleration(laws, now.time, q, qd, tau, dt, qdd, implicit=True)
    torque, damping, laws = plant.resist(laws, now.time, q, qd, qdd, dt)
    return (laws, positions, qd, tau), (tau - torque, plant.arm.damping + damping, shown, tau, added)


def at_start(plant: Plant, task: Task, dt: float) -> tuple[Any, Array, Array]:
    """Carry, q and qd of an arm whose sensors show the first row of the task."""
    q, qd, tau = task.q[0], task.qd[0], task.tau[0]
    laws, positions = plant.begin(task.time[0], q, qd, tau)
    q = q - plant.shift(positions, task.time[0], q, qd, tau, dt)[0]
    return (laws, positions, qd, tau), q, qd


def mjx_rollout(model: mujoco.MjModel) -> Callable[[Plant, Gains, Task], tuple[Array, ...]]:
    """The roll-out in MJX as a function of plant, gains and task: to be jitted, vmapped, differentiated.

    It gives, a row a step, what the position sensors show [rad], the transmitted torque and its feedback [N m].

    Raises:
        InputError: the model holds what MJX would silently ignore, or MJX is not installed.
    """
    assert_mjx_supported(model)
    mjx, notes = mjx_package(model)
    if mjx is None:
        raise InputError(notes[0])
    compiled = mjx.put_model(model)
    blank = mjx.make_data(compiled)
    dt = float(model.opt.timestep)

    def run(plant: Plant, gains: Gains, task: Task) -> tuple[Array, ...]:
        carry, q, qd = at_start(plant, task, dt)

        def step(state, now):
            carry, data = state
            carry, (applied, damping, *seen) = control(plant, gains, dt, carry, now, data.qpos, data.qvel)
            data = mjx.step(compiled.replace(dof_damping=damping), data.replace(qfrc_applied=applied))
            return (carry, data), tuple(seen)

        return jax.lax.scan(step, (carry, blank.replace(qpos=q, qvel=qd)), task)[1]

    return run


def _in_mjx(bare: mujoco.MjModel, plant: Plant, gains: Gains, task: Task) -> tuple[np.ndarray, ...]:
    numbers, rest = eqx.partition(jax.tree.map(_as_array, (plant, gains, task)), eqx.is_array)
    run = mjx_rollout(bare)
    jitted = jit_mjx(lambda numbers: run(*eqx.combine(numbers, rest)))
    return tuple(np.asarray(x) for x in jitted(numbers))


@own_log()
def in_mujoco(bare: mujoco.MjModel, plant: Plant, gains: Gains, task: Task) -> tuple[np.ndarray, ...]:
    """C MuJoCo, step by step."""
    model, dt = copy.copy(bare), float(bare.opt.timestep)
    data = mujoco.MjData(model)
    plant, gains = jax.tree.map(_as_array, (plant, gains))
    carry, q, qd = eqx.filter_jit(at_start)(plant, task, dt)
    data.qpos, data.qvel = np.asarray(q), np.asarray(qd)
    times, motion, speed, torque = (np.asarray(x) for x in (task.time, task.q, task.qd, task.tau))
    shown, tau, added = (np.empty(motion.shape) for _ in range(3))
    if not plant.laws and not plant.positions:
        stiffness, damping = np.asarray(gains.stiffness), np.asarray(gains.damping)
        for k in range(len(times)):
            shown[k] = data.qpos
            added[k] = stiffness * (motion[k] - data.qpos) + damping * (speed[k] - data.qvel)
            tau[k] = data.qfrc_applied = torque[k] + added[k]
            mujoco.mj_step(model, data)
            if has_run_away(data):
                shown[k:] = np.nan
                break
        return shown, tau, added
    leaves, shape = jax.tree.flatten((plant, gains))
    rows = np.concatenate([times[:, None], motion, speed, torque], 1)
    for k in range(len(times)):
        carry, out = _packed(leaves, carry, rows[k], data.qpos, data.qvel, shape=shape, dt=dt)
        data.qfrc_applied, model.dof_damping[:], shown[k], tau[k], added[k] = np.asarray(out)
        mujoco.mj_step(model, data)
        if has_run_away(data):
            shown[k:] = np.nan
            break
    return shown, tau, added


def _step(leaves, carry, row, q, qd, *, shape, dt):
    plant, gains = jax.tree.unflatten(shape, leaves)
    dof = q.shape[0]
    now = Task(row[0], row[1 : dof + 1], row[dof + 1 : 2 * dof + 1], row[2 * dof + 1 :])
    carry, out = control(plant, gains, dt, carry, now, q, qd)
    return carry, jnp.stack(out)


_packed = jax.jit(_step, static_argnames=("shape", "dt"))


def _as_array(leaf: Any) -> Any:
    return jnp.asarray(leaf) if isinstance(leaf, bool | int | float) else leaf


def _replay(
    bare: mujoco.MjModel, plant: Plant, task: Task, gains: Gains, name: str, engine: Engine
) -> Replay:
    begin = clock.perf_counter()
    run = {"mujoco": in_mujoco, "mjx": _in_mjx}.get(engine)
    if run is None:
        raise InputError(f"unknown engine {engine!r}; there are mujoco, mjx")
    shown, tau, added = run(bare, plant, gains, task)
    if not (np.isfinite(shown).all() and np.isfinite(tau).all()):
        raise InputError(f"{name}: the simulation ran away from the recorded motion")
    rate = 1 / float(bare.opt.timestep)
    q, qd, _ = derivatives(shown, min(CUTOFF, 0.2 * rate), rate)
    return Replay(
        name,
        engine,
        np.asarray(task.time),
        q,
        qd,
        np.asarray(plant.sensed(task.time, jnp.asarray(tau))),
        added,
        np.asarray(task.q),
        np.asarray(task.qd),
        np.asarray(plant.sensed(task.time, task.tau)),
        clock.perf_counter() - begin,
    )


def _rms(x: Float[np.ndarray, "time dof"]) -> Float[np.ndarray, " dof"]:
    return np.sqrt(np.mean(x**2, axis=0))
