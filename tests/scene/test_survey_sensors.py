"""The recordings of all three LiDARs on the rack, read back by the builder's own reader."""

from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from scene.poses.calibration import PRESETS, load_calibration
from scene.poses.imu import imu_samples
from scene.reading.recording import Recording
from scene.survey import simulate
from tests.scene.fits import keep
from tests.scene.surveyed import Cast, Trajectory, load_cast, load_trajectory, read_tum, survey

EPOCH = 1_700_000_000
SUFFIXES = ["_vlp16", "_os1"]
ROS1 = get_typestore(Stores.ROS1_NOETIC)


def make(out: Path, *more: object) -> Path:
    return survey(out, "--length", 12, "--seed", 5, "--point-rate", 24000, "--speed", 1.5, "--scan-every", 8, *more)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("rack"), "--sensors", "vlp16", "os1")


@pytest.fixture(scope="module")
def cast(folder: Path) -> Cast:
    return load_cast(folder / "truth.ply")


def errors_of(bag: Path, trajectory: Trajectory, cast: Cast, every: int) -> tuple[np.ndarray, dict]:
    """Ranges less the true ones, of each `every`-th return, as the builder reads them; and what it detected, m."""
    found = []
    with Recording(bag) as recording:
        for scan in recording.scans():
            points = scan.points[::every].astype(float)
            position, attitude = trajectory.at(scan.stamp + scan.times[::every])
            reach = np.linalg.norm(points, axis=1)
            found.append(reach - cast(position, attitude.apply(points / reach[:, None])))
        return np.concatenate(found), recording.facts


def messages(bag: Path, topic: str) -> list:
    with Reader(bag) as reader:
        chosen = [c for c in reader.connections if c.topic == topic]
        return [(t, ROS1.deserialize_ros1(raw, c.msgtype)) for c, t, raw in reader.messages(chosen)]


def records(message: object) -> np.ndarray:
    """The points of a PointCloud2 by the fields that it declares."""
    kinds = {2: "u1", 4: "<u2", 6: "<u4", 7: "<f4"}
    layout = np.dtype({
        "names": [f.name for f in message.fields], "formats": [kinds[f.datatype] for f in message.fields],
        "offsets": [f.offset for f in message.fields], "itemsize": message.point_step,
    })  # fmt: skip
    return np.frombuffer(message.data.tobytes(), layout).reshape(message.height, message.width)


@pytest.mark.parametrize(
    ("suffix", "topic", "convention"),
    [
        ("_vlp16", "/velodyne_points", "`time`, s before the stamp (its end)"),
        ("_os1", "/ouster/points", "`t`, ns after the stamp (its start)"),
    ],
)
def test_returns_lie_on_the_truth_as_the_builder_reads_them(
    folder: Path, cast: Cast, suffix: str, topic: str, convention: str
) -> None:
    trajectory = load_trajectory(folder / f"groundtruth{suffix}.tum")
    error, facts = errors_of(folder / f"survey{suffix}.bag", trajectory, cast, 5)
    assert facts["topic"] == topic
    assert facts["point_times"].startswith(convention)
    close = abs(error) < 0.12
    assert len(error) > 20_000
    assert close.mean() > 0.997
    assert 0.0185 < error[close].std() < 0.0215
    assert error[close].mean() == pytest.approx(0.0, abs=6e-4)


def test_a_survey_in_another_convention_is_the_same_drive(folder: Path, tmp_path: Path) -> None:
    words = ("--point-times", "boot", "--point-unit", "ns", "--container", "mcap", "--bags", 2, "--imu-late", 0.5)
    other = make(tmp_path, "--sensors", "vlp16", *words)
    with Recording(folder / "survey_vlp16.bag") as one, Recording(other / "survey_vlp16") as two:
        pairs = list(zip(one.scans(), two.scans(), strict=True))
        starts = [next(row[0] for row in imu_samples(recording, "/imu/data")) for recording in (one, two)]
        assert "absolute by another clock, ns" in two.facts["point_times"]
    apart = np.concatenate([b.stamp + b.times - a.stamp - a.times for a, b in pairs])
    np.testing.assert_allclose(apart, np.median(apart), atol=2e-5)
    np.testing.assert_array_equal(pairs[3][0].points, pairs[3][1].points)
    assert starts[1] - starts[0] == pytest.approx(0.5, abs=1e-6)


def test_a_velodyne_sweep_is_stamped_at_its_end(folder: Path) -> None:
    whole = messages(folder / "survey_vlp16.bag", "/velodyne_points")
    assert np.unique(np.diff([t for t, _ in whole])).tolist() == [800_000_000]
    _, message = whole[12]
    points = records(message)[0]
    keep(points, rel=1e-3)
    assert [f.name for f in message.fields] == ["x", "y", "z", "intensity", "ring", "time"]
    assert (message.height, message.point_step, message.header.frame_id) == (1, 22, "velodyne")
    end = message.header.stamp.sec - EPOCH + 1e-9 * message.header.stamp.nanosec
    assert end == pytest.approx(12 * 0.8 + 74 * 24 * 55.296e-6, abs=1e-8)
    assert (points["time"] < 0).mean() > 0.95
    assert -0.0983 < points["time"].min() < -0.095
    assert 0.0 < points["time"].max() < 0.00133
    assert sorted(np.unique(points["ring"])) == list(range(16))
    upright = np.rad2deg(np.arctan2(points["z"], np.hypot(points["x"], points["y"])))
    np.testing.assert_allclose(upright, 2.0 * points["ring"] - 15.0, atol=1e-3)
    # Clockwise, seen from above, at ten turns a second.
    ring = points[points["ring"] == 7]
    turn = np.unwrap(np.arctan2(ring["y"], ring["x"]).astype(float))
    assert np.polyfit(ring["time"], turn, 1)[0] == pytest.approx(-20.0 * np.pi, rel=1e-4)


def test_an_ouster_sweep_has_a_row_for_each_ring_and_a_time_for_each_column(folder: Path) -> None:
    _, message = messages(folder / "survey_os1.bag", "/ouster/points")[12]
    points = records(message)
    keep(points, rel=1e-3)
    names = ["x", "y", "z", "intensity", "t", "reflectivity", "ring", "ambient", "range"]
    assert [f.name for f in message.fields] == names
    assert (message.height, message.width, message.point_step) == (64, 1024, 48)
    assert message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec == pytest.approx(EPOCH + 9.6)
    assert (points["t"] == points["t"][0]).all()
    assert points["t"][0, 0] == 0
    np.testing.assert_allclose(np.diff(points["t"][0].astype(float)), 1e8 / 1024, atol=1)
    assert (points["ring"] == np.arange(64)[:, None]).all()
    reach = np.sqrt(sum(points[k].astype(float) ** 2 for k in "xyz"))
    np.testing.assert_allclose(points["range"], 1e3 * reach, atol=0.51)
    seen = reach > 0
    assert 0.4 < seen.mean() < 0.995
    upright = np.rad2deg(np.arcsin(points["z"][seen] / reach[seen]))
    np.testing.assert_allclose(
        upright, np.broadcast_to(np.linspace(22.5, -22.5, 64)[:, None], seen.shape)[seen], atol=1e-3
    )


@pytest.mark.parametrize(("suffix", "preset"), [("_vlp16", None), ("_os1", "geode-beta")])
def test_a_calibration_places_the_prism_where_the_total_station_saw_it(
    folder: Path, suffix: str, preset: str | None
) -> None:
    read = load_calibration(folder / f"calibration{suffix}.yaml")
    time, rows = read_tum(folder / "prism.tum")
    position, attitude = load_trajectory(folder / f"groundtruth{suffix}.tum").at(time)
    error = rows[:, :3] - position - attitude.apply(read.prism)
    assert error.std() == pytest.approx(0.0025, abs=8e-4)
    assert abs(error.mean(axis=0)).max() < 3.5 * 0.0025 / np.sqrt(len(time))
    if preset:
        known = PRESETS[preset]
        np.testing.assert_allclose(read.prism, known.prism, atol=1e-8)
        for topic, mount in known.imu.items():
            np.testing.assert_allclose(read.imu[topic].rotation, mount.rotation, atol=1e-8)
            np.testing.assert_allclose(read.imu[topic].shift, mount.shift, atol=1e-8)


def test_a_sensor_records_the_same_whatever_else_is_on_the_rack(folder: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(simulate, "_WORTH_A_PROCESS", 0.0)  # and in a process of its own
    fewer = make(tmp_path / "fewer", "--sensors", "os1", "vlp16")
    names = [f"{kind}{suffix}" for suffix in SUFFIXES for kind in ("survey", "groundtruth", "calibration")]
    files = [*fewer.glob("*_*.*"), fewer / "prism.tum", fewer / "truth.ply"]
    assert sorted(f.stem for f in files) == sorted([*names, "prism", "truth"])
    for file in files:
        assert file.read_bytes() == (folder / file.name).read_bytes(), file.name
    assert not (fewer / "survey.bag").exists()


PERFECT = [
    *("--errors.range-noise", "0", "--errors.range-noise-per-metre", "0", "--errors.incidence-noise", "0"),
    *("--errors.mixed-pixels", "0", "--errors.lost", "0", "--errors.prism-noise", "0", "--errors.no-weak-echoes"),
    *("--errors.no-imu-noise", "--errors.no-imu-bias"),
]


def test_with_all_errors_off_the_instruments_tell_the_truth(tmp_path: Path) -> None:
    folder = make(tmp_path / "exact", "--sensors", "vlp16", *PERFECT)
    trajectory, cast = load_trajectory(folder / "groundtruth_vlp16.tum"), load_cast(folder / "truth.ply")
    error, _ = errors_of(folder / "survey_vlp16.bag", trajectory, cast, 9)
    # Next to an edge, the rounding of a direction decides which side is hit.
    assert (abs(error) < 1e-3).mean() > 0.997
    read = messages(folder / "survey_vlp16.bag", "/imu/data")
    mount = load_calibration(folder / "calibration_vlp16.yaml").imu["/imu/data"]
    turns = Rotation.from_quat([[getattr(m.orientation, k) for k in "xyzw"] for _, m in read])
    time = EPOCH + np.arange(len(read)) / 100
    apart = trajectory.at(time)[1].inv() * turns * Rotation.from_matrix(mount.rotation)
    assert apart.magnitude().max() < 1e-5
    time, rows = read_tum(folder / "prism.tum")
    position, attitude = trajectory.at(time)
    lever = load_calibration(folder / "calibration_vlp16.yaml").prism
    assert abs(rows[:, :3] - position - attitude.apply(lever)).max() < 1e-4


def test_without_distortion_a_sweep_is_measured_at_its_stamp(tmp_path: Path) -> None:
    still = make(tmp_path / "still", "--sensors", "vlp16", *PERFECT, "--errors.no-distortion")
    moving = make(tmp_path / "moving", "--sensors", "vlp16", *PERFECT)
    cast, fraction = load_cast(still / "truth.ply"), []
    for folder in (still, moving):
        trajectory = load_trajectory(folder / "groundtruth_vlp16.tum")
        _, message = messages(folder / "survey_vlp16.bag", "/velodyne_points")[6]
        points = records(message)[0]
        at = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        position, attitude = trajectory.at(np.full(len(points), at))
        local = np.stack([points[k].astype(float) for k in "xyz"], axis=-1)
        reach = np.linalg.norm(local, axis=1)
        fraction.append((abs(reach - cast(position, attitude.apply(local / reach[:, None]))) < 2e-3).mean())
        assert points["time"].any() == (folder == moving)
    assert fraction[0] > 0.995
    assert fraction[1] < 0.5
