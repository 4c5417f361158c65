import numpy as np
import pytest

from benchmarks.fidelity.derive.beams import returns
from benchmarks.fidelity.derive.distances import phantom_cells
from tests.benchmarks.fidelity import tube
from tests.benchmarks.fidelity.judged import category, judged, obstructed, raw


def test_missing_surface_is_the_share_of_returns_beyond_the_end():
    short = judged(length=14.0)
    beyond = tube.Tube().frames([14.0])
    points = returns(short).points
    behind = (points - beyond[0]) @ beyond[1][0] > 0.2
    assert raw("missing_surface_frac", short) == pytest.approx(behind.mean(), abs=0.01)
    assert category("CMP", short) < 70.0


def test_an_obstacle_that_beams_pass_through_is_extra_surface():
    found = raw("extra_surface_frac", obstructed())
    assert found > 0.003
    assert found == np.mean(phantom_cells(obstructed()))
    assert raw("comp_10cm", obstructed()) < raw("comp_10cm", judged())
    assert raw("hausdorff_p99", obstructed()) >= raw("hausdorff_p99", judged())
