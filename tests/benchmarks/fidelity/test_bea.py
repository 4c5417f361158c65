from dataclasses import replace

import numpy as np
import pytest
import trimesh

from benchmarks.fidelity import table
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.beams import cast_beams
from benchmarks.fidelity.derive.surface import Caster
from tests.benchmarks.fidelity import tube
from tests.benchmarks.fidelity.judged import judged, measure, obstructed, raw

SIGMA = 0.02


def test_in_the_right_tube_nothing_but_the_range_noise_is_left():
    assert raw("beam_range_mae", judged()) == pytest.approx(SIGMA * np.sqrt(2 / np.pi), rel=0.03)
    assert raw("beam_range_medae", judged()) == pytest.approx(0.6745 * SIGMA, rel=0.03)
    assert raw("beam_range_bias", judged()) < 4 * SIGMA / np.sqrt(len(cast_beams(judged()).range))
    assert raw("beam_early_frac", judged()) == raw("beam_late_frac", judged()) == 0.0


def test_a_beam_meets_a_wall_where_geometry_says():
    straight = replace(tube.Tube(), bend=np.inf, grade=0.0, variation=0.0, depth=0.0, track=False)
    eye = straight.point(9.0, 0.3, 0.0)
    _, tangent, left, up = straight.frames([9.0])
    caster = Caster(tube.candidate(straight).lining)
    directions = np.concatenate([left, -left, -up, np.sqrt(0.5) * (left + tangent), tangent])
    reach, face = caster.first(np.repeat(eye, 5, axis=0), directions)
    np.testing.assert_allclose(reach[:4], [2.5, 3.1, 3.1, 2.5 * np.sqrt(2)], atol=1e-5)
    assert np.isinf(reach[4])
    assert face[4] == -1


def test_an_obstacle_is_early_and_a_missing_end_is_late():
    assert raw("beam_early_frac", obstructed()) > 0.005
    assert raw("beam_late_frac", obstructed()) == 0.0
    short = judged(length=14.0)
    assert raw("beam_late_frac", short) == pytest.approx(np.mean(~cast_beams(short).hit), abs=0.01)
    assert raw("beam_within_10cm", short) < 0.9


def test_returns_are_foreseen_where_the_recording_knows_its_silent_beams():
    assert measure("beam_return_bacc", judged()).value is None
    hold = judged().hold
    out = np.tile(tube.Tube().frames([0.0])[1], (300, 1)) * -1.0
    eye = np.repeat(hold.origin[:1], 300, axis=0)
    columns = {
        "time": np.concatenate([hold.time, np.full(300, hold.time[0])]),
        "scan": np.concatenate([hold.scan, np.zeros(300, int)]),
        "origin": np.concatenate([hold.origin, eye]),
        "direction": np.concatenate([hold.direction, out]),
        "range": np.concatenate([hold.range, np.full(300, np.inf)]),
    }
    listening = replace(hold, **columns, knows_missing=True, cache={})
    assert raw("beam_return_bacc", Case(judged().candidate, listening)) == pytest.approx(1.0, abs=1e-3)
    walled = replace(judged().candidate, extra=_wall(0.0))
    assert raw("beam_return_bacc", Case(walled, listening)) < 0.6
    assert raw("dropout_diff", Case(walled, listening)) > raw("dropout_diff", Case(judged().candidate, listening))


def _wall(station):
    _, tangent, left, up = (axis[0] for axis in tube.Tube().frames([station]))
    placement = np.eye(4)
    placement[:3, :3] = np.column_stack([tangent, left, up])
    placement[:3, 3] = tube.Tube().point(station, 0.0, 0.0)[0]
    return trimesh.creation.box((0.1, 6.0, 7.0), transform=placement)


def test_the_papers_own_figure_cannot_tell_a_wrong_tube_and_is_not_scored():
    right, wrong = (raw("selfcast_p2s_mean", judged(**spoilt)) for spoilt in ({}, {"width": 6.2, "height": 7.0}))
    assert wrong == pytest.approx(right, rel=0.1)
    assert raw("selfcast_noise_ratio", judged(width=6.2)) == pytest.approx(1.0, abs=0.1)
    assert not any(metric.scored for id, metric in table.load().items() if id.startswith("selfcast"))
