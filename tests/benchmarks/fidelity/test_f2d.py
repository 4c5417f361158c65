from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import trimesh

from tests.benchmarks.fidelity import tube
from tests.benchmarks.fidelity.judged import measure
from tests.benchmarks.fidelity.tube import Tube

TUBE = Tube(length=12.0)


@cache
def judged(**changes):
    return tube.case(TUBE, replace(TUBE, **changes))


def test_a_true_copy_has_the_true_free_space():
    case = judged()
    assert measure("occ2d_free_iou", case).value == 1.0
    assert measure("occ2d_boundary_f1", case).value == 1.0
    assert measure("free2d_width_mae", case).value < 1e-6
    assert measure("free2d_edt_rmse", case).value == 0.0


def test_a_wider_tube_is_too_free_by_its_width():
    case = judged(width=5.8)
    assert measure("free2d_width_mae", case).value == pytest.approx(0.2, abs=5e-3)
    assert measure("free2d_width_min_err", case).value == pytest.approx(0.2, abs=5e-3)
    assert measure("free2d_area_rel_err", case).value == pytest.approx(100 * 0.2 / 5.6, abs=1.0)
    assert measure("occ2d_free_precision", case).value < 0.98
    assert measure("occ2d_free_recall", case).value == 1.0


def test_a_bend_that_is_not_there_moves_the_medial_axis():
    assert measure("free2d_skeleton_p95", judged(bend=40.0)).value > 0.3


def test_a_pillar_is_not_free():
    pillar = trimesh.creation.box((0.6, 0.6, 6.0))
    pillar.apply_translation(TUBE.point(6.0, 1.5, 0.0)[0])
    case = replace(judged(), candidate=replace(judged().candidate, extra=pillar), cache={})
    lost = 1.0 - measure("occ2d_free_recall", case).value
    assert lost == pytest.approx(0.6 * 0.6 / (5.6 * 12.0), rel=0.6)
    assert measure("free2d_edt_rmse", case).value > 0.2


def test_beams_alone_show_the_free_space():
    good, wide = (replace(case, truth=None, cache={}) for case in (judged(), judged(width=6.2)))
    assert measure("occ2d_free_iou", good).value > 0.97
    assert measure("free2d_area_rel_err", good).value < 2.0
    assert measure("free2d_area_rel_err", wide).value > 8.0
    assert 0.0 < measure("occ2d_unknown_frac", good).value < 0.8


def test_a_tube_that_is_not_there_breaks_with_a_reason():
    far = replace(judged().candidate, lining=trimesh.Trimesh())
    broken = measure("occ2d_free_iou", replace(judged(), candidate=far, cache={}))
    assert broken.failed
    assert broken.value is None
    assert broken.reason.startswith(("ValueError: ", "IndexError: "))


def test_the_same_case_gives_the_same_interval():
    first, second = (measure("free2d_width_mae", replace(judged(width=5.8), cache={})) for _ in range(2))
    assert first == second
    assert np.isfinite(first.value)
