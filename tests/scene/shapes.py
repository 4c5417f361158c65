"""Analytic clouds that are more, less or other than one D-shaped bore: sections of each type, junctions, rooms."""

from dataclasses import dataclass

import numpy as np

from tests.scene.clouds import d_section

WIDTH, HEIGHT = 5.0, 5.5
PLACE = np.array([1000.0, 2000.0, 30.0])


def outline(kind: str, count: int = 4000) -> np.ndarray:
    """Points around a section about its springing, m."""
    turn = np.linspace(-np.pi, np.pi, count)
    if kind == "circle":
        return np.stack([2.75 * np.cos(turn), 2.75 * np.sin(turn)], axis=1)
    if kind == "circle on a floor":
        return np.stack([2.75 * np.cos(turn), np.maximum(2.75 * np.sin(turn), -1.9)], axis=1)
    if kind == "ellipse":
        return np.stack([2.5 * np.cos(turn), 3.1 * np.sin(turn)], axis=1)
    crown, down = np.linspace(0, np.pi, count), np.linspace(0, -3.2, count // 2)
    wall = 5.6  # radius of the horseshoe's walls
    side = np.full(count // 2, 2.8) if kind == "d" else np.sqrt(wall**2 - down**2) - (wall - 2.8)
    bed = np.linspace(-side[-1], side[-1], count // 2)
    y = np.concatenate([2.8 * np.cos(crown), side, -side, bed])
    return np.stack([y, np.concatenate([2.8 * np.sin(crown), down, down, np.full(count // 2, -3.2)])], axis=1)


def swept(kind: str, length: float, yaw: float, start: float = 0.0, per_metre: int = 4000) -> np.ndarray:
    """A straight bore of one section with a grade of 1 %, noise 8 mm, m."""
    rng = np.random.default_rng(5)
    around = outline(kind)
    y, z = around[rng.integers(0, len(around), int(length * per_metre))].T
    station = start + rng.random(len(y)) * length
    x_east, y_north = station * np.cos(yaw) - y * np.sin(yaw), station * np.sin(yaw) + y * np.cos(yaw)
    points = np.stack([x_east, y_north, z + 0.01 * station], axis=1)
    return points + rng.normal(0, 0.008, points.shape) + PLACE


def midline(kind: str, length: float, yaw: float) -> tuple[np.ndarray, np.ndarray]:
    """The ends of the line through mid-width and mid-height of a `swept` bore, m."""
    up = outline(kind)[:, 1]
    middle = PLACE + np.array([0.0, 0.0, (up.min() + up.max()) / 2])
    return middle, middle + length * np.array([np.cos(yaw), np.sin(yaw), 0.01])


@dataclass(frozen=True)
class Tube:
    """A D-shaped bore between two points of the plan."""

    start: tuple[float, float]
    end: tuple[float, float]
    width: float = WIDTH
    height: float = HEIGHT

    def _frame(self) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
        run = np.subtract(self.end, self.start)
        length = float(np.hypot(*run))
        along = run / length
        return np.array(self.start), length, along, np.array([-along[1], along[0]])

    def surface(self, rng: np.random.Generator) -> np.ndarray:
        start, length, along, left = self._frame()
        count = int(length * 1000 * self.width / WIDTH)
        y, z = d_section(self.width, self.height, count, rng).T
        plan = start + rng.random((count, 1)) * length * along + y[:, None] * left
        return np.column_stack([plan, z + self.height / 2])

    def holds(self, points: np.ndarray) -> np.ndarray:
        start, length, along, left = self._frame()
        s, y = (points[:, :2] - start) @ along, (points[:, :2] - start) @ left
        radius = self.width / 2
        top = self.height - radius + np.sqrt(np.maximum(radius**2 - y**2, 0))
        inside = (s > 0) & (s < length) & (np.abs(y) < radius - 0.03)
        return inside & (points[:, 2] < top - 0.03) & (points[:, 2] > 0.03)


@dataclass(frozen=True)
class Box:
    """A room with its lowest corner on the floor."""

    low: tuple[float, float]
    high: tuple[float, float]
    height: float

    def surface(self, rng: np.random.Generator) -> np.ndarray:
        size = np.array([*np.subtract(self.high, self.low), self.height])
        parts = []
        for axis in range(3):
            count = int(40 * np.prod(np.delete(size, axis)))
            for side in (0.0, 1.0):
                part = rng.random((count, 3)) * size
                part[:, axis] = side * size[axis]
                parts.append(part + np.array([*self.low, 0.0]))
        return np.concatenate(parts)

    def holds(self, points: np.ndarray) -> np.ndarray:
        inside = (points[:, :2] > np.add(self.low, 0.03)) & (points[:, :2] < np.subtract(self.high, 0.03))
        return inside.all(axis=1) & (points[:, 2] < self.height - 0.03) & (points[:, 2] > 0.03)


def cavity(*parts: Tube | Box, yaw: float = 0.0, tilt: float = 0.0) -> np.ndarray:
    """Walls of the space that the parts make together, tilted about y, turned about z, with 1 cm of noise, m."""
    rng = np.random.default_rng(3)
    kept = []
    for part in parts:
        points = part.surface(rng)
        hidden = [other.holds(points) for other in parts if other is not part]
        kept.append(points[~np.any(hidden, axis=0)] if hidden else points)
    points = np.concatenate(kept)
    return placed(points + rng.normal(0, 0.01, points.shape), yaw, tilt)


def placed(points: np.ndarray, yaw: float, tilt: float) -> np.ndarray:
    """Tilted about y, turned about z, and moved to `PLACE`."""
    c, s, ct, st = np.cos(yaw), np.sin(yaw), np.cos(tilt), np.sin(tilt)
    return (
        points @ np.array([[ct, 0, st], [0, 1, 0], [-st, 0, ct]]) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + PLACE
    )
