"""The model at some point of a search, and what each of its terms is worth there."""

import dataclasses
import functools
import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from .evidence import Design, Noise
from .problem import Problem, Term


@dataclasses.dataclass(frozen=True)
class State:
    """Accepted terms, the noise beside them, and the model fitted."""

    terms: tuple[Term, ...]
    noise: Noise
    design: Design

    @functools.cached_property
    def shares(self) -> Float[np.ndarray, "terms dof"]:
        """Share of each term's torque, squared over noise, that acts in each joint."""
        energy = np.zeros((len(self.terms), len(self.design.columns)))
        for j, A in enumerate(self.design.columns):
            for i, at in enumerate(places(self)):
                energy[i, j] = np.sum((A[:, at] @ self.design.x[at]) ** 2)
        return energy / np.maximum(energy.sum(1, keepdims=True), 1e-300)

    @functools.cached_property
    def score(self) -> float:
        """Logarithm of the model's probability, up to what all models of these recordings share [nats].

        Models may differ in their noise: what is likelier in a noise of its own is likelier.
        """
        counted = 0.0
        for j, r in enumerate(self.design.residual):
            here = r != 0
            width = np.full(len(r), self.noise.sigma[j])
            if self.noise.trust is not None:
                width = width / np.maximum(self.noise.trust[:, j], 1e-9)
            counted += float(0.5 * np.sum(r**2) + np.log(width[here]).sum())
        return self.design.log_evidence - counted + sum(t.prior for t in self.terms)


def start(problem: Problem) -> State:
    """Nothing accepted yet."""
    return with_terms(problem, ())


def with_terms(problem: Problem, terms: Sequence[Term]) -> State:
    r"""The model with these terms, its noise estimated anew.

    What the model leaves of a joint beyond the noise is noise as well until something explains it: the variance
    is not known, and a law is worth $\tfrac n2 \log$ of what it reduces it by. Else many laws would be called on
    to explain together what none of them is.
    """
    noise = problem.noise(terms)
    scaled = lambda scale: in_noise(problem, terms, dataclasses.replace(noise, sigma=noise.sigma * scale))
    scale = problem.noise_scale.copy()
    state = scaled(scale)
    beyond = mean_squares(state) * scale**2
    found = _STEP ** np.floor(np.log(np.maximum(beyond, 1.0)) / (2 * np.log(_STEP)))
    if np.all(found == scale):
        return state
    problem.noise_scale[:] = found
    return scaled(found)


def in_noise(problem: Problem, terms: Sequence[Term], noise: Noise) -> State:
    """The model with these terms, in some noise."""
    return State(tuple(terms), noise, problem.design(terms, noise))


def places(state: State) -> list[slice]:
    """Where the coefficients of each term's law are among those of the design."""
    widths = [t.width for t in state.terms]
    starts = len(state.design.precision) - sum(widths) + np.cumsum([0, *widths])
    return [slice(int(a), int(a) + len(t.deviation)) for a, t in zip(starts, state.terms, strict=False)]


def without(state: State, i: int) -> Design:
    """The model less one of its terms."""
    return state.design.without(i)


def gains(state: State) -> list[float]:
    """By how much each term makes the model likelier, beside the others [nats]."""
    own = state.design.log_evidence
    return [own - without(state, i).log_evidence + t.prior for i, t in enumerate(state.terms)]


def likelier(a: tuple[Problem, State], b: tuple[Problem, State]) -> float:
    r"""By how much the second of two models of the same recordings is likelier than the first [nats].

    To what the models' evidence tells is added what they predict on blocks that they were not fitted to,
    $\tfrac12 \sum_j n_j \log (s^2_{a,j}/s^2_{b,j})$ with $n_j$ independent samples of an error whose mean square
    is $s^2_j$: innovations, of which evidence is made, tell little of slow errors, and free forms fit them in
    ways that hold nowhere else.
    """
    drifts = any(t.effect.drifts for _, state in (a, b) for t in state.terms)
    left, other = (problem.mispredicted(state.design, spread=drifts) for problem, state in (a, b))
    count = np.minimum(independent(left), independent(other))
    power = [np.maximum(np.sum(x**2, 0), 1e-300) for x in (left, other)]
    foretold = float(np.sum(0.5 * count * np.log(power[0] / power[1])))
    return b[1].score - a[1].score + foretold


def independent(x: Float[np.ndarray, "rows dof"]) -> Float[np.ndarray, " dof"]:
    r"""How many samples tell of a mean square, $n / (1 + 2 \sum \rho_k^2)$ (Bartlett 1946), lags up to where the
    correlation has first changed its sign."""
    n = len(x)
    spectrum = np.abs(np.fft.rfft(x, 2 * n, axis=0)) ** 2
    rho = np.fft.irfft(spectrum, axis=0)[:n] / np.maximum(np.sum(x**2, 0), 1e-300)
    related = np.cumprod(rho > 0, 0)[1:] * rho[1:]
    return np.count_nonzero(x, 0) / (1 + 2 * np.sum(related**2, 0))


def leftover(problem: Problem, state: State) -> tuple[Float[np.ndarray, " dof"], Float[np.ndarray, " dof"]]:
    """Mean square of each joint's whitened residual beyond a saturated model's noise, before the terms and after
    them."""
    design, beyond = state.design, np.square(state.noise.sigma / problem.noise(state.terms).sigma)
    kept = np.arange(len(design.precision)) < len(design.precision) - sum(t.width for t in state.terms)
    bare = Design([A[:, kept] for A in design.columns], design.residual, design.precision[kept])
    before, after = (beyond * [_mean_square(e) for e in d.left] - 1 for d in (bare, design))
    return before, after


def mean_squares(state: State) -> Float[np.ndarray, " dof"]:
    """Of what is left of each joint's residual, whitened: 1 where it is noise."""
    return np.array([_mean_square(left) for left in state.design.left])


def _mean_square(left: Float[np.ndarray, " rows"]) -> float:
    """Of what is left of a joint, whitened; rows that do not count are zero."""
    return float(np.sum(left**2)) / max(np.count_nonzero(left), 1)


def overlaps(state: State) -> list[tuple[int, int]]:
    """Pairs of terms that act in a joint together."""
    share = state.shares
    pairs = itertools.combinations(range(len(share)), 2)
    return [(i, k) for i, k in pairs if float(share[i] @ share[k]) > _TOGETHER]


_TOGETHER = 0.02
_STEP = 1.1
"""Between the deviations of a joint's noise that are told apart: others' columns are whitened again for each."""
