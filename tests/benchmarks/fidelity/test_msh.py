"""MSH and TRI: soundness of the meshes; shape, normals and roughness of their triangles."""

from functools import cache

import numpy as np
import pytest
import trimesh

from benchmarks.fidelity.derive.clouds import hold_patches
from tests.benchmarks.fidelity import tube
from tests.benchmarks.fidelity.judged import measure

SHORT = tube.Tube(length=6.0)


@cache
def good():
    return tube.case(SHORT)


def corrupted(**changes):
    return tube.corrupted(good(), **changes)


def remade(mesh, faces):
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def both(change):
    judged = good().candidate
    return corrupted(lining=change(judged.lining), solid=change(judged.solid))


PASSING = [
    "mesh_finite", "mesh_watertight", "mesh_winding_consistent", "mesh_is_volume", "mesh_manifold_status",
]  # fmt: skip


def test_a_dropped_face_opens_the_solid_and_shows_as_a_rim():
    case = both(lambda mesh: remade(mesh, np.delete(mesh.faces, 777, axis=0)))
    assert measure("mesh_watertight", case).value == 0.0
    assert measure("mesh_is_volume", case).value == 0.0
    assert measure("mesh_manifold_status", case).value == 0.0
    edges = trimesh.Trimesh(good().candidate.lining.vertices, good().candidate.lining.faces, process=False)
    rim = np.linalg.norm(np.diff(edges.triangles[777][[0, 1, 2, 0]], axis=0), axis=1).sum()
    assert measure("mesh_boundary_unexpected", case).value == pytest.approx(
        rim / edges.edges_unique_length.sum(), rel=1e-2
    )


def test_a_floor_wound_the_wrong_way_costs_its_part_of_the_area():
    lining = good().candidate.lining
    low = lining.face_normals[:, 2] > 0.9
    case = corrupted(lining=remade(lining, np.where(low[:, None], lining.faces[:, ::-1], lining.faces)))
    left = 1.0 - lining.area_faces[low].sum() / lining.area
    assert measure("mesh_orientation_frac", case).value == pytest.approx(left, abs=0.01)


def test_a_bore_cut_across_is_two_pieces_with_two_rims_more():
    lining = good().candidate.lining
    station = (lining.triangles_center - SHORT.point(2.0, 0.0, 0.0)) @ SHORT.frames(2.0)[1][0]
    case = corrupted(lining=remade(lining, lining.faces[np.abs(station) > 0.3]))
    parts = [lining.area_faces[side * station > 0.3].sum() for side in (-1, 1)]
    assert measure("topo_floater_area", case).value == pytest.approx(parts[0] / sum(parts), rel=1e-6)
    assert [measure(id, case).value for id in ("topo_body_count_err", "topo_mouth_err")] == [1, 2]


def test_the_volume_is_that_of_the_sections_and_a_scaled_solid_is_off_by_its_cube():
    assert measure("mesh_volume_vs_sections", good()).value < 0.2
    solid = good().candidate.solid.copy()
    solid.apply_scale(1.05)
    assert measure("mesh_volume_vs_sections", corrupted(solid=solid)).value == pytest.approx(
        100 * (1 - 1.05**-3), abs=0.2
    )


def test_a_mesh_that_went_through_a_format_without_shared_corners_is_judged_the_same():
    def torn(mesh):
        soup = mesh.triangles.astype(np.float32).reshape(-1, 3)
        return trimesh.Trimesh(soup, np.arange(len(soup)).reshape(-1, 3), process=False)

    case = both(torn)
    assert [measure(id, case).value for id in PASSING] == [1.0] * len(PASSING)
    assert measure("mesh_boundary_unexpected", case).value == 0.0


NINE = tube.Tube(length=9.0)


@cache
def sound():
    return tube.case(NINE)


def with_lining(vertices, faces=None):
    faces = sound().candidate.lining.faces if faces is None else faces
    return tube.corrupted(sound(), lining=trimesh.Trimesh(vertices, faces, process=False))


def sheet(step, skew=1.0):
    """A flat grid of right triangles with legs `step` and `skew * step`, 4 m long, at mid-height of the tube."""
    along, across = np.meshgrid(np.arange(0.0, 4.0, step), np.arange(0.0, 2.0, step * skew), indexing="ij")
    n, m = along.shape
    corner = np.arange(n * m).reshape(n, m)[:-1, :-1].ravel()
    faces = np.concatenate([np.column_stack([corner, corner + m, corner + 1]),
                            np.column_stack([corner + m, corner + m + 1, corner + 1])])  # fmt: skip
    return NINE.point(along.ravel() + 1.0, across.ravel() - 1.0, np.zeros(n * m)), faces


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
    ends = NINE.point([1.0, 7.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0])
    case = with_lining(ends, np.array([[0, 1, 2]]))
    assert measure("tri_chord_error_max", case).value == pytest.approx(6.0**2 / 8 / NINE.bend, rel=0.05)


def test_noise_on_the_vertices_shows_in_normals_and_roughness():
    vertices = sound().candidate.lining.vertices
    noisy = with_lining(vertices + np.random.default_rng(0).normal(scale=0.06, size=vertices.shape))
    assert measure("tri_normal_noise", noisy).value > measure("tri_normal_noise", sound()).value + 5.0
    assert measure("tri_roughness_ratio", sound()).value == pytest.approx(1.0, abs=0.1)
    assert measure("tri_roughness_ratio", noisy).value > 1.5


def test_the_noise_of_the_recording_is_taken_off_the_wall():
    patches = hold_patches(sound())
    assert abs(patches.roughness) < 0.1 * patches.noise
    assert 0.010 < np.sqrt(patches.noise) < 0.020  # 2 cm along beams that meet the wall aslant


def test_a_wall_without_returns_has_no_roughness_to_compare():
    case = tube.case(NINE, beams=200)
    assert measure("tri_roughness_ratio", case).value is None
    assert not measure("tri_roughness_ratio", case).failed
