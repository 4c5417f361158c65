"""A written survey, read back by readers of its own."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from tests.scene.surveyed import Cast, Trajectory, load_cast, load_trajectory, read_tum, survey

LENGTH, POINTS, EPOCH = 14.0, 2_400, 1_700_000_000
POINT = np.dtype([("t", "<u4"), ("xyz", "<f4", 3), ("reflectivity", "u1"), ("tag", "u1"), ("line", "u1")])


def make(out: Path, *more: str) -> Path:
    return survey(out, "--length", LENGTH, "--seed", 4, "--point-rate", 24000, *more)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("survey"))


@pytest.fixture(scope="module")
def truth(folder: Path) -> dict:
    return json.loads((folder / "truth.json").read_text())


@pytest.fixture(scope="module")
def trajectory(folder: Path) -> Trajectory:
    return load_trajectory(folder / "groundtruth.tum")


@dataclass(frozen=True)
class Bag:
    connections: dict
    lidar: list
    points: np.ndarray  # (scans, points) of POINT
    imu: list


@pytest.fixture(scope="module")
def bag(folder: Path) -> Bag:
    store = get_typestore(Stores.ROS1_NOETIC)
    with Reader(folder / "survey.bag") as reader:
        connections = {c.topic: c for c in reader.connections}
        custom = connections["/livox/lidar"]
        store.register(get_types_from_msg(custom.msgdef.data, custom.msgtype))
        assert store.generate_msgdef(custom.msgtype)[1] == custom.digest
        raw = [(t, data) for _, t, data in reader.messages([custom])]
        imu = [store.deserialize_ros1(data, c.msgtype) for c, _, data in reader.messages([connections["/imu/data"]])]
        # Object by object only once: the packed array must say the same.
        whole = store.deserialize_ros1(raw[80][1], custom.msgtype)
    points = np.array([np.frombuffer(data[-19 * POINTS :], POINT) for _, data in raw])
    assert [p.x for p in whole.points] == points[80]["xyz"][:, 0].tolist()
    assert [p.line for p in whole.points] == points[80]["line"].tolist()
    assert whole.point_num == len(whole.points) == POINTS
    assert whole.timebase == EPOCH * 10**9 + 8 * 10**9
    return Bag(connections, raw, points, imu)


@pytest.fixture(scope="module")
def cast(folder: Path) -> Cast:
    return load_cast(folder / "truth.ply")


def test_the_bag_has_the_topics_types_and_rates_of_geode(bag: Bag) -> None:
    kinds = {topic: (c.msgtype, c.digest, c.msgcount) for topic, c in bag.connections.items()}
    scans = len(bag.lidar)
    assert kinds == {
        "/livox/lidar": ("livox_ros_driver/msg/CustomMsg", "e4d6829bdfe657cb6c21a746c86b21a6", scans),
        "/livox/imu": ("sensor_msgs/msg/Imu", "6a62c6daae103f4ff57a132d6f95cec2", 20 * scans),
        "/imu/data": ("sensor_msgs/msg/Imu", "6a62c6daae103f4ff57a132d6f95cec2", 10 * scans),
    }
    times = [t for t, _ in bag.lidar]
    assert np.unique(np.diff(times)).tolist() == [100_000_000]


def test_returns_lie_on_the_truth_within_the_range_noise(bag: Bag, trajectory: Trajectory, cast: Cast) -> None:
    points, scan = bag.points[:, ::7], np.arange(len(bag.points))[:, None]
    seen = (points["xyz"] != 0).any(axis=2)
    time = (EPOCH + 0.1 * scan + 1e-9 * points["t"])[seen]
    position, attitude = trajectory.at(time)
    local = points["xyz"][seen].astype(float)
    reach = np.linalg.norm(local, axis=1)
    error = reach - cast(position, attitude.apply(local / reach[:, None]))
    # Next to an edge, the rounding of a direction decides which side is hit.
    close = abs(error) < 0.12
    assert close.mean() > 0.998
    assert np.median(abs(error)) == pytest.approx(0.6745 * 0.02, abs=3e-4)
    assert error[close].std() == pytest.approx(0.02, abs=5e-4)
    assert error[close].mean() == pytest.approx(0.0, abs=3e-4)


def test_the_prism_is_a_lever_arm_away_from_the_lidar(folder: Path, trajectory: Trajectory) -> None:
    time, rows = read_tum(folder / "prism.tum")
    assert (np.diff(time) < 0).sum() >= 1
    assert not rows[:, 3:].any()
    assert np.median(np.diff(np.sort(time))) == pytest.approx(1 / 3, abs=0.05)
    position, attitude = trajectory.at(time)
    # GEODE's evaluation: T_leica = T_lidar · inv(T), T as printed there.
    turn, shift = Rotation.from_quat([-0.00492765, 0.00575961, 0.0117651, 0.999901]), [0.00947221, -0.308202, -0.365733]
    error = rows[:, :3] - (position - attitude.apply(turn.inv().apply(shift)))
    assert error.std() == pytest.approx(0.0025, abs=6e-4)
    assert abs(error.mean(axis=0)).max() < 1.5e-3
