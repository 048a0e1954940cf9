"""A case before it is simulated: the user's arm, and what the truth adds to it, step by step."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np
from arms import Arm, inverse, rigid
from physics import Viscous, bristles, constant
from plant import Gear, Plant
from sensors import Sensors

FAMILY = {
    "friction": (
        "viscous_friction",
        "coulomb_friction",
        "asymmetric_friction",
        "stribeck_friction",
        "load_dependent_friction",
        "friction_drift",
        "presliding_hysteresis",
        "power_law_friction",
    ),
    "drive": ("torque_ripple", "backlash", "joint_elasticity", "armature"),
    "load": ("inertial_parameters", "payload", "payload_change", "gravity_direction", "joint_spring"),
    "sensor": ("torque_offset", "torque_gain", "torque_drift", "torque_crosstalk", "encoder_offset"),
    "clock": ("time_delay",),
    "contact": ("external_contact",),
    "meaning": ("torque_meaning",),
    "unknown": ("unknown",),
}
FAMILY_OF = {name: family for family, names in FAMILY.items() for name in names}


@dataclass
class Entry:
    """One concealed effect. Joints are 0-based here; None: those where it shows above the noise."""

    effect: str
    key: str
    joints: list[int] | None
    parameters: list[tuple] = field(default_factory=list)  # (name, joint, value, unit)
    also: list[str] = field(default_factory=list)
    intervals: list[tuple[float, float]] | None = None
    what: str = ""  # for what is outside the catalogue, and for the kind of a torque_meaning


@dataclass
class Step:
    """A change from the user's arm towards the true one, from the clock's `start` on."""

    key: str
    change: Callable[[Arm], Arm]
    start: float = -np.inf


@dataclass
class Draft:
    rng: np.random.Generator
    user: Arm
    sensors: Sensors
    seconds: float  # of the first recording
    steps: list[Step] = field(default_factory=list)
    laws: list = field(default_factory=list)
    gears: list[Gear] = field(default_factory=list)
    encoders: list[tuple[str, np.ndarray]] = field(default_factory=list)  # (key, offset)
    torque: list[tuple[str, Callable]] = field(default_factory=list)  # (key, f(draft, log, tau) -> tau)
    entries: list[Entry] = field(default_factory=list)
    allowed: list[tuple[str, list[int] | None]] = field(default_factory=list)
    noise_scale: np.ndarray = field(init=False)  # of the recorded column's unit
    nominal: str = "exact"

    def __post_init__(self):
        self.noise_scale = np.ones(self.user.n)

    @property
    def n(self) -> int:
        return self.user.n

    @property
    def noise(self) -> np.ndarray:
        return self.user.noise

    def key(self, effect: str) -> str:
        return f"{effect}:{len(self.entries)}"

    def add(self, effect: str, joints, parameters=(), also=(), **more) -> str:
        """Put an effect on the list; returns the key for its laws and steps."""
        key = self.key(effect)
        joints = None if joints is None else [int(j) for j in joints]
        self.entries.append(Entry(effect, key, joints, list(parameters), list(also), **more))
        return key

    def allow(self, effect: str, joints=None):
        self.allowed.append((effect, None if joints is None else [int(j) for j in joints]))

    # ---------------------------------------------------------------------------- sizes to draw from

    def truth_so_far(self) -> Arm:
        arm = self.user
        for step in self.steps:
            arm = step.change(arm)
        return arm

    def inertia(self) -> np.ndarray:
        """Joint inertias at the home pose, other joints held."""
        model = rigid(self.truth_so_far())
        data = mujoco.MjData(model)
        data.qpos = self.user.home
        mujoco.mj_forward(model, data)
        own = np.zeros(self.n)
        for j in range(self.n):
            unit, row = np.zeros(self.n), np.zeros(self.n)
            unit[j] = 1.0
            mujoco.mj_mulM(model, data, row, unit)
            own[j] = row[j]
        return own

    def load(self, moving: bool = True) -> np.ndarray:
        """RMS torque at each joint over poses and accelerations of its motions, or at rest."""
        rng = np.random.default_rng(0)
        q = self.user.home + self.user.reach * rng.uniform(-1, 1, (60, self.n))
        qdd = moving * 0.8 * self.user.speed * rng.standard_normal(q.shape)
        arm = self.user.with_joint(damping=np.zeros(self.n), frictionloss=np.zeros(self.n))
        return np.sqrt(np.mean(inverse(arm, q, 0 * q, qdd) ** 2, axis=0))

    def at(self, joints, values) -> np.ndarray:
        """Vector of all joints that is zero elsewhere."""
        out = np.zeros(self.n)
        out[list(joints)] = np.broadcast_to(values, (self.n,))[list(joints)]
        return out

    def one(self, candidates=None) -> list[int]:
        return [int(self.rng.choice(np.arange(self.n) if candidates is None else candidates))]

    def some(self) -> list[int]:
        """One joint mostly, else a few or all."""
        count = self.rng.choice([1, self.rng.integers(2, 4), self.n], p=[0.65, 0.25, 0.1])
        return sorted(int(j) for j in self.rng.choice(self.n, count, replace=False))

    # ---------------------------------------------------------------------------- known friction

    def know_friction(self, joints, reach=(3e-4, 2e-3), scale=1.0):
        """Friction that stands in the user's file, and in truth sticks with bristles."""
        size = scale * self.user.friction * np.exp(0.25 * self.rng.standard_normal(self.n))
        coulomb = self.at(joints, size)
        damping = self.at(joints, 0.6 * self.user.friction * np.exp(0.4 * self.rng.standard_normal(self.n)))
        self.user = self.user.with_joint(
            frictionloss=self.user.of("frictionloss") + coulomb, damping=self.user.of("damping") + damping
        )
        self.dry("known", coulomb, reach)
        self.laws.append(Viscous("known", damping))
        self.allow("presliding_hysteresis", joints)

    def dry(self, key: str, typical: np.ndarray, reach=(3e-4, 2e-3), level=None):
        """Bristles of `typical` level; `level` may depend on the state."""
        length = self.rng.uniform(*reach)
        level = constant(typical) if level is None else level
        self.laws.append(bristles(self.rng, key, level, typical, self.inertia(), length))

    # ---------------------------------------------------------------------------- the true arm

    def chain(self) -> list[Step]:
        """Steps from the user's arm to the plant's, whose friction is all in the laws."""
        zero = np.zeros(self.n)
        return [*self.steps, Step("known", lambda arm: arm.with_joint(damping=zero, frictionloss=zero))]

    def phases(self, upto: int | None = None) -> list[tuple[float, Arm]]:
        """(start, arm) after the first `upto` steps of the chain."""
        steps = self.chain()[:upto]
        starts = sorted({-np.inf, *(step.start for step in steps)})
        phases = []
        for start in starts:
            arm = self.user
            for step in steps:
                arm = step.change(arm) if step.start <= start else arm
            phases.append((start, arm))
        return phases

    def plant(self) -> Plant:
        return Plant(self.phases(), self.laws, self.gears, help=float(self.rng.choice([0.0, 0.8])))


def set_joint(name: str, values: np.ndarray) -> Callable[[Arm], Arm]:
    return lambda arm: arm.with_joint(**{name: values})


def add_joint(name: str, values: np.ndarray) -> Callable[[Arm], Arm]:
    return lambda arm: arm.with_joint(**{name: arm.of(name) + values})


def replace_arm(**values) -> Callable[[Arm], Arm]:
    return lambda arm: replace(arm, **values)
