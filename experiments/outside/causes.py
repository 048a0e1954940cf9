"""One function a cause: it adds to a draft the physics and the entry in the truth.

Each takes the joints it may choose and `ratio`, the size that it aims at in units of torque noise.
"""

from dataclasses import replace

import numpy as np
import physics
from arms import Arm, Body, draw_body, inverse, perturb_links
from draft import Draft, Step, add_joint, replace_arm, set_joint
from plant import DT, Gear
from scipy.signal import lfilter

NM, NMS, KGM2 = "N·m", "N·m·s/rad", "kg·m²"
MOVING = 0.35  # RMS speed of a motion over the arm's speed


def per_joint(name: str, joints, values, unit: str) -> list[tuple]:
    return [(name, int(j), float(values[j]), unit) for j in joints]


# -------------------------------------------------------------------------------- friction


def viscous_friction(d: Draft, ratio: float, joints=None, level=None):
    joints = d.some() if joints is None else joints
    c = d.at(joints, ratio * d.noise / (MOVING * d.user.speed) if level is None else level)
    key = d.add("viscous_friction", joints, per_joint("damping", joints, c, NMS))
    d.laws.append(physics.Viscous(key, c))


def coulomb_friction(d: Draft, ratio: float, joints=None, level=None):
    joints = d.some() if joints is None else joints
    c = d.at(joints, ratio * d.noise / 0.85 if level is None else level)
    key = d.add("coulomb_friction", joints, per_joint("coulomb", joints, c, NM), ["presliding_hysteresis"])
    d.dry(key, c)
    d.allow("presliding_hysteresis", joints)


def asymmetric_friction(d: Draft, ratio: float):
    """Coulomb levels that differ; while moving the same as a symmetric level and an offset."""
    joints = d.some()
    forward = d.at(joints, 1.3 * ratio * d.noise)
    backward = d.at(joints, 1.3 * ratio * d.noise * d.rng.uniform(0.05, 0.45, d.n))
    if d.rng.random() < 0.5:
        forward, backward = backward, forward
    also = ["coulomb_friction", "torque_offset", "presliding_hysteresis"]
    told = per_joint("forward", joints, forward, NM) + per_joint("backward", joints, backward, NM)
    key = d.add("asymmetric_friction", joints, told, also)
    d.dry(key, np.maximum(forward, backward), level=physics.asymmetric(forward, backward))


def stribeck_friction(d: Draft, ratio: float, joints=None, level=None):
    joints = d.some() if joints is None else joints
    c = d.at(joints, ratio * d.noise / 0.9 if level is None else level)
    static = c * d.rng.uniform(1.5, 2.3, d.n)
    knee = float(np.exp(d.rng.uniform(np.log(0.02), np.log(0.15))))
    told = per_joint("coulomb", joints, c, NM) + per_joint("static", joints, static, NM)
    told += [("stribeck_velocity", j, knee, "rad/s") for j in joints]
    key = d.add("stribeck_friction", joints, told, ["presliding_hysteresis"])
    d.dry(key, static, (2e-4, 8e-4), physics.stribeck(c, static, np.full(d.n, knee)))
    d.allow("coulomb_friction", joints)
    d.allow("presliding_hysteresis", joints)


def load_dependent_friction(d: Draft, ratio: float):
    load = d.load()
    joints = d.one(np.argsort(-load)[: max(2, d.n // 2)])
    share = d.at(joints, np.clip(1.1 * ratio * d.noise / load, 0.02, 0.25))
    key = d.add("load_dependent_friction", joints, per_joint("share", joints, share, "1"))
    d.dry(key, share * load, level=physics.loaded(share))
    d.allow("coulomb_friction", joints)
    d.allow("presliding_hysteresis", joints)


def friction_drift(d: Draft, ratio: float):
    """A cold arm: what the file has is the warm friction, the surplus dies away."""
    joints = d.some()
    if not np.any(d.user.of("frictionloss")):
        d.know_friction(joints)
    a = d.at(joints, 1.6 * ratio * d.noise)
    time = float(d.seconds * d.rng.uniform(0.25, 0.7))
    told = [*per_joint("surplus", joints, a, NM), ("time", joints[0], time, "s")]
    key = d.add("friction_drift", joints, told)
    d.dry(key, 0.6 * a, level=physics.warming(0.6 * a, 0.0, time))
    viscous = 0.4 * a / (2 * MOVING * d.user.speed)
    d.laws.append(physics.WarmingViscous(key, viscous, 0.0, time))
    # what of the surplus lasts through the recording is friction of the plain kinds
    for name in ("presliding_hysteresis", "coulomb_friction", "viscous_friction"):
        d.allow(name, joints)


def presliding_hysteresis(d: Draft, ratio: float):
    """Friction whose level the file has, but which takes 8-40 mrad to build up."""
    joints = d.some()
    c = d.at(joints, 2.0 * ratio * d.noise)
    reach = d.rng.uniform(8e-3, 4e-2)
    key = d.add("presliding_hysteresis", joints, [("breakaway", j, float(reach), "rad") for j in joints])
    d.user = d.user.with_joint(frictionloss=d.user.of("frictionloss") + c)
    d.steps.append(Step(key, add_joint("frictionloss", -c)))
    d.dry(key, c, (reach, reach))


def power_law_friction(d: Draft, ratio: float):
    joints = d.some()
    power = float(d.rng.choice([d.rng.uniform(0.35, 0.65), d.rng.uniform(1.5, 2.2)]))
    c = d.at(joints, ratio * d.noise / (MOVING * d.user.speed) ** power)
    told = per_joint("scale", joints, c, "N·m·(s/rad)^p") + [("power", j, power, "1") for j in joints]
    d.laws.append(physics.PowerLaw(d.add("power_law_friction", joints, told), c, power))
    if power < 1:
        d.allow("coulomb_friction", joints)
    d.allow("viscous_friction", joints)


# -------------------------------------------------------------------------------- drive


def torque_ripple(d: Draft, ratio: float):
    joints = d.one() if d.rng.random() < 0.8 else d.some()
    fastest = max(d.user.speed[j] for j in joints)
    orders = [
        o for o in (3, 6, 12, 30, 50, 100, 160) if o * MOVING * fastest < 2 * np.pi * 0.15 * d.sensors.fs
    ]
    order = float(d.rng.choice(orders or [3]))
    a = d.at(joints, 1.35 * ratio * d.noise)
    told = per_joint("amplitude", joints, a, NM) + [("order", j, order, "1") for j in joints]
    key = d.add("torque_ripple", joints, told)
    second, phase = float(d.rng.choice([0.0, 0.25])), d.rng.uniform(0, 2 * np.pi)
    d.laws.append(physics.Ripple(key, a, order, phase, second, 0.2))


def need_rotor(d: Draft, j: int, least: float):
    """A rotor at joint j, known to the user."""
    armature = d.user.of("armature")
    armature[j] = max(armature[j], least)
    d.user = d.user.with_joint(armature=armature)


def backlash(d: Draft, ratio: float):
    j = d.one(np.argsort(-d.load(moving=False))[:4])[0]
    need_rotor(d, j, 0.3 * d.inertia()[j])
    gap = min(d.rng.uniform(1e-3, 6e-3) * max(1.0, ratio / 10), 0.03)
    inertia, rotor = d.inertia()[j], float(d.user.of("armature")[j])
    stiffness = min(d.load()[j] / 5e-4, rotor * 400**2)
    d.add("backlash", [j], [("gap", j, float(gap), "rad")])
    d.allow("joint_elasticity", [j])
    damping = 1.2 * np.sqrt(stiffness * min(inertia, rotor))
    d.gears.append(Gear(j, stiffness, damping, rotor, gap / 2))


def joint_elasticity(d: Draft, ratio: float):
    load = d.load(moving=False)
    j = d.one(np.argsort(-load)[: max(2, d.n // 2)])[0]
    need_rotor(d, j, 0.1 * d.inertia()[j])
    stiffness = float(max(load[j] ** 2 / (ratio * d.noise[j]), 25 * load[j]))
    rotor = float(d.user.of("armature")[j])
    stiffness = min(stiffness, rotor * 600**2)
    d.add("joint_elasticity", [j], [("stiffness", j, stiffness, "N·m/rad")])
    d.gears.append(Gear(j, stiffness, 0.15 * np.sqrt(stiffness * d.inertia()[j]), rotor))


def armature(d: Draft, ratio: float):
    joints = d.some()
    value = d.at(joints, ratio * d.noise / (1.3 * d.user.speed))
    key = d.add("armature", joints, per_joint("armature", joints, value, KGM2))
    d.steps.append(Step(key, add_joint("armature", value)))


# -------------------------------------------------------------------------------- load


def inertial_parameters(d: Draft, ratio: float):
    size = float(np.clip(0.02 * ratio, 0.03, 0.25))
    which = sorted(int(k) for k in d.rng.choice(d.n, d.rng.integers(1, 4), replace=False))
    rng = np.random.default_rng(d.rng.integers(2**31))
    truth = perturb_links(d.user, rng, size, 0.08 * size, size, which)
    key = d.add("inertial_parameters", None)
    links = truth.links
    d.steps.append(Step(key, replace_arm(links=links)))


def combined(first: Body | None, second: Body) -> Body:
    """Two bodies as one; the radius is that of the same spread about the common centre, on average."""
    if first is None:
        return second
    mass = first.mass + second.mass
    com = (first.mass * first.com + second.mass * second.com) / mass
    spread = sum(b.mass * (0.4 * b.radius**2 + 2 / 3 * np.sum((b.com - com) ** 2)) for b in (first, second))
    return Body(mass, com, float(np.sqrt(spread / (0.4 * mass))))


def load_up(body: Body):
    return lambda arm: replace_arm(tool=combined(arm.tool, body))(arm)


def body_of(d: Draft, ratio: float) -> Body:
    arm_length = 0.7
    mass = float(np.clip(ratio * np.median(d.noise[1:4]) / (9.81 * arm_length), 0.05, 4.0))
    body = draw_body(d.rng, d.user, 1.0, 1.01)
    return Body(mass, body.com, float(0.05 * np.cbrt(mass)))


def told_of(body: Body, j: int) -> list[tuple]:
    return [
        ("mass", j, body.mass, "kg"),
        *((f"com_{a}", j, float(x), "m") for a, x in zip("xyz", body.com, strict=False)),
    ]


def payload(d: Draft, ratio: float):
    body = body_of(d, ratio)
    key = d.add("payload", None, told_of(body, d.n - 1), ["inertial_parameters"])
    d.steps.append(Step(key, load_up(body)))


def payload_change(d: Draft, ratio: float):
    """Taken up during the first recording; in half of the cases put down again."""
    body = body_of(d, max(ratio, 3.0))
    begin = float(d.rng.uniform(0.2, 0.5) * d.seconds)
    end = float(d.seconds if d.rng.random() < 0.5 else begin + 0.3 * d.seconds)
    told = told_of(body, d.n - 1)
    key = d.add("payload_change", None, told, intervals=[(begin, end)])
    before = d.user.tool
    d.steps.append(Step(key, load_up(body), begin))
    if end < d.seconds:
        d.steps.append(Step(key, replace_arm(tool=before), end))


def gravity_direction(d: Draft, ratio: float):
    tilt = float(np.clip(ratio * np.min(d.noise / d.load()), 0.006, 0.12))
    about = d.rng.uniform(0, 2 * np.pi)
    g = 9.81 * np.array([np.sin(tilt) * np.cos(about), np.sin(tilt) * np.sin(about), -np.cos(tilt)])
    key = d.add("gravity_direction", None, [("tilt", None, tilt, "rad")])
    d.steps.append(Step(key, replace_arm(gravity=g)))


def joint_spring(d: Draft, ratio: float):
    joints = d.one() if d.rng.random() < 0.8 else d.some()
    k = d.at(joints, ratio * d.noise / (0.55 * d.user.reach))
    centre = d.user.home + 0.5 * d.user.reach * d.rng.uniform(-1, 1, d.n)
    told = per_joint("stiffness", joints, k, "N·m/rad") + per_joint("rest", joints, centre, "rad")
    d.laws.append(physics.Spring(d.add("joint_spring", joints, told), k, centre))
    d.allow("torque_offset", joints)


# -------------------------------------------------------------------------------- sensors and clocks


def torque_offset(d: Draft, ratio: float):
    joints = d.some()
    offset = d.at(joints, ratio * d.noise * d.rng.choice([-1, 1], d.n))
    key = d.add("torque_offset", joints, per_joint("offset", joints, offset, NM))
    d.torque.append((key, lambda d, log, tau: tau + offset))


def torque_gain(d: Draft, ratio: float):
    load = d.load(moving=False) + d.user.of("frictionloss")
    joints = d.one(np.argsort(-load)[: max(3, d.n // 2)])
    error = np.clip(ratio * d.noise / np.maximum(load, d.noise), 0.01, 0.3) * d.rng.choice([-1, 1], d.n)
    gain = 1 + d.at(joints, error)
    key = d.add("torque_gain", joints, per_joint("gain", joints, gain, "1"), ["inertial_parameters"])
    d.torque.append((key, lambda d, log, tau: gain * tau))


def torque_drift(d: Draft, ratio: float):
    joints = d.some()
    size = d.at(joints, 2.2 * ratio * d.noise * d.rng.choice([-1, 1], d.n))
    time = float(d.seconds * d.rng.uniform(0.3, 3.0))
    full = 1 - np.exp(-d.seconds / time)
    told = [*per_joint("change", joints, size, NM), ("time", joints[0], time, "s")]
    key = d.add("torque_drift", joints, told)
    d.torque.append((key, lambda d, log, tau: tau + np.outer((1 - np.exp(-log.t / time)) / full, size)))
    d.allow("torque_offset", joints)


def torque_crosstalk(d: Draft, ratio: float):
    load = d.load(moving=False)
    source = d.one(np.argsort(-load)[:3])[0]
    j = d.one([k for k in range(d.n) if k != source])[0]
    share = float(np.clip(ratio * d.noise[j] / load[source], 0.005, 0.2) * d.rng.choice([-1, 1]))
    key = d.add("torque_crosstalk", [j], [("share", j, share, "1"), ("source", j, source + 1, "1")])

    def cross(d, log, tau):
        return tau + share * np.outer(tau[:, source], np.eye(d.n)[j])

    d.torque.append((key, cross))


def encoder_offset(d: Draft, ratio: float):
    load = d.load(moving=False)
    j = d.one(np.argsort(-load)[:3])[0]
    offset = float(np.clip(1.5 * ratio * d.noise[j] / load[j], 0.004, 0.1) * d.rng.choice([-1, 1]))
    key = d.add("encoder_offset", [j], [("offset", j, offset, "rad")])
    d.encoders.append((key, np.eye(d.n)[j] * offset))


def time_delay(d: Draft, ratio: float):
    """The torque column lags by `delay`; a negative one means that the motion does."""
    steps = int(d.rng.integers(4, 40 if ratio < 4 else 80)) * int(d.rng.choice([-1, 1], p=[0.3, 0.7]))
    key = d.add("time_delay", None, [("delay", None, steps * DT, "s")])
    d.torque.append((key, lambda d, log, tau: shifted(tau, steps)))


def shifted(x: np.ndarray, steps: int) -> np.ndarray:
    index = np.clip(np.arange(len(x)) - steps, 0, len(x) - 1)
    return x[index]


def external_contact(d: Draft, ratio: float):
    size = float(np.clip(ratio * np.median(d.noise) / 0.4, 0.5, 60.0))
    direction = d.rng.standard_normal(3)
    direction /= np.linalg.norm(direction)
    begin = float(d.rng.uniform(0.15, 0.6) * d.seconds)
    end = begin + float(d.rng.uniform(0.5, 2.5))
    j = d.n - 1
    told = [
        ("force", j, size, "N"),
        *((f"direction_{a}", j, float(x), "1") for a, x in zip("xyz", direction, strict=True)),
    ]
    key = d.add("external_contact", None, told, intervals=[(begin, end)])
    d.laws.append(physics.Contact(key, size * direction, begin, end, 0.15))


def torque_meaning(d: Draft, ratio: float):
    kinds = ("gravity_removed", "sign", "unit", "current", "joint_order", "motor_side", "mounting")
    kind = str(d.rng.choice(kinds))
    also = {"mounting": ["gravity_direction"], "gravity_removed": [], "joint_order": []}.get(
        kind, ["torque_gain"]
    )
    key = d.add("torque_meaning", None, also=also, what=kind)
    if kind == "mounting":
        tilt = d.rng.choice([np.pi, np.pi / 2, np.pi / 4])
        d.steps.append(Step(key, replace_arm(gravity=9.81 * np.array([np.sin(tilt), 0, -np.cos(tilt)]))))
    elif kind == "gravity_removed":
        d.torque.append((key, lambda d, log, tau: tau - gravity(d.user, log.q)))
    elif kind == "joint_order":
        order = np.arange(d.n)
        a, b = sorted(d.rng.choice(min(d.n, 5), 2, replace=False))
        order[[a, b]] = order[[b, a]]
        d.noise_scale = d.noise[order] / d.noise
        d.torque.append((key, lambda d, log, tau: tau[:, order]))
    else:
        scale = scale_of(d, kind)
        d.noise_scale = np.abs(scale)
        d.torque.append((key, lambda d, log, tau: scale * tau))


def scale_of(d: Draft, kind: str) -> np.ndarray:
    if kind == "sign":
        flipped = d.rng.random(d.n) < d.rng.choice([0.3, 1.0])
        flipped[1] = True
        return np.where(flipped, -1.0, 1.0)
    if kind == "unit":
        return np.full(d.n, d.rng.choice([1000.0, 0.73756, 0.101972, 8.85075]))
    if kind == "motor_side":
        return 1 / np.full(d.n, d.rng.choice([50.0, 100.0, 101.0, 160.0]))
    large = d.user.friction / d.user.friction.max()
    return 1 / (10 * np.where(large > 0.5, 1.3, 0.9) * d.rng.uniform(0.9, 1.1))


def gravity(arm: Arm, q: np.ndarray) -> np.ndarray:
    """Static torque on a fine grid: on every tenth row, between them linear."""
    zero = np.zeros(arm.n)
    arm = arm.with_joint(damping=zero, frictionloss=zero)
    rows = np.unique([*range(0, len(q), 10), len(q) - 1])
    some = inverse(arm, q[rows], 0 * q[rows], 0 * q[rows])
    return np.stack([np.interp(np.arange(len(q)), rows, column) for column in some.T], 1)


# -------------------------------------------------------------------------------- outside the catalogue


def eddy_brake(d: Draft, ratio: float):
    joints = d.one()
    knee = float(d.rng.uniform(0.12, 0.3) * d.user.speed[joints[0]])
    a = d.at(joints, 1.25 * ratio * d.noise)
    also = ["stribeck_friction", "coulomb_friction", "power_law_friction"]
    key = d.add("unknown", joints, per_joint("peak", joints, a, NM), what="eddy_brake")
    d.laws.append(physics.EddyBrake(key, a, knee))
    for name in also:
        d.allow(name, joints)


def velocity_product(d: Draft, ratio: float):
    first, second = (int(j) for j in d.rng.choice(d.n, 2, replace=False))
    joints = d.one()
    speeds = MOVING**2 * d.user.speed[first] * d.user.speed[second]
    c = d.at(joints, ratio * d.noise / speeds)
    key = d.add("unknown", joints, what="velocity_product")
    d.laws.append(physics.VelocityProduct(key, c, first, second))


def flange_drag(d: Draft, ratio: float):
    scale = float(ratio * np.median(d.noise) / (0.5 * 0.25**2))
    d.laws.append(physics.FlangeDrag(d.add("unknown", None, what="flange_drag"), scale))


def flywheel(d: Draft, ratio: float):
    """A spinning tool; its torque is the gyroscope's."""
    axis = d.rng.standard_normal(3)
    axis /= np.linalg.norm(axis)
    momentum = float(1.5 * min(ratio, 8.0) * np.median(d.noise))
    d.laws.append(physics.Flywheel(d.add("unknown", None, what="flywheel"), momentum, axis))


def link_length(d: Draft, ratio: float):
    """One link is longer or shorter than in the file; torque tells that from a moved mass only in part."""
    long = [k for k in range(1, d.n) if np.linalg.norm(d.user.links[k].offset) > 0.15]
    k = d.one(long)[0]
    error = float(d.rng.uniform(5e-3, 15e-3) * d.rng.choice([-1, 1]))
    link = d.user.links[k]
    grown = link.offset * (1 + error / np.linalg.norm(link.offset))
    links = tuple(replace(a, offset=grown) if i == k else a for i, a in enumerate(d.user.links))
    told = [("length_error", k - 1, error, "m")]
    key = d.add("unknown", None, told, ["inertial_parameters"], what="link_length")
    d.steps.append(Step(key, replace_arm(links=links)))


def cable_wrap(d: Draft, ratio: float):
    j = d.one()[0]
    reach = float(0.35 * d.user.reach[j])
    centre = float(d.user.home[j] + d.rng.uniform(-0.3, 0.3) * d.user.reach[j])
    key = d.add("unknown", [j], [], ["joint_spring"], what="cable_wrap")
    d.laws.append(physics.CableWrap(key, j, float(0.6 * ratio * d.noise[j]), centre, reach))
    for name in ("presliding_hysteresis", "coulomb_friction", "torque_offset"):
        d.allow(name, [j])


def sensor_hysteresis(d: Draft, ratio: float):
    """Play in the torque sensor: what it says follows the torque with the memory of Bouc and Wen."""
    load = d.load(moving=False)
    joints = d.one(np.argsort(-load)[:3])
    width = d.at(joints, 0.5 * load)
    size = d.at(joints, 1.4 * ratio * d.noise)
    key = d.add("unknown", joints, per_joint("width", joints, size, NM), what="sensor_hysteresis")

    def lag(d, log, tau):
        out = tau.copy()
        for j in joints:
            play, z = np.zeros(len(tau)), 0.0
            for k, step in enumerate(np.diff(tau[:, j], prepend=tau[0, j])):
                z = np.clip(z + step / width[j], -1.0, 1.0)
                play[k] = z
            out[:, j] -= size[j] * play
        return out

    d.torque.append((key, lag))
    for name in ("coulomb_friction", "presliding_hysteresis", "torque_gain"):
        d.allow(name, joints)


def sensor_saturation(d: Draft, ratio: float):
    """The sensor cannot say more than a certain torque."""
    load = d.load(moving=False)
    joints = d.one(np.argsort(-load)[:3])
    limit = np.where(d.at(joints, 1.0) > 0, d.rng.uniform(0.5, 0.9) * load, np.inf)
    key = d.add(
        "unknown", joints, [("limit", j, float(limit[j]), NM) for j in joints], what="sensor_saturation"
    )
    d.torque.append((key, lambda d, log, tau: np.clip(tau, -limit, limit)))
    d.allow("torque_gain", joints)


def sensor_lag(d: Draft, ratio: float):
    """One joint's torque goes through a slow filter of its own."""
    joints = d.one(np.argsort(-d.load())[:4])
    time = float(d.rng.uniform(0.05, 0.2))
    pole = np.exp(-DT / time)
    key = d.add("unknown", joints, [("lag", joints[0], time, "s")], what="sensor_lag")

    def filtered(d, log, tau):
        out = tau.copy()
        for j in joints:
            out[:, j] = lfilter([1 - pole], [1, -pole], tau[:, j], zi=[pole * tau[0, j]])[0]
        return out

    d.torque.append((key, filtered))
    for name in ("time_delay", "armature"):
        d.allow(name)


OUTSIDE = (
    eddy_brake,
    velocity_product,
    flange_drag,
    flywheel,
    link_length,
    cable_wrap,
    sensor_hysteresis,
    sensor_saturation,
    sensor_lag,
)
SINGLES = (
    viscous_friction,
    coulomb_friction,
    asymmetric_friction,
    stribeck_friction,
    load_dependent_friction,
    friction_drift,
    presliding_hysteresis,
    power_law_friction,
    torque_ripple,
    backlash,
    joint_elasticity,
    armature,
    inertial_parameters,
    payload,
    payload_change,
    gravity_direction,
    joint_spring,
    torque_offset,
    torque_gain,
    torque_drift,
    torque_crosstalk,
    encoder_offset,
    time_delay,
    external_contact,
    torque_meaning,
)


def placeholders(d: Draft):
    """Round numbers in the file, too large at every joint, as in files made for show."""
    every = range(d.n)
    large = float(d.user.friction.max()) > 2
    true_damping = 0.25 * d.user.friction * d.rng.uniform(0, 1, d.n)
    true_dry = 0.4 * d.user.friction * d.rng.uniform(0, 1, d.n) * d.rng.choice([0, 1])
    true_rotor = d.user.of("armature")
    damping = np.full(d.n, d.rng.choice([1.0, 2.0]) * (4.0 if large else 1.0))
    dry = np.full(d.n, 1.5 * d.user.friction.max()) * d.rng.choice([0, 0.5, 1.0])
    rotor = np.maximum(np.full(d.n, 0.1), 1.5 * true_rotor)
    d.user = d.user.with_joint(damping=damping, frictionloss=dry, armature=rotor)
    key = d.add("viscous_friction", every, per_joint("damping", every, true_damping - damping, NMS))
    d.steps.append(Step(key, set_joint("damping", np.zeros(d.n))))
    d.laws.append(physics.Viscous(key, true_damping))
    if np.any(dry) or np.any(true_dry):
        key = d.add("coulomb_friction", every, per_joint("coulomb", every, true_dry - dry, NM))
        d.steps.append(Step(key, set_joint("frictionloss", np.zeros(d.n))))
        d.dry(key, true_dry)
        d.allow("presliding_hysteresis", every)
    key = d.add("armature", every, per_joint("armature", every, true_rotor - rotor, KGM2))
    d.steps.append(Step(key, set_joint("armature", true_rotor)))
