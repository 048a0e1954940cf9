"""Effects of a user's own in a diagnosis, and results that travel by pickle."""

import dataclasses
import json
import pickle
from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import mujoco
import numpy as np
import pytest

import jaxpanda
from jaxpanda import Arm, Corrected, InputError, Recording, diagnose, predict
from jaxpanda.diagnosis import page
from jaxpanda.effects import (
    AbstractArmEffect,
    AbstractInstantEffect,
    Channels,
    Coefficient,
    Motion,
    Shape,
    catalogue_with,
)
from jaxpanda.inference.state import start
from jaxpanda.search.events import windows
from jaxpanda.search.premises import pose
from jaxpanda.traces import prepare


class CoupledDamping(AbstractInstantEffect):
    """Damping of a wrist's shared belt: torque at a joint proportional to the next one's velocity."""

    name: ClassVar[str] = "coupled_damping"
    family: ClassVar[str] = "drive"
    reveals: ClassVar[str] = "a motion of the next joint alone"
    joint: int = eqx.field(converter=int)

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["CoupledDamping"]:
        return [cls(j) for j in range(arm.dof - 1)]

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return (Coefficient("coupling", "N·m·s/rad"),)

    @property
    def equation(self) -> str:
        return "tau = coupling * dq of the next joint"

    def at(self, s: Channels):
        return s.qd[self.joint + 1][None]


class BrakeLeftOn(AbstractArmEffect):
    """A brake that drags at a joint for a while: torque in proportion to its velocity from `start` to `stop`."""

    name: ClassVar[str] = "brake_left_on"
    family: ClassVar[str] = "drive"
    prior: ClassVar[float] = -17.0
    shapes: ClassVar[tuple[Shape, ...]] = (
        Shape("start", "s", -np.inf, np.inf, False),
        Shape("stop", "s", -np.inf, np.inf, False),
    )
    bound_to_recording: ClassVar[bool] = True

    joint: int = eqx.field(static=True)
    start: float
    stop: float
    recording: str = eqx.field(static=True)

    @classmethod
    def grid(cls, arm: Arm) -> Sequence["BrakeLeftOn"]:
        return []

    @classmethod
    def at_some_time(cls, dof: int, recording: str) -> Sequence[Sequence["BrakeLeftOn"]]:
        return [[cls(joint, -1e9, 1e9, recording)] for joint in range(dof)]

    @property
    def joints(self) -> tuple[int, ...]:
        return (self.joint,)

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return (Coefficient("drag", "N·m·s/rad", sign=1, scale=1.0),)

    @property
    def equation(self) -> str:
        return "tau = drag * dq while start <= t < stop"

    def over(self, motion: Motion) -> np.ndarray:
        on = (motion.time >= self.start) & (motion.time < self.stop)
        return (motion.qd * on[:, None])[:, :, None] * np.eye(motion.dof)[self.joint][:, None]


MODEL = """<mujoco><compiler angle="radian"/><worldbody>
<body name="link1" pos="0 0 0.3"><joint name="joint1" axis="0 0 1" range="-2 2"/>
<inertial mass="3" pos="0.02 0.03 -0.05" diaginertia="0.02 0.02 0.015"/>
<body name="link2" pos="0 0.1 0.2"><joint name="joint2" axis="0 1 0" range="-2 2"/>
<inertial mass="2" pos="0.15 0 0.02" diaginertia="0.01 0.02 0.02"/>
<body name="link3" pos="0.3 0 0"><joint name="joint3" axis="0 1 0" range="-2 2"/>
<inertial mass="1" pos="0.1 0.01 0" diaginertia="0.002 0.004 0.004"/>
</body></body></body></worldbody></mujoco>"""
NOISE = 0.02


def record(seed: int, coupling: float = 0.6) -> Recording:
    """C MuJoCo's inverse dynamics of a motion, the belt's torque and white noise."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    data, rng, t = mujoco.MjData(model), np.random.default_rng(seed), np.arange(1600) / 200
    w = 2 * np.pi * np.array([0.1, 0.2, 0.4, 0.6])[:, None]
    a = rng.normal(0, 0.25, (4, 3))
    q, qd, qdd = np.sin(w * t).T @ a, (w * np.cos(w * t)).T @ a, -(w**2 * np.sin(w * t)).T @ a
    tau = np.zeros_like(q)
    for i in range(len(t)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[i], qd[i], qdd[i]
        mujoco.mj_inverse(model, data)
        tau[i] = data.qfrc_inverse
    tau[:, 1] += coupling * qd[:, 2]
    return Recording(f"motion_{seed}.csv", t, q, qd=qd, tau=tau + NOISE * rng.normal(size=q.shape))


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("arm") / "arm.xml"
    path.write_text(MODEL)
    return path


@pytest.fixture(scope="module")
def found(model):
    return diagnose(model, [record(20)], effects=[CoupledDamping])


def test_an_effect_of_one_s_own_is_named_located_and_fitted(found):
    (finding,) = found.findings
    assert (finding.effect, finding.joints, finding.family) == ("coupled_damping", (1,), "drive")
    assert finding.parameters[0]["value"] == pytest.approx(0.6, abs=0.05)
    assert finding.confidence > 0.9


@pytest.mark.slow
def test_it_stands_in_the_tables_and_on_the_page(found):
    assert "coupled_damping" in found.heat_map.effects
    assert "coupled_damping" in {one.effect for one in found.least_shown}
    assert any("coupled damping" in section.heading for section in page.sections(found))


@pytest.mark.slow
def test_without_it_the_same_torque_is_called_otherwise(model):
    (finding,) = diagnose(model, [record(20)]).findings
    assert finding.effect == "unknown"


def test_what_was_saved_reads_back_with_the_class_and_says_so_without(found, tmp_path):
    found.save(tmp_path)
    with pytest.raises(InputError, match=r"corrected\.json.*'CoupledDamping'.*effects=\[CoupledDamping\]"):
        Corrected.load(tmp_path)
    loaded = Corrected.load(tmp_path, effects=[CoupledDamping])
    assert [type(e) for e in loaded.effects] == [CoupledDamping]
    other = record(22)
    tau = predict(tmp_path, other, effects=[CoupledDamping])
    np.testing.assert_allclose(np.sqrt(np.mean((tau - other.tau) ** 2, 0)), NOISE, rtol=0.1)


@pytest.mark.parametrize(
    ("name", "base", "said"),
    [
        ("coulomb_friction", CoupledDamping, "CoulombFriction"),
        ("unfinished", AbstractInstantEffect, "lacks at,"),
    ],
)
def test_an_effect_that_is_unfinished_or_whose_name_is_taken_is_refused(name, base, said, model):
    with pytest.raises(InputError, match=said):
        diagnose(model, [record(20)], effects=[type("Other", (base,), {"name": name})])


def test_the_time_of_an_effect_of_one_s_own_is_searched_for(model):
    one = record(20, coupling=0.0)
    on = (one.time >= 3.0) & (one.time < 5.0)
    tau = one.tau + 0.8 * one.qd * on[:, None] * np.eye(3)[1]
    trace = prepare(dataclasses.replace(one, tau=tau), Arm.from_mjcf(model))
    problem = pose((trace,), (True,), "exact", catalogue=catalogue_with([BrakeLeftOn])).problem
    state = start(problem)
    likeliest = max(windows(problem, state.design, state.noise), key=lambda p: p.evidence)
    assert likeliest.key == ("brake_left_on", (1,))
    assert (likeliest.effect.start, likeliest.effect.stop) == pytest.approx((3.0, 5.0), abs=0.15)


def test_an_effect_at_some_time_must_have_a_plausible_size():
    class Unsized(BrakeLeftOn):
        @property
        def coefficients(self) -> tuple[Coefficient, ...]:
            return (Coefficient("drag", "N·m·s/rad", sign=1),)

    with pytest.raises(
        InputError, match="Unsized acts at some time, and its coefficients lack a plausible size"
    ):
        catalogue_with([Unsized])


def test_an_effect_of_a_recording_must_name_it(model):
    unnamed = type("Other", (CoupledDamping,), {"name": "slip", "bound_to_recording": True})
    with pytest.raises(InputError, match="Other is bound to a recording, and lacks its name"):
        diagnose(model, [record(20)], effects=[unnamed])


def test_a_diagnosis_travels_by_pickle(found):
    again = pickle.loads(pickle.dumps(found))
    assert [f.to_json() for f in again.findings] == [f.to_json() for f in found.findings]
    assert again.problem.catalogue[-1] is CoupledDamping
    for old, new in zip(found.residuals(), again.residuals(), strict=True):
        np.testing.assert_array_equal(new[3], old[3])


@pytest.mark.slow
def test_other_results_travel_by_pickle(found, model):
    arm, recording = found.corrected.arm, record(20)
    identified = jaxpanda.identify(recording, arm)
    results = (
        identified,
        jaxpanda.retrieve(identified, arm=arm, starts=8, certificate=False),
        jaxpanda.inspect(recording, arm),
        jaxpanda.validate(model, [recording], in_mjx=False),
    )
    for result in results:
        again = pickle.loads(pickle.dumps(result))
        assert json.dumps(again.to_json()) == json.dumps(result.to_json()), type(result)
