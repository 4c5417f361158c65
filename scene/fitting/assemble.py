"""Axis and sections put together: the bore."""

from dataclasses import replace

import numpy as np

from scene.axis import Axis
from scene.bore import POCKET, Bore, uniform_stations
from scene.fitting import profile
from scene.fitting.branches import require_no_room
from scene.fitting.section import Sections
from scene.fitting.sectiontype import find_stretches
from scene.fitting.sureness import known

_MIN_COVERAGE = 0.4
_SURE = 0.1  # quantile of the wall's uncertainty: where profiles stand, not between them


def measured_extents(angle: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Width and height of each section, m, `(n,)` each."""
    extents = [profile.measure(angle, section) for section in radius]
    return np.array([e.width for e in extents]), np.array([e.height for e in extents])


def from_sections(axis: Axis, sections: Sections) -> Bore:
    """The bore over the seen span, without lining features; stations start at its first end.

    Raises:
        FitError: It holds a room.
    """
    grid = sections.grid
    start, end = grid.start, grid.start + grid.rows * grid.step
    station = uniform_stations(end - start)
    at = axis.at(station + start)
    rows = np.clip((station + start - grid.start) / grid.step - 0.5, 0, grid.rows - 1)
    low = np.minimum(rows.astype(np.intp), max(grid.rows - 2, 0))
    share = (rows - low)[:, None]
    high = np.minimum(low + 1, grid.rows - 1)
    radius = (1 - share) * sections.radius[low] + share * sections.radius[high]
    width, height = measured_extents(grid.angle, radius)
    require_no_room(station, width)
    seen = sections.weight > 0
    coverage = np.array([seen[max(row - 2, 0) : row + 3].any(axis=0).mean() for row in low])
    bore = Bore(
        station, at.position, at.tangent, at.lateral, at.up, width, height, grid.angle, radius,
        _window_mean(sections.spread, low), coverage, coverage < _MIN_COVERAGE,
        np.empty(0), np.empty(0, POCKET), known(sections.sigma).mean(axis=1)[low],
    )  # fmt: skip
    return replace(bore, stretch=find_stretches(bore, sections.flat_floor, float(np.quantile(sections.sigma, _SURE))))


def _window_mean(rows: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Mean over the five rows, one station step, around each place."""
    padded = np.pad(rows, 2, mode="edge")
    return np.mean([padded[at + k] for k in range(5)], axis=0)
