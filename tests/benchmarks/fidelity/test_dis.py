import numpy as np
import pytest
from scipy.spatial import cKDTree

from benchmarks.fidelity.categories.sensor import middle_range
from benchmarks.fidelity.derive.clouds import fit_planes, mean_entropy, voxel_map, voxel_wasserstein
from benchmarks.fidelity.faults import Fault, Site, put_in
from tests.benchmarks.fidelity.judged import judged, measure, raw


def test_a_moved_cloud_is_as_far_in_wasserstein_as_it_was_moved():
    rng = np.random.default_rng(0)
    cloud = rng.uniform(0.15, 0.35, (400, 3)) + np.repeat(0.5 * np.arange(4), 100)[:, None] * [1.0, 0.0, 0.0]
    key, distance = voxel_wasserstein(voxel_map(cloud, 0.5), voxel_map(cloud + np.array([0.03, -0.04, 0.0]), 0.5))
    assert len(key) == 4
    np.testing.assert_allclose(distance, 0.05, atol=1e-6)


def test_a_cloud_twice_as_rough_is_as_far_as_its_roughness():
    rng = np.random.default_rng(1)
    flat = rng.uniform(0.05, 0.45, (200_000, 3)) * [1.0, 1.0, 0.0]
    noise = rng.normal(size=len(flat))[:, None] * [0.0, 0.0, 1.0]
    smooth, rough = (voxel_map(flat + 0.25 * np.array([0, 0, 1.0]) + sigma * noise, 0.5) for sigma in (0.01, 0.03))
    _, distance = voxel_wasserstein(smooth, rough)
    np.testing.assert_allclose(distance, 0.02, atol=1e-4)


def test_the_entropy_of_a_normal_cloud_is_its_formula():
    rng = np.random.default_rng(2)
    cloud = rng.normal(size=(4000, 3)) * [0.02, 0.03, 0.01]
    expected = 0.5 * np.log((2 * np.pi * np.e) ** 3 * (0.02 * 0.03 * 0.01) ** 2)
    assert mean_entropy(cKDTree(cloud), cloud[:200]) == pytest.approx(expected, abs=0.05)


def test_a_local_plane_knows_its_normal_and_its_noise():
    rng = np.random.default_rng(3)
    cloud = np.column_stack([rng.uniform(-1, 1, (5000, 2)), 0.01 * rng.normal(size=5000)])
    found = fit_planes(cloud, cKDTree(cloud), cloud[:2000])
    assert np.median(np.abs(found.normal[:, 2])) > 0.99
    assert np.median(found.sigma) == pytest.approx(0.01, rel=0.1)
    assert np.median(found.residual) == pytest.approx(0.00674, rel=0.1)


def test_the_middle_of_ranges_with_gaps_hardly_moves_with_half_of_the_beams():
    rng = np.random.default_rng(4)
    rings = np.repeat(4.0 * 1.2 ** np.arange(10), 100)  # m: where the rings of a scanner meet a bore
    measured, cast = (rings + 0.03 * rng.normal(size=rings.size) for _ in range(2))
    halves = [rng.random(rings.size) < 0.5 for _ in range(200)]

    def spread(middle):
        return np.std([middle(measured[half]) - middle(cast[half]) for half in halves])

    assert middle_range(measured) == pytest.approx(np.median(rings), rel=0.05)
    assert spread(middle_range) < 0.005
    assert spread(middle_range) < 0.5 * spread(np.median)


def test_half_of_the_beams_hardly_move_the_profile_over_azimuth():
    case = judged()
    half = put_in(Site(case, np.random.default_rng(5)), Fault("thinned", 0.5))
    assert raw("azimuth_profile_rmse", half) == pytest.approx(raw("azimuth_profile_rmse", case), abs=0.003)


def test_what_is_not_recorded_is_missing():
    assert measure("dropout_diff", judged()).value is None
    assert not measure("dropout_diff", judged()).failed
