"""The command `compare`: between files and files."""

from pathlib import Path

from ..files import output_folder
from ..recordings import load
from ..session import telling
from .compare import compare
from .result import KIND, Comparison


def compare_files(out: Path, a: Path, b: Path, motion: Path | None = None) -> Comparison:
    """`jaxpanda compare`."""
    with output_folder(out, KIND) as folder, telling("comparing") as say:
        say("reading both results")
        found = compare(a, b, motion=None if motion is None else load(motion))
        found.save(folder)
    return found
