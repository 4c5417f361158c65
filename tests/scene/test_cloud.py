import numpy as np
import pytest
import trimesh
from pypcd4 import PointCloud

from scene.cloud import VoxelMean, occupied_cells
from scene.errors import RecordingError
from scene.reading.cloudfile import read_cloud

POINTS = np.random.default_rng(0).uniform(-3, 3, (500, 3)).astype(np.float32)


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


def write_ply(path, points):
    trimesh.PointCloud(points).export(path)
    return path


def write_pcd(path, points):
    PointCloud.from_xyz_points(points).save(path)
    return path


@pytest.mark.parametrize(("suffix", "write"), [(".ply", write_ply), (".pcd", write_pcd)])
def test_a_cloud_file_comes_back_as_it_was_written(tmp_path, suffix, write):
    cloud, _ = read_cloud(write(tmp_path / f"c{suffix}", POINTS), 1e-4)
    back = cloud.points + cloud.origin
    np.testing.assert_allclose(back[np.lexsort(back.T)], POINTS[np.lexsort(POINTS.T)], atol=1e-5)


@pytest.mark.parametrize(("suffix", "write"), [(".ply", write_ply), (".pcd", write_pcd)])
@pytest.mark.parametrize("keep", [0.0, 0.05, 0.5])
def test_a_truncated_cloud_file_is_refused(tmp_path, suffix, write, keep):
    whole = write(tmp_path / f"c{suffix}", POINTS).read_bytes()
    cut = tmp_path / f"cut{suffix}"
    cut.write_bytes(whole[: int(keep * len(whole))])
    with pytest.raises(RecordingError, match=rf"cut\{suffix}: not a readable"):
        read_cloud(cut, 0.1)


@pytest.mark.parametrize(("suffix", "write"), [(".ply", write_ply), (".pcd", write_pcd)])
def test_a_cloud_of_nan_is_refused(tmp_path, suffix, write):
    with pytest.raises(RecordingError, match="none of its 500 points is finite"):
        read_cloud(write(tmp_path / f"nan{suffix}", np.full_like(POINTS, np.nan)), 0.1)


def test_an_empty_cloud_is_refused(tmp_path):
    (tmp_path / "e.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    with pytest.raises(RecordingError, match=r"e\.ply: holds no points"):
        read_cloud(tmp_path / "e.ply", 0.1)


@pytest.mark.parametrize("count", [0, 1, 5000])
def test_occupied_cells_are_the_different_rows_in_order(count):
    points = np.random.default_rng(0).normal(0.0, 1.5, (count, 3))
    cells = occupied_cells(points, 0.5)
    np.testing.assert_array_equal(cells, np.unique(np.floor(points / 0.5).astype(np.int64), axis=0))
    assert len(cells) < max(count, 2)
