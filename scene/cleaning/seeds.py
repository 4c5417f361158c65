"""Places inside a bore: where the cloud, looked at along one direction, draws a closed ring around an open middle.

A bore is what stays the same along its axis. Its direction is the one along which the returns around a place fall on
the fewest cells of a plane.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.ndimage import binary_dilation, distance_transform_edt
from scipy.spatial import cKDTree

from scene.cloud import occupied_cells
from scene.geometry import bin_angles

_TILE = 6.0  # m between places tried
_MOST = 60  # places
_REACH = 10.0  # m around a place whose returns tell the direction
_CELL = 0.25  # m
_SLAB = 3.0  # m before and behind a place that draw the ring
_HEADINGS = 24
_SLOPES = np.tan(np.deg2rad([-18, -12, -6, 0, 6, 12, 18]))
N_RAYS = 72
_LUMENS = 6  # open middles tried at a place
_LEAST_CLEARANCE = 0.5  # m
_FURTHEST = 15.0  # m
_MOST_POINTS = 6000


@dataclass(frozen=True)
class Seed:
    """A place inside a bore."""

    position: Float[np.ndarray, "3"]  # m
    direction: Float[np.ndarray, "3"]  # Unit vector along the bore
    radius: Float[np.ndarray, " rays"]  # Distance to the first return around, m; NaN where there is none
    enclosed: float  # Share of the directions around in which there is a return
    score: float  # Share of the returns seen from here, times the square of `enclosed`

    @property
    def width(self) -> float:
        """Extent across, from left to right, m."""
        across = (self.radius * np.cos(bin_angles(N_RAYS)))[np.isfinite(self.radius)]
        return float(np.ptp(across))


def frame_of(direction: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return the horizontal vector to the left of a direction, and the one above it."""
    left = np.array([-direction[1], direction[0], 0.0])
    left /= max(float(np.linalg.norm(left)), 1e-9)
    return left, np.cross(direction, left)


def find_seeds(points: Float[np.ndarray, "n 3"]) -> list[Seed]:
    """Return places inside bores, the likeliest first; a bore may have many, an open place has none well enclosed."""
    middles = (occupied_cells(points[:, :2], _TILE) + 0.5) * _TILE
    tree = cKDTree(points[:, :2])
    count = np.array([len(rows) for rows in tree.query_ball_point(middles, _TILE)])
    middles = middles[count > 0.3 * np.median(count)]
    middles = middles[:: max(1, -(-len(middles) // _MOST))]
    result = []
    for rows in tree.query_ball_point(middles, _REACH):
        near = points[rows[:: max(1, len(rows) // _MOST_POINTS)]]
        if len(near) > 100:
            result.extend(_seeds_at(near))
    return sorted(result, key=lambda seed: -seed.score)


def _seeds_at(near: np.ndarray) -> list[Seed]:
    direction = sweep_direction(near)
    left, up = frame_of(direction)
    middle = np.median(near, axis=0)
    along, across, upward = ((near - middle) @ vector for vector in (direction, left, up))
    slab = np.abs(along) < _SLAB
    if slab.sum() < 50:
        return []
    y, z = across[slab], upward[slab]
    low = np.array([y.min(), z.min()]) - 4 * _CELL
    shape = np.ceil((np.array([y.max(), z.max()]) - low) / _CELL).astype(int) + 4
    cell = np.floor((np.stack([y, z], axis=1) - low) / _CELL).astype(int)
    count = np.zeros(shape, int)
    np.add.at(count, tuple(cell.T), 1)
    solid = binary_dilation(count > 0, np.ones((2, 2), bool))
    clear = distance_transform_edt(np.pad(~solid, 1))[1:-1, 1:-1] * _CELL
    result, free = [], clear.copy()
    for _ in range(_LUMENS):
        at = np.unravel_index(int(free.argmax()), free.shape)
        clearance = free[at]
        if clearance < _LEAST_CLEARANCE:
            break
        grid = np.stack(np.meshgrid(*(np.arange(n) for n in free.shape), indexing="ij"), axis=-1)
        free[np.linalg.norm((grid - at) * _CELL, axis=-1) < clearance] = 0.0
        radius, seen = _cast(solid, count, np.array(at, float))
        enclosed = float(np.isfinite(radius).mean())
        if enclosed < 0.5:
            continue
        place = low + (np.array(at) + 0.5) * _CELL
        turn = bin_angles(N_RAYS)
        shift = _centroid(turn, radius)
        moved = np.array(at) + shift / _CELL
        inside = np.clip(np.rint(moved).astype(int), 0, np.array(solid.shape) - 1)
        if not solid[tuple(inside)]:
            radius, seen = _cast(solid, count, moved)
            enclosed, place = float(np.isfinite(radius).mean()), place + shift
        position = middle + place[0] * left + place[1] * up
        result.append(Seed(position, direction, radius, enclosed, enclosed**2 * seen / len(y)))
    return result


def sweep_direction(near: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """Return the unit vector along which points fall on the fewest cells of the plane square to it."""
    centred = near - near.mean(axis=0)

    def cells(heading: float, slope: float) -> int:
        direction = np.array([np.cos(heading), np.sin(heading), slope])
        row, column = (
            np.floor(centred @ vector / _CELL).astype(np.int64)
            for vector in frame_of(direction / np.linalg.norm(direction))
        )
        taken = np.zeros((np.ptp(row) + 1, np.ptp(column) + 1), bool)
        taken[row - row.min(), column - column.min()] = True
        return int(np.count_nonzero(taken))

    best = min((cells(turn, 0.0), turn, 0.0) for turn in np.pi * np.arange(_HEADINGS) / _HEADINGS)
    best = min((cells(best[1], slope), best[1], float(slope)) for slope in _SLOPES)
    step = np.pi / _HEADINGS / 2
    for _ in range(3):
        around = [(best[1] + i * step, best[2] + j * step) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        best = min((cells(*at), *at) for at in around)
        step /= 2
    direction = np.array([np.cos(best[1]), np.sin(best[1]), best[2]])
    return direction / np.linalg.norm(direction)


def _cast(solid: np.ndarray, count: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, int]:
    """Distance to the first solid cell in each direction, m, NaN without one, and the returns in the cells seen."""
    turn = bin_angles(N_RAYS)
    steps = np.arange(1, int(_FURTHEST / _CELL * 2)) / 2
    where = at + steps[:, None, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    cell = np.rint(where).astype(int)
    inside = ((cell >= 0) & (cell < solid.shape)).all(axis=2)
    cell = np.clip(cell, 0, np.array(solid.shape) - 1)
    hit = solid[cell[..., 0], cell[..., 1]] & inside
    first = hit.argmax(axis=0)
    met = hit.any(axis=0)
    seen = np.zeros(solid.shape, bool)
    seen[tuple(cell[first[met], np.flatnonzero(met)].T)] = True
    seen = binary_dilation(seen, np.ones((3, 3), bool))
    return np.where(met, steps[first] * _CELL, np.nan), int(count[seen].sum())


def _centroid(turn: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Middle of the box around the ring, from where it was drawn, m."""
    seen = np.isfinite(radius)
    y, z = (radius * np.cos(turn))[seen], (radius * np.sin(turn))[seen]
    return np.array([y.min() + y.max(), z.min() + z.max()]) / 2
