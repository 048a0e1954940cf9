"""The command `rehearse`: between files and files."""

from collections.abc import Sequence
from pathlib import Path

from ..arms.model_file import Model
from ..files import output_folder
from ..recordings import load
from ..session import telling
from .rehearse import rehearse
from .result import KIND, Rehearsal


def rehearse_files(
    out: Path,
    model: Model | None,
    motion: Path,
    *,
    draws: int,
    seed: int,
    torque_noise: Sequence[float] = (),
    diagnose: bool = False,
) -> Rehearsal:
    """`jaxpanda rehearse`."""
    with output_folder(out, KIND) as folder, telling("rehearsing") as say:
        found = rehearse(
            model,
            load(motion),
            draws=draws,
            seed=seed,
            torque_noise=torque_noise,
            diagnose=diagnose,
            progress=say,
        )
        found.save(folder)
    return found
