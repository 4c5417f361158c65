"""Beam directions of common LiDARs: unit vectors in the sensor's frame, x ahead, y to the left, z upwards.

They are, turned into the tunnel frame, the input of `lidar3d.meet`.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

# Source: the speeds reported for the two prisms of Livox's Mid-40, turns a second; they have no small common period.
_PRISMS = (7294.0 / 60.0, -4664.0 / 60.0)


def planar(n_beams: int = 16) -> Float[np.ndarray, "n_beams 3"]:
    """Return the beams of `lidar.scan`: beam 0 straight ahead, the others counter-clockwise, evenly spaced."""
    bearing = np.arange(_at_least_one("n_beams", n_beams)) * (2.0 * np.pi / n_beams)
    return _unit(bearing, np.zeros(n_beams))


def spinning(elevations: Float[np.ndarray, "n_rings"], n_columns: int) -> Float[np.ndarray, "n 3"]:
    """Return the beams of a turning head: columns counter-clockwise from straight ahead, ring by ring in a column.

    Args:
        elevations: Elevations of the rings, rad.
        n_columns: Columns in a turn.

    Raises:
        ValueError: `n_columns` is below 1, or an elevation is not below a right angle.
    """
    elevations = np.asarray(elevations, np.float64)
    if not np.all(np.abs(elevations) < np.pi / 2):
        raise ValueError(f"elevations must lie between -pi/2 and pi/2 rad, got {elevations.tolist()}")
    azimuth = np.arange(_at_least_one("n_columns", n_columns)) * (2.0 * np.pi / n_columns)
    return _unit(np.repeat(azimuth, len(elevations)), np.tile(elevations, n_columns))


def rosette(
    n_beams: int = 24_000,
    start: float = 0.0,
    duration: float = 0.1,
    half_fov: tuple[float, float] = (np.deg2rad(35.2), np.deg2rad(38.6)),
) -> Float[np.ndarray, "n_beams 3"]:
    """Return a pattern that never repeats, as of a Livox with two counter-rotating prisms.

    The pattern has the shape of the instrument's but is no copy: Livox does not publish the angles.

    Args:
        n_beams: Beams.
        start: Time of the first beam, s; the next sweep begins at `start + duration`.
        duration: Duration of the sweep, s.
        half_fov: Half the field of view across and upright, rad. The default is the Avia's 70.4° by 77.2°.
    """
    time = start + np.arange(_at_least_one("n_beams", n_beams)) * (duration / n_beams)
    first, second = (2.0 * np.pi * rate * time for rate in _PRISMS)
    azimuth = half_fov[0] * 0.5 * (np.cos(first) + np.cos(second))
    return _unit(azimuth, half_fov[1] * 0.5 * (np.sin(first) + np.sin(second)))


N_LEVEL = 16  # beams of `level_ring`


def level_ring(scan: Any, shape: tuple[int, int]) -> Any:
    """Return what of a scan a planar LiDAR would see: 16 beams of the ring just above its middle, ahead first.

    Args:
        scan: Ranges row by row, `(..., rows * columns)`.
        shape: Rows and columns. A scan of one row is returned whole.
    """
    rows, columns = shape
    if rows == 1:
        return scan
    return scan[..., (rows // 2) * columns + np.arange(n_level(shape)) * columns // N_LEVEL]


def level_row(scan: Any, shape: tuple[int, int]) -> Any:
    """Return every beam of the ring that `level_ring` takes, ahead first; arguments as there."""
    rows, columns = shape
    return scan[..., (rows // 2) * columns : (rows // 2 + 1) * columns]


def n_level(shape: tuple[int, int]) -> int:
    """Return the number of beams of `level_ring`."""
    return shape[1] if shape[0] == 1 else N_LEVEL


def _unit(azimuth: np.ndarray, elevation: np.ndarray) -> Float[np.ndarray, "n 3"]:
    level = np.cos(elevation)
    vectors = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)
    return vectors.astype(np.float32)


def _at_least_one(name: str, count: int) -> int:
    if count < 1:
        raise ValueError(f"{name} must be at least 1, got {count}")
    return count
