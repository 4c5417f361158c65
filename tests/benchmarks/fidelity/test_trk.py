"""TRK and SCN: the track, and the scene in MuJoCo."""

from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest

from benchmarks.fidelity import table
from benchmarks.fidelity.candidate import load_candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive import track
from benchmarks.fidelity.derive.scene import rays_from_axis
from benchmarks.fidelity.derive.track import hold_railway
from tests.benchmarks.fidelity import tube, tubescene
from tests.benchmarks.fidelity.judged import SHORT, against, measure
from tests.benchmarks.fidelity.test_tubes import bounds, value_of

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


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return Case(load_candidate(tubescene.write(tmp_path_factory.mktemp("scene") / "tube", SHORT)))


@pytest.fixture
def rewritten(good, tmp_path):
    """The good scene with one piece of its text replaced."""

    def rewrite(old, new, count=-1):
        text = good.candidate.scene.read_text()
        assert old in text
        path = good.candidate.folder / f"{tmp_path.name}.xml"  # beside the meshes that it names
        path.write_text(text.replace(old, new, count))
        return Case(replace(good.candidate, scene=path))

    return rewrite


@pytest.mark.parametrize("id", [row.id for row in table.load().values() if row.category == "SCN" and row.scored])
def test_a_sound_scene_scores_full_marks(good, id):
    value = measure(id, good)
    assert table.load()[id].map.score(value.value) == 100.0, value


def test_rays_see_nothing_of_a_robot_with_wheels(good, rewritten):
    wheel = '<body name="wheel" pos="0 0.5 0"><joint/><geom type="sphere" size="0.4" mass="1" contype="0"/></body>'
    wheeled = rewritten('conaffinity="3"/></body>', f'conaffinity="3"/>{wheel}</body>')
    for id in ("mj_ray_vs_mesh_mae", "mj_probe_free_frac", "mj_wall_contact_err"):
        assert measure(id, wheeled).value == measure(id, good).value
    seen = [rays_from_axis(case)[0] for case in (wheeled, good)]
    np.testing.assert_array_equal(*seen)


def test_the_step_rate_is_measured(good):
    assert measure("mj_step_rate", good).value > 100.0


EDITS = Path(__file__).with_name("scenes.txt").read_text().splitlines()


@pytest.mark.parametrize("row", [row for row in EDITS if not row.startswith("#")])
def test_a_scene_with_something_else_in_its_file_has_the_values_that_follow(rewritten, row):
    old, new, metrics = row.replace("\\n", "\n").split(" | ")
    case, known = rewritten(old, new), dict(map(bounds, metrics.split("; ")))
    values = {id: value_of(id, case) for id in known}
    assert {id: values[id] for id, (low, high) in known.items() if not low <= values[id] <= high} == {}


def test_panels_off_by_a_hand_are_touched_too_late(tmp_path):
    off = Case(load_candidate(tubescene.write(tmp_path / "tube", SHORT, panels_off=0.10)))
    assert measure("mj_wall_contact_err", off).value == pytest.approx(0.10, abs=0.01)


def test_a_sleeper_less_than_the_manifest_says_is_told(rewritten):
    case = rewritten('name="sleeper_0003"', 'name="plank"')
    value = measure("mj_manifest_match", case)
    assert value.value == 0.0
    assert "sleepers: 19 of 20" in value.reason


def test_what_does_not_change_is_not_computed_again(good, monkeypatch):
    before = measure("mj_wall_contact_err", good).value
    monkeypatch.setattr("benchmarks.fidelity.derive.contact.Probe", None)
    assert measure("mj_wall_contact_err", good).value == before


def test_a_sleeper_is_as_high_as_most_of_its_returns():
    station = np.repeat(np.arange(0.0, 6.0, track._PROFILE_BIN) + 1e-6, 9)
    on = (station + 0.1) % 0.6 < 0.2
    lost = np.tile(np.arange(9) < 4, len(station) // 9)  # four of nine returns of a sleeper come from beside it
    found, rise = track._find_sleepers(station, np.where(on, np.where(lost, -0.1, 0.06), 0.0))
    assert rise == pytest.approx(0.06)
    np.testing.assert_allclose(np.diff(found), 0.6, atol=0.03)
