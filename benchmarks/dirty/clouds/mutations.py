"""Mutations of clouds that have truth: a window of each at random, changed in one way that no builder may mind.

Walls keep their truth in every mutation. Sizes keep it too, but not under roll and pitch: a floor that leans has no
height above it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import laspy
import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from benchmarks.dirty.truth import Case, Truth, load_truth

WINDOW = (40.0, 60.0)  # m of the bore that a mutation keeps
_MARGIN = 2.0  # m inside a cut that is not judged
_OBLIQUE = np.radians(25.0)  # most that a random cut leans from the section
_REACH = 6.0  # m beside the axis, within which a leaning cut takes part of the bore away
_LEAN = np.radians(15.0)  # most roll and pitch
_STRAYS, _THINNED, _ASIDE = 0.10, 0.10, 30.0


@dataclass(frozen=True)
class Mutant:
    """A cloud with its truth."""

    points: Float[np.ndarray, "p 3"]  # m, or what `stored` makes of them
    truth: Truth  # In the survey frame of the points, m


def read_mutant(case: Case) -> Mutant:
    """Return a case as it is."""
    laz = laspy.read(case.source)
    return Mutant(np.stack([laz.x, laz.y, laz.z], axis=1), load_truth(case))


def take_window(rng: np.random.Generator, whole: Mutant, oblique: bool = False) -> Mutant:
    """Return a piece of 40 to 60 m, cut by upright planes across the axis, or leaning by up to 25° in plan."""
    truth, length = whole.truth, float(whole.truth.station[-1])
    run = min(rng.uniform(*WINDOW), length)
    start = rng.uniform(-5.0, max(length - run, 0.0) + 5.0)
    kept, slack = np.ones(len(whole.points), bool), []
    for station, side in ((start, 1.0), (start + run, -1.0)):
        lean = rng.uniform(-_OBLIQUE, _OBLIQUE) if oblique else 0.0
        slack.append(_MARGIN + _REACH * abs(np.tan(lean)))
        if not 0.0 < station < length:
            continue  # beyond an end of the bore all is kept
        row = int(np.searchsorted(truth.station, station).clip(1, len(truth.axis) - 1))
        normal = Rotation.from_euler("z", lean).apply(truth.axis[row] - truth.axis[row - 1]) * (1.0, 1.0, 0.0)
        kept &= side * ((whole.points - truth.axis[row]) @ normal) > 0.0
    low, high = max(truth.span[0], start + slack[0]), min(truth.span[1], start + run - slack[1])
    at = truth.station[cKDTree(truth.axis).query(truth.wall)[1]]
    wall = truth.wall[(at >= low) & (at <= high)]
    return Mutant(whole.points[kept], replace(truth, wall=wall, span=(low, high), ends=(np.nan, np.nan)))


def _move(whole: Mutant, move: Callable[[np.ndarray], np.ndarray], sizes: bool = True) -> Mutant:
    truth = replace(whole.truth, axis=move(whole.truth.axis), wall=move(whole.truth.wall))
    if not sizes:
        nothing = np.full(len(truth.axis), np.nan)
        truth = replace(truth, axis_above_floor=nothing, width=nothing, height=nothing)
    return Mutant(move(whole.points), truth)


def crop(rng: np.random.Generator, whole: Mutant) -> Mutant:
    """Return an obliquely cut piece."""
    return take_window(rng, whole, oblique=True)


def rotate(rng: np.random.Generator, whole: Mutant) -> Mutant:
    """Return a piece turned by any yaw and by up to 15° of roll and pitch."""
    piece = take_window(rng, whole)
    turn = Rotation.from_euler("ZYX", [rng.uniform(-np.pi, np.pi), *rng.uniform(-_LEAN, _LEAN, 2)])
    centre = piece.points.mean(axis=0)
    return _move(piece, lambda points: turn.apply(points - centre) + centre, sizes=False)


def thin_out(rng: np.random.Generator, whole: Mutant) -> Mutant:
    """Return a piece of which a tenth of the points is left."""
    piece = take_window(rng, whole)
    kept = rng.choice(len(piece.points), round(_THINNED * len(piece.points)), replace=False)
    return replace(piece, points=piece.points[np.sort(kept)])


def stray(rng: np.random.Generator, whole: Mutant) -> Mutant:
    """Return a piece with 10 % of its points anywhere in its box, which is 3 m larger to all sides."""
    piece = take_window(rng, whole)
    low, high = piece.points.min(axis=0) - 3.0, piece.points.max(axis=0) + 3.0
    more = rng.uniform(low, high, (round(_STRAYS / (1.0 - _STRAYS) * len(piece.points)), 3))
    return replace(piece, points=np.concatenate([piece.points, more]))


def mirror(rng: np.random.Generator, whole: Mutant) -> Mutant:
    """Return a piece with left and right exchanged."""
    moved = _move(take_window(rng, whole), lambda points: points * (-1.0, 1.0, 1.0))
    return replace(moved, truth=replace(moved.truth, middle=-np.asarray(moved.truth.middle)))


def in_mm(rng: np.random.Generator, whole: Mutant) -> Mutant:
    """Return a piece in mm; its truth stays in m."""
    piece = take_window(rng, whole)
    return replace(piece, points=1000.0 * piece.points)


def second_tunnel(rng: np.random.Generator, whole: Mutant) -> Mutant:
    """Return a piece with 60 % of the same bore 30 m aside."""
    piece = take_window(rng, whole)
    inside = (piece.truth.station >= piece.truth.span[0]) & (piece.truth.station <= piece.truth.span[1])
    axis = piece.truth.axis[inside]
    along = (axis[-1] - axis[0]) / np.linalg.norm(axis[-1] - axis[0])
    aside = rng.choice([-1.0, 1.0]) * _ASIDE * np.array([-along[1], along[0], 0.0])
    place = (piece.points - axis[0]) @ along
    low, high = 0.0, float((axis[-1] - axis[0]) @ along)
    other = piece.points[(place > low + 0.2 * (high - low)) & (place < low + 0.8 * (high - low))]
    return replace(piece, points=np.concatenate([piece.points, other + aside]))


MUTATIONS: dict[str, Callable[[np.random.Generator, Mutant], Mutant]] = {
    "crop": crop,
    "rotated": rotate,
    "thinned": thin_out,
    "strays": stray,
    "mirrored": mirror,
    "mm": in_mm,
    "second": second_tunnel,
}
