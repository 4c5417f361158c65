"""Registered clouds of a profile scanner: full turns in planes across the bore, at even stations."""

import numpy as np

from scene.survey import echo, write
from scene.survey.bore import Bore
from scene.survey.carrier import CARRY_HEIGHT
from scene.survey.cast import Caster, Hits
from scene.survey.config import SurveyConfig
from scene.survey.lidar import Lidar

_POINTS = 3600  # in one turn
_THICK = 0.01  # m, half the thickness of a profile: the carrier creeps on while the mirror turns
_HELD_OUT = (0.25, 0.5, 0.75)  # places of the held-out profiles between two others, as shares of their spacing
_AT_ONCE = 40  # profiles cast together
_SCANNER = Lidar(
    "profile scanner", np.zeros(1, np.int64), 0, np.zeros(1, np.int64), lambda t, p: np.zeros((len(t), 3)),
    range_min=0.3, range_max=80.0, weakest_echo=0.1 / 80.0**2, divergence=1e-3,
)  # fmt: skip


def profile_stations(length: float, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Stations, m, of the profiles, the first and last `_THICK` inside the mouths at least, and of those held out."""
    given = np.arange(2.0 * _THICK, length - 2.0 * _THICK + 1e-9, spacing)
    return given, np.add.outer(given[:-1], spacing * np.array(_HELD_OUT)).ravel()


def write_profiles(config: SurveyConfig, bore: Bore, caster: Caster, seed: np.random.SeedSequence) -> int:
    """Write `cloud.ply` and `held_out.ply`; return the number of points of the first."""
    counts = []
    stations = profile_stations(config.length, config.profiles)
    for name, at, one in zip(("cloud.ply", "held_out.ply"), stations, seed.spawn(2), strict=True):
        rng, count = np.random.default_rng(one), 0
        with write.replacing(config.out / name) as part, write.CloudWriter(part) as cloud:
            for first in range(0, len(at), _AT_ONCE):
                placed, brightness = _turns(rng, config, bore, caster, at[first : first + _AT_ONCE])
                cloud.add(placed, brightness)
                count += len(placed)
        counts.append(count)
    return counts[0]


def _turns(
    rng: np.random.Generator, config: SurveyConfig, bore: Bore, caster: Caster, stations: np.ndarray
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
    valid = echo.returned(rng, _SCANNER, config.errors, hits)
    distance = hits.distance
    if config.errors.mixed_pixels > 0.0:
        distance = echo.mixed(rng, _SCANNER, config.errors.mixed_pixels, caster, origin, heading, hits)
    distance = distance + echo.noise_sigma(config.errors, distance, hits.cosine) * rng.standard_normal(len(distance))
    bright = echo.reflectivity(rng, hits.cosine, hits.part)
    return (origin + np.where(valid, distance, 0.0)[:, None] * heading)[valid], bright[valid]
