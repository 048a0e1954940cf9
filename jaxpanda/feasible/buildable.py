r"""Links that meet every constraint and that nobody would build, each with its reason.

A positive inertia that keeps the triangle inequality is that of some cloud of points. Three things that such a
cloud need not be, and that a link is:

- as dense as a solid at most. Of all bodies of mass m and density up to ρ a ball has the least mean inertia,
  $\tfrac13 \mathrm{tr}\,I \ge \tfrac25 m r^2$ with $\tfrac43\pi r^3\rho = m$; and of those no longer than $D$ a
  rod of that length has about the least inertia about any one axis. With Σ the second moments about the centre
  of mass, $\det(\Sigma/m) \ge (r^2/5)^3$ (an ellipsoid has equality) and $\Sigma_3 \le m D^2/4$ give
  $I_{min} = \Sigma_1 + \Sigma_2 \ge 2\sqrt{\Sigma_1\Sigma_2} \ge 4 m\,(r^2/5)^{3/2}/D$;
- no longer than its arm. A body of diameter D lies in a ball of radius $\sqrt{3/8}\,D$ (Jung), so that its radius
  of gyration, $\sqrt{\mathrm{tr}\,\Sigma/m}$, is no larger;
- of some weight: it carries half the bearings and drives of two joints.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels import inertia
from jaxtyping import Float

from ..arms.arm import Arm

DENSEST = 8960.0
"""Density of copper [kg/m³], the densest material of which joints hold much."""
LIGHTEST = 0.003
"""Of the mass of the whole arm. The lightest link of an arm that is sold, as far as models at hand tell, has more
than twice as much: the last flange of Universal Robots' UR10e, 0.2 of 33 kg."""


def reach(arm: Arm) -> float:
    """Length of the arm from its base to its last joint, drawn out straight [m]."""
    travel = np.where(np.asarray(arm.chain.prismatic), np.asarray(arm.upper) - np.asarray(arm.lower), 0.0)
    return float(np.linalg.norm(arm.chain.p, axis=1).sum() + np.where(np.isfinite(travel), travel, 0.0).sum())


def doubts(standard: Float[np.ndarray, "dof 10"], names: Sequence[str], length: float | None) -> list[str]:
    """A sentence for each link that nobody would build.

    Args:
        standard: order and units as in `jaxpanda_kernels.inertia`.
        names: of the links.
        length: of the arm [m]; None where it is not known, which leaves out what goes by it.
    """
    mass, _, I_com = (np.asarray(x) for x in jax.vmap(inertia.to_com)(jnp.asarray(standard)))
    said, thin = [], []
    for name, m, I in zip(names, mass, I_com, strict=True):
        if m == 0:  # the link between two joints of one body
            continue
        if m < LIGHTEST * mass.sum():
            said.append(
                f"{name} weighs {_mass(m)}, {100 * m / mass.sum():.2g} % of the arm: too light for any drive"
            )
        radius = (3 * m / (4 * np.pi * DENSEST)) ** (1 / 3)
        mean, least = np.trace(I) / 3, np.linalg.eigvalsh(I)[0]
        gyration = np.sqrt(max(np.trace(I) / 2 / m, 0.0))
        if mean < 0.4 * m * radius**2:
            said.append(
                f"{name} is more compact than a ball of solid copper of its {_mass(m)}: mean inertia {mean:.2g} "
                f"kg·m², the ball's {0.4 * m * radius**2:.2g}"
            )
        elif length is not None and least < (bound := 4 * m * (radius**2 / 5) ** 1.5 / length):
            thin.append(f"{name} ({least:.1g} kg·m², where {_mass(m)} need {bound:.1g})")
        if length is not None and gyration > np.sqrt(3 / 8) * length:
            said.append(
                f"{name} would be longer than the arm ({length:.2f} m): {_mass(m)} with a mean inertia of "
                f"{mean:.2g} kg·m² need a body at least {gyration / np.sqrt(3 / 8):.2g} m long"
            )
    if thin:
        said.append(
            "thinner than a rod of solid copper as long as the arm, by their least inertia: "
            + ", ".join(thin)
        )
    return said


def _mass(kilograms: float) -> str:
    return f"{kilograms:.3g} kg" if kilograms >= 0.1 else f"{1e3 * kilograms:.2g} g"
