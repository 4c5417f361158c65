"""Floor of the axial drift: what the ranges of a drive could tell about the way, whatever program reads them.

A beam's slope over the station is that of the best line through its ranges from stations about the true one
(statistical linearisation); what the line leaves over counts as noise.
One sweep against a perfect map knows the station to the Cramér–Rao bound σ₁. A program without a map ties each view
length ℓ of wall to the next, with every sweep that sees both: over a way d its drift is at least
σ₁ · sqrt(2 / n) · sqrt(d / ℓ), with n sweeps to a view length.

Slopes below `LEAST_SLOPE` count as none: no program knows a wall to the millimetre before it has driven past.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from benchmarks.slam.arena.record import Scene
from scene.survey.carrier import rotate
from scene.survey.cast import Caster, draw_returns, noise_sigma
from scene.survey.config import SensorErrors

LEAST_SLOPE = 0.005  # 1
_BLUR = 0.05  # m, spread of the stations about the true one
_PLACES = np.array([-1.6, -0.8, 0.0, 0.8, 1.6]) * _BLUR  # m; standard deviation 1.13 times the blur
_SWEEPS = 12  # sweeps of a drive that are looked at


class Floor(NamedTuple):
    """Bounds of one drive."""

    sweep: float  # Cramér–Rao bound of the station from one sweep and a perfect map, median over the drive, m
    view: float  # Length of bore that a sweep shows, m
    drift: float  # Floor of the axial drift per 100 m, m


def find_floor(scene: Scene) -> Floor:
    """Returns the floor of a drive, its dust left out."""
    drive, lidar = scene.drive, scene.sensor.lidar
    start, _, _, end = drive.knots
    caster = Caster(drive.bore.mesh(), lidar.range_max)
    rng = np.random.default_rng(0)
    rays = lidar.directions(1e-9 * lidar.offset, np.zeros(2))
    pairs = [_sweep_bound(rng, scene, caster, rays, at) for at in np.linspace(start + 2.0, end, _SWEEPS)]
    sweep, view = (float(np.median(values)) for values in zip(*pairs, strict=True))
    sweeps = max(1.0, 10.0 * view / drive.carrier.speed)
    return Floor(sweep, view, sweep * np.sqrt(2.0 / sweeps) * np.sqrt(100.0 / view))


def _sweep_bound(
    rng: np.random.Generator, scene: Scene, caster: Caster, rays: Float[np.ndarray, "n 3"], time: float
) -> tuple[float, float]:
    """Returns the bound of the station of one sweep, m, and the length of bore that it shows, m."""
    at = np.array([time])
    poses = scene.drive.poses(at)
    tangent = scene.drive.bore.alignment.frames(scene.drive.station(at)).tangent[0]
    heading = rotate(np.repeat(poses.quaternion, len(rays), axis=0), rays)
    caster.load(float(scene.drive.station(at)[0]), poses.position[0])
    casts = [caster.cast_loaded(np.repeat(poses.position + shift * tangent, len(rays), axis=0), heading)
             for shift in _PLACES]  # fmt: skip
    ranges = np.stack([one.distance for one in casts]).astype(np.float64)
    hits = casts[len(casts) // 2]
    seen = draw_returns(rng, scene.sensor.lidar, SensorErrors(), hits) & np.isfinite(ranges).all(axis=0)
    slope, left = fit_slopes(ranges[:, seen])
    noise = noise_sigma(SensorErrors(), hits.distance[seen], hits.cosine[seen])
    information = np.sum(np.where(abs(slope) < LEAST_SLOPE, 0.0, slope**2 / (noise**2 + left)))
    along = (heading[seen] @ tangent) * hits.distance[seen]
    view = float(np.ptp(np.quantile(along, [0.05, 0.95])))
    return float(1.0 / np.sqrt(max(information, 1e-12))), view


def fit_slopes(ranges: Float[np.ndarray, "k n"]) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Returns the slope of each beam's range over the station and the variance about the line, m²."""
    middle = ranges - ranges.mean(axis=0)
    slope = _PLACES @ middle / (_PLACES @ _PLACES)
    return slope, np.mean((middle - np.outer(_PLACES, slope)) ** 2, axis=0)
