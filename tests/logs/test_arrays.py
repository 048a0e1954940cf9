"""Parquet, LeRobot, HDF5 and MATLAB files, each written by the library of the format."""

import dataclasses
import json
import sys

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from made import assert_same, made

from jaxpanda.errors import InputError, MissingExtraError
from jaxpanda.recordings import Reading, Recording, load, load_many


def joints(name: str, channel: np.ndarray) -> dict[str, np.ndarray]:
    return {f"{name}_{j + 1}": channel[:, j] for j in range(channel.shape[1])}


def test_voraus_episodes_are_chosen_and_the_link_s_torque_is_taken(tmp_path):
    one, two = made(dof=6), made(dof=6, samples=150)
    both = lambda a, b: np.concatenate([a, b])
    columns = {"sample": np.repeat([12, 755], [200, 150]), "time": both(one.time, two.time)}
    for name, channel in (("joint_position", "q"), ("joint_velocity", "qd"), ("torque_sensor_a", "tau")):
        columns |= joints(name, both(getattr(one, channel), getattr(two, channel)))
    columns |= joints("motor_torque", both(one.tau, two.tau) + 1)
    pq.write_table(pa.table(columns), tmp_path / "voraus.parquet")
    with pytest.raises(InputError, match=r"holds 2 episodes \(12, 755\): choose by --episode"):
        load(tmp_path / "voraus.parquet")
    with pytest.raises(InputError, match="no episode 3; it holds 2 episodes"):
        load(tmp_path / "voraus.parquet", reading=Reading(episode=("3",)))
    assert_same(load(tmp_path / "voraus.parquet", reading=Reading(episode=("755",))), two)
    read = load_many([tmp_path / "voraus.parquet"], Reading(episode=("755", "12")))
    assert [r.name for r in read] == ["voraus.parquet (episode 755)", "voraus.parquet (episode 12)"]
    motor = load(tmp_path / "voraus.parquet", reading=Reading(("tau=motor_torque_{j}",), episode=("12",)))
    assert motor.origin is not None
    assert motor.origin.torque == "motor_side"
    assert np.array_equal(motor.require_tau(), one.tau + 1)


def lerobot(folder, version: str, episodes: list[Recording], names) -> None:
    """A data set as LeRobot lays it out: version 2 has a file an episode, version 3 many in one."""
    features = {
        "observation.state": {"dtype": "float32", "shape": [8], "names": names},
        "observation.effort": {"dtype": "float32", "shape": [7], "names": None},
    }
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(
        json.dumps({"codebase_version": version, "fps": 100, "features": features})
    )
    tables = []
    for number, r in enumerate(episodes):
        state = np.column_stack([r.q, np.full(r.samples, 0.04)]).astype(np.float32)
        columns = {
            "observation.state": pa.FixedSizeListArray.from_arrays(pa.array(state.ravel()), 8),
            "observation.effort": pa.array(r.tau.astype(np.float32).tolist(), pa.list_(pa.float32())),
            "timestamp": pa.array(r.time.astype(np.float32)),
            "episode_index": pa.array(np.full(r.samples, number)),
        }
        tables.append(pa.table(columns))
    data = folder / "data" / "chunk-000"
    data.mkdir(parents=True)
    if version.startswith("v3"):
        pq.write_table(pa.concat_tables(tables), data / "file-000.parquet")
    else:
        for number, one in enumerate(tables):
            pq.write_table(one, data / f"episode_{number:06d}.parquet")


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_lerobot_s_joints_are_told_by_their_names(tmp_path, version):
    episodes = [made(), made(samples=300)]
    names = {"motors": [f"joint_{j}.pos" for j in range(1, 8)] + ["gripper.pos"]}
    lerobot(tmp_path / "set", version, episodes, names)
    with pytest.raises(InputError, match=r"set: holds 2 episodes \(0, 1\): choose by --episode"):
        load(tmp_path / "set")
    read = load(tmp_path / "set", reading=Reading(episode=("1",)))
    assert (read.samples, read.dof) == (300, 7)
    assert np.array_equal(read.q, episodes[1].q.astype(np.float32))
    assert read.tau is not None
    assert np.array_equal(read.tau, episodes[1].tau.astype(np.float32))
    assert read.origin is not None
    assert read.origin.torque == "unstated"


def test_lerobot_s_joints_come_in_the_order_of_their_numbers(tmp_path):
    order = [0, 2, 1, 3, 6, 5, 4]
    written = made()
    shuffled = dataclasses.replace(written, q=written.q[:, order], tau=written.tau[:, order])
    lerobot(tmp_path / "set", "v3.0", [shuffled], [f"joint_{j + 1}" for j in order] + ["gripper"])
    read = load(tmp_path / "set")
    assert np.array_equal(read.q, written.q.astype(np.float32))
    assert np.array_equal(read.require_tau(), written.tau.astype(np.float32))


def test_lerobot_without_names_asks_which_is_which(tmp_path):
    lerobot(tmp_path / "set", "v3.0", [made()], None)
    with pytest.raises(
        InputError, match=r"no columns q_1, q_2, …; it has the columns observation\.state\[\{j\}\]"
    ):
        load(tmp_path / "set")
    read = load(tmp_path / "set", reading=Reading(("time=timestamp", "q=observation.state[0:7]")))
    assert np.array_equal(read.q, made().q.astype(np.float32))


def test_lerobot_at_thirty_hertz_is_too_slow_and_says_so(tmp_path):
    lerobot(tmp_path / "set", "v3.0", [made(rate=30)], [f"joint{j}" for j in range(1, 8)] + ["gripper"])
    with pytest.raises(InputError, match=r"30 Hz.*from 50 Hz to 4000 Hz"):
        load(tmp_path / "set")


def test_droid_s_trajectory_gives_the_measured_torque(tmp_path):
    r = made()
    with h5py.File(tmp_path / "trajectory.h5", "w") as file:
        state, stamp = "observation/robot_state", "observation/timestamp/robot_state"
        ns = np.round(1e9 * r.time).astype(int)
        file[f"{stamp}/robot_timestamp_seconds"] = 1_700_000_000 + ns // 10**9
        file[f"{stamp}/robot_timestamp_nanos"] = ns % 10**9
        file[f"{state}/joint_positions"], file[f"{state}/joint_velocities"] = r.q, r.qd
        file[f"{state}/motor_torques_measured"] = r.tau
        file[f"{state}/joint_torques_computed"] = 0 * r.tau
    read = load(tmp_path / "trajectory.h5")
    assert_same(read, r)
    assert read.origin is not None
    assert read.origin.torque == "measured"


def test_robomimic_s_demonstrations_are_episodes_with_time_from_the_control_frequency(tmp_path):
    r = made()
    with h5py.File(tmp_path / "demos.hdf5", "w") as file:
        for number in (0, 2, 10):
            demo = file.create_group(f"data/demo_{number}")
            demo["actions"], demo["obs/robot0_joint_pos"], demo["obs/robot0_joint_vel"] = r.q, r.q, r.qd
        file["data"].attrs["env_args"] = json.dumps({"env_kwargs": {"control_freq": 100}})
    with pytest.raises(InputError, match=r"holds 3 episodes \(0, 2, 10\)"):
        load(tmp_path / "demos.hdf5")
    assert_same(load(tmp_path / "demos.hdf5", reading=Reading(episode=("10",))), r, tau=False)


def write_mat(path, version: str, r: Recording) -> None:
    """Structure `rec` with time along the rows of `q`, and along the columns of `tau`."""
    if version == "5":
        scipy.io.savemat(path, {"rec": {"t": r.time, "q": np.degrees(r.q), "tau": r.tau.T}, "arm": "mine"})
        return
    with h5py.File(path, "w", userblock_size=512) as file:  # 7.3 is HDF5 behind a header, transposed
        file["rec/t"], file["rec/q"], file["rec/tau"] = r.time[None, :], np.degrees(r.q).T, r.tau
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_matlab_s_variables_are_called_by_their_path(tmp_path, version):
    r = made()
    write_mat(tmp_path / "log.mat", version, r)
    with pytest.raises(InputError, match=r"no column time; it has the columns .*rec\.q\[\{j\}\]"):
        load(tmp_path / "log.mat")
    read = load(tmp_path / "log.mat", reading=Reading(("time=rec.t", "q=rec.q:deg", "tau=rec.tau")))
    assert_same(read, r, qd=False, atol=1e-15)


@pytest.mark.parametrize("name", ["log.mat", "log.h5", "log.parquet"])
def test_garbage_is_one_sentence(tmp_path, name):
    for content in (b"", b"MATLAB 7.3 MAT-file" + bytes(600), bytes(range(256)) * 20):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=f"{name}: no ") as raised:
            load(tmp_path / name)
        assert "\n" not in str(raised.value)


def test_hdf5_without_h5py_names_the_extra(tmp_path, monkeypatch):
    (tmp_path / "log.h5").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(MissingExtraError, match=r"HDF5 needs the extra \[io\]: pip install 'jaxpanda\[io\]'"):
        load(tmp_path / "log.h5")


def test_voraus_real_episodes_read(data):
    read = load_many([data / "voraus" / "test.parquet"], Reading(episode=("12", "755", "1702", "1703")))
    assert [r.dof for r in read] == [6] * 4
    faulty, *normal = (r.require_tau()[:, 0].mean() for r in read)
    assert faulty - max(normal) > 5 * np.ptp(normal)  # friction was added at axis 1, and its sensor shows it


def test_the_kr300_s_real_mat_reads(data):
    columns = ("time=rec.time_cont", "q=rec.act_pos_mot_deg:deg", "dq=rec.act_vel_mot_deg_per_s:deg/s")
    read = load(data / "kr300" / "run_A.mat", reading=Reading((*columns, "tau=rec.act_torque_abs_nm")))
    assert (read.samples, read.dof, round(read.rate)) == (2501, 6, 250)
