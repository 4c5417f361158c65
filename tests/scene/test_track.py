from dataclasses import replace

import numpy as np
import pytest

from scene.errors import FitError
from scene.writing import mesh, mjcf, planar, track, trackmesh
from tests.scene.conftest import arc_bore


def test_sleepers_stand_every_60_cm_from_end_to_end():
    assert len(track.lay(arc_bore(length=60.0), track.TrackConfig()).sleeper_station) == 101


def test_the_gauge_is_between_the_inner_faces_of_the_heads(bore):
    """Measured on the triangles, 16 mm below the rail top; rail centres 1.435 m apart would give 1.362 m."""
    laid = track.lay(bore, track.TrackConfig())
    rails = trackmesh.rails(laid, bore.axis, 0.0, bore.length)
    assert rails.is_watertight
    station = 10.2
    at = bore.axis.at(np.array([station]))
    base = np.interp(station, bore.station, laid.elevation)
    top = base + 0.010 + 0.176
    origin = np.array([*at.position[0, :2], top - 0.016])
    hits = [
        np.linalg.norm(rails.ray.intersects_location([origin], [side * at.lateral[0]], multiple_hits=False)[0] - origin)
        for side in (1, -1)
    ]
    assert sum(hits) == pytest.approx(1.435, abs=0.001)


def test_the_bed_is_the_flat_floor_and_sleepers_stand_out_of_it(bore):
    laid = track.lay(bore, track.TrackConfig())
    floor = bore.position[:, 2] - 3.2 * bore.up[:, 2]
    np.testing.assert_allclose(laid.bed, floor, atol=0.02)
    np.testing.assert_allclose(laid.elevation - laid.bed, 0.06)
    assert not laid.raised
    assert laid.clearance.min() == pytest.approx(2.8 - 1.25, abs=0.02)


def test_in_a_round_bore_the_track_lies_on_a_slab_just_wide_enough(bore):
    n = len(bore.station)
    round_bore = replace(bore, radius=np.full((n, 360), 2.9), width=np.full(n, 5.8), height=np.full(n, 5.8))
    laid = track.lay(round_bore, track.TrackConfig())
    assert laid.raised
    np.testing.assert_allclose(bore.position[:, 2] - laid.bed, np.sqrt(2.9**2 - 1.6**2), atol=0.03)


def test_a_bore_too_low_for_a_track_gets_none(bore):
    n = len(bore.station)
    pipe = replace(bore, radius=np.full((n, 360), 1.2), width=np.full(n, 2.4), height=np.full(n, 2.4))
    assert not len(track.lay(pipe, track.TrackConfig()).sleeper_station)


def test_a_sleeper_too_near_the_wall_is_an_error_with_its_place():
    with pytest.raises(FitError, match=r"the sleeper at .* m comes within"):
        track.lay(arc_bore(half_width=1.3), track.TrackConfig(shoulder=0.0))


def test_the_scene_file_names_every_sleeper_and_both_rails(bore, tmp_path):
    laid = track.lay(bore, track.TrackConfig())
    solid = mesh.build_solid(bore, pockets=False)
    walls = planar.cut_walls(solid, bore, laid.elevation, 0.7)
    lining = mesh.open_lining(mesh.as_trimesh(solid), bore)
    count = mjcf.write_scene(tmp_path, "x", bore, lining, walls, laid, mjcf.SceneConfig())
    text = (tmp_path / "scene.xml").read_text()
    assert text.count('name="sleeper_') == count["sleepers"] == 41
    assert text.count('name="rail_left_') == text.count('name="rail_right_') > 0
