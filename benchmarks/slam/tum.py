"""Poses as TUM files."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from subterra_jax.host.files import replace_file

Poses = tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 4 4"], float]  # times, s; LiDAR poses; run time, s


def save_tum(path: Path, times: Float[np.ndarray, " n"], poses: Float[np.ndarray, "n 4 4"]) -> None:
    """Writes poses as rows `t x y z qx qy qz qw`."""
    rows = np.column_stack([times, poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)])
    with replace_file(path) as fresh:
        np.savetxt(fresh, rows, fmt="%.9f")
