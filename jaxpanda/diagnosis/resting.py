r"""Arms that hold still: what torque says although no joint moves.

At rest friction is bounded, not known: $|f_j| \le F_j$ with the model's `frictionloss` F. So a joint tells
something only where the measured torque differs from the model's gravity by more than that; a change during
the recording only where it exceeds $2 F_j$, as friction may have stood at either end. What lies within is
anybody's.

Torque is cut into short blocks. Intervals in which its level differs from that of the rest are events; the
level of the rest, over all recordings, is steady. Either is explained by one of some models, each linear in
parameters x with declared deviations $\Lambda$: a force on a link, a body at the flange, a base that is not
level, other links, a bias of the sensors, friction that the model does not have. By Laplace's method the
evidence of a model with columns B is

$$ \log p = -\min_x \Big[ \tfrac12 \sum_j \frac{\max(0, |d_j - B_j x| - b_j)^2}{\sigma_j^2} + \tfrac12 x^\top
\Lambda^{-1} x \Big] - \tfrac12 \log \det(I + \Lambda^{1/2} B^\top S^{-1} B \Lambda^{1/2}),
\quad S_{jj} = \sigma_j^2 + b_j^2/3, $$

the bound b as wide as friction leaves it, $\sigma$ of the level's mean by the noise from block to block,
correlated noise included. No joint moved, so none was judged: a finding here is at most "partly explained",
and what the prediction uses is the user's own model.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
import scipy.special
from jaxtyping import Bool, Float

from .. import summaries
from ..arms.arm import Arm
from ..arms.mjcf import MjcfSource
from ..corrected import Corrected
from ..effects import CATALOGUE, UNNAMED, AbstractEffect, LawAtRest, Levels, Motion, may_carry
from ..errors import InputError
from ..inference.knowledge import Knowledge, inertial_spread
from ..recordings import Recording
from ..report import Figure, Section, Table, estimate, number
from ..traces import TRIM, Trace
from .finding import Finding, Fit
from .localise import ALARM
from .saved import AbstractAsItIs
from .unnamed import UNSURE

YIELDS = 0.02
"""Travel below which an arm holds still [rad]: what gives way by milliradians under a force does not move."""
LEAST = 3 * TRIM
"""Rest that is left to be judged, at least [s]."""
_BLOCK, _BLOCKS = 0.1, 240
"""Torque is averaged over so long [s], or longer where there would be more blocks than so many."""
_FEWEST = 8
"""Blocks of which noise can be told."""
_EVENTS = 4
"""Events in a recording, at most."""
_ABSOLUTE = 0.05
"""How well a level of torque is known beside noise, as a share of that."""
_SIZES = 1.0, 0.2
"""Half of what happens is of the declared deviations, half smaller by this."""
_VARIES = 2.5
"""How far the variance of noise from block to block may differ by chance, in itself."""
_NOTHING = 0.5
"""Prior odds of nothing, beside those that effects declare."""
_TOLD = 0.02
"""Probability from which an alternative is told."""


@dataclasses.dataclass(frozen=True)
class Level:
    """One recording at rest: its torque in blocks, and what noise does to their means."""

    trace: Trace
    start: Float[np.ndarray, " blocks"]
    stop: Float[np.ndarray, " blocks"]
    """[s]"""
    mean: Float[np.ndarray, "blocks dof"]
    """Measured less modelled torque, friction left out of the model [N m]."""
    long: Float[np.ndarray, " dof"]
    """Deviation of a mean over n blocks, times the root of n [N m]."""
    event: Bool[np.ndarray, " blocks"]
    """In some event."""
    motion: Motion
    """The mean pose, at rest."""

    @property
    def level(self) -> Float[np.ndarray, " dof"]:
        """Mean outside of events [N m]."""
        return self.mean[~self.event].mean(0)

    @property
    def std(self) -> Float[np.ndarray, " dof"]:
        """Of `level` [N m]."""
        return self.long / np.sqrt(np.sum(~self.event))


@dataclasses.dataclass(frozen=True, kw_only=True)
class AtRest(AbstractAsItIs):
    """What recordings of an arm at rest say."""

    levels: tuple[Level, ...] = dataclasses.field(repr=False)

    @property
    def opening(self) -> str:
        if self.findings:
            return (
                "No joint moved, and torque at rest differs from the simulation's by more than friction can"
                " carry."
            )
        return (
            "No joint moved, so that none was judged; what differs at rest is within noise, what the model's"
            " numbers leave open, and the friction that may carry it."
        )


def rests(trace: Trace) -> bool:
    """Whether the arm holds still in a recording."""
    return bool(np.all(np.ptp(trace.motion.q, axis=0) < YIELDS))


def while_still(recording: Recording, trace: Trace) -> Recording:
    """The rows of a recording in which an arm that rests in its trace holds still, without those at its ends in
    which it sets out or comes to rest, which filters had cut off.

    Raises:
        InputError: too few are left.
    """
    moves = np.abs(recording.q - trace.motion.q.mean(0)).max(1) > YIELDS
    first, last = np.searchsorted(recording.time, trace.motion.time[[0, -1]])
    before, after = np.flatnonzero(moves[:first]), last + np.flatnonzero(moves[last:])
    kept = slice(int(before[-1]) + 1 if len(before) else 0, int(after[0]) if len(after) else len(moves))
    if kept == slice(0, recording.samples):
        return recording
    still = recording.at(kept)
    seconds = float(np.ptp(still.time))
    if seconds < LEAST:
        raise InputError(
            f"{recording.name}: the arm moves only within {TRIM:g} s of an end, where filters tell no torque, and"
            f" holds still for {seconds:.2f} s beside; record the whole motion, or {LEAST:g} s of rest or more"
        )
    note = (
        f"{recording.name}: judged where the arm holds still, {still.time[0]:.2f} to {still.time[-1]:.2f} s"
    )
    return dataclasses.replace(still, notes=(*recording.notes, note))


def judge(
    traces: Sequence[Trace],
    reference: Sequence[Trace],
    source: MjcfSource,
    knowledge: Knowledge,
    catalogue: Sequence[type[AbstractEffect]] = CATALOGUE,
) -> AtRest:
    """What recordings in all of which the arm holds still say.

    Args:
        traces: of the recordings.
        reference: of recordings from when nothing was wrong; those at rest in the same pose count.
        source: the simulation.
        knowledge: how well its numbers are known.
        catalogue: effects that are tried.
    """
    arm = traces[0].motion.arm
    bound = np.asarray(arm.frictionloss)
    levels = tuple(_with_events(_level(trace), bound) for trace in traces)
    healthy = [_level(trace) for trace in reference if rests(trace)]
    found = [one for level in levels for one in _events(level, arm, catalogue)]
    steady = _steady(levels, healthy, arm, knowledge, catalogue)
    found = sorted([*found, *steady], key=lambda one: -one.evidence)
    before = np.concatenate([t.residual_at_rest for t in traces])
    rms = np.sqrt(np.mean(before**2, 0))
    floor = np.sqrt(np.mean(np.concatenate([_fast(t) for t in traces]) ** 2, 0))
    return AtRest(
        verdict="consistent"
        if not found
        else "unexplained"
        if {one.family for one in found} == {UNNAMED}
        else "partly_explained",
        findings=tuple(found),
        fit=Fit(rms, rms, rms, rms, np.maximum(floor, 1e-9)),
        corrected=Corrected.of(arm),
        source=source,
        notes=tuple(_notes(levels, arm, bool(found))),
        levels=levels,
        knowledge=knowledge,
    )


def _fast(trace: Trace) -> Float[np.ndarray, "time dof"]:
    """What changes within a block [N m]."""
    r, width = trace.residual_at_rest, max(2, round(_BLOCK / trace.motion.dt))
    whole = r[: len(r) // width * width].reshape(-1, width, r.shape[1])
    return (whole - whole.mean(1, keepdims=True)).reshape(-1, r.shape[1]) if len(whole) else r - r.mean(0)


def _level(trace: Trace) -> Level:
    """A recording in blocks."""
    motion, r = trace.motion, trace.residual_at_rest
    there = np.flatnonzero(trace.weight > 0)
    seconds = len(there) * motion.dt
    width = max(1, round(max(min(_BLOCK, seconds / 40), seconds / _BLOCKS) / motion.dt))
    cut = [part for part in np.array_split(there, max(1, len(there) // width)) if len(part)]
    mean = np.stack([r[part].mean(0) for part in cut])
    edges = np.array([[motion.time[part[0]], motion.time[part[-1]]] for part in cut])
    q, still = np.stack([motion.q.mean(0)] * 2), np.zeros((2, motion.dof))
    rest = Motion(motion.arm, np.array([0.0, 1.0]), q, still, still, still)
    return Level(trace, edges[:, 0], edges[:, 1], mean, _long(mean, trace), np.zeros(len(mean), bool), rest)


def _long(mean: Float[np.ndarray, "blocks dof"], trace: Trace) -> Float[np.ndarray, " dof"]:
    """Deviation of a mean over many blocks, times the root of their number.

    Allan's variance: half the square by which means over m blocks differ from those over the next m, times m, of
    the m with which that is largest, as noise may be slow. The median of squares does not mind events. Of few
    means it is uncertain, and taken higher by that.
    """
    n = len(mean)
    least = trace.torque_step / np.sqrt(12)
    if n < _FEWEST:
        return np.maximum(np.sqrt(n) * np.ptp(mean, axis=0), least)
    sums, found = np.concatenate([np.zeros_like(mean[:1]), np.cumsum(mean, 0)]), []
    m = 1
    while m == 1 or 10 * m <= n:
        means = (sums[m:] - sums[:-m]) / m
        apart = np.median(np.abs(means[m:] - means[:-m]), axis=0) / 0.6745 / np.sqrt(2)
        found.append(np.sqrt(m) * apart * (1 + UNSURE * np.sqrt(m / n)))
        m *= 2
    return np.maximum(np.max(found, 0), least)


def _with_events(level: Level, bound: Float[np.ndarray, " dof"]) -> Level:
    """The recording with the blocks marked in which its level differs by more than friction at rest explains."""
    for _ in range(_EVENTS):
        inside = _interval(level, bound)
        if inside is None:
            break
        quiet = ~level.event
        if not level.event.any() and (inside.min() == 0 or inside.max() == len(level.mean) - 1):
            other = np.flatnonzero(quiet & ~np.isin(np.arange(len(quiet)), inside))
            inside = _stranger(level, inside, other, bound)
        event = level.event.copy()
        event[inside] = True
        level = dataclasses.replace(level, event=event)
    return level


def _stranger(level: Level, a: np.ndarray, b: np.ndarray, bound: Float[np.ndarray, " dof"]) -> np.ndarray:
    """Of two parts of a recording the one that is further from the model; the shorter where that says nothing."""
    off = [
        np.sum(np.maximum(np.abs(level.mean[part].mean(0)) - bound, 0) ** 2 / level.long**2)
        for part in (a, b)
    ]
    if max(off) > 2 * min(off) + 2 * len(bound):
        return a if off[0] > off[1] else b
    return a if len(a) <= len(b) else b


def _interval(level: Level, bound: Float[np.ndarray, " dof"]) -> np.ndarray | None:
    """Blocks of the interval that differs most from the other blocks that are in no event, if beyond chance."""
    quiet = np.flatnonzero(~level.event)
    n, dof = len(quiet), level.mean.shape[1]
    if n < _FEWEST:
        return None
    sums = np.concatenate([np.zeros((1, dof)), np.cumsum(level.mean[quiet], 0)])
    first, last = np.triu_indices(n + 1, 2)
    count = last - first
    fits = n - count >= 2
    first, last, count = first[fits], last[fits], count[fits]
    inner = sums[last] - sums[first]
    difference = inner / count[:, None] - (sums[-1] - inner) / (n - count)[:, None]
    share = count * (n - count) / n
    beyond = np.maximum(np.abs(difference) - 2 * bound, 0) / level.long
    gain = share * np.sum(beyond**2, 1)
    best = int(np.argmax(gain))
    x = np.log(n * n / (2 * ALARM))
    if (
        gain[best] < dof + 2 * np.sqrt(dof * x) + 2 * x
    ):  # chi squared (Laurent and Massart 2000), any interval
        return None
    return quiet[first[best] : last[best]]


Cause = type[AbstractEffect] | None
"""What explains levels of torque: an effect, or nothing."""


@dataclasses.dataclass(frozen=True)
class _Fitted:
    """A law's evidence [nats] and parameters."""

    evidence: float
    x: Float[np.ndarray, " n"]
    covariance: Float[np.ndarray, "n n"]


def _fitted(
    law: LawAtRest,
    d: Float[np.ndarray, " rows"],
    std: Float[np.ndarray, " rows"],
    bound: Float[np.ndarray, " rows"],
    links: Float[np.ndarray, "rows m"],
) -> _Fitted:
    """The equation at the top of this file, by Newton's method; `links` are columns that every law has."""
    B = np.concatenate([law.columns, links], 1)
    n = B.shape[1]
    x = np.zeros(n)

    def cost(x: np.ndarray) -> float:
        over = np.maximum(np.abs(d - B @ x) - bound, 0) / std
        return 0.5 * float(over @ over + x @ x)

    for _ in range(60):
        e = d - B @ x
        active = np.abs(e) > bound
        W = B[active] / std[active, None] ** 2
        step = np.linalg.solve(W.T @ B[active] + np.eye(n), W.T @ (e - bound * np.sign(e))[active] - x)
        size = 1.0
        while cost(x + size * step) > cost(x) and size > 1e-6:
            size /= 2
        x = x + size * step
        if np.abs(step).max(initial=0.0) * size < 1e-9:
            break
    wide = B / np.sqrt(std**2 + bound**2 / 3)[:, None]
    H = wide.T @ wide + np.eye(n)
    covariance = np.linalg.inv(H)
    evidence = -cost(x) - 0.5 * float(np.linalg.slogdet(H)[1])
    if law.positive:
        evidence += float(scipy.special.log_ndtr(x[0] / np.sqrt(covariance[0, 0]))) + np.log(2.0)
    count = law.columns.shape[1]
    return _Fitted(evidence, x[:count], covariance[:count, :count])


def _compared(
    catalogue: Sequence[type[AbstractEffect]],
    levels: Levels,
    d: Float[np.ndarray, " rows"],
    std: Float[np.ndarray, " rows"],
    bound: Float[np.ndarray, " rows"],
    links: Float[np.ndarray, "rows m"],
    told_by: Mapping[str, float] = MappingProxyType({}),
) -> tuple[dict[Cause, float], dict[Cause, tuple[LawAtRest, _Fitted]], float]:
    """Probability of each cause, the best law of each, and evidence of the best over nothing [nats]; `told_by` is
    how much likelier the course of torque is with laws that are told by it."""
    nothing = LawAtRest(np.zeros((len(d), 0)), _NOTHING)
    laws: list[tuple[Cause, LawAtRest]] = [(None, nothing)]
    laws += [(effect, law) for effect in catalogue for law in effect.while_still(levels)]
    tried = [
        (cause, law.scaled(size, 0.5 * told_by.get(law.told_by, 1.0)))
        for cause, law in laws
        for size in _SIZES
    ]
    fitted = [_fitted(law, d, std, bound, links) for _, law in tried]
    scores = np.array([f.evidence + np.log(law.odds) for (_, law), f in zip(tried, fitted, strict=True)])
    weights = np.exp(scores - scores.max())
    weights /= weights.sum()
    chances: dict[Cause, float] = {}
    best: dict[Cause, tuple[LawAtRest, _Fitted]] = {}
    for i in np.argsort(-scores):
        cause, law = tried[i]
        chances[cause] = chances.get(cause, 0.0) + float(weights[i])
        best.setdefault(cause, (law, fitted[i]))
    return chances, best, max(f.evidence for f in fitted) - best[None][1].evidence


def _events(level: Level, arm: Arm, catalogue: Sequence[type[AbstractEffect]]) -> list[Finding]:
    """A finding for all events of a recording that have the same cause."""
    edges = np.flatnonzero(np.diff(np.r_[False, level.event, False]))
    out: list[Finding] = []
    quiet = ~level.event
    if not level.event.any() or not quiet.any():
        return out
    bound, none = 2 * np.asarray(arm.frictionloss), np.zeros((arm.dof, 0))
    for first, last in edges.reshape(-1, 2).tolist():
        d = level.mean[first:last].mean(0) - level.level
        std = level.long * np.sqrt(1 / (last - first) + 1 / quiet.sum())
        passes = first > 0 and last < len(level.mean)
        explained = Levels([level.motion], "passing" if passes else "lasting")
        course = {"sliding": _slides(level, first, last), "keeping": _keeps(level, first, last)}
        compared = _compared(catalogue, explained, d, std, bound, none, course)
        if compared[0][None] > 0.5:
            continue
        span = (float(level.start[first]), float(level.stop[last - 1]))
        out.append(_told(compared, d, std, bound, [level], span))
    return out


def _keeps(level: Level, first: int, last: int) -> float:
    """How likely a body is, by how torque varies during an event: a hand varies its force, a body does not.

    Likelihood ratio of the variance from block to block being what it is elsewhere, 1e-3 at least; elsewhere by
    the lower quartile, as there may be other events.
    """
    inner = level.mean[first + 1 : last - 1]
    if len(inner) < 4:
        return 1.0
    usual = np.quantile(np.abs(np.diff(level.mean, axis=0)), 0.25, axis=0) / 0.3186
    ratio = np.mean(np.diff(inner, axis=0) ** 2, 0) / np.maximum(usual, 1e-9) ** 2 / _VARIES
    said = 0.5 * (len(inner) - 1) * np.where(ratio > 1, ratio - 1 - np.log(np.maximum(ratio, 1e-9)), 0.0)
    return float(np.exp(-np.clip(said.max(), 0.0, 6.9)))


def _slides(level: Level, first: int, last: int) -> float:
    """How much likelier a slow change is than a sudden one, at the edges of an event; between 1e-6 and 1e6.

    The blocks about an edge as a step, against a straight line through them.
    """
    said = 0.0
    for edge in (first, last):
        reach = min(edge, len(level.mean) - edge, 10)
        if reach < 3:
            continue
        x = level.mean[edge - reach : edge + reach] / level.long
        t = np.linspace(-1, 1, 2 * reach)
        left = [
            np.sum((x - A @ np.linalg.lstsq(A, x, rcond=None)[0]) ** 2)
            for A in (np.stack([np.ones(2 * reach), t], 1), np.stack([np.ones(2 * reach), np.sign(t)], 1))
        ]
        said += 0.5 * (left[1] - left[0])
    return float(np.exp(np.clip(said, -13.8, 13.8)))


def _steady(
    levels: Sequence[Level],
    healthy: Sequence[Level],
    arm: Arm,
    knowledge: Knowledge,
    catalogue: Sequence[type[AbstractEffect]],
) -> list[Finding]:
    """What stands in the level of all recordings."""
    loss, carries = np.asarray(arm.frictionloss), may_carry(arm)
    ds, stds, bounds = [], [], []
    for level in levels:
        d, std, bound = level.level, np.hypot(level.std, _ABSOLUTE * carries), loss
        same = [h for h in healthy if np.abs(h.motion.q[0] - level.motion.q[0]).max() < YIELDS]
        if same:
            d, std, bound = d - same[0].level, np.hypot(std, same[0].std), 2 * loss
        ds.append(d)
        stds.append(std)
        bounds.append(bound)
    d, std, bound = (np.concatenate(parts) for parts in (ds, stds, bounds))
    motions = [level.motion for level in levels]
    felt = np.concatenate([m.regressor[0] for m in motions])
    noise = np.maximum(np.mean([level.long for level in levels], 0), 1e-6)
    links = _distinct(felt @ inertial_spread(arm, knowledge, noise))
    rough = _distinct(2 * felt @ inertial_spread(arm, "rough", noise))
    compared = _compared(catalogue, Levels(motions, "throughout", rough), d, std, bound, links)
    return [] if compared[0][None] > 0.5 else [_told(compared, d, std, bound, levels, None)]


def _distinct(columns: Float[np.ndarray, "rows n"]) -> Float[np.ndarray, "rows m"]:
    """Columns of the same covariance, no more than rows."""
    U, s, _ = np.linalg.svd(columns, full_matrices=False)
    return U * s


def _told(
    compared: tuple[Mapping[Cause, float], Mapping[Cause, tuple[LawAtRest, _Fitted]], float],
    d: np.ndarray,
    std: np.ndarray,
    bound: np.ndarray,
    levels: Sequence[Level],
    span: tuple[float, float] | None,
) -> Finding:
    """The likeliest effect as a finding, with the others as its alternatives."""
    chances, best, evidence = compared
    ranked = sorted(((p, cause) for cause, p in chances.items() if cause), key=lambda one: -one[0])
    confidence, effect = ranked[0]
    law, fit = best[effect]
    dof = levels[0].motion.dof
    beyond = np.abs(d) - bound > 2 * std
    seen = np.flatnonzero(beyond.reshape(-1, dof).any(0)).tolist()
    at = tuple(range(dof)) if law.names or not seen else tuple(seen)
    joints = at if law.link is None else (law.link,)
    place = None if law.link is None else law.link + 1
    units = law.scale * np.array([size for _, _, size in law.names])
    deviations = np.sqrt(np.diag(fit.covariance))
    parameters: list[dict[str, Any]] = [
        {"name": name, "joint": place, "value": float(x * size), "std": float(std * size), "unit": unit}
        for (name, unit, _), x, std, size in zip(law.names, fit.x, deviations, units, strict=False)
    ]
    torque, wide = law.columns @ fit.x, np.hypot(std, bound / np.sqrt(3))
    if not parameters and len(levels) == 1:
        parameters = [
            {"name": "torque", "joint": j + 1, "value": float(torque[j]), "std": float(wide[j]),
             "unit": levels[0].motion.arm.unit("N·m", j)}
            for j in joints
        ]  # fmt: skip
    shares = [float(level.event.mean()) if span else 1.0 for level in levels]
    rms = np.sqrt(np.mean(np.asarray(shares)[:, None] * torque.reshape(-1, dof) ** 2, 0))
    shown = ", ".join(
        f"{d[j]:+.3g} {levels[0].motion.arm.unit('N·m', j)} at joint {j + 1}" for j in (seen or range(dof))
    )
    names = ", ".join(level.trace.name for level in levels)
    when = f"from {span[0]:.2f} to {span[1]:.2f} s " if span else ""
    others = " or ".join(map(_in_words, (other for p, other in ranked[1:3] if p > 0.1)))
    summary = (
        f"In {names} the arm holds still, and {when}torque {'changes' if span else 'is off'} by {shown}"
        + (" (in the first recording)" if len(levels) > 1 else "")
        + f", beyond what friction at rest can carry: {_in_words(effect)}"
        + (f", or {others}." if others else ".")
    )
    return Finding(
        effect=effect.name,
        joints=joints,
        recordings=tuple(level.trace.name for level in levels),
        intervals=None if span is None else (span,),
        confidence=confidence,
        alternatives=tuple((other.name, p) for p, other in ranked[1:] if p >= _TOLD),
        equation="|tau - g(q) - tau_effect| <= frictionloss, at rest",
        parameters=tuple(parameters),
        rms_torque=rms,
        evidence=evidence,
        summary=summary,
        own_family=effect.family,
    )


def _in_words(effect: type[AbstractEffect]) -> str:
    return effect.at_rest or _plain(effect.name)


def _notes(levels: Sequence[Level], arm: Arm, found: bool) -> list[str]:
    loss = np.asarray(arm.frictionloss)
    listed = lambda values: ", ".join(f"{v:.2g}" for v in values)
    said = [
        f"{level.trace.name}: no joint moves, so that none was judged; friction at rest may carry any load up to"
        " its limit"
        for level in levels
    ]
    said.append(
        f"friction at rest was taken to carry up to the model's frictionloss: {listed(loss)} {arm.unit('N·m')} at"
        f" joints 1 to {arm.dof}"
        if np.any(loss)
        else "the model has no frictionloss; what friction at rest carries in truth is one of the explanations of"
        " a difference"
    )
    changes = np.min([2 * loss + 4 * level.long * np.sqrt(2 / len(level.mean)) for level in levels], 0)
    said.append(f"a change of {listed(changes)} {arm.unit('N·m')} for half of a recording would have shown")
    travel = np.max([np.ptp(level.trace.motion.q, axis=0) for level in levels], 0)
    if travel.max() > 1e-3:
        said.append(
            f"joint {int(travel.argmax()) + 1} gave way by {1e3 * travel.max():.2g} mrad: what holds it yields,"
            " which was not taken for motion"
        )
    said += [
        f"{t.name}: {what}: {count}"
        for level in levels
        for t in [level.trace]
        for what, count in t.signals.repairs.items()
    ]
    said += [note for level in levels for note in level.trace.signals.notes]
    if found:
        said.append(
            "corrected.xml and `predict` are your model as it is: nothing that is seen at rest alone is put in"
        )
    return said


def sections(found: AtRest) -> list[Section]:
    """The page."""
    arm = found.corrected.arm
    names = arm.joint_names
    columns = summaries.fit_columns(found.fit.to_json())
    table = summaries.by_joint(f"Torque error at rest, rms [{arm.unit('N·m')}]", names, columns)
    tone = "unsure" if found.findings else "good"
    out = [Section("Verdict", [*found.lines(), *found.notes], [table], tone=tone)]
    for i, one in enumerate(found.findings):
        tables = []
        if one.parameters:
            rows = [
                [
                    p["name"],
                    str(p["joint"] or "-"),
                    estimate(p["value"], p["std"]),
                    number(p["std"], 2),
                    p["unit"],
                ]
                for p in one.parameters
            ]
            tables.append(Table(["parameter", "joint", "value", "deviation", "unit"], rows))
        rows = [[_plain(name), f"{p:.2f}"] for name, p in ((one.effect, one.confidence), *one.alternatives)]
        tables.append(Table(["what it could be", "probability"], rows))
        out.append(Section(f"{i + 1}. {_plain(one.effect)}", [one.summary], tables))
    out.append(Section("Torque at rest", figures=[_drawn(level, names) for level in found.levels[:3]]))
    out.append(Section("Your file", ["corrected.xml is your file as it was."]))
    return out


def _plain(effect: str) -> str:
    return effect.replace("_", " ")


def _drawn(level: Level, names: Sequence[str]) -> Figure:
    """Measured less modelled torque, and what friction at rest may carry."""
    arm = level.trace.motion.arm
    loss = np.asarray(arm.frictionloss)

    def draw(canvas: Any) -> None:
        axes = canvas.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
        for j, axis in enumerate(axes):
            axis.plot(level.start, level.mean[:, j], drawstyle="steps-post", color="#1f6fb2")
            axis.axhspan(-loss[j], loss[j], color="0.5", alpha=0.2, linewidth=0)
            axis.set_ylabel(f"{names[j][:14]}\n[{arm.unit('N·m', j)}]")
        axes[-1].set_xlabel("time [s]")

    caption = f"{level.trace.name}: measured less modelled torque; grey: what friction at rest may carry"
    return Figure(draw, caption, (10.0, 1.05 * len(names)))
