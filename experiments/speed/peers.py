"""The published retrieval as a user would write it with other people's optimisers, one start at a time.

    minimise phi(p) = |A phi(p) - b|² over masses, centres of mass and inertias within boxes, the triangle
    inequality at every link, and the total mass within its range

Numbers come in as plain arrays; nothing of jaxpanda is used. Functions are jitted with JAX where gradients are
taken, and plain numpy where only values are (which is faster for single evaluations).
"""

import functools
import time

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import Bounds, dual_annealing, minimize

XI = 10.0 * np.arange(10)
"""Penalty coefficients of the paper's ten steps, as in the authors' code."""
ROW, COLUMN = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])  # xx yy zz xy xz yz
SYMMETRIC = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])
TRIANGLE = np.array([0, 1, 1, 2, 2, 2]), np.array([0, 0, 1, 0, 1, 2])


class Problem:
    """Columns of A: m, m c, then J about the frame's origin as xx, xy, yy, xz, yz, zz, link after link."""

    def __init__(self, A, b, boxes, total):
        self.A, self.b, self.total = A, b, total
        self.boxes = boxes  # (links, 10, 2): m, c, I about the centre of mass as xx yy zz xy xz yz
        self.links = len(boxes)

    def objective(self, m, c, I, xp=np):
        """Given mass (n,), centre of mass (n, 3) and inertia about it (n, 3, 3)."""
        squares = xp.sum(c * c, -1)[:, None, None] * np.eye(3) - c[:, :, None] * c[:, None, :]
        J = I + m[:, None, None] * squares
        six = xp.stack([J[:, i, k] for i, k in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))], 1)
        phi = xp.concatenate([m[:, None], m[:, None] * c, six], 1)
        return xp.sum((self.A @ phi.ravel() - self.b) ** 2)

    def split(self, p, xp=np):
        p = p.reshape(self.links, 10)
        return p[:, 0], p[:, 1:4], p[:, 4:][:, SYMMETRIC]

    def missed(self, m, I, xp=np):
        """First powers: the triangle inequality (half the trace less the largest moment) and the total mass."""
        triangle = 0.5 * xp.trace(I, axis1=1, axis2=2) - xp.linalg.eigvalsh(I)[:, 2]
        total = xp.sum(m)
        return (
            xp.sum(xp.maximum(0.0, -triangle))
            + xp.maximum(0.0, self.total[0] - total)
            + xp.maximum(0.0, total - self.total[1])
        )

    def penalised(self, p, xi, xp=np):
        m, c, I = self.split(p, xp)
        return self.objective(m, c, I, xp) + xi * self.missed(m, I, xp)

    def outcome(self, m, c, I):
        """(phi, largest violation)."""
        p = np.concatenate([m[:, None], c, I[:, ROW, COLUMN]], 1)
        triangle = 0.5 * np.trace(I, axis1=1, axis2=2) - np.linalg.eigvalsh(I)[:, 2]
        margins = [p - self.boxes[..., 0], self.boxes[..., 1] - p, triangle]
        margins += [m.sum() - self.total[0], self.total[1] - m.sum()]
        return float(self.objective(m, c, I)), max(0.0, -min(float(np.min(x)) for x in margins))

    def random(self, rng):
        return rng.uniform(self.boxes[..., 0], self.boxes[..., 1])


def slsqp(problem, rng):
    """scipy's SLSQP with exact gradients, on coordinates that suit it: mass, centre of mass, and the Cholesky
    factor of the second moment, in which the triangle inequality always holds.

    Inertia boxes are left out in its favour (they do not bind), and looked at afterwards.
    """
    n = problem.links
    value, lower, upper, weights = _slsqp_program(problem)
    x0 = problem.random(rng)
    radius = 0.5 * np.linalg.norm(problem.boxes[:, 1:4, 1] - problem.boxes[:, 1:4, 0], axis=-1)
    x0[:, 4:] = rng.normal(size=(n, 6)) * 0.5 * (radius * np.sqrt(x0[:, 0]))[:, None]
    inset = 1e-6 * np.array([1.0, -1.0])
    constraints = [
        {
            "type": "ineq",
            "fun": lambda x: x @ weights - problem.total[0] - inset[0],
            "jac": lambda x: weights,
        },
        {
            "type": "ineq",
            "fun": lambda x: problem.total[1] - x @ weights + inset[1],
            "jac": lambda x: -weights,
        },
    ]
    found = minimize(
        lambda x: tuple(np.asarray(part) for part in value(x)),
        x0.ravel(),
        jac=True,
        method="SLSQP",
        bounds=Bounds(lower, upper),
        constraints=constraints,
        options={"maxiter": 5000, "ftol": 1e-10},
    )
    m, c, I = (np.asarray(part) for part in _from_factor(found.x, n))
    return problem.outcome(np.clip(m, *problem.boxes[:, 0].T), c, I)


def _from_factor(x, links):
    x = x.reshape(links, 10)
    L = jnp.zeros((links, 3, 3)).at[:, TRIANGLE[0], TRIANGLE[1]].set(x[:, 4:])
    Sigma = L @ jnp.swapaxes(L, 1, 2) + 1e-8 * jnp.eye(3)
    I = jnp.trace(Sigma, axis1=1, axis2=2)[:, None, None] * jnp.eye(3) - Sigma
    return x[:, 0], x[:, 1:4], I


@functools.cache
def _slsqp_program(problem):
    def objective(x):
        return problem.objective(*_from_factor(x, problem.links), jnp)

    lower, upper = np.full((problem.links, 10), -np.inf), np.full((problem.links, 10), np.inf)
    lower[:, :4], upper[:, :4] = problem.boxes[:, :4, 0], problem.boxes[:, :4, 1]
    weights = np.zeros((problem.links, 10))
    weights[:, 0] = 1.0
    return jax.jit(jax.value_and_grad(objective)), lower.ravel(), upper.ravel(), weights.ravel()


@functools.cache
def _penalised_program(problem):
    return jax.jit(jax.value_and_grad(lambda p, xi: problem.penalised(p, xi, jnp)))


def _descend(problem, p, xi):
    value = _penalised_program(problem)
    found = minimize(
        lambda p: tuple(np.asarray(part) for part in value(p, xi)),
        p,
        jac=True,
        method="L-BFGS-B",
        bounds=Bounds(problem.boxes[..., 0].ravel(), problem.boxes[..., 1].ravel()),
    )
    return found.x


def lbfgsb(problem, rng):
    """The paper's Algorithm 1 with scipy's L-BFGS-B, with exact gradients, where the authors anneal."""
    p = problem.random(rng).ravel()
    for xi in XI:
        p = _descend(problem, p, xi)
    return problem.outcome(*problem.split(p))


def dual(problem, rng, steps=10, iterations=1000):
    """Algorithm 1 with scipy's dual annealing (its defaults; its local search gets exact gradients)."""
    p = problem.random(rng).ravel()
    boxes = problem.boxes.reshape(-1, 2)
    gradient = _penalised_program(problem)
    for xi in XI[-steps:]:
        found = dual_annealing(
            lambda p, xi=xi: float(problem.penalised(p, xi)),
            [*map(tuple, boxes)],
            maxiter=iterations,
            rng=rng,
            x0=p,
            minimizer_kwargs={
                "method": "L-BFGS-B",
                "jac": lambda p, xi=xi: np.asarray(gradient(p, xi)[1]),
                "bounds": [*map(tuple, boxes)],
            },
        )
        p = found.x
    return problem.outcome(*problem.split(p))


def annealing(problem, rng, steps=10):
    """Algorithm 1 as published: MATLAB's `simulannealbnd`, emulated from its documented defaults.

    Initial temperature 100, cooling by 0.95 to the power of the annealing parameter, steps in a uniform direction
    as long as the temperature and clipped to the box, acceptance 1 / (1 + exp(increase / T)), reannealing every
    100 acceptances (simplified: the parameter is halved), an end when the best has changed by less than 1e-6 over
    500 iterations a variable or after 3000 evaluations a variable; then a bounded descent. MATLAB was not run.
    """
    p = problem.random(rng).ravel()
    low, high = problem.boxes[..., 0].ravel(), problem.boxes[..., 1].ravel()
    for xi in XI[-steps:]:
        p = _descend(problem, _anneal(lambda p, xi=xi: problem.penalised(p, xi), p, low, high, rng), xi)
    return problem.outcome(*problem.split(p))


def _anneal(value, p, low, high, rng):
    n = len(p)
    k, accepted = 1, 0
    now = best = value(p)
    best_p, last, last_best = p, 0, best
    for evaluation in range(3000 * n):
        temperature = 100.0 * 0.95**k
        step = rng.normal(size=n)
        new = np.clip(p + temperature * step / np.linalg.norm(step), low, high)
        outside = (new <= low) | (new >= high)
        new = np.where(outside, low + (high - low) * rng.random(n), new) if outside.all() else new
        v = value(new)
        if v <= now or rng.random() < 1 / (1 + np.exp(min(700.0, (v - now) / max(temperature, 1e-300)))):
            p, now, accepted = new, v, accepted + 1
            if now < best:
                best, best_p = now, p
        k += 1
        if accepted and accepted % 100 == 0:
            k, accepted = max(1, k // 2), accepted + 1
        if evaluation - last >= 500 * n:
            if last_best - best < 1e-6:
                break
            last, last_best = evaluation, best
    return best_p


def timed(method, problem, starts, seed=0, budget=np.inf, **options):
    """Outcomes and processor seconds of each start, after a call that compiles; ends when the budget is spent."""
    _descend(problem, problem.random(np.random.default_rng(0)).ravel(), 1.0)
    if method is slsqp:
        slsqp(problem, np.random.default_rng(seed + 10_000))
    outcomes, seconds = [], []
    for start in range(starts):
        began = time.process_time()
        outcomes.append(method(problem, np.random.default_rng([seed, start]), **options))
        seconds.append(time.process_time() - began)
        if sum(seconds) > budget:
            break
    return outcomes, seconds
