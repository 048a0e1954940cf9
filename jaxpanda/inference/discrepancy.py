r"""What a law may be off: no gear's friction, spring or sensor is quite the one in a textbook.

$$\tau = B c + D \epsilon, \qquad \epsilon \sim N(0, 1)$$

with a few columns D that are made from the law's own torque: copies of it that vary smoothly with what such
laws depend on, each of the size `discrepancy` of the effect's class; what neighbouring shapes of the law would
give; and, for dry friction, other ways to turn at a reversal: over other speeds, or over a distance, as a gear's
bristles do. What no column describes is noise in proportion to the torque and to how fast it changes
(`unresolved`). A law without either is believed to the last digit, and what it leaves passes for a second effect.

References:
    Kennedy and O'Hagan, J. R. Stat. Soc. B 2001; Brynjarsdóttir and O'Hagan, Inverse Problems 2014.
"""

from collections.abc import Callable, Sequence

import numpy as np
import scipy.linalg
from jaxtyping import Float

from ..effects import AbstractEffect, law_of, neighbours
from ..traces import Trace
from .library import turning
from .noise import hats

SEEN = 0.1
"""Discrepancy over the noise's deviation below which it is left out: it would change nothing."""
SHAPE = 0.3
"""Deviation of a neighbouring shape's share."""
TURN, KNOWN_TURN = 0.1, 0.3
"""Deviation of the share of dry friction that turns in another way: of a law whose width was fitted, and of the
user's, which turns as a simulator has it and may do so otherwise altogether."""
UNRESOLVED, TIMING = 0.03, 0.005
"""Share of its torque by which a law is off in no smooth way, and by how much it may be early or late [s]."""
_KNOTS = {"q": 5, "qd": 6, "t": 4}
_PERIOD = 1.5
"""Between knots in time of what comes and goes [s]."""

Torque = list[Float[np.ndarray, "_time dof"]]
"""In each recording [N m]."""


def of_law(
    traces: Sequence[Trace],
    effect: AbstractEffect,
    torque: Torque,
    std: Float[np.ndarray, " dof"],
    evaluate: Callable[[AbstractEffect], Torque],
) -> list[Float[np.ndarray, "_time dof _m"]]:
    """Columns of a law's discrepancy in each recording, of unit variance.

    Args:
        traces: the recordings.
        effect: the law.
        torque: what it explains.
        std: deviation of each joint's noise [N m].
        evaluate: torque of another shape, with the coefficients of this one.
    """
    ends = np.cumsum([t.motion.samples for t in traces])[:-1]
    stacked, dof = np.concatenate(torque), torque[0].shape[1]
    weights = np.concatenate([t.weights for t in traces])
    count = np.maximum((weights**2).sum(0), 1.0)
    size = lambda x: np.sqrt(((weights * x) ** 2).sum(0) / count) / std
    felt = size(stacked)
    columns: list[np.ndarray] = []

    def take(joint: int, values: Float[np.ndarray, "rows n"]) -> None:
        wide = np.zeros((len(values), dof, values.shape[1]))
        wide[:, joint] = values
        columns.append(wide)

    for j in np.flatnonzero(effect.discrepancy * felt > SEEN):
        for channel in effect.varies_with:
            copies = effect.discrepancy * stacked[:, j, None] * _hats(traces, int(j), channel)
            take(int(j), copies)
    if np.any(felt > SEEN):
        for other in neighbours(effect):
            off = SHAPE * (np.concatenate(evaluate(other)) - stacked)
            if np.any(size(off) > SEEN):
                columns.append(off[:, :, None])
    if effect.dry_width is not None and effect.one_joint:
        j = effect.joints[0]
        level = _level(stacked[:, j])
        if TURN * level > SEEN * std[j]:
            reference = np.concatenate(
                [t.down(np.tanh(t.channels.qd[:, j] / float(effect.dry_width))) for t in traces]
            )
            take(j, TURN * level * (turning(traces, j) - reference[:, None]))
    if not columns:
        return []
    return np.split(np.concatenate(columns, 2), ends)


def unresolved(traces: Sequence[Trace], torque: Torque) -> Float[np.ndarray, "rows dof"]:
    """Square of what a law may be off from sample to sample [N² m²]: in proportion to its torque, and to how fast
    that changes."""
    rates = [np.gradient(tau, t.motion.dt, axis=0) for t, tau in zip(traces, torque, strict=True)]
    return np.square(UNRESOLVED * np.concatenate(torque)) + np.square(TIMING * np.concatenate(rates))


def at_rest(
    traces: Sequence[Trace], effect: AbstractEffect, torque: Torque
) -> Float[np.ndarray, "rows dof"] | None:
    """Square of what a law may be off for as long as a joint rests [N² m²]: dry friction, by all of it; and until
    it has forgotten how it began, as nobody has recorded where its joint came from."""
    if not (effect.dry and effect.one_joint):
        return None
    j, rests = effect.joints[0], resting(traces)
    share = rests[:, j]
    if effect.forgets is not None:
        share = np.maximum(share, np.concatenate([_remembered(t, j, float(effect.forgets)) for t in traces]))
    off = np.zeros_like(rests)
    off[:, j] = np.square(_level(np.concatenate(torque)[:, j]) * share)
    return off


def _remembered(trace: Trace, joint: int, distance: float) -> Float[np.ndarray, " _time"]:
    """Share of its beginning that is left of a law which forgets it over a distance [rad]."""
    travelled = np.cumsum(np.abs(trace.channels.qd[:, joint])) * trace.dt
    left = np.exp(-travelled[trace.keep] / distance)
    return np.where(left > SEEN, left, 0.0)


def known_at_rest(traces: Sequence[Trace]) -> Float[np.ndarray, "rows dof"]:
    """The same of the friction that the user's model holds."""
    return np.square(np.asarray(traces[0].motion.arm.frictionloss) * resting(traces))


def resting(traces: Sequence[Trace]) -> Float[np.ndarray, "rows dof"]:
    """`Trace.unsure` of all recordings, one below the other."""
    return np.concatenate([np.zeros(t.motion.q.shape) if t.unsure is None else t.unsure for t in traces])


def unresolved_known(traces: Sequence[Trace]) -> Float[np.ndarray, "rows dof"]:
    """What the friction that the user's model holds may be off from sample to sample; where it rests
    `Trace.trust` says."""
    return unresolved(traces, [_known_friction(t) for t in traces])


def _known_friction(trace: Trace) -> Float[np.ndarray, "_time dof"]:
    """Of the user's model [N m]."""
    arm = trace.motion.arm
    return np.asarray(arm.frictionloss) * trace.down(trace.sign) + np.asarray(arm.damping) * trace.motion.qd


def _level(torque: Float[np.ndarray, " rows"]) -> float:
    """Of dry friction while its joint moves [N m]."""
    moving = np.abs(torque) > 0.1 * np.abs(torque).max()
    return float(np.sqrt(np.mean(torque[moving] ** 2))) if moving.any() else 0.0


def of_known(
    traces: Sequence[Trace], std: Float[np.ndarray, " dof"]
) -> list[Float[np.ndarray, "_time dof _m"]]:
    """The same of the friction that the user's model holds, which is a law like any other."""
    arm, dof = traces[0].motion.arm, traces[0].motion.dof
    samples = [t.motion.samples for t in traces]
    parts = [np.zeros((sum(samples), dof, 0))]
    friction = np.concatenate([_known_friction(t) for t in traces])
    for j, level in enumerate(np.asarray(arm.frictionloss)):
        off = []
        if KNOWN_TURN * level > SEEN * std[j]:
            sign = np.concatenate([t.down(t.sign[:, j]) for t in traces])
            off.append(KNOWN_TURN * level * (turning(traces, j) - sign[:, None]))
        law = law_of("frictionloss")
        if law.discrepancy * np.sqrt(np.mean(friction[:, j] ** 2)) > SEEN * std[j]:
            copies = (_hats(traces, j, channel) for channel in law.varies_with)
            off += [law.discrepancy * friction[:, j, None] * copy for copy in copies]
        if off:
            parts.append(np.concatenate(off, 1)[:, None] * np.eye(dof)[j][:, None])
    return np.split(np.concatenate(parts, 2), np.cumsum(samples)[:-1])


def _hats(traces: Sequence[Trace], joint: int, channel: str) -> Float[np.ndarray, "rows n"]:
    if channel == "moments":
        parts = [hats(t.motion.time, max(3, round(np.ptp(t.motion.time) / _PERIOD))) for t in traces]
        return np.asarray(scipy.linalg.block_diag(*parts))
    x = {
        "q": lambda t: t.motion.q[:, joint],
        "qd": lambda t: t.motion.qd[:, joint],
        "t": lambda t: t.motion.time,
    }
    return hats(np.concatenate([x[channel](t) for t in traces]), _KNOTS[channel])
