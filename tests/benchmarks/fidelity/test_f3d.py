from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import trimesh

from benchmarks.fidelity.derive.freespace import air_voxels, clearance
from tests.benchmarks.fidelity import tube
from tests.benchmarks.fidelity.judged import measure
from tests.benchmarks.fidelity.tube import Tube

TUBE = Tube(length=12.0)


@cache
def judged(**changes):
    return tube.case(TUBE, replace(TUBE, **changes))


def with_extra(mesh):
    return replace(judged(), candidate=replace(judged().candidate, extra=mesh), cache={})


def wall(station):
    """A wall across the whole bore."""
    mesh = trimesh.creation.box((0.3, 8.0, 9.0))
    turned = np.eye(4)
    turned[:3, :3] = np.column_stack([axis[0] for axis in TUBE.frames(station)[1:]])
    turned[:3, 3] = TUBE.point(station, 0.0, 0.0)[0]
    return mesh.apply_transform(turned)


def test_a_true_copy_has_the_true_air():
    case = judged()
    assert measure("free3d_iou", case).value > 0.997
    assert measure("free3d_esdf_rmse", case).value < 1e-6
    assert measure("free3d_headroom_rmse", case).value < 1e-3
    assert measure("free3d_envelope_agree", case).value == 1.0
    assert measure("free3d_false_free", case).value == 0.0
    assert measure("free3d_false_occupied", case).value < 1e-3
    assert measure("free3d_hold_poses_free", case).value == 1.0
    assert measure("free3d_voxel_vs_mesh_vol", case).value < 2.0


def test_a_wider_tube_has_a_larger_inscribed_sphere():
    assert measure("free3d_inscribed_err", judged(width=5.8)).value == pytest.approx(0.1, abs=0.01)


def test_a_higher_crown_is_headroom():
    assert measure("free3d_headroom_rmse", judged(height=6.4)).value == pytest.approx(0.2, abs=0.02)
    assert measure("free3d_envelope_agree", judged(height=6.0)).value < 0.9


def test_a_much_wider_tube_lets_returns_hang_in_its_air():
    case = judged(width=6.4)
    assert measure("free3d_false_free", case).value > 0.2
    assert measure("free3d_volume_rel_err", case).value > 5.0


def test_a_much_narrower_tube_stands_where_beams_went():
    assert measure("free3d_false_occupied", judged(width=4.8)).value > 0.02


def test_a_closed_box_around_the_sensor_takes_its_poses_away():
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    box.apply_translation(TUBE.point(5.5, 0.15, -1.5)[0])
    case = with_extra(box)
    assert measure("free3d_hold_poses_free", case).value < 1.0 or measure("free3d_false_occupied", case).value > 5e-3


def test_air_behind_a_wall_is_still_reached_from_the_other_mouth():
    both = air_voxels(with_extra(wall(6.0)))
    rows = both.judged.any(axis=(1, 2))
    assert rows[:25].all()
    assert rows[-25:].all()
    assert not rows[30]


def test_clearance_on_the_axis_is_half_the_width():
    judged_clear, reference = clearance(judged())
    assert reference.max() == pytest.approx(2.8, abs=0.25)
    assert np.corrcoef(judged_clear.ravel(), reference.ravel())[0, 1] > 0.999


def test_beams_alone_show_the_air():
    case = replace(judged(), truth=None, cache={})
    assert measure("free3d_iou", case).value > 0.93
    assert measure("free3d_esdf_rmse", case).value < 0.1
    assert measure("free3d_headroom_rmse", case).value < 0.06
