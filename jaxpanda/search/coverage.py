r"""What recordings could show: every effect at every joint on data held out, and the smallest size that shows.

Adding one candidate's columns $\Phi$ to a model with columns A gives it $c = (G + S^{-1})^{-1} b$ and takes
$H^{-1} A^\top \Phi\,c$ from the model's own coefficients (b, G and H as in `evidence`). With that done on the
blocks that a fold trains on, what its test blocks gain is what the effect is worth where it was not fitted.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.linalg
from jaxtyping import Float

from ..effects import AbstractEffect
from ..inference.evidence import Design, Noise
from ..inference.library import Candidates
from ..inference.problem import Problem
from ..inference.state import State
from .events import Proposal, swept
from .proposals import grids

_PAID = 7.0
"""What a search over shapes, sizes and places costs an effect, about [nats]."""


@dataclasses.dataclass(frozen=True)
class HeatMap:
    """Held-out gain of every effect at every joint, alone and beside what was found [nats]."""

    effects: tuple[str, ...]
    alone: Float[np.ndarray, "effects dof"]
    """Added to the nominal model; NaN where an effect cannot be held out, or cannot act."""
    beside: Float[np.ndarray, "effects dof"]
    """Added to the model with all findings."""

    def to_json(self) -> dict[str, Any]:
        def rows(values):
            return [[None if np.isnan(v) else float(v) for v in row] for row in values]

        return {
            "effects": list(self.effects),
            "unit": "nats",
            "held_out_gain": rows(self.alone),
            "held_out_gain_beside_findings": rows(self.beside),
        }


@dataclasses.dataclass(frozen=True)
class Least:
    """Smallest size of an effect that these recordings would have shown."""

    effect: str
    joint: int | None
    """None: in the whole arm."""
    parameter: str
    size: float | None
    """In `unit`; None where nothing of the effect survives a refit of what is not known exactly."""
    unit: str
    rms_torque: float | None
    """The same at the joint that feels it most [N m]."""
    survives: float
    """Share of its energy that a refit of the nuisance leaves."""

    def to_json(self) -> dict[str, Any]:
        return {**dataclasses.asdict(self), "joint": None if self.joint is None else self.joint + 1}


def heat_map(problem: Problem, state: State) -> HeatMap:
    """The best shape of every effect at every joint, by evidence, and what it gains on held-out blocks."""
    names = list(dict.fromkeys(c.name for c in problem.catalogue))
    groups = [*problem.library, *problem.catchalls]
    second = _best(problem, state.design, state.noise, groups)
    if not state.terms:
        gains = _gains(problem, state.design, state.noise, names, second)
        return HeatMap(tuple(names), gains, gains)
    nominal = problem.design((), state.noise)
    touched = {j for t in state.terms for j in range(problem.dof) if any(np.any(c[:, j]) for c in t.columns)}
    again = [g for g in groups if g.joint is None or g.joint in touched]
    first = {**second, **_best(problem, nominal, state.noise, again)}
    return HeatMap(
        tuple(names),
        _gains(problem, nominal, state.noise, names, first),
        _gains(problem, state.design, state.noise, names, second),
    )


Best = dict[tuple[str, tuple[int, ...]], tuple[Proposal, tuple[Candidates, int] | None]]


def _best(problem: Problem, design: Design, noise: Noise, groups: Sequence[Candidates]) -> Best:
    """The likeliest shape of each effect at each place, and where in the groups it stands."""
    best: Best = {}
    places = {id(e): (g, i) for g in groups for i, e in enumerate(g.effects)}
    laws = [c for c in problem.catalogue if not c.free]
    scanned = swept(problem, design, noise, range(problem.dof), laws)
    for p in (*grids(problem, design, noise, groups), *scanned):
        if not p.effect.bound_to_recording and (p.key not in best or p.evidence > best[p.key][0].evidence):
            best[p.key] = p, places.get(id(p.effect))
    return best


def _gains(
    problem: Problem, design: Design, noise: Noise, names: Sequence[str], best: Best
) -> Float[np.ndarray, "effects dof"]:
    chosen = [p for p, _ in best.values()]
    columns = [_whitened(problem, noise, p.effect, place) for p, place in best.values()]
    gains = held_out_gains(problem, design, columns, [p.deviation for p in chosen])
    out = np.full((len(names), problem.dof), np.nan)
    for p, gain in zip(chosen, gains, strict=True):
        row, joints = names.index(p.effect.name), p.effect.joints
        if len(joints) > 1:  # each joint's share
            out[row] = np.fmax(out[row], gain)
        elif joints:
            out[row, joints[0]] = np.fmax(out[row, joints[0]], gain.sum())
    return out


def _whitened(
    problem: Problem, noise: Noise, effect: AbstractEffect, place: tuple[Candidates, int] | None
) -> dict[int, np.ndarray]:
    """An effect's whitened columns in the joints where it acts."""
    if place is None:
        wide = problem.full_columns(effect)
    elif effect.one_joint:
        group, i = place
        j = effect.joints[0]
        return {j: problem.whitened([c[:, i] for c in group.columns], noise, j)}
    else:
        wide = [c[:, :, place[1]] for c in place[0].columns]
    felt = [j for j in range(problem.dof) if any(np.any(c[:, j]) for c in wide)]
    return {j: problem.whitened([c[:, j] for c in wide], noise, j) for j in felt}


def held_out_gains(
    problem: Problem,
    design: Design,
    columns: Sequence[dict[int, np.ndarray]],
    deviations: Sequence[Float[np.ndarray, " _n"]],
) -> Float[np.ndarray, "candidates dof"]:
    """What each candidate alone adds to the log likelihood of the blocks held out, joint by joint [nats].

    Args:
        problem: whose blocks.
        design: what is in the model already.
        columns: of each candidate, whitened, by joint.
        deviations: prior deviations of its coefficients.
    """
    widths = np.cumsum([0, *(len(d) for d in deviations)])
    slices = [slice(a, b) for a, b in itertools.pairwise(widths.tolist())]
    at = [[m for m, c in enumerate(columns) if j in c] for j in range(problem.dof)]
    stacked = [
        np.concatenate([columns[m][j] for m in at[j]], 1) if at[j] else None for j in range(problem.dof)
    ]
    index = [
        np.concatenate([np.arange(slices[m].start, slices[m].stop) for m in at[j]]) if at[j] else None
        for j in range(problem.dof)
    ]
    n, gains = len(design.precision), np.zeros((len(columns), problem.dof))
    for train, test in problem.folds:
        H, g = np.diag(design.precision).astype(float), np.zeros(n)
        C, u = np.zeros((n, int(widths[-1]))), np.zeros(int(widths[-1]))
        G = [np.zeros((len(d), len(d))) for d in deviations]
        for j, (A, r) in enumerate(zip(design.columns, design.residual, strict=True)):
            A, r = A[train], r[train]
            H += A.T @ A
            g += A.T @ r
            columns_here = stacked[j]
            if columns_here is None:
                continue
            F = columns_here[train]
            C[:, index[j]] += A.T @ F
            u[index[j]] += F.T @ r
            for m in at[j]:
                own = np.flatnonzero((index[j] >= slices[m].start) & (index[j] < slices[m].stop))
                part = F[:, own[0] : own[-1] + 1]
                G[m] += part.T @ part
        factor = scipy.linalg.cho_factor(H, lower=True) if n else None
        HC = C if factor is None else scipy.linalg.cho_solve(factor, C)
        x = g if factor is None else scipy.linalg.cho_solve(factor, g)
        u = u - C.T @ x
        X, c = np.repeat(x[:, None], len(columns), 1), np.zeros((int(widths[-1]), len(columns)))
        for m, own in enumerate(slices):
            S = G[m] - C[:, own].T @ HC[:, own] + np.diag(deviations[m] ** -2.0)
            c[own, m] = np.linalg.solve(S, u[own])
            X[:, m] -= HC[:, own] @ c[own, m]
        for j, (A, r) in enumerate(zip(design.columns, design.residual, strict=True)):
            before = r[test] - A[test] @ x
            after = r[test][:, None] - A[test] @ X
            columns_here = stacked[j]
            if columns_here is not None:
                after -= columns_here[test] @ c[index[j]]
            gains[:, j] += 0.5 * (before @ before - (after**2).sum(0))
    return gains


def least_shown(problem: Problem, state: State) -> tuple[Least, ...]:
    r"""The smallest size of each effect at each joint that would have been found.

    The evidence of an effect of size c is about $\tfrac12 \delta^2$ with $\delta^2 = c^2 G$, G what a refit of
    the nuisance leaves of it. It is found where that exceeds the bar with what the search pays. Of several shapes
    of an effect the one of median torque stands for all.
    """
    rows: dict[tuple[str, int | None], list[tuple[int, Least]]] = {}
    for group in problem.library:
        effect = group.effects[0]
        joints = effect.joints
        key = effect.name, joints[0] if len(joints) == 1 else None
        count = len(effect.coefficients)
        found = [(count, one) for one in _least(problem, state, group.effects, group.columns)]
        held = rows.get(key, [])
        if held and held[0][0] < count:
            continue
        rows[key] = found if held and held[0][0] > count else [*held, *found]
    acting = {t.name: t.motion for t, on in zip(problem.traces, problem.active, strict=True) if on}
    for effects in (place for cls in problem.catalogue for place in cls.typical(acting)):
        key = effects[0].name, effects[0].joints[0]
        rows[key] = [(0, one) for one in _least(problem, state, effects, problem.columns(effects))]
    out = []
    for found in rows.values():
        shown = sorted(
            (one for _, one in found if one.rms_torque is not None), key=lambda one: one.rms_torque or 0.0
        )
        out.append(shown[len(shown) // 2] if shown else found[0][1])
    order = [c.name for c in problem.catalogue]
    return tuple(
        sorted(out, key=lambda one: (order.index(one.effect), -1 if one.joint is None else one.joint))
    )


def _least(
    problem: Problem, state: State, effects: Sequence[AbstractEffect], columns: Sequence[np.ndarray]
) -> list[Least]:
    """One row a shape."""
    design, noise = state.design, state.noise
    effect = effects[0]
    leading = min(effect.size_of[1], len(effect.coefficients))
    columns = [c[..., :leading] for c in columns]
    if effect.one_joint:
        j = effect.joints[0]
        Phi = problem.whitened(columns, noise, j)
        raw = np.einsum("tma,tma->ma", Phi, Phi)
        _, G = design.in_joint(j, Phi, np.einsum("tma,tmb->mab", Phi, Phi))
        size = np.sqrt(np.mean(np.concatenate(columns) ** 2, 0))
    else:
        parts = [problem.whitened([c[:, j] for c in columns], noise, j) for j in range(problem.dof)]
        raw = np.sum([np.einsum("tma,tma->ma", F, F) for F in parts], 0)
        _, G = design.in_arm(parts, [np.einsum("tma,tmb->mab", F, F) for F in parts])
        acting = [np.any(c != 0, axis=(1, 3)) for c in columns]
        felt = sum(np.einsum("tjma->jma", c**2) for c in columns)
        size = np.sqrt(felt / np.maximum(sum(a.sum(0) for a in acting), 1)[:, None]).max(0)
    left = np.maximum(np.diagonal(G, axis1=1, axis2=2), 0.0)
    share = left / np.maximum(raw, 1e-300)
    delta = 2 * (_PAID - effect.prior)
    joint = effect.joints[0] if len(effect.joints) == 1 else None
    coefficient = effect.coefficients[0]
    name = effect.size_of[0] or coefficient.name
    out = []
    for m in range(len(effects)):
        k = int(np.argsort(left[m])[0 if effect.weakest_counts else leading // 2])
        shown = share[m, k] > 1e-6 and raw[m, k] > 0
        c = float(np.sqrt(delta / left[m, k])) if shown else None
        rms = None if c is None else float(c * size[m, k])
        told = effect.unit(coefficient.unit, problem.arm)
        out.append(Least(effect.name, joint, name, c, told, rms, float(share[m, k])))
    return out
