"""What furniture is asked for, its boxes, and where in the bore one may stand."""

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from scene.bore import Bore
from scene.writing.markup import along
from scene.writing.track import Track, wall_offset

_ROBOT_HEIGHT = 1.0


@dataclass(frozen=True)
class FurnitureConfig:
    """Which furniture, and its sizes, m; heights are above the top of the sleepers.

    Sources: widths of walkways 0.8 m (low) to 1.0 m: metro walkway descriptions; cross-passages 244 m apart: NFPA 130.
    Bracket pitch and tiers, the third rail's offset, plate pitch and all other sizes are engineering defaults.

    Attributes:
        walkway: Whether there is a low walkway, on the left.
        walkway_width: It is less where it would come nearer than 5 cm to the sleepers' ends, none below 0.5 m.
        walkway_height: Of its top.
        handrail: Whether a handrail on posts runs along the walkway's wall.
        handrail_height: Above the walkway.
        post_spacing: Of the handrail's posts.
        post_size: Side of a post's square section.
        cables: Whether cables on brackets run along the right wall.
        bracket_spacing: Of the brackets.
        bracket_length: Out of the wall.
        tiers: Heights of the brackets' arms.
        cable_diameter: Of each tier's bundle.
        third_rail: Whether there is a third rail, on the right.
        third_rail_offset: From the running rail, middle to middle.
        plates: Whether there are hectometre plates on the left wall.
        plate_spacing: Of the plates.
        passage: Whether there are doors of cross-passages, in niches of the left wall.
        passage_spacing: Of the doors, the first half of that from the start.
        passage_size: Length, height and depth of a niche.
        lamps: Whether there are lamps at the crown.
        lamp_spacing: Of the lamps.
        gauge: Half the width about the axis that nothing may enter up to a robot's height.
    """

    walkway: bool = True
    walkway_width: float = 0.8
    walkway_height: float = 0.30
    handrail: bool = True
    handrail_height: float = 1.0
    post_spacing: float = 2.0
    post_size: float = 0.05
    cables: bool = True
    bracket_spacing: float = 1.0
    bracket_length: float = 0.25
    tiers: tuple[float, ...] = (0.55, 0.90, 1.25, 1.60)
    cable_diameter: float = 0.06
    third_rail: bool = True
    third_rail_offset: float = 0.7
    plates: bool = True
    plate_spacing: float = 100.0
    passage: bool = True
    passage_spacing: float = 244.0
    passage_size: tuple[float, float, float] = (2.0, 2.1, 0.5)
    lamps: bool = True
    lamp_spacing: float = 12.0
    gauge: float = 0.9


@dataclass(frozen=True)
class Piece:
    """One box of furniture.

    Attributes:
        kind: What it is part of.
        material: Of the scene.
        centre: m, `(3,)`.
        rotation: X along the bore, y to the left, z upwards.
        half: Half its sizes, m, `(3,)`.
        low: Whether it stands where a robot could run into it.
    """

    kind: str
    material: str
    centre: Float[np.ndarray, "3"]
    rotation: Rotation
    half: Float[np.ndarray, "3"]
    low: bool

    def corners(self) -> Float[np.ndarray, "8 3"]:
        """Its corners, m; the last bit of a corner's number tells lower from upper."""
        signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        return self.centre + self.rotation.apply(signs * self.half)


@dataclass(frozen=True, eq=False)
class Place:
    """Where furniture may stand.

    Attributes:
        bore: The bore.
        track: Its track.
        config: What to place.
        keep_out: First and last station of each niche of the left wall, m.
    """

    bore: Bore
    track: Track
    config: FurnitureConfig
    keep_out: list[tuple[float, float]] = field(default_factory=list)

    def wall(self, start: float, end: float, height: float, side: int) -> tuple[float, float]:
        """Nearest and furthest distance of the wall from the axis over a stretch, at a height over the sleepers, m."""
        offset = self._offset(height, side)
        step = self.bore.station[1]
        near = offset[int(start / step) : int(np.ceil(end / step)) + 1]
        return float(near.min()), float(near.max())

    @lru_cache(maxsize=64)  # noqa: B019 a place lives as long as it is furnished
    def _offset(self, height: float, side: int) -> Float[np.ndarray, " n"]:
        return wall_offset(self.bore, self.track.elevation + height - self.bore.position[:, 2], side)

    def barred(self, start: float, end: float) -> bool:
        """Whether a niche of the left wall lies in a stretch."""
        return any(start < last + 0.1 and first - 0.1 < end for first, last in self.keep_out)

    def box(
        self, kind: str, material: str, span: tuple[float, float], across: tuple[float, float], up: tuple[float, float]
    ) -> Piece:
        """A box between two stations, two distances to the left of the axis and two heights over the sleepers, m."""
        line = (self.bore.position[:, 0], self.bore.position[:, 1], self.track.elevation)
        foot = np.column_stack([np.interp(span, self.bore.station, values) for values in line])
        rotation = along(foot[0], foot[1])
        middle = foot.mean(axis=0) + rotation.apply([0, sum(across) / 2, sum(up) / 2])
        half = np.array([np.linalg.norm(foot[1] - foot[0]), across[1] - across[0], up[1] - up[0]]) / 2
        return Piece(kind, material, middle, rotation, half, low=up[0] < _ROBOT_HEIGHT)
