"""Registered clouds from files of any format, in metres, z up: read in chunks and thinned on the way."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np

from scene.cli import Stage
from scene.cloud import Cloud, VoxelMean
from scene.errors import RecordingError
from scene.reading import e57, frame, las, parquet, pcd, ply, table
from scene.reading.cause import refusing
from scene.reading.config import ReadingConfig
from scene.reading.detect import CLOUDS, detect
from scene.resume import Partial

_OPEN = {
    "ply": ply.open_cloud,
    "pcd": pcd.open_cloud,
    "las": las.open_cloud,
    "e57": e57.open_cloud,
    "table": table.open_cloud,
    "parquet": parquet.open_cloud,
}
_MOST_OUTSIDE = 0.5


def read_cloud(
    path: Path,
    voxel: float,
    config: ReadingConfig | None = None,
    stage: Stage | None = None,
    partial: Partial | None = None,
) -> tuple[Cloud, dict[str, Any]]:
    """Reads and thins a registered cloud.

    Args:
        path: A file of one of the formats in `detect.CLOUDS`.
        voxel: Thinning, m.
        config: Overrides of what is detected.
        stage: Counts the points.
        partial: What an earlier build got done, and where this one keeps what it does.

    Returns:
        The cloud, and what was detected.

    Raises:
        RecordingError: Unreadable, truncated, without coordinates, empty, or with no finite point.
    """
    config = config or ReadingConfig()
    found = detect(path, config.format)
    format = found.format
    if format not in _OPEN:
        raise RecordingError(f"{path}: is no registered cloud")
    partial = partial or Partial(None)
    thinned, read, skip = VoxelMean(voxel), 0, 0
    if (known := partial.load("cloud")) is not None:
        thinned, (read, skip) = VoxelMean.restored(voxel, known), (int(n) for n in known["read"])
    with refusing(path, f"a readable {CLOUDS[format]} cloud", RecordingError):
        source = _OPEN[format](path)
        placed = _frame(path, source.sample, source.unit, config)
        if stage is not None:
            stage.total = source.count
            if skip:
                stage.resume(read)
        # Chunks that an earlier build had thinned are decoded again, which most formats cannot do without.
        for index, chunk in enumerate(itertools.islice(source.chunks(), skip, None), skip + 1):
            read += len(chunk)
            thinned.add(placed.apply(chunk))
            if stage is not None:
                stage.advance(len(chunk))
            if partial.due():
                partial.save("cloud", read=np.array([read, index]), **thinned.arrays())
    if not read:
        raise RecordingError(f"{path}: holds no points")
    if not thinned.finite:
        raise RecordingError(f"{path}: none of its {read} points is finite")
    if thinned.returns < (1 - _MOST_OUTSIDE) * thinned.finite:
        raise RecordingError(
            f"{path}: most of its points lie further apart than any tunnel is long (unit {placed.unit}); "
            "is the unit mm? --unit says so"
        )
    facts = {"kind": "registered cloud", "format": source.format, "format_by": found.by, **placed.facts}
    return thinned.cloud(), facts | {"points_read": read, "points_dropped": read - thinned.returns}


def _frame(path: Path, sample, declared: str | None, config: ReadingConfig) -> frame.Frame:
    try:
        return frame.choose(sample, declared, config.unit, config.axes)
    except ValueError as error:
        raise RecordingError(f"{path}: {error}") from error
