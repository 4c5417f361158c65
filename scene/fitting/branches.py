"""One bore or several: a side tunnel or a room is told from a niche, a door or a portal that flares open."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from scene.bore import Axis
from scene.errors import FitError

_USUAL = 1.5  # times the median reach: slices that reach further say nothing of the axis
_BESIDE = 1.4  # times the wall's distance from the axis: further is beyond it
_FAR = 2.0  # times the same: as far as no niche goes
_WALL_SHARE = 90  # percentile of the distances from the axis that counts as the wall's
_SIMILAR = 0.55  # of the bore's girth: narrower is a door or a passage, which the section closes
_PORTAL = 6.0  # m from an end within which a bore may flare open
_WINDOW = 5  # slices that one branch falls into
_MIN_USUAL = 4
_ROOT_SHARE = 20  # percent of what lies beside the bore that is nearest to it
_TURN = np.deg2rad(75)
_ROOM, _ROOM_LENGTH = 2.0, 5.0  # times the median width; m, longer than a niche


def require_one_bore(
    nodes: Float[np.ndarray, "k 3"],
    along: Float[np.ndarray, " k"],
    length: float,
    voxel: float,
    origin: Float[np.ndarray, "3"],
) -> Bool[np.ndarray, " k"]:
    """Refuses a surface that leaves its axis by far, with the girth of a tunnel; raises `FitError`.

    All of a branch is as far from both ends as its junction, but for a constant: it falls into the slices of the
    junction, and reaches far out of them. `along` is half the difference of each node's distances from both ends, from
    0, m; slices have a `length`, m. `origin` is that of the nodes' frame in the input's, m.

    Returns the nodes of the bore itself, without those of a niche or a passage.
    """
    index = np.floor(along / length).astype(np.intp)
    count = np.bincount(index)
    centre = _slice_medians(nodes, index, len(count))
    reach = np.zeros(len(count))
    np.maximum.at(reach, index, np.linalg.norm(nodes - centre[index], axis=1))
    usual = float(np.median(reach[count > 0]))
    plain = np.flatnonzero((reach < _USUAL * usual) & (count > 0.4 * np.median(count[count > 0])))
    if len(plain) < _MIN_USUAL:
        return np.ones(len(nodes), bool)  # no bore to branch off; the fits that follow say so
    grid = np.arange(plain[0], plain[-1] + 0.25, 0.25)
    line = np.stack([np.interp(grid, plain, centre[plain, axis]) for axis in range(3)], axis=1)
    off, nearest = cKDTree(line).query(nodes)
    wall = float(np.percentile(off[np.isin(index, plain)], _WALL_SHARE))
    inner = (along > _PORTAL) & (along < along.max() - _PORTAL)
    beside = inner & (off > _BESIDE * wall)
    girth = float(np.median(count[plain])) * voxel**2 / length
    for k in np.unique(index[beside & (off > _FAR * wall)]):
        there = beside & (np.abs(index - k) <= _WINDOW // 2)
        furthest = float(off[there].max())
        if there.sum() * voxel**2 / (furthest - _BESIDE * wall) > _SIMILAR * girth:
            root = there & (off < np.percentile(off[there], _ROOT_SHARE))
            at = line[int(np.median(nearest[root]))] + origin
            raise FitError(
                f"about {k * length:.0f} m from one end, near ({at[0]:.1f}, {at[1]:.1f}, {at[2]:.1f}), the bore opens "
                f"into a branch or a room that reaches {furthest:.0f} m from its axis; build each bore from a cloud of "
                "its own"
            )
    return ~beside


def require_no_fold(axis: Axis, across: float, origin: Float[np.ndarray, "3"]) -> None:
    """Refuses an axis that turns by more than 75° within the width `across`, m: it winds through a room.

    `origin` is that of the axis' frame in the input's, m. Raises `FitError`.
    """
    ahead = max(round(across / (axis.station[1] - axis.station[0])), 1)
    if len(axis.station) <= ahead:
        return
    cosine = np.einsum("ij,ij->i", axis.tangent[ahead:], axis.tangent[:-ahead])
    k = int(np.argmin(cosine))
    if cosine[k] < np.cos(_TURN):
        x, y, z = axis.position[k + ahead // 2] + origin
        raise FitError(
            f"a room, not a tunnel: near ({x:.1f}, {y:.1f}, {z:.1f}) its axis would turn by "
            f"{np.rad2deg(np.arccos(np.clip(cosine[k], -1, 1))):.0f}° within {across:.0f} m"
        )


def require_no_room(station: Float[np.ndarray, " n"], width: Float[np.ndarray, " n"]) -> None:
    """Refuses a bore that is twice as wide as usual over more than 5 m; raises `FitError`.

    Stations are uniform, m. What widens within 6 m of an end is a portal.
    """
    usual = float(np.median(width))
    wide = (width > _ROOM * usual) & (station > _PORTAL) & (station < station[-1] - _PORTAL)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], wide.astype(int), [0]])))
    for first, last in zip(edges[::2], edges[1::2] - 1, strict=True):
        if station[last] - station[first] > _ROOM_LENGTH:
            raise FitError(
                f"from station {station[first]:.0f} to {station[last]:.0f} m the bore is "
                f"{width[first : last + 1].max():.0f} m wide where it is {usual:.1f} m elsewhere: a room, not a tunnel"
            )


def _slice_medians(nodes: np.ndarray, index: np.ndarray, count: int) -> Float[np.ndarray, "c 3"]:
    """Median position of each slice's nodes, m; 0 where there is none."""
    order = np.argsort(index, kind="stable")
    bounds = np.searchsorted(index[order], np.arange(count + 1))
    result = np.zeros((count, 3))
    for k in np.flatnonzero(np.diff(bounds)):
        result[k] = np.median(nodes[order[bounds[k] : bounds[k + 1]]], axis=0)
    return result
