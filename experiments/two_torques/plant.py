"""The arm as it is: MuJoCo's rigid body, everything else in numpy, and which torque is whose.

    tau       = rigid body + links' causes                    (what passes from the gear to the link)
    tau_motor = tau + friction + armature qdd + ripple        (what the motor gives)

Dry friction is elasto-plastic (Dupont et al. 2002) with a Stribeck level (Canudas de Wit et al. 1995): a bristle
of state s in [-1, 1] is elastic up to `elastic`, creeps beyond and slides at 1.
"""

from dataclasses import dataclass, field

import mujoco
import numpy as np
from arms import Arm, rigid, with_load_body
from motions import DT

REST = 2e-3  # rad/s below which a joint counts as at rest
GRID = 10  # every how many steps the parts are evaluated: 100 Hz


@dataclass
class Drive:
    """What lies between tau_motor and tau; one number a joint."""

    coulomb: np.ndarray  # [N m]
    viscous: np.ndarray  # [N m s/rad]
    armature: np.ndarray  # [kg m2]
    breakaway: np.ndarray  # [rad]
    elastic: np.ndarray  # share of the breakaway that is purely elastic
    stribeck: np.ndarray  # level on top of `coulomb` at standstill [N m]
    stribeck_speed: np.ndarray  # [rad/s]
    asymmetry: np.ndarray  # level and viscous friction are (1 + asymmetry) forward and (1 - asymmetry) back
    load: np.ndarray  # friction for each N m that passes
    warming: np.ndarray  # friction is 1 + warming (exp(-t / warming_time) - its mean)
    ripple: np.ndarray  # [N m]
    ripple_order: np.ndarray  # periods in a turn of the joint
    ripple_phase: np.ndarray
    warming_time: float = 10.0  # [s]


@dataclass
class Links:
    """What lies behind the drives."""

    mass_factor: np.ndarray  # of each link
    com_shift: np.ndarray  # (n, 3) in the link's frame [m]
    hose: np.ndarray  # [N m/rad]
    hose_centre: np.ndarray
    tilt: np.ndarray = field(default_factory=lambda: np.zeros(2))  # of the base about its x and y [rad]
    load: float = 0.0  # at the flange, throughout [kg]
    load_com: np.ndarray = field(default_factory=lambda: np.zeros(3))
    gained: float = 0.0  # at the same place, from `gained_at` on [kg]
    gained_at: float = 0.0  # [s]
    push: np.ndarray = field(default_factory=lambda: np.zeros(3))  # in the world [N]
    push_link: int = 0
    push_point: np.ndarray = field(default_factory=lambda: np.zeros(3))  # in that link's frame [m]
    push_at: float = 0.0
    push_length: float = 1.0


@dataclass
class Sensors:
    """Errors of the two torque sensors and of the encoders; one number a joint."""

    gain: np.ndarray  # relative error
    offset: np.ndarray  # [N m]
    drift: np.ndarray  # [N m], reached as 1 - exp(-t / drift_time)
    motor_gain: np.ndarray
    motor_offset: np.ndarray
    motor_drift: np.ndarray
    encoder: np.ndarray  # measured minus true angle [rad]
    drift_time: float = 10.0


@dataclass
class Truth:
    drive: Drive
    links: Links
    sensors: Sensors


@dataclass
class Record:
    """A motion as it was, at every step or on the grid."""

    t: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    tau: np.ndarray  # behind the gear
    tau_motor: np.ndarray
    stick: np.ndarray  # state of the bristles

    def every(self, k: int) -> "Record":
        return Record(*(values[::k] for values in vars(self).values()))


def inverse(model: mujoco.MjModel, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    data = mujoco.MjData(model)
    tau = np.empty_like(q)
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], qd[k], qdd[k]
        mujoco.mj_inverse(model, data)
        tau[k] = data.qfrc_inverse
    return tau


def set_load(model: mujoco.MjModel, mass: float) -> None:
    """A compact thing: 3 cm of radius of gyration."""
    body = model.body("load").id
    model.body_mass[body] = max(mass, 1e-9)
    model.body_inertia[body] = max(mass, 1e-9) * 0.03**2


def set_inertia(model: mujoco.MjModel, links: Links) -> None:
    for j in range(model.nv):
        body = model.jnt_bodyid[j]
        model.body_mass[body] *= links.mass_factor[j]
        model.body_inertia[body] *= links.mass_factor[j]
        model.body_ipos[body] += links.com_shift[j]


def set_tilt(model: mujoco.MjModel, tilt: np.ndarray) -> None:
    g, (x, y) = 9.81, tilt
    model.opt.gravity[:] = g * np.sin(y), -g * np.sin(x) * np.cos(y), -g * np.cos(x) * np.cos(y)


def pushed(model: mujoco.MjModel, data: mujoco.MjData, links: Links, t: float) -> np.ndarray:
    """Torque of the push at the posture in `data.qpos`; it comes and goes softly."""
    phase, torque = (t - links.push_at) / links.push_length, np.zeros(model.nv)
    if 0 < phase < 1 and np.any(links.push):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        body = model.jnt_bodyid[links.push_link]
        point = data.xpos[body] + data.xmat[body].reshape(3, 3) @ links.push_point
        force = links.push * min(1, 1.6 * np.sin(np.pi * phase))
        mujoco.mj_applyFT(model, data, force, np.zeros(3), point, body, torque)
    return torque


def push_part(xml: str, links: Links, r: Record) -> np.ndarray:
    model = rigid(xml)
    data, torque = mujoco.MjData(model), np.zeros_like(r.q)
    for k in range(len(r.t)):
        data.qpos[:] = r.q[k]
        torque[k] = pushed(model, data, links, r.t[k])
    return torque


def rigid_parts(arm: Arm, xml: str, truth: Truth, r: Record) -> dict[str, np.ndarray]:
    """Torque of the file's rigid body at the measured angles ("file"), then what each cause adds to it."""
    links, encoder = truth.links, truth.sensors.encoder
    model = rigid(with_load_body(arm, xml, links.load_com))
    changes = {
        "encoder_offset": (np.any(encoder), lambda: None),
        "inertial_parameters": (
            np.any(links.mass_factor != 1) or np.any(links.com_shift),
            lambda: set_inertia(model, links),
        ),
        "gravity_direction": (np.any(links.tilt), lambda: set_tilt(model, links.tilt)),
        "payload": (links.load > 0, lambda: set_load(model, links.load)),
        "payload_change": (links.gained > 0, lambda: set_load(model, links.load + links.gained)),
    }
    tau = inverse(model, r.q + encoder, r.qd, r.qdd)
    added = {"file": tau}
    for name, (there, change) in changes.items():
        before = tau
        if there:
            change()
            tau = inverse(model, r.q, r.qd, r.qdd)
        added[name] = tau - before
    added["payload_change"] = added["payload_change"] * (r.t >= links.gained_at)[:, None]
    return added


def warmth(drive: Drive, t: np.ndarray) -> np.ndarray:
    """Factor on all friction, (time, n); one on average over the recording."""
    shape = np.exp(-t / drive.warming_time)
    return 1 + drive.warming * (shape - shape.mean())[:, None]


def drive_parts(drive: Drive, held: dict[str, np.ndarray], r: Record) -> dict[str, np.ndarray]:
    """Torque of each law beyond what the file holds; "file" is what it holds. They add up to tau_motor - tau.

    At rest dry friction is whatever keeps the joint there, and the whole of it counts as Coulomb's or as that of
    the law it belongs to; `presliding_hysteresis` is what the bristles make of it while the joint moves.
    """
    sign = np.where(np.abs(r.qd) > REST, np.sign(r.qd), r.stick)
    bump = drive.stribeck * np.exp(-((r.qd / drive.stribeck_speed) ** 2))
    load, viscous = drive.load * np.abs(r.tau), drive.viscous * r.qd
    level = drive.coulomb + bump + load
    steady = level * sign + viscous + drive.asymmetry * (level * sign**2 + viscous * sign)
    s = r.stick
    actual = level * s + viscous + drive.asymmetry * (level * s**2 + viscous * s)
    return {
        "file": held["coulomb"] * sign + held["viscous"] * r.qd + held["armature"] * r.qdd,
        "coulomb_friction": (drive.coulomb - held["coulomb"]) * sign,
        "viscous_friction": (drive.viscous - held["viscous"]) * r.qd,
        "stribeck_friction": bump * sign,
        "load_dependent_friction": load * sign,
        "asymmetric_friction": drive.asymmetry * (level * sign**2 + viscous * sign),
        "presliding_hysteresis": actual - steady,
        "friction_drift": (warmth(drive, r.t) - 1) * actual,
        "armature": (drive.armature - held["armature"]) * r.qdd,
        "torque_ripple": drive.ripple * np.sin(drive.ripple_order * r.q + drive.ripple_phase),
    }


def sensor_parts(
    tau: np.ndarray, gain, offset, drift, t: np.ndarray, drift_time: float
) -> dict[str, np.ndarray]:
    return {
        "torque_gain": gain * tau,
        "torque_offset": np.broadcast_to(offset, tau.shape),
        "torque_drift": (1 - np.exp(-t / drift_time))[:, None] * drift,
    }


def parts(arm: Arm, xml: str, truth: Truth, held: dict[str, np.ndarray], r: Record) -> dict[str, dict]:
    """{"link": …, "drive": …}: torque of every cause by its name. With s for what the sensors show,

    tau_s = sum(link);  tau_motor_s - tau_s = sum(drive) - gain, offset and drift of tau's sensor.
    """
    links, sensors = truth.links, truth.sensors
    link = rigid_parts(arm, xml, truth, r)
    link["joint_spring"] = links.hose * (r.q - links.hose_centre)
    link["external_contact"] = -push_part(xml, links, r)
    link |= sensor_parts(r.tau, sensors.gain, sensors.offset, sensors.drift, r.t, sensors.drift_time)
    wrong = sensors.motor_gain, sensors.motor_offset, sensors.motor_drift
    drive = drive_parts(truth.drive, held, r) | sensor_parts(r.tau_motor, *wrong, r.t, sensors.drift_time)
    return {"link": link, "drive": drive}


def as_shown(truth: Truth, r: Record) -> tuple[np.ndarray, np.ndarray]:
    """(tau, tau_motor) with the errors of their sensors, without noise."""
    s = truth.sensors
    link = sensor_parts(r.tau, s.gain, s.offset, s.drift, r.t, s.drift_time)
    motor = sensor_parts(r.tau_motor, s.motor_gain, s.motor_offset, s.motor_drift, r.t, s.drift_time)
    return r.tau + sum(link.values()), r.tau_motor + sum(motor.values())


def tracked(arm: Arm, xml: str, truth: Truth, plan, bandwidth: float) -> Record:
    """The arm follows a plan under feedforward of the file's rigid body and a PD controller [bandwidth in Hz]."""
    t, q_plan, qd_plan, qdd_plan = plan
    drive, links = truth.drive, truth.links
    file = rigid(xml)
    file.dof_armature[:] = drive.armature
    fed = inverse(file, q_plan[::GRID], qd_plan[::GRID], qdd_plan[::GRID])
    fed = np.stack([np.interp(t, t[::GRID], column) for column in fed.T], axis=1)

    model = rigid(with_load_body(arm, xml, links.load_com))
    set_inertia(model, links)
    set_tilt(model, links.tilt)
    set_load(model, links.load)
    model.dof_armature[:] = drive.armature
    data, n = mujoco.MjData(model), arm.joints
    data.qpos[:] = arm.home
    mujoco.mj_forward(model, data)
    mass = np.zeros((n, n))
    mujoco.mj_fullM(model, data, mass)
    stiffness = (2 * np.pi * bandwidth) ** 2 * np.diag(mass)
    damping = 1.6 * 2 * np.pi * bandwidth * np.diag(mass)

    warm = warmth(drive, t)
    names = ("q", "qd", "qdd", "tau", "tau_motor", "stick")
    kept = {name: np.zeros((len(t), n)) for name in names}
    q, qd, stick, tau = q_plan[0].copy(), np.zeros(n), np.zeros(n), fed[0]
    for k in range(len(t)):
        if links.gained and k and t[k - 1] < links.gained_at <= t[k]:
            set_load(model, links.load + links.gained)
        motor = fed[k] + stiffness * (q_plan[k] - q) + damping * (qd_plan[k] - qd)
        stick = slid(stick, qd * DT / drive.breakaway, drive.elastic)
        level = drive.coulomb + drive.stribeck * np.exp(-((qd / drive.stribeck_speed) ** 2))
        level = level + drive.load * np.abs(tau)
        friction = warm[k] * (1 + drive.asymmetry * stick) * (level * stick + drive.viscous * qd)
        lost = friction + drive.ripple * np.sin(drive.ripple_order * q + drive.ripple_phase)
        data.qpos[:], data.qvel[:] = q, qd
        hose = links.hose * (q - links.hose_centre)
        data.qfrc_applied[:] = motor - lost - hose + pushed(model, data, links, t[k])
        mujoco.mj_forward(model, data)
        qdd = data.qacc.copy()
        tau = motor - lost - drive.armature * qdd
        for name, value in zip(names, (q, qd, qdd, tau, motor, stick), strict=True):
            kept[name][k] = value
        qd = qd + DT * qdd
        q = q + DT * qd
    return Record(t, **kept)


def slid(stick: np.ndarray, moved: np.ndarray, elastic: np.ndarray) -> np.ndarray:
    """The bristles after the joint moved by `moved` breakaway distances."""
    ahead = stick * np.sign(moved)
    creep = np.clip((ahead - elastic) / (1 - elastic), 0, 1)
    return np.clip(stick + moved * (1 - creep * ahead), -1, 1)
