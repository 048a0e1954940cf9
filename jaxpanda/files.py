"""The way out: what a command leaves appears as one set or not at all, and replaces nothing but its own.

No other module opens a file to write it (`tests/test_doors.py`). A set is staged in a folder `.jaxpanda.…` inside
the folder it is meant for, on the same disk, so that a full one is met before anything is replaced. A journal
then says what goes where, and renaming follows. Whatever ends the process before the journal leaves the old set;
after it, the next run finishes the renaming (`settle`).
"""

import contextlib
import dataclasses
import errno
import fcntl
import hashlib
import json
import math
import os
import re
import shutil
import signal
import stat
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from . import inputs
from .errors import InputError, OutputError
from .inputs import read_json

_PREFIX = ".jaxpanda."
_NAME = re.compile(r"\.jaxpanda\.[a-z0-9_]{8}")  # as tempfile.mkdtemp has it
_JOURNAL = "journal"
_DISK = {errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EFBIG, errno.EMFILE, errno.ENFILE, errno.ENOMEM}
_SIGNALS = (signal.SIGINT, signal.SIGTERM)

_staging: list[Path] = []
_last_run: Mapping[str, Any] = {}


# What is written


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file, whole or not at all; among staged files it goes with them.

    Raises:
        InputError: there is no such folder, it cannot be written to, or `path` is no regular file.
        OutputError: the disk is full or broken.
    """
    path = Path(path)
    with _as_sentence(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if _is_staged(path):
            _write(path, content)
            return
        _require_replaceable(path)
        with _scratch(path.parent) as scratch:
            _write(scratch / path.name, content)
            os.replace(scratch / path.name, path)


def write_text(path: str | Path, text: str) -> None:
    """`write_bytes` of UTF-8; a byte of a file's name that is no UTF-8 becomes an escape, as JSON has it too."""
    write_bytes(path, text.encode("utf-8", "backslashreplace"))


def write_json(path: str | Path, document: Any) -> None:
    """Write a result as JSON."""
    write_text(path, to_json(document))


def remove(path: str | Path) -> None:
    """Take away a file of our own that is not needed any more."""
    Path(path).unlink(missing_ok=True)


def write_npz(path: str | Path, arrays: Mapping[str, Any], *, compressed: bool = False) -> None:
    """Write a NumPy archive among staged files, or into a folder of one's own."""
    with _as_sentence(Path(path)), Path(path).open("wb") as file:
        (np.savez_compressed if compressed else np.savez)(file, **arrays)


def to_json(document: Any) -> str:
    """JSON of a result; a number that is not finite is a defect and raises."""
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def finite(value: float) -> float | None:
    """`value`, or None where it is not finite: what JSON can say of it."""
    return float(value) if math.isfinite(value) else None


def _write(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())  # a full disk may say so no earlier


@contextlib.contextmanager
def _as_sentence(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno in _DISK:
            raise OutputError(
                f"{path}: cannot be written ({error.strerror}); what was there is as it was"
            ) from None
        raise InputError(
            f"{path}: cannot be written ({error.strerror or error}); choose another --out"
        ) from None


# Sets


@dataclasses.dataclass(frozen=True)
class Kind:
    """What a set is, so that a later one of the same kind may replace it, and nothing else may."""

    command: str
    """Which leaves it."""
    names: tuple[str, ...]
    """Files that it has at any rate. The first is JSON and lists all of them with their digests."""


@contextlib.contextmanager
def output_folder(path: str | Path, kind: Kind | None = None) -> Iterator[Path]:
    """A scratch folder whose files move into `path` as one set, only when the body ends well.

    Every JSON of the set gets a field `run` with one id, a page a `meta` element; the first of
    `kind.names` has the digests of all others, by which a later set of this kind knows what it may replace, and
    removes what it does not have. Other files in `path` are left alone. Inside another set, the files join that.

    Args:
        path: the folder; made where it is not there.
        kind: None for a set that replaces nothing.

    Raises:
        InputError: a file that stands there is an input, another command's, changed by hand, or no regular
            file; nothing is written then.
        OutputError: the disk is full or broken; what was there before is there still.
    """
    path = Path(path)
    if _is_staged(path):
        path.mkdir(parents=True, exist_ok=True)
        yield path
        return
    with _as_sentence(path):
        if path.exists() and not path.is_dir():
            raise InputError(f"{path}: is a file; --out needs a folder")
        made = [folder for folder in (path, *path.parents) if not folder.exists()]
        path.mkdir(parents=True, exist_ok=True)
    try:
        with contextlib.ExitStack() as stack:
            with _as_sentence(path):
                scratch = stack.enter_context(_scratch(path))
                before = _Before.of(path, kind)
                for name in kind.names if kind else ():
                    before.require_own(name)
                new = scratch / "new"
                new.mkdir()
            yield new
            with _as_sentence(path):
                _commit(new, path, before)
    finally:
        for folder in made:  # leave no empty folder behind when the work failed
            with contextlib.suppress(OSError):
                folder.rmdir()


@contextlib.contextmanager
def output_file(path: str | Path, own: Callable[[bytes], bool]) -> Iterator[Path]:
    """Where to write what becomes the file `path` when the body ends well.

    Args:
        path: the file.
        own: whether what stands there now was written by the same command, and may be replaced.

    Raises:
        InputError, OutputError: as `output_folder`.
    """
    path = Path(path)

    def require_own() -> None:
        found = _require_replaceable(path)
        if found is not None and found.st_size and not own(path.read_bytes()):
            raise InputError(
                f"{path}: stands there already and is no earlier result of this command; {_ADVICE}"
            )

    require_own()
    with output_folder(path.parent) as scratch:
        yield scratch / path.name
        require_own()
        with _as_sentence(path):
            os.replace(scratch / path.name, path)


def stamped(document: Any) -> Any:
    """A command's document as it was written last: with the field `run`, where it is the first of that set."""
    same = isinstance(document, dict) and document.get("schema") == _last_run.get("schema")
    return {**document, "run": _last_run["run"]} if same and _last_run else document


_ADVICE = "choose another --out, or move it away"


@dataclasses.dataclass(frozen=True)
class _Before:
    """What stood in a folder before a set came."""

    path: Path
    kind: Kind | None
    listed: Mapping[str, str]
    """Digests of the earlier set, by name; empty where there is none."""
    legacy: bool
    """It is of a version that kept no list."""

    @classmethod
    def of(cls, path: Path, kind: Kind | None) -> "_Before":
        run = _run_of(path / kind.names[0]) if kind else None
        if kind is None or run is None:
            return cls(path, kind, {}, False)
        files = run.get("files", {}) if run.get("command", kind.command) == kind.command else None
        listed = files if isinstance(files, dict) else {}
        return cls(path, kind, {str(name): str(value) for name, value in listed.items()}, not run)

    def require_own(self, name: str, content: bytes | None = None) -> bool:
        """Refuse to replace what is not of an earlier set; False where the same content stands there already."""
        target, command = self.path / name, self.kind.command if self.kind else "this command"
        if (
            target.parent.resolve() != self.path.resolve()
            and self.path.resolve() not in target.parent.resolve().parents
        ):
            raise InputError(f"{target}: lies outside of {self.path}, where {command} writes nothing")
        try:
            found = _require_replaceable(target)
        except InputError:
            if content is None or not target.is_file() or target.read_bytes() != content:
                raise
            return False
        if found is None or found.st_size == 0:
            return True
        if content is not None and found.st_size == len(content) and target.read_bytes() == content:
            return False
        run = _run_of(target) if target.suffix == ".json" else None
        if run is not None and (other := run.get("command", command)) != command:
            raise InputError(
                f"{target}: is a result of `{other}`, which {command} does not replace; {_ADVICE}"
            )
        if name in self.listed and self.listed[name] != _sha256(target):
            raise InputError(f"{target}: was changed since {command} wrote it; {_ADVICE}")
        if name not in self.listed and not self.legacy and run is None:
            raise InputError(
                f"{target}: stands there already and is no earlier result of {command}; {_ADVICE}"
            )
        return True

    def stale(self, names: Sequence[str]) -> list[str]:
        """Files of the earlier set that the new one does not have, unless they were changed or read."""
        gone = []
        for name, digest in self.listed.items():
            target = self.path / name
            plain = not Path(name).is_absolute() and ".." not in Path(name).parts
            if name in names or not plain or not target.is_file() or target.is_symlink():
                continue
            if not inputs.is_input(target.stat()) and _sha256(target) == digest:
                gone.append(name)
        return gone


def _run_of(file: Path) -> dict[str, Any] | None:
    """The field `run` of a result, empty where an older version wrote it; None where no result stands."""
    if not file.is_file() or file.is_symlink():
        return None
    with inputs.forgotten():
        try:
            document = read_json(file)
        except InputError:
            return None
    if not isinstance(document, dict) or not str(document.get("schema", "")).startswith("jaxpanda."):
        return None
    run = document.get("run")
    return run if isinstance(run, dict) else {}


def _require_replaceable(path: Path) -> os.stat_result | None:
    """What stands at `path`; refuse what is no regular file, or was read by this command."""
    try:
        found = path.lstat()
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be written ({error}); choose another --out") from None
    if not stat.S_ISREG(found.st_mode):
        raise InputError(
            f"{path}: is {inputs.kind_of(found)}, which no result replaces; choose another --out"
        )
    if inputs.is_input(found):
        raise InputError(
            f"{path}: is an input of this command, which its result would replace; choose another --out"
        )
    return found


def _commit(new: Path, path: Path, before: _Before) -> None:
    names = [file.relative_to(new).as_posix() for file in sorted(new.rglob("*")) if file.is_file()]
    if before.kind is not None and names:
        _stamp(new, names, before.kind)
    put = [name for name in names if before.require_own(name, (new / name).read_bytes())]
    drop = before.stale(names)
    for name in put:
        (path / name).parent.mkdir(parents=True, exist_ok=True)
    with _uninterrupted():
        _write(new.parent / _JOURNAL, to_json({"put": put, "drop": drop}).encode())
        old = new.parent / "old"
        for name in put:
            if (path / name).exists():
                (old / name).parent.mkdir(parents=True, exist_ok=True)
                _keep(path / name, old / name)
        try:
            _swap(new, path, put, drop)
        except OSError:
            for name in put:
                if (old / name).exists():
                    os.replace(old / name, path / name)
                elif not (new / name).exists():
                    (path / name).unlink(missing_ok=True)
            raise


def _keep(file: Path, copy: Path) -> None:
    try:
        os.link(file, copy)
    except OSError:  # a file system without links
        shutil.copy2(file, copy)


def _swap(new: Path, path: Path, put: Sequence[str], drop: Sequence[str]) -> None:
    for name in put:
        if (new / name).exists():  # else it was moved before the process ended
            os.replace(new / name, path / name)
    for name in drop:
        (path / name).unlink(missing_ok=True)


def _stamp(new: Path, names: Sequence[str], kind: Kind) -> None:
    """Put one id into every JSON and page of a set, and the digests into its first file."""
    global _last_run
    digests = {name: _sha256(new / name) for name in names}
    run: dict[str, Any] = {
        "id": hashlib.sha256(to_json([kind.command, digests]).encode()).hexdigest()[:16],
        "command": kind.command,
    }
    for name in names:
        if name.endswith(".json") and name != kind.names[0]:
            write_json(new / name, {**read_json(new / name), "run": run})
        elif name.endswith(".html"):
            text, meta = (new / name).read_text("utf-8"), f'<meta name="jaxpanda-run" content="{run["id"]}">'
            write_text(new / name, text.replace("<head>", f"<head>\n{meta}", 1))
    main = new / kind.names[0]
    if main.exists():
        run["files"] = {name: _sha256(new / name) for name in names if name != kind.names[0]}
        document = {**read_json(main), "run": run}
        write_json(main, document)
        _last_run = {"schema": document.get("schema"), "run": run}


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


# Scratch folders


def _is_staged(path: Path) -> bool:
    return any(scratch == path or scratch in path.parents for scratch in _staging)


@contextlib.contextmanager
def _scratch(folder: Path) -> Iterator[Path]:
    """A folder inside `folder` that its process holds locked, so that others know whether that is alive."""
    settle(folder)
    scratch, lock = _locked(folder)
    _staging.append(scratch)
    try:
        yield scratch
    finally:
        _staging.remove(scratch)
        shutil.rmtree(scratch, ignore_errors=True)
        os.close(lock)


def _locked(folder: Path) -> tuple[Path, int]:
    while True:
        scratch = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=folder))
        lock = os.open(scratch, os.O_RDONLY | os.O_CLOEXEC)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:  # `settle` of another process took it for a dead one's before it was locked
            os.close(lock)
            continue
        except OSError:  # not every file system locks folders; then nobody clears up
            return scratch, lock
        if scratch.exists():
            return scratch, lock
        os.close(lock)


def settle(folder: str | Path) -> None:
    """Finish what a process that was killed had begun to put into a folder, or clear it away.

    Only folders of our own user's that no process holds.
    """
    folder = Path(folder)
    names = (
        sorted(os.listdir(folder))
        if folder.is_dir() and os.access(folder, os.R_OK | os.W_OK | os.X_OK)
        else []
    )
    for scratch in [folder / name for name in names if _NAME.fullmatch(name)]:
        with contextlib.suppress(OSError):
            state = scratch.lstat()
            if state.st_uid != os.geteuid() or stat.S_IMODE(state.st_mode) != 0o700 or _is_staged(scratch):
                continue
            lock = os.open(scratch, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_DIRECTORY)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                _finish(scratch, folder)
                shutil.rmtree(scratch, ignore_errors=True)
            finally:
                os.close(lock)


def _finish(scratch: Path, folder: Path) -> None:
    try:
        journal = json.loads((scratch / _JOURNAL).read_bytes())
        put, drop = [str(name) for name in journal["put"]], [str(name) for name in journal["drop"]]
    except (OSError, ValueError, LookupError, TypeError):
        return  # it had not come so far
    if all(not Path(name).is_absolute() and ".." not in Path(name).parts for name in (*put, *drop)):
        _swap(scratch / "new", folder, put, drop)


@contextlib.contextmanager
def _uninterrupted() -> Iterator[None]:
    """Signals wait until the body has ended; for what takes milliseconds."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    before = {number: signal.signal(number, lambda number, _: came.append(number)) for number in _SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        for number in came:
            signal.raise_signal(number)
