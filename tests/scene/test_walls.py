"""A ball in the compiled scene: free on the axis, stopped where the wall is."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import trimesh

from scene.writing import mjcf
from scene.writing.mesh import as_trimesh, build_solid, open_lining
from scene.writing.planar import cut_walls
from scene.writing.track import TrackConfig, lay_track
from tests.scene.conftest import arc_bore
from tests.scene.test_validity import irregular

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
