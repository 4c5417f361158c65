"""What comes back of a pulse: whether, from how far, how bright."""

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from scene.survey.cast import Caster, Hits
from scene.survey.config import SensorErrors
from scene.survey.lidar import Lidar
from scene.survey.mesh import Part

FADING = 0.5  # standard deviation of the logarithm of the echo (speckle)
STEEPEST = 10.0  # tangent of the incidence angle beyond which the noise grows no more
EDGE_STEP = 0.03  # m between two surfaces from which on they make an edge
PULSE = 0.75  # m: echoes further apart in range are told apart by the receiver; half a pulse of 5 ns

# Diffuse reflectivity at 905 nm by `Part`; engineering judgement, meant to tell materials apart.
ALBEDO = np.zeros(len(Part))
ALBEDO[[Part.LINING, Part.JOINT, Part.POCKET, Part.NAIL]] = 0.30, 0.15, 0.24, 0.45
ALBEDO[[Part.FLOOR, Part.SLEEPER, Part.RAIL, Part.FASTENING]] = 0.20, 0.36, 0.42, 0.28


def returned(rng: np.random.Generator, lidar: Lidar, errors: SensorErrors, hits: Hits) -> Bool[np.ndarray, "n"]:
    """Which pulses come back.

    The echo is albedo · cos(incidence) / distance², faded by a log-normal factor; it returns if it exceeds the
    weakest that the LiDAR detects. On a concrete wall beside the track that ends the Avia's view at about 60 to 70 m.
    A surface that is hit from behind never returns.

    Args:
        rng: Source of randomness.
        lidar: Its ranges and its weakest echo.
        errors: `weak_echoes` and `lost`.
        hits: What the pulses meet.
    """
    distance, cosine = hits.distance, hits.cosine
    seen = (distance >= lidar.range_min) & (distance <= lidar.range_max) & (cosine > 0.0)
    if errors.weak_echoes:
        echo = ALBEDO[hits.part] * cosine * np.exp(FADING * rng.standard_normal(len(distance), np.float32))
        seen &= echo > lidar.weakest_echo * distance * distance
    return seen & (rng.random(len(distance), np.float32) >= errors.lost)


def noise_sigma(
    errors: SensorErrors, distance: Float32[np.ndarray, "n"], cosine: Float32[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """Standard deviation of ranges, m: a constant, a part by range and one by incidence, in quadrature."""
    slant = np.clip(cosine, 1e-3, 1.0)
    tangent = np.minimum(np.sqrt(1.0 - slant * slant) / slant, STEEPEST)
    reach = np.where(np.isfinite(distance), distance, 0.0)
    return np.sqrt(
        errors.range_noise**2 + (errors.range_noise_per_metre * reach) ** 2 + (errors.incidence_noise * tangent) ** 2
    )


def mixed(
    rng: np.random.Generator,
    lidar: Lidar,
    share: float,
    caster: Caster,
    origin: Float[np.ndarray, "n 3"],
    heading: Float[np.ndarray, "n 3"],
    hits: Hits,
) -> Float32[np.ndarray, "n"]:
    """Distances in which some beams across a depth edge fall between its two surfaces, m.

    A beam straddles an edge if a ray from its rim, to a drawn side, meets a surface more than `EDGE_STEP` off the
    plane that its middle meets, and less than `PULSE` further or nearer. Of those, `share` report a distance drawn
    evenly between the two.

    Args:
        rng: Source of randomness.
        lidar: Its divergence.
        share: Of the beams that straddle an edge.
        caster: Of the true mesh, loaded about the carrier.
        origin: Of the rays, survey frame, m.
        heading: Unit vectors, survey frame.
        hits: What the middles of the beams meet.
    """
    chosen = np.flatnonzero((rng.random(len(heading), np.float32) < share) & np.isfinite(hits.distance))
    ray, near, normal = heading[chosen], hits.distance[chosen], hits.normal[chosen]
    side = np.cross(ray, rng.standard_normal(ray.shape))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    rim = np.cos(lidar.divergence) * ray + np.sin(lidar.divergence) * side
    other = caster.cast_loaded(origin[chosen], rim).distance
    step = np.where(np.isfinite(other), other - near, np.inf)
    reach = np.where(np.isfinite(other), other, 0.0)
    off_plane = reach * np.einsum("ij,ij->i", normal, rim) - near * np.einsum("ij,ij->i", normal, ray)
    edge = (abs(step) < PULSE) & (abs(off_plane) > EDGE_STEP)
    distance = hits.distance.copy()
    distance[chosen] += np.where(edge, step, 0.0) * rng.random(len(step), np.float32)
    return distance


def reflectivity(
    rng: np.random.Generator, cosine: Float32[np.ndarray, "n"], part: UInt8[np.ndarray, "n"]
) -> UInt8[np.ndarray, "n"]:
    """Reported reflectivity: 0 to 150 for 0 to 100 % diffuse, as Livox scales it, with 5 % noise."""
    value = 150.0 * ALBEDO[part] * cosine * (1.0 + 0.05 * rng.standard_normal(len(part), np.float32))
    return np.clip(np.rint(value), 0, 255).astype(np.uint8)
