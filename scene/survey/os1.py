"""The Ouster OS1-64: 64 rings by 1024 columns, ten turns a second.

Source: Ouster's OS1 hardware user manual: 64 beams over 45°, in four columns of beams that look to slightly different
azimuths; the head turns clockwise seen from above. The beams are taken as evenly spaced and as starting at the axis.
"""

import numpy as np
from jaxtyping import Float

from scene.survey.lidar import SCAN_PERIOD, Lidar

N_RINGS, N_COLUMNS = 64, 1024
_ELEVATION = np.deg2rad(np.linspace(22.5, -22.5, N_RINGS))  # ring 0 looks up
_AZIMUTH = np.deg2rad(np.tile([4.22, 1.41, -1.41, -4.22], N_RINGS // 4))


def directions(time: Float[np.ndarray, "n"], phase: Float[np.ndarray, "2"]) -> Float[np.ndarray, "n 3"]:
    """Unit vectors in the LiDAR frame.

    Args:
        time: Time of each beam, s, in whole columns.
        phase: Not used: a sweep begins backwards, where the encoder starts.
    """
    ring = np.arange(len(time)) % N_RINGS
    azimuth = np.pi - 2.0 * np.pi * time / SCAN_PERIOD + _AZIMUTH[ring]
    level = np.cos(_ELEVATION)[ring]
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(_ELEVATION)[ring]], axis=-1)


def os1() -> Lidar:
    """The OS1-64, stamped at the start of a sweep; all beams of a column fire at once."""
    column = (np.arange(N_COLUMNS) * round(SCAN_PERIOD * 1e9)) // N_COLUMNS
    line = np.tile(np.arange(N_RINGS), N_COLUMNS)
    # The manual's 45 m hold for a target of 10 %.
    return Lidar("os1", column.repeat(N_RINGS), 0, line, directions, 0.5, 120.0, 0.1 / 45.0**2, 1.6e-3)
