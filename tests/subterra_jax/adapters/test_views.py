"""Pictures: the plan from above shows what is there, and a scene is drawn through MuJoCo where GL works."""

import shutil
from pathlib import Path

import jax
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.parts.boxes import Boxes
from subterra_jax.pictures import top_down as drawing
from subterra_jax.pictures.views import make_view
from tests.subterra_jax.drawn import draw


def colours(picture):
    assert picture.shape == (480, 480, 3)
    assert picture.dtype == np.uint8
    return {tuple(int(c) for c in colour) for colour in np.unique(picture.reshape(-1, 3), axis=0)}


@pytest.fixture(scope="module")
def begun():
    env, params = st.make("Subterra/Obstructed-v1", "subterra-351")
    obs, state = jax.device_get(jax.jit(env.reset)(jax.random.key(1), params))
    return env, params, state, obs


def at(begun, station):
    """The picture with the robot elsewhere on the centreline."""
    env, params, state, obs = begun
    row = round(station / float(params.tunnel.spacing))
    moved = state.replace(position=np.asarray(params.tunnel.grid[row, :2]), station=np.float32(station))
    return colours(make_view("top", None).picture(env, params, moved, obs))


def test_the_plan_shows_walls_beams_and_robot(begun):
    assert at(begun, 0.0) >= {drawing.BACKGROUND, drawing.WALL, drawing.BEAM, drawing.ROBOT}


def test_the_goal_and_the_boxes_are_shown_where_they_are_near(begun):
    goal = float(begun[2].goal.station)
    assert drawing.GOAL in at(begun, goal - 5.0)
    assert drawing.GOAL not in at(begun, goal - 20.0 if goal > 30.0 else goal + 20.0)
    start = float(begun[2].station)  # boxes stand ahead of it
    assert any(drawing.BOX in at(begun, start + ahead) for ahead in (15.0, 30.0, 45.0))


def test_a_box_and_a_goal_are_drawn_where_they_are():
    boxes = Boxes(centre=np.array([[3.0, 4.0]]), axis=np.array([[0.0, 1.0]]), half=np.array([[1.0, 0.5]]))
    goal = np.array([[-5.0, -2.0], [-5.0, 2.0]])
    picture = drawing.top_down(
        np.zeros((0, 2)), np.zeros(2), 0.0, 0.4, np.zeros(4), view=24.0, size=240, goal=goal, boxes=[boxes]
    )
    rows, columns = np.nonzero((picture == drawing.BOX).all(axis=2))
    x, y = (columns + 0.5 - 120) / 10, (120 - rows - 0.5) / 10
    assert [x.min(), x.max(), y.min(), y.max()] == pytest.approx([2.5, 3.5, 3.0, 5.0], abs=0.11)
    rows, columns = np.nonzero((picture == drawing.GOAL).all(axis=2))
    assert np.ptp(rows) == pytest.approx(40, abs=2)
    assert np.abs((columns + 0.5 - 120) / 10 + 5.0).max() < 0.2


def test_a_scene_that_is_not_there_is_named(tmp_path):
    from subterra_jax.pictures.views import SceneError

    with pytest.raises(SceneError, match=r"scene\.xml is missing"):
        make_view("mujoco", tmp_path)
    (tmp_path / "scene.xml").write_text("<mujoco><bad/></mujoco>")
    (tmp_path / "tunnel.npz").write_bytes(b"")
    with pytest.raises(SceneError, match="cannot be loaded"):
        make_view("mujoco", tmp_path)


DRAW = """
import sys
from types import SimpleNamespace

import numpy as np

from subterra_jax.pictures.views import MujocoView, Path, SceneError

x, y, heading = (float(word) for word in sys.argv[3:])
view = MujocoView(Path(sys.argv[2]))
state = SimpleNamespace(position=np.array([x, y]), heading=heading)
params = SimpleNamespace(vehicle=SimpleNamespace(radius=0.4))
try:
    np.save(sys.argv[1], view.picture(None, params, state, None))
except SceneError as cause:
    sys.exit(str(cause))
view.close()
"""


def test_a_scene_is_drawn_with_the_robot_in_front_of_the_camera(tmp_path):
    """A plane at the height of the ground and one lamp stand for a scene."""
    packaged = Path(st.__file__).parent / "data" / "subterra-351.npz"
    shutil.copy(packaged, tmp_path / "tunnel.npz")
    plan = st.load_tunnel(packaged)
    (tmp_path / "scene.xml").write_text(
        "<mujoco><worldbody><light pos='0 0 9'/>"
        f"<geom type='plane' size='50 50 1' pos='0 0 {plan.elevation[40]}' rgba='0.3 0.3 0.3 1'/></worldbody></mujoco>"
    )
    heading = np.arctan2(plan.tangent[40, 1], plan.tangent[40, 0])
    place = [str(value) for value in (*plan.centre[40], heading)]
    picture, _ = draw(DRAW, tmp_path / "picture.npy", str(tmp_path), *place)
    red, _, blue = np.moveaxis(picture.astype(int), -1, 0)
    rows, columns = np.nonzero(red > blue + 60)
    assert len(rows) > 200, "no robot to be seen"
    assert abs(columns.mean() - 240) < 15
    assert (red[400:] <= blue[400:] + 60).all()
