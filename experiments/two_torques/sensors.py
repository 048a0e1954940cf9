"""What the arm's computer writes down: encoders with steps, dq by the vendor's filter, two torques with noise.

The current is noisier than the sensor behind the gear. Noise is white, coloured, heavy-tailed or in coarse steps.
"""

from dataclasses import dataclass

import numpy as np
from arms import Arm
from motions import DT
from scipy.signal import butter, lfilter, sosfiltfilt

BAND = 8.0  # Hz; sizes of causes and of noise are those below it
STYLES = ("white", "coloured", "heavy", "steps")


@dataclass(frozen=True)
class Channel:
    style: str
    white: np.ndarray  # standard deviation of a sample [N m]
    coloured: np.ndarray
    memory: float  # of the coloured part [s]
    step: np.ndarray  # [N m]; 0 for none

    def noise(self, rng: np.random.Generator, count: int, rate: float) -> np.ndarray:
        shape = (count, len(self.white))
        heavy = self.style == "heavy"
        white = np.clip(rng.standard_t(4, shape), -8, 8) / np.sqrt(2) if heavy else rng.standard_normal(shape)
        kept = np.exp(-1 / (rate * self.memory))
        coloured = lfilter(
            [np.sqrt(1 - kept**2)], [1, -kept], rng.standard_normal((count + 1000, shape[1])), axis=0
        )
        return self.white * white + self.coloured * coloured[1000:]

    def shows(self, rng: np.random.Generator, torque: np.ndarray, rate: float) -> np.ndarray:
        shown = torque + self.noise(rng, len(torque), rate)
        return np.where(self.step > 0, np.round(shown / np.maximum(self.step, 1e-12)) * self.step, shown)

    def std(self, rng: np.random.Generator, rate: float) -> np.ndarray:
        """Of the noise below BAND, steps included."""
        noise = self.noise(rng, round(120 * rate), rate)
        noise = noise + self.step * rng.uniform(-0.5, 0.5, noise.shape)
        return np.std(low_pass(noise, rate), axis=0)


@dataclass(frozen=True)
class Sensing:
    rate: float  # [Hz]
    bits: int
    cutoff: float  # of the filter for dq [Hz]
    tau: Channel
    motor: Channel

    @property
    def every(self) -> int:
        return round(1 / (self.rate * DT))

    def motion(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(q, dq) as shown, of the angles at every step of the simulation."""
        tick = 2 * np.pi / 2**self.bits
        counted = np.round(q / tick) * tick
        raw = np.diff(counted, axis=0, prepend=counted[:1]) / DT
        dq = lfilter(*butter(2, self.cutoff, fs=1 / DT), raw, axis=0)
        return counted[:: self.every], dq[:: self.every]


def low_pass(x: np.ndarray, rate: float) -> np.ndarray:
    return sosfiltfilt(butter(2, BAND, fs=rate, output="sos"), x, axis=0)


def channel(rng: np.random.Generator, style: str, white: np.ndarray, coloured: np.ndarray) -> Channel:
    step = 1.5 * white if style == "steps" else 0 * white
    if style == "coloured":
        white, coloured = 0.4 * white, 1.6 * coloured
    return Channel(style, white, coloured, rng.uniform(0.02, 0.3), step)


def sensing(rng: np.random.Generator, arm: Arm) -> Sensing:
    per_mille = 1e-3 * arm.rated * rng.uniform(0.7, 1.4, arm.joints)
    return Sensing(
        rate=float(rng.choice([100, 125, 200, 250, 500, 1000])),
        bits=int(rng.integers(17, 21)),
        cutoff=rng.uniform(20, 60),
        tau=channel(rng, rng.choice(STYLES), rng.uniform(2, 6) * per_mille, rng.uniform(0.8, 2) * per_mille),
        motor=channel(
            rng, rng.choice(STYLES), rng.uniform(7, 16) * per_mille, rng.uniform(1.8, 4) * per_mille
        ),
    )
