"""A robot whose own LiDAR sees in three dimensions, as a recording."""

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import subterra_jax as st
from benchmarks.rewrite import RewriteConfig, rewrite
from scene.reading.recording import Recording
from scene.survey.messages import Convention
from subterra_jax.recorder import RecorderConfig, record
from subterra_jax.recorder.messages import POINT
from subterra_jax.tunnel.sources import tunnel_file


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    scene = tmp_path_factory.mktemp("spatial")
    (scene / "tunnel.npz").symlink_to(str(tunnel_file("subterra-351")))
    config = RecorderConfig(
        out=scene / "o", task="TraverseShort", scene=scene, lining="smooth", sensor="spin16x64", steps=4, every=2
    )
    record(config)
    return config


def test_its_points_lie_on_the_wall_by_the_true_pose(config):
    with AnyReader([config.recording_folder]) as reader:
        topics = {connection.topic for connection in reader.connections}
        clouds = [
            reader.deserialize(raw, connection.msgtype)
            for connection, _, raw in reader.messages()
            if connection.topic == "/points"
        ]
    assert "/scan" not in topics
    assert len(clouds) == 3  # of five rows every second one
    rows = clouds[-1].data.view(POINT)
    points = np.column_stack([rows["x"], rows["y"], rows["z"]]).astype(float)
    assert set(np.unique(rows["ring"])) <= set(range(16))
    elevation = np.rad2deg(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    np.testing.assert_allclose(elevation, -15.0 + 2.0 * rows["ring"], atol=0.1)
    shell = st.load_tunnel(config.scene, solid=True).shell
    off = [depth(shell, points, config, lift) for lift in (0.0, 0.5)]
    assert np.median(np.abs(off[0])) < 0.06
    assert np.median(np.abs(off[1])) > 0.1, "half a metre goes unnoticed"


def test_its_sweeps_are_written_anew_in_the_convention_of_another_driver(config, tmp_path):
    convention = Convention(point_times="epoch", point_unit="us", header_of="end", bags=2)
    path = rewrite(RewriteConfig(config.recording_folder, tmp_path / "a.bag", convention=convention))
    scans = []
    for one in (config.recording_folder, path):
        with Recording(one) as recording:
            scans.append(list(recording.scans()))
    assert len(scans[0]) == 3
    for before, after in zip(*scans, strict=True):
        assert after.stamp == pytest.approx(before.stamp, abs=1e-5)
        np.testing.assert_array_equal(after.points, before.points)


def depth(shell, points, config, lift):
    """Distance of points behind the wall, m, above the axis alone, since the track lies below it."""
    _, *pose = np.loadtxt(config.truth_folder / "lidar.tum")[-1]
    there = Rotation.from_quat(pose[3:]).apply(points) + pose[:3] + [0.0, 0.0, lift]
    node = KDTree(shell.position).query(there)[1]
    apart = there - shell.position[node]
    left, up = (np.sum(apart * axis[node], axis=1) for axis in (shell.left, shell.up))
    column = np.round((np.arctan2(up, left) - shell.angle[0]) / (2 * np.pi) * len(shell.angle)).astype(int)
    return (np.hypot(left, up) - shell.radius[node, column % len(shell.angle)])[up > 0.3]
