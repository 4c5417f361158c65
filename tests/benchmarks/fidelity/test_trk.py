"""TRK: sleepers, rails, pads and fasteners."""

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest

from benchmarks.fidelity.derive.track import hold_railway
from tests.benchmarks.fidelity import tube
from tests.benchmarks.fidelity.judged import SHORT, against, measure

judged = partial(against, SHORT)


@cache
def heard():
    """A short tube without a truth."""
    return replace(tube.case(SHORT, beams=20_000), truth=None)


def test_jitter_shows_in_the_standard_deviation():
    case = judged()
    moved = case.candidate.track.sleeper.copy()
    moved += np.random.default_rng(0).normal(scale=0.02, size=(len(moved), 1)) * SHORT.frames(5.0)[1]
    shaken = tube.corrupted(case, track=replace(case.candidate.track, sleeper=moved))
    assert measure("trk_sleeper_spacing_std_err", shaken).value == pytest.approx(0.02 * np.sqrt(2), rel=0.5)


def test_a_missing_length_of_rail_is_the_gap():
    case = judged()
    track = case.candidate.track
    length = 12.0 / 8
    part = np.arange(len(track.rail_mesh.faces)) // 12 // 3  # twelve faces a box, three boxes a length
    holed = track.rail_mesh.copy()
    holed.update_faces(part != 4)
    assert measure(
        "trk_rail_gap_max", tube.corrupted(case, track=replace(track, rail_mesh=holed))
    ).value == pytest.approx(length, abs=0.01)


def test_a_lifted_rail_floats_over_its_pads():
    case = judged()
    lifted = case.candidate.track.rail_mesh.copy()
    lifted.apply_translation([0.0, 0.0, 0.04])
    before = measure("trk_asset_penetration_max", case).value
    case = tube.corrupted(case, track=replace(case.candidate.track, rail_mesh=lifted))
    assert measure("trk_asset_penetration_max", case).value == pytest.approx(0.04 + before, abs=0.01)


def test_a_narrow_bore_does_not_hold_its_sleepers():
    case = judged()
    bore = replace(case.candidate.bore, radius=case.candidate.bore.radius * 0.43)
    assert measure("trk_sleeper_in_bore", tube.corrupted(case, bore=bore)).value == 0.0


def test_the_recording_alone_shows_sleepers_and_rails_where_they_are():
    seen = hold_railway(heard())
    real = SHORT.point(SHORT.sleepers, np.zeros(20), SHORT.floor(SHORT.sleepers) + SHORT.rise)
    gap = np.linalg.norm(seen.sleeper[:, None] - real, axis=2).min(axis=1)
    assert len(seen.sleeper) >= 18
    assert gap.max() < 0.06
    assert measure("trk_rail_lateral_rmse", heard()).value < 0.01
    assert measure("trk_rail_height_rmse", heard()).value < 0.01
    assert measure("trk_sleeper_f1", heard()).value > 0.97
    assert measure("trk_gauge_mean_err", heard()).reason.startswith("K:")


def test_where_the_recording_shows_no_track_there_is_nothing_to_match():
    bare = replace(tube.case(replace(SHORT, track=False), SHORT), truth=None)
    for id in ("trk_sleeper_f1", "trk_gauge_mean_err", "trk_rail_lateral_rmse"):
        assert measure(id, bare).value is None
        assert not measure(id, bare).failed


def test_sleepers_that_the_truth_has_not_match_nothing():
    assert measure("trk_sleeper_f1", tube.case(replace(SHORT, track=False), SHORT)).value == 0.0
