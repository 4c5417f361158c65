"""Registered clouds from files: PLY and PCD, in metres, z up."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from plyfile import PlyData, PlyParseError
from pypcd4 import PointCloud

from scene.cloud import Cloud, VoxelMean
from scene.errors import RecordingError

SUFFIXES = (".ply", ".pcd")
_BATCH = 2_000_000


def read_cloud(path: Path, voxel: float) -> Cloud:
    """Reads and thins a registered cloud.

    Args:
        path: A `.ply` or `.pcd` file with x, y and z in metres.
        voxel: Thinning, m.

    Raises:
        RecordingError: Unreadable, truncated, without coordinates, empty, or with no finite point.
    """
    try:
        points = _read_ply(path) if path.suffix.lower() == ".ply" else _read_pcd(path)
    except Exception as error:  # the libraries raise anything from struct.error to MemoryError on damaged headers
        raise RecordingError(f"{path}: not a readable {path.suffix[1:].upper()} cloud ({error})") from error
    if not len(points):
        raise RecordingError(f"{path}: holds no points")
    thinned = VoxelMean(voxel)
    for start in range(0, len(points), _BATCH):
        thinned.add(points[start : start + _BATCH].astype(np.float64))
    cloud = thinned.cloud()
    if not len(cloud.points):
        raise RecordingError(f"{path}: none of its {len(points)} points is finite")
    return cloud


def _read_ply(path: Path) -> Float[np.ndarray, "n 3"]:
    try:
        vertex = PlyData.read(str(path), mmap="c")["vertex"].data
    except PlyParseError as error:
        raise ValueError(str(error)) from error
    return np.stack([vertex["x"], vertex["y"], vertex["z"]], axis=1)


def _read_pcd(path: Path) -> Float[np.ndarray, "n 3"]:
    cloud = PointCloud.from_path(path)
    missing = {"x", "y", "z"} - set(cloud.fields)
    if missing:
        raise ValueError(f"no field {', '.join(sorted(missing))}")
    return cloud.numpy(("x", "y", "z"))
