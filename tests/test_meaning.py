"""What a torque column is: other readings are named, and models that are merely poor are not taken for them.

The torque is MuJoCo's, of arms that `experiments/concealed` draws; nothing of it is our own dynamics.
"""

import dataclasses
import json
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from jaxpanda import Recording
from jaxpanda.__main__ import main
from jaxpanda.inspection import inspect
from jaxpanda.meaning import meaning
from jaxpanda.mjcf import from_mjcf
from jaxpanda.recordings import save

FOLDER = Path(__file__).parents[1] / "experiments" / "concealed"
NOISE = 0.08 * np.array([1, 1, 1, 1, 0.5, 0.5, 0.5])
"""Of the torque [N m]."""
LIGHT = np.array([1, 1, 1, 1, 0.4, 0.4, 0.4])
G = 9.81


@pytest.fixture(scope="module")
def trial():
    """The experiment's modules."""
    sys.path.insert(0, str(FOLDER))
    import arm
    import motions

    sys.path.remove(str(FOLDER))
    return arm, motions


class Case:
    """An arm, its motion, and its torque with friction that the model lacks."""

    def __init__(self, trial, seed: int, folder: Path):
        self.made, motions = trial
        self.rng = rng = np.random.default_rng(seed)
        self.user = self.made.draw_arm(rng)
        self.true = dataclasses.replace(
            self.user, frictionloss=rng.uniform(0.2, 0.8, 7) * LIGHT, damping=rng.uniform(0.2, 1, 7) * LIGHT
        )
        family = motions.FAMILIES[seed % len(motions.FAMILIES)]
        t, self.q, self.v, self.a = (x[600::4] for x in motions.desired(rng, family, 10.0))
        self.t = t - t[0]
        self.path = folder / f"arm_{seed}.xml"
        self.path.write_text(self.made.mjcf(self.user))
        self.model = from_mjcf(self.path)[0]

    def torque(self, true=None, **changes) -> np.ndarray:
        """Of the true arm, or another, with noise [N m]."""
        true = dataclasses.replace(self.true if true is None else true, **changes)
        engine = mujoco.MjModel.from_xml_string(self.made.mjcf(true, actuators=False))
        tau = self.made.inverse_dynamics(engine, self.q, self.v, self.a)
        tau += true.frictionloss * np.tanh(self.v / 0.005)
        return tau + NOISE * self.rng.normal(size=tau.shape)

    def recorded(self, tau: np.ndarray, order=None) -> Recording:
        """`order`: in which all columns stand."""
        at = np.arange(7) if order is None else np.asarray(order)
        q = self.q + 1e-5 * self.rng.normal(size=self.q.shape)
        return Recording("arm.csv", self.t, q[:, at], self.v[:, at], tau[:, at])

    def read(self, tau: np.ndarray, order=None):
        return meaning(self.recorded(tau, order), self.model)


@pytest.fixture(scope="module")
def case(trial, tmp_path_factory):
    return Case(trial, 0, tmp_path_factory.mktemp("arm"))


@pytest.mark.parametrize("seed", [0, 3])
def test_a_poor_model_is_not_a_wrong_meaning(trial, seed, tmp_path):
    """Each of these is physics, or a number that is somewhat off, of which the torque column is not guilty."""
    case = Case(trial, seed, tmp_path)
    body = case.made.Body
    signs = case.rng.choice([-1, 1], 7)
    links = tuple(
        body(b.mass * (1 + 0.2 * s), b.com, b.inertia * (1 + 0.2 * s))
        for b, s in zip(case.true.links, signs, strict=True)
    )
    payload = body(3.0, np.array([0.02, 0.0, 0.08]), np.array([0.01, 0.01, 0.01, 0, 0, 0]))
    tilt = np.radians(5.0)
    said = {
        "null": case.read(case.torque(case.user)),
        "missing friction": case.read(case.torque()),
        "links": case.read(case.torque(links=links)),
        "payload": case.read(case.torque(load=payload)),
        "gain": case.read(case.torque() * (1 + 0.3 * (np.arange(7) == 3))),
        "tilt": case.read(case.torque(gravity=G * np.array([np.sin(tilt), 0, -np.cos(tilt)]))),
        "offset": case.read(case.torque() + 0.8 * signs),
    }
    assert said == dict.fromkeys(said)


@pytest.mark.parametrize("seed", [0, 3])
def test_torque_without_gravity_is_named(trial, seed, tmp_path):
    case = Case(trial, seed, tmp_path)
    found = case.read(case.torque(gravity=np.zeros(3)))
    assert found is not None
    assert found.kind == "gravity_removed"
    assert found.confidence > 0.9
    assert "Add gravity" in found.mend


@pytest.mark.parametrize("seed", [0, 3])
def test_reversed_signs_are_named_with_their_joints(trial, seed, tmp_path):
    case = Case(trial, seed, tmp_path)
    every = case.read(-case.torque())
    assert every is not None
    assert (every.kind, every.joints) == ("sign", tuple(range(7)))
    one = case.read(case.torque() * np.where(np.arange(7) == 3, -1, 1))
    assert one is not None
    assert (one.kind, one.joints) == ("sign", (3,))


def test_units_and_currents_are_told_from_each_other(case):
    unit = case.read(1000 * case.torque())
    assert unit is not None
    assert (unit.kind, set(unit.factors)) == ("unit", {1000.0})
    constants = 1 / np.array([15.0, 13.0, 8.0, 11.0, 6.0, 9.0, 7.0])
    current = case.read(case.torque() * constants)
    assert current is not None
    assert current.kind == "current"
    np.testing.assert_allclose(np.array(current.factors)[[1, 3]], constants[[1, 3]], rtol=0.3)
    geared = case.read(case.torque() / 101.0)
    assert geared is not None
    assert geared.kind == "motor_side"


def test_columns_out_of_order_are_put_in_order(case):
    whole = case.read(case.torque(), order=[0, 3, 2, 1, 4, 5, 6])
    assert whole is not None
    assert (whole.kind, whole.joints, whole.whole_order) == ("joint_order", (1, 3), True)
    assert whole.order == (0, 3, 2, 1, 4, 5, 6)


def test_another_mounting_is_named(case):
    for gravity, word in (((G, 0, 0), "wall"), ((0, 0, G), "ceiling"), ((0, 0, -1.62), "moon")):
        found = case.read(case.torque(gravity=np.array(gravity, float)))
        assert found is not None
        assert found.kind == "mounting"
        assert word in found.says
        np.testing.assert_allclose(found.gravity, gravity, atol=0.6)


def test_too_little_to_tell_is_told_nothing(case):
    whole = case.recorded(1000 * case.torque())
    assert whole.tau is not None
    short = Recording("short", whole.time[:200], whole.q[:200], whole.qd[:200], whole.tau[:200])
    assert meaning(short, case.model) is None
    assert meaning(Recording("motion", whole.time, whole.q, whole.qd), case.model) is None
    still = Recording("rest", whole.time, 0 * whole.q + whole.q[0], 0 * whole.qd, whole.tau)
    assert meaning(still, case.model) is None


def test_diagnose_says_what_the_column_is_and_seeks_no_physics_in_it(case, tmp_path):
    save(case.recorded(case.torque(gravity=np.zeros(3))), tmp_path / "free.csv")
    command = ["diagnose", "--model", str(case.path), "--recording", str(tmp_path / "free.csv")]
    assert main([*command, "--out", str(tmp_path / "out")]) == 0
    document = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    (finding,) = document["findings"]
    assert (finding["effect"], finding["family"]) == ("torque_meaning", "meaning")
    assert finding["kind"] == "gravity_removed"
    assert document["verdict"] in ("unexplained", "partly_explained")
    assert (tmp_path / "out" / "corrected.xml").read_text() == case.path.read_text()
    assert "gravity" in (tmp_path / "out" / "report.html").read_text()


def test_inspect_says_the_same_in_words(case):
    wall = case.recorded(case.torque(gravity=np.array([G, 0, 0])))
    assert "on a wall" in "\n".join(inspect(wall, case.model).verdicts)
    verdicts = inspect(case.recorded(case.torque()), case.model).verdicts
    assert not any("mounted" in said or "wrong sign" in said for said in verdicts)
