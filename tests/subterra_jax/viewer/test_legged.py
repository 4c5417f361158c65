"""A robot that walks, in the viewer."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.b2.constants import HIP_X, STAND_HEIGHT
from subterra_jax.b2.kinematics import standing_pose
from subterra_jax.viewer import library
from subterra_jax.viewer.geometry import Centreline, EpisodeGeometry, Moment
from subterra_jax.viewer.recording import N_POSE
from subterra_jax.viewer.scene import LeggedRobot
from tests.subterra_jax import tunnels
from tests.subterra_jax.viewer.episodes import straight


class Scene:
    """Keeps what would be drawn."""

    def __init__(self):
        self.made = {}

    def add_mesh_trimesh(self, name, mesh, **_options):
        self.made[name] = SimpleNamespace(mesh=mesh, position=None, wxyz=None)
        return self.made[name]


def moment(turned, trunk):
    pose = np.concatenate([[np.cos(turned / 2), 0.0, 0.0, np.sin(turned / 2)], standing_pose()[0]])
    return Moment(0, np.array([3.0, 4.0, 0.0]), turned, np.zeros(3), 0.0, trunk, pose)


def test_thirteen_bodies_stand_where_mujoco_has_them():
    scene = Scene()
    robot = LeggedRobot(scene)
    assert len(robot.nodes) == 13
    assert all(len(node.mesh.faces) for node in robot.nodes)
    robot.place(moment(0.0, 1.0 + STAND_HEIGHT))
    np.testing.assert_allclose(scene.made["/robot/base_link"].position, [3.0, 4.0, 1.0 + STAND_HEIGHT])
    assert scene.made["/robot/FL_hip"].position[0] == pytest.approx(3.0 + HIP_X)
    lowest = min(float((_turned(node.wxyz, node.mesh.vertices) + node.position)[:, 2].min()) for node in robot.nodes)
    assert lowest == pytest.approx(1.0, abs=0.02)  # its feet are on the ground


def test_it_faces_where_its_trunk_does():
    scene = Scene()
    robot = LeggedRobot(scene)
    robot.place(moment(np.pi / 2, 0.6))
    assert scene.made["/robot/FL_hip"].position[1] == pytest.approx(4.0 + HIP_X)


def test_between_two_rows_the_legs_move(plan_of):
    plan = plan_of(tunnels.tunnel_arrays(tunnels.straight(60.0)))
    poses = np.arange(3 * 4, dtype=np.float32).reshape(3, 4, 1) * np.ones(N_POSE, np.float32)
    episode = EpisodeGeometry(straight(3, pose=poses), Centreline(plan))
    assert [episode.moment(at).pose[0] for at in (0.0, 0.3, 0.99, 1.0, 1.6, 2.0)] == [4.0, 5.0, 7.0, 8.0, 10.0, 11.0]


@pytest.mark.slow
def test_a_b2_is_driven_and_its_legs_are_recorded():
    plan = st.load_tunnel()
    parts = library.drive_episode(plan, "0", "t", "pockets", "Subterra/B2Traverse-v1", "policy:B2Traverse-v1", 3)
    recording = list(itertools.islice(parts, 6))[-1]
    assert recording.pose.shape == (26, 10, N_POSE)
    np.testing.assert_allclose(np.linalg.norm(recording.pose[..., :4], axis=-1), 1.0, atol=1e-4)
    assert recording.pose[1:, :, 4:].std(axis=(0, 1)).max() > 0.05  # rad: it walks
    assert recording.station[-1] - recording.station[0] > 2.0


@pytest.mark.slow
def test_what_a_lidar_on_the_trunk_sees_is_shown_about_the_robot():
    plan = st.load_tunnel()
    parts = library.drive_episode(plan, "0", "t", "smooth", "Subterra/B2Traverse-v1", "dead-reckoning", 3, "spin16x64")
    points = list(itertools.islice(parts, 2))[-1].points
    assert points.shape[1:] == (1024, 3)
    half = float(np.interp(2.0, plan.station, plan.half_width))
    for row in points:
        near = row[(np.abs(row[:, 0]) < 1.0) & (row[:, 2] > 0.4)]
        assert np.ptp(near[:, 1]) == pytest.approx(2.0 * half, abs=0.5)  # both walls, at heights that the rings reach
        floor = row[(np.abs(row[:, 1]) < 0.7) & (np.abs(row[:, 0]) > 2.0) & (row[:, 2] < 0.3)]
        assert np.median(floor[:, 2]) == pytest.approx(0.0, abs=0.12)


def _turned(wxyz, points):
    import trimesh

    return points @ trimesh.transformations.quaternion_matrix(wxyz)[:3, :3].T
