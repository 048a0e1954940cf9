"""Bags of ROS 1 and 2 (`.bag`, a folder with `metadata.yaml`, `.db3`, `.mcap`), without ROS; extra [io].

Every number of a message is a column: `q[0]` of an array, `position.panda_joint1` of a `JointState`, whose joints
come in any order and are told by their names. Time is the header's stamp, from the first message on; where
messages have none, when they were received.
"""

import contextlib
import dataclasses
import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import inputs
from ..errors import InputError, MissingExtraError, printable
from ..reading import Reading
from . import ur
from .recording import Recording, Torque
from .table import COLUMNS, MEASURED, WIDEST, Source, Table, recording_of, refuse

_FRANKA = f"tau_J is the {MEASURED}; tau_J_d is commanded, without gravity"
_STATES = {
    "franka_msgs/msg/FrankaState": (
        Source(
            "franka_ros's FrankaState",
            {"time": "stamp", "q": "q", "dq": "dq", "tau": "tau_J"},
            "measured",
            _FRANKA,
            {"tau_J_d": "commanded"},
            marks=("tau_J",),
        ),
        Source(
            "franka_ros2's FrankaState",
            {"time": "stamp", "q": "q", "dq": "dq", "tau": "tau_j"},
            "measured",
            _FRANKA.replace("tau_J", "tau_j"),
            {"tau_j_d": "commanded"},
        ),
    ),
    "lbr_fri_idl/msg/LBRState": (
        Source(
            "lbr_fri_ros2's LBRState (KUKA FRI)",
            {"time": "stamp", "q": "measured_joint_position", "tau": "measured_torque"},
            "measured",
            f"measured_torque is the {MEASURED}; external_torque is what the arm's own model leaves of it",
            {"commanded_torque": "commanded"},
        ),
    ),
}
"""Messages that hold an arm's state in arrays, and what these are."""
_JOINT_STATES = {
    "sensor_msgs/msg/JointState": "",
    "franka_msgs/msg/FrankaRobotState": "measured_joint_state.",
}
"""Messages that are a JointState or hold the measured one, and where."""
_JOINT_STATE = "sensor_msgs/msg/JointState"
_CHANNELS = {"q": "position", "dq": "velocity", "tau": "effort"}
_GRIPPER = re.compile(r"finger|gripper|robotiq|knuckle|hand_|jaw", re.IGNORECASE)
_FEW = 8
"""Joints that a message lists."""
_LOOK = 200
"""Messages of a topic that are looked at for the joints they name."""


@dataclasses.dataclass(frozen=True)
class _Column:
    """One number of a message: attributes down to an array or a JointState, and the place or joint in it."""

    path: tuple[str, ...]
    place: int | str | None = None


def read_bag(path: Path, reading: Reading) -> list[Recording]:
    """The recording of one topic of a bag.

    Raises:
        MissingExtraError: rosbags is not installed.
        InputError: no bag, no such topic, or several that could be meant.
    """
    refuse(path.name, reading, "episode")
    with _opened(path) as bag:
        topic, kind = _topic(path, bag, reading)
        inputs.require_size(path.name, bag.topics[topic].msgcount)
        samples = _samples(bag, topic)
        columns, stamped = _columns(samples), any(_stamp(message) is not None for _, message in samples)
        taken: dict[str, int] = {}

        def take(places: Sequence[int]) -> np.ndarray:
            wanted = [list(columns)[i] for i in places]
            return _take(bag, topic, path.name, wanted, columns, taken, stamped)

        notes = (f"topic {topic} ({_short(kind)})",)
        if not stamped:
            notes += ("its messages have no stamps: time is when they were received",)
        table = Table(
            path, path.name, list(columns), take, lambda i: f"message {i + 1}", notes, lambda: taken
        )
        sources = _STATES.get(kind) or _joint_sources(path.name, topic, kind, columns, reading)
        return [recording_of(table, sources, reading)]


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MissingExtraError("a ROS bag or MCAP", "io") from None
    try:
        # sqlite3 bags before 2023 hold no definitions of their messages; these are the standard ones.
        with AnyReader([inputs.in_place(path)], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
            yield bag
    except InputError:
        raise
    except Exception as error:  # what a broken bag raises is as varied as what it is packed with
        said = (str(error) or type(error).__name__).splitlines()[0][:200]
        raise InputError(
            f"{path.name}: no ROS bag or MCAP of ROS messages, or a broken one ({said})"
        ) from None


def _topic(path: Path, bag: Any, reading: Reading) -> tuple[str, str]:
    """The topic meant, and its type."""
    kinds = {name: info.msgtype or "" for name, info in bag.topics.items() if info.msgcount}
    if reading.topic:
        asked = next((name for name in kinds if name.lstrip("/") == reading.topic.lstrip("/")), None)
        if asked is None:
            raise InputError(f"{path.name}: no messages on --topic {reading.topic}; it has {_listed(kinds)}")
        return asked, kinds[asked]
    states = {name: kind for name, kind in kinds.items() if kind in _STATES or kind in _JOINT_STATES}
    arms = {name: kind for name, kind in states.items() if kind != _JOINT_STATE or _arms(_joints(bag, name))}
    if not arms and "q" in reading.channels():
        arms = states
    if len(arms) == 1:
        return next(iter(arms.items()))
    if arms:
        raise InputError(
            f"{path.name}: {len(arms)} topics could be meant, {_listed(arms)}: choose by --topic"
        )
    if states:
        topic = next(iter(states))
        names = _joints(bag, topic)
        shown = ", ".join(map(printable, names[:_FEW])) + ", …" * (len(names) > _FEW) or "none"
        raise InputError(
            f"{path.name}: the joints of topic {printable(topic)} ({shown}) have no names that tell their"
            " order: say it by --columns, as q=position.FIRST,position.SECOND,…"
        )
    known = ", ".join(_short(kind) for kind in (*_JOINT_STATES, *_STATES))
    raise InputError(
        f"{path.name}: no topic with an arm's state ({known}); it has {_listed(kinds) or 'no messages'}: choose "
        "by --topic, and say by --columns what its numbers are"
    )


def _listed(kinds: dict[str, str]) -> str:
    return ", ".join(f"{printable(name)} ({_short(kind)})" for name, kind in sorted(kinds.items()))


def _short(kind: str) -> str:
    return printable(kind.replace("/msg/", "/"))


def _messages(bag: Any, topic: str) -> Iterator[tuple[int, Any]]:
    """When each message was received [ns], and the message."""
    connections = [c for c in bag.connections if c.topic == topic]
    if missing := next((c.msgtype for c in connections if c.msgtype not in bag.typestore.fielddefs), None):
        raise InputError(
            f"topic {topic}: the bag holds no definition of {_short(missing)}; convert it to MCAP on a machine "
            "that has one (ros2 bag convert), or choose a topic of standard messages by --topic"
        )
    for connection, received, raw in bag.messages(connections):
        yield received, bag.deserialize(raw, connection.msgtype)


def _samples(bag: Any, topic: str) -> list[tuple[int, Any]]:
    """The first messages, of which one must be there."""
    return [message for message, _ in zip(_messages(bag, topic), range(_LOOK), strict=False)]


def _joints(bag: Any, topic: str) -> list[str]:
    return list(dict.fromkeys(name for _, message in _samples(bag, topic) for name in message.name))


def _columns(samples: Sequence[tuple[int, Any]]) -> dict[str, _Column]:
    """All numbers of a topic's messages."""
    columns = {"stamp": _Column(()), "received": _Column(())}
    for _, message in samples:
        for name, column in itertools.islice(_numbers(message, ()), COLUMNS + 1):  # more are refused
            columns.setdefault(name, column)
    return columns


def _numbers(message: Any, path: tuple[str, ...]) -> Iterator[tuple[str, _Column]]:
    if getattr(message, "__msgtype__", "") == _JOINT_STATE:
        for field in _CHANNELS.values():
            for joint, _ in zip(message.name, getattr(message, field), strict=False):
                yield ".".join((*path, field, joint)), _Column((*path, field), joint)
        return
    for field in dataclasses.fields(message):
        if field.name in ("header", "__msgtype__"):
            continue
        value, below = getattr(message, field.name), (*path, field.name)
        if dataclasses.is_dataclass(value):
            yield from _numbers(value, below)
        elif isinstance(value, np.ndarray) and value.dtype.kind in "fiu" and len(value) <= WIDEST:
            yield from ((f"{'.'.join(below)}[{k}]", _Column(below, k)) for k in range(len(value)))
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield ".".join(below), _Column(below)


def _stamp(message: Any) -> int | None:
    """The header's stamp, or KUKA's own [ns]; None where there is none."""
    if (header := getattr(message, "header", None)) is not None:
        return header.stamp.sec * 1_000_000_000 + header.stamp.nanosec or None
    if (seconds := getattr(message, "time_stamp_sec", None)) is not None:
        return seconds * 1_000_000_000 + message.time_stamp_nano_sec or None
    return None


def _take(
    bag: Any,
    topic: str,
    name: str,
    wanted: Sequence[str],
    columns: dict[str, _Column],
    taken: dict[str, int],
    stamped: bool,
) -> np.ndarray:
    """The columns wanted, a row a message; a message that lacks one of their joints is another device's."""
    rows: list[list[float]] = []
    stamps: list[int] = []
    first: dict[str, int] = {}
    read = other = repeated = 0
    for received, message in _messages(bag, topic):
        stamp = _stamp(message)
        if stamped and stamp is None and not read:
            stamp = 0  # of a simulation's beginning, or of a row that was not filled in: `checked` knows
        read += 1
        if stamped != (stamp is not None):
            raise InputError(
                f"{name}: topic {topic}: some messages have a stamp and some have none; say "
                "--columns time=received"
            )
        now = stamp if stamp is not None else received
        row = []
        for column in wanted:
            if column in ("stamp", "received"):
                at = now if column == "stamp" else received
                row.append(1e-9 * (at - first.setdefault(column, at)))
                continue
            value = _value(message, columns[column])
            if value is None:
                break
            row.append(value)
        if len(row) < len(wanted):
            other += 1
        elif rows and now == stamps[-1] and row == rows[-1]:
            repeated += 1
        else:
            rows.append(row)
            stamps.append(now)
    if not rows and other:
        lacking = " … ".join(map(printable, (wanted[1], wanted[-1])))
        raise InputError(
            f"{name}: topic {topic}: none of its {other} messages holds all of {lacking}: joints that come in"
            " several messages are not put together"
        )
    taken.update({what: count for what, count in {_OTHER: other, _REPEATED: repeated}.items() if count})
    return np.array(rows, dtype=float).reshape(-1, len(wanted))


_OTHER = "messages that lack these joints left out"
_REPEATED = "repeated messages dropped"


def _value(message: Any, column: _Column) -> float | None:
    """The number, or None where the message has no such joint or place."""
    *path, field = column.path
    for attribute in path:
        message = getattr(message, attribute)
    if isinstance(column.place, str):
        if column.place not in message.name:
            return None
        place = message.name.index(column.place)
        values = getattr(message, field)
        return float(values[place]) if place < len(values) else None
    value = getattr(message, field)
    if column.place is None:
        return float(value)
    return float(value[column.place]) if column.place < len(value) else None


def _joint_sources(
    name: str, topic: str, kind: str, columns: dict[str, _Column], reading: Reading
) -> tuple[Source, ...]:
    """The arm whose joints a JointState names; none where it is no JointState or `--columns` says everything."""
    prefix = _JOINT_STATES.get(kind)
    if prefix is None:
        return (Source(_short(kind), {"time": "stamp", "q": ""}),)
    asked = reading.channels().get("q", "")
    start = f"{prefix}position."
    said = {c: asked.replace(start, f"{prefix}{field}.") for c, field in _CHANNELS.items()}
    joints = [column[len(start) :] for column in columns if column.startswith(start)]
    if start in asked:
        return (_declared(kind, joints, {"time": "stamp", **said}),)
    arms = _arms(joints)
    if not arms:
        return ()
    if len(arms) > 1 and not asked:
        choices = ", ".join(f"--columns q={start}{arm}" for arm in arms)
        raise InputError(
            f"{name}: topic {topic} holds the joints of {len(arms)} arms: choose by {choices}; if they are one"
            " arm's, name them from the base on, as q=position.FIRST,position.SECOND,…"
        )
    chain = next(iter(arms.values()))
    mapped = {c: ",".join(f"{prefix}{field}.{joint}" for joint in chain) for c, field in _CHANNELS.items()}
    return (_declared(kind, chain, {"time": "stamp", **mapped}),)


def _declared(kind: str, joints: Sequence[str], columns: dict[str, str]) -> Source:
    """What effort is, by whose joints these are."""
    torque: Torque = "unstated"
    if kind != _JOINT_STATE or any(re.search(r"(panda|fr3|fer)\w*_joint\d$", joint) for joint in joints):
        torque, says = "measured", f"effort is libfranka's tau_J, the {MEASURED}"
    elif all(any(joint.endswith(name) for joint in joints) for name in ur.JOINTS):
        says = ur.EFFORT
    else:
        says = "what effort is depends on the robot's driver: nothing here says it"
    return Source(_short(kind), columns, torque, says)


def _arms(names: Sequence[str]) -> dict[str, list[str]]:
    """Chains of joints among names, from the base on: UR's, or joints that one name numbers."""
    joints = [name for name in names if not _GRIPPER.search(name)]
    first = ur.JOINTS[0]
    robots = {name[: -len(first)]: None for name in joints if name.endswith(first)}
    chains = {
        f"{p}*": [p + joint for joint in ur.JOINTS] for p in robots if {p + j for j in ur.JOINTS} <= {*joints}
    }
    if chains:
        return chains
    stems: dict[str, list[tuple[int, str]]] = {}
    for name in joints:
        if m := re.fullmatch(r"(.*?)(\d+)(\D*)", name):
            stems.setdefault(f"{m[1]}{{j}}{m[3]}", []).append((int(m[2]), name))
    longest = max((len(chain) for chain in stems.values()), default=0)
    return {
        s: [name for _, name in sorted(chain)]
        for s, chain in stems.items()
        if len(chain) > max(1, longest // 2)
    }
