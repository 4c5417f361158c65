"""Gate of degeneracy: what the eigenvalues of scan matching say about a sweep, right or wrong.

A sweep matched by planes constrains a shift by the mean of n nᵀ over the normals n of its surroundings. Programs that
watch for degeneracy compare the least eigenvalue with a threshold (Zhang, Kaess and Singh 2016, On degeneracy of
optimization-based state estimation problems). It is about 0 where nothing faces along the tunnel, and 1/3 where
normals look everywhere. Dust that moves with the robot has normals everywhere: the gate stays open, and the robot
seems to stand still.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from benchmarks.slam.arena import dust
from benchmarks.slam.arena.record import Scene
from scene.survey.carrier import rotate
from scene.survey.cast import Caster, draw_returns, noise_sigma
from scene.survey.config import SensorErrors

_SWEEPS, _MERGED = 6, 5  # places of a drive that are looked at; sweeps merged at each, as a map of the near past
_VOXEL, _NEIGHBOURS = 0.2, 10  # m; points that a plane is fitted to
_FLAT = 0.1  # least over middle eigenvalue of a neighbourhood that counts as a plane


def least_eigenvalue(points: Float[np.ndarray, "n 3"]) -> float:
    """Returns the least eigenvalue of the mean of n nᵀ over the planes in a cloud, 0 to 1/3.

    Raises:
        ValueError: The cloud holds no planes.
    """
    _, first = np.unique(np.floor(points / _VOXEL).astype(np.int64), axis=0, return_index=True)
    points = points[first]
    if len(points) < _NEIGHBOURS:
        raise ValueError("too few points for planes")
    _, near = cKDTree(points).query(points, _NEIGHBOURS)
    parts = points[near] - points[near].mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", parts, parts))
    flat = values[:, 0] < _FLAT * values[:, 1]
    if not flat.any():
        raise ValueError("no neighbourhood is a plane")
    normals = vectors[flat, :, 0]
    return float(np.linalg.eigvalsh(normals.T @ normals / len(normals))[0])


def find_gate(scene: Scene) -> float:
    """Returns the least eigenvalue of a drive, median over its sweeps; its dust counts."""
    drive, rng = scene.drive, np.random.default_rng(0)
    start, _, _, end = drive.knots
    caster = Caster(drive.bore.mesh(), scene.sensor.lidar.range_max)
    density = scene.course.dust
    veil = dust.draw_dust(np.random.default_rng(scene.seeds["dust"]), density) if density > 0.0 else None
    return float(np.median([
        least_eigenvalue(_near_past(rng, scene, caster, veil, at)) for at in np.linspace(start + 2.0, end, _SWEEPS)
    ]))  # fmt: skip


def _near_past(
    rng: np.random.Generator, scene: Scene, caster: Caster, veil: dust.Dust | None, time: float
) -> Float[np.ndarray, "n 3"]:
    """Returns the points of some sweeps up to a time, s, at their true places as seen by the robot, m.

    Dust is where it is for the robot, which carries it along; walls are merged by the true motion.
    """
    lidar, clouds = scene.sensor.lidar, []
    rays = lidar.directions(1e-9 * lidar.offset, np.zeros(2))
    last = scene.drive.poses(np.array([time]))
    for k in range(_MERGED):
        poses = scene.drive.poses(np.array([time - 0.1 * k]))
        heading = rotate(np.repeat(poses.quaternion, len(rays), axis=0), rays)
        caster.load(float(scene.drive.station(np.array([time - 0.1 * k]))[0]), poses.position[0])
        hits = caster.cast_loaded(np.repeat(poses.position, len(rays), axis=0), heading)
        walls = hits.distance
        hits = hits if veil is None else veil(rng, rays, hits)
        seen = draw_returns(rng, lidar, SensorErrors(), hits)
        far = hits.distance + rng.standard_normal(len(rays)) * noise_sigma(SensorErrors(), hits.distance, hits.cosine)
        dusty = hits.distance < walls
        ends = np.where(dusty[:, None], last.position, poses.position) + far[:, None] * heading
        clouds.append(ends[seen & np.isfinite(far)])
    return np.concatenate(clouds)
