"""Every return against the model: its place about the axis, and its distance from the wall that was built."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from scene.bore import Bore
from scene.cloud import Cloud
from scene.writing.track import Track

EXPLAINED, INSIDE, BEHIND, BEYOND = range(4)
_CHUNK = 500_000  # points; bounds the memory
_NEAR = 0.8  # of the tolerance: returns that are radially closer than this are on the wall
_FURTHEST = 0.8  # m from the wall; the distance of returns further off is taken along the radius
_PIECES = 20  # directions to each side in which the nearest piece of wall is looked for


@dataclass(frozen=True)
class TrackZone:
    """The space that a laid track fills: returns in it are the track's, whatever their distance from the floor."""

    half_width: float  # Half the length of a sleeper, m
    top: Float[np.ndarray, " n"]  # Height of the rails' tops above the axis at each station of the bore, m


def track_zone(track: Track, bore: Bore) -> TrackZone | None:
    """Return the space between the ends of the sleepers, up to the rails' tops; `None` without a track."""
    if not track.lines:
        return None
    widest = max(float(np.abs(line.offset).max()) for line in track.lines) + track.config.sleeper_length / 2
    top = np.max([line.seat + line.rail_height for line in track.lines], axis=0)
    return TrackZone(widest, top - bore.position[:, 2])


@dataclass(frozen=True)
class Returns:
    """Returns by their place about the axis of a bore."""

    station: Float[np.ndarray, " p"]  # m; below 0 and above the length beyond the ends
    lateral: Float[np.ndarray, " p"]  # To the left of the axis, m
    upward: Float[np.ndarray, " p"]  # Above the axis, m
    angle: Float[np.ndarray, " p"]  # Direction from the axis, rad
    outward: Float[np.ndarray, " p"]  # Distance behind the wall, m; negative inside
    kind: Int[np.ndarray, " p"]  # `EXPLAINED`, `INSIDE`, `BEHIND` or `BEYOND`
    weight: Float[np.ndarray, " p"]  # Returns that each point stands for

    @property
    def in_span(self) -> Bool[np.ndarray, " p"]:
        """True for returns between the ends of the bore."""
        return self.kind != BEYOND

    def share(self, kind: int) -> float:
        """Return the share of one kind in all returns, `BEYOND`, or in those between the ends, the others."""
        rows = np.ones(len(self.kind), bool) if kind == BEYOND else self.in_span
        total = float(self.weight[rows].sum())
        return float(self.weight[self.kind == kind].sum()) / total if total else 0.0


def compare_returns(bore: Bore, cloud: Cloud, tolerance: float, track: TrackZone | None = None) -> Returns:
    """Compares every point of a cloud in the bore's frame with the wall, the pockets and the track of a bore.

    Returns are explained up to `tolerance` from the model, m; further than that beyond an end they are `BEYOND`. The
    rows are those of the cloud.
    """
    parts = [
        _compare(bore, cloud.points[k : k + _CHUNK].astype(np.float64), tolerance, track)
        for k in range(0, max(len(cloud.points), 1), _CHUNK)
    ]
    station, lateral, upward, angle, outward, kind = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Returns(station, lateral, upward, angle, outward, kind, cloud.weights.astype(np.float64))


def _compare(bore: Bore, points: np.ndarray, tolerance: float, track: TrackZone | None) -> tuple[np.ndarray, ...]:
    station, lateral, upward = bore.axis.local(points)
    angle = np.arctan2(upward, lateral)
    outward = np.hypot(lateral, upward) - wall_radius(bore, station, angle)
    beyond = (station < -tolerance) | (station > bore.length + tolerance)
    far = np.flatnonzero(~beyond & (np.abs(outward) > _NEAR * tolerance) & (np.abs(outward) < _FURTHEST))
    outward[far] = np.copysign(_distance_to_section(bore, station[far], lateral[far], upward[far]), outward[far])
    kind = np.where(np.abs(outward) <= tolerance, EXPLAINED, np.where(outward > 0, BEHIND, INSIDE))
    kind[kind == BEHIND] = np.where(
        _in_pockets(bore, station, angle, outward, tolerance)[kind == BEHIND], EXPLAINED, BEHIND
    )
    if track is not None:
        row = bore.row_of(station)
        low = (np.abs(lateral) < track.half_width + tolerance) & (upward < track.top[row] + tolerance)
        kind[low & (kind == INSIDE)] = EXPLAINED
    kind[beyond] = BEYOND
    return station, lateral, upward, angle, outward, kind


def wall_radius(bore: Bore, station: np.ndarray, angle: np.ndarray) -> Float[np.ndarray, " p"]:
    """Return the distance from the axis to the wall at places about it, m; the ends hold beyond them."""
    columns = len(bore.angle)
    row = np.clip(station / bore.station[1], 0, len(bore.station) - 1)
    low = np.minimum(row.astype(np.intp), len(bore.station) - 2)
    share = row - low
    column = (angle - bore.angle[0]) / (2 * np.pi) * columns % columns
    left = np.floor(column).astype(np.intp) % columns
    right, part = (left + 1) % columns, column - np.floor(column)
    before = (1 - part) * bore.radius[low, left] + part * bore.radius[low, right]
    after = (1 - part) * bore.radius[low + 1, left] + part * bore.radius[low + 1, right]
    return (1 - share) * before + share * after


def _distance_to_section(
    bore: Bore, station: np.ndarray, lateral: np.ndarray, upward: np.ndarray
) -> Float[np.ndarray, " p"]:
    """Distance to the nearest piece of the section's outline, m: near a corner the radius alone overstates it."""
    columns = len(bore.angle)
    row = bore.row_of(station)
    left = np.floor((np.arctan2(upward, lateral) - bore.angle[0]) / (2 * np.pi) * columns).astype(np.intp)
    least = np.full(len(station), np.inf)
    for step in range(-_PIECES, _PIECES + 1):
        ends = []
        for column in ((left + step) % columns, (left + step + 1) % columns):
            radius = bore.radius[row, column]
            ends.append((radius * np.cos(bore.angle[column]), radius * np.sin(bore.angle[column])))
        (y, z), (y1, z1) = ends
        dy, dz = y1 - y, z1 - z
        along = ((lateral - y) * dy + (upward - z) * dz) / np.maximum(dy**2 + dz**2, 1e-12)
        along = np.clip(along, 0.0, 1.0)
        least = np.minimum(least, np.hypot(lateral - y - along * dy, upward - z - along * dz))
    return least


def _in_pockets(
    bore: Bore, station: np.ndarray, angle: np.ndarray, outward: np.ndarray, tolerance: float
) -> Bool[np.ndarray, " p"]:
    """True for returns in a recess of the lining, or within the tolerance of one."""
    result = np.zeros(len(station), bool)
    pocket = bore.pocket
    rows = np.flatnonzero((outward > tolerance) & (outward < 2.0))
    if not len(pocket) or not len(rows):
        return result
    across = float(np.median(bore.radius))
    place = np.column_stack([pocket["station"], across * pocket["angle"]])
    reach = float(np.hypot(pocket["length"].max(), pocket["width"].max())) / 2 + tolerance
    turn = 2 * np.pi * across
    tree = cKDTree(np.concatenate([place + np.array([0.0, shift]) for shift in (-turn, 0.0, turn)]))
    distance, nearest = tree.query(np.column_stack([station[rows], across * angle[rows]]), distance_upper_bound=reach)
    near = np.isfinite(distance)
    own = pocket[nearest[near] % len(pocket)]
    result[rows[near]] = outward[rows[near]] < own["depth"] + tolerance
    return result
