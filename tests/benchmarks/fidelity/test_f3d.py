from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import trimesh

from benchmarks.fidelity.derive.freespace import air_voxels, clearance
from tests.benchmarks.fidelity.judged import SHORT, against

TUBE = SHORT
judged = partial(against, SHORT)


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


def test_clearance_on_the_axis_is_half_the_width():
    judged_clear, reference = clearance(judged())
    assert reference.max() == pytest.approx(2.8, abs=0.25)
    assert np.corrcoef(judged_clear.ravel(), reference.ravel())[0, 1] > 0.999
