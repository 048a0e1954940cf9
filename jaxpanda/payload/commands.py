"""The command `payload`: between files and files."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from ..errors import InputError
from ..export import missing_assets
from ..files import output_folder
from ..recordings import load_many
from .estimate import estimate_payload
from .result import KIND, MODEL_XML, PayloadEstimate


def payload_files(
    out: Path,
    model: Path | None,
    without: Sequence[Path],
    loaded: Sequence[Path],
    *,
    frame: str,
    torque_scale_std: float,
) -> PayloadEstimate:
    """`jaxpanda payload`."""
    for flag, paths in (("--without", without), ("--with", loaded)):
        if not paths:
            raise InputError(f"{flag}: none given; name at least one file or folder")
    with output_folder(out, KIND) as folder:
        found = estimate_payload(
            model, load_many(without), load_many(loaded), frame=frame, torque_scale_std=torque_scale_std
        )
        if found.written is not None:
            missing = tuple(f"{MODEL_XML}: {what}" for what in missing_assets(found.written, out))
            found = dataclasses.replace(found, notes=(*found.notes, *missing))
        found.save(folder)
    return found
