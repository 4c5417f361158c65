"""Evidence against chance: holes of a wall are pockets only with closed rims, in filled rows, at a clear pitch.

What stands out between two rails is a row of sleepers only where its gaps are alike: rubble leaves gaps of any size.

Strays, shadows of pillars and a wall that was fitted too far in all make holes with returns behind them. A shadow has
no rim: the wall beside it is missing as well. Strays leave most places of a row empty, and their pitch is the best of
the many that were tried.

Pockets of turned rings fill no rows. They need a pitch that all clear holes of the wall agree on, each place of the
bore counted once whatever stands around it, few holes elsewhere, and most rings.

Source: Rayleigh's test of uniformity, `P(|mean wave| > c) = exp(-p c²)` for p phases, over the independent pitches;
Buccheri's over the first harmonics; binomial test for gaps.
"""

import numpy as np
from jaxtyping import Float, Shaped
from scipy.ndimage import uniform_filter
from scipy.special import bdtrc
from scipy.stats import chi2

from scene.fitting.turned import N_HARMONICS, NEAR_PLACE, Ring, agreement, one_a_bin
from scene.fitting.unroll import Grid

_BEYOND_RIM = 2  # cells beyond the edge of a hole in which the wall must stand again
_MODES = ("nearest", "wrap")
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

    Args:
        deficit: Share of the wall's returns that each cell lacks.
        grid: Cells of the wall.
        row: Middle of each hole, in cells.
        column: The same around.
        size: Length and width of a hole, m.
        radius: Distance of the wall from the axis, m.
    """
    smooth = uniform_filter(deficit, (3, 3), mode=_MODES)
    reach = (size[0] / 2 / grid.step, size[1] / 2 / (2 * np.pi * radius / grid.columns))
    sides = []
    for along, around in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        at = np.rint(row + along * (reach[0] + _BEYOND_RIM)).astype(np.intp)
        beside = np.rint(column + around * (reach[1] + _BEYOND_RIM)).astype(np.intp)
        sides.append(smooth[np.clip(at, 0, grid.rows - 1), beside % grid.columns])
    return np.mean(sides, axis=0)


def more_than_chance(
    pocket: Shaped[np.ndarray, " p"], joints: Float[np.ndarray, " r"], pitches: tuple[float, float], radius: float
) -> bool:
    """Return whether pockets stand at their joints in a way that random holes would not.

    Args:
        pocket: Pockets, of `scene.bore.POCKET`.
        joints: Ring joints fitted to them, m.
        pitches: Least and largest pitch that was tried, m.
        radius: Distance of the wall from the axis, m.
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

    Args:
        station: Stations of all clear holes of the wall, m, whether at such a place or not.
        ring: Pitch and places fitted to them.
        length: Length of the bore, m.
        pitches: Least and largest pitch that was tried, m.
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

    Args:
        gaps: Distances of neighbours, m; where one was not seen, the gap is double.
    """
    if not len(gaps):
        return False
    usual = float(np.median(gaps))
    alike = int((np.minimum(np.abs(gaps - usual), np.abs(gaps - 2 * usual)) < _ALIKE * usual).sum())
    return bool(bdtrc(alike - 1, len(gaps), _ALIKE_BY_CHANCE) < _CHANCE)
