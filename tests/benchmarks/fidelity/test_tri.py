"""TRI: shape, normals and roughness of the triangles."""

from functools import cache

import numpy as np
import pytest
import trimesh

from benchmarks.fidelity.derive.clouds import hold_patches
from tests.benchmarks.fidelity import tube
from tests.benchmarks.fidelity.judged import measure

SHORT = tube.Tube(length=9.0)


@cache
def good():
    return tube.case(SHORT)


def with_lining(vertices, faces=None):
    faces = good().candidate.lining.faces if faces is None else faces
    return tube.corrupted(good(), lining=trimesh.Trimesh(vertices, faces, process=False))


def sheet(step, skew=1.0):
    """A flat grid of right triangles with legs `step` and `skew * step`, 4 m long, at mid-height of the tube."""
    along, across = np.meshgrid(np.arange(0.0, 4.0, step), np.arange(0.0, 2.0, step * skew), indexing="ij")
    n, m = along.shape
    corner = np.arange(n * m).reshape(n, m)[:-1, :-1].ravel()
    faces = np.concatenate([np.column_stack([corner, corner + m, corner + 1]),
                            np.column_stack([corner + m, corner + m + 1, corner + 1])])  # fmt: skip
    return SHORT.point(along.ravel() + 1.0, across.ravel() - 1.0, np.zeros(n * m)), faces


def test_right_triangles_have_the_shape_of_right_triangles():
    case = with_lining(*sheet(0.2))
    assert measure("tri_aspect_p95", case).value == pytest.approx(2.0, rel=0.02)
    assert measure("tri_min_angle_p05", case).value == pytest.approx(45.0, rel=0.02)
    assert measure("tri_sliver_frac", case).value == 0.0
    assert measure("tri_edge_p95", case).value == pytest.approx(0.2 * np.sqrt(2), rel=0.02)
    assert measure("tri_normal_noise", case).value < 0.1
    assert measure("tri_face_count", case).value == len(case.candidate.lining.faces)


def test_needles_are_slivers():
    case = with_lining(*sheet(0.004, 100.0))
    assert measure("tri_sliver_frac", case).value == 1.0
    assert measure("tri_min_angle_p05", case).value == pytest.approx(np.degrees(np.arctan(0.01)), rel=0.02)
    assert measure("tri_aspect_p95", case).value == pytest.approx(100.0, rel=0.02)


def test_an_edge_over_the_bend_misses_it_by_its_sagitta():
    ends = SHORT.point([1.0, 7.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0])
    case = with_lining(ends, np.array([[0, 1, 2]]))
    assert measure("tri_chord_error_max", case).value == pytest.approx(6.0**2 / 8 / SHORT.bend, rel=0.05)


def test_noise_on_the_vertices_shows_in_normals_and_roughness():
    vertices = good().candidate.lining.vertices
    noisy = with_lining(vertices + np.random.default_rng(0).normal(scale=0.06, size=vertices.shape))
    assert measure("tri_normal_noise", noisy).value > measure("tri_normal_noise", good()).value + 5.0
    assert measure("tri_roughness_ratio", good()).value == pytest.approx(1.0, abs=0.1)
    assert measure("tri_roughness_ratio", noisy).value > 1.5


def test_the_noise_of_the_recording_is_taken_off_the_wall():
    patches = hold_patches(good())
    assert abs(patches.roughness) < 0.1 * patches.noise
    assert 0.010 < np.sqrt(patches.noise) < 0.020  # 2 cm along beams that meet the wall aslant


def test_a_wall_without_returns_has_no_roughness_to_compare():
    case = tube.case(SHORT, beams=200)
    assert measure("tri_roughness_ratio", case).value is None
    assert not measure("tri_roughness_ratio", case).failed
