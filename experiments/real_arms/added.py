"""What is added to a real log by independent code: MuJoCo's C engine and numpy.

An addition is made at a size of 1 (its unit) and scaled; it can be put into a log, and into a model's prediction
of the log that results.
"""

import dataclasses
from collections.abc import Callable

import chain as c
import numpy as np
from reference import Log, inner, motion, shifted

FAST = 20.0
"""What additions are computed from holds frequencies up to this [Hz]."""
FRICTION = (
    "coulomb_friction",
    "viscous_friction",
    "asymmetric_friction",
    "stribeck_friction",
    "presliding_hysteresis",
    "power_law_friction",
    "load_dependent_friction",
    "friction_drift",
)


def other_friction(name):
    return [x for x in FRICTION if x != name]


@dataclasses.dataclass(frozen=True)
class Added:
    """A known effect; `size` times what it is at size 1."""

    name: str
    joints: list
    form: Callable
    """(log, size) -> torque (T, n) that the effect adds, or with `kind` what that says."""
    told: Callable
    """size -> parameters for the truth."""
    kind: str = "torque"  # or gain, encoder, delay
    also: tuple = ()
    most: float = np.inf
    lasts: bool = True
    """Also in the held-out recording."""
    intervals: list | None = None

    def into(self, log: Log, size):
        """The log as it would have been recorded."""
        if self.kind == "torque":
            return log.but(tau=log.tau + self.form(log, size))
        j = self.joints[0] - 1 if self.joints else 0
        if self.kind == "gain":
            tau = log.tau.copy()
            tau[:, j] *= 1 + size
            return log.but(tau=tau)
        if self.kind == "encoder":
            q = log.q.copy()
            q[:, j] += size
            return log.but(q=q)
        return log.but(tau=shifted(log.tau, -size * log.rate))

    def predicted(self, chain, log: Log, size):
        """What a model with the effect says of a log that has it."""
        j = self.joints[0] - 1 if self.joints else 0
        if self.kind == "encoder":
            q = log.q.copy()
            q[:, j] -= size
            return c.torque(chain, *motion(log.but(q=q)))
        tau = c.torque(chain, *motion(log))
        if self.kind == "torque":
            return tau + self.form(log, size)
        if self.kind == "gain":
            tau[:, j] *= 1 + size
            return tau
        return shifted(tau, -size * log.rate)

    def rms(self, chain, logs, size):
        """(n,) of the torque it makes, while it acts [N m]; logs without the effect."""
        parts = []
        for log in logs:
            changed = self.into(log, size)
            made = self.predicted(chain, changed, size) - c.torque(chain, *motion(changed))
            made = made[inner(log)]
            if self.intervals is not None:
                made = made[np.any(made != 0, 1)]
            parts.append(made)
        return np.sqrt(np.mean(np.concatenate(parts) ** 2, 0))


def one(n, j, x):
    out = np.zeros((len(x), n))
    out[:, j - 1] = x
    return out


def number(name, joint, value, unit):
    return {"name": name, "joint": joint, "value": float(value), "unit": unit}


def _speed(log, j):
    return motion(log, FAST)[1][:, j - 1]


def coulomb(n, j):
    form = lambda log, s: s * one(n, j, np.tanh(_speed(log, j) / 0.005))
    told = lambda s: [number("coulomb", j, s, "N·m")]
    also = ("presliding_hysteresis", "asymmetric_friction", "power_law_friction")
    return Added("coulomb_friction", [j], form, told, also=also)


def viscous(n, j):
    form = lambda log, s: s * one(n, j, _speed(log, j))
    return Added(
        "viscous_friction",
        [j],
        form,
        lambda s: [number("damping", j, s, "N·m·s/rad")],
        also=("power_law_friction",),
    )


def stribeck(n, j, rise, speed):
    """Coulomb level s, `rise` times that at rest, falling off over `speed`."""

    def form(log, s):
        v = _speed(log, j)
        return s * one(n, j, np.tanh(v / 0.005) * (1 + (rise - 1) * np.exp(-((v / speed) ** 2))))

    told = lambda s: [
        number("coulomb", j, s, "N·m"),
        number("static", j, rise * s, "N·m"),
        number("stribeck_velocity", j, speed, "rad/s"),
    ]
    return Added("stribeck_friction", [j], form, told, also=("coulomb_friction", "presliding_hysteresis"))


def asymmetric(n, j, ratio):
    def form(log, s):
        v = _speed(log, j)
        return s * one(n, j, np.tanh(v / 0.005) * np.where(v > 0, 1.0, ratio))

    told = lambda s: [
        number("coulomb_positive", j, s, "N·m"),
        number("coulomb_negative", j, ratio * s, "N·m"),
    ]
    return Added("asymmetric_friction", [j], form, told, also=("coulomb_friction",))


def bristle(q, distance):
    """(T, n) Dahl's z, from -1 to 1: z' = v (1 - sgn(v) z) / distance [rad], exact where speed keeps its sign."""
    z = np.zeros_like(q)
    way = np.diff(q, axis=0)
    side, decay = np.sign(way), np.exp(-np.abs(way) / distance)
    for t in range(1, len(q)):
        z[t] = side[t - 1] + (z[t - 1] - side[t - 1]) * decay[t - 1]
    return z


def hysteresis(n, j, distance):
    """Friction s that builds up over a distance [rad]."""
    form = lambda log, s: s * one(n, j, bristle(motion(log, FAST)[0], distance)[:, j - 1])
    told = lambda s: [number("friction", j, s, "N·m"), number("distance", j, distance, "rad")]
    return Added("presliding_hysteresis", [j], form, told, also=("coulomb_friction",))


def spring(n, j, rest):
    form = lambda log, s: s * one(n, j, motion(log, FAST)[0][:, j - 1] - rest)
    told = lambda s: [number("stiffness", j, s, "N·m/rad"), number("rest", j, rest, "rad")]
    return Added("joint_spring", [j], form, told)


def ripple(n, j, order, phase):
    form = lambda log, s: s * one(n, j, np.sin(order * motion(log, FAST)[0][:, j - 1] + phase))
    told = lambda s: [number("amplitude", j, s, "N·m"), number("order", j, order, "1")]
    return Added("torque_ripple", [j], form, told)


def offset(n, j):
    form = lambda log, s: s * one(n, j, np.ones(len(log.time)))
    return Added("torque_offset", [j], form, lambda s: [number("offset", j, s, "N·m")])


def drift(n, j, constant):
    """From 0 to s, over `constant` seconds; it goes on with the stamps of the held-out recording."""
    form = lambda log, s: s * one(n, j, 1 - np.exp(-log.time / constant))
    told = lambda s: [number("drift", j, s, "N·m"), number("time_constant", j, constant, "s")]
    return Added("torque_drift", [j], form, told)


def crosstalk(chain, j, k):
    """A share of joint k's torque in joint j's sensor: of the model's torque, as the true one is not known."""
    n = chain.dof
    form = lambda log, s: s * one(n, j, c.torque(chain, *motion(log, FAST))[:, k - 1])
    told = lambda s: [number("crosstalk", j, s, "1"), number("from", j, k, "1")]
    return Added("torque_crosstalk", [j], form, told, most=0.4)


def load_friction(chain, j):
    n = chain.dof

    def form(log, s):
        q, v, a = motion(log, FAST)
        rigid = c.regressor(chain, q, v, a) @ chain.phi.ravel()
        return s * one(n, j, np.abs(rigid[:, j - 1]) * np.tanh(v[:, j - 1] / 0.005))

    told = lambda s: [number("share", j, s, "1")]
    also = ("coulomb_friction",)
    return Added("load_dependent_friction", [j], form, told, also=also, most=0.4)


def gain(j):
    return Added("torque_gain", [j], None, lambda s: [number("gain", j, 1 + s, "1")], "gain", most=0.45)


def encoder(j):
    return Added("encoder_offset", [j], None, lambda s: [number("offset", j, s, "rad")], "encoder", most=0.15)


def delay():
    return Added("time_delay", [], None, lambda s: [number("delay", None, s, "s")], "delay", most=0.06)


def _rigid(chain):
    zero = np.zeros(chain.dof)
    return chain.but(armature=zero, damping=zero, frictionloss=zero)


def body_torque(chain, mass, com, inertia, q, qd, qdd):
    """Difference of the C engine's inverse dynamics with and without the body."""
    arm = _rigid(chain)
    with_it = c.c_engine(c.mjcf(arm, (mass, np.asarray(com), inertia)), q, qd, qdd)
    return with_it - c.c_engine(c.mjcf(arm), q, qd, qdd)


def payload(chain, com, radius, until=None):
    """A ball fixed to the last link; from `until` = (start, stop) on only while it is held (payload_change)."""

    def form(log, s):
        unit = body_torque(chain, 1.0, com, 0.4 * radius**2 * np.eye(3), *motion(log, FAST))
        if until is not None:
            unit = unit * ((log.time >= until[0]) & (log.time < until[1]))[:, None]
        return s * unit

    told = lambda s: (
        [number("mass", None, s, "kg")]
        + [number(f"com_{axis}", None, x, "m") for axis, x in zip("xyz", com, strict=True)]
    )
    if until is None:
        return Added("payload", [], form, told, also=("inertial_parameters",))
    return Added("payload_change", [], form, told, intervals=[list(until)])


def tilt(chain, direction):
    """The base leans by s [rad] about a horizontal axis."""

    def form(log, s):
        motion_ = motion(log, FAST)
        g = chain.gravity
        axis = np.array([np.cos(direction), np.sin(direction), 0.0])
        leaned = g * np.cos(s) + np.cross(axis, g) * np.sin(s)
        arm = _rigid(chain)
        return c.c_engine(c.mjcf(arm.but(gravity=leaned)), *motion_) - c.c_engine(c.mjcf(arm), *motion_)

    g = np.linalg.norm(chain.gravity)
    told = lambda s: [
        number("gravity_x", None, g * np.sin(s) * -np.sin(direction), "m/s²"),
        number("gravity_y", None, g * np.sin(s) * np.cos(direction), "m/s²"),
    ]
    return Added("gravity_direction", [], form, told, most=0.12)


def contact(chain, link, point, direction, interval, ramp=0.15):
    """A force of s [N] on a link over an interval, coming and going within `ramp` seconds."""
    text = c.mjcf(chain)
    start, stop = interval

    def form(log, s):
        t = log.time
        pulse = np.clip(np.minimum((t - start) / ramp, (stop - t) / ramp), 0, 1)
        return c.pushed(text, motion(log, FAST)[0], s * pulse[:, None] * direction, point, link)

    told = lambda s: (
        [number("force", link, s, "N")]
        + [number(f"direction_{axis}", link, x, "1") for axis, x in zip("xyz", direction, strict=True)]
    )
    return Added(
        "external_contact",
        [link],
        form,
        told,
        lasts=False,
        intervals=[[float(start), float(stop)]],
        also=("payload_change",),
    )
