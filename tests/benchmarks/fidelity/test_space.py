"""F2D, F3D, NAV and TOP: free space, the ways through it, and its topology."""

from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from benchmarks.fidelity.categories import space
from benchmarks.fidelity.derive.curve import Curve
from benchmarks.fidelity.derive.freespace import air_voxels, reachable
from benchmarks.fidelity.derive.ground import judged_ground, judged_route
from benchmarks.fidelity.derive.mesh import Grid, persistence_diagrams
from tests.benchmarks.fidelity import tube
from tests.benchmarks.fidelity.judged import SHORT, against, measure
from tests.benchmarks.fidelity.tube import Tube

TUBE = SHORT
judged = partial(against, SHORT)


def test_a_pillar_is_not_free():
    pillar = trimesh.creation.box((0.6, 0.6, 6.0))
    pillar.apply_translation(TUBE.point(6.0, 1.5, 0.0)[0])
    case = replace(judged(), candidate=replace(judged().candidate, extra=pillar), cache={})
    lost = 1.0 - measure("occ2d_free_recall", case).value
    assert lost == pytest.approx(0.6 * 0.6 / (5.6 * 12.0), rel=0.6)
    assert measure("free2d_edt_rmse", case).value > 0.2


def test_a_tube_that_is_not_there_breaks_with_a_reason():
    far = replace(judged().candidate, lining=trimesh.Trimesh())
    broken = measure("occ2d_free_iou", replace(judged(), candidate=far, cache={}))
    assert broken.failed
    assert broken.value is None
    assert broken.reason.startswith(("ValueError: ", "IndexError: "))


def with_extra(mesh):
    return replace(judged(), candidate=replace(judged().candidate, extra=mesh), cache={})


def wall(station):
    """A wall across the whole bore."""
    mesh = trimesh.creation.box((0.3, 8.0, 9.0))
    turned = np.eye(4)
    turned[:3, :3] = np.column_stack([axis[0] for axis in TUBE.frames(station)[1:]])
    turned[:3, 3] = TUBE.point(station, 0.0, 0.0)[0]
    return mesh.apply_transform(turned)


def test_air_behind_a_wall_is_still_reached_from_the_other_mouth():
    both = air_voxels(with_extra(wall(6.0)))
    rows = both.judged.any(axis=(1, 2))
    assert rows[:25].all()
    assert rows[-25:].all()
    assert not rows[30]


STRAIGHT = Tube(length=6.0, bend=np.inf)


def test_rails_keep_the_robot_between_them():
    shown = judged_ground(judged())
    assert not shown.traversable[:, np.abs(np.abs(shown.left) - 0.75) < 0.06].any()
    assert shown.traversable[:, np.abs(shown.left) < 0.45].all()


def test_a_box_between_the_rails_blocks_the_way():
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    box.apply_translation(TUBE.point(6.0, 0.0, -2.4)[0])
    case = with_extra(box)
    assert measure("nav_path_exists", case).value == 0.0
    assert measure("nav_path_len_ratio", case).failed
    assert measure("nav_blocked_diff", case).value >= 1.0
    assert measure("nav_feasible_agree", case).value < 1.0


def test_a_thin_wall_across_the_bore_blocks_the_way():
    corners = TUBE.point([6.0] * 4, [-4.0, 4.0, 4.0, -4.0], [-4.0, -4.0, 4.0, 4.0])
    wall = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    case = replace(judged(), candidate=replace(judged().candidate, extra=wall), cache={})
    assert measure("nav_path_exists", case).value == 0.0
    assert measure("nav_feasible_agree", case).value < 0.97


def widened(gauge):
    """The straight tube with another gauge, judged against the standard one."""
    return tube.case(STRAIGHT, replace(STRAIGHT, gauge=gauge))


def test_the_lane_between_the_rails_widens_with_the_gauge_by_centimetres_and_not_by_cells():
    lanes, clearances = [], []
    for gauge in (1.435, 1.445, 1.455, 1.465, 1.475):
        ground = judged_ground(widened(gauge))
        lanes.append(ground.traversable[:, np.abs(ground.left) < 0.75].sum(axis=1).mean() * ground.spacing)
        clearances.append(judged_route(widened(gauge)).clearance.mean())
    assert 0.03 <= lanes[-1] - lanes[0] <= 0.05
    assert np.max(np.diff(lanes)) < 0.021  # a centimetre on either side: half as many lattices would give 4 cm
    assert np.max(np.diff(clearances)) < 0.011


MIDDLE = 6.13


good = partial(against, SHORT)


@cache
def heard():
    return tube.case(SHORT, beams=20_000)


def placed(size, left=0.0, up=0.0):
    turn = np.eye(4)
    turn[:3, :3] = np.column_stack([axis[0] for axis in SHORT.frames(MIDDLE)[1:]])
    turn[:3, 3] = SHORT.point(MIDDLE, left, up)[0]
    return trimesh.creation.box(size, transform=turn)


WALL = placed((0.1, 8.0, 8.0))
PILLAR = placed((0.4, 0.4, 8.0))
BLOB = placed((0.5, 0.5, 0.5), 0.4, 0.4)


def test_a_wall_across_cuts_it_in_two():
    case = tube.corrupted(good(), extra=WALL)
    assert measure("topo_free_b0", case).value == 2
    assert measure("topo_body_count_err", case).value == 1


def test_a_pillar_from_floor_to_crown_makes_a_loop():
    assert measure("topo_free_b1_err", tube.corrupted(good(), extra=PILLAR)).value == 1
    assert measure("topo_free_b2_err", tube.corrupted(good(), extra=PILLAR)).value == 0


def test_a_body_in_the_air_makes_a_void_and_is_loose_area():
    case = tube.corrupted(good(), extra=BLOB)
    assert measure("topo_free_b2_err", case).value == 1
    assert measure("topo_floater_area", case).value == pytest.approx(
        1.5 / (1.5 + good().candidate.lining.area), rel=1e-6
    )


def test_held_out_returns_show_the_pillar_too():
    known = replace(heard(), truth=None)
    assert measure("topo_free_b1_err", known).value == 0
    assert measure("topo_free_b1_err", tube.corrupted(known, extra=PILLAR)).value == 1


def test_a_narrower_bore_moves_the_diagram_by_what_it_is_narrower():
    assert measure("topo_bottleneck_h0", against(SHORT, width=5.0, height=5.6)).value == pytest.approx(0.3, abs=0.11)


def test_a_hole_leaks_by_its_solid_angle_and_is_a_third_rim():
    lining = good().candidate.lining
    local = lining.triangles_center - SHORT.point(MIDDLE, 0.0, 3.3)[0]
    hole = np.linalg.norm(local, axis=1) < 0.8
    case = tube.corrupted(good(), lining=trimesh.Trimesh(lining.vertices, lining.faces[~hole], process=False))
    assert measure("topo_mouth_err", case).value == 1
    assert measure("topo_leak_frac", case).value == pytest.approx(lining.area_faces[hole].sum() / lining.area, rel=0.5)


def test_a_handle_is_counted():
    ring = trimesh.creation.torus(1.0, 0.2)
    case = tube.corrupted(good(), solid=ring)
    assert measure("topo_genus", case).value == 1
    assert measure("topo_chi_err", case).value == 2


def test_persistence_of_a_box_with_a_floating_block_is_known():
    occupied = np.ones((12, 12, 12), bool)
    occupied[:, 1:-1, 1:-1] = False
    occupied[5:7, 5:7, 5:7] = True
    straight = Curve(np.linspace(0, 12, 13), np.column_stack([np.linspace(0, 12, 13), np.zeros((13, 2))]))
    grid = Grid(straight, np.ones(3), np.array([0.0, -3.0, -3.0]), occupied.shape)
    zero, _, two = persistence_diagrams(grid.clearance(occupied))
    assert np.isinf(zero[:, 1]).sum() == 1
    assert (two[:, 1] - two[:, 0] > 1.0).sum() == 1


@pytest.mark.parametrize(("nearest", "free"), [(0.15, 0.0), (0.25, 1.0)])
def test_a_sensor_is_in_the_air_from_twenty_centimetres_off_any_surface_on(monkeypatch, nearest, free):
    surface = SimpleNamespace(query=lambda at: (np.full(len(at), nearest), None, None))
    monkeypatch.setattr(space, "surface_nearest", lambda case: surface)
    assert measure("free3d_hold_poses_free", replace(judged(), cache={})).value == free


@pytest.mark.parametrize(("width", "counts"), [(2, False), (4, True)])
def test_air_at_a_mouth_counts_from_a_tenth_of_the_largest_part_on(width, counts):
    free = np.zeros((12, 40, 3), bool)
    free[:, :30] = free[:, 31 : 31 + width] = True
    found = reachable(free)
    assert found[:, :30].all()
    assert found[:, 31 : 31 + width].all() == counts
