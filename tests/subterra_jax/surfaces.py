"""Surfaces with known geometry, float64 brute force in them by no code of the simulator, and the simulator's ranges."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from subterra_jax import lidar3d

Surface = tuple[np.ndarray, np.ndarray]  # vertices (v, 3) m, faces (f, 3)


def axis_of(length: float, curvature: float = 0.0, grade: float = 0.0, step: float = 0.25) -> dict[str, np.ndarray]:
    """Station (m), position (m) and tangent of a straight line or an arc to the left, with a grade."""
    station = np.linspace(0.0, length, round(length / step) + 1)
    heading = curvature * station
    across = np.sqrt(1.0 + grade**2)
    if curvature:
        x, y = np.sin(heading) / curvature, (1.0 - np.cos(heading)) / curvature
    else:
        x, y = station, np.zeros_like(station)
    position = np.stack([x, y, grade * station], axis=-1)
    tangent = np.stack([np.cos(heading), np.sin(heading), np.full_like(station, grade)], axis=-1) / across
    return {"station": station, "position": position, "tangent": tangent}


def tube(axis: dict[str, np.ndarray], radius: np.ndarray | float, sides: int, rows: int) -> Surface:
    """Wall around an axis; `radius` may be given for every row and side, `(rows, sides)`, m. Both mouths are open."""
    pick = np.linspace(0, len(axis["station"]) - 1, rows).round().astype(int)
    tangent, position = axis["tangent"][pick], axis["position"][pick]
    left = np.cross([0.0, 0.0, 1.0], tangent)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    up = np.cross(tangent, left)
    angle = np.arange(sides) * 2.0 * np.pi / sides
    reach = np.broadcast_to(radius, (rows, sides))
    y, z = (reach * np.cos(angle))[..., None], (reach * np.sin(angle))[..., None]
    vertices = (position[:, None] + y * left[:, None] + z * up[:, None]).reshape(-1, 3)
    row, side = (a.ravel() for a in np.meshgrid(np.arange(rows - 1), np.arange(sides), indexing="ij"))
    after = (side + 1) % sides
    a, b, c, d = row * sides + side, row * sides + after, (row + 1) * sides + side, (row + 1) * sides + after
    return vertices, np.concatenate([np.column_stack([a, b, c]), np.column_stack([b, d, c])])


def box(centre: tuple[float, float, float], half: tuple[float, float, float]) -> Surface:
    """A box along the axes of the tunnel frame."""
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    faces = []
    for low in (1, 2, 4):
        one, two = (bit for bit in (1, 2, 4) if bit != low)
        for base in (0, low):
            faces += [(base, base + one, base + two), (base + one, base + two, base + one + two)]
    return np.asarray(centre) + corners * half, np.array(faces)


def together(*parts: Surface) -> Surface:
    """Several surfaces as one."""
    before = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    faces = [faces + offset for (_, faces), offset in zip(parts, before, strict=False)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def brute(surface: Surface, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Distance from each origin along each direction to the nearest triangle, `inf` for none, `(n,)`.

    A ray meets a triangle if it passes its three edges on the same side.
    """
    corner = surface[0][surface[1]]
    reach = np.full(len(origin), np.inf)
    for k, (o, d) in enumerate(zip(np.asarray(origin, float), np.asarray(direction, float), strict=True)):
        v = corner - o
        side = np.stack([np.cross(v[:, i], v[:, (i + 1) % 3]) @ d for i in range(3)])
        inside = (side >= 0.0).all(axis=0) | (side <= 0.0).all(axis=0)
        normal = np.cross(v[:, 1] - v[:, 0], v[:, 2] - v[:, 0])[inside]
        along = normal @ d
        flat = np.abs(along) < 1e-14
        distance = np.sum(normal * v[inside, 0], axis=1)[~flat] / along[~flat]
        reach[k] = distance[distance >= 0.0].min(initial=np.inf)
    return reach


def ranges(relief, origin, directions, station, limit=30.0):
    """Ranges of rays from one place."""
    return lidar3d.meet(relief, jnp.broadcast_to(origin, directions.shape), directions, station, limit).ranges
