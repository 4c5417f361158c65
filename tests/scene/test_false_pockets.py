"""Places where the wall is thin by chance, or a pocket is mortared flush, become no pockets; true ones all do."""

from types import SimpleNamespace

import numpy as np
import pytest

from scene.bore import Bore
from scene.fitting import evidence, pockets
from scene.fitting.evidence import Holes, odds_by_place, pocket_over_wall
from scene.fitting.section import Sections
from scene.fitting.unroll import Grid
from tests.scene.fits import fitted, thin
from tests.scene.test_lining import DEPTH, HALF, JOINTS, LENGTH, OFFSET, RADIUS, ROWS

FILLED = 8  # every so many places: a pocket mortared flush, where the mortar gives half of the echoes
BEYOND, THIN = 0.30, 0.6  # m from a pocket away from its joint; share of the echoes that is missing there
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
    for share, bare in ((0.5, place[filled]), (THIN, spot)):
        for at in bare:
            seen &= ~(near(station, angle, at) & (radius == RADIUS) & (rng.random(len(station)) < share))
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


MEAN, BY_CHANCE = 2.0, 0.05  # points on the wall in a cell, and the share of the cells with a return behind it
EVERY, SIZE = 12, (0.10, 0.10)  # cells between two places; m, so that 5 × 5 cells tell


def drawn(seed: int, left: float = 0.5, behind: float = 0.15) -> tuple[SimpleNamespace, Holes, np.ndarray]:
    """A wall drawn by the model itself, and holes: clear pockets (0), faint ones (1) and wall (2).

    In pockets a share of the points is left, and so many cells more have a return behind them.
    """
    rng = np.random.default_rng(seed)
    row, column = (k.ravel() for k in np.meshgrid(np.arange(8, 1000, EVERY), np.arange(6, 360, EVERY), indexing="ij"))
    kind = rng.integers(0, 3, len(row))
    points, share = np.full((1000, 360), MEAN), np.full((1000, 360), BY_CHANCE)
    for r, c, k in zip(row, column, kind, strict=True):
        if k < 2:  # the middle of a faint one may be a cell off
            r, c = np.array([r, c]) + (rng.integers(-1, 2, 2) if k else 0)
            points[r - 1 : r + 2, c - 1 : c + 2] = left * MEAN
            share[r - 1 : r + 2, c - 1 : c + 2] = 1 - (1 - behind) * (1 - BY_CHANCE)
    sections = SimpleNamespace(
        grid=Grid(0.0, 0.05, 1000, 360), radius=np.full((1000, 360), 2.75), support=rng.poisson(points).astype(float),
        deepest=0.1 * (rng.random(share.shape) < share),
    )  # fmt: skip
    return sections, Holes(row, column, np.where(kind == 0, 0.5, 0.2)), kind


@pytest.mark.parametrize(("left", "behind"), [(0.5, 0.15), (0.7, 0.3)])
def test_the_ratio_is_the_odds_that_a_hole_is_a_pocket(left, behind) -> None:
    sections, holes, kind = drawn(7, left, behind)
    faint = kind > 0
    ratio, pocket = pocket_over_wall(sections, holes, SIZE)[faint], kind[faint] == 1
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
    assert odds[40] == pytest.approx(np.log(21 / 0.5), abs=0.1)  # across the end of a ring from twenty pockets
    assert odds[41] == pytest.approx(-odds[40], abs=0.1)
    assert odds[42] == pytest.approx(0.0, abs=1e-9)  # alone
    assert 1.0 < odds[43] < 3.0
    np.testing.assert_array_equal(np.sign(odds[:40]), np.sign(ratio[:40]))
