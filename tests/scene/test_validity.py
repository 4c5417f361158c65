"""The solid and the lining as manifold3d, trimesh and a ball in MuJoCo judge them, over bores that are hard to mesh."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import trimesh
from manifold3d import Error, Manifold, Mesh64
from scipy.ndimage import gaussian_filter

from scene.bore import POCKET, Bore
from scene.errors import FitError, Refusal
from scene.writing import mjcf
from scene.writing.mesh import as_trimesh, build_solid, open_lining, split_lining
from scene.writing.planar import cut_walls
from scene.writing.track import TrackConfig, lay_track
from tests.scene.conftest import arc_bore


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


def boundary(surface: trimesh.Trimesh) -> np.ndarray:
    edges, count = np.unique(surface.edges_sorted, axis=0, return_counts=True)
    assert count.max() <= 2
    return edges[count == 1]


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
    loops = trimesh.graph.connected_components(boundary(lining), min_len=3)
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
