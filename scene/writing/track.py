"""Sleepers, rails, pads and fasteners: as the survey shows them, by standard where it does not, fitted to the bore."""

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d

from scene.bore import Bore
from scene.errors import FitError, Refusal
from scene.fitting.rails import SeenRails
from scene.fitting.trackseen import SeenLine, SeenTrack
from scene.geometry import wall_at

_FLAT = 0.10  # a bed this little above the lowest point of the bore is its floor
_SMOOTHING = 1.0  # m
_OTHER_PROFILE = 0.015  # m from the standard's rail height that a survey must show to be believed
_LEAST_RAIL = 0.08  # m
_BARE = 0.10  # m under a standard sleeper's top, where sleepers would be seen if there were any


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

    # Tracks that are laid: those that the survey shows, none, or one by standard on the axis.
    lay: Annotated[Literal["auto", "none", "standard"], tyro.conf.arg(name="")] = "auto"
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
class Line:
    """One track; arrays over the stations of the bore unless said otherwise."""

    gauge: float  # m
    gauge_measured: bool  # False where it is the standard's
    offset: Float[np.ndarray, " n"]  # Of the middle of the track to the left of the axis, m
    cant: Float[np.ndarray, " n"]  # Rise of the left rail over the right one, m
    seat: Float[np.ndarray, " n"]  # z of the top of the sleepers in the middle of the track, m
    rail_height: float  # From the top of the sleepers to that of the rails, m
    footing: float  # What stands under the rails where no sleepers do, m
    # Stations of the sleepers, m; empty where the floor is seen between the rails, and no sleeper
    sleeper_station: Float[np.ndarray, " k"]
    measured: Bool[np.ndarray, " k"]  # Sleepers that the survey shows; the others lie where the spacing asks for one
    clearance: Float[np.ndarray, " k"]  # Distance of each sleeper's nearer end to the wall, m
    left_out: int = 0  # Sleepers between seen rails that would come nearer to a wall than the margin

    def rail_offset(self, rail: RailProfile) -> float:
        """Distance from the middle of the track to that of a rail's head, m; the gauge itself is face to face."""
        return (self.gauge + rail.head_width) / 2


@dataclass(frozen=True)
class Track:
    """The tracks of one bore."""

    config: TrackConfig  # Standard by which they were laid
    bed: Float[np.ndarray, " n"]  # z of the ballast or slab at each station of the bore, m
    elevation: Float[np.ndarray, " n"]  # z of the top of the sleepers, of the floor where there are none, m
    lines: tuple[Line, ...]  # The tracks, from the right to the left
    raised: bool  # True where the bed is a slab above the floor (a round bore)
    why: str = ""  # Reason for which there is no track; empty where there is one

    @property
    def sleeper_station(self) -> Float[np.ndarray, " k"]:
        """Stations of the sleepers of all tracks, one track after another, m."""
        return np.concatenate([np.empty(0), *(line.sleeper_station for line in self.lines)])

    @property
    def measured(self) -> Bool[np.ndarray, " k"]:
        """True for the sleepers that the survey shows."""
        return np.concatenate([np.empty(0, bool), *(line.measured for line in self.lines)])

    @property
    def clearance(self) -> Float[np.ndarray, " k"]:
        """Distance of each sleeper's nearer end to the wall, m."""
        return np.concatenate([np.empty(0), *(line.clearance for line in self.lines)])


def lay_track(bore: Bore, config: TrackConfig, seen: SeenTrack | None = None) -> Track:
    """Lays the tracks on the flat floor, or one on a bed just wide enough where the bore is round.

    Rails and sleepers that the survey shows are taken as they lie, and stand out as far as they do; without `seen` all
    is by standard. Each sleeper is checked against the wall at its level on both sides: one that would come nearer than
    the margin is left out between rails that the survey shows, whose sleepers are not as long as the standard's;
    without such rails it raises `FitError`.
    """
    if config.gauge + 2.0 * config.rail.head_width > config.sleeper_length:
        why = f"a gauge of {config.gauge:g} m puts the rails beyond the ends of sleepers of {config.sleeper_length:g} m"
        raise FitError(f"{why}; --track.sleeper-length sets those", Refusal.TRACK)
    half_width = config.sleeper_length / 2 + config.shoulder
    floor = bore.position[:, 2] - bore.toward(-np.pi / 2) * bore.up[:, 2]
    chord = bore.position[:, 2] + _lowest_chord(bore, half_width)
    sought = config.lay == "auto" and seen is not None and seen.sought
    lines = seen.lines if seen is not None and sought else (SeenLine(None, None),)
    shown = sought and bool(lines)
    raised = not shown and bool(np.median(chord - floor) > _FLAT)
    bed = chord if raised else floor
    sigma = _SMOOTHING / (bore.station[1] - bore.station[0])
    smooth = gaussian_filter1d(bed, sigma, mode="nearest")
    why = ""
    if config.lay == "none":
        why = "none: as asked for"
    elif sought and not lines:
        why = "none: the survey shows no rails"
    elif config.lay == "auto" and seen is not None and not sought:
        why = "none: the survey can show no rails"
    elif np.median(floor + bore.height - bed) < config.min_headroom and not shown:
        why = "none: the bore is too low for it"
    if why:
        level = gaussian_filter1d(floor, sigma, mode="nearest")
        return Track(config, level, level, (), False, why)
    if shown and lines[0].sleepers is not None:
        config = replace(config, protrusion=lines[0].sleepers.protrusion)
    laid = tuple(_lay_line(bore, config, smooth, line) for line in lines)
    seats = [line.seat for line in laid if len(line.sleeper_station)]
    return Track(config, smooth, seats[0] if len(seats) == 1 else np.mean(seats or [smooth], axis=0), laid, raised)


def _lay_line(bore: Bore, config: TrackConfig, bed: np.ndarray, seen: SeenLine) -> Line:
    rails, sleepers, count = seen.rails, seen.sleepers, len(bore.station)
    station = np.arange(int(bore.length / config.sleeper_spacing + 1e-6) + 1) * config.sleeper_spacing
    measured, protrusion = np.zeros(len(station), bool), config.protrusion
    standard = rail_height = config.pad_thickness + config.rail.height
    footing = 0.0
    if sleepers is not None:
        station, measured, protrusion = sleepers.station, sleepers.measured, sleepers.protrusion
        if rails is not None and abs(rails.top - protrusion - standard) > _OTHER_PROFILE:
            rail_height = max(rails.top - protrusion, _LEAST_RAIL)
    elif rails is not None:
        protrusion = max(rails.top - standard, 0.0)
        if protrusion - seen.bed > _BARE:  # where sleepers would lie, the survey shows nothing
            station, measured, footing = station[:0], measured[:0], protrusion
    offset, cant = np.zeros(count), np.zeros(count)
    if rails is not None:
        offset = rails.offset_at(bore.station)
        cant = np.interp(bore.station, rails.station, rails.cant)
    seat = bed + protrusion
    level = seat - bore.position[:, 2]
    nearer = np.minimum(wall_offset(bore, level, 1) - offset, wall_offset(bore, level, -1) + offset)
    clearance = nearer[bore.row_of(station)] - config.sleeper_length / 2
    fits = clearance >= config.margin
    if not fits.all() and rails is None:
        worst = int(np.argmin(clearance))
        raise FitError(
            f"the sleeper at {station[worst]:.1f} m comes within {clearance[worst]:.2f} m of the wall; "
            f"{config.margin:g} m are needed; `--track none` lays no track",
            Refusal.TRACK,
        )
    known = rails is not None and rails.measured
    gauge = rails.gauge if rails is not None and known else config.gauge
    if not fits.any():
        footing = protrusion
    return Line(
        gauge, known, offset, cant, seat, rail_height, footing,
        station[fits], measured[fits], clearance[fits], int((~fits).sum()),
    )  # fmt: skip


def _lowest_chord(bore: Bore, half_width: float) -> np.ndarray:
    """Lowest height above the axis, m, at which both walls are at least `half_width` away; 0 where none is."""
    down = -bore.toward(-np.pi / 2)
    levels = np.zeros(len(bore.station))
    for row in range(len(bore.station)):
        grid = np.linspace(down[row], 0.0, 300)
        outline = bore.radius[row] * np.cos(bore.angle), bore.radius[row] * np.sin(bore.angle)
        narrow = np.minimum(wall_at(1, *outline, grid), -wall_at(-1, *outline, grid))
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
    fraction = np.where(crosses, (level - upward) / np.where(crosses, next_upward - upward, 1.0), 0.0)
    return np.where(crosses, across + fraction * (next_across - across), 0.0).max(axis=1)


def describe_track(track: Track, seen: SeenTrack) -> dict[str, Any]:
    """Return what the manifest says of the tracks: of the first one, then of each in `lines`."""
    shown = seen.lines if len(seen.lines) == len(track.lines) else (SeenLine(None, None),) * len(track.lines)
    lines = [_describe_line(line, of.rails) for line, of in zip(track.lines, shown, strict=True)]
    first: dict[str, Any] = lines[0] if lines else {}
    laid = track.why or ("as the survey shows it" if any(of.rails or of.sleepers for of in shown) else "by standard")
    return {
        "lay": track.config.lay, "laid": laid,
        "least_clearance": float(track.clearance.min()) if len(track.clearance) else None, "slab": track.raised,
        "sleepers_seen": int(track.measured.sum()),
        "protrusion": track.config.protrusion if len(track.sleeper_station) else None, "gauge": first.get("gauge"),
        "gauge_seen": first.get("gauge_seen"), "gauge_spread": first.get("gauge_spread"),
        "rail_top_seen": first.get("rail_top_seen"), "lines": lines,
    }  # fmt: skip


def _describe_line(line: Line, rails: SeenRails | None) -> dict[str, Any]:
    known = rails is not None and rails.measured
    return {
        "gauge": line.gauge, "gauge_from": "measured" if line.gauge_measured else "by standard",
        "gauge_seen": rails.gauge if rails is not None and known else None,
        "gauge_spread": rails.spread if rails is not None and known else None,
        "gauge_pieces": rails.stretches if rails is not None else 0,
        "rail_top_seen": rails.top if rails is not None else None, "rail_height": line.rail_height,
        "offset": [float(line.offset.min()), float(line.offset.max())], "cant_mean": float(np.mean(line.cant)),
        "cant_spread": float(np.std(line.cant)), "cant_from": "measured" if rails is not None else "by standard",
        "sleepers": len(line.sleeper_station), "sleepers_seen": int(line.measured.sum()),
        "sleepers_left_out": line.left_out,
    }  # fmt: skip


def track_provenance(track: Track, seen: SeenTrack) -> dict[str, str]:
    """Return how each asset of the track came about, for the manifest."""
    if not track.lines:
        return {"track": track.why}
    sleepers = "measured" if track.measured.any() else "by standard"
    shown = seen.sought and any(line.rails for line in seen.lines) and track.config.lay == "auto"
    gauge = "gauge measured" if any(line.gauge_measured for line in track.lines) else "gauge by standard"
    return {
        "sleepers": sleepers if len(track.sleeper_station) else "none: the floor is seen between the rails",
        "rails": f"profile by standard, place measured, {gauge}" if shown else "by standard",
        "fasteners": "by standard" if len(track.sleeper_station) else "none",
    }
