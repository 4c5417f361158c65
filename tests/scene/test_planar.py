from dataclasses import replace

import numpy as np
import pytest

from scene.bore import NAIL
from scene.writing.mesh import build_solid
from scene.writing.planar import cut_walls, half_widths, ring_pitch, save_tunnel
from scene.writing.track import TrackConfig, lay_track


@pytest.fixture(scope="module")
def walls(bore):
    laid = lay_track(bore, TrackConfig())
    return {
        name: cut_walls(build_solid(bore, pockets=name == "pockets"), bore, laid.elevation, 0.7)
        for name in ("smooth", "pockets")
    }


def test_smooth_walls_run_at_half_the_width_over_the_whole_length(bore, walls):
    np.testing.assert_allclose(half_widths(walls["smooth"], bore), 2.8, atol=0.005)
    for station in (walls["smooth"].left_station, walls["smooth"].right_station):
        assert station[0] == pytest.approx(0, abs=0.05)
        assert station[-1] == pytest.approx(bore.length, abs=0.05)
        assert (np.diff(station) >= 0).all()


def test_left_is_left_of_the_centreline(bore, walls):
    plan = bore.axis.in_plan()
    for wall, side in ((walls["smooth"].left, 1), (walls["smooth"].right, -1)):
        assert (side * plan.local(np.column_stack([wall, np.zeros(len(wall))]))[1] > 2.7).all()


def test_pockets_are_recesses_of_13_cm_with_upright_sides(bore, walls):
    plan = bore.axis.in_plan()
    wall = walls["pockets"].left
    across = plan.local(np.column_stack([wall, np.zeros(len(wall))]))[1]
    assert across.max() == pytest.approx(2.93, abs=0.01)
    assert (across > 2.9).sum() >= 2 * (len(bore.pocket) // 2)


def test_the_ring_pitch_is_that_of_the_joints(bore):
    joints = np.delete(np.arange(0.4, bore.length, 1.4), [3, 9])
    assert ring_pitch(replace(bore, ring_station=joints)) == pytest.approx(1.4)
    assert ring_pitch(replace(bore, ring_station=joints[:0])) == 0.0


def test_a_survey_of_every_fifth_ring_takes_the_pitch_of_the_joints_that_nails_bridge(bore):
    nail = np.zeros(24, NAIL)
    nail["station"] = np.repeat(np.arange(1.5, 18.0, 1.5), 3)[:24] + np.tile([-0.01, 0.0, 0.01], 8)
    surveyed = replace(bore, ring_station=np.arange(0.0, 24.0, 7.0), nail=nail)
    assert ring_pitch(surveyed) == pytest.approx(1.5)


def test_the_tunnel_file_holds_every_field_of_the_format(bore, walls, tmp_path):
    laid = lay_track(bore, TrackConfig())
    save_tunnel(
        tmp_path / "t.npz", "x", "simulated", bore, laid.elevation, 0.7, {**walls, "furnished": walls["pockets"]}
    )
    with np.load(tmp_path / "t.npz") as data:
        assert str(data["schema"]) == "subterra.tunnel/3"
        assert list(data["lining"]) == ["smooth", "pockets", "furnished"]
        n = len(data["station"])
        assert data["centre"].shape == data["tangent"].shape == (n, 2)
        assert data["elevation"].shape == data["half_width"].shape == (n,)
        assert data["ring_pitch"].shape == ()
        for variant in data["lining"]:
            for side in ("left", "right"):
                assert data[f"{side}_{variant}"].shape == (*data[f"{side}_station_{variant}"].shape, 2)
            assert data[f"furniture_{variant}"].shape[1] == 4
