"""Writing files so that nothing half-written is ever left behind."""

import contextlib
import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from .errors import InputError


def write_text(path: str | Path, text: str) -> None:
    """Write `text` beside its destination, then move it there in one step."""
    path = Path(path)
    with _as_input_error(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, part = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        try:
            with os.fdopen(handle, "w", encoding="utf-8", newline="") as file:
                file.write(text)
            os.chmod(part, 0o644)
            os.replace(part, path)
        except BaseException:
            os.unlink(part)
            raise


def to_json(document: Any) -> str:
    """JSON of a result; a number that is not finite is a defect and raises."""
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def write_json(path: str | Path, document: Any) -> None:
    """Write a result as JSON."""
    write_text(path, to_json(document))


def read_json(path: str | Path) -> Any:
    """The document in a user's JSON file.

    Raises:
        InputError: no such file, no JSON, or a number that is not finite.
    """
    path = Path(path)
    try:
        text = path.read_text("utf-8-sig")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not a text file, so it cannot be JSON") from None
    try:
        return json.loads(text, parse_constant=_refuse_constant)
    except json.JSONDecodeError as error:
        raise InputError(
            f"{path}: line {error.lineno}, column {error.colno}: {error.msg}; JSON is expected"
        ) from None
    except _NotFiniteError as error:
        raise InputError(f"{path}: holds {error}, where a finite number is needed") from None


class _NotFiniteError(ValueError):
    pass


def _refuse_constant(name: str) -> float:
    raise _NotFiniteError(name)


@contextlib.contextmanager
def output_folder(path: str | Path) -> Iterator[Path]:
    """A scratch folder whose files move into `path` only when the body ends well.

    Files of other names that stand in `path` already are left alone.
    """
    path = Path(path)
    with _as_input_error(path):
        if path.exists() and not path.is_dir():
            raise InputError(f"{path}: is a file; --out needs a folder")
        made = [folder for folder in (path, *path.parents) if not folder.exists()]
        path.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=".jaxpanda.", dir=path))
    try:
        yield scratch
        for part in sorted(scratch.iterdir()):
            os.replace(part, path / part.name)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
        for folder in made:  # leave no empty folder behind when the work failed
            with contextlib.suppress(OSError):
                folder.rmdir()


@contextlib.contextmanager
def _as_input_error(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another --out") from None


def finite(value: float) -> float | None:
    """`value`, or None where it is not finite: what JSON can say of it."""
    return float(value) if math.isfinite(value) else None
