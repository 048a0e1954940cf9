"""The convex lower bound."""

import sys

import numpy as np
import pytest

from jaxpanda.certificate import lower_bound
from jaxpanda.errors import InputError, MissingExtraError
from jaxpanda.feasible import Bounds


@pytest.fixture
def one_link() -> Bounds:
    inertia = np.array([[[0.0, 1.0]] * 3 + [[-1.0, 1.0]] * 3])
    return Bounds(np.array([[0.0, 3.0]]), np.tile([-0.1, 0.1], (1, 3, 1)), inertia)


def test_a_mass_held_back_by_its_bound_costs_the_square_of_the_rest(one_link):
    found = lower_bound(np.eye(10)[:1], np.array([5.0]), one_link)
    assert found.lower_bound == pytest.approx(4.0, rel=1e-6)
    assert found.phi[0, 0] == pytest.approx(3.0, rel=1e-6)


def test_a_body_that_breaks_the_triangle_inequality_costs_its_distance_to_a_plate(one_link):
    """Ixx = Iyy = 0.1, Izz = 0.5: the nearest body has Izz = Ixx + Iyy, 0.3/sqrt(3) away."""
    A, b = np.eye(10)[[4, 6, 9]], np.array([0.1, 0.1, 0.5])
    found = lower_bound(A, b, one_link)
    assert found.lower_bound == pytest.approx(0.3**2 / 3, rel=1e-5)


def test_first_moments_are_bounded_by_the_mass_and_the_box(one_link):
    """m = 1 and m c = 0.5 with c <= 0.1: min (m - 1)² + (0.1 m - 0.5)²."""
    found = lower_bound(np.eye(10)[:2], np.array([1.0, 0.5]), one_link)
    m = 1.05 / 1.01
    assert found.lower_bound == pytest.approx((m - 1) ** 2 + (0.1 * m - 0.5) ** 2, rel=1e-6)


def test_extra_unknowns_are_held_in_their_bounds(one_link):
    A = np.zeros((1, 11))
    A[0, 10] = 1
    args = {"extra_lower": np.array([-1.0]), "extra_upper": np.array([2.0])}
    assert lower_bound(A, np.array([5.0]), one_link, **args).lower_bound == pytest.approx(9.0, rel=1e-6)
    assert lower_bound(A, np.array([5.0]), one_link).lower_bound == pytest.approx(0.0, abs=1e-6)


def test_impossible_bounds_are_named(one_link):
    """A total mass that the boxes on the centre of mass allow, and a contradiction between extra bounds."""
    A = np.zeros((1, 11))
    with pytest.raises(InputError, match="no optimum"):
        lower_bound(A, np.ones(1), one_link, extra_lower=np.array([2.0]), extra_upper=np.array([1.0]))


def test_without_the_extra_its_name_is_told(one_link, monkeypatch):
    monkeypatch.setitem(sys.modules, "clarabel", None)
    with pytest.raises(MissingExtraError, match=r"\[sdp\]"):
        lower_bound(np.eye(10)[:1], np.array([5.0]), one_link)
