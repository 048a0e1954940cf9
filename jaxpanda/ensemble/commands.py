"""The command `ensemble`: between files and files."""

import dataclasses
from pathlib import Path

from ..corrected import FILE as CORRECTED
from ..errors import InputError
from ..files import output_folder
from ..inputs import require_written
from ..retrieval import FILE as RETRIEVAL
from ..retrieval import Retrieval
from ..session import progress
from .result import KIND, Ensemble
from .sample import draw_ensemble
from .sampler import SWEEPS


def ensemble_files(
    out: Path,
    retrieval: Path | None,
    diagnosis: Path | None,
    *,
    count: int,
    seed: int,
    mjcf: int = 0,
    sweeps: int = SWEEPS,
) -> Ensemble:
    """`jaxpanda ensemble`."""
    folder = retrieval or diagnosis
    if folder is None or (retrieval is not None and diagnosis is not None):
        raise InputError("ensemble: give either --retrieval or --diagnosis, one of the two")
    if mjcf < 0 or mjcf > count:
        raise InputError(f"--mjcf {mjcf}: from 0 to as many as there are members ({count})")
    if sweeps < 1:
        raise InputError(f"--sweeps {sweeps}: at least 1 is needed")
    if retrieval is not None:
        require_written(folder / RETRIEVAL, "retrieve")
    else:
        require_written(folder / CORRECTED, "diagnose")
    with output_folder(out, KIND) as scratch, progress("drawing") as tick:
        source = folder if retrieval is None else Retrieval.load(folder)
        found = draw_ensemble(source, count=count, seed=seed, sweeps=sweeps, progress=tick)
        said = found.save(scratch, mjcf=mjcf)
    return dataclasses.replace(found, notes=(*found.notes, *said))
