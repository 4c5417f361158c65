"""Sleepers, rails, pads and fasteners, placed by standard and checked against the bore."""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d

from scene.bore import Bore
from scene.errors import FitError
from scene.fitting.trackseen import SeenSleepers

_FLAT = 0.10  # a bed this little above the lowest point of the bore is its floor
_SMOOTHING = 1.0  # m


@dataclass(frozen=True)
class RailProfile:
    """A flat-bottom rail, m.

    Source: CHN60 (GB 2585): height, foot and head from suppliers' tables; web and head depth are engineering knowledge.
    """

    name: str = "CHN60"
    height: float = 0.176
    foot_width: float = 0.150
    foot_height: float = 0.012
    web_width: float = 0.0165
    head_width: float = 0.073
    head_height: float = 0.0485


@dataclass(frozen=True)
class TrackConfig:
    """Standard-gauge track on concrete monoblock sleepers, m."""

    gauge: float = 1.435  # Distance of the inner faces of the heads. Source: the paper and every standard.
    sleeper_spacing: float = 0.6  # Spacing of the sleepers. Source: the paper.
    sleeper_length: float = 2.5  # Length of a sleeper. Source: suppliers' tables for standard gauge.
    sleeper_top: float = 0.20  # Width of the top; the bottom is `sleeper_bottom` wide.
    sleeper_bottom: float = 0.30  # Width of the bottom.
    sleeper_height: float = 0.21  # Height of a sleeper; all but `protrusion` lies in the ballast.
    protrusion: float = 0.06  # Height of the sleepers above the bed.
    pad_thickness: float = 0.010  # Thickness of the pad between sleeper and rail foot.
    margin: float = 0.10  # Least distance from the end of a sleeper to the wall.
    shoulder: float = 0.35  # Bed left beside the sleepers where the bore is round.
    min_headroom: float = 3.0  # No track is laid where less is left between bed and crown.
    rail: RailProfile = field(default_factory=RailProfile)  # The rail.

    @property
    def rail_offset(self) -> float:
        """Distance from the axis to the middle of a rail's head; the gauge itself is face to face."""
        return (self.gauge + self.rail.head_width) / 2


@dataclass(frozen=True)
class Track:
    """The track of one bore."""

    config: TrackConfig  # Standard by which it was laid
    bed: Float[np.ndarray, " n"]  # z of the ballast or slab at each station of the bore, m
    elevation: Float[np.ndarray, " n"]  # z of the top of the sleepers, of the floor where there is no track, m
    sleeper_station: Float[np.ndarray, " k"]  # m; empty where the bore is too narrow for a track
    # Sleepers that the survey shows; the others lie where the spacing asks for one
    measured: Bool[np.ndarray, " k"]
    clearance: Float[np.ndarray, " k"]  # Distance of each sleeper's nearer end to the wall, m
    raised: bool  # True where the bed is a slab above the floor (a round bore)


def lay_track(bore: Bore, config: TrackConfig, seen: SeenSleepers | None = None) -> Track:
    """Lays the track on the flat floor, or on a bed just wide enough where the bore is round.

    Sleepers that the survey shows are taken as they lie, and stand out as far as they do. Raises `FitError` where a
    sleeper would come closer to the wall than the margin.
    """
    half_width = config.sleeper_length / 2 + config.shoulder
    floor = bore.position[:, 2] - _radius_down(bore) * bore.up[:, 2]
    chord = bore.position[:, 2] + _lowest_chord(bore, half_width)
    raised = bool(np.median(chord - floor) > _FLAT)
    bed = chord if raised else floor
    sigma = _SMOOTHING / (bore.station[1] - bore.station[0])
    smooth = gaussian_filter1d(bed, sigma, mode="nearest")
    if np.median(floor + bore.height - bed) < config.min_headroom:
        level = gaussian_filter1d(floor, sigma, mode="nearest")
        return Track(config, level, level, np.empty(0), np.empty(0, bool), np.empty(0), False)
    if seen is None:
        station = np.arange(int(bore.length / config.sleeper_spacing + 1e-6) + 1) * config.sleeper_spacing
        measured = np.zeros(len(station), bool)
    else:
        station, measured, config = seen.station, seen.measured, replace(config, protrusion=seen.protrusion)
    elevation = smooth + config.protrusion
    level = elevation - bore.position[:, 2]
    nearer = np.minimum(wall_offset(bore, level, 1), wall_offset(bore, level, -1))
    row = np.clip(np.rint(station / bore.station[1]).astype(int), 0, len(bore.station) - 1)
    clearance = nearer[row] - config.sleeper_length / 2
    if (clearance < config.margin).any():
        worst = int(np.argmin(clearance))
        raise FitError(
            f"the sleeper at {station[worst]:.1f} m comes within {clearance[worst]:.2f} m of the wall; "
            f"{config.margin:g} m are needed"
        )
    return Track(config, smooth, elevation, station, measured, clearance, raised)


def _radius_down(bore: Bore) -> np.ndarray:
    return np.array([np.interp(-np.pi / 2, bore.angle, radius, period=2 * np.pi) for radius in bore.radius])


def _wall_at(bore: Bore, row: int, height: float | np.ndarray, side: int) -> np.ndarray:
    """Distance from the axis to the wall on one side at a height above the axis, m."""
    across, upward = side * bore.radius[row] * np.cos(bore.angle), bore.radius[row] * np.sin(bore.angle)
    half = across > 0
    order = np.argsort(upward[half], kind="stable")
    return np.interp(height, upward[half][order], across[half][order])


def _lowest_chord(bore: Bore, half_width: float) -> np.ndarray:
    """Lowest height above the axis, m, at which both walls are at least `half_width` away; 0 where none is."""
    down = -_radius_down(bore)
    levels = np.zeros(len(bore.station))
    for row in range(len(bore.station)):
        grid = np.linspace(down[row], 0.0, 300)
        narrow = np.minimum(_wall_at(bore, row, grid, 1), _wall_at(bore, row, grid, -1))
        wide = np.flatnonzero(narrow >= half_width)
        levels[row] = grid[wide[0]] if len(wide) else 0.0
    return levels


def wall_offset(bore: Bore, level: Float[np.ndarray, " n"], side: int) -> Float[np.ndarray, " n"]:
    """Return the distance from the axis to the wall, m, `level` m above the axis at each station.

    0 where the bore is not that high.
    """
    across, upward = side * bore.radius * np.cos(bore.angle), bore.radius * np.sin(bore.angle)
    level = level[:, None]
    next_across, next_upward = np.roll(across, -1, axis=1), np.roll(upward, -1, axis=1)
    crosses = (upward < level) != (next_upward < level)
    share = np.where(crosses, (level - upward) / np.where(crosses, next_upward - upward, 1.0), 0.0)
    return np.where(crosses, across + share * (next_across - across), 0.0).max(axis=1)
