"""From an arm to a motion that tells its parameters: designed in JAX, checked in MuJoCo's C engine."""

import copy
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from ..arms.arm import Arm
from ..arms.export import panda_mjcf
from ..arms.markup import parse
from ..arms.mjcf import MjcfSource
from ..arms.model_file import Model
from ..arms.source import from_document, from_mjcf
from ..errors import InputError, require_x64
from ..friction import LINEAR
from ..identification import Identification
from ..parameters import Base, arm_base_parameters
from ..simulation import FourierTrajectory
from ..workspace.limits import Limits, limits_of
from ..workspace.scene import CLEARANCE, Closest, Scene, probes_of, reach_of, scene_of
from .design import FRICTION, Criterion, Fourier, Task, friction_columns, gram, rows, solve, starts
from .result import Check, Excitation, Precision

CUTOFF = 5.0
"""Of the low-pass in `identify` [Hz]: two independent samples a period of it."""
NOISE = 0.0025
"""Torque noise where nothing is known of it, as a share of the torque limit."""
_UNLIMITED_NOISE = 0.1
"""Where there is no torque limit either [N m]."""
_RATE = 1000.0
"""At which a motion is checked [Hz]."""
_ATTEMPTS = 3
"""Times that a motion is sought with more clearance than the time before."""
_MORE = 0.02
"""By so much [m]."""
_SMALLER, _TRIES = 0.99, 15
"""Factor on a motion that is a little beyond a limit between the samples it was sought at, and how often."""
_LEAST_SECONDS = 2.0
_UNTOLD = 0.01
"""Share of a parameter's information that is there for numerics only, from which nothing tells it."""


def excite(
    model: Model | None = None,
    *,
    seconds: float = 20.0,
    rate: float = 1000.0,
    highest_frequency: float = 0.5,
    criterion: Criterion = "logdet",
    identification: str | Path | Identification | None = None,
    limits: Mapping[str, Sequence[float]] | None = None,
    torque_noise: Sequence[float] = (),
    share: float = 0.9,
    margin: float = 0.05,
    clearance: float = CLEARANCE,
    floor: float | None = 0.0,
    collisions: bool = True,
    count: int = 8,
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Excitation:
    """A periodic motion that tells the arm's base parameters and friction best, and that the arm can do.

    Args:
        model: MJCF of the arm, perhaps in its scene; None for the project's own Panda.
        seconds: length of the motion, which is its period: it starts and ends at rest, so can be repeated.
        rate: of the CSV [Hz].
        highest_frequency: of the motion [Hz].
        criterion: `logdet`, the mean logarithm of the parameters' standard deviations; or `condition`, the
            condition number of the regressor with friction columns, joints weighted by their torque noise.
        identification: what an earlier run of `identify` knows already. The new motion asks for the rest; its
            residuals are taken as the torque noise.
        limits: velocity, acceleration, jerk, torque: one number for all joints or one a joint, SI units.
        torque_noise: rms of what a fit leaves of torque below 5 Hz, one number or one a joint [N m].
        share: of these limits that the motion may use.
        margin: to the ends of joint ranges [rad, m].
        clearance: to keep from itself, the floor and the scene [m].
        floor: height of the floor where the file has none [m]; None for no floor.
        collisions: False to leave them out.
        count: random motions to start from.
        seed: of those.
        progress: called with (rounds done, rounds).

    Raises:
        InputError: bad options, a scene that cannot be read, or no motion that keeps all limits.
    """
    require_x64("a motion's design")
    _check(seconds, rate, highest_frequency, clearance, count)
    if model is None:
        arm, source = from_document(parse(panda_mjcf(), "mujoco", Path("panda.xml")))
    else:
        arm, source = from_mjcf(model)
    base = arm_base_parameters(arm)
    everything = limits_of(arm, source, limits or {})
    within = everything.within(margin, share)
    earlier = identification
    if earlier is not None and not isinstance(earlier, Identification):
        earlier = Identification.load(earlier)
    sigma, said = _noise(everything, torque_noise, earlier)
    prior = np.zeros((base.rank + arm.dof * len(LINEAR[FRICTION]),) * 2)
    notes = [*source.notes, said]
    if earlier is not None:
        prior, more = _known(earlier, base, arm)
        notes += more
    scene = scene_of(arm, source, clearance, floor, collisions=collisions)
    notes += scene.notes
    fourier = Fourier(seconds, max(3, round(highest_frequency * seconds)))
    task = Task(
        arm,
        base,
        within,
        probes_of(scene, arm),
        fourier,
        sigma,
        2 * CUTOFF * seconds,
        prior + _weak(sigma, 2 * CUTOFF * seconds) * np.eye(len(prior)),
        criterion,
    )
    first = starts(task, count, seed)
    failed: list[str] = []
    for attempt in range(_ATTEMPTS):
        found = solve(task, first, tick=progress)
        for k in np.argsort(found.f + 10 * np.maximum(found.violation, 0)).tolist():
            q = {name: np.asarray(value[k]) for name, value in found.x.items()}
            trajectory = _fitted(scene, task, fourier.trajectory(q["x"], q["q0"]))
            if isinstance(trajectory, str):
                failed.append(trajectory)
                continue
            check = verify(scene, arm, within, trajectory)
            if check.failed:
                failed.append(check.failed)
                continue
            precision = precision_of(task, trajectory)
            before = precision_of(task, None) if earlier is not None else None
            return Excitation(
                arm=arm,
                model_file="" if model is None else str(model),
                trajectory=trajectory,
                seconds=seconds,
                rate=rate,
                criterion=criterion,
                base=base,
                sigma=sigma,
                precision=precision,
                before=before,
                limits=everything,
                share=share,
                margin=margin,
                clearance=clearance,
                check=check,
                found=found,
                chosen=k,
                seed=seed,
                notes=tuple(notes),
            )
        first = found.x
        task = dataclasses.replace(task, probes=probes_of(scene, arm, (attempt + 1) * _MORE))
    why = next((one for one in failed if "come within" in one), failed[-1])
    raise InputError(
        f"excite: none of {count} starts became a motion that keeps all limits ({why}); more --starts, "
        "a smaller --clearance or --margin, or another --seed may help"
    )


def _check(seconds: float, rate: float, highest: float, clearance: float, count: int) -> None:
    for flag, value, least, what in (
        ("--seconds", seconds, _LEAST_SECONDS, "s or more"),
        ("--rate", rate, 10.0, "Hz or more"),
        ("--starts", count, 1, "or more"),
        ("--clearance", clearance, 0.0, "m or more"),
    ):
        if not np.isfinite(value) or value < least:
            raise InputError(f"{flag}: {value:g}, where {least:g} {what} is expected")
    if not 0 < highest <= CUTOFF:
        raise InputError(
            f"--highest-frequency: {highest:g} Hz; above 0 and up to {CUTOFF:g} Hz, where `identify` cuts off, "
            "is expected"
        )
    if abs(seconds * rate - round(seconds * rate)) > 1e-6:
        raise InputError(f"--rate: {rate:g} Hz gives no whole number of samples in {seconds:g} s")


def _noise(
    limits: Limits, given: Sequence[float], earlier: Identification | None
) -> tuple[Float[np.ndarray, " dof"], str]:
    """Torque noise of each joint [N m], and a sentence on where it is from."""
    dof = len(limits.torque)
    if len(given):
        if len(given) not in (1, dof) or not all(np.isfinite(v) and v > 0 for v in given):
            raise InputError(f"--torque-noise: one positive number for all joints or {dof} are expected")
        return np.broadcast_to(np.array(given, float), dof).copy(), "torque noise as given"
    if earlier is not None and earlier.rmse is not None and np.all(np.asarray(earlier.rmse) > 0):
        factor = _inflation(earlier)
        return factor * np.asarray(earlier.rmse), (
            f"torque noise is what the identification left at each joint, times {factor:.2g}, by which its "
            "deviations exceed the textbook's"
        )
    sigma = np.where(np.isfinite(limits.torque), NOISE * limits.torque, _UNLIMITED_NOISE)
    return sigma, (
        f"torque noise is taken as {100 * NOISE:g} % of each joint's torque limit ({_UNLIMITED_NOISE:g} N m "
        "without one); --torque-noise or --identification says better"
    )


def _inflation(earlier: Identification) -> float:
    """By how much deviations that know of correlated residuals exceed the textbook's."""
    if earlier.std is None or earlier.classical_std is None:
        return 1.0
    ratio = np.asarray(earlier.std) / np.asarray(earlier.classical_std)
    ratio = ratio[np.isfinite(ratio)]
    return float(max(1.0, np.median(ratio))) if len(ratio) else 1.0


def _known(
    earlier: Identification, base: Base, arm: Arm
) -> tuple[Float[np.ndarray, "columns columns"], list[str]]:
    """Information that an earlier identification holds on the arm's base parameters and friction.

    Its base may be smaller than the arm's; what it does not tell has no information.
    """
    if earlier.dof != arm.dof:
        raise InputError(f"--identification: of {earlier.dof} joints, where the arm has {arm.dof}")
    shares = np.linalg.lstsq(base.projection.T, earlier.projection.T, rcond=None)[0].T
    if not np.allclose(shares @ base.projection, earlier.projection, atol=1e-6):
        raise InputError(
            "--identification: its coefficients are not of this arm; give the model it was made with"
        )
    factor = _inflation(earlier)
    if earlier.classical_covariance is not None:
        covariance = factor**2 * np.asarray(earlier.classical_covariance)
    elif earlier.std is not None:
        covariance = np.diag(np.asarray(earlier.std) ** 2)
    else:
        raise InputError("--identification: has no standard deviations, so it tells nothing to start from")
    kept = np.isfinite(np.diag(covariance)) & (np.diag(covariance) > 0)
    inverse = np.linalg.pinv(covariance[np.ix_(kept, kept)], hermitian=True)
    own = len(LINEAR[FRICTION])
    columns = base.rank + arm.dof * own
    information = np.zeros((columns, columns))
    information[: base.rank, : base.rank] = shares[kept].T @ inverse @ shares[kept]
    notes = [f"the motion adds to {', '.join(earlier.recordings) or 'what the identification knows'}"]
    if earlier.friction is not None and earlier.friction.std is not None:
        for k, name in enumerate(LINEAR[FRICTION]):
            std = earlier.friction.std.get(name)
            if std is not None:
                at = base.rank + own * np.arange(arm.dof) + k
                told = np.isfinite(std) & (np.asarray(std) > 0)
                information[at[told], at[told]] = np.asarray(std)[told] ** -2.0
    return information, notes


def _weak(sigma: Float[np.ndarray, " dof"], independent: float) -> float:
    """Next to no information on a parameter: keeps a joint that hardly moves from being infinitely bad."""
    return 1e-9 * float(np.mean(sigma**-2.0)) * independent


def _fitted(scene: Scene, task: Task, trajectory: FourierTrajectory) -> FourierTrajectory | str:
    """The motion made a little smaller until it keeps the limits at the full rate, too; else what it breaks."""
    factor = 1.0
    said = ""
    for _ in range(_TRIES):
        smaller = dataclasses.replace(trajectory, a=factor * trajectory.a, b=factor * trajectory.b)
        check = _peaks(scene, task.arm, task.limits, smaller)
        if not (said := check.failed):
            return smaller
        factor *= _SMALLER
    return said


def verify(scene: Scene, arm: Arm, limits: Limits, trajectory: FourierTrajectory) -> Check:
    """Every limit and distance of a motion at 1 kHz; torque and distances by MuJoCo's C engine."""
    check = _peaks(scene, arm, limits, trajectory)
    if not scene.pairs:
        return check
    time, q, qd, _, _ = _states(trajectory)
    speed = 2 * float(np.abs(qd).sum(1).max()) * reach_of(arm)
    closest = scene.closest(time, q, speed)
    failed = check.failed
    if closest.distance < scene.clearance:
        failed = failed or (
            f"{closest.pair} come within {closest.distance:.3f} m at {closest.time:.2f} s, where "
            f"{scene.clearance:g} m is kept"
        )
    return dataclasses.replace(check, closest=closest, failed=failed)


def _states(
    trajectory: FourierTrajectory,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Time, position, velocity, acceleration and jerk at the rate of the check, over one period."""
    period = 2 * np.pi / trajectory.w
    time = np.linspace(0, period, round(period * _RATE) + 1)
    lw = trajectory.w * np.arange(1, trajectory.a.shape[1] + 1)
    s, c = np.sin(time[:, None] * lw), np.cos(time[:, None] * lw)
    return time, *trajectory(time), -c @ (trajectory.a * lw**2).T - s @ (trajectory.b * lw**2).T


def _peaks(scene: Scene, arm: Arm, limits: Limits, trajectory: FourierTrajectory) -> Check:
    """Without distances."""
    time, q, qd, qdd, jerk = _states(trajectory)
    tau = _torque(scene.source, arm, q, qd, qdd)
    peaks = {
        "velocity": np.abs(qd).max(0),
        "acceleration": np.abs(qdd).max(0),
        "jerk": np.abs(jerk).max(0),
        "torque": np.abs(tau).max(0),
    }
    low, high = q.min(0), q.max(0)
    failed = ""
    names = arm.joint_names
    for j in np.flatnonzero((low < limits.lower) | (high > limits.upper)):
        failed = failed or f"{names[j]} leaves its range"
    for name, values in peaks.items():
        for j in np.flatnonzero(values > getattr(limits, name)):
            failed = (
                failed or f"the {name} of {names[j]} is {values[j]:.3g} of {getattr(limits, name)[j]:.3g}"
            )
    lw = trajectory.w * np.arange(1, trajectory.a.shape[1] + 1)
    size = np.hypot(trajectory.a, trajectory.b)
    step = float(time[1] - time[0])
    return Check(low, high, peaks, step**2 / 8 * (size @ lw), Closest(np.inf, "", 0.0), failed)


def _torque(
    source: MjcfSource, arm: Arm, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray
) -> Float[np.ndarray, "time dof"]:
    """Inverse dynamics by MuJoCo, and the dry friction that the file has, as MuJoCo softens that [N m]."""
    model = copy.copy(source.model)
    off = mujoco.mjtDisableBit
    model.opt.disableflags |= off.mjDSBL_CONSTRAINT | off.mjDSBL_CONTACT | off.mjDSBL_ACTUATION
    model.body_gravcomp[:] = 0
    data, dofs = mujoco.MjData(model), [link.dof for link in source.links]
    tau = np.empty_like(q)
    states = zip(source.qpos(q), source.qvel(qd), source.qvel(qdd), strict=True)
    for k, state in enumerate(states):
        data.qpos[:], data.qvel[:], data.qacc[:] = state
        mujoco.mj_inverse(model, data)
        tau[k] = data.qfrc_inverse[dofs]
    return tau + np.asarray(arm.frictionloss) * np.sign(qd)


def precision_of(task: Task, trajectory: FourierTrajectory | None) -> Precision:
    """What a motion tells, with what was known before; without a motion that alone."""
    dof, own = task.arm.dof, len(LINEAR[FRICTION])
    rank = task.base.rank
    information = task.prior
    conditions: dict[str, float] = {}
    if trajectory is not None:
        period = 2 * np.pi / trajectory.w
        count = round(100 * period)
        q, qd, qdd = (jnp.asarray(x) for x in trajectory(np.arange(count) * period / count))
        Y = rows(task.arm.chain, task.base.independent, q, qd, qdd)
        F = friction_columns(qd, 0.0)
        plain = np.asarray(gram(Y, F, jnp.ones(dof)))
        weighted = np.asarray(gram(Y, F, jnp.asarray(task.sigma**-2.0)))
        conditions = {
            "base": _condition(plain[:rank, :rank]),
            "with_friction": _condition(plain),
            "base_weighted": _condition(weighted[:rank, :rank]),
            "with_friction_weighted": _condition(weighted),
        }
        information = information + weighted * task.independent / count
    covariance = np.linalg.inv(information)
    variance = np.maximum(np.diag(covariance), 0.0)
    untold = variance * _weak(task.sigma, task.independent) > _UNTOLD
    std = np.where(untold, np.inf, np.sqrt(variance))
    friction = std[rank:].reshape(dof, own)
    return Precision(
        std[:rank],
        {name: friction[:, k] for k, name in enumerate(LINEAR[FRICTION])},
        conditions,
        float(np.linalg.slogdet(information)[1]),
    )


def _condition(information: Float[np.ndarray, "n n"]) -> float:
    """Of the rows behind normal equations."""
    s = np.linalg.eigvalsh(information)
    return float(np.sqrt(s[-1] / max(s[0], 1e-15 * s[-1])))
