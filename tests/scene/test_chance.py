"""Strays, shadows of pillars and false holes make no pockets; without the tests of evidence they would."""

from types import SimpleNamespace

import numpy as np
import pytest

from scene.bore import POCKET, Bore
from scene.fitting import evidence, pockets, trackseen
from scene.fitting.evidence import Holes, more_than_chance, odds_by_place, pocket_over_wall, steadier_than_chance
from scene.fitting.section import Sections
from scene.fitting.unroll import Grid
from tests.scene.clouds import curved_d_bore
from tests.scene.fits import fitted, keep, thin
from tests.scene.railway import World, arch, stations, terrestrial
from tests.scene.shapes import PLACE
from tests.scene.test_lining import DEPTH, HALF, JOINTS, LENGTH, OFFSET, RADIUS, ROWS

PITCHES = (0.9, 2.1)


def pillared() -> np.ndarray:
    row = [(x - 0.2, x + 0.2, y - 0.2, y + 0.2, 0.0, 6.0) for x in np.arange(3, 24, 3.0) for y in (-2.5, 2.5)]
    world = World(arch(9.0, 7.0, 2.5), 24.0, row, grade=0.0)
    return world.scan(terrestrial(), stations(24.0), noise=0.005) - PLACE


def strewn() -> np.ndarray:
    points = curved_d_bore(60, per_metre=4000, radius=1e6, grade=0.0, yaw=0.0, offset=(0.0, 0.0, 0.0)).points
    low, high = points.min(axis=0) - 3.0, points.max(axis=0) + 3.0
    return np.concatenate([points, np.random.default_rng(1).uniform(low, high, (len(points) // 100, 3))])


@pytest.mark.parametrize(
    ("cloud", "line"),
    [(pillared, np.array([[0.0, 0.0, 3.5], [24.0, 0.0, 3.5]])), (strewn, np.array([[0.0] * 3, [60.0, 0.0, 0.0]]))],
)
def test_no_ring_and_no_pocket_is_measured_where_there_is_none(cloud, line):
    thinned = thin(cloud())
    sections = fitted(thinned, line)[1]
    keep(sections)
    found, joints = pockets.find_pockets(sections)
    assert len(found) == len(joints) == 0


def lining(rng: np.random.Generator, keep: float) -> np.ndarray:
    places = [(j + side * 0.22, a) for j in np.arange(0.75, 60, 1.5) for side in (-1, 1) for a in (0.1, 1.0, 2.0, 3.0)]
    result = np.zeros(len(places), POCKET)
    result["station"], result["angle"] = np.transpose(places)
    return result[rng.random(len(places)) < keep]


@pytest.mark.parametrize("keep", [1.0, 0.5])
def test_a_lining_with_half_its_pockets_unseen_is_no_chance(keep):
    found = lining(np.random.default_rng(0), keep)
    assert more_than_chance(found, pockets.find_ring_joints(found["station"], 60.0), PITCHES, 2.75)


@pytest.mark.parametrize("count", [10, 40, 300])
def test_random_stations_are_chance_whatever_pitch_suits_them_best(count):
    rng = np.random.default_rng(1)
    for _ in range(20):
        found = np.zeros(count, POCKET)
        found["station"], found["angle"] = rng.uniform(0, 60, count), rng.choice([0.1, 1.0, 2.0], count)
        wave = np.arange(0.0, 60.0, 1.5)
        joints = pockets.find_ring_joints(found["station"], 60.0)
        assert not more_than_chance(found, joints if len(joints) else wave, PITCHES, 2.75)


def strewn_bed(rng: np.random.Generator, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Station and height of points between two rails, with lumps of 22 cm that begin at some stations, m."""
    station = rng.uniform(0.0, 30.0, 60_000)
    raised = (station[:, None] >= starts) & (station[:, None] < starts + 0.22)
    return station, 0.08 * raised.any(axis=1) + rng.normal(0.0, 0.006, len(station))


def rubble(rng: np.random.Generator) -> np.ndarray:
    return np.cumsum(0.3 + rng.exponential(0.22, 80))


@pytest.mark.parametrize("seed", range(5))
def test_rubble_between_rails_is_no_row_of_sleepers(seed):
    rng = np.random.default_rng(seed)
    station, height = strewn_bed(rng, rubble(rng))
    assert trackseen._find_sleepers(station, height, 30.0, 0.25) is None


@pytest.mark.parametrize("pitches", [(0.6,), (0.5, 0.5, 0.75), (0.57, 0.63), (0.6, 0.6, 1.2)])
def test_a_row_of_sleepers_is_no_chance_with_any_true_pitch_and_some_unseen(pitches):
    rng = np.random.default_rng(2)
    starts = np.cumsum(np.resize(pitches, 40)) + rng.normal(0.0, 0.015, 40)
    assert steadier_than_chance(np.diff(starts[starts < 28.0]))


FILLED = 8  # every so many places: a pocket mortared flush, where the mortar gives half of the echoes
BEYOND, THIN = 0.30, 0.75  # m from a pocket away from its joint; fraction of the echoes that is missing there
MOUTH = JOINTS[0] - OFFSET - HALF[0] - 0.05  # m: the first pockets begin 5 cm behind it


def near(station: np.ndarray, angle: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Points within the mouth of a pocket at a place, station, m, and angle."""
    around = RADIUS * np.angle(np.exp(1j * (angle - place[1])))
    return (np.abs(station - place[0]) < HALF[0]) & (np.abs(around) < HALF[1])


def places() -> tuple[np.ndarray, np.ndarray]:
    """Station and angle of the places for pockets, and of thin spots of the wall, one beside every third."""
    sides = [(joint, side, row) for joint in JOINTS for row in ROWS for side in (-1, 1)]
    place = np.array([(joint + side * OFFSET, row) for joint, side, row in sides])
    spot = np.array([(joint + side * (OFFSET + BEYOND), row) for joint, side, row in sides])[::3]
    return place, spot[(spot[:, 0] > 0.4) & (spot[:, 0] < LENGTH - 0.4)]


def mortared() -> tuple[np.ndarray, np.ndarray]:
    """Points on a bore in whose walls some pockets are filled, and station and angle of its open ones."""
    rng = np.random.default_rng(5)
    station, angle = rng.uniform(MOUTH, LENGTH, 700_000), rng.uniform(-np.pi, np.pi, 700_000)
    place, spot = places()
    filled = np.arange(len(place)) % FILLED == 0
    radius, seen = np.full(len(station), RADIUS), np.ones(len(station), bool)
    for at in place[~filled]:
        radius[near(station, angle, at)] = RADIUS + DEPTH
    for fraction, bare in ((0.5, place[filled]), (THIN, spot)):
        for at in bare:
            seen &= ~(near(station, angle, at) & (radius == RADIUS) & (rng.random(len(station)) < fraction))
    points = np.stack([station, radius * np.cos(angle), radius * np.sin(angle)], axis=1)[seen]
    return points + rng.normal(0, 0.004, points.shape) + 40.0, place[~filled]


@pytest.fixture(scope="module")
def wall() -> tuple[Bore, Sections, np.ndarray]:
    points, place = mortared()
    cloud = thin(points)
    bore, sections = fitted(cloud, (np.full(3, 40.0), np.array([40.0 + LENGTH, 40.0, 40.0])))
    at = np.column_stack([place[:, 0], RADIUS * np.cos(place[:, 1]), RADIUS * np.sin(place[:, 1])])
    return bore, sections, at + 40.0 - cloud.origin


def count_hits(wall: tuple) -> tuple[int, int]:
    """Count the open pockets that were missed, and those built where there is none, beyond 15 cm."""
    bore, sections, true = wall
    found, _ = pockets.find_pockets(sections)
    at = bore.axis.at(found["station"])
    across, up = np.cos(found["angle"])[:, None], np.sin(found["angle"])[:, None]
    apart = np.linalg.norm((at.position + RADIUS * (across * at.lateral + up * at.up))[:, None] - true, axis=2)
    return int((apart.min(axis=0) > 0.15).sum()), int((apart.min(axis=1) > 0.15).sum())


def test_thin_walls_and_filled_pockets_are_none_and_every_open_one_is(wall, monkeypatch) -> None:
    assert count_hits(wall) == (0, 0)
    monkeypatch.setattr(evidence, "pocket_over_wall", lambda sections, holes, size: np.zeros(len(holes.row)))
    assert count_hits(wall)[1] > 5, "this wall does not try the evidence"


MEAN, BY_CHANCE = 2.0, 0.05  # points on the wall in a cell, and the fraction of the cells with a return behind it
EVERY, SIZE = 12, (0.10, 0.10)  # cells between two places; m, so that 5 × 5 cells tell


def drawn(seed: int, left: float = 0.5, behind: float = 0.15) -> tuple[SimpleNamespace, Holes, np.ndarray]:
    """A wall drawn by the model itself, and holes: clear pockets (0), faint ones (1) and wall (2).

    In pockets a fraction of the points is left, and so many cells more have a return behind them.
    """
    rng = np.random.default_rng(seed)
    row, column = (k.ravel() for k in np.meshgrid(np.arange(8, 1000, EVERY), np.arange(6, 360, EVERY), indexing="ij"))
    kind = rng.integers(0, 3, len(row))
    points, fraction = np.full((1000, 360), MEAN), np.full((1000, 360), BY_CHANCE)
    for r, c, k in zip(row, column, kind, strict=True):
        if k < 2:  # the middle of a faint one may be a cell off
            r, c = np.array([r, c]) + (rng.integers(-1, 2, 2) if k else 0)
            points[r - 1 : r + 2, c - 1 : c + 2] = left * MEAN
            fraction[r - 1 : r + 2, c - 1 : c + 2] = 1 - (1 - behind) * (1 - BY_CHANCE)
    sections = SimpleNamespace(
        grid=Grid(0.0, 0.05, 1000, 360), radius=np.full((1000, 360), 2.75), support=rng.poisson(points).astype(float),
        deepest=0.1 * (rng.random(fraction.shape) < fraction),
    )  # fmt: skip
    return sections, Holes(row, column, np.where(kind == 0, 0.5, 0.2)), kind


@pytest.mark.parametrize(("left", "behind"), [(0.5, 0.15), (0.7, 0.3)])
def test_the_ratio_is_the_odds_that_a_hole_is_a_pocket(left, behind) -> None:
    sections, holes, kind = drawn(7, left, behind)
    faint = kind > 0
    ratio, pocket = pocket_over_wall(sections, holes, SIZE)[faint], kind[faint] == 1
    keep(ratio)
    chance = 1 / (1 + np.exp(-ratio))
    for low, high in ((0.0, 0.1), (0.1, 0.3), (0.3, 0.7), (0.7, 0.9), (0.9, 1.0)):
        some = (chance > low) & (chance <= high)
        expected, sigma = chance[some].sum(), np.sqrt((chance * (1 - chance))[some].sum())
        assert some.sum() > 80
        assert abs(pocket[some].sum() - expected) < 4 * sigma  # looks from a third of the holes cost up to one


def test_without_clear_holes_nothing_tells_a_pocket_from_a_wall() -> None:
    sections, holes, _ = drawn(8)
    nobody = Holes(holes.row, holes.column, np.full(len(holes.row), 0.2))
    np.testing.assert_allclose(pocket_over_wall(sections, nobody, SIZE), 0.0, atol=1e-9)


def test_holes_are_what_most_others_at_their_place_in_the_ring_are() -> None:
    ring = 1.5 * np.arange(20)
    station = np.concatenate([ring + 0.01, ring + 0.8, [31.49, 30.8, 30.4, 31.2]])
    ratio = np.concatenate([np.full(20, 9.0), np.full(20, -9.0), [0.0, 0.0, 0.0, 1.0]])
    odds = odds_by_place(ratio, station, 1.5)
    keep(odds)
    assert odds[40] == pytest.approx(np.log(21 / 0.5), abs=0.1)  # across the end of a ring from twenty pockets
    assert odds[41] == pytest.approx(-odds[40], abs=0.1)
    assert odds[42] == pytest.approx(0.0, abs=1e-9)  # alone
    assert 1.0 < odds[43] < 3.0
    np.testing.assert_array_equal(np.sign(odds[:40]), np.sign(ratio[:40]))
