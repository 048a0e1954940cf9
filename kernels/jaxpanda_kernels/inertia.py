r"""Inertial parameters of one rigid body, and the maps between their forms.

`phi`, the ten standard inertial parameters, is ordered here and nowhere else:

    m, mx, my, mz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz

$m$ [kg]; $(mx, my, mz) = m c$ the first moment [kg m]; $I$ the inertia tensor about the *origin of the
link's frame*, along its axes, with signed tensor entries ($I_{xy} = -\int xy\,dm$) [kg m²].
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Where each of Ixx, Ixy, Iyy, Ixz, Iyz, Izz stands in the symmetric 3x3 matrix.
_ROW = np.array([0, 0, 1, 0, 1, 2])
_COLUMN = np.array([0, 1, 1, 2, 2, 2])


def skew(v: Float[Array, "3"]) -> Float[Array, "3 3"]:
    r"""$[v]_\times$, so that $[v]_\times u = v \times u$."""
    zero = jnp.zeros_like(v[0])
    return jnp.array([[zero, -v[2], v[1]], [v[2], zero, -v[0]], [-v[1], v[0], zero]])


def symmetric(six: Float[Array, "6"]) -> Float[Array, "3 3"]:
    """The symmetric matrix with entries xx, xy, yy, xz, yz, zz."""
    xx, xy, yy, xz, yz, zz = six
    return jnp.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def six(matrix: Float[Array, "3 3"]) -> Float[Array, "6"]:
    """The entries xx, xy, yy, xz, yz, zz of a symmetric matrix."""
    return matrix[_ROW, _COLUMN]


def from_com(
    mass: Float[Array, ""], com: Float[Array, "3"], I_com: Float[Array, "3 3"]
) -> Float[Array, "10"]:
    r"""`phi` of a body given about its centre of mass: $I = I_c + m(c^\top c\,1 - cc^\top)$.

    `com` in the link's frame [m]; `I_com` about the centre of mass, along the link's axes [kg m²].
    """
    c = skew(com)
    return jnp.concatenate([mass[None], mass * com, six(I_com - mass * (c @ c))])


def to_com(phi: Float[Array, "10"]) -> tuple[Float[Array, ""], Float[Array, "3"], Float[Array, "3 3"]]:
    """Mass, centre of mass and inertia about it; the inverse of `from_com`.

    A body without mass has no centre of mass: its first moment is returned divided by one.
    """
    mass = phi[0]
    com = phi[1:4] / jnp.where(mass == 0, jnp.ones_like(mass), mass)
    c = skew(com)
    return mass, com, symmetric(phi[4:]) + mass * (c @ c)


def second_moment(I: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    r"""$\Sigma = \int xx^\top dm = \tfrac12 \mathrm{tr}(I)\,1 - I$."""
    return 0.5 * jnp.trace(I) * jnp.eye(3, dtype=I.dtype) - I


def inertia(Sigma: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    r"""$I = \mathrm{tr}(\Sigma)\,1 - \Sigma$; the inverse of `second_moment`."""
    return jnp.trace(Sigma) * jnp.eye(3, dtype=Sigma.dtype) - Sigma


def pseudo_inertia(phi: Float[Array, "10"]) -> Float[Array, "4 4"]:
    r"""$J = \begin{bmatrix}\Sigma & mc\\ (mc)^\top & m\end{bmatrix}$, linear in `phi`.

    A body with positive density has $J \succ 0$, and every $J \succ 0$ is such a body's: this one
    matrix inequality holds positive mass, positive inertia and the triangle inequality.

    References:
        Wensing, Kim, Slotine, "Linear Matrix Inequalities for Physically-Consistent Inertial
        Parameter Identification", RA-L 2018.
    """
    Sigma = second_moment(symmetric(phi[4:]))
    h = phi[1:4]
    return jnp.block([[Sigma, h[:, None]], [h[None, :], phi[:1, None]]])


def from_pseudo_inertia(J: Float[Array, "4 4"]) -> Float[Array, "10"]:
    """`phi` of the body with pseudo-inertia `J`."""
    return jnp.concatenate([J[3:, 3], J[:3, 3], six(inertia(J[:3, :3]))])


def triangle_margin(phi: Float[Array, "10"]) -> Float[Array, ""]:
    r"""$\tfrac12 \mathrm{tr}(I_c) - \lambda_{\max}(I_c)$ [kg m²]: not negative for a real body.

    Half of what the smaller two principal moments exceed the largest by (Gaz et al. 2019, eq. 27).
    """
    _, _, I_com = to_com(phi)
    return jnp.linalg.eigvalsh(second_moment(I_com))[0]


def move(phi: Float[Array, "10"], R_ab: Float[Array, "3 3"], p_ab: Float[Array, "3"]) -> Float[Array, "10"]:
    """`phi` of the same body in frame a, given it in frame b, whose pose in a is (`R_ab`, `p_ab`)."""
    X = jnp.block([[R_ab, p_ab[:, None]], [jnp.zeros((1, 3), phi.dtype), jnp.ones((1, 1), phi.dtype)]])
    return from_pseudo_inertia(X @ pseudo_inertia(phi) @ X.T)


def from_log_cholesky(eta: Float[Array, "10"]) -> Float[Array, "10"]:
    r"""`phi` of the body with log-Cholesky coordinates `eta`; every real `eta` gives a real body.

    $$J(\eta) = U U^\top, \qquad
      U = e^{\alpha}\begin{bmatrix}
        e^{d_1} & s_{12} & s_{13} & t_1 \\ 0 & e^{d_2} & s_{23} & t_2 \\
        0 & 0 & e^{d_3} & t_3 \\ 0 & 0 & 0 & 1\end{bmatrix}$$

    Bodies on the boundary (a flat plate, a rod) lie at infinity, so optimisers crawl towards them.

    Args:
        eta: $(\alpha, d_1, d_2, d_3, s_{12}, s_{23}, s_{13}, t_1, t_2, t_3)$; $\alpha$ is half the log
            of the mass in [kg], $t$ the centre of mass in [m], the rest second moments in [m].

    References:
        Rucker and Wensing, "Smooth Parameterization of Rigid-Body Inertia", RA-L 2022.
    """
    alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3 = eta
    zero, one = jnp.zeros_like(alpha), jnp.ones_like(alpha)
    U = jnp.exp(alpha) * jnp.array(
        [
            [jnp.exp(d1), s12, s13, t1],
            [zero, jnp.exp(d2), s23, t2],
            [zero, zero, jnp.exp(d3), t3],
            [zero, zero, zero, one],
        ]
    )
    return from_pseudo_inertia(U @ U.T)


def to_log_cholesky(phi: Float[Array, "10"]) -> Float[Array, "10"]:
    """Log-Cholesky coordinates of a real body; not a number where `phi` is none."""
    flip = np.array([3, 2, 1, 0])
    J = pseudo_inertia(phi)
    U = jnp.linalg.cholesky(J[flip][:, flip])[flip][:, flip]
    V = U / U[3, 3]
    return jnp.stack(
        [
            jnp.log(U[3, 3]),
            jnp.log(V[0, 0]),
            jnp.log(V[1, 1]),
            jnp.log(V[2, 2]),
            V[0, 1],
            V[1, 2],
            V[0, 2],
            V[0, 3],
            V[1, 3],
            V[2, 3],
        ]
    )
