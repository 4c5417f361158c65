"""Files of made clouds: LAZ as a scanner's office exports it, and the truth beside it."""

from pathlib import Path
from typing import Any

import laspy
import numpy as np
from jaxtyping import Float

from subterra_jax.host.files import replace_file


def write_laz(path: Path, points: Float[np.ndarray, "p 3"]) -> None:
    """Writes points as LAZ with a resolution of 1 mm."""
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.offsets, header.scales = np.floor(points.min(axis=0)), np.full(3, 1e-3)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    with replace_file(path) as part, part.open("wb") as file:
        cloud.write(file, do_compress=True, laz_backend=laspy.LazBackend.Lazrs)


def write_truth(path: Path, kind: str, truth: dict[str, Any]) -> None:
    """Writes `NAME_truth.npz`."""
    with replace_file(path) as part, part.open("wb") as file:
        np.savez_compressed(file, kind=kind, **truth)
