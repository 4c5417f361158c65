"""E57 clouds through `pye57` (libE57Format), a buffer at a time, each scan placed by its own pose.

Source: ASTM E2807. Coordinates are metres; a pose is a unit quaternion w, x, y, z and a translation.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pye57 import E57, ScanHeader
from scipy.spatial.transform import Rotation

from scene.reading.source import BATCH, CloudSource

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")


def open_cloud(path: Path) -> CloudSource:
    """The points of every scan of an E57 file, in the frame of the file.

    Raises:
        ValueError: Damaged, or without coordinates.
    """
    with E57(str(path)) as file:
        scans = file.scan_count

    def chunks() -> Iterator[np.ndarray]:
        with E57(str(path)) as file:
            for index in range(scans):
                try:
                    yield from _scan(file, file.get_header(index))
                except Exception as error:
                    raise ValueError(f"scan {index} of {scans}: {error}") from error

    return CloudSource(f"E57, {scans} scans", chunks, np.empty((0, 3)), "m")


def _scan(file: E57, header: ScanHeader) -> Iterator[np.ndarray]:
    fields = header.point_fields
    system = next((s for s in (_CARTESIAN, _SPHERICAL) if set(s) <= set(fields)), None)
    if system is None:
        raise ValueError(f"no coordinates among the fields {', '.join(fields)}")
    flag = "cartesianInvalidState" if system is _CARTESIAN else "sphericalInvalidState"
    flags = [flag] if flag in fields else []
    count = header.point_count
    rotation, translation = _pose(header)
    data, buffers = file.make_buffers([*system, *flags], min(max(count, 1), BATCH))
    reader = header.points.reader(buffers)
    read = 0
    while size := reader.read():
        read += size
        a, b, c = (data[name][:size] for name in system)
        if system is _SPHERICAL:
            a, b, c = a * np.cos(c) * np.cos(b), a * np.cos(c) * np.sin(b), a * np.sin(c)
        points = np.stack([a, b, c], axis=1)
        if flags:
            points = points[data[flag][:size] == 0]
        yield rotation.apply(points) + translation
    if read != count:
        raise ValueError(f"it ends after {read} of {count} points")


def _pose(header: ScanHeader) -> tuple[Rotation, np.ndarray]:
    """By the names of its nodes: the library takes them in the order of the file."""
    if not header.has_pose():
        return Rotation.identity(), np.zeros(3)
    pose: Any = header.pose
    rotation, translation = Rotation.identity(), np.zeros(3)
    if pose.isDefined("rotation"):
        rotation = Rotation.from_quat([pose["rotation"][name].value() for name in "xyzw"])
    if pose.isDefined("translation"):
        translation = np.array([pose["translation"][name].value() for name in "xyz"])
    return rotation, translation
