"""Pockets: those that an unrolled map shows, those of the truth, and which belong together."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import label
from scipy.spatial import cKDTree
from skimage.measure import regionprops

from benchmarks.fidelity.case import Case, derived
from benchmarks.fidelity.derive.curve import truth_curve
from benchmarks.fidelity.derive.radii import COLUMNS, ROW
from benchmarks.fidelity.derive.unrolled import Unrolled, blurred, both_maps, hold_map

MATCH = 0.15  # m
DEEP = (0.06, 0.008)  # m behind the smooth section, about half a pocket, and m² of it
GRAZED = (0.025, 0.004)  # the same of what beams show: most end on a pocket's far side and miss its bottom
_LARGEST = 0.20  # m²
_EIGHT = np.ones((3, 3), int)


@dataclass(frozen=True)
class Pockets:
    """Recesses of the lining.

    Attributes:
        station: m, `(p,)`.
        arc: Along the section, m, `(p,)`.
        depth: Normal to the wall, m, `(p,)`.
        area: Of the opening, m², `(p,)`.
    """

    station: Float[np.ndarray, " p"]
    arc: Float[np.ndarray, " p"]
    depth: Float[np.ndarray, " p"]
    area: Float[np.ndarray, " p"]

    def __len__(self) -> int:
        return len(self.station)

    @property
    def place(self) -> Float[np.ndarray, "p 2"]:
        """On the unrolled wall, m."""
        return np.column_stack([self.station, self.arc])


def detected(
    unrolled: Unrolled, depth: Float[np.ndarray, "n m"], arc: Float[np.ndarray, " m"], least: tuple[float, float]
) -> Pockets:
    """Connected cells that are deep enough and together have the area of a pocket.

    Args:
        unrolled: Where the cells are.
        depth: Of the cells, m.
        arc: Along the section at each column, m: that of the reference, so that both sides are measured alike.
        least: Depth, m, and area, m².
    """
    deep = (np.nan_to_num(depth) * unrolled.slant > least[0]) & unrolled.wall
    size = np.where(unrolled.wall, unrolled.pitch, 0.0) * ROW
    found = []
    for region in regionprops(label(deep, _EIGHT)[0]):
        rows, columns = region.coords.T
        area = float(size[columns].sum())
        if least[1] < area < _LARGEST:
            values = depth[rows, columns] * unrolled.slant[columns]
            bottom = float(np.median(values[values >= np.median(values)]))
            found.append((unrolled.station[rows].mean(), arc[columns].mean(), bottom, area))
    return Pockets(*np.array(found, float).reshape(-1, 4).T)


def shown(unrolled: Unrolled, arc: Float[np.ndarray, " m"]) -> Pockets:
    """Those that beams show."""
    return detected(unrolled, blurred(unrolled.depth, np.isfinite(unrolled.depth)), arc, GRAZED)


@derived
def judged_pockets(case: Case) -> Pockets:
    """Those of the candidate's lining; against a held-out recording those that its beams would have shown."""
    judged, arc = both_maps(case)[0], reference_arc(case)
    return shown(judged, arc) if case.truth is None else detected(judged, judged.depth, arc, DEEP)


@derived
def reference_pockets(case: Case) -> Pockets:
    """The open pockets of the truth; otherwise those that the held-out recording shows."""
    if case.truth is None:
        return shown(hold_map(case), reference_arc(case))
    rows = [pocket for pocket in case.truth.furniture.get("pockets", ()) if pocket["open"]]
    if not rows:
        return Pockets(*np.zeros((4, 0)))
    local = truth_curve(case).local(np.array([row["position"] for row in rows]) - case.truth.origin)
    angle = np.arctan2(local[:, 2], local[:, 1])
    arc = reference_arc(case)[np.minimum(((angle + np.pi) / (2 * np.pi) * COLUMNS).astype(int), COLUMNS - 1)]
    depth = np.array([row["depth"] for row in rows], float)
    return Pockets(local[:, 0], arc, depth, np.array([row["length"] * row["width"] for row in rows], float))


def reference_arc(case: Case) -> Float[np.ndarray, " m"]:
    """Length along the reference's section at each column, m: both sides are measured by it."""
    return both_maps(case)[1].arc


@derived
def matched(case: Case) -> Int[np.ndarray, "k 2"]:
    """Pairs (judged, reference) that are each other's nearest and at most 15 cm apart on the unrolled wall."""
    judged, reference = judged_pockets(case), reference_pockets(case)
    if not len(judged) or not len(reference):
        return np.zeros((0, 2), int)
    apart, there = cKDTree(reference.place).query(judged.place)
    back = cKDTree(judged.place).query(reference.place)[1]
    mutual = (back[there] == np.arange(len(judged))) & (apart <= MATCH * case.tolerance)
    return np.column_stack([np.flatnonzero(mutual), there[mutual]])
