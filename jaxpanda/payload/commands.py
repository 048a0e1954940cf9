"""The command `payload`: between files and files."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from ..arms.export import missing_assets
from ..arms.model_file import Model
from ..convention import PLAIN, Convention
from ..errors import InputError
from ..files import output_folder
from ..reading import Reading
from ..recordings import load_many
from .estimate import estimate_payload
from .result import KIND, MODEL_XML, PayloadEstimate


def payload_files(
    out: Path,
    model: Model | None,
    without: Sequence[Path],
    loaded: Sequence[Path],
    *,
    frame: str,
    torque_scale_std: float,
    reading: Reading | None = None,
    convention: Convention = PLAIN,
) -> PayloadEstimate:
    """`jaxpanda payload`."""
    for flag, paths in (("--without", without), ("--with", loaded)):
        if not paths:
            raise InputError(f"{flag}: none given; name at least one file or folder")
    with output_folder(out, KIND) as folder:
        found = estimate_payload(
            model,
            convention.applied(load_many(without, reading), model),
            convention.applied(load_many(loaded, reading), model),
            frame=frame,
            torque_scale_std=torque_scale_std,
            gravity=convention.mounting,
        )
        if found.written is not None:
            missing = tuple(f"{MODEL_XML}: {what}" for what in missing_assets(found.written, out))
            found = dataclasses.replace(found, notes=(*found.notes, *missing))
        found.save(folder)
    return found
