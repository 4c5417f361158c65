"""Terrestrial scans of a straight arch with things in it: rays from stations on the floor, with shadows and noise."""

import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene


def arch(width: float = 5.5, height: float = 5.5, length: float = 40.0) -> trimesh.Trimesh:
    """An open arch along x with its floor at z = 0, m."""
    half, turn = width / 2, np.linspace(0, np.pi, 49)
    rise = height - half
    outline = np.array([(-half, 0.0), (half, 0.0), *np.column_stack([half * np.cos(turn), rise + half * np.sin(turn)])])
    ends = [np.column_stack([np.full(len(outline), x), outline]) for x in (0.0, length)]
    count = len(outline)
    here = np.arange(count)
    ahead = (here + 1) % count
    faces = np.concatenate(
        [np.column_stack([here, ahead, here + count]), np.column_stack([ahead, ahead + count, here + count])]
    )
    return trimesh.Trimesh(np.concatenate(ends), faces, process=False)


def pillar(x: float, y: float, radius: float = 0.3, height: float = 6.0) -> trimesh.Trimesh:
    """A round pillar from the floor up, m."""
    cylinder = trimesh.creation.cylinder(radius=radius, height=height, sections=24)
    return cylinder.apply_translation([x, y, height / 2])


def scan(
    parts: list[trimesh.Trimesh],
    stations: np.ndarray,
    per_station: int = 250_000,
    noise: float = 0.005,
    height: float = 1.5,
    seed: int = 0,
) -> np.ndarray:
    """Return what a scanner sees of some surfaces from stations along x, m."""
    mesh = trimesh.util.concatenate(parts)
    scene = EmbreeScene(robust=True)
    TriangleMesh(scene, mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32))
    rng = np.random.default_rng(seed)
    points = []
    for x in stations:
        ray = rng.standard_normal((per_station, 3))
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        start = np.broadcast_to([x, 0.0, height], ray.shape).astype(np.float32)
        distance = scene.run(np.ascontiguousarray(start), ray.astype(np.float32), query="DISTANCE")
        hit = (distance > 0.5) & (distance < 40.0)
        points.append(start[hit] + (distance[hit] + rng.normal(0, noise, hit.sum()))[:, None] * ray[hit])
    return np.concatenate(points).astype(np.float64)


def with_outliers(points: np.ndarray, share: float, reach: float = 3.0, seed: int = 1) -> np.ndarray:
    """Return points with stray ones scattered over their box, `reach` m wider to each side."""
    rng = np.random.default_rng(seed)
    low, high = points.min(axis=0) - reach, points.max(axis=0) + reach
    return np.concatenate([points, rng.uniform(low, high, (int(share * len(points)), 3))])
