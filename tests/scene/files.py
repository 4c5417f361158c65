"""Clouds and ring surveys in every format, by the writers of independent libraries or byte by byte."""

from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import openpyxl
import trimesh
from pye57 import E57
from pypcd4 import Encoding, PointCloud

RING_HEADER = ("RING NO.", "POINT NO.", "EASTING (M.)", "NORTHING (M.)", "ELEVATION (M.)", "OFFSET (M.)")


def write_ply(path: Path, points: np.ndarray) -> Path:
    trimesh.PointCloud(points).export(path)
    return path


def write_ply_ascii(path: Path, points: np.ndarray) -> Path:
    head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty uchar red\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    path.write_text(head + "".join(f"7 {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in points))
    return path


def write_pcd(path: Path, points: np.ndarray, encoding: Encoding = Encoding.BINARY) -> Path:
    PointCloud.from_xyz_points(points.astype(np.float32)).save(path, encoding=encoding)
    return path


def write_las(path: Path, points: np.ndarray, *records: laspy.VLR) -> Path:
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.vlrs.extend(records)
    header.scales, header.offsets = [1e-5] * 3, np.floor(np.nanmean(points, axis=0))
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.write(str(path))
    return path


def write_e57(path: Path, points: np.ndarray, *poses: tuple[np.ndarray, np.ndarray]) -> Path:
    """One scan a pose: quaternion w, x, y, z and translation, m; the points are in the scan's own frame."""
    with E57(str(path), mode="w") as file:
        for rotation, translation in poses or [(np.array([1.0, 0, 0, 0]), np.zeros(3))]:
            data = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), points.T.copy(), strict=True))
            file.write_scan_raw(data, rotation=rotation, translation=translation)
    return path


def write_text(path: Path, points: np.ndarray, delimiter: str = " ", header: str = "") -> Path:
    rows = [delimiter.join(f"{value:.6f}" for value in row) for row in points]
    path.write_text("\n".join([header] * bool(header) + rows) + "\n")
    return path


CLOUDS: dict[str, Callable[[Path, np.ndarray], Path]] = {
    "a.ply": write_ply,
    "ascii.ply": write_ply_ascii,
    "a.pcd": write_pcd,
    "ascii.pcd": lambda path, points: write_pcd(path, points, Encoding.ASCII),
    "packed.pcd": lambda path, points: write_pcd(path, points, Encoding.BINARY_COMPRESSED),
    "a.las": write_las,
    "a.laz": write_las,
    "a.e57": write_e57,
    "a.xyz": write_text,
    "a.csv": lambda path, points: write_text(path, points, ",", "X,Y,Z"),
}


def ring_rows(count: int = 12, radius: float = 1.7, offset: float = 0.0, spacing: float = 4.8) -> list[tuple]:
    """Rings along easting, eight points each, targets `offset` inside the wall."""
    turn = 2 * np.pi * np.arange(8) / 8
    inner = radius - offset
    return [
        (ring, k + 1, 1000 + spacing * ring, 500 + inner * np.cos(a), 10 + inner * np.sin(a), offset)
        for ring in range(count)
        for k, a in enumerate(turn)
    ]


def write_xlsx(path: Path, rows: list[tuple], header: tuple = RING_HEADER) -> Path:
    book = openpyxl.Workbook()
    book.active.title = "Survey"
    for row in [header, *rows]:
        book.active.append(row)
    book.save(path)
    return path
