r"""Base parameters: the combinations of standard parameters that torque can tell, and how they read.

$$W \phi = W_b\,\beta, \qquad \beta = K \phi$$

$W_b$ are independent columns of the regressor $W$; every other column is a combination of them, and $K$
says which standard parameters are therefore felt together.

References:
    Gautier, "Numerical calculation of the base inertial parameters of robots", J. Robotic Systems 1991;
    Khalil and Dombre, Modeling, Identification and Control of Robots, 2002, ch. 9 (which to keep).
"""

import dataclasses
import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxpanda_kernels import Chain, regressor
from jaxtyping import Float

from .arms.arm import Arm
from .errors import InputError, require_x64

# Names of the ten parameters of link {0}, in the order of `jaxpanda_kernels.inertia`.
_PATTERNS = (
    "m{0}",
    "m{0}c{0}x",
    "m{0}c{0}y",
    "m{0}c{0}z",
    "J{0}xx",
    "J{0}xy",
    "J{0}yy",
    "J{0}xz",
    "J{0}yz",
    "J{0}zz",
)
_M, _MX, _MY, _MZ, _XX, _XY, _YY, _XZ, _YZ, _ZZ = range(10)

# Which columns to keep when several would do. A link's Jyy, mcz and m are always felt together with other
# parameters, so they come last and are the ones to be regrouped.
_KEPT_FIRST = (_XX, _XY, _XZ, _YZ, _ZZ, _MX, _MY)
_KEPT_LAST = (_YY, _MZ, _M)
# How the paper's Table III lists coefficients: inertias link by link, then first moments, then masses.
_LISTED = ((_XX, _XY, _XZ, _YY, _YZ, _ZZ), (_MX, _MY, _MZ), (_M,))
# In an expression: inertias by kind, then by link.
_INERTIAS = (_XX, _XY, _XZ, _YY, _YZ, _ZZ)

_NEGLIGIBLE = 1e-9
"""Share of a column below which a contribution to it is round-off."""


def standard_names(dof: int) -> tuple[str, ...]:
    """Names of the standard parameters in flat order: m1, m1c1x, ... J1zz, m2, ..."""
    return tuple(pattern.format(link) for link in range(1, dof + 1) for pattern in _PATTERNS)


@dataclasses.dataclass(frozen=True)
class Base:
    """Base parameters `beta = projection @ phi.ravel()` of an arm, or of what one recording excites."""

    independent: tuple[int, ...]
    """Column of the regressor that belongs to each base parameter."""
    projection: Float[np.ndarray, "base standard"]
    """K: what each base parameter is, in standard parameters."""
    singular_values: Float[np.ndarray, " columns"]
    """Of the regressor with columns scaled to unit length, largest first: what the rank was read from."""

    @property
    def rank(self) -> int:
        return len(self.independent)

    @property
    def dof(self) -> int:
        return self.projection.shape[1] // 10

    @property
    def terms(self) -> list[dict[str, float]]:
        """Each base parameter as a linear form: standard parameter to coefficient."""
        return linear_forms(self.projection)

    @property
    def expressions(self) -> list[str]:
        """Each base parameter as the literature prints it, as in `J2yy + J1zz`."""
        return [expression(terms) for terms in self.terms]


def linear_forms(projection: Float[np.ndarray, "base standard"]) -> list[dict[str, float]]:
    """Rows of K as linear forms: name of the standard parameter to coefficient."""
    names = standard_names(projection.shape[1] // 10)
    return [{names[k]: float(row[k]) for k in np.flatnonzero(row)} for row in projection]


_PANEL = 32
"""Columns that are factored at a time."""


def triangle(rows: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "columns columns"]:
    """The R of a QR factorisation, which has a matrix's singular values and is all that least squares needs of
    it; padded with rows of zeros where there are fewer rows than columns.

    By LAPACK's recursive form: tall matrices take a quarter of the time of `numpy.linalg.qr`.
    """
    m, n = rows.shape
    out = np.zeros((n, n))
    if min(m, n):
        factor = scipy.linalg.lapack.dgeqrt  # pyright: ignore[reportAttributeAccessIssue]
        factored, _, info = factor(min(_PANEL, m, n), np.array(rows, float, order="F"), 1)
        assert info == 0
        out[: min(m, n)] = np.triu(factored[: min(m, n)])
    return out


def base_parameters(
    W: Float[np.ndarray, "rows standard"], *, tolerance: float = 1e-8, independent: int | None = None
) -> Base:
    """Base parameters behind a regressor, by a factorisation that reveals its rank.

    Columns are scaled to unit length, so that the rank does not depend on units; it is the number of singular
    values above `tolerance` times the largest. Columns are then taken in Khalil's order, each kept if what
    the kept ones leave of it exceeds the round-off, until the rank is reached.

    Args:
        W: stacked regressor; ten columns a link in the kernels' order.
        tolerance: of singular values, relative to the largest.
        independent: the rank, where it is known from elsewhere.

    Raises:
        RuntimeError: fewer independent columns than the rank: singular values fall off without a gap.
    """
    columns = W.shape[1]
    R = triangle(W)
    norms = np.linalg.norm(R, axis=0)
    felt = norms > tolerance * max(norms.max(initial=0.0), 1e-300)
    scaled = R / np.where(felt, norms, 1.0) * felt
    singular_values = np.linalg.svd(scaled, compute_uv=False)
    rank = independent
    if rank is None:
        rank = int(np.sum(singular_values > tolerance * max(singular_values.max(initial=0.0), 1e-300)))

    kept: list[int] = []
    basis = np.zeros((scaled.shape[0], 0))
    for k in _khalil_order(columns // 10):
        rest = scaled[:, k]
        for _ in range(2):  # once more for the digits that cancellation cost
            rest = rest - basis @ (basis.T @ rest)
        size = np.linalg.norm(rest)
        if len(kept) < rank and size > tolerance:
            kept.append(k)
            basis = np.column_stack([basis, rest / size])
    if len(kept) != rank:
        raise RuntimeError(
            f"{len(kept)} independent columns, but {rank} singular values above {tolerance:g} of the largest:"
            " they fall off without a gap, so this motion has no clear rank"
        )

    kept = [k for k in _listed_order(columns // 10) if k in set(kept)]
    shares = np.linalg.lstsq(scaled[:, kept], scaled, rcond=None)[0]
    shares[np.abs(shares) < _NEGLIGIBLE] = 0.0
    projection = shares * norms / norms[kept][:, None]
    projection[:, kept] = np.eye(rank)
    return Base(tuple(kept), np.round(projection, 12), singular_values)


def arm_base_parameters(arm: Arm, *, samples: int = 200, seed: int = 0) -> Base:
    """Base parameters of the arm itself: of its regressor at random states within the joint limits."""
    return base_parameters(random_regressor(arm, samples, seed))


def random_regressor(arm: Arm, samples: int, seed: int = 0) -> Float[np.ndarray, "rows standard"]:
    """Stacked regressor at random states within the joint limits, speeds and accelerations of order one."""
    require_x64("a rank")
    draws = jax.random.split(jax.random.key(seed), 3)
    shape = (samples, arm.dof)
    reach = jnp.where(arm.chain.prismatic, 1.0, jnp.pi)
    lower = jnp.where(jnp.isfinite(arm.lower), arm.lower, -reach)
    upper = jnp.where(jnp.isfinite(arm.upper), arm.upper, reach)
    q = jax.random.uniform(draws[0], shape, minval=lower, maxval=upper)
    qd = jax.random.uniform(draws[1], shape, minval=-2.0, maxval=2.0)
    qdd = jax.random.uniform(draws[2], shape, minval=-8.0, maxval=8.0)
    Y = _regressors(arm.chain, q, qd, qdd)
    return np.asarray(Y).reshape(-1, 10 * arm.dof)


@jax.jit
def _regressors(chain: Chain, q, qd, qdd):
    return jax.vmap(lambda q, qd, qdd: regressor(chain, q, qd, qdd))(q, qd, qdd)


def _khalil_order(dof: int) -> list[int]:
    return [10 * link + k for tier in (_KEPT_FIRST, _KEPT_LAST) for link in range(dof) for k in tier]


def _listed_order(dof: int) -> list[int]:
    return [10 * link + k for tier in _LISTED for link in range(dof) for k in tier]


def expression(terms: Mapping[str, float | int]) -> str:
    """A linear form as text: inertias by kind, then single masses and moments, then masses that go together.

    Coefficients are printed to four decimals, as the paper does (five significant digits where that says less
    than three); `terms` has them in full.
    """
    inertias, singles, masses = [], [], []
    for name, coefficient in terms.items():
        link, kind = divmod(_index(name), 10)
        place = masses if kind == _M else inertias if kind in _INERTIAS else singles
        rank = _INERTIAS.index(kind) if kind in _INERTIAS else 0
        place.append((rank, link, name, coefficient))
    groups = []  # masses of neighbouring links that enter alike
    for _, run in groupby(sorted(masses), key=lambda term: round(term[3], 9)):
        groups.append(list(run))
    for group in groups:
        if len(group) == 1:
            singles.append((-1, *group[0][1:]))
    parts = [(c, name) for _, _, name, c in sorted(inertias)]
    parts += [(c, name) for _, _, name, c in sorted(singles, key=lambda term: (term[1], term[0]))]
    parts += [
        (group[0][3], "(" + " + ".join(name for _, _, name, _ in group) + ")")
        for group in groups
        if len(group) > 1
    ]
    text = ""
    for coefficient, name in parts:
        sign = "-" if coefficient < 0 else "+"
        text += f" {sign} " if text else "-" if coefficient < 0 else ""
        text += name if abs(coefficient) == 1 else f"{_digits(abs(coefficient))} {name}"
    return text


def unit_of_form(terms: Iterable[str]) -> str:
    """Of a linear form of these standard parameters: coefficients hold the lengths that the others lack."""
    kinds = {_index(name) % 10 for name in terms}
    return "kg m²" if kinds & set(_INERTIAS) else "kg" if kinds == {_M} else "kg m"


def _digits(value: float) -> str:
    return f"{value:.4f}".rstrip("0").rstrip(".") if value >= 0.001 else f"{value:.3g}"


_MASS = re.compile(r"m([1-9]\d*)(?:c\1([xyz]))?")
_INERTIA = re.compile(r"J([1-9]\d*)(xx|xy|yy|xz|yz|zz)")


def _index(name: str) -> int:
    """Flat index of a standard parameter; KeyError if it is none."""
    if match := _MASS.fullmatch(name):
        kind = 0 if match[2] is None else 1 + "xyz".index(match[2])
    elif match := _INERTIA.fullmatch(name):
        kind = 4 + ("xx", "xy", "yy", "xz", "yz", "zz").index(match[2])
    else:
        raise KeyError(name)
    return 10 * (int(match[1]) - 1) + kind


def coefficient_matrix(
    terms: Sequence[Any], dof: int | None = None, *, where: str = "coefficients"
) -> Float[np.ndarray, "base standard"]:
    """K of a table of coefficients: row i holds the linear form `terms[i]`.

    Args:
        terms: for each coefficient, standard parameter (as in `standard_names`) to number.
        dof: links of the arm; the largest link named in the table where it is not given.
        where: what to call the table in an error.

    Raises:
        InputError: an unknown parameter, a link the arm lacks, or a number that is none.
    """
    entries = []
    for row, form in enumerate(terms):
        place = f"{where}[{row}].terms"
        if not isinstance(form, Mapping) or not form:
            raise InputError(
                f"{place}: needs at least one standard parameter, as in {{'J2yy': 1, 'J1zz': 1}}"
            )
        for name, value in form.items():
            try:
                column = _index(name)
            except KeyError:
                raise InputError(f"{place}: unknown parameter {name!r}; write m3, m3c3x or J3xx") from None
            if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
                raise InputError(f"{place}.{name}: {value!r} is no finite number")
            entries.append((row, column, float(value)))
    links = 1 + max((column // 10 for _, column, _ in entries), default=0)
    if dof is not None and links > dof:
        raise InputError(f"{where}: names link {links}, but the arm has {dof}")
    K = np.zeros((len(terms), 10 * (dof or links)))
    for row, column, value in entries:
        K[row, column] = value
    return K
