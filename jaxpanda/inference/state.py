"""The model at some point of a search, and what each of its terms is worth there."""

import dataclasses
import functools
from collections import defaultdict
from collections.abc import Collection, Sequence

import numpy as np
import scipy.fft
from jaxtyping import Float

from .alike import shared
from .evidence import Design, Noise, stretches
from .problem import Problem, Term


@dataclasses.dataclass(frozen=True)
class State:
    """Accepted terms, the noise beside them, and the model fitted."""

    terms: tuple[Term, ...]
    noise: Noise
    design: Design
    joints: int
    """How many tell of themselves."""
    counts: Float[np.ndarray, " dof"] | None = None
    """How many samples tell of a joint, by `Problem.counts`; None for all."""

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
            least = self.noise.sigma[j] if self.noise.least is None else self.noise.least[j]
            count = np.count_nonzero(here)
            told = count if self.counts is None else self.counts[j]
            counted += 0.5 * float(r @ r) + count * float(np.log(least))
            counted += told * float(np.log(self.noise.sigma[j] / least))
            counted += self.noise.widened(j, here)
        return self.design.log_evidence - counted + paid(self.terms, self.joints)


def start(problem: Problem) -> State:
    """Nothing accepted yet."""
    return with_terms(problem, ())


def with_terms(problem: Problem, terms: Sequence[Term]) -> State:
    r"""The model with these terms, its noise estimated anew.

    What the model leaves of a joint beyond the noise is noise as well until something explains it: the variance
    is not known, and a law is worth $\tfrac n2 \log$ of what it reduces it by. Else many laws would be called on
    to explain together what none of them is. The same of what is slower than the noise, as errors of a model are:
    of that there are few independent samples, however many were recorded.
    """
    noise, dt = problem.noise(terms), problem.traces[0].motion.dt

    def widened(beyond: Sequence[Beyond]) -> State:
        wider = dataclasses.replace(
            noise,
            sigma=noise.sigma * [b.scale for b in beyond],
            slow=np.array([b.slow for b in beyond]),
            least=noise.sigma,
        )
        return in_noise(problem, terms, wider)

    # what a fit leaves depends on the noise it was made in: that of the last model, and none that is unexplained
    starts = (*problem.beyond_noise, (Beyond(),) * problem.dof)
    x = [widened(start).design.x for start in starts]
    counts = [problem.counts(noise, j) for j in range(problem.dof)]
    each = [left_over(problem, noise, terms, c) for c in x]
    left = [[beyond(y, n, dt) for y, n in zip(of_joints, counts, strict=True)] for of_joints in each]
    least = tuple(min(of_joint, key=lambda b: b.left) for of_joint in zip(*left, strict=True))
    problem.beyond_noise[:] = [least]
    return widened(least)


def left_over(
    problem: Problem,
    noise: Noise,
    terms: Sequence[Term],
    x: Float[np.ndarray, " n"],
    joints: Sequence[int] | None = None,
) -> list[list[Float[np.ndarray, " _time"]]]:
    """Innovations, in some noise, of what a model leaves of each of these joints in each recording; zero where a
    row does not count."""
    out = []
    for j in range(problem.dof) if joints is None else joints:
        left = enumerate(misfit(problem, terms, x, j))
        out.append([noise.weighted(y, j, problem.weights(noise, r, j), problem.rows[r]) for r, y in left])
    return out


def misfit(
    problem: Problem, terms: Sequence[Term], x: Float[np.ndarray, " n"], joint: int
) -> list[Float[np.ndarray, " _time"]]:
    """What a model leaves of a joint's torque in each recording [N m]."""
    count = problem.nuisance[0].shape[2]
    out = [
        r[:, joint] - n[:, joint] @ x[:count] for r, n in zip(problem.residual, problem.nuisance, strict=True)
    ]
    for term in terms:
        own, count = x[count : count + term.width], count + term.width
        if term.acts[joint]:
            for left, torque in zip(out, term.torque_at(joint, own), strict=True):
                left -= torque
    return out


@dataclasses.dataclass(frozen=True)
class Beyond:
    """What of a joint's innovations is beyond those that a saturated model leaves."""

    scale: float = 1.0
    """How many times those they are, in steps."""
    slow: tuple[float, float] = (0.0, 0.0)
    """Pole and zero of the slow error beside which they are smallest."""
    left: float = 0.0
    """Twice the nats that a sample of them costs beside that."""


def beyond(left: Sequence[Float[np.ndarray, " _time"]], count: float, dt: float) -> Beyond:
    """The slow error, if what is left is beyond the noise, with which a joint's innovations are smallest; its two
    numbers must be worth it (Schwarz 1978).

    `count`: how many samples tell, by `Problem.counts`.
    """
    best, shape = float(np.log(max(_mean_square(left, count), 1e-300))), (0.0, 0.0)
    count = max(count, 2.0)
    if best > 0 and (tried := slow_errors(dt)):
        squares = _levelled_squares([part[rows] for part in left for rows in stretches(part != 0)], dt)
        found = np.log(squares / count) + 2 * np.log(count) / count
        if found.min() < best:
            best, shape = float(found.min()), tried[int(found.argmin())]
    scale = _STEP ** np.floor(max(best, 0.0) / (2 * np.log(_STEP)))
    return Beyond(scale, shape, 1 + best if best > 0 else float(np.exp(best)))


@functools.cache
def slow_errors(dt: float) -> tuple[tuple[float, float], ...]:
    """Poles and zeros of slow errors that are told apart: how long they last, and how many times the noise they
    are where they are largest."""
    out = []
    for lasts in _LASTING:
        pole = float(np.exp(-dt / lasts))
        times = _LARGER
        while (zero := 1 - times * (1 - pole)) >= 0:
            out.append((pole, zero))
            times *= _LARGER
    return tuple(out)


def _levelled_squares(
    each: Sequence[Float[np.ndarray, " _time"]], dt: float
) -> Float[np.ndarray, " slow_errors"]:
    r"""Sum of squares of `levelled` stretches for each of `slow_errors`, which differ little from each other.

    $\sum_t u_t^2 = \sum_k r_k c_k - e$ with r the autocorrelation of y, c that of the filter's response
    $1, (z-p), (z-p) z, \ldots$, and e what it answers behind the stretch. Stretches of like length go together.
    """
    longest = max(1e-9, *(zero for _, zero in slow_errors(dt)))
    most = 2 + int(np.log(np.finfo(float).eps) / np.log(longest))  # lags beyond are rounding
    alike: dict[int, list[np.ndarray]] = defaultdict(list)
    for y in each:
        alike[len(y).bit_length()].append(y)
    out = np.zeros(len(slow_errors(dt)))
    for some in alike.values():
        count = max(map(len, some))
        lags = min(count, most)
        size = scipy.fft.next_fast_len(count + lags, real=True)  # a prime takes ten times as long
        back = np.zeros((len(some), count))
        for k, y in enumerate(some):
            back[k, : len(y)] = y[::-1]
        power = np.sum(np.abs(np.fft.rfft(back, size)) ** 2, 0)
        related, behind, powers = _responses(dt, lags)
        ends = np.sum((powers @ back[:, :lags].T) ** 2, 1)
        out += related @ np.fft.irfft(power, size)[:lags] - behind * ends
    return out


@functools.lru_cache(maxsize=64)
def _responses(dt: float, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each of `slow_errors` the autocorrelation of its response at so many lags, with those that count twice;
    $(z-p)^2/(1-z^2)$; and the powers of z."""
    pole, zero = np.transpose(slow_errors(dt))
    powers = zero[:, None] ** np.arange(count)
    behind = (zero - pole) ** 2 / (1 - zero**2)
    related = behind[:, None] * powers
    related[:, 0] += 1
    related[:, 1:] += (zero - pole)[:, None] * powers[:, :-1]
    related[:, 1:] *= 2
    return related, behind, powers


def in_noise(problem: Problem, terms: Sequence[Term], noise: Noise) -> State:
    """The model with these terms, in some noise."""
    counts = np.array([problem.counts(noise, j) for j in range(problem.dof)])
    return State(tuple(terms), noise, problem.design(terms, noise), problem.telling, counts)


def places(state: State) -> list[slice]:
    """Where the coefficients of each term's law are among those of the design."""
    widths = [t.width for t in state.terms]
    starts = len(state.design.precision) - sum(widths) + np.cumsum([0, *widths])
    return [slice(int(a), int(a) + len(t.deviation)) for a, t in zip(starts, state.terms, strict=False)]


def without(state: State, i: int) -> Design:
    """The model less one of its terms."""
    return state.design.without(i)


def gains(problem: Problem, state: State) -> list[float]:
    """By how much each term makes the model likelier, beside the others [nats]."""
    own = evidence(problem, state.terms, state.design, state.noise)
    return [own - beside(problem, state, (i,), without(state, i)) for i in range(len(state.terms))]


def beside(problem: Problem, state: State, which: Collection[int], rest: Design) -> float:
    """Log evidence of the model without some of its terms, `rest`, less their priors: what the whole must exceed
    for them to be worth it."""
    others = [t for i, t in enumerate(state.terms) if i not in which]
    less = paid(others, state.joints) - paid(state.terms, state.joints)
    return evidence(problem, others, rest, state.noise) + less


def paid(terms: Sequence[Term], joints: int) -> float:
    """Log prior odds of these terms together, less what the search for their shapes has cost [nats]."""
    return sum(t.prior for t in terms) + shared([t.effect for t in terms], joints)


def evidence(problem: Problem, terms: Sequence[Term], design: Design, noise: Noise) -> float:
    r"""Log evidence of a model that was fitted in the noise beside another.

    Where a joint has errors beyond the saturated model's noise their size is not known, and falls with what is
    explained: there $-\tfrac12 \sum e^2$ gives way to $-\tfrac n2 \log s^2$ in the noise that is left.
    """
    uneven = [j for j in range(problem.dof) if noise.is_widened(j)]
    if noise.least is None or not uneven:
        return design.log_evidence
    plain, dt = dataclasses.replace(noise, sigma=noise.least, slow=None), problem.traces[0].motion.dt
    counts = {j: problem.counts(noise, j) for j in uneven}

    def told(fitted: Design, wide: Noise) -> float:
        out = fitted.log_evidence
        for j, parts in zip(uneven, left_over(problem, plain, terms, fitted.x, uneven), strict=True):
            as_is = np.concatenate([wide.level(part, j, part != 0) for part in parts])
            as_is *= plain.sigma[j] / wide.sigma[j]
            r = fitted.residual[j]
            out += 0.5 * (float(as_is @ as_is - r @ r) - counts[j] * beyond(parts, counts[j], dt).left)
        return out

    # a fit among slow errors does not see what is slow
    best = max(told(design, noise), told(problem.design(terms, plain), plain))
    for j in uneven:
        r = design.residual[j]
        best += 0.5 * float(r @ r) + counts[j] * float(np.log(noise.sigma[j] / plain.sigma[j]))
    return best


def likelier(a: tuple[Problem, State], b: tuple[Problem, State]) -> float:
    r"""By how much the second of two models of the same recordings is likelier than the first [nats].

    To what the models' evidence tells is added what they predict on blocks that they were not fitted to
    (`foretelling`): innovations, of which evidence is made, tell little of slow errors, and free forms fit them
    in ways that hold nowhere else.
    """
    drifts = any(t.effect.drifts for _, state in (a, b) for t in state.terms)
    noises = [state.noise for _, state in (a, b)]
    left, other = (problem.mispredicted(state.design, noises, spread=drifts) for problem, state in (a, b))
    return b[1].score - a[1].score + foretelling(left, other)


def coefficients(state: State, i: int) -> Float[np.ndarray, " n"]:
    """Those of a term."""
    return state.design.x[places(state)[i]]


def torque(state: State, *members: int) -> list[Float[np.ndarray, "_time dof"]]:
    """Torque of terms together in each recording [N m]."""
    parts = [[columns @ coefficients(state, i) for columns in state.terms[i].columns] for i in members]
    return [np.sum(of_one, 0) for of_one in zip(*parts, strict=True)]


def foretelling(left: Float[np.ndarray, "rows dof"], other: Float[np.ndarray, "rows dof"]) -> float:
    r"""By how much likelier a model is that leaves `other` than one that leaves `left` where neither was fitted.

    $\tfrac12 \sum_j n_j \log (s^2_{\text{left},j}/s^2_{\text{other},j})$ [nats] with $n_j$ independent samples of
    an error whose mean square is $s^2_j$.
    """
    count = np.minimum(independent(left), independent(other))
    power = [np.maximum(np.sum(x**2, 0), 1e-300) for x in (left, other)]
    return float(np.sum(0.5 * count * np.log(power[0] / power[1])))


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
    design = state.design
    kept = np.arange(len(design.precision)) < len(design.precision) - sum(t.width for t in state.terms)
    columns, known = [A[:, kept] for A in design.columns], design.corrections
    bare = Design(columns, design.residual, design.precision[kept], corrections=known)
    before, after = (
        mean_squares(problem, problem.noise(state.terms), terms, d.x) - 1
        for terms, d in (((), bare), (state.terms, design))
    )
    return before, after


def mean_squares(
    problem: Problem, noise: Noise, terms: Sequence[Term], x: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " dof"]:
    """Of what a model leaves of each joint, whitened by a saturated model's noise: 1 where it is noise."""
    left = left_over(problem, noise, terms, x)
    return np.array([_mean_square(y, problem.counts(noise, j)) for j, y in enumerate(left)])


def _mean_square(left: Sequence[Float[np.ndarray, " _time"]], count: float) -> float:
    """Of what is left of a joint in each recording, whitened, over that of noise of so many samples."""
    return float(sum(y @ y for y in left)) / max(count, 1.0)


_LASTING, _LARGER = (0.5, 2.0), 2.0
"""Of slow errors: how long they last [s], and between their sizes that are told apart."""
_STEP = 1.1
"""Between the deviations of a joint's noise that are told apart: others' columns are whitened again for each."""
