from dataclasses import replace
from functools import partial

import pytest
import trimesh

from tests.benchmarks.fidelity.judged import SHORT, against, measure

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
