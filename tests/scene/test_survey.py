"""A written survey, read back by readers of its own."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.scene.surveyed import Cast, Trajectory, frames, load_cast, load_trajectory, survey

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


@pytest.fixture(scope="module")
def bag(folder: Path) -> Bag:
    store = get_typestore(Stores.ROS1_NOETIC)
    with Reader(folder / "survey.bag") as reader:
        connections = {c.topic: c for c in reader.connections}
        custom = connections["/livox/lidar"]
        store.register(get_types_from_msg(custom.msgdef.data, custom.msgtype))
        assert store.generate_msgdef(custom.msgtype)[1] == custom.digest
        raw = [(t, data) for _, t, data in reader.messages([custom])]
        # Object by object only once: the packed array must say the same.
        whole = store.deserialize_ros1(raw[80][1], custom.msgtype)
    points = np.array([np.frombuffer(data[-19 * POINTS :], POINT) for _, data in raw])
    assert [p.x for p in whole.points] == points[80]["xyz"][:, 0].tolist()
    assert [p.line for p in whole.points] == points[80]["line"].tolist()
    assert whole.point_num == len(whole.points) == POINTS
    assert whole.timebase == EPOCH * 10**9 + 8 * 10**9
    return Bag(connections, raw, points)


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


def test_the_whole_bore_is_seen_from_mouth_to_mouth(truth: dict, bag: Bag, trajectory: Trajectory) -> None:
    seen = (bag.points["xyz"] != 0).any(axis=2)
    time = (EPOCH + 0.1 * np.arange(len(seen))[:, None] + 1e-9 * bag.points["t"])[seen]
    place, attitude = trajectory.at(time)
    cloud = place + attitude.apply(bag.points["xyz"][seen])
    position, tangent, lateral, up = frames(truth)
    for i in range(0, len(position) - 1, 2):
        away = cloud - position[i]
        near = away[abs(away @ tangent[i] - 0.25) <= 0.25]
        turn = np.arctan2(near @ up[i], near @ lateral[i])
        assert np.histogram(turn, 18, (-np.pi, np.pi))[0].min() >= 4, truth["station"][i]


def test_the_truth_keeps_its_format(truth: dict) -> None:
    assert (truth["schema"], truth["provenance"], truth["seed"]) == ("subterra.truth/1", "simulated", 4)
    station, (position, tangent, _, _) = np.array(truth["station"]), frames(truth)
    np.testing.assert_allclose(station, np.arange(0, LENGTH + 0.1, 0.25))
    np.testing.assert_allclose(np.linalg.norm(np.diff(position, axis=0), axis=1), 0.25, atol=2e-6)
    np.testing.assert_allclose(np.gradient(position, 0.25, axis=0)[1:-1], tangent[1:-1], atol=1e-4)
    assert len(truth["width"]) == len(truth["height"]) == len(station)
    np.testing.assert_allclose(np.diff(truth["rings"]["station"]), 1.5, atol=1e-5)
    assert {p["side"] for p in truth["pockets"]} == {"left", "right"}
    assert 0.8 < np.mean([p["open"] for p in truth["pockets"]]) < 1.0


def test_the_gauge_is_between_the_inner_faces(truth: dict, cast: Cast) -> None:
    tops = [np.array(truth["rails"][side]) for side in ("left", "right")]
    _, _, lateral, up = frames(truth)
    for below in (0.014, 0.015, 0.016):
        start = (0.5 * (tops[0] + tops[1]) - below * up)[1:-1]
        gap = cast(start, lateral[1:-1]) + cast(start, -lateral[1:-1])
        np.testing.assert_allclose(gap, 1.435, atol=1e-3)
    above = 1.0
    np.testing.assert_allclose(cast(tops[0][1:-1] + above * up[1:-1], -up[1:-1]), above, atol=1e-3)


def test_sleepers_stand_above_the_floor_as_told(truth: dict, cast: Cast) -> None:
    top = np.array(truth["sleepers"]["position"])
    drop = np.array([0.0, 0.0, -1.0])
    onto_sleeper = cast(top - drop, drop)
    between = 0.5 * (top[1:] + top[:-1])
    onto_floor = cast(between - drop, drop)
    np.testing.assert_allclose(onto_sleeper, 1.0, atol=1e-3)
    np.testing.assert_allclose(onto_floor, 1.0 + truth["sleepers"]["top_above_floor"], atol=2e-3)


def pocket_rays(pockets: list[dict], truth: dict, shift: float) -> tuple[np.ndarray, np.ndarray]:
    """Rays that start 0.3 m before the pockets, `shift` off their middle along the girth."""
    out = np.array([p["outward"] for p in pockets])
    nearest = [int(np.argmin(abs(np.array(truth["station"]) - p["station"]))) for p in pockets]
    girth = np.cross(frames(truth)[1][nearest], out)
    return np.array([p["position"] for p in pockets]) + shift * girth - 0.3 * out, out


def test_pockets_are_as_deep_as_told_and_filled_ones_are_flush(truth: dict, cast: Cast) -> None:
    for opened in (True, False):
        pockets = [p for p in truth["pockets"] if p["open"] == opened]
        assert pockets
        within = cast(*pocket_rays(pockets, truth, 0.05))
        # The lining around has a roughness of 1 cm, which the pocket's floor shares with its mouth.
        beside = 0.5 * (cast(*pocket_rays(pockets, truth, 0.10)) + cast(*pocket_rays(pockets, truth, -0.10)))
        error = within - beside - np.array([p["depth"] * opened for p in pockets])
        assert np.median(error) == pytest.approx(0.0, abs=1.5e-3)
        np.testing.assert_allclose(error, 0.0, atol=0.012)


def test_nails_cross_the_pockets_that_they_join(truth: dict, cast: Cast) -> None:
    nailed = [p for p in truth["pockets"] if p["nail"]]
    assert len(nailed) > 0.8 * len(truth["pockets"])
    start, out = pocket_rays(nailed, truth, 0.0)
    along = frames(truth)[1][[int(np.argmin(abs(np.array(truth["station"]) - p["station"]))) for p in nailed]]
    rings = np.array(truth["rings"]["station"])[[p["ring"] for p in nailed]]
    towards = np.sign(rings - [p["station"] for p in nailed])[:, None]
    reach = cast(start + 0.05 * towards * along, out)
    assert np.median(reach) == pytest.approx(0.3 + 0.06 - 0.014, abs=4e-3)
