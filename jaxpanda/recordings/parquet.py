"""Parquet with the canonical columns as scalar float64 columns; needs the extra [io]."""

from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

import numpy as np

from .. import inputs
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
    content = inputs.read_bytes(path)
    try:
        file = parquet.ParquetFile(arrow.BufferReader(content))
        names, schema = file.schema_arrow.names, file.schema_arrow
        channels = find_channels(names, path.name, columns)
        used = [place for places in channels.values() for place in places]
        inputs.require_size(path.name, file.metadata.num_rows * len(used))
        table = np.full((file.metadata.num_rows, len(names)), np.nan)
        for i in used:
            kind = schema.field(i).type
            if not (arrow.types.is_floating(kind) or arrow.types.is_integer(kind)):
                raise InputError(f"{path.name}: column {names[i]} holds {kind}, where numbers are needed")
            table[:, i] = file.read([names[i]]).column(0).to_numpy().astype(float)
    except (OSError, arrow.ArrowException) as error:
        raise InputError(
            f"{path.name}: no Parquet file, or a broken one ({' '.join(str(error).split())[:200]})"
        ) from None
    return checked(from_table(path, names, table, channels))


def parquet_bytes(recording: Recording, name: str) -> bytes:
    """The canonical columns, losslessly compressed."""
    arrow, parquet = _pyarrow()
    names = canonical_names(recording.dof, recording.qd is not None, recording.tau is not None)
    table = np.column_stack([recording.time, *recording.channels()])
    out = arrow.BufferOutputStream()
    parquet.write_table(
        arrow.table({name: table[:, i] for i, name in enumerate(names)}), out, compression="zstd"
    )
    return out.getvalue().to_pybytes()


def _pyarrow() -> tuple[ModuleType, ModuleType]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise MissingExtraError("Parquet", "io") from None
    return pyarrow, pyarrow.parquet
