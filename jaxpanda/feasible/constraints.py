"""What a link must satisfy, as plain JAX functions of all links.

A constraint takes `Links` and returns margins: an array of any shape, satisfied where it is not negative, in
units of its own. It need not be convex, and anything that JAX can differentiate once will do:

    def lighter_than_its_neighbour(links):
        return links.mass[1] - links.mass[2]
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels import inertia
from jaxtyping import Array, Bool, Float
from scipy.spatial import ConvexHull, QhullError

from ..errors import InputError


class Links(eqx.Module):
    """All links of an arm in the quantities that constraints speak of; the links' frames, SI units."""

    mass: Float[Array, " dof"]
    """[kg]"""
    com: Float[Array, "dof 3"]
    """Centre of mass [m]."""
    I_com: Float[Array, "dof 3 3"]
    """Inertia about the centre of mass [kg m²]."""

    @classmethod
    def from_phi(cls, phi: Float[Array, "dof 10"]) -> "Links":
        return cls(*jax.vmap(inertia.to_com)(phi))

    @property
    def phi(self) -> Float[Array, "dof 10"]:
        return jax.vmap(inertia.from_com)(self.mass, self.com, self.I_com)


Constraint = Callable[[Links], Array]
Points = Sequence[Any] | np.ndarray


def triangle_inequality(links: Links) -> Float[Array, " dof"]:
    r"""$\tfrac12\mathrm{tr}(I_c) - \lambda_{\max}(I_c) \ge 0$ [kg m²] of each link (Gaz et al. 2019, eq. 27).

    The solver's links satisfy it by construction; this is for checking, and for the exact penalty.
    """
    return jax.vmap(lambda I: jnp.linalg.eigvalsh(inertia.second_moment(I))[0])(links.I_com)


def total_mass(lower: float, upper: float) -> Constraint:
    """The links' masses add up to between `lower` and `upper` [kg]."""
    return lambda links: jnp.stack([jnp.sum(links.mass) - lower, upper - jnp.sum(links.mass)])


def com_in_hull(link: int, points: Points) -> Constraint:
    """The centre of mass of `link` (0-based) lies in the convex hull of `points` (link's frame [m]).

    The margins are the distances [m] to the hull's faces, inside positive.

    Raises:
        InputError: the points span no volume.
    """
    try:
        faces = ConvexHull(np.asarray(points, float)).equations
    except (QhullError, ValueError) as error:
        raise InputError(
            f"hull of link {link}: {len(points)} points span no volume; give four or more"
        ) from error
    normals, offsets = jnp.asarray(faces[:, :3]), jnp.asarray(faces[:, 3])
    return lambda links: -(normals @ links.com[link] + offsets)


def com_in_cylinder(link: int, start: Points, end: Points, radius: float) -> Constraint:
    """The centre of mass of `link` (0-based) lies in the cylinder from `start` to `end` (link's frame [m]).

    Margins: distance [m] to either cap, and to the wall as $(r^2 - d^2)/2r$, smooth on the axis and
    the distance itself to first order at the wall.
    """
    p, axis = jnp.asarray(start, float), jnp.asarray(end, float) - jnp.asarray(start, float)
    length = jnp.linalg.norm(axis)
    axis = axis / length

    def margins(links: Links) -> Float[Array, "3"]:
        v = links.com[link] - p
        along = v @ axis
        wall = (radius**2 - jnp.sum((v - along * axis) ** 2)) / (2 * radius)
        return jnp.stack([along, length - along, wall])

    return margins


def mass_in_ellipsoid(link: int, centre: Points, semi_axes: Points) -> Constraint:
    r"""All mass of `link` (0-based) could lie inside this ellipsoid along the link's axes [m].

    $m - \int (x-x_s)^\top D^{-2} (x-x_s)\,dm \ge 0$ [kg], $D$ the semi-axes: necessary for a body inside it,
    and it keeps a light link from having a heavy one's inertia.

    References:
        Wensing, Kim, Slotine, RA-L 2018, section III.
    """
    x_s, D = jnp.asarray(centre, float), jnp.asarray(semi_axes, float)

    def margin(links: Links) -> Float[Array, ""]:
        offset = links.com[link] - x_s
        Sigma = inertia.second_moment(links.I_com[link]) + links.mass[link] * jnp.outer(offset, offset)
        return links.mass[link] - jnp.sum(jnp.diagonal(Sigma) / D**2)

    return margin


def less_lumped(lumped: Float[np.ndarray, "dof 10"] | Float[Array, "dof 10"]) -> Constraint:
    """What is left of every link is a body when those that are fixed to it are taken off.

    The margins are the least eigenvalues of the pseudo-inertias of what is left [kg m², kg].
    """

    def margins(links: Links) -> Float[Array, " dof"]:
        least = jax.vmap(lambda phi: jnp.linalg.eigvalsh(inertia.pseudo_inertia(phi))[0])(links.phi - lumped)
        return jnp.where(jnp.any(lumped != 0, axis=1), least, jnp.inf)

    return margins


def when(condition: Callable[[Links], Bool[Array, ""]], constraint: Constraint) -> Constraint:
    """`constraint` wherever `condition` holds; elsewhere satisfied with an infinite margin."""
    return lambda links: jnp.where(condition(links), constraint(links), jnp.inf)
