"""Friction at which joints stick as they turn back, as in every simulation and on every arm with gears."""

import jax
import mujoco
import numpy as np
import pytest

from jaxpanda import Arm, Recording, compare, diagnose, identify, retrieve, summaries, validate

LEVEL, SLOPE = 8.0, 40.0
LIFT = """<mujoco><compiler angle="radian"/><option timestep="0.0005" integrator="implicitfast"/><worldbody>
<body name="carriage" pos="0 0 0.3"><joint name="lift" type="slide" axis="0 0 1" range="-1 1"/>
<inertial mass="9" pos="0.02 0 0" diaginertia="0.1 0.1 0.1"/>
<body name="arm" pos="0.1 0 0"><joint name="turn" axis="0 1 0" range="-2 2"/>
<inertial mass="3" pos="0.15 0 0.02" diaginertia="0.01 0.03 0.03"/>
</body></body></worldbody></mujoco>"""


def lifted(frictionloss: float, damping: float) -> Recording:
    """Twelve seconds of the lift with such friction under computed torque, by MuJoCo's C engine."""
    model, rng, rows = mujoco.MjModel.from_xml_string(LIFT), np.random.default_rng(5), []
    model.dof_frictionloss[0], model.dof_damping[0] = frictionloss, damping
    data, mass = mujoco.MjData(model), np.zeros((2, 2))
    w = 2 * np.pi * np.array([[0.1], [0.23], [0.31]])
    a = np.array([[0.08, 0.3], [0.05, 0.5], [0.03, 0.4]])
    for k in range(int(12 / model.opt.timestep)):
        t = k * model.opt.timestep
        q, qd, qdd = (np.sum(a * x, 0) for x in (np.sin(w * t), w * np.cos(w * t), -(w**2) * np.sin(w * t)))
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass)
        data.qfrc_applied[:] = mass @ (qdd + 400 * (q - data.qpos) + 40 * (qd - data.qvel)) + data.qfrc_bias
        if k % 8 == 0:
            rows.append(np.concatenate([[t], data.qpos, data.qfrc_applied]))
        mujoco.mj_step(model, data)
    time, q, tau = np.split(np.array(rows), [1, 3], 1)
    noise = lambda deviation: deviation * rng.normal(size=q.shape)
    return Recording("lift.csv", time[:, 0], q + noise(2e-5), tau=tau + noise(np.array([0.3, 0.05])))


@pytest.mark.parametrize("slope", [0.0, SLOPE])
def test_friction_has_the_level_that_it_has_while_the_joint_moves(slope, tmp_path):
    """As a joint turns back it sticks, and carries what it must. A fit that took each sample there for the law's
    held 8 N for 3.3, and called friction with damping Stribeck's, at 0.4 and 0.96."""
    (tmp_path / "lift.xml").write_text(LIFT)
    with jax.enable_x64(True):
        found = diagnose(tmp_path / "lift.xml", [lifted(LEVEL, slope)])
    of = {f.effect: f for f in found.findings}
    assert set(of) == {"coulomb_friction", *(["viscous_friction"] if slope else [])}
    assert all(f.joints == (0,) and f.confidence > 0.9 for f in of.values())
    level = of["coulomb_friction"].parameters[0]
    assert level["value"] == pytest.approx(LEVEL, rel=0.03)
    assert abs(level["value"] - LEVEL) < 2 * level["std"]
    told = {f.effect: f.parameters[0]["value"] for f in found.findings}
    written = mujoco.MjModel.from_xml_string(found.written.text)
    assert written.dof_frictionloss[0] == pytest.approx(told["coulomb_friction"], rel=0.01)
    assert written.dof_damping[0] == pytest.approx(told.get("viscous_friction", 0.0), rel=0.01)
    assert found.fit.held_out_rmse_after[0] < 0.15 * found.fit.held_out_rmse_before[0]


@pytest.mark.parametrize("slope", [0.0, SLOPE])
def test_identified_friction_is_that_of_the_moving_joint(slope, tmp_path):
    """As a joint turns back it sticks. Taken for the law's, those samples held 8 N for 7.86 ± 0.06 and called
    what was missing damping, 1.6 ± 0.8."""
    (tmp_path / "lift.xml").write_text(LIFT)
    with jax.enable_x64(True):
        found = identify(lifted(LEVEL, slope), Arm.from_mjcf(tmp_path / "lift.xml"), folds=0).friction
    for name, truth, most in (("coulomb", LEVEL, 0.05), ("viscous", slope, 0.5)):
        value, std = found.parameters[name][0], found.std[name][0]
        assert abs(value - truth) < 2 * std < 2 * most


def test_tables_of_an_arm_that_turns_and_slides_name_both_units(tmp_path):
    """N m and rad were told of a lift."""
    (tmp_path / "lift.xml").write_text(LIFT)
    recording = lifted(LEVEL, SLOPE)
    with jax.enable_x64(True):
        found = identify(recording, Arm.from_mjcf(tmp_path / "lift.xml"))
        links = retrieve(found, starts=8)
        checked = validate(tmp_path / "lift.xml", [recording], in_mjx=False)
        found.save(tmp_path / "found")
        same = compare(tmp_path / "found", tmp_path / "found")
        tables = [
            table for one in (found, links, checked) for part in summaries.of(one) for table in part.tables
        ]
    told = " ".join(text for table in tables for text in (table.caption, *table.columns))
    assert told.count("[N m or N]") == 5  # errors of each, the level and the offset of friction
    assert "[N m s/rad or N s/m]" in told
    assert "tracking in MuJoCo, rmse [rad or m]" in told
    assert "[N m]" not in told
    assert {p.unit for p in same.parameters if p.name == "coulomb"} == {"N", "N m"}
    assert {p.unit for p in same.parameters if p.joint is None} <= {"kg", "kg m", "kg m²"}
    assert same.sections()[0].tables[1].caption.endswith("noise [N m or N]")
