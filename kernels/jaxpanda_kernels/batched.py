r"""The dynamics of one given arm for many samples at once: the functions of `dynamics`, on any leading shape.

Same names and results as `vmap` of the plain definitions, faster by what `kernels/benchmarks/rnea.py` prints.
The price: the chain's geometry is compiled in, so that it must be a constant, and each arm compiles anew.
For a single sample, and for a chain that is itself traced or differentiated in, take `dynamics`.

Inertial parameters are arguments like any other. All of it can be differentiated and mapped.
"""

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from . import columns
from .chain import Chain
from .columns import Columns, Entry, Geometry, specialise
from .scalars import Scalar
from .staging import alone


def _geometry(chain: Chain | Geometry, *states: Float[Array, "*samples dof"]) -> Geometry:
    arm = chain if isinstance(chain, Geometry) else specialise(chain)
    for x in states:
        if x.shape != states[0].shape or x.shape[-1] != arm.dof:
            expected = ("...", arm.dof)
            raise ValueError(f"states must all have one shape {expected}; got {[x.shape for x in states]}")
    return arm


def _columns(x: Float[Array, "*samples dof"]) -> list[Float[Array, " filled"]]:
    """An array for each joint, filled up with samples at rest to a number that XLA compiles well.

    On CPUs it vectorises over samples only as far as their number can be divided: an odd one costs a factor of
    two to four. On GPUs that makes each thread compute four samples, or two; kernels as long as these then run
    out of registers, in float64 at half the speed: there the number is made odd.
    """

    def transposed(x):
        rows = x.reshape(-1, x.shape[-1])
        count = rows.shape[0]
        missing = -count % 8 if jax.default_backend() == "cpu" else 1 - count % 2
        return jnp.pad(rows, ((0, missing), (0, 0))).T

    return list(alone(transposed, x))


def _samples(columns: Sequence[Float[Array, " filled"]], shape: tuple[int, ...]) -> Array:
    """Columns side by side, less what `_columns` filled in, as the last axes of an array of `shape`."""
    count = math.prod(shape) // len(columns)
    return jnp.stack([c[:count] for c in columns], -1).reshape(shape)


def _bodies(arm: Geometry, phi: Float[Array, "dof 10"], like: Float[Array, "..."]) -> list[list[Scalar]]:
    """Bodies that take the same torques, with floats for the zeros among their parameters."""
    T = columns.regrouping(arm)
    regrouped = jnp.matmul(T, phi.reshape(-1), precision=lax.Precision.HIGHEST).astype(like.dtype)
    numbers = [value if row.any() else 0.0 for value, row in zip(regrouped, T, strict=True)]
    return [numbers[i : i + 10] for i in range(0, len(numbers), 10)]


def rnea(
    chain: Chain | Geometry,
    phi: Float[Array, "dof 10"],
    q: Float[Array, "*samples dof"],
    qd: Float[Array, "*samples dof"],
    qdd: Float[Array, "*samples dof"],
) -> Float[Array, "*samples dof"]:
    """Joint torques [N m; N where the joint slides]; `dynamics.rnea` for every sample.

    Args:
        chain: the arm, or what `specialise` made of it (which saves some 0.1 ms a call).
        phi: inertial parameters, as in `inertia`.
        q: positions [rad or m].
        qd: velocities.
        qdd: accelerations.

    Raises:
        ValueError: the states differ in shape or do not have a column a joint.
    """
    return _rnea(_geometry(chain, q, qd, qdd), phi, q, qd, qdd)


@functools.partial(jax.jit, static_argnums=0)
def _rnea(arm: Geometry, phi, q, qd, qdd):
    kernel = functools.partial(columns.rnea, arm)
    return _samples(alone(kernel, _bodies(arm, phi, q), *map(_columns, (q, qd, qdd))), q.shape)


def entries(
    chain: Chain | Geometry, q: Columns, qd: Columns, qdd: Columns
) -> dict[Entry, Float[Array, "*samples"]]:
    """Entries of the regressor that are not zero for every motion, a column of samples each.

    As `columns.regressor`, in programs that compile and run well: on a CPU one, joints, motions and rows
    after each other; on a GPU several (outside `jit`), each of a few entries, from the states. Choose the
    number of samples as `_columns` does: a multiple of 8 on a CPU, odd on a GPU.

    Args:
        chain: the arm, or what `specialise` made of it.
        q: positions [rad or m], one column a joint.
        qd: velocities.
        qdd: accelerations.
    """
    arm = _geometry(chain)
    states = list(q), list(qd), list(qdd)
    if jax.default_backend() == "cpu":
        return _staged(arm, *states)
    every = [_some(arm, group, *states) for group in _groups(arm)]
    return {entry: column for group in every for entry, column in group.items()}


@functools.partial(jax.jit, static_argnums=0)
def _staged(arm: Geometry, q, qd, qdd):
    outward = alone(functools.partial(columns.joints, arm), q)
    moving = alone(functools.partial(columns.motions, arm), outward, qd, qdd)
    return alone(lambda o, m: columns.rows(arm, o, m, range(arm.dof), q[0]), outward, moving)


@functools.cache
def _groups(arm: Geometry) -> tuple[tuple[Entry, ...], ...]:
    """Entries in groups small enough for a GPU's registers, neighbours of one link together."""
    state = [jax.ShapeDtypeStruct((), jnp.float32)] * arm.dof
    found = jax.eval_shape(functools.partial(columns.regressor, arm), state, state, state)
    by_link = sorted(found, key=lambda entry: (entry[1], entry))
    size = math.ceil(len(by_link) / math.ceil(len(by_link) / 51))
    return tuple(tuple(by_link[i : i + size]) for i in range(0, len(by_link), size))


@functools.partial(jax.jit, static_argnums=(0, 1))
def _some(arm: Geometry, group: tuple[Entry, ...], q, qd, qdd):
    def chosen(q, qd, qdd):
        Y = columns.regressor(arm, q, qd, qdd)
        return {entry: Y[entry] for entry in group}

    return alone(chosen, q, qd, qdd)


def regressor(
    chain: Chain | Geometry,
    q: Float[Array, "*samples dof"],
    qd: Float[Array, "*samples dof"],
    qdd: Float[Array, "*samples dof"],
) -> Float[Array, "*samples dof dof 10"]:
    """`dynamics.regressor` for every sample, its many zeros filled in.

    Filling in and transposing cost more than the arithmetic: where a normal matrix will do take `gram`, and
    where single entries will, `entries`.

    Raises:
        ValueError: the states differ in shape or do not have a column a joint.
    """
    return _regressor(_geometry(chain, q, qd, qdd), q, qd, qdd)


@functools.partial(jax.jit, static_argnums=0)
def _regressor(arm: Geometry, q, qd, qdd):
    Y = entries(arm, *map(_columns, (q, qd, qdd)))
    zero = jnp.zeros_like(next(iter(Y.values())))
    every = [Y.get((i, l, k), zero) for i in range(arm.dof) for l in range(arm.dof) for k in range(10)]
    return _samples(every, (*q.shape, arm.dof, 10))


def mass_matrix(
    chain: Chain | Geometry, phi: Float[Array, "dof 10"], q: Float[Array, "*samples dof"]
) -> Float[Array, "*samples dof dof"]:
    """$M(q)$ [kg m²]; `dynamics.mass_matrix` for every sample.

    Raises:
        ValueError: `q` does not have a column a joint.
    """
    return _mass_matrix(_geometry(chain, q), phi, q)


@functools.partial(jax.jit, static_argnums=0)
def _mass_matrix(arm: Geometry, phi, q):
    M = alone(functools.partial(columns.mass_matrix, arm), _bodies(arm, phi, q), _columns(q))
    every = [M[min(i, j), max(i, j)] for i in range(arm.dof) for j in range(arm.dof)]
    return _samples(every, (*q.shape, arm.dof))


def forward_dynamics(
    chain: Chain | Geometry,
    phi: Float[Array, "dof 10"],
    q: Float[Array, "*samples dof"],
    qd: Float[Array, "*samples dof"],
    tau: Float[Array, "*samples dof"],
    armature: Float[Array, " dof"],
) -> Float[Array, "*samples dof"]:
    r"""$\ddot q$ [rad/s²] under torques `tau` [N m]; `dynamics.forward_dynamics` for every sample.

    Raises:
        ValueError: the states differ in shape or do not have a column a joint.
    """
    return _forward_dynamics(_geometry(chain, q, qd, tau), phi, q, qd, tau, armature)


@functools.partial(jax.jit, static_argnums=0)
def _forward_dynamics(arm: Geometry, phi, q, qd, tau, armature):
    bodies = _bodies(arm, phi, q)
    rotors = list(armature.astype(q.dtype))
    angles, speeds, torques = map(_columns, (q, qd, tau))
    M = alone(functools.partial(columns.mass_matrix, arm), bodies, angles)
    h = alone(lambda b, x, v: columns.rnea(arm, b, x, v, [0.0] * arm.dof), bodies, angles, speeds)

    def accelerations(M, h, torques, rotors):
        M = M | {(i, i): M[i, i] + rotor for i, rotor in enumerate(rotors)}
        return columns.solve(M, [t - bias for t, bias in zip(torques, h, strict=True)])

    return _samples(alone(accelerations, M, h, torques, rotors), q.shape)


class NormalEquations(NamedTuple):
    r"""What weighted least squares on $\tau = Y\phi$ needs of samples; parameter k of link l is 10 l + k."""

    matrix: Float[Array, "parameters parameters"]
    r"""$\sum Y^\top w\,Y$."""
    vector: Float[Array, " parameters"]
    r"""$\sum Y^\top w\,\tau$."""
    energy: Float[Array, ""]
    r"""$\sum \tau^\top w\,\tau$."""


def gram(
    chain: Chain | Geometry,
    q: Float[Array, "*samples dof"],
    qd: Float[Array, "*samples dof"],
    qdd: Float[Array, "*samples dof"],
    weights: Float[Array, "*#samples dof"],
    tau: Float[Array, "*samples dof"],
    chunk: int = 4096,
) -> NormalEquations:
    """Normal equations of all samples, without ever holding more than `chunk` samples' regressor.

    Forming them squares the condition number: they carry half the digits, enough for a well-excited fit in
    float64, not for deciding a rank.

    Args:
        chain: the arm, or what `specialise` made of it.
        q: positions [rad or m].
        qd: velocities.
        qdd: accelerations.
        weights: of each squared residual, a joint or a joint and sample [1/(N m)²].
        tau: measured torques [N m].
        chunk: samples at a time; the answer depends on it by rounding alone.

    Raises:
        ValueError: the states differ in shape or do not have a column a joint.
    """
    arm = _geometry(chain, q, qd, qdd, tau)
    return _gram(arm, chunk, q, qd, qdd, jnp.broadcast_to(weights.astype(q.dtype), q.shape), tau)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _gram(arm: Geometry, chunk: int, *samples):
    dof, count = arm.dof, samples[0].size // arm.dof
    chunk = max(1, min(chunk, count))
    missing = -count % chunk  # filled up with samples at rest, of weight zero

    def split(x: Array) -> Array:
        filled = jnp.pad(x.reshape(count, dof), ((0, missing), (0, 0)))
        return filled.reshape(-1, chunk, dof).swapaxes(1, 2)

    kept = sorted(entry for group in _groups(arm) for entry in group)
    unknowns = [[(l, k) for row, l, k in kept if row == i] for i in range(dof)]

    def accumulate(sums, part):
        q, qd, qdd, weight, tau = part
        Y = entries(arm, q, qd, qdd)

        def products(Y, weight, tau):
            W = [jnp.stack([*(Y[i, l, k] for l, k in unknowns[i]), tau[i]]) for i in range(dof)]
            return [
                jnp.matmul(w * v, w.T, precision=lax.Precision.HIGHEST)
                for w, v in zip(W, weight, strict=True)
            ]

        return [s + g for s, g in zip(sums, alone(products, Y, weight, tau), strict=True)], None

    sizes = [len(u) + 1 for u in unknowns]
    empty = [jnp.zeros((n, n), samples[0].dtype) for n in sizes]
    sums, _ = lax.scan(accumulate, empty, tuple(split(x) for x in samples))
    total = jnp.zeros((10 * dof + 1, 10 * dof + 1), samples[0].dtype)
    for i, s in enumerate(sums):
        where = np.array([10 * l + k for l, k in unknowns[i]] + [10 * dof])
        total = total.at[where[:, None], where[None, :]].add(s)
    return NormalEquations(total[:-1, :-1], total[:-1, -1], total[-1, -1])
