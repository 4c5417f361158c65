"""Free space in voxels along the reference axis, and clearances near it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation, label
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case, kept_until, per_case, per_hold, per_reference
from benchmarks.fidelity.derive.axis import hold_local, hold_points, reference_curve
from benchmarks.fidelity.derive.beams import returns
from benchmarks.fidelity.derive.curve import Curve, grouped_median, nanmedian
from benchmarks.fidelity.derive.sections import lining_radii, sections, truth_caster, truth_radii
from benchmarks.fidelity.derive.surface import Caster, Nearest, sample_surface, surface_caster, surface_nearest
from benchmarks.fidelity.meshes import concatenate_meshes

_BEAMS_PER_METRE = 300  # beams followed for each metre of chainage
_CARVE_STEP = 0.15  # m
_CARVE_FARTHEST = 25.0  # m
CARVE_MARGIN = 0.20  # m before the return where a beam's air ends


@kept_until("F3D", per_hold)
def carve_beams(case: Case) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "b 3"]]:
    """Samples about 300 beams a metre every 15 cm, from the sensor to 20 cm before the return or 25 m.

    Returns:
        Points that beams went through, and the returns of the same beams, tunnel frame, m.
    """
    real = returns(case)
    length = np.linalg.norm(np.ptp(real.origin, axis=0)) + 10.0
    back = np.arange(0, len(real.range), max(1, int(len(real.range) / (_BEAMS_PER_METRE * length))))
    origin, direction = real.origin[back], real.direction[back]
    reach = np.minimum(real.range[back] - CARVE_MARGIN, _CARVE_FARTHEST)
    count = np.maximum((reach / _CARVE_STEP).astype(int), 0)
    beam = np.repeat(np.arange(len(back)), count)
    place = np.arange(len(beam)) - np.repeat(np.cumsum(count) - count, count)
    along = (place + 0.5) * _CARVE_STEP
    return origin[beam] + along[:, None] * direction[beam], real.points[back]


@kept_until("F3D", per_hold)
def carved_about(case: Case, curve: Curve) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "b 3"]]:
    passed, ended = carve_beams(case)
    return curve.local(passed), curve.local(ended)


# Air in voxels of (station, left, up), 20 cm, so that nothing is aligned with the world.

AIR_VOXEL = 0.20  # m
KNOWN_AROUND = 0.6  # m around the reference's air that is known, too
_OBJECTS = ("sleeper", "rail", "fastening")
_MOUTH_VOXELS = 5  # voxels at either end where air begins
HIT_RETURNS = 2


@dataclass(frozen=True)
class Lattice:
    """Cells about a curve."""

    curve: Curve  # Axis of the lattice
    low: Float[np.ndarray, "3"]  # Corner of the first cell: station, left, up, m
    shape: tuple[int, int, int]  # Number of cells each way
    edge: float  # Edge of a cell, m

    def axes(self) -> list[np.ndarray]:
        """Return the middles of the cells along station, left and up, m."""
        return [low + self.edge * (np.arange(n) + 0.5) for low, n in zip(self.low, self.shape, strict=True)]

    def local(self) -> Float[np.ndarray, "k 3"]:
        """Return the middles of all cells: station, left, up, m."""
        return np.stack(np.meshgrid(*self.axes(), indexing="ij"), axis=-1).reshape(-1, 3)

    def points(self) -> Float[np.ndarray, "k 3"]:
        """Return the middles of all cells in the tunnel frame, m."""
        axes = self.axes()
        position, _, left, up = (a[:, None, None] for a in self.curve.frames(axes[0]))
        placed = position + axes[1][None, :, None, None] * left + axes[2][None, None, :, None] * up
        return placed.reshape(-1, 3)

    def cell(self, local: Float[np.ndarray, "k 3"]) -> tuple[Int[np.ndarray, " k"], Bool[np.ndarray, " k"]]:
        """Return the flat index of the cell of each point, and True where it lies in the lattice."""
        place = np.floor((local - self.low) / self.edge).astype(int)
        inside = ((place >= 0) & (place < self.shape)).all(axis=1)
        return np.ravel_multi_index(tuple(np.where(inside[:, None], place, 0).T), self.shape), inside

    def marked(self, local: Float[np.ndarray, "k 3"], least: int = 1) -> Bool[np.ndarray, "n m k"]:
        """Return True for cells with at least so many of the points."""
        cell, inside = self.cell(local)
        return (np.bincount(cell[inside], minlength=int(np.prod(self.shape))) >= least).reshape(self.shape)


@dataclass(frozen=True)
class Air:
    """Air of candidate and reference in the same voxels."""

    lattice: Lattice  # Lattice of the voxels
    judged: Bool[np.ndarray, "n m k"]  # judged, reference: Voxels of air that can be reached from a mouth
    reference: Bool[np.ndarray, "n m k"]
    known: Bool[np.ndarray, "n m k"]  # Voxels that the reference knows
    blocked: Bool[np.ndarray, "n m k"]  # Voxels inside the candidate's lining that are not its air
    filled: Bool[np.ndarray, "n m k"]  # Blocked voxels that its extra surfaces take or close off, not its track


@per_case
def air_lattice(case: Case) -> Lattice:
    return make_lattice(case, AIR_VOXEL)


def make_lattice(case: Case, edge: float) -> Lattice:
    """Return cells from mouth to mouth of the reference, with 0.8 m to spare around its largest section."""
    curve, cut = reference_curve(case), sections(case)
    x, z = cut.reference * np.cos(cut.angle), cut.reference * np.sin(cut.angle)
    low = np.floor((np.array([np.nanmin(x), np.nanmin(z)]) - 0.8) / edge)
    high = np.ceil((np.array([np.nanmax(x), np.nanmax(z)]) + 0.8) / edge)
    count = (high - low).astype(int)
    start = np.array([curve.station[0], low[0] * edge, low[1] * edge])
    return Lattice(curve, start, (int(curve.length / edge), int(count[0]), int(count[1])), edge)


@kept_until("F3D", per_case)
def air_voxels(case: Case) -> Air:
    cells = air_lattice(case)
    inside = (lining_radii(case).depth(cells.points()) > 0).reshape(cells.shape)
    track = cells.marked(cells.curve.local(track_points(case, cells.edge)))
    judged = reachable(inside & ~cells.marked(cells.curve.local(object_points(case, cells.edge))))
    reference, known = reference_air(case)
    return Air(cells, judged, reference, known, inside & ~judged, inside & ~judged & ~track)


def object_points(case: Case, edge: float) -> Float[np.ndarray, "k 3"]:
    """Return samples of the objects in the candidate's bore: track and extra surfaces, m."""
    return np.concatenate([track_points(case, edge), sample_surface(case.candidate.extra, edge / 2)[0]])


def track_points(case: Case, edge: float) -> Float[np.ndarray, "k 3"]:
    track = case.candidate.track
    parts = [track.sleeper_mesh, track.rail_mesh, track.fastening_mesh]
    return sample_surface(concatenate_meshes([part for part in parts if len(part.faces)]), edge / 2)[0]


def true_object_points(case: Case, edge: float) -> Float[np.ndarray, "k 3"]:
    assert case.truth is not None
    return sample_surface(case.truth.faces(*_OBJECTS), edge / 2)[0]


@per_reference
def reference_air(case: Case) -> tuple[Bool[np.ndarray, "n m k"], Bool[np.ndarray, "n m k"]]:
    """Return the air of the reference and where it is known.

    The truth is known to 0.6 m behind its surface, a recording where its beams pass or end.
    """
    cells = air_lattice(case)
    if case.truth is None:
        passed, ended = carved_about(case, cells.curve)
        return carved_cells(cells, passed, ended, lambda local: np.hypot(local[:, 1], local[:, 2]))
    inside = (truth_radii(case).depth_local(cells.local()) > 0).reshape(cells.shape)
    free = reachable(inside & ~cells.marked(cells.curve.local(true_object_points(case, cells.edge))))
    return free, binary_dilation(inside, iterations=max(int(KNOWN_AROUND / cells.edge), 1))


def carved_cells(
    cells: Lattice,
    passed: Float[np.ndarray, "k 3"],
    ended: Float[np.ndarray, "b 3"],
    away: Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, " n"]],
) -> tuple[Bool[np.ndarray, "n m k"], Bool[np.ndarray, "n m k"]]:
    """Return free and known cells by the points that beams passed, and by those where they ended; `away` from the axis.

    A cell in which at least two beams end is free where its middle lies nearer to the axis than their ends do.
    """
    cell, kept = cells.cell(ended)
    size = int(np.prod(cells.shape))
    ends = np.bincount(cell[kept], minlength=size)
    far = np.bincount(cell[kept], away(ended[kept]), size) / np.maximum(ends, 1)
    hit = ends >= HIT_RETURNS
    free = np.where(hit, away(cells.local()) < far, cells.marked(passed).ravel())
    return free.reshape(cells.shape), (free | hit).reshape(cells.shape)


def reachable(free: Bool[np.ndarray, "n m k"]) -> Bool[np.ndarray, "n m k"]:
    """Return the air that is connected with the first or last metre of the lattice that has any."""
    part, count = label(free)
    if not count:
        return free
    rows = np.flatnonzero(free.any(axis=tuple(range(1, free.ndim))))
    ends = part[rows[0] : rows[0] + _MOUTH_VOXELS], part[rows[-1] - _MOUTH_VOXELS + 1 : rows[-1] + 1]
    cells = np.bincount(np.concatenate([end.ravel() for end in ends]), minlength=count + 1)
    cells[0] = 0
    return np.isin(part, np.flatnonzero(cells > 0.1 * cells.max()))


# Distances in the air: around the axis, up and down in lanes, and in vehicle envelopes.

LANES = (-1.0, 0.0, 1.0)  # m to the left of the axis
_AROUND_AXIS = 1.0  # m to either side of the axis, and up and down
_NODE = 0.25  # m between the places in a section
_LANE_HALF = 0.15  # m
_LANE_BIN = 0.5  # m of chainage
_VEHICLE = (2.8, 3.8)  # m; a metro car (type B), width and height above the rails
_VEHICLE_FLOOR = 0.45  # m; where its envelope begins
_TIGHTER = (0.0, 0.05, 0.10)  # m that the reference's own median outline is drawn in


def _places_near_axis(case: Case) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "k 3"]]:
    station = sections(case).station
    offset = np.arange(-_AROUND_AXIS, _AROUND_AXIS + 1e-9, _NODE)
    grid = np.stack(np.meshgrid(station, offset, offset, indexing="ij"), axis=-1)
    return station, reference_curve(case).point(grid.reshape(-1, 3))


@per_reference
def _reference_clearances(case: Case) -> Float[np.ndarray, " k"]:
    nearest: Any = Nearest(case.truth.surface) if case.truth is not None else cKDTree(hold_points(case))
    return np.asarray(nearest.query(_places_near_axis(case)[1])[0])


@per_case
def axis_clearances(case: Case) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n k"], Float[np.ndarray, "n k"]]:
    """Return stations, and distances to the nearest surface around the axis, m, of candidate and reference.

    They are by section and place in it; a recording's is the distance to its nearest return.
    """
    station, points = _places_near_axis(case)
    judged, reference = surface_nearest(case).query(points)[0], _reference_clearances(case)
    return station, judged.reshape(len(station), -1), reference.reshape(len(station), -1)


@per_case
def headrooms(case: Case) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Return stations, and floor to crown in three lanes of candidate and reference, m; NaN where not known.

    Medians over 0.5 m of chainage, so that a sleeper a centimetre off counts by its centimetre.
    """
    station = _lane_stations(case)
    judged = _cast_headroom(surface_caster(case), reference_curve(case), station)
    return station, judged, _reference_headroom(case)


def _lane_stations(case: Case) -> Float[np.ndarray, " n"]:
    curve = reference_curve(case)
    return np.arange(curve.station[0] + _LANE_BIN, curve.station[-1] - _LANE_BIN, _LANE_BIN)


def _cast_headroom(caster: Caster, curve: Curve, station: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    fine = (station[:, None] + np.linspace(-0.4, 0.4, 5) * _LANE_BIN).ravel()
    position, _, left, up = curve.frames(fine)
    lanes = []
    for lane in LANES:
        eye = position + lane * left
        total = caster.first(eye, up)[0] + caster.first(eye, -up)[0]
        lanes.append(nanmedian(np.where(np.isfinite(total), total, np.nan).reshape(len(station), -1)))
    return np.column_stack(lanes)


@per_reference
def _reference_headroom(case: Case) -> Float[np.ndarray, "n 3"]:
    station = _lane_stations(case)
    if case.truth is not None:
        return _cast_headroom(truth_caster(case), reference_curve(case), station)
    local, lanes = hold_local(case), []
    row = np.floor((local[:, 0] - station[0]) / _LANE_BIN + 0.5).astype(int)
    for lane in LANES:
        near = (np.abs(local[:, 1] - lane) < _LANE_HALF) & (row >= 0) & (row < len(station))
        ends = [near & (sign * local[:, 2] > 1.0) for sign in (1, -1)]
        top, bottom = (grouped_median(row[kept], local[kept, 2], len(station), 5) for kept in ends)
        lanes.append(top - bottom)
    return np.column_stack(lanes)


@per_case
def infringements(case: Case) -> tuple[Bool[np.ndarray, "n e"], Bool[np.ndarray, "n e"]]:
    """Return True where lining and reference cut into each of four envelopes, by section.

    A metro car's envelope, and the median outline of the reference drawn in by 0, 5 and 10 cm: a car alone is clear of
    any bore that it is driven through and would tell nothing apart.
    """
    cut = sections(case)
    typical = nanmedian(cut.reference.T)
    known = np.isfinite(typical)
    ring = (typical[:, None] * np.column_stack([np.cos(cut.angle), np.sin(cut.angle)]))[known]
    outline = shapely.make_valid(shapely.Polygon(ring))
    floor = shapely.bounds(outline)[1] + _VEHICLE_FLOOR
    car = shapely.box(-_VEHICLE[0] / 2, floor, _VEHICLE[0] / 2, floor + _VEHICLE[1])
    envelopes = [car, *(outline.buffer(-inset) for inset in _TIGHTER)]
    both = []
    for sides in (cut.judged_outline, cut.reference_outline):
        lost = [shapely.area(shapely.difference(envelope, sides)) > 0.005 * envelope.area for envelope in envelopes]
        both.append(np.column_stack(lost))
    return both[0], both[1]
