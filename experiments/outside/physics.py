"""Laws of torque that act inside the simulated arm, written from the literature.

A law answers with the torque that the motors must supply because of it, one number a joint. `key` says to which
concealed effect (or to the known friction) that torque belongs.

Dry friction never is a function of the velocity here. Its bristles have a state, so that it sticks:
`ElastoPlastic` is Dupont, Hayward, Armstrong, Altpeter (2002), a LuGre model without the drift; `MaxwellSlip` the
generalized Maxwell-slip elements of Al-Bender, Lampaert, Swevers (2005) with instantaneous slip.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import mujoco
import numpy as np


@dataclass
class State:
    """What a law may look at; velocities and positions are those on the motor's side."""

    t: float
    dt: float
    q: np.ndarray
    v: np.ndarray
    load: np.ndarray  # [N m], torque that went through each gear in the previous step
    model: mujoco.MjModel
    data: mujoco.MjData

    def flange(self) -> tuple[np.ndarray, np.ndarray]:
        """Jacobians of the flange: of its point and of its rotation."""
        n = self.model.nv
        point, rotation = np.zeros((3, n)), np.zeros((3, n))
        mujoco.mj_jacBody(self.model, self.data, point, rotation, self.model.nbody - 1)
        return point, rotation


Level = Callable[[State], tuple[np.ndarray, np.ndarray]]


def constant(level: np.ndarray) -> Level:
    """The same dry friction in both directions."""
    level = np.asarray(level, float)
    return lambda s: (level, level)


def asymmetric(forward: np.ndarray, backward: np.ndarray) -> Level:
    return lambda s: (forward, backward)


def stribeck(coulomb: np.ndarray, static: np.ndarray, velocity: np.ndarray, power: float = 1.5) -> Level:
    """Level that falls from `static` to `coulomb` as the speed passes `velocity`."""

    def level(s: State):
        now = coulomb + (static - coulomb) * np.exp(-((np.abs(s.v) / velocity) ** power))
        return now, now

    return level


def loaded(share: np.ndarray) -> Level:
    """Level that is a share of the torque through the gear."""

    def level(s: State):
        now = share * np.abs(s.load)
        return now, now

    return level


def warming(level: np.ndarray, start: float, time: float) -> Level:
    """Surplus that decays with time constant `time` from the clock's zero."""

    def now(s: State):
        x = level * np.exp(-(s.t + start) / time)
        return x, x

    return now


@dataclass
class ElastoPlastic:
    key: str
    level: Level
    stiffness: np.ndarray  # [N m/rad]
    micro_damping: np.ndarray  # [N m s/rad]
    z: np.ndarray = field(init=False)

    def __post_init__(self):
        self.z = np.zeros_like(self.stiffness)

    def __call__(self, s: State) -> np.ndarray:
        forward, backward = self.level(s)
        limit = np.maximum(np.where(self.z + s.v * s.dt >= 0, forward, backward), 1e-12)
        steady = limit / self.stiffness
        reach = np.abs(self.z) / steady
        same = self.z * s.v > 0
        rising = 0.5 + 0.5 * np.sin(np.pi * np.clip((reach - 0.85) / 0.3, -0.5, 0.5))
        slip = np.where(same, rising, 0.0)
        z = (self.z + s.dt * s.v) / (1 + slip * np.abs(s.v) * s.dt / steady)
        z = np.clip(z, -1.6 * steady, 1.6 * steady)
        rate = (z - self.z) / s.dt
        self.z = z
        return self.stiffness * z + self.micro_damping * rate


SHARES = np.array([0.1, 0.2, 0.3, 0.4])  # of the level, for the elements of a Maxwell-slip joint
REACHES = np.array([0.15, 0.4, 0.8, 1.5])  # of the breakaway distance at which each lets go


@dataclass
class MaxwellSlip:
    key: str
    level: Level
    stiffness: np.ndarray
    micro_damping: np.ndarray
    z: np.ndarray = field(init=False)

    def __post_init__(self):
        self.z = np.zeros((len(self.stiffness), len(SHARES)))

    def __call__(self, s: State) -> np.ndarray:
        forward, backward = self.level(s)
        length = REACHES / self.stiffness[:, None]
        high, low = forward[:, None] * length, backward[:, None] * length
        z = np.clip(self.z + s.dt * s.v[:, None], -low, high)
        rate = (z - self.z) / s.dt
        self.z = z
        torque = z * self.stiffness[:, None] * (SHARES / REACHES)
        return torque.sum(1) + self.micro_damping * (rate @ SHARES)


def bristles(
    rng: np.random.Generator, key: str, level: Level, typical: np.ndarray, inertia: np.ndarray, reach
):
    """Dry friction of one of the two kinds that lets go after `reach` [rad] at the `typical` level."""
    stiffness = np.maximum(typical, 1e-9) / reach
    # ω dt < 0.5 keeps the explicit coupling stable
    stiffness = np.minimum(stiffness, inertia * (0.5 / 5e-4) ** 2)
    damping = 2 * rng.uniform(0.05, 0.3) * np.sqrt(stiffness * inertia)
    kind = ElastoPlastic if rng.random() < 0.5 else MaxwellSlip
    return kind(key, level, stiffness, np.where(typical > 0, damping, 0.0))


@dataclass
class Viscous:
    key: str
    damping: np.ndarray

    def __call__(self, s: State) -> np.ndarray:
        return self.damping * s.v


@dataclass
class PowerLaw:
    key: str
    scale: np.ndarray
    power: float

    def __call__(self, s: State) -> np.ndarray:
        return self.scale * s.v * (s.v**2 + 1e-6) ** ((self.power - 1) / 2)


@dataclass
class WarmingViscous:
    key: str
    damping: np.ndarray
    start: float
    time: float

    def __call__(self, s: State) -> np.ndarray:
        return self.damping * s.v * np.exp(-(s.t + self.start) / self.time)


@dataclass
class Ripple:
    """Gear or cogging ripple: two harmonics, a little stronger under load."""

    key: str
    amplitude: np.ndarray
    order: float
    phase: float
    second: float
    per_load: float

    def __call__(self, s: State) -> np.ndarray:
        angle = self.order * s.q + self.phase
        size = self.amplitude * (1 + self.per_load * np.abs(s.load) / (1 + np.abs(s.load)))
        return size * (np.sin(angle) + self.second * np.sin(2 * angle + 1.0))


@dataclass
class Spring:
    key: str
    stiffness: np.ndarray
    centre: np.ndarray

    def __call__(self, s: State) -> np.ndarray:
        return self.stiffness * (s.q - self.centre)


@dataclass
class Contact:
    """A force at the flange, with soft edges and a tremor, while `begin < t < end`."""

    key: str
    force: np.ndarray
    begin: float
    end: float
    tremor: float

    def __call__(self, s: State) -> np.ndarray:
        inside = np.clip(min(s.t - self.begin, self.end - s.t) / 0.05, 0.0, 1.0)
        if inside == 0.0:
            return np.zeros(s.model.nv)
        point, _ = s.flange()
        return -inside * (1 + self.tremor * np.sin(2 * np.pi * 1.7 * s.t)) * (point.T @ self.force)


# -------------------------------------------------------------------------------- outside the catalogue


@dataclass
class EddyBrake:
    """Torque that rises with speed up to `knee` and falls beyond (eddy currents in a conducting disc)."""

    key: str
    peak: np.ndarray
    knee: float

    def __call__(self, s: State) -> np.ndarray:
        x = s.v / self.knee
        return self.peak * 2 * x / (1 + x**2)


@dataclass
class VelocityProduct:
    key: str
    scale: np.ndarray
    first: int
    second: int

    def __call__(self, s: State) -> np.ndarray:
        return self.scale * s.v[self.first] * s.v[self.second]


@dataclass
class FlangeDrag:
    """Drag of a panel or net at the flange in a fluid: against the velocity, with its square."""

    key: str
    scale: float  # [N s^2/m^2]

    def __call__(self, s: State) -> np.ndarray:
        point, _ = s.flange()
        v = point @ s.data.qvel
        return point.T @ (self.scale * np.linalg.norm(v) * v)


@dataclass
class Flywheel:
    """A spinning tool: its angular momentum, fixed to the flange, has to be turned about."""

    key: str
    momentum: float  # [N m s], about the flange's z
    axis: np.ndarray

    def __call__(self, s: State) -> np.ndarray:
        _, rotation = s.flange()
        axis = s.data.xmat[-1].reshape(3, 3) @ self.axis
        return rotation.T @ np.cross(rotation @ s.data.qvel, self.momentum * axis)


@dataclass
class CableWrap:
    """A hose wound about a joint: stiffens to one side, with the hysteresis of Bouc and Wen."""

    key: str
    joint: int
    size: float
    centre: float
    reach: float
    z: float = 0.0

    def __call__(self, s: State) -> np.ndarray:
        v = s.v[self.joint]
        self.z += s.dt * (v - 0.5 * (abs(v) * self.z + v * abs(self.z)) / self.reach)
        x = (s.q[self.joint] - self.centre) / self.reach
        out = np.zeros(len(s.v))
        out[self.joint] = self.size * (0.3 * np.expm1(np.clip(x, -3, 2.5)) + self.z / self.reach)
        return out
