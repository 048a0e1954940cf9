"""What is concealed: each effect as plain code of its own, at random joints and of random shape.

An effect may change the plant (`plant`, `before`), act on the joints while they move (`level`: friction of
Coulomb's kind, in N m; `force`: any other opposing torque; `wrench`: forces from outside), sit between motor
and link (`twist`), or falsify what the sensors say (`observe`). `size` is scaled until the effect has the
wanted strength. Joint numbers are 0-based here, 1-based in truth.json.

The formulas are meant to differ in detail from those of a library of effects, as a real arm's do.
"""

from dataclasses import replace

import mujoco
import numpy as np
from arm import Body, N, SoftJoint
from scipy.signal import lfilter

SHOULDER = (0, 1, 2, 3)
BIG = np.array([1, 1, 1, 1, 0.4, 0.4, 0.4])


class Effect:
    """Base: nothing is changed; subclasses override what they do."""

    name = ""
    local = True  # whether it belongs to joints, and can sit on several
    candidates = tuple(range(N))
    likes_free = False  # prefers joints without known friction
    cap = np.inf
    memory = False

    def __init__(self, rng, joints, arm, seconds):
        self.joints = tuple(joints)
        self.size = np.ones(len(self.joints))
        self.interval = None  # [s], where it acts in an interval of one recording only
        self.outlives = True  # whether it goes on in the held-out motion
        self.draw(rng, arm, seconds)

    def draw(self, rng, arm, seconds):
        """Draw the shape; `self.size` is scaled afterwards."""

    def resize(self, factor):
        self.size = np.clip(self.size * factor, -self.cap, self.cap)

    def plant(self, arm):
        return arm

    def before(self, model, t):
        """Change the compiled plant at time t."""

    def level(self, t, q, v, load):
        """Friction level [N m] as (joint, level), for one sample or for columns of many."""
        return ()

    def force(self, t, q, v, load):
        """Torque against the motion [N m] as (joint, torque); added to what the actuators must give."""
        return ()

    def reset(self):
        """Forget the state, for effects with memory."""

    def wrench(self, model, data, t):
        """Joint torque [N m] that forces from outside put in."""
        return None

    def observe(self, t, q, tau):
        """What the sensors say instead of (q, tau)."""
        return q, tau

    def unobserve(self, q):
        """True position from the measured one."""
        return q

    def active(self, t):
        return (
            np.ones(len(t), bool)
            if self.interval is None
            else (t >= self.interval[0]) & (t <= self.interval[1])
        )

    def parameters(self):
        """(name, joint, value, unit) of each number."""
        return []

    def per_joint(self, name, values, unit):
        return [
            (name, j, float(x), unit)
            for j, x in zip(self.joints, np.broadcast_to(values, len(self.joints)), strict=True)
        ]


# -------------------------------------------------------------------------------- friction


class Viscous(Effect):
    name = "viscous_friction"

    def force(self, t, q, v, load):
        return [(j, c * v[..., j]) for j, c in zip(self.joints, self.size, strict=True)]

    def parameters(self):
        return self.per_joint("damping", self.size, "N·m·s/rad")


class Coulomb(Effect):
    name = "coulomb_friction"
    likes_free = True

    def level(self, t, q, v, load):
        return [(j, F + 0 * v[..., j]) for j, F in zip(self.joints, self.size, strict=True)]

    def parameters(self):
        return self.per_joint("coulomb", self.size, "N·m")


class Asymmetric(Effect):
    """Level, and at times slope, that are larger one way than the other."""

    name = "asymmetric_friction"
    likes_free = True

    def draw(self, rng, arm, seconds):
        ratio = rng.uniform(0.25, 0.6, len(self.joints))
        flip = rng.random(len(self.joints)) < 0.5
        self.up = np.where(flip, 1.0, ratio)
        self.down = np.where(flip, ratio, 1.0)
        self.slope = rng.uniform(0.2, 0.6) * (rng.random() < 0.4)

    def level(self, t, q, v, load):
        return [
            (j, F * np.where(v[..., j] > 0, up, down))
            for j, F, up, down in zip(self.joints, self.size, self.up, self.down, strict=True)
        ]

    def force(self, t, q, v, load):
        if not self.slope:
            return ()
        return [
            (j, self.slope * F * np.where(v[..., j] > 0, up, down) * v[..., j])
            for j, F, up, down in zip(self.joints, self.size, self.up, self.down, strict=True)
        ]

    def parameters(self):
        return (
            self.per_joint("coulomb_positive", self.size * self.up, "N·m")
            + self.per_joint("coulomb_negative", self.size * self.down, "N·m")
            + self.per_joint("viscous_share", self.slope, "s/rad")
        )


class Stribeck(Effect):
    """Level Fc + (Fs - Fc) exp(-|v / vs|^d) with an exponent that is nobody's default."""

    name = "stribeck_friction"
    likes_free = True

    def draw(self, rng, arm, seconds):
        self.ratio = rng.uniform(1.6, 3.0)
        self.speed = np.exp(rng.uniform(np.log(0.04), np.log(0.25)))
        self.exponent = rng.uniform(0.8, 2.2)

    def level(self, t, q, v, load):
        bump = [np.exp(-(np.abs(v[..., j] / self.speed) ** self.exponent)) for j in self.joints]
        return [
            (j, F * (1 + (self.ratio - 1) * b)) for j, F, b in zip(self.joints, self.size, bump, strict=True)
        ]

    def parameters(self):
        return (
            self.per_joint("coulomb", self.size, "N·m")
            + self.per_joint("static", self.size * self.ratio, "N·m")
            + self.per_joint("stribeck_velocity", self.speed, "rad/s")
            + self.per_joint("exponent", self.exponent, "1")
        )


class LoadDependent(Effect):
    """Friction that rises with the transmitted torque, a little rounded at no load."""

    name = "load_dependent_friction"
    candidates = (1, 2, 3)
    likes_free = True
    cap = 0.5

    def draw(self, rng, arm, seconds):
        self.power = rng.uniform(0.85, 1.15)
        self.viscous = rng.uniform(0, 0.3) * (rng.random() < 0.5)
        self.size = np.full(len(self.joints), 0.05)

    def level(self, t, q, v, load):
        return [
            (j, mu * np.abs(load[..., j]) ** self.power) for j, mu in zip(self.joints, self.size, strict=True)
        ]

    def force(self, t, q, v, load):
        if not self.viscous:
            return ()
        return [
            (j, self.viscous * mu * np.abs(load[..., j]) * v[..., j])
            for j, mu in zip(self.joints, self.size, strict=True)
        ]

    def parameters(self):
        return self.per_joint("friction_per_load", self.size, "1") + self.per_joint(
            "exponent", self.power, "1"
        )


class FrictionDrift(Effect):
    """Friction that changes while the joint warms up; the model knows one end of it."""

    name = "friction_drift"

    def draw(self, rng, arm, seconds):
        self.time = rng.uniform(0.25, 0.8) * seconds
        self.falls = rng.random() < 0.6
        self.linear = rng.random() < 0.3
        self.viscous = rng.uniform(0, 0.8)

    def _share(self, t):
        decay = np.maximum(0, 1 - t / (2 * self.time)) if self.linear else np.exp(-t / self.time)
        return decay if self.falls else 1 - decay

    def level(self, t, q, v, load):
        return [(j, F * self._share(t)) for j, F in zip(self.joints, self.size, strict=True)]

    def force(self, t, q, v, load):
        return [
            (j, self.viscous * F * self._share(t) * v[..., j])
            for j, F in zip(self.joints, self.size, strict=True)
        ]

    def parameters(self):
        return (
            self.per_joint("coulomb_change", self.size * (-1 if self.falls else 1), "N·m")
            + self.per_joint("time_constant", self.time, "s")
            + self.per_joint("viscous_share", self.viscous, "s/rad")
        )


class Presliding(Effect):
    """Friction with memory: LuGre's bristle, or several slip elements side by side (Maxwell)."""

    name = "presliding_hysteresis"
    memory = True

    def draw(self, rng, arm, seconds):
        self.bristle = rng.random() < 0.5
        self.distance = np.exp(rng.uniform(np.log(0.004), np.log(0.04)))
        elements = 4
        self.share = rng.dirichlet(np.full(elements, 4.0))
        self.slip = self.distance * np.geomspace(0.25, 1.6, elements)
        self.bump = rng.uniform(0, 0.3)
        self.reset()

    def reset(self):
        self.state = np.zeros((len(self.joints), len(self.slip)))
        self.last = None

    def force(self, t, q, v, load):
        if self.last is None:
            self.last = np.array([q[j] for j in self.joints])
        out = []
        for i, j in enumerate(self.joints):
            s = q[j] - self.last[i]
            self.last[i] = q[j]
            if self.bristle:
                z = self.state[i, 0]
                g = 1 + self.bump * np.exp(-abs(v[j]) / 0.05)
                z += s - abs(s) * z / (g * self.distance)
                self.state[i, 0] = z
                out.append((j, self.size[i] * z / self.distance))
            else:
                z = np.clip(self.state[i] + s / self.slip, -1, 1)
                self.state[i] = z
                out.append((j, self.size[i] * float(self.share @ z)))
        return out

    def parameters(self):
        return self.per_joint("coulomb", self.size, "N·m") + self.per_joint(
            "breakaway_distance", self.distance, "rad"
        )


# -------------------------------------------------------------------------------- transmission


class Ripple(Effect):
    """Two harmonics of the joint's (or its motor's) position."""

    name = "torque_ripple"

    def draw(self, rng, arm, seconds):
        slow = rng.random() < 0.5
        self.order = int(rng.integers(8, 61)) if slow else int(rng.choice([80, 100, 120, 160]))
        self.second = rng.uniform(0, 0.5)
        self.phase = rng.uniform(0, 2 * np.pi, (2, len(self.joints)))

    def force(self, t, q, v, load):
        return [
            (
                j,
                A
                * (
                    np.sin(self.order * q[..., j] + self.phase[0, i])
                    + self.second * np.sin(2 * self.order * q[..., j] + self.phase[1, i])
                ),
            )
            for i, (j, A) in enumerate(zip(self.joints, self.size, strict=True))
        ]

    def parameters(self):
        return (
            self.per_joint("amplitude", self.size, "N·m")
            + self.per_joint("order", self.order, "1/rev")
            + self.per_joint("second_harmonic", self.second * self.size, "N·m")
        )


class Soft(Effect):
    """Sensor and link joined by a law of their own: a hinge more in the plant."""

    def plant(self, arm):
        return replace(arm, soft=SoftJoint(self.joints[0], self.rotor))

    def twist(self, angle, rate):
        """Torque [N m] on the link for a twist [rad] of link against sensor."""
        raise NotImplementedError

    def settled(self, tau):
        """Twist [rad] under a slowly varying transmitted torque [N m]."""
        raise NotImplementedError


class Elasticity(Soft):
    """Two masses and a spring that stiffens a little."""

    name = "joint_elasticity"
    candidates = (1, 2, 3)
    cap = 1 / 350.0

    def draw(self, rng, arm, seconds):
        self.joints = self.joints[:1]
        self.rotor = rng.uniform(0.1, 0.3)
        self.size = np.array([1 / 3000.0])
        self.cubic = rng.uniform(0, 0.3)
        self.ratio = rng.uniform(0.08, 0.25)

    def twist(self, angle, rate):
        K = 1 / self.size[0]
        swing = angle * K / 30.0
        return -K * angle * (1 + self.cubic * swing * swing) - 2 * self.ratio * np.sqrt(K * 0.2) * rate

    def settled(self, tau):
        x = -tau * self.size[0]
        for _ in range(8):
            swing = x / self.size[0] / 30.0
            x = -tau * self.size[0] / (1 + self.cubic * swing * swing)
        return x

    def parameters(self):
        return self.per_joint("stiffness", 1 / self.size, "N·m/rad")


class Backlash(Soft):
    """A gap of `2 size` [rad] between stiff stops."""

    name = "backlash"
    candidates = (1, 2, 3, 4)
    cap = 0.04

    def draw(self, rng, arm, seconds):
        self.joints = self.joints[:1]
        self.rotor = rng.uniform(0.05, 0.15)
        self.size = np.array([0.003])
        self.stop = rng.uniform(2500, 5000)

    def twist(self, angle, rate):
        beyond = angle - min(max(angle, -self.size[0]), self.size[0])
        return -self.stop * beyond - (3.0 * rate if beyond else 0.05 * rate)

    def settled(self, tau):
        return -tau / self.stop - self.size[0] * np.tanh(tau / 0.3)

    def parameters(self):
        return self.per_joint("gap", 2 * self.size, "rad")


# -------------------------------------------------------------------------------- inertia and load


class Armature(Effect):
    name = "armature"

    def draw(self, rng, arm, seconds):
        self.size = 0.1 * BIG[list(self.joints)]
        self.cap = 1.5

    def plant(self, arm):
        armature = arm.armature.copy()
        armature[list(self.joints)] += self.size
        return replace(arm, armature=armature)

    def parameters(self):
        return self.per_joint("armature", self.size, "kg·m²")


class Inertial(Effect):
    """One link is not what the model says: mass, centre and inertia together."""

    name = "inertial_parameters"
    local = False
    candidates = (1, 2, 3, 4, 5, 6)
    cap = 6.0

    def draw(self, rng, arm, seconds):
        self.joints = self.joints[:1]
        self.size = np.array([0.1])
        self.mass = rng.uniform(0.3, 1) * rng.choice([-1, 1])
        self.shift = rng.standard_normal(3) * 0.03
        self.swell = rng.uniform(0, 1)

    def plant(self, arm):
        links = list(arm.links)
        body = links[self.joints[0]]
        s = self.size[0]
        scale = max(1 + self.mass * s, 0.15)
        links[self.joints[0]] = Body(
            body.mass * scale, body.com + self.shift * s, body.inertia * (1 + self.swell * s) * scale
        )
        return replace(arm, links=tuple(links))

    def parameters(self):
        return self.per_joint("mass_share", self.mass * self.size, "1") + [
            (f"com_{axis}", self.joints[0], float(x), "m")
            for axis, x in zip("xyz", self.shift * self.size[0], strict=True)
        ]


class Payload(Effect):
    """A body at the flange that the model does not have."""

    name = "payload"
    local = False
    candidates = (6,)
    cap = 5.0

    def draw(self, rng, arm, seconds):
        self.joints = (6,)
        self.com = np.array([*rng.uniform(-0.04, 0.04, 2), rng.uniform(0.02, 0.12)])
        self.radius = rng.uniform(0.02, 0.06, 3)
        self.size = np.array([0.3])

    def body(self):
        m = self.size[0]
        a, b, c = self.radius
        return Body(m, self.com, m * np.array([b * b + c * c, a * a + c * c, a * a + b * b, 0, 0, 0]))

    def plant(self, arm):
        return replace(arm, load=self.body())

    def parameters(self):
        return self.per_joint("mass", self.size, "kg") + [
            (f"com_{axis}", 6, float(x), "m") for axis, x in zip("xyz", self.com, strict=True)
        ]


class PayloadChange(Payload):
    """A body at the flange, taken up or put down at one instant."""

    name = "payload_change"

    def draw(self, rng, arm, seconds):
        super().draw(rng, arm, seconds)
        when = rng.uniform(0.25, 0.75) * seconds
        self.gained = rng.random() < 0.5
        self.interval = (when, np.inf) if self.gained else (-np.inf, when)

    def before(self, model, t):
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "load")
        there = self.interval[0] <= t <= self.interval[1]
        if there != (model.body_mass[index] > 0):
            body = self.body()
            model.body_mass[index] = body.mass * there
            model.body_inertia[index] = np.sort(body.inertia[:3])[::-1] * there


class Gravity(Effect):
    """A base that is not level."""

    name = "gravity_direction"
    local = False
    cap = 0.6

    def draw(self, rng, arm, seconds):
        self.joints = tuple(range(N))
        self.size = np.array([0.01])
        self.heading = rng.uniform(0, 2 * np.pi)

    def plant(self, arm):
        tilt = self.size[0]
        down = np.array(
            [np.sin(tilt) * np.cos(self.heading), np.sin(tilt) * np.sin(self.heading), -np.cos(tilt)]
        )
        return replace(arm, gravity=np.linalg.norm(arm.gravity) * down)

    def parameters(self):
        return [("tilt", 0, float(self.size[0]), "rad"), ("heading", 0, float(self.heading), "rad")]


class Spring(Effect):
    """A cable or hose that pulls, and pulls harder when it is taut."""

    name = "joint_spring"

    def draw(self, rng, arm, seconds):
        self.rest = (
            rng.uniform(-0.6, 0.6, len(self.joints))
            + np.array([0.0, -0.785, 0.0, -2.2, 0.0, 1.6, 0.785])[list(self.joints)]
        )
        self.cubic = rng.uniform(0, 0.8)

    def force(self, t, q, v, load):
        out = []
        for j, k, rest in zip(self.joints, self.size, self.rest, strict=True):
            x = q[..., j] - rest
            out.append((j, k * (x + self.cubic * x * x * x)))
        return out

    def parameters(self):
        return (
            self.per_joint("stiffness", self.size, "N·m/rad")
            + self.per_joint("reference", self.rest, "rad")
            + self.per_joint("cubic", self.cubic * self.size, "N·m/rad³")
        )


# -------------------------------------------------------------------------------- sensors


class Offset(Effect):
    name = "torque_offset"

    def draw(self, rng, arm, seconds):
        self.sign = rng.choice([-1.0, 1.0], len(self.joints))

    def observe(self, t, q, tau):
        tau = tau.copy()
        tau[:, list(self.joints)] += self.sign * self.size
        return q, tau

    def parameters(self):
        return self.per_joint("offset", self.sign * self.size, "N·m")


class Gain(Effect):
    name = "torque_gain"
    candidates = (1, 2, 3, 4, 5)
    cap = 0.6

    def draw(self, rng, arm, seconds):
        self.sign = rng.choice([-1.0, 1.0], len(self.joints))
        self.size = np.full(len(self.joints), 0.05)

    def observe(self, t, q, tau):
        tau = tau.copy()
        tau[:, list(self.joints)] *= 1 + self.sign * self.size
        return q, tau

    def parameters(self):
        return self.per_joint("gain", 1 + self.sign * self.size, "1")


class Drift(Effect):
    """Bias that creeps: saturating, straight, or a slow wander."""

    name = "torque_drift"

    def draw(self, rng, arm, seconds):
        self.kind = rng.choice(["creep", "ramp", "wander"])
        self.time = rng.uniform(0.3, 0.8) * seconds
        self.sign = rng.choice([-1.0, 1.0], len(self.joints))
        self.phase = rng.uniform(0, 2 * np.pi, 2)

    def observe(self, t, q, tau):
        x = t / self.time
        if self.kind == "creep":
            bias = 1 - np.exp(-x)
        elif self.kind == "ramp":
            bias = 0.6 * np.minimum(x, 1.8)
        else:
            bias = np.sin(1.3 * x + self.phase[0]) + 0.5 * np.sin(2.9 * x + self.phase[1])
            bias = bias - (np.sin(self.phase[0]) + 0.5 * np.sin(self.phase[1]))
        tau = tau.copy()
        tau[:, list(self.joints)] += bias[:, None] * self.sign * self.size
        return q, tau

    def parameters(self):
        return self.per_joint("drift", self.sign * self.size, "N·m") + self.per_joint(
            "time_constant", self.time, "s"
        )


class Crosstalk(Effect):
    """A joint's sensor also sees the torque of a loaded joint."""

    name = "torque_crosstalk"
    cap = 0.6

    def draw(self, rng, arm, seconds):
        self.joints = self.joints[:1]
        self.source = int(rng.choice([j for j in (1, 2, 3) if j != self.joints[0]]))
        self.sign = rng.choice([-1.0, 1.0])
        self.size = np.array([0.02])

    def observe(self, t, q, tau):
        seen = tau.copy()
        seen[:, self.joints[0]] += self.sign * self.size[0] * tau[:, self.source]
        return q, seen

    def parameters(self):
        return [
            *self.per_joint("crosstalk", self.sign * self.size, "1"),
            ("source", self.source, self.source + 1.0, "1"),
        ]


class EncoderOffset(Effect):
    name = "encoder_offset"
    candidates = (1, 2, 3, 4, 5)
    cap = 0.4

    def draw(self, rng, arm, seconds):
        self.joints = self.joints[:1]
        self.sign = rng.choice([-1.0, 1.0])
        self.size = np.array([0.01])

    def observe(self, t, q, tau):
        q = q.copy()
        q[:, self.joints[0]] += self.sign * self.size[0]
        return q, tau

    def unobserve(self, q):
        q = q.copy()
        q[:, self.joints[0]] -= self.sign * self.size[0]
        return q

    def parameters(self):
        return self.per_joint("offset", self.sign * self.size, "rad")


class Delay(Effect):
    """Torque that comes late: by a dead time, or through a first-order filter."""

    name = "time_delay"
    local = False
    cap = 0.05

    def draw(self, rng, arm, seconds):
        self.joints = tuple(range(N))
        self.filter = rng.random() < 0.4
        self.size = np.array([0.004])

    def observe(self, t, q, tau):
        d = self.size[0]
        if self.filter:
            pole = np.exp(-(t[1] - t[0]) / d)
            late, _ = lfilter([1 - pole], [1, -pole], tau, axis=0, zi=pole * tau[:1])
        else:
            late = np.stack([np.interp(t - d, t, column) for column in tau.T], axis=1)
        return q, late

    def parameters(self):
        return [("lag" if self.filter else "delay", 0, float(self.size[0]), "s")]


# -------------------------------------------------------------------------------- environment


class Contact(Effect):
    """A push on one link for a while; steady, swelling, or with soft flanks."""

    name = "external_contact"
    local = False
    candidates = (2, 3, 4, 5, 6)
    cap = 80.0

    def draw(self, rng, arm, seconds):
        self.joints = self.joints[:1]
        length = rng.uniform(0.6, 3.0)
        start = rng.uniform(0.8, seconds - length - 0.8)
        self.interval = (start, start + length)
        self.outlives = False
        self.direction = rng.standard_normal(3)
        self.direction /= np.linalg.norm(self.direction)
        self.point = rng.uniform(-0.05, 0.05, 3)
        self.profile = rng.choice(["steady", "half_sine", "flanks"])
        self.flank = rng.uniform(0.03, 0.12)

    def _newton(self, t):
        start, end = self.interval
        if not start <= t <= end:
            return 0.0
        if self.profile == "half_sine":
            return self.size[0] * np.sin(np.pi * (t - start) / (end - start))
        if self.profile == "flanks":
            return self.size[0] * min(1.0, (t - start) / self.flank, (end - t) / self.flank)
        return self.size[0]

    def wrench(self, model, data, t):
        newton = self._newton(t)
        if not newton:
            return None
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, f"link{self.joints[0] + 1}")
        point = data.xpos[body] + data.xmat[body].reshape(3, 3) @ self.point
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, jacobian, None, point, body)
        return newton * (jacobian.T @ self.direction)

    def parameters(self):
        return self.per_joint("force", self.size, "N") + [
            (f"direction_{axis}", self.joints[0], float(x), "1")
            for axis, x in zip("xyz", self.direction, strict=True)
        ]


# -------------------------------------------------------------------------------- outside the catalogue


class Detent(Effect):
    """A magnet or notch: torque that belongs to one place on the way."""

    name = "outside:detent"

    def draw(self, rng, arm, seconds):
        home = np.array([0.0, -0.785, 0.0, -2.2, 0.0, 1.6, 0.785])[list(self.joints)]
        self.place = home + rng.uniform(-0.15, 0.15, len(self.joints))
        self.width = rng.uniform(0.02, 0.06)

    def force(self, t, q, v, load):
        out = []
        for j, A, place in zip(self.joints, self.size, self.place, strict=True):
            x = (q[..., j] - place) / self.width
            out.append((j, A * x * np.exp(-x * x / 2)))
        return out


class FrictionCoupling(Effect):
    """A shared gearbox: one joint feels another's friction."""

    name = "outside:friction_coupling"

    def draw(self, rng, arm, seconds):
        self.joints = self.joints[:1]
        self.other = int(rng.choice([j for j in range(N) if abs(j - self.joints[0]) == 1]))

    def force(self, t, q, v, load):
        return [(self.joints[0], self.size[0] * np.tanh(v[..., self.other] / 0.02))]


class Saturation(Effect):
    """A torque sensor that cannot read further."""

    name = "outside:saturation"
    candidates = (1, 2, 3)
    cap = 0.98

    def draw(self, rng, arm, seconds):
        self.joints = self.joints[:1]
        self.size = np.array([0.2])
        self.peak = None

    def observe(self, t, q, tau):
        x = tau[:, self.joints[0]]
        if self.peak is None:
            self.peak = np.max(np.abs(x))
        tau = tau.copy()
        limit = self.peak * (1 - min(self.size[0], self.cap))
        tau[:, self.joints[0]] = np.clip(x, -limit, limit)
        return q, tau


class BaseVibration(Effect):
    """The table shakes at a frequency of its own."""

    name = "outside:base_vibration"
    local = False

    def draw(self, rng, arm, seconds):
        self.joints = tuple(range(N))
        self.hertz = rng.uniform(3, 12)
        self.direction = rng.standard_normal(3)
        self.direction /= np.linalg.norm(self.direction)
        self.phase = rng.uniform(0, 2 * np.pi)
        self.still = arm.gravity.copy()

    def before(self, model, t):
        model.opt.gravity[:] = (
            self.still + self.size[0] * np.sin(2 * np.pi * self.hertz * t + self.phase) * self.direction
        )


class PositionFriction(Effect):
    """Friction that depends on where the joint is."""

    name = "outside:position_dependent_friction"
    likes_free = True

    def draw(self, rng, arm, seconds):
        self.wave = rng.uniform(2.5, 5)
        self.phase = rng.uniform(0, 2 * np.pi)

    def level(self, t, q, v, load):
        return [
            (j, F * (0.5 - 0.5 * np.cos(self.wave * q[..., j] + self.phase)) ** 2)
            for j, F in zip(self.joints, self.size, strict=True)
        ]


class CubicCoupling(Effect):
    """A tendon across two joints: torque from the product of their positions."""

    name = "outside:cubic_coupling"

    def draw(self, rng, arm, seconds):
        self.joints = self.joints[:1]
        self.other = int(rng.choice([j for j in range(N) if j != self.joints[0]]))
        self.home = np.array([0.0, -0.785, 0.0, -2.2, 0.0, 1.6, 0.785])

    def force(self, t, q, v, load):
        x = q[..., self.joints[0]] - self.home[self.joints[0]]
        y = q[..., self.other] - self.home[self.other]
        return [(self.joints[0], self.size[0] * (x * y * y + y * y * y - 0.5 * x * x * y))]


class EvenInSpeed(Effect):
    """Torque that rises with the speed and does not know its sign."""

    name = "outside:even_in_speed"

    def force(self, t, q, v, load):
        return [
            (j, c * v[..., j] ** 2 / (0.3 + v[..., j] ** 2))
            for j, c in zip(self.joints, self.size, strict=True)
        ]


class SensorCompression(Effect):
    """A torque sensor that flattens towards large torques."""

    name = "outside:sensor_compression"
    candidates = (1, 2, 3)

    def draw(self, rng, arm, seconds):
        self.joints = self.joints[:1]
        self.cap = 0.02
        self.size = np.array([1e-3])

    def observe(self, t, q, tau):
        tau = tau.copy()
        x = tau[:, self.joints[0]]
        tau[:, self.joints[0]] = x / (1 + self.size[0] * x * x) ** 0.5
        return q, tau


CATALOGUE = (
    Viscous,
    Coulomb,
    Asymmetric,
    Stribeck,
    LoadDependent,
    FrictionDrift,
    Presliding,
    Ripple,
    Backlash,
    Elasticity,
    Armature,
    Inertial,
    Payload,
    PayloadChange,
    Gravity,
    Spring,
    Offset,
    Gain,
    Drift,
    Crosstalk,
    EncoderOffset,
    Delay,
    Contact,
)
OUTSIDE = (
    Detent,
    FrictionCoupling,
    Saturation,
    BaseVibration,
    PositionFriction,
    CubicCoupling,
    EvenInSpeed,
    SensorCompression,
)


def draw_joints(kind, rng, arm):
    """One joint, at times two; where friction is concealed, rather a joint that has none in the model."""
    allowed = np.array(kind.candidates)
    if kind.likes_free and np.any(arm.frictionloss[allowed] == 0):
        allowed = allowed[arm.frictionloss[allowed] == 0]
    several = kind.local and len(allowed) > 1 and rng.random() < 0.2
    return sorted(int(j) for j in rng.choice(allowed, 2 if several else 1, replace=False))
