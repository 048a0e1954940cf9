r"""The twist of a joint between its position sensor and its link, stepped along a recorded motion.

The sensor's side is where the recording says it is, and so are the other joints; the link beyond has one freedom
left, $\delta = q_{link} - q$. Its equation of motion is joint j's row of the arm's,

$$M_{jj}(q)\,\ddot\delta + \tau_j(q) + \frac{\partial\tau_j}{\partial q_j}\,\delta = T(\delta, \dot\delta), \qquad
  T = -K y\,\bigl(1 + s\,(K y)^2\bigr) - d\,\dot\delta, \qquad y = \delta - \mathrm{clip}(\delta, -b, b)$$

with $\tau_j(q)$ the torque [N m] that the rigid arm would take: a spring K [N m/rad] that stiffens by
s [1/(N m)²], behind stops b [rad] from the middle, damped by d [N m s/rad] where they touch. Every joint feels
$\tau(q + \delta, \dot q + \dot\delta, \ddot q + \ddot\delta) - \tau(q, \dot q, \ddot q)$.

Impacts come out with the right impulse and at the right time to some ms. What the motor does in them lies above
the low-pass of q: it recoils, which damps them, and their shape is not quite that of the recording.

References:
    Spong, ASME JDSMC 1987 (two masses and a spring); Nordin and Gutman, Automatica 2002 (dead zone with damping,
    their "physical model" of backlash).
"""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import scipy.interpolate
from jaxtyping import Array, Float

from .. import signals as signals_
from .motion import Motion

_STEP = 1e-3
"""Longest step [s]."""
_BUCKET = 4096
_LANES = 8
_BAND = 0.4
"""Cutoff of the low-pass before the steps are thinned out, in rates of the motion's own grid."""


@dataclasses.dataclass(frozen=True)
class Law:
    """What joins sensor and link at a joint."""

    joint: int
    stiffness: float
    """K [N m/rad]."""
    damping_ratio: float
    """Of the link on its spring, at the mean inertia that the joint turns."""
    half_width: float = 0.0
    """b [rad]."""
    stiffening: float = 0.0
    """s [1/(N m)²]."""
    cutoff: float = np.inf
    """Low-pass of the torque that twists [Hz]."""


def held_up(stiffness: float, joint: int, motion: Motion) -> float:
    r"""A stiffness [N m/rad], or what keeps gravity from turning the link over: twice
    $-\partial\tau_j/\partial q_j$, at which it would not come to rest."""
    return max(stiffness, -2.0 * float(motion.slope[:, joint].min()))


def twist_torque(motion: Motion, laws: Sequence[Law]) -> Float[np.ndarray, "time dof m"]:
    """What each law adds to the torque of the rigid arm in all joints [N m]."""
    steps = max(1, int(np.ceil(motion.dt / _STEP - 1e-9)))
    fine = motion.time[0] + motion.dt / steps * np.arange((motion.samples - 1) * steps + 1)
    joints = [law.joint for law in laws]
    load = np.stack([low_passed(motion.load[:, law.joint], law.cutoff, motion.dt) for law in laws], 1)
    channels = (load, motion.inertia[:, joints], motion.slope[:, joints])
    if steps > 1:
        channels = tuple(scipy.interpolate.CubicSpline(motion.time, x)(fine) for x in channels)
    moved = np.stack(_stepped(channels, motion, laws, motion.dt / steps), 2)
    if steps > 1:
        moved = signals_.zero_phase(moved, _BAND / motion.dt, steps / motion.dt)[::steps]
    out = []
    for i, j in enumerate(joints):
        unit = np.eye(motion.dof)[j]
        more = [moved[:, i, k : k + 1] * unit for k in range(3)]
        twisted = Motion(
            motion.arm,
            motion.time,
            motion.q + more[0],
            motion.qd + more[1],
            motion.qdd + more[2],
            motion.friction,
        )
        out.append(twisted.load - motion.load)
    return np.stack(out, 2)


def low_passed(x: Float[np.ndarray, "time ..."], cutoff: float, dt: float) -> Float[np.ndarray, "time ..."]:
    """Magnitude $1/(1 + (f/f_c)^4)$, no phase; mirrored at the end, lest it step from end to start."""
    if not np.isfinite(cutoff):
        return x
    mirrored = np.concatenate([x, x[::-1]])
    gain = 1 / (1 + (np.fft.rfftfreq(len(mirrored), dt) / cutoff) ** 4)
    spectrum = np.fft.rfft(mirrored, axis=0) * gain.reshape(-1, *[1] * (x.ndim - 1))
    return np.fft.irfft(spectrum, len(mirrored), axis=0)[: len(x)]


def _stepped(
    channels: Sequence[Float[np.ndarray, "fine m"]], motion: Motion, laws: Sequence[Law], h: float
) -> list[Float[np.ndarray, "fine m"]]:
    """Twist and its two derivatives, a stretch after the other and some laws at once: any motion, any number of
    laws share what is compiled."""
    samples, m = channels[0].shape
    pad = ((0, -samples % _BUCKET), (0, -m % _LANES))
    padded = [np.pad(x, pad, mode="edge") for x in channels]
    mean = motion.mean_inertia
    table = np.array(
        [
            [
                law.stiffness,
                2 * law.damping_ratio * np.sqrt(law.stiffness * max(mean[law.joint], 1e-6)),
                law.half_width,
                law.stiffening,
            ]
            for law in laws
        ]
    )
    table = np.pad(table, (pad[1], (0, 0)), mode="edge").T
    state, out = _settled(padded[0][0], table), []
    for begin in range(0, len(padded[0]), _BUCKET):
        state, moved = _scan(state, *(x[begin : begin + _BUCKET] for x in padded), table, h)
        out.append(moved)
    return [np.concatenate(parts)[:samples, :m] for parts in zip(*out, strict=True)]


@jax.jit
def _settled(load: Float[Array, " m"], law: Float[Array, "4 m"]) -> tuple[Array, Array]:
    """Twist and its speed at rest."""
    K, _, b, s = law
    spring = -load / K  # y (1 + s (K y)²) is what it would be without stiffening
    for _ in range(8):
        spring = spring - (spring * (1 + s * (K * spring) ** 2) + load / K) / (1 + 3 * s * (K * spring) ** 2)
    rest = spring - b * jnp.sign(load)
    return rest, jnp.zeros_like(rest)


@jax.jit
def _scan(
    state: tuple[Array, Array],
    load: Float[Array, "fine m"],
    inertia: Float[Array, "fine m"],
    slope: Float[Array, "fine m"],
    law: Float[Array, "4 m"],
    h: Array | float,
):
    """Linearly implicit steps, stable for any stiffness."""
    K, d, b, s = law

    def step(state, now):
        x, v = state
        tau, M, g = now
        y = x - jnp.clip(x, -b, b)
        touching = (y != 0) | (b == 0)
        torque, tangent = -K * y * (1 + s * (K * y) ** 2), K * (1 + 3 * s * (K * y) ** 2)
        held = jnp.where(touching, h * d + h * h * tangent, 0.0)
        pushed = v + h / M * (torque - tau - g * x)
        new = pushed / (1 + held / M)
        x = x + h * new
        return (x, new), (x, new, (new - v) / h)

    return jax.lax.scan(step, state, (load, inertia, slope), unroll=8)
