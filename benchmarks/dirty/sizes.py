"""Sizes along the dirty clouds, whose truth files hold axis and wall but no width, height or floor.

The true width and height sway by some centimetres along the bore, so the nominal sizes are no truth. They are read off
the true wall, and the floor off the cloud itself, in the frame of the true axis.
"""

from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

_WINDOW = 3.0  # m of the bore from which one size is read
_LEAST = 4  # points for a size
BAND = (-1.5, 0.1)  # m about the axis: heights at which the walls stand upright
_CROWN = 0.25  # m beside the axis
_FLOOR_HALF, _FLOOR_SLACK = (
    0.5,
    0.12,
)  # m beside the axis, and about the nominal floor: tops of proud sleepers are above
_EVEN, _LEAP = 10.0, 0.02  # m before and behind a place that tell its floor; m that it may be off them
_BESIDE = (1.4, 1.9)  # m from the axis: beside the sleepers of a single track
_SAME = 0.015  # m between the floor under the axis and beside the sleepers, further apart than which it is unknown
_FLOOR_THICK = 0.03  # m about the lower quartile that count as floor; the flanks of sleepers are above


@dataclass(frozen=True)
class Described:
    """Sizes and track of one kind of cloud, as the README of the dirty clouds gives them."""

    axis_above_floor: float  # m
    track: str  # `none`, `single` or `double`
    proud: float = 0.0  # Top of the sleepers above the floor, m; 0 where they are flush
    crown: bool = True  # False where the ceiling is open
    bulge: tuple[str, ...] = ()  # Sizes that change along the bore, and are judged by their median alone


DESCRIBED = {
    "portal": Described(3.3, "double", 0.2, bulge=("width", "height", "aside")),
    "corridor": Described(2.2, "none", crown=False, bulge=("width", "aside")),
    "works": Described(3.18, "single", 0.17),
    "slabtrack": Described(2.75, "single", 0.22),
    "platform": Described(2.8, "single", bulge=("width", "height", "aside")),
    "road": Described(3.5, "none", bulge=("width", "height", "aside")),
}


def measure_sizes(
    source: Path, axis: Float[np.ndarray, "n 3"], wall: Float[np.ndarray, "w 3"], told: Described
) -> dict[str, Float[np.ndarray, " n"]]:
    """Return `axis_above_floor`, `width`, `height` and `middle` at each point of the axis, m.

    NaN where too little was seen. `middle` is how far the middle between both walls lies to the left of the axis.
    """
    laz = laspy.read(source)
    cloud = np.stack([laz.x, laz.y, laz.z], axis=1)
    station = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(axis, axis=0), axis=1))])
    at, y, z = local_places(wall, axis, station)
    upright = (z > BAND[0]) & (z < BAND[1])
    sides = [_quantiles(station, at[chosen], y[chosen]) for chosen in (upright & (y > 0), upright & (y < 0))]
    crown = (np.abs(y) < _CROWN) & (z > 0.0)
    top = _quantiles(station, at[crown], z[crown]) if told.crown else np.full(len(station), np.nan)
    at, y, z = local_places(cloud, axis, station)
    low = (np.abs(y) < _FLOOR_HALF) & (np.abs(z + told.axis_above_floor) < _FLOOR_SLACK)
    lower = np.interp(at, station, _quantiles(station, at[low], z[low], 0.25))
    low &= np.abs(z - lower) < _FLOOR_THICK
    above = _without_leaps(station, -_quantiles(station, at[low], z[low]))
    if told.track == "single" and told.proud:  # beside what hides it, flanks of sleepers are all that is seen of a bed
        beside = (
            (np.abs(y) > _BESIDE[0]) & (np.abs(y) < _BESIDE[1]) & (np.abs(z + told.axis_above_floor) < _FLOOR_SLACK)
        )
        above = np.where(np.abs(above + _quantiles(station, at[beside], z[beside])) > _SAME, np.nan, above)
    middle = 0.5 * (sides[0] + sides[1])
    return {"axis_above_floor": above, "width": sides[0] - sides[1], "height": above + top, "middle": middle}


def _without_leaps(station: np.ndarray, above: np.ndarray) -> np.ndarray:
    """Heights of a floor without those that leap: where ballast hides in shadow, flanks of sleepers stand in for it."""
    usual = np.array([np.nanmedian(above[np.abs(station - at) < _EVEN]) for at in station])
    return np.where(np.abs(above - usual) < _LEAP, above, np.nan)


def local_places(
    points: Float[np.ndarray, "p 3"], axis: Float[np.ndarray, "n 3"], station: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Return station, offset to the left and height above the axis of points, m."""
    tangent = np.gradient(axis, station, axis=0)
    lateral = np.cross([0.0, 0.0, 1.0], tangent)
    lateral /= np.linalg.norm(lateral, axis=1, keepdims=True)
    near = cKDTree(axis).query(points)[1]
    offset = points - axis[near]
    along = np.einsum("ij,ij->i", offset, tangent[near])
    rise = offset[:, 2] - along * tangent[near, 2]
    return station[near] + along, np.einsum("ij,ij->i", offset, lateral[near]), rise


def _quantiles(station: np.ndarray, at: np.ndarray, value: np.ndarray, share: float = 0.5) -> np.ndarray:
    order = np.argsort(at, kind="stable")
    at, value = at[order], value[order]
    ends = np.searchsorted(at, np.stack([station - _WINDOW / 2, station + _WINDOW / 2]))
    return np.array([np.quantile(value[i:j], share) if j - i >= _LEAST else np.nan for i, j in ends.T])
