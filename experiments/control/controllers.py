"""Three controllers of one form, u = feed-forward + K(t) (desired - measured state), from a `Corrected` arm.

Copy what you need: `motion` is (q, qd, qdd) of your own trajectory, each [time, dof], and `corrected` what
`jaxpanda.Corrected.load("why")` reads from a folder that `diagnose` wrote. In: units of SI, radians.
"""

import functools

import jax
import jax.numpy as jnp


def feed_forward(corrected, motion):
    """Torque that the motion takes, friction and all that was found included [time, dof]."""
    return jax.jit(jax.vmap(corrected.inverse_dynamics))(*motion)


def masses(corrected, q):
    """Mass matrix with rotors [time, dof, dof]: how torque changes with acceleration."""
    rest = jnp.zeros(q.shape[-1])
    return jax.jit(jax.vmap(jax.jacfwd(lambda a, q: corrected.inverse_dynamics(q, rest, a)), (None, 0)))(
        rest, q
    )


def computed_torque(corrected, motion, bandwidth=5.0):
    """Feedback as an acceleration, critically damped at `bandwidth` [Hz]: K of [time, dof, 2 dof]."""
    M, w = masses(corrected, motion[0]), 2 * jnp.pi * bandwidth
    return jnp.concatenate([w**2 * M, 2 * w * M], -1)


def linearised(corrected, motion, tau, dt):
    """A, B of the state (q, qd) about the motion; implicit in damping, so that friction is stable."""

    def one(q, qd, u):
        f_q, f_v, f_u = jax.jacfwd(corrected.forward_dynamics, (0, 1, 2))(q, qd, u)
        one, zero = jnp.eye(len(q)), jnp.zeros((len(q), len(q)))
        velocity = jnp.linalg.solve(one - dt * f_v, jnp.concatenate([dt * f_q, one, dt * f_u], 1))
        position = jnp.concatenate([one, zero, zero], 1) + dt * velocity
        return jnp.split(jnp.concatenate([position, velocity]), [2 * len(q)], axis=1)

    return jax.jit(jax.vmap(one))(motion[0], motion[1], tau)


def lqr(corrected, motion, tau, dt, state_scale, torque_scale):
    """Time-varying linear-quadratic regulator about the motion, by the Riccati recursion backwards."""
    Q, R = jnp.diag(state_scale**-2), jnp.diag(torque_scale**-2)

    def step(P, AB):
        A, B = AB
        K = jnp.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        return Q + A.T @ P @ (A - B @ K), K

    return jax.lax.scan(step, Q, linearised(corrected, motion, tau, dt), reverse=True)[1]


def tuned(corrected, motion, tau, dt, first, disturbance, torque_scale, knots=3, iterations=20):
    """Gains of `first` times a schedule, tuned by the gradient of roll-outs through the forward dynamics.

    The arm starts off the motion, and a torque that nobody models pushes it: rows of `disturbance` [case, 3 dof]
    are position, velocity and torque. What counts is the tracking error, and the feedback's torque beside
    `torque_scale`.
    """
    plant, dof = corrected.plant(), motion[0].shape[1]
    memory = corrected.start(motion[0][0], motion[1][0])
    hats = jnp.maximum(0, 1 - jnp.abs(jnp.linspace(0, knots - 1, len(tau))[:, None] - jnp.arange(knots)))

    def gains(schedule):  # (knots, 2 dof), the logarithm of a factor on position's and velocity's gain
        return first * jnp.exp(hats @ schedule)[:, None, :]

    def error(schedule, start):
        def step(state, now):
            q, qd = state
            wanted, speed, ahead, K = now
            off = jnp.concatenate([wanted - q, speed - qd])
            u = ahead + K @ off + start[2 * dof :]
            a = plant.acceleration(memory, 0.0, q, qd, u, dt, jnp.zeros(dof), implicit=True)
            qd = qd + dt * a
            return (q + dt * qd, qd), jnp.mean((off[:dof] / 0.01) ** 2) + jnp.mean(
                (K @ off / torque_scale) ** 2
            )

        begin = motion[0][0] + start[:dof], motion[1][0] + start[dof : 2 * dof]
        return jnp.mean(jax.lax.scan(step, begin, (*motion[:2], tau, gains(schedule)))[1])

    @jax.jit
    def cost(schedule):
        return jax.value_and_grad(lambda s: jnp.mean(jax.vmap(functools.partial(error, s))(disturbance)))(
            schedule
        )

    schedule, m, v, rate, history, best = jnp.zeros((knots, 2 * dof)), 0.0, 0.0, 0.1, [], None
    for k in range(1, iterations + 1):  # Adam; gains that let a roll-out run away are gone back from
        value, g = cost(schedule)
        if not (jnp.isfinite(value) and jnp.isfinite(g).all()):
            if best is None:
                raise FloatingPointError("a roll-out ran away: start from other gains or weaker disturbances")
            (_, schedule, g), rate, m, v = best, rate / 4, 0.0, 0.0
        else:
            history.append(float(value))
            best = min(best or (value, schedule, g), (value, schedule, g), key=lambda found: found[0])
        m, v = 0.9 * m + 0.1 * g, 0.99 * v + 0.01 * g**2
        schedule = schedule - rate * (m / (1 - 0.9**k)) / (jnp.sqrt(v / (1 - 0.99**k)) + 1e-9)
    return gains(best[1]), history
