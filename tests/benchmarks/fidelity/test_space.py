"""F2D, F3D and NAV: free space and the ways through it."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import trimesh

from benchmarks.fidelity.derive.freespace import air_voxels
from benchmarks.fidelity.derive.ground import judged_ground, judged_route
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


def with_box(left):
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    box.apply_translation(TUBE.point(6.0, left, -2.4)[0])
    return replace(judged(), candidate=replace(judged().candidate, extra=box), cache={})


def test_rails_keep_the_robot_between_them():
    shown = judged_ground(judged())
    assert not shown.traversable[:, np.abs(np.abs(shown.left) - 0.75) < 0.06].any()
    assert shown.traversable[:, np.abs(shown.left) < 0.45].all()


def test_a_box_between_the_rails_blocks_the_way():
    case = with_box(0.0)
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
