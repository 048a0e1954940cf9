"""What the user says of a log's columns: options by which it is read, refused where they do not fit."""

import json
from pathlib import Path

import numpy as np
import pytest
from helpers import record

from jaxpanda import Recording
from jaxpanda.__main__ import main
from jaxpanda.arms.markup import parse
from jaxpanda.arms.mjcf import with_gravity
from jaxpanda.arms.source import from_document, from_mjcf
from jaxpanda.convention import PLAIN, Convention
from jaxpanda.errors import InputError
from jaxpanda.recordings import save


def three(tau=None) -> Recording:
    """Three joints, each column with its own number."""
    q = np.arange(12.0).reshape(4, 3)
    return Recording("three", np.arange(4.0), q, q + 100, q + 200 if tau is None else tau)


def test_without_options_nothing_is_changed():
    recording = three()
    assert PLAIN.applied([recording]) == [recording]


def test_signs_and_units_are_those_of_joints_in_order():
    said = Convention(
        torque_sign=("+", "-", "+"), torque_unit=("Nm", "mNm", "2.5"), joint_order=("2", "1", "3")
    )
    before = three()
    (read,) = said.applied([before])
    np.testing.assert_array_equal(read.q, before.q[:, [1, 0, 2]])
    assert read.qd is not None
    assert read.tau is not None
    assert before.tau is not None
    np.testing.assert_array_equal(read.qd, read.q + 100)
    np.testing.assert_allclose(read.tau, before.tau[:, [1, 0, 2]] * [1, -1e-3, 2.5])
    assert len(read.notes) == 2


def test_an_order_names_the_joint_of_each_column():
    """The columns _1, _2, _3 are those of joints 2, 3, 1: joint 1 is in the third."""
    before = three()
    (every,) = Convention(joint_order=("2", "3", "1")).applied([before])
    np.testing.assert_array_equal(every.q[0], before.q[0, [2, 0, 1]])
    (alone,) = Convention(joint_order=("tau", "2", "3", "1")).applied([before])
    np.testing.assert_array_equal(alone.q, before.q)
    assert alone.tau is not None
    assert before.tau is not None
    np.testing.assert_array_equal(alone.tau[0], before.tau[0, [2, 0, 1]])


@pytest.mark.parametrize(
    ("said", "why"),
    [
        (Convention(torque_sign=("+", "-")), "2 values"),
        (Convention(torque_sign=("minus",)), "+ or -"),
        (Convention(torque_unit=("Nmmm",)), "lbfin"),
        (Convention(torque_unit=("-1",)), "is expected"),
        (Convention(joint_order=("0", "1", "2")), "from 1 to 3"),
        (Convention(joint_order=("tau",)), "from 1 to 3"),
        (Convention(joint_order=("1", "1", "2")), "expected once"),
    ],
)
def test_options_that_do_not_fit_are_refused(said, why):
    with pytest.raises(InputError, match=why.replace("+", r"\+")):
        said.applied([three()])


@pytest.mark.parametrize("words", [("1", "2"), ("up", "0", "0"), ("0", "0", "nan"), ("gone",)])
def test_a_gravity_that_is_none_is_refused(words):
    with pytest.raises(InputError, match="--gravity"):
        _ = Convention(gravity=words).mounting


INERTIAL = '<inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>'
BODIES = f"""<worldbody><body>{INERTIAL}<joint name="a"/>
  <body>{INERTIAL}<joint name="b"/></body></body></worldbody>"""


@pytest.mark.parametrize(
    "options",
    [
        "",
        '<option timestep="0.01"/>',
        '<option gravity="0 0 -1"/>',
        '<option timestep="0.01"/><option gravity="0 0 -1"/>',
        '<option><flag gravity="disable" contact="disable"/></option>',
    ],
)
def test_gravity_is_put_where_the_file_has_it(options):
    text = f"<mujoco>{options}{BODIES}</mujoco>"
    arm, source = from_document(with_gravity(parse(text, "mujoco", Path("arm.xml")), (9.81, 0.0, 0.1)))
    np.testing.assert_array_equal(arm.chain.gravity, (9.81, 0.0, 0.1))
    np.testing.assert_array_equal(source.model.opt.gravity, (9.81, 0.0, 0.1))
    assert source.model.opt.timestep == (0.01 if "timestep" in options else 0.002)


@pytest.fixture(scope="module")
def log():
    return record(3, seconds=6.0)


def verdicts(capsys, path, *options: str) -> str:
    assert main(["inspect", "--recording", str(path), "--json", *options]) == 0
    (one,) = json.loads(capsys.readouterr().out)["recordings"]
    return "\n".join([*one["verdicts"], *one["notes"]])


def test_a_command_reads_a_log_as_it_is_told(capsys, log, tmp_path):
    order = [0, 3, 2, 1, 4, 5, 6]
    tau = -1000 * log.tau[:, order]
    save(Recording("odd", log.time, log.q[:, order], log.qd[:, order], tau), tmp_path / "odd.csv")
    order_option = ["--joint-order", *(str(j + 1) for j in order)]
    said = verdicts(
        capsys, tmp_path / "odd.csv", *order_option, "--torque-sign", "-", "--torque-unit", "N·mm"
    )
    assert "torque in N m, positive along the joint axis" in said
    assert "gravity is in the torque" in said
    assert "as asked, tau multiplied by -0.001" in said


def test_gravity_that_was_removed_is_added(capsys, log, tmp_path):
    from jaxpanda import Arm
    from jaxpanda.convention import weight_torque

    free = log.tau - weight_torque(Arm.panda(), log.q)
    save(Recording("free", log.time, log.q, log.qd, free), tmp_path / "free.csv")
    assert "holds no gravity" in verdicts(capsys, tmp_path / "free.csv")
    assert "gravity is in the torque" in verdicts(capsys, tmp_path / "free.csv", "--gravity", "removed")


def test_bad_options_are_one_line_and_status_2(capsys, log, tmp_path):
    save(log, tmp_path / "arm.csv")
    for options in (["--torque-sign", "x"], ["--gravity", "1"], ["--joint-orders", "1"]):
        assert main(["inspect", "--recording", str(tmp_path / "arm.csv"), *options]) == 2
        out, err = capsys.readouterr()
        assert not out
        assert err.count("\n") == 1
        assert options[0] in err
    assert "did you mean --joint-order?" in err


@pytest.mark.slow
def test_corrected_xml_stands_in_the_gravity_that_was_told(log, tmp_path):
    """Of a recording with reversed signs, which is answered without a search."""
    save(Recording("arm", log.time, log.q, log.qd, -log.tau), tmp_path / "arm.csv")
    given = ["--recording", str(tmp_path / "arm.csv"), "--out", str(tmp_path / "out")]
    assert main(["diagnose", *given, "--gravity", "0", "0", "-9.7"]) == 0
    arm, _ = from_mjcf(tmp_path / "out" / "corrected.xml")
    np.testing.assert_array_equal(arm.chain.gravity, (0, 0, -9.7))
