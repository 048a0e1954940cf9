"""What a recording is, what speaks for its units and signs, and what can be identified from it."""

import dataclasses
from typing import Any

import jax
import numpy as np
from jaxpanda_kernels import gravity_torque, regressor
from jaxtyping import Array, Bool, Float, Int
from scipy.ndimage import maximum_filter1d

from .arms.arm import Arm, joints_named, unit_of
from .errors import require_x64
from .meaning import Meaning, meaning
from .parameters import triangle
from .recordings import Origin, Recording
from .recordings.checks import velocity_scale
from .signals import LONGEST_GAP, Signals, prepare, repeatability, white_noise, zero_phase
from .xla import chunked

MOVING = 0.01
"""Below this a joint rests [rad/s]."""
WEAK = 1e-3
"""Directions of parameter space that show this much less torque than the strongest one are weakly excited."""
_STATES = 400  # of the motion, spread evenly, at which ranks are computed
_NEAR = 0.1  # an arm rests where no joint moves within this time [s]
_PARTS = 10  # of the motion, that are to agree on a torque's scale
_UNTOLD = (
    "torque's unit and sign cannot be told: the model's torque hardly varies over this motion, or parts of it "
    "disagree"
)
_OPPOSITE = 0.5  # share of d(q)/dt with the other sign from which dq is said to have it
_UNSURE = 0.25  # deviation of a scale, or its share of a large one, from which it is not told


@dataclasses.dataclass(frozen=True)
class JointInspection:
    """One joint's motion and sensors; None where it cannot be told."""

    joint: int
    slides: bool
    """By the model; False without one. Where it slides, rad is m and N m is N."""
    lower: float
    """Least position [rad]."""
    upper: float
    """Greatest position [rad]."""
    speed: float
    """Greatest speed [rad/s], from q."""
    acceleration: float
    """Greatest acceleration [rad/s²], from q."""
    reversals: int
    """How often the joint turns round."""
    rest: float
    """Share of the time below `MOVING`."""
    velocity_scale: float | None
    """k of dq = k d(q)/dt; -1 where dq has the other sign."""
    velocity_lag: float | None
    """By how much the logged dq, or its opposite, is late behind d(q)/dt [s]."""
    torque_step: float | None
    """Smallest difference between two torques: the sensor's resolution, or the file's; None where torque never
    changes [N m]."""
    noise: float | None
    """Torque noise from sample to sample [N m]."""
    repeat_noise: float | None
    """Torque noise below the cutoff, from motion that repeats itself [N m]."""
    torque_scale: float | None
    """k of tau = k tau_model(q, qd, qdd) + friction + offset: 1 when units and sign are right."""
    gravity_scale: float | None
    """The same for the gravity torque alone: 0 when the controller has taken gravity out."""


@dataclasses.dataclass(frozen=True)
class Identifiable:
    """What the motion shows of the parameters; ranks by the regressor at the recorded states."""

    rank: int
    """Base parameters that the motion shows at all."""
    structural_rank: int
    """Base parameters of the arm."""
    well_excited: int
    """Of these, directions within `WEAK` of the strongest."""
    condition_number: float
    """Greatest over least singular value of what the motion shows."""
    gravity_rank: int
    """Of them, those that show at rest in the positions of the motion."""
    gravity_structural_rank: int
    gravity_well_excited: int
    viscous_joints: tuple[int, ...]
    """Joints that move both ways at speeds that differ."""
    coulomb_joints: tuple[int, ...]
    """Joints that move both ways."""


@dataclasses.dataclass(frozen=True)
class Inspection:
    """What `inspect` found; `verdicts` says it in sentences."""

    name: str
    channels: tuple[str, ...]
    dof: int
    samples: int
    duration: float
    """[s]"""
    rate: float
    """[Hz]"""
    steps: tuple[float, float, float]
    """Least, median and greatest step of time [s]."""
    missing: int
    """Samples missing between rows, by the median step."""
    gaps: tuple[tuple[float, float], ...]
    """Time and length of gaps longer than `signals.LONGEST_GAP` [s]."""
    repeated_rows: int
    """Rows whose measured channels all equal the row before."""
    velocity_scale: float | None
    """k of dq = k d(q)/dt; 1 when the units agree."""
    period: float | None
    """After which the motion repeats itself [s]."""
    joints: tuple[JointInspection, ...]
    identifiable: Identifiable | None
    """None without a model."""
    repairs: dict[str, int]
    notes: tuple[str, ...]
    verdicts: tuple[str, ...]
    origin: Origin | None = None
    """What the file called the channels, and what its source says they are."""

    def to_json(self) -> dict[str, Any]:
        """Plain numbers, lists and strings."""
        origin = None if self.origin is None else self.origin.to_json()
        plain = dataclasses.asdict(dataclasses.replace(self, origin=None))
        return {"schema": "jaxpanda.inspection/1", **plain, "origin": origin}

    def unit(self, turning: str) -> str:
        """`unit_of` the joints."""
        return unit_of(turning, [joint.slides for joint in self.joints])

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Heads and rows of a table with a row for each joint."""
        rad, speed, acceleration, force = map(self.unit, ("rad", "rad/s", "rad/s²", "N m"))
        heads = ["joint", f"range {rad}", f"speed {speed}", f"acceleration {acceleration}"]
        heads += [
            "reversals",
            "rest %",
            "dq late ms",
            f"step {force}",
            f"noise {force}",
            f"repeat noise {force}",
        ]
        heads += ["torque scale", "gravity scale"]
        rows = [
            [
                str(joint.joint),
                f"{joint.lower:.2f} … {joint.upper:.2f}",
                f"{joint.speed:.2f}",
                f"{joint.acceleration:.2f}",
                str(joint.reversals),
                f"{100 * joint.rest:.0f}",
                _shown(joint.velocity_lag, 1e3, ".1f"),
                _shown(joint.torque_step, 1.0, ".2g"),
                _shown(joint.noise, 1.0, ".3f"),
                _shown(joint.repeat_noise, 1.0, ".4f"),
                _shown(joint.torque_scale, 1.0, ".3f"),
                _shown(joint.gravity_scale, 1.0, ".3f"),
            ]
            for joint in self.joints
        ]
        return heads, rows

    def lines(self) -> list[str]:
        """The facts about the whole file, then the verdicts."""
        least, median, greatest = (1e3 * step for step in self.steps)
        facts = [
            f"{self.samples} samples over {self.duration:.3f} s; channels {', '.join(self.channels)}; "
            f"{self.dof} joints",
            *(self.origin.lines() if self.origin else ()),
            f"rate {self.rate:.4g} Hz; steps {least:.3g} … {median:.3g} … {greatest:.3g} ms; {self.missing} "
            f"samples missing; {self.repeated_rows} repeated rows",
        ]
        repairs = [f"{what}: {count}" for what, count in self.repairs.items()]
        return facts + repairs + list(self.notes) + list(self.verdicts)


@dataclasses.dataclass(frozen=True)
class _States:
    """Some states of the motion, spread evenly, and what the nominal model says there."""

    places: Int[np.ndarray, " state"]
    """Among the kept samples."""
    regressor: Float[np.ndarray, "state dof parameter"]
    gravity_regressor: Float[np.ndarray, "state dof parameter"]
    torque: Float[np.ndarray, "state dof"]
    """[N m]"""
    gravity: Float[np.ndarray, "state dof"]
    """[N m]"""


def inspect(recording: Recording, arm: Arm | None = None) -> Inspection:
    """Look at a recording before anything is fitted to it.

    Args:
        recording: as read.
        arm: of the same robot; without one, signs, gravity and ranks cannot be told.

    Raises:
        InputError: the arm has another number of joints, or the recording is too short to filter.
    """
    if arm is not None:
        recording.require_dof(arm.dof)
        require_x64("inspect")
    duration = float(recording.time[-1] - recording.time[0])
    signals = prepare(recording, cutoff=min(5.0, 0.2 * recording.rate), trim=min(0.6, duration / 5))
    model = None if arm is None else _states(arm, signals)
    joints = tuple(
        _joint(j, recording, signals, model, arm is not None and bool(arm.chain.prismatic[j]))
        for j in range(recording.dof)
    )
    identifiable = None if arm is None or model is None else _identifiable(arm, signals, joints, model)
    steps = np.diff(recording.time)
    long = np.flatnonzero(steps > LONGEST_GAP)
    motion = np.column_stack(recording.channels())
    inspection = Inspection(
        name=recording.name,
        channels=tuple(recording.measured),
        dof=recording.dof,
        samples=recording.samples,
        duration=duration,
        rate=signals.rate,
        steps=(float(steps.min()), float(np.median(steps)), float(steps.max())),
        missing=len(signals.time) - recording.samples if len(signals.time) > recording.samples else 0,
        gaps=tuple((float(recording.time[i]), float(steps[i])) for i in long),
        repeated_rows=int(np.sum(np.all(np.diff(motion, axis=0) == 0, axis=1))),
        velocity_scale=velocity_scale(recording),
        period=signals.period,
        joints=joints,
        identifiable=identifiable,
        repairs=dict(signals.repairs),
        notes=signals.notes,
        verdicts=(),
        origin=recording.origin,
    )
    read = None if arm is None else meaning(recording, arm)
    verdicts = (
        _time_verdicts(inspection) + _unit_verdicts(inspection, arm) + _torque_verdicts(inspection, arm, read)
    )
    return dataclasses.replace(
        inspection, verdicts=tuple(verdicts + _declared_verdicts(inspection) + _motion_verdicts(inspection))
    )


def _joint(
    j: int, recording: Recording, signals: Signals, model: _States | None, slides: bool
) -> JointInspection:
    """What one joint's channels say."""
    inner = slice(signals.keep[0], signals.keep[-1] + 1)
    qd, qdd = signals.qd[inner, j], signals.qdd[inner, j]
    tau = recording.tau
    repeat = repeatability(signals)
    step = None if tau is None else _step(tau[:, j])
    scale, lag = _velocity(j, recording, signals) or (None, None)
    scales = (None, None) if model is None or step is None else _scales(j, signals, model)
    return JointInspection(
        joint=j + 1,
        slides=slides,
        lower=float(recording.q[:, j].min()),
        upper=float(recording.q[:, j].max()),
        speed=float(np.abs(qd).max()),
        acceleration=float(np.abs(qdd).max()),
        reversals=_reversals(qd),
        rest=float(np.mean(np.abs(qd) < MOVING)),
        velocity_scale=scale,
        velocity_lag=lag,
        torque_step=step,
        noise=None if tau is None else float(white_noise(tau)[j]),
        repeat_noise=None if repeat is None else float(repeat[j]),
        torque_scale=scales[0],
        gravity_scale=scales[1],
    )


def _reversals(qd: Float[np.ndarray, " time"]) -> int:
    """Changes of direction; trembling around rest is none."""
    signs = np.sign(qd[np.abs(qd) > MOVING])
    return int(np.sum(np.diff(signs) != 0))


def _step(tau: Float[np.ndarray, " time"]) -> float | None:
    steps = np.diff(np.unique(tau))
    return float(steps.min()) if steps.size else None


def _velocity(j: int, recording: Recording, signals: Signals) -> tuple[float, float] | None:
    r"""k and $\delta$ [s] of $\dot q_{logged}(t) = k\,\dot q(t - \delta)$, both low-passed alike.

    k by least squares without a delay; the delay of what has the sign of k, as large as it is, by Gauss-Newton.
    """
    moved = signals.qd[signals.keep, j]
    if recording.qd is None or np.abs(moved).max() < 5 * MOVING:
        return None
    logged = np.interp(signals.time, recording.time, recording.qd[:, j])
    logged = zero_phase(logged, signals.derivative_cutoff, signals.rate)[signals.keep]
    scale = float(np.sum(logged * moved) / np.sum(moved**2))
    logged = logged if scale > 0 else -logged
    lag = 0.0
    for _ in range(5):
        velocity, acceleration = (
            np.interp(signals.times - lag, signals.time, x[:, j]) for x in (signals.qd, signals.qdd)
        )
        lag -= float(np.sum((logged - velocity) * acceleration) / np.sum(acceleration**2))
        lag = float(np.clip(lag, -0.5, 0.5))
    return scale, lag


def _states(arm: Arm, signals: Signals) -> _States:
    """Both torques are low-passed as the measured one: what noise of q makes of them is mostly faster."""
    places = np.linspace(0, len(signals.keep) - 1, _STATES).astype(int)
    moving = _moving(signals)[:, None]
    q, qd, qdd = signals.q, signals.qd * moving, signals.qdd * moving
    torque = arm.inverse_dynamics_of_many(q, qd, qdd)
    gravity = chunked(_gravity, arm.nameless, q)
    q, qd, qdd = (x[signals.keep[places]] for x in (q, qd, qdd))
    return _States(
        places,
        _stacked(arm, q, qd, qdd),
        _stacked(arm, q, 0 * q, 0 * q),
        signals.lowpass(torque)[places],
        signals.lowpass(gravity)[places],
    )


@jax.jit
def _gravity(arm: Arm, q: Array) -> Array:
    return jax.vmap(gravity_torque, (None, None, 0))(arm.chain, arm.standard, q)


def _moving(signals: Signals) -> Bool[np.ndarray, " time"]:
    """Where some joint moves: elsewhere speed and acceleration are noise of q."""
    reach = 2 * round(_NEAR * signals.rate) + 1
    return maximum_filter1d(np.any(np.abs(signals.qd) > MOVING, axis=1), reach)


def _stacked(
    arm: Arm,
    q: Float[np.ndarray, "state dof"],
    qd: Float[np.ndarray, "state dof"],
    qdd: Float[np.ndarray, "state dof"],
) -> Float[np.ndarray, "state dof parameter"]:
    """Regressors of many states, a column a parameter."""
    return np.asarray(_regressors(arm.chain, q, qd, qdd)).reshape(len(q), arm.dof, 10 * arm.dof)


_regressors = jax.jit(jax.vmap(regressor, in_axes=(None, 0, 0, 0)))


def _scales(j: int, signals: Signals, model: _States) -> tuple[float | None, float | None]:
    """Least-squares factors of the model's torque, and of its gravity part when the rest has its own.

    Friction and an offset are fitted along. None where the torque at hand does not vary enough to tell.
    """
    assert signals.tau is not None
    qd = signals.qd[:, j]
    channels = np.stack([signals.tau[:, j], qd, np.tanh(qd / 0.05)], 1)
    tau, *friction = signals.lowpass(channels)[model.places].T
    others = [*friction, np.ones_like(tau)]
    torque, gravity = model.torque[:, j], model.gravity[:, j]
    return _factor(tau, [torque], others), _factor(tau, [gravity, torque - gravity], others)


def _factor(tau: np.ndarray, first: list[np.ndarray], others: list[np.ndarray]) -> float | None:
    """The coefficient of `first[0]`; None unless what the other columns leave of it varies by 0.3 N m, and parts
    of the motion agree on it (a jackknife over `_PARTS`)."""
    columns = np.column_stack(first + others)
    rest = columns[:, 1:]
    alone = columns[:, 0] - rest @ np.linalg.lstsq(rest, columns[:, 0], rcond=None)[0]
    if np.std(alone) < 0.3:
        return None
    scale = lambda rows: float(np.linalg.lstsq(columns[rows], tau[rows], rcond=None)[0][0])
    everything = np.arange(len(tau))
    whole = scale(everything)
    without = [scale(np.delete(everything, part)) for part in np.array_split(everything, _PARTS)]
    agree = np.sqrt(_PARTS - 1) * np.std(without) < _UNSURE * max(1.0, abs(whole))
    return whole if agree else None


def _identifiable(
    arm: Arm, signals: Signals, joints: tuple[JointInspection, ...], at: _States
) -> Identifiable:
    """Ranks of the regressor at states of the motion, against random states of the same arm."""
    random = np.random.default_rng(0).uniform(-2, 2, (3, _STATES, arm.dof))
    motion, gravity = _singular_values(at.regressor), _singular_values(at.gravity_regressor)
    rank = _rank(motion)
    both = [
        joint.joint for joint in joints if joint.reversals > 0 and _both_ways(signals.qd[:, joint.joint - 1])
    ]
    return Identifiable(
        rank=rank,
        structural_rank=_rank(_singular_values(_stacked(arm, *random))),
        well_excited=int(np.sum(motion > WEAK * motion[0])),
        condition_number=float(motion[0] / motion[max(rank - 1, 0)]),
        gravity_rank=_rank(gravity),
        gravity_well_excited=int(np.sum(gravity > WEAK * gravity[0])),
        gravity_structural_rank=_rank(
            _singular_values(_stacked(arm, random[0], 0 * random[0], 0 * random[0]))
        ),
        viscous_joints=tuple(j for j in both if _speeds_differ(signals.qd[:, j - 1])),
        coulomb_joints=tuple(both),
    )


def _singular_values(Y: Float[np.ndarray, "state dof parameter"]) -> Float[np.ndarray, " value"]:
    return np.linalg.svd(triangle(Y.reshape(-1, Y.shape[-1])), compute_uv=False)


def _rank(singular_values: np.ndarray) -> int:
    return int(np.sum(singular_values > 1e-9 * max(singular_values[0], 1e-300)))


def _both_ways(qd: Float[np.ndarray, " time"]) -> bool:
    """At least a twentieth of the time in each direction."""
    return bool(min(np.mean(qd > MOVING), np.mean(qd < -MOVING)) > 0.05)


def _speeds_differ(qd: Float[np.ndarray, " time"]) -> bool:
    speeds = np.abs(qd[np.abs(qd) > MOVING])
    low, high = np.quantile(speeds, [0.1, 0.9])
    return bool(high > 2 * low and high > 0.05)


def _time_verdicts(found: Inspection) -> list[str]:
    least, median, greatest = found.steps
    said = []
    if greatest - least > 0.02 * median:
        said.append(
            f"time is not uniform (steps of {1e3 * least:.3g} to {1e3 * greatest:.3g} ms): filtering "
            "resamples it"
        )
    if found.gaps:
        at, length = max(found.gaps, key=lambda gap: gap[1])
        said.append(
            f"{len(found.gaps)} gaps longer than {LONGEST_GAP:g} s, the longest {length:.3g} s at {at:.3f} s"
        )
    if found.repeated_rows > 0.01 * found.samples:
        said.append(
            f"{found.repeated_rows} rows repeat the one before: the logger ran faster than the controller, or the"
            " arm stood still"
        )
    if found.period is not None:
        said.append(
            f"the motion repeats itself every {found.period:.3f} s: test on phase blocks, not on the rest"
        )
    return said


def _unit_verdicts(found: Inspection, arm: Arm | None) -> list[str]:
    said = [f"time in s: {found.rate:.4g} Hz is a usual rate"]
    furthest = max(max(abs(joint.lower), abs(joint.upper)) for joint in found.joints)
    if furthest <= 2 * np.pi:
        said.append(f"q in {found.unit('rad')}: no joint beyond {furthest:.2f}")
    else:
        said.append(
            f"q reaches {furthest:.2f}, more than a turn: rad if a joint turns on, else check for degrees"
        )
    if found.velocity_scale is not None and found.velocity_scale > 0:
        said.append(f"dq in {found.unit('rad/s')}: {found.velocity_scale:.3f} times d(q)/dt")
    scales = {j.joint: j.velocity_scale for j in found.joints if j.velocity_scale is not None}
    opposite = [joint for joint, scale in scales.items() if scale < -_OPPOSITE]
    if opposite:
        said.append(
            f"dq of {joints_named([j - 1 for j in opposite])} has the opposite sign of d(q)/dt: velocities are"
            " taken from q"
        )
    lags = [joint.velocity_lag for joint in found.joints if joint.velocity_lag is not None]
    if lags and abs(np.median(lags)) > 2e-3:
        said.append(f"dq is {1e3 * np.median(lags):.1f} ms late behind d(q)/dt: velocities are taken from q")
    if arm is not None:
        lower, upper = np.asarray(arm.lower), np.asarray(arm.upper)
        for joint, low, high in zip(found.joints, lower, upper, strict=True):
            if joint.lower < low - 0.05 or joint.upper > high + 0.05:
                said.append(
                    f"joint {joint.joint} goes from {joint.lower:.2f} to {joint.upper:.2f} "
                    f"{unit_of('rad', [joint.slides])}, beyond the "
                    f"model's limits {low:.2f} to {high:.2f}: check the model, the joints' order and zeros"
                )
    return said


def _torque_verdicts(found: Inspection, arm: Arm | None, read: Meaning | None) -> list[str]:
    if "tau" not in found.channels:
        return ["no torque: a motion, which can be predicted for but not identified from"]
    dead = _dead_verdicts(found)
    if arm is None:
        return [*dead, "torque's unit and sign cannot be told without a model"]
    if read is not None:
        return [*dead, read.summary]
    scales = {joint.joint: joint.torque_scale for joint in found.joints if joint.torque_scale is not None}
    gravity = [joint.gravity_scale for joint in found.joints if joint.gravity_scale is not None]
    said = dead + (_scale_verdicts(found, scales) if scales else [_UNTOLD])
    if gravity:
        weight = float(np.median(gravity))
        if abs(weight) < 0.3:
            said.append(f"gravity is not in the torque ({weight:.2f} times the model's): add it back")
        elif weight > 0:
            said.append(f"gravity is in the torque: {weight:.2f} times the model's")
    return said


def _scale_verdicts(found: Inspection, scales: dict[int, float]) -> list[str]:
    """Signs, unit and joints that are unlike the others, by each joint's scale."""
    said = []
    reversed_ = [joint for joint, k in scales.items() if k < -0.3]
    if reversed_:
        said.append(
            f"torque has the wrong sign on joints {_listed(reversed_)}: positive is along the joint axis"
        )
    median = float(np.median(np.abs(list(scales.values()))))
    if not 0.5 < median < 2:
        said.append(
            f"torque is {median:.3g} times what the model needs: check its unit "
            f"({found.unit('N m')} at the joint) and the model"
        )
    odd = [joint for joint, k in scales.items() if k > 0 and not 0.5 < k / median < 2]
    if odd:
        said.append(
            f"torque on joints {_listed(odd)} has another scale than on the rest: check gear ratios or the "
            "model"
        )
    if not reversed_ and 0.5 < median < 2 and not odd:
        said.append(
            f"torque in {found.unit('N m')}, positive along the joint axis: {min(scales.values()):.2f} to "
            f"{max(scales.values()):.2f} times the model's"
        )
    return said


def _dead_verdicts(found: Inspection) -> list[str]:
    """Torque that never changes."""
    dead = [joint.joint for joint in found.joints if joint.torque_step is None]
    return [f"torque of joints {_listed(dead)} never changes: no sensor speaks there"] if dead else []


def _declared_verdicts(found: Inspection) -> list[str]:
    """What the source says of gravity in its torque, against what the motion shows."""
    weights = [joint.gravity_scale for joint in found.joints if joint.gravity_scale is not None]
    if found.origin is None or not weights:
        return []
    says = {"measured": True, "motor_side": True, "gravity_removed": False}.get(found.origin.torque)
    weight = float(np.median(weights))
    shows = False if abs(weight) < 0.3 else True if weight > 0.6 else None
    if says is None or shows is None or says == shows:
        return []
    return [
        f"{found.origin.source} says that its torque {'has' if says else 'is without'} gravity, and the data "
        f"show {weight:.2f} times the model's: trust the data, and look for what changed it"
    ]


def _motion_verdicts(found: Inspection) -> list[str]:
    can = found.identifiable
    resting = [joint.joint for joint in found.joints if joint.rest > 0.95]
    said = [f"joints {_listed(resting)} hardly move: their friction cannot be told"] if resting else []
    if can is None:
        return said
    said.append(
        f"gravity: {can.gravity_rank} of {can.gravity_structural_rank} parameters show, "
        f"{can.gravity_well_excited} of them well"
        + ("" if can.gravity_well_excited == can.gravity_structural_rank else ": move more joints, further")
    )
    said.append(
        f"inertia: {can.rank} of {can.structural_rank} base parameters show, {can.well_excited} of them well "
        f"(condition number {can.condition_number:.3g})"
        + ("" if can.well_excited == can.structural_rank else ": faster motion of all joints would show more")
    )
    neither = [joint.joint for joint in found.joints if joint.joint not in can.coulomb_joints]
    said.append(
        f"friction: Coulomb on joints {_listed(can.coulomb_joints) or 'none'}, viscous on joints "
        f"{_listed(can.viscous_joints) or 'none'}"
        + (f"; joints {_listed(neither)} do not move both ways enough" if neither else "")
    )
    if max(joint.acceleration for joint in found.joints) < 0.1:
        said.append(
            "the motion is too slow to tell inertia from gravity: accelerations stay below 0.1 rad/s²"
        )
    return said


def _listed(joints) -> str:
    return ", ".join(map(str, joints))


def _shown(value: float | None, factor: float, spec: str) -> str:
    return "–" if value is None else format(factor * value, spec)
