from dataclasses import replace

import numpy as np
import pytest
import trimesh

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.distances import mesh_distances
from benchmarks.fidelity.derive.surface import Nearest
from tests.benchmarks.fidelity import tube
from tests.benchmarks.fidelity.judged import judged, measure, raw

SIGMA = 0.02


def test_without_noise_the_distance_is_none():
    quiet = tube.case(sigma=1e-6, beams=600)
    assert raw("c2m_p95", quiet) < 1e-4
    assert raw("c2m_rmse", quiet) < 0.002


def test_walls_ten_centimetres_too_wide_lie_five_centimetres_off_behind_the_points():
    wide = tube.case(tube.Tube(), replace(tube.Tube(), width=5.7, depth=0.0), sigma=1e-6, beams=1200)
    found = mesh_distances(wide)
    wall = found.sector % 4 == 0
    assert np.median(found.signed[wall]) == pytest.approx(0.05, abs=0.002)
    assert raw("c2m_sector_worst", wide) > 0.035
    assert raw("c2m_signed_bias", wide) > 0.01


def test_the_gap_is_left_out_without_the_recording_that_was_fitted():
    assert measure("c2m_fit_hold_gap", judged()).value is None
    assert not measure("c2m_fit_hold_gap", judged()).failed
    right = judged()
    fitted = Case(right.candidate, right.hold, tube.hold(tube.Tube(), beams=600, seed=3), right.truth)
    assert raw("c2m_fit_hold_gap", fitted) < 0.002
    foreign = Case(right.candidate, tube.hold(replace(tube.Tube(), width=5.7), beams=600), right.hold, None)
    assert raw("c2m_fit_hold_gap", foreign) > 0.005


def test_without_a_surface_the_metric_has_failed_and_is_not_missing():
    empty = judged().candidate.extra
    nothing = replace(judged().candidate, lining=empty, track=replace(
        judged().candidate.track, sleeper_mesh=empty, rail_mesh=empty, fastening_mesh=empty))  # fmt: skip
    assert measure("c2m_mean", Case(nothing, judged().hold)).failed


def test_distances_agree_with_trimesh():
    mesh = judged().candidate.lining
    points = judged().hold.points[::500] + 0.03
    expected = trimesh.proximity.closest_point(mesh, points)[1]
    found, closest, _ = Nearest(mesh).query(points)
    assert (found >= expected - 1e-6).all()
    assert np.percentile(found - expected, 99) < 1e-3
    np.testing.assert_allclose(np.linalg.norm(points - closest, axis=1), found, atol=1e-9)
