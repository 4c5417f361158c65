"""Recordings of the arena: layouts of the drivers, both kinds of bag, the IMU at rest, wheels, dust, and mistakes."""

import json
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from mcap_ros2.reader import read_ros2_messages
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from benchmarks.slam.__main__ import command
from benchmarks.slam.arena import bags, record, sets
from benchmarks.slam.arena.drives import CARRIERS, REST, measure_wheels
from benchmarks.slam.arena.walls import draw_walls
from benchmarks.slam.reading import read_samples, sweep_points
from scene.survey.carrier import ACCEL_BIAS, GRAVITY, Poses
from scene.survey.cast import Hits
from tests.recorded import check

# Fields as name, offset, ROS code of the type; and the bytes of a point. Sources: velodyne_pointcloud's
# pointcloudXYZIRT.cpp; ouster_ros' os_point.h (`ring` is a byte up to 2023, as LIO-SAM and FAST-LIO declare it).
VELODYNE = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("ring", 16, 4), ("time", 18, 7)], 22
OUSTER = [
    ("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 16, 7), ("t", 20, 6), ("reflectivity", 24, 4), ("ring", 26, 2),
    ("ambient", 28, 4), ("range", 32, 6),
], 48  # fmt: skip
TOPICS = {"vlp16": "/velodyne_points", "os1-32": "/ouster/points", "avia": "/livox/lidar"}
VALUES = Path(__file__).with_name("values.csv")
SEED = np.random.SeedSequence(4)


@pytest.fixture(scope="module", params=list(TOPICS))
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """The first sweeps of a recording, as both kinds of bag."""
    folder = tmp_path_factory.mktemp(request.param)
    scene = record.draw_scene(record.Course("one", "smooth", request.param, distance=1.0), SEED)
    for _ in bags.write_bags(folder, ("mcap", "bag"), islice(record.stream(scene), 80)):
        pass
    return request.param, folder


def content(path: Path) -> list[tuple[str, int, object]]:
    with AnyReader([path]) as reader:
        return [(c.topic, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()]


def test_both_bags_hold_the_same_messages_and_other_readers_agree(made):
    name, folder = made
    first, second = content(folder / bags.BAG), content(folder / bags.MCAP)
    assert sorted(row[:2] for row in first) == sorted(row[:2] for row in second)
    assert {row[0] for row in first} == {TOPICS[name], "/imu/data", "/odom", "/tf_static"}
    clouds = [[sweep_points(one) for topic, _, one in rows if topic == TOPICS[name]] for rows in (first, second)]
    foreign = [sweep_points(row.ros_msg) for row in read_ros2_messages(folder / bags.MCAP / "recording.mcap")
               if row.channel.topic == TOPICS[name]]  # fmt: skip
    ours = [points for _, points in read_samples(_recording(folder, name)) if not isinstance(points, tuple)]
    assert len(clouds[0]) >= 2
    for one, *others in zip(*clouds, foreign, ours, strict=True):
        for other in others:
            np.testing.assert_array_equal(one, other)


def _recording(folder: Path, name: str) -> Path:
    """The folder of a recording of the arena: bag and calibration."""
    place = folder / "set" / "recordings" / "one"
    if not place.exists():
        place.mkdir(parents=True)
        (place / "recording").symlink_to(folder / bags.MCAP)
        scene = record.draw_scene(record.Course("one", "smooth", name, distance=1.0), SEED)
        (place / "calibration.yaml").write_text(json.dumps(record.calibration(scene)))
    return place


def test_evalio_is_given_a_recording_as_images_of_points(made):
    name, folder = made
    from evalio.types import ImuMeasurement

    from benchmarks.slam.evalio import EvalioRecording

    one = EvalioRecording(_recording(folder, name))
    samples = list(one.samples())
    sweeps = [s for s in samples if not isinstance(s, ImuMeasurement)]
    assert len(samples) - len(sweeps) >= 40
    raw = [sweep_points(m) for topic, _, m in content(folder / bags.MCAP) if topic == TOPICS[name]]
    facts = one.lidar
    for sweep, points in zip(sweeps, raw, strict=True):
        xyz = np.array([(p.x, p.y, p.z, p.row, p.t.to_sec()) for p in sweep.points])
        assert len(xyz) == facts.num_rows * facts.num_columns
        seen = np.abs(xyz[:, :3]).sum(axis=1) > 0.0
        valid = np.abs(points["x"]) + np.abs(points["y"]) + np.abs(points["z"]) > 0.0
        outcome = np.column_stack([points["x"], points["y"], points["z"], points["ring"], 1e-9 * points["t"]])[valid]
        assert seen.sum() == valid.sum()
        np.testing.assert_allclose(np.sort(xyz[seen], axis=0), np.sort(outcome, axis=0), atol=2e-6)
    np.testing.assert_allclose(one.mount.trans, record.IMU.shift)


def test_layouts_are_those_of_the_drivers(made):
    name, folder = made
    message = next(one for topic, _, one in content(folder / bags.BAG) if topic == TOPICS[name])
    if name == "avia":
        assert message.__msgtype__ == "livox_ros_driver/msg/CustomMsg"
        assert message.point_num == len(message.points) == 24_000
        assert message.timebase == message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
    else:
        fields, size = VELODYNE if name == "vlp16" else OUSTER
        assert [(f.name, f.offset, f.datatype) for f in message.fields] == fields
        assert message.point_step == size
        assert message.row_step == size * message.width
    points = sweep_points(message)
    assert 0 <= points["t"].min() < 2_000_000
    assert 95_000_000 < points["t"].max() < 100_000_000
    assert len(np.unique(points["ring"])) == {"vlp16": 16, "os1-32": 32, "avia": 6}[name]
    assert points["intensity"].max() > 1.0


def test_livox_messages_have_the_fields_of_either_driver():
    for store, package in ((bags.ros1_store(), "livox_ros_driver"), (bags.ros2_store(), "livox_ros_driver2")):
        for line in Path(__file__).with_name("livox.txt").read_text().splitlines()[1:]:
            name, *fields = line.split()
            _, parts = store.fielddefs[f"{package}/msg/{name}"]
            assert [f"{part}:{_base(kind)}" for part, kind in parts] == fields, name


def _base(kind: tuple) -> str:
    """The basic type of a field or of its elements; nothing for a message."""
    node, rest = kind
    if node.name == "BASE":
        return rest[0]
    return _base(rest[0]) if node.name in ("ARRAY", "SEQUENCE") else ""


def test_kiss_icp_loads_the_bags_as_they_are(made):
    from kiss_icp.datasets.rosbag import RosbagDataset

    name, folder = made
    if name == "avia":
        pytest.skip("kiss-icp reads PointCloud2 only")
    for path in (folder / bags.BAG, folder / bags.MCAP):
        data = RosbagDataset(path, TOPICS[name])
        points, times = data[0]
        assert points.shape == (len(times), 3)
        assert len(data) >= 2
        assert np.ptp(times) > 0.0


def test_extrinsics_say_where_the_imu_hangs(made):
    name, folder = made
    (message,) = [one for topic, _, one in content(folder / bags.MCAP) if topic == "/tf_static"]
    lidar, imu = (np.array([t.transform.translation.x, t.transform.translation.y, t.transform.translation.z])
                  for t in message.transforms)  # fmt: skip
    assert [t.child_frame_id for t in message.transforms] == [record.make_sensor(name).frame, "imu_link"]
    np.testing.assert_allclose(imu - lidar, [-0.05, 0.02, -0.10])
    np.testing.assert_allclose(imu - lidar, -record.IMU.shift)


def inertial(motion: str) -> tuple[record.Scene, np.ndarray, np.ndarray, np.ndarray]:
    scene = record.draw_scene(record.Course("one", "smooth", "vlp16", motion, distance=20.0), SEED)
    store = bags.ros1_store()
    rows = [store.deserialize_ros1(m.raw, m.kind) for m in record._inertial(scene)]
    time = np.arange(len(rows)) / record.IMU_RATE
    accel = np.array([[r.linear_acceleration.x, r.linear_acceleration.y, r.linear_acceleration.z] for r in rows])
    gyro = np.array([[r.angular_velocity.x, r.angular_velocity.y, r.angular_velocity.z] for r in rows])
    return scene, time, accel, gyro


@pytest.mark.parametrize("motion", list(CARRIERS))
def test_a_drive_rests_first_and_its_imu_then_integrates_to_the_way(motion):
    scene, time, accel, gyro = inertial(motion)
    rest = time < REST
    assert np.linalg.norm(accel[rest].mean(axis=0) - [0.0, 0.0, GRAVITY]) < 4.0 * np.sqrt(3.0) * ACCEL_BIAS
    assert gyro[rest].std() < 0.02
    poses = scene.drive.poses(time)
    assert np.ptp(poses.position[rest], axis=0).max() == 0.0
    # Free of the biases, which the rest shows, dead reckoning over some seconds meets the truth at its end.
    attitude, speed, place = Rotation.from_quat(poses.quaternion), np.zeros(3), poses.position[0]
    imu = poses.position + attitude.apply(record.IMU.origin)
    bias = accel[rest].mean(axis=0) - attitude[0].inv().apply([0.0, 0.0, GRAVITY])
    force = attitude.apply(accel - bias) - [0.0, 0.0, GRAVITY]
    speed = np.cumsum(force, axis=0) / record.IMU_RATE
    place = imu[0] + np.cumsum(speed, axis=0) / record.IMU_RATE
    until = int(8.0 * record.IMU_RATE)
    assert np.linalg.norm(imu[until] - imu[0]) > 3.0
    assert np.linalg.norm(place[until] - imu[until]) < 0.15
    turn = (attitude[rest.argmin() - 1].inv() * attitude[until]).magnitude()
    felt = np.linalg.norm(np.sum(gyro[rest.argmin() : until] - gyro[rest].mean(axis=0), axis=0)) / record.IMU_RATE
    assert felt == pytest.approx(turn, abs=0.05)


@pytest.mark.parametrize("name", ["walls-joints", "motion-walk", "motion-b2", "dust-half", "beams-06", "walls-sprayed"])
def test_a_course_is_what_it_was_when_programs_were_scored(name, tmp_path):
    config = sets.ArenaConfig(tmp_path, courses=(name,), distance=20.0)
    scene = record.draw_scene((course := sets.plan_arena(config)[0]), sets.course_seed(config, course))
    _, time, wheels = record._odometry(scene)
    bore, poses = scene.drive.bore, scene.drive.poses(time)
    record.write_truth(scene, tmp_path)
    node = bore.section.rough(np.arange(20.0, 90.0, 0.37))
    ray = np.random.default_rng(4).normal(size=(60_000, 3))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    wall = Hits(*(np.full((len(ray), *more), 3.0, np.float32) for more in ((), (), (), (3,))))
    dust = record.draw_dust(np.random.default_rng(5), 0.5)(np.random.default_rng(6), ray, wall)
    start, truth = poses.position[0], np.loadtxt(tmp_path / "lidar.tum")
    way = [poses.position - start, poses.quaternion, wheels.position, wheels.quaternion]
    told = {"way": np.column_stack(way), "start": start, "walls": node.ravel(), "truth": truth[:, 1:4].ravel()}
    told |= {"knots": np.array([*scene.drive.knots, scene.drive.duration, bore.alignment.length])}
    told |= {"axis": np.loadtxt(tmp_path / "axis.csv", delimiter=",", skiprows=1).ravel()}
    told |= {"dust": np.column_stack(list(vars(dust).values())).ravel(), "times": truth[:, 0]}
    told |= {"course": json.dumps(json.loads((tmp_path / "course.json").read_text()))}
    told |= {"calibration": json.dumps(record.calibration(scene))}
    told |= {"things": json.dumps([one.describe() for one in bore.things])}
    check(VALUES, f"course {name}", told, rel=1e-6)


def test_wheels_have_one_sign_a_robot_and_the_scale_of_real_corridors():
    station = np.linspace(0.0, 20_000.0, 40_001)
    still = Poses(np.zeros((len(station), 3)), np.tile([0.0, 0.0, 0.0, 1.0], (len(station), 1)))
    errors, signs = [], set()
    for seed in range(8):
        position, _ = measure_wheels(np.random.default_rng(seed), station, still)
        steps = np.linalg.norm(np.diff(position, axis=0), axis=1).reshape(-1, 40).sum(axis=1) / 20.0 - 1.0
        signs.add(np.sign(np.median(steps)))
        errors.append(np.median(np.sign(steps)) * steps)
    assert np.mean(errors) == pytest.approx(0.022, abs=3.0 * 0.006 / np.sqrt(8 * 1000))
    assert signs == {-1.0, 1.0}
    assert np.std(errors) == pytest.approx(0.006, rel=0.05)


def test_dust_hides_walls_and_stands_still_before_the_sensor():
    rng = np.random.default_rng(0)
    ray = rng.standard_normal((20_000, 3)) * [1.0, 1.0, 0.2]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    far = Hits(np.full(len(ray), 9.0, np.float32), np.ones(len(ray), np.float32), np.zeros(len(ray), np.uint8),
               np.zeros((len(ray), 3), np.float32))  # fmt: skip
    fractions = []
    for density in (0.1, 1.0):
        dust = record.draw_dust(np.random.default_rng(1), density)
        once, again = (dust(np.random.default_rng(k), ray, far).distance for k in (2, 3))
        assert once.max() == 9.0
        assert once.min() > 0.3
        both = (once < 9.0) & (again < 9.0)
        assert np.median(np.abs(once - again)[both]) < 0.5
        fractions.append((once < 9.0).mean())
    assert fractions[1] > fractions[0] > 0.05
    assert fractions[1] > 0.4


def test_walls_differ_by_walls_alone():
    bores = {name: draw_walls(np.random.SeedSequence(3), name, 30.0) for name in ("smooth", "joints", "pockets")}
    assert len(bores["smooth"].furniture.joints) == 0
    np.testing.assert_array_equal(bores["joints"].furniture.joints, bores["pockets"].furniture.joints)
    station = np.linspace(2.0, 28.0, 600)
    rough = {name: bore.section.rough(station)[:, 40, 0] for name, bore in bores.items()}
    np.testing.assert_array_equal(rough["joints"], rough["pockets"])
    steps = rough["joints"] - rough["smooth"]
    assert steps.std() == pytest.approx(0.004, rel=0.5)
    assert len(np.unique(steps.round(9))) == len(np.unique(np.searchsorted(bores["joints"].furniture.joints, station)))
    np.testing.assert_array_equal(bores["smooth"].alignment.frames(station).position,
                                  bores["pockets"].alignment.frames(station).position)  # fmt: skip


def test_a_set_is_planned_from_its_seed_and_a_secret_hides_it():
    config = sets.ArenaConfig(Path("o"))
    plan = sets.plan_arena(config)
    assert len(plan) == len({one.name for one in plan}) == 18
    states = [sets.course_seed(config, one).entropy for one in plan]
    assert len(set(states)) == 1
    secret = [sets.course_seed(replace(config, secret=5), one).entropy for one in plan]
    assert len(set(secret)) == len(plan)
    assert secret != [sets.course_seed(replace(config, secret=6), one).entropy for one in plan]


@pytest.mark.slow
def test_a_set_is_resumed_and_a_program_keeps_to_furnished_walls_and_loses_smooth_ones_and_dust(tmp_path, capsys):
    expected = ["--courses", "walls-smooth", "walls-furnished", "dust-lock", "--distance", "12", "--jobs", "2"]
    assert command(["arena", "--out", str(tmp_path / "set"), *expected]) == 0
    assert command(["arena", "--out", str(tmp_path / "set"), *expected]) == 0
    assert capsys.readouterr().err.count("there already") == 3
    assert command(["arena", "--out", str(tmp_path / "set"), *expected, "--seed", "1"]) == 2
    assert "was recorded with other settings" in capsys.readouterr().err
    run = ["board", "--programs", "evalio-mad", "--sets", str(tmp_path / "set"), "--out", str(tmp_path / "mad")]
    assert command(run) == 0
    rows = json.loads((tmp_path / "mad" / "board.json").read_text())["rows"]
    drift = {row["recording"]: row["drift"] for row in rows}
    assert drift["walls-furnished"] < 1.0
    assert drift["walls-smooth"] > 50.0
    assert drift["dust-lock"] > 50.0
