"""What all LiDARs of the rack have in common: when and where they look, and what one sweep of theirs holds."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

SCAN_PERIOD = 0.1  # s, one message of every LiDAR here


@dataclass(frozen=True)
class Lidar:
    """One model of LiDAR. Its frame: x forward, y left, z up.

    Attributes:
        name: As the user calls it.
        offset: Times of the beams of one sweep in the order of firing, ns after its first; not decreasing.
        stamp: Time of the header's stamp, ns after the first beam.
        line: Laser of each beam, counted as its driver does.
        directions: Time of each beam of whole sweeps, s, and a drawn phase `(2,)`, rad, to unit vectors.
        range_min, range_max: What it reports, m.
        weakest_echo: Weakest echo that it detects: albedo · cos(incidence) / distance², 1/m².
        divergence: Half the opening angle of a beam, rad.
    """

    name: str
    offset: Int[np.ndarray, "n"]
    stamp: int
    line: Int[np.ndarray, "n"]
    directions: Callable[[Float[np.ndarray, "n"], Float[np.ndarray, "2"]], Float[np.ndarray, "n 3"]]
    range_min: float
    range_max: float
    weakest_echo: float
    divergence: float


@dataclass(frozen=True)
class Sweep:
    """One sweep, its beams in the order of firing.

    Attributes:
        number: Of the sweep, counted from the start of the survey.
        begin: Time of its first beam, ns since the start of the survey.
        offset: Time of each beam after that, ns.
        valid: Which beams returned.
        points: In the LiDAR's frame, m; (0, 0, 0) where nothing returned.
        reflectivity: 0 to 150 for 0 to 100 % diffuse; 0 where nothing returned.
        second: Returns marked as the second of their beam.
        placed: Points in the survey frame by the true poses, m; meaningless where not `valid`.
    """

    number: int
    begin: int
    offset: Int[np.ndarray, "n"]
    valid: Bool[np.ndarray, "n"]
    points: Float32[np.ndarray, "n 3"]
    reflectivity: UInt8[np.ndarray, "n"]
    second: Bool[np.ndarray, "n"]
    placed: Float[np.ndarray, "n 3"]
