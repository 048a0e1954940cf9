r"""How sure the parameters of the terms are, nonlinear ones included.

A term's torque is $X(\theta)\,c$: linear in its coefficients c, not in its shape $\theta$. Near the optimum it is
linear in both, with columns $[X,\ \partial X/\partial\theta\; c]$, so that all coefficients and shapes of all
terms have one covariance, beside what a refit of the model may absorb. Two are made:

- $H^{-1} (A^\top \Sigma A + P)\, H^{-1}$ with the whitened columns A, the prior's precision P, $H = A^\top A + P$
  and the covariance $\Sigma$ of what the model leaves, as autoregressive noise. It is not 1: the noise that the
  search weighs by is what a saturated model leaves, which takes slow noise for structure.
- The delete-a-block jackknife's, which asks the data how far the parameters move without a stretch of time. It
  needs no model of the noise and allows for a wrong one of the arm, but cannot see what happened in one stretch
  only. `jaxpanda.identification.statistics` has its formula and source.

Each parameter takes the larger deviation of the two; correlations are the first one's. Neither sees torque that
nobody modelled and that goes along with a law's all the time: the law has taken it in. To the coefficients comes
what it may be (`leaning`).
"""

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.signal import lfilter

from ..effects import AbstractEffect
from ..identification import statistics
from ..inference.evidence import Design
from ..inference.noise import autoregression, moments
from ..inference.problem import Problem, Term
from ..inference.state import State, coefficients, in_noise, places, torque
from .shapes import first_steps, moved, within

_STEP_LOG, _STEP_SHARE, _STEP_TIME = 0.02, 0.002, 0.01
"""Steps of the differences: of a logarithm, as a share of the bounds, and of an instant [s]."""
_POLISHED, _ENOUGH = 5, 0.01
"""Steps towards the optimum at most, and the evidence below which another is not worth it [nats]."""


LEANS = 0.5
"""Correlation that torque which a model lacks may have with that of a law, one standard deviation: as directions
in a space of four dimensions have. Both follow the same few motions."""


@dataclasses.dataclass(frozen=True)
class Linearised:
    """The model near its optimum: its design with a column for every shape, and which those are."""

    design: Design
    shapes: tuple[tuple[int, int], ...]
    """Term and place among its shapes, in the order of the last columns."""


def linearised(problem: Problem, state: State) -> Linearised:
    """Every shape that is an unknown of its own beside all coefficients."""
    duration = sum(float(np.ptp(t.motion.time)) for t in problem.traces)
    tangents, owners = [], []
    for i, (term, place) in enumerate(zip(state.terms, places(state), strict=True)):
        for k, shape in enumerate(term.effect.shapes):
            if not shape.pivot:
                slope, deviation = _tangent(problem, term.effect, k, state.design.x[place], duration)
                tangents.append(Term(term.effect, slope, np.array([deviation])))
                owners.append((i, k))
    return Linearised(problem.design((*state.terms, *tangents), state.noise), tuple(owners))


def polished(problem: Problem, state: State) -> State:
    """Shapes moved to the optimum by Gauss-Newton steps, all at once, as long as the recordings get likelier."""
    for _ in range(_POLISHED):
        near = linearised(problem, state)
        step = _step(state, near)
        for share in (1.0, 0.3, 0.1):
            tried = _moved(problem, state, near, share * step)
            gained = tried.design.log_evidence - state.design.log_evidence
            if gained > 0:
                break
        else:
            return state
        state = tried
        if gained < _ENOUGH:
            return state
    return state


def _step(state: State, near: Linearised) -> Float[np.ndarray, " shapes"]:
    """Of the shapes; one that is at a bound and would leave it stays, and the others move beside it."""
    H, g = near.design.information, near.design.g
    first = len(g) - len(near.shapes)
    free = np.ones(len(g), bool)
    while True:
        x = np.zeros(len(g))
        x[free] = np.linalg.solve(H[np.ix_(free, free)], g[free]) if free.any() else 0.0
        stuck = []
        for n, (i, k) in enumerate(near.shapes, first):
            effect, shape = state.terms[i].effect, state.terms[i].effect.shapes[k]
            value = float(getattr(effect, shape.name))
            if (value <= shape.lower and x[n] < 0) or (value >= shape.upper and x[n] > 0):
                stuck.append(n)
        if not stuck:
            return x[first:]
        free[stuck] = False


def _moved(problem: Problem, state: State, near: Linearised, step: Float[np.ndarray, " shapes"]) -> State:
    """With the shapes a step further, none by more than a refinement's first."""
    steps = {i: np.zeros(len(state.terms[i].effect.shapes)) for i, _ in near.shapes}
    for (i, k), value in zip(near.shapes, step, strict=True):
        most = first_steps(state.terms[i].effect)[k]
        steps[i][k] = np.clip(value, -most, most)
    terms = [
        _reshaped(problem, t, within(problem, moved(t.effect, steps[i]))) if i in steps else t
        for i, t in enumerate(state.terms)
    ]
    return in_noise(problem, terms, state.noise)


def _reshaped(problem: Problem, term: Term, effect: AbstractEffect) -> Term:
    """The term with another shape, of nearly the same torque."""
    return dataclasses.replace(term, effect=effect, columns=tuple(problem.full_columns(effect)))


def covariances(problem: Problem, state: State) -> list[Float[np.ndarray, "n n"]]:
    """Covariance of each term's coefficients and, after them, of those shapes that are no pivots."""
    if not state.terms:
        return []
    near = linearised(problem, state)
    C = _under_noise(near.design)
    variance = np.diag(_by_blocks(near.design))
    ratio = np.sqrt(np.maximum(variance / np.maximum(np.diag(C), 1e-300), 1.0))
    C = ratio[:, None] * C * ratio
    first = len(C) - len(near.shapes)
    out = []
    for i, (term, place) in enumerate(zip(state.terms, places(state), strict=True)):
        shapes, c = term.effect.shapes, state.design.x[place]
        own = {k: first + n for n, (owner, k) in enumerate(near.shapes) if owner == i}
        at = [*range(place.start, place.stop), *own.values()]
        unit = [float(getattr(term.effect, shapes[k].name)) if shapes[k].logarithmic else 1.0 for k in own]
        scale = np.array([1.0] * len(c) + unit)
        out.append(scale[:, None] * C[np.ix_(at, at)] * scale)
    return out


def leaning(
    law: Float[np.ndarray, " dof"], missed: Float[np.ndarray, " dof"], noise: Float[np.ndarray, " dof"]
) -> float:
    r"""Share of itself that a law may be off by, for what the model lacks beside it, one standard deviation.

    Least squares put $\rho\,e_j/\tau_j$ of it into the law at a joint where it has rms torque $\tau_j$ and
    $e_j$ is lacking, with $\rho$ their unknown correlation; joints weigh as their noise has it.

    Args:
        law: rms torque of the law [N m].
        missed: of what is lacking [N m].
        noise: [N m].
    """
    weight = np.square(law / noise)
    off = np.sqrt(np.sum(np.square(law * missed / noise**2)))
    return LEANS * float(off / np.sum(weight)) if np.any(weight) else 0.0


def leaned(state: State, missed: Float[np.ndarray, " dof"]) -> list[Float[np.ndarray, " n"]]:
    """What each term's coefficients may be off by for that, one standard deviation."""
    out = []
    for i in range(len(state.terms)):
        law = np.concatenate(torque(state, i))
        acts = np.any(law != 0, axis=1)
        rms = np.sqrt(np.mean(law[acts] ** 2, 0)) if acts.any() else np.zeros(len(missed))
        out.append(leaning(rms, missed, state.noise.std) * coefficients(state, i))
    return out


def _tangent(
    problem: Problem, effect: AbstractEffect, k: int, c: Float[np.ndarray, " n"], duration: float
) -> tuple[tuple[Float[np.ndarray, "_time dof 1"], ...], float]:
    """Derivative of a term's torque by a shape or its logarithm; the shape's deviation, were it uniform."""
    shape = effect.shapes[k]
    value = float(getattr(effect, shape.name))
    if shape.logarithmic:
        step, wide = _STEP_LOG, float(np.log(shape.upper / shape.lower))
    elif np.isfinite(shape.upper - shape.lower):
        wide = shape.upper - shape.lower
        step = _STEP_SHARE * wide
    else:
        step, wide = _STEP_TIME, duration
    unit = np.eye(len(effect.shapes))[k]
    ends = [moved(effect, sign * step * unit) for sign in (-1.0, 1.0)]
    reached = [float(getattr(e, shape.name)) for e in ends]
    width = float(np.log(reached[1] / reached[0])) if shape.logarithmic else reached[1] - reached[0]
    low, high = (problem.full_columns(e) for e in ends)
    assert width > 0, (shape, value)
    slopes = tuple(((b - a) @ c / width)[:, :, None] for a, b in zip(low, high, strict=True))
    return slopes, wide / np.sqrt(12)


def _under_noise(design: Design) -> Float[np.ndarray, "n n"]:
    """Covariance of the unknowns under noise like what the model leaves."""
    meat = np.diag(design.precision)
    for A, left in zip(design.columns, design.left, strict=True):
        if np.any(left):
            a, sigma, _ = autoregression(moments(left[:, None]), float(len(left)))
            # A^T Sigma A is the square of the columns run backwards through the noise's own filter
            coloured = np.asarray(lfilter([sigma], np.concatenate([[1.0], -a]), A[::-1], axis=0))
            meat = meat + coloured.T @ coloured
    half = design.solve(meat)
    return design.solve(np.swapaxes(half, 0, 1))


def joint(design: Design) -> Float[np.ndarray, "n n"]:
    r"""Covariance of all unknowns of a design, of full rank: the jackknife's, shrunk, and what the prior leaves.

    $\hat x - x = H^{-1}(A^\top e - P x)$, so that to the data's part comes $H^{-1} P H^{-1}$.
    """
    prior = design.solve(design.solve(np.diag(design.precision)).T)
    return statistics.shrunk(design.information, *_blocks(design)) + prior


def _by_blocks(design: Design) -> Float[np.ndarray, "n n"]:
    """Covariance of the unknowns by the jackknife over blocks of time."""
    return statistics.jackknife(design.information, *_blocks(design))


def _blocks(design: Design) -> tuple[list[Float[np.ndarray, "n n"]], list[Float[np.ndarray, " n"]]]:
    """Information and scores of each block of time."""
    blocks = statistics.cut(len(design.residual[0]), statistics.BLOCKS)
    informations = [np.zeros_like(design.information) for _ in blocks]
    scores = [np.zeros_like(design.g) for _ in blocks]
    for A, left in zip(design.columns, design.left, strict=True):
        for b, block in enumerate(blocks):
            informations[b] += A[block].T @ A[block]
            scores[b] += A[block].T @ left[block]
    return informations, scores
