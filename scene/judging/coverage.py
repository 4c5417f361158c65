"""The wall that nobody saw, where the built surface lacks returns, and the wall that was seen and not built."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import label
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from scene.bore import Bore
from scene.geometry import angle_bins, bin_angles
from scene.judging.codes import name_sides
from scene.judging.returns import EXPLAINED, Returns

ROW = 1.0  # m
SECTORS = 36
_SPARSE = 0.03  # of the usual number of returns of a cell: with fewer it was not seen, as stray returns are everywhere
_MIN_AREA = 3.0  # m² of wall in one piece: a smaller one is a shadow that its neighbours tell about
_MIN_LENGTH, _MIN_GIRTH = 1.5, 0.9  # m
_CENTRES = bin_angles(SECTORS)
_FLOOR = np.deg2rad(35)


@dataclass(frozen=True)
class Unseen:
    """One piece of wall without returns."""

    start: float  # First station, m
    end: float  # Last station, m
    area: float  # m²
    sides: str  # Where it lies about the axis, in words
    share: float  # Of the girth, in the mean over its stations


@dataclass(frozen=True)
class Coverage:
    """Cells of the built wall, along the bore and around it."""

    start: Float[np.ndarray, " r"]  # First station of each row of cells, m
    end: Float[np.ndarray, " r"]  # Last station, m
    seen: Bool[np.ndarray, "r c"]  # True where enough returns lie on the wall
    pieces: tuple[Unseen, ...]  # Unseen pieces of some size, the largest first

    @property
    def floor(self) -> Float[np.ndarray, " r"]:
        """Share of the floor, 35° to each side of straight down, that was seen in each row."""
        return self.seen[:, np.abs(_CENTRES + np.pi / 2) < _FLOOR].mean(axis=1)

    @property
    def share(self) -> float:
        """Share of the cells that were seen."""
        return float(self.seen.mean())


def find_unseen(bore: Bore, returns: Returns, spacing: float = 0.0) -> Coverage:
    """Finds the parts of a bore's wall on which hardly a return lies.

    `spacing` is the distance of the survey's profiles, m; 0 for a dense survey.
    """
    step = max(ROW, 2.5 * spacing)
    rows = max(round(bore.length / step), 1)
    edges = np.linspace(0.0, bore.length, rows + 1)
    on_wall = (returns.kind == EXPLAINED) & (returns.station >= 0) & (returns.station <= bore.length)
    row = np.minimum((returns.station[on_wall] / bore.length * rows).astype(np.intp), rows - 1)
    column = angle_bins(returns.angle[on_wall], SECTORS)
    count = np.bincount(row * SECTORS + column, minlength=rows * SECTORS).reshape(rows, SECTORS)
    area = _cell_areas(bore, edges)
    density = count / area
    usual = float(np.median(density[count > 0])) if (count > 0).any() else 1.0
    seen = density > _SPARSE * usual
    return Coverage(edges[:-1], edges[1:], seen, _list_pieces(seen, area, edges))


_BEYOND = 20  # m beyond an end that are looked at
_ON_LINING = 0.25  # m from the wall of the last section, carried on straight
_OVERHEAD = 0.2  # sine of the directions that count: floor and walls go on into a cutting, a crown does not
_GOES_ON = 0.6  # of these directions


def measure_overruns(bore: Bore, returns: Returns) -> tuple[float, float]:
    """Return how far the cloud shows a lining before the first and behind the last station of a bore, at least, m."""
    overhead = (np.sin(returns.angle) > _OVERHEAD) & (np.abs(returns.outward) < _ON_LINING)
    column = angle_bins(returns.angle, SECTORS)
    all_columns = np.sin(_CENTRES) > _OVERHEAD
    result = []
    for beyond in (-returns.station, returns.station - bore.length):
        rows = np.flatnonzero(overhead & (beyond > 0.0) & (beyond < _BEYOND))
        seen = np.zeros((_BEYOND, SECTORS), bool)
        seen[beyond[rows].astype(np.intp), column[rows]] = True
        full = seen[:, all_columns].mean(axis=1) > _GOES_ON
        result.append(max(float(np.argmin(np.append(full, False))) - 1.0, 0.0))  # the last metre may be begun
    return result[0], result[1]


def _cell_areas(bore: Bore, edges: np.ndarray) -> Float[np.ndarray, "r c"]:
    """Area of wall in each cell, m²."""
    y, z = bore.radius * np.cos(bore.angle), bore.radius * np.sin(bore.angle)
    girth = np.hypot(np.roll(y, -1, axis=1) - y, np.roll(z, -1, axis=1) - z)
    column = angle_bins(bore.angle + 1e-9, SECTORS)
    around = np.stack([girth[:, column == k].sum(axis=1) for k in range(SECTORS)], axis=1)
    middle = (edges[1:] + edges[:-1]) / 2
    return np.maximum(around[bore.row_of(middle)], 1e-3) * np.diff(edges)[:, None]


def _list_pieces(seen: np.ndarray, area: np.ndarray, edges: np.ndarray) -> tuple[Unseen, ...]:
    labels = _label_around(~seen)
    pieces = []
    for index in range(1, int(labels.max(initial=0)) + 1):
        row, column = np.nonzero(labels == index)
        if not len(row):
            continue
        size = float(area[row, column].sum())
        start, end = float(edges[row.min()]), float(edges[row.max() + 1])
        if size < _MIN_AREA or end - start < _MIN_LENGTH or size / (end - start) < _MIN_GIRTH:
            continue
        across = float(area[row.min() : row.max() + 1].sum())
        pieces.append(Unseen(start, end, size, name_sides(_CENTRES[column], area[row, column]), size / across))
    return tuple(sorted(pieces, key=lambda piece: (-piece.area, piece.start)))


def _label_around(cells: np.ndarray) -> Int[np.ndarray, "r c"]:
    """Number the connected parts of a grid from 1, 0 elsewhere; the last column is beside the first."""
    labels, count = label(cells)
    both = cells[:, 0] & cells[:, -1]
    joins = csr_matrix((np.ones(both.sum()), (labels[both, 0], labels[both, -1])), shape=(count + 1, count + 1))
    return connected_components(joins, directed=False)[1][labels]
