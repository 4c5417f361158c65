"""The contract between cleaning, fitting and judging."""

import numpy as np

from scene.cleaning.clean import CleaningConfig, clean_cloud
from scene.cleaning.removed import BEYOND, CAUSES, INSIDE, list_removed
from scene.fitting.centreline import CentrelineConfig
from tests.scene.clouds import curved_d_bore
from tests.scene.test_reconstruction import thin


def test_a_clean_cloud_is_handed_on_as_it_is():
    cloud = thin(curved_d_bore(length=20).points)
    cleaned = clean_cloud(cloud, CleaningConfig(), CentrelineConfig())
    assert cleaned.cloud is cloud
    assert cleaned.removed == ()
    assert not cleaned.cause.any()
    assert len(cleaned.cause) == len(cloud.points)


def test_what_was_removed_is_listed_by_stretch_with_its_place_in_the_frame_of_the_input():
    cloud = thin(curved_d_bore(length=20).points)
    station, cause = np.linspace(0, 20, len(cloud.points)), np.zeros(len(cloud.points), np.int8)
    cause[(station > 3) & (station < 5)] = INSIDE
    cause[(station > 8) & (station < 9)] = INSIDE
    cause[station > 19] = BEYOND
    removed = list_removed(cloud, cause, station, gap=1.0)
    assert [part.cause for part in removed] == [CAUSES[INSIDE], CAUSES[INSIDE], CAUSES[BEYOND]]
    np.testing.assert_allclose([(part.start, part.end) for part in removed], [(3, 5), (8, 9), (19, 20)], atol=0.01)
    assert sum(part.points for part in removed) == np.count_nonzero(cause)
    there = np.median(cloud.points[cause == BEYOND], axis=0) + cloud.origin
    np.testing.assert_allclose(removed[-1].place, there, atol=1e-3)


def test_stations_of_what_was_removed_follow_the_axis():
    cloud = thin(curved_d_bore(length=20).points)
    cause = np.zeros(len(cloud.points), np.int8)
    cause[:10] = INSIDE
    (part,) = list_removed(cloud, cause, np.full(len(cause), 4.0), gap=1.0)
    assert (part.shifted(-1.5).start, part.shifted(-1.5).end) == (2.5, 2.5)
    assert (part.reversed(20.0).start, part.reversed(20.0).end) == (16.0, 16.0)
