"""The arm as it is: what a case conceals, and the closed loop that moves it."""

from dataclasses import dataclass, field

import mujoco
import numpy as np
from arms import Arm, mjcf
from laws import AT_REST, Beyond, Friction, Periodic, Spring

G = np.array([0, 0, -9.81])


@dataclass
class Contact:
    """A push on link `joint` [from 1] at `point` of its frame, `force` [N] along the world's axes."""

    recording: int
    joint: int
    point: np.ndarray
    force: np.ndarray
    interval: tuple[float, float]
    edge: float  # share of the interval in which it builds up and falls

    def at(self, t: np.ndarray) -> np.ndarray:
        x = (t - self.interval[0]) / (self.interval[1] - self.interval[0])
        rise = np.clip(np.minimum(x, 1 - x) / self.edge, 0, 1)
        return np.sin(rise * np.pi / 2) ** 2


@dataclass
class Plan:
    """One case. `phi_*`, `gravity_*`: from the user's model to the truth; `user`: its joint attributes."""

    arm: Arm
    noise: np.ndarray
    phi_user: np.ndarray
    phi_named: np.ndarray
    phi_true: np.ndarray
    phi_loaded: np.ndarray
    gravity_level: np.ndarray
    gravity_true: np.ndarray
    friction: Friction
    armature: np.ndarray
    user: dict[str, np.ndarray]
    causes: list[dict] = field(default_factory=list)
    allowed: list[dict] = field(default_factory=list)
    role: dict[str, list] = field(default_factory=dict)  # friction term -> name of its effect at each joint
    loaded_in: tuple | None = None  # (recording, start, end) where the load is there; None: throughout
    ripple: Periodic | None = None
    spring: Spring | None = None
    stiffness: dict[int, float] = field(default_factory=dict)
    play: dict[int, float] = field(default_factory=dict)
    contacts: list[Contact] = field(default_factory=list)
    beyond: Beyond | None = None
    encoder: np.ndarray | None = None
    delay: float = 0.0
    gain: np.ndarray | None = None
    limit: np.ndarray | None = None
    crosstalk: np.ndarray | None = None
    offset: np.ndarray | None = None
    drift: tuple | None = None  # (size, time constant) of each joint's bias
    meaning: tuple | None = None  # (kind, what it takes)

    def __post_init__(self):
        names = dict(
            coulomb="coulomb_friction",
            viscous="viscous_friction",
            asymmetry="asymmetric_friction",
            extra="stribeck_friction",
            load="load_dependent_friction",
            power="power_law_friction",
            cold="friction_drift",
        )
        self.role = {term: [name] * self.arm.n for term, name in names.items()}

    def loaded(self, recording: int, t: np.ndarray) -> np.ndarray:
        """Whether the load hangs at the flange, at every t; recording -1 is the held-out one."""
        if self.loaded_in is None:
            return np.ones(len(t), bool)
        which, start, end = self.loaded_in
        return (t >= start) & (t < end) if recording == which else np.zeros(len(t), bool)


@dataclass
class Run:
    """What really happened, step by step. theta: motor side of the gears, as angles of the joint."""

    t: np.ndarray
    clock: float  # seconds since the arm was switched on, at t = 0
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    theta: np.ndarray
    omega: np.ndarray
    alpha: np.ndarray
    tau: np.ndarray
    z: np.ndarray
    load: np.ndarray
    contact: np.ndarray
    beyond: np.ndarray


class Rigid:
    """Inverse dynamics of bare links, by MuJoCo."""

    def __init__(self, arm: Arm, phi: np.ndarray, gravity: np.ndarray):
        self.model = mujoco.MjModel.from_xml_string(mjcf(arm, phi, gravity, {}, 1e-3))
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        self.data = mujoco.MjData(self.model)

    def torque(self, q, v, a) -> np.ndarray:
        d, out = self.data, np.empty_like(q)
        for k in range(len(q)):
            d.qpos[:], d.qvel[:], d.qacc[:] = q[k], v[k], a[k]
            mujoco.mj_inverse(self.model, d)
            out[k] = d.qfrc_inverse
        return out

    def mass(self, q: np.ndarray) -> np.ndarray:
        """Joint-space inertia at one posture, column by column."""
        n, zero = len(q), np.zeros((len(q) + 1, len(q)))
        tau = self.torque(np.tile(q, (n + 1, 1)), zero, np.vstack([np.zeros(n), np.eye(n)]))
        return (tau[1:] - tau[0]).T


def simulate(plan: Plan, desired: tuple, dt: float, recording: int, clock: float) -> Run:
    """Feed-forward and PD control at the motors; semi-implicit Euler on both sides of soft gears."""
    arm, n, steps = plan.arm, plan.arm.n, len(desired[0])
    t = np.arange(steps) * dt
    soft = np.array(sorted({*plan.stiffness, *plan.play}), int)
    rotor = plan.armature.copy()
    rotor[soft] = 0
    models = []
    for phi in (plan.phi_true, plan.phi_loaded):
        model = mujoco.MjModel.from_xml_string(mjcf(arm, phi, plan.gravity_true, {"armature": rotor}, dt))
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        models.append(model)
    mass = Rigid(arm, plan.phi_true, plan.gravity_true).mass(np.array(arm.home, float))
    inertia = np.diag(mass) + plan.armature
    free = 1 / np.diag(np.linalg.inv(mass + np.diag(rotor)))[soft]
    k_gear = np.array([plan.stiffness.get(j, 0) for j in soft])
    gap = np.array([plan.play.get(j, 0) / 2 for j in soft])
    stiff = (2 * np.pi * 45) ** 2 * free * plan.armature[soft] / (free + plan.armature[soft])
    k_gear = np.where(gap > 0, stiff, k_gear)
    d_gear = np.where(gap > 0, 0.5, 0.1) * np.sqrt(k_gear * free)
    pole = 28.0 if not len(soft) else 18.0
    kp, kd = pole**2 * inertia, 1.4 * pole * inertia
    forward = Rigid(arm, plan.phi_true, plan.gravity_true).torque(*(x[::10] for x in desired))
    forward = (
        np.stack([np.interp(t, t[::10], column) for column in forward.T], 1) + plan.armature * desired[2]
    )
    has_load = (
        plan.loaded(recording, t).astype(int)
        if plan.phi_loaded is not plan.phi_true
        else np.zeros(steps, int)
    )
    pushes = [(c, c.at(t)) for c in plan.contacts if c.recording == recording]
    data = mujoco.MjData(models[0])
    data.qpos[:], data.qvel[:] = desired[0][0], desired[1][0]
    theta, omega = data.qpos[soft].copy(), data.qvel[soft].copy()
    if len(soft):
        theta += forward[0, soft] / k_gear + gap * np.sign(forward[0, soft])
    bristles = np.zeros((4, n))
    load, acceleration = forward[0].copy(), np.zeros(n)
    log = {
        key: np.zeros((steps, n))
        for key in ("q", "v", "a", "theta", "omega", "alpha", "tau", "z", "load", "contact", "beyond")
    }
    weights, kept = np.array([0.4, 0.3, 0.2, 0.1]), plan.beyond
    if kept:
        kept.state[:], kept.way = 0, 0.0
    for k in range(steps):
        q, v = data.qpos.copy(), data.qvel.copy()
        th, om = q.copy(), v.copy()
        th[soft], om[soft] = theta, omega
        bristles = plan.friction.slip(bristles, om * dt)
        z = weights @ bristles
        lost = sum(plan.friction.components(z, om, load, clock + t[k]).values())
        if plan.ripple:
            lost = lost + plan.ripple.torque(th)
        if plan.spring:
            lost = lost + plan.spring.torque(th)
        if kept:
            j = kept.joint
            log["beyond"][k, j] = kept.step(th[j], om[j], acceleration[j], dt)
            lost = lost + log["beyond"][k]
        for push, share in pushes:
            if share[k] > 0:
                _push(models[0], data, push, share[k], log["contact"][k])
        tau = forward[k] + kp * (desired[0][k] - th) + kd * (desired[1][k] - om)
        drive = tau - lost
        applied = drive + log["contact"][k]
        if len(soft):
            bend = theta - q[soft]
            bend = bend - np.clip(bend, -gap, gap)
            through = k_gear * bend + d_gear * (omega - v[soft]) * ((bend != 0) | (gap == 0))
            applied[soft] = through + log["contact"][k][soft]
        data.qfrc_applied[:] = applied
        mujoco.mj_step(models[has_load[k]], data)
        acceleration = data.qacc.copy()
        al = acceleration.copy()
        if len(soft):
            al[soft] = (drive[soft] - through) / plan.armature[soft]
            omega = omega + al[soft] * dt
            theta = theta + omega * dt
        for key, value in zip(
            ("q", "v", "a", "theta", "omega", "alpha", "tau", "z", "load"),
            (q, v, acceleration, th, om, al, tau, z, load),
            strict=True,
        ):
            log[key][k] = value
        load = drive
    return Run(t, clock, **log)


def _push(model, data, push: Contact, share: float, out: np.ndarray) -> None:
    body = push.joint + 1  # world and base come first
    point = data.xpos[body] + data.xmat[body].reshape(3, 3) @ push.point
    mujoco.mj_applyFT(model, data, share * push.force, np.zeros(3), point, body, out)


def modelled(plan: Plan, rigid: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """The torque of the user's model, armature and friction of its file included, from its bare links'."""
    user, zero = plan.user, np.zeros(plan.arm.n)
    return (
        rigid
        + user.get("armature", zero) * a
        + user.get("damping", zero) * v
        + user.get("frictionloss", zero) * np.tanh(v / AT_REST)
    )


def account(plan: Plan, run: Run, at: np.ndarray, recording: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """(torque of the user's model, torque of every cause) at the samples `at`; they sum to the motors'.

    The user's model is evaluated at the motion that the encoders see, without their noise. The unnamed rest
    of the links and of the base's level is the cause "background". Causes of the sensors come in sensors.py.
    """
    r = {key: getattr(run, key)[at] for key in ("q", "v", "a", "theta", "omega", "alpha", "tau", "z", "load")}
    t = run.t[at]
    parts: dict[str, np.ndarray] = {}
    first = Rigid(plan.arm, plan.phi_user, G)
    seen = r["theta"] if plan.encoder is None else r["theta"] + plan.encoder
    bare = first.torque(seen, r["omega"], r["alpha"])
    base = modelled(plan, bare, r["omega"], r["alpha"])
    last = bare
    if plan.encoder is not None:
        now = first.torque(r["theta"], r["omega"], r["alpha"])
        parts["encoder_offset"], last = now - last, now
    if plan.stiffness or plan.play:
        now = first.torque(r["q"], r["v"], r["a"])
        parts["joint_elasticity" if plan.stiffness else "backlash"], last = now - last, now
    stages = [
        ("inertial_parameters", plan.phi_named, G),
        ("background", plan.phi_true, plan.gravity_level),
        ("gravity_direction", plan.phi_true, plan.gravity_true),
    ]
    before = (plan.phi_user, G)
    for name, phi, gravity in stages:
        if phi is not before[0] or gravity is not before[1]:
            now = Rigid(plan.arm, phi, gravity).torque(r["q"], r["v"], r["a"])
            parts[name], last = now - last, now
        before = (phi, gravity)
    if plan.phi_loaded is not plan.phi_true:
        there = plan.loaded(recording, t)
        now = Rigid(plan.arm, plan.phi_loaded, plan.gravity_true).torque(r["q"], r["v"], r["a"])
        parts["payload" if plan.loaded_in is None else "payload_change"] = np.where(
            there[:, None], now - last, 0
        )
    user, zero = plan.user, np.zeros(plan.arm.n)
    spare = plan.armature - user.get("armature", zero)
    if spare.any():
        parts["armature"] = spare * r["alpha"]
    terms = plan.friction.components(r["z"], r["omega"], r["load"], run.clock + t[:, None])
    terms["coulomb"] = terms["coulomb"] - user.get("frictionloss", zero) * np.tanh(r["omega"] / AT_REST)
    terms["viscous"] = terms["viscous"] - user.get("damping", zero) * r["omega"]
    for term, value in terms.items():
        for j in range(plan.arm.n):
            if value[:, j].any():
                parts.setdefault(plan.role[term][j], np.zeros_like(value))[:, j] += value[:, j]
    for name, law in (("torque_ripple", plan.ripple), ("joint_spring", plan.spring)):
        if law:
            parts[name] = law.torque(r["theta"])
    if plan.contacts:
        parts["external_contact"] = -run.contact[at]
    if plan.beyond:
        parts["unknown"] = run.beyond[at]
    return base, parts
