r"""A virtual arm: recordings whose truth is known, made by other code than analyses them.

MuJoCo's C engine supplies the rigid-body dynamics; friction and sensors are written out here. Nothing of
the project's kernels, signals or effects is imported, so that a mistake there cannot hide itself in its own
test data.

The motion obeys

$$M(q)\,\ddot q + h(q, \dot q) + \tau_f(\dot q) = u$$

where $h$ holds gravity, Coriolis torque and whatever passive torque the MJCF has (damping, springs), and
the recorded torque is $u$, which is what inverse dynamics with friction must reproduce.
"""

import copy
import dataclasses
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import scipy.interpolate
from jaxtyping import Float

from .errors import InputError
from .recordings.recording import Recording

_MOST_STEPS = 5e6
"""Integration steps of a recording, at most: some ten minutes."""


@dataclasses.dataclass(frozen=True)
class FourierTrajectory:
    r"""A sum of harmonics.

    $$q_j(t) = q_{0j} + \sum_l \frac{a_{jl}}{l\omega}\sin l\omega t - \frac{b_{jl}}{l\omega}\cos l\omega t$$

    Periodic and as smooth as its highest harmonic, so its derivatives are known exactly.

    References:
        Swevers et al., "Optimal robot excitation and identification", IEEE T-RA 1997.
    """

    a: Float[np.ndarray, "dof harmonics"]
    """[rad/s]"""
    b: Float[np.ndarray, "dof harmonics"]
    """[rad/s]"""
    q0: Float[np.ndarray, " dof"]
    """[rad]"""
    w: float
    """Angular frequency of the first harmonic [rad/s]."""

    @property
    def dof(self) -> int:
        return self.a.shape[0]

    def __call__(
        self, time: Float[np.ndarray, " time"]
    ) -> tuple[Float[np.ndarray, "time dof"], Float[np.ndarray, "time dof"], Float[np.ndarray, "time dof"]]:
        """Position [rad], velocity [rad/s] and acceleration [rad/s²] at `time` [s]."""
        lw = self.w * np.arange(1, self.a.shape[1] + 1)
        s, c = np.sin(time[:, None] * lw), np.cos(time[:, None] * lw)
        q = self.q0 + s @ (self.a / lw).T - c @ (self.b / lw).T
        return q, c @ self.a.T + s @ self.b.T, c @ (self.b * lw).T - s @ (self.a * lw).T


@dataclasses.dataclass(frozen=True)
class SplineTrajectory:
    """A motion through recorded positions: a spline of the fifth degree, so that accelerations are smooth."""

    spline: Any
    """Of the positions [rad] over time from 0 [s]."""
    derivatives: tuple[Any, Any]
    q0: Float[np.ndarray, " dof"]
    """[rad]"""
    w: float
    """2π over its length [rad/s]."""

    @classmethod
    def through(
        cls, time: Float[np.ndarray, " time"], q: Float[np.ndarray, "time dof"]
    ) -> "SplineTrajectory":
        """Through positions at increasing times; where these are many, every n-th is enough."""
        step = max(1, int(0.01 / max(float(np.median(np.diff(time))), 1e-9)))
        chosen = np.unique(np.append(np.arange(0, len(time), step), len(time) - 1))
        if len(chosen) < 6:
            raise InputError(f"a motion of {len(time)} rows is too short to be simulated")
        spline = scipy.interpolate.make_interp_spline(time[chosen] - time[0], q[chosen], k=5)
        length = float(time[-1] - time[0])
        rates = (spline.derivative(1), spline.derivative(2))
        return cls(spline, rates, q.mean(0), 2 * np.pi / length)

    @property
    def dof(self) -> int:
        return len(self.q0)

    def __call__(
        self, time: Float[np.ndarray, " time"]
    ) -> tuple[Float[np.ndarray, "time dof"], Float[np.ndarray, "time dof"], Float[np.ndarray, "time dof"]]:
        """Position [rad], velocity [rad/s] and acceleration [rad/s²] at `time` [s]."""
        return self.spline(time), self.derivatives[0](time), self.derivatives[1](time)


def fourier_trajectory(a: Any, b: Any, q0: Any, w: float = 0.15 * np.pi) -> FourierTrajectory:
    """The trajectory with these tables, lists or arrays; `w` defaults to the Panda's published one.

    Raises:
        InputError: the tables do not belong to one arm.
    """
    a, b, q0 = (np.asarray(x, float) for x in (a, b, q0))
    if a.ndim != 2 or a.shape != b.shape or q0.shape != a.shape[:1]:
        raise InputError(
            f"a trajectory needs a and b of shape (joints, harmonics) and q0 of shape (joints,); "
            f"got {a.shape}, {b.shape} and {q0.shape}"
        )
    return FourierTrajectory(a, b, q0, float(w))


def random_trajectory(
    model: str | Path | mujoco.MjModel,
    seed: int,
    *,
    harmonics: int = 5,
    period: float = 40 / 3,
    speed: float = 1.5,
    acceleration: float = 4.0,
) -> FourierTrajectory:
    """A random trajectory that stays within nine tenths of every joint's range.

    Each joint is scaled until its range, `speed` or `acceleration` is used up, whichever comes first.

    Args:
        model: MJCF text or file, or a compiled model.
        seed: of the random numbers.
        harmonics: of the first frequency.
        period: after which the motion repeats [s].
        speed: largest joint speed [rad/s; m/s where the joint slides].
        acceleration: largest joint acceleration [rad/s²; m/s²].
    """
    arm = _compiled(model)
    rng = np.random.default_rng(seed)
    limited = arm.jnt_limited.astype(bool)
    lower = np.where(limited, arm.jnt_range[:, 0], -np.pi)
    upper = np.where(limited, arm.jnt_range[:, 1], np.pi)
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    shape = (arm.nv, harmonics)
    raw = FourierTrajectory(
        rng.normal(size=shape), rng.normal(size=shape), np.zeros(arm.nv), 2 * np.pi / period
    )
    largest = [np.abs(x).max(0) for x in raw(np.linspace(0, period, 2000))]
    q0 = middle + 0.4 * half * rng.uniform(-1, 1, arm.nv)
    room = 0.9 * half - np.abs(q0 - middle)
    scale = np.min([room / largest[0], speed / largest[1], acceleration / largest[2]], 0)[:, None]
    return FourierTrajectory(raw.a * scale, raw.b * scale, q0, raw.w)


_TURNS_OVER, _SLIDES_OVER = 0.02, 0.002
"""Speeds over which dry friction turns [rad/s, m/s]."""


@dataclasses.dataclass(frozen=True)
class JointFriction:
    r"""$\tau_f = f_v \dot q + f_c \tanh(\dot q / w) + f_o$, each a number for all joints or one a joint."""

    viscous: Float[np.ndarray, " dof"] | float = 0.0
    """$f_v$ [N m s/rad]"""
    coulomb: Float[np.ndarray, " dof"] | float = 0.0
    """$f_c$ [N m]"""
    offset: Float[np.ndarray, " dof"] | float = 0.0
    """$f_o$ [N m]"""
    width: Float[np.ndarray, " dof"] | float | None = None
    """$w$: speed at which three quarters of the Coulomb level are reached; None takes 0.02 rad/s, 2 mm/s of a
    joint that slides."""

    @property
    def turns_over(self) -> Float[np.ndarray, " dof"] | float:
        """`width`, of joints that turn where it was left open."""
        return _TURNS_OVER if self.width is None else self.width

    def torque(self, qd: Float[np.ndarray, "*batch dof"]) -> Float[np.ndarray, "*batch dof"]:
        return self.viscous * qd + self.coulomb * np.tanh(qd / self.turns_over) + self.offset


@dataclasses.dataclass(frozen=True)
class Sensors:
    """What lies between the motion and its log; the default is a perfect one.

    A field is a number for all joints or one a joint. Zero switches an imperfection off.
    """

    torque_noise: Float[np.ndarray, " dof"] | float = 0.0
    """Standard deviation [N m]."""
    torque_correlation_time: float = 0.0
    """Over which torque noise forgets itself [s]: first-order autoregressive."""
    torque_resolution: Float[np.ndarray, " dof"] | float = 0.0
    """Step of the torque reading [N m]."""
    position_noise: Float[np.ndarray, " dof"] | float = 0.0
    """Standard deviation [rad], white."""
    position_resolution: Float[np.ndarray, " dof"] | float = 0.0
    """Step of the position reading [rad]."""
    velocity_noise: Float[np.ndarray, " dof"] | float = 0.0
    """Standard deviation [rad/s], white."""
    velocity_lag: float = 0.0
    """Time constant of the first-order filter in the logged velocity [s]."""
    jitter: float = 0.0
    """Standard deviation of the time stamps [s], cut where stamps would change order."""
    missing: float = 0.0
    """Fraction of rows that never reach the log."""


def panda_sensors() -> Sensors:
    """Sensors like those behind the published Panda log.

    Torque steps as in the raw logs of Gaz et al.; noise such that what two repeats of a motion differ by at
    1 kHz and below 10 Hz is about what that log shows; velocity 5 ms late.
    """
    return Sensors(
        torque_noise=np.array([0.08, 0.08, 0.07, 0.07, 0.03, 0.03, 0.03]),
        torque_correlation_time=2e-3,
        torque_resolution=np.array([0.0357, 0.0357, 0.0357, 0.0357, 0.006, 0.006, 0.006]),
        position_noise=5e-6,
        velocity_noise=1e-3,
        velocity_lag=5e-3,
    )


def simulate(
    model: str | Path | mujoco.MjModel,
    trajectory: FourierTrajectory | SplineTrajectory,
    *,
    duration: float = 20.0,
    rate: float = 1000.0,
    friction: JointFriction | None = None,
    sensors: Sensors | None = None,
    bandwidth: float = 20.0,
    seed: int = 0,
    name: str = "virtual",
) -> Recording:
    r"""The log of an arm that tracks `trajectory` under feedback.

    $$u = \mathrm{ID}(q_r, \dot q_r, \ddot q_r) + M_0\,(\omega^2 (q_r - q) + 2\omega (\dot q_r - \dot q))$$

    ID is the model's own inverse dynamics and knows nothing of `friction`, so the arm lags where it rubs, as
    arms do. $M_0$ is the mass matrix in the middle of the motion. The arm starts on the trajectory.

    Time steps are classical Runge-Kutta with the controller evaluated at every stage. So at every logged
    instant torque and motion satisfy the equation of motion, and inverse dynamics of the logged positions is
    the logged torque to the integrator's accuracy: on the Panda 2e-4 N m at worst, 4e-5 N m rms, less
    than a hundredth of its torque noise (`tests/test_simulation.py`).

    Contacts, limits and equality constraints of the model are off, its actuators too; a `frictionloss` in it
    is applied as smoothed Coulomb friction rather than as MuJoCo's soft constraint.

    Args:
        model: MJCF text or file, or a compiled model; hinges and slides only.
        trajectory: for as many joints as the model has.
        duration: [s].
        rate: of the log [Hz].
        friction: beyond what the model holds.
        sensors: perfect unless given.
        bandwidth: $\omega / 2\pi$, of the critically damped feedback [Hz].
        seed: of the sensor noise.
        name: of the recording.

    Raises:
        InputError: no such arm, a trajectory for another one, or friction too steep for a light joint.
    """
    compiled = _prepared(model)
    if compiled.nv != trajectory.dof:
        raise InputError(f"the trajectory moves {trajectory.dof} joints; the model has {compiled.nv}")
    samples = round(duration * rate)
    if samples < 2:
        raise InputError(f"a recording of {duration} s at {rate} Hz has fewer than two samples")
    friction = _with_frictionloss(friction or JointFriction(), compiled)
    arm = _Tracking(compiled, trajectory, friction, bandwidth)
    time, substeps = np.arange(samples) / rate, arm.substeps(1 / rate)
    if samples * substeps > _MOST_STEPS:
        raise InputError(
            f"{arm.stiffest()}: {samples} samples would take {samples * substeps:.1e} integration steps; give the"
            " joint the armature of its drive, or less friction or damping"
        )
    q, qd, u = arm.run(time, substeps)
    return _logged(name, time, q, qd, u, sensors or Sensors(), np.random.default_rng(seed))


def with_sensors(recording: Recording, sensors: Sensors, seed: int) -> Recording:
    """A perfect log as these sensors would have shown it; each seed another noise."""
    if recording.qd is None or recording.tau is None:
        raise InputError(f"{recording.name}: has no velocity or no torque, so it is no perfect log")
    random = np.random.default_rng(seed)
    return _logged(recording.name, recording.time, recording.q, recording.qd, recording.tau, sensors, random)


def perturbed(model: str | Path | mujoco.MjModel, seed: int, scale: float = 0.1) -> mujoco.MjModel:
    """The arm of an MJCF with other inertial parameters: a truth that its file does not tell.

    Mass and principal second moments of every body are multiplied by log-normal factors of width `scale`,
    its centre of mass moves by about `scale` radii of gyration and its principal axes turn by about `scale`
    radians, so every body remains one that could be built.
    """
    arm = _compiled(model)
    rng = np.random.default_rng(seed)
    for i in range(1, arm.nbody):
        if arm.body_mass[i] == 0:
            continue
        Sigma = arm.body_inertia[i].sum() / 2 - arm.body_inertia[i]
        Sigma = np.maximum(Sigma, 0) * np.exp(scale * rng.normal(size=3))
        factor = np.exp(scale * rng.normal())
        radius = np.sqrt(arm.body_inertia[i].mean() / arm.body_mass[i])
        mujoco.mju_quatIntegrate(arm.body_iquat[i], rng.normal(size=3), scale)
        arm.body_mass[i] *= factor
        arm.body_ipos[i] += scale * radius * rng.normal(size=3)
        arm.body_inertia[i] = factor * (Sigma.sum() - Sigma)
    # MuJoCo skips the offset of a centre of mass or the turn of its axes where the compiler found none.
    arm.body_simple[:] = 0
    arm.body_sameframe[:] = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)
    mujoco.mj_setConst(arm, mujoco.MjData(arm))
    return arm


def body_inertias(
    model: mujoco.MjModel,
) -> tuple[Float[np.ndarray, " body"], Float[np.ndarray, "body 3"], Float[np.ndarray, "body 3 3"]]:
    """Mass [kg], centre of mass [m] and inertia about it [kg m²], in body frames, without the world's."""
    axes = np.zeros((model.nbody, 9))
    for R, quat in zip(axes, model.body_iquat, strict=True):
        mujoco.mju_quat2Mat(R, quat)
    axes = axes.reshape(-1, 3, 3)
    I = np.einsum("bij,bj,bkj->bik", axes, model.body_inertia, axes)
    return model.body_mass[1:].copy(), model.body_ipos[1:].copy(), I[1:]


def _spec(model: str | Path) -> mujoco.MjSpec:
    text = str(model)
    try:
        if text.lstrip().startswith("<"):
            return mujoco.MjSpec.from_string(text)
        return mujoco.MjSpec.from_file(text)
    except ValueError as error:
        where = "the MJCF text" if text.lstrip().startswith("<") else text
        raise InputError(f"{where} cannot be simulated: {' '.join(str(error).split())}") from None


def _compiled(model: str | Path | mujoco.MjModel) -> mujoco.MjModel:
    """A copy of a compiled model, or the model of a file or text."""
    if not isinstance(model, str | Path):
        compiled = copy.copy(model)
    else:
        try:
            compiled = _spec(model).compile()
        except ValueError as error:
            raise InputError(f"the MJCF does not compile: {' '.join(str(error).split())}") from None
    scalar = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    if compiled.nv == 0 or not np.isin(compiled.jnt_type, scalar).all():
        raise InputError("only arms of hinges and slides can be simulated")
    return compiled


def _prepared(model: str | Path | mujoco.MjModel) -> mujoco.MjModel:
    """A model with nothing but smooth dynamics left on."""
    compiled = _compiled(model)
    off = mujoco.mjtDisableBit
    compiled.opt.disableflags |= off.mjDSBL_CONSTRAINT | off.mjDSBL_CONTACT | off.mjDSBL_ACTUATION
    return compiled


def _with_frictionloss(friction: JointFriction, model: mujoco.MjModel) -> JointFriction:
    slides = model.jnt_type[model.dof_jntid] == mujoco.mjtJoint.mjJNT_SLIDE
    width = np.where(slides, _SLIDES_OVER, _TURNS_OVER) if friction.width is None else friction.width
    return dataclasses.replace(friction, coulomb=friction.coulomb + model.dof_frictionloss, width=width)


class _Tracking:
    """An arm under feedback along a trajectory."""

    def __init__(
        self,
        model: mujoco.MjModel,
        trajectory: FourierTrajectory | SplineTrajectory,
        friction: JointFriction,
        bandwidth: float,
    ):
        self.model, self.trajectory, self.friction = model, trajectory, friction
        self.data = mujoco.MjData(model)
        M = self._mass_matrix(trajectory.q0)
        w = 2 * np.pi * bandwidth
        self.stiffness, self.damping = w**2 * M, 2 * w * M

    def _mass_matrix(self, q: Float[np.ndarray, " dof"]) -> Float[np.ndarray, "dof dof"]:
        self.data.qpos = q
        mujoco.mj_fwdPosition(self.model, self.data)
        M = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, self.data, M)
        return M

    def substeps(self, interval: float) -> int:
        r"""Stable Runge-Kutta steps in `interval` [s], with some room: $h\,\lambda(M^{-1}D) < 2$.

        D is the damping of the feedback and the steepest slope of friction, met at rest.
        """
        slope = self.damping + np.diag(self._steepest())
        poses = self.trajectory(np.linspace(0, 2 * np.pi / self.trajectory.w, 500))[
            0
        ]  # some are passed quickly
        rates = [np.linalg.eigvals(np.linalg.solve(self._mass_matrix(q), slope)) for q in poses]
        return int(np.ceil(interval * np.abs(rates).max() / 2))

    def _steepest(self) -> Float[np.ndarray, " dof"]:
        """Slope of friction over velocity at rest [N m s/rad]."""
        slope = self.friction.viscous + np.abs(self.friction.coulomb) / self.friction.turns_over
        return np.broadcast_to(slope, self.model.nv)

    def stiffest(self) -> str:
        """Which joint's friction brakes it most abruptly."""
        moved = np.diag(np.linalg.inv(self._mass_matrix(self.trajectory.q0)))
        joint = int(np.argmax(moved * self._steepest()))
        return (
            f"joint {self.model.joint(joint).name!r}, of {1 / moved[joint]:.2g} kg·m² about its axis, rubs by"
            f" {self._steepest()[joint]:.3g} N·m·s/rad at rest"
        )

    def _feed_forward(self, q, qd, qdd) -> Float[np.ndarray, "time dof"]:
        """Torque of the reference under the model, friction unknown to it."""
        u, data = np.empty_like(q), self.data
        for k in range(len(q)):
            data.qpos, data.qvel, data.qacc = q[k], qd[k], qdd[k]
            mujoco.mj_inverse(self.model, data)
            u[k] = data.qfrc_inverse
        return u

    def run(
        self, time: Float[np.ndarray, " time"], substeps: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position, velocity and torque at `time`, a uniform grid, each of shape (time, dof)."""
        h = (time[1] - time[0]) / substeps
        stages = np.arange(2 * substeps * (len(time) - 1) + 1) * h / 2
        q_r, qd_r, qdd_r = self.trajectory(stages)
        u_r = self._feed_forward(q_r, qd_r, qdd_r)

        def control(k, q, qd):
            return u_r[k] + self.stiffness @ (q_r[k] - q) + self.damping @ (qd_r[k] - qd)

        def acceleration(k, q, qd):
            data = self.data
            data.qpos, data.qvel = q, qd
            data.qfrc_applied = control(k, q, qd) - self.friction.torque(qd)
            mujoco.mj_forward(self.model, data)
            return data.qacc.copy()

        q, qd = q_r[0], qd_r[0]
        log = np.empty((3, len(time), len(q)))
        for i in range(2 * substeps * (len(time) - 1) + 1):
            if i % (2 * substeps) == 0:
                log[:, i // (2 * substeps)] = q, qd, control(i, q, qd)
            if i % 2 == 1 or i == len(stages) - 1:
                continue
            a1 = acceleration(i, q, qd)
            a2 = acceleration(i + 1, q + h / 2 * qd, v2 := qd + h / 2 * a1)
            a3 = acceleration(i + 1, q + h / 2 * v2, v3 := qd + h / 2 * a2)
            a4 = acceleration(i + 2, q + h * v3, v4 := qd + h * a3)
            q, qd = q + h / 6 * (qd + 2 * v2 + 2 * v3 + v4), qd + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        if not np.isfinite(log).all():
            raise InputError("the simulated arm ran away; a lower feedback bandwidth may help")
        return log[0], log[1], log[2]


def _recursion(x: Float[np.ndarray, "time dof"], keep: float) -> Float[np.ndarray, "time dof"]:
    """$y_0 = x_0$, $y_k = keep * y_{k-1} + x_k$."""
    y = x.copy()
    for k in range(1, len(y)):
        y[k] += keep * y[k - 1]
    return y


def _memory(step: float, time_constant: float) -> float:
    """What a first-order system keeps over one step."""
    return float(np.exp(-step / time_constant)) if time_constant > 0 else 0.0


def _rounded(x: Float[np.ndarray, "time dof"], step: Any) -> Float[np.ndarray, "time dof"]:
    step = np.broadcast_to(step, x.shape)
    whole = np.where(step > 0, step, 1.0)
    return np.where(step > 0, np.round(x / whole) * whole, x)


def _logged(
    name: str,
    time: Float[np.ndarray, " time"],
    q: Float[np.ndarray, "time dof"],
    qd: Float[np.ndarray, "time dof"],
    tau: Float[np.ndarray, "time dof"],
    sensors: Sensors,
    rng: np.random.Generator,
) -> Recording:
    """The recording of a motion.

    Every random number is always drawn, so that switching one fault off leaves the others as they were.
    """
    step = time[1] - time[0]
    white = rng.normal(size=(3, *q.shape))
    stamps, lost = rng.normal(size=len(time)), rng.random(len(time))

    a = _memory(step, sensors.torque_correlation_time)
    innovation = white[0]
    innovation[1:] *= np.sqrt(1 - a**2)
    tau = tau + sensors.torque_noise * _recursion(innovation, a)

    a = _memory(step, sensors.velocity_lag)
    late = (1 - a) * qd
    late[0] = qd[0]

    time = time + np.clip(sensors.jitter * stamps, -0.45 * step, 0.45 * step)
    kept = lost >= sensors.missing
    kept[[0, -1]] = True
    return Recording(
        name=name,
        time=time[kept],
        q=_rounded(q + sensors.position_noise * white[1], sensors.position_resolution)[kept],
        qd=(_recursion(late, a) + sensors.velocity_noise * white[2])[kept],
        tau=_rounded(tau, sensors.torque_resolution)[kept],
    )
