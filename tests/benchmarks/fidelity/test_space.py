"""F2D, F3D, NAV and TOP: free space, the ways through it, and its topology."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import trimesh

from benchmarks.fidelity.derive.curve import Curve
from benchmarks.fidelity.derive.freespace import air_voxels, reachable
from benchmarks.fidelity.derive.ground import judged_ground, judged_route
from benchmarks.fidelity.derive.mesh import Grid, persistence_diagrams
from tests.benchmarks.fidelity import tube
from tests.benchmarks.fidelity.judged import SHORT, against, measure
from tests.benchmarks.fidelity.tube import Tube

judged = partial(against, SHORT)


def test_a_tube_that_is_not_there_breaks_with_a_reason():
    far = replace(judged().candidate, lining=trimesh.Trimesh())
    broken = measure("occ2d_free_iou", replace(judged(), candidate=far, cache={}))
    assert broken.failed
    assert broken.value is None
    assert broken.reason.startswith(("ValueError: ", "IndexError: "))


def test_air_behind_a_wall_is_still_reached_from_the_other_mouth():
    both = air_voxels(judged(box=(0.3, 8.0, 9.0, 6.0, 0.0, 0.0)))
    rows = both.judged.any(axis=(1, 2))
    assert rows[:25].all()
    assert rows[-25:].all()
    assert not rows[30]


STRAIGHT = Tube(length=6.0, bend=np.inf)


def test_rails_keep_the_robot_between_them():
    shown = judged_ground(judged())
    assert not shown.traversable[:, np.abs(np.abs(shown.left) - 0.75) < 0.06].any()
    assert shown.traversable[:, np.abs(shown.left) < 0.45].all()


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


def test_a_hole_leaks_by_its_solid_angle_and_is_a_third_rim():
    lining = judged().candidate.lining
    local = lining.triangles_center - SHORT.point(MIDDLE, 0.0, 3.3)[0]
    hole = np.linalg.norm(local, axis=1) < 0.8
    case = tube.corrupted(judged(), lining=trimesh.Trimesh(lining.vertices, lining.faces[~hole], process=False))
    assert measure("topo_mouth_err", case).value == 1
    assert measure("topo_leak_frac", case).value == pytest.approx(lining.area_faces[hole].sum() / lining.area, rel=0.5)


def test_a_handle_is_counted():
    ring = trimesh.creation.torus(1.0, 0.2)
    case = tube.corrupted(judged(), solid=ring)
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


@pytest.mark.parametrize(("width", "counts"), [(2, False), (4, True)])
def test_air_at_a_mouth_counts_from_a_tenth_of_the_largest_part_on(width, counts):
    free = np.zeros((12, 40, 3), bool)
    free[:, :30] = free[:, 31 : 31 + width] = True
    found = reachable(free)
    assert found[:, :30].all()
    assert found[:, 31 : 31 + width].all() == counts
