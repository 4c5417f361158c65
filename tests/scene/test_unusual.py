"""Well-formed inputs as other people's programs write them: each is read as what it is, or refused in one sentence."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from scene.errors import RecordingError
from scene.poses.imu import read_inertial
from scene.poses.trajectory import load_tum
from scene.reading.cloudfile import read_cloud
from scene.reading.recording import Recording
from tests.scene.bags import write_imu_bag
from tests.scene.conventions import OFFSET, RAYS, sweeps, write_convention
from tests.scene.files import CLOUDS
from tests.scene.fits import keep
from tests.scene.messages import PLAIN, POINTCLOUD2, pointcloud2, write_bag1
from tests.scene.test_odd_inputs import WKT

pytestmark = pytest.mark.usefixtures("silent")
SINCE = 1e-9 * OFFSET
HEADERS = np.array([start for start, _, _ in sweeps(40)])


@dataclass(frozen=True)
class Sweeps:
    """A driver's way to publish sweeps: name, type and values of the times of sweep `k`, its header, and its points."""

    name: str = "time"
    kind: str = "f8"
    times: Callable[[int, float], np.ndarray] = lambda k, start: SINCE
    header: Callable[[int, float], float] = lambda k, start: start
    change: Callable[[np.ndarray], np.ndarray] = lambda points: points
    axes: str = "xyz"
    said: str = ""
    layout: dict[str, Any] = field(default_factory=dict)
    count: int = 12


def seconds(values: Callable[[int], np.ndarray], **how: Any) -> Sweeps:
    return Sweeps(times=lambda k, start: values(k), **how)


def gaps(points: np.ndarray) -> np.ndarray:
    points = points.copy()
    points[::7], points[3::9] = 0.0, np.nan
    return points


HOUR = 3599.5  # s of the hour at the first sweep
RECORDINGS = {
    "ns in a field whose name says so": Sweeps("time_offset_ns", "u4", lambda k, s: OFFSET, said="ns after the stamp"),
    "µs, 16 sweeps a second of one": Sweeps("t_us", "i4", lambda k, s: OFFSET // 1000, said="µs after the stamp"),
    "negative µs before the end": Sweeps(
        "offset_time", "i4", lambda k, s: (OFFSET - OFFSET[-1]) // 1000, lambda k, s: s + SINCE[-1],
        said="µs before the stamp"),
    "a stamp in ns, in capitals": Sweeps("TIMESTAMP", "f8", lambda k, s: 1e9 * (s + SINCE), said="absolute, ns"),
    "axes in capitals": Sweeps(axes="XYZ", said="s after the stamp"),
    "double coordinates": Sweeps(layout={"xyz": "f8"}),
    "organised, zeros and NaN": Sweeps(change=gaps, layout={"height": 16}),
    "rows with padding": Sweeps(layout={"height": 4, "row_padding": 24}),
    "milliseconds in float": Sweeps("timestamp", "f4", lambda k, s: 1e3 * SINCE, said="ms after the stamp"),
    "week of GPS": seconds(lambda k: 2e5 + 0.1 * k + SINCE, said="by another clock, s"),
    "µs of the hour, which begins anew": seconds(
        lambda k: 1e6 * ((HOUR + 0.1 * k + SINCE) % 3600), said="µs; sweeps of 0.098 s", count=40),
    "a sensor that starts again": seconds(
        lambda k: (100.0 if k < 20 else 3.0) + 0.1 * k + SINCE, said="and otherwise 1 times", count=40),
    "clock that runs away from the headers": seconds(
        lambda k: 500.0 + 0.1003 * k + SINCE, said="by another clock, s", count=40),
    "headers that come late by chance": Sweeps(
        times=lambda k, s: 500.0 + 0.1 * k + SINCE, header=lambda k, s: s + 0.04 * (k % 7 == 3), count=40,
        said="by another clock, s"),
    "time of a simulation, from zero": Sweeps(
        header=lambda k, s: 0.1 * k, said="s after the stamp"),
    "a few times that are no number": Sweeps(times=lambda k, s: np.where(np.arange(RAYS) % 50 == 7, np.nan, SINCE)),
    "no stamps at all": Sweeps(header=lambda k, s: 0.0, said="the time of recording stands for them"),
    "the first sweeps without times": Sweeps(times=lambda k, s: 0.0 * SINCE if k < 3 else SINCE, said="s after"),
}  # fmt: skip


def write_sweeps(path: Path, how: Sweeps) -> Path:
    xyz, layout = how.layout.get("xyz", "f4"), {k: v for k, v in how.layout.items() if k != "xyz"}
    size = int(xyz[1])
    fields = [(axis, xyz, size * i) for i, axis in enumerate(how.axes)] + [(how.name, how.kind, 3 * size + 4)]
    rows = []
    for k, (start, points, _) in enumerate(sweeps(how.count)):
        columns = dict(zip(how.axes, how.change(points).T, strict=True)) | {how.name: how.times(k, start)}
        rows.append((start + 0.1, pointcloud2(how.header(k, start), fields, 3 * size + 12, columns, **layout)))
    return write_bag1(path, {"/points": rows})


@pytest.mark.parametrize("name", RECORDINGS)
def test_sweeps_of_another_driver_are_read_as_they_were_measured(tmp_path, name):
    how = RECORDINGS[name]
    with Recording(write_sweeps(tmp_path / "a.bag", how)) as recording:
        scans = list(recording.scans())
    assert how.said in recording.facts["point_times"]
    keep([recording.facts, [scan.stamp - HEADERS[0] for scan in scans], [scan.times for scan in scans]])
    assert len(scans) == how.count
    shift = [scan.stamp - start for scan, (start, _, _) in zip(scans, sweeps(how.count), strict=True)]
    assert np.ptp(shift) < 0.02  # one clock for all of them, whatever its beginning
    for scan in scans[4::5]:
        assert scan.times.max() == pytest.approx(SINCE[-1], rel=0.02)
        assert len(scan.points) > 0.7 * RAYS
        assert np.isfinite(scan.points).all()
        assert (scan.points != 0).any(axis=1).all()


def packed(path: Path, how: Any) -> Path:
    """A bag whose chunks are compressed."""
    writer = Writer(path)
    writer.set_compression(how)
    whole = write_convention(path.with_name("plain.bag"))
    with writer, Recording(whole) as plain:
        store = get_typestore(Stores.ROS1_NOETIC)
        topic = writer.add_connection("/points", POINTCLOUD2, typestore=store)
        for _, at, raw in plain.reader.messages():
            writer.write(topic, at, raw)
    return path


def packed2(path: Path, plugin: StoragePlugin, mode: CompressionMode) -> Path:
    """A ROS 2 folder with compressed messages, chunks or files."""
    whole, store = write_convention(path.with_name("plain.bag"), container="mcap"), get_typestore(Stores.ROS2_HUMBLE)
    writer = Writer2(path, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer, Recording(whole) as plain:
        topic = writer.add_connection("/points", POINTCLOUD2, typestore=store)
        for _, at, raw in plain.reader.messages():
            writer.write(topic, at, raw)
    return path


def nested(folder: Path) -> Path:
    write_convention(folder / "outer" / "inner.bag", container="mcap", bags=2)
    return folder / "outer"


def bare(folder: Path) -> Path:
    """The files of a split ROS 2 recording whose metadata were lost."""
    path = write_convention(folder / "a.bag", container="mcap", bags=3)
    (path / "metadata.yaml").unlink()
    return path


CONTAINERS = {
    "bz2": lambda folder: packed(folder / "a.bag", Writer.CompressionFormat.BZ2),
    "lz4": lambda folder: packed(folder / "a.bag", Writer.CompressionFormat.LZ4),
    "zstd in chunks of an MCAP": lambda folder: packed2(folder / "a", StoragePlugin.MCAP, CompressionMode.STORAGE),
    "zstd by message of a db3": lambda folder: packed2(folder / "a", StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    "zstd by file of a db3": lambda folder: packed2(folder / "a", StoragePlugin.SQLITE3, CompressionMode.FILE),
    "a folder in a folder": nested,
    "a split recording without metadata": bare,
    "a sweep in two messages": lambda folder: write_convention(folder / "a.bag", chunks=2),
    "a sweep in ten messages": lambda folder: write_convention(folder / "a.bag", chunks=10, point_times="epoch"),
    "sweeps that never came": lambda folder: write_convention(folder / "a.bag", count=40, missing=0.2),
}


@pytest.mark.parametrize("name", CONTAINERS)
def test_a_container_is_read_whole(tmp_path, name):
    path = CONTAINERS[name](tmp_path)
    with Recording(path) as recording:
        scans = list(recording.scans())
    if "never" not in name:
        assert len(scans) == 12
        assert {scan.points.tobytes() for scan in scans} == {points.tobytes() for _, points, _ in sweeps(12)}
        np.testing.assert_allclose([scan.times for scan in scans], [SINCE] * 12, atol=2e-4)
    assert np.all(np.diff([scan.stamp for scan in scans]) > 0)
    assert sum(len(scan.points) for scan in scans) >= (25 if "never" in name else 12) * RAYS


XYZ = np.round(np.random.default_rng(0).uniform(1, 9, (400, 3)) + np.array([390_000.0, 5_820_000.0, 40.0]), 3)
ENGLISH = "".join(f"{x:.3f} {y:.3f} {z:.3f}\n" for x, y, z in XYZ)
GERMAN = ENGLISH.replace(".", ",")
ROWS = [line.split() for line in ENGLISH.splitlines()]


def ply(types: str, names: str, form: str = "binary_little_endian") -> bytes:
    order = ">" if "big" in form else "<"
    head = f"ply\nformat {form} 1.0\nelement vertex {len(XYZ)}\nproperty uchar intensity\n"
    head += "".join(f"property {types} {name}\n" for name in names) + "end_header\n"
    rows = np.zeros(len(XYZ), [("i", "u1"), *((name, order + "f8") for name in "xyz")])
    rows["x"], rows["y"], rows["z"] = XYZ.T
    return head.encode() + rows.tobytes()


def pts(scans: int) -> str:
    parts = np.array_split(np.arange(len(ROWS)), scans)
    rows = ["".join(" ".join([*ROWS[k], "-1200 1 2 3"]) + "\n" for k in part) for part in parts]
    return "".join(f"{len(part)}\n{row}" for part, row in zip(parts, rows, strict=True))


CLOUD_FILES: dict[str, tuple[str, str | bytes]] = {
    "decimal commas apart by blanks": ("a.xyz", GERMAN),
    "decimal commas and semicolons": ("a.csv", "X;Y;Z\n" + GERMAN.replace(" ", ";")),
    "decimal commas and tabs": ("a.txt", "Rechtswert\tHochwert\tHöhe\n" + GERMAN.replace(" ", "\t")),
    "as CloudCompare writes it": ("a.asc", "//X Y Z Intensity\n" + ENGLISH.replace("\n", " 0.7\n")),
    "names in quotes, an index first": ("a.csv", '"id","x","y","z"\n' + "".join(
        f"{k},{','.join(row)}\n" for k, row in enumerate(ROWS))),
    "lines of Windows": ("a.xyz", ENGLISH.replace("\n", "\r\n")),
    "a mark before the text": ("a.xyz", b"\xef\xbb\xbf" + ENGLISH.encode()),
    "a comment first": ("a.csv", "# exported\n" + ENGLISH.replace(" ", ",")),
    "exponents": ("a.xyz", "".join(f"{x:.9e} {y:.9e} {z:.9e}\n" for x, y, z in XYZ)),
    "a PTS of three scans": ("a.pts", pts(3)),
    "a PTS without its count": ("a.pts", pts(1).partition("\n")[2]),
    "a PLY of doubles, highest byte first": ("a.ply", ply("double", "xyz", "binary_big_endian")),
    "a PLY with axes in capitals": ("a.ply", ply("double", "XYZ")),
}  # fmt: skip


@pytest.mark.parametrize("name", CLOUD_FILES)
def test_a_cloud_of_another_program_is_read_where_it_lies(tmp_path, name, small_blocks):
    ending, content = CLOUD_FILES[name]
    (tmp_path / ending).write_bytes(content if isinstance(content, bytes) else content.encode())
    (tmp_path / "a.prj").write_text(WKT)
    cloud, facts = read_cloud(tmp_path / ending, 1e-3)
    found = np.round(cloud.points + cloud.origin, 3)
    np.testing.assert_allclose(found[np.lexsort(found.T)], XYZ[np.lexsort(XYZ.T)], atol=2e-3)
    keep(facts)
    assert facts["crs"] == WKT  # of the file beside it


TURN = Rotation.from_euler("zyx", np.column_stack([0.1 * np.arange(20), np.full((20, 2), 0.02)])).as_quat()
AT = 1_700_000_000 + 0.5 * np.arange(20)
PATH = np.column_stack([np.arange(20.0), np.zeros((20, 2))])


def lines(scale: float = 1.0, apart: str = " ", head: str = "", order: str = "xyzw", more: str = "") -> str:
    rows = []
    for t, p, q in zip(AT, PATH, TURN, strict=True):
        numbers = [*(f"{v:.6f}" for v in p), *(f"{q['xyzw'.index(axis)]:.9f}" for axis in order)]
        rows.append(apart.join([f"{t:.6f}" if scale == 1 else f"{round(t * scale)}", *numbers]) + more)
    return head + "\n".join(rows) + "\n"


EUROC = "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_x\n"
TRAJECTORIES = {
    "EuRoC": (lines(1e9, ", ", EUROC, "wxyz", ", 0.5"), "wxyz"),
    "a header of words": (lines(1, ",", "timestamp,x,y,z,qx,qy,qz,qw\n"), "xyzw"),
    "evo's comment": (lines(1, " ", "# timestamp tx ty tz qx qy qz qw\n"), "xyzw"),
    "milliseconds": (lines(1e3), None),
    "nanoseconds": (lines(1e9, "\t"), None),
    "decimal commas": (lines(1, ";").replace(".", ","), None),
    "decimal commas apart by blanks": (lines().replace(".", ","), None),
    "a comma at the end": (lines(1, ",", more=","), None),
    "Windows and a mark": ("\ufeff" + lines().replace("\n", "\r\n"), None),
}


@pytest.mark.parametrize("name", TRAJECTORIES)
def test_a_trajectory_of_another_program_is_read(tmp_path, name):
    text, order = TRAJECTORIES[name]
    (tmp_path / "a.csv").write_text(text, encoding="utf-8", newline="")
    found = load_tum(tmp_path / "a.csv")
    np.testing.assert_allclose(found.times, AT, atol=1e-5)
    np.testing.assert_allclose(found.positions, PATH)
    quaternion = found.rotations.as_quat()[:, [1, 2, 3, 0] if order == "wxyz" else [0, 1, 2, 3]]
    assert found.order == order
    np.testing.assert_allclose(np.abs(np.sum(quaternion * TURN, axis=1)), 1.0, atol=1e-6)


IMUS = {
    "g and rad/s": (1.0, 1.0, 1.0, 9.80665, None),
    "m/s² and deg/s": (180 / np.pi, 9.80665, 1.0, 9.80665, "rates in deg/s"),
    "without gravity": (1.0, 1.0, 0.0, 0.0, "force without gravity, which is left out"),
}


@pytest.mark.parametrize("name", IMUS)
def test_units_of_an_imu_are_told_by_its_size(tmp_path, name, capsys):
    rate, unit, gravity, force, said = IMUS[name]
    path = write_imu_bag(tmp_path / "a.bag", sweeps(1)[0][1], 400, lambda k: (
        [0.0, 0.0, 0.3 * rate], unit * np.array([0.1 * np.sin(k), 0.1 * np.cos(k), gravity])))  # fmt: skip
    with Recording(path) as recording:
        inertial = read_inertial(recording, "/livox/imu")
    assert inertial.rate[:, 2] == pytest.approx(0.3)
    assert np.median(inertial.force[:, 2]) == pytest.approx(force)
    assert recording.facts.get("imu_units") == (f"/livox/imu: {said}" if said else None)
    assert (said or "") in capsys.readouterr().out


SPARSE = {"one": XYZ[:1], "NaN": np.full((30, 3), np.nan), "same": np.tile(XYZ[:1], (30, 1))}


@pytest.mark.parametrize("name", [*CLOUDS, "a.bag", "a.pts"])
@pytest.mark.parametrize("kind", SPARSE)
def test_a_sparse_input_of_any_format_is_read_or_refused_without_a_warning(tmp_path, name, kind):
    path, points = tmp_path / name, SPARSE[kind]
    with suppress(RecordingError):
        if name == "a.bag":
            columns = dict(zip("xyz", (points - XYZ[0]).T, strict=True))
            write_bag1(path, {"/points": [(5.0 + k, pointcloud2(5.0, PLAIN, 12, columns)) for k in range(3)]})
            with Recording(path) as recording:
                recording.peek()
                list(recording.scans())
        elif name == "a.pts":
            path.write_text(pts(2) if kind == "same" else "3\n")
            read_cloud(path, 0.01)
        else:
            read_cloud(
                CLOUDS[name](path, np.nan_to_num(points) if name.endswith(("las", "laz", "e57")) else points), 0.01
            )
