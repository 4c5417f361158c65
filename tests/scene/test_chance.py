"""Strays and the shadows of pillars make no pockets; without the tests of evidence they would."""

import numpy as np
import pytest

from scene.bore import POCKET
from scene.fitting import evidence, pockets, trackseen
from scene.fitting.evidence import more_than_chance, steadier_than_chance
from tests.scene.clouds import curved_d_bore
from tests.scene.fits import fitted, thin
from tests.scene.railway import World, arch, stations, terrestrial
from tests.scene.shapes import PLACE

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
def test_no_ring_and_no_pocket_is_measured_where_there_is_none(cloud, line, monkeypatch):
    thinned = thin(cloud())
    sections = fitted(thinned, line)[1]
    found, joints = pockets.find_pockets(sections)
    assert len(found) == len(joints) == 0
    monkeypatch.setattr(evidence, "open_rims", lambda deficit, grid, row, *rest: np.zeros(len(row)))
    monkeypatch.setattr(pockets, "_keep_likely", lambda deficit, sections, holes: (holes, np.zeros(len(holes.row))))
    reached = []
    monkeypatch.setattr(evidence, "more_than_chance", lambda found, *rest: reached.append(len(found)))
    pockets.find_pockets(sections)
    assert max(reached, default=0) >= 10, "this cloud does not try the evidence at all"


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
def test_rubble_between_rails_is_no_row_of_sleepers(seed, monkeypatch):
    rng = np.random.default_rng(seed)
    station, height = strewn_bed(rng, rubble(rng))
    assert trackseen._find_sleepers(station, height, 30.0, 0.25) is None
    monkeypatch.setattr(trackseen, "steadier_than_chance", lambda gaps: True)
    assert trackseen._find_sleepers(station, height, 30.0, 0.25) is not None, "this bed does not try the evidence"


@pytest.mark.parametrize("pitches", [(0.6,), (0.5, 0.5, 0.75), (0.57, 0.63), (0.6, 0.6, 1.2)])
def test_a_row_of_sleepers_is_no_chance_with_any_true_pitch_and_some_unseen(pitches):
    rng = np.random.default_rng(2)
    starts = np.cumsum(np.resize(pitches, 40)) + rng.normal(0.0, 0.015, 40)
    assert steadier_than_chance(np.diff(starts[starts < 28.0]))
