r"""The periodic motion that tells most about an arm's base parameters and friction, within its limits.

$$\min_x\; f(x) \quad\text{with}\quad g(x) \le 0$$

x are the Fourier coefficients of a motion that starts and ends at rest (`Fourier`), g what the limits and the
clearance leave at samples, and f the mean logarithm of the parameters' standard deviations

$$f = -\frac{1}{2n}\log\det\Big(\Lambda_0 + \nu\sum_k A_k^\top \Sigma^{-1} A_k\Big)$$

(D-optimality) or the logarithm of the condition number of the same information. $A_k$ are the rows of base
parameters and friction at sample k, Σ the torque noise, ν how many independent samples a sample stands for,
$\Lambda_0$ what earlier recordings know. Inequalities by the augmented Lagrangian (Rockafellar 1973), inside
of it L-BFGS with exact gradients, all starts in one `vmap`.

References:
    Swevers et al., "Optimal robot excitation and identification", IEEE T-RA 1997;
    Nocedal and Wright, Numerical Optimization, 2nd ed., ch. 17.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import scipy.linalg
from jaxpanda_kernels import Chain, regressor
from jaxtyping import Array, Float

from ..arms.arm import Arm
from ..friction import LINEAR, columns
from ..parameters import Base
from ..simulation import FourierTrajectory
from ..workspace.limits import Limits
from ..workspace.scene import Probes

Criterion = Literal["logdet", "condition"]
FRICTION = "coulomb_viscous_offset"
_WIDTH = 0.1
"""Speed over which dry friction turns while the motion is sought [rad/s]: a step has no gradient."""
_SAMPLES = 10
"""A period of the highest harmonic."""
_BETWEEN = 0.02
"""Share of the limits, and of 0.1 m of clearance, kept back for what happens between samples."""
_OUTER, _INNER = 5, 60
"""Multiplier updates, and L-BFGS steps in each."""
_PENALTY, _GROWTH = 10.0, 2.0
"""Weight of a squared violation at first, and its growth from update to update."""
_SOLVER = optx.LBFGS(rtol=1e-4, atol=1e-4)


@dataclasses.dataclass(frozen=True)
class Fourier:
    """Motions of one period with so many harmonics, at rest (speed and acceleration zero) where they start."""

    period: float
    """[s]"""
    harmonics: int

    @property
    def w(self) -> float:
        return 2 * np.pi / self.period

    @property
    def free(self) -> Float[np.ndarray, "coefficients free"]:
        """Orthonormal columns that span what coefficients (a, then b) of a motion from rest to rest may be."""
        l, one = np.arange(1, self.harmonics + 1), np.ones(self.harmonics)
        rest = np.array([[*one, *(0 * one)], [*(0 * one), *(l / l.max())]])  # speed, acceleration at time 0
        return scipy.linalg.null_space(rest)

    def basis(self, time: Float[np.ndarray, " time"]) -> Float[np.ndarray, "4 time free"]:
        """What a unit of each free coefficient is of position, velocity, acceleration and jerk."""
        lw = self.w * np.arange(1, self.harmonics + 1)
        s, c = np.sin(time[:, None] * lw), np.cos(time[:, None] * lw)
        orders = ((s / lw, -c / lw), (c, s), (-s * lw, c * lw), (-c * lw**2, -s * lw**2))
        return np.stack([np.concatenate(pair, 1) for pair in orders]) @ self.free

    def trajectory(
        self, x: Float[np.ndarray, "dof free"], q0: Float[np.ndarray, " dof"]
    ) -> FourierTrajectory:
        ab = np.asarray(x) @ self.free.T
        return FourierTrajectory(ab[:, : self.harmonics], ab[:, self.harmonics :], np.asarray(q0), self.w)


@dataclasses.dataclass(frozen=True)
class Task:
    """One design problem, as numbers."""

    arm: Arm
    base: Base
    limits: Limits
    """To stay within, margins taken off."""
    probes: Probes
    fourier: Fourier
    sigma: Float[np.ndarray, " dof"]
    """Torque noise [N m]."""
    independent: float
    """Independent samples that the whole motion is worth."""
    prior: Float[np.ndarray, "columns columns"]
    """Information of earlier recordings."""
    criterion: Criterion

    @property
    def beta(self) -> Float[np.ndarray, " base"]:
        return self.base.projection @ np.asarray(self.arm.standard).ravel()


def rows(
    chain: Chain, independent: Sequence[int], q: Array, qd: Array, qdd: Array
) -> Float[Array, "time dof base"]:
    """Rows of the base parameters, unweighted.

    Not by `jaxpanda_kernels.batched`: its gradient runs seven times faster, but takes a minute and 3 GB to
    compile.
    """
    Y = jax.vmap(lambda *state: regressor(chain, *state))(q, qd, qdd)
    return Y.reshape(*Y.shape[:-2], -1)[..., np.array(independent)]


def gram(Y: Float[Array, "time dof base"], F: Float[Array, "time dof own"], weight: Float[Array, " dof"]):
    r"""$\sum_k A_k^\top\,\mathrm{diag}(w)\,A_k$ with each joint's own columns beside the common ones."""
    dof, own = F.shape[1:]
    rigid = jnp.einsum("tjb,j,tjc->bc", Y, weight, Y)
    mixed = jnp.einsum("tjb,j,tjf->bjf", Y, weight, F).reshape(rigid.shape[0], dof * own)
    apart = jnp.einsum("tjf,j,tjg->jfg", F, weight, F)
    return jnp.block([[rigid, mixed], [mixed.T, jax.scipy.linalg.block_diag(*apart)]])


def friction_columns(qd: Array, width: float) -> Float[Array, "time dof own"]:
    """Of `FRICTION`, dry friction turning over `width` [rad/s]; at once where it is 0."""
    at_once = columns(FRICTION, qd)
    dry = LINEAR[FRICTION].index("coulomb")
    return at_once.at[..., dry].set(jnp.tanh(qd / width)) if width else at_once


class Problem(eqx.Module):
    """A task as arrays, so that what was compiled for one serves the next of the same shape."""

    arm: Arm
    independent: tuple[int, ...] = eqx.field(static=True)
    beta: Float[Array, " base"]
    basis: Float[Array, "4 time free"]
    middle: Float[Array, " dof"]
    half: Float[Array, " dof"]
    most: Float[Array, "4 dof"]
    """Of velocity, acceleration, jerk, torque; infinite without a limit."""
    probes: Probes
    weight: Float[Array, " dof"]
    """Of each joint's squared rows [1/(N m)²]."""
    prior: Float[Array, "columns columns"]
    criterion: Criterion = eqx.field(static=True)

    @classmethod
    def of(cls, task: Task) -> "Problem":
        limits, fourier = task.limits, task.fourier
        count = 8 * int(np.ceil(_SAMPLES * fourier.harmonics / 8))
        most = [limits.velocity, limits.acceleration, limits.jerk, limits.torque]
        return cls(
            arm=task.arm,
            independent=task.base.independent,
            beta=jnp.asarray(task.beta),
            basis=jnp.asarray(fourier.basis(np.arange(count) * fourier.period / count)),
            middle=jnp.asarray((limits.upper + limits.lower) / 2),
            half=jnp.asarray((limits.upper - limits.lower) / 2),
            most=jnp.asarray(np.stack(most)),
            probes=task.probes,
            weight=jnp.asarray(task.sigma**-2.0 * task.independent / count),
            prior=jnp.asarray(task.prior),
            criterion=task.criterion,
        )

    def evaluate(self, u: Mapping[str, Array]) -> tuple[Array, Array]:
        """f and g of one start."""
        moved = jnp.einsum("otf,jf->otj", self.basis, u["x"])
        q, qd, qdd, jerk = moved[0] + u["q0"], moved[1], moved[2], moved[3]
        Y = rows(self.arm.chain, self.independent, q, qd, qdd)
        information = self.prior + gram(Y, friction_columns(qd, _WIDTH), self.weight)
        if self.criterion == "logdet":
            f = -0.5 * jnp.linalg.slogdet(information)[1] / len(information)
        else:
            s = jnp.linalg.eigvalsh(information)
            f = 0.5 * jnp.log(s[-1] / jnp.maximum(s[0], 1e-14 * s[-1]))
        tau = Y @ self.beta + jax.vmap(self.arm.known_torque)(q, qd, qdd)
        keep = 1 - _BETWEEN
        parts = [
            jnp.abs(q - self.middle) / self.half - keep,
            jnp.abs(jnp.stack([qd, qdd, jerk, tau])) / self.most[:, None] - keep,
            (self.probes.shortfall(self.arm.chain, q) + 0.1 * _BETWEEN) / 0.1,
        ]
        return f, jnp.concatenate([part.ravel() for part in parts])


def starts(task: Task, count: int, seed: int) -> dict[str, Array]:
    """Random motions of about half what the limits allow."""
    rng, limits, fourier = np.random.default_rng(seed), task.limits, task.fourier
    dof, free = task.arm.dof, fourier.free.shape[1]
    x = rng.normal(size=(count, dof, free))
    basis = fourier.basis(np.linspace(0, fourier.period, 20 * fourier.harmonics))
    peaks = np.abs(np.einsum("otf,sjf->ostj", basis, x)).max(2)
    half = (limits.upper - limits.lower) / 2
    most = np.stack([half, limits.velocity, limits.acceleration, limits.jerk])
    scale = 0.5 * (most[:, None] / peaks).min(0)
    q0 = limits.lower + half * (1 + 0.5 * rng.uniform(-1, 1, (count, dof)))
    return {"x": jnp.asarray(x * scale[..., None]), "q0": jnp.asarray(q0)}


@dataclasses.dataclass(frozen=True)
class Found:
    """What became of every start."""

    x: dict[str, Array]
    f: Float[np.ndarray, " start"]
    violation: Float[np.ndarray, " start"]
    """Largest g; 0 and less is within limits at the samples, and `_BETWEEN` short of them."""
    evaluations: int


def solve(
    task: Task,
    first: dict[str, Array],
    *,
    outer: int = _OUTER,
    inner: int = _INNER,
    tick: Callable[[int, int], None] = lambda done, total: None,
) -> Found:
    """Minimise f with g <= 0 from every start at once."""
    problem = Problem.of(task)
    u, penalty, evaluations = first, jnp.asarray(_PENALTY), 0
    _, g = jax.eval_shape(problem.evaluate, jax.tree.map(lambda x: x[0], first))
    multipliers = jnp.zeros((len(first["q0"]), *g.shape))
    f = g = None
    for k in range(outer):
        u, f, g, multipliers, steps = _improve(problem, u, multipliers, penalty, inner)
        evaluations += int(np.max(steps))
        penalty = penalty * _GROWTH
        tick(k + 1, outer)
    assert f is not None
    assert g is not None
    return Found(u, np.asarray(f), np.asarray(g.max(1)), evaluations)


@eqx.filter_jit
def _improve(
    problem: Problem, u: dict[str, Array], multipliers: Array, penalty: float | Array, steps: int
) -> tuple[dict[str, Array], Array, Array, Array, Array]:
    """One round of the augmented Lagrangian for all starts: unknowns, f, g, multipliers and steps taken."""

    def lagrangian(u, args):
        multipliers, penalty = args
        f, g = problem.evaluate(u)
        pushed = jnp.maximum(0.0, multipliers + penalty * g)
        return f + jnp.sum(pushed**2 - multipliers**2) / (2 * penalty), (f, g)

    def one(u, multipliers):
        args = multipliers, penalty
        found = optx.minimise(lagrangian, _SOLVER, u, args, has_aux=True, max_steps=steps, throw=False)
        f, g = found.aux  # not evaluated once more: that would be a third of what XLA has to compile
        return found.value, f, g, jnp.maximum(0.0, multipliers + penalty * g), found.stats["num_steps"]

    return jax.vmap(one)(u, multipliers)
