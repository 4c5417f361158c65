"""Furniture by standard: in its place, clear of the robot's gauge, and the same to MuJoCo's rays as in the plane."""

from dataclasses import replace
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest

from scene.writing.folder import write_geometry
from scene.writing.furnished import FurnitureConfig, TunnelSpace, count_items, furnish_bore, planar_segments
from scene.writing.mesh import as_trimesh, build_solid, has_rings, open_lining, split_skin
from scene.writing.mjcf import SceneConfig, add_lights, concrete_picture
from scene.writing.track import TrackConfig, lay_track
from subterra_jax.host.tunnelfile import read_fields
from tests.scene.conftest import arc_bore
from tests.scene.fits import keep

WITH_DOOR = FurnitureConfig(passage_spacing=20.0, plate_spacing=6.0)


@pytest.fixture(scope="module")
def level():
    """A bore without grade, so that rays and plane agree beyond a few metres."""
    return arc_bore(length=24.0, radius=150.0, grade=0.0)


@pytest.fixture(scope="module")
def laid(level):
    return lay_track(level, TrackConfig())


@pytest.fixture(scope="module")
def written(level, laid, tmp_path_factory):
    folder = tmp_path_factory.mktemp("furnished")
    config = SceneConfig(furniture=WITH_DOOR)
    return folder, *write_geometry(folder, "x", "simulated", level, laid, config)


@pytest.fixture(scope="module")
def tunnel(written):
    return read_fields(written[0] / "tunnel.npz")


def segments(tunnel, variant: str) -> np.ndarray:
    walls = [tunnel[f"{side}_{variant}"] for side in ("left", "right")]
    return np.concatenate([*(np.hstack([wall[:-1], wall[1:]]) for wall in walls), tunnel[f"furniture_{variant}"]])


def cast(lines: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> float:
    a, edge = lines[:, :2] - origin, lines[:, 2:] - lines[:, :2]
    across = direction[0] * edge[:, 1] - direction[1] * edge[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (a[:, 0] * edge[:, 1] - a[:, 1] * edge[:, 0]) / across
        fraction = (a[:, 0] * direction[1] - a[:, 1] * direction[0]) / across
    hit = (distance > 0) & (fraction >= 0) & (fraction <= 1)
    return float(np.min(distance[hit], initial=30.0))


def test_brackets_stand_every_metre_with_an_arm_a_tier_and_one_door_at_half_the_spacing(written):
    _, count, _ = written
    assert count["furniture_bracket"] == 24
    assert count["furniture_bracket_arm"] == 4 * 24
    assert count["furniture_handrail_post"] == pytest.approx(12 - 2, abs=1)
    assert count["furniture_hectometre_plate"] == 3
    assert count["furniture_niche"] == 1


@pytest.mark.parametrize(
    ("kind", "size"),
    [
        ("lamp", (1.2, 0.18, 0.10)), ("hectometre_plate", (0.5, 0.03, 0.30)), ("third_rail", (3.0, 0.08, 0.10)),
        ("third_rail_cover", (3.0, 0.16, 0.02)), ("insulator", (0.10, 0.10, 0.22)), ("bracket", (0.05, 0.05, 1.3)),
    ],
)  # fmt: skip
def test_pieces_have_their_sizes_and_lamps_hang_4_cm_under_the_crown(level, laid, kind, size):
    items = [item for item in furnish_bore(level, laid, WITH_DOOR).items if item.kind == kind]
    for item in items:
        np.testing.assert_allclose(2 * item.half, size, atol=0.02)
        if kind == "lamp":
            under = level.toward(np.pi / 2)[0] - level.axis.local(item.corners())[2].max()
            assert under == pytest.approx(0.04, abs=2e-3)
    assert items


def test_every_kind_can_be_left_out(level, laid):
    whole = furnish_bore(level, laid, WITH_DOOR)
    keep([planar_segments(whole.items, level, laid.elevation, 0.7), whole.bore, *whole.niche_corners])
    keep([[item.corners() for item in whole.items], count_items(whole.items)], " items")
    kinds = {"walkway", "handrail", "cables", "third_rail", "plates", "passage", "lamps"}
    none = FurnitureConfig(**dict.fromkeys(kinds, False))
    nothing = furnish_bore(level, laid, none)
    assert not nothing.items
    assert not nothing.niches
    assert not len(planar_segments(nothing.items, level, laid.elevation, 0.7))
    only_cables = furnish_bore(level, laid, replace(none, cables=True))
    assert set(count_items(only_cables.items)) == {"bracket", "bracket_arm", "cable"}


def test_nothing_enters_the_robots_gauge(level, laid):
    for item in furnish_bore(level, laid, WITH_DOOR).items:
        station, lateral, _ = level.axis.local(item.corners())
        low = item.corners()[:, 2] - np.interp(station, level.station, laid.elevation)
        if low.min() < 2.0:
            assert np.abs(lateral).min() > 0.9, item.kind
            assert (np.sign(lateral) == np.sign(lateral[0])).all(), item.kind


def test_no_piece_is_without_size_where_the_wall_is_dented_at_an_arm(level, laid, monkeypatch):
    whole = TunnelSpace.wall

    def dented(space, start, end, height, side):
        near, far = whole(space, start, end, height, side)
        return (near - 0.4, far - 0.4) if side < 0 and abs(height - WITH_DOOR.tiers[1]) < 0.02 else (near, far)

    monkeypatch.setattr(TunnelSpace, "wall", dented)
    items = furnish_bore(level, laid, WITH_DOOR).items
    assert count_items(items)["bracket_arm"] == 4 * 24
    assert min(item.half.min() for item in items) > 0.0


def test_walkway_and_third_rail_are_left_out_where_the_bore_is_too_narrow():
    narrow = arc_bore(half_width=1.7, radius=300.0)
    laid = lay_track(narrow, TrackConfig(shoulder=0.2))
    kinds = count_items(furnish_bore(narrow, laid, FurnitureConfig()).items)
    assert "walkway" not in kinds
    assert "handrail_post" not in kinds
    assert "bracket" in kinds


def test_the_niche_is_half_a_metre_deep_two_metres_long_and_on_the_left_alone(level, tunnel):
    def across(side: str) -> np.ndarray:
        wall = tunnel[f"{side}_furnished"]
        return np.abs(level.axis.local(np.column_stack([wall, np.full(len(wall), 3.2)]))[1])

    assert across("left").max() == pytest.approx(2.8 + 0.5, abs=0.02)
    assert across("right").max() == pytest.approx(2.8 + 0.13, abs=0.02)
    deep = tunnel["left_station_furnished"][across("left") > 3.2]
    assert np.ptp(deep) == pytest.approx(2.0, abs=0.26)
    assert deep.mean() == pytest.approx(10.0, abs=0.3)


@pytest.mark.parametrize(("variant", "scene"), [("pockets", "scene.xml"), ("furnished", "scene_furnished.xml")])
def test_mujocos_rays_see_what_the_plane_holds(level, laid, tunnel, written, variant, scene):
    model = mujoco.MjModel.from_xml_path(str(written[0] / scene))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rng, lines, error = np.random.default_rng(0), segments(tunnel, variant), []
    visible, hit = np.array([1, 1, 0, 0, 0, 0], np.uint8), np.zeros(1, np.int32)
    for row in rng.integers(8, len(level.station) - 8, 400):
        turn = rng.uniform(-np.pi, np.pi)
        origin = level.position[row] + rng.uniform(-1.5, 1.5) * level.lateral[row]
        origin[2] = laid.elevation[row] + 0.7
        direction = np.array([np.cos(turn), np.sin(turn), 0.0])
        distance = mujoco.mj_ray(model, data, origin, direction, visible, 1, -1, hit)
        error.append(abs(min(distance if distance >= 0 else 30.0, 30.0) - cast(lines, origin[:2], direction[:2])))
    assert np.mean(np.array(error) < 0.005) > 0.98


def test_the_niche_is_open_to_bodies_and_closed_at_its_back(level, laid, written):
    from tests.scene.test_validity import Probe

    probe = Probe(written[0] / "scene_furnished.xml")
    at = level.axis.at(np.array([10.0]))
    inside = np.array([*(at.position[0] + 2.85 * at.lateral[0])[:2], laid.elevation[40] + 1.3])
    assert not probe.touches(inside)
    assert probe.touches(inside + 0.25 * at.lateral[0])
    assert Probe(written[0] / "scene.xml").touches(inside)


@pytest.fixture(scope="module")
def dressed(bore, arc_scene):
    lining = open_lining(as_trimesh(build_solid(bore, pockets=True)), bore)
    return arc_scene[1], lining, mujoco.MjModel.from_xml_path(str(arc_scene[0] / "scene.xml"))


def test_joints_are_dark_lines_where_there_are_rings_and_only_there():
    with_rings, without = (concrete_picture(rings, 128, 512).astype(float).mean(axis=(1, 2)) for rings in (True, False))
    assert np.argsort(with_rings)[:2].tolist() in ([0, 64], [64, 0], [0, 127], [0, 1])
    assert with_rings.min() < with_rings.mean() - 20
    assert without.min() > without.mean() - 15


def test_skins_hold_every_face_once_and_the_floor_is_the_floor(bore, dressed):
    laid, lining, _ = dressed
    parts = split_skin(lining, bore, laid.bed)
    assert set(parts) == {"lining", "recess", "floor"}
    assert sum(len(part.faces) for part, _ in parts.values()) == len(lining.faces)
    floor = parts["floor"][0]
    assert floor.area == pytest.approx(2 * 2.8 * bore.length, rel=0.03)
    assert parts["recess"][0].area == pytest.approx(len(bore.pocket) * (0.2 * 0.16 + 2 * 0.36 * 0.13), rel=0.05)


def test_texture_coordinates_run_once_around_without_a_jump_inside_a_face(bore, dressed):
    laid, lining, _ = dressed
    texture_at, corner = split_skin(lining, bore, laid.bed)["lining"][1]
    assert np.ptp(texture_at[corner], axis=1).max() < 0.3
    assert np.ptp(texture_at[corner][..., 0]) == pytest.approx(1.0, abs=0.05)
    texture_at, corner = split_skin(lining, replace(bore, ring_station=np.empty(0)), laid.bed)["lining"][1]
    assert np.ptp(texture_at[corner][..., 1]) == pytest.approx(bore.length / 3.0, rel=0.02)  # two bays of 1.5 m


def test_the_first_seven_lamps_are_on(bore):
    world = ElementTree.Element("worldbody")
    assert add_lights(world, bore, spacing=2.0) == 12
    assert [light.get("active") for light in world] == ["true"] * 7 + ["false"] * 5


def test_stations_of_surveyed_rings_are_no_joints(bore):
    assert has_rings(replace(bore, ring_station=np.arange(1.0, 20.0, 1.5)))
    assert not has_rings(replace(bore, ring_station=np.arange(1.0, 24.0, 5.0)))
    assert not has_rings(replace(bore, ring_station=np.empty(0)))


def test_cameras_stand_in_both_portals_and_the_middle_and_the_rover_two_metres_in(bore, dressed):
    laid, _, model = dressed
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    seen = [data.cam(name) for name in ("portal_start", "middle", "wall", "portal_end")]
    place = np.array([*(camera.xpos for camera in seen), data.body("scout").xpos])
    station, aside, _ = bore.axis.local(place)
    above = place[:, 2] - np.interp(station, bore.station, laid.elevation)
    half = bore.length / 2
    np.testing.assert_allclose(station, [1.0, half, half, bore.length - 1.0, 2.0], atol=0.05)
    np.testing.assert_allclose(aside, [0.0, 0.9, 1.0, 0.0, 0.0], atol=0.01)
    np.testing.assert_allclose(above[:4], [1.9, 1.7, 1.6, 1.9], atol=0.01)
    at = bore.axis.at(station[:4])
    look = [-camera.xmat.reshape(3, 3)[:, 2] for camera in seen]
    np.testing.assert_allclose(np.einsum("ij,ij->i", look, at.tangent), [1.0, 1.0, 0.507, -1.0], atol=0.01)
    assert look[2] @ at.lateral[2] == pytest.approx(-0.862, abs=0.01)
