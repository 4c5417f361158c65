"""Walls that nobody saw stand straight, and an axis that makes sections fold is smoothed until none do."""

import numpy as np
import pytest

from scene.fitting import section
from scene.fitting.assemble import find_fold, fit_unfolded
from scene.fitting.unroll import fill_sides
from scene.geometry import axis_through
from tests.scene import railway
from tests.scene.fits import bore_about, fitted, thin
from tests.scene.railway import World, arch
from tests.scene.shapes import PLACE

L = 18.0
ARCH = World(arch(5.5, 6.0, 3.2), L)


def test_a_gap_in_a_wall_is_closed_by_a_line_and_those_of_crown_and_floor_stay():
    angle = -np.pi + 2 * np.pi * (np.arange(120) + 0.5) / 120
    square = 2.0 / np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle)))
    for middle, known in ((0.0, True), (np.pi, True), (np.pi / 2, False), (-np.pi / 2, False)):
        unseen = np.abs(np.angle(np.exp(1j * (angle - middle)))) < np.deg2rad(30)
        filled = fill_sides(np.where(unseen, np.nan, square)[None], angle)[0]
        assert np.isfinite(filled[unseen]).all() == known
        np.testing.assert_allclose(filled[np.isfinite(filled)], square[np.isfinite(filled)], atol=1e-9)


def test_a_wall_goes_on_to_an_end_as_it_was_before_and_no_further_than_told():
    angle = -np.pi + 2 * np.pi * (np.arange(120) + 0.5) / 120
    square = 2.0 / np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle)))
    walls = np.repeat(square[None], 10, axis=0)
    gap = (angle > np.deg2rad(-60)) & (angle < np.deg2rad(50))  # from the floor, past both corners, to the ceiling
    walls[4:, gap] = np.nan
    line = fill_sides(walls, angle)[4:, gap]
    assert (square[gap] - line).max() > 0.5, "the line from floor to ceiling cuts the wall off"
    filled = fill_sides(walls, angle, 2)
    np.testing.assert_array_equal(filled[:6], np.repeat(square[None], 6, axis=0))
    np.testing.assert_array_equal(filled[6:, gap], line[2:])
    np.testing.assert_array_equal(fill_sides(walls[::-1], angle, 2), filled[::-1])
    walls[-1] = square  # seen again: no end
    np.testing.assert_array_equal(fill_sides(walls, angle, 2)[4:9, gap], line[:5])


def test_the_bore_keeps_its_width_where_a_scan_ends_aslant(monkeypatch):
    points = ARCH.scan(railway.terrestrial(), railway.stations(L), 0.004) - PLACE
    unseen = (points[:, 1] > -1.0) & (points[:, 0] > L - 0.9 - 0.2 * points[:, 1])
    cloud = thin(points[~unseen] + PLACE, 0.07)

    def off() -> float:
        return float(np.abs(fitted(cloud, ARCH.middle)[0].width - 5.5).max())

    assert off() < 0.03
    monkeypatch.setattr(section, "_GOES_ON", 0.0)
    assert off() > 0.2


def test_a_wall_that_nobody_saw_stands_straight_between_crown_and_floor(monkeypatch):
    points = ARCH.scan(railway.terrestrial(), railway.stations(L), 0.004) - PLACE
    unseen = (points[:, 1] > 2.70) & (points[:, 2] - 0.01 * points[:, 0] < 3.2)
    cloud = thin(points[~unseen] + PLACE, 0.07)

    def width() -> np.ndarray:
        return fitted(cloud, ARCH.middle)[0].width[8:-8]

    assert np.abs(width() - 5.5).max() < 0.10
    monkeypatch.setattr(section, "fill_sides", lambda wall, angle, reach: wall)
    assert np.median(width()) > 6.0


def test_an_axis_that_bends_so_sharply_that_sections_fold_is_smoothed():
    cloud = thin(ARCH.scan(railway.terrestrial(), railway.stations(L), 0.004), 0.07)
    along = np.arange(0.0, L + 0.1, 0.5)
    jump = 0.9 / (1.0 + np.exp((L / 2 - along) / 0.12))  # as at the end of a platform
    path = np.column_stack([along, jump - 0.4, 2.9 + 0.01 * along]) + PLACE - cloud.origin
    axis = axis_through(path, 0.25)
    assert find_fold(bore_about(axis, cloud)) is not None
    _, bore = fit_unfolded(cloud, axis, 12.0)
    assert find_fold(bore) is None
    assert np.abs(bore.axis.curvature).max() < 0.3
    assert np.median(bore.width) == pytest.approx(5.5, abs=0.05)
