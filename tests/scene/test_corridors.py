"""A sparse corridor with things standing along one wall is built by the plane wall behind them."""

import numpy as np
import pytest

from scene.bore import Bore
from scene.cleaning.clean import clean_cloud
from scene.cleaning.sort import Cleaned
from scene.errors import Cause
from scene.fitting.axis import CentrelineConfig
from scene.fitting.section import fit_unfolded
from scene.judging.judge import JudgingConfig, judge_bore
from tests.scene.fits import keep, thin, told

Span = tuple[float, float]
Thing = tuple[Span, Span, Span]  # along the corridor, across it, and above its floor, m
LENGTH, WIDTH, HEIGHT = 20.0, 4.0, 2.8
_APART = 0.10  # m between the points
_NOISE = 0.01  # m
_EYES = 1.0  # m between the places that it was seen from, in the middle, 1.4 m above the floor
PLACE = np.array([300.0, -80.0, 12.0])
_TURN = np.array([[np.cos(0.4), np.sin(0.4), 0.0], [-np.sin(0.4), np.cos(0.4), 0.0], [0.0, 0.0, 1.0]])

# What stands along the right wall: depth, least height, greatest height, length, and gap to the next one, m.
FURNITURE = {
    "cabinets": (0.6, 0.0, 2.0, 0.9, 0.5),
    "benches": (0.5, 0.0, 0.5, 1.8, 0.6),
    "shelves": (0.4, 0.0, 2.3, 2.5, 0.4),
    "desks": (0.8, 0.0, 0.75, 1.6, 0.7),
    "machines": (1.2, 0.0, 1.6, 1.5, 1.0),
    "racks": (0.9, 0.0, 2.2, 1.0, 0.3),
    "closets": (0.6, 0.0, 4.0, 1.2, 0.9),
    "ducts": (0.4, 2.1, 2.4, 6.0, 0.02),
}


def furniture(kind: str) -> list[Thing]:
    """Things of a kind along the right wall, not all of one size."""
    depth, low, high, long, gap = FURNITURE[kind]
    rng = np.random.default_rng(7)
    things, at = [], 0.8
    while at + long < LENGTH - 0.5:
        fraction = rng.uniform(0.8, 1.2, 3)
        things.append(
            (
                (at, at + long * fraction[0]),
                (-WIDTH / 2, -WIDTH / 2 + depth * fraction[1]),
                (low, min(low + (high - low) * fraction[2], HEIGHT - 0.01)),
            )
        )
        at += long * fraction[0] + gap * rng.uniform(0.7, 1.3)
    return things


def corridor(things: list[Thing], recesses: tuple[Thing, ...] = ()) -> np.ndarray:
    """Points of walls, floor, ceiling and things as far as somebody who walks down the middle sees them, m.

    Recesses are boxes that the right wall is set back into.
    """
    rng = np.random.default_rng(1)
    room = ((0.0, LENGTH), (-WIDTH / 2, WIDTH / 2), (0.0, HEIGHT))
    points = np.concatenate([_faces(room, rng, ends=False), *(_faces(thing, rng) for thing in things)])
    for low, high in (np.array(recess).T for recess in recesses):
        front = (points[:, 1] < -WIDTH / 2 + 1e-6) & ((points > low) & (points < high))[:, [0, 2]].all(axis=1)
        points[front, 1] = low[1]
    points = points[_seen(points, things, LENGTH)]
    points += rng.normal(0.0, _NOISE, points.shape)
    return points @ _TURN + PLACE


def _faces(box: Thing, rng: np.random.Generator, ends: bool = True) -> np.ndarray:
    low, high = np.array(box).T
    parts = []
    for axis in range(3) if ends else (1, 2):
        size = np.delete(high - low, axis)
        count = int(np.prod(size) / _APART**2)
        for side in (low, high):
            part = low + rng.random((count, 3)) * (high - low)
            part[:, axis] = side[axis]
            parts.append(part)
    return np.concatenate(parts)


def _seen(points: np.ndarray, things: list[Thing], length: float) -> np.ndarray:
    """Points that nothing hides from the nearest five places on the way."""
    seen = np.zeros(len(points), bool)
    for step in range(-2, 3):
        eye = np.zeros_like(points)
        eye[:, 0] = np.clip(np.round(points[:, 0] / _EYES) + step, 0, length / _EYES) * _EYES
        eye[:, 2] = 1.4
        free = np.ones(len(points), bool)
        way = points - eye
        way = np.where(np.abs(way) < 1e-9, 1e-9, way)
        for low, high in (np.array(thing).T for thing in things):
            first, last = (low - eye) / way, (high - eye) / way
            enter, leave = np.minimum(first, last).max(axis=1), np.maximum(first, last).min(axis=1)
            free &= ~((enter < leave) & (enter < 1.0 - 1e-6) & (leave > 0.0) & (leave > enter + 1e-9))
        seen |= free
    return seen


QUICK = ("racks", "machines", "closets")


def built(things: list[Thing], recesses: tuple[Thing, ...] = ()) -> tuple[Bore, Cleaned, np.ndarray, bool]:
    """The bore, its cleaning, its surface by station, lateral and height, m, and whether the judge refuses it."""
    cloud = thin(corridor(things, recesses))
    cleaned = clean_cloud(cloud, CentrelineConfig())
    _, bore = fit_unfolded(cleaned.cloud, cleaned.axis, 12.0, cleaned.behind)
    judgement = judge_bore(bore, cloud, JudgingConfig(), cause=cleaned.cause)
    keep({"cleaned": told(cleaned), "bore": bore, "judgement": judgement.facts})
    surface = (bore.surface() + cloud.origin - PLACE) @ _TURN.T  # station, left of the middle, above the floor, m
    return bore, cleaned, surface, any(warning.refuses for warning in judgement.warnings)


def off_wall(surface: np.ndarray, side: int, low: float = 0.3) -> np.ndarray:
    """Distances of the walls on one side from the true one, above a height, m."""
    lateral, height = surface[..., 1], surface[..., 2]
    wall = (side * lateral > 0) & (height > low) & (height < HEIGHT - 0.3)
    return lateral[wall] - side * WIDTH / 2


@pytest.mark.parametrize("kind", [k if k in QUICK else pytest.param(k, marks=pytest.mark.slow) for k in FURNITURE])
def test_walls_are_where_they_are_whatever_stands_along_one(kind):
    things = furniture(kind)
    bore, cleaned, surface, refused = built(things)
    assert not refused
    assert bore.length == pytest.approx(20.0, abs=0.2)
    left, right = off_wall(surface, 1), off_wall(surface, -1)
    assert np.percentile(np.abs(left), 99) < 0.05
    assert np.percentile(np.abs(right), 90) < 0.05
    assert np.median(np.abs(right)) < 0.02
    assert (cleaned.cause == Cause.STANDING).sum() > 500


def test_doors_set_back_from_a_wall_do_not_move_it():
    doors = tuple(((x, x + 1.0), (-WIDTH / 2 - 0.25, -WIDTH / 2), (0.0, 2.1)) for x in np.arange(1.0, 19.0, 2.0))
    _, cleaned, surface, refused = built([], doors)
    assert not refused
    assert np.abs(np.median(off_wall(surface, -1, low=2.2))) < 0.02
    assert not (cleaned.cause == Cause.STANDING).any()


def test_a_void_above_the_walls_does_not_move_them():
    void = ((0.0, 20.0), (-WIDTH / 2 - 0.6, -WIDTH / 2), (1.9, HEIGHT + 0.1))
    _, cleaned, surface, _ = built([], (void,))
    low = (surface[..., 1] < 0) & (surface[..., 2] > 0.3) & (surface[..., 2] < 1.6)
    assert np.abs(np.median(surface[low][:, 1] + WIDTH / 2)) < 0.02
    assert not (cleaned.cause == Cause.STANDING).any()


def test_a_walkway_without_a_gap_is_part_of_the_section():
    walkway = ((0.0, 20.0), (-WIDTH / 2, -WIDTH / 2 + 0.8), (0.0, 0.4))
    _, cleaned, surface, refused = built([walkway])
    assert not refused
    assert (cleaned.cause == Cause.STANDING).mean() < 0.01
    over = (np.abs(surface[..., 1] + WIDTH / 2 - 0.4) < 0.2) & (surface[..., 2] < 1.0)
    assert np.median(surface[over][:, 2]) == pytest.approx(0.4, abs=0.03)
