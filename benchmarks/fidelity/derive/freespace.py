"""Free space on a grid along a curve, and the persistence of its clearance."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_closing, distance_transform_edt, label

from benchmarks.fidelity.case import Case, derived, of_hold, of_truth, until
from benchmarks.fidelity.derive import surface
from benchmarks.fidelity.derive.curve import Curve, candidate_curve, truth_curve
from benchmarks.fidelity.derive.reference_axis import hold_curve

_CELL = (0.5, 0.25, 0.25)  # m along, left, up
_SAMPLES = 0.10  # m between samples of a surface
_AT_ONCE = 300_000  # points, whose coordinates take 100 MB on their way
_PAD = 0.3  # m beyond the walls; more would give leaks room to loop in
_KEPT = 0.05  # m; pairs of less persistence are the grid's
_MIDDLE = 0.5  # m about the curve, in which the flood starts

Diagrams = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Grid:
    """A box along a curve.

    Attributes:
        curve: Along which it lies.
        cell: Sizes along, left and up, m.
        low: Station, left and up of its first corner, m.
        shape: Cells each way.
    """

    curve: Curve
    cell: Float[np.ndarray, "3"]
    low: Float[np.ndarray, "3"]
    shape: tuple[int, int, int]

    def occupied(self, points: Float[np.ndarray, "k 3"]) -> Bool[np.ndarray, "a b c"]:
        """Cells with a point in them; points outside the box are left out."""
        cells = np.zeros(self.shape, bool)
        for start in range(0, len(points), _AT_ONCE):
            local = self.curve.local(points[start : start + _AT_ONCE])
            index = np.floor((local - self.low) / self.cell).astype(int)
            index = index[((index >= 0) & (index < self.shape)).all(axis=1)]
            cells[tuple(index.T)] = True
        return cells

    def on_curve(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The cells along the curve itself."""
        middle = np.floor((0.0 - self.low[1:]) / self.cell[1:]).astype(int)
        along = np.arange(self.shape[0])
        return along, np.full_like(along, middle[0]), np.full_like(along, middle[1])

    def clearance(self, occupied: Bool[np.ndarray, "a b c"]) -> Float[np.ndarray, "a b c"]:
        """Distance to what bounds the space about the curve, m; 0 outside it. The mouths bound nothing."""
        number, _ = label(~occupied)
        _, left, up = self.on_curve()
        reach = np.ceil(_MIDDLE / self.cell[1:]).astype(int)
        tube = number[:, left[0] - reach[0] : left[0] + reach[0] + 1, up[0] - reach[1] : up[0] + reach[1] + 1]
        free = np.isin(number, np.setdiff1d(np.unique(tube), [0]))
        return distance_transform_edt(free, sampling=self.cell)


def _grid(case: Case, curve: Curve, points: Float[np.ndarray, "k 3"]) -> Grid:
    """A grid that holds the points between the ends of a curve."""
    cell = np.asarray(_CELL) * case.tolerance
    across = np.abs(curve.local(points[::10])[:, 1:])
    half = np.percentile(across, 99.9, axis=0) + _PAD
    low = np.array([curve.station[0], *-half])
    shape = np.ceil(np.array([curve.length, *2 * half]) / cell).astype(int)
    return Grid(curve, cell, low, (int(shape[0]), int(shape[1]), int(shape[2])))


@until("TOP")
@derived
def samples(case: Case) -> Float[np.ndarray, "k 3"]:
    """Points all over the candidate's visible surface."""
    return surface.lattice(surface.surface(case), _SAMPLES)[0]


@until("TOP")
@of_truth
def _truth_samples(case: Case) -> Float[np.ndarray, "k 3"]:
    assert case.truth is not None
    return surface.lattice(case.truth.surface, _SAMPLES)[0]


@derived
def own_components(case: Case) -> tuple[int, int]:
    """Components of the candidate's free space that its centreline runs through, and cells of the centreline free."""
    import cc3d

    curve = candidate_curve(case)
    grid = _grid(case, curve, samples(case))
    number = cc3d.connected_components(~grid.occupied(samples(case)), connectivity=6)
    ends = 1  # a mouth's own cell is cut by its rim
    found = number[grid.on_curve()][ends:-ends]
    return len(np.setdiff1d(np.unique(found), [0])), int((found > 0).sum())


@of_truth
def truth_grid(case: Case) -> Grid:
    """The grid of the comparison with the truth."""
    return _grid(case, truth_curve(case), _truth_samples(case))


@of_hold
def hold_grid(case: Case) -> Grid:
    """The grid of the comparison with the held-out recording."""
    assert case.hold is not None
    return _grid(case, hold_curve(case), case.hold.points)


@of_truth
def truth_diagrams(case: Case) -> Diagrams:
    """Persistence of the true clearance."""
    grid = truth_grid(case)
    return persistence(grid.clearance(grid.occupied(_truth_samples(case))))


@of_hold
def hold_diagrams(case: Case) -> Diagrams:
    """Persistence of the clearance that the held-out returns leave."""
    assert case.hold is not None
    grid = hold_grid(case)
    return persistence(grid.clearance(_closed(grid.occupied(case.hold.points))))


@derived
def candidate_diagrams(case: Case) -> Diagrams:
    """Persistence of the candidate's clearance, sampled as the reference is."""
    if case.truth is not None:
        grid = truth_grid(case)
        return persistence(grid.clearance(grid.occupied(samples(case))))
    assert case.hold is not None
    hold, grid = case.hold, hold_grid(case)
    distance = surface.intersector(case).first(hold.origin, hold.direction)[0]
    hit = np.isfinite(distance) & hold.returned
    distance = distance[hit] + hold.sigma * case.rng("clearance").normal(size=int(hit.sum()))
    points = hold.origin[hit] + distance[:, None] * hold.direction[hit]
    return persistence(grid.clearance(_closed(grid.occupied(points))))


def _closed(occupied: Bool[np.ndarray, "a b c"]) -> Bool[np.ndarray, "a b c"]:
    """Occupied cells with the gaps of one cell shut that lie between the beams of a recording."""
    return binary_closing(np.pad(occupied, 1, mode="edge"), np.ones((3, 3, 3)))[1:-1, 1:-1, 1:-1]


def reference_diagrams(case: Case) -> Diagrams:
    """Of the truth where there is one, else of the held-out recording."""
    return truth_diagrams(case) if case.truth is not None else hold_diagrams(case)


def persistence(clearance: Float[np.ndarray, "a b c"]) -> Diagrams:
    """Birth and death of components, loops and voids of the space wider than a falling clearance, m, `(k, 2)` each.

    Nothing lies below 0, so that a slit between two beams, however deep the wall behind it, lasts no longer than it is
    wide. Signs are turned, so that births come before deaths: the space at level t is where minus the clearance is
    below t.
    """
    import gudhi

    complex_ = gudhi.CubicalComplex(top_dimensional_cells=-clearance)
    complex_.compute_persistence(min_persistence=_KEPT)
    zero, one, two = (np.asarray(complex_.persistence_intervals_in_dimension(k)).reshape(-1, 2) for k in range(3))
    return zero, one, two
