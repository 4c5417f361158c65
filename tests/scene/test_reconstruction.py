"""Cloud to bore against analytic tunnels: sizes, type of section, and the corner of wall and floor."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from shapely import LineString, points

from scene.bore import Bore
from scene.cloud import Cloud
from scene.errors import FitError
from scene.fitting.section import fit_sections
from tests.scene.clouds import KnownBore, curved_d_bore
from tests.scene.fits import axis_of, rebuilt, thin
from tests.scene.shapes import PLACE, midline, outline, swept

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


def test_an_axis_knows_its_bend_to_the_left_and_its_grade(bore):
    np.testing.assert_allclose(bore.axis.curvature[30:-30], 1 / 60, rtol=0.02)
    np.testing.assert_allclose(bore.axis.grade[30:-30], 0.01, rtol=0.02)


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


def test_curvature_and_grade_are_in_the_bore_file(tmp_path):
    bore, _ = rebuilt(curved_d_bore(length=40, radius=150, grade=0.01).points)
    bore.save(tmp_path / "bore.npz")
    with np.load(tmp_path / "bore.npz") as data:
        inner = (data["station"] > 5) & (data["station"] < 35)
        sign = np.sign(np.median(data["grade"]))  # the bore may be run from either end
        np.testing.assert_allclose(sign * data["curvature"][inner], 1 / 150, rtol=0.1)
        np.testing.assert_allclose(sign * data["grade"], 0.01, atol=0.003)
        np.testing.assert_array_equal(data["radius"], bore.radius)


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
