"""Dust that a robot drives in: puffs about the LiDAR that move with it, and whose echoes hide the walls behind them.

The cloud stands still as seen from the robot. A program that matches sweeps finds it well-conditioned in every
direction, and that the robot does not move: clutter lock.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from scene.survey.cast import Hits
from scene.survey.mesh import Part

_PUFFS = 90
_NEAR, _FAR = 0.8, 3.0  # m from the LiDAR to the middles of the puffs
_RADII = (0.15, 0.5)  # m
_DEPTH = 0.15  # m of dust after which 1 - 1/e of the pulses have come back
_AT_ONCE = 40_000  # rays met with all puffs at a time


@dataclass(frozen=True)
class Dust:
    """Spheres of dust in the LiDAR's frame."""

    middle: Float[np.ndarray, "k 3"]  # Their middles, m, `(k, 3)`
    radius: Float[np.ndarray, "k"]  # Their radii, m, `(k,)`
    density: float  # Density against that of full dust, 1

    def __call__(self, rng: np.random.Generator, ray: Float[np.ndarray, "n 3"], hits: Hits) -> Hits:
        """Returns what rays in the LiDAR's frame hit with the dust before the walls: a `Veil` of `scene.survey`."""
        distance = hits.distance.copy()
        dusty = np.zeros(len(ray), bool)
        for first in range(0, len(ray), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            echo = self._echo(rng, ray[part])
            dusty[part] = echo < distance[part]
            distance[part] = np.minimum(distance[part], echo)
        normal = np.where(dusty[:, None], -ray, hits.normal).astype(np.float32)
        return Hits(
            distance, np.where(dusty, 1.0, hits.cosine).astype(np.float32),
            np.where(dusty, Part.THING, hits.part).astype(np.uint8), normal,
        )  # fmt: skip

    def _echo(self, rng: np.random.Generator, ray: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Returns the range of the first echo from the dust, m; infinite where a pulse passes."""
        along = ray @ self.middle.T
        inside = self.radius**2 - (np.sum(self.middle**2, axis=1) - along**2)
        half = np.sqrt(np.maximum(inside, 0.0))
        echo = np.full(along.shape, np.inf)
        met = np.nonzero((inside > 0.0) & (along > half))
        depth = rng.exponential(_DEPTH / self.density, len(met[0]))
        echo[met] = np.where(depth < 2.0 * half[met], along[met] - half[met] + depth, np.inf)
        return echo.min(axis=1).astype(np.float32)


def draw_dust(rng: np.random.Generator, density: float) -> Dust:
    """Draws a cloud of a density, 1: 0.5 lets every second pulse through a mean puff that 1 would stop."""
    direction = rng.standard_normal((_PUFFS, 3)) * (1.0, 1.0, 0.3)  # about the level of the LiDAR
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    middle = direction * rng.uniform(_NEAR, _FAR, _PUFFS)[:, None]
    return Dust(middle, rng.uniform(*_RADII, _PUFFS), density)
