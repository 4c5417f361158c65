"""Registered clouds from files of any format, in metres, z up: read in chunks and thinned on the way."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from scene.cloud import Cloud, VoxelMean
from scene.errors import RecordingError
from scene.progress import Stage
from scene.reading.formats import Format, ReadingConfig, detect
from scene.reading.source import CloudSource, Frame, choose_frame, needs_local_points, refuse_damage
from scene.reading.tables import given_columns

_COARSE, _HOPELESS = 0.02, 0.25  # m: coordinates rounded so far are reported, and refused
_REPEATED = 10  # points for each value of a coordinate: on a grid they repeat
_MOST_OUTSIDE = 0.5  # fraction of the points that may lie too far from the first to be thinned


def read_cloud(
    path: Path,
    voxel: float,
    config: ReadingConfig | None = None,
    stage: Stage | None = None,
) -> tuple[Cloud, dict[str, Any]]:
    """Reads a registered cloud, thinned to `voxel`, m; returns it and what was detected.

    Raises `RecordingError` for a file that is unreadable, truncated, without coordinates, empty, or without a finite
    point.
    """
    config = config or ReadingConfig()
    detected = detect(path, config.format)
    if detected.format.kind != "cloud":
        raise RecordingError(f"{path}: is no registered cloud")
    with refuse_damage(path, f"a readable {detected.format.label} cloud", RecordingError):
        source: CloudSource = _open_cloud(path, detected.format, config)
        frame = _frame_of(path, source, config)
        thinned, read, rounding = _thin(source, frame, voxel, stage)
    _refuse_unusable(path, thinned, read, rounding, frame.unit)
    rounded: dict[str, Any] = {"rounded_to": rounding} if rounding >= _COARSE else {}
    facts: dict[str, Any] = {
        **rounded,
        "kind": "registered cloud",
        "format": source.format,
        "format_by": detected.by,
        **frame.facts,
    }
    if crs := source.crs or _crs_beside(path):
        facts["crs"] = crs
    if source.left_out:
        facts["points_left_out"] = dict(source.left_out)
    return thinned.cloud(), facts | {"points_read": read, "points_dropped": read - thinned.returns}


def _crs_beside(path: Path) -> str | None:
    """Return the text of a `.prj` file of the cloud's name, as geographic programs write it; `None` without one."""
    beside = next((file for end in (".prj", ".PRJ") if (file := path.with_suffix(end)).is_file()), None)
    text = beside.read_text("utf-8", "replace") if beside else ""
    return " ".join(text.split()) or None


def _frame_of(path: Path, source: CloudSource, config: ReadingConfig) -> Frame:
    """Chooses unit and axes of a cloud; raises `RecordingError` for a flag or declaration that is none."""
    local = next(source.chunks(), None) if needs_local_points(source) else None
    local = None if local is None else local[:, :3]
    whole = source.sample if len(source.sample) or local is None else local
    try:
        return choose_frame(whole, source.unit, config.unit, config.axes, local)
    except ValueError as error:
        raise RecordingError(f"{path}: {error}") from error


def _thin(source: CloudSource, frame: Frame, voxel: float, stage: Stage | None) -> tuple[VoxelMean, int, float]:
    """Thins a cloud chunk by chunk.

    Returns:
        The thinned cloud, the number of points read, and the coarsest rounding of the first chunk's coordinates, m.
    """
    thinned, read, rounding = VoxelMean(voxel), 0, None
    if stage is not None:
        stage.expect(source.count)
    for chunk in source.chunks():
        read += len(chunk)
        thinned.add(placed := frame.apply(chunk))
        rounding = max(measure_rounding(placed[:, :3])) if rounding is None else rounding
        if stage is not None:
            stage.advance(len(chunk))
    return thinned, read, rounding or 0.0


def _refuse_unusable(path: Path, thinned: VoxelMean, read: int, rounding: float, unit: str) -> None:
    """Raises `RecordingError` for a cloud without points, larger than any tunnel, or rounded until no wall shows."""
    if not read:
        raise RecordingError(f"{path}: holds no points")
    if not thinned.finite:
        raise RecordingError(f"{path}: none of its {read} points is finite")
    if thinned.returns < (1 - _MOST_OUTSIDE) * thinned.finite:
        raise RecordingError(
            f"{path}: most of its points lie further apart than any tunnel is long (unit {unit}); "
            "is the unit mm? --unit says so"
        )
    if rounding >= _HOPELESS:
        raise RecordingError(
            f"{path}: its coordinates are rounded to {rounding:.2g} m, so no wall can be seen: 32-bit numbers far "
            "from the origin do so; export it with an offset, in 64 bits or with more digits"
        )


def measure_rounding(points: Float[np.ndarray, "n 3"]) -> tuple[float, float, float]:
    """Return the step of the grid that each coordinate lies on, m; 0 where its values do not repeat."""
    steps = []
    for column in points[np.isfinite(points).all(axis=1)].T:
        values = np.unique(column)
        on_grid = len(values) > 1 and len(column) >= _REPEATED * len(values)
        steps.append(float(np.diff(values).min()) if on_grid else 0.0)
    return steps[0], steps[1], steps[2]


def _open_cloud(path: Path, row: Format, config: ReadingConfig) -> CloudSource:
    """Opens a cloud; raises `RecordingError` for columns that are none, and for a format that has no columns."""
    if config.columns is not None and row.name != "table":
        raise RecordingError(f"{path}: --columns goes with a table, but this is {row.label}")
    if config.keep_noise and row.name == "las":
        return row.open(path, True)
    return row.open(path) if config.columns is None else row.open(path, given_columns(path, config.columns))
