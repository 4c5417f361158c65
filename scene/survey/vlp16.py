"""The Velodyne VLP-16: 16 rings from -15° to 15°, ten turns a second.

Source: Velodyne VLP-16 user manual: 16 lasers fire in turn, 2.304 µs apart, every 55.296 µs; 24 firings are a packet;
the head turns clockwise seen from above. The lasers' offsets of up to 11 mm along the axis are left out.
"""

import numpy as np
from jaxtyping import Float

from scene.survey.lidar import SCAN_PERIOD, Lidar

N_RINGS = 16
FIRING, LASER = 55.296e-6, 2.304e-6  # s: from firing to firing; from laser to laser
_PACKET, _PACKETS = 24, 75  # firings a packet; packets a sweep: the remaining 0.5 ms of a turn are left out
# Elevations of the lasers in the order in which they fire, in degrees.
_FIRED = np.array([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15])
_RING = np.argsort(np.argsort(_FIRED))  # rings count upwards


def directions(time: Float[np.ndarray, "n"], phase: Float[np.ndarray, "2"]) -> Float[np.ndarray, "n 3"]:
    """Unit vectors in the LiDAR frame.

    Args:
        time: Time of each beam, s, in whole firings.
        phase: Azimuth at time 0 in its first entry, rad.
    """
    azimuth = phase[0] - 2.0 * np.pi * time / SCAN_PERIOD
    elevation = np.deg2rad(_FIRED)[np.arange(len(time)) % N_RINGS]
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)


def vlp16() -> Lidar:
    """The VLP-16; a sweep is stamped, as its driver does, at the first firing of its last packet."""
    firing = np.arange(_PACKET * _PACKETS)[:, None]
    offset = np.rint(1e9 * (firing * FIRING + np.arange(N_RINGS) * LASER)).astype(np.int64).ravel()
    stamp = round(1e9 * FIRING * _PACKET * (_PACKETS - 1))
    line = np.tile(_RING, len(firing))
    # 100 m on a target of 50 %; 0.4 m and 3 mrad of full divergence are assumptions near the manual's.
    return Lidar("vlp16", offset, stamp, line, directions, 0.4, 100.0, 0.5 / 100.0**2, 1.5e-3)
