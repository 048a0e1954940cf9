"""Which causes a case conceals, and how large: so many times the sensor noise on the commanded motion."""

from dataclasses import dataclass

import numpy as np
from arms import possible, with_load
from laws import AT_REST, BEYOND, Beyond, Periodic, Spring
from plant import Contact, G, Plan, Rigid

SHARES = {
    "control": 0.25,
    "one": 0.30,
    "friction_all": 0.15,
    "mixed": 0.20,
    "placeholder": 0.05,
    "beyond": 0.05,
}
CONTROLS = ("sticking", "identified links", "coarse encoders", "heavy tails", "ringing", "plain")
FRICTION = (
    "viscous_friction",
    "coulomb_friction",
    "asymmetric_friction",
    "stribeck_friction",
    "load_dependent_friction",
    "friction_drift",
    "presliding_hysteresis",
    "power_law_friction",
)
OTHERS = (
    "torque_ripple",
    "backlash",
    "joint_elasticity",
    "armature",
    "inertial_parameters",
    "payload",
    "payload_change",
    "gravity_direction",
    "joint_spring",
    "torque_offset",
    "torque_gain",
    "torque_drift",
    "torque_crosstalk",
    "encoder_offset",
    "time_delay",
    "external_contact",
    "torque_meaning",
)
NEAR = {  # what else is as right to say of a cause of that name, at the same joint
    "payload": ["inertial_parameters"],
    "coulomb_friction": ["presliding_hysteresis"],
    "presliding_hysteresis": ["coulomb_friction"],
    "stribeck_friction": [],
    "unknown": [],
}
TOLERATED = {  # what is neither right nor wrong beside a cause of that name, at the same joint
    "asymmetric_friction": ["coulomb_friction", "presliding_hysteresis", "torque_offset"],
    "stribeck_friction": [
        "coulomb_friction",
        "presliding_hysteresis",
        "power_law_friction",
        "viscous_friction",
    ],
    "load_dependent_friction": ["coulomb_friction", "presliding_hysteresis"],
    "friction_drift": ["coulomb_friction", "viscous_friction", "presliding_hysteresis"],
    "power_law_friction": [
        "coulomb_friction",
        "viscous_friction",
        "presliding_hysteresis",
        "stribeck_friction",
    ],
    "presliding_hysteresis": ["stribeck_friction"],
    "coulomb_friction": ["power_law_friction"],
    "viscous_friction": ["power_law_friction"],
    "joint_spring": ["torque_offset"],
    "backlash": ["presliding_hysteresis", "unknown"],
    "joint_elasticity": ["armature", "unknown"],
    "payload_change": ["external_contact"],
    "time_delay": [],
}


@dataclass
class Sight:
    """The training motions as commanded, every few hundredths of a second, and the torque they take."""

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    t: np.ndarray
    tau: np.ndarray
    seconds: list[float]
    dt: float  # of this grid


class Scaler:
    """Adds causes to a plan."""

    def __init__(self, plan: Plan, sight: Sight, rng: np.random.Generator):
        self.plan, self.sight, self.rng = plan, sight, rng
        self.n, self.noise, self.most = plan.arm.n, plan.noise, np.array(plan.arm.torque, float)
        self.busy: set[int] = set()
        self.bare = Rigid(plan.arm, plan.phi_true, G)
        self.plain = self.bare.torque(sight.q, sight.v, sight.a)

    def add(self, name: str) -> None:
        cause = {"effect": name, "joints": None, "parameters": []}
        self.plan.causes.append(cause)
        getattr(self, "_" + name)(cause)
        joints = cause["joints"]
        for other in TOLERATED.get(name, []):
            self.plan.allowed.append({"effect": other, "joints": joints})

    def _size(self) -> float:
        return float(np.exp(self.rng.uniform(np.log(2), np.log(13))))

    def _joint(self, signal: np.ndarray, cause: dict) -> int:
        """A joint whose signal is not much weaker, against the noise, than the strongest joint's."""
        level = np.sqrt(np.mean(signal**2, 0)) / self.noise
        good = [j for j in range(self.n) if level[j] >= 0.2 * level.max() and j not in self.busy]
        j = int(self.rng.choice(good)) if good else int(np.argmax(level))
        self.busy.add(j)
        cause["joints"] = [j + 1]
        return j

    def _fit(self, signal: np.ndarray, j: int) -> float:
        """Factor on the signal of joint j that gives the wanted torque, at most a fifth of the limit."""
        wanted = min(self._size() * self.noise[j], 0.2 * self.most[j])
        return wanted / max(float(np.sqrt(np.mean(signal[:, j] ** 2))), 1e-9)

    def _whole(self, signal: np.ndarray) -> float:
        level = np.sqrt(np.mean(signal**2, 0))
        return min(self._size() / np.max(level / self.noise), np.min(0.3 * self.most / (level + 1e-12)))

    def note(self, cause: dict, j: int | None, **values: tuple[float, str]) -> None:
        cause["parameters"] += [
            {"name": key, "joint": None if j is None else j + 1, "value": float(value), "unit": unit}
            for key, (value, unit) in values.items()
        ]

    def _way(self) -> np.ndarray:
        return np.tanh(self.sight.v / AT_REST)

    def _known(self, j: int, level: float) -> None:
        """Dry friction that the user's file has; in truth it builds up over a breakaway distance."""
        self.plan.friction.coulomb[j] = level
        self.plan.user["frictionloss"][j] = level
        self.plan.role["coulomb"][j] = "presliding_hysteresis"

    def _viscous_friction(self, cause):
        j = self._joint(self.sight.v, cause)
        extra = self._fit(self.sight.v, j)
        self.plan.friction.viscous[j] += extra
        self.note(cause, j, damping=(extra, "N·m·s/rad"))

    def _coulomb_friction(self, cause):
        j = self._joint(self._way(), cause)
        level = self._fit(self._way(), j)
        self.plan.friction.coulomb[j] = self.plan.user["frictionloss"][j] + level
        self.plan.role["coulomb"][j] = "coulomb_friction"
        self.note(cause, j, coulomb=(level, "N·m"), breakaway=(self.plan.friction.breakaway[j], "rad"))

    def _presliding_hysteresis(self, cause):
        j = self._joint(self._way(), cause)
        span = float(np.ptp(self.sight.q[:, j]))
        width = min(self.rng.uniform(0.01, 0.05), 0.08 * span)
        level = self._fit(self._way(), j) * self.rng.uniform(1.0, 2.0)
        self.plan.friction.breakaway[j] = width
        if self.rng.random() < 0.5:
            self._known(j, level)
        else:
            self.plan.user["frictionloss"][j], self.plan.friction.coulomb[j] = 0, level
            self.plan.role["coulomb"][j] = "presliding_hysteresis"
        self.note(cause, j, coulomb=(level, "N·m"), breakaway=(width, "rad"))

    def _refined(self, j: int, name: str, least: float) -> None:
        """The dry friction beneath a refinement: in the user's file, or concealed under the same name."""
        level = max(least, self.plan.friction.coulomb[j])
        if (
            self.plan.role["coulomb"][j] == "coulomb_friction"
            and self.plan.friction.coulomb[j] > 0
            and (self.plan.user["frictionloss"][j] == 0)
        ):
            self.plan.friction.coulomb[j] = level
        elif self.rng.random() < 0.5:
            self._known(j, level)
        else:
            self.plan.user["frictionloss"][j], self.plan.friction.coulomb[j] = 0, level
            self.plan.role["coulomb"][j] = name

    def _asymmetric_friction(self, cause):
        j = self._joint(self._way(), cause)
        more = self._fit(self._way(), j) * float(self.rng.choice([-1, 1]))
        self._refined(j, "asymmetric_friction", 1.3 * abs(more))
        self.plan.friction.asymmetry[j] = more
        level = self.plan.friction.coulomb[j]
        self.note(cause, j, coulomb_forward=(level + more, "N·m"), coulomb_backward=(level - more, "N·m"))

    def _stribeck_friction(self, cause):
        f, width = self.plan.friction, self.rng.uniform(0.05, 0.25)
        shape = np.exp(-((self.sight.v / width) ** 2)) * self._way()
        j = self._joint(shape, cause)
        f.extra[j] = min(self._fit(shape, j), 0.05 * self.most[j])
        f.v_stribeck[j] = width
        self._refined(j, "stribeck_friction", f.extra[j] * self.rng.uniform(0.8, 2))
        self.note(
            cause,
            j,
            coulomb=(f.coulomb[j], "N·m"),
            static=(f.coulomb[j] + f.extra[j], "N·m"),
            stribeck_velocity=(width, "rad/s"),
        )

    def _load_dependent_friction(self, cause):
        shape = np.abs(self.sight.tau) * self._way()
        j = self._joint(shape, cause)
        k = min(self._fit(shape, j), 0.2)
        self.plan.friction.load[j] = k
        self._refined(j, "load_dependent_friction", k * np.mean(np.abs(self.sight.tau[:, j])))
        self.note(cause, j, load_coefficient=(k, "1"))

    def _friction_drift(self, cause):
        f = self.plan.friction
        j = self._joint(self._way(), cause)
        last = self.rng.uniform(0.25, 0.6) * self.sight.seconds[0]
        fade = np.exp(-self.sight.t / last)[:, None]
        first = self.sight.t < self.sight.seconds[0]
        least = min(self._fit((self._way() * fade)[first], j) / 0.9, 14 * self.noise[j])
        if f.coulomb[j] < least:
            if self.plan.user["frictionloss"][j] == 0 and f.coulomb[j] > 0:
                f.coulomb[j] = least
            else:
                self._known(j, least)
        f.cold[j], f.warm_time[j] = min(0.9 * least / f.coulomb[j], 1.0), last
        self.note(cause, j, cold_excess=(f.cold[j], "1"), time_constant=(last, "s"))

    def _power_law_friction(self, cause):
        f, p = self.plan.friction, self.rng.uniform(0.3, 0.7)
        shape = np.abs(self.sight.v) ** p * self._way()
        j = self._joint(shape, cause)
        f.power[j], f.exponent[j] = self._fit(shape, j), p
        self.note(cause, j, coefficient=(f.power[j], "N·m·(s/rad)^p"), exponent=(p, "1"))

    def _torque_ripple(self, cause):
        j = self._joint(self.sight.v, cause)
        size = self._fit(np.full_like(self.sight.v, np.sqrt(0.5)), j) * np.array(
            [1, self.rng.uniform(0.2, 0.8)]
        )
        per_turn = self.plan.arm.gear[j] if self.rng.random() < 0.65 else int(self.rng.integers(3, 12))
        a, c, p = np.zeros((2, self.n)), np.ones((2, self.n)), np.zeros((2, self.n))
        a[:, j], c[:, j], p[:, j] = size, [per_turn, 2 * per_turn], self.rng.uniform(0, 6.28, 2)
        self.plan.ripple = Periodic(a, c, p)
        self.note(cause, j, amplitude=(size[0], "N·m"), cycles=(per_turn, "1/turn"), second=(size[1], "N·m"))

    def _backlash(self, cause):
        both_ways = 2 * np.minimum(np.mean(self.plain > 0, 0), np.mean(self.plain < 0, 0))
        j = self._joint(self.plain * both_ways, cause)
        worn = 0.03 if self.most.max() < 30 else 0.01 if self.most.max() < 1000 else 0.0025
        width = worn * self.rng.uniform(0.3, 1)
        self.plan.play[j] = width
        self.note(cause, j, gap=(width, "rad"))

    def _joint_elasticity(self, cause):
        s = self.sight
        change = np.zeros_like(s.tau)
        step = 1e-4
        for j in range(self.n):
            bend = np.zeros_like(s.q)
            bend[:, j] = step * s.tau[:, j] / self.most[j]
            bent = np.gradient(np.gradient(bend, s.dt, axis=0), s.dt, axis=0)
            change[:, j] = (self.bare.torque(s.q - bend, s.v, s.a - bent) - self.plain)[:, j]
        j = self._joint(change, cause)
        worst = step * self._fit(change, j)
        inertia = self.bare.mass(np.array(self.plan.arm.home, float))[j, j]
        k = np.clip(self.most[j] / worst, (2 * np.pi * 5) ** 2 * inertia, (2 * np.pi * 15) ** 2 * inertia)
        self.plan.stiffness[j] = float(k)
        self.note(cause, j, stiffness=(k, "N·m/rad"))

    def _armature(self, cause):
        user = self.plan.user["armature"]
        j = self._joint(self.sight.a * self.plan.armature, cause)
        wanted = self._fit(self.sight.a, j)
        self.plan.armature[j] *= np.clip(wanted / self.plan.armature[j], 0.6, 1.6)
        user[j] = 0.0
        self.note(cause, j, armature=(self.plan.armature[j], "kg·m²"))

    def _inertial_parameters(self, cause):
        plan = self.plan
        joints = np.arange(1, self.n)
        link = int(self.rng.choice(joints))
        sign = float(self.rng.choice([-1, 1]))
        shift = 0.15 * sign * np.abs(plan.phi_named[link, 1:4]) * self.rng.uniform(0, 1, 3)

        def wrong(x: float) -> np.ndarray:
            phi = plan.phi_named.copy()
            phi[link, 0] *= 1 + sign * x
            phi[link, 4:] *= 1 + sign * x
            phi[link, 1:4] += shift * x
            return phi

        s = self.sight
        change = Rigid(plan.arm, wrong(0.2), G).torque(s.q, s.v, s.a) - Rigid(
            plan.arm, plan.phi_named, G
        ).torque(s.q, s.v, s.a)
        phi = wrong(float(np.clip(0.2 * self._whole(change), 0.03, 0.6)))
        if not possible(phi):
            raise ValueError(f"impossible link {link + 1}")
        plan.phi_user = phi
        cause["joints"] = [link + 1]
        cause["also"] = ["payload"] if link == self.n - 1 else []
        right = plan.phi_named[link]
        self.note(
            cause,
            link,
            mass=(right[0] - phi[link, 0], "kg"),
            **{f"com_{x}": (right[k + 1] - phi[link, k + 1], "m") for k, x in enumerate("xyz")},
        )

    def _load(self, cause, part: slice):
        plan, s, size = self.plan, self.sight, 0.04 + 0.12 * np.cbrt(self.plan.arm.payload / 10)
        com = plan.arm.tool * (1 + 0.5 * size / np.linalg.norm(plan.arm.tool)) + self.rng.normal(
            0, 0.15 * size, 3
        )
        light = 0.1 * plan.arm.payload
        change = self.bare.torque(s.q[part], s.v[part], s.a[part])
        change = (
            Rigid(plan.arm, with_load(plan.phi_true, light, com, size), G).torque(
                s.q[part], s.v[part], s.a[part]
            )
            - change
        )
        mass = np.clip(light * self._whole(change), 0.06 * plan.arm.payload, plan.arm.payload)
        plan.phi_loaded = with_load(plan.phi_true, mass, com, size)
        self.note(cause, None, mass=(mass, "kg"), **{f"com_{x}": (com[k], "m") for k, x in enumerate("xyz")})

    def _payload(self, cause):
        self._load(cause, slice(None))

    def _payload_change(self, cause):
        length = self.sight.seconds[0]
        start = self.rng.uniform(0.2, 0.5) * length
        end = start + self.rng.uniform(0.25, 0.4) * length if self.rng.random() < 0.6 else np.inf
        self.plan.loaded_in = (0, start, end)
        cause["intervals"] = [[start, min(end, length)]]
        first = np.flatnonzero((self.sight.t >= start) & (self.sight.t < end) & (self.sight.t < length))
        self._load(cause, slice(first[0], first[-1]))

    def _tilt(self, angle: float, heading: float) -> np.ndarray:
        return 9.81 * np.array(
            [np.sin(angle) * np.cos(heading), np.sin(angle) * np.sin(heading), -np.cos(angle)]
        )

    def _gravity_direction(self, cause):
        s, heading = self.sight, self.rng.uniform(0, 2 * np.pi)
        change = (
            Rigid(self.plan.arm, self.plan.phi_true, self._tilt(0.02, heading)).torque(s.q, s.v, s.a)
            - self.plain
        )
        angle = float(np.clip(0.02 * self._whole(change), 0.006, 0.14))
        self.plan.gravity_true = self._tilt(angle, heading)
        self.note(
            cause,
            None,
            **{f"gravity_{x}": (g, "m/s²") for x, g in zip("xyz", self.plan.gravity_true, strict=True)},
        )

    def _joint_spring(self, cause):
        j = self._joint(self.sight.v, cause)
        rest = np.array(self.plan.arm.home) + self.rng.uniform(-0.3, 0.3, self.n)
        d = self.sight.q - rest
        bend = d**3 if self.rng.random() < 0.4 else np.zeros_like(d)
        k = self._fit(d + bend, j)
        cubic = k if bend.any() else 0.0
        row = np.eye(self.n)[j]
        self.plan.spring = Spring(k * row, rest * row, cubic * row)
        self.note(cause, j, stiffness=(k, "N·m/rad"), rest=(rest[j], "rad"), cubic=(cubic, "N·m/rad³"))

    def _torque_offset(self, cause):
        j = self._joint(np.ones_like(self.sight.v) * self.noise, cause)
        bias = self._fit(np.ones_like(self.sight.v), j) * float(self.rng.choice([-1, 1]))
        self.plan.offset = bias * np.eye(self.n)[j]
        self.note(cause, j, offset=(bias, "N·m"))

    def _torque_gain(self, cause):
        j = self._joint(self.sight.tau, cause)
        gain = min(self._fit(self.sight.tau, j), 0.35) * float(self.rng.choice([-1, 1]))
        self.plan.gain = gain * np.eye(self.n)[j]
        self.note(cause, j, gain=(1 + gain, "1"))
        if self.rng.random() < 0.3:  # a current that saturates
            self.plan.limit = np.where(
                np.arange(self.n) == j, 2.5 * np.max(np.abs(self.sight.tau[:, j])), 1e9
            )
            self.note(cause, j, saturation=(self.plan.limit[j], "N·m"))

    def _torque_drift(self, cause):
        j = self._joint(np.ones_like(self.sight.v) * self.noise, cause)
        last = self.rng.uniform(0.2, 0.8) * sum(self.sight.seconds)
        size = self._fit((1 - np.exp(-self.sight.t / last))[:, None] * np.ones(self.n), j)
        size *= float(self.rng.choice([-1, 1]))
        self.plan.drift = (size * np.eye(self.n)[j], last)
        self.note(cause, j, drift=(size, "N·m"), time_constant=(last, "s"))

    def _torque_crosstalk(self, cause):
        strong = np.sqrt(np.mean(self.sight.tau**2, 0))
        source = int(np.argmax(strong))
        j = int(self.rng.choice([k for k in range(self.n) if abs(k - source) in (1, 2)]))
        share = min(self._fit(np.repeat(self.sight.tau[:, [source]], self.n, 1), j), 0.12)
        cause["joints"] = [j + 1]
        self.plan.crosstalk = share * np.outer(np.eye(self.n)[j], np.eye(self.n)[source])
        self.note(cause, j, share=(share, "1"), source=(source + 1, "joint"))

    def _encoder_offset(self, cause):
        s, change = self.sight, np.zeros_like(self.sight.tau)
        for j in range(1, self.n):
            change += (self.bare.torque(s.q - 0.01 * np.eye(self.n)[j], s.v, s.a) - self.plain) * np.eye(
                self.n
            )[j]
        j = self._joint(change, cause)
        off = min(0.01 * self._fit(change, j), 0.08) * float(self.rng.choice([-1, 1]))
        self.plan.encoder = off * np.eye(self.n)[j]
        self.note(cause, j, offset=(off, "rad"))

    def _time_delay(self, cause):
        rate = np.gradient(self.sight.tau, self.sight.dt, axis=0)
        delay = float(np.clip(self._whole(rate), 0.006, 0.08))
        self.plan.delay = round(delay, 3)
        self.note(cause, None, delay=(self.plan.delay, "s"))

    def _external_contact(self, cause):
        plan, which = self.plan, int(self.rng.integers(len(self.sight.seconds)))
        length = self.sight.seconds[which]
        joint = int(self.rng.choice([self.n, self.n, self.n - 1, self.n // 2 + 1]))
        direction = self.rng.normal(size=3)
        point = np.array(plan.phi_true[joint - 1, 1:4]) if joint < self.n else plan.arm.tool
        reach = 0.55 * sum(np.linalg.norm(link[1]) for link in plan.arm.links[1:joint])
        force = self._size() * np.min(self.noise[:joint]) / max(reach, 0.03)
        force = np.clip(force, 0.1 * plan.arm.payload * 9.81, 0.9 * plan.arm.payload * 9.81)
        force = float(force) * direction / np.linalg.norm(direction)
        start = self.rng.uniform(0.1, 0.75) * length
        gap = (start, start + self.rng.uniform(0.6, 0.2 * length))
        plan.contacts.append(Contact(which, joint, point, force, gap, float(self.rng.choice([0.12, 0.5]))))
        cause["joints"], cause["intervals"] = [joint], [list(gap)]
        cause["recordings"] = [f"train_{which}.csv"]
        self.note(
            cause,
            joint - 1,
            force=(np.linalg.norm(force), "N"),
            **{f"direction_{x}": (d, "1") for x, d in zip("xyz", force / np.linalg.norm(force), strict=True)},
        )

    def _torque_meaning(self, cause):
        kind = str(
            self.rng.choice(
                ["gravity_removed", "sign", "unit", "current", "joint_order", "motor_side", "mounting"]
            )
        )
        gear, value = np.array(self.plan.arm.gear, float), None
        if kind == "sign":
            value = -np.ones(self.n)
        elif kind == "unit":
            value = np.full(self.n, 1000.0)
        elif kind == "motor_side":
            value = 1 / gear
        elif kind == "current":
            value = 1 / (gear * self.rng.uniform(0.05, 0.15, self.n) * np.cbrt(self.most / 50))
        elif kind == "joint_order":
            value = np.arange(self.n)
            i = int(self.rng.integers(1, self.n - 1))
            value[[i, i + 1]] = value[[i + 1, i]]
            cause["joints"] = [i + 1, i + 2]
        elif kind == "mounting":
            self.plan.gravity_true = self._tilt(float(self.rng.choice([np.pi / 2, np.pi])), 0.0)
            self.note(
                cause,
                None,
                **{f"gravity_{x}": (g, "m/s²") for x, g in zip("xyz", self.plan.gravity_true, strict=True)},
            )
        self.plan.meaning, cause["kind"] = (kind, value), kind
        cause["also"] = ["gravity_direction"] if kind == "mounting" else []
        if value is not None and kind != "joint_order":
            for j in range(self.n):
                self.note(cause, j, factor=(value[j], "column per N·m"))

    def _unknown(self, cause):
        what = str(self.rng.choice(BEYOND))
        inertia = np.diag(self.bare.mass(np.array(self.plan.arm.home, float)))
        j = self._joint(self.sight.v if what != "wobbling_tool" else self.sight.a * inertia, cause)
        size = self._fit(np.ones_like(self.sight.v), j)
        shape = {
            "hose_drag": self.rng.uniform(0.1, 0.3),
            "wobbling_tool": self.rng.uniform(3, 7),
            "loose_bolt": self.rng.uniform(6, 14),
            "settled_grease": self.rng.uniform(0.3, 1.5),
            "dragging_brake": self.plan.arm.home[j] + self.rng.uniform(-0.3, 0.3),
        }[what]
        if what == "wobbling_tool":
            size = float(
                np.clip(size / np.sqrt(np.mean(self.sight.a[:, j] ** 2)), 0.02 * inertia[j], 0.3 * inertia[j])
            )
        if what in ("loose_bolt", "settled_grease", "dragging_brake"):
            size *= 2
        self.plan.beyond = Beyond(what, j, size, float(shape))
        cause["what"] = what
        cause["also"] = {
            "hose_drag": ["presliding_hysteresis", "joint_spring"],
            "wobbling_tool": ["joint_elasticity"],
            "settled_grease": ["stribeck_friction", "friction_drift", "presliding_hysteresis"],
            "dragging_brake": ["coulomb_friction", "torque_ripple"],
        }.get(what, [])
        self.note(cause, j, size=(size, "N·m"), shape=(float(shape), ""))


def friction_all(scaler: Scaler) -> None:
    """Every joint rubs and the user's model has none of it: one law for the arm, sizes vary."""
    plan, rng, f = scaler.plan, scaler.rng, scaler.plan.friction
    law = str(
        rng.choice(["coulomb_viscous", "power", "stribeck", "presliding", "asymmetric", "load", "warming"])
    )
    level = scaler.noise * np.exp(rng.uniform(np.log(1.5), np.log(12), scaler.n))
    f.coulomb[:] = level
    f.viscous[:] = level * rng.uniform(0.2, 0.8, scaler.n) / np.array(plan.arm.speed)
    for key in ("frictionloss", "damping"):
        plan.user[key][:] = 0
    base = {
        "presliding": "presliding_hysteresis",
        "stribeck": "stribeck_friction",
        "asymmetric": "asymmetric_friction",
    }.get(law, "coulomb_friction")
    plan.role["coulomb"] = [base] * scaler.n
    names = [base, "viscous_friction"]
    if law == "power":
        f.power[:], f.exponent[:] = f.viscous * np.array(plan.arm.speed), rng.uniform(0.35, 0.65)
        f.viscous[:] = 0
        names = [base, "power_law_friction"]
    elif law == "stribeck":
        f.extra[:], f.v_stribeck[:] = level * rng.uniform(0.4, 0.9, scaler.n), rng.uniform(0.06, 0.2)
    elif law == "presliding":
        f.breakaway[:] = np.minimum(
            rng.uniform(0.01, 0.03, scaler.n), 0.05 * np.ptp(scaler.sight.q, axis=0) + 1e-3
        )
    elif law == "asymmetric":
        f.asymmetry[:] = level * rng.uniform(0.25, 0.6, scaler.n) * rng.choice([-1, 1], scaler.n)
    elif law == "load":
        f.load[:] = rng.uniform(0.03, 0.12)
        names.append("load_dependent_friction")
    elif law == "warming":
        f.cold[:], f.warm_time[:] = rng.uniform(0.3, 0.8), rng.uniform(5, 15)
        names.append("friction_drift")
    shown = {
        "viscous_friction": {"damping": (f.viscous, "N·m·s/rad")},
        "power_law_friction": {"coefficient": (f.power, "N·m·(s/rad)^p"), "exponent": (f.exponent, "1")},
        "load_dependent_friction": {"load_coefficient": (f.load, "1")},
        "friction_drift": {"cold_excess": (f.cold, "1"), "time_constant": (f.warm_time, "s")},
        "stribeck_friction": {
            "coulomb": (f.coulomb, "N·m"),
            "static": (f.coulomb + f.extra, "N·m"),
            "stribeck_velocity": (f.v_stribeck, "rad/s"),
        },
        "asymmetric_friction": {
            "coulomb_forward": (f.coulomb + f.asymmetry, "N·m"),
            "coulomb_backward": (f.coulomb - f.asymmetry, "N·m"),
        },
        "coulomb_friction": {"coulomb": (f.coulomb, "N·m"), "breakaway": (f.breakaway, "rad")},
        "presliding_hysteresis": {"coulomb": (f.coulomb, "N·m"), "breakaway": (f.breakaway, "rad")},
    }
    for name in names:
        cause = {"effect": name, "joints": [j + 1 for j in range(scaler.n)], "parameters": []}
        for key, (values, unit) in shown[name].items():
            for j in range(scaler.n):
                scaler.note(cause, j, **{key: (values[j], unit)})
        plan.causes.append(cause)
    for other in sorted({x for name in names for x in TOLERATED.get(name, [])} - set(names)):
        plan.allowed.append({"effect": other, "joints": None})


def placeholder(scaler: Scaler) -> None:
    """The file's damping, dry friction and rotor inertia are round numbers that nobody measured."""
    plan, rng, f = scaler.plan, scaler.rng, scaler.plan.friction
    scale = float(10 ** np.floor(np.log10(np.median(scaler.most) / 10)))
    f.coulomb[:] = scaler.noise * rng.uniform(1.5, 6, scaler.n)
    f.viscous[:] = scaler.noise * rng.uniform(1, 5, scaler.n) / np.array(plan.arm.speed)
    plan.role["coulomb"] = ["coulomb_friction"] * scaler.n
    plan.user["damping"][:] = scale * float(rng.choice([0.1, 0.5]))
    plan.user["frictionloss"][:] = scale * float(rng.choice([0.0, 0.1, 0.2]))
    plan.user["armature"][:] = scale * float(rng.choice([0.05, 0.1]))
    for name, true, said, unit in (
        ("viscous_friction", f.viscous, "damping", "N·m·s/rad"),
        ("coulomb_friction", f.coulomb, "frictionloss", "N·m"),
        ("armature", plan.armature, "armature", "kg·m²"),
    ):
        cause = {"effect": name, "joints": [j + 1 for j in range(scaler.n)], "parameters": []}
        for j in range(scaler.n):
            scaler.note(cause, j, **{said: (true[j] - plan.user[said][j], unit)})
        plan.causes.append(cause)


def deal(kind: str, turn: int, scaler: Scaler) -> str:
    """Give the plan what its kind conceals; `turn` counts those of its kind. Returns a control's sort."""
    rng = scaler.rng
    if kind == "control":
        return CONTROLS[turn % len(CONTROLS)]
    if kind == "one":
        scaler.add((FRICTION + OTHERS)[(turn * 7) % (len(FRICTION) + len(OTHERS))])
    elif kind == "friction_all":
        friction_all(scaler)
    elif kind == "placeholder":
        placeholder(scaler)
    elif kind == "beyond":
        scaler.add("unknown")
    else:
        pool = [x for x in OTHERS if x not in ("torque_meaning", "backlash")]
        names = set(rng.choice(pool, int(rng.integers(1, 4)), replace=False))
        names |= set(rng.choice(FRICTION, int(rng.integers(1, 3)), replace=False))
        if {"payload", "payload_change"} <= names:
            names.remove("payload")
        if "inertial_parameters" in names:
            names.discard("payload")
        order = {"armature": 0, "coulomb_friction": 1}
        for name in sorted(names, key=lambda x: (order.get(x, 2), x)):
            scaler.add(name)
    return ""
