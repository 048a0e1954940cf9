r"""Reverse engineering: base parameters from samples of M(q) and g(q).

$$\begin{bmatrix} M_{ik}(q)\\ g_i(q)\end{bmatrix} =
  \begin{bmatrix} Y_i(q, 0, e_k)|_{g=0}\\ Y_i(q, 0, 0)\end{bmatrix}\phi, \qquad i \le k$$

M is symmetric, so its upper triangle is stacked, once. Of the Panda this has rank 43, as torque itself does.

References:
    Gaz et al., RA-L 2019, Sec. III-IV.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxpanda_kernels import Chain, regressor
from jaxtyping import Array, Float

from .. import inputs
from ..arms.arm import Arm
from ..errors import InputError, require_x64
from ..parameters import base_parameters, triangle
from .result import RELIABLE, Identification, check_folds, of_model

_SYMMETRIC = 1e-6  # of the largest entry of M
_GRAVITIES = (0.98, 1.02)  # of the given gravity, between which the data's own is looked for


@dataclasses.dataclass(frozen=True)
class MassGravity:
    """Samples of an arm's mass matrix and gravity torque, of its rigid links alone."""

    name: str
    q: Float[np.ndarray, "sample dof"]
    """[rad]"""
    M: Float[np.ndarray, "_ _ _"] | None
    """[kg m²]; None where only gravity is known."""
    g: Float[np.ndarray, "_ _"] | None
    """[N m]; None where only the mass matrix is known."""

    def __post_init__(self):
        samples, dof = self.q.shape
        if self.M is None and self.g is None:
            raise InputError(f"{self.name}: holds neither M nor g; at least one is needed")
        for field, shape in (("q", (dof,)), ("M", (dof, dof)), ("g", (dof,))):
            values = getattr(self, field)
            if values is None:
                continue
            if values.shape != (samples, *shape):
                raise InputError(
                    f"{self.name}: {field} has the shape {values.shape}, where q needs {(samples, *shape)}"
                )
            if not np.all(np.isfinite(values)):
                row = int(np.argwhere(~np.isfinite(values))[0][0])
                raise InputError(f"{self.name}: {field}, sample {row + 1}, is not finite")
        if samples == 0:
            raise InputError(f"{self.name}: holds no samples")
        if self.M is not None:
            skew = np.max(np.abs(self.M - np.swapaxes(self.M, 1, 2)), axis=(1, 2))
            if np.any(skew > _SYMMETRIC * np.max(np.abs(self.M))):
                raise InputError(f"{self.name}: M, sample {int(np.argmax(skew)) + 1}, is not symmetric")


def load_mass_gravity(path: str | Path) -> MassGravity:
    """A table `.npz` with q (N, n), M (N, n, n) and g (N, n); one of M and g may be absent.

    Raises:
        InputError: no such file, no table, or numbers that are none.
    """
    path = Path(path)
    arrays = inputs.read_npz(path)
    try:
        found = {name: np.asarray(arrays[name], float) for name in ("q", "M", "g") if name in arrays}
    except (TypeError, ValueError):
        raise InputError(f"{path}: is no .npz file with numbers in q, M and g") from None
    if "q" not in found or found["q"].ndim != 2:
        raise InputError(f"{path}: needs q with one row of joint positions a sample")
    return MassGravity(path.name, found["q"], found.get("M"), found.get("g"))


def sample_mass_gravity(
    model: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], q: Float[np.ndarray, "sample dof"]
) -> MassGravity:
    """Samples of any model, given as a function of one q that returns (M, g)."""
    pairs = [model(row) for row in q]
    M, g = (np.stack([np.asarray(pair[k], float) for pair in pairs]) for k in range(2))
    return MassGravity("model", q, M, g)


def mass_gravity_from_mujoco(path: str | Path, arm: Arm, q: Float[np.ndarray, "sample dof"]) -> MassGravity:
    """Samples from a MuJoCo model, its joints found by the arm's names, any others locked where they start.

    Armature is left out: M is that of the links.

    Raises:
        InputError: no model, or none with the arm's joints.
    """
    import mujoco

    path = Path(path)
    inputs.require_regular(path)
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise InputError(f"{path}: MuJoCo does not compile it: {str(error).splitlines()[0]}") from None
    data = mujoco.MjData(model)
    ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in arm.joint_names]
    if -1 in ids:
        raise InputError(
            f"{path}: has no joint {arm.joint_names[ids.index(-1)]!r}, which the arm {arm.name} has"
        )
    places, axes = model.jnt_qposadr[ids], model.jnt_dofadr[ids]

    def at(row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        data.qpos[:] = model.qpos0
        data.qpos[places] = row
        data.qvel[:] = 0
        mujoco.mj_forward(model, data)
        M = np.empty((len(ids), len(ids)))
        for k, axis in enumerate(axes):  # mj_fullM changed its signature between versions; this did not
            column = np.zeros(model.nv)
            mujoco.mj_mulM(model, data, column, np.eye(model.nv)[axis])
            M[k] = column[axes]
        return M - np.diag(model.dof_armature[axes]), data.qfrc_bias[axes].copy()

    return dataclasses.replace(sample_mass_gravity(at, q), name=path.name)


def configurations(arm: Arm, samples: int = 500, seed: int = 0) -> Float[np.ndarray, "sample dof"]:
    """Random joint positions within the limits, for a model that can be asked anywhere."""
    reach = np.where(arm.chain.prismatic, 1.0, np.pi)
    lower = np.where(np.isfinite(arm.lower), arm.lower, -reach)
    upper = np.where(np.isfinite(arm.upper), arm.upper, reach)
    draw = np.asarray(jax.random.uniform(jax.random.key(seed), (samples, arm.dof)))
    return lower + draw * (upper - lower)


def mass_gravity_regressor(arm: Arm, samples: MassGravity) -> Float[np.ndarray, "rows standard"]:
    """Rows of all upper triangles of M, then rows of all g; those that the samples have."""
    q = jnp.asarray(samples.q)
    parts = []
    if samples.M is not None:
        rows, columns = np.triu_indices(arm.dof)
        parts.append(np.asarray(_mass_rows(arm.chain, q))[:, columns, rows])  # [sample, acceleration, joint]
    if samples.g is not None:
        parts.append(np.asarray(_gravity_rows(arm.chain, q)))
    return np.concatenate([part.reshape(-1, 10 * arm.dof) for part in parts])


@jax.jit
@partial(jax.vmap, in_axes=(None, 0))
def _mass_rows(chain: Chain, q: Float[Array, " dof"]) -> Float[Array, "dof dof dof 10"]:
    weightless = Chain(chain.R, chain.p, chain.prismatic, jnp.zeros_like(chain.gravity))
    return jax.vmap(lambda e: regressor(weightless, q, jnp.zeros_like(q), e))(jnp.eye(len(q), dtype=q.dtype))


@jax.jit
@partial(jax.vmap, in_axes=(None, 0))
def _gravity_rows(chain: Chain, q: Float[Array, " dof"]) -> Float[Array, "dof dof 10"]:
    return regressor(chain, q, jnp.zeros_like(q), jnp.zeros_like(q))


def _stacked(samples: MassGravity) -> tuple[Float[np.ndarray, " mass"], Float[np.ndarray, " gravity"]]:
    rows, columns = np.triu_indices(samples.q.shape[1])
    mass = np.empty(0) if samples.M is None else samples.M[:, rows, columns].ravel()
    return mass, np.empty(0) if samples.g is None else samples.g.ravel()


def identify_mass_gravity(
    source: MassGravity | str | Path | Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    arm: Arm,
    *,
    gravity: float | None = None,
    folds: int = 5,
) -> Identification:
    """Base parameters behind samples of M(q) and g(q), by least squares.

    Standard deviations are the textbook's, as the paper's: samples of a model have no time to be correlated
    in. Coefficients beyond 30 % are marked unreliable, the others kept as estimated with them.

    Args:
        source: samples, a table's path, or a function q -> (M, g), which is asked at random configurations.
        arm: for its geometry.
        gravity: magnitude to assume [m/s²]; the arm's own by default. `settings["preferred_gravity"]` of the
            result says which one the data fit best.
        folds: of the cross-validation over blocks of neighbouring samples. 0 leaves it out.

    Raises:
        InputError: a malformed table, or one of another arm.
    """
    require_x64("identification")
    check_folds(folds)
    samples = _as_samples(source, arm)
    if samples.q.shape[1] != arm.dof:
        raise InputError(
            f"{samples.name}: q has {samples.q.shape[1]} joints, but the arm {arm.name} has {arm.dof}"
        )
    own = float(np.linalg.norm(arm.chain.gravity))
    if gravity is not None:
        if not (np.isfinite(gravity) and gravity > 0 and own > 0):
            raise InputError(
                f"gravity: {gravity!r} m/s² cannot replace the arm's {own:g}; a positive number can"
            )
        chain = dataclasses.replace(arm.chain, gravity=arm.chain.gravity * (gravity / own))
        arm = dataclasses.replace(arm, chain=chain)

    W = mass_gravity_regressor(arm, samples)
    mass, weight = _stacked(samples)
    y = np.concatenate([mass, weight])
    base = base_parameters(W)
    A = W[:, base.independent]
    beta = np.linalg.lstsq(A, y, rcond=None)[0]
    residual = y - A @ beta
    covariance = residual @ residual / max(len(y) - base.rank, 1) * np.linalg.inv(A.T @ A)
    std = np.sqrt(np.diag(covariance))
    held_out = _cross_validate(A, y, len(samples.q), len(mass), folds) if folds else None
    settings = {"gravity": gravity or own, "samples": len(samples.q), "folds": folds}
    if len(mass) and len(weight):
        scale, error = _preferred_gravity(A, y, len(mass))
        settings |= {
            "preferred_gravity": settings["gravity"] * scale,
            "preferred_gravity_relative_error_percent": error,
        }
    return Identification(
        method="mass_gravity",
        projection=base.projection,
        beta=beta,
        reliable=std <= RELIABLE * np.abs(beta),
        expressions=tuple(base.expressions),
        std=std,
        classical_std=std,
        covariance=covariance,
        classical_covariance=covariance,
        rank=base.rank,
        condition_number=float(np.linalg.cond(A)),
        relative_error_percent=_percent(residual, y),
        rmse=_rms_of_gravity(residual, len(mass), arm.dof),
        cross_validated_rmse=None if held_out is None else _rms_of_gravity(held_out, len(mass), arm.dof),
        cross_validated_relative_error_percent=None if held_out is None else _percent(held_out, y),
        known=of_model(arm),
        arm=arm.name,
        model=arm,
        link_names=arm.link_names,
        joint_names=arm.joint_names,
        recordings=(samples.name,),
        settings=settings,
    )


def _as_samples(source, arm: Arm) -> MassGravity:
    if isinstance(source, MassGravity):
        return source
    if isinstance(source, str | Path):
        return load_mass_gravity(source)
    return sample_mass_gravity(source, configurations(arm))


def _percent(e: np.ndarray, y: np.ndarray) -> float:
    size = np.linalg.norm(y)
    return float(100 * np.linalg.norm(e) / size) if size else 0.0


def _rms_of_gravity(e: np.ndarray, mass: int, dof: int) -> np.ndarray | None:
    gravity = e[mass:].reshape(-1, dof)
    return np.sqrt(np.mean(gravity**2, axis=0)) if len(gravity) else None


def _cross_validate(A: np.ndarray, y: np.ndarray, samples: int, mass: int, folds: int) -> np.ndarray:
    """Residuals of samples left out of the fit, block by block."""
    block = np.minimum(np.arange(samples) * folds // samples, folds - 1)
    of_row = np.concatenate([np.repeat(block, mass // samples), np.repeat(block, (len(y) - mass) // samples)])
    held_out = np.empty_like(y)
    for k in range(folds):
        test = of_row == k
        held_out[test] = y[test] - A[test] @ np.linalg.lstsq(A[~test], y[~test], rcond=None)[0]
    return held_out


def _preferred_gravity(A: np.ndarray, y: np.ndarray, mass: int) -> tuple[float, float]:
    """Scale of the given gravity at which M and g agree best, and the relative error [%] there."""
    upper, lower = (
        triangle(np.column_stack([A[part], y[part]])) for part in (slice(mass), slice(mass, None))
    )

    def leftover(scale: float) -> float:
        rows = np.concatenate([upper, np.column_stack([scale * lower[:, :-1], lower[:, -1]])])
        beta = np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=None)[0]
        return float(np.linalg.norm(rows[:, -1] - rows[:, :-1] @ beta))

    found: Any = scipy.optimize.minimize_scalar(
        leftover, bounds=_GRAVITIES, method="bounded", options={"xatol": 1e-7}
    )
    return float(found.x), float(100 * found.fun / np.linalg.norm(y))
