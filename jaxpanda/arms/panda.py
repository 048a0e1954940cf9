"""The Franka Emika Panda as it was published, with its source."""

import functools
import json
from importlib import resources
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels import from_modified_dh, inertia


@functools.cache
def published() -> dict[str, Any]:
    """Tables of Gaz et al. 2019 and its supplement; `source`, `conventions` and `corrections` stand in it."""
    return json.loads(resources.files("jaxpanda").joinpath("published/gaz2019.json").read_text("utf-8"))


def published_parts() -> dict[str, Any]:
    """Fields of the `Arm` without hand: modified Denavit-Hartenberg table and retrieved parameters of Gaz et al.

    Table VIII with its misprinted c6z corrected, and Table IX. The model holds no friction.
    """
    table = published()
    dh = table["modified_dh"]
    dof = len(dh["a"])
    coms = np.array([link["com"] for link in table["retrieved_links"]])
    coms[5, 2] = table["c6z_corrected"]
    xx, yy, zz, xy, xz, yz = np.array([link["inertia"] for link in table["retrieved_links"]]).T
    I_com = np.moveaxis(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), -1, 0)
    mass = jnp.array([link["mass"] for link in table["retrieved_links"]])
    zero = jnp.zeros(dof)
    return dict(
        chain=from_modified_dh(
            jnp.array(dh["a"], float),
            jnp.deg2rad(jnp.array(dh["alpha_degrees"], float)),
            jnp.array(dh["d"], float),
            zero,
            jnp.zeros(dof, bool),
            jnp.array([0.0, 0.0, -table["gravity"]]),
        ),
        standard=jax.vmap(inertia.from_com)(mass, jnp.asarray(coms), jnp.asarray(I_com)),
        armature=zero,
        damping=zero,
        frictionloss=zero,
        stiffness=zero,
        springref=zero,
        lower=jnp.array(table["joint_limits"]["lower"]),
        upper=jnp.array(table["joint_limits"]["upper"]),
        joint_names=tuple(f"joint{i}" for i in range(1, dof + 1)),
        link_names=tuple(f"link{i}" for i in range(1, dof + 1)),
        name="panda",
    )
