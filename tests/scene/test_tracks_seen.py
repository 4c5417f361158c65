"""Tracks as a cloud shows them: none in a road, two where there are two, with the gauge and sleepers that they have."""

import functools
import json
from dataclasses import replace

import numpy as np
import pytest

from scene.bore import Bore
from scene.cloud import Cloud
from scene.fitting import rails as rails_seen
from scene.fitting.rails import measure_again
from scene.fitting.trackseen import SeenTrack, above_floor, find_track
from scene.judging.sanity import doubt_track
from scene.writing.folder import write_geometry
from scene.writing.mjcf import SceneConfig
from scene.writing.track import TrackConfig, describe_track, lay_track, track_provenance
from subterra_jax.physics.ground import read_track
from subterra_jax.tunnel.sources import load_tunnel
from tests.scene import railway
from tests.scene.fits import fitted, keep, thin
from tests.scene.railway import World, arch
from tests.scene.shapes import PLACE

L = 26.0
STATIONS = np.arange(0.3, L - 0.2, 0.6) + np.random.default_rng(4).normal(0, 0.01, 43)


def track(seat: float, aside: float = 0.0, gauge: float = 1.435, cant: float = 0.0) -> list[railway.Box]:
    return [*railway.sleepers(STATIONS, seat, aside), *railway.rails(L, seat + 0.01, aside, gauge, cant)]


WORLDS = {
    "proud": World(arch(5.1, 5.5, 3.0), L, track(0.22)),
    "ballast": World(arch(5.6, 6.4, 3.6), L, [(0.0, L, -1.6, 1.6, 0.0, 0.14), *track(0.24)]),
    "metre gauge": World(arch(5.1, 5.5, 3.0), L, track(0.22, gauge=1.0)),
    "double": World(arch(8.7, 6.6, 3.0), L, [*track(0.22, -2.1), *track(0.22, 2.1)]),
    "bare rails": World(arch(5.1, 5.5, 3.0), L, railway.rails(L, 0.22)),
    "road": World(arch(9.6, 7.0, 4.0), L, [(0, L, 3.8, 4.8, 0, 0.2), (0, L, -4.8, -3.8, 0, 0.2)]),
    "corridor": World(arch(4.5, 4.0, 3.5), L, [(5, 7, 1.5, 2.25, 0, 1.8), (0, L, -2.2, -1.9, 0.3, 0.5)]),
    "canted": World(arch(5.1, 5.5, 3.0), L, track(0.24, cant=0.08)),
}


@functools.cache
def scanned(name: str, sensor: str = "os1") -> tuple[Cloud, Bore]:
    world = WORLDS[name]
    if sensor == "terrestrial":
        cloud = thin(world.scan(railway.terrestrial(), railway.stations(L), 0.004), 0.07)
    else:
        rays = railway.os1() if sensor == "os1" else railway.vlp16()
        cloud = thin(world.scan(rays, railway.carried(L, 1.4, 0.5), 0.012))
    return cloud, fitted(cloud, world.middle)[0]


@functools.cache
def seen_in(name: str, sensor: str = "os1") -> SeenTrack:
    return find_track(*scanned(name, sensor))


def low_points(name: str) -> rails_seen.LowPoints:
    cloud, bore = scanned(name)
    return above_floor(cloud.points.astype(np.float64), bore)


def f1(bore: Bore, cloud: Cloud, stations: np.ndarray) -> float:
    """F1 of sleepers within 15 cm of a true one."""
    built = bore.axis.at(stations).position[:, 0] + cloud.origin[0] - PLACE[0]
    near = np.abs(built[:, None] - STATIONS) < 0.15
    return 2 * near.any(axis=1).sum() / (len(built) + len(STATIONS))


@pytest.mark.parametrize(
    ("name", "sensor", "gauge"),
    [
        ("proud", "vlp16", 1.435), ("proud", "os1", 1.435), ("proud", "terrestrial", 1.435), ("ballast", "os1", 1.435),
        ("metre gauge", "os1", 1.0),
    ],
)  # fmt: skip
def test_proud_sleepers_and_the_gauge_are_found(name, sensor, gauge):
    cloud, bore = scanned(name, sensor)
    (line,) = seen_in(name, sensor).lines
    keep(line)
    assert line.rails.measured
    assert line.rails.gauge == pytest.approx(gauge, abs=0.005)
    assert line.sleepers.protrusion == pytest.approx(0.24 if name == "ballast" else 0.22, abs=0.015)
    assert f1(bore, cloud, line.sleepers.station) >= 0.9
    laid = lay_track(bore, TrackConfig(), SeenTrack((line,), True))
    assert laid.lines[0].gauge == line.rails.gauge
    assert describe_track(laid, SeenTrack((line,), True))["gauge_seen"] == line.rails.gauge


def test_two_tracks_are_two_and_a_gauge_that_no_face_shows_is_not_seen():
    cloud, bore = scanned("double")
    seen = seen_in("double")
    assert [float(np.median(line.rails.offset)) for line in seen.lines] == pytest.approx([-2.1, 2.1], abs=0.03)
    assert all(f1(bore, cloud, line.sleepers.station) >= 0.9 for line in seen.lines)
    laid = lay_track(bore, TrackConfig(), seen)
    facts = describe_track(laid, seen)
    keep([seen, facts])
    assert [line["gauge_seen"] for line in facts["lines"]] == [None, None]
    assert [line["gauge_from"] for line in facts["lines"]] == ["by standard"] * 2
    assert facts["gauge"] == 1.435


@pytest.mark.parametrize("name", ["road", "corridor"])
def test_no_railway_is_found_where_there_is_none(name):
    _, bore = scanned(name, "terrestrial")
    seen = seen_in(name, "terrestrial")
    keep([seen, lay_track(bore, TrackConfig(lay="standard"), seen)])
    assert not seen.lines
    laid = lay_track(bore, TrackConfig(), seen)
    assert not laid.lines
    np.testing.assert_array_equal(laid.elevation, laid.bed)
    assert track_provenance(laid, seen) == {"track": "none: the survey shows no rails"}


def test_cant_is_measured():
    _, bore = scanned("canted")
    (line,) = seen_in("canted").lines
    keep([line, lay_track(bore, TrackConfig(), seen_in("canted"))])
    turned = 1 if bore.tangent[0, 0] > 0 else -1  # left is the other side for who goes back
    assert np.median(line.rails.cant) == pytest.approx(turned * 0.08, abs=0.01)


def test_the_gauge_of_a_canted_track_is_that_of_its_own_plane():
    station, lateral, height, upward = low_points("proud")
    gauges = []
    for lean in np.radians([0.0, 7.0]):  # the very same track on its side, by as much as railways are canted
        across = lateral * np.cos(lean) - upward * np.sin(lean)
        upright = lateral * np.sin(lean) + upward * np.cos(lean)
        (line,) = rails_seen.find_rails(rails_seen.LowPoints(station, across, height / np.cos(lean), upright))
        gauges.append(line.gauge)
    assert gauges[1] == pytest.approx(gauges[0], abs=0.001)  # across, not in its plane, it would be 10 mm less


def test_rails_on_a_bare_floor_get_no_sleepers_and_the_robot_drives_on_the_floor():
    _, bore = scanned("bare rails")
    seen = seen_in("bare rails")
    laid = lay_track(bore, TrackConfig(), seen)
    keep([seen, laid])
    assert len(laid.lines) == 1
    assert not len(laid.sleeper_station)
    np.testing.assert_array_equal(laid.elevation, laid.bed)
    top = laid.lines[0].seat + laid.lines[0].rail_height - laid.bed
    assert np.median(top) == pytest.approx(0.22 + 0.176, abs=0.015)
    assert track_provenance(laid, seen)["sleepers"] == "none: the floor is seen between the rails"


def test_the_user_may_want_none_or_the_standard_and_rings_show_none():
    _, bore = scanned("proud")
    seen = seen_in("proud")
    (line,) = seen.lines
    sunk = replace(line, rails=replace(line.rails, top=line.sleepers.protrusion + 0.05))
    assert lay_track(bore, TrackConfig(), SeenTrack((sunk,), True)).lines[0].rail_height == 0.08
    for config, shown, why in (
        (TrackConfig(lay="none"), seen, "none: as asked for"),
        (TrackConfig(), SeenTrack(), "none: the survey can show no rails"),
    ):
        none = lay_track(bore, config, shown)
        assert (none.lines, none.why) == ((), why)
    for shown in (seen, SeenTrack()):
        standard = lay_track(bore, TrackConfig(lay="standard"), shown)
        assert standard.lines[0].gauge == 1.435
        assert not standard.measured.any()
        assert len(standard.sleeper_station) == int(bore.length / 0.6) + 1
        assert track_provenance(standard, shown)["sleepers"] == "by standard"


@pytest.mark.parametrize("name", ["road", "double"])
def test_what_is_written_agrees_and_a_scene_without_track_loads(name, tmp_path):
    _, bore = scanned(name, "terrestrial")
    seen = seen_in(name, "terrestrial")
    laid = lay_track(bore, TrackConfig(), seen)
    count, _ = write_geometry(tmp_path, name, "simulated", bore, laid, SceneConfig())
    text = (tmp_path / "scene.xml").read_text()
    plan = load_tunnel(tmp_path / "tunnel.npz")
    np.testing.assert_allclose(plan.elevation, laid.elevation, atol=0.51e-5)  # as the file rounds
    assert (
        text.count('name="sleeper_') - text.count('mesh name="sleeper_')
        >= count["sleepers"]
        == len(laid.sleeper_station)
    )
    assert json.dumps(describe_track(laid, seen))
    if name == "road":
        assert count["rails"] == 0
        floor = bore.position[:, 2] - bore.toward(-np.pi / 2)
        assert np.abs(plan.elevation - floor).max() < 0.03
        assert float(read_track(plan).rails.max()) == 0.0
    else:
        assert count["rails"] == 4
        walked = read_track(plan)
        assert len(walked.station) == len(laid.lines[0].sleeper_station)
        assert np.asarray(walked.protrusion) == pytest.approx(0.22, abs=0.02)


def test_sleepers_of_uneven_pitch_are_not_filled_up():
    uneven = np.cumsum([0.5, 0.5, 0.75] * 15)[:-1]
    _, bore = scanned("proud")
    world = replace(WORLDS["proud"], boxes=[*railway.sleepers(uneven + 0.3, 0.22), *railway.rails(L, 0.23)])
    cloud = thin(world.scan(railway.os1(), railway.carried(L, 1.4, 0.5), 0.012))
    (line,) = find_track(cloud, bore).lines
    keep(line)
    inside = (uneven + 0.3 < L).sum()
    assert abs(len(line.sleepers.station) - inside) <= 2


def test_a_plank_nearly_as_high_as_the_rails_that_lies_between_them_is_no_sleeper():
    _, bore = scanned("proud")
    world = replace(WORLDS["proud"], boxes=[*track(0.22), (0.0, L, -0.15, 0.15, 0.36, 0.38)])
    cloud = thin(world.scan(railway.os1(), railway.carried(L, 1.4, 0.5), 0.012))
    (line,) = find_track(cloud, bore).lines
    assert line.sleepers.protrusion == pytest.approx(0.22, abs=0.015)


def test_sleepers_that_nobody_saw_are_said_to_stand_by_the_spacing():
    _cloud, bore = scanned("proud", "terrestrial")
    seen = seen_in("proud", "terrestrial")
    assert doubt_track(lay_track(bore, TrackConfig(), seen), seen) == []
    unseen = SeenTrack((replace(seen.lines[0], sleepers=None, bed=0.2),), sought=True)
    (warned,) = doubt_track(lay_track(bore, TrackConfig(), unseen), unseen)
    assert "44 sleepers lie where a spacing of 0.60 m asks for them, and none of them was seen" in warned.text
    few = np.arange(len(seen.lines[0].sleepers.measured)) < 9
    some = SeenTrack((replace(seen.lines[0], sleepers=replace(seen.lines[0].sleepers, measured=few)),), sought=True)
    (warned,) = doubt_track(lay_track(bore, TrackConfig(), some), some)
    assert "only 9 of them were seen" in warned.text
    asked = lay_track(bore, TrackConfig(lay="standard"), unseen)
    assert doubt_track(asked, unseen) == doubt_track(lay_track(bore, TrackConfig(), None), SeenTrack()) == []


@pytest.mark.parametrize(("blur", "seed"), [(0.012, 1), (0.027, 4)])
def test_a_gauge_between_faces_that_poses_blur_is_not_measured(blur, seed):
    station, lateral, height, upward = low_points("proud")
    blurred = lateral + np.random.default_rng(seed).normal(0.0, blur, len(lateral))
    (line,) = rails_seen.find_rails(rails_seen.LowPoints(station, blurred, height, upward))
    keep(line)
    assert not line.measured  # though all pieces agree, on too little


@pytest.mark.parametrize("blur", [0.03, 0.04])
def test_rails_that_poses_broaden_are_found_and_have_no_gauge(blur):
    station, lateral, height, upward = low_points("double")
    blurred = lateral + np.random.default_rng(2).normal(0.0, blur, len(lateral))
    tracks = rails_seen.find_rails(rails_seen.LowPoints(station, blurred, height, upward))
    keep(tracks)
    assert [float(np.median(one.offset)) for one in tracks] == pytest.approx([-2.1, 2.1], abs=0.02)
    assert not any(one.measured for one in tracks)


def test_a_cloud_too_thin_to_show_rails_or_blurred_by_its_poses_says_so():
    cloud, bore = scanned("road")
    assert doubt_track(lay_track(bore, TrackConfig(), seen_in("road")), seen_in("road")) == []
    few = replace(cloud, points=cloud.points[::25], weights=cloud.weights[::25])
    thin = find_track(few, bore)
    (warned,) = doubt_track(lay_track(bore, TrackConfig(), thin), thin)
    assert "too few" in warned.text
    (warned,) = doubt_track(lay_track(bore, TrackConfig(), seen_in("road")), seen_in("road"), "poses blur the walls")
    assert "no rails were seen, but poses blur the walls" in warned.text
    shown = seen_in("proud")
    assert doubt_track(lay_track(scanned("proud")[1], TrackConfig(), shown), shown, "poses blur the walls") == []


def test_single_returns_show_a_gauge_that_means_of_voxels_widen(simulated):
    found, gauge = simulated.found, simulated.truth["rails"]["gauge"]
    (line,) = found.seen.lines
    assert line.rails.measured
    assert line.rails.gauge == pytest.approx(gauge, abs=0.0015)
    (thinned,) = find_track(found.cloud, found.bore).lines
    assert thinned.rails.gauge > gauge + 0.0015
    np.testing.assert_array_equal(line.rails.offset, thinned.rails.offset)
    assert line.rails.top == thinned.rails.top


def test_few_or_blurred_returns_leave_the_gauge_as_it_was(simulated):
    found = simulated.found
    rails = found.seen.lines[0].rails
    low = above_floor(found.cloud.points.astype(np.float64), found.bore)
    keep(measure_again(rails, low))
    assert measure_again(rails, low).gauge != rails.gauge
    blurred = low.lateral + np.random.default_rng(1).normal(0.0, 0.012, len(low.lateral))
    assert measure_again(rails, low._replace(lateral=blurred)) is rails
    assert measure_again(rails, low.where(np.arange(len(blurred)) < 5)) is rails
