"""The sweeps of a LiDAR along the walk."""

from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float

from scene.survey.carrier import Carried, rotate
from scene.survey.cast import Caster, Hits, draw_reflectivity, draw_returns, draw_strays, mix_pixels, noise_sigma
from scene.survey.config import SensorErrors
from scene.survey.lidar import SCAN_PERIOD, Lidar, Sweep

_RAYS_AT_ONCE = 240_000  # large enough for numpy, small enough for the memory
_SECOND_RETURN = 0.02  # share of returns marked as second ones


def n_sweeps(carried: Carried, every: int) -> int:
    """Return the number of sweeps that `sweeps` yields."""
    return len(range(0, round(carried.walk.duration / SCAN_PERIOD), every))


# What floats between the LiDAR and the walls: from rays in the LiDAR's frame and what they hit to what they then hit.
Veil = Callable[[np.random.Generator, Float[np.ndarray, "n 3"], Hits], Hits]


def sweeps(
    rng: np.random.Generator,
    lidar: Lidar,
    carried: Carried,
    caster: Caster,
    errors: SensorErrors,
    every: int = 1,
    veil: Veil | None = None,
) -> Iterator[Sweep]:
    """Yields every `every`-th sweep in order of time; every point is cast from the pose at its own time.

    Without `distortion` in `errors`, all points of a sweep are measured at its stamp, and say so. A `veil` stands
    before every surface, as dust does.
    """
    phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    offset = lidar.offset if errors.distortion else np.full_like(lidar.offset, lidar.stamp)
    numbers = np.arange(0, round(carried.walk.duration / SCAN_PERIOD), every)
    # Poses come from a table over all sweeps that are cast together, so these must follow each other.
    at_once = max(1, _RAYS_AT_ONCE // len(offset)) if every == 1 else 1
    for first in range(0, len(numbers), at_once):
        batch = numbers[first : first + at_once]
        n, begin = len(offset), SCAN_PERIOD * batch
        ray = lidar.directions((begin[:, None] + 1e-9 * lidar.offset).ravel(), phase)
        poses = carried.poses_between(begin[0], (begin[:, None] + 1e-9 * offset).ravel())
        heading = rotate(poses.quaternion, ray)
        caster.load(float(carried.walk.station(begin[:1])[0]), poses.position[0])
        hits = caster.cast_loaded(poses.position, heading)
        if veil is not None:
            hits = veil(rng, ray, hits)

        valid = draw_returns(rng, lidar, errors, hits)
        distance = hits.distance
        if errors.mixed_pixels > 0.0:
            distance = mix_pixels(rng, lidar, errors.mixed_pixels, caster, poses.position, heading, hits)
        distance = draw_strays(rng, errors.strays, distance)
        sigma = noise_sigma(errors, distance, hits.cosine)
        # Rounded once, here: the cloud and the bag then hold the same point.
        seen = np.where(valid, distance + sigma * rng.standard_normal(len(ray), np.float32), 0.0).astype(np.float32)
        points = (seen[:, None] * ray).astype(np.float32)
        reflectivity = np.where(valid, draw_reflectivity(rng, hits.cosine, hits.part), 0).astype(np.uint8)
        second = valid & (rng.random(len(ray), np.float32) < _SECOND_RETURN)
        placed = poses.position + seen[:, None] * heading
        for k, number in enumerate(batch):
            of = slice(k * n, (k + 1) * n)
            yield Sweep(
                int(number), round(SCAN_PERIOD * 1e9) * int(number), offset, valid[of], points[of], reflectivity[of],
                second[of], placed[of],
            )  # fmt: skip
