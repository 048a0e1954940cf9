"""What is known of links beforehand: boxes that are points, as numbers from CAD are.

A link of which everything is known is no unknown: its columns go to the right-hand side. Masses and centres of
mass that are known are held by `newton`'s projection. A box on inertias or on the total mass that is a point has
no inside, which both solvers need: it is opened a little for them, and what they find is set to the known number
afterwards.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels import inertia
from jaxtyping import Array, Bool, Float, Int

from ..errors import InputError
from .bounds import Bounds
from .constraints import Constraint, Links
from .outcome import XYZ_COLUMN, XYZ_MATRIX, XYZ_ROW, largest_violation, limits_of

_OPENED = 1.2e-6
"""Width of what was a point, as a share of a link's largest bound on inertia or four times the total mass."""
_CLOSED = 1e-6
"""Width below which a box is a point: [kg], [m], and as a share of a link's largest bound on inertia."""


_SPHERE = np.array([0, 0, 0, 0, 1, 0, 1, 0, 0, 1.0])  # equal moments, in the order of phi


@dataclasses.dataclass(frozen=True)
class Known:
    """Which links are unknown, and which of their numbers are known."""

    bounds: Bounds
    """Of all links, as given."""
    free: Int[np.ndarray, " free"]
    """The links of which something is unknown."""
    phi: Float[np.ndarray, "dof 10"]
    """Of the others; zero where `free`."""
    points: Bool[np.ndarray, "dof 10"]
    """Which of mass, centre of mass and inertia about it are points."""

    @classmethod
    def of(cls, bounds: Bounds) -> "Known":
        size = _size(bounds)[:, None]
        boxes = np.concatenate([bounds.mass[:, None], bounds.com, bounds.inertia / size[..., None]], 1)
        points = boxes[..., 1] - boxes[..., 0] <= _CLOSED
        nothing = bounds.mass[:, 1] == 0
        whole = nothing | points.all(1)
        phi = np.zeros((bounds.dof, 10))
        for i in np.flatnonzero(whole & ~nothing):
            six = bounds.inertia[i].mean(-1)
            phi[i] = inertia.from_com(
                jnp.asarray(bounds.mass[i].mean()),
                jnp.asarray(bounds.com[i].mean(-1)),
                jnp.asarray(six[XYZ_MATRIX]),
            )
        return cls(bounds, np.flatnonzero(~whole), phi, points)

    @property
    def nothing(self) -> bool:
        """Whether no box is a point."""
        return not (bool(self.points.any()) or self._total)

    @property
    def _total(self) -> bool:
        total = self.bounds.total_mass
        return total is not None and bool(total[1] - total[0] <= _CLOSED)

    def reduced(self) -> Bounds:
        """Of the links that are unknown, with no box on inertia or the total mass that is a point."""
        bounds, free, points = self.bounds, self.free, self.points[self.free]
        total = bounds.total_mass
        if total is not None:
            total = total - np.delete(self.phi[:, 0], free).sum()
            total = _open(total, np.asarray(self._total), max(1.0, 4 * float(total[1])))
        unit = _size(bounds)[free]
        return Bounds(
            mass=bounds.mass[free],
            com=bounds.com[free],
            inertia=_open(bounds.inertia[free], points[:, 4:], unit[:, None]),
            total_mass=total,
        )

    def filled(self, phi: Float[np.ndarray, "*starts free 10"]) -> Float[np.ndarray, "*starts dof 10"]:
        """The unknown links with the known ones between them."""
        found = np.broadcast_to(self.phi, (*phi.shape[:-2], *self.phi.shape)).copy()
        found[..., self.free, :] = phi
        return found

    def constraint(self, one: Constraint) -> Constraint:
        """The same of the links that are unknown, with their known numbers as they are known."""
        whole, free = jnp.asarray(self.phi), jnp.asarray(self.free)
        settle = partial(_settled, self.bounds, self.points, self.free, self.phi)
        return lambda links: one(Links.from_phi(whole.at[free].set(settle(links.phi))))

    def carried(self, given: Float[np.ndarray, "dof 10"] | None) -> Float[np.ndarray, "free 10"] | None:
        """What the unknown links carry, a little more of it: known numbers that are set must not take it away."""
        points = self.points[self.free]
        carried = np.zeros((len(self.free), 10)) if given is None else given[self.free].copy()
        some = points[:, 4:].any(1) & (carried.any(1) | ~points[:, 4:].all(1))
        if given is None and not some.any():
            return None
        carried[some] += 2 * _OPENED * _size(self.bounds)[self.free][some, None] * _SPHERE
        return carried

    def settled(
        self, phi: Float[np.ndarray, "starts free 10"], constraints: Sequence[Constraint]
    ) -> tuple[Float[np.ndarray, "starts dof 10"], Float[np.ndarray, " starts"]]:
        """All links of every start, known numbers as they are known, and by how much anything is missed."""
        if not len(self.free):
            settle = lambda phi: phi
        else:
            settle = jax.jit(jax.vmap(partial(_settled, self.bounds, self.points, self.free, self.phi)))
        found = self.filled(np.asarray(settle(jnp.asarray(phi))))
        limits = limits_of(self.bounds, tuple(constraints))
        return found, np.asarray(jax.jit(jax.vmap(partial(largest_violation, limits)))(jnp.asarray(found)))


def _size(bounds: Bounds) -> Float[np.ndarray, " dof"]:
    """Largest bound on each link's inertia [kg m²]; one where it has none."""
    largest = np.max(np.where(np.isfinite(bounds.inertia), np.abs(bounds.inertia), 0.0), (1, 2))
    return np.where(largest > 0, largest, 1.0)


def _open(box: np.ndarray, points: np.ndarray, unit: float | np.ndarray) -> np.ndarray:
    """Boxes that are points, a little wider."""
    middle, half = box.mean(-1), 0.5 * _OPENED * np.broadcast_to(unit, points.shape)
    with np.errstate(invalid="ignore"):  # a box without ends has no middle
        opened = np.stack([middle - half, middle + half], -1)
    return np.where(points[..., None], opened, box)


def _settled(
    bounds: Bounds,
    points: np.ndarray,
    free: np.ndarray,
    whole: Float[np.ndarray, "dof 10"],
    phi: Float[Array, "free 10"],
) -> Float[Array, "free 10"]:
    """Known numbers set; a known total mass is met by the link whose mass is farthest from its bounds."""
    mass, com, I_com = jax.vmap(inertia.to_com)(phi)
    set_to = lambda value, box, known: jnp.where(known, jnp.clip(value, box[..., 0], box[..., 1]), value)
    known = points[free]
    six = set_to(I_com[:, XYZ_ROW, XYZ_COLUMN], bounds.inertia[free], known[:, 4:])
    set_mass = set_to(mass, bounds.mass[free], known[:, 0])
    total = bounds.total_mass
    if total is not None and total[1] - total[0] <= _CLOSED and not known[:, 0].all():
        slack = jnp.where(known[:, 0], -jnp.inf, jnp.min(jnp.abs(set_mass[:, None] - bounds.mass[free]), 1))
        others = np.delete(whole[:, 0], free).sum()
        set_mass = set_mass.at[jnp.argmax(slack)].add(total.mean() - others - jnp.sum(set_mass))
    settled = jax.vmap(inertia.from_com)(
        set_mass,
        set_to(com, bounds.com[free], known[:, 1:4]),
        six[:, XYZ_MATRIX],
    )
    moved = known.any(1) | (set_mass != mass)
    return jnp.where(moved[:, None], settled, phi)


def require_numbers(constraints: Sequence[Callable], bounds: Bounds) -> None:
    """Refuse a constraint that is no number at links inside the bounds.

    Raises:
        InputError: naming the constraint.
    """
    rng = np.random.default_rng(0)
    for share in (np.full(4, 0.5), *rng.uniform(0.1, 0.9, (3, 4))):
        between = lambda box, at: box[..., 0] + (box[..., 1] - box[..., 0]) * at
        mass, com = between(bounds.mass, share[0]), between(bounds.com, share[1:])
        radius = 0.3 * np.linalg.norm(bounds.com[..., 1] - bounds.com[..., 0], axis=-1) + 0.01
        I_com = np.einsum("l,ij->lij", mass * radius**2, np.diag([1.0, 0.9, 0.8]))
        links = Links(jnp.asarray(mass), jnp.asarray(com), jnp.asarray(I_com))
        for i, constraint in enumerate(constraints):
            if np.any(np.isnan(np.asarray(constraint(links)))):
                name = getattr(constraint, "__name__", "")
                called = f" ({name})" if name and name != "<lambda>" else ""
                raise InputError(
                    f"constraint {i}{called}: its margin is not a number at links inside the bounds; jnp.where"
                    " with a safe argument on the branch that is not taken keeps it one"
                )
