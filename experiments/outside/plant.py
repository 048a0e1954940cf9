"""The simulated arm in closed loop: MuJoCo's C engine for the rigid part, laws of torque, soft or loose gears."""

from dataclasses import dataclass, field

import mujoco
import numpy as np
from arms import Arm, rigid
from physics import State

DT = 5e-4  # [s]
LOAD_LAG = (
    0.01  # [s], of the gear's normal forces behind its torque; without it, friction by load would chatter
)


@dataclass
class Gear:
    """A joint whose motor reaches the link through a spring, with a dead band of half width `half_gap`."""

    joint: int
    stiffness: float
    damping: float
    rotor: float  # [kg m^2], on the motor's side
    half_gap: float = 0.0

    def torque(self, twist: float, rate: float) -> float:
        over = twist - np.clip(twist, -self.half_gap, self.half_gap)
        if over == 0.0:
            return 0.0
        torque = self.stiffness * over + self.damping * rate
        # two teeth push and never pull
        return torque if self.half_gap == 0.0 or torque * over > 0 else 0.0


@dataclass
class Plant:
    """What really moves. `phases` are (start time, arm): a body may be gained or lost on the way."""

    phases: list[tuple[float, Arm]]
    laws: list = field(default_factory=list)
    gears: list[Gear] = field(default_factory=list)
    bandwidth: float = 30.0  # [rad/s], of the position loop
    stiffness_floor: float = 200.0  # [1/rad], of the position loop over the typical friction
    help: float = 0.0  # share of the file's friction that the controller feeds forward


@dataclass
class Log:
    """Clean signals on the simulation's grid. `q` is where the position sensor sits, the motor for soft gears."""

    t: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    tau: np.ndarray
    by_key: dict[str, np.ndarray]


def soft_gears_aside(model: mujoco.MjModel, gears: list[Gear]) -> mujoco.MjModel:
    """The rotor of a soft gear moves with the motor, not with the link."""
    for gear in gears:
        model.dof_armature[gear.joint] = 0.0
    return model


def simulate(plant: Plant, reference, user: Arm, clock: float = 0.0) -> Log:
    """Follow `reference` (q, qd, qdd on the grid) by feed-forward of the rigid dynamics and PD.

    `clock` [s] is the time stamp of the first sample.
    """
    q_ref, qd_ref, qdd_ref = reference
    count, n = q_ref.shape
    models = [(start, soft_gears_aside(rigid(arm), plant.gears)) for start, arm in plant.phases]
    rotor = plant.phases[0][1].of("armature")
    while len(models) > 1 and models[1][0] <= clock:
        models.pop(0)
    model = models[0][1]
    data = mujoco.MjData(model)
    data.qpos, data.qvel = q_ref[0], qd_ref[0]
    soft = np.array([gear.joint for gear in plant.gears], int)
    kp, kd = gains(plant, model, user, rotor)
    unwind(plant, model, data)
    feed = plant.help * (user.of("frictionloss") * np.tanh(qd_ref / 0.02) + user.of("damping") * qd_ref)
    motor, speed = q_ref[0].copy(), qd_ref[0].copy()
    log = Log(clock + np.arange(count) * DT, *(np.zeros((count, n)) for _ in range(4)), {})
    log.by_key.update({law.key: np.zeros((count, n)) for law in plant.laws})
    load, inertial, waiting = data.qfrc_bias.copy(), np.zeros(n), models[1:]
    for k in range(count):
        t = log.t[k]
        if waiting and t >= waiting[0][0]:
            model = waiting.pop(0)[1]
            fresh = mujoco.MjData(model)
            fresh.qpos, fresh.qvel = data.qpos, data.qvel
            data = fresh
        model.opt.timestep = DT
        mujoco.mj_step1(model, data)
        q, v = data.qpos.copy(), data.qvel.copy()
        q[soft], v[soft] = motor[soft], speed[soft]
        state = State(t, DT, q, v, load, model, data)
        extra = np.zeros(n)
        for law in plant.laws:
            torque = law(state)
            log.by_key[law.key][k] += torque
            extra += torque
        mujoco.mj_mulM(model, data, inertial, qdd_ref[k])
        inertial[soft] += rotor[soft] * qdd_ref[k][soft]
        u = inertial + data.qfrc_bias + kp * (q_ref[k] - q) + kd * (qd_ref[k] - v) + feed[k]
        net = u - extra
        through = net.copy()
        acceleration = np.zeros(n)
        for gear in plant.gears:
            j = gear.joint
            through[j] = gear.torque(motor[j] - data.qpos[j], speed[j] - data.qvel[j])
            acceleration[j] = (net[j] - through[j]) / gear.rotor
        data.qfrc_applied = through
        mujoco.mj_step2(model, data)
        qdd = data.qacc.copy()
        qdd[soft] = acceleration[soft]
        log.q[k], log.qd[k], log.qdd[k], log.tau[k] = q, v, qdd, u
        load += (through - load) * DT / LOAD_LAG
        speed[soft] += DT * acceleration[soft]
        motor[soft] += DT * speed[soft]
    if not np.all(np.isfinite(log.q)) or np.max(np.abs(log.q - q_ref)) > 0.5:
        raise FloatingPointError("the simulated arm left its reference")
    return log


def unwind(plant: Plant, model: mujoco.MjModel, data: mujoco.MjData):
    """Start with soft gears wound up by gravity, their teeth in touch."""
    mujoco.mj_forward(model, data)
    for gear in plant.gears:
        held = data.qfrc_bias[gear.joint]
        data.qpos[gear.joint] -= held / gear.stiffness + np.sign(held) * gear.half_gap
    mujoco.mj_forward(model, data)


def gains(plant: Plant, model: mujoco.MjModel, user: Arm, rotor: np.ndarray):
    """Stiffness and damping of the position loop: bandwidth times inertia, but stiff enough against friction."""
    data = mujoco.MjData(model)
    data.qpos = user.home
    mujoco.mj_forward(model, data)
    n = model.nv
    own = np.zeros(n)
    for j in range(n):
        unit, row = np.zeros(n), np.zeros(n)
        unit[j] = 1.0
        mujoco.mj_mulM(model, data, row, unit)
        own[j] = row[j]
    for gear in plant.gears:
        # in the gap the motor is alone: gains for the whole would make it rattle
        own[gear.joint] = rotor[gear.joint] + own[gear.joint] * (gear.half_gap == 0.0)
    loose = np.isin(np.arange(n), [gear.joint for gear in plant.gears if gear.half_gap > 0])
    kp = np.maximum(plant.bandwidth**2 * own, plant.stiffness_floor * user.friction * ~loose)
    return kp, 2 * 0.8 * np.sqrt(kp * own)
