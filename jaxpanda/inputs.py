"""The way in: everything that is read is a regular file within caps, or one sentence says why not.

No other module opens a file to read it (`tests/test_doors.py`), so that what holds here holds for every format.
"""

import contextlib
import gzip
import hashlib
import io
import json
import math
import os
import stat
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from .errors import InputError, reason

BYTES = 1 << 29
"""Most that is read of one file, and most that it may unpack to; an hour of a 7-joint arm at 1 kHz is less in any
binary format."""
IN_PLACE = 1 << 36
"""Most of a file of which a library reads only the parts it is asked for, as a bag's topic or one data set."""
RATIO = 200
"""Recordings never pack so tightly; what does, and is long, was made to fill the memory."""
_SMALL = 1 << 26
"""Bytes below which the ratio is no matter."""
JSON_BYTES = 1 << 27
JSON_DEPTH = 64
_CHUNK = 1 << 20

_read: set[tuple[int, int]] | None = None


@contextlib.contextmanager
def remembered() -> Iterator[None]:
    """While it lasts, what is read is remembered as input, which no output may replace (`is_input`)."""
    global _read
    before, _read = _read, set() if _read is None else _read
    try:
        yield
    finally:
        _read = before


@contextlib.contextmanager
def forgotten() -> Iterator[None]:
    """While it lasts, what is read is no input: results of earlier runs, looked at before they are replaced."""
    global _read
    before, _read = _read, None
    try:
        yield
    finally:
        _read = before


def is_input(found: os.stat_result) -> bool:
    """Whether this file was read since `remembered` began."""
    return _read is not None and (found.st_dev, found.st_ino) in _read


def kind_of(found: os.stat_result) -> str:
    """What a file is that is no regular one, in words."""
    kinds = {
        stat.S_IFDIR: "a folder",
        stat.S_IFLNK: "a link",
        stat.S_IFIFO: "a pipe",
        stat.S_IFCHR: "a device",
    }
    return kinds.get(stat.S_IFMT(found.st_mode), "a special file")


def require_regular(path: str | Path, most: int = BYTES, where: str = "") -> None:
    """Refuse a file that others will open for us unless it is a regular one of no more than `most` bytes.

    Raises:
        InputError: as `read_bytes`.
    """
    os.close(_opened(Path(path), most, where))


def in_place(path: str | Path, most: int = IN_PLACE) -> Path:
    """The same path, for a library that opens files itself; of a folder, each file in it is looked at.

    Raises:
        InputError: as `read_bytes`.
    """
    path = Path(path)
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        if not file.is_dir():
            require_regular(file, most)
    return path


def read_start(path: str | Path, count: int) -> bytes:
    """The first bytes of a file, however large it is; for what tells its kind.

    Raises:
        InputError: as `read_bytes`.
    """
    with os.fdopen(_opened(Path(path), IN_PLACE, ""), "rb") as file:
        return file.read(count)


def read_bytes(path: str | Path, most: int = BYTES, where: str = "") -> bytes:
    """The file's content.

    Args:
        path: the file; a link to one will do.
        most: bytes that it may have.
        where: how the refusal begins, as "arm.xml: line 3: includes 'x.xml', which"; without it, with the path.

    Raises:
        InputError: absent, unreadable, no regular file (a folder, pipe or device), or too large.
    """
    path = Path(path)
    with os.fdopen(_opened(path, most, where), "rb") as file:
        try:
            size = os.fstat(file.fileno()).st_size  # asked for `most`, Python makes room for that much
            parts = [file.read(min(size, most) + 1)]
            while len(parts[-1]) and sum(map(len, parts)) <= most:
                parts.append(file.read(_CHUNK))
        except OSError as error:
            raise InputError(f"{where or f'{path}:'} cannot be read ({error.strerror})") from None
    content = b"".join(filter(None, parts))
    if len(content) > most:  # it grew
        _too_large(where or f"{path}:", most)
    return content


def require_written(path: Path, command: str) -> None:
    """Refuse a file that a command writes into its folder, where it is not there."""
    if not path.exists():
        raise InputError(f"{path}: is not there; a folder that `{command}` wrote is needed")


def _opened(path: Path, most: int, where: str) -> int:
    where = where or f"{path}:"
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe does not block
    except FileNotFoundError:
        raise InputError(f"{where} cannot be read (no such file)") from None
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the name
        raise InputError(f"{where} cannot be read ({getattr(error, 'strerror', None) or error})") from None
    found = os.fstat(handle)
    try:
        if not stat.S_ISREG(found.st_mode):
            raise InputError(f"{where} cannot be read (it is {kind_of(found)}); a regular file is needed")
        if found.st_size > most:
            _too_large(where, most)
    except InputError:
        os.close(handle)
        raise
    if _read is not None:
        _read.add((found.st_dev, found.st_ino))
    return handle


def _too_large(where: str, most: int) -> NoReturn:
    raise InputError(f"{where} has more than {_size(most)}, the most that is read of such a file; cut it")


def require_size(name: str, count: int, most: int = BYTES // 8) -> None:
    """Refuse a table of more than `most` numbers before there is room made for it."""
    if not 0 <= count <= most:
        raise InputError(f"{name}: holds {count} numbers, where at most {most} are read: cut it")


def _size(count: int) -> str:
    return f"{count >> 20} MiB" if count >= 1 << 20 else f"{count} bytes"


def read_text(path: str | Path, most: int = BYTES, what: str = "text") -> str:
    """The text of a file, plain or `.gz`, without a byte-order mark.

    Args:
        path: the file.
        most: bytes that it may have, unpacked.
        what: it should be, for messages.

    Raises:
        InputError: as `read_bytes`; a broken gzip file, empty, or no text.
    """
    path = Path(path)
    content = read_bytes(path, most)
    if path.suffix == ".gz":
        content = unpacked(content, path, most)
    if not content or content.isspace():
        raise InputError(f"{path.name}: the file is empty")
    if 0 <= (at := content.find(0)) < _CHUNK:
        raise InputError(f"{path.name}: binary data (byte {at + 1} is zero), no text: {what} is needed")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path.name}: no text (byte {error.start} is not UTF-8): {what} is needed"
        ) from None


def unpacked(content: bytes, path: Path, most: int = BYTES) -> bytes:
    """What a gzip file holds.

    Raises:
        InputError: it is broken, or unpacks to more than recordings do.
    """
    out = bytearray()
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(content)) as file:
            while part := file.read(_CHUNK):
                out += part
                require_unpacked(path.name, len(content), len(out), most)
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(
            f"{path.name}: a broken or truncated gzip file ({reason(error)}): copy it again"
        ) from None
    return bytes(out)


def require_unpacked(name: str, packed: int, size: int, most: int = BYTES) -> None:
    """Refuse what unpacks to more than recordings do, from `packed` bytes to `size`."""
    if size > most or size > max(_SMALL, RATIO * packed):
        _bomb(name, packed, size, most)


def _bomb(name: str, packed: int, size: int, most: int) -> NoReturn:
    what = f"to more than {_size(most)}" if size > most else f"{size // max(packed, 1)}-fold"
    raise InputError(f"{name}: unpacks {what}, more than a recording does; it is not read")


def read_npz(path: str | Path, most: int = BYTES) -> dict[str, np.ndarray]:
    """The arrays of a NumPy archive, numbers only.

    Raises:
        InputError: as `read_bytes`; no archive, a broken one, pickled objects, or too much when unpacked.
    """
    path = Path(path)
    content = read_bytes(path, most)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        require_unpacked(path.name, len(content), size, most)
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            found = {name: arrays[name] for name in arrays.files}
    except InputError:
        raise
    except (ValueError, MemoryError, TypeError) as error:
        raise InputError(
            f"{path}: holds no plain arrays ({reason(error)}): save numbers only, no objects"
        ) from None
    except Exception as error:  # zip, deflate and header errors have no common class
        raise InputError(
            f"{path}: no NumPy archive (.npz), or a broken one ({type(error).__name__}: {reason(error)})"
        ) from None
    for name, array in found.items():
        if not isinstance(array, np.ndarray):  # a member that is no array comes as bytes
            raise InputError(
                f"{path}: {name!r} in it is no array; an archive as numpy.savez writes it is needed"
            )
    return found


def read_json(path: str | Path) -> Any:
    """The document in a user's JSON file: every number in it finite, no deeper than `JSON_DEPTH`.

    Raises:
        InputError: as `read_bytes`; no JSON, a number that is not finite, or too deep.
    """
    text = _json_text(Path(path))
    try:
        document = json.loads(text, parse_constant=_refuse, parse_float=_float, parse_int=_int)
    except json.JSONDecodeError as error:
        raise InputError(
            f"{path}: line {error.lineno}, column {error.colno}: {error.msg}; JSON is expected"
        ) from None
    except _NotFiniteError as error:
        raise InputError(f"{path}: holds {error}, where a finite number is needed") from None
    except RecursionError:
        _too_deep(path)
    if not _shallow(document, JSON_DEPTH):
        _too_deep(path)
    return document


def _too_deep(path: str | Path) -> NoReturn:
    raise InputError(f"{path}: is nested deeper than {JSON_DEPTH} levels, which no result is")


def _json_text(path: Path) -> str:
    content = read_bytes(path, JSON_BYTES)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not a text file, so it cannot be JSON") from None


def _shallow(document: Any, levels: int) -> bool:
    layer = [document]
    for _ in range(levels + 1):
        layer = [part for part in layer if isinstance(part, dict | list)]
        if not layer:
            return True
        layer = [one for part in layer for one in (part.values() if isinstance(part, dict) else part)]
    return False


class _NotFiniteError(ValueError):
    pass


def _refuse(name: str) -> float:
    raise _NotFiniteError(name)


def _float(digits: str) -> float:
    value = float(digits)
    return value if math.isfinite(value) else _refuse(_short(digits))


def _int(digits: str) -> int:
    if len(digits) > 20:
        raise _NotFiniteError(f"{_short(digits)}, a whole number of {len(digits)} digits")
    return int(digits)


def _short(digits: str) -> str:
    return digits if len(digits) <= 24 else f"{digits[:20]}…"


def digest(*paths: str | Path) -> str:
    """SHA-256 of files' contents, one after the other."""
    found = hashlib.sha256()
    for path in paths:
        with os.fdopen(_opened(Path(path), IN_PLACE, ""), "rb") as file:
            while part := file.read(_CHUNK):
                found.update(part)
    return found.hexdigest()
