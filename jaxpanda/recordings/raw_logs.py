"""A folder with one text file a quantity, as control programs dump them.

A file holds one number a line (`dof` consecutive numbers are a sample) or one sample a line. Time is what a
host stamped: true ticks are reconstructed where they can be and are better (`ticks`).
"""

import dataclasses
import itertools
import re
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..errors import InputError
from ..reading import Reading
from .checks import checked
from .recording import Origin, Recording
from .table import chosen, cut, factor_of, refuse, split_unit
from .text import numbers, read_text
from .ticks import Ticks, consistent, reconstruct

_WORDS = {
    "time": {"time", "times", "stamp", "stamps", "timestamp", "timestamps"},
    "q": {"position", "positions", "pos", "q"},
    "dq": {"velocity", "velocities", "vel", "dq", "qd"},
    "tau": {"torque", "torques", "tau", "effort", "efforts"},
}
_NOT_MEASURED = {
    "gen",
    "cmd",
    "command",
    "commanded",
    "des",
    "desired",
    "ref",
    "reference",
    "target",
    "external",
    "ext",
}
_SUFFIX = re.compile(r"\.(txt|dat|log)(\.gz)?$", re.IGNORECASE)
_ALONE = re.compile(r"\.(csv(\.gz)?|npz|parquet|bag|mcap|db3|h5|hdf5|mat)$", re.IGNORECASE)
"""Of files that are recordings by themselves."""
_SLACK = 5  # rows by which the files of one log may differ in length


def read_raw_logs(path: Path, reading: Reading) -> list[Recording]:
    """The runs logged in a folder; a new run begins where time goes back, and is an episode from 1 on.

    Args:
        path: the folder.
        reading: `columns` names the file of a channel where the names do not say it.

    Raises:
        InputError: naming the folder or file and the row, and what would work.
    """
    refuse(path.name, reading, "topic")
    said = reading.channels()
    files = find_logs(path, said)
    time = _numbers(files["time"], "time")
    if time.shape[1] != 1:
        raise InputError(f"{files['time'].name}: {time.shape[1]} numbers a line, where time has one")
    logs = {
        channel: _samples(_numbers(file, channel), len(time), file, files["time"])
        for channel, file in files.items()
    }
    rows = min(map(len, logs.values()))
    short = max(len(log) for log in logs.values()) - rows
    logs = {channel: _in_si(channel, log[:rows], said, path) for channel, log in logs.items()}
    _same_joints(logs, files)
    stamps = logs["time"][:, 0]
    breaks = [0, *(np.flatnonzero(np.diff(stamps) < 0) + 1).tolist(), rows]
    runs = []
    wanted = (
        chosen(path.name, [str(k) for k in range(1, len(breaks))], reading, "runs")
        if reading.episode
        else None
    )
    called = {channel: file.name for channel, file in files.items()}
    origin = Origin("a folder of logs", called, columns=called)
    for number, (start, stop) in enumerate(itertools.pairwise(breaks), 1):
        if wanted is not None and str(number) not in wanted:
            continue
        name = path.name if len(breaks) == 2 else f"{path.name} (run {number})"
        run = {channel: log[start:stop] for channel, log in logs.items()}
        logged = _Run(name, stamps[start:stop], run["q"], run.get("dq"), run.get("tau"), path, origin)
        repairs = {"rows cut to the shortest file": short} if short else {}
        runs.append(cut(_on_ticks(logged, start, repairs), reading))
    return runs


def find_logs(path: Path, columns: Mapping[str, str] | None = None) -> dict[str, Path]:
    """Which file of a folder holds which quantity.

    Commands (`gen_dq.txt`, `q_desired.txt`) are no measurements; of several candidates, those called
    `measured` count, else those whose name begins like the other files'.

    Raises:
        InputError: no time or position file, or several that could be meant.
    """
    if not path.is_dir():
        raise InputError(f"{path}: no such folder")
    files = sorted(file for file in path.iterdir() if _SUFFIX.search(file.name) and file.is_file())
    found = {channel: _unzipped_first([file for file in files if _is(file, channel)]) for channel in _WORDS}
    for channel, name in (columns or {}).items():
        if not name:
            found[channel] = []
            continue
        file = path / name if (path / name).is_file() else path / split_unit(name)[0]
        if not file.is_file():
            raise InputError(f"{path}: no file {name!r} (asked for as {channel}) in this folder")
        found[channel] = [file]
    for channel in ("time", "q"):
        if not found[channel]:
            what = "time stamps" if channel == "time" else "joint positions"
            other = sorted(file.name for file in path.iterdir() if _ALONE.search(file.name))
            if other:
                many = f"{other[0]} and {len(other) - 1} more" if len(other) > 1 else other[0]
                raise InputError(f"{path}: a folder of other files ({many}), each a recording: name those")
            raise InputError(
                f"{path}: a folder without {what}: one-number-a-line logs like …time.txt, …positions.txt, "
                "…velocity.txt, …torques.txt (or .txt.gz) are needed"
            )
    beginnings = {_beginning(files[0]) for files in found.values() if len(files) == 1}
    chosen = {}
    for channel, candidates in found.items():
        likely = [file for file in candidates if "measured" in _tokens(file)] or candidates
        if len(likely) > 1:
            likely = [file for file in likely if _beginning(file) in beginnings] or likely
        if len(likely) > 1:
            names = ", ".join(file.name for file in likely)
            raise InputError(
                f"{path}: {names} could each be {channel}: move the others away, or say which by"
                f" --columns {channel}=FILE"
            )
        if likely:
            chosen[channel] = likely[0]
    return chosen


def _in_si(
    channel: str, log: Float[np.ndarray, "row column"], said: Mapping[str, str], path: Path
) -> Float[np.ndarray, "row column"]:
    """A log whose unit was said with its file, in SI."""
    where = said.get(channel, "")
    factor = 1.0 if not where or (path / where).is_file() else factor_of(channel, where)
    return log if factor == 1 else factor * log


def _tokens(file: Path) -> list[str]:
    return re.split(r"[_\-. ]+", _SUFFIX.sub("", file.name).lower())


def _is(file: Path, channel: str) -> bool:
    tokens = set(_tokens(file))
    return bool(tokens & _WORDS[channel]) and not tokens & _NOT_MEASURED


def _beginning(file: Path) -> str:
    return _tokens(file)[0]


def _unzipped_first(files: list[Path]) -> list[Path]:
    """Each log once: `x.txt` where `x.txt.gz` lies beside it."""
    return [file for file in files if file.suffix != ".gz" or file.with_suffix("") not in files]


def _numbers(file: Path, channel: str) -> Float[np.ndarray, "row column"]:
    lines = read_text(file).splitlines()
    first = next(line for line in lines if line.strip())
    width = len(first.split())
    names = [channel] if width == 1 else [f"{channel}_{j + 1}" for j in range(width)]
    table = numbers(lines, file.name, None, names, 1)
    bad = np.argwhere(~np.isfinite(table))
    if bad.size:
        row, column = bad[0]
        raise InputError(
            f"{file.name}: column {names[column]}, row {row + 1}: the value is {table[row, column]}, where a "
            "finite number is needed; leave out the rows that were not measured"
        )
    return table


def _samples(
    table: Float[np.ndarray, "row column"], rows: int, file: Path, time_file: Path
) -> Float[np.ndarray, "time dof"]:
    """One row a sample, whether the file has one number a line or one sample a line."""
    if table.shape[1] > 1 or abs(len(table) - rows) <= _SLACK:
        samples = table
    else:
        dof = max(1, round(len(table) / rows))
        if len(table) % dof:
            raise InputError(
                f"{file.name}: {len(table)} numbers cannot be shared among the {rows} rows of "
                f"{time_file.name}: the last sample is cut off, or the files belong to different logs"
            )
        samples = table.reshape(-1, dof)
    if abs(len(samples) - rows) > _SLACK:
        raise InputError(
            f"{file.name}: {len(samples)} rows, but {time_file.name} has {rows}: these files belong to "
            "different logs"
        )
    return samples


def _same_joints(logs: Mapping[str, np.ndarray], files: Mapping[str, Path]) -> None:
    dof = logs["q"].shape[1]
    for channel in ("dq", "tau"):
        if channel in logs and logs[channel].shape[1] != dof:
            raise InputError(
                f"{files[channel].name}: {logs[channel].shape[1]} joints, but {files['q'].name} has {dof}: "
                "each joint needs a number in both"
            )


@dataclasses.dataclass(frozen=True)
class _Run:
    """Rows as they were logged, whose stamps may repeat."""

    name: str
    time: Float[np.ndarray, " time"]
    q: Float[np.ndarray, "time dof"]
    qd: Float[np.ndarray, "time dof"] | None
    tau: Float[np.ndarray, "time dof"] | None
    path: Path
    origin: Origin

    def recording(
        self, row: Callable[[int], str], repairs: Mapping[str, int], notes: tuple[str, ...] = ()
    ) -> Recording:
        channels = (self.time, self.q, self.qd, self.tau)
        made = Recording(self.name, *channels, self.path, repairs, notes, origin=self.origin, row=row)
        return checked(made, row)


def _on_ticks(run: _Run, start: int, repairs: dict[str, int]) -> Recording:
    """The recording with its rows on true ticks if that is better than the stamps, checked either way."""
    row = lambda i: f"row {start + i + 1}"
    if run.qd is None or len(run.time) < 40 or consistent(run.time):
        return run.recording(row, repairs)
    ticks = reconstruct(run.time, run.q, run.qd, run.tau)
    if ticks is None:
        return run.recording(row, repairs)
    evidence = _evidence(ticks)
    if not ticks.better:
        return run.recording(row, repairs, (f"the stamps are kept: {evidence}",))
    new = np.concatenate([[True], np.diff(ticks.tick) > 0])
    repairs |= {
        "repeated rows dropped": int(np.sum(~new)),
        "rows moved from their stamp to their tick": int(np.sum(new)),
        "rows at rest put on a tick by their stamp": ticks.stamped,
        "ticks missing between rows": int(ticks.tick[-1] + 1 - np.sum(new)),
    }
    moved = dataclasses.replace(
        run,
        time=ticks.tick[new] * ticks.period,
        q=run.q[new],
        qd=run.qd[new],
        tau=None if run.tau is None else run.tau[new],
    )
    return moved.recording(
        lambda i: f"row {i + 1}", repairs, (f"rows are on reconstructed ticks: {evidence}",)
    )


def _evidence(ticks: Ticks) -> str:
    return (
        f"rms(dq - d(q)/dt) is {ticks.mismatch_stamps:.3g} rad/s with the stamps and "
        f"{ticks.mismatch_ticks:.3g} rad/s with ticks of {1e3 * ticks.period:g} ms, whose counts are "
        f"integers to {ticks.residual:.2g}"
    )
