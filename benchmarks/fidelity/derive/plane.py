"""Free space in the plane of the sensor, along the reference axis: cells of 10 cm, widths, medial axes."""

from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Bool, Float
from scipy.ndimage import binary_dilation, binary_opening, distance_transform_edt
from skimage.morphology import skeletonize

from benchmarks.fidelity.case import Case, per_case
from benchmarks.fidelity.derive import freespace
from benchmarks.fidelity.derive.axis import hold_local, reference_curve
from benchmarks.fidelity.derive.curve import grouped_median
from benchmarks.fidelity.derive.sections import WIDTH_HEIGHT, lining_radii, sections, truth_caster, truth_radii, widths
from benchmarks.fidelity.derive.surface import surface_caster

PLANE_CELL = 0.10  # m
_SLAB = 0.15  # m to either side of the plane in which held-out beams count
_LEAST_RETURNS = 5
_SPUR = 3  # cells; pockets narrower than twice this grow no branch of the medial axis


@dataclass(frozen=True)
class Plane:
    """Free cells of candidate and reference at the height of the sensor."""

    lattice: freespace.Lattice  # Lattice of one layer
    judged: Bool[np.ndarray, "n m"]  # judged, reference: Free cells
    reference: Bool[np.ndarray, "n m"]
    known: Bool[np.ndarray, "n m"]  # Cells that the reference knows
    height: float  # Height of the plane above the reference axis, m

    @property
    def station(self) -> Float[np.ndarray, " n"]:
        """Stations of the rows, m."""
        return self.lattice.axes()[0]


def sensor_height(case: Case) -> float:
    """Return the height of the held-out sensor above the reference axis, m; without one 1.2 m above the floor."""
    if case.hold is not None:
        return float(np.median(reference_curve(case).local(case.hold.origin[::100])[:, 2]))
    return float(np.median(shapely.bounds(sections(case).reference_outline)[:, 1])) + WIDTH_HEIGHT


@per_case
def free_plane(case: Case) -> Plane:
    around, height = freespace.make_lattice(case, PLANE_CELL), sensor_height(case)
    low = np.array([around.low[0], around.low[1], height - around.edge / 2])
    cells = freespace.Lattice(around.curve, low, (around.shape[0], around.shape[1], 1), around.edge)
    inside = (lining_radii(case).depth(cells.points()) > 0).reshape(cells.shape[:2])
    objects = cells.marked(cells.curve.local(freespace.object_points(case, cells.edge)))[..., 0]
    judged = freespace.reachable(inside & ~objects)
    if case.truth is None:
        free, known = _cells_near_plane(case, cells)
        return Plane(cells, judged, free, known, height)
    inside = (truth_radii(case).depth_local(cells.local()) > 0).reshape(cells.shape[:2])
    objects = cells.marked(cells.curve.local(freespace.true_object_points(case, cells.edge)))[..., 0]
    known = binary_dilation(inside, iterations=int(freespace.KNOWN_AROUND / cells.edge))
    return Plane(cells, judged, freespace.reachable(inside & ~objects), known, height)


def _cells_near_plane(case: Case, cells: freespace.Lattice) -> tuple[Bool[np.ndarray, "n m"], Bool[np.ndarray, "n m"]]:
    """Return free and known cells by the held-out beams that run or end within 15 cm of the plane."""
    middle = cells.low[2] + cells.edge / 2
    near = [local[np.abs(local[:, 2] - middle) < _SLAB] for local in freespace.carved_about(case, cells.curve)]
    passed, ended = (np.column_stack([local[:, :2], np.full(len(local), middle)]) for local in near)
    free, known = freespace.carved_cells(cells, passed, ended, lambda local: np.abs(local[:, 1]))
    return free[..., 0], known[..., 0]


def unknown_share(case: Case) -> float:
    """Return the fraction of the candidate's free cells that no held-out beam shows."""
    _, known = _cells_near_plane(case, free_plane(case).lattice)
    return float(1.0 - known[free_plane(case).judged].mean())


@per_case
def gapless_maps(case: Case) -> tuple[Bool[np.ndarray, "r m"], Bool[np.ndarray, "r m"], Float[np.ndarray, " r"]]:
    """Return both maps without gaps, and the stations of their rows.

    The truth has none. A held-out recording's map lies between its two walls, each the median of the returns near the
    plane in a row and its neighbours; rows in which it does not show both are left out.
    """
    both = free_plane(case)
    if case.truth is not None:
        return both.judged, both.reference, both.station
    wall = _wall_distances(hold_local(case), both)
    rows = np.isfinite(wall).all(axis=0)
    left = both.lattice.axes()[1]
    free = (left < wall[0, rows, None]) & (left > -wall[1, rows, None])
    return both.judged[rows], free, both.station[rows]


def _wall_distances(local: Float[np.ndarray, "k 3"], both: Plane) -> Float[np.ndarray, "2 n"]:
    """Return the distance from the axis to the left and right wall by row, m; NaN with fewer than 5 returns."""
    near = local[np.abs(local[:, 2] - both.height) < _SLAB]
    rows = len(both.station)
    row = ((near[:, 0] - both.lattice.low[0]) / both.lattice.edge).astype(int)
    wall = np.empty((2, rows))
    for side, sign in enumerate((1, -1)):
        mine = (sign * near[:, 1] > 1.0) & (near[:, 0] > both.lattice.low[0]) & (row < rows)
        spread = np.concatenate([row[mine] + shift for shift in (-1, 0, 1)])
        value = np.tile(sign * near[mine, 1], 3)
        kept = (spread >= 0) & (spread < rows)
        wall[side] = grouped_median(spread[kept], value[kept], rows, _LEAST_RETURNS)
    return wall


def cell_distances(from_cells: Bool[np.ndarray, "n m"], to: Bool[np.ndarray, "n m"], edge: float) -> np.ndarray:
    """Return the distance from each of some cells to the nearest of others, m."""
    if not to.any():
        raise ValueError("no free space at the height of the sensor")
    return distance_transform_edt(~to, edge)[from_cells]


def medial_axis(free: Bool[np.ndarray, "n m"]) -> Bool[np.ndarray, "n m"]:
    """Return the skeleton of the free space without its pockets."""
    padded = np.pad(free, ((20, 20), (1, 1)), mode="edge")  # a skeleton shrinks from the mouths
    padded[:, [0, -1]] = False
    return skeletonize(binary_opening(padded, np.ones((2 * _SPUR + 1,) * 2)))[20:-20, 1:-1]


@per_case
def free_widths(case: Case) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return stations, and free widths of candidate and reference in the plane, m; `inf` where a side is open.

    Against the truth they are measured every 10 cm by rays, pockets with them; against a held-out recording every
    metre in the smooth sections.
    """
    both = free_plane(case)
    if case.truth is None:
        cut = sections(case)
        above = np.full(len(cut.station), both.height)
        return cut.station, widths(cut.judged_outline, above), widths(cut.reference_outline, above)
    position, _, left, up = both.lattice.curve.frames(both.station)
    eye = position + both.height * up
    pair = (surface_caster(case), truth_caster(case))
    width = [caster.first(eye, left)[0] + caster.first(eye, -left)[0] for caster in pair]
    return both.station, width[0], width[1]
