"""Places of what is built into the bore: rings, bolt pockets, nails, sleepers, rails; and the sizes that never vary."""

from dataclasses import dataclass

import numpy as np

from scene.survey.sizes import DESIGN, Sizes

POCKET_WIDTH = 0.18  # m, along the girth
NAIL_DIAMETER = 0.028  # m
NAIL_DEPTH = 0.06  # m, axis of the nail behind the lining surface
POCKET_DEPTH_SIGMA = 0.01  # m, from pocket to pocket
FILLED_SHARE = 0.05  # pockets missing: mortared flush
NAIL_MISSING_SHARE = 0.03

SLEEPER_JITTER = 0.01  # m, standard deviation of each sleeper's station
SLEEPER_BOTTOM = 0.30  # m, along the track
SLEEPER_HEIGHT = 0.20  # m
SLEEPER_RISE = 0.06  # m, top of the sleeper above the floor (ballast surface); the rest is buried and not modelled

PAD = (0.18, 0.15)  # m: along, across
CLIP = (0.11, 0.09, 0.06)  # m: along, across, high
CLIP_INNER = 0.070  # m from the rail's axis to the near face of a clip, which so overlaps the foot by 5 mm

# Right half of a CHN60 rail without inclination, from the edge of the foot to the middle of the head: across, up, m.
# Height 176, foot 150, head 73, web 16.5 mm; the head's side is vertical through the gauge plane.
RAIL_HALF = 1e-3 * np.array([
    (75.0, 0.0), (75.0, 12.0), (30.0, 22.0), (8.25, 38.0), (8.25, 120.0), (35.0, 128.0), (36.5, 131.0),
    (36.5, 164.0), (33.0, 171.0), (22.0, 175.0), (8.0, 175.9),
])  # fmt: skip
RAIL_HEIGHT = 0.176  # m
_HEAD_WIDTH = 0.073  # m
_WORN = 0.150  # m above the foot: what lies higher of a worn head has come down


N_ROWS = 8  # longitudinal rows of pockets: four on the left side from the floor up, four on the right


@dataclass(frozen=True)
class Furniture:
    """The furniture of one bore."""

    joints: np.ndarray  # Stations of the ring joints, m `(r,)`; empty where the bore has no rings
    pocketed: np.ndarray  # Joints with pockets: those far enough from the mouths
    filled: np.ndarray  # Pockets mortared flush, by joint, row and side of the joint (before, after)
    depth: np.ndarray  # Depth of each pocket, m
    nails: np.ndarray  # Pairs that a nail bridges; false where a pocket is filled
    sleepers: np.ndarray  # Stations of the sleepers' middles, m
    tracks: tuple[float, ...] = (0.0,)  # Middles of the tracks to the left of the axis, m; empty where there is none
    rise: float = SLEEPER_RISE  # Top of the sleepers above the floor, m
    dark: tuple[float, float] = (0.0, 0.0)  # Stations between which the lining gives no echo, m
    sizes: Sizes = DESIGN  # Sizes as built

    @property
    def rail_height(self) -> float:
        """Height of the rails from foot to top, m."""
        return RAIL_HEIGHT - self.sizes.wear

    @property
    def rail_half(self) -> np.ndarray:
        """Right half of the rails' profile: across, up, m, `(11, 2)`."""
        return RAIL_HALF - np.where(RAIL_HALF[:, 1:] > _WORN, (0.0, self.sizes.wear), 0.0)

    @property
    def rail_axis(self) -> float:
        """Distance from a track's middle to the middle of a rail, m: half the gauge and half a head."""
        return 0.5 * (self.sizes.gauge + _HEAD_WIDTH)

    @property
    def rail_top(self) -> float:
        """Height of the rails' tops above the floor, m."""
        return self.rise + self.sizes.pad + self.rail_height


def draw_furniture(rng: np.random.Generator, length: float, rings: bool = True, sizes: Sizes = DESIGN) -> Furniture:
    """Draws the furniture of a bore of `length` m and such sizes, without rings, pockets and nails if not `rings`.

    The first joint and the first sleeper stand at drawn stations: whoever assumes that they start at a mouth is wrong.
    """
    joints = np.arange(rng.uniform(0.1, 1.4), length - 1e-3, sizes.ring_width)[: None if rings else 0]
    # Far enough from the mouths for the jitter, which ends at three standard deviations.
    sleepers = np.arange(rng.uniform(0.19, 0.44), length - 0.19, sizes.sleeper_spacing)
    sleepers = sleepers + SLEEPER_JITTER * np.clip(rng.standard_normal(len(sleepers)), -3.0, 3.0)
    reach = sizes.pocket_offset + 0.5 * sizes.pocket_length + 0.05
    pocketed = (joints > reach) & (joints < length - reach)
    filled = rng.random((len(joints), N_ROWS, 2)) < FILLED_SHARE
    depth = sizes.pocket_depth + POCKET_DEPTH_SIGMA * np.clip(rng.standard_normal(filled.shape), -3.0, 3.0)
    depth += np.asarray(sizes.row_depth)[None, :, None]
    nails = (rng.random((len(joints), N_ROWS)) >= NAIL_MISSING_SHARE) & ~filled.any(axis=2)
    return Furniture(joints, pocketed, filled, depth, nails & pocketed[:, None], sleepers, sizes=sizes)
