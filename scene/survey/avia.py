"""The Livox Avia: where it looks and how far it sees.

The rosette is the sum of two counter-rotating prisms whose speeds have no small common period, so that it does not
repeat; six lines fire in turn. That is the shape of the instrument's pattern, not a copy of it: Livox does not publish
the angles.
"""

import numpy as np
from jaxtyping import Float, Int

from scene.survey.lidar import SCAN_PERIOD, Lidar

POINT_RATE = 240_000  # points/s [geode.md]
N_LINES = 6
HALF_FOV = np.deg2rad([35.2, 38.6])  # half of 70.4° across by 77.2° upright [geode.md]
LINE_SPACING = np.deg2rad(0.25)  # upright, between neighbouring lines; an assumption
PRISM_RATE = (7294.0 / 60.0, -4664.0 / 60.0)  # turns/s; the speeds reported for Livox's two-prism Mid-40
RANGE_MIN, RANGE_MAX = 1.0, 190.0  # m
# The maker's range of 190 m holds for a target of 10 % met squarely.
WEAKEST_ECHO = 0.10 / 190.0**2
DIVERGENCE = 0.5 * np.deg2rad(np.sqrt(0.03 * 0.28))  # rad; a circle for the maker's 0.03° across by 0.28° upright


def point_times(point_rate: int) -> Int[np.ndarray, "n"]:
    """Offsets of the points of one message, ns: 0 to 99.996 ms at the full rate."""
    return (np.arange(round(point_rate * SCAN_PERIOD)) * 1_000_000_000) // point_rate


def directions(time: Float[np.ndarray, "n"], phase: Float[np.ndarray, "2"]) -> Float[np.ndarray, "n 3"]:
    """Unit vectors in the LiDAR frame.

    Args:
        time: Time of each point, s. Points come in whole turns of the six lines.
        phase: Angles of the two prisms at time 0, rad.
    """
    first, second = (2.0 * np.pi * rate * time + p for rate, p in zip(PRISM_RATE, phase, strict=True))
    line = np.arange(len(time)) % N_LINES - 0.5 * (N_LINES - 1)
    reach = HALF_FOV[1] - 0.5 * (N_LINES - 1) * LINE_SPACING
    azimuth = HALF_FOV[0] * 0.5 * (np.cos(first) + np.cos(second))
    elevation = reach * 0.5 * (np.sin(first) + np.sin(second)) + LINE_SPACING * line
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)


def avia(point_rate: int = POINT_RATE) -> Lidar:
    """The Avia, thinned to `point_rate` points per second; stamped at the start of a sweep."""
    offset = point_times(point_rate)
    line = np.arange(len(offset)) % N_LINES
    return Lidar("avia", offset, 0, line, directions, RANGE_MIN, RANGE_MAX, WEAKEST_ECHO, DIVERGENCE)
