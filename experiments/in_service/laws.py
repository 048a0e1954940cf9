"""Torques that a drive's innards take, by its angle, speed, load and time; all joints at once."""

from dataclasses import dataclass, fields

import numpy as np

WEIGHTS = np.array([0.4, 0.3, 0.2, 0.1])[:, None]
LENGTHS = np.array([0.3, 0.7, 1.3, 2.5])[:, None]
AT_REST = 0.004  # speed below which a rigid model's dry friction counts as undetermined [rad/s]


@dataclass
class Friction:
    """Dry friction on four parallel bristles that slip at 0.3 to 2.5 breakaway distances (Maxwell slip).

    torque = warm(t) (level z + viscous v + power |v|^exponent sign v), with z in [-1, 1] the bristles' mean,
    level = coulomb + asymmetry z + extra exp(-(v/v_stribeck)²) + load |transmitted torque|.
    warm(t) = 1 + cold exp(-t/warm_time).
    """

    coulomb: np.ndarray
    asymmetry: np.ndarray
    extra: np.ndarray
    v_stribeck: np.ndarray
    load: np.ndarray
    viscous: np.ndarray
    power: np.ndarray
    exponent: np.ndarray
    cold: np.ndarray
    warm_time: np.ndarray
    breakaway: np.ndarray

    @classmethod
    def none(cls, n: int) -> "Friction":
        blank = {f.name: np.zeros(n) for f in fields(cls)}
        ones = dict(v_stribeck=0.05, exponent=0.5, warm_time=10.0, breakaway=1e-3)
        return cls(**blank | {key: np.full(n, value) for key, value in ones.items()})

    def components(self, z, v, load, t) -> dict[str, np.ndarray]:
        """Torque of every term that occurs; they sum to the whole. z, v, load: (…, n), t: (…, 1)."""
        parts = {"coulomb": self.coulomb * z, "viscous": self.viscous * v}
        if self.asymmetry.any():
            parts["asymmetry"] = self.asymmetry * z * z
        if self.extra.any():
            parts["extra"] = self.extra * np.exp(-((v / self.v_stribeck) ** 2)) * z
        if self.load.any():
            parts["load"] = self.load * np.abs(load) * z
        if self.power.any():
            parts["power"] = self.power * np.abs(v) ** self.exponent * np.tanh(v / 1e-3)
        if self.cold.any():
            parts["cold"] = self.cold * np.exp(-t / self.warm_time) * sum(parts.values())
        return parts

    def slip(self, bristles: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Bristles (4, n) after the joints have turned by `step`."""
        return np.clip(bristles + step / (self.breakaway * LENGTHS), -1, 1)


@dataclass
class Periodic:
    """Ripple of a gear: amplitude sin(cycles q + phase) for each of a few waves a joint; (waves, n)."""

    amplitude: np.ndarray
    cycles: np.ndarray
    phase: np.ndarray

    def torque(self, q: np.ndarray) -> np.ndarray:
        return sum(
            a * np.sin(c * q + p) for a, c, p in zip(self.amplitude, self.cycles, self.phase, strict=True)
        )


@dataclass
class Spring:
    """A cable package, hose or balancer: stiffness (q - rest) + cubic (q - rest)³."""

    stiffness: np.ndarray
    rest: np.ndarray
    cubic: np.ndarray

    def torque(self, q: np.ndarray) -> np.ndarray:
        d = q - self.rest
        return self.stiffness * d + self.cubic * d**3


class Beyond:
    """What no name of the list covers, at one joint, with a memory that steps with the simulation."""

    def __init__(self, what: str, joint: int, size: float, shape: float):
        self.what, self.joint, self.size, self.shape = what, joint, size, shape
        self.state = np.zeros(2)
        self.way = 0.0

    def step(self, q: float, v: float, a: float, dt: float) -> float:
        """Torque [N·m] against the motion at angle q, speed v; a: the acceleration one step before."""
        s = self.state
        if self.what == "hose_drag":  # a hose rubbing over 0.2 to 0.5 rad, Bouc-Wen
            s[0] += dt * (v - 0.5 * abs(v) * s[0] / self.shape - 0.5 * v * abs(s[0]) / self.shape)
            return self.size * s[0] / self.shape
        if (
            self.what == "wobbling_tool"
        ):  # a mass on a loose grip; shape: its frequency [Hz]; size: its inertia
            w = 2 * np.pi * self.shape
            s[1] += dt * (-a - 0.06 * w * s[1] - w * w * s[0])
            s[0] += dt * s[1]
            return -self.size * (w * w * s[0] + 0.06 * w * s[1])
        if self.what == "loose_bolt":  # a knock after every reversal that rings out
            if abs(v) > 0.03 and np.sign(v) != self.way:
                s[0], self.way = 0.0, float(np.sign(v))
            s[0] += dt
            return self.size * self.way * np.exp(-s[0] / 0.06) * np.cos(2 * np.pi * self.shape * s[0])
        if self.what == "settled_grease":  # friction grows while the joint rests, and wears off on the move
            resting = abs(v) < 0.02
            s[0] += dt * ((1 - s[0]) / self.shape if resting else -s[0] * min(abs(v), 1) / 0.25)
            s[1] = np.clip(s[1] + v * dt / 2e-3, -1, 1)
            return self.size * s[0] * s[1]
        s[1] = np.clip(s[1] + v * dt / 2e-3, -1, 1)  # dragging_brake: a warped disc rubs at some angles
        return self.size * s[1] * max(0.0, np.cos(q - self.shape)) ** 6


BEYOND = ("hose_drag", "wobbling_tool", "loose_bolt", "settled_grease", "dragging_brake")
