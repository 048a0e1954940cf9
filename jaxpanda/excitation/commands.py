"""The command `excite`: between files and files."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..arms.model_file import Model
from ..files import output_folder
from ..session import progress
from .excite import excite
from .result import KIND, Excitation


def excite_files(
    out: Path, model: Model | None, limits: Mapping[str, Sequence[float]], **options: Any
) -> Excitation:
    """`jaxpanda excite`."""
    with output_folder(out, KIND) as folder, progress("designing the motion") as tick:
        found = excite(model, limits=limits, progress=tick, **options)
        found.save(folder)
    return found
