"""A bore judged against all returns: what it does not explain is found, placed and named, and nothing else is."""

import numpy as np
import pytest

from scene.bore import Bore
from scene.cloud import Cloud
from scene.errors import Cause, Code
from scene.judging.judge import Judgement, JudgingConfig, judge_bore
from scene.judging.places import BEHIND, BEYOND, EXPLAINED, INSIDE, TrackZone, compare_returns, wall_radius
from tests.scene.fits import keep

FLOOR = -3.2


def about(bore: Bore, station, lateral, upward) -> np.ndarray:
    at = bore.axis.at(np.asarray(station, float))
    return at.position + np.asarray(lateral)[:, None] * at.lateral + np.asarray(upward)[:, None] * at.up


def on_wall(bore: Bore, count: int = 60_000, outward: float = 0.0, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Station, lateral and upward offset of returns spread over the whole wall."""
    rng = np.random.default_rng(seed)
    station, angle = rng.uniform(0, bore.length, count), rng.uniform(-np.pi, np.pi, count)
    radius = wall_radius(bore, station, angle) + outward
    return station, radius * np.cos(angle), radius * np.sin(angle)


def cloud_of(*points: np.ndarray) -> Cloud:
    whole = np.concatenate(points).astype(np.float32)
    return Cloud(whole, np.ones(len(whole), np.float32), np.zeros(3), len(whole), 0.04)


def block(bore: Bore, station: tuple, lateral: tuple, upward: tuple, count: int = 4000) -> np.ndarray:
    rng = np.random.default_rng(1)
    return about(bore, *(rng.uniform(*span, count) for span in (station, lateral, upward)))


@pytest.fixture(scope="module")
def wall(bore) -> np.ndarray:
    return about(bore, *on_wall(bore))


def test_returns_on_the_wall_are_explained_and_nothing_is_said(bore, wall):
    judgement = judge_bore(bore, cloud_of(wall), JudgingConfig())
    assert judgement.fractions["explained"] > 0.999
    assert judgement.coverage.fraction == 1.0
    assert not judgement.warnings
    assert not judgement.places


@pytest.mark.parametrize(("outward", "kind"), [(-0.12, INSIDE), (-0.08, EXPLAINED), (0.08, EXPLAINED), (0.12, BEHIND)])
def test_the_side_and_the_tolerance_decide(bore, outward, kind):
    angle = np.full(50, 2.0)
    station = np.linspace(1.6, 20, 50)
    radius = wall_radius(bore, station, angle)
    points = about(bore, station, (radius + outward) * np.cos(angle), (radius + outward) * np.sin(angle))
    assert (compare_returns(bore, cloud_of(points), 0.10).kind == kind).all()


def test_near_a_corner_the_distance_is_that_to_the_nearest_wall(bore):
    """5 cm above the floor beside the wall, the radius overstates the distance by half."""
    points = about(bore, np.linspace(1, 20, 40), np.full(40, 2.72), np.full(40, FLOOR + 0.09))
    returns = compare_returns(bore, cloud_of(points), 0.10)
    assert (returns.kind == EXPLAINED).all()
    np.testing.assert_allclose(np.abs(returns.outward), 0.08, atol=0.015)


def test_pockets_and_track_explain_what_is_in_them(bore):
    pocket = bore.pocket[10]
    radius = wall_radius(bore, pocket["station"][None], pocket["angle"][None]) + pocket["depth"] - 0.01
    back = about(bore, pocket["station"][None], radius * np.cos(pocket["angle"]), radius * np.sin(pocket["angle"]))
    beside = about(
        bore, pocket["station"][None] + 1.0, radius * np.cos(pocket["angle"]), radius * np.sin(pocket["angle"])
    )
    assert list(compare_returns(bore, cloud_of(back, beside), 0.05).kind) == [EXPLAINED, BEHIND]
    rail = about(bore, [8.0], [0.75], [FLOOR + 0.24])
    assert compare_returns(bore, cloud_of(rail), 0.10).kind == [INSIDE]
    zone = TrackZone(1.25, np.full(len(bore.station), FLOOR + 0.25))
    assert compare_returns(bore, cloud_of(rail), 0.10, zone).kind == [EXPLAINED]
    high = about(bore, [8.0], [0.75], [FLOOR + 0.60])
    assert compare_returns(bore, cloud_of(high), 0.10, zone).kind == [INSIDE]


def test_what_lies_beyond_the_ends_is_counted_apart(bore, wall):
    outside = about(bore, np.full(600, -4.0), np.linspace(-5, 5, 600), np.zeros(600))
    judgement = judge_bore(bore, cloud_of(wall, outside), JudgingConfig())
    assert judgement.fractions["beyond_ends"] == pytest.approx(600 / 60_600, abs=1e-4)
    assert judgement.fractions["inside"] + judgement.fractions["behind"] < 1e-3
    assert (judgement.returns.kind[-600:] == BEYOND).all()
    near = about(bore, [-0.3, bore.length + 0.3], [0.0, 0.0], [0.0, 0.0])
    assert (compare_returns(bore, cloud_of(near), 0.10).kind == BEYOND).all()


THINGS = {
    "vehicle": (((9, 15), (-1, 1), (FLOOR + 0.1, FLOOR + 2.2)), "floor"),
    "person": (((9, 9.5), (-0.3, 0.3), (FLOOR + 0.1, FLOOR + 1.8)), "floor"),
    "duct": (((2, 22), (-0.4, 0.4), (1.6, 2.4)), "crown"),
    "walkway": (((2, 22), (1.5, 2.5), (FLOOR + 0.15, FLOOR + 0.4)), "floor"),
    "pillar": (((9, 9.6), (-0.3, 0.3), (FLOOR, 2.7)), "floor"),
    "passage": (((9, 12), (3.0, 6.0), (-2, 1)), "left wall"),
    "pit": (((9, 12), (-1.0, 1.0), (FLOOR - 0.9, FLOOR - 0.2)), "floor"),
}


@pytest.mark.parametrize("name", THINGS)
def test_a_thing_is_found_where_it_is_and_named(bore, wall, name):
    (station, lateral, upward), side = THINGS[name]
    judgement = judge_bore(bore, cloud_of(wall, block(bore, station, lateral, upward)), JudgingConfig())
    keep(judgement.facts)
    largest = judgement.places[0]
    assert largest.start == pytest.approx(station[0], abs=0.5)
    assert largest.end == pytest.approx(station[1], abs=0.5)
    assert (largest.low, largest.high) == pytest.approx(np.subtract(upward, FLOOR), abs=0.25)
    assert side in largest.sides
    assert largest.behind == (name in ("passage", "pit"))
    assert any(station[0] - 2 <= start <= station[1] for start, _, _ in judgement.worst[:1])
    assert any(warning.code is Code.PLACE and side in warning.text for warning in judgement.warnings)


def judged_without(bore: Bore, hide) -> Judgement:
    """Judgement of returns on the whole wall but those that `hide` takes, by station, lateral and upward offset."""
    wall = on_wall(bore)
    seen = ~hide(*wall)
    judgement = judge_bore(bore, cloud_of(about(bore, *(v[seen] for v in wall))), JudgingConfig())
    keep(judgement.facts)
    return judgement


def test_an_unseen_wall_is_named_with_its_side_and_its_stations(bore):
    judgement = judged_without(bore, lambda station, lateral, _: (lateral > 2.4) & (station > 8) & (station < 18))
    patch = judgement.coverage.patches[0]
    assert (patch.start, patch.end) == (pytest.approx(8, abs=1.1), pytest.approx(18, abs=1.1))
    assert patch.sides == "left wall"
    assert [warning.code for warning in judgement.warnings] == ["unseen"]
    assert "left wall" in judgement.warnings[0].text


def test_strays_do_not_count_as_having_seen_a_wall(bore):
    few = np.random.default_rng(2).random(60_000) < 0.002
    judgement = judged_without(bore, lambda station, *_: (station > 8) & ~few)
    assert judgement.coverage.patches[0].sides == "all around"
    assert judgement.coverage.fraction == pytest.approx(8 / 24, abs=0.08)


def test_what_was_cut_away_as_another_tunnel_refuses_nothing(bore, wall):
    far = block(bore, (2, 22), (20, 24), (-2, 2), 60_000)
    cause = np.zeros(120_000, np.int8)
    cause[60_000:] = Cause.ELSEWHERE
    cloud = cloud_of(wall, far)
    assert any(w.refuses for w in judge_bore(bore, cloud, JudgingConfig()).warnings)
    judgement = judge_bore(bore, cloud, JudgingConfig(), cause=cause)
    assert not any(w.refuses for w in judgement.warnings)
    assert judgement.fractions["behind"] == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(("overhead", "length", "said"), [(False, 8.0, False), (True, 1.2, False), (True, 8.0, True)])
def test_a_lining_that_goes_on_beyond_an_end_is_told_and_a_cutting_is_not(bore, wall, overhead, length, said):
    rng = np.random.default_rng(9)
    before = rng.uniform(-length, 0.0, 8000)
    angle = rng.uniform(-np.pi, np.pi, 8000)
    radius = wall_radius(bore, before, angle)
    kept = overhead | (radius * np.sin(angle) < 0.5)  # floor and foot of the walls alone
    more = about(bore, before[kept], (radius * np.cos(angle))[kept], (radius * np.sin(angle))[kept])
    judgement = judge_bore(bore, cloud_of(wall, more), JudgingConfig())
    keep(judgement.facts)
    warnings = judgement.warnings
    outcome = [warning.text for warning in warnings if warning.code == "cut_short"]
    assert bool(outcome) == said
    assert not said or "goes on for at least 7 m before station 0 m" in outcome[0]


def test_a_large_part_of_the_cloud_beyond_the_ends_is_told(bore, wall):
    far = block(bore, (-60.0, -30.0), (-2.0, 2.0), (-2.0, 2.0), 30_000)  # half as many as on the wall
    for points, said in ((far[:9000], False), (far, True)):
        codes = [warning.code for warning in judge_bore(bore, cloud_of(wall, points), JudgingConfig()).warnings]
        assert ("beyond" in codes) == said
