r"""Gaussian evidence of candidate columns, projected on what everything else could not have absorbed.

The whitened model is $r = A x + \Phi c + e$ with $e \sim N(0, 1)$, $x \sim N(0, P^{-1})$, $c \sim N(0, S)$. With
$H = A^\top A + P$,

$$b = \Phi^\top r - (A^\top\Phi)^\top H^{-1} A^\top r, \qquad
  G = \Phi^\top\Phi - (A^\top\Phi)^\top H^{-1} A^\top\Phi$$

$$\log B = \tfrac12\, b^\top (G + S^{-1})^{-1} b - \tfrac12 \log|1 + S^{1/2} G S^{1/2}|$$

is the log Bayes factor of the candidate. This is at once a score test with nuisance parameters, orthogonal
forward regression, and Bayesian model selection.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import scipy.linalg
import scipy.signal
import scipy.sparse
import scipy.special
from jaxtyping import Bool, Float, Int

from .bodies import Body, Correction, Kept, at_bounds, likeliest

SCALES = (1.0, 4.0, 16.0)
"""Sizes of an effect over the noise, per sample, that are expected alike."""
PHYSICAL_SCALES = (0.03, 0.1, 0.3, 1.0, 3.0)
"""Sizes over the physically plausible one, where a coefficient has such."""


Rests = tuple[Int[np.ndarray, " resting"], scipy.sparse.csr_array, scipy.sparse.csr_array]
"""Which rows are in rests, u of each rest there, by the root of what it takes of its own, and its transpose."""


@dataclasses.dataclass(frozen=True)
class Noise:
    """Autoregressive noise of each joint: $e_t = r_t - \\sum_k a_k r_{t-k}$, with deviation `sigma` [N m]."""

    a: Float[np.ndarray, "dof order"]
    sigma: Float[np.ndarray, " dof"]
    std: Float[np.ndarray, " dof"]
    """Of the noise itself [N m]."""
    trust: Float[np.ndarray, "rows dof"] | None = None
    """What a sample weighs beside what laws may be off there, 0 to 1; None where there are no laws."""
    at_rest: Float[np.ndarray, "rows dof"] | None = None
    """Of the variance that `trust` allows for, in that of the noise, what stays the same for as long as a joint
    rests: friction that may carry any load up to its level."""
    stays: Float[np.ndarray, "rows dof"] | None = None
    """The same together with what friction of the user's model may carry there."""
    slow: Float[np.ndarray, "dof 2"] | None = None
    """Pole p and zero z of a slow error beside the noise: what is white is $(1 - p L) / (1 - z L)$ of the
    innovations, with L the step back; as good as none where they are equal."""
    quiet: Float[np.ndarray, " dof"] | None = None
    """Mean square of the innovations while a joint rests, over that of all; as of any where None."""
    least: Float[np.ndarray, " dof"] | None = None
    """Deviation of the innovations where nothing is left unexplained; `sigma` may be larger [N m]."""

    def trusted(self, rows: slice, joint: int) -> Float[np.ndarray, " _rows"] | float:
        """Weights of some rows, all recordings one below the other."""
        return 1.0 if self.trust is None else self.trust[rows, joint]

    def whiten(
        self, x: Float[np.ndarray, "_time ..."], joint: int, weights: Float[np.ndarray, " _time"], rows: slice
    ) -> Float[np.ndarray, "_time ..."]:
        """x in some rows, by what each weighs, with unit, uncorrelated noise; the first rows are zero."""
        return self.level(self.weighted(x, joint, weights, rows), joint, self._tells(weights))

    def transposed(
        self, x: Float[np.ndarray, "_time ..."], joint: int, weights: Float[np.ndarray, " _time"], rows: slice
    ) -> Float[np.ndarray, "_time ..."]:
        r"""$W^\top x$ with W what `whiten` does: $(W y)^\top x = y^\top (W^\top x)$."""
        y = x.copy()
        if self.has_slow(joint):
            y[:] = 0.0
            for part in stretches(self._tells(weights)):
                y[part] = levelled(x[part][::-1], self.slow[joint])[0][::-1]  # pyright: ignore
        y = self._settled(y, joint, weights, rows) * weights.reshape(-1, *[1] * (x.ndim - 1))
        a = self.a[joint]
        y[: len(a)] = 0.0
        out = y.copy()
        for k in range(len(a)):
            out[: len(x) - 1 - k] -= a[k] * y[k + 1 :]
        return out / self.sigma[joint]

    def _tells(self, weights: Float[np.ndarray, " _time"]) -> Bool[np.ndarray, " _time"]:
        """Rows that count, and whose past foretells something of them."""
        return (weights > 0) & (np.arange(len(weights)) >= self.a.shape[1])

    def weighted(
        self, x: Float[np.ndarray, "_time ..."], joint: int, weights: Float[np.ndarray, " _time"], rows: slice
    ) -> Float[np.ndarray, "_time ..."]:
        """Innovations by what each row weighs, in which what stays for a rest counts as one number."""
        y = self.innovations(x, joint)
        y *= weights.reshape(-1, *[1] * (x.ndim - 1))
        return self._settled(y, joint, weights, rows)

    def settled(
        self, y: Float[np.ndarray, "_time ..."], joint: int, weights: Float[np.ndarray, " _time"], rows: slice
    ) -> Float[np.ndarray, "_time ..."]:
        r"""$(1 + u u^\top)^{-1/2} y$ in each rest, with u the weighted innovations of the error that stays."""
        return self._settled(y.copy(), joint, weights, rows)

    def _settled(
        self, y: Float[np.ndarray, "_time ..."], joint: int, weights: Float[np.ndarray, " _time"], rows: slice
    ) -> Float[np.ndarray, "_time ..."]:
        rests = self._rests(joint, weights, rows)
        if rests is not None:
            at, u, back = rests
            here = y[at].reshape(len(at), -1)
            y[at] -= (back @ (u @ here)).reshape(len(at), *y.shape[1:])
        return y

    def _rests(self, joint: int, weights: Float[np.ndarray, " _time"], rows: slice) -> Rests | None:
        """Where a joint rests among some rows."""
        key = joint, rows.start, rows.stop
        if self.stays is None or key in self._held:
            return self._held.get(key)
        size = np.sqrt(self.stays[rows, joint])
        u = self.innovations(self.std[joint] * size, joint) * weights
        each = [part for part in stretches(size > 0) if np.any(u[part])]
        at = np.concatenate([np.arange(part.start, part.stop) for part in each] or [np.zeros(0, int)])
        ends = np.cumsum([0, *(part.stop - part.start for part in each)])
        power = np.array([u[part] @ u[part] for part in each])
        share = np.sqrt((1 - 1 / np.sqrt(1 + power)) / power)
        values = u[at] * np.repeat(share, np.diff(ends))
        each_row = scipy.sparse.csr_array((values, np.arange(len(at)), ends), shape=(len(each), len(at)))
        self._held[key] = (at, each_row, each_row.T.tocsr()) if each else None
        return self._held[key]

    @functools.cached_property
    def _held(self) -> dict[tuple[int, int, int], Rests | None]:
        return {}

    def level(
        self, y: Float[np.ndarray, "_time ..."], joint: int, counts: Bool[np.ndarray, " _time"]
    ) -> Float[np.ndarray, "_time ..."]:
        """Innovations, in which slow errors weigh as much as any; zero where they do not count, beyond which
        each stretch is taken by itself."""
        if not self.has_slow(joint):
            return y
        out = np.zeros_like(y)
        for rows in stretches(counts):
            out[rows], _ = levelled(y[rows], self.slow[joint])  # pyright: ignore
        return out

    def widened(self, joint: int, counts: Bool[np.ndarray, " rows"]) -> float:
        r"""What it costs that samples may be further off than the noise, `trust`, in the rows that count [nats].

        Of errors from sample to sample of variance $i_t$, in the noise's, it is $\tfrac12 \sum \log(1 + i_t)$. An
        error of variance $\rho$ that stays for a rest is one number: $\tfrac12 \log(1 + \sum \rho_t / (1 + i_t))$
        for each, and the samples scatter about it as noise does while the joint rests.
        """
        if self.trust is None:
            return 0.0
        spread = 1 / np.maximum(self.trust[:, joint], 1e-9) ** 2
        stays = (
            np.zeros_like(spread) if self.at_rest is None else np.where(counts, self.at_rest[:, joint], 0.0)
        )
        own = spread - stays
        rests = np.array([np.sum((stays / own)[rows]) for rows in stretches(stays > 0)])
        scatter = 1.0 if self.quiet is None else self.quiet[joint]
        each = np.log(own[counts]) + scatter * (stays / (spread * own))[counts]
        return 0.5 * float(np.sum(each) + np.sum(np.log1p(rests)))

    def has_slow(self, joint: int) -> bool:
        """Whether there is an error slower than the noise in a joint."""
        return self.slow is not None and bool(self.slow[joint, 0] != self.slow[joint, 1])

    def is_widened(self, joint: int) -> bool:
        """Whether a joint's noise is more than where nothing is left unexplained."""
        return self.has_slow(joint) or (
            self.least is not None and bool(self.sigma[joint] != self.least[joint])
        )

    def response(self, joint: int, angle: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """What `whiten` makes of the power of a wave that turns by so many radians a step."""
        back = np.exp(-1j * angle)
        out = 1 - sum(a * back ** (k + 1) for k, a in enumerate(self.a[joint]))
        if self.has_slow(joint):
            pole, zero = self.slow[joint]  # pyright: ignore
            out = out * (1 - pole * back) / (1 - zero * back)
        return np.abs(out / self.sigma[joint]) ** 2

    def innovations(self, x: Float[np.ndarray, "_time ..."], joint: int) -> Float[np.ndarray, "_time ..."]:
        """x less what the noise's past foretells of it; the first rows are zero."""
        a = self.a[joint]
        y = np.zeros_like(x)
        order = len(a)
        y[order:] = x[order:]
        for k in range(order):
            y[order:] -= a[k] * x[order - 1 - k : len(x) - 1 - k]
        y /= self.sigma[joint]
        return y


def stretches(counts: Bool[np.ndarray, " rows"]) -> list[slice]:
    """Where rows count, one after the other."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], counts, [False]])))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def levelled(
    y: Float[np.ndarray, "_time ..."],
    slow: Sequence[float] | Float[np.ndarray, " 2"],
    past: Float[np.ndarray, "1 ..."] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Innovations of a stretch, in which slow errors weigh as much as any, and the filter's state behind it.

    `past`: the state before it, where it goes on from another; else errors begin at zero, as where sensors were.
    """
    pole, zero = slow
    past = np.zeros((1, *y.shape[1:])) if past is None else past
    return scipy.signal.lfilter([1.0, -pole], [1.0, -zero], y, axis=0, zi=past)


class Columns(Sequence):
    """For each joint the columns of everything in a model. Most are zero: only those that act are kept."""

    def __init__(
        self, parts: Sequence[Sequence[tuple[slice, Float[np.ndarray, "rows _n"]]]], rows: int, width: int
    ):
        """`parts`: of each joint, what acts there, and which columns that is of so many."""
        self.parts, self.rows, self.width = parts, rows, width

    def __len__(self) -> int:
        return len(self.parts)

    def __getitem__(self, joint: Any) -> Any:
        if not 0 <= joint < len(self):
            raise IndexError(joint)
        if joint not in self._whole:
            A = np.zeros((self.rows, self.width))
            for at, x in self.parts[joint]:
                A[:, at] = x
            self._whole[joint] = A
        return self._whole[joint]

    @functools.cached_property
    def _whole(self) -> dict[int, Float[np.ndarray, "rows n"]]:
        return {}

    def times(self, joint: int, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " rows"]:
        """$A_j x$."""
        return sum((part @ x[at] for at, part in self.parts[joint]), np.zeros(self.rows))

    def products(self, joint: int, F: Float[np.ndarray, "rows m"]) -> Float[np.ndarray, "acting m"]:
        """$A_j^\\top F$, of the columns that act there."""
        return np.concatenate([np.zeros((0, F.shape[1])), *(part.T @ F for _, part in self.parts[joint])])

    def acting(self, joint: int) -> Int[np.ndarray, " acting"]:
        """Which columns act in a joint, in the order of `products`."""
        each = [np.arange(at.start, at.stop) for at, _ in self.parts[joint]]
        return np.concatenate([np.zeros(0, int), *each])

    def without(self, gone: slice) -> "Columns":
        """Less the columns of one term."""
        width = gone.stop - gone.start
        moved = lambda at: at if at.start < gone.start else slice(at.start - width, at.stop - width)
        kept = [[(moved(at), x) for at, x in here if at.start != gone.start] for here in self.parts]
        return Columns(kept, self.rows, self.width - width)


class Design:
    """What is in the model already: whitened columns for each joint, and their prior."""

    def __init__(
        self,
        columns: Sequence[Float[np.ndarray, "rows n"]],
        residual: Sequence[Float[np.ndarray, " rows"]],
        precision: Float[np.ndarray, " n"],
        normal: tuple[Float[np.ndarray, "n n"], Float[np.ndarray, " n"]] | None = None,
        terms: Sequence[Any] = (),
        corrections: Mapping[int, Correction] | None = None,
    ):
        """`normal` holds $A^\\top A$ and $A^\\top r$ where they are known; `terms` made the last columns, and
        `corrections` says which of the others change a number that is not negative."""
        if not isinstance(columns, Columns):
            ends = len(precision) - np.cumsum([0, *(t.width for t in reversed(terms))])[::-1]
            each = [slice(int(a), int(b)) for a, b in itertools.pairwise([0, *ends])]
            columns = Columns(
                [[(at, A[:, at]) for at in each] for A in columns], len(residual[0]), len(precision)
            )
        self.columns, self.residual, self.precision, self.terms = columns, residual, precision, tuple(terms)
        self.corrections = corrections or {}
        if normal is None:
            pairs = list(zip(columns, residual, strict=True))
            normal = np.asarray(sum(A.T @ A for A, _ in pairs)), np.asarray(sum(A.T @ r for A, r in pairs))
        self.normal = normal
        self.information, self.g = normal[0] + np.diag(precision), normal[1]
        self.factor = scipy.linalg.cho_factor(self.information, lower=True) if len(self.g) else None
        free = self.solve(self.g)
        self.x, cost, self.kept = self.admissible(free, self.solve)
        # by how much the data are likelier than without coefficients
        self.fitted = 0.5 * self.g @ free - cost

    def admissible(
        self, x: Float[np.ndarray, " n"], solve: Callable[[np.ndarray], np.ndarray]
    ) -> tuple[Float[np.ndarray, " n"], float, list[Kept]]:
        """The likeliest coefficients whose bodies can be built, and with which no number of the user's arm that
        they correct is negative; what that costs [nats], and what keeps them so.

        x: the likeliest of all; `solve`: multiplies by their covariance.
        """
        bodies, numbers = self._bounds
        bound = at_bounds(x, solve, numbers) if numbers else (x, 0.0, solve, [])
        x, cost, solve, kept = bound
        if not bodies:
            return x, cost, kept
        x, more, kept_too = likeliest(x, solve, bodies)
        return x, cost + more, [*kept, *kept_too]

    @functools.cached_property
    def _bounds(self) -> tuple[list[tuple[slice, Body]], list[dict[int, Correction]]]:
        """Which coefficients are bodies; and of each number that some correct, which do."""
        place, bodies = len(self.precision) - sum(t.width for t in self.terms), []
        corrections = dict(self.corrections)
        for term in self.terms:
            if term.body is not None:
                bodies.append((slice(place, place + len(term.deviation)), term.body))
            corrections |= {place + k: one for k, one in term.corrections.items()}
            place += term.width
        numbers: dict[tuple[str, int], dict[int, Correction]] = {}
        for at, one in corrections.items():
            numbers.setdefault(one.of, {})[at] = one
        return bodies, [*numbers.values()]

    def without(self, i: int) -> "Design":
        """The model less one of its terms."""
        first = len(self.precision) - sum(t.width for t in self.terms[i:])
        gone, kept = slice(first, first + self.terms[i].width), np.ones(len(self.precision), bool)
        kept[gone] = False
        normal = self.normal[0][np.ix_(kept, kept)], self.normal[1][kept]
        others = (*self.terms[:i], *self.terms[i + 1 :])
        columns, precision = self.columns.without(gone), self.precision[kept]
        return Design(columns, self.residual, precision, normal, others, self.corrections)

    @functools.cached_property
    def left(self) -> list[Float[np.ndarray, " rows"]]:
        """What the model leaves of each joint's residual."""
        return [r - self.columns.times(j, self.x) for j, r in enumerate(self.residual)]

    def solve(self, y: np.ndarray) -> np.ndarray:
        """$H^{-1} y$."""
        return y if self.factor is None else scipy.linalg.cho_solve(self.factor, y)

    @functools.cached_property
    def _roots(self) -> dict[int, Float[np.ndarray, "acting acting"]]:
        return {}

    def explained(self, joint: int, F: Float[np.ndarray, "acting m"]) -> Float[np.ndarray, "acting m"]:
        r"""C with $C^\top C = F^\top H^{-1} F$, F the products of what acts in one joint.

        For many F: of $H^{-1} = R^\top R$ no more than the rows that act there is needed.
        """
        if not len(F):
            return F
        if joint not in self._roots:
            here = self.lowered(np.eye(len(self.g))[:, self.columns.acting(joint)])
            self._roots[joint] = np.asarray(np.linalg.qr(here, mode="r"))
        return self._roots[joint] @ F

    def lowered(self, F: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
        r"""$L^{-1} F$ with $L L^\top = H$, that of coefficients which stay what can be built."""
        if self.factor is None:
            return F
        return scipy.linalg.solve_triangular(self._bounded, F, lower=True, check_finite=False)

    @functools.cached_property
    def _bounded(self) -> Float[np.ndarray, "n n"]:
        """Beside a bound what is left of a residual is not orthogonal to the columns of what is held there:
        another law takes it without them."""
        assert self.factor is not None
        if not self.kept:
            return self.factor[0]
        H = self.information.copy()
        for held in self.kept:
            H[np.ix_(held.at, held.at)] += held.curvature
        return scipy.linalg.cho_factor(H, lower=True)[0]

    @property
    def log_evidence(self) -> float:
        """Log evidence of the whole model, up to a constant of the data."""
        if self.factor is None:
            return 0.0
        half_determinant = np.log(np.diag(self.factor[0])).sum()
        return float(self.fitted - half_determinant + 0.5 * np.log(self.precision).sum())

    def in_joint(
        self, joint: int, Phi: Float[np.ndarray, "rows m n"], G: Float[np.ndarray, "m n n"]
    ) -> tuple[Float[np.ndarray, "m n"], Float[np.ndarray, "m n n"]]:
        """b and G of m candidates that act in one joint, given their Gram matrices."""
        rows, m, n = Phi.shape
        flat = Phi.reshape(rows, m * n)
        b = (flat.T @ self.left[joint]).reshape(m, n)
        C = self.explained(joint, self.columns.products(joint, flat))
        return b, G - gram(C.reshape(-1, m, n))

    def in_arm(
        self, Phi: Sequence[Float[np.ndarray, "rows m n"]], grams: Sequence[Float[np.ndarray, "m n n"]]
    ) -> tuple[Float[np.ndarray, "m n"], Float[np.ndarray, "m n n"]]:
        """b and G of m candidates that act in all joints, given their Gram matrices in each."""
        _, m, n = Phi[0].shape
        b, G, C = np.zeros((m, n)), np.zeros((m, n, n)), np.zeros((len(self.g), m * n))
        for joint, (left, F, Q) in enumerate(zip(self.left, Phi, grams, strict=True)):
            if not Q.any():
                continue
            flat = F.reshape(len(F), m * n)
            b += (flat.T @ left).reshape(m, n)
            G += Q
            C[self.columns.acting(joint)] += self.columns.products(joint, flat)
        return b, G - gram(self.lowered(C).reshape(-1, m, n))


def gram(F: Float[np.ndarray, "rows m n"]) -> Float[np.ndarray, "m n n"]:
    """$F_m^\\top F_m$ of each m."""
    stacked = np.moveaxis(F, 1, 0)
    return np.matmul(np.swapaxes(stacked, 1, 2), stacked)


def log_bayes(
    b: Float[np.ndarray, "m n"],
    G: Float[np.ndarray, "m n n"],
    deviation: Float[np.ndarray, "m n"],
    scales: Sequence[float],
    signs: Float[np.ndarray, "*_m n"] | None = None,
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Log Bayes factor of each candidate, averaged over the scales, and the scale that is likeliest.

    Args:
        b: projections of the residual.
        G: Gram matrices.
        deviation: prior deviation of each coefficient, before the scale.
        scales: multiples of it.
        signs: where a coefficient cannot be negative (1) or positive (-1): its half-normal prior counts.
    """
    m, n = b.shape
    s = np.asarray(scales, float)[:, None]
    D = [deviation[:, k] for k in range(n)]
    Db = [s * (D[k] * b[:, k]) for k in range(n)]
    B = [[s**2 * (D[i] * G[:, i, k] * D[k]) + (i == k) for k in range(i + 1)] for i in range(n)]
    L = _cholesky(B)
    y = _forward(L, Db)
    out = sum((0.5 * y[k] ** 2 - np.log(L[k][k]) for k in range(n)), np.zeros((len(scales), m)))
    if signs is not None and np.any(signs):
        wide = np.broadcast_to(signs, (m, n))
        for k in np.flatnonzero(np.any(wide != 0, 0)):
            column = _forward(L, [np.full_like(out, float(i == k)) for i in range(n)], int(k))
            spread = np.sqrt(sum(c**2 for c in column[k:]))
            mean = sum(c * v for c, v in zip(column[k:], y[k:], strict=True))
            allowed = scipy.special.log_ndtr(wide[:, k] * mean / spread) + np.log(2.0)
            out += np.where(wide[:, k] != 0, allowed, 0.0)
    return log_mean_exp(out), np.asarray(scales)[out.argmax(0)]


def log_mean_exp(x: Float[np.ndarray, "n ..."]) -> Any:
    """$\\log \\langle e^x \\rangle$ over the first axis."""
    top = x.max(0)
    return top + np.log(np.exp(x - top).mean(0))


Rows = list[list[np.ndarray]]
"""A lower triangle, each entry an array over candidates: small matrices are fastest side by side."""


def _cholesky(B: Rows) -> Rows:
    """The factor L of many matrices $B = 1 + S$ with S positive: no pivot is below one but by rounding."""
    L: Rows = []
    for i, row in enumerate(B):
        L.append([])
        for k, entry in enumerate(row):
            for l in range(k):
                entry = entry - L[i][l] * L[k][l]
            L[i].append(np.sqrt(np.maximum(entry, 1.0)) if i == k else entry / L[k][k])
    return L


def _forward(L: Rows, b: Sequence[np.ndarray], first: int = 0) -> list[np.ndarray]:
    """$L^{-1} b$, where b is zero before `first`."""
    y = list(b[:first])
    for i in range(first, len(b)):
        value = b[i]
        for l in range(first, i):
            value = value - L[i][l] * y[l]
        y.append(value / L[i][i])
    return y
