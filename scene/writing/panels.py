"""The lining as boxes to collide with: flat patches of the wall, as large as the wall is flat.

MuJoCo collides a mesh as its convex hull, which of a bore is the bore filled up.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from shapely import LineString

from scene.bore import Bore
from scene.writing.markup import cross

_TOLERANCE = 0.015  # of a patch from its wall, m
_STRETCH = 6.0  # longest patch, m
_LEAST = 3  # points along a patch's side below which it is not divided
_OVERLAP = 0.01
_THICKNESS = 0.10
_ON_BED = 0.03  # wall this little above the bed is floor, m


@dataclass(frozen=True)
class Panel:
    """A box behind the wall.

    Attributes:
        centre: m, `(3,)`.
        rotation: X along the bore, y around it, z out of the air.
        half: Half its sizes, m, `(3,)`.
        height: Lowest and highest point above the bed, m.
    """

    centre: Float[np.ndarray, "3"]
    rotation: Rotation
    half: Float[np.ndarray, "3"]
    height: tuple[float, float]


@dataclass(frozen=True)
class Opening:
    """Rows and columns of the bore's grid that a niche takes out of the wall, first and last of each."""

    rows: tuple[int, int]
    columns: tuple[int, int]


def wall_panels(bore: Bore, bed: Float[np.ndarray, " n"], openings: list[Opening]) -> list[Panel]:
    """Boxes within about a centimetre of the smooth wall, everywhere but below the bed and in openings."""
    surface, (n, m) = bore.surface(), bore.radius.shape
    above = surface[..., 2] - bed[:, None]
    outline = bore.radius.mean(axis=0)[:, None] * np.column_stack([np.cos(bore.angle), np.sin(bore.angle)])
    floor = above.mean(axis=0) < _ON_BED
    start = int(np.flatnonzero(floor)[len(np.flatnonzero(floor)) // 2]) if floor.any() else 0
    turn = (start + np.arange(m + 1)) % m
    kept = np.asarray(LineString(outline[turn]).simplify(_TOLERANCE).coords)
    breaks = {int(np.argmin(np.linalg.norm(outline[turn[:-1]] - point, axis=1))) for point in kept} | {0, m}
    edge = np.flatnonzero(np.diff(floor[turn].astype(int)))
    breaks |= {int(k) + int(floor[turn[k]]) for k in edge}
    panels: list[Panel] = []
    for c0, c1 in pairwise(sorted(breaks)):
        if floor[turn[c0 : c1 + 1]].mean() > 0.5:
            continue
        cuts = {0, n - 1} | {row for opening in openings for row in opening.rows}
        for r0, r1 in pairwise(sorted(cuts)):
            pieces = max(int(np.ceil((bore.station[r1] - bore.station[r0]) / _STRETCH - 1e-6)), 1)
            rows = np.rint(np.linspace(r0, r1, pieces + 1)).astype(int).tolist()
            for first, last in pairwise(sorted(set(rows))):
                for low, high in _without(openings, (first, last), (c0, c1), turn):
                    columns = turn[low : high + 1]
                    _divide(surface[first : last + 1][:, columns], above[first : last + 1][:, columns], panels)
    return panels


def _without(
    openings: list[Opening], rows: tuple[int, int], columns: tuple[int, int], turn: np.ndarray
) -> list[tuple[int, int]]:
    """The columns of a stretch that no opening takes, as first and last place in `turn`."""
    low, high = columns
    for opening in openings:
        if opening.rows[0] <= rows[0] and rows[1] <= opening.rows[1]:
            first, last = sorted(int(np.flatnonzero(turn == column)[0]) for column in opening.columns)
            if first < high and low < last:
                return [(a, b) for a, b in ((low, min(high, first)), (max(low, last), high)) if b > a]
    return [(low, high)]


def _divide(points: Float[np.ndarray, "r c 3"], above: Float[np.ndarray, "r c"], panels: list[Panel]) -> None:
    """One panel where the patch is flat, else those of its halves, cut across the direction in which it bends."""
    centre = points.mean(axis=(0, 1))
    x = points[-1].mean(axis=0) - points[0].mean(axis=0)
    x /= np.linalg.norm(x)
    y = points[:, -1].mean(axis=0) - points[:, 0].mean(axis=0)
    z = cross(y - (y @ x) * x, x)
    z /= np.linalg.norm(z)
    offset = points - centre
    local = np.stack([offset @ x, offset @ cross(z, x), offset @ z], axis=-1).reshape(-1, 3)
    slope = np.linalg.lstsq(np.column_stack([local[:, :2], np.ones(len(local))]), local[:, 2], rcond=None)[0]
    error = (local[:, 2] - local[:, :2] @ slope[:2] - slope[2]).reshape(points.shape[:2])
    rows, columns = points.shape[:2]
    if np.abs(error).max() > _TOLERANCE and max(rows, columns) > _LEAST:
        down = (
            np.ptp(error.mean(axis=1)) > np.ptp(error.mean(axis=0)) if min(rows, columns) > _LEAST else rows > columns
        )
        half = (rows if down else columns) // 2
        for part in (slice(None, half + 1), slice(half, None)):
            index = part if down else (slice(None), part)
            _divide(points[index], above[index], panels)
        return
    z = z - slope[0] * x - slope[1] * cross(z, x)
    z /= np.linalg.norm(z)
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    frame = np.stack([x, cross(z, x), z], axis=1)
    inside = (points.reshape(-1, 3) - centre) @ frame
    low, high = inside.min(axis=0), inside.max(axis=0)
    middle = (low + high) / 2
    middle[2] = inside[:, 2].mean() + _THICKNESS / 2
    half_size = np.array([*((high - low)[:2] / 2 + _OVERLAP), _THICKNESS / 2])
    span = (float(above.min()), float(above.max()))
    panels.append(Panel(centre + frame @ middle, Rotation.from_matrix(frame), half_size, span))
