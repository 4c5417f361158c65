"""The Livox Avia: where it looks, what it misses, how far off it is.

LiDAR frame: x forward, y left, z up. The rosette is the sum of two counter-rotating prisms whose speeds have no small
common period, so that it does not repeat; six lines fire in turn. That is the shape of the instrument's pattern, not a
copy of it: Livox does not publish the angles.
"""

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from scene.survey.mesh import Part

POINT_RATE = 240_000  # points/s [geode.md]
SCAN_PERIOD = 0.1  # s, one message
N_LINES = 6
HALF_FOV = np.deg2rad([35.2, 38.6])  # half of 70.4° across by 77.2° upright [geode.md]
LINE_SPACING = np.deg2rad(0.25)  # upright, between neighbouring lines; an assumption
PRISM_RATE = (7294.0 / 60.0, -4664.0 / 60.0)  # turns/s; the speeds reported for Livox's two-prism Mid-40
RANGE_SIGMA = 0.02  # m
RANGE_MIN, RANGE_MAX = 1.0, 190.0  # m
# The maker's range of 190 m holds for a target of 10 % met squarely: the weakest echo that is still detected, 1/m².
WEAKEST_ECHO = 0.10 / 190.0**2
FADING = 0.5  # standard deviation of the logarithm of the echo (speckle)
DROPOUT = 0.004  # share of returns lost for no reason modelled here
SECOND_RETURN = 0.02  # share of returns tagged 0x10

# Diffuse reflectivity at 905 nm by `Part`; engineering judgement, meant to tell materials apart.
ALBEDO = np.zeros(len(Part))
ALBEDO[[Part.LINING, Part.JOINT, Part.POCKET, Part.NAIL]] = 0.30, 0.15, 0.24, 0.45
ALBEDO[[Part.FLOOR, Part.SLEEPER, Part.RAIL, Part.FASTENING]] = 0.20, 0.36, 0.42, 0.28


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


def returned(
    rng: np.random.Generator,
    distance: Float32[np.ndarray, "n"],
    cosine: Float32[np.ndarray, "n"],
    part: UInt8[np.ndarray, "n"],
) -> Bool[np.ndarray, "n"]:
    """Which pulses come back.

    The echo is albedo · cos(incidence) / distance², faded by a log-normal factor; it returns if it exceeds
    `WEAKEST_ECHO`. On a concrete wall beside the track that ends the view at about 60 to 70 m.

    Args:
        rng: Source of randomness.
        distance: True distance, m; infinite where nothing is hit.
        cosine: Cosine of the incidence angle; negative where a surface is hit from behind, which never returns.
        part: `Part` that is hit.
    """
    near = (distance >= RANGE_MIN) & (distance <= RANGE_MAX) & (cosine > 0.0)
    echo = ALBEDO[part] * cosine * np.exp(FADING * rng.standard_normal(len(distance), np.float32))
    return near & (echo > WEAKEST_ECHO * distance * distance) & (rng.random(len(distance), np.float32) >= DROPOUT)


def reflectivity(
    rng: np.random.Generator, cosine: Float32[np.ndarray, "n"], part: UInt8[np.ndarray, "n"]
) -> UInt8[np.ndarray, "n"]:
    """Reported reflectivity: Livox's scale, 0 to 150 for 0 to 100 % diffuse, with 5 % noise."""
    value = 150.0 * ALBEDO[part] * cosine * (1.0 + 0.05 * rng.standard_normal(len(part), np.float32))
    return np.clip(np.rint(value), 0, 255).astype(np.uint8)
