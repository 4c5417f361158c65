"""Cloud to bore against analytic tunnels."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from scene.bore import Bore
from scene.cloud import Cloud
from scene.errors import FitError
from scene.fitting.section import fit_sections
from tests.scene.clouds import KnownBore, curved_d_bore
from tests.scene.fits import axis_of, rebuilt, thin

STRAIGHT = np.array([[0.0] * 3, [30.0, 0.0, 0.0]])


def offsets(bore: Bore, cloud: Cloud, known: KnownBore) -> tuple[np.ndarray, np.ndarray]:
    centre = known.centre - cloud.origin
    offset = bore.position - centre[cKDTree(centre).query(bore.position)[1]]
    return np.einsum("ij,ij->i", offset, bore.lateral), np.einsum("ij,ij->i", offset, bore.up)


@pytest.mark.parametrize("yaw", [0.0, 2.3, -1.6])
def test_a_curved_d_bore_is_measured_in_any_orientation(yaw):
    known = curved_d_bore(yaw=yaw, per_metre=2000)
    bore, cloud = rebuilt(known.points)
    lateral, vertical = offsets(bore, cloud, known)
    assert np.sqrt(np.mean(lateral**2)) < 0.01
    assert np.sqrt(np.mean(vertical**2)) < 0.01
    assert bore.length == pytest.approx(known.length, abs=0.15)
    assert np.sqrt(np.mean((bore.width - known.width) ** 2)) < 0.015
    assert np.sqrt(np.mean((bore.height - known.height) ** 2)) < 0.015
    assert not bore.filled.any()


def test_frames_are_orthonormal_and_lateral_points_left():
    bore, _ = rebuilt(curved_d_bore(length=20, per_metre=1500).points)
    np.testing.assert_allclose(np.cross(bore.up, bore.tangent), bore.lateral, atol=1e-12)
    np.testing.assert_allclose(bore.lateral[:, 2], 0, atol=1e-12)
    steps = np.diff(bore.position, axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), np.diff(bore.station), rtol=1e-3)


def test_rails_and_people_do_not_move_floor_or_walls():
    known = curved_d_bore(length=30, radius=1e6, grade=0.0, yaw=0.0, offset=(0, 0, 0))
    rng = np.random.default_rng(1)
    rails = np.stack(
        [
            rng.uniform(0, 30, 8000),
            rng.choice([-0.75, 0.75], 8000) + rng.normal(0, 0.03, 8000),
            rng.uniform(-3.0, -2.9, 8000),
        ],
        axis=1,
    )
    person = np.array([15.0, 1.6, -2.3]) + rng.normal(0, [0.15, 0.15, 0.4], (4000, 3))
    bore, _ = rebuilt(np.concatenate([known.points, rails, person]), STRAIGHT)
    assert np.abs(bore.width - known.width).max() < 0.05
    assert np.abs(bore.height - known.height).max() < 0.05


def test_a_hole_in_the_survey_is_filled_and_marked():
    known = curved_d_bore(length=30, radius=1e6, grade=0.0, yaw=0.0, offset=(0, 0, 0))
    gone = (np.abs(known.points[:, 0] - 15) < 0.4) & (known.points[:, 2] > -2.5)
    bore, _ = rebuilt(known.points[~gone], STRAIGHT)
    at_hole = np.abs(bore.position[:, 0] + np.floor(np.median(known.points[:, 0])) - 15) < 0.2
    assert bore.filled[at_hole].all()
    assert np.abs(bore.width[at_hole] - known.width).max() < 0.05


@pytest.mark.parametrize("shape", ["plane", "ball", "noise"])
def test_a_cloud_without_a_tunnel_is_refused(shape):
    rng = np.random.default_rng(0)
    if shape == "plane":
        points = np.column_stack([rng.uniform(0, 60, 60000), rng.uniform(0, 8, 60000), rng.normal(0, 0.01, 60000)])
    elif shape == "ball":
        points = rng.normal(size=(60000, 3))
        points *= 8 / np.linalg.norm(points, axis=1, keepdims=True)
    else:
        points = rng.uniform(-10, 10, (60000, 3))
    cloud = thin(points)
    with pytest.raises(FitError):
        fit_sections(cloud, axis_of(cloud))
