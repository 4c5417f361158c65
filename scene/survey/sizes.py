"""Sizes of track, rings and pockets: as designed, or as a site builds them, within tolerances."""

from dataclasses import dataclass, fields

import numpy as np


@dataclass(frozen=True)
class Sizes:
    """Sizes of one bore, m; the defaults are the design's.

    Attributes:
        gauge: Distance of the inner faces of the rail heads 14 to 16 mm below rail top.
        wear: Height that the rail heads have lost.
        pad: Thickness of the pads under the rails.
        track_aside: Middle of each track to the left of where the design puts it.
        ring_width: Distance of the ring joints. Source: Guangzhou line 21.
        pocket_length: Length of a pocket along the axis.
        pocket_depth: Mean depth of the pockets, along the normal of the section at a pocket's middle.
        pocket_offset: Distance of a pocket's middle from the ring joint.
        row_depth: What each of the eight rows of pockets is deeper than the mean; left and right rows differ.
        sleeper_spacing: Distance of the sleepers.
        sleeper_length: Length of a sleeper, across the track.
        sleeper_top: Width of a sleeper's top, along the track.
    """

    gauge: float = 1.435
    wear: float = 0.0
    pad: float = 0.010
    track_aside: float = 0.0
    ring_width: float = 1.5
    pocket_length: float = 0.20
    pocket_depth: float = 0.13
    pocket_offset: float = 0.22
    row_depth: tuple[float, ...] = (0.0,) * 8
    sleeper_spacing: float = 0.6
    sleeper_length: float = 2.50
    sleeper_top: float = 0.20


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
