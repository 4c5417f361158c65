"""Walls that a registered cloud shows twice: passes that do not fit each other, or poses that drifted."""

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from scene.bore import Bore
from scene.cloud import Cloud
from scene.judging.codes import Code, name_span
from scene.judging.judge import Warned

_PLACES = 1500  # of the wall that are looked at
_REACH = 0.22  # m around a place
_LEAST = 24  # points of a place
_NEAR_WALL = 0.30  # m
_SIDES = -0.3  # sine of the lowest direction: sleepers and ballast below it are two layers, too
_THINNEST = 0.02  # m between two layers; nearer is noise
_APART = 0.92  # share of the variance that lies between two halves: 0.64 of one noisy layer, 0.75 of an even one
_HALF = 0.15  # least share of the points in each layer
_MIXED = 0.5  # of the neighbours in other layers that points at random would have
_DOUBLED = 0.25  # share of the places
_WINDOW = 10.0  # m


def doubt_layers(bore: Bore, cloud: Cloud) -> list[Warned]:
    """Warn of a wall that most places of some stretch show twice, a few centimetres apart."""
    station, lateral, upward = bore.axis.local(cloud.points.astype(np.float64))
    angle = np.arctan2(upward, lateral)
    column = np.rint((angle - bore.angle[0]) / (2 * np.pi) * len(bore.angle)).astype(np.intp) % len(bore.angle)
    on_wall = np.abs(np.hypot(lateral, upward) - bore.radius[bore.row_of(station), column]) < _NEAR_WALL
    on_wall &= (np.sin(angle) > _SIDES) & (station > 0) & (station < bore.length)
    wall = cloud.points[on_wall].astype(np.float64)
    if len(wall) < _PLACES:
        return []
    picked = np.arange(0, len(wall), max(1, len(wall) // _PLACES))
    near = cKDTree(wall).query_ball_point(wall[picked], _REACH)
    apart = np.array([layers_apart(wall[rows]) if len(rows) >= _LEAST else np.nan for rows in near])
    at, known = station[on_wall][picked], np.isfinite(apart)
    if known.sum() < _PLACES / 10:
        return []
    doubled = known & (apart > 0)
    count = max(round(bore.length / _WINDOW), 1)
    window = np.minimum((at / bore.length * count).astype(np.intp), count - 1)
    share = np.bincount(window[doubled], minlength=count) / np.maximum(np.bincount(window[known], minlength=count), 1)
    rows = np.flatnonzero(share > _DOUBLED)
    if not len(rows):
        return []
    widest = 100 * float(np.percentile(apart[doubled], 90))
    start, end = rows[0] / count * bore.length, (rows[-1] + 1) / count * bore.length
    return [Warned(
        Code.DOUBLED,
        f"{name_span(start, end)} the wall shows twice, up to {widest:.0f} cm apart, at "
        f"{doubled[known].mean():.0%} of its places: two passes of the scan do not fit each other, or its poses "
        "drifted; register them first: the wall that was built is neither",
        float(start), float(end),
    )]  # fmt: skip


def layers_apart(points: Float[np.ndarray, "n 3"]) -> float:
    """Return the distance of two parallel layers that a patch of points makes up, m; 0 where it is one.

    Two passes lie over each other; panels and ribs lie side by side, and make no layers.
    """
    centred = points - points.mean(axis=0)
    frame = np.linalg.eigh(centred.T @ centred)[1]
    off, place = centred @ frame[:, 0], centred @ frame[:, 1:]
    order = np.argsort(off)
    n, below = len(off), np.arange(1, len(off))
    total = np.cumsum(off[order])[:-1]
    between = total**2 / below + total**2 / (n - below)  # the mean of all is 0
    inner = (below > _HALF * n) & (below < (1 - _HALF) * n)
    cut = int(np.argmax(np.where(inner, between, 0.0)))
    upper = np.zeros(n, bool)
    upper[order[cut + 1 :]] = True
    apart = float(off[upper].mean() - off[~upper].mean())
    if apart < _THINNEST or between[cut] < _APART * float(off @ off):
        return 0.0
    nearest = cKDTree(place).query(place, 2)[1][:, 1]
    by_chance = 2 * upper.mean() * (1 - upper.mean())
    return apart if np.mean(upper != upper[nearest]) > _MIXED * by_chance else 0.0
