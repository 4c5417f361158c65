"""Design section of a drawn bore, and the place of the LiDAR in it."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from subterra_jax.procedural.kinds import MOUNT_HEIGHT, MOUNT_LATERAL, MOUNT_TILT, SectionRanges

_OUTLINE = 4000  # points of an outline before it is sampled


@dataclasses.dataclass(frozen=True)
class Mount:
    """Place of the LiDAR on the robot.

    Attributes:
        height: Height above the floor, m.
        lateral: Distance to the left of the robot's middle, m.
        roll: Turn about the axis ahead, rad; the left side rises.
        pitch: Turn about the axis to the left, rad; above 0 it looks down. Of no account in the plane.
    """

    height: float
    lateral: float
    roll: float
    pitch: float

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Mount:
        height, lateral = rng.uniform(*MOUNT_HEIGHT), rng.uniform(*MOUNT_LATERAL)
        roll, pitch = MOUNT_TILT * np.clip(rng.normal(size=2), -3.0, 3.0)
        return cls(float(height), float(lateral), float(roll), float(pitch))

    def plane(self, lateral: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
        """Return the height of the plane of the planar LiDAR at a lateral, m."""
        return np.asarray(self.height + (np.asarray(lateral) - self.lateral) * np.tan(self.roll))


@dataclasses.dataclass(frozen=True)
class Section:
    """Design section as a closed outline, in the direction of growing angle from below the floor."""

    outline: Float[np.ndarray, "k 2"]  # points, m to the left of the lining's middle line and above the floor, `(k, 2)`
    centre: float  # height of the lining's own middle, m
    height: float  # height of the crown, m
    half_width: float  # half the largest width, m

    @classmethod
    def draw(cls, rng: np.random.Generator, ranges: SectionRanges) -> Section:
        """Draw a circle with a filled invert, or walls with an elliptic crown."""
        half = 0.5 * float(rng.uniform(*ranges.width))
        turn = np.linspace(-0.5 * np.pi, 1.5 * np.pi, _OUTLINE)
        if ranges.height is None:
            centre = half - float(rng.uniform(*ranges.fill))
            circle = half * np.stack([np.cos(turn), np.sin(turn)], axis=-1) + [0.0, centre]
            return cls(circle, centre, centre + half, half)
        height, foot = float(rng.uniform(*ranges.height)), float(rng.uniform(*ranges.foot))
        spring = height * float(rng.uniform(*ranges.spring))
        rise = np.linspace(-1.0, spring, _OUTLINE // 4)
        wall = np.stack([half - foot * (1.0 - rise / spring) ** 2, rise], axis=-1)
        arc = np.linspace(0.0, 0.5 * np.pi, _OUTLINE // 4)
        crown = np.stack([half * np.cos(arc), spring + (height - spring) * np.sin(arc)], axis=-1)
        left = np.concatenate([[[0.0, -1.0]], wall, crown[1:]])
        return cls(np.concatenate([left, left[-2::-1] * [-1.0, 1.0]]), 0.5 * height, height, half)

    def wall(self, height: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
        """Return half the width at heights above the floor and below the crown, m."""
        left = self.outline[(self.outline[:, 0] > 0.0) & (self.outline[:, 1] < self.height - 1e-3)]
        return np.asarray(np.interp(height, left[:, 1], left[:, 0]))

    def slope(self, height: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return how fast half the width grows with the height, 1, over 20 cm."""
        return (self.wall(height + 0.1) - self.wall(height - 0.1)) / 0.2
