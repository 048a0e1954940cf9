"""Scans over what the grids cannot hold: windows in time, and orders of ripple."""

import dataclasses
from collections.abc import Iterable, Iterator

import numpy as np
import scipy.linalg
import scipy.special
from jaxtyping import Float

from ..effects import AbstractEffect
from ..effects.contact import ExternalContact
from ..effects.drive import TorqueRipple
from ..effects.load import PayloadChange
from .evidence import PHYSICAL_SCALES, SCALES, Design, Noise, log_bayes
from .problem import Problem

BIN = 0.1
"""Resolution of the scan over time [s]."""
_WIDTHS = (2, 3, 5, 8, 12, 18, 27, 40, 60, 90, 135)
_EDGE = 3


@dataclasses.dataclass(frozen=True)
class Proposal:
    """The likeliest shape of an effect at one place, and the evidence for the effect there."""

    effect: AbstractEffect
    evidence: float
    """Averaged over shapes: what the effect has gained, its search paid for [nats]."""
    best: float
    """Of the likeliest shape [nats]."""
    deviation: Float[np.ndarray, " n"]
    steps: tuple[float, ...]
    """First steps of a refinement, one a shape parameter."""

    @property
    def key(self) -> tuple[str, tuple[int, ...]]:
        return self.effect.name, self.effect.joints


def ripple(problem: Problem, design: Design, noise: Noise, joints: Iterable[int]) -> Iterator[Proposal]:
    """For each of these joints the likeliest order."""
    for j in joints:
        q = [t.motion.q[:, j] for t in problem.traces]
        travel = max(np.ptp(x) for x in q)
        speed = np.sqrt(np.mean(np.concatenate([t.motion.qd[:, j] for t in problem.traces]) ** 2))
        if travel < 0.1 or speed < 0.02:
            continue
        step = np.pi / (2 * travel)
        highest = min(400.0, 2 * np.pi * 0.9 * problem.traces[0].cutoff / speed)
        orders = np.arange(
            max(5.0, 3 * np.pi / travel), highest, step
        )  # one turn and a half, lest it be a spring
        if not len(orders):
            continue
        Phi, G = problem.prepared(
            ("ripple",),
            lambda q=q, orders=orders: [
                np.stack([np.sin(x[:, None] * orders), np.cos(x[:, None] * orders)], 2) * on
                for x, on in zip(q, problem.active, strict=True)
            ],
            noise,
            j,
        )
        b, G = design.in_joint(j, Phi, G)
        deviation = np.full((len(orders), 2), noise.std[j] * np.sqrt(2))
        score, scale = log_bayes(b, G, deviation, SCALES)
        top = int(score.argmax())
        evidence = float(scipy.special.logsumexp(score) - np.log(len(score)))
        yield Proposal(
            TorqueRipple(j, float(orders[top]), "one"),
            evidence,
            float(score[top]),
            deviation[top] * scale[top],
            (0.4 * step / orders[top],),
        )


def windows(problem: Problem, design: Design, noise: Noise) -> Iterator[Proposal]:
    """For each link and recording the likeliest window of a contact, and the likeliest change of payload."""
    L = None if design.factor is None else design.factor[0]
    first = np.cumsum([0, *(t.motion.samples for t in problem.traces)])
    for r, (trace, on) in enumerate(zip(problem.traces, problem.active, strict=True)):
        if not on:
            continue
        bins = max(2, round(BIN / trace.motion.dt))
        edges = np.arange(0, trace.motion.samples, bins)
        clock = trace.motion.time[edges]
        rows = slice(first[r], first[r + 1])
        left = [(res - A @ design.x)[rows] for res, A in zip(design.residual, design.columns, strict=True)]
        nuisance = [A[rows] for A in design.columns]

        def sums(columns, joints, trace=trace, left=left, nuisance=nuisance, edges=edges):
            n = columns.shape[2]
            G, b = np.zeros((len(edges), n, n)), np.zeros((len(edges), n))
            C = np.zeros((len(edges), nuisance[0].shape[1], n))
            for j in joints:
                F = noise.whiten(columns[:, j], j) * trace.weight[:, None]
                G += np.add.reduceat(np.einsum("ta,tb->tab", F, F), edges)
                b += np.add.reduceat(F * left[j][:, None], edges)
                parts = np.split(np.arange(len(F)), edges[1:])
                C += np.stack([nuisance[j][p].T @ F[p] for p in parts])
            if L is not None:
                flat = np.moveaxis(C, 1, 0).reshape(C.shape[1], -1)
                C = np.moveaxis(
                    scipy.linalg.solve_triangular(L, flat, lower=True).reshape(-1, len(edges), n), 1, 0
                )
            return tuple(np.concatenate([np.zeros((1, *x.shape[1:])), np.cumsum(x, 0)]) for x in (b, G, C))

        count = len(edges)
        pairs = np.array(
            [
                (s, s + w)
                for w in _WIDTHS
                for s in range(_EDGE, count - max(_EDGE, w - 1), max(1, w // 6))
                if s + w <= count
            ]
        )  # fmt: skip
        stops = np.append(clock, trace.motion.time[-1] + trace.motion.dt)
        for link in range(problem.dof) if len(pairs) else ():
            effect = ExternalContact(link, 0.0, 1.0, trace.name, "base")
            columns = trace.motion.wrench_columns[:, link]
            b, G = _window_sums(sums(columns, range(link + 1)), pairs)
            yield _event(effect, b, G, stops, pairs)
        switches = np.arange(_EDGE, count - _EDGE)
        gained = np.stack([switches, np.full_like(switches, count)], 1)
        lost = np.stack([np.zeros_like(switches), switches], 1)
        change = PayloadChange(problem.dof - 1, 0.0, 1.0, trace.name, "gained")
        forever = np.array([-1e9, 1e9])
        total = sums(
            dataclasses.replace(change, start=forever[0], stop=forever[1]).over(trace.motion),
            range(problem.dof),
        )
        for form, spans in (("gained", gained), ("lost", lost)):
            if len(spans):
                b, G = _window_sums(total, spans)
                proposal = _event(dataclasses.replace(change, form=form), b, G, stops, spans)
                yield proposal


def _window_sums(sums, pairs):
    b, G, C = (x[pairs[:, 1]] - x[pairs[:, 0]] for x in sums)
    return b, G - np.matmul(np.swapaxes(C, 1, 2), C)


def _event(effect, b, G, clock, pairs) -> Proposal:
    coefficients = effect.coefficients
    deviation = np.tile([k.scale for k in coefficients], (len(b), 1))
    signs = np.array([float(k.sign) for k in coefficients])
    n = b.shape[1]
    G = 0.5 * (G + np.swapaxes(G, 1, 2)) + 1e-9 * np.eye(n) / deviation[:1, :, None] ** 2
    score, scale = log_bayes(b, G, deviation, PHYSICAL_SCALES, signs)
    top = int(score.argmax())
    evidence = float(scipy.special.logsumexp(score) - np.log(len(score)))
    start, stop = float(clock[pairs[top, 0]]), float(clock[pairs[top, 1]])
    if isinstance(effect, PayloadChange):
        start, stop = (start, 1e9) if effect.form == "gained" else (-1e9, stop)
    placed = dataclasses.replace(effect, start=start, stop=stop)
    return Proposal(placed, evidence, float(score[top]), deviation[top] * scale[top], (BIN, BIN))
