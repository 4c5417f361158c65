"""What is built into the bore: rings, bolt pockets, nails, sleepers, rails. Sizes and where they stand."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

RING_WIDTH = 1.5  # m [track.md A5: Guangzhou line 21]
POCKET_LENGTH = 0.20  # m, along the axis
POCKET_WIDTH = 0.18  # m, along the girth
POCKET_DEPTH = 0.13  # m, along the normal of the section at the pocket's middle
POCKET_OFFSET = 0.22  # m from the ring joint to the middle of a pocket
NAIL_DIAMETER = 0.028  # m
NAIL_DEPTH = 0.06  # m, axis of the nail behind the lining surface
FILLED_SHARE = 0.04  # pockets mortared flush
NAIL_MISSING_SHARE = 0.03

SLEEPER_SPACING = 0.6  # m
SLEEPER_LENGTH = 2.50  # m, across the track
SLEEPER_TOP = 0.20  # m, along the track
SLEEPER_BOTTOM = 0.30  # m, along the track
SLEEPER_HEIGHT = 0.20  # m
SLEEPER_RISE = 0.06  # m, top of the sleeper above the floor (ballast surface); the rest is buried and not modelled

PAD = (0.18, 0.15, 0.010)  # m: along, across, thick
CLIP = (0.11, 0.09, 0.06)  # m: along, across, high
CLIP_INNER = 0.070  # m from the rail's axis to the near face of a clip, which so overlaps the foot by 5 mm
GAUGE = 1.435  # m, between the inner faces of the rail heads 14 to 16 mm below rail top

# Right half of a CHN60 rail without inclination, from the edge of the foot to the middle of the head: across, up, m.
# Height 176, foot 150, head 73, web 16.5 mm; the head's side is vertical through the gauge plane.
RAIL_HALF = 1e-3 * np.array(
    [
        (75.0, 0.0),
        (75.0, 12.0),
        (30.0, 22.0),
        (8.25, 38.0),
        (8.25, 120.0),
        (35.0, 128.0),
        (36.5, 131.0),
        (36.5, 164.0),
        (33.0, 171.0),
        (22.0, 175.0),
        (8.0, 175.9),
    ]
)
RAIL_HEIGHT = 0.176  # m
RAIL_AXIS = 0.5 * (GAUGE + 0.073)  # m from the track's axis to the rail's: half the gauge and half a head
RAIL_TOP = SLEEPER_RISE + PAD[2] + RAIL_HEIGHT  # m above the floor


@dataclass(frozen=True)
class Row:
    """A longitudinal row of pockets.

    Attributes:
        side: +1 left, -1 right.
        on: The part of the section that it runs along.
        at: Middle of the row: height above the floor, m, on the wall; angle above the springing, rad, on the crown.
    """

    side: int
    on: Literal["wall", "crown"]
    at: float


WALL_ROWS = (SLEEPER_RISE + 0.70, 2.20)  # m above the floor; the first is 0.70 m above the sleepers
CROWN_ROWS = (float(np.deg2rad(35.0)), float(np.deg2rad(70.0)))  # rad above the springing, about the crown's centre
_PLACES: tuple[tuple[Literal["wall", "crown"], tuple[float, ...]], ...] = (("wall", WALL_ROWS), ("crown", CROWN_ROWS))
ROWS = tuple(Row(side, on, at) for side in (1, -1) for on, places in _PLACES for at in places)


@dataclass(frozen=True)
class Furniture:
    """Where the furniture of one bore stands.

    Attributes:
        joints: Stations of the ring joints, m `(r,)`.
        pocketed: Which joints have pockets: those far enough from the mouths `(r,)`.
        filled: Pockets mortared flush, by joint, row of `ROWS` and side of the joint (before, after) `(r, k, 2)`.
        nails: Whether a nail bridges the pair; false wherever a pocket is filled `(r, k)`.
        sleepers: Stations of the sleepers' middles, m `(t,)`.
    """

    joints: np.ndarray
    pocketed: np.ndarray
    filled: np.ndarray
    nails: np.ndarray
    sleepers: np.ndarray


def draw_furniture(rng: np.random.Generator, length: float) -> Furniture:
    """Draw the furniture of a bore of `length` m.

    The first joint and the first sleeper stand at drawn stations: whoever assumes that they start at a mouth is wrong.
    """
    joints = np.arange(rng.uniform(0.1, 1.4), length - 1e-3, RING_WIDTH)
    sleepers = np.arange(rng.uniform(0.16, 0.44), length - 0.16, SLEEPER_SPACING)
    reach = POCKET_OFFSET + 0.5 * POCKET_LENGTH + 0.05
    pocketed = (joints > reach) & (joints < length - reach)
    filled = rng.random((len(joints), len(ROWS), 2)) < FILLED_SHARE
    nails = (rng.random((len(joints), len(ROWS))) >= NAIL_MISSING_SHARE) & ~filled.any(axis=2)
    return Furniture(joints, pocketed, filled, nails & pocketed[:, None], sleepers)
