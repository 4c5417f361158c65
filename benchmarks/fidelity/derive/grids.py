"""Air in voxels unrolled along the reference axis: of the candidate, of the reference, and what is known of it.

Voxels are cells of (station, left, up), so that nothing is aligned with the world; 20 cm.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation, distance_transform_edt, label

from benchmarks.fidelity.case import Case, derived, until
from benchmarks.fidelity.compiled import concatenated
from benchmarks.fidelity.derive import carving
from benchmarks.fidelity.derive.curve import Curve
from benchmarks.fidelity.derive.radii import lining_radii, truth_radii
from benchmarks.fidelity.derive.reference_axis import reference_curve
from benchmarks.fidelity.derive.sections import sections, true_part
from benchmarks.fidelity.derive.surface import lattice

VOXEL = 0.20  # m
ROUND = 0.6  # m around the reference's air that is known, too
_OBJECTS = ("sleeper", "rail", "fastening")
_MOUTH = 5  # voxels at either end where air begins
_RETURNS = 2


@dataclass(frozen=True)
class Lattice:
    """Cells about a curve.

    Attributes:
        curve: Axis.
        low: Corner of the first cell: station, left, up, m.
        shape: Cells.
        edge: Of a cell, m.
    """

    curve: Curve
    low: Float[np.ndarray, "3"]
    shape: tuple[int, int, int]
    edge: float

    def local(self) -> Float[np.ndarray, "k 3"]:
        """Middles of all cells: station, left, up, m."""
        axes = [low + self.edge * (np.arange(n) + 0.5) for low, n in zip(self.low, self.shape, strict=True)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)

    def points(self) -> Float[np.ndarray, "k 3"]:
        """Middles of all cells in the tunnel frame, m."""
        axes = [low + self.edge * (np.arange(n) + 0.5) for low, n in zip(self.low, self.shape, strict=True)]
        position, _, left, up = (a[:, None, None] for a in self.curve.frames(axes[0]))
        placed = position + axes[1][None, :, None, None] * left + axes[2][None, None, :, None] * up
        return placed.reshape(-1, 3)

    def cell(self, local: Float[np.ndarray, "k 3"]) -> tuple[Int[np.ndarray, " k"], Bool[np.ndarray, " k"]]:
        """Flat index of the cell of each point, and whether it lies in the lattice at all."""
        place = np.floor((local - self.low) / self.edge).astype(int)
        inside = ((place >= 0) & (place < self.shape)).all(axis=1)
        return np.ravel_multi_index(tuple(np.where(inside[:, None], place, 0).T), self.shape), inside

    def marked(self, local: Float[np.ndarray, "k 3"], least: int = 1) -> Bool[np.ndarray, "n m k"]:
        """Cells with at least so many of the points."""
        cell, inside = self.cell(local)
        return (np.bincount(cell[inside], minlength=int(np.prod(self.shape))) >= least).reshape(self.shape)


@dataclass(frozen=True)
class Air:
    """Air of candidate and reference in the same voxels.

    Attributes:
        lattice: The voxels.
        judged, reference: Whether each is air that can be reached from a mouth, `(n, m, k)`.
        known: Whether the reference says anything of it, `(n, m, k)`.
        blocked: Voxels inside the candidate's lining that are not its air, `(n, m, k)`.
        filled: Those of them that its extra surfaces take or close off, not its track, `(n, m, k)`.
    """

    lattice: Lattice
    judged: Bool[np.ndarray, "n m k"]
    reference: Bool[np.ndarray, "n m k"]
    known: Bool[np.ndarray, "n m k"]
    blocked: Bool[np.ndarray, "n m k"]
    filled: Bool[np.ndarray, "n m k"]


@derived
def lattice3(case: Case) -> Lattice:
    """20 cm voxels around the reference's sections."""
    return lattice_of(case, VOXEL * case.tolerance)


def lattice_of(case: Case, edge: float) -> Lattice:
    """Cells from mouth to mouth of the reference, with 0.8 m to spare around its largest section."""
    curve, cut = reference_curve(case), sections(case)
    x, z = cut.reference * np.cos(cut.angle), cut.reference * np.sin(cut.angle)
    low = np.floor((np.array([np.nanmin(x), np.nanmin(z)]) - 0.8) / edge)
    high = np.ceil((np.array([np.nanmax(x), np.nanmax(z)]) + 0.8) / edge)
    count = (high - low).astype(int)
    start = np.array([curve.station[0], low[0] * edge, low[1] * edge])
    return Lattice(curve, start, (int(curve.length / edge), int(count[0]), int(count[1])), edge)


@until("F3D")
@derived
def air(case: Case) -> Air:
    """Both, in voxels."""
    cells = lattice3(case)
    inside = (lining_radii(case).depth(cells.points()) > 0).reshape(cells.shape)
    track = cells.marked(cells.curve.local(track_points(case, cells.edge)))
    extra = cells.marked(cells.curve.local(lattice(case.candidate.extra, cells.edge / 2)[0]))
    judged = reached(inside & ~track & ~extra)
    reference, known = reference_air(case, cells)
    return Air(cells, judged, reference, known, inside & ~judged, inside & ~judged & ~track)


def object_points(case: Case, edge: float) -> Float[np.ndarray, "k 3"]:
    """Samples of what stands in the candidate's bore: track and extra surfaces."""
    return np.concatenate([track_points(case, edge), lattice(case.candidate.extra, edge / 2)[0]])


def track_points(case: Case, edge: float) -> Float[np.ndarray, "k 3"]:
    """Samples of the candidate's track."""
    track = case.candidate.track
    parts = [track.sleeper_mesh, track.rail_mesh, track.fastening_mesh]
    return lattice(concatenated([part for part in parts if len(part.faces)]), edge / 2)[0]


def true_objects(case: Case, edge: float) -> Float[np.ndarray, "k 3"]:
    """The same of the truth."""
    return lattice(true_part(case, _OBJECTS), edge / 2)[0]


def reference_air(case: Case, cells: Lattice) -> tuple[Bool[np.ndarray, "n m k"], Bool[np.ndarray, "n m k"]]:
    """Air of the reference and where it is known.

    The truth is known to 0.6 m behind its surface. Held-out beams know the cells that they pass; a cell in which at
    least two of them end is air where its middle lies nearer to the axis than their ends do.
    """
    if case.truth is not None:
        inside = (truth_radii(case).depth_local(cells.local()) > 0).reshape(cells.shape)
        free = reached(inside & ~cells.marked(cells.curve.local(true_objects(case, cells.edge))))
        return free, binary_dilation(inside, iterations=max(int(ROUND / cells.edge), 1))
    passed, ended = carving.about(case, cells.curve)
    cell, kept = cells.cell(ended)
    size = int(np.prod(cells.shape))
    ends = np.bincount(cell[kept], minlength=size)
    far = np.bincount(cell[kept], np.hypot(ended[kept, 1], ended[kept, 2]), size) / np.maximum(ends, 1)
    middle = cells.local()
    hit = ends >= _RETURNS
    free = np.where(hit, np.hypot(middle[:, 1], middle[:, 2]) < far, cells.marked(passed).ravel())
    return free.reshape(cells.shape), (free | hit).reshape(cells.shape)


def reached(free: Bool[np.ndarray, "n m k"]) -> Bool[np.ndarray, "n m k"]:
    """What of the air is connected with the first or last metre of the lattice that has any."""
    part, count = label(free)
    if not count:
        return free
    rows = np.flatnonzero(free.any(axis=tuple(range(1, free.ndim))))
    ends = np.concatenate(
        [part[rows[0] : rows[0] + _MOUTH].ravel(), part[rows[-1] - _MOUTH + 1 : rows[-1] + 1].ravel()]
    )
    found = np.bincount(ends, minlength=count + 1)
    found[0] = 0
    return np.isin(part, np.flatnonzero(found > 0.1 * found.max()))


@derived
def clearance(case: Case) -> tuple[Float[np.ndarray, "n m k"], Float[np.ndarray, "n m k"]]:
    """Distance to the edge of the air in every voxel, of candidate and reference, m; negative outside the air."""
    both = air(case)
    return signed(both.judged, both.lattice.edge), signed(both.reference, both.lattice.edge)


def signed(free: Bool[np.ndarray, "n m k"], edge: float) -> Float[np.ndarray, "n m k"]:
    """Signed Euclidean distance to the edge of free cells, m."""
    if free.all() or not free.any():
        return np.full(free.shape, np.inf if free.all() else -np.inf)
    return distance_transform_edt(free, edge) - distance_transform_edt(~free, edge)
