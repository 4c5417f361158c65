"""Clouds of straight bores with whatever lies on their floors, seen by scanners from where they stand, with shadows."""

from dataclasses import dataclass, field

import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from tests.scene.shapes import PLACE

Box = tuple[float, float, float, float, float, float]  # x, y, z from and to, m
_HEADS = ((0.0, 0.012, 0.075), (0.012, 0.1275, 0.00825), (0.1275, 0.176, 0.0365))  # of a rail: from, to, half width, m


def arch(width: float, height: float, walls: float) -> np.ndarray:
    """A closed outline: flat floor at 0, upright walls of a height, an elliptical crown on them, m."""
    turn = np.linspace(0, np.pi, 60)
    crown = np.column_stack([width / 2 * np.cos(turn), walls + (height - walls) * np.sin(turn)])
    return np.concatenate([[(width / 2, 0.0)], crown, [(-width / 2, 0.0)]])


def sleepers(stations: np.ndarray, top: float, aside: float = 0.0, depth: float = 0.21) -> list[Box]:
    return [(s - 0.11, s + 0.11, aside - 1.25, aside + 1.25, max(top - depth, 0.0), top) for s in stations]


def rails(length: float, seat: float, aside: float = 0.0, gauge: float = 1.435, cant: float = 0.0) -> list[Box]:
    """Two rails on seats at a height, the left one higher by `cant`, m."""
    middle = gauge / 2 + 0.0365
    return [
        (0.0, length, aside + side * middle - half, aside + side * middle + half, low + lift, high + lift)
        for side, lift in ((1, seat + cant / 2), (-1, seat - cant / 2))
        for low, high, half in _HEADS
    ]


@dataclass(frozen=True)
class World:
    """A bore and the boxes in it."""

    outline: np.ndarray
    length: float = 40.0
    boxes: list[Box] = field(default_factory=list)
    grade: float = 0.01
    hole: tuple[float, float] | None = None  # stretch of the floor from which nothing comes back, m

    @property
    def middle(self) -> tuple[np.ndarray, np.ndarray]:
        """The ends of the line through mid-width and mid-height, m."""
        half = self.outline[:, 1].max() / 2
        return np.array([0.0, 0.0, half]) + PLACE, np.array([self.length, 0.0, half + self.grade * self.length]) + PLACE

    def _mesh(self) -> trimesh.Trimesh:
        around, count = self.outline, len(self.outline)
        ends = [np.column_stack([np.full(count, x), around]) for x in (0.0, self.length)]
        a, b = np.arange(count), np.roll(np.arange(count), -1)
        faces = np.concatenate([np.column_stack([a, b, a + count]), np.column_stack([b, b + count, a + count])])
        parts = [trimesh.Trimesh(np.concatenate(ends), faces, process=False)]
        for box in self.boxes:
            low, high = np.array(box).reshape(3, 2).T
            parts.append(trimesh.creation.box(bounds=[low, high]))
        return trimesh.util.concatenate(parts)

    def scan(self, rays: np.ndarray, positions: np.ndarray, noise: float = 0.008, seed: int = 0) -> np.ndarray:
        """Returns of a sweep of `rays` from each position, turned at random about z, by the nearest surface, m."""
        rng = np.random.default_rng(seed)
        mesh, scene = self._mesh(), EmbreeScene(robust=True)
        TriangleMesh(scene, mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32))
        found = []
        for position in positions:
            yaw = rng.uniform(0, 2 * np.pi)
            c, s = np.cos(yaw), np.sin(yaw)
            ray = (rays @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])).astype(np.float32)
            start = np.broadcast_to(position.astype(np.float32), ray.shape)
            distance = scene.run(np.array(start), ray, query="DISTANCE")
            hit = (distance > 0.5) & (distance < 60.0)
            reach = distance[hit, None] + rng.normal(0, noise, (hit.sum(), 1))
            found.append(position + reach * ray[hit])
        points = np.concatenate(found)
        if self.hole:
            x, z = points[:, 0], points[:, 2]
            points = points[~((x > self.hole[0]) & (x < self.hole[1]) & (z < 0.4))]
        return points + np.column_stack([np.zeros((len(points), 2)), self.grade * points[:, 0]]) + PLACE


def _rays(elevation: np.ndarray, columns: int) -> np.ndarray:
    turn = np.repeat(np.linspace(0, 2 * np.pi, columns, endpoint=False), len(elevation))
    lift = np.deg2rad(np.tile(elevation, columns))
    return np.column_stack([np.cos(lift) * np.cos(turn), np.cos(lift) * np.sin(turn), np.sin(lift)])


def vlp16() -> np.ndarray:
    return _rays(np.arange(-15.0, 16.0, 2.0), 900)


def os1() -> np.ndarray:
    return _rays(np.linspace(-22.5, 22.5, 64), 512)


def terrestrial() -> np.ndarray:
    return _rays(np.arange(-62.0, 90.0, 0.5), 900)


def carried(length: float, height: float, step: float, aside: float = 0.1) -> np.ndarray:
    """Positions of a sensor that sways a little to both sides, m."""
    x = np.arange(0.5, length - 0.4, step)
    return np.column_stack([x, aside * np.sin(x), height + 0.03 * np.sin(2.1 * x)])


def stations(length: float, height: float = 1.6, step: float = 6.0) -> np.ndarray:
    x = np.arange(2.0, length - 1.0, step)
    return np.column_stack([x, np.full_like(x, 0.05), np.full_like(x, height)])
