"""Things built into the bore, rings, bolt pockets, nails, sleepers, rails: its sizes, and its places."""

from dataclasses import dataclass, fields

import numpy as np


@dataclass(frozen=True)
class Sizes:
    """Sizes of one bore, m; the defaults are the design's."""

    gauge: float = 1.435  # Distance of the inner faces of the rail heads 14 to 16 mm below rail top.
    wear: float = 0.0  # Height that the rail heads have lost.
    pad: float = 0.010  # Thickness of the pads under the rails.
    track_aside: float = 0.0  # Middle of each track to the left of where the design puts it.
    ring_width: float = 1.5  # Distance of the ring joints. Source: Guangzhou line 21.
    pocket_length: float = 0.20  # Length of a pocket along the axis.
    pocket_depth: float = 0.13  # Mean depth of the pockets, along the normal of the section at a pocket's middle.
    pocket_offset: float = 0.22  # Distance of a pocket's middle from the ring joint.
    # What each of the eight rows of pockets is deeper than the mean; left and right rows differ.
    row_depth: tuple[float, ...] = (0.0,) * 8
    sleeper_spacing: float = 0.6  # Distance of the sleepers.
    sleeper_length: float = 2.50  # Length of a sleeper, across the track.
    sleeper_top: float = 0.20  # Width of a sleeper's top, along the track.


DESIGN = Sizes()
# Half of the range that a size is drawn from, m. Gauge, sleepers and the depth of pockets (8 to 16 cm, its middle by
# `_DEPTH_MIDDLE`): railway practice for new track and what linings show. The others are assumptions of ours.
TOLERANCE = {
    "gauge": 0.003, "pad": 0.002, "track_aside": 0.03, "ring_width": 0.003, "pocket_length": 0.02,
    "pocket_depth": 0.03, "pocket_offset": 0.02, "sleeper_spacing": 0.02, "sleeper_length": 0.05, "sleeper_top": 0.02,
}  # fmt: skip
WEAR = 0.004  # m; largest loss of height, about that between a CHN60 and a 60E1 rail
ROW_DEPTH = 0.01  # m
_DEPTH_MIDDLE = 0.12  # m


def draw_sizes(rng: np.random.Generator) -> Sizes:
    """Draws the sizes of a bore as built: each evenly within its tolerance, none of them the same left and right."""
    values = {}
    for size in fields(Sizes):
        if size.name in TOLERANCE:
            middle = _DEPTH_MIDDLE if size.name == "pocket_depth" else getattr(DESIGN, size.name)
            values[size.name] = round(float(middle + TOLERANCE[size.name] * rng.uniform(-1.0, 1.0)), 4)
    rows = np.round(rng.uniform(-ROW_DEPTH, ROW_DEPTH, len(DESIGN.row_depth)), 4)
    return Sizes(**values, wear=round(float(rng.uniform(0.0, WEAR)), 4), row_depth=tuple(rows.tolist()))


POCKET_WIDTH = 0.18  # m, along the girth
NAIL_DIAMETER = 0.028  # m
NAIL_DEPTH = 0.06  # m, axis of the nail behind the lining surface
POCKET_DEPTH_SIGMA = 0.01  # m, from pocket to pocket
FILLED_FRACTION = 0.05  # pockets missing: mortared flush
NAIL_MISSING_FRACTION = 0.03

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
    filled = rng.random((len(joints), N_ROWS, 2)) < FILLED_FRACTION
    depth = sizes.pocket_depth + POCKET_DEPTH_SIGMA * np.clip(rng.standard_normal(filled.shape), -3.0, 3.0)
    depth += np.asarray(sizes.row_depth)[None, :, None]
    nails = (rng.random((len(joints), N_ROWS)) >= NAIL_MISSING_FRACTION) & ~filled.any(axis=2)
    return Furniture(joints, pocketed, filled, depth, nails & pocketed[:, None], sleepers, sizes=sizes)
