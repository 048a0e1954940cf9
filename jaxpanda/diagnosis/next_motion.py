r"""The motion that would tell apart what these recordings cannot.

A finding a and its rival b are fitted to what was recorded. Over a new motion, a would leave

$$\delta^2(a|b) = \min_{\psi_b, c_b, x}\; \|W(\Phi_a c_a - \Phi_b(\psi_b)\,c_b - A x)\|^2$$

that no shape of b, refitted together with the nuisance on old and new data, could imitate: half of it is the
evidence for a that the motion is expected to bring [nats] (T-optimality, Atkinson and Fedorov 1975). Torque is
not needed for that, only q(t). Either may be the true one, so both directions count, by their probabilities (Box
and Hill 1967); of several rivals the one that is told least decides.

A finding that is in doubt although no rival is likely may be none: what no law of the catalogue describes has
passed for it. Then δ² is what the nuisance cannot imitate, and its evidence is $\tfrac12 n \log(1 + \delta^2/n)$
with n independent samples, as in `state.foretelling`. W is that of the error where the model was not fitted; the
same motion makes the same errors again, so that repeating it tells nothing of that.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy.interpolate
from jaxtyping import Float

from .. import files
from ..arms.mjcf import MjcfSource
from ..effects import UNNAMED, AbstractEffect, Channels, Motion
from ..host import parallel
from ..inference.evidence import Noise
from ..inference.knowledge import Knowledge, nuisance
from ..inference.library import columns_of
from ..inference.problem import Problem, Term, posed
from ..inference.state import State, coefficients, independent
from ..search.events import Proposal, swept
from ..search.proposals import grids
from ..traces import TRIM, Trace, held_sign
from .calibration import TOLD
from .finding import Finding
from .motions import Surroundings, motions

WORTH = 0.05
"""Probability from which a rival is worth an experiment."""
LEAST = 1.0
"""Evidence below which no motion decides [nats]: a rival that holds the finding as a special case stays."""
_RIVALS, _FINALISTS = 3, 2
_SHAPES = 16
"""Shapes of a rival that are tried in each of its forms, at most."""
NOTHING = "nothing"
"""The rival of a finding that may be none."""


@dataclasses.dataclass(frozen=True)
class Told:
    """One pair of explanations, and how well two motions tell them apart."""

    finding: str
    rival: str
    joint: int | None
    nats: float
    """Evidence that the recommended motion is expected to bring for whichever is true."""
    nats_repeated: float
    """The same of the recorded motion, once more."""

    def to_json(self) -> dict[str, Any]:
        return {**dataclasses.asdict(self), "joint": None if self.joint is None else self.joint + 1}


@dataclasses.dataclass(frozen=True)
class NextMotion:
    """A motion to record next."""

    kind: str
    time: Float[np.ndarray, " time"]
    q: Float[np.ndarray, "time dof"]
    qd: Float[np.ndarray, "time dof"]
    pairs: tuple[Told, ...]
    tried: tuple[tuple[str, float], ...]
    """Every motion that was compared, and the evidence for the pair that it tells least, by rivals in the shape
    that fitted [nats]."""
    said: str
    """What it was kept clear of, in a sentence."""

    def to_json(self) -> dict[str, Any]:
        return {
            "kind": self.kind,
            "file": "next_motion.csv",
            "seconds": float(self.time[-1] - self.time[0]),
            "pairs": [p.to_json() for p in self.pairs],
            "tried": [{"kind": kind, "nats": nats} for kind, nats in self.tried],
            "collisions": self.said,
        }

    def save(self, path: str | Path) -> None:
        """Write the motion as a canonical CSV without torque."""
        dof = self.q.shape[1]
        head = ",".join(["time", *(f"q_{j + 1}" for j in range(dof)), *(f"dq_{j + 1}" for j in range(dof))])
        rows = np.column_stack([self.time, self.q, self.qd])
        lines = [",".join(f"{v:.9g}" for v in row) for row in rows.tolist()]
        files.write_text(Path(path), "\n".join([head, *lines]) + "\n")


@dataclasses.dataclass(frozen=True)
class _Shapes:
    """Shapes of one form of an effect, with their columns on the recordings where those are known."""

    effects: tuple[AbstractEffect, ...]
    columns: tuple[np.ndarray, ...] | None = None


@dataclasses.dataclass(frozen=True)
class _Side:
    """One explanation of a pair: what it fitted, and every shape it may have, its own first."""

    effect: AbstractEffect
    c: Float[np.ndarray, " n"]
    shapes: tuple[_Shapes, ...]

    @property
    def alone(self) -> "_Side":
        """In its own shape only."""
        return dataclasses.replace(self, shapes=self.shapes[:1])


@dataclasses.dataclass(frozen=True)
class _Pair:
    a: _Side
    b: _Side | None
    """None for nothing in its place."""
    others: tuple[Term, ...]
    share: float
    """Probability of a, of the two."""
    doubt: float
    """Product of their probabilities."""

    @property
    def rival(self) -> str:
        return NOTHING if self.b is None else self.b.effect.name

    @property
    def alone(self) -> "_Pair":
        return dataclasses.replace(self, a=self.a.alone, b=None if self.b is None else self.b.alone)


def next_motion(
    problem: Problem,
    state: State,
    found: Sequence[Finding],
    spread: Float[np.ndarray, "standard n"],
    knowledge: Knowledge,
    source: MjcfSource,
) -> NextMotion | None:
    """The motion that tells best what the findings are confused with; None where none is worth it or tells.

    Args:
        problem: the recordings.
        state: the model that was found.
        found: the findings.
        spread: of the inertial parameters.
        knowledge: how well the model is known.
        source: the arm's file, for what it could run into.
    """
    pairs = [pair for finding in found for pair in _pairs(problem, state, finding)]
    pairs = sorted(pairs, key=lambda pair: -pair.doubt)[:_RIVALS]
    if not pairs:
        return None
    trace = max(problem.traces, key=lambda t: len(t.channels.t))
    sides = [side for p in pairs for side in (p.a, p.b) if side is not None]
    joints = sorted({j for side in sides for j in side.effect.joints[:1]})
    surroundings = Surroundings.around(problem, source)
    kinds, ways = zip(*motions(problem, trace, joints, surroundings), strict=True)
    new = _placed(trace, ways, spread, knowledge, problem.background)
    error = _Error.of(problem, state)
    quick = _told(problem, new, error, [pair.alone for pair in pairs])
    decidable = [k for k in range(len(pairs)) if max(row[k] for row in quick) >= LEAST]
    if not decidable:
        return None
    pairs, quick = [pairs[k] for k in decidable], [[row[k] for k in decidable] for row in quick]
    best = sorted(range(1, len(new)), key=lambda i: -min(quick[i]))[:_FINALISTS]
    chosen = [0, *best]
    told = _told(problem, [new[i] for i in chosen], error, pairs)
    results = [(kinds[i], ways[i], nats) for i, nats in zip(chosen, told, strict=True)]
    repeated = results[0][2]
    kind, q, told = max(results, key=lambda one: min(one[2]))
    if max(told) < LEAST:
        return None
    return NextMotion(
        kind,
        np.arange(len(q)) * trace.dt,
        q,
        np.gradient(q, trace.dt, axis=0),
        tuple(
            Told(
                p.a.effect.name,
                p.rival,
                p.a.effect.joints[0] if len(p.a.effect.joints) == 1 else None,
                float(t),
                float(r),
            )
            for p, t, r in zip(pairs, told, repeated, strict=True)
        ),
        tuple((kind, float(min(t))) for kind, t in zip(kinds, quick, strict=True)),
        surroundings.said,
    )


@dataclasses.dataclass(frozen=True)
class _Error:
    """What the model makes wrong where it was not fitted, as noise that another motion would have too."""

    noise: Noise
    independent: float
    """Share of its samples that are independent, in the joint where most are."""

    @classmethod
    def of(cls, problem: Problem, state: State) -> "_Error":
        noise, left = state.noise, problem.mispredicted(state.design, [state.noise])
        count = np.maximum(np.count_nonzero(left, 0), 1)
        more = np.maximum(np.sqrt(np.sum(left**2, 0) / count) / noise.std, 1.0)
        wider = dataclasses.replace(noise, sigma=noise.sigma * more, std=noise.std * more)
        return cls(wider, float(np.max(independent(left) / count)))


def _told(
    problem: Problem, new: Sequence[Problem], error: _Error, pairs: Sequence[_Pair]
) -> list[list[float]]:
    """For each motion, the first of which is the recorded one, and pair the evidence that it is expected to bring
    [nats]."""
    noise = error.noise
    old = [_pair_sums(problem, noise, pair) for pair in pairs]
    known = [_discrimination(pair, sums, error) for pair, sums in zip(pairs, old, strict=True)]

    def told(one: Problem) -> list[float]:
        row = []
        for pair, before, already in zip(pairs, old, known, strict=True):
            more = _pair_sums(one, dataclasses.replace(noise, trust=None, stays=None), pair)
            together = [_added(x, y) for x, y in zip(before, more, strict=True)]
            row.append(_discrimination(pair, together, error) - already)
        return row

    rows = parallel(told, new)
    rows[0] = [0.0 if pair.b is None else nats for pair, nats in zip(pairs, rows[0], strict=True)]
    return rows


def _pairs(problem: Problem, state: State, finding: Finding) -> list[_Pair]:
    """The finding against each rival that is worth an experiment."""
    rivals = {name: p for name, p in finding.alternatives if p >= WORTH}
    none = 1.0 - finding.confidence - sum(p for _, p in finding.alternatives)
    if not finding.terms:
        return []
    i = max(finding.terms, key=lambda i: float(np.sum(state.terms[i].columns[0] ** 2)))
    term = state.terms[i]
    stands_in = finding.effect == UNNAMED and term.effect.name != UNNAMED
    if not (rivals or none >= TOLD) or stands_in or term.effect.bound_to_recording:
        return []
    others = (*state.terms[:i], *state.terms[i + 1 :])
    a = _Side(term.effect, coefficients(state, i), _shapes(problem, term.effect))
    sure = finding.confidence
    out = [_Pair(a, None, others, 1.0, sure * none)] if none >= TOLD else []
    if not rivals:
        return out
    design = problem.design(others, state.noise)
    groups = [g for g in (*problem.library, *problem.catchalls) if g.name in rivals]
    lawful = [c for c in problem.catalogue if c.name in rivals and not c.free]
    proposals = [
        *grids(problem, design, state.noise, groups),
        *swept(problem, design, state.noise, term.effect.joints, lawful),
    ]
    best: dict[str, Proposal] = {}
    for p in proposals:
        name = p.effect.name
        if name in rivals and (name not in best or p.evidence > best[name].evidence):
            best[name] = p
    for name, p in best.items():
        more = problem.design((*others, problem.term(p.effect, p.deviation)), state.noise)
        b = _Side(p.effect, more.x[-len(p.deviation) :], _shapes(problem, p.effect))
        share = float(np.clip(sure / max(sure + rivals[name], 1e-9), 0.05, 0.95))
        out.append(_Pair(a, b, others, share, sure * rivals[name]))
    return out


def _shapes(problem: Problem, effect: AbstractEffect) -> tuple[_Shapes, ...]:
    """The shapes that an effect may have at its place, those of one form together; its own first."""
    out = [_Shapes((effect,))]
    for group in (*problem.library, *problem.catchalls):
        if group.name == effect.name and group.effects[0].joints == effect.joints:
            some = slice(None, None, -(-len(group.effects) // _SHAPES))
            out.append(_Shapes(group.effects[some], tuple(c[..., some, :] for c in group.columns)))
    return tuple(out)


@dataclasses.dataclass(frozen=True)
class _Sums:
    """Sums over samples, which add up over recordings: of y, of the columns A, and of each shape's columns."""

    n: int
    H: np.ndarray
    g: np.ndarray
    s: float
    C: tuple[np.ndarray, ...]
    u: tuple[np.ndarray, ...]
    G: tuple[np.ndarray, ...]


def _added(x: _Sums, y: _Sums) -> _Sums:
    def both(a, b):
        return tuple(p + q for p, q in zip(a, b, strict=True))

    return _Sums(x.n + y.n, x.H + y.H, x.g + y.g, x.s + y.s, both(x.C, y.C), both(x.u, y.u), both(x.G, y.G))


def _pair_sums(problem: Problem, noise: Noise, pair: _Pair) -> tuple[_Sums, ...]:
    """What a leaves for b to imitate, and the other way round where there is a b."""
    base = []
    for r, of_one in enumerate(problem.nuisance):
        columns = np.delete(of_one, problem.known_off, axis=2)
        held = [_wide(problem, _Shapes((t.effect,)), r)[:, :, 0] for t in pair.others]
        base.append(np.concatenate([columns, *held], 2))
    A = [problem.whitened([c[:, j] for c in base], noise, j) for j in range(problem.dof)]
    H = sum(a.T @ a for a in A)
    one = _sums(problem, noise, A, H, pair.a, () if pair.b is None else pair.b.shapes)
    return (one,) if pair.b is None else (one, _sums(problem, noise, A, H, pair.b, pair.a.shapes))


def _sums(
    problem: Problem, noise: Noise, A: list[np.ndarray], H: Any, true: _Side, rivals: Sequence[_Shapes]
) -> _Sums:
    y = [_wide(problem, true.shapes[0], r)[:, :, 0] @ true.c for r in range(len(problem.traces))]
    y = [problem.whitened([x[:, j] for x in y], noise, j) for j in range(problem.dof)]
    g = sum(a.T @ x for a, x in zip(A, y, strict=True))
    C, u, G = [], [], []
    for shapes in rivals:
        wide = [_wide(problem, shapes, r) for r in range(len(problem.traces))]
        m, k = wide[0].shape[2:]
        parts = np.zeros((H.shape[0], m * k)), np.zeros(m * k), np.zeros((m, k, k))
        for j in range(problem.dof):
            if not any(np.any(w[:, j]) for w in wide):
                continue
            F = problem.whitened([w[:, j] for w in wide], noise, j)
            flat = F.reshape(len(F), -1)
            parts[0][:] += A[j].T @ flat
            parts[1][:] += flat.T @ y[j]
            stacked = np.moveaxis(F, 1, 0)
            parts[2][:] += np.swapaxes(stacked, 1, 2) @ stacked
        C.append(parts[0])
        u.append(parts[1])
        G.append(parts[2])
    n = sum(t.motion.samples for t in problem.traces)
    return _Sums(n, H, np.asarray(g), float(sum(x @ x for x in y)), tuple(C), tuple(u), tuple(G))


def _wide(problem: Problem, shapes: _Shapes, r: int) -> Float[np.ndarray, "_time dof m n"]:
    """Columns of shapes of one form at all joints of a recording; zero where they are bound to another."""
    trace, effect = problem.traces[r], shapes.effects[0]
    out = np.zeros((trace.motion.samples, problem.dof, len(shapes.effects), len(effect.coefficients)))
    if not problem.active[r] or effect.bound_to_recording:
        return out
    known = None if trace.tau is None else shapes.columns
    columns = columns_of(shapes.effects, trace) if known is None else known[r]
    if effect.one_joint:
        out[:, effect.joints[0]] = columns
        return out
    return columns


def _discrimination(pair: _Pair, sums: Sequence[_Sums], error: _Error) -> float:
    """Expected evidence for whichever of a pair is true [nats]."""
    if pair.b is None:
        (one,) = sums
        return 0.5 * error.independent * one.n * float(np.log1p(_left(one, pair) / one.n))
    a, b = (_left(one, pair) for one in sums)
    return 0.5 * (pair.share * a + (1 - pair.share) * b)


def _left(sums: _Sums, pair: _Pair) -> float:
    """$\\delta^2$: what no shape of the rival imitates."""
    precision = np.ones(len(sums.g))
    if pair.others:
        own = np.concatenate([t.deviation**-2.0 for t in pair.others])
        precision[len(precision) - len(own) :] = own
    H = sums.H + np.diag(precision)
    x = np.linalg.solve(H, sums.g)
    best = sums.s - sums.g @ x
    left = best
    for C, u, G in zip(sums.C, sums.u, sums.G, strict=True):
        m, k, _ = G.shape
        b = (u - C.T @ x).reshape(m, k)
        C = C.reshape(len(H), m, k)
        S = G - np.einsum("amk,aml->mkl", C, np.linalg.solve(H, C.reshape(len(H), m * k)).reshape(C.shape))
        S = S + 1e-9 * (np.trace(G, axis1=1, axis2=2)[:, None, None] / k + 1e-12) * np.eye(k)
        gained = np.einsum("mk,mk->m", b, np.linalg.solve(S, b[:, :, None])[:, :, 0])
        left = min(left, float(best - gained.max()))
    return max(float(left), 0.0)


def _placed(
    trace: Trace,
    ways: Sequence[Float[np.ndarray, "time dof"]],
    spread: Float[np.ndarray, "standard n"],
    knowledge: Knowledge,
    background: Sequence[Term] = (),
) -> list[Problem]:
    """Motions on the grids of a recording, each as a problem of its own, without torque; the friction that the
    model holds is taken for exact there."""
    arm, dt = trace.motion.arm, trace.dt
    stride = int(trace.keep[1] - trace.keep[0])
    exact = np.full(arm.dof, np.inf)  # no law is taken for wrong
    speeds = [np.gradient(q, dt, axis=0) for q in ways]
    bends = [np.gradient(qd, dt, axis=0) for qd in speeds]
    signs = held_sign(arm, np.concatenate(speeds), np.concatenate(bends), np.full(arm.dof, 1e-4))
    out = []
    for q, qd, qdd, sign in zip(ways, speeds, bends, np.split(signs, len(ways)), strict=True):
        time = trace.signals.time[0] + np.arange(len(q)) * dt  # what drifts does as it did in the recording
        ends = min(round(TRIM / dt), len(q) // 4)
        keep = np.arange(ends, len(q) - ends, stride)
        friction = np.asarray(arm.damping) * qd + np.asarray(arm.frictionloss) * sign
        motion = Motion(arm, time[keep], q[keep], qd[keep], qdd[keep], friction[keep])
        load = scipy.interpolate.CubicSpline(motion.time, motion.load)(np.clip(time, *motion.time[[0, -1]]))
        torque = load + friction
        channels = Channels(time, q, qd, qdd, load, torque, torque, sign)
        weight = np.ones(len(keep))
        new = Trace(
            "next",
            trace.signals,
            channels,
            dt,
            motion,
            None,
            weight,
            keep,
            trace.cutoff,
            sign,
            np.ones((len(keep), arm.dof)),
        ).showing(trace.friction_shown)
        out.append(posed((new,), (True,), nuisance([new], spread, knowledge, exact)[0], background))
    return out
