"""Pictures without a scene: surfaces lie where the tunnel is, face the camera, and the robot stands in them whole."""

from pathlib import Path
from types import SimpleNamespace

import jax
import mujoco
import numpy as np
import pytest
from scipy.spatial import KDTree

import subterra_jax as st
from subterra_jax.host.texture import brightness, wall_angle
from subterra_jax.physics.engine import Engine
from subterra_jax.physics.ground import read_track
from subterra_jax.physics.rolling import ROVER
from subterra_jax.physics.view import RobotView
from subterra_jax.pictures import camera
from subterra_jax.pictures import top_down as drawing
from subterra_jax.pictures.camera import TunnelChoice
from subterra_jax.pictures.renderer import light_near
from subterra_jax.pictures.stage import Stretch, add_carrier, carrier_parts, stage_spec
from subterra_jax.pictures.surfaces import short_shell, tunnel_surfaces
from subterra_jax.pictures.views import make_view
from tests.recorded import check
from tests.subterra_jax.placing import draw, placed

TABLE = Path(__file__).with_name("values.csv")


@pytest.fixture(scope="module")
def plan():
    return st.load_tunnel("metro", solid=True)


def test_surfaces_of_a_bore_lie_on_it_and_face_the_air(plan):
    surfaces = {surface.name: surface for surface in tunnel_surfaces(plan, "pockets", 200.0, 212.0)}
    assert set(surfaces) == {"wall", "recess", "floor", "rail", "sleeper"}
    wall, shell = surfaces["wall"].triangles, plan.shell
    corner = wall.vertices[wall.faces]
    normal, middle = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), corner.mean(axis=1)
    node = KDTree(shell.position).query(middle)[1]
    inward = np.sum(normal * (shell.position[node] - middle), axis=1)
    assert (inward > 0.0).mean() > 0.999
    away = np.linalg.norm(wall.vertices - shell.position[node[0]], axis=1)
    assert 2.0 < away.min() < 3.0
    deepest = np.sqrt(np.sum(np.cross(middle - shell.position[node], shell.tangent[node]) ** 2, axis=1)).max()
    assert deepest < shell.radius.max() + 0.05


def test_a_short_shell_keeps_its_recesses_in_place(plan):
    whole = plan.shell
    short = short_shell(whole, 300.0, 330.0)
    there = whole.linings["pockets"].pocket
    kept = short.linings["pockets"].pocket[:, 0] + whole.station[np.searchsorted(whole.station, 294.0)]
    inside = there[(there[:, 0] > 301.0) & (there[:, 0] < 329.0), 0]
    assert len(inside) > 50
    assert all(np.abs(kept - station).min() < 1e-9 for station in inside)


def test_the_next_stretch_is_made_before_the_robot_sees_the_end(plan):
    stretch = Stretch.around(plan, None, 500.0)
    assert (stretch.start, stretch.end) == (470.0, 570.0)
    assert stretch.shows(500.0)
    assert stretch.shows(529.0)
    assert not stretch.shows(531.0)
    assert not stretch.shows(500.0, -1.0)
    assert Stretch.around(plan, None, 500.0, -1.0).shows(500.0, -1.0)
    assert Stretch.around(plan, None, 3.0).shows(0.0)
    assert Stretch.around(plan, None, plan.length - 3.0).shows(plan.length)


@pytest.mark.parametrize(
    ("name", "lining", "begin", "end"),
    [
        ("metro", "furnished", 100.0, 108.0),
        ("subterra-351", "pockets", 100.0, 105.0),
        ("open:val:0", None, 0.0, 20.0),
        ("open:cast:val:1", "smooth", 10.0, 19.0),
    ],
)
def test_a_stage_holds_what_it_held(name, lining, begin, end):
    plan = st.load_tunnel(name, solid=name != "open:val:0")
    model = stage_spec(Stretch(plan, lining, begin, end, 1.0)).compile()
    assert not np.any([model.geom_contype, model.geom_conaffinity])  # it is for looks alone
    kept = ("geom_pos", "geom_quat", "geom_size", "mesh_vertnum", "mat_rgba", "light_pos", "tex_data")
    check(TABLE, f"stage {name}", {kind: getattr(model, kind) for kind in kept})
    seen = {one.name: (one.triangles.vertices, one.rolled) for one in tunnel_surfaces(plan, lining, begin, end)}
    check(TABLE, f"surfaces {name}", seen)


def test_the_seven_nearest_lamps_burn_and_the_carrier_is_what_it_was(plan):
    model = stage_spec(Stretch(plan, "smooth", 100.0, 190.0)).compile()
    data, scene = mujoco.MjData(model), mujoco.MjvScene(model, 50)
    mujoco.mj_forward(model, data)
    light_near(model, data, data.light_xpos[2])
    assert np.flatnonzero(model.light_active).tolist() == [0, 1, 2, 3, 4, 5, 6]
    add_carrier(scene, np.array([1.0, 2.0, 3.0]), 0.3, 0.1, 0.4, 0.7)
    geoms = scene.geoms[: scene.ngeom]
    check(TABLE, "carrier", {k: np.stack([getattr(geom, k) for geom in geoms]) for k in ("pos", "mat", "size", "rgba")})


class Unseen:
    """A renderer without OpenGL: its picture is what MuJoCo would draw, and from where."""

    def __init__(self, model, *_size):
        self.model, self.scene = model, mujoco.MjvScene(model, 4000)

    def update_scene(self, data, seen):
        every, option = mujoco.mjtCatBit.mjCAT_ALL, mujoco.MjvOption()
        mujoco.mjv_updateScene(self.model, data, option, None, seen, every, self.scene)
        self.seen = [np.copy(seen.lookat), seen.distance, seen.azimuth, seen.elevation, self.model.light_active]

    def render(self):
        drawn = self.scene.geoms[: self.scene.ngeom][-30:]
        rows = [np.hstack([geom.pos - self.seen[0], geom.size, geom.rgba, geom.mat.ravel()]) for geom in drawn]
        return SimpleNamespace(copy=lambda: {"camera": self.seen, "parts": list(np.transpose(rows))})


def test_a_camera_behind_a_robot_sees_what_it_saw(plan, monkeypatch):
    monkeypatch.setattr(camera, "open_renderer", Unseen)
    choice, place = TunnelChoice(plan, "pockets", (100.0, 300.0), texture=0.5), plan.stretch((100.0, 300.0)).centre[400]
    view, params = make_view("mujoco", choice), SimpleNamespace(vehicle=SimpleNamespace(radius=0.4))
    state = SimpleNamespace(position=place + 0.3, heading=2.8, tunnel=0)
    check(TABLE, "camera behind a carrier", view.picture(None, params, state, None))
    robot = RobotView(Engine(ROVER), read_track(plan), choice)
    pose = np.array([*place, 1.5, 0.9, 0.1, -0.1, 0.4, 0.1, 0.2, 0.3, 0.4][: 7 + 4])
    check(TABLE, "camera behind a rover", robot.draw(pose))


def test_walls_goal_beams_and_robot_are_seen_from_above_where_they_are():
    straight = st.tunnel.from_centreline([[0.0, 0.0], [100.0, 0.0]], 2.5)
    env, params = st.make("Subterra/StopAtShort-v1", straight, lidar=st.lidar.LidarParams(range_sigma=0.0))
    state = placed(env, params, 40.0)
    state = state.replace(goal=state.goal.replace(station=np.float32(43.1)))
    obs = env.observe(state, env.draw_step(jax.random.key(0), (), params), params)
    picture = make_view("top").picture(env, params, state, np.asarray(obs))
    walls = drawing.wall_points(params.tunnel, int(params.tunnel.scan_first[160]), step=0.04)
    for side in (2.5, -2.5):
        along = np.sort(walls[np.abs(walls[:, 1] - side) < 1e-4, 0])
        assert np.diff(along).max() < 0.0401 < 60.0 < np.ptp(along)
    expected = {
        drawing.WALL: (-12.0, 12.0, -2.5, 2.5), drawing.GOAL: (3.1, 3.1, -2.5, 2.5),
        drawing.ROBOT: (-0.4, 0.8, -0.4, 0.4), drawing.BEAM: (-12.0, 12.0, -2.5, 2.5),
    }  # fmt: skip
    for colour, sides in expected.items():
        rows, columns = np.nonzero((picture == colour).all(axis=2))
        x, y = (columns + 0.5 - 240.0) / 20.0, (240.0 - rows - 0.5) / 20.0
        assert [x.min(), x.max(), y.min(), y.max()] == pytest.approx(sides, abs=0.13)


def test_the_walls_show_the_brightness_that_a_lidar_reads(plan):
    begin, end = 200.0, 206.0
    model = stage_spec(Stretch(plan, "smooth", begin, end, 1.0)).compile()
    own = model.tex("wall").id
    wide, high, first = (int(part[own]) for part in (model.tex_width, model.tex_height, model.tex_adr))
    pixels = model.tex_data[first : first + 3 * wide * high].reshape(high, wide, 3)[..., 0]
    (wall,) = (one for one in tunnel_surfaces(plan, "smooth", begin, end) if one.name == "wall")
    mesh = int(model.geom_dataid[model.geom("tunnel wall").id])
    place = model.mesh_texcoord[model.mesh_texcoordadr[mesh] :][: model.mesh_texcoordnum[mesh]] % 1.0
    assert len(place) == len(wall.rolled)
    seen = pixels[(place[:, 1] * high).astype(int), (place[:, 0] * wide).astype(int)]
    node = KDTree(plan.centre).query(wall.triangles.vertices[:, :2])[1]
    away, tangent = wall.triangles.vertices[:, :2] - plan.centre[node], plan.tangent[node]
    station = plan.station[node] + np.sum(away * tangent, axis=1)
    left = tangent[:, 0] * away[:, 1] - tangent[:, 1] * away[:, 0]
    angle = wall_angle(np, left, wall.triangles.vertices[:, 2] - plan.elevation[node])
    expected = brightness(np, station, angle, plan.texture, 1.0)
    assert np.corrcoef(seen, expected)[0, 1] > 0.7


def test_each_tunnel_of_a_list_is_drawn_by_its_number(plan):
    choice = TunnelChoice([plan, "control"], stretch=(10.0, 60.0))
    assert choice.plan(0).name == "metro"
    assert choice.plan(1).length == pytest.approx(60.0)
    assert TunnelChoice("open:val:0-2").plan(1).name == st.load_tunnel("open:val:1").name
    ready = st.make("Subterra/TraverseShort-v1")[1].tunnel
    with pytest.raises(ValueError, match="holds no heights"):
        TunnelChoice(ready).plan(0)


def test_the_carrier_stands_on_the_ground_within_its_footprint():
    for part in carrier_parts(0.4, 0.7):
        reach = part.half if part.kind == "box" else (part.half[0], part.half[0], part.half[0])
        assert part.middle[2] - reach[2] > -1e-9
        assert np.hypot(*part.middle[:2]) < 0.4


DRAW = """
import sys
import gymnasium
import numpy as np
env = gymnasium.make("subterra_jax:Subterra/StopAt-v1", tunnel="control", render_mode="rgb_array", view="mujoco")
env.reset(seed=0)
try:
    np.save(sys.argv[1], env.render())
except Exception as cause:
    sys.exit(str(cause))
"""


def test_without_a_scene_the_bore_is_drawn_with_the_robot_and_nothing_is_said_at_exit(tmp_path):
    """The environment is not closed."""
    picture, said = draw(DRAW, tmp_path / "picture.npy")
    assert "Traceback" not in said
    picture = picture.astype(int)
    assert picture.shape == (480, 480, 3)
    red, _, blue = np.moveaxis(picture, -1, 0)
    rows, columns = np.nonzero(red > blue + 60)
    assert len(rows) > 200, "no robot to be seen"
    assert abs(columns.mean() - 240) < 15
    wall = picture[200:300, [10, 470]]
    assert wall.mean() > 40, "the walls are dark"
    assert (picture.sum(axis=-1) < 30).mean() < 0.2, "a void"
