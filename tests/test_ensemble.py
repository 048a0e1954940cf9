"""Members of an ensemble can all be built, spread as the posterior says, and their torque holds the truth."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers import result
from jaxpanda_kernels import inertia
from jaxpanda_kernels import rnea as inverse_dynamics
from test_excitation import ARM

from jaxpanda import Arm, Ensemble, InputError, Retrieval, draw_ensemble, identify, retrieve
from jaxpanda.__main__ import main
from jaxpanda.arms.source import from_mjcf
from jaxpanda.ensemble import sampler
from jaxpanda.feasible import Bounds
from jaxpanda.posterior import Posterior
from jaxpanda.signals import prepare
from jaxpanda.simulation import JointFriction, Sensors, perturbed, random_trajectory, simulate

CHAINS, SWEEPS = 64, 60
FRICTION = JointFriction(viscous=0.5, coulomb=0.3, offset=0.1, width=0.005)
SENSORS = Sensors(torque_noise=0.05, torque_correlation_time=0.02)


def recorded(seed, *, seconds=12.0, sensors=SENSORS, truth=None):
    model = perturbed(ARM, 1) if truth is None else truth
    motion = random_trajectory(ARM, seed, period=8.0)
    return simulate(
        model, motion, duration=seconds, rate=200.0, friction=FRICTION, sensors=sensors, seed=seed
    )


SLOW = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What `identify` and `retrieve` leave of the three-joint arm."""
    path = tmp_path_factory.mktemp("chain")
    (path / "arm.xml").write_text(ARM)
    arm, _ = from_mjcf(path / "arm.xml")
    found = dataclasses.replace(identify(recorded(1), arm, folds=2), model_file=str(path / "arm.xml"))
    retrieve(found, starts=64, certificate=False).save(path / "run")
    return path


@pytest.fixture(scope="module")
def members(folder):
    return draw_ensemble(folder / "run", count=256, seed=0, chains=CHAINS, sweeps=SWEEPS)


@SLOW
def test_every_member_can_be_built_within_bounds(folder, members):
    posterior = Retrieval.load(folder / "run").posterior
    assert posterior is not None
    bounds = posterior.bounds
    assert bounds.total_mass is not None
    mass, com, six = members.bodies()
    J = np.asarray(jax.vmap(jax.vmap(inertia.pseudo_inertia))(jnp.asarray(members.standard)))
    assert np.all(np.linalg.eigvalsh(J)[..., 0] > 0)
    for values, box in ((mass, bounds.mass), (com, bounds.com), (six, bounds.inertia)):
        assert np.all((values >= box[..., 0] - 1e-9) & (values <= box[..., 1] + 1e-9))
    assert np.all(np.abs(mass.sum(1) - bounds.total_mass.mean()) <= np.ptp(bounds.total_mass) / 2 + 1e-9)
    assert np.all(members.own("viscous") >= 0)
    assert np.all(members.own("coulomb") >= 0)


@SLOW
def test_what_torque_cannot_tell_differs_and_what_it_tells_does_not(folder, members):
    mass = members.bodies()[0]
    assert np.all(mass.std(0) > 0.1)  # single masses are not identified
    motion = recorded(3, seconds=4.0)
    _, torque = members.torque(motion)
    assert torque.std(0).max() < 0.1 * np.abs(torque).max()
    links = np.ptp(members.standard[..., 0], axis=0)
    assert np.all(links > 0.2)


@SLOW
def test_held_out_torque_lies_in_the_band(members):
    inside = []
    for seed in (5, 6, 7):
        for measured, sensors in ((True, SENSORS), (False, Sensors())):
            motion = recorded(seed, sensors=sensors)
            signals = prepare(motion)
            _, low, high = members.band(motion, measured=measured)
            torque = signals.lowpass(signals.tau)
            inside.append((measured, np.mean((low <= torque) & (torque <= high))))
    assert 0.84 < np.mean([share for measured, share in inside if measured]) < 0.95
    assert np.mean([share for measured, share in inside if not measured]) > 0.5


@SLOW
def test_a_band_without_the_uncertainty_would_be_too_narrow_or_too_wide(members):
    motion = recorded(8)
    widths = []
    for level in (0.5, 0.9):
        _, low, high = members.band(motion, level=level)
        widths.append(np.mean(high - low))
    assert widths[0] < 0.55 * widths[1]


@pytest.mark.slow
def test_hit_and_run_finds_a_uniform_and_a_gaussian():
    """One link of which only the first moment along x is told: the mass is uniform up to its bound."""
    bounds = Bounds(
        mass=np.array([[1.0, 3.0]]),
        com=np.array([[[-0.5, 0.5]] * 3]),
        inertia=np.array([[[0, 10.0]] * 3 + [[-10.0, 10.0]] * 3]),
    )
    told = np.zeros((1, 11))
    told[0, 10] = 1.0
    posterior = Posterior(
        told=told,
        mean=np.array([2.0]),
        covariance=np.array([[0.04]]),
        names=("viscous_1",),
        least=np.array([0.0]),
        bounds=bounds,
        carried=np.zeros((1, 10)),
        noise=np.zeros(1),
    )
    start = np.asarray(inertia.from_com(jnp.asarray(2.0), jnp.zeros(3), 2.0 * jnp.eye(3)))
    draws = sampler.draw(posterior, start[None, None], 4000, 0, chains=200, sweeps=200)
    assert draws.extra[:, 0].mean() == pytest.approx(2.0, abs=0.03)
    assert draws.extra[:, 0].std() == pytest.approx(0.2, rel=0.1)
    x = draws.standard[:, 0, 1] / draws.standard[:, 0, 0]
    assert np.mean(x) == pytest.approx(0.0, abs=0.03)  # by symmetry
    assert draws.rhat < 1.2


@SLOW
def test_a_constraint_of_the_users_holds():
    bounds = Bounds(
        mass=np.array([[1.0, 3.0]]),
        com=np.array([[[-0.5, 0.5]] * 3]),
        inertia=np.array([[[0, 10.0]] * 3 + [[-10.0, 10.0]] * 3]),
    )
    posterior = Posterior(
        told=np.eye(10)[:1],
        mean=np.array([2.0]),
        covariance=np.array([[0.25]]),
        names=(),
        least=np.zeros(0),
        bounds=bounds,
        carried=np.zeros((1, 10)),
        noise=np.zeros(1),
    )
    start = np.asarray(inertia.from_com(jnp.asarray(2.0), jnp.zeros(3), 2.0 * jnp.eye(3)))
    heavy = lambda links: links.mass - 2.0
    draws = sampler.draw(
        posterior, start[None, None] * 1.2, 500, 0, constraints=[heavy], chains=100, sweeps=40
    )
    assert draws.standard[:, 0, 0].min() >= 2.0
    assert 2.2 < draws.standard[:, 0, 0].mean() < 2.7  # a normal about 2, cut there


@SLOW
def test_mjx_and_mjcf_hold_the_members(folder, members, tmp_path):
    mjx = pytest.importorskip("mujoco.mjx")
    model, in_axes = members.mjx(members=[0, 1, 2])
    data = mjx.make_data(members.template())
    q = jnp.asarray([0.3, -0.5, 0.8])
    qd = jnp.asarray([0.5, 1.0, -0.7])

    def passive(model, data):
        out = mjx.rne(model, mjx.com_vel(model, mjx.com_pos(model, mjx.kinematics(model, data))))
        return out.qfrc_bias

    bias = np.asarray(jax.vmap(passive, in_axes=(in_axes, None))(model, data.replace(qpos=q, qvel=qd)))
    for k in range(3):
        ours = inverse_dynamics(members.arm.chain, jnp.asarray(members.standard[k]), q, qd, jnp.zeros(3))
        assert np.allclose(bias[k], ours, atol=1e-8)
        members.mjcf(k).save(tmp_path / f"{k}.xml")
        read = Arm.from_mjcf(tmp_path / f"{k}.xml")
        assert np.allclose(read.standard, members.standard[k], atol=1e-8)
        assert np.allclose(read.damping, members.own("viscous")[k])
    compiled = mujoco.MjModel.from_xml_path(str(tmp_path / "1.xml"))
    link = members.template().body("two").id
    assert compiled.body_mass[link] == pytest.approx(float(model.body_mass[1, link]))


@SLOW
def test_command_leaves_what_it_says(folder, members, tmp_path, capsys):
    out = tmp_path / "ensemble"
    given = [
        "ensemble",
        "--retrieval",
        str(folder / "run"),
        "--count",
        "256",
        "--seed",
        "0",
        "--sweeps",
        "60",
    ]
    assert main([*given, "--out", str(out), "--mjcf", "1", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert result(out / "ensemble.json")["count"] == document["count"] == 256
    assert (out / "member_1.xml").is_file()
    again = Ensemble.load(out)
    assert again.count == 256
    assert again.names == members.names
    motion = recorded(3, seconds=4.0)
    assert np.allclose(again.torque(motion, [0])[1], again.torque(motion, slice(0, 1))[1])
    mass = np.load(out / "ensemble.npz")["mass"]
    assert np.allclose(mass, again.standard[..., 0])


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ([], "give either --retrieval or --diagnosis"),
        (["--retrieval", "nowhere"], "is not there"),
        (["--retrieval", "nowhere", "--mjcf", "9", "--count", "2"], "--mjcf 9"),
        (["--diagnosis", "nowhere"], "corrected.json"),
    ],
)
def test_bad_usage_is_one_sentence(tmp_path, capsys, given, said):
    assert main(["ensemble", *given, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@SLOW
def test_a_table_without_deviations_has_no_ensemble():
    table = {"coefficients": [{"terms": {"m1": 1}, "value": 2.0}]}
    bounds = Bounds(
        mass=np.array([[1.0, 3.0]]),
        com=np.array([[[-0.5, 0.5]] * 3]),
        inertia=np.array([[[0, 10.0]] * 3 + [[-10.0, 10.0]] * 3]),
    )
    links = retrieve(table, bounds=bounds, starts=4, prefer="best", certificate=False)
    with pytest.raises(InputError, match="no standard deviations"):
        draw_ensemble(links, count=2)
