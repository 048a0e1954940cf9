"""Outcomes of finished starts in a file, from which an interrupted run goes on.

A line of JSON says what the starts belong to; blocks follow, each with its length and checksum, appended as
chunks finish. A block that was cut off by the end of the process is dropped, so whatever stops a run leaves a
file that can be used.
"""

import hashlib
import json
import os
import platform
import re
import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels import inertia

from ..errors import InputError
from .bounds import Bounds
from .constraints import Constraint, Links

SCHEMA = "jaxpanda.starts/1"
_BLOCK = struct.Struct("<QQI")  # first start, starts, checksum


class Checkpoint:
    """A file of finished starts.

    Args:
        path: the file; its folder exists.
        identity: what a start's outcome depends on, under the names that a refusal gives them.
    """

    def __init__(self, path: str | Path, identity: Mapping[str, str]):
        self.path = Path(path)
        self.identity = dict(identity)

    def require_same(self) -> None:
        """Refuse a file of another run before any work is done.

        Raises:
            InputError: the file is of another run, or is no checkpoint.
        """
        if not self.path.exists():
            return
        with self.path.open("rb") as file:
            line = file.readline(1 << 20)
        try:
            found = json.loads(line)
            theirs = found["identity"]
            if found["schema"] != SCHEMA or not isinstance(theirs, dict):
                raise ValueError(found["schema"])
        except (ValueError, KeyError, TypeError):
            raise InputError(
                f"{self.path}: is no checkpoint of starts; move it away, or choose another --out"
            ) from None
        differing = [name for name, value in self.identity.items() if theirs.get(name) != value]
        if differing:
            raise InputError(
                f"{self.path}: holds finished starts of another run (other {', '.join(differing)}); "
                "repeat that run to finish it, or remove the file"
            )

    def restore(self, outcome: tuple[np.ndarray, ...]) -> int:
        """Copy the finished starts, without gap from the first on, into `outcome`; how many those are.

        Leaves the file ready for `append`.

        Args:
            outcome: arrays with a row a start, as the blocks hold them; filled in place.
        """
        self._row = np.dtype([(f"{i}", one.dtype, one.shape[1:]) for i, one in enumerate(outcome)])
        header = {"schema": SCHEMA, "identity": self.identity}
        if not self.path.exists():
            part = self.path.with_name(f".{self.path.name}.part")
            part.write_bytes(json.dumps(header).encode() + b"\n")
            os.replace(part, self.path)
            return 0
        size, done = self.path.stat().st_size, 0
        with self.path.open("r+b") as file:
            file.readline()
            whole = file.tell()
            while len(start := file.read(_BLOCK.size)) == _BLOCK.size:
                first, count, checksum = _BLOCK.unpack(start)
                if first != done or file.tell() + count * self._row.itemsize > size:
                    break
                block = file.read(count * self._row.itemsize)
                if zlib.crc32(block) != checksum:
                    break
                rows = np.frombuffer(block, self._row)
                for name, one in zip(self._row.names or (), outcome, strict=True):
                    one[first : first + count] = rows[name][: max(0, len(one) - first)]
                whole, done = file.tell(), first + count
            file.truncate(whole)
        return min(done, len(outcome[0]))

    def append(self, first: int, parts: tuple[np.ndarray, ...]) -> None:
        """Add the outcome of starts `first`, `first` + 1, ..."""
        rows = np.empty(len(parts[0]), self._row)
        for name, part in zip(self._row.names or (), parts, strict=True):
            rows[name] = part
        block = rows.data
        with self.path.open("ab") as file:
            file.write(_BLOCK.pack(first, len(rows), zlib.crc32(block)))
            file.write(block)

    def remove(self) -> None:
        """The run is over and its result saved."""
        self.path.unlink(missing_ok=True)


def identity(
    A: np.ndarray,
    b: np.ndarray,
    bounds: Bounds,
    constraints: Sequence[Constraint],
    extra: tuple[np.ndarray | None, ...],
    seed: int,
    settings: tuple[int | tuple[int, ...], ...],
) -> dict[str, str]:
    """What a start's outcome depends on, by name: the numbers as digests, programs by their source."""
    here = Path(__file__).parent
    sources = [*sorted(here.glob("*.py")), Path(inertia.__file__)]
    device = jax.devices()[0]
    boxes = [np.append(i, box) for i, (_, box) in enumerate(bounds.boxes())]
    none = np.zeros(0)
    return {
        "coefficients": _digest(A, b),
        "bounds": _digest(*boxes),
        "constraints": _digest(*(part for one in constraints for part in _program(one, bounds.dof))),
        "further unknowns or given starts": _digest(*(none if one is None else one for one in extra)),
        "seed": str(seed),
        "settings": str(settings),
        "software": f"JAX {jax.__version__}, {_digest(*(path.read_bytes() for path in sources))}",
        "device": f"{platform.machine()}, {device.device_kind}",
    }


def _digest(*parts: np.ndarray | bytes) -> str:
    found = hashlib.sha256()
    for part in parts:
        data = part if isinstance(part, bytes) else np.ascontiguousarray(part).tobytes()
        found.update(struct.pack("<Q", len(data)) + data)
    return found.hexdigest()[:16]


def _program(constraint: Constraint, dof: int) -> list[np.ndarray | bytes]:
    """What a constraint computes: its operations, and the numbers that they hold."""
    links = Links(jnp.zeros(dof), jnp.zeros((dof, 3)), jnp.zeros((dof, 3, 3)))
    traced = jax.make_jaxpr(constraint)(links)
    operations = re.sub(r"0x[0-9a-f]+", "", str(traced.jaxpr))
    return [operations.encode(), *(np.asarray(number) for number in traced.consts)]
