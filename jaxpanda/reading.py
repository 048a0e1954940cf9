"""Which part of a log is meant, and which of its columns is what: the options of every command that reads one.

Imported by the command line before numpy is, so it needs neither numpy nor JAX.
"""

import dataclasses
import math
from typing import Annotated

import tyro

from .errors import InputError

CHANNELS = ("time", "q", "dq", "tau", "tau_motor")
"""What a log's columns can be, as the canonical CSV calls it."""


@dataclasses.dataclass(frozen=True)
class Reading:
    """What is read of a recording, where a file holds more than one or does not say what its columns are."""

    columns: tuple[str, ...] = ()
    """Which column is which, as time=t:ms q=pos_{j}:deg dq=vel_{j} tau=; {j} is the joint's number, what follows
    a colon the unit, and nothing after = leaves the channel out (docs/files.md)."""
    topic: str = ""
    """Topic of a bag, where several could be meant."""
    episode: tuple[str, ...] = ()
    """Episodes of a file or folder that holds several, each a recording."""
    from_: Annotated[float, tyro.conf.arg(name="from")] = -math.inf
    """Only rows from this time on, by the recording's own time [s]."""
    to: float = math.inf
    """Only rows up to this time [s]."""

    def __post_init__(self):
        if not self.from_ < self.to:
            raise InputError(f"--from {self.from_:g} --to {self.to:g}: --from must be before --to")
        self.channels()

    @property
    def whole(self) -> bool:
        """Whether neither `from_` nor `to` cuts anything."""
        return self.from_ == -math.inf and self.to == math.inf

    def channels(self) -> dict[str, str]:
        """What `columns` says of each channel.

        Raises:
            InputError: it is no `channel=columns`, or a channel is there twice.
        """
        said: dict[str, str] = {}
        for given in self.columns:
            channel, equals, where = given.partition("=")
            stem, _, joint = channel.rpartition("_")
            if not equals or (channel not in CHANNELS and not (stem in CHANNELS[1:] and joint.isdecimal())):
                raise InputError(
                    f"--columns {given}: CHANNEL=COLUMNS is needed, such as q=pos_{{j}}, where CHANNEL is one of"
                    f" {', '.join(CHANNELS)}"
                )
            if channel in said:
                raise InputError(f"--columns {given}: {channel} is said twice")
            said[channel] = where
        return said
