"""Cleaning cuts away by place and cause, moves nothing, and refuses by its name a cloud without a bore."""

import numpy as np
import pytest

from scene.bore import Bore
from scene.cleaning.sort import Cleaned, end_stations
from scene.cleaning.tube import Tube as WallTube
from scene.cleaning.tube import measure_tube
from scene.errors import Cause, FitError
from scene.fitting.unroll import Grid, cell_medians, fill_holes, fill_nearest
from scene.geometry import Around
from tests.scene import fits
from tests.scene.fits import thin
from tests.scene.shapes import PLACE, Box, Tube, cavity, placed

LENGTH, MIDDLE = 30.0, 2.75  # m; mid-height of `Tube`
MAIN = Tube((0, 0), (LENGTH, 0))
ORIENTATION = (0.4, 0.1)


def cleaned(points: np.ndarray) -> Cleaned:
    result = fits.cleaned(thin(points))
    fits.keep(fits.told(result))
    return result


def arch(*others: Tube | Box) -> np.ndarray:
    """The arch along x with its floor at 0, m."""
    return cavity(MAIN, *others) - PLACE


def turned(points: np.ndarray) -> np.ndarray:
    return placed(points, *ORIENTATION)


def turned_back(result: Cleaned, points: np.ndarray) -> np.ndarray:
    """Points of a result in the arch's own frame, `(n, 3)`, m."""
    back = np.stack([placed(unit, *ORIENTATION) - PLACE for unit in np.eye(3)])
    return (points + result.cloud.origin - PLACE) @ back.T


def axis_offsets(result: Cleaned) -> np.ndarray:
    """Station, lateral and upward place of the axis in the arch's own frame, `(n, 3)`, m."""
    return turned_back(result, result.axis.position)


def causes(result: Cleaned) -> dict[str, int]:
    return {Cause(index): int((result.cause == index).sum()) for index in np.unique(result.cause)}


def require_axis_in_the_middle(result: Cleaned, within: float = 0.03) -> None:
    station, aside, up = axis_offsets(result).T
    inner = (station > 2) & (station < LENGTH - 2)
    assert inner.sum() > LENGTH - 8
    assert np.abs(aside[inner]).max() < within
    assert np.abs(up[inner] - MIDDLE).max() < within


def box(rng: np.random.Generator, low: tuple, high: tuple, count: int) -> np.ndarray:
    """Points on the sides and top of a box, m."""
    points = rng.uniform(low, high, (count, 3))
    face = rng.integers(0, 5, count)
    for axis in range(3):
        points[face == axis, axis] = low[axis] if axis < 2 else high[axis]
    for axis in (0, 1):
        points[face == 3 + axis, axis] = high[axis]
    return points


def cutting(rng: np.random.Generator) -> np.ndarray:
    """Ground of 10 m beyond the far mouth, with slopes on both sides that begin at the walls."""
    x, y = rng.uniform(LENGTH, LENGTH + 10, 15_000), rng.uniform(-8, 8, 15_000)
    return np.stack([x, y, np.maximum(np.abs(y) - 2.5, 0.0) + rng.normal(0, 0.05, len(x))], axis=1)


def test_strays_anywhere_move_neither_axis_nor_ends():
    points = arch()
    rng = np.random.default_rng(1)
    strays = rng.uniform(points.min(axis=0) - 4, points.max(axis=0) + 4, (len(points) // 20, 3))
    result = cleaned(turned(np.concatenate([points, strays])))
    require_axis_in_the_middle(result)
    assert causes(result)[Cause.SCATTERED] > 0.5 * len(strays)
    station = axis_offsets(result)[:, 0]
    assert np.ptp(station) == pytest.approx(LENGTH, abs=1.6)  # sections stand a metre apart


def test_a_cutting_is_cut_off_where_the_lining_ends_and_reported():
    result = cleaned(turned(np.concatenate([arch(), cutting(np.random.default_rng(2))])))
    require_axis_in_the_middle(result)
    kept = turned_back(result, result.cloud.points)
    assert kept[:, 0].max() == pytest.approx(LENGTH, abs=0.3)
    parts = [part for part in result.removed if part.cause == Cause.BEYOND]
    assert sum(part.points for part in parts) > 5_000
    assert any(min(abs(part.end - part.start - 10), 99) < 1.5 for part in parts)


def test_a_parked_vehicle_is_taken_out_and_leaves_the_floor():
    rng = np.random.default_rng(3)
    points = np.concatenate([arch(), box(rng, (12, -1, 0), (18, 1, 1.8), 12_000)])
    result = cleaned(turned(points))
    require_axis_in_the_middle(result)
    assert causes(result)[Cause.INSIDE] > 4_000
    (part,) = [part for part in result.removed if part.cause == Cause.INSIDE and part.points > 1_000]
    along = sorted(min(part.start - s, part.end - s, key=abs) for s in (12, 18))
    assert part.end - part.start == pytest.approx(6.0, abs=0.6), along


@pytest.mark.parametrize("depth", [*(pytest.param(d, marks=pytest.mark.slow) for d in (1.0, 2.5)), 5.0])
def test_a_niche_or_a_stub_does_not_pull_the_axis_aside(depth):
    result = cleaned(turned(arch(Box((13, 0), (16, 2.5 + depth), 2.5))))
    require_axis_in_the_middle(result)
    warnings = [part.warning for part in result.removed if part.warning]
    assert len(warnings) == (depth > 3)


def test_of_two_tunnels_the_longer_is_built_with_a_warning():
    shorter = cavity(Tube((4, 20), (24, 20))) - PLACE
    result = cleaned(turned(np.concatenate([arch(), shorter])))
    require_axis_in_the_middle(result)
    (part,) = [part for part in result.removed if part.warning]
    assert part.cause == Cause.ELSEWHERE


def test_the_wall_of_a_twin_beside_the_tunnel_is_not_taken_for_its_own():
    twin = Tube((3, 13), (27, 13))
    passage = Tube((14, 0), (14, 13), 2.0, 2.4)
    result = cleaned(turned(arch(twin, passage)))
    require_axis_in_the_middle(result)
    assert {part.cause for part in result.removed if part.warning} <= {Cause.ELSEWHERE, Cause.BRANCH}
    assert any(part.warning for part in result.removed)


def test_an_unseen_wall_does_not_move_the_axis():
    points = arch()
    unseen = (points[:, 1] > 1.5) & (points[:, 2] > 0.05) & (np.abs(points[:, 0] - 15) < 6)
    require_axis_in_the_middle(cleaned(turned(points[~unseen])))


def street(rng: np.random.Generator) -> np.ndarray:
    x, y = rng.uniform(0, 60, 60_000), rng.uniform(-6, 6, 60_000)
    wall = rng.random(60_000) < 0.6
    y = np.where(wall, np.sign(y) * 6, y)
    return np.stack([x, y, np.where(wall, rng.uniform(0, 9, len(x)), 0.0)], axis=1) + rng.normal(0, 0.02, (len(x), 3))


def shaft(rng: np.random.Generator) -> np.ndarray:
    turn = rng.uniform(-np.pi, np.pi, 60_000)
    return np.stack([3 * np.cos(turn), 3 * np.sin(turn), rng.uniform(0, 25, len(turn))], axis=1)


def plane(rng: np.random.Generator) -> np.ndarray:
    return np.column_stack([rng.uniform(0, 40, (60_000, 2)), rng.normal(0, 0.02, 60_000)])


def field(rng: np.random.Generator) -> np.ndarray:
    plan = rng.uniform(0, 60, (60_000, 2))
    return np.column_stack([plan, np.sin(plan[:, 0] / 5) + np.cos(plan[:, 1] / 7)])


def room(_rng: np.random.Generator) -> np.ndarray:
    return cavity(Box((0, 0), (14, 11), 4)) - PLACE


def hall(_rng: np.random.Generator) -> np.ndarray:
    return cavity(Box((0, 0), (40, 30), 6), yaw=0.4) - PLACE


def culvert(_rng: np.random.Generator) -> np.ndarray:
    return cavity(Tube((0, 0), (30, 0), 1.0, 1.2)) - PLACE


@pytest.mark.parametrize(
    ("make", "code"),
    [
        (street, "open"), (shaft, "upright"), (plane, "plane"), (room, "room"), (hall, "room"), (culvert, "narrow"),
        (field, ("no_bore", "open", "plane", "room")),
    ],
)  # fmt: skip
def test_what_is_no_bore_is_refused_by_its_name(make, code):
    with pytest.raises(FitError) as raised:
        cleaned(make(np.random.default_rng(4)) + PLACE)
    fits.keep(str(raised.value))
    assert raised.value.code in (code if isinstance(code, tuple) else (code,))


def test_returns_beyond_64_m_count_as_so_far_in_their_own_cell():
    grid = Grid.over(0.0, 2.0, 0.5, 8)
    found = cell_medians(grid, np.array([2, 2, 2, 4]), np.array([100.0, 90.0, 80.0, 5.0])).ravel()
    np.testing.assert_allclose(found[[2, 4]], [64.0, 5.0], atol=1e-3)


def test_a_wall_unseen_beside_a_train_goes_on_as_before_and_behind():
    field = np.tile(np.linspace(2.0, 3.0, 60), (100, 1))
    field += np.random.default_rng(5).normal(0, 0.005, field.shape)
    seen = field.copy()
    field[30:80, 10:50] = np.nan
    field[5, 5] = np.nan
    filled = fill_holes(field, 4.0)
    fits.keep(filled)
    assert np.abs(filled - seen)[30:80, 10:50].max() < 0.03
    assert np.isnan(filled[5, 5])  # small holes are filled from all around
    assert np.nanmax(np.abs(fill_nearest(field) - seen)) > 0.2  # which would bulge here


@pytest.mark.parametrize(
    ("length", "out", "bore"), [(5.0, 4.0, False), (9.0, 4.0, True), (9.0, 5.9, True), (9.0, 7.6, False)]
)
def test_a_widening_of_a_lay_bys_length_is_bore_and_a_niche_is_not(length, out, bore):
    rng = np.random.default_rng(6)
    station, angle = rng.uniform(0.0, 90.0, 200_000), rng.uniform(-np.pi, np.pi, 200_000)
    beside = (np.abs(station - 45.0) < length / 2) & (np.abs(angle) < 0.5)
    radius = np.where(beside, out, 2.75) + rng.normal(0.0, 0.01, len(station))
    around = Around(station, radius * np.cos(angle), radius * np.sin(angle))
    tube = measure_tube(around, np.ones(len(station)), 90.0, np.full(72, 8.0))
    fits.keep([tube.wall, tube.usual, tube.matched, tube.closed])
    row = round((45.0 - tube.grid.start) / tube.grid.step)
    wall = float(np.median(tube.wall[row - 2 : row + 3][:, np.abs(tube.grid.angle) < 0.3]))
    assert wall == pytest.approx(out if bore else 2.75, abs=0.15)


def test_a_mouth_at_which_no_direction_shows_the_wall_ends_where_its_last_row_does():
    grid = Grid.over(0.0, 40.0, 0.5, 120)
    wall, every = np.full((grid.rows, 120), 2.75), np.ones((grid.rows, 120), bool)
    tube = WallTube(grid, wall, wall, every, every, every, ~every, np.empty((0, 3)))
    rng = np.random.default_rng(8)
    station, turn = rng.uniform(0.0, 40.0, 50_000), rng.uniform(-np.pi, np.pi, 50_000)
    radius = np.where(station > 30.0, 4.0, 2.75)  # a flare: closed all around, but nowhere near the wall
    around = Around(station, radius * np.cos(turn), radius * np.sin(turn))
    first, last = end_stations(tube, around)
    assert first == pytest.approx(-1.0, abs=0.3)  # where nothing lies beyond, the rim stays whole
    assert last == pytest.approx(41.0, abs=0.3)


def test_a_section_that_changes_at_once_ends_no_bore():
    wide = Tube((LENGTH / 2, 0), (LENGTH, 0), 8.0, 7.0)
    result = cleaned(turned(cavity(Tube((0, 0), (LENGTH / 2, 0)), wide) - PLACE))
    station, aside, _ = axis_offsets(result).T
    assert min(station) < 1.5
    assert max(station) > LENGTH - 1.5
    assert np.abs(aside).max() < 0.1


def test_a_bore_goes_on_where_its_returns_grow_thin():
    points = arch()
    rng = np.random.default_rng(4)
    thin_end = (points[:, 0] < 0.7 * LENGTH) | (rng.random(len(points)) < 0.25)
    station = axis_offsets(cleaned(turned(points[thin_end])))[:, 0]
    assert np.ptp(station) == pytest.approx(LENGTH, abs=2.0)


def test_what_a_wet_floor_mirrors_is_no_bore():
    points = arch()
    rng = np.random.default_rng(7)
    seen = points[(np.abs(points[:, 1]) < 1.4) & (points[:, 2] > 1.0) & (rng.random(len(points)) < 0.3)]
    result = cleaned(turned(np.concatenate([points, seen * (1.0, 1.0, -1.0)])))
    require_axis_in_the_middle(result)
    kept = turned_back(result, result.cloud.points)
    assert np.mean(kept[:, 2] < -0.5) < 1e-3


LONG = Tube((0, 0), (50, 0))
ORIENTATIONS = [(0.0, 0.0), (1.1, 0.12), (-2.4, -0.08)]
JUNCTIONS = {
    "T": (LONG, Tube((25, 0), (25, 20))),
    "short T": (LONG, Tube((25, 0), (25, 10))),
    "Y": (Tube((0, 0), (60, 0)), Tube((25, 0), (51, 15))),
    "crossing": (LONG, Tube((25, -20), (25, 20))),
    "room on the way": (LONG, Box((18, -7), (32, 7), 7)),
}


def bore_of(points: np.ndarray) -> Bore:
    result = cleaned(points)
    bore = fits.bore_about(result.axis, result.cloud)
    fits.keep(bore, " bore")
    return bore


@pytest.mark.parametrize(
    ("name", "yaw", "tilt"),
    [("T", *ORIENTATIONS[1]), ("short T", *ORIENTATIONS[0]), ("Y", *ORIENTATIONS[1]), ("crossing", *ORIENTATIONS[1]),
     ("room on the way", *ORIENTATIONS[0])],
)  # fmt: skip
def test_a_branch_or_a_room_is_warned_of_with_its_place_in_the_frame_of_the_input(name, yaw, tilt):
    result = cleaned(cavity(*JUNCTIONS[name], yaw=yaw, tilt=tilt))
    part = next(part for part in result.removed if part.warning)
    there = placed(np.array([[25.0, 0.0, 2.5]]), yaw, tilt)[0]
    assert np.linalg.norm(np.subtract(part.place, there)) < (18.0 if name == "Y" else 8.0)


@pytest.mark.parametrize(("yaw", "tilt"), ORIENTATIONS[1:])
def test_a_niche_and_a_passage_are_cut_off(yaw, tilt):
    niche, door = Box((20, 0), (23, 4.5), 2.5), Tube((35, 0), (35, 8), 1.8, 2.2)
    bore = bore_of(cavity(LONG, niche, door, yaw=yaw, tilt=tilt))
    assert bore.length == pytest.approx(50, abs=1.3)  # the mouths are cut aslant
    assert np.median(bore.width) == pytest.approx(5.0, abs=0.03)


@pytest.mark.parametrize("length", [4.0, 10.0])
def test_a_gap_in_the_survey_is_no_end(length):
    points = cavity(LONG)
    along = points[:, 0] - PLACE[0]
    bore = bore_of(points[np.abs(along - 25) > length / 2])
    assert bore.length == pytest.approx(50, abs=0.3)
    assert np.abs(bore.width - 5.0).max() < 0.3
    in_gap = np.abs(bore.station - 25) < 1.0
    assert bore.filled[in_gap].all()


def test_a_portal_that_flares_open_is_no_room():
    points = cavity(LONG) - PLACE
    flare = 1 + 0.12 * np.maximum(points[:, 0] - 45, 0)
    points[:, 1:] *= flare[:, None]
    bore = bore_of(points + PLACE)
    assert bore.length == pytest.approx(50, abs=1.5)
    assert bore.width.max() > 7.0
