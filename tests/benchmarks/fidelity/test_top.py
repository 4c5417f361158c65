"""TOP: topology of the surface and of the free space."""

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
import trimesh

from benchmarks.fidelity.derive.curve import Curve
from benchmarks.fidelity.derive.mesh import Grid, persistence_diagrams
from tests.benchmarks.fidelity import tube
from tests.benchmarks.fidelity.judged import SHORT, against, measure

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
