"""A sparse corridor with things standing along one wall is built by the plane wall behind them."""

import numpy as np
import pytest

from scene.bore import Bore
from scene.cleaning.clean import clean_cloud
from scene.cleaning.sort import Cleaned
from scene.errors import Cause
from scene.fitting.assemble import CentrelineConfig, fit_unfolded
from scene.judging.judge import JudgingConfig, judge_bore
from tests.scene.corridors import FURNITURE, HEIGHT, WIDTH, Thing, corridor, furniture, in_corridor
from tests.scene.fits import thin

QUICK = ("racks", "shelves", "machines", "closets")


def built(things: list[Thing], recesses: tuple[Thing, ...] = ()) -> tuple[Bore, Cleaned, np.ndarray, bool]:
    """The bore, its cleaning, its surface by station, lateral and height, m, and whether the judge refuses it."""
    cloud = thin(corridor(things, recesses))
    cleaned = clean_cloud(cloud, CentrelineConfig())
    _, bore = fit_unfolded(cleaned.cloud, cleaned.axis, 12.0, cleaned.behind)
    judgement = judge_bore(bore, cloud, JudgingConfig(), cause=cleaned.cause)
    surface = in_corridor(bore.surface() + cloud.origin)
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
