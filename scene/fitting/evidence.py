"""Holes of a wall: the mould that they come from, and the evidence that they are pockets and no chance.

Pockets have closed rims, stand in filled rows and at a clear pitch; place, size and depth are measured on all of them.

What stands out between two rails is a row of sleepers only where its gaps are alike: rubble leaves gaps of any size.

A hole by itself is a pocket where it looks like the clear ones: the cells about it lack as much of the wall, and have
returns behind it as often. A pocket mortared flush, or a wall that is thin by chance, does not.

Strays, shadows of pillars and a wall that was fitted too far in all make holes with returns behind them. A shadow has
no rim: the wall beside it is missing as well. Strays leave most places of a row empty, and their pitch is the best of
the many that were tried.

Source: the ratio of likelihoods (Neyman and Pearson 1933); Rayleigh's test of uniformity, `P(|mean wave| > c) = exp(-p
c²)` for p phases, over the independent pitches; binomial test for gaps.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy.ndimage import binary_dilation, uniform_filter
from scipy.special import bdtrc, expit, logit, logsumexp

from scene.fitting.section import Sections
from scene.fitting.unroll import Grid

CLEAR = 0.32  # score of a hole that nobody doubts
MIN_DEPTH = 0.06  # m behind the wall that no wall reaches
MODES = ("nearest", "wrap")
_PROFILE = 0.30  # half window for the common size, m
_SIDE = 0.5  # weight of a return behind the wall against a missing one on it
_OVERSHOOT = 0.7  # of the wall's spread: how far the deepest of a few returns lies beyond the surface, measured
_DEEP_FRACTION = 0.75  # quantile over pockets of their deepest return


@dataclass(frozen=True)
class Holes:
    """Holes of the unrolled wall: cell and how clear each is."""

    row: Int[np.ndarray, " p"]
    column: Int[np.ndarray, " p"]
    score: Float[np.ndarray, " p"]

    def where(self, keep: Bool[np.ndarray, " p"]) -> "Holes":
        return Holes(self.row[keep], self.column[keep], self.score[keep])


def patches(field: np.ndarray, holes: Holes, rows: int, columns: int) -> Float[np.ndarray, "p r c"]:
    """Return the field around each hole; beyond the ends the last row holds, around it wraps."""
    at_row = np.clip(holes.row[:, None] + np.arange(-rows, rows + 1), 0, field.shape[0] - 1)
    at_column = (holes.column[:, None] + np.arange(-columns, columns + 1)) % field.shape[1]
    return field[at_row[:, :, None], at_column[:, None, :]]


def refine_positions(
    deficit: np.ndarray, sections: Sections, holes: Holes
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Row and column of each hole's centre of gravity, in cells.

    The side that faces the scanner is seen through the mouth and blurs that rim, so that the hole alone would lie
    4 cm off; being the rim, it counts half.
    """
    missing = np.maximum(patches(deficit, holes, 4, 3), 0.0) ** 2
    side = patches((sections.deepest > MIN_DEPTH).astype(float), holes, 4, 3)
    patch = missing + _SIDE * side
    mass = np.maximum(patch.sum(axis=(1, 2)), 1e-9)
    row = holes.row + (patch.sum(axis=2) @ np.arange(-4, 5)) / mass
    column = holes.column + (patch.sum(axis=1) @ np.arange(-3, 4)) / mass
    return row, column


def slopes(sections: Sections, holes: Holes) -> Float[np.ndarray, " p"]:
    """Cosine between the wall's normal and the radius at each hole; cells on an oblique wall are longer."""
    around = 2 * np.pi / sections.grid.columns
    wall = sections.radius
    before, after = (wall[holes.row, (holes.column + step) % wall.shape[1]] for step in (-3, 3))
    lean = (after - before) / (6 * around) / wall[holes.row, holes.column]
    return 1 / np.sqrt(1 + lean**2)


def common_size(deficit: np.ndarray, sections: Sections, holes: Holes, slope: np.ndarray) -> tuple[float, float]:
    """Length and width of the mould, m, from the mean hole, along and around.

    A voxel that the rim crosses still holds a wall point, so the hole in the thinned cloud is one voxel short each way.
    """
    grid = sections.grid
    across = sections.radius[holes.row, holes.column] * 2 * np.pi / grid.columns / slope  # m a column
    rows, columns = int(_PROFILE / grid.step), int(_PROFILE / np.median(across))
    mean = patches(deficit, holes, rows, columns).mean(axis=0)
    mean = mean - np.median(mean)
    core = mean[rows - 3 : rows + 4, columns - 3 : columns + 4]
    along, around = core.sum(axis=1), core.sum(axis=0)
    length = _spread(along) * grid.step
    width = _spread(around) * float(np.median(across))
    return float(np.clip(length + sections.voxel, 0.05, 0.5)), float(np.clip(width + sections.voxel, 0.05, 0.5))


def _spread(profile: Float[np.ndarray, " k"]) -> float:
    """Width, in cells, of the box with the profile's second moment, less that of one cell."""
    weight = np.maximum(profile, 0.0)
    at = np.arange(len(profile)) - len(profile) // 2
    mass = weight.sum()
    if mass <= 0:
        return 1.0
    centre = (weight @ at) / mass
    variance = (weight @ (at - centre) ** 2) / mass
    return float(np.sqrt(max(12 * variance - 1.0, 1.0)))


def common_depth(sections: Sections, holes: Holes, slope: np.ndarray) -> float:
    """Depth of the mould, m, from the pockets whose backs are seen, less the noise of the deepest return."""
    deepest = patches(sections.deepest, holes, 4, 2).max(axis=(1, 2)) * slope
    return float(np.quantile(deepest, _DEEP_FRACTION) - _OVERSHOOT * np.median(sections.spread))


_BEYOND_RIM = 2  # cells beyond the edge of a hole in which the wall must stand again
_BEHIND = 0.055  # m, four to five standard deviations of a wall: a return further out lies behind it
_EXPECTED = (31, 21)  # cells of 5 cm × 1° over which the wall is alike
_LEAST_BEHIND = 1 / (_EXPECTED[0] * _EXPECTED[1])  # fraction of the wall's cells with a return behind: one among them
_MOUTH = (9, 7)  # cells about the middle of a hole that are no wall
_PRIOR = 1.0  # points on the wall, or holes, that a cell of the looks starts with as wall
_SHIFTS = [(row, column) for row in (-1, 0, 1) for column in (-1, 0, 1)]
_SAME_PLACE = 0.05  # m along the rings
_ROUNDS = 8  # after which the odds hardly change
_CHANCE = 1e-4  # probability that random stations have a pitch as clear as the one found
_MIN_FILLED = 0.2  # of the places that rows and joints make; a true lining fills most, a staggered one half
_ROW_APART = 0.25  # m of girth between two rows
_ALIKE = 0.15  # of the median gap: gaps that differ from it, or from twice it, by less are alike
_ALIKE_BY_CHANCE = 0.3  # alike of random gaps, as a fraction; 0.24 where they are 20 cm and an exponential of 40 cm


def open_rims(
    deficit: Float[np.ndarray, "rows cols"],
    grid: Grid,
    row: Float[np.ndarray, " p"],
    column: Float[np.ndarray, " p"],
    size: tuple[float, float],
    radius: float,
) -> Float[np.ndarray, " p"]:
    """Return the fraction of the wall that is missing around each hole: about 0 for a pocket, 1 for a shadow's part.

    `deficit` is the fraction of the wall's returns that each cell lacks. The middle of a hole is given in cells, its
    length and width, and the distance of the wall from the axis, `radius`, in m.
    """
    smooth = uniform_filter(deficit, (3, 3), mode=MODES)
    reach = (size[0] / 2 / grid.step, size[1] / 2 / (2 * np.pi * radius / grid.columns))
    sides = []
    for along, around in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        at = np.rint(row + along * (reach[0] + _BEYOND_RIM)).astype(np.intp)
        beside = np.rint(column + around * (reach[1] + _BEYOND_RIM)).astype(np.intp)
        sides.append(smooth[np.clip(at, 0, grid.rows - 1), beside % grid.columns])
    return np.mean(sides, axis=0)


def pocket_over_wall(sections: Sections, holes: Holes, size: tuple[float, float]) -> Float[np.ndarray, " p"]:
    """Return how much likelier the returns about each hole are with a pocket there than with wall, as a logarithm.

    A cell has points on the wall by Poisson's law, of the mean that the wall around has, or of the fraction of it that
    clear holes leave; and has returns behind the wall as often as the wall around or, more, as clear holes do. The
    middle may be a cell off, each way as likely. Cells are taken as independent. Without clear holes the result is 0.

    Args:
        sections: The wall, and what was measured of it.
        holes: Holes, with the middle of each.
        size: Length along and width around of the pockets, m: with a cell of rim, the cells that tell.
    """
    points, chance = _wall_around(sections, holes)
    fields = sections.support, points, (sections.deepest > _BEHIND).astype(float), chance
    across = 2 * np.pi * float(np.median(sections.radius)) / sections.grid.columns
    reach = round(0.5 * size[0] / sections.grid.step) + 1, round(0.5 * size[1] / across) + 1
    left, hollow = _looks_of(holes.where(holes.score > CLEAR), fields, reach)
    ratios = []
    for row, column in _SHIFTS:
        at = Holes(holes.row + row, holes.column + column, holes.score)
        found, expected, behind, by_chance = (patches(field, at, *reach) for field in fields)
        on_wall = found * np.log(left) + expected * (1 - left)
        fraction = 1 - (1 - hollow) * (1 - by_chance)
        beyond = behind * np.log(fraction / by_chance) + (1 - behind) * np.log((1 - fraction) / (1 - by_chance))
        ratios.append((on_wall + beyond).sum(axis=(1, 2)))
    return np.asarray(logsumexp(ratios, axis=0) - np.log(len(ratios)))


def _wall_around(
    sections: Sections, holes: Holes
) -> tuple[Float[np.ndarray, "rows cols"], Float[np.ndarray, "rows cols"]]:
    """Points on the wall that each cell would have without a hole, and the chance of a return behind it."""
    columns = sections.grid.columns
    cells = np.zeros(sections.radius.shape, bool)
    cells[np.clip(holes.row, 0, len(cells) - 1), holes.column % columns] = True
    cells = binary_dilation(np.concatenate([cells] * 3, axis=1), np.ones(_MOUTH))[:, columns : 2 * columns]
    wall = (~cells).astype(float)
    fraction = np.maximum(uniform_filter(wall, _EXPECTED, mode=MODES), _LEAST_BEHIND)
    seen = (sections.deepest > _BEHIND) * wall
    points = uniform_filter(sections.support * wall, _EXPECTED, mode=MODES) / fraction
    behind = uniform_filter(seen, _EXPECTED, mode=MODES) / fraction
    return np.maximum(points, 0.0), np.clip(behind, _LEAST_BEHIND, 0.5)


def _looks_of(
    clear: Holes, fields: tuple[np.ndarray, ...], reach: tuple[int, int]
) -> tuple[Float[np.ndarray, "r c"], Float[np.ndarray, "r c"]]:
    """Fraction of the wall's points that clear holes leave in each cell, and the chance that they show one behind it.

    `fields` are points on the wall, those without a hole, whether one lies behind, and the chance of it without a hole.
    """
    found, expected, behind, by_chance = (patches(field, clear, *reach).sum(axis=0) for field in fields)
    left = (found + _PRIOR) / (expected + _PRIOR)
    wall = (by_chance + _PRIOR * _LEAST_BEHIND) / (len(clear.row) + _PRIOR)
    fraction = (behind + _PRIOR * wall) / (len(clear.row) + _PRIOR)
    return left, np.clip((fraction - wall) / (1 - wall), 0.0, None)


def odds_by_place(
    ratio: Float[np.ndarray, " p"], station: Float[np.ndarray, " p"], pitch: float
) -> Float[np.ndarray, " p"]:
    """Return the odds that each hole is a pocket, as a logarithm, with what holes at the same place in the rings are.

    A hole's odds before its own returns count are those of all holes within 5 cm along the rings, half a pocket and
    half a wall beside them; they are found together with the odds of those (expectation and maximisation). `ratio` is
    how much likelier the returns about each hole are with a pocket there, as a logarithm.
    """
    place = np.mod(station, pitch)
    order = np.argsort(place)
    around = np.concatenate([place[order] - pitch, place[order], place[order] + pitch])
    first = np.searchsorted(around, place - _SAME_PLACE)
    after = np.searchsorted(around, place + _SAME_PLACE, side="right")
    odds = ratio
    for _ in range(_ROUNDS):
        total = np.concatenate([[0.0], np.cumsum(np.tile(expit(odds)[order], 3))])
        fraction = (total[after] - total[first] + 0.5) / (after - first + 1.0)
        odds = ratio + logit(fraction)
    return odds


def more_than_chance(
    pocket: Shaped[np.ndarray, " p"], joints: Float[np.ndarray, " r"], pitches: tuple[float, float], radius: float
) -> bool:
    """Return whether pockets, of `scene.bore.POCKET`, stand at their joints, m, in a way that random holes would not.

    `pitches` are the least and largest that were tried, m; `radius` is the distance of the wall from the axis, m.
    """
    if len(joints) < 2 or not len(pocket):
        return False
    pitch = float(np.median(np.diff(joints)))
    length = float(joints[-1] - joints[0]) + pitch
    clear = abs(np.exp(2j * np.pi * pocket["station"] / pitch).mean())
    tried = max(length * (1 / pitches[0] - 1 / pitches[1]), 1.0)
    if len(pocket) * clear**2 < np.log(tried / _CHANCE):
        return False
    around = np.sort(pocket["angle"]) * radius
    rows = 1 + int((np.diff(around) > _ROW_APART).sum())
    return len(pocket) > _MIN_FILLED * 2 * len(joints) * rows


def steadier_than_chance(gaps: Float[np.ndarray, " g"]) -> bool:
    """Return whether more gaps between sleepers are alike than between things that lie at random.

    Gaps are distances of neighbours, m; where one was not seen, the gap is double.
    """
    if not len(gaps):
        return False
    usual = float(np.median(gaps))
    alike = int((np.minimum(np.abs(gaps - usual), np.abs(gaps - 2 * usual)) < _ALIKE * usual).sum())
    return bool(bdtrc(alike - 1, len(gaps), _ALIKE_BY_CHANCE) < _CHANCE)
