"""Retrieval: the published problem, and what is said about its answer."""

import copy
import json
import pickle

import numpy as np
import pytest

from jaxpanda.arms.arm import Arm
from jaxpanda.arms.panda import published
from jaxpanda.errors import InputError
from jaxpanda.feasible import Bounds
from jaxpanda.parameters import coefficient_matrix
from jaxpanda.retrieval import Retrieval, retrieve

OPTIMUM = 3.7262e-4
"""Certified once by another modelling tool (cvxpy), gap 1e-11."""


def table() -> dict:
    return {"coefficients": copy.deepcopy(published()["coefficients"])}


@pytest.fixture(scope="module")
def found() -> Retrieval:
    """The published problem as the defaults solve it."""
    return retrieve(table())


def test_the_published_coefficients_are_met_as_well_as_any_real_arm_can(found):
    assert found.objective <= 3.73e-4
    assert found.objective >= OPTIMUM * (1 - 1e-4)


def test_the_objective_is_that_of_the_41_reliable_coefficients(found):
    links = found.links
    moments = {}
    for i, link in enumerate(links, start=1):
        m, c = link["mass"], np.array(link["com"])
        xx, yy, zz, xy, xz, yz = link["inertia"]
        J = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) + m * (c @ c * np.eye(3) - np.outer(c, c))
        moments[f"m{i}"] = m
        moments |= {f"m{i}c{i}{axis}": m * c[k] for k, axis in enumerate("xyz")}
        moments |= {f"J{i}{'xyz'[a]}{'xyz'[b]}": J[a, b] for a in range(3) for b in range(a, 3)}
    rows = [row for row in published()["coefficients"] if row["reliable"]]
    error = [sum(k * moments[name] for name, k in row["terms"].items()) - row["value"] for row in rows]
    assert len(rows) == 41
    assert np.sum(np.square(error)) == pytest.approx(found.objective, rel=1e-9)


def test_every_margin_is_there_as_numpy_computes_it(found):
    bounds = Bounds.panda()
    assert found.max_violation == 0.0
    for i, link in enumerate(found.links):
        xx, yy, zz, xy, xz, yz = link["inertia"]
        principal = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        assert principal[0] + principal[1] > principal[2]
        assert np.all((link["com"] >= bounds.com[i, :, 0]) & (link["com"] <= bounds.com[i, :, 1]))
        assert np.all(
            (link["inertia"] >= bounds.inertia[i, :, 0]) & (link["inertia"] <= bounds.inertia[i, :, 1])
        )
        assert bounds.mass[i, 0] <= link["mass"] <= bounds.mass[i, 1]
    assert 16 <= sum(link["mass"] for link in found.links) <= 20


def test_the_certificate_is_below_and_close(found):
    assert found.lower_bound <= found.objective
    assert found.lower_bound == pytest.approx(OPTIMUM, rel=2e-5)


def test_many_starts_are_as_good_as_the_best(found):
    assert found.as_good > found.starts / 4


def test_all_seven_triangle_inequalities_are_active(found):
    assert sum(name.startswith("triangle") for name in found.active) == 7


def test_torque_does_not_tell_the_masses(found):
    for link in range(1, 8):
        low, high = found.spread[f"m{link}"]
        assert high - low > 1.0
    low, high = found.spread["total_mass"]
    assert high - low > 3.0


def test_a_result_is_the_same_after_saving_and_loading(found, tmp_path):
    found.save(tmp_path)
    loaded = Retrieval.load(tmp_path)
    assert loaded.to_json() == found.to_json()
    written = json.loads((tmp_path / "retrieval.json").read_text())
    assert sorted(written.pop("run")["files"]) == ["posterior.npz", "starts.npz"]
    assert written == found.to_json()
    np.testing.assert_array_equal(loaded.standard, found.standard)
    np.testing.assert_array_equal(loaded.solutions.objective, found.solutions.objective)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "posterior.npz",
        "retrieval.json",
        "starts.npz",
    ]


def test_a_result_can_be_pickled(found):
    again = pickle.loads(pickle.dumps(found))
    assert again.to_json() == found.to_json()
    np.testing.assert_array_equal(again.solutions.phi, found.solutions.phi)


@pytest.fixture(scope="module")
def quick() -> dict:
    """Options of a run that need not be good."""
    return {"starts": 64, "certificate": False, "bounds": Bounds.panda()}


def test_where_nothing_is_left_to_gain_the_last_digits_do_not_make_one_solution_better(quick):
    """Coefficients that links of the Panda have exactly: rounding leaves 1e-16 of them, more or less."""
    rows = table()["coefficients"]
    values = coefficient_matrix([row["terms"] for row in rows], 7) @ Arm.panda().standard.ravel()
    exact = {"coefficients": [row | {"value": float(v)} for row, v in zip(rows, values, strict=True)]}
    links = retrieve(exact, **quick)
    assert links.as_good > 0.9 * links.starts
    low, high = links.spread["m2"]
    assert high - low > 1.0


def test_weighing_by_torque_misses_the_sure_coefficients_less(quick):
    rows = table()["coefficients"]
    K = coefficient_matrix([row["terms"] for row in rows], 7)
    value, std = (np.array([row[key] for row in rows]) for key in ("value", "std"))
    misses = {}
    for weighting in ("none", "torque"):
        links = retrieve(table(), weighting=weighting, prefer="best", **quick)
        misses[weighting] = np.sum(((K @ links.standard.ravel() - value) / std) ** 2)
    assert links.objective == pytest.approx(misses["torque"], rel=1e-9)
    assert misses["torque"] < 0.8 * misses["none"]


def test_a_user_constraint_holds_and_its_margin_is_reported(quick):
    kept = retrieve(table(), constraints=[lambda links: links.mass[0] - links.mass[1]], **quick)
    assert kept.links[0]["mass"] >= kept.links[1]["mass"]
    assert kept.margins["user"][0][0] == pytest.approx(kept.links[0]["mass"] - kept.links[1]["mass"])


def test_links_stay_near_the_nominal_ones_in_what_the_coefficients_do_not_tell(quick):
    arm = Arm.panda()
    near = retrieve(table(), arm=arm, prefer="nominal", **quick)
    best = retrieve(table(), prefer="best", **quick)
    distance = lambda r: np.sum((r[:, 0] - np.asarray(arm.standard[:, 0])) ** 2)
    assert best.objective <= near.objective <= 1.001 * best.objective
    assert near.max_violation == 0
    assert distance(near.standard) < distance(best.standard)
    outcome = best.solutions
    as_good = outcome.phi[(outcome.violation == 0) & (outcome.objective <= 1.0005 * best.objective)]
    assert len(as_good) > 5
    assert distance(near.standard) < 0.8 * np.median([distance(phi) for phi in as_good])


@pytest.mark.slow
def test_constraints_that_no_start_meets_are_an_error(quick):
    with pytest.raises(InputError, match="no start of 64"):
        retrieve(table(), constraints=[lambda links: links.mass[:1] - 11.0], **quick)


def of_three_links(table):
    """An identification of another arm."""
    masses = [{**table["coefficients"][0], "terms": {f"m{i}": 1.0}} for i in (1, 2, 3)]
    return {"links": ["upper", "lower", "hand"], "coefficients": masses}


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda t: t["coefficients"][3]["terms"].update({"J3qq": 1}), r"coefficients\[3\].*J3qq"),
        (lambda t: t["coefficients"][2].update(value=None), r"coefficients\[2\].value"),
        (lambda t: t["coefficients"][0]["terms"].update({"m8": 1}), "link 8"),
        (lambda t: t.pop("coefficients"), "coefficients"),
        (lambda t: [row.update(reliable=False) for row in t["coefficients"]], "none is reliable"),
        (lambda t: t.update(of_three_links(t)), "cover 7 links, the identified arm has 3"),
    ],
)
def test_a_malformed_table_is_refused_by_field(change, complaint):
    broken = table()
    change(broken)
    with pytest.raises(InputError, match=complaint):
        retrieve(broken, bounds=Bounds.panda())


def test_a_file_that_is_no_retrieval_is_refused(tmp_path):
    (tmp_path / "retrieval.json").write_text('{"schema": "jaxpanda.retrieval/1"}')
    with pytest.raises(InputError, match=r"retrieval\.json"):
        Retrieval.load(tmp_path)


@pytest.mark.slow
def test_the_papers_own_penalty_stalls_far_from_the_optimum():
    exact = retrieve(table(), penalty="exact", starts=32, certificate=False)
    assert exact.objective > 10 * OPTIMUM
