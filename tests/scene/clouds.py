"""Analytic bores as point clouds: what a perfect survey of a known tunnel would give, with noise."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class KnownBore:
    """A D-section on an arc with a grade, and where its middle runs."""

    points: np.ndarray
    centre: np.ndarray
    width: float
    height: float
    length: float


def d_section(width: float, height: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """Points spread evenly over floor, walls and crown about mid-width and mid-height, m."""
    radius = width / 2
    wall = height - radius
    perimeter = np.array([width, wall, np.pi * radius, wall])
    piece = rng.choice(4, count, p=perimeter / perimeter.sum())
    along = rng.random(count)
    turn = np.pi * along
    lateral = np.choose(piece, [width * (along - 0.5), -radius, radius * np.cos(turn), radius])
    upward = np.choose(piece, [0.0, wall * along, wall + radius * np.sin(turn), wall * along])
    return np.stack([lateral, upward - height / 2], axis=1)


def curved_d_bore(
    length: float = 40.0,
    radius: float = 150.0,
    grade: float = 0.01,
    yaw: float = 0.7,
    noise: float = 0.01,
    per_metre: int = 4000,
    offset: tuple[float, float, float] = (1200.0, -340.0, 25.0),
    seed: int = 0,
) -> KnownBore:
    """A D-section of 5.65 m × 6.36 m swept along a left-hand arc."""
    rng = np.random.default_rng(seed)
    width, height, count = 5.65, 6.36, int(length * per_metre)

    def place(station: np.ndarray, lateral: np.ndarray, upward: np.ndarray) -> np.ndarray:
        heading = yaw + station / radius
        x = radius * (np.sin(heading) - np.sin(yaw)) - lateral * np.sin(heading)
        y = -radius * (np.cos(heading) - np.cos(yaw)) + lateral * np.cos(heading)
        return np.stack([x, y, grade * station + upward], axis=1) + offset

    section = d_section(width, height, count, rng)
    points = place(rng.random(count) * length, section[:, 0], section[:, 1])
    at = np.linspace(0, length, 400)
    centre = place(at, np.zeros(400), np.zeros(400))
    return KnownBore(points + noise * rng.standard_normal(points.shape), centre, width, height, length)
