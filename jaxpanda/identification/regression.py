r"""Least squares of filtered torque on filtered regressors, joint by joint.

$$F\tau_j = F Y_j(q, \dot q, \ddot q)\,\beta + F \psi(\dot q_j)\,\theta_j + e_j$$

$F$ is the same zero-phase low-pass for every column and for the torque ("parallel filtering"), so that it
changes the noise and not the parameters. Joints are kept apart until the last step: each has its own noise.
"""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels import Chain, regressor
from jaxtyping import Array, Bool, Float, Int
from threadpoolctl import threadpool_limits

from ..arms.arm import Arm
from ..errors import InputError
from ..friction import LINEAR, columns
from ..parameters import Base, base_parameters, triangle
from ..signals import Signals

_CHUNK = 1024  # samples whose regressor is evaluated at once; bounds the memory
_AT_ONCE = 2**26  # numbers of the rows of some joints at the full rate; 512 MiB of them
_REWEIGHTINGS = 2  # after the first, joint weights change by less than a percent
_LEAST_SIGMA = 1e-9  # of the torque: below it a residual is round-off, as on noise-free data
UNDETERMINED = 1e-9
"""Singular values of unit-length columns below this share of the largest tell nothing."""

Masks = Sequence[Bool[np.ndarray, "..."]]
"""Which samples of each recording to use."""


@dataclasses.dataclass(frozen=True)
class Regression:
    """One recording, filtered: what each joint's torque should be a combination of."""

    name: str
    A: Float[np.ndarray, "dof time columns"]
    """Base parameters' columns, then the friction's, all of joint 1 first."""
    y: Float[np.ndarray, "dof time"]
    """Measured torque less what the arm's model holds beyond rigid links [N m]."""
    tau: Float[np.ndarray, "dof time"]
    """Measured torque [N m]: what relative errors are relative to."""
    unsure: Float[np.ndarray, "dof time"]
    """Share of a sample in which a joint may rest, or turn: dry friction is then anything up to its level."""
    weight: Float[np.ndarray, "dof time"]
    """By which `A` and `y` are multiplied, one where nothing is doubted."""

    def residual(self, x: Float[np.ndarray, " columns"]) -> Float[np.ndarray, "dof time"]:
        """What the unknowns `x` leave of the torque, as weighted [N m]."""
        return self.y - self.A @ x

    def error(self, x: Float[np.ndarray, " columns"]) -> Float[np.ndarray, "dof time"]:
        """The same as it is [N m]."""
        return self.residual(x) / self.weight

    def doubted(self, level: Float[np.ndarray, " dof"], sigma: Float[np.ndarray, " dof"]) -> "Regression":
        """With weights for dry friction of such levels beside such residuals [N m]."""
        weight = 1 / np.sqrt(1 + (np.abs(level) / sigma)[:, None] ** 2 * self.unsure**2)
        more = weight / self.weight
        return dataclasses.replace(self, A=self.A * more[:, :, None], y=self.y * more, weight=weight)

    def only(self, mask: Bool[np.ndarray, " time"]) -> "Regression":
        """Some samples."""
        taken = {name: getattr(self, name)[:, mask] for name in ("A", "y", "tau", "unsure", "weight")}
        return dataclasses.replace(self, **taken)


def regression(signals: Signals, arm: Arm, base: Base, friction: str) -> Regression:
    """Filter one recording's torque, its regressor and the columns of a linear friction model alike.

    Raises:
        InputError: the recording has no torque, or another number of joints than the arm.
    """
    if signals.tau is None:
        raise InputError(
            f"{signals.name}: has no columns tau_1 ...; identification needs the measured torque"
        )
    if signals.dof != arm.dof:
        raise InputError(f"{signals.name}: has {signals.dof} joints, but the arm {arm.name} has {arm.dof}")
    q, qd, qdd = jnp.asarray(signals.q), jnp.asarray(signals.qd), jnp.asarray(signals.qdd)
    tau = signals.lowpass(signals.tau).T
    known = signals.lowpass(np.asarray(jax.vmap(arm.known_torque)(q, qd, qdd))).T
    independent = jnp.asarray(base.independent, int)
    at_once = min(max(1, _AT_ONCE // (len(q) * base.rank)), arm.dof)
    rigid = []
    for first in range(0, arm.dof, at_once):
        joints = np.minimum(np.arange(first, first + at_once), arm.dof - 1)
        rows = np.asarray(base_rows(arm.chain, independent, joints, q, qd, qdd))
        rigid += [signals.lowpass(of_joint) for of_joint in rows[: arm.dof - first]]
    own = signals.lowpass(np.asarray(columns(friction, jnp.asarray(moving(signals)))))
    A = with_columns(np.stack(rigid), np.moveaxis(own, 1, 0))
    for what, values in (("torque", tau), ("motion", A), ("torque of the model's own joint physics", known)):
        if not np.all(np.isfinite(values)):
            raise InputError(
                f"{signals.name}: the filtered {what} is not finite; jaxpanda inspect shows where"
            )
    unsure = np.clip(signals.lowpass(signals.unsure).T, 0.0, 1.0)
    return Regression(signals.name, A, tau - known, tau, unsure, np.ones_like(tau))


def moving(signals: Signals) -> Float[np.ndarray, "time dof"]:
    """Velocities [rad/s], zero for a joint that stands still throughout.

    Noise of its encoder is no motion. Nor does friction brake a joint that trembles while others move: it yields
    by as much without sliding, and carries any load.
    """
    return np.where(signals.moves, signals.qd, 0.0)


def with_columns(
    rigid: Float[np.ndarray, "dof time base"], own: Float[np.ndarray, "dof time extra"]
) -> Float[np.ndarray, "dof time columns"]:
    """The rigid columns, and beside them each joint's own ones, which no other joint feels."""
    dof, _, extra = own.shape
    blocks = np.zeros((*own.shape[:2], dof * extra))
    for joint in range(dof):
        blocks[joint, :, joint * extra : (joint + 1) * extra] = own[joint]
    return np.concatenate([rigid, blocks], -1)


@jax.jit
def base_rows(
    chain: Chain,
    independent: Int[Array, " base"],
    joints: Int[Array, " some"] | Int[np.ndarray, " some"],
    q: Float[Array, "time dof"],
    qd: Float[Array, "time dof"],
    qdd: Float[Array, "time dof"],
) -> Float[Array, "some time base"]:
    """Some joints' rows of the regressor, independent columns only.

    Not always all joints', since a long recording's whole regressor would not fit in memory.
    """

    def rows(sample):
        return regressor(chain, *sample).reshape(len(sample[0]), -1)[joints][:, independent]

    return jnp.moveaxis(jax.lax.map(rows, (q, qd, qdd), batch_size=_CHUNK), 1, 0)


def everything(regressions: Sequence[Regression]) -> Masks:
    """Masks that leave nothing out."""
    return [np.ones(r.y.shape[1], bool) for r in regressions]


def excited(regressions: Sequence[Regression], base: Base) -> tuple[list[Regression], Base]:
    """The problem in as many base parameters as the recordings excite, exactly the given ones if all of them.

    A recording at rest, say, tells gravity parameters only. A column of the smaller base is the torque of a
    standard parameter, which need not be one that the arm's own base is named after.

    Raises:
        InputError: the motion shows some parameters so weakly that their number is not clear.
    """
    R = np.concatenate(triangles(regressions, everything(regressions)))[:, : base.rank]
    norms = np.linalg.norm(R, axis=0)
    s = np.linalg.svd(R / np.where(norms > 0, norms, 1), compute_uv=False)
    if norms.all() and s[-1] > UNDETERMINED * s[0]:
        return list(regressions), base
    try:
        fewer = base_parameters(R @ base.projection, tolerance=UNDETERMINED)
    except RuntimeError as error:
        names = ", ".join(r.name for r in regressions)
        raise InputError(f"{names}: {error}; record a motion of all joints") from None
    columns = base.projection[:, list(fewer.independent)]
    reduced = [
        np.concatenate([r.A[:, :, : base.rank] @ columns, r.A[:, :, base.rank :]], 2) for r in regressions
    ]
    return [dataclasses.replace(r, A=A) for r, A in zip(regressions, reduced, strict=True)], fewer


def triangles(
    regressions: Sequence[Regression], masks: Masks, *, weighted: bool = True
) -> Float[np.ndarray, "dof rows columns"]:
    r"""The R of a QR factorisation of $[A_j\; y_j]$ a joint: all that least squares needs of the data."""
    R = []
    for joint in range(len(regressions[0].A)):
        parts = [
            np.column_stack([r.A[joint, mask], r.y[joint, mask]])
            / (1.0 if weighted else r.weight[joint, mask, None])
            for r, mask in zip(regressions, masks, strict=True)
        ]
        R.append(triangle(np.concatenate(parts)))
    return np.stack(R)


def doubting_rest(
    regressions: Sequence[Regression], base: Base, friction: str, held: Float[np.ndarray, " dof"]
) -> list[Regression]:
    r"""The same, samples weighed down in which a joint with Coulomb friction may rest or turn.

    There friction is anything up to its level $F_c$, whatever the sign of the velocity: for a share $u$ of a
    sample the residual's variance is $\sigma^2 + (u F_c)^2$. Taken for the law's, such samples make $F_c$ too
    small, and viscous friction of what is missing. The level is what the model holds, `held` [N m], with what is
    found beside it. A sigmoid turns as the joint is found to: nothing is doubted.
    """
    names, dof = LINEAR.get(friction, ()), len(held)
    if friction not in LINEAR or not ("coulomb" in names or np.any(held)):
        return list(regressions)
    for _ in range(_REWEIGHTINGS):
        fit = least_squares(regressions, everything(regressions), "joint")
        own = fit.x[base.rank :].reshape(dof, -1)
        found = own[:, names.index("coulomb")] if "coulomb" in names else np.zeros(dof)
        regressions = [r.doubted(held + found, fit.sigma) for r in regressions]
    return list(regressions)


@dataclasses.dataclass(frozen=True)
class Fit:
    """A solution of a regression."""

    x: Float[np.ndarray, " columns"]
    """Base parameters, then friction."""
    sigma: Float[np.ndarray, " dof"]
    """Residual that each joint was weighted by [N m]; ones without weighting."""
    phi: Float[np.ndarray, "dof 10"] | None = None
    """Link parameters behind it, where the fit goes by them."""


# The products are small: on a busy machine BLAS's threads would wait for each other.
@threadpool_limits.wrap(limits=1, user_api="blas")
def least_squares(regressions: Sequence[Regression], masks: Masks, weighting: str) -> Fit:
    r"""$\min_x \sum_j \lVert y_j - A_j x\rVert^2 / \sigma_j^2$.

    With the weighting `joint`, $\sigma_j$ is joint j's rms residual in the fit before; with `none` it is one.
    """
    return weighted_fit(triangles(regressions, masks), sum(int(mask.sum()) for mask in masks), weighting)


def weighted_fit(R: Float[np.ndarray, "dof rows columns"], samples: int, weighting: str) -> Fit:
    """`least_squares` from the joints' triangles of so many samples."""
    least = _LEAST_SIGMA * np.linalg.norm(R[:, :, -1]) / np.sqrt(R.shape[0] * samples) + np.finfo(float).tiny
    sigma = np.ones(len(R))
    x = weighted_solution(R, sigma)
    for _ in range(_REWEIGHTINGS if weighting == "joint" else 0):
        residual = R @ np.append(-x, 1.0)
        sigma = np.maximum(np.linalg.norm(residual, axis=1) / np.sqrt(samples), least)
        x = weighted_solution(R, sigma)
    return Fit(x, sigma)


def weighted_solution(
    R: Float[np.ndarray, "dof rows columns"], sigma: Float[np.ndarray, " dof"]
) -> Float[np.ndarray, " unknowns"]:
    """Weighted least squares from the joints' triangles; zero along directions without information."""
    rows = np.concatenate(R / sigma[:, None, None])
    norms = np.linalg.norm(rows[:, :-1], axis=0)
    scale = np.where(norms > 0, norms, 1.0)
    return np.linalg.lstsq(rows[:, :-1] / scale, rows[:, -1], rcond=UNDETERMINED)[0] / scale
