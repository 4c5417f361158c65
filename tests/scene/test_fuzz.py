"""Damaged inputs of every format: one sentence that names the file, or a sane result; never anything else.

Seeded, so that a case that fails can be run again: the test's name carries format, kind of damage and seed.
"""

import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import laspy
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

from scene.errors import FitError, RecordingError
from scene.fitting.rings import fit_rings
from scene.poses.calibration import load_calibration
from scene.poses.imu import read_inertial
from scene.poses.trajectory import load_control, load_tum
from scene.reading.cloudfile import read_cloud
from scene.reading.recording import Recording
from scene.reading.ringsurvey import read_ring_survey
from tests.scene.bags import write_bag, write_imu_bag
from tests.scene.files import CLOUDS, RING_HEADER, ring_rows, write_las, write_xlsx
from tests.scene.messages import LIVOX2, OUSTER, POINTCLOUD2, livox_cdr, pointcloud2, write_bag1, write_bag2, write_mcap

pytestmark = pytest.mark.usefixtures("silent")
CASES = 60
POINTS = np.random.default_rng(0).uniform(-3, 3, (200, 3)).astype(np.float32) * [10, 1, 1]


def cloud_message(stamp: float, cdr: bool) -> bytes:
    columns = dict(zip("xyz", POINTS.T, strict=True), t=np.arange(200, dtype="u4") * 1000)
    return pointcloud2(stamp, OUSTER, 32, columns, cdr=cdr)


def ros1(folder: Path) -> Path:
    return write_bag1(folder / "a.bag", {"/points": [(5.0 + k, cloud_message(5.0 + k, False)) for k in range(3)]})


def livox1(folder: Path) -> Path:
    return write_bag(folder / "livox.bag", [(5.0 + k, POINTS) for k in range(3)])


def storage(folder: Path, plugin: StoragePlugin, topic: str, kind: str, message: Callable[[float], bytes]) -> Path:
    bag = write_bag2(folder / "bag", plugin, topic, kind, [(5.0 + k, message(5.0 + k)) for k in range(3)])
    return next(file for file in bag.iterdir() if file.suffix in (".db3", ".mcap"))


def db3(folder: Path) -> Path:
    return storage(folder, StoragePlugin.SQLITE3, "/points", POINTCLOUD2, lambda stamp: cloud_message(stamp, True))


def mcap(folder: Path) -> Path:
    return storage(folder, StoragePlugin.MCAP, "/points", POINTCLOUD2, lambda stamp: cloud_message(stamp, True))


def livox2(folder: Path) -> Path:
    return storage(folder, StoragePlugin.SQLITE3, "/livox/lidar", LIVOX2, lambda stamp: livox_cdr(stamp, POINTS))


def metadata(folder: Path) -> Path:
    return db3(folder).with_name("metadata.yaml")


def kitti(folder: Path) -> Path:
    np.column_stack([POINTS, POINTS[:, 0]]).astype("<f4").tofile(folder / "1317376510.25.bin")
    return folder / "1317376510.25.bin"


def times(folder: Path) -> Path:
    for k in range(5):
        shutil.copy(kitti(folder), folder / f"{k}.bin")
    (folder / "1317376510.25.bin").unlink()
    (folder / "times.txt").write_text("\n".join(f"{0.1 * k:.3f}" for k in range(5)))
    return folder / "times.txt"


def xlsx(folder: Path) -> Path:
    return write_xlsx(folder / "s.xlsx", ring_rows())


def csv(folder: Path) -> Path:
    lines = [",".join(RING_HEADER), *(",".join(map(str, row)) for row in ring_rows())]
    (folder / "s.csv").write_text("\n".join(lines))
    return folder / "s.csv"


def read_file(path: Path) -> None:
    cloud, _ = read_cloud(path, 0.05)
    assert len(cloud.points)
    assert np.isfinite(cloud.points).all()


def read_recording(path: Path) -> None:
    with Recording(path) as recording:
        last = -np.inf
        for scan in recording.scans():
            assert len(scan.points) == len(scan.times)
            assert np.isfinite(scan.points).all()
            assert (scan.times >= 0).all()
            assert (np.diff(scan.times) >= 0).all()
            assert scan.stamp > last
            last = scan.stamp


def read_rings(path: Path) -> None:
    fit = fit_rings(read_ring_survey(path))
    assert np.isfinite(fit.radius).all()
    assert np.isfinite(fit.centre).all()


def imu_bag(folder: Path) -> Path:
    return write_imu_bag(folder / "imu.bag", POINTS, 60)


def read_imu(path: Path) -> None:
    with Recording(path) as recording:
        inertial = read_inertial(recording, "/livox/imu")
    if inertial is not None:
        assert (np.diff(inertial.times) > 0).all()
        assert np.isfinite(inertial.rate).all()
        assert np.isfinite(inertial.force).all()


def ros1_mcap(folder: Path) -> Path:
    messages = [(5.0 + k, cloud_message(5.0 + k, False)) for k in range(3)]
    return write_mcap(folder / "a.mcap", "ros1", ("ros1msg", "ros1"), "sensor_msgs/PointCloud2", messages)


def feet(folder: Path) -> Path:
    wkt = b'PROJCS["a",GEOGCS["b",UNIT["degree",0.0174]],UNIT["US survey foot",0.304800609601219]]\0'
    return write_las(folder / "feet.las", POINTS, laspy.VLR("LASF_Projection", 2112, "", wkt))


def tum(folder: Path) -> Path:
    rows = np.column_stack([np.arange(20.0), np.arange(20.0), np.zeros((20, 5)), np.ones(20)])
    np.savetxt(folder / "poses.tum", rows, fmt="%.6f")
    return folder / "poses.tum"


def calibration(folder: Path) -> Path:
    (folder / "c.yaml").write_text(
        "prism: [0.1, -0.3, 0.3]\nimu:\n  /imu/data:\n    rotation: [[0.0, 1.0, 0], [-1, 0, 0], [0, 0, 1]]\n"
        "    shift: [0.05, 0, 0.02]\n"
    )
    return folder / "c.yaml"


def read_poses(path: Path) -> None:
    trajectory = load_tum(path)
    assert (np.diff(trajectory.times) > 0).all()
    assert np.isfinite(trajectory.at(trajectory.times)[0]).all()


def read_control(path: Path) -> None:
    control = load_control(path)
    assert (np.diff(control.times) > 0).all()
    assert np.isfinite(control.positions).all()


def read_calibration(path: Path) -> None:
    for mount in load_calibration(path).imu.values():
        np.testing.assert_allclose(mount.rotation @ mount.rotation.T, np.eye(3), atol=1e-9)
        assert np.isfinite(mount.shift).all()


# Name: what writes a whole input and returns the file to damage, and what reads it, given that file.
READERS: dict[str, tuple[Callable[[Path], Path], Callable[[Path], None]]] = {
    **{name: ((lambda n: lambda folder: CLOUDS[n](folder / n, POINTS))(name), read_file) for name in CLOUDS},
    **{write.__name__: (write, read_recording) for write in (ros1, livox1, db3, mcap, livox2, ros1_mcap)},
    "feet": (feet, read_file),
    "imu": (imu_bag, read_imu),
    "tum": (tum, read_poses),
    "control": (tum, read_control),
    "calibration": (calibration, read_calibration),
    **{write.__name__: (write, lambda path: read_recording(path.parent)) for write in (metadata, kitti, times)},
    **{write.__name__: (write, read_rings) for write in (xlsx, csv)},
}


def truncated(raw: bytes, rng: random.Random) -> Iterator[bytes]:
    for _ in range(CASES // 3):
        yield raw[: rng.randrange(len(raw))]


def flipped(raw: bytes, rng: random.Random) -> Iterator[bytes]:
    """Half of the damage falls on the first 512 bytes or the last, where headers and indices are."""
    for case in range(CASES):
        damaged = bytearray(raw)
        for _ in range(rng.choice([1, 1, 4])):
            place = rng.randrange(len(raw))
            if case % 4 < 2:
                place = rng.randrange(min(512, len(raw))) * (1 if case % 4 else -1)
            damaged[place] = rng.randrange(256)
        yield bytes(damaged)


def replaced(raw: bytes, rng: random.Random) -> Iterator[bytes]:
    yield b""
    yield bytes(len(raw))
    yield rng.randbytes(len(raw))
    yield raw[:64] + rng.randbytes(max(len(raw) - 64, 0))
    yield raw + raw
    for count in (b"\xff" * 4, b"\xff" * 8, b"\x7f" + b"\xff" * 7):
        for _ in range(5):
            place = rng.randrange(min(len(raw), 600))
            yield raw[:place] + count + raw[place + len(count) :]


def refusal(read: Callable[[Path], None], path: Path) -> str | None:
    """The sentence about a file, `None` where it was read."""
    try:
        read(path)
    except (RecordingError, FitError) as error:
        return str(error)
    return None


@pytest.mark.parametrize("damage", [truncated, flipped, replaced], ids=lambda damage: damage.__name__)
@pytest.mark.parametrize("name", READERS)
@pytest.mark.timeout(60)
def test_a_damaged_input_is_refused_in_one_sentence_or_read_sanely(tmp_path, name, damage):
    write, read = READERS[name]
    path = write(tmp_path)
    read(path)
    raw = path.read_bytes()
    for damaged in damage(raw, random.Random(f"{name} {damage.__name__}")):
        path.write_bytes(damaged)
        said = refusal(read, path)
        if said is not None:
            assert str(tmp_path) in said
            assert "\n" not in said
            assert len(said) < 700
