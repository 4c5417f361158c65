"""Solid, lining and walls as manifold3d, trimesh and MuJoCo judge them over bores hard to mesh; the track in them."""

from dataclasses import replace
from xml.etree import ElementTree as ET

import mujoco
import numpy as np
import pytest
import trimesh
from manifold3d import Error, Manifold, Mesh64
from scipy.ndimage import gaussian_filter

from scene.bore import NAIL, POCKET, Bore
from scene.errors import FitError, Refusal
from scene.fitting.rails import SeenRails
from scene.fitting.trackseen import SeenLine, SeenSleepers, SeenTrack
from scene.judging.sanity import doubt_track
from scene.writing import mjcf
from scene.writing.mesh import as_trimesh, build_solid, open_lining, split_lining
from scene.writing.planar import cut_walls
from scene.writing.track import TrackConfig, lay_track
from scene.writing.trackgeoms import fastening_mesh, nail_mesh
from tests.scene.conftest import arc_bore
from tests.scene.fits import keep


def irregular(bore: Bore) -> Bore:
    """Walls that vary by 13 cm at a correlation length of about a metre."""
    noise = gaussian_filter(np.random.default_rng(0).standard_normal(bore.radius.shape), (4, 14), mode="wrap")
    return replace(bore, radius=bore.radius + 0.13 * noise / noise.std())


def crowded(bore: Bore) -> Bore:
    """Pockets that overlap one another, pockets across a mouth, and one at the seam's side, the floor."""
    rows = [(8.0, 0.3), (8.1, 0.32), (0.05, 0.5), (bore.length, 2.5), (12.0, -np.pi / 2), (12.15, -np.pi / 2)]
    more = np.array([(s, a, 0.2, 0.16, 0.13, 1.0, True) for s, a in rows], POCKET)
    return replace(bore, pocket=np.concatenate([bore.pocket, more]))


BORES = {
    "a bend of 60 m": lambda: arc_bore(radius=60.0),
    "nearly straight": lambda: arc_bore(radius=2000.0),
    "irregular walls": lambda: irregular(arc_bore(radius=150.0)),
    "crowded pockets": lambda: crowded(arc_bore(radius=150.0)),
    "no pockets": lambda: replace(arc_bore(), pocket=np.empty(0, POCKET)),
}


@pytest.fixture(scope="module", params=BORES)
def case(request):
    bore = BORES[request.param]()
    solid = as_trimesh(build_solid(bore, pockets=True))
    return bore, solid, open_lining(solid, bore)


def test_both_libraries_accept_the_solid_as_one_ball(case):
    _, solid, _ = case
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.is_volume
    assert (solid.euler_number, solid.body_count) == (2, 1)
    vertices, faces = np.array(solid.vertices), np.array(solid.faces, np.uint64)
    again = Manifold(Mesh64(vertices, faces))
    assert again.status() == Error.NoError
    assert again.genus() == 0
    assert again.volume() == pytest.approx(solid.volume)


def test_the_lining_has_two_boundary_loops_one_at_either_mouth(case):
    bore, _, lining = case
    edges, count = np.unique(lining.edges_sorted, axis=0, return_counts=True)
    assert count.max() <= 2
    loops = trimesh.graph.connected_components(edges[count == 1], min_len=3)
    assert len(loops) == 2
    for loop, end in zip(
        sorted(loops, key=lambda part: bore.axis.local(lining.vertices[part])[0].mean()), (0, -1), strict=True
    ):
        assert np.abs((lining.vertices[loop] - bore.position[end]) @ bore.tangent[end]).max() < 1e-3


def test_triangles_are_well_shaped_and_small_enough_to_show_the_pockets(case):
    _, _, lining = case
    edge = np.linalg.norm(lining.triangles - np.roll(lining.triangles, 1, axis=1), axis=2)
    height = 2 * lining.area_faces / edge.max(axis=1)
    angle = np.degrees(trimesh.triangles.angles(lining.triangles)).min(axis=1)
    assert np.percentile(angle, 5) > 30
    assert np.percentile(edge.max(axis=1) / height, 95) < 4
    assert np.percentile(edge, 95) < 0.25
    assert np.mean(angle < 1) < 1e-3


def test_the_lining_faces_the_axis(case):
    bore, _, lining = case
    station, lateral, up = bore.axis.local(lining.triangles_center)
    at = bore.axis.at(station)
    outward = lateral[:, None] * at.lateral + up[:, None] * at.up
    seen = np.einsum("ij,ij->i", lining.face_normals, outward) < 1e-3
    assert lining.area_faces[seen].sum() / lining.area > 0.98


def test_sections_that_fold_into_each_other_are_an_error_with_their_place():
    bore = arc_bore(length=24.0, radius=60.0)
    with pytest.raises(FitError, match=r"at \d+\.\d m") as raised:
        build_solid(replace(bore, radius=bore.radius * 25), pockets=False)
    assert raised.value.code is Refusal.FOLDED


def test_chunks_hold_every_face_once(case):
    bore, _, lining = case
    parts = split_lining(lining, bore, 5.0)
    assert len(parts) > 3
    assert sum(len(part.faces) for part in parts) == len(lining.faces)
    assert sum(part.area for part in parts) == pytest.approx(lining.area)


RADIUS = 0.3


class Probe:
    """A ball that touches everything solid, with MuJoCo's default bits."""

    def __init__(self, path):
        spec = mujoco.MjSpec.from_file(str(path))
        body = spec.worldbody.add_body(name="probe")
        body.add_freejoint()
        body.add_geom(name="probe", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0])
        self.model = spec.compile()
        self.data, self.geom = mujoco.MjData(self.model), self.model.geom("probe").id

    def touches(self, position: np.ndarray) -> bool:
        self.data.qpos[-7:-4] = position
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)
        return any(self.geom in (c.geom1, c.geom2) and c.dist < 0 for c in self.data.contact[: self.data.ncon])

    def first_contact(self, start: np.ndarray, direction: np.ndarray) -> np.ndarray:
        free, met = 0.0, next(step for step in np.arange(1.5, 4.0, 0.25) if self.touches(start + step * direction))
        for _ in range(12):
            middle = (free + met) / 2
            free, met = (free, middle) if self.touches(start + middle * direction) else (middle, met)
        return start + met * direction


@pytest.fixture(
    scope="module", params=[arc_bore(radius=150.0), irregular(arc_bore(radius=300.0))], ids=["R 150 m", "irregular"]
)
def built(request, tmp_path_factory):
    bore = request.param
    folder = tmp_path_factory.mktemp("walls")
    laid = lay_track(replace(bore, radius=arc_bore().radius[:1].repeat(len(bore.station), axis=0)), TrackConfig())
    solid = build_solid(bore, pockets=True)
    walls = cut_walls(build_solid(bore, pockets=False), bore, laid.elevation, 0.7)
    lining = open_lining(as_trimesh(solid), bore)
    mjcf.write_scene(folder, "x", bore, lining, walls, laid, mjcf.SceneConfig())
    return bore, lining, Probe(folder / "scene.xml")


def test_a_ball_on_the_axis_is_free_at_every_station(built):
    bore, _, probe = built
    assert not any(probe.touches(position) for position in bore.position)


def test_a_ball_moved_to_the_wall_stops_within_3_cm_of_the_mesh(built):
    bore, lining, probe = built
    rng, stopped = np.random.default_rng(0), []
    for k, row in enumerate(rng.integers(4, len(bore.station) - 4, 90)):
        turn = (0.0, np.pi, rng.uniform(0, np.pi))[k % 3]
        direction = np.cos(turn) * bore.lateral[row] + np.sin(turn) * bore.up[row]
        stopped.append(probe.first_contact(bore.position[row], direction))
    error = np.abs(trimesh.proximity.closest_point(lining, np.array(stopped))[1] - RADIUS)
    assert np.median(error) < 0.01
    assert error.max() < 0.03


def test_the_gauge_is_between_the_inner_faces_of_the_heads(bore, arc_scene):
    """Seen by rays in the compiled scene, 16 mm below the rail top; rail centres 1.435 m apart would give 1.362 m."""
    folder, laid, _ = arc_scene
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    at = bore.axis.at(np.array([10.2]))
    top = np.interp(10.2, bore.station, laid.elevation) + 0.010 + 0.176
    origin = np.array([*at.position[0, :2], top - 0.016])
    track_only, hit = np.array([0, 1, 0, 0, 0, 0], np.uint8), np.zeros(1, np.int32)
    distances = [mujoco.mj_ray(model, data, origin, side * at.lateral[0], track_only, 1, -1, hit) for side in (1, -1)]
    assert sum(distances) == pytest.approx(1.435, abs=0.002)


def test_the_bed_is_the_flat_floor_and_sleepers_stand_out_of_it(bore):
    laid = lay_track(bore, TrackConfig())
    floor = bore.position[:, 2] - 3.2 * bore.up[:, 2]
    np.testing.assert_allclose(laid.bed, floor, atol=0.02)
    np.testing.assert_allclose(laid.elevation - laid.bed, 0.06)
    assert not laid.raised
    assert laid.clearance.min() == pytest.approx(2.8 - 1.25, abs=0.02)


def test_in_a_round_bore_the_track_lies_on_a_slab_just_wide_enough(bore):
    n = len(bore.station)
    round_bore = replace(bore, radius=np.full((n, 360), 2.9), width=np.full(n, 5.8), height=np.full(n, 5.8))
    laid = lay_track(round_bore, TrackConfig())
    assert laid.raised
    np.testing.assert_allclose(bore.position[:, 2] - laid.bed, np.sqrt(2.9**2 - 1.6**2), atol=0.03)


def test_a_bore_too_low_for_a_track_gets_none(bore):
    n = len(bore.station)
    pipe = replace(bore, radius=np.full((n, 360), 1.2), width=np.full(n, 2.4), height=np.full(n, 2.4))
    assert not len(lay_track(pipe, TrackConfig()).sleeper_station)


def narrowed(bore: Bore, side: int, half_width: float, stations: slice = slice(None)) -> Bore:
    """The bore with one wall (1 the left one) nearer to the axis, at some stations."""
    radius = bore.radius.copy()
    with np.errstate(divide="ignore"):
        wall = half_width / np.maximum(side * np.cos(bore.angle), 0.0)
    radius[stations] = np.minimum(radius[stations], wall)
    return replace(bore, radius=radius)


@pytest.mark.parametrize("side", [1, -1])
def test_the_clearance_of_a_sleeper_is_that_to_the_nearer_wall(bore, side):
    laid = lay_track(narrowed(bore, side, 1.5), TrackConfig(shoulder=0.0))
    np.testing.assert_allclose(laid.clearance, 1.5 - 1.25, atol=0.02)
    with pytest.raises(FitError, match=r"0\.05 m") as raised:
        lay_track(narrowed(bore, side, 1.3), TrackConfig(shoulder=0.0))
    assert raised.value.code is Refusal.TRACK


def seen_rails(bore: Bore, aside: float = 0.0) -> SeenTrack:
    """Rails that a survey shows, so far to the left of the axis, on sleepers that stand out by 6 cm."""
    there, ones = bore.station[[0, -1]], np.ones(2)
    rails = SeenRails(there, aside * ones, 0.0 * ones, 1.508, 1.435, 0.001, 9, 0.246)
    sleepers = SeenSleepers(np.arange(0.3, bore.length, 0.6), np.ones(40, bool), 0.06)
    return SeenTrack((SeenLine(sleepers, rails),), sought=True)


@pytest.mark.parametrize("side", [1, -1])
def test_sleepers_between_seen_rails_that_would_meet_a_wall_are_left_out_and_told_of(bore, side):
    squeezed = slice(40, 61)  # 10 to 15 m
    seen = seen_rails(bore)
    laid = lay_track(narrowed(bore, side, 1.3, squeezed), TrackConfig(), seen)
    (line,) = laid.lines
    inside = (seen.lines[0].sleepers.station > 9.8) & (seen.lines[0].sleepers.station < 15.1)
    np.testing.assert_allclose(line.sleeper_station, seen.lines[0].sleepers.station[~inside])
    assert line.left_out == inside.sum() > 5
    assert line.clearance.min() >= TrackConfig().margin
    (warning,) = doubt_track(laid, seen)
    keep([laid, warning])
    assert warning.text.startswith(f"{line.left_out} sleepers are left out")
    whole = lay_track(bore, TrackConfig(), seen)
    assert whole.lines[0].left_out == 0
    assert not doubt_track(whole, seen)


@pytest.mark.parametrize("aside", [1.3, -1.3])
def test_a_track_beside_the_axis_is_as_near_to_a_wall_as_its_nearer_end(bore, aside):
    laid = lay_track(bore, TrackConfig(), seen_rails(bore, aside))
    np.testing.assert_allclose(laid.clearance, 2.8 - 1.3 - 1.25, atol=0.02)


def test_each_sleeper_has_two_pads_and_four_clips_on_the_rails_feet():
    config = TrackConfig()
    parts = fastening_mesh(config).split(only_watertight=True)
    pads = [part for part in parts if np.ptp(part.bounds[:, 2]) == pytest.approx(config.pad_thickness)]
    clips = [part for part in parts if len(part.vertices) > 8]
    assert (len(pads), len(clips), len(parts)) == (2, 4, 10)
    for clip in clips:
        inner = np.abs(np.abs(clip.vertices[:, 1]) - config.rail_offset)
        foot = config.pad_thickness + config.rail.foot_height
        assert inner.min() < config.rail.foot_width / 2
        assert clip.vertices[inner < config.rail.foot_width / 2, 2].min() == pytest.approx(foot, abs=0.005)


def test_rails_stand_on_pads_of_a_centimetre(bore, arc_scene):
    folder, laid, _ = arc_scene
    world = ET.parse(folder / "scene.xml").getroot().find("worldbody")
    at = {geom.get("name"): geom for geom in world.iter("geom")}
    foot = at["rail_left_000_foot"]  # to 3 m
    middle, half = (np.array(foot.get(key).split(), float)[2] for key in ("pos", "size"))
    assert middle - half - np.interp(1.5, bore.station, laid.elevation) == pytest.approx(0.010, abs=1e-3)


def test_nails_bridge_the_joint_behind_the_wall(bore, tmp_path):
    assert nail_mesh(bore, 0.0, bore.length) is None
    rows = [(4.5, 0.4, 0.30, 0.028, 0.06, 1.0, False), (7.5, 2.0, 0.30, 0.028, 0.06, 1.0, True)]
    nailed = replace(bore, nail=np.array(rows, NAIL))
    mesh_of_nails = nail_mesh(nailed, 0.0, bore.length)
    assert mesh_of_nails.is_volume
    station, lateral, up = nailed.axis.local(mesh_of_nails.vertices)
    first = np.abs(station - 4.5) < 1
    assert np.ptp(station[first]) == pytest.approx(0.30, abs=0.02)  # on its arc
    depth = np.hypot(lateral, up)[first].mean() - np.interp(0.4, bore.angle, bore.radius[0])
    assert depth == pytest.approx(0.06, abs=0.01)
    assert nail_mesh(nailed, 5.0, 7.0) is None
