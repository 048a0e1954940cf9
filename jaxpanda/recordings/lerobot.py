"""LeRobot data sets, versions 2 and 3: a folder with `meta/info.json` and Parquet files; needs the extra [io].

`observation.state` is whatever the robot's maker put there, so that its joints are told by the names that
`info.json` gives them. Nothing there says in which unit, nor what a torque is.
"""

import re
from pathlib import Path
from typing import Any

from .. import inputs
from ..errors import InputError
from ..reading import Reading
from .parquet import read_episodes
from .recording import Recording
from .table import WORDS, Source, chosen, refuse

INFO = Path("meta") / "info.json"
"""What makes a folder a LeRobot data set."""
_STATE = "observation.state"
_GRIPPER = re.compile(r"gripper|finger|hand|jaw", re.IGNORECASE)
_SUFFIXES = {
    "q": ("pos", "position", "q", ""),
    "dq": ("vel", "velocity", "dq"),
    "tau": ("torque", "effort", "tau"),
}


def read_lerobot(path: Path, reading: Reading) -> list[Recording]:
    """Episodes of a data set.

    Raises:
        MissingExtraError: pyarrow is not installed.
        InputError: no such episode, several and none asked for, or joints that cannot be told by their names.
    """
    refuse(path.name, reading, "topic")
    try:
        info = inputs.read_json(path / INFO)
        features = {str(name): dict(feature) for name, feature in info["features"].items()}
        version = str(info.get("codebase_version", ""))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path / INFO}: is not what a LeRobot data set has there ({error!r})") from None
    single = {
        m[1]: f
        for f in sorted(path.glob("data/*/*.parquet"))
        if (m := re.fullmatch(r"episode_0*(\d+)", f.stem))
    }
    if single:  # version 2: a file an episode
        files = [single[k] for k in chosen(path.name, list(single), reading)]
    else:
        files = sorted(path.glob("data/*/*.parquet"))
    if not files:
        raise InputError(f"{path}: a LeRobot data set without data/*/*.parquet: fetch its data files")
    return read_episodes(files, path, path.name, (_source(features, version),), reading)


def _source(features: dict[str, dict[str, Any]], version: str) -> Source:
    """What the names of the data set's features say of their columns."""
    columns = {"time": "timestamp"}
    state = _names(features.get(_STATE, {}))
    positions: list[int] = []
    for channel, suffixes in _SUFFIXES.items():
        places = _in_order(
            {
                k: name
                for k, name in enumerate(state)
                if not _GRIPPER.search(name) and _is_joint(name, suffixes)
            }
        )
        positions = places if channel == "q" else positions
        if places:
            columns[channel] = ",".join(f"{_STATE}[{k}]" for k in places)
    for channel, words in (("dq", ("velocity",)), ("tau", ("torque", "effort"))):
        named = [f for f in features if f.startswith("observation.") and f != _STATE and f.endswith(words)]
        if channel not in columns and len(named) == 1:
            given = _names(features[named[0]])
            joints = _in_order({k: name for k, name in enumerate(given) if not _GRIPPER.search(name)})
            joints = joints if given else positions  # in the order of what has names
            columns[channel] = ",".join(f"{named[0]}[{k}]" for k in joints) or named[0]
    columns.setdefault("q", "observation.joint_positions")
    return Source(
        f"a LeRobot data set ({version})", columns, "unstated", WORDS["unstated"], episode="episode_index"
    )


def _in_order(names: dict[int, str]) -> list[int]:
    """Places of joints in the order of their numbers, where one name numbers them all; else as they come."""
    numbers = {k: re.findall(r"\d+", name) for k, name in names.items()}
    one = len({re.sub(r"\d+(?!.*\d)", "", name) for name in names.values()}) == 1
    return sorted(names, key=lambda k: int(numbers[k][-1])) if one and all(numbers.values()) else list(names)


def _names(feature: dict[str, Any]) -> list[str]:
    """Of a feature's numbers: a list, or a list in a dictionary of one entry."""
    names = feature.get("names")
    if isinstance(names, dict):
        names = next(iter(names.values()), [])
    return [str(name) for name in names] if isinstance(names, list) else []


def _is_joint(name: str, suffixes: tuple[str, ...]) -> bool:
    """`joint_1`, `joint1.pos`, `panda_joint3_pos`, `left_joint_2.vel`."""
    m = re.fullmatch(r".*?(?:joint|motor|j)[_.]?\d+(?:[_.]?([a-z]*))?", name, re.IGNORECASE)
    return bool(m) and (m[1] or "").lower() in suffixes
