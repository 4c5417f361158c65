"""A recorded episode: the scored one, whole in every reader, its truth apart, poses and IMU with known answers."""

import dataclasses
import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.reader import read_ros2_messages
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

import subterra_jax as st
from subterra_jax.baselines.registry import make_agent
from subterra_jax.evaluation import evaluate, listed_episodes
from subterra_jax.host import rover
from subterra_jax.recorder import record
from subterra_jax.recorder.__main__ import main
from subterra_jax.recorder.messages import EPOCH, laser_scan, odometry, store
from subterra_jax.recorder.sensors import GRAVITY, Poses, measure_imu, reckoned_poses, true_poses
from subterra_jax.recorder.trace import Trace
from subterra_jax.state import State
from tests.recorded import check, named

TASK = "Subterra/StopAtShort-v1"
TYPES = get_typestore(Stores.ROS2_JAZZY)
TOPICS = {"/cmd_vel", "/imu", "/odom", "/scan", "/tf", "/tf_static"}


@pytest.fixture(scope="session")
def messages(config, trace):
    """Messages of the recording by topic, as rosbags reads them: stamps in s since the start, and contents."""
    found = {}
    with Reader(config.recording_folder) as bag:
        for connection, time, raw in bag.messages():
            message = TYPES.deserialize_cdr(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append((time * 1e-9 - EPOCH, message))
    return found


def test_the_episode_is_the_one_that_the_board_scores(config, trace):
    env, params = st.make(TASK)
    agent = make_agent(config.agent, params)
    record = evaluate(env, params, agent, listed_episodes(env, params, 2)).where(np.array([False, True]))
    truth = json.loads((config.truth_folder / "truth.json").read_text())
    assert truth["seed"] == record.seed[0]
    assert len(trace.command) * trace.period == pytest.approx(record.time[0])
    assert truth["travelled"] == pytest.approx(record.travelled[0], abs=1e-3)
    assert trace.success == record.success[0]
    missed = float(trace.state.station[-1]) - trace.observation[0, env.fields(params)["goal"]][0]
    assert missed == pytest.approx(float(record.goal_error[0]), abs=1e-3)


def test_rosbags_reads_what_the_agent_saw_and_did(config, trace, messages):
    n = len(trace.command)
    assert set(messages) == TOPICS
    assert [len(messages[topic]) for topic in ("/scan", "/odom", "/tf", "/cmd_vel")] == [n + 1, n + 1, n + 1, n]
    ranges = np.array([message.ranges for _, message in messages["/scan"]])
    seen, (_, first) = trace.observation[:, :16], messages["/scan"][0]
    np.testing.assert_array_equal(ranges, np.where(seen >= np.float32(first.range_max), np.inf, seen))
    assert 0.0 < first.range_min <= np.min(ranges)
    commanded = np.array([(m.twist.linear.x, m.twist.angular.z) for _, m in messages["/cmd_vel"]])
    np.testing.assert_allclose(commanded, trace.command, rtol=1e-6)
    np.testing.assert_allclose([time for time, _ in messages["/scan"]], trace.time, atol=1e-6)
    one = messages["/scan"][5][1]
    topics = TOPICS - {"/scan", "/tf"}
    bag = {topic: [dataclasses.asdict(sent) for _, sent in messages[topic][:20]] for topic in topics}
    check(__file__, "messages", bag, 1e-3)
    few = {name: np.atleast_1d(values)[:20] for name, values in named(vars(trace)).items()}
    check(__file__, "trace", few, 1e-3)
    assert one.angle_min + 15 * one.angle_increment == pytest.approx(one.angle_max)
    assert one.header.stamp.sec + 1e-9 * one.header.stamp.nanosec == pytest.approx(EPOCH + 0.5)


def test_the_reckoned_pose_drives_the_distance_that_the_odometer_counted(trace, messages):
    x = np.array([(m.pose.pose.position.x, m.pose.pose.position.y) for _, m in messages["/odom"]])
    steps = np.linalg.norm(np.diff(x, axis=0), axis=1)
    np.testing.assert_allclose(steps, np.abs(np.diff(trace.observation[:, 16])), atol=1e-5)
    transform = messages["/tf"][-1][1].transforms[0]
    assert (transform.header.frame_id, transform.child_frame_id) == ("odom", "base_link")
    assert transform.transform.translation.x == pytest.approx(x[-1, 0])
    mounts = {part.child_frame_id: part.transform.translation.z for part in messages["/tf_static"][0][1].transforms}
    assert mounts == pytest.approx({"laser": 0.7, "imu": 0.7})


def test_the_twist_of_the_odometry_is_in_the_frame_of_the_robot():
    """A robot that heads north and drives ahead: its own x grows, whatever the world's."""
    north = Rotation.from_euler("z", np.deg2rad([[90.0], [95.0]]))
    poses = Poses(np.array([0.0, 0.5]), np.array([[1.0, 2.0, 0.0], [1.0, 2.5, 0.0]]), north)
    twist = odometry(poses, 1, "odom").twist.twist
    assert twist.linear.x == pytest.approx(1.0, abs=0.01)
    assert abs(twist.linear.y) < 0.1
    assert twist.angular.z == pytest.approx(np.deg2rad(10.0))


@pytest.mark.parametrize(("reach", "reported"), [(29.9, 29.9), (30.0, np.inf), (0.01, -np.inf)])
def test_a_beam_without_echo_and_one_too_near_are_no_distances(reach, reported):
    scan = laser_scan(0.0, "laser", np.array([5.0, reach]), 30.0, 0.1)
    assert scan.ranges[1] == pytest.approx(reported)
    assert scan.range_min > 0.0


def test_mcap_and_its_ros2_decoder_read_it_by_the_definitions_inside(config, trace, messages):
    path = config.recording_folder / "recording.mcap"
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert {channel.topic for channel in summary.channels.values()} == TOPICS
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
        assert summary.statistics.message_count == sum(len(some) for some in messages.values())
    decoded = [one.ros_msg for one in read_ros2_messages(str(path), topics=["/scan"])]
    assert len(decoded) == len(trace.observation)
    np.testing.assert_array_equal(np.float32(decoded[-1].ranges), messages["/scan"][-1][1].ranges)


def test_the_recording_tells_neither_seed_nor_truth(config, trace):
    names = {path.name for path in config.recording_folder.iterdir()}
    assert names == {"metadata.yaml", "recording.mcap", "recording.json", "odometry.tum"}
    facts = json.loads((config.recording_folder / "recording.json").read_text())
    assert not {"seed", "episode", "severity", "success"} & set(facts)
    assert facts["observed"]["goal"] == pytest.approx(trace.observation[0, 18])
    rows = np.loadtxt(config.truth_folder / "base_link.tum")
    np.testing.assert_allclose(rows[:, 1:3], trace.state.position, atol=1e-6)
    lidar = np.loadtxt(config.truth_folder / "lidar.tum")
    np.testing.assert_allclose(np.linalg.norm(lidar[:, 1:4] - rows[:, 1:4], axis=1), 0.7, atol=1e-6)
    axis = np.loadtxt(config.truth_folder / "axis.csv", delimiter=",", skiprows=1)
    truth = json.loads((config.truth_folder / "truth.json").read_text()) | {"recording_sha256": None}
    told = {"lidar": lidar[:20], "axis": axis[:50], "facts": {**facts, "versions": None}, "truth": truth}
    check(__file__, "files", told)
    with Reader(config.truth_folder) as bag:
        assert {connection.topic for connection in bag.connections} == {"/tf", "/truth/odometry"}


def test_the_same_config_gives_the_same_bytes(config, trace, tmp_path):
    again = dataclasses.replace(config, out=tmp_path / "again")
    record(again)
    for folder, other in ((config.recording_folder, again.recording_folder), (config.truth_folder, again.truth_folder)):
        for path in folder.iterdir():
            assert path.read_bytes() == (other / path.name).read_bytes(), path.name


def test_a_missing_library_and_a_place_that_cannot_be_written_are_told(monkeypatch, capsys, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    assert main(["--out", str(blocked / "out"), "--task", "StopAtShort", "--steps", "1"]) == 2
    assert "is a file, so no folder" in capsys.readouterr().err
    store.cache_clear()
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    assert main(["--out", str(tmp_path / "out")]) == 2
    assert "subterra_jax.recorder needs rosbags, which is not installed" in capsys.readouterr().err


def test_a_recording_is_not_overwritten(config, trace, capsys):
    assert main(["--out", str(config.out)]) == 2
    assert "exists already" in capsys.readouterr().err


@dataclasses.dataclass
class Places:
    """As much of a state as poses need."""

    position: np.ndarray
    heading: np.ndarray
    station: np.ndarray


def trace_of(position, heading, station, period: float = 0.1) -> Trace:
    return of_states(Places(np.asarray(position), np.asarray(heading), np.asarray(station)), len(station), period)


def of_states(states, n, period=0.1):
    """A trace of `n` rows of which the states alone are looked at."""
    nothing = np.zeros(n - 1)
    seen, poses = np.zeros((n, 18)), np.zeros((n, 0, 19))
    return Trace(states, seen, np.zeros((n - 1, 5)), nothing, nothing, np.zeros((n, 0, 3)), poses, period)


def test_on_a_grade_the_robot_is_pitched_by_it_and_facing_back_it_looks_down():
    plan = st.load_tunnel("control")
    plan = dataclasses.replace(plan, elevation=0.03 * plan.station)
    station = np.array([10.0, 50.0])
    tangent = np.stack([np.interp(station, plan.station, plan.tangent[:, i]) for i in range(2)], axis=-1)
    centre = np.stack([np.interp(station, plan.station, plan.centre[:, i]) for i in range(2)], axis=-1)
    heading = np.arctan2(tangent[:, 1], tangent[:, 0]) + np.array([0.0, np.pi])
    poses = true_poses(trace_of(centre, heading, station), plan)
    ahead = poses.rotation.apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(ahead[:, 2], np.array([1.0, -1.0]) * np.sin(np.arctan(0.03)), atol=1e-6)
    np.testing.assert_allclose(poses.rotation.apply([0.0, 1.0, 0.0])[:, 2], 0.0, atol=1e-9)
    np.testing.assert_allclose(poses.position[:, 2], 0.03 * station, atol=1e-9)


def test_a_rover_leans_as_its_trunk_does_over_the_point_where_it_stands():
    turn = Rotation.from_euler("ZYX", [[0.4, 0.2, -0.1]])
    where = np.array([[1.0, 2.0, 0.5]]) + rover.HEIGHT * turn.apply([0.0, 0.0, 1.0])
    body = SimpleNamespace(qpos=np.hstack([where, turn.as_quat()[:, [3, 0, 1, 2]]]))
    ride = SimpleNamespace(body=body, anchor=np.array([1]))
    states = SimpleNamespace(parts={"rover": ride})
    track = SimpleNamespace(position=np.array([[0.0, 0.0, 0.0], [10.0, 20.0, 30.0]]))
    poses = true_poses(of_states(states, 1), st.load_tunnel("control"), track)
    np.testing.assert_allclose(poses.position, [[11.0, 22.0, 30.5]], atol=1e-9)
    np.testing.assert_allclose(poses.rotation.as_matrix(), turn.as_matrix(), atol=1e-9)


def test_an_odometer_without_errors_reckons_the_true_path():
    turn = np.linspace(0.0, 1.4 * np.pi, 60)  # past the wrap of the heading
    step, rate = 0.2, turn[1]
    chord = 2.0 * step / rate * np.sin(rate / 2.0)
    moves = chord * np.stack([np.cos(turn[:-1] + rate / 2.0), np.sin(turn[:-1] + rate / 2.0)], axis=-1)
    true = np.concatenate([[[0.0, 0.0]], np.cumsum(moves, axis=0)])
    reading = np.column_stack([step * np.arange(60), np.arctan2(np.sin(turn), np.cos(turn))])
    poses = reckoned_poses(trace_of(true, turn, turn), reading)
    np.testing.assert_allclose(poses.position[:, :2], true, atol=2e-3 * step * 60)
    np.testing.assert_allclose(poses.rotation.as_rotvec()[10, 2], turn[10], atol=1e-9)


def test_an_imu_on_a_circle_feels_the_turn_the_pull_inwards_and_gravity():
    time, speed, rate = np.arange(0.0, 6.0, 0.1), 2.0, 0.3
    radius = speed / rate
    position = radius * np.stack([np.sin(rate * time), 1.0 - np.cos(rate * time), 0.0 * time], axis=-1)
    poses = Poses(time, position, Rotation.from_rotvec(rate * time[:, None] * np.array([0.0, 0.0, 1.0])))
    true = measure_imu(poses, seed=0, noise=0.0)
    inner = slice(20, -20)
    np.testing.assert_allclose(true.gyro[inner], np.broadcast_to([0.0, 0.0, rate], true.gyro[inner].shape), atol=1e-6)
    expected = np.broadcast_to([0.0, speed * rate, GRAVITY], true.accel[inner].shape)
    np.testing.assert_allclose(true.accel[inner], expected, atol=2e-3)
    noisy = measure_imu(poses, seed=0)
    check(__file__, "imu", {"gyro": noisy.gyro, "accel": noisy.accel})
    assert 0.004 < np.std(noisy.gyro[:, 2] - true.gyro[:, 2]) < 0.006
    np.testing.assert_array_equal(measure_imu(poses, seed=0).accel, noisy.accel)


def test_a_state_has_all_that_poses_need():
    assert {field.name for field in dataclasses.fields(Places)} <= {field.name for field in dataclasses.fields(State)}
