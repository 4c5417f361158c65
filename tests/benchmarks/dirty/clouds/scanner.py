"""A scanner on tripods in the air: rays to the first surface, noise, and one point kept in each cell of a grid."""

from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float

from tests.benchmarks.dirty.clouds.air import Alignment, Surface

HEIGHT = 1.7  # m of a tripod above the floor
NOISE, NOISE_PER_METRE = 0.004, 0.0002  # m, m/m: standard deviation of a range
_REACH = (0.5, 70.0)  # m
_RAYS = 500_000  # of one station


@dataclass(frozen=True)
class Scan:
    """Points of a cloud before anything spoils it."""

    local: Float[np.ndarray, "p 3"]  # Station, left, up of the surface that was met, m
    exact: Float[np.ndarray, "p 3"]  # The same in the survey frame, m
    point: Float[np.ndarray, "p 3"]  # As measured, m


def scan(
    rng: np.random.Generator,
    surface: Surface,
    alignment: Alignment,
    tripods: Float[np.ndarray, "t 3"],
    spacing: float = 0.06,
) -> Scan:
    """Scans a surface from tripods at `tripods` (station, left, up, m), thinned to one point in `spacing` m."""
    centre = np.floor(surface.placed.mean(axis=0))
    scene = EmbreeScene(robust=True)
    TriangleMesh(scene, (surface.placed - centre).astype(np.float32), surface.faces)
    local, exact, point = [], [], []
    for origin in alignment.place(tripods):
        heading = _directions(rng, _RAYS)
        start = np.broadcast_to((origin - centre).astype(np.float32), heading.shape).copy()
        hit = scene.run(start, heading.astype(np.float32), output=True)
        reach = hit["tfar"].astype(float)
        met = (hit["primID"] >= 0) & (reach > _REACH[0]) & (reach < _REACH[1])
        face, u, v = surface.faces[hit["primID"][met]], hit["u"][met, None], hit["v"][met, None]
        corners = surface.local[face]
        local.append((1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2])
        sigma = np.hypot(NOISE, NOISE_PER_METRE * reach[met])
        noisy = reach[met] + sigma * rng.standard_normal(len(sigma))
        exact.append(origin + reach[met, None] * heading[met])
        point.append(origin + noisy[:, None] * heading[met])
    whole = Scan(np.concatenate(local), np.concatenate(exact), np.concatenate(point))
    return choose(whole, thin(rng, whole.point, spacing))


def _directions(rng: np.random.Generator, count: int) -> Float[np.ndarray, "n 3"]:
    """Directions evenly over the sphere, by a spiral that is turned at random."""
    k = np.arange(count)
    up = 1.0 - 2.0 * (k + 0.5) / count
    turn = k * np.pi * (3.0 - np.sqrt(5.0)) + rng.uniform(0.0, 2.0 * np.pi)
    across = np.sqrt(1.0 - up * up)
    return np.stack([across * np.cos(turn), across * np.sin(turn), up], axis=1)


def choose(whole: Scan, kept: np.ndarray) -> Scan:
    """Return the points of a scan that a mask or an index names."""
    return Scan(whole.local[kept], whole.exact[kept], whole.point[kept])


def thin(rng: np.random.Generator, points: Float[np.ndarray, "p 3"], spacing: float) -> np.ndarray:
    """Return the indices of one point, drawn at random, in each cell of a grid of `spacing` m."""
    order = rng.permutation(len(points))
    cell = np.floor((points[order] - points.min(axis=0)) / spacing).astype(np.int64)
    key = (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]
    return np.sort(order[np.unique(key, return_index=True)[1]])
