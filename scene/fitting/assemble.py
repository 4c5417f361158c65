"""From axis and sections to the bore, with its type of section stretch by stretch: D, horseshoe, circle, or free.

The three parametric types are one family: a semicircular crown on walls that curve inwards with the radius of the
crown (circle), a larger one (horseshoe) or not at all (D), on a flat floor. Each is fitted to the free radial profile,
and Akaike's criterion says whether fewer parameters describe it as well.

Source: Akaike 1974, IEEE Trans. Automatic Control 19(6).
"""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped
from scipy.optimize import least_squares

from scene.bore import POCKET, STRETCH, Bore, uniform_stations
from scene.cloud import Cloud
from scene.errors import FitError, Refusal
from scene.fitting.centreline import smooth_axis
from scene.fitting.section import Sections, fit_sections
from scene.fitting.unroll import probability_known
from scene.geometry import Axis, measure_section

_WINDOW = 2.0  # m of bore that one fit is made to
_PIECE = 0.5  # m of girth that vary for themselves: so many parameters has a free profile
_ROUGH = 0.01  # m, what a wall departs from its type by without being of another
_MOST_UNSURE = 0.01  # m: a wall known worse is not therefore of any type
_ABOVE_FLOOR = 0.30  # m
_BEST = 0.9  # share of the directions that a fit is judged by: a niche is no other type
_SHORTEST = 6.0  # m
_MIN_DIRECTIONS = 60
FREE = "free"
_N_PARAMETERS = {"circle": 3, "d": 3, "horseshoe": 4}


@dataclass(frozen=True)
class TypeFit:
    """One type fitted to one section."""

    type: str  # `circle`, `d`, `horseshoe` or `free`
    crown_radius: float  # m; NaN where free
    wall_radius: float  # m; infinite for a D, NaN where free
    rms: float  # RMS of the best nine tenths of the directions, m; 0 where free
    cost: float  # Akaike's criterion; the least is the best


def find_stretches(bore: Bore, flat_floor: bool, sigma: float) -> Shaped[np.ndarray, " t"]:
    """Finds stretches of one type, of `scene.bore.STRETCH`, that cover the bore from end to end.

    Its walls have the standard deviation `sigma`, m. Without a flat floor, only circle and free profile are tried.
    """
    count = max(round(bore.length / _WINDOW), 1)
    rows = np.minimum((bore.station / max(bore.length, 1e-9) * count).astype(np.intp), count - 1)
    noise = float(np.hypot(_ROUGH, min(sigma, _MOST_UNSURE)))
    windows = [_fit_types(bore.angle, bore.radius[rows == k], flat_floor, noise) for k in range(count)]
    best = [min(fits, key=lambda fit: fit.cost).type for fits in windows]
    result = []
    for first, last in _runs(best, max(round(_SHORTEST / _WINDOW), 1)):
        kind = max(sorted(set(best[first:last])), key=best[first:last].count)
        fits = [next((fit for fit in fits if fit.type == kind), fits[-1]) for fits in windows[first:last]]
        inside = (rows >= first) & (rows < last)
        curvature = float(np.mean([1 / fit.wall_radius for fit in fits]))  # a mean that counts straight walls
        wall_radius = 1 / curvature if curvature else np.inf
        result.append((
            bore.length * first / count, bore.length * last / count, kind, bore.width[inside].mean(),
            bore.height[inside].mean(), np.mean([fit.crown_radius for fit in fits]),
            wall_radius, np.sqrt(np.mean([fit.rms**2 for fit in fits])),
            np.sqrt(np.mean(bore.residual_rms[inside] ** 2)), best[first:last].count(kind) / (last - first),
        ))  # fmt: skip
    return np.array(result, STRETCH)


def _runs(best: list[str], shortest: int) -> list[tuple[int, int]]:
    """Runs of windows of one type, as first window and the one after; a short run joins its longer neighbour."""
    runs = _lengths((kind, 1) for kind in best)
    while len(runs) > 1:
        k = min(range(len(runs)), key=lambda i: runs[i][1])
        if runs[k][1] >= shortest:
            break
        into = max((i for i in (k - 1, k + 1) if 0 <= i < len(runs)), key=lambda i: runs[i][1])
        runs[k] = (runs[into][0], runs[k][1])
        runs = _lengths(runs)
    edges = [0, *itertools.accumulate(length for _, length in runs)]
    return list(itertools.pairwise(edges))


def _lengths(runs: Iterable[tuple[str, int]]) -> list[tuple[str, int]]:
    """Runs of type and length, with neighbours of one type joined."""
    groups = itertools.groupby(runs, key=lambda run: run[0])
    return [(kind, sum(length for _, length in group)) for kind, group in groups]


def _fit_types(angle: np.ndarray, sections: np.ndarray, flat_floor: bool, noise: float) -> list[TypeFit]:
    """Fits every type to the median of some sections; the free profile comes last."""
    radius, wander = np.median(sections, axis=0), float(np.median(sections.std(axis=0)))
    y, z = radius * np.cos(angle), radius * np.sin(angle)
    if flat_floor:
        low = float(np.interp(-np.pi / 2, angle, z))
        y, z = y[z > low + _ABOVE_FLOOR], z[z > low + _ABOVE_FLOOR]
    pieces = float(np.hypot(np.diff(y), np.diff(z)).clip(max=0.5).sum()) / _PIECE
    free = TypeFit(FREE, np.nan, np.nan, 0.0, pieces * np.log(noise**2) + 2 * pieces)
    if len(y) < _MIN_DIRECTIONS:
        return [free]
    kinds = _N_PARAMETERS if flat_floor else {"circle": 3}
    return [*(_fit_type(kind, y, z, pieces, noise, wander) for kind in kinds), free]


def _fit_type(kind: str, y: np.ndarray, z: np.ndarray, pieces: float, noise: float, wander: float) -> TypeFit:
    half = float(np.ptp(y)) / 2
    crown = float(z.max()) - half
    start = [float(y.min()) + half, crown, half] + ([0.5] if kind == "horseshoe" else [])
    bounds = ([-np.inf, -np.inf, 0.3 * half, 0.0][: len(start)], [np.inf, np.inf, 3 * half, 1.0][: len(start)])

    def misfit(shape: np.ndarray) -> np.ndarray:
        bend = {"circle": 1.0, "d": 0.0}.get(kind, shape[-1])
        return _distance_from_type(y - shape[0], z - shape[1], shape[2], bend)

    shape = least_squares(misfit, start, bounds=bounds, loss="soft_l1", f_scale=2 * noise).x
    bend = {"circle": 1.0, "d": 0.0}.get(kind, float(shape[-1]))
    off = np.sort(np.abs(misfit(shape)))
    rms = float(np.sqrt(np.mean(off[: max(int(_BEST * len(off)), 1)] ** 2)))
    wall = float(shape[2]) / bend if bend > 1e-9 else np.inf
    cost = pieces * np.log(rms**2 + wander**2 + noise**2) + 2 * _N_PARAMETERS[kind]
    return TypeFit(kind, float(shape[2]), wall, rms, cost)


def _distance_from_type(y: np.ndarray, z: np.ndarray, radius: float, bend: float) -> np.ndarray:
    """Outward distance from a crown on walls of curvature `bend / radius`, m."""
    crown = np.hypot(y, z) - radius
    if bend < 1e-6:
        return np.where(z > 0, crown, np.abs(y) - radius)
    wall = radius / bend
    return np.where(z > 0, crown, np.hypot(np.abs(y) + wall - radius, z) - wall)


_MIN_COVERAGE = 0.4
_SURE = 0.1  # quantile of the wall's uncertainty: where profiles stand, not between them


def measure_extents(angle: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return width and height of each section, m, `(n,)` each."""
    extents = [measure_section(angle, section) for section in radius]
    return np.array([e.width for e in extents]), np.array([e.height for e in extents])


def bore_from_sections(axis: Axis, sections: Sections) -> Bore:
    """Return the bore over the seen span, from station 0, without lining; raises `FitError` where it holds a room."""
    grid = sections.grid
    start, end = grid.start, grid.start + grid.rows * grid.step
    station = uniform_stations(end - start)
    at = axis.at(station + start)
    rows = np.clip((station + start - grid.start) / grid.step - 0.5, 0, grid.rows - 1)
    low = np.minimum(rows.astype(np.intp), max(grid.rows - 2, 0))
    share = (rows - low)[:, None]
    high = np.minimum(low + 1, grid.rows - 1)
    radius = (1 - share) * sections.radius[low] + share * sections.radius[high]
    width, height = measure_extents(grid.angle, radius)
    require_no_room(station, width)
    seen = sections.weight > 0
    coverage = np.array([seen[max(row - 2, 0) : row + 3].any(axis=0).mean() for row in low])
    padded = np.pad(sections.spread, 2, mode="edge")
    spread = np.mean([padded[low + k] for k in range(5)], axis=0)  # over five rows, one station step
    bore = Bore(
        station, at.position, at.tangent, at.lateral, at.up, width, height, grid.angle, radius,
        spread, coverage, coverage < _MIN_COVERAGE,
        np.empty(0), np.empty(0, POCKET), probability_known(sections.sigma).mean(axis=1)[low],
    )  # fmt: skip
    return replace(bore, stretch=find_stretches(bore, sections.flat_floor, float(np.quantile(sections.sigma, _SURE))))


def find_fold(bore: Bore) -> float | None:
    """Return the first station at which a section cuts the next one, m; `None` where none does."""
    step = np.einsum("nmi,ni->nm", np.diff(bore.surface(), axis=0), bore.tangent[:-1] + bore.tangent[1:])
    folded = np.flatnonzero((step <= 0).any(axis=1))
    return float(bore.station[folded[0]]) if len(folded) else None


_STRAIGHTER = 3  # times that an axis is smoothed over twice the length


def fit_unfolded(
    cloud: Cloud, axis: Axis, cutoff: float, behind: Float[np.ndarray, "k 3"] | None = None
) -> tuple[Sections, Bore]:
    """Fits sections to an axis, which is smoothed further where they fold: at a jump of the wall it may bend sharply.

    `cutoff` is the wavelength that the axis is smooth over, m; see `fit_sections` for `behind`.
    """
    for power in range(1, _STRAIGHTER + 2):
        sections = fit_sections(cloud, axis, behind)
        bore = bore_from_sections(axis, sections)
        if power > _STRAIGHTER or find_fold(bore) is None:
            break
        axis = smooth_axis(axis.position, cutoff * 2**power)
    return sections, bore


_STRAIGHT = 1e-5  # 1/m


def describe_bore(bore: Bore) -> dict[str, Any]:
    """Return residual, coverage, confidence, alignment and types of section, for the manifest.

    `least_plan_radius` is `None` where the bore is straight; parameters that a type of section lacks are left out.
    """
    axis = bore.axis
    bend = float(np.abs(axis.curvature).max())
    return {
        "residual_rms": float(np.sqrt(np.mean(bore.residual_rms**2))),
        "coverage": float(bore.coverage.mean()),
        "confidence": float(bore.confidence.mean()),
        "least_plan_radius": 1 / bend if bend > _STRAIGHT else None,
        "grade": [float(axis.grade.min()), float(axis.grade.max())],
        "sections": [_describe_stretch(stretch) for stretch in bore.stretch],
    }


def _describe_stretch(stretch: np.void) -> dict[str, Any]:
    """One stretch for the manifest; a straight wall has no radius."""
    values = {name: stretch[name].item() for name in stretch.dtype.names or ()}
    return {name: value for name, value in values.items() if isinstance(value, str) or np.isfinite(value)}


_PORTAL = 6.0  # m from an end within which a bore may flare open
_ROOM, _ROOM_LENGTH = 2.0, 5.0  # times the median width; m, longer than a niche


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
                f"{width[first : last + 1].max():.0f} m wide where it is {usual:.1f} m elsewhere: a room, not a tunnel",
                Refusal.ROOM,
            )
