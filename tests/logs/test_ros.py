"""Bags written by rosbags itself: ROS 1, and ROS 2 as sqlite3 and MCAP."""

import contextlib
import dataclasses
import sqlite3
import sys
from pathlib import Path

import numpy as np
import pytest
from made import assert_same, made
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from jaxpanda.errors import InputError, MissingExtraError
from jaxpanda.recordings import Reading, Recording, load

EPOCH = 1_700_000_000
CHANNELS = {"q": "position", "dq": "velocity", "tau": "effort"}
FRANKA = [f"panda_joint{j}" for j in range(1, 8)]
UR = [
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
]
FRANKA_STATE = "std_msgs/Header header\nfloat64[7] q\nfloat64[7] dq\nfloat64[7] tau_J\nfloat64[7] tau_J_d\n"
ROBOT_STATE = (
    "std_msgs/Header header\nsensor_msgs/JointState measured_joint_state\n"
    "sensor_msgs/JointState desired_joint_state\nfloat64[7] dtau_j\nfloat64 time\n"
)
LBR_STATE = (
    "float64 sample_time\nuint32 time_stamp_sec\nuint32 time_stamp_nano_sec\nfloat64[7] measured_joint_position\n"
    "float64[7] measured_torque\nfloat64[7] external_torque\n"
)


class Bag:
    """Writes messages into a bag of one of the three kinds."""

    def __init__(self, path: Path, kind: str):
        self.path, self.kind = path, kind
        self.store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
        for name, text in (
            ("franka_msgs/msg/FrankaState", FRANKA_STATE),
            ("franka_msgs/msg/FrankaRobotState", ROBOT_STATE),
            ("lbr_fri_idl/msg/LBRState", LBR_STATE),
        ):
            self.store.register(get_types_from_msg(text, name))
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        self.writer = Writer1(path) if kind == "ros1" else Writer2(path, version=9, storage_plugin=plugin)

    def __enter__(self):
        self.writer.open()
        self.topics = {}
        return self

    def __exit__(self, *_):
        self.writer.close()

    def header(self, at: float):
        ns = round(at * 1e9)
        Time, Header = (
            self.store.types["builtin_interfaces/msg/Time"],
            self.store.types["std_msgs/msg/Header"],
        )
        stamp = Time(sec=EPOCH + ns // 10**9, nanosec=ns % 10**9)
        return Header(**({"seq": 0} if self.kind == "ros1" else {}), stamp=stamp, frame_id="")

    def joint_state(self, at, names, q, qd, tau):
        JointState = self.store.types["sensor_msgs/msg/JointState"]
        return JointState(
            header=self.header(at),
            name=list(names),
            position=np.array(q),
            velocity=np.array(qd),
            effort=np.array(tau),
        )

    def write(self, topic: str, at: float, message) -> None:
        kind = message.__msgtype__
        if topic not in self.topics:
            self.topics[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.kind == "ros1" else self.store.serialize_cdr
        late = round((at + 0.003 * (1 + np.sin(99 * at))) * 1e9)  # received late, by more or less
        self.writer.write(self.topics[topic], EPOCH * 10**9 + late, serialize(message, kind))


def bag(tmp_path: Path, kind: str) -> Bag:
    return Bag(tmp_path / ("log.bag" if kind == "ros1" else "log"), kind)


def joint_states(b: Bag, names, written: Recording, topic: str = "/joint_states", order=None) -> None:
    order = list(range(written.dof)) if order is None else order
    for t, q, qd, tau in zip(written.time, written.q, written.qd, written.tau, strict=True):
        b.write(topic, t, b.joint_state(t, [names[k] for k in order], q[order], qd[order], tau[order]))


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_joint_states_read_by_name_and_by_the_header_s_stamp(tmp_path, kind):
    written = made()
    with bag(tmp_path, kind) as b:
        joint_states(b, FRANKA, written, order=[6, 0, 5, 1, 4, 2, 3])
        for t in written.time[::3]:  # the gripper's joints, on the same topic
            b.write("/joint_states", t, b.joint_state(t, ["panda_finger_joint1"], [0.04], [0.0], [0.0]))
    read = load(b.path)
    assert read.repairs == {"messages that lack these joints left out": 67}
    assert_same(dataclasses.replace(read, repairs={}), written)
    assert read.origin is not None
    assert read.origin.torque == "measured"
    assert any("/joint_states" in note for note in read.notes)


@pytest.mark.parametrize(("kind", "suffix"), [("sqlite3", ".db3"), ("mcap", ".mcap")])
def test_a_bag_s_file_alone_reads_as_its_folder(tmp_path, kind, suffix):
    with bag(tmp_path, kind) as b:
        joint_states(b, FRANKA, made())
    (file,) = b.path.glob(f"*{suffix}")
    assert_same(load(file), made())


def test_a_ur_s_joints_are_put_in_the_arm_s_order_and_effort_is_not_vouched_for(tmp_path):
    written = made(dof=6)
    with bag(tmp_path, "mcap") as b:
        joint_states(b, [f"ur_{name}" for name in UR], written, order=list(np.argsort(UR)))
    read = load(b.path)
    assert_same(read, written)
    assert read.origin is not None
    assert read.origin.torque == "unstated"
    assert "current" in read.origin.says
    assert "July 2026" in read.origin.says


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_franka_state_gives_tau_J_and_none_of_the_commanded(tmp_path, kind):
    written = made()
    with bag(tmp_path, kind) as b:
        State = b.store.types["franka_msgs/msg/FrankaState"]
        for t, q, qd, tau in zip(written.time, written.q, written.qd, written.tau, strict=True):
            b.write("/franka_states", t, State(b.header(t), q, qd, tau, 0 * tau))
    read = load(b.path)
    assert_same(read, written)
    assert read.origin is not None
    assert (read.origin.torque, read.origin.channels["tau"]) == ("measured", "tau_J[0] … tau_J[6]")
    commanded = load(b.path, columns={"tau": "tau_J_d[{j}]"})
    assert commanded.tau is not None
    assert not commanded.tau.any()


def test_franka_robot_state_is_read_and_several_topics_are_a_question(tmp_path):
    written, other = made(), made()
    other = dataclasses.replace(other, q=other.q + 1)
    with bag(tmp_path, "sqlite3") as b:
        State = b.store.types["franka_msgs/msg/FrankaRobotState"]
        names = [f"fr3_joint{j}" for j in range(1, 8)]
        for k, t in enumerate(written.time):
            measured = b.joint_state(t, names, written.q[k], written.qd[k], written.tau[k])
            desired = b.joint_state(t, names, other.q[k], other.qd[k], other.tau[k])
            b.write("/state", t, State(b.header(t), measured, desired, np.zeros(7), t))
        joint_states(b, names, other)
    with pytest.raises(
        InputError, match=r"2 topics .*/joint_states \(sensor_msgs/JointState\), /state.*--topic"
    ):
        load(b.path)
    assert_same(load(b.path, reading=Reading(topic="/state")), written)
    assert_same(load(b.path, reading=Reading(topic="joint_states")), other)
    with pytest.raises(InputError, match="no messages on --topic /states; it has /joint_states"):
        load(b.path, reading=Reading(topic="/states"))


def test_two_arms_on_one_topic_are_a_question_that_columns_answers(tmp_path):
    written = made()
    with bag(tmp_path, "mcap") as b:
        names = [f"left_joint_{j}" for j in range(1, 5)] + [f"right_joint_{j}" for j in range(1, 4)]
        joint_states(b, names, written)
    with pytest.raises(InputError, match=r"2 arms: choose by --columns q=position\.left_joint_\{j\}"):
        load(b.path)
    left = load(b.path, columns={"q": "position.left_joint_{j}"})
    assert np.array_equal(left.q, written.q[:, :4])
    assert left.tau is not None
    assert np.array_equal(left.tau, made().tau[:, :4])


def test_kuka_s_state_has_its_own_stamp_and_no_velocity(tmp_path):
    written = made()
    with bag(tmp_path, "mcap") as b:
        State = b.store.types["lbr_fri_idl/msg/LBRState"]
        for t, q, tau in zip(written.time, written.q, written.tau, strict=True):
            ns = round(t * 1e9)
            b.write("/lbr/state", t, State(0.01, EPOCH + ns // 10**9, ns % 10**9, q, tau, 0 * tau))
    assert_same(load(b.path), written, qd=False)


def test_what_a_driver_does_not_measure_is_left_out_and_told(tmp_path):
    """ROS 2's broadcaster writes nan for what the hardware does not offer, others leave the array empty."""
    written = made()
    for topic, effort in (("/nan", np.full(7, np.nan)), ("/empty", np.zeros(0))):
        with Bag(tmp_path / topic[1:], "mcap") as b:
            for t, q, qd in zip(written.time, written.q, written.qd, strict=True):
                b.write(topic, t, b.joint_state(t, FRANKA, q, qd, effort))
        read = load(b.path)
        assert_same(read, written, tau=False)
        assert any("tau is nan throughout" in note for note in read.notes) == (topic == "/nan")
        with pytest.raises(InputError, match=r"not a motion$"):
            read.require_tau()


def test_a_first_message_without_a_stamp_is_the_beginning_of_a_simulation_or_refused(tmp_path):
    written = made()
    for folder, epoch in (("simulated", 0), ("real", EPOCH)):
        (tmp_path / folder).mkdir()
        with bag(tmp_path / folder, "mcap") as b:
            for k, t in enumerate(written.time):
                message = b.joint_state(t, FRANKA, written.q[k], written.qd[k], written.tau[k])
                message.header.stamp.sec += (epoch if k else 0) - EPOCH
                b.write("/joint_states", t, message)
    assert_same(load(tmp_path / "simulated" / "log"), written)
    with pytest.raises(InputError, match=r"message 2: time jumps from 0 s to 17\d+ s"):
        load(tmp_path / "real" / "log")


def test_joints_of_no_known_order_and_joints_in_several_messages_are_told(tmp_path):
    written = made(dof=3)
    names = ["shoulder_pan_joint", "elbow_flex_joint", "wrist_roll_joint"]
    with bag(tmp_path, "mcap") as b:
        joint_states(b, names, written)
    with pytest.raises(
        InputError, match=r"shoulder_pan_joint, elbow_flex_joint, wrist_roll_joint.*no names that"
    ):
        load(b.path)
    asked = {c: ",".join(f"{field}.{name}" for name in names) for c, field in CHANNELS.items()}
    read = load(b.path, columns={"q": asked["q"]})
    assert np.array_equal(read.q, written.q)
    assert read.origin is not None
    assert "current" not in read.origin.says
    (tmp_path / "apart").mkdir()
    with bag(tmp_path / "apart", "mcap") as b:
        for k, t in enumerate(written.time):
            for j in range(3):
                one = b.joint_state(
                    t, [f"joint_{j}"], *(x[k, [j]] for x in (written.q, written.qd, written.tau))
                )
                b.write("/joint_states", t, one)
    with pytest.raises(InputError, match="joints that come in several messages are not put together"):
        load(b.path)


def test_messages_without_stamps_take_the_time_they_were_received(tmp_path):
    written = made()
    with bag(tmp_path, "mcap") as b:
        Array = b.store.types["std_msgs/msg/Float64MultiArray"]
        Layout = b.store.types["std_msgs/msg/MultiArrayLayout"]
        for k, t in enumerate(written.time):
            b.write("/mine", t, Array(Layout([], 0), np.concatenate([written.q[k], written.tau[k]])))
    with pytest.raises(
        InputError, match=r"no topic with an arm's state .*/mine \(std_msgs/Float64MultiArray\)"
    ):
        load(b.path)
    read = load(b.path, reading=Reading(("time=received", "q=data[0:7]", "tau=data[7:14]"), topic="/mine"))
    assert np.array_equal(read.q, written.q)
    assert any("received" in note for note in read.notes)
    assert np.ptp(np.diff(read.time if read.stamps is None else read.stamps)) > 1e-4  # late as they were


def test_a_broken_bag_and_a_missing_library_are_one_sentence(tmp_path, monkeypatch):
    for name in ("log.bag", "log.mcap", "log.db3"):
        (tmp_path / name).write_bytes(bytes(range(256)) * 40)
        with pytest.raises(InputError, match="no ROS bag or MCAP") as raised:
            load(tmp_path / name)
        assert "\n" not in str(raised.value)
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'jaxpanda\[io\]'"):
        load(tmp_path / "log.bag")


def test_a_bag_without_definitions_reads_standard_messages_and_says_what_it_lacks(tmp_path):
    """As ROS 2 wrote them until 2023: schema 3, without the table of definitions."""
    b = bag(tmp_path, "sqlite3")
    written = made()
    with b:
        State = b.store.types["franka_msgs/msg/FrankaState"]
        joint_states(b, FRANKA, written)
        b.write("/franka", 0.0, State(b.header(0.0), *(np.zeros(7) for _ in range(4))))
    (file,) = b.path.glob("*.db3")
    with contextlib.closing(sqlite3.connect(file)) as base:
        base.executescript("DROP TABLE message_definitions; UPDATE schema SET schema_version = 3")
    assert_same(load(b.path, reading=Reading(topic="/joint_states")), written)
    with pytest.raises(InputError, match="no definition of franka_msgs/FrankaState; convert it to MCAP"):
        load(b.path, reading=Reading(topic="/franka"))
