import numpy as np
import pytest

from scene.cloud import VoxelMean, occupied_cells


def test_a_voxel_keeps_the_mean_and_the_number_of_its_points():
    thinned = VoxelMean(1.0)
    thinned.add(np.array([[5.1, 0.1, 0.1], [5.3, 0.3, 0.3]]))
    thinned.add(np.array([[5.2, 0.2, 0.5], [7.5, 0.5, 0.5], [np.nan, 0, 0]]))
    cloud = thinned.cloud()
    order = np.argsort(cloud.points[:, 0])
    np.testing.assert_allclose(cloud.points[order] + cloud.origin, [[5.2, 0.2, 0.3], [7.5, 0.5, 0.5]], atol=1e-6)
    np.testing.assert_array_equal(cloud.weights[order], [3, 1])
    assert cloud.returns == 4


def test_the_origin_is_whole_metres_so_that_nothing_is_lost_far_away():
    thinned = VoxelMean(0.01)
    thinned.add(np.array([[271540.0078, 2104023.106, -14.0345]]))
    cloud = thinned.cloud()
    assert (cloud.origin == np.round(cloud.origin)).all()
    np.testing.assert_allclose(cloud.points[0] + cloud.origin, [271540.0078, 2104023.106, -14.0345], atol=1e-6)


@pytest.mark.parametrize("count", [0, 1, 5000])
def test_occupied_cells_are_the_different_rows_in_order(count):
    points = np.random.default_rng(0).normal(0.0, 1.5, (count, 3))
    cells = occupied_cells(points, 0.5)
    np.testing.assert_array_equal(cells, np.unique(np.floor(points / 0.5).astype(np.int64), axis=0))
    assert len(cells) < max(count, 2)
