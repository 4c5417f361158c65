"""Files of made clouds: LAZ as a scanner's office exports it, or in other axes, units and formats."""

from pathlib import Path
from typing import Any

import laspy
import numpy as np
from jaxtyping import Float
from plyfile import PlyData, PlyElement

from subterra_jax.host.files import replace_file

FOOT = 0.3048  # m


def write_laz(path: Path, points: Float[np.ndarray, "p 3"]) -> None:
    """Writes points as LAZ with a resolution of 1 mm, or a thousandth of whatever unit they are in."""
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.offsets, header.scales = np.floor(points.min(axis=0)), np.full(3, 1e-3)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    with replace_file(path) as part, part.open("wb") as file:
        cloud.write(file, do_compress=True, laz_backend=laspy.LazBackend.Lazrs)


def write_ply(path: Path, points: Float[np.ndarray, "p 3"]) -> None:
    """Writes points as binary PLY in 32-bit numbers, as most programs do."""
    table = np.zeros(len(points), [("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    table["x"], table["y"], table["z"] = points.T
    with replace_file(path) as part:
        PlyData([PlyElement.describe(table, "vertex")]).write(str(part))


def write_e57(path: Path, points: Float[np.ndarray, "p 3"]) -> None:
    """Writes points as E57 as they are; the standard's unit is the metre, whatever they are in."""
    import pye57

    with replace_file(path) as part:
        file = pye57.E57(str(part), mode="w")
        columns = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), np.ascontiguousarray(points.T), strict=True))
        file.write_scan_raw(columns)
        file.close()


def y_up(points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3"]:
    """Return points with y up, as modelling programs have it: x, z, -y."""
    return points[:, [0, 2, 1]] * (1.0, 1.0, -1.0)


def write_truth(path: Path, kind: str, truth: dict[str, Any]) -> None:
    """Writes `NAME_truth.npz`."""
    with replace_file(path) as part, part.open("wb") as file:
        np.savez_compressed(file, kind=kind, **truth)
