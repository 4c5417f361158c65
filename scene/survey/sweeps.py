"""The sweeps of one LiDAR along the walk."""

from collections.abc import Iterator

import numpy as np

from scene.survey import echo
from scene.survey.carrier import Carried, rotate
from scene.survey.cast import Caster
from scene.survey.config import SensorErrors
from scene.survey.lidar import SCAN_PERIOD, Lidar, Sweep

_RAYS_AT_ONCE = 240_000  # large enough for numpy, small enough for the memory
_SECOND_RETURN = 0.02  # share of returns marked as second ones


def n_sweeps(carried: Carried, every: int) -> int:
    """How many sweeps `sweeps` yields."""
    return len(range(0, round(carried.walk.duration / SCAN_PERIOD), every))


def sweeps(
    rng: np.random.Generator, lidar: Lidar, carried: Carried, caster: Caster, errors: SensorErrors, every: int = 1
) -> Iterator[Sweep]:
    """Sweeps in order of time; every point is cast from the pose at its own time.

    Args:
        rng: Source of randomness.
        lidar: What looks.
        carried: Its motion.
        caster: Of the true mesh.
        errors: Without `distortion`, all points of a sweep are measured at its stamp, and say so.
        every: Keep every so many sweeps; those left out are not cast.
    """
    phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    offset = lidar.offset if errors.distortion else np.full_like(lidar.offset, lidar.stamp)
    numbers = np.arange(0, round(carried.walk.duration / SCAN_PERIOD), every)
    # Poses come from a table over all sweeps that are cast together, so these must follow each other.
    at_once = max(1, _RAYS_AT_ONCE // len(offset)) if every == 1 else 1
    for first in range(0, len(numbers), at_once):
        batch = numbers[first : first + at_once]
        yield from _cast(rng, lidar, carried, caster, errors, phase, offset, batch)


def _cast(
    rng: np.random.Generator,
    lidar: Lidar,
    carried: Carried,
    caster: Caster,
    errors: SensorErrors,
    phase: np.ndarray,
    offset: np.ndarray,
    numbers: np.ndarray,
) -> Iterator[Sweep]:
    n, begin = len(offset), SCAN_PERIOD * numbers
    ray = lidar.directions((begin[:, None] + 1e-9 * lidar.offset).ravel(), phase)
    poses = carried.poses_between(begin[0], (begin[:, None] + 1e-9 * offset).ravel())
    heading = rotate(poses.quaternion, ray)
    caster.load(float(carried.walk.station(begin[:1])[0]), poses.position[0])
    hits = caster.cast_loaded(poses.position, heading)

    valid = echo.returned(rng, lidar, errors, hits)
    distance = hits.distance
    if errors.mixed_pixels > 0.0:
        distance = echo.mixed(rng, lidar, errors.mixed_pixels, caster, poses.position, heading, hits)
    sigma = echo.noise_sigma(errors, distance, hits.cosine)
    # Rounded once, here: the cloud and the bag then hold the same point.
    seen = np.where(valid, distance + sigma * rng.standard_normal(len(ray), np.float32), 0.0).astype(np.float32)
    points = (seen[:, None] * ray).astype(np.float32)
    reflectivity = np.where(valid, echo.reflectivity(rng, hits.cosine, hits.part), 0).astype(np.uint8)
    second = valid & (rng.random(len(ray), np.float32) < _SECOND_RETURN)
    placed = poses.position + seen[:, None] * heading
    for k, number in enumerate(numbers):
        of = slice(k * n, (k + 1) * n)
        yield Sweep(
            int(number),
            round(SCAN_PERIOD * 1e9) * int(number),
            offset,
            valid[of],
            points[of],
            reflectivity[of],
            second[of],
            placed[of],
        )
