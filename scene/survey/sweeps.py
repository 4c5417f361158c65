"""The sweeps of a LiDAR along the walk, and the turns of a profile scanner."""

from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float

from scene.survey.carrier import CARRY_HEIGHT, Carried, Passage, rotate
from scene.survey.cast import Caster, Hits, draw_reflectivity, draw_returns, draw_strays, mix_pixels, noise_sigma
from scene.survey.config import SensorErrors, SurveyConfig
from scene.survey.lidar import SCAN_PERIOD, Lidar, Sweep
from scene.survey.write import CloudWriter
from subterra_jax.host.files import replace_file

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


_POINTS = 3600  # in one turn
_THICK = 0.01  # m, half the thickness of a profile: the carrier creeps on while the mirror turns
_HELD_OUT = (0.25, 0.5, 0.75)  # places of the held-out profiles between two others, as shares of their spacing
_AT_ONCE = 40  # profiles cast together
_SCANNER = Lidar(
    "profile scanner", np.zeros(1, np.int64), 0, np.zeros(1, np.int64), lambda t, p: np.zeros((len(t), 3)),
    range_min=0.3, range_max=80.0, weakest_echo=0.1 / 80.0**2, divergence=1e-3,
)  # fmt: skip


def profile_stations(length: float, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the stations, m, of the profiles, at least 2 `_THICK` inside the mouths, and of those held out."""
    given = np.arange(2.0 * _THICK, length - 2.0 * _THICK + 1e-9, spacing)
    return given, np.add.outer(given[:-1], spacing * np.array(_HELD_OUT)).ravel()


def write_profiles(config: SurveyConfig, bore: Passage, caster: Caster, seed: np.random.SeedSequence) -> int:
    """Writes `cloud.ply` and `held_out.ply`; returns the number of points of the first."""
    counts = []
    stations = profile_stations(config.length, config.profiles)
    for name, at, one in zip(("cloud.ply", "held_out.ply"), stations, seed.spawn(2), strict=True):
        rng, count = np.random.default_rng(one), 0
        with replace_file(config.out / name) as part, CloudWriter(part) as cloud:
            for first in range(0, len(at), _AT_ONCE):
                placed, brightness = _cast_turns(rng, config, bore, caster, at[first : first + _AT_ONCE])
                cloud.add(placed, brightness)
                count += len(placed)
        counts.append(count)
    return counts[0]


def _cast_turns(
    rng: np.random.Generator, config: SurveyConfig, bore: Passage, caster: Caster, stations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Points, m, and reflectivities of one turn at each station."""
    turn = np.linspace(0.0, 2.0 * np.pi, _POINTS, endpoint=False)
    at = np.repeat(stations, _POINTS) + rng.uniform(-_THICK, _THICK, _POINTS * len(stations))
    angle = np.tile(turn, len(stations)) + np.repeat(rng.uniform(0.0, 2.0 * np.pi, len(stations)), _POINTS)
    frames = bore.alignment.frames(at)
    origin = frames.point(np.zeros_like(at), CARRY_HEIGHT - 0.5 * bore.section.height(at))
    heading = np.cos(angle)[:, None] * frames.lateral + np.sin(angle)[:, None] * frames.up
    caster.load(float(stations[0]), origin[0])
    hits: Hits = caster.cast_loaded(origin, heading)
    valid = draw_returns(rng, _SCANNER, config.errors, hits)
    distance = hits.distance
    if config.errors.mixed_pixels > 0.0:
        distance = mix_pixels(rng, _SCANNER, config.errors.mixed_pixels, caster, origin, heading, hits)
    distance = draw_strays(rng, config.errors.strays, distance)
    distance = distance + noise_sigma(config.errors, distance, hits.cosine) * rng.standard_normal(len(distance))
    bright = draw_reflectivity(rng, hits.cosine, hits.part)
    return (origin + np.where(valid, distance, 0.0)[:, None] * heading)[valid], bright[valid]
