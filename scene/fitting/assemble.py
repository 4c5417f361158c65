"""From axis and sections to the bore."""

from typing import Any

import numpy as np
from jaxtyping import Float

from scene.bore import POCKET, Bore, uniform_stations
from scene.cloud import Cloud
from scene.errors import FitError, Refusal
from scene.fitting.centreline import smooth_axis
from scene.fitting.section import Sections, fit_sections
from scene.geometry import Axis, find_runs, measure_section

_MIN_COVERAGE = 0.4  # of the directions, within two rows: with less seen a section counts as filled


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
    return Bore(
        station, at.position, at.tangent, at.lateral, at.up, width, height, grid.angle, radius,
        spread, coverage, coverage < _MIN_COVERAGE,
        np.empty(0), np.empty(0, POCKET),
    )  # fmt: skip


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
    """Return residual, coverage and alignment for the manifest; a straight bore has no plan radius."""
    axis = bore.axis
    bend = float(np.abs(axis.curvature).max())
    return {
        "residual_rms": float(np.sqrt(np.mean(bore.residual_rms**2))),
        "coverage": float(bore.coverage.mean()),
        "least_plan_radius": 1 / bend if bend > _STRAIGHT else None,
        "grade": [float(axis.grade.min()), float(axis.grade.max())],
    }


_PORTAL = 6.0  # m from an end within which a bore may flare open
_ROOM, _ROOM_LENGTH = 2.0, 5.0  # times the median width; m, longer than a niche


def require_no_room(station: Float[np.ndarray, " n"], width: Float[np.ndarray, " n"]) -> None:
    """Refuses a bore that is twice as wide as usual over more than 5 m; raises `FitError`.

    Stations are uniform, m. What widens within 6 m of an end is a portal.
    """
    usual = float(np.median(width))
    wide = (width > _ROOM * usual) & (station > _PORTAL) & (station < station[-1] - _PORTAL)
    for first, last in find_runs(wide) - np.array([0, 1]):
        if station[last] - station[first] > _ROOM_LENGTH:
            raise FitError(
                f"from station {station[first]:.0f} to {station[last]:.0f} m the bore is "
                f"{width[first : last + 1].max():.0f} m wide where it is {usual:.1f} m elsewhere: a room, not a tunnel",
                Refusal.ROOM,
            )
