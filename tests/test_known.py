"""Numbers that are known beforehand, and bodies that links carry: they hold exactly, in every start."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxpanda_kernels import inertia

import jaxpanda
from jaxpanda.arms.arm import Arm
from jaxpanda.arms.source import is_panda
from jaxpanda.errors import InputError
from jaxpanda.feasible import Bounds, solve
from jaxpanda.feasible.convex import scaled_problem, starting_points
from jaxpanda.feasible.nearest import are_buildable

MASS, COM = np.array([2.0, 1.0]), np.array([[0.0, 0.02, 0.1], [0.05, 0.0, -0.03]])
I_COM = np.array([[0.03, 0.025, 0.02, 0.001, 0, -0.002], [0.01, 0.012, 0.009, 0, 0.001, 0]])
_XYZ = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])
PHI = np.asarray(jax.vmap(inertia.from_com)(*map(jnp.asarray, (MASS, COM, I_COM[:, _XYZ]))))
WIDE = Bounds(
    mass=np.array([[0.2, 5.0], [0.2, 5.0]]),
    com=np.tile([-0.3, 0.3], (2, 3, 1)),
    inertia=np.tile([[0.0, 1.0]] * 3 + [[-1.0, 1.0]] * 3, (2, 1, 1)),
    total_mass=np.array([2.0, 4.0]),
)


def equations(rows=12):
    """Some coefficients of both links, not quite those of real ones."""
    rng = np.random.default_rng(3)
    A = rng.standard_normal((rows, 20)) * np.tile([1, 5, 5, 5, *[30] * 6], 2)
    return A, A @ PHI.ravel() + 0.05 * rng.standard_normal(rows)


def with_points(names):
    """The bounds, of which those of these names are the true numbers."""
    truth = {f"m{i + 1}": MASS[i] for i in range(2)}
    truth |= {f"c{i + 1}{axis}": COM[i, k] for i in range(2) for k, axis in enumerate("xyz")}
    six = ("xx", "yy", "zz", "xy", "xz", "yz")
    truth |= {f"I{i + 1}{entry}": I_COM[i, k] for i in range(2) for k, entry in enumerate(six)}
    truth["total_mass"] = MASS.sum()
    bounds = dataclasses.replace(
        WIDE,
        mass=WIDE.mass.copy(),
        com=WIDE.com.copy(),
        inertia=WIDE.inertia.copy(),
        total_mass=np.array([2.0, 4.0]),
    )
    for name, box in bounds.boxes():  # views of the arrays
        if name in names or (name[:2] in names and name[0] != "t"):
            box[:] = truth[name]
    return bounds


KNOWN = {
    "a mass": ("m1",),
    "the total mass": ("total_mass",),
    "a centre of mass": ("c2",),
    "one coordinate": ("c1x",),
    "an inertia": ("I2",),
    "one moment": ("I1zz",),
    "a link": ("m2", "c2", "I2"),
    "all masses and the total": ("m1", "m2", "total_mass"),
}


QUICK = ("an inertia", "a link")


@pytest.fixture(scope="module")
def loose():
    """Where nothing is known, and nothing carried."""
    return solve(*equations(), WIDE, starts=4)


@pytest.mark.parametrize(
    "names",
    [
        pytest.param(names, id=case, marks=[] if case in QUICK else [pytest.mark.slow])
        for case, names in KNOWN.items()
    ],
)
def test_known_numbers_hold_exactly(names, loose):
    """A division by zero, or "nearest misses by 5.7e-19"."""
    A, b = equations()
    bounds = with_points(names)
    found = solve(A, b, bounds, starts=4)
    assert np.any(found.violation == 0)
    mass, com, I_com = (np.asarray(x) for x in jax.vmap(inertia.to_com)(found.phi[found.best]))
    got = dataclasses.replace(
        bounds,
        mass=np.stack([mass] * 2, -1),
        com=np.stack([com] * 2, -1),
        inertia=np.stack([np.stack([I[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]] for I in I_com])] * 2, -1),
        total_mass=np.full(2, mass.sum()),
    )
    for (name, (value, _)), (_, (low, high)) in zip(got.boxes(), bounds.boxes(), strict=True):
        if low == high:
            np.testing.assert_allclose(value, low, rtol=1e-12, atol=1e-14, err_msg=name)
    assert loose.objective[loose.best] <= found.objective[found.best] * (1 + 1e-4) + 1e-9


def test_everything_known_leaves_nothing_to_find():
    A, b = equations()
    found = solve(A, b, with_points(("m1", "c1", "I1", "m2", "c2", "I2")), starts=2)
    assert found.violation.max() == 0
    np.testing.assert_allclose(found.phi, np.stack([PHI, PHI]), rtol=1e-12)


@pytest.mark.slow
def test_a_link_without_mass_stays_one():
    A, b = equations()
    bounds = with_points(())
    bounds.mass[0] = 0.0
    bounds.total_mass[:] = [0.2, 5.0]
    found = solve(A, b, Bounds(bounds.mass, bounds.com, bounds.inertia, bounds.total_mass), starts=2)
    assert found.violation[found.best] == 0
    assert not np.any(found.phi[:, 0])


def test_a_constraint_that_is_no_number_is_named():
    def heavier_than_its_root(links):
        return jnp.sqrt(links.mass[0] - 100.0)

    with pytest.raises(
        InputError, match=r"constraint 1 \(heavier_than_its_root\): its margin is not a number"
    ):
        solve(*equations(), WIDE, constraints=[lambda links: links.mass, heavier_than_its_root], starts=2)


# Bodies that links carry

CARRIED = np.zeros((2, 10))
CARRIED[1] = inertia.from_com(jnp.asarray(0.8), jnp.array([0.02, 0.01, 0.05]), 0.004 * jnp.eye(3))


@pytest.mark.slow
def test_what_is_left_of_a_link_is_a_body_in_every_start(loose):
    """Export was refused once the gripper was taken off."""
    found, free = solve(*equations(), WIDE, carried=CARRIED, starts=4), loose
    assert np.all(found.violation == 0)
    assert all(are_buildable(phi[1:] - CARRIED[1:]) for phi in found.phi)
    assert not all(are_buildable(phi[1:] - CARRIED[1:]) for phi in free.phi)
    assert found.objective.min() >= free.objective.min() * (1 - 1e-6) - 1e-20  # both may be rounding alone


def test_starts_leave_room_for_what_is_carried():
    problem = scaled_problem(*equations(), WIDE, None, None, carried=CARRIED)
    u = np.asarray(starting_points(problem, 20, 0, initial=np.stack([PHI])))
    phi = np.einsum("lpq,blq->blp", problem.to_phi, u[:, :20].reshape(-1, 2, 10))
    assert all(are_buildable(one - CARRIED) for one in phi)


def test_bodies_heavier_than_a_bound_are_refused():
    with pytest.raises(InputError, match=r"bounds of m2: at most 5 kg, but bodies .* weigh 8 kg"):
        solve(*equations(), WIDE, carried=10 * CARRIED, starts=2)


# Geometry, not names


def test_another_arm_called_panda_is_another_arm():
    """The Panda with hand got the bounds of the one without."""
    own = Arm.panda()
    other = dataclasses.replace(own, standard=own.standard.at[6, 0].add(0.73))
    assert other.name == "panda"
    assert is_panda(own)
    assert not is_panda(other)
    np.testing.assert_array_equal(Bounds.of(other).mass, Bounds.around(other).mass)


def test_links_of_another_panda_are_not_exported_into_the_own_one(tmp_path):
    made = object.__new__(jaxpanda.Retrieval)
    for field in dataclasses.fields(jaxpanda.Retrieval):
        object.__setattr__(made, field.name, None)
    for name, value in {"arm": "panda", "own": False, "model_file": ""}.items():
        object.__setattr__(made, name, value)
    with pytest.raises(InputError, match="not the project's own Panda"):
        jaxpanda.to_mjcf(made, tmp_path / "new.xml")
