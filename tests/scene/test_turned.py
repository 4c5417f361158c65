"""Rings that turn: pockets by their place in the ring, joints by the steps of the wall, and neither by chance."""

from types import SimpleNamespace

import numpy as np
import pytest

from scene.bore import POCKET, Bore
from scene.fitting import pockets
from scene.fitting.evidence import find_ring, turned_more_than_chance
from scene.fitting.lining import add_lining, pair_pockets
from scene.fitting.section import Sections
from scene.fitting.unroll import Grid
from tests.scene import fits
from tests.scene.fits import thin

RADIUS, LENGTH, RING, FIRST = 2.75, 24.0, 1.5, 0.4
HALF, DEPTH, ASIDE = (0.10, 0.09), 0.12, 0.25
SEGMENT = np.deg2rad([0.0, 22.5, 90.0, 157.5, 225.0, 292.5])
PITCHES = (0.9, 2.1)


def drawn(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Turns of the rings, rad, and station and angle of the pockets on either side of their segments' joints."""
    turn = 2 * np.pi / 16 * rng.integers(0, 16, int(LENGTH / RING) + 2)
    places = [
        (FIRST + (ring - 0.5) * RING, turn[ring] + edge + side * ASIDE / RADIUS)
        for ring in range(len(turn)) for edge in SEGMENT for side in (-1, 1)
    ]  # fmt: skip
    return turn, np.array([place for place in places if 0.3 < place[0] < LENGTH - 0.3])


def cloud_of(step: float, anywhere: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Points on a bore of turned rings, and its pockets; `step` is the standard deviation of a segment's place, m."""
    rng = np.random.default_rng(3)
    turn, place = drawn(rng)
    if anywhere:
        place[:, 0] = rng.uniform(0.5, LENGTH - 0.5, len(place))
    station, angle = rng.random(450_000) * LENGTH, rng.uniform(-np.pi, np.pi, 450_000)
    ring = np.searchsorted(FIRST + RING * np.arange(len(turn)), station)
    segment = np.searchsorted(SEGMENT, np.mod(angle - turn[ring], 2 * np.pi), side="right") - 1
    radius = RADIUS + rng.normal(0.0, step, (len(turn), len(SEGMENT)))[ring, segment]
    for at, around in place:
        near = np.abs(station - at) < HALF[0]
        radius[near & (RADIUS * np.abs(np.angle(np.exp(1j * (angle - around)))) < HALF[1])] = RADIUS + DEPTH
    points = np.stack([station, radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return points + rng.normal(0.0, 0.004, points.shape) + 40.0, place


def line(length: float) -> fits.Line:
    return np.full(3, 40.0), np.array([40.0 + length, 40.0, 40.0])


def fitted(points: np.ndarray) -> tuple[Bore, Sections, np.ndarray]:
    """Smooth bore, sections, and origin of their frame, m."""
    cloud = thin(points)
    return *fits.fitted(cloud, line(LENGTH)), np.asarray(cloud.origin)


def built(points: np.ndarray) -> tuple[Bore, dict[str, str], np.ndarray]:
    """Bore, provenance of its lining, and origin of its frame, m."""
    bore, sections, origin = fitted(points)
    return *add_lining(bore, sections), origin


def hits(bore: Bore, origin: np.ndarray, place: np.ndarray) -> tuple[float, float]:
    """Share of the true pockets that were found, and of those found that are true, within 15 cm."""
    at = bore.axis.at(bore.pocket["station"])
    across, up = np.cos(bore.pocket["angle"])[:, None], np.sin(bore.pocket["angle"])[:, None]
    found = at.position + RADIUS * (across * at.lateral + up * at.up) + origin - 40.0
    true = np.column_stack([place[:, 0], RADIUS * np.cos(place[:, 1]), RADIUS * np.sin(place[:, 1])])
    near = np.linalg.norm(found[:, None] - true, axis=2) < 0.15
    return float(near.any(axis=0).mean()), float(near.any(axis=1).mean())


@pytest.fixture(scope="module")
def stepped() -> tuple:
    points, place = cloud_of(0.004)
    return *built(points), place


def test_pockets_that_turn_are_found_with_their_size(stepped) -> None:
    bore, provenance, origin, place = stepped
    assert provenance["pockets"] == "measured"
    recall, precision = hits(bore, origin, place)
    assert recall > 0.95
    assert precision > 0.98
    assert bore.pocket["depth"][0] == pytest.approx(DEPTH, abs=0.01)
    assert len(bore.nail) == 0  # no pocket has another across a ring joint


def test_joints_are_where_the_wall_steps_half_a_ring_from_the_pockets(stepped) -> None:
    bore, provenance, origin, _ = stepped
    assert provenance["rings"] == "measured"
    along = bore.axis.at(bore.ring_station).position[:, 0] + origin[0] - 40.0
    off = np.mod(along - FIRST + 0.5 * RING, RING) - 0.5 * RING
    assert np.abs(off).max() < 0.05
    assert len(bore.ring_station) == pytest.approx(LENGTH / RING, abs=1)


def test_without_steps_pockets_are_found_and_no_joints_are_made_up() -> None:
    points, place = cloud_of(0.0)
    bore, provenance, origin = built(points)
    assert hits(bore, origin, place)[0] > 0.95
    assert len(bore.ring_station) == 0
    assert provenance["rings"] == "none: neither pockets nor steps of the wall tell the joints"


def test_holes_anywhere_in_their_rings_are_no_pockets(monkeypatch) -> None:
    points, _ = cloud_of(0.004, anywhere=True)
    _, sections, _ = fitted(points)
    found, joints = pockets.find_pockets(sections)
    assert len(found) == len(joints) == 0
    monkeypatch.setattr(pockets, "turned_more_than_chance", lambda *_: True)
    assert len(pockets.find_pockets(sections)[0]) > 0, "this cloud does not try the evidence"


@pytest.mark.parametrize(("turned", "rows"), [(False, True), (True, False)])
def test_rows_are_a_lining_of_their_own_where_their_pockets_come_again_in_the_next_ring(turned, rows) -> None:
    rng = np.random.default_rng(6)
    column = np.concatenate([rng.permutation(360)[:12] if turned else np.arange(0, 360, 30) for _ in range(30)])
    row = np.repeat(10 + 30 * np.arange(30), 12)
    holes = pockets.Holes(row[keep := rng.random(360) < 0.85], column[keep], np.ones(int(keep.sum())))
    sections = SimpleNamespace(grid=Grid(0.0, 0.05, 900, 360), radius=np.full((2, 2), RADIUS))
    assert pockets._are_rows(holes, holes, sections, 1.5) is rows


def stations(rng: np.random.Generator, places: tuple[float, ...], keep: float, pitch: float = 1.5) -> np.ndarray:
    ring = pitch * np.arange(40)[:, None, None]
    at = (ring + np.array(places)[:, None] + 0 * np.arange(10)).ravel()
    return np.sort(at + rng.normal(0.0, 0.02, at.size))[rng.random(at.size) < keep]


@pytest.mark.parametrize("keep", [1.0, 0.3])
@pytest.mark.parametrize("places", [(0.7,), (0.25, 1.25), (0.22, 0.75, 1.28), (0.1, 0.9)])
def test_pitch_and_places_are_found_and_are_no_chance(places, keep) -> None:
    at = stations(np.random.default_rng(0), places, keep)
    ring = find_ring(at, 60.0, PITCHES)
    assert ring.pitch == pytest.approx(1.5, abs=0.002)
    assert len(ring.place) == len(places)
    assert turned_more_than_chance(at, ring, 60.0, PITCHES)


@pytest.mark.parametrize("pitch", [0.95, 1.0, 1.9, 2.05])
def test_a_ring_is_neither_halved_nor_doubled(pitch) -> None:
    at = stations(np.random.default_rng(1), (0.2 * pitch, 0.5 * pitch, 0.8 * pitch), 0.8, pitch)
    assert find_ring(at, 40 * pitch, PITCHES).pitch == pytest.approx(pitch, abs=0.003)


@pytest.mark.parametrize("count", [10, 40, 300, 2000])
def test_random_holes_are_chance(count) -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        at = rng.uniform(0.0, 60.0, count)
        assert not turned_more_than_chance(at, find_ring(at, 60.0, PITCHES), 60.0, PITCHES)


def test_many_holes_beside_a_few_pillars_are_chance() -> None:
    rng = np.random.default_rng(4)
    for _ in range(20):
        at = (rng.uniform(0.0, 60.0, (6, 1)) + rng.normal(0.0, 0.05, (6, 30))).ravel()
        assert not turned_more_than_chance(at, find_ring(at, 60.0, PITCHES), 60.0, PITCHES)


def test_true_rings_on_a_short_stretch_of_a_rough_wall_are_not_enough() -> None:
    rng = np.random.default_rng(5)
    at = np.concatenate([stations(rng, (0.7,), 1.0)[:150], rng.uniform(0.0, 60.0, 400)])
    assert not turned_more_than_chance(at, find_ring(at, 60.0, PITCHES), 60.0, PITCHES)


def test_pockets_are_paired_across_known_joints_alone(stepped) -> None:
    bore = stepped[0]
    row = np.zeros(7, POCKET)
    row["station"] = [0.0, 0.4, 0.9, 1.4, 1.8, 2.4, 2.9]
    bore = Bore(**{**vars(bore), "pocket": row})
    assert pair_pockets(bore).tolist() == [[0, 1], [2, 3], [4, 5]]  # any two that are as far apart
    assert pair_pockets(bore, np.array([1.15, 2.65])).tolist() == [[2, 3], [5, 6]]
