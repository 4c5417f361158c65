"""Unrolled maps: how far the candidate's surface lies from held-out points or truth, by station and angle."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from benchmarks.fidelity.case import Case, kept_until, per_case, per_hold, per_truth
from benchmarks.fidelity.derive import curve as curves
from benchmarks.fidelity.derive.beams import cast_beams, observed_extent, returns, sensor_path
from benchmarks.fidelity.derive.sections import truth_bore_caster
from benchmarks.fidelity.derive.surface import Caster, visible_parts
from benchmarks.fidelity.meshes import concatenate_meshes

CELL = 0.5  # m along the tunnel
SECTORS = 72  # cells around it, of 5 degrees
CAP = 0.5  # m; larger offsets count as this
LEAST = 4  # returns that make a cell known
FINE = 0.05  # m along the tunnel between rays of a relief
COLUMNS = 216  # rays of a relief around the tunnel
ANGLES = curves.section_angles(COLUMNS)
TRACK = ("sleeper", "rail", "fastening")  # parts of a candidate that are no bore
TRACK_SIDE = np.deg2rad(50.0)  # from straight down: what lies there may be track
_STEEPEST = np.cos(np.deg2rad(80.0))  # beams that graze more steeply say little about where a surface is
_BORE = 0.5  # share of a cell's returns off the candidate's track from which on it shows the bore
_MOUTH = 0.5  # m at the mouths that the truth's rays leave out


@dataclass(frozen=True)
class Unrolled:
    """Radius of the reference about the middle of its section, and what the candidate's surface lies beyond it."""

    curve: curves.Curve  # Curve that stations count along
    middle: tuple[float, float]  # Middle of the section to the left of and above the curve, m
    low: float  # Station where the first cells begin, m
    radius: Float[np.ndarray, "n m"]  # Median radius of the reference, m; NaN where it is not known
    offset: Float[np.ndarray, "n m"]  # Median offset of the candidate, m, outward positive; NaN where it is not known

    def place(self, station: float) -> Float[np.ndarray, "3"]:
        """Return the middle of the section at a station, tunnel frame, m."""
        return self.curve.point(np.array([[station, *self.middle]]))[0]


def is_floor(angle: Float[np.ndarray, "*shape"]) -> Bool[np.ndarray, "*shape"]:
    """Return True for directions in which track may lie."""
    return np.cos(angle + np.pi / 2) > np.cos(TRACK_SIDE)


# By the held-out recording.


@dataclass(frozen=True)
class Frame:
    """Held-out returns about the middle of the section, along the sensor's path."""

    local: Float[np.ndarray, "n 3"]  # Station along the path, left and up of the section's middle, m
    angle: Float[np.ndarray, " n"]  # Angle about the middle from left towards up, rad
    middle: tuple[float, float]  # Middle of the section to the left of and above the path, m
    low: float  # low, high: Stations between which returns lie, m
    high: float
    cell: Int[np.ndarray, " n"]  # Number of the cell of each return; -1 outside these stations

    @property
    def rows(self) -> int:
        """Number of cells along the tunnel."""
        return max(int((self.high - self.low) / CELL), 1)


@per_hold
def hold_frame(case: Case) -> Frame:
    """Return the frame of the held-out returns; the middle lies half way between their extremes, strays left out."""
    low, high = observed_extent(case)
    local = returns(case).local.copy()
    inside = (local[:, 0] > low) & (local[:, 0] < high)
    middle = np.percentile(local[inside, 1:], [0.5, 99.5], axis=0).mean(axis=0)
    local[:, 1:] -= middle
    angle = np.arctan2(local[:, 2], local[:, 1])
    row = np.floor((local[:, 0] - low) / CELL).astype(int)
    column = ((angle + np.pi) / (2.0 * np.pi) * SECTORS).astype(int) % SECTORS
    cell = np.where((row >= 0) & (row < max(int((high - low) / CELL), 1)), row * SECTORS + column, -1)
    return Frame(local, angle, (float(middle[0]), float(middle[1])), low, high, cell)


@kept_until("LIN", per_case)
def beam_offsets(case: Case) -> Float[np.ndarray, " n"]:
    """Return the offset of the candidate's surface along its normal at each return, m; NaN where a beam only grazes it.

    Positive where the candidate lies beyond the return. A beam that leaves the candidate counts as `CAP`.
    """
    cast = cast_beams(case)
    offset = np.where(cast.hit, np.where(cast.hit, cast.difference, 0.0) * cast.cosine, CAP)
    return np.where(~cast.hit | (cast.cosine > _STEEPEST), np.clip(offset, -CAP, CAP), np.nan)


@kept_until("LIN", per_case)
def parts_hit(case: Case) -> np.ndarray:
    """Return the name of the candidate's part that each beam meets; empty where it meets nothing, `(n,)`."""
    face = cast_beams(case).face
    return np.where(face >= 0, visible_parts(case.candidate)[face], "")


@per_case
def hold_map(case: Case) -> Unrolled:
    """Return the map against the held-out returns; those on the candidate's track are left out.

    A cell that shows mostly track is not known: its other returns are those that miss an edge of the track by a hair,
    and met far behind it.
    """
    frame, offset = hold_frame(case), beam_offsets(case)
    shape = (frame.rows, SECTORS)
    off_track = ~np.isin(parts_hit(case), TRACK)
    inside = frame.cell >= 0
    count = np.bincount(frame.cell[inside], minlength=shape[0] * shape[1])
    free = np.bincount(frame.cell[inside & off_track], minlength=shape[0] * shape[1])
    off_track &= (free >= _BORE * count)[frame.cell]

    def medians(rows: np.ndarray, values: np.ndarray) -> np.ndarray:
        return curves.grouped_median(frame.cell[rows], values[rows], shape[0] * shape[1], LEAST).reshape(shape)

    known = inside & off_track
    radius = medians(known, np.hypot(frame.local[:, 1], frame.local[:, 2]))
    return Unrolled(sensor_path(case), frame.middle, frame.low, radius, medians(known & np.isfinite(offset), offset))


# By the truth.


@dataclass(frozen=True)
class Relief:
    """Radii of one surface about a curve: rows every `FINE` metres, columns every `COLUMNS`-th of a turn."""

    station: Float[np.ndarray, " n"]  # m
    radius: Float[np.ndarray, "n m"]  # m; NaN where a ray meets nothing


@kept_until("LIN", per_case)
def bore_caster(case: Case) -> Caster:
    """Return the caster of rays into lining, bed and further bodies of the candidate, without its track."""
    one = case.candidate
    return Caster(concatenate_meshes([part for part in (one.lining, one.bed, one.extra) if len(part.faces)]))


@per_truth
def truth_relief(case: Case) -> Relief:
    curve = curves.truth_curve(case)
    stations = np.arange(_MOUTH + FINE / 2, curve.length - _MOUTH, FINE)
    return Relief(stations, curves.cast_profile(truth_bore_caster(case), curve, stations, ANGLES))


@per_case
def relief_on_truth(case: Case) -> Relief:
    stations = truth_relief(case).station
    return Relief(stations, curves.cast_profile(bore_caster(case), curves.truth_curve(case), stations, ANGLES))


@per_case
def relief_on_path(case: Case) -> Relief:
    frame = hold_frame(case)
    stations = np.arange(frame.low + FINE / 2, frame.high, FINE)
    return Relief(stations, curves.cast_profile(bore_caster(case), sensor_path(case), stations, ANGLES, frame.middle))


def relief_cells(relief: Relief, values: Float[np.ndarray, "n m"] | None = None) -> Float[np.ndarray, "k s"]:
    """Return the medians of a relief, or of other values on its grid, in the cells of a map."""
    rows, columns = round(CELL / FINE), COLUMNS // SECTORS
    grid = relief.radius if values is None else values
    count = len(grid) // rows
    blocks = grid[: count * rows].reshape(count, rows, SECTORS, columns)
    return curves.nanmedian(blocks.transpose(0, 2, 1, 3).reshape(count, SECTORS, -1))


@per_case
def truth_map(case: Case) -> Unrolled:
    real, judged = truth_relief(case), relief_on_truth(case)
    offset = np.where(np.isfinite(judged.radius), judged.radius - real.radius, CAP)
    offset = np.where(np.isfinite(real.radius), np.clip(offset, -CAP, CAP), np.nan)
    low = float(real.station[0]) - FINE / 2
    return Unrolled(curves.truth_curve(case), (0.0, 0.0), low, relief_cells(real), relief_cells(real, offset))
