"""Where wall and floor meet: walls run on into the corner as they curve, whatever rails stand on the floor."""

import numpy as np
import pytest
from shapely import LineString, points

from scene.fitting.unroll import median_smooth
from tests.scene.fits import rebuilt
from tests.scene.shapes import PLACE, midline, outline, swept

RAILS, RAIL_TOP = 0.75, 0.24


def with_rails(cloud: np.ndarray, floor: float) -> np.ndarray:
    rng = np.random.default_rng(1)
    station = rng.uniform(0.0, 24.0, 40_000)
    rail = np.stack([station, rng.choice([-RAILS, RAILS], 40_000), floor + RAIL_TOP + 0.01 * station], axis=1)
    return np.concatenate([cloud, rail + rng.normal(0, [0.0, 0.03, 0.008], rail.shape) + PLACE])


@pytest.mark.parametrize("kind", ["d", "horseshoe", "circle on a floor"])
def test_the_corner_of_wall_and_floor_is_not_cut_off(kind):
    section = outline(kind)
    bore, cloud = rebuilt(with_rails(swept(kind, 24.0, yaw=0.0), section[:, 1].min()), midline(kind, 24.0, yaw=0.0))
    surface = bore.surface()[8:-8] + cloud.origin - PLACE
    wall = np.stack([surface[..., 1], surface[..., 2] - 0.01 * surface[..., 0]], axis=-1).reshape(-1, 2)
    true = LineString(section[np.argsort(np.arctan2(*section.T[::-1]))])
    away = true.distance(points(wall))
    assert away.max() < 0.06  # a degree of angle is 7 cm of wall: the very corner falls between two
    assert np.quantile(away, 0.99) < 0.02
    corner = section[np.argmax(np.hypot(section[:, 0], section[:, 1] - 0.5) * (section[:, 1] < 0))]
    gap = np.hypot(*(wall - corner).T).min(initial=np.inf)
    assert gap < 0.06


def test_a_window_of_one_column_smooths_along_alone():
    field = np.tile([[1.0], [1.0], [9.0], [1.0], [1.0]], (1, 4)) + np.arange(4)
    np.testing.assert_array_equal(median_smooth(field, (3, 1)), np.ones((5, 4)) + np.arange(4))
