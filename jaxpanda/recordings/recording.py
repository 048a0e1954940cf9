"""`Recording`: what an arm's log says, in SI units, with an account of what reading it took."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from ..errors import InputError

Torque = Literal["measured", "gravity_removed", "current", "commanded", "motor_side", "unstated"]
"""What a source says its torque is; `measured` is what a recording's must be."""

_CHANNELS = {"q": "q", "dq": "qd", "tau": "tau", "tau_motor": "tau_motor"}
"""What the canonical CSV calls the channels of the joints, and their fields here."""


@dataclasses.dataclass(frozen=True)
class Origin:
    """Which of a log's columns a recording was made of, and what the log's source says they are."""

    source: str
    """Who writes such logs, or who says what the columns are."""
    channels: Mapping[str, str]
    """Of time, q, dq and tau, the columns they were taken from."""
    torque: Torque = "unstated"
    says: str = ""
    """Of torque, in words."""
    columns: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Of each channel, and of each joint's, what `--columns` calls it, without a unit."""

    def lines(self) -> list[str]:
        """For who looks at a recording."""
        took = "; ".join(f"{channel} from {columns}" for channel, columns in self.channels.items())
        return [f"taken for {self.source}: {took}", *([f"its source says: {self.says}"] if self.says else [])]

    def to_json(self) -> dict[str, Any]:
        return {
            "source": self.source,
            "channels": dict(self.channels),
            "torque": self.torque,
            "says": self.says,
        }


@dataclasses.dataclass(frozen=True)
class Recording:
    """Channels of one motion of an arm, as logged; nothing in it is filtered or resampled.

    `time` increases strictly but need not be uniform.

    Raises:
        InputError: on construction, where channels differ in length or joints, a number is not finite, or time
            does not increase; naming the column and the row, as `row` counts them.
    """

    name: str
    """File or folder name, as messages and `diagnosis.json` call it; `distinct` puts folders before it."""
    time: Float[np.ndarray, " time"]
    """[s]"""
    q: Float[np.ndarray, "time dof"]
    """Joint positions [rad]."""
    qd: Float[np.ndarray, "time dof"] | None = None
    """Joint velocities as logged [rad/s], often late and filtered."""
    tau: Float[np.ndarray, "time dof"] | None = None
    """Measured joint torque [N m], gravity included; None for a motion."""
    path: Path | None = None
    repairs: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """How many rows or values reading dropped, filled or moved, by what was done; empty if none."""
    notes: tuple[str, ...] = ()
    """What else reading found out, and the evidence for the repairs, in plain words."""
    stamps: Float[np.ndarray, " time"] | None = None
    """Time as it was written [s], where rows were moved to ticks; else None."""
    origin: Origin | None = None
    """What a file called the channels; None where the recording comes from no file."""
    tau_motor: Float[np.ndarray, "time dof"] | None = None
    """Torque of the motors at the joints [N m], where it was measured beside `tau`; what the drives lose is in
    it."""
    transmitted: Float[np.ndarray, "time dof"] | None = None
    """Torque that the drives pass on to the links [N m], where `tau` is the motors' and this is known."""
    row: dataclasses.InitVar[Callable[[int], str] | None] = None
    """How the file counts sample `i` (0-based), for messages."""

    def __post_init__(self, row: Callable[[int], str] | None):
        for name in ("time", *_CHANNELS.values(), "stamps"):
            object.__setattr__(self, name, _array(getattr(self, name), name, self.name))
        self._require_shapes()
        row = row or (lambda i: f"row {i + 1}")
        self._require_finite(row)
        self._require_order(row)

    def _require_shapes(self) -> None:
        if self.time.ndim != 1 or self.q.ndim != 2 or self.q.shape[1] == 0:
            raise InputError(
                f"{self.name}: time has the shape {self.time.shape} and q {self.q.shape}, where (n,) and "
                "(n, joints) are needed"
            )
        for name, channel in self.measured.items():
            if channel.shape != (self.samples, self.dof):
                raise InputError(
                    f"{self.name}: {name} has the shape {channel.shape}, where "
                    f"{(self.samples, self.dof)} is needed, a row for each time and a column for each joint"
                )

    def _require_finite(self, row: Callable[[int], str]) -> None:
        for name, column in self.columns():
            bad = np.flatnonzero(~np.isfinite(column))
            if not bad.size:
                continue
            channel = name.rpartition("_")[0]
            if channel and np.isnan(column).all():
                without = "" if channel == "q" else f", or none: --columns {channel}= leaves the channel out"
                what = "no row has a number, where every joint's are needed"
                raise InputError(f"{self.name}: column {name}: {what}{without}")
            more = f" and {bad.size - 1} more below it" if bad.size > 1 else ""
            raise InputError(
                f"{self.name}: column {name}, {row(int(bad[0]))}: the value is {column[bad[0]]}{more}, "
                "where a finite number is needed; leave out the rows that were not measured"
            )

    def _require_order(self, row: Callable[[int], str]) -> None:
        back = np.flatnonzero(np.diff(self.time) <= 0)
        if back.size:
            i = int(back[0]) + 1
            before, after = float(self.time[i - 1]), float(self.time[i])
            what = "repeats" if before == after else "goes back"
            raise InputError(
                f"{self.name}: column time, {row(i)}: time {what} ({before!r} s, then {after!r} s; "
                f"{back.size} such rows), where it must increase; sort the rows, drop repeated ones, or split "
                "the file into its runs"
            )

    def columns(self) -> Iterator[tuple[str, Float[np.ndarray, " time"]]]:
        """Each column with the name that the canonical CSV gives it."""
        yield "time", self.time
        for name, channel in self.measured.items():
            yield from ((f"{name}_{j + 1}", channel[:, j]) for j in range(channel.shape[1]))

    def called(self, channel: str) -> str:
        """What `--columns` calls a channel, such as q, or that of one joint, such as q_2."""
        columns = {} if self.origin is None else self.origin.columns
        plain = channel if channel == "time" or "_" in channel else f"{channel}_{{j}}"
        return columns.get(channel, plain)

    @property
    def dof(self) -> int:
        return self.q.shape[1]

    @property
    def samples(self) -> int:
        return len(self.time)

    @property
    def rate(self) -> float:
        """Sample rate [Hz]: the inverse of the median step."""
        return 1 / float(np.median(np.diff(self.time)))

    @property
    def measured(self) -> dict[str, Float[np.ndarray, "time dof"]]:
        """q, and what else was measured of dq, tau and tau_motor, by the names of the canonical CSV."""
        each = {name: getattr(self, field) for name, field in _CHANNELS.items()}
        return {name: channel for name, channel in each.items() if channel is not None}

    def channels(self) -> list[Float[np.ndarray, "time dof"]]:
        """`measured` without the names."""
        return list(self.measured.values())

    def at(self, rows: slice | Bool[np.ndarray, " time"]) -> "Recording":
        """Some of its rows."""
        names = ("time", *_CHANNELS.values(), "transmitted", "stamps")
        kept = {name: x[rows] for name in names if (x := getattr(self, name)) is not None}
        return dataclasses.replace(self, **kept)

    def of_link_side(self) -> "Recording":
        """The same with the torque behind the drives alone."""
        return dataclasses.replace(self, tau_motor=None)

    def of_motor_side(self) -> "Recording":
        """The same with the motors' torque alone, in the place of `tau`."""
        return dataclasses.replace(self, tau=self.tau_motor, tau_motor=None)

    def require_dof(self, dof: int) -> None:
        """Refuse a recording of an arm with another number of joints."""
        if self.dof != dof:
            raise InputError(
                f"{self.name}: {self.dof} joints (columns q_1 ... q_{self.dof}), where the model has {dof}: "
                "both must be of one arm"
            )

    def require_tau(self) -> Float[np.ndarray, "time dof"]:
        """The measured torque; refuse a motion."""
        if self.tau is None:
            said = f" ({self.origin.says})" if self.origin and self.origin.says else ""
            if self.tau_motor is not None:
                said = "; --columns tau=tau_motor_{j} takes the motors' torque for it"
            raise InputError(
                f"{self.name}: no columns tau_1 ... tau_{self.dof}: this needs measured joint torques, not a "
                f"motion{said}"
            )
        return self.tau


def _array(values: Any, channel: str, name: str) -> np.ndarray | None:
    if values is None:
        return None
    try:
        return np.asarray(values, float)
    except (TypeError, ValueError):
        raise InputError(f"{name}: {channel} is no array of numbers") from None
