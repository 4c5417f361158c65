"""Evidence against chance: holes of a wall are pockets only with closed rims, in filled rows, at a clear pitch.

What stands out between two rails is a row of sleepers only where its gaps are alike: rubble leaves gaps of any size.

A hole by itself is a pocket where it looks like the clear ones: the cells about it lack as much of the wall, and have
returns behind it as often. A pocket mortared flush, or a wall that is thin by chance, does not.

Strays, shadows of pillars and a wall that was fitted too far in all make holes with returns behind them. A shadow has
no rim: the wall beside it is missing as well. Strays leave most places of a row empty, and their pitch is the best of
the many that were tried.

Pockets of turned rings fill no rows, but stand at the same few places along every ring. Pitch and places are those that
the stations of all holes agree on best, whatever their angles; of pitches that share harmonics it is the one with the
fewest places. They need a pitch that all clear holes of the wall agree on, each place of the bore counted once whatever
stands around it, few holes elsewhere, and most rings.

Source: the ratio of likelihoods (Neyman and Pearson 1933); Rayleigh's test of uniformity, `P(|mean wave| > c) = exp(-p
c²)` for p phases, over the independent pitches; Buccheri's over the first harmonics (1983, Astronomy and Astrophysics
128), which see two places that cancel in the first; binomial test for gaps.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Shaped
from scipy.ndimage import binary_dilation, maximum_filter1d, uniform_filter, uniform_filter1d
from scipy.special import bdtrc, expit, logit, logsumexp
from scipy.stats import chi2

from scene.fitting.mould import CLEAR, MODES, Holes, patches
from scene.fitting.section import Sections
from scene.fitting.unroll import Grid

N_HARMONICS = 4
_BIN = 0.02  # m of station, in which holes are counted
_FINER = 16  # times that the frequencies tried are finer than the length tells apart
_STEPS = np.linspace(-1.0, 1.0, 81)  # of such a frequency, tried at the end
_FOLD = 0.02  # m along a ring, in which places are looked for
_BLUR = 5  # of these
_PLACE = 0.1  # of the fullest place
_RATIOS = (1.0, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2.0)  # of pitches that share harmonics
_NARROW = 0.05  # m along a ring
CROWD = 0.2  # m
NEAR_PLACE = 0.10  # m along the bore


@dataclass(frozen=True)
class Ring:
    """Pitch and places that all rings have in common."""

    pitch: float  # Length of a ring, m
    place: Float[np.ndarray, " k"]  # Places of pockets, m after the stations that are multiples of the pitch

    def holds(self, station: Float[np.ndarray, " p"]) -> Bool[np.ndarray, " p"]:
        """Return which stations, m, lie at a place."""
        apart = np.mod(station[:, None] - self.place + 0.5 * self.pitch, self.pitch) - 0.5 * self.pitch
        return np.asarray(np.abs(apart).min(axis=1, initial=np.inf) < NEAR_PLACE)

    def number(self, station: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """Return the number of each station's ring, counted from ring joint or from place."""
        return np.floor((station - self.place[0]) / self.pitch + 0.5)


def find_ring(station: Float[np.ndarray, " p"], length: float, pitches: tuple[float, float]) -> Ring:
    """Finds the pitch, and the places in a ring, that holes agree on best; whether they do is for others to say.

    Takes the stations of at least one hole, the length of the bore, and the least and largest pitch, m.
    """
    pitch = _find_pitch(station, length, pitches)
    bins = max(round(pitch / _FOLD), 8)
    count = np.bincount((np.mod(station, pitch) / pitch * bins).astype(int) % bins, minlength=bins).astype(float)
    full = uniform_filter1d(count, _BLUR, mode="wrap")
    most = maximum_filter1d(full, 2 * round(NEAR_PLACE / _FOLD) + 1, mode="wrap")
    peak = np.flatnonzero((full == most) & (full > _PLACE * full.max()))
    return Ring(pitch, _centre(station, (peak + 0.5) * pitch / bins, pitch))


def _find_pitch(station: Float[np.ndarray, " p"], length: float, pitches: tuple[float, float]) -> float:
    size = 1 << int(np.ceil(np.log2(_FINER * max(length, 4 * pitches[1]) / _BIN)))
    count = np.bincount(np.clip((station / _BIN).astype(int), 0, size - 1), minlength=size)
    power = np.abs(np.fft.rfft(count)) ** 2
    step = 1.0 / (size * _BIN)  # 1/m
    tried = np.arange(int(np.ceil(1.0 / (pitches[1] * step))), int(1.0 / (pitches[0] * step)) + 1)
    best = tried[int(np.argmax(sum(power[k * tried] for k in range(1, N_HARMONICS + 1))))]
    near = (best + _STEPS) * step
    pitch = float(1.0 / near[int(np.argmax(agreement(station, near)))])
    like = [pitch * ratio for ratio in _RATIOS if pitches[0] <= pitch * ratio <= pitches[1]]
    return max(like, key=lambda one: _information(station, one))


def _information(station: Float[np.ndarray, " p"], pitch: float) -> float:
    """Return by how much the places of a pitch, m, make these stations likelier than none, less what chance would.

    Source: Miller 1955, on the bias of the information of a sample.
    """
    bins = round(pitch / _NARROW)
    count = np.bincount((np.mod(station, pitch) / pitch * bins).astype(int) % bins, minlength=bins)
    full = count[count > 0]
    return float(full @ np.log(full * bins / len(station))) - 0.5 * (bins - 1)


def one_a_bin(station: Float[np.ndarray, " p"]) -> Float[np.ndarray, " b"]:
    """Return one station for all those within 20 cm, m: holes beside each other may have one cause."""
    station = np.sort(station)
    _, first, count = np.unique((station / CROWD).astype(int), return_index=True, return_counts=True)
    return station[first + count // 2]


def agreement(station: Float[np.ndarray, " p"], frequency: Float[np.ndarray, " f"]) -> Float[np.ndarray, " f"]:
    """Return Buccheri's statistic of stations, m, at frequencies, 1/m; by chance χ² with two degrees a harmonic."""
    wave = np.exp(2j * np.pi * station[None] * frequency[:, None])
    total = np.zeros(len(frequency))
    for k in range(1, N_HARMONICS + 1):
        total += np.abs((wave**k).sum(axis=1)) ** 2
    return 2.0 * total / max(len(station), 1)


def _centre(station: Float[np.ndarray, " p"], place: Float[np.ndarray, " k"], pitch: float) -> Float[np.ndarray, " k"]:
    """Return each place moved to the mean of the holes near it, m; those that meet there are one."""
    apart = np.mod(station[:, None] - place + 0.5 * pitch, pitch) - 0.5 * pitch
    near = np.abs(apart) < NEAR_PLACE
    moved = np.sort(np.mod(place + (apart * near).sum(axis=0) / np.maximum(near.sum(axis=0), 1), pitch))
    return moved[np.diff(moved, prepend=moved[-1] - pitch) > NEAR_PLACE] if len(moved) > 1 else moved


_BEYOND_RIM = 2  # cells beyond the edge of a hole in which the wall must stand again
_BEHIND = 0.055  # m, four to five standard deviations of a wall: a return further out lies behind it
_EXPECTED = (31, 21)  # cells of 5 cm × 1° over which the wall is alike
_LEAST_BEHIND = 1 / (_EXPECTED[0] * _EXPECTED[1])  # share of the wall's cells with a return behind: one among them
_MOUTH = (9, 7)  # cells about the middle of a hole that are no wall
_PRIOR = 1.0  # points on the wall, or holes, that a cell of the looks starts with as wall
_SHIFTS = [(row, column) for row in (-1, 0, 1) for column in (-1, 0, 1)]
_SAME_PLACE = 0.05  # m along the rings
_ROUNDS = 8  # after which the odds hardly change
_CHANCE = 1e-4  # probability that random stations have a pitch as clear as the one found
_MIN_FILLED = 0.2  # of the places that rows and joints make; a true lining fills most, a staggered one half
_MIN_IN_PLACE = 0.5  # of the clear holes beyond those that chance puts there
_MIN_RINGS = 0.5  # of the rings, with a hole each
_ROW_APART = 0.25  # m of girth between two rows
_ALIKE = 0.15  # of the median gap: gaps that differ from it, or from twice it, by less are alike
_ALIKE_BY_CHANCE = 0.3  # share of alike gaps among random ones; 0.24 where they are 20 cm and an exponential of 40 cm


def open_rims(
    deficit: Float[np.ndarray, "rows cols"],
    grid: Grid,
    row: Float[np.ndarray, " p"],
    column: Float[np.ndarray, " p"],
    size: tuple[float, float],
    radius: float,
) -> Float[np.ndarray, " p"]:
    """Return the share of the wall that is missing around each hole: about 0 for a pocket, 1 for a shadow's part.

    `deficit` is the share of the wall's returns that each cell lacks. The middle of a hole is given in cells, its
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

    A cell has points on the wall by Poisson's law, of the mean that the wall around has, or of the share of it that
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
        share = 1 - (1 - hollow) * (1 - by_chance)
        beyond = behind * np.log(share / by_chance) + (1 - behind) * np.log((1 - share) / (1 - by_chance))
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
    share = np.maximum(uniform_filter(wall, _EXPECTED, mode=MODES), _LEAST_BEHIND)
    seen = (sections.deepest > _BEHIND) * wall
    points = uniform_filter(sections.support * wall, _EXPECTED, mode=MODES) / share
    behind = uniform_filter(seen, _EXPECTED, mode=MODES) / share
    return np.maximum(points, 0.0), np.clip(behind, _LEAST_BEHIND, 0.5)


def _looks_of(
    clear: Holes, fields: tuple[np.ndarray, ...], reach: tuple[int, int]
) -> tuple[Float[np.ndarray, "r c"], Float[np.ndarray, "r c"]]:
    """Share of the wall's points that clear holes leave in each cell, and the chance that they show one behind it.

    `fields` are points on the wall, those without a hole, whether one lies behind, and the chance of it without a hole.
    """
    found, expected, behind, by_chance = (patches(field, clear, *reach).sum(axis=0) for field in fields)
    left = (found + _PRIOR) / (expected + _PRIOR)
    wall = (by_chance + _PRIOR * _LEAST_BEHIND) / (len(clear.row) + _PRIOR)
    share = (behind + _PRIOR * wall) / (len(clear.row) + _PRIOR)
    return left, np.clip((share - wall) / (1 - wall), 0.0, None)


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
        share = (total[after] - total[first] + 0.5) / (after - first + 1.0)
        odds = ratio + logit(share)
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


def turned_more_than_chance(
    station: Float[np.ndarray, " p"], ring: Ring, length: float, pitches: tuple[float, float]
) -> bool:
    """Return whether holes stand at the same places of every ring in a way that random holes would not.

    `station` are those of all clear holes, m, whether at such a place or not; `ring` is fitted to them, between the
    least and largest of `pitches`, m.
    """
    each = one_a_bin(station)
    tried = max(N_HARMONICS * length * (1 / pitches[0] - 1 / pitches[1]), 1.0)
    if chi2.sf(float(agreement(each, np.array([1 / ring.pitch]))[0]), 2 * N_HARMONICS) * tried > _CHANCE:
        return False
    held = ring.holds(station)
    by_chance = min(2 * NEAR_PLACE * len(ring.place) / ring.pitch, 1.0)
    rings = len(np.unique(ring.number(station[held])))
    return bool(
        held.mean() > by_chance + _MIN_IN_PLACE * (1.0 - by_chance) and rings > _MIN_RINGS * length / ring.pitch
    )


def steadier_than_chance(gaps: Float[np.ndarray, " g"]) -> bool:
    """Return whether more gaps between sleepers are alike than between things that lie at random.

    Gaps are distances of neighbours, m; where one was not seen, the gap is double.
    """
    if not len(gaps):
        return False
    usual = float(np.median(gaps))
    alike = int((np.minimum(np.abs(gaps - usual), np.abs(gaps - 2 * usual)) < _ALIKE * usual).sum())
    return bool(bdtrc(alike - 1, len(gaps), _ALIKE_BY_CHANCE) < _CHANCE)
