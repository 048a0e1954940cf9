"""The body at a flange comes back from pairs that MuJoCo's C engine made, with friction the model lacks."""

import dataclasses
import importlib
import json
import re
import sys
from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np
import payload_pairs as pairs
import pytest
from helpers import result
from jaxpanda_kernels import inertia
from scipy.spatial.transform import Rotation

from jaxpanda.__main__ import main
from jaxpanda.arms.source import from_mjcf
from jaxpanda.errors import InputError
from jaxpanda.files import output_folder, write_json, write_text
from jaxpanda.payload import estimate_payload
from jaxpanda.payload.frame import frame_of
from jaxpanda.payload.result import KIND, result_of
from jaxpanda.recordings import save

TRUTH = np.r_[pairs.BODY.mass, pairs.BODY.com, pairs.BODY.inertia]


def numbers(found) -> tuple[np.ndarray, np.ndarray]:
    """Mass, centre of mass and inertia, and their intervals."""
    parts = found.mass, found.com, found.inertia
    return np.concatenate([p.value for p in parts]), np.concatenate([p.interval for p in parts])


def estimated(tmp_path: Path, pair, **options):
    user, without, loaded = pair
    (tmp_path / "user.xml").write_text(user)
    return estimate_payload(tmp_path / "user.xml", [without], [loaded], **options)


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    """A folder with a user's model and a pair of recordings."""
    folder = tmp_path_factory.mktemp("pair")
    user, without, loaded = pairs.panda_pair(0)
    (folder / "user.xml").write_text(user)
    save(without, folder / "without.csv")
    save(loaded, folder / "with.csv")
    return folder


def command(folder: Path, out: Path, *more: str) -> list[str]:
    given = ["--without", f"{folder / 'without.csv'}", "--with", f"{folder / 'with.csv'}"]
    return ["payload", "--model", f"{folder / 'user.xml'}", *given, "--out", f"{out}", *more]


def test_the_command_finds_the_body_and_writes_it_in_every_form(files, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(command(files, out, "--json")) == 0
    said = json.loads(capsys.readouterr().out)
    assert said == result(out / "payload.json")
    assert said["schema"] == "jaxpanda.payload/1"
    assert said["verdict"] == "found"
    assert said["frame"]["name"] == "flange"
    assert said["frame"]["position_in_last_link"] == pytest.approx([0, 0, 0.107])
    assert said["mass"]["value"] == pytest.approx(pairs.BODY.mass, rel=0.01)
    assert said["com"]["value"] == pytest.approx(pairs.BODY.com, abs=2e-3)
    assert said["mass"]["interval"][0] < pairs.BODY.mass < said["mass"]["interval"][1]

    before = mujoco.MjModel.from_xml_path(f"{files / 'user.xml'}")
    after = mujoco.MjModel.from_xml_path(f"{out / 'with_payload.xml'}")
    body = after.body("payload")
    assert after.body_mass.sum() - before.body_mass.sum() == pytest.approx(said["mass"]["value"])
    assert body.ipos == pytest.approx(said["com"]["value"])
    assert after.body_pos[body.id] == pytest.approx([0, 0, 0.107])
    R = Rotation.from_quat(body.iquat, scalar_first=True).as_matrix()
    I = R @ np.diag(body.inertia) @ R.T
    six = said["inertia"]["value"]
    assert I[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]] == pytest.approx(six, abs=1e-7)
    assert (out / "payload.xml").read_text().strip() in (out / "with_payload.xml").read_text()

    load = said["commands"]["franka"]["setLoad"]
    assert load["load_mass"] == pytest.approx(said["mass"]["value"], abs=1e-4)
    assert load["F_x_Cload"] == pytest.approx(said["com"]["value"], abs=1e-5)
    assert np.reshape(load["load_inertia"], (3, 3)) == pytest.approx(I, abs=1e-6)
    target = said["commands"]["ur"]["set_target_payload"]
    assert [target["m"], *target["cog"]] == [load["load_mass"], *load["F_x_Cload"]]
    assert target["inertia"] == pytest.approx(six, abs=1e-6)
    assert np.all(np.linalg.eigvalsh(inertia.pseudo_inertia(jnp.asarray(_standard(said)))) > 0)


def _standard(said) -> np.ndarray:
    xx, yy, zz, xy, xz, yz = said["inertia"]["value"]
    I = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    mass, com = jnp.asarray(said["mass"]["value"]), jnp.asarray(said["com"]["value"])
    return np.asarray(inertia.from_com(mass, com, jnp.asarray(I)))


def test_the_terminal_says_what_robots_take(files, tmp_path, capsys):
    assert main(command(files, tmp_path / "out")) == 0
    said = capsys.readouterr().out
    for words in (
        "95 % interval",
        "setLoad: mass 1.3",
        "set_target_payload(1.3",
        '<body name="payload"',
        "'flange'",
    ):
        assert words in said


@pytest.mark.slow
def test_intervals_of_twenty_pairs_hold_the_truth(tmp_path):
    inside, off = [], []
    for seed in range(100, 120):
        found = estimated(tmp_path, pairs.panda_pair(seed, seconds=6.0))
        value, interval = numbers(found)
        inside.append((interval[:, 0] <= TRUTH) & (interval[:, 1] >= TRUTH))
        off.append(value - TRUTH)
    assert np.mean(inside) >= 0.85
    assert np.mean(np.array(inside)[:, :4]) >= 0.85  # mass and centre of mass alone
    width = np.median(np.abs(off), 0)
    assert width[0] < 0.01 * pairs.BODY.mass
    assert np.all(width[1:4] < 2e-3)


def test_a_pair_without_a_body_shows_none_and_old_files_go(tmp_path):
    out = tmp_path / "out"
    with output_folder(out, KIND) as folder:
        write_json(folder / "payload.json", {"schema": "jaxpanda.payload/1"})
        for name in ("payload.xml", "with_payload.xml"):
            write_text(folder / name, "from before")
    (out / "mine.txt").write_text("from before")
    user, without, loaded = pairs.panda_pair(3, body=None, seconds=8.0)
    (tmp_path / "user.xml").write_text(user)
    save(without, tmp_path / "without.csv")
    save(loaded, tmp_path / "with.csv")
    assert main(command(tmp_path, out)) == 0
    said = result(out / "payload.json")
    assert said["verdict"] == "no_difference"
    assert "show no difference" in said["summary"][0]
    assert said["com"] is said["inertia"] is said["commands"] is said["mjcf"] is None
    assert {p.name for p in out.iterdir()} == {"payload.json", "mine.txt"}


def test_swapped_recordings_are_told(files):
    """Several of either kind, and of other lengths, are as good as one."""
    _, without, loaded = pairs.panda_pair(0, seconds=8.0)
    _, more, _ = pairs.panda_pair(0, seconds=5.0)
    found = estimate_payload(files / "user.xml", [loaded], [without, dataclasses.replace(more, name="more")])
    assert found.verdict == "lighter"
    assert "swapped" in found.sentences[0]
    assert found.snippet is None


def test_a_slow_motion_tells_no_inertia_but_its_range(tmp_path):
    found = estimated(tmp_path, pairs.panda_pair(1, speed=0.15))
    assert not any(found.inertia.told)
    said = found.to_json()
    assert said["inertia"]["value"] == [None] * 6
    low, high = np.array(said["inertia"]["interval"]).T
    assert np.all((low <= pairs.BODY.inertia) & (pairs.BODY.inertia <= high))
    assert np.all(low[:3] == 0)
    assert any("does not tell the inertia" in sentence for sentence in found.sentences)
    assert said["commands"]["stand_ins"] == [f"inertia {n}" for n in ("xx", "yy", "zz", "xy", "xz", "yz")]
    assert said["not_told"]["directions"]
    assert found.mass.interval[0, 0] < pairs.BODY.mass < found.mass.interval[0, 1]


def test_one_pose_tells_the_mass_and_not_where_it_is(tmp_path):
    """How much of its load friction carries nobody knows of a joint that never moves."""
    _, truth = pairs.panda_truth(5)
    loaded = dataclasses.replace(truth, load=pairs.BODY)
    t = np.arange(800) / pairs.RATE
    q = np.tile(pairs.panda.HOME + 0.2, (len(t), 1))
    still = (t, q, 0 * q, 0 * q)
    a = pairs.record("without", pairs.panda.mjcf(truth), still, None, 1)
    b = pairs.record("with", pairs.panda.mjcf(loaded), still, None, 2)
    found = estimated(tmp_path, (pairs.panda.mjcf(truth), a, b))
    assert not all(found.com.told)
    assert any("where the centre of mass is" in sentence for sentence in found.sentences)
    assert found.mass.interval[0, 0] < pairs.BODY.mass < found.mass.interval[0, 1]
    assert np.ptp(found.mass.interval) > 0.1 * pairs.BODY.mass


def test_poses_held_at_rest_are_enough_for_mass_and_centre_of_mass(tmp_path):
    user, truth = pairs.panda_truth(6)
    loaded = dataclasses.replace(truth, load=pairs.BODY)
    law = pairs.Friction(np.full(7, 0.3), np.full(7, 0.4))
    a = pairs.record("without", pairs.panda.mjcf(truth), pairs.held_poses(1, 6), law, 1)
    b = pairs.record("with", pairs.panda.mjcf(loaded), pairs.held_poses(2, 6), law, 2)
    value, interval = numbers(estimated(tmp_path, (user, a, b)))
    assert np.all((interval[:4, 0] < TRUTH[:4]) & (TRUTH[:4] < interval[:4, 1]))
    assert value[0] == pytest.approx(TRUTH[0], rel=0.03)


@pytest.fixture(scope="module")
def real():
    """Models and loaders of the experiment on real arms."""
    folder = Path(__file__).parents[1] / "experiments" / "real_arms"
    sys.path.insert(0, str(folder))
    yield {name: importlib.import_module(name) for name in ("arms", "recordings")}
    sys.path.remove(str(folder))


@pytest.fixture(scope="module")
def ur(real) -> str:
    """A UR10e as its public numbers have it, with a tool frame that is turned against its last link."""
    text = real["arms"].ur10e([5.0, 5.0, 3.0, 0.5, 0.5, 0.4])
    last = re.search(r'<joint name="joint6"[^>]*>', text)
    assert last is not None
    site = '<site name="tool0" pos="0.01 -0.02 0.11655" euler="0.3 -0.4 2.0"/>'
    return text[: last.end()] + site + text[last.end() :]


def test_a_ur_by_its_motor_currents_in_a_turned_tool_frame(ur, tmp_path):
    """Rotors and much friction are missing from the user's model, as where torque is current times a gain."""
    degrees = 'euler="0.3 -0.4 2.0"'
    assert degrees in ur
    body = pairs.panda.Body(
        4.2, np.array([0.03, 0.05, 0.12]), np.array([0.02, 0.03, 0.015, 0.002, -0.001, 0.003])
    )
    inside = re.sub("<site name=.tool0.", '<body name="load"', ur).replace(
        '2.0"/>', '2.0">' + pairs.inertial(body) + "</body>"
    )
    law = pairs.Friction(np.array([8.0, 10, 7, 2, 2, 2]), np.array([15.0, 15, 10, 3, 3, 3]), 0.2, 0.03, 0.2)
    hotter = dataclasses.replace(law, coulomb=0.95 * law.coulomb, viscous=0.93 * law.viscous)
    middle = np.array([0.0, -1.3, 1.0, -1.2, 0.3, 0.2])
    motions = [pairs.fourier(k, 20.0, 6, middle, 1.1, 0.8) for k in (1, 2)]
    a = pairs.record("without", ur, motions[0], law, 1, noise=0.5)
    b = pairs.record("with", inside, motions[1], hotter, 2, noise=0.5)
    rotors = re.sub(r'armature="[^"]*"', 'armature="0.0"', ur)
    user = re.sub(r'mass="([^"]*)"', lambda m: f'mass="{1.1 * float(m[1])!r}"', rotors)
    found = estimated(tmp_path, (user, a, b))
    assert found.frame.name == "tool0"
    value, interval = numbers(found)
    truth = np.r_[body.mass, body.com, body.inertia]
    assert value[0] == pytest.approx(body.mass, rel=0.01)
    assert value[1:4] == pytest.approx(body.com, abs=4e-3)
    assert np.mean((interval[:, 0] <= truth) & (truth <= interval[:, 1])) >= 0.8

    scaled = estimated(tmp_path, (user, a, b), torque_scale_std=0.4)
    assert scaled.verdict == "found"
    assert np.diff(scaled.mass.interval)[0, 0] == pytest.approx(2 * 1.96 * 0.4 * value[0], rel=0.05)
    assert scaled.com.std == pytest.approx(found.com.std, rel=0.05)
    by_link = estimated(tmp_path, (user, a, b), frame="link6")
    assert by_link.mass.value == pytest.approx(found.mass.value, rel=1e-4)
    turned = found.frame.p + found.frame.R @ found.com.value
    assert by_link.com.value == pytest.approx(turned, abs=1e-3)


def test_parameters_that_no_body_has_are_called_so(ur, tmp_path):
    path = tmp_path / "ur.xml"
    path.write_text(ur)
    _, source = from_mjcf(path)
    frame = frame_of(source, "link6")
    hollow = np.array([2.0, 0.0, 0.0, 0.2, 0.01, 0.0, 0.01, 0.0, 0.0, 0.01])  # 2 kg at 0.1 m need 0.02 kg m²
    prior = np.array([30.0, *[1.0] * 3, *[0.5] * 6])
    for std, distant in ((1e-4, True), (0.05, False)):
        covariance = np.diag((std * np.array([1.0, *[0.1] * 9])) ** 2)
        found = result_of(hollow, covariance, prior, frame, source, "ur", {}, [], 0.0)
        assert not found.feasible
        assert any("No real body" in sentence for sentence in found.sentences) is distant
        assert found.body is not None
        assert np.linalg.eigvalsh(np.asarray(inertia.pseudo_inertia(jnp.asarray(found.body))))[0] > 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (["--frame", "hand"], "'hand' is no body or site fixed to the last link"),
        (["--torque-scale-std", "2"], "a share of 0 to 1"),
        (["--with"], "needs --with|--with"),
        (["--with", "WITHOUT"], "given twice"),
        (["--with", "MOTION"], "no columns tau_1"),
        (["--with", "SIX"], "6 joints"),
    ],
)
def test_bad_input_is_one_sentence_and_leaves_nothing(files, tmp_path, capsys, change, words):
    table = (files / "with.csv").read_text().splitlines()
    head = table[0].split(",")
    for name, drop in (("MOTION", "tau_"), ("SIX", "_7")):
        kept = [k for k, column in enumerate(head) if drop not in column]
        rows = [",".join(np.array(row.split(","))[kept]) for row in table[:800]]
        (tmp_path / f"{name}.csv").write_text("\n".join(rows) + "\n")
    paths = {"WITHOUT": files / "without.csv", "MOTION": tmp_path / "MOTION.csv", "SIX": tmp_path / "SIX.csv"}
    arguments = command(files, tmp_path / "out")
    if change[0] == "--with":
        at = arguments.index("--with")
        arguments[at : at + 2] = []
    assert main([*arguments, *(str(paths.get(word, word)) for word in change)]) == 2
    said = capsys.readouterr().err
    assert re.search(words, said)
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_both_kinds_of_recordings_are_needed(files):
    _, without, _ = pairs.panda_pair(0, seconds=8.0)
    with pytest.raises(InputError, match="no recording with the body"):
        estimate_payload(files / "user.xml", [without], [])


@pytest.mark.slow
@pytest.mark.parametrize("gains", ["main.m", "UR10E_parameters.txt"])
def test_the_real_ur10e_carries_its_load_within_what_its_gains_leave_open(real, data, tmp_path, gains):
    (tmp_path / "ur.xml").write_text(real["arms"].ur10e())
    of = lambda name: real["recordings"].ur10e(data, name, gains)
    unloaded, loaded = of("02_19_14harm50sec"), of("02_19_14harm50secLoad")
    found = estimate_payload(tmp_path / "ur.xml", [unloaded], [loaded], torque_scale_std=0.1)
    assert found.verdict == "found"
    assert found.mass.interval[0, 0] < 2.805 < found.mass.interval[0, 1]
    assert np.diff(found.mass.interval)[0, 0] < 1.4
    other = estimate_payload(tmp_path / "ur.xml", [of("02_12-50sec_12harm")], [unloaded])
    assert other.verdict == "no_difference"
    assert np.abs(other.mass.interval).max() < 0.1
