"""The LiDARs of the rack: Livox Avia, Velodyne VLP-16 and Ouster OS1-64.

The Avia's rosette is the sum of two counter-rotating prisms whose speeds have no small common period, so that it does
not repeat; six lines fire in turn. That is the shape of the instrument's pattern, not a copy of it: Livox does not
publish the angles.

Source of the VLP-16: Velodyne's user manual: 16 rings from -15° to 15°, ten turns a second; 16 lasers fire in turn,
2.304 µs apart, every 55.296 µs; 24 firings are a packet; the head turns clockwise seen from above. The lasers' offsets
of up to 11 mm along the axis are left out.

Source of the OS1-64: Ouster's hardware user manual: 64 beams over 45°, in four columns of beams that look to slightly
different azimuths, 1024 columns a turn, ten turns a second; the head turns clockwise seen from above. The beams are
taken as evenly spaced and as starting at the axis.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

SCAN_PERIOD = 0.1  # s, one message of every LiDAR here


@dataclass(frozen=True)
class Lidar:
    """One model of LiDAR. Its frame: x forward, y left, z up."""

    name: str  # Name that the user gives
    # Times of the beams of one sweep in the order of firing, ns after its first; not decreasing
    offset: Int[np.ndarray, "n"]
    stamp: int  # Time of the header's stamp, ns after the first beam
    line: Int[np.ndarray, "n"]  # Laser of each beam, counted as its driver does
    # Time of each beam of whole sweeps, s, and a drawn phase `(2,)`, rad, to unit vectors
    directions: Callable[[Float[np.ndarray, "n"], Float[np.ndarray, "2"]], Float[np.ndarray, "n 3"]]
    range_min: float  # Least range reported, m
    range_max: float  # Largest range reported, m
    weakest_echo: float  # Weakest echo that it detects: albedo · cos(incidence) / distance², 1/m²
    divergence: float  # Half the opening angle of a beam, rad


@dataclass(frozen=True)
class Sweep:
    """One sweep, its beams in the order of firing."""

    number: int  # Number of the sweep from the start of the survey
    begin: int  # Time of its first beam, ns since the start of the survey
    offset: Int[np.ndarray, "n"]  # Time of each beam after that, ns
    valid: Bool[np.ndarray, "n"]  # Beams that returned
    points: Float32[np.ndarray, "n 3"]  # Points in the LiDAR's frame, m; 0, 0, 0 without a return
    reflectivity: UInt8[np.ndarray, "n"]  # 0 to 150 for 0 to 100 % diffuse; 0 where nothing returned
    second: Bool[np.ndarray, "n"]  # Returns marked as the second of their beam
    velocity: Float32[np.ndarray, "n"] | None = None  # Speed of each range, m/s, of a LiDAR that measures it

    def pick(self, beams: Int[np.ndarray, "k"]) -> "Sweep":
        """Return a part of it; its begin stays."""
        names = ("offset", "valid", "points", "reflectivity", "second", "velocity")
        known = {name: values for name in names if (values := getattr(self, name)) is not None}
        return replace(self, **{name: values[beams] for name, values in known.items()})


AVIA_POINT_RATE = 240_000  # points/s [geode.md]
AVIA_LINES = 6
_AVIA_HALF_FOV = np.deg2rad([35.2, 38.6])  # half of 70.4° across by 77.2° upright [geode.md]
_AVIA_LINE_SPACING = np.deg2rad(0.25)  # upright, between neighbouring lines; an assumption
_AVIA_PRISM_RATE = (7294.0 / 60.0, -4664.0 / 60.0)  # turns/s; the speeds reported for Livox's two-prism Mid-40
_AVIA_RANGE_MIN, _AVIA_RANGE_MAX = 1.0, 190.0  # m
# The maker's range of 190 m holds for a target of 10 % met squarely.
_AVIA_WEAKEST_ECHO = 0.10 / 190.0**2
_AVIA_DIVERGENCE = 0.5 * np.deg2rad(np.sqrt(0.03 * 0.28))  # rad; a circle for the maker's 0.03° across by 0.28° upright


def avia_directions(time: Float[np.ndarray, "n"], phase: Float[np.ndarray, "2"]) -> Float[np.ndarray, "n 3"]:
    """Return unit vectors in the LiDAR frame at times, s, in whole turns of the six lines.

    `phase` holds the angles of the two prisms at time 0, rad.
    """
    first, second = (2.0 * np.pi * rate * time + p for rate, p in zip(_AVIA_PRISM_RATE, phase, strict=True))
    line = np.arange(len(time)) % AVIA_LINES - 0.5 * (AVIA_LINES - 1)
    reach = _AVIA_HALF_FOV[1] - 0.5 * (AVIA_LINES - 1) * _AVIA_LINE_SPACING
    azimuth = _AVIA_HALF_FOV[0] * 0.5 * (np.cos(first) + np.cos(second))
    elevation = reach * 0.5 * (np.sin(first) + np.sin(second)) + _AVIA_LINE_SPACING * line
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)


def avia(point_rate: int = AVIA_POINT_RATE) -> Lidar:
    """Return the Avia, thinned to `point_rate` points per second; stamped at the start of a sweep."""
    offset = (np.arange(round(point_rate * SCAN_PERIOD)) * 1_000_000_000) // point_rate
    line = np.arange(len(offset)) % AVIA_LINES
    reach = _AVIA_RANGE_MIN, _AVIA_RANGE_MAX
    return Lidar("avia", offset, 0, line, avia_directions, *reach, _AVIA_WEAKEST_ECHO, _AVIA_DIVERGENCE)


VLP16_RINGS = 16
VLP16_FIRING, VLP16_LASER = 55.296e-6, 2.304e-6  # s: from firing to firing; from laser to laser
_PACKET, _PACKETS = 24, 75  # firings a packet; packets a sweep: the remaining 0.5 ms of a turn are left out
# Elevations of the lasers in the order in which they fire, in degrees.
_FIRED = np.array([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15])
_RING = np.argsort(np.argsort(_FIRED))  # rings count upwards


def vlp16_directions(time: Float[np.ndarray, "n"], phase: Float[np.ndarray, "2"]) -> Float[np.ndarray, "n 3"]:
    """Return unit vectors in the LiDAR frame at times, s, in whole firings; `phase[0]`: azimuth at time 0, rad."""
    azimuth = phase[0] - 2.0 * np.pi * time / SCAN_PERIOD
    elevation = np.deg2rad(_FIRED)[np.arange(len(time)) % VLP16_RINGS]
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)


def vlp16() -> Lidar:
    """Return the VLP-16; a sweep is stamped, as its driver does, at the first firing of its last packet."""
    firing = np.arange(_PACKET * _PACKETS)[:, None]
    offset = np.rint(1e9 * (firing * VLP16_FIRING + np.arange(VLP16_RINGS) * VLP16_LASER)).astype(np.int64).ravel()
    stamp = round(1e9 * VLP16_FIRING * _PACKET * (_PACKETS - 1))
    line = np.tile(_RING, len(firing))
    # 100 m on a target of 50 %; 0.4 m and 3 mrad of full divergence are assumptions near the manual's.
    return Lidar("vlp16", offset, stamp, line, vlp16_directions, 0.4, 100.0, 0.5 / 100.0**2, 1.5e-3)


OS1_RINGS, OS1_COLUMNS = 64, 1024
_OS1_ELEVATION = np.deg2rad(np.linspace(22.5, -22.5, OS1_RINGS))  # ring 0 looks up
_OS1_AZIMUTH = np.deg2rad(np.tile([4.22, 1.41, -1.41, -4.22], OS1_RINGS // 4))


def os1_directions(
    time: Float[np.ndarray, "n"], phase: Float[np.ndarray, "2"], kept: Int[np.ndarray, "r"] | None = None
) -> Float[np.ndarray, "n 3"]:
    """Return unit vectors in the LiDAR frame at times, s, in whole columns of the beams `kept`, by default all.

    `phase` is not used.
    """
    rings = np.arange(OS1_RINGS) if kept is None else kept
    ring = rings[np.arange(len(time)) % len(rings)]
    azimuth = np.pi - 2.0 * np.pi * time / SCAN_PERIOD + _OS1_AZIMUTH[ring]
    level = np.cos(_OS1_ELEVATION)[ring]
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(_OS1_ELEVATION)[ring]], axis=-1)


def os1(columns: int = OS1_COLUMNS, rings: int = OS1_RINGS) -> Lidar:
    """Return the OS1, stamped at the start of a sweep; all beams of a column fire at once.

    Args:
        columns: Columns of a turn: 512, 1024 or 2048, the device's modes.
        rings: Beams in use: 64, or every second, fourth ... one of them, as the OS1-32 and the OS1-16 have.

    Raises:
        ValueError: `rings` does not divide 64.
    """
    if rings < 1 or OS1_RINGS % rings:
        raise ValueError(f"rings must divide {OS1_RINGS}, got {rings}")
    column = (np.arange(columns) * round(SCAN_PERIOD * 1e9)) // columns
    kept = np.arange(0, OS1_RINGS, OS1_RINGS // rings)

    def directions(time: Float[np.ndarray, "n"], phase: Float[np.ndarray, "2"]) -> Float[np.ndarray, "n 3"]:
        return os1_directions(time, phase, kept)

    # The manual's 45 m hold for a target of 10 %.
    line = np.tile(np.arange(rings), columns)
    return Lidar("os1", column.repeat(rings), 0, line, directions, 0.5, 120.0, 0.1 / 45.0**2, 1.6e-3)
