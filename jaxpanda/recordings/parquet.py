"""Parquet with the canonical columns as scalar float64 columns; needs the extra [io]."""

from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

import numpy as np

from ..errors import InputError, MissingExtraError
from .checks import checked
from .csv import canonical_names, find_channels, from_table
from .recording import Recording


def read_parquet(path: Path, columns: Mapping[str, str] | None = None) -> Recording:
    """A recording from Parquet.

    Args:
        path: the file.
        columns: {canonical name: name in the file} where the two differ.

    Raises:
        MissingExtraError: pyarrow is not installed.
        InputError: naming file and column, and what would work.
    """
    arrow, parquet = _pyarrow()
    try:
        content = parquet.read_table(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, arrow.ArrowInvalid) as error:
        raise InputError(
            f"{path.name}: no Parquet file, or a broken one ({str(error).splitlines()[0]})"
        ) from None
    names = content.column_names
    channels = find_channels(names, path.name, columns)
    table = np.full((content.num_rows, len(names)), np.nan)
    for i in [place for places in channels.values() for place in places]:
        kind = content.schema.field(i).type
        if not (arrow.types.is_floating(kind) or arrow.types.is_integer(kind)):
            raise InputError(f"{path.name}: column {names[i]} holds {kind}, where numbers are needed")
        table[:, i] = content.column(i).to_numpy().astype(float)
    return checked(from_table(path, names, table, channels))


def write_parquet(recording: Recording, path: Path) -> None:
    """The canonical columns, losslessly compressed."""
    arrow, parquet = _pyarrow()
    names = canonical_names(recording.dof, recording.qd is not None, recording.tau is not None)
    table = np.column_stack([recording.time, *recording.channels()])
    parquet.write_table(
        arrow.table({name: table[:, i] for i, name in enumerate(names)}), path, compression="zstd"
    )


def _pyarrow() -> tuple[ModuleType, ModuleType]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise MissingExtraError("Parquet", "io") from None
    return pyarrow, pyarrow.parquet
