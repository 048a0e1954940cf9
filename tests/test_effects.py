"""The catalogue: every effect keeps the promises that the search, the corrected model and the export rely on."""

import ast
import dataclasses
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import scipy.integrate
import scipy.interpolate
from helpers import to_mujoco
from jaxpanda_kernels import rnea

import jaxpanda.diagnosis
from jaxpanda import Arm
from jaxpanda.corrected import effect_from_json
from jaxpanda.effects import (
    CATALOGUE,
    AbstractInstantEffect,
    AbstractJointEffect,
    Channels,
    Motion,
    Stretches,
    joint_columns,
)
from jaxpanda.effects.contact import ExternalContact
from jaxpanda.effects.drive import Backlash, JointElasticity, JointSpring, TorqueRipple
from jaxpanda.effects.friction import CoulombFriction
from jaxpanda.effects.load import GravityDirection, InertialParameters, Payload, PayloadChange
from jaxpanda.effects.memory import PreslidingHysteresis
from jaxpanda.effects.sensing import EncoderOffset, TimeDelay, TorqueDrift, TorqueGain
from jaxpanda.effects.stribeck import StribeckBristles
from jaxpanda.effects.twist import Law, twist_torque
from jaxpanda.effects.unknown import (
    Unknown,
    UnknownAt,
    UnknownDrag,
    UnknownLimit,
    UnknownOfSpeeds,
    UnknownOfTwo,
    UnknownShaking,
    UnknownSpin,
)

NAMES = {
    "viscous_friction", "coulomb_friction", "power_law_friction", "asymmetric_friction", "stribeck_friction",
    "load_dependent_friction", "friction_drift", "presliding_hysteresis", "torque_ripple", "backlash",
    "joint_elasticity", "armature",
    "inertial_parameters", "payload", "payload_change", "gravity_direction", "joint_spring", "torque_offset",
    "torque_gain", "torque_drift", "torque_crosstalk", "encoder_offset", "time_delay", "external_contact",
    "unknown",
}  # fmt: skip


@pytest.fixture(scope="module")
def arm() -> Arm:
    return Arm.panda()


@pytest.fixture(scope="module")
def motion(arm: Arm) -> Motion:
    t = np.arange(400) / 100.0
    phases, speeds = np.arange(7.0), 1.0 + 0.3 * np.arange(7)
    middle = 0.5 * np.asarray(arm.lower + arm.upper)
    angle = speeds * t[:, None] + phases
    q, qd, qdd = middle + 0.5 * np.sin(angle), 0.5 * speeds * np.cos(angle), -0.5 * speeds**2 * np.sin(angle)
    return Motion(arm, t, q, qd, qdd, np.zeros_like(q))


@pytest.fixture(scope="module")
def channels(motion: Motion) -> Channels:
    return Channels(motion.time, motion.q, motion.qd, motion.qdd, motion.load, motion.torque)


def shapes(arm: Arm):
    """One shape of every form of every effect, those that only a scan proposes included."""
    proposed = [
        StribeckBristles(3, 0.1, 2e-3, 1.5, "bristles"),
        StribeckBristles(3, 0.1, 2e-3, 1.5, "lugre"),
        TorqueRipple(1, 20.0, "one"),
        TorqueRipple(1, 20.0, "two"),
        JointSpring(3, "slack", -1.5, 0.05),
        PayloadChange(6, 1.0, 1e9, "a.csv", "gained"),
        ExternalContact(4, 1.0, 2.0, "a.csv", "base"),
        ExternalContact(4, 1.0, 2.0, "a.csv", "link"),
        ExternalContact(4, 1.0, 2.0, "a.csv", "point base", (0.0, 0.1, 0.05)),
        ExternalContact(4, 1.0, 2.0, "a.csv", "point link", (0.0, 0.1, 0.05)),
        UnknownOfTwo(2, 1, (-0.4, -0.4), (0.4, 0.4)),
        UnknownOfSpeeds(2, 1, 3, 0.2),
        UnknownDrag(arm.dof, 0.1, (0.1, 0.4)),
        UnknownSpin(arm.dof),
        UnknownShaking(arm.dof, ("a.csv", "b.csv"), 4.0, "b.csv"),
        UnknownAt(2, 0.1, 0.2),
        UnknownLimit(2, 1.0),
        *(Unknown(2, 2, (-0.4, 0.0, 0.4), form) for form in ("of q", "of q_k", "friction of q")),
    ]
    kinds = {}
    for effect in [*proposed, *(e for c in CATALOGUE for e in c.grid(arm))]:
        if effect.joints != (0,):  # the first joint is vertical: some effects do not show there
            kinds.setdefault((type(effect).__name__, getattr(effect, "form", "")), effect)
    return list(kinds.values())


def columns(effect, motion: Motion, channels: Channels) -> np.ndarray:
    if isinstance(effect, AbstractJointEffect):
        wide = np.zeros((motion.samples, motion.dof, len(effect.coefficients)))
        wide[:, effect.joints[0]] = joint_columns([effect], Stretches(channels), motion.dt)[:, 0]
        return wide
    return effect.over(motion)


def test_the_diagnosis_names_no_effect():
    """Nor asks of what class one is. A joint's armature and knowledge that is unknown are words of others too."""
    classes = {c.__name__ for c in CATALOGUE} | {"AbstractJointEffect", "AbstractArmEffect"}
    names = {c.name for c in CATALOGUE} - {"armature", "unknown"}
    for path in sorted(Path(jaxpanda.diagnosis.__file__).parent.glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            said = node.id if isinstance(node, ast.Name) else node.name if isinstance(node, ast.alias) else ""
            text = node.value if isinstance(node, ast.Constant) else ""
            assert said not in classes, (path.name, said)
            assert text not in names, (path.name, text)


def test_the_catalogue_holds_the_interface_s_names_and_no_others():
    assert {effect.name for effect in CATALOGUE} == NAMES


def test_every_effect_has_as_many_columns_as_coefficients_and_all_are_finite(arm, motion, channels):
    for effect in shapes(arm):
        found = columns(effect, motion, channels)
        assert found.shape == (motion.samples, motion.dof, len(effect.coefficients)), effect
        assert np.isfinite(found).all(), effect
        assert np.any(found), effect


def test_every_effect_reads_back_from_its_json_and_says_its_parameters(arm, motion, channels):
    for effect in shapes(arm):
        again = effect_from_json(effect.to_json(), {type(effect).__name__: type(effect)})
        np.testing.assert_array_equal(columns(again, motion, channels), columns(effect, motion, channels))
        n = len(effect.coefficients)
        parameters = effect.parameters(np.ones(n), np.eye(n + sum(not s.pivot for s in effect.shapes)))
        for parameter in parameters:
            assert {"name", "joint", "value", "std", "unit"} == set(parameter)
            assert 0 <= parameter["std"] < np.inf
        assert effect.equation


def test_units_go_by_whether_the_joint_slides_where_the_number_is_in_its_coordinate(arm):
    slides = eqx.tree_at(lambda a: a.chain.prismatic, arm, arm.chain.prismatic.at[2].set(True))
    spring = JointSpring(2, "linear")
    for turning, sliding in (
        ("N·m/rad", "N/m"),
        ("rad/(N·m)", "m/N"),
        ("N·m·s/rad", "N·s/m"),
        ("kg·m²", "kg"),
    ):
        assert spring.unit(turning, arm) == JointSpring(1, "linear").unit(turning, slides) == turning
        assert spring.unit(turning, slides) == sliding
        assert Payload(2).unit(turning, slides) == turning
    assert (slides.unit("N·m"), slides.unit("s"), arm.unit("N·m")) == ("N·m or N", "s", "N·m")


def test_every_shape_of_a_grid_lies_within_its_bounds(arm):
    for effect in (e for c in CATALOGUE for e in c.grid(arm)):
        for shape in effect.shapes:
            assert shape.lower <= getattr(effect, shape.name) <= shape.upper


def test_derivatives_of_effects_without_memory_exist_at_rest(arm):
    still = jnp.zeros(7)
    for effect in shapes(arm):
        if isinstance(effect, AbstractInstantEffect):
            slope = jax.jacfwd(
                lambda qd, e=effect: e.at(Channels(jnp.ones(()), still, qd, still, still, still))
            )(still)
            assert np.isfinite(slope).all(), effect


def test_friction_takes_energy_out(arm, motion, channels):
    for effect in (CoulombFriction(2, 0.01), PreslidingHysteresis(2, 0.01, "dahl only")):
        torque = joint_columns([effect], Stretches(channels), motion.dt)[:, 0, 0]
        assert torque @ motion.qd[:, 2] > 0


def test_presliding_friction_goes_over_into_coulomb_friction_beyond_its_breakaway_distance(motion, channels):
    dahl = joint_columns([PreslidingHysteresis(3, 1e-4, "dahl only")], Stretches(channels), motion.dt)[
        :, 0, 0
    ]
    sliding = np.abs(motion.qd[:, 3]) > 0.2
    np.testing.assert_allclose(dahl[sliding], np.sign(motion.qd[sliding, 3]), atol=1e-3)


def test_a_tilt_turns_the_gravity_that_inverse_dynamics_feels(arm, motion):
    effect = GravityDirection.grid(arm)[0]
    c = np.array([0.1, -0.2])
    chain = dataclasses.replace(arm.chain, gravity=arm.chain.gravity + effect.gravity_change(c))
    zero = jnp.zeros(7)
    for i in (0, 150):
        q = jnp.asarray(motion.q[i])
        expected = rnea(chain, arm.standard, q, zero, zero) - rnea(arm.chain, arm.standard, q, zero, zero)
        np.testing.assert_allclose(effect.over(motion)[i] @ c, expected, atol=1e-10)


def test_a_body_s_columns_are_those_of_inverse_dynamics_with_its_parameters_added(arm, motion):
    for effect in (Payload.grid(arm)[0], InertialParameters.grid(arm)[3]):
        c = np.linspace(0.5, -0.1, 10)
        link, change = effect.standard_change(c)
        heavier = arm.standard.at[link].add(change)
        q, qd, qdd = (jnp.asarray(a[77]) for a in (motion.q, motion.qd, motion.qdd))
        expected = rnea(arm.chain, heavier, q, qd, qdd) - rnea(arm.chain, arm.standard, q, qd, qdd)
        np.testing.assert_allclose(effect.over(motion)[77] @ c, expected, atol=1e-9)


def test_a_contact_does_the_virtual_work_of_its_force(arm, motion):
    """tau . dq = -F . dx of the link's origin; joints beyond the link feel nothing."""
    from jaxpanda_kernels import link_poses

    effect, F = ExternalContact(4, -1.0, 9.0, "a.csv", "base"), np.array([3.0, -1.0, 2.0])
    tau = effect.over(motion)[123] @ np.concatenate([F, np.zeros(3)])
    jac = jax.jacfwd(lambda q: link_poses(arm.chain, q)[1][4])(jnp.asarray(motion.q[123]))
    np.testing.assert_allclose(tau, -F @ jac, atol=1e-10)
    assert not np.any(tau[5:])


def test_a_force_at_a_point_is_the_wrench_of_its_moment(arm, motion):
    F, point = np.array([3.0, -1.0, 2.0]), (0.02, 0.1, -0.05)
    tau = ExternalContact(4, -1.0, 9.0, "a.csv", "point base", point).over(motion)[123] @ F
    moment = np.cross(motion.link_axes[123, 4] @ np.array(point), F)
    wrench = ExternalContact(4, -1.0, 9.0, "a.csv", "base").over(motion)[123] @ np.concatenate([F, moment])
    np.testing.assert_allclose(tau, wrench, atol=1e-10)


def test_a_drag_and_a_spin_are_what_mujoco_s_jacobians_make_of_them(arm, motion):
    model, reach, slope = to_mujoco(arm.chain, arm.standard), 0.15, 3.0
    momentum = np.array([0.02, -0.05, 0.03])
    data, last = mujoco.MjData(model), model.nbody - 1
    drag = UnknownDrag(arm.dof, reach, (0.5, 10.0)).over(motion) @ (slope * np.array([0.5, 10.0]))
    spin = UnknownSpin(arm.dof).over(motion) @ momentum
    linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    for k in range(0, motion.samples, max(1, motion.samples // 20)):
        data.qpos[:], data.qvel[:] = motion.q[k], motion.qd[k]
        mujoco.mj_forward(model, data)
        R = data.xmat[last].reshape(3, 3)
        mujoco.mj_jac(model, data, linear, angular, data.xpos[last] + reach * R[:, 2], last)
        np.testing.assert_allclose(drag[k], slope * linear.T @ linear @ motion.qd[k], atol=1e-9)
        turns = np.cross(angular @ motion.qd[k], R @ momentum)
        np.testing.assert_allclose(spin[k], angular.T @ turns, atol=1e-9)


def test_a_base_that_shakes_is_gravity_that_does(arm, motion):
    shaken = UnknownShaking(arm.dof, ("a.csv", "b.csv"), 4.0)
    sine, cosine = np.array([0.2, -0.1, 0.4]), np.array([0.0, 0.3, -0.2])
    tau = shaken.placed("b.csv", None).over(motion) @ np.concatenate([np.zeros(6), sine, cosine])
    model = to_mujoco(arm.chain, arm.standard)
    still, data = model.opt.gravity.copy(), mujoco.MjData(model)

    def held(q, gravity):
        model.opt.gravity[:] = gravity
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        return data.qfrc_bias.copy()

    for k in range(0, motion.samples, max(1, motion.samples // 20)):
        angle = 2 * np.pi * 4.0 * motion.time[k]
        base = sine * np.sin(angle) + cosine * np.cos(angle)
        q = motion.q[k]
        np.testing.assert_allclose(tau[k], held(q, still - base) - held(q, still), atol=1e-9)
    assert shaken.placed("c.csv", True) is None


def test_a_contact_acts_in_its_interval_only(motion):
    felt = np.any(ExternalContact(6, 1.0, 2.0, "a.csv", "base").over(motion) != 0, axis=(1, 2))
    assert motion.time[felt].min() >= 0.98
    assert motion.time[felt].max() <= 2.02


def test_an_encoder_offset_is_the_change_of_torque_to_first_order(arm, motion):
    small = 1e-5
    effect = EncoderOffset(3, small)
    moved = motion.moved(np.broadcast_to(small * np.eye(7)[3], motion.q.shape))
    np.testing.assert_allclose(
        effect.over(motion)[..., 0] * small, motion.sensitivity(moved.q - motion.q), atol=1e-7
    )


def test_a_sensor_that_is_linearised_has_a_plausible_error_within_what_it_is_linearised_over(arm):
    """Without, a real arm's last joint had an offset of 53 rad, for a part of what it carries."""
    linearised = [e for c in CATALOGUE if c.family in ("sensor", "clock") for e in c.grid(arm)]
    linearised = [e for e in linearised if any(shape.pivot for shape in e.shapes)]
    assert {e.name for e in linearised} == {"encoder_offset", "time_delay"}
    for effect in linearised:
        (shape,) = (shape for shape in effect.shapes if shape.pivot)
        assert effect.coefficients[0].scale is not None
        assert 0 < effect.coefficients[0].scale < shape.upper


def test_an_encoder_offset_of_a_vertical_first_joint_does_not_show(motion):
    assert np.abs(EncoderOffset(0, 0.1).over(motion)).max() < 1e-9


def test_a_torque_sensor_is_as_likely_to_show_half_as_double():
    gain, s = TorqueGain(2), np.array([0.3])
    log_prior = lambda c: gain.beyond_normal(np.array([c]), s) - 0.5 * (c / s[0]) ** 2
    np.testing.assert_allclose(log_prior(1.0), log_prior(-0.5))
    np.testing.assert_allclose(log_prior(1.0), -0.5 * (np.log(2) / s[0]) ** 2)
    assert log_prior(-0.97) < log_prior(0.97) - 50
    assert np.isfinite(log_prior(-1.2))


def test_what_a_saturated_sensor_shows_tells_no_torque_beyond_its_limit():
    t, tau = jnp.arange(3.0), jnp.array([[1.0], [5.0], [-7.0]])
    sensor = UnknownLimit(0, 4.0)
    np.testing.assert_allclose(sensor.sensed(jnp.ones(1), t, tau)[:, 0], [1, 4, -4])
    np.testing.assert_allclose(
        sensor.true(jnp.ones(1), t, sensor.sensed(jnp.ones(1), t, tau))[:, 0], [1, 4, -4]
    )
    half = jnp.full(1, 0.5)
    np.testing.assert_allclose(sensor.true(half, t, sensor.sensed(half, t, tau)), tau)


def test_a_delay_reproduces_the_shifted_torque_where_it_was_linearised(motion):
    d = 0.02
    shifted = motion.torque + TimeDelay(7, d, "whole").over(motion)[..., 0] * d
    np.testing.assert_allclose(shifted[2:], motion.torque[:-2], atol=1e-9)


def test_torque_may_lead_and_a_single_joint_may_lag(motion):
    d = 0.02
    ahead = motion.torque + TimeDelay(7, d, "whole ahead").over(motion)[..., 0] * d
    np.testing.assert_allclose(ahead[:-2], motion.torque[2:], atol=1e-9)
    late = TimeDelay(7, d, "whole", 3)
    one = motion.torque + late.over(motion)[..., 0] * d
    np.testing.assert_allclose(one[2:, 3], motion.torque[:-2, 3], atol=1e-9)
    np.testing.assert_array_equal(np.delete(one, 3, 1), np.delete(motion.torque, 3, 1))
    assert late.joints == (3,)
    told = dataclasses.replace(late, form="whole ahead").parameters(np.array([d]), np.eye(1))
    assert [(p["joint"], p["value"]) for p in told] == [(4, -d)]


def test_a_filter_of_first_order_gives_what_it_is_solved_for(motion):
    T = 0.05
    lag = TimeDelay(7, T, "whole lag", 3)
    shown = motion.torque + lag.over(motion)[..., 0] * T
    fine = scipy.integrate.solve_ivp(
        lambda t, y: (np.interp(t, motion.time, motion.torque[:, 3]) - y) / T,
        motion.time[[0, -1]], shown[:1, 3], t_eval=motion.time, rtol=1e-9, atol=1e-9, max_step=motion.dt,
    )  # fmt: skip
    np.testing.assert_allclose(shown[:, 3], fine.y[0], atol=1e-4)
    np.testing.assert_array_equal(np.delete(shown, 3, 1), np.delete(motion.torque, 3, 1))
    half = lag.sensed(jnp.array([T / 2]), jnp.asarray(motion.time), jnp.asarray(motion.torque))
    np.testing.assert_allclose(half, motion.torque + lag.over(motion)[..., 0] * T / 2, atol=1e-9)
    (told,) = lag.parameters(np.array([T]), np.eye(1))
    assert (told["name"], told["joint"], told["value"]) == ("delay", 4, T)


def test_a_stiff_joint_deflects_by_its_torque_over_its_stiffness(motion):
    K = 2e5
    found = JointElasticity(1, K, 0.2).over(motion)[50:-50, :, 0]
    dq = np.zeros_like(motion.q)
    dq[:, 1] = -motion.load[:, 1]
    expected = motion.sensitivity(dq)[50:-50]
    assert np.abs(found - expected).max() < 0.05 * np.abs(expected).max()


@pytest.mark.parametrize("effect", [JointElasticity, Backlash])
def test_a_gear_too_soft_for_a_heavy_arm_does_not_let_it_fall(arm, motion, effect):
    heavy = Motion(
        eqx.tree_at(lambda a: a.standard, arm, 200 * arm.standard),
        motion.time,
        motion.q,
        motion.qd,
        motion.qdd,
        np.zeros_like(motion.q),
    )
    slope = -heavy.slope[:, 1].min()
    assert slope > 5000
    at_joint = [e for e in effect.grid(heavy.arm) if e.joint == 1]
    found = effect.over_many(at_joint, heavy)[:, 1]
    most = 2 * max(2 * slope, 15000.0) * np.abs(heavy.load).max()
    assert np.isfinite(found).all()
    assert np.abs(found).max() < (most if effect is JointElasticity else most / at_joint[0].half_width)


@pytest.mark.slow
def test_what_a_simulation_applies_is_what_inverse_dynamics_has(arm, motion, channels):
    """Along a motion, resistance and damping of the step add up to the columns times the coefficients."""
    for effect in shapes(arm):
        if (
            effect.acts_on != "plant"
            or effect.standard_change(np.zeros(len(effect.coefficients))) is not None
            or effect.name == "gravity_direction"
        ):
            continue  # what MJCF holds natively
        c = jnp.linspace(0.3, 0.5, len(effect.coefficients))

        def step(z, s, effect=effect, c=c):
            done = effect.resist(c, arm, z, s, motion.dt)
            return done.state, done.torque + done.damping * s.qd

        z = effect.begin(c, arm, jax.tree.map(lambda a: jnp.asarray(a[0]), channels))
        found = np.array(jax.jit(lambda s, z=z, step=step: jax.lax.scan(step, z, s)[1])(channels))
        if (carried := effect.carried(c)) is not None:  # what the simulator's model holds
            link, phi = carried
            found += motion.regressor[:, :, 10 * link : 10 * link + 10] @ np.asarray(phi)
        expected = columns(effect, motion, channels) @ np.asarray(c)
        np.testing.assert_allclose(found, expected, atol=1e-9, err_msg=str(effect))


def test_torque_sensors_show_what_the_columns_add(arm, motion, channels):
    for effect in shapes(arm):
        if effect.acts_on != "torque":
            continue
        if effect.name == "time_delay":
            effect = dataclasses.replace(effect, form=effect.form.replace("smooth", "whole"))
        d = 0.02  # a delay of two samples is where its column is exact
        c = jnp.full(1, -effect.around if effect.name == "time_delay" else d)
        c = jnp.linspace(d, 2 * d, len(effect.coefficients)) if effect.name != "time_delay" else -c
        shown = effect.sensed(c, jnp.asarray(motion.time), jnp.asarray(motion.torque))
        expected = motion.torque + columns(effect, motion, channels) @ np.asarray(c)
        np.testing.assert_allclose(shown, expected, atol=1e-9, err_msg=str(effect))
        back = effect.true(c, jnp.asarray(motion.time), shown)
        inside = slice(10, -10)  # a delay does not know what was before and after
        np.testing.assert_allclose(back[inside], motion.torque[inside], atol=0.05, err_msg=str(effect))


def test_a_position_sensor_beyond_a_spring_shows_the_motion_that_takes_the_torque(arm, motion):
    """The columns, on what the sensor shows of a motion, give the torque of the motion itself."""
    K = 4000.0
    for effect, c in (
        (JointElasticity(1, K, 0.2), 1 / K),
        (Backlash(3, 0.01, 1e4), 0.01),
        (EncoderOffset(2, 0.05), 0.05),
    ):
        c = jnp.full(len(effect.coefficients), c)
        s = Channels(motion.time, motion.q, motion.qd, motion.qdd, motion.torque, motion.torque)
        z = effect.begin(c, arm, jax.tree.map(lambda a: jnp.asarray(a[0]), s))

        def step(z, s, effect=effect, c=c):
            return effect.shift(c, arm, z, s, motion.dt)[::-1]

        shown = motion.moved(np.asarray(jax.lax.scan(step, z, s)[1]))
        left = shown.load + effect.over(shown) @ np.asarray(c) - motion.load
        before = shown.load - motion.load
        middle = slice(60, -60)
        assert np.abs(left[middle]).max() < 0.1 * np.abs(before[middle]).max(), effect


def test_the_torque_through_a_twisted_joint_is_that_of_its_spring(arm, motion):
    """Where the law is stiff the link follows the sensor; else the joint transmits what its spring gives."""
    K, b = 3000.0, 0.004
    added = twist_torque(motion, [Law(1, K, 0.5, half_width=b)])[:, :, 0]
    transmitted = motion.load[:, 1] + added[:, 1]
    # The spring's own torque, from a second solution of the same equation by scipy.
    M, g = (scipy.interpolate.CubicSpline(motion.time, x[:, 1]) for x in (motion.inertia, motion.slope))
    load = scipy.interpolate.CubicSpline(motion.time, motion.load[:, 1])
    d = 2 * 0.5 * np.sqrt(K * motion.mean_inertia[1])

    def torque(x, v):
        y = x - np.clip(x, -b, b)
        return -K * y - d * v * (y != 0)

    def slope(t, z):
        return z[1], (torque(*z) - load(t) - g(t) * z[0]) / M(t)

    start = [-load(0.0) / K - b * np.sign(load(0.0)), 0.0]
    found = scipy.integrate.solve_ivp(slope, (0, motion.time[-1]), start, t_eval=motion.time, max_step=1e-3)
    expected = np.array([torque(*z) for z in found.y.T])
    inside = slice(30, -30)
    error = np.abs(transmitted - expected)[inside]
    assert np.median(error) < 0.01 * np.abs(expected).max()
    assert np.mean(error**2) < 0.01 * np.mean(added[inside, 1] ** 2) + 0.002 * np.mean(expected**2)


def test_backlash_under_a_load_of_one_sign_is_an_encoder_offset_on_stiff_stops(arm, motion):
    b, j = 0.003, 3
    still = Motion(arm, motion.time, motion.q, 0.05 * motion.qd, 0.05**2 * motion.qdd, motion.friction)
    assert still.load[:, j].max() * still.load[:, j].min() > 0
    offset = (
        EncoderOffset(j, -b * np.sign(still.load[0, j])).over(still)[..., 0] * -b * np.sign(still.load[0, j])
    )
    found = Backlash(j, b, 1e5).over(still).sum(-1) * b
    np.testing.assert_allclose(found[30:-30], offset[30:-30], atol=0.1 * np.abs(offset).max())


def test_a_link_that_leaves_its_stop_transmits_nothing_until_the_other_one(arm, motion):
    """A load that swings about zero and a gap too wide to cross: torque stays at zero once it got there."""
    j = 6
    load = motion.load[:, j]
    gone = int(np.argmax(load * np.sign(load[0]) < 0))
    assert 10 < gone < 350
    transmitted = load + Backlash(j, 0.1, 1e5, form="whole").over(motion).sum(-1)[:, j] * 0.1
    soon = slice(gone + 5, gone + 12)
    assert np.abs(transmitted[soon]).max() < 0.1 * np.abs(load[soon]).max()


def test_shapes_evaluated_together_are_those_evaluated_alone(arm, motion):
    for effects in (JointElasticity.grid(arm)[:9], Backlash.grid(arm)[:9]):
        together = type(effects[0]).over_many(effects, motion)
        for i in (0, 8):
            np.testing.assert_allclose(together[:, :, i], effects[i].over(motion), atol=1e-8)


def test_a_gear_that_stiffens_twists_less(motion):
    soft, stiff = (JointElasticity(1, 400.0, 0.3, s).over(motion)[..., 0] for s in (0.0, 1e-3))
    assert np.sqrt(np.mean(stiff**2)) < 0.9 * np.sqrt(np.mean(soft**2))


@pytest.mark.parametrize("period", [9.0, 30.0])
def test_a_bias_that_wandered_returns_to_its_mean_as_far_as_that_was_seen(period):
    effect = TorqueDrift(0, period, "wandering", until=20.0)
    c, none = np.array([0.01, 0.3, 0.2, -0.4, 0.1, 0.2]), np.zeros(7)
    at = jax.jit(jax.vmap(lambda t: effect.at(Channels(t, none, none, none, none, none)) @ c))
    mean = np.mean(np.asarray(at(np.linspace(0, 20, 2001))))
    here, beyond, late = np.asarray(at(np.array([20.0, 20.0 + 1e-9, 300.0])))
    assert beyond == pytest.approx(here, abs=1e-6)
    assert late == pytest.approx(mean * 20 / (20 + period), abs=1e-3)
    begin, before = np.asarray(at(np.array([0.0, -1e-9])))
    assert before == pytest.approx(begin, abs=1e-6)
    early = np.asarray(at(np.array([-280.0])))[0]  # where it came from is as little known
    assert early == pytest.approx(late, abs=1e-3)
    another = effect.counted_from(50.0)
    another = dataclasses.replace(another, until=70.0)
    moved = jax.vmap(lambda t: another.at(Channels(t, none, none, none, none, none)) @ c)
    np.testing.assert_allclose(
        moved(np.array([45.0, 60.0, 90.0])), at(np.array([-5.0, 10.0, 40.0])), atol=1e-9
    )
