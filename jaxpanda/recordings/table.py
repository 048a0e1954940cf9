"""From named columns to a recording: what a log's source says of them, what the user says, and the units.

A format's reader makes a `Table` and offers the sources that write such files. What `Reading.columns` says comes
first, then the canonical names, then the first source whose columns are all there. Nothing else is guessed: where
names merely look like it, the message proposes the option that says so.
"""

import dataclasses
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from .. import inputs
from ..errors import InputError
from ..reading import CHANNELS, Reading
from .checks import RATES, SHORTEST, checked
from .recording import Origin, Recording, Torque

UNITS: Mapping[str, Mapping[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "q": {"rad": 1.0, "deg": np.pi / 180, "m": 1.0, "mm": 1e-3},
    "dq": {"rad/s": 1.0, "deg/s": np.pi / 180, "m/s": 1.0, "mm/s": 1e-3},
}
"""Units that a channel may be said to have, each in SI; of torque `--torque-unit` speaks."""
_SHOWN = 12
"""Columns that a message lists at most."""
WORDS: Mapping[Torque, str] = {
    "measured": "joint torque as measured, gravity included",
    "gravity_removed": "torque without gravity",
    "current": "the motors' current, no torque",
    "commanded": "torque as commanded, not measured",
    "motor_side": "torque of the motors, friction of the gears included",
    "unstated": "nothing says what its torque is",
}
MEASURED = WORDS["measured"]


@dataclasses.dataclass(frozen=True)
class Table:
    """What a log holds before anyone says what it means: columns of one number a row, by name."""

    path: Path
    name: str
    """As messages call it."""
    names: Sequence[str]
    take: Callable[[Sequence[int]], Float[np.ndarray, "rows columns"]]
    """The columns at these places."""
    row: Callable[[int], str] = lambda i: f"row {i + 1}"
    """How the file counts row `i` (0-based), for messages."""
    notes: tuple[str, ...] = ()
    repairs: Callable[[], Mapping[str, int]] = dict
    """What `take` dropped."""


@dataclasses.dataclass(frozen=True)
class Source:
    """Who writes logs with such columns, and what the columns are there."""

    name: str
    columns: Mapping[str, str]
    """Of each channel, as `--columns` says it; time and q must be there, dq and tau may be."""
    torque: Torque = "unstated"
    """What its tau is."""
    says: str = WORDS["unstated"]
    """The same in words, with what else could be taken for torque."""
    others: Mapping[str, Torque] = dataclasses.field(default_factory=dict)
    """Columns that are no such torque but could be asked for, and what they are."""
    marks: Sequence[str] = ()
    """Columns that must be there for it to be this source."""
    episode: str = ""
    """The column that numbers the file's episodes."""


def recording_of(table: Table, sources: Sequence[Source], reading: Reading) -> Recording:
    """The recording in a table, checked.

    Raises:
        InputError: columns are missing or cannot be told, or what `checked` refuses.
    """
    if len(table.names) > COLUMNS:
        raise InputError(
            f"{table.name}: {len(table.names)} columns, where at most {COLUMNS} are read: leave out what is no"
            " joint's"
        )
    said = reading.channels()
    source = _source(table, sources, said)
    declared = {} if source is None else source.columns
    free = {c: where for c, where in declared.items() if c not in said and where not in said.values()}
    there = {c: where for c, where in free.items() if _there(table.names, where)}
    wanted = there | said
    mapping: dict[str, str] = {}
    for name, where in wanted.items():
        mapping |= _mapping(table, name, where)
    _stated_units(table, said, mapping)
    found = find_channels(table.names, table.name, mapping)
    found = {name: places for name, places in found.items() if wanted.get(name) != ""}
    nanoseconds = _second_part(table.names, wanted.get("time", ""))
    places = [place for group in found.values() for place in group] + nanoseconds
    content = dict(zip(places, np.asarray(table.take(places), dtype=float).T, strict=True))
    channels: dict[str, np.ndarray] = {}
    for name, group in found.items():
        values = np.column_stack([content[place] for place in group])
        factors = [_factor(name, j, wanted, table.names) for j in range(1, len(group) + 1)]
        channels[name] = values if set(factors) == {1.0} else values * factors
    time = channels["time"][:, 0]
    if nanoseconds and len(time):  # from the first whole second on, so that no digit is lost
        time = time - np.floor(time[0]) + 1e-9 * content[nanoseconds[0]]
    absent = {
        name: what
        for name in MEASURED_TOO
        if name in channels
        and name not in said
        and (what := unmeasured(channels[name], channels["q"], name in there))
    }
    channels = {name: values for name, values in channels.items() if name not in absent}
    notes = [UNMEASURED.format(name=name, what=what) for name, what in absent.items()]
    if ignored := [name or "(no name)" for i, name in enumerate(table.names) if i not in content]:
        notes.append(f"ignores {len(ignored)} other columns: {_listed(_stems(ignored))}")
    torque, says = _torque(source, said)
    if "tau" in declared and "tau" not in channels:
        torque, says = "unstated", ""
    taken = {
        name: _span([table.names[place] for place in found[name]]) for name in CHANNELS if name in channels
    }
    if nanoseconds:
        taken["time"] += f" + {table.names[nanoseconds[0]]}"
    _seconds(table, source, time, declared.get("time", "") if "time" not in said else "")
    rows, cut_notes = within(table.name, time, reading)
    row = lambda i: table.row(i + rows.start)
    recording = Recording(
        table.name,
        time[rows],
        channels["q"][rows],
        channels["dq"][rows] if "dq" in channels else None,
        channels["tau"][rows] if "tau" in channels else None,
        table.path,
        dict(table.repairs()),
        (*table.notes, *notes, *cut_notes),
        origin=Origin(_named(source, said), taken, torque, says, _called(wanted, found, table.names)),
        tau_motor=channels["tau_motor"][rows] if "tau_motor" in channels else None,
        row=row,
    )
    return checked(recording, row)


def _called(
    wanted: Mapping[str, str], found: Mapping[str, Sequence[int]], names: Sequence[str]
) -> dict[str, str]:
    """Of each channel, and of each joint's, what `--columns` calls its columns."""
    each = {f"{c}_{j + 1}": names[k] for c, at in found.items() for j, k in enumerate(at) if c != "time"}
    return each | {c: split_unit(where)[0] for c, where in wanted.items() if where and c not in each}


def unmeasured(values: Float[np.ndarray, "rows n"], q: Float[np.ndarray, "rows n"], declared: bool) -> str:
    """What stands in the place of a channel that was not measured; empty where it was, or where it is nan and its
    source is not `declared`."""
    if declared and np.all(np.isnan(values)):
        return "nan"
    return "0" if not np.any(values) and len(q) and np.any(np.ptp(q, axis=0) > 0) else ""


def _named(source: Source | None, said: Mapping[str, str]) -> str:
    if source is None and {"time", "q"} <= said.keys():
        return "what --columns says"
    name = "canonical columns" if source is None else source.name
    return f"{name}, {', '.join(said)} as asked for" if said else name


def _torque(source: Source | None, said: Mapping[str, str]) -> tuple[Torque, str]:
    """What tau is, by the canonical form, the log's source, or what the source says of what was asked for."""
    if "tau" not in said:
        return ("measured", "") if source is None else (source.torque, source.says)
    kind = {} if source is None else source.others
    return (kind[said["tau"]], WORDS[kind[said["tau"]]]) if said["tau"] in kind else ("unstated", "")


def within(name: str, time: Float[np.ndarray, " rows"], reading: Reading) -> tuple[slice, tuple[str, ...]]:
    """The rows from the first to the last that `--from` and `--to` leave, and what to tell of it.

    Raises:
        InputError: none is left.
    """
    if reading.whole:
        return slice(0, len(time)), ()
    low, high = reading.from_, reading.to
    kept = np.flatnonzero((time >= low) & (time <= high))
    if not kept.size or np.ptp(time[kept]) < SHORTEST:
        span = f"{np.nanmin(time):g} to {np.nanmax(time):g}" if np.any(np.isfinite(time)) else "no"
        raise InputError(
            f"{name}: {len(kept)} rows between --from {low:g} and --to {high:g} s, where at least"
            f" {SHORTEST} s are needed; its time goes from {span} s"
        )
    first, last = int(kept[0]), int(kept[-1])
    said = f"only the rows from {time[first]:g} to {time[last]:g} s: {last + 1 - first} of {len(time)}"
    return slice(first, last + 1), (said,)


def cut(recording: Recording, reading: Reading) -> Recording:
    """The part of a recording that `--from` and `--to` leave."""
    rows, notes = within(recording.name, recording.time, reading)
    return dataclasses.replace(recording.at(rows), notes=(*recording.notes, *notes))


def chosen(name: str, episodes: Sequence[str], reading: Reading, what: str = "episodes") -> list[str]:
    """The episodes to be read: those asked for, or the only one.

    Raises:
        InputError: one asked for is not there, or there are several and none is asked for.
    """
    listed = _listed(list(episodes))
    for asked in reading.episode:
        if asked not in episodes:
            raise InputError(f"{name}: no episode {asked}; it holds {len(episodes)} {what} ({listed})")
    if not reading.episode and len(episodes) > 1:
        raise InputError(f"{name}: holds {len(episodes)} {what} ({listed}): choose by --episode")
    return list(dict.fromkeys(reading.episode)) or list(episodes)


def refuse(name: str, reading: Reading, *options: str) -> None:
    """Options that choose nothing in such a file."""
    for option in options:
        if getattr(reading, option):
            raise InputError(f"{name}: has no {option}s, so that --{option} chooses nothing in it")


def of_arrays(
    path: Path,
    name: str,
    shapes: Mapping[str, tuple[int, ...]],
    get: Callable[[str], np.ndarray],
    notes: tuple[str, ...] = (),
) -> Table:
    """A table of arrays: a vector is a column, the columns of a matrix are `name[0]`, `name[1]`, …

    Time runs along the longer side of a matrix.
    """
    names: list[str] = []
    where: list[tuple[str, int | None]] = []
    for key, shape in shapes.items():
        if len(shape) == 1 or (len(shape) == 2 and 1 in shape):
            names.append(key)
            where.append((key, None))
        elif len(shape) == 2 and min(shape) <= WIDEST:
            names += [f"{key}[{k}]" for k in range(min(shape))]
            where += [(key, k) for k in range(min(shape))]

    def take(places: Sequence[int]) -> np.ndarray:
        for key in dict.fromkeys(where[i][0] for i in places):
            inputs.require_size(name, math.prod(shapes[key]))
        arrays = {
            key: np.asarray(get(key), dtype=float) for key in dict.fromkeys(where[i][0] for i in places)
        }
        rows = {key: max(array.shape) for key, array in arrays.items()}
        if len(set(rows.values())) > 1:
            said = ", ".join(f"{key} has {count}" for key, count in rows.items())
            raise InputError(
                f"{name}: {said} rows, where all must have as many: say by --columns which belong together"
            )
        columns = []
        for i in places:
            key, k = where[i]
            array = arrays[key]
            columns.append(
                array.ravel() if k is None else array[:, k] if array.shape[0] >= array.shape[1] else array[k]
            )
        return np.column_stack(columns)

    return Table(path, name, names, take, notes=notes)


WIDEST = 1000
"""Columns that one array may have."""
UNMEASURED = "{name} is {what} throughout, as drivers and simulators write what they do not measure: left out"
"""What is told of such a channel."""
MEASURED_TOO = CHANNELS[2:]
"""What may stand beside positions."""
COLUMNS = 5000
"""Most that a table may have."""


def _source(table: Table, sources: Sequence[Source], said: Mapping[str, str]) -> Source | None:
    """The first source that this table is from; None where it is canonical or the user says it all."""
    needed = [c for c in ("time", "q") if c not in said] or ["time", "q"]
    for source in sources:
        marks = [*(source.columns.get(c, "") for c in needed), *source.marks]
        own = [where for c, where in source.columns.items() if c != "time"]  # many logs have a time
        if all(_there(table.names, where) for where in marks) and any(_there(table.names, w) for w in own):
            return source
    seen = {name.lower() for name in table.names}
    timed = "time" in seen or "time" in said
    if timed and ("q_1" in seen or "q" in said or "q_1" in said):
        return None
    if "time" in seen and any(_known(name) for name in seen - {"time"}):
        return None  # all but canonical: `find_channels` says what is wrong
    timed = timed or any(_there(table.names, s.columns["time"]) for s in sources if s.columns.get("time"))
    what = "no columns q_1, q_2, …" if timed else "no column time"
    likely = _proposal(table.names, said)
    raise InputError(
        f"{table.name}: {what}; it has {listed(table.names)}, where time, q_1, …, dq_1, …, tau_1, … are needed: "
        + (
            f"perhaps --columns {likely}"
            if likely
            else "say which is which, as --columns time=t q=pos_{j} tau=effort_{j}"
        )
    )


def listed(names: Sequence[str]) -> str:
    """The columns of a table, joints put together, for a message."""
    return f"the columns {_listed(_stems(names))}" if any(names) else "no columns of numbers"


def _stems(names: Sequence[str]) -> list[str]:
    stems: dict[str, list[str]] = {}
    for name in names:
        stems.setdefault(re.sub(r"\d+(?!.*\d)", "{j}", name), []).append(name)
    return [(stem if len(group) > 1 else group[0])[:40] for stem, group in stems.items()]


def _listed(words: list[str]) -> str:
    return ", ".join(words[:_SHOWN]) + (f", … ({len(words) - _SHOWN} more)" if len(words) > _SHOWN else "")


_LIKE = {
    "time": {"time", "stamp", "timestamp", "stamps", "timestamps", "times", "sec", "secs", "seconds"},
    "q": {"q", "pos", "position", "positions", "angle", "angles"},
    "dq": {"dq", "qd", "vel", "velocity", "velocities", "speed"},
    "tau": {"tau", "torque", "torques", "effort", "efforts", "eff"},
}
_COMMANDS = {
    "cmd",
    "command",
    "commanded",
    "des",
    "desired",
    "ref",
    "target",
    "ext",
    "external",
    "d",
    "action",
    "cmptd",
    "error",
    "init",
}


_STATED = re.compile(r"[\[(\s_]\s*(deg|degrees|°|ms|us|µs|ns)\s*(/\s*s|ps)?\s*[\])]?$", re.IGNORECASE)
"""A unit that is not SI's at the end of a column's name, and whether it is one of a velocity."""


def _stated(channel: str, name: str) -> str:
    """The unit, not SI's, that a column's name gives; empty where it gives none that the channel has."""
    if (m := _STATED.search(name)) is None:
        return ""
    unit = {"degrees": "deg", "°": "deg", "µs": "us"}.get(m[1].lower(), m[1].lower()) + ("/s" if m[2] else "")
    return unit if unit in UNITS.get(channel, {}) else ""


def _stated_units(table: Table, said: Mapping[str, str], mapping: Mapping[str, str]) -> None:
    """Refuse what the user says of a column whose name gives another unit than what is said."""
    for channel, where in said.items():
        base = _of_all_joints(channel)
        name = mapping.get(channel, mapping.get(f"{channel}_1", ""))
        unit = _stated(base, name)
        if unit and (where in table.names or not split_unit(where)[1]):
            si = next(iter(UNITS[base]))
            raise InputError(
                f"--columns {channel}={where}: {table.name} calls it {name!r}, which is read in {si}: say"
                f" {channel}={where}:{unit}, or :{si} if it is not in {unit}"
            )


def _seconds(table: Table, source: Source | None, time: Float[np.ndarray, " rows"], where: str) -> None:
    """Refuse times in seconds that are read as the source writes them, in another unit."""
    unit = split_unit(where)[1]
    factor = UNITS["time"].get(unit, 1.0)
    if source is None or factor == 1 or len(time) < 2 or not np.isfinite(time).all():
        return
    step = float(np.median(np.diff(time))) / factor
    if 1 / RATES[1] <= step <= 1 / RATES[0]:
        raise InputError(
            f"{table.name}: column time is read in {unit}, as {source.name} writes it, and looks like seconds"
            f" (its median step is {step:g}): say so by --columns time={where.removesuffix(f':{unit}')}:s"
        )


def _proposal(names: Sequence[str], told: Mapping[str, str]) -> str:
    """The option that would say which column is which, where names look like it, what is told already included;
    else nothing."""
    stems: dict[str, None] = {}
    for name in names:
        stems.setdefault(re.sub(r"\d+(?!.*\d)", "{j}", name))
    said = []
    for channel, like in _LIKE.items():
        if channel in told:
            said.append(f"{channel}={told[channel]}")
            continue
        fits = []
        for stem in stems:
            words = set(
                re.findall(r"[a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", stem.replace("{j}", " ")).lower())
            )
            if (
                (words & like or stem.lower() in like | {"t"})
                and not words & _COMMANDS
                and ("{j}" in stem) == (channel != "time")
            ):
                fits.append(stem)
        if fits:
            best = min(fits, key=len)
            unit = _stated(channel, best)
            said.append(f"{channel}={best}" + (f":{unit}" if unit else ""))
        elif channel in ("time", "q"):
            return ""
    return " ".join(f"'{one}'" if " " in one or ("{" in one and "[" in one) else one for one in said)


def _there(names: Sequence[str], where: str) -> bool:
    return where == "" or bool(_expand(names, split_unit(where)[0]))


def factor_of(channel: str, where: str) -> float:
    """What a channel's numbers are multiplied by to be in SI, by the unit said behind its columns.

    Raises:
        InputError: it is no unit of such a channel.
    """
    unit, base = split_unit(where)[1], _of_all_joints(channel)
    if unit and unit not in UNITS.get(base, {}):
        has = ", ".join(UNITS[base]) if base in UNITS else "none here; torque's is said by --torque-unit"
        raise InputError(f"--columns {channel}={where}: {unit} is no unit of {base}; its units are {has}")
    return UNITS[base][unit] if unit else 1.0


def _of_all_joints(channel: str) -> str:
    """q of q_3."""
    stem, _, joint = channel.rpartition("_")
    return stem if joint.isdecimal() else channel


def split_unit(where: str) -> tuple[str, str]:
    """What names the columns, and the unit after the last colon if there is one."""
    head, colon, unit = where.rpartition(":")
    known = {unit for units in UNITS.values() for unit in units}
    return (head, unit) if colon and unit in known else (where, "")


def _factor(channel: str, joint: int, wanted: Mapping[str, str], names: Sequence[str]) -> float:
    of_joint = f"{channel}_{joint}"
    where = wanted.get(of_joint, wanted.get(channel, ""))
    return 1.0 if where in names else factor_of(of_joint if of_joint in wanted else channel, where)


def _second_part(names: Sequence[str], where: str) -> list[int]:
    """Place of the nanoseconds in `time=SECONDS+NANOSECONDS`."""
    _, plus, second = where.partition("+")
    return [names.index(second)] if where not in names and plus and second in names else []


def _expand(names: Sequence[str], where: str) -> list[str]:
    """The columns that `where` names, in the order of the joints; empty where one is not there."""
    if where in names:
        return [where]
    if "," in where:
        parts = [_expand(names, part.strip()) for part in where.split(",")]
        return [name for part in parts for name in part] if all(parts) else []
    if "+" in where and _second_part(names, where):
        return _expand(names, where.split("+")[0])
    if m := re.fullmatch(r"(\d{1,9})\.\.(\d{1,9})", where):
        ranged = [str(k) for k in range(int(m[1]), min(int(m[2]), int(m[1]) + WIDEST) + 1)]
        return ranged if set(ranged) <= set(names) else []
    if m := re.fullmatch(r"(.*)\[(\d{,9}):(\d{,9})\]", where):
        every = _expand(names, m[1])
        return every[int(m[2] or 0) : int(m[3] or len(every))]
    pattern = (
        re.escape(where if "{j}" in where else where + "[{j}]")
        .replace(r"\{j\}", r"(\d{1,9})")
        .replace(r"\*", ".*")
    )
    found = sorted((int(m[1]), name) for name in names if (m := re.fullmatch(pattern, name)))
    numbers = [number for number, _ in found]  # of the joints, from whatever the file counts from
    whole = numbers == list(range(numbers[0], numbers[0] + len(numbers))) if numbers else False
    return [name for _, name in found] if whole else []


def _mapping(table: Table, channel: str, where: str) -> dict[str, str]:
    """What `find_channels` takes: the column of each canonical name."""
    if where == "":
        if channel in ("time", "q"):
            raise InputError(f"--columns {channel}=: {channel} cannot be left out")
        return {}
    plain = where
    if where not in table.names:
        factor_of(channel, where)
        plain = split_unit(where)[0]
    columns = _expand(table.names, plain)
    alike = re.escape(plain).replace(r"\*", ".*")
    if not columns and (several := [name for name in table.names if re.fullmatch(alike, name)]):
        raise InputError(
            f"{table.name}: {plain!r} (asked for as {channel}) is {_listed(several)}, whose order it does not"
            f" say: name them in that of the joints, as {channel}={','.join(several[:_SHOWN])}"
        )
    if not columns:
        raise InputError(
            f"{table.name}: no column {plain!r} (asked for as {channel}); it has {listed(table.names)}"
        )
    if channel == "time" or _of_all_joints(channel) != channel:
        if len(columns) > 1:
            raise InputError(f"{table.name}: {plain!r} is {len(columns)} columns, where {channel} is one")
        return {channel: columns[0]}
    return {f"{channel}_{j + 1}": name for j, name in enumerate(columns)}


def find_channels(names: Sequence[str], file: str, columns: Mapping[str, str]) -> dict[str, list[int]]:
    """Where time, q, dq and tau stand among a table's columns; a channel that is absent has no entry.

    Raises:
        InputError: a column is missing, double, or one joint's column is absent.
    """
    seen = [name.lower() for name in names]
    for canonical_name, given in columns.items():
        if given not in names:
            raise InputError(
                f"{file}: no column {given!r} (asked for as {canonical_name}); it has {listed(names)}"
            )
        for i, name in enumerate(names):
            if name == given:
                seen[i] = canonical_name.lower()
            elif seen[i] == canonical_name.lower():
                seen[i] = ""
    double = next((name for i, name in enumerate(seen) if name and name in seen[:i] and _known(name)), None)
    if double is not None:
        raise InputError(f"{file}: column {double} is there twice: rename or drop one of them")
    if "time" not in seen:
        raise InputError(
            f"{file}: no column time; it has {listed(names)}, where {canonical(7)} is needed{_MAP}"
        )
    found: dict[str, list[int]] = {"time": [seen.index("time")]}
    for channel in ("q", *MEASURED_TOO):
        joints = {
            int(m[1]): i
            for i, name in enumerate(seen)
            if (m := re.fullmatch(rf"{channel}_(\d{{1,9}})", name))
        }
        if joints:
            found[channel] = [joints[j] for j in _complete(sorted(joints), channel, file)]
    if "q" not in found:
        raise InputError(f"{file}: no columns q_1, q_2, …; it has {listed(names)}{_MAP}")
    dof = len(found["q"])
    for channel in MEASURED_TOO:
        if channel in found and len(found[channel]) != dof:
            raise InputError(
                f"{file}: {dof} columns q_1 ... q_{dof} but {len(found[channel])} columns {channel}_1 ... "
                f"{channel}_{len(found[channel])}: each joint needs one, or leave all {channel} columns out"
            )
    return found


_MAP = "; rename them, or say which is which, as --columns time=t q=pos_{j} tau=effort_{j}"


def _known(name: str) -> bool:
    return name == "time" or re.fullmatch(r"(q|dq|tau|tau_motor)_\d+", name) is not None


def _complete(joints: list[int], channel: str, file: str) -> list[int]:
    missing = next((j for j, there in enumerate([j for j in joints if j], 1) if j != there), None)
    if missing or joints[0] != 1:
        name = f"{channel}_{missing or joints[0]}"
        raise InputError(
            f"{file}: column {name} is missing, while {channel}_{joints[-1]} is there"
            if missing
            else f"{file}: column {name} cannot be: joints count from 1"
        )
    return joints


def _span(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} … {names[-1]}"


def canonical(dof: int) -> str:
    """How the header of the canonical CSV reads."""
    return f"time,q_1,…,q_{dof},dq_1,…,dq_{dof},tau_1,…,tau_{dof}"


def canonical_names(recording: Recording) -> list[str]:
    """The columns of a recording, in order."""
    return [name for name, _ in recording.columns()]
