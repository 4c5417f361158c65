"""Trajectories with known errors, written as TUM files."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

EPOCH = 1_700_000_000.0


def bend(n: int = 400, step: float = 0.2, radius: float = 80.0) -> tuple[np.ndarray, np.ndarray, Rotation]:
    """Times, positions and attitudes along an arc to the left that starts eastwards at the origin."""
    angle = np.arange(n) * step / radius
    position = radius * np.column_stack([np.sin(angle), 1.0 - np.cos(angle), np.zeros(n)])
    return EPOCH + 0.1 * np.arange(n), position, Rotation.from_rotvec(angle[:, None] * np.array([0.0, 0.0, 1.0]))


def line(n: int = 401, step: float = 0.25) -> tuple[np.ndarray, np.ndarray, Rotation]:
    """The same along the x axis, 100 m by default."""
    position = np.column_stack([step * np.arange(n), np.zeros(n), np.zeros(n)])
    return EPOCH + 0.1 * np.arange(n), position, Rotation.identity(n)


def write_tum(path: Path, time: np.ndarray, position: np.ndarray, rotation: Rotation) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, np.column_stack([time, position, rotation.as_quat(canonical=True)]), fmt="%.12f")
    return path


def write_axis(path: Path, position: np.ndarray) -> Path:
    steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
    rows = np.column_stack([np.concatenate([[0.0], np.cumsum(steps)]), position])
    np.savetxt(path, rows, fmt="%.9f", delimiter=",", header="station,x,y,z", comments="")
    return path
