"""Parquet clouds through `pyarrow`, a batch of rows at a time; only the three columns are read."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from scene.reading.columns import find_xyz
from scene.reading.source import BATCH, CloudSource


def open_cloud(path: Path) -> CloudSource:
    """The columns x, y, z (or easting, northing, elevation) of a Parquet file.

    Raises:
        ValueError: Damaged, without such columns, or with columns that hold no numbers.
    """
    with pq.ParquetFile(path) as file:
        names, rows = file.schema_arrow.names, file.metadata.num_rows
        found = find_xyz(names)
        if found is None:
            raise ValueError(f"no columns x, y, z among {', '.join(names)}")
        columns = [names[index] for index in found[0]]
        for name in columns:
            kind = file.schema_arrow.field(name).type
            if not (pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_decimal(kind)):
                raise ValueError(f"column {name} holds {kind}, not numbers")
        declared = found[1] or _unit(file.schema_arrow.field(columns[0]))
        groups = sorted({0, file.num_row_groups // 2, file.num_row_groups - 1}) if file.num_row_groups else []
        sample = [next(_batches(file, columns, [group]), np.empty((0, 3)))[::100] for group in groups]

    def chunks() -> Iterator[np.ndarray]:
        with pq.ParquetFile(path) as file:
            yield from _batches(file, columns, list(range(file.num_row_groups)))

    return CloudSource("Parquet", chunks, np.concatenate([np.empty((0, 3)), *sample]), declared, rows)


def _batches(file: pq.ParquetFile, columns: list[str], groups: list[int]) -> Iterator[np.ndarray]:
    for batch in file.iter_batches(BATCH, columns=columns, row_groups=groups):
        arrays = [batch.column(name).cast(pa.float64()).to_numpy(zero_copy_only=False) for name in columns]
        yield np.stack(arrays, axis=1)


def _unit(field: pa.Field) -> str | None:
    """From the column's own metadata, key `unit`."""
    said = (field.metadata or {}).get(b"unit", b"").decode("utf-8", "replace")
    return said if said in ("m", "mm") else None
