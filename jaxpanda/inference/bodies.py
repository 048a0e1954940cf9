r"""Of the bodies that can be built, and of numbers that are not negative, those that the recordings are likeliest
with.

A law that adds a body is linear in its standard parameters, and a Gaussian prior lets them be anyone's. A body's
pseudo-inertia is positive, $J(c) = \sum_k c_k J_k \succ 0$ (Wensing, Kim, Slotine, RA-L 2018). With the
coefficients $\hat c$ that are likeliest without that, and their covariance C,

$$\min_c\; \tfrac12 (c - \hat c)^\top C^{-1} (c - \hat c) - \mu \sum_{bodies} \log\det J(c)$$

for falling $\mu$ (Boyd and Vandenberghe, Convex Optimization 2004, ch. 11). `feasible.nearest` does the like for
the links of an arm by their factors; for one body that is slower, and may end where no step helps.

A number of the user's file, as a rotor's inertia or a level of friction, is not negative with all that laws and
refits add to it (`at_bounds`).
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.optimize
from jaxpanda_kernels.inertia import pseudo_inertia
from jaxtyping import Float, Int

from ..arms.arm import Arm
from ..effects import AbstractEffect


@dataclasses.dataclass(frozen=True)
class Body:
    """A pseudo-inertia, linear in some coefficients."""

    steps: Float[np.ndarray, "n 4 4"]
    begin: Float[np.ndarray, " n"]
    """Coefficients of some body that can be built."""

    def at(self, c: Float[np.ndarray, " n"]) -> Float[np.ndarray, "4 4"]:
        return np.tensordot(c, self.steps, 1)


@functools.cache
def _pseudo_inertias() -> Float[np.ndarray, "10 4 4"]:
    """Of each standard parameter by itself."""
    return np.asarray(jax.vmap(pseudo_inertia)(jnp.eye(10)), float)


def body(directions: Float[np.ndarray, "10 n"]) -> Body:
    """Of standard parameters that are so many for each coefficient, the first one's a body's."""
    steps = np.tensordot(directions, _pseudo_inertias(), (0, 0))
    values, vectors = np.linalg.eigh(steps[0])
    inside = (vectors * np.maximum(values, _INSIDE * values[-1])) @ vectors.T
    return Body(steps, np.linalg.lstsq(steps.reshape(-1, 16).T, inside.ravel(), rcond=None)[0])


@dataclasses.dataclass(frozen=True)
class Correction:
    """A coefficient that is added to a number of the user's model, which is not negative with it."""

    of: tuple[str, int]
    """The number's name, and its joint."""
    value: float
    """The user's."""
    size: float = 1.0
    """By how much one of the coefficient changes it."""


def corrections_of(effect: AbstractEffect, arm: Arm) -> dict[int, Correction]:
    """Which coefficients of an effect correct a number of the arm."""
    named = zip(effect.coefficients, effect.corrected(arm), strict=True)
    return {
        k: Correction((law.beyond, effect.joints[0]), value)
        for k, (law, value) in enumerate(named)
        if law.beyond
    }


@dataclasses.dataclass(frozen=True)
class Kept:
    """How much less likely coefficients get beside the likeliest, for what they may not be."""

    at: Int[np.ndarray, " m"]
    """Which coefficients."""
    curvature: Float[np.ndarray, "m m"]
    """Of that: where a step is barred it has next to none to go."""


def at_bounds(
    x: Float[np.ndarray, " n"],
    solve: Callable[[np.ndarray], np.ndarray],
    numbers: Sequence[Mapping[int, Correction]],
) -> tuple[Float[np.ndarray, " n"], float, Callable[[np.ndarray], np.ndarray], list[Kept]]:
    r"""Coefficients with which no number is negative, what they cost [nats], what multiplies by the covariance of
    those that leave the numbers that are zero at that, and what keeps them so.

    With $v + A c \ge 0$ they are $\hat c + C A^\top \lambda$, where $\lambda \ge 0$ makes
    $\tfrac12 \lambda^\top A C A^\top \lambda + \lambda^\top (v + A \hat c)$ least (Lawson and Hanson, Solving
    Least Squares Problems 1974).

    Args:
        x: the likeliest of all.
        solve: multiplies by their covariance.
        numbers: of each, what coefficients add to it.
    """
    A = np.zeros((len(numbers), len(x)))
    for row, parts in zip(A, numbers, strict=True):
        row[[*parts]] = [one.size for one in parts.values()]
    found = np.array([next(iter(parts.values())).value for parts in numbers]) + A @ x
    if not np.any(found < 0):
        return x, 0.0, solve, []
    wide = solve(A.T)
    C = A @ wide
    unit = 1 / np.sqrt(np.diag(C))
    root = np.linalg.cholesky(unit[:, None] * C * unit + _ROUNDING * np.eye(len(C)))
    short = scipy.linalg.solve_triangular(root, -found * unit, lower=True)
    pull = unit * scipy.optimize.nnls(root.T, short, maxiter=100 * len(C))[0]
    zero = np.flatnonzero(pull > 0)
    if not len(zero):  # below zero by rounding
        return x, 0.0, solve, []
    at = np.flatnonzero(np.any(A[zero] != 0, 0))
    held, there = A[np.ix_(zero, at)], wide[:, zero]
    factor = scipy.linalg.cho_factor(C[np.ix_(zero, zero)], lower=True)
    among = lambda y: solve(y) - there @ scipy.linalg.cho_solve(factor, there.T @ y)
    kept = Kept(at, held.T @ (_STIFF * unit[zero, None] ** 2 * held))
    return x + wide @ pull, 0.5 * float(pull @ C @ pull), among, [kept]


def likeliest(
    x: Float[np.ndarray, " n"],
    solve: Callable[[np.ndarray], np.ndarray],
    bodies: Sequence[tuple[slice, Body]],
) -> tuple[Float[np.ndarray, " n"], float, list[Kept]]:
    """Coefficients whose bodies can be built, what they cost [nats], and what keeps them so.

    Args:
        x: the likeliest of all.
        solve: multiplies by their covariance.
        bodies: and where their coefficients are.
    """
    if all(np.linalg.eigvalsh(b.at(x[at]))[0] >= 0 for at, b in bodies):
        return x, 0.0, []
    at = np.concatenate([np.arange(where.start, where.stop) for where, _ in bodies])
    wide = solve(np.eye(len(x))[:, at])
    C = wide[at]
    deviation = np.sqrt(np.diag(C))
    correlation = C / np.outer(deviation, deviation)
    root = deviation[:, None] * np.linalg.cholesky(correlation + _ROUNDING * np.eye(len(at)))
    ends = np.cumsum([0, *(len(b.begin) for _, b in bodies)])
    blocks = [
        (b.at(x[where]), np.tensordot(root[lo:hi], b.steps, (0, 0)))
        for (where, b), lo, hi in zip(bodies, ends[:-1], ends[1:], strict=True)
    ]
    start = np.concatenate([b.begin for _, b in bodies]) - x[at]
    z = _inside(blocks, scipy.linalg.solve_triangular(root, start, lower=True))
    weights = scipy.linalg.solve_triangular(root, z, lower=True, trans=1)
    *_, curvature = _barrier(blocks, z, _PRICE, derivatives=True)
    half = scipy.linalg.solve_triangular(root, curvature - np.eye(len(z)), lower=True, trans=1)
    kept = Kept(at, scipy.linalg.solve_triangular(root, half.T, lower=True, trans=1))
    return x + wide @ weights, 0.5 * float(z @ z), [kept]


Blocks = Sequence[tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "n 4 4"]]]


def _inside(blocks: Blocks, z: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """The z nearest to zero at which every matrix is positive, from one at which they are."""
    price = max(0.5 * float(z @ z) / (4 * len(blocks)), _PRICE)
    while True:
        for _ in range(_STEPS):
            value, gradient, hessian = _barrier(blocks, z, price, derivatives=True)
            step = -np.linalg.solve(hessian, gradient)
            decrement = -float(gradient @ step)
            if decrement < _CLOSE * price:
                break
            length = 1.0
            while length > _ROUNDING:
                if _barrier(blocks, z + length * step, price)[0] <= value - 0.1 * length * decrement:
                    break
                length *= 0.5
            else:
                break
            z = z + length * step
        if price <= _PRICE:
            return z
        price = max(price / _FALL, _PRICE)


def _barrier(
    blocks: Blocks, z: Float[np.ndarray, " n"], price: float, *, derivatives: bool = False
) -> tuple[float, np.ndarray, np.ndarray]:
    """$\\tfrac12 z^\\top z - \\mu \\sum \\log\\det J(z)$, infinite outside, and its derivatives."""
    value, gradient, hessian = 0.5 * float(z @ z), z.copy(), np.eye(len(z))
    for constant, steps in blocks:
        try:
            factor = np.linalg.cholesky(constant + (z @ steps.reshape(len(z), 16)).reshape(4, 4))
        except np.linalg.LinAlgError:
            return np.inf, gradient, hessian
        value -= 2 * price * float(np.log(np.diag(factor)).sum())
        if derivatives:
            inverse = np.linalg.inv(factor)
            level = (inverse @ steps @ inverse.T).reshape(len(z), 16)
            gradient = gradient - price * level[:, ::5].sum(1)
            hessian = hessian + price * level @ level.T
    return value, gradient, hessian


_ROUNDING = 1e-9
_STIFF = 1e6
"""By how many times what holds a number at zero is stiffer than what tells of it."""
_INSIDE = 1e-3
"""Least eigenvalue of the body that a search begins from, as a share of the largest."""
_PRICE, _FALL = 0.01, 10.0
"""Last price of nearness to the boundary [nats], of which a body costs four at most, and by how much it falls."""
_STEPS, _CLOSE = 30, 0.1
"""Newton's steps for each price, and the decrement that ends them, over the price."""
