"""One survey from beginning to end: draw the bore, walk through it, write what was seen."""

from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from rich.console import Console
from rich.progress import Progress
from rosbags.rosbag1 import Writer

from scene.survey import avia, imu, messages, write
from scene.survey.bore import draw_bore
from scene.survey.carrier import Walk, draw_walk, rotate
from scene.survey.cast import Caster
from scene.survey.config import SurveyConfig
from scene.survey.truth import describe

TRUTH_RATE = 200.0  # Hz, rows of groundtruth.tum
_SCANS_AT_ONCE = 10  # scans cast together: large enough for numpy, small enough for the memory


@dataclass(frozen=True)
class Scan:
    """One message of the LiDAR.

    Attributes:
        begin: Time of its first point, ns since the start of the survey.
        points: Array of `messages.POINT`. A pulse without return keeps its time and line and lies at (0, 0, 0).
        valid: Which pulses returned.
        placed: Points in the survey frame by the true poses, m; meaningless where not `valid`.
    """

    begin: int
    points: np.ndarray
    valid: Bool[np.ndarray, "n"]
    placed: Float[np.ndarray, "n 3"]


def scans(rng: np.random.Generator, walk: Walk, caster: Caster, point_rate: int) -> Iterator[Scan]:
    """Scans in order of time; every point is cast from the pose at its own time."""
    phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    offset = avia.point_times(point_rate)
    n, n_scans = len(offset), round(walk.duration / avia.SCAN_PERIOD)
    for first in range(0, n_scans, _SCANS_AT_ONCE):
        count = min(_SCANS_AT_ONCE, n_scans - first)
        time = (avia.SCAN_PERIOD * (first + np.arange(count))[:, None] + 1e-9 * offset).ravel()
        begin = avia.SCAN_PERIOD * first
        ray = avia.directions(time, phase)
        poses = walk.poses_between(begin, time)
        heading = rotate(poses.quaternion, ray)
        station = float(walk.station(np.array([begin]))[0])
        distance, cosine, part = caster.cast(station, poses.position, heading)

        valid = avia.returned(rng, distance, cosine, part)
        # Rounded once, here: the cloud and the bag then hold the same point.
        seen = np.where(valid, distance + avia.RANGE_SIGMA * rng.standard_normal(len(time), np.float32), 0.0)
        points = np.zeros(len(time), messages.POINT)
        points["offset_time"] = np.tile(offset, count)
        points["x"], points["y"], points["z"] = (seen[:, None] * ray).T
        points["reflectivity"] = np.where(valid, avia.reflectivity(rng, cosine, part), 0)
        points["tag"] = np.where(valid & (rng.random(len(time), np.float32) < avia.SECOND_RETURN), 0x10, 0)
        points["line"] = np.arange(len(time)) % avia.N_LINES
        placed = poses.position + seen[:, None] * heading
        for k in range(count):
            of = slice(k * n, (k + 1) * n)
            yield Scan(round(1e8) * (first + k), points[of], valid[of], placed[of])


def simulate(config: SurveyConfig, console: Console) -> str:
    """Write the survey of `config`; return a line that says what was written."""
    root = np.random.SeedSequence(config.seed)
    of_bore, of_walk, of_lidar, of_avia_imu, of_mti, of_prism = root.spawn(6)
    bore = draw_bore(of_bore, config.length)
    mesh = bore.mesh()
    walk = draw_walk(np.random.default_rng(of_walk), bore, config.speed, avia.SCAN_PERIOD)
    config.out.mkdir(parents=True, exist_ok=True)

    write.write_mesh(config.out / "truth.ply", mesh)
    write.write_json(config.out / "truth.json", describe(bore, config))
    time = np.arange(round(walk.duration * TRUTH_RATE) + 1) / TRUTH_RATE
    poses = walk.poses(time)
    write.write_tum(config.out / "groundtruth.tum", time, poses.position, poses.quaternion)
    write.write_tum(config.out / "prism.tum", *imu.measure_prism(np.random.default_rng(of_prism), walk), None)

    inertial = _inertial(walk, np.random.default_rng(of_avia_imu), np.random.default_rng(of_mti))
    lidar = scans(np.random.default_rng(of_lidar), walk, Caster(mesh), config.point_rate)
    n_scans = round(walk.duration / avia.SCAN_PERIOD)
    with Progress(console=console, transient=True) as progress:
        returns = _record(config, progress.track(lidar, total=n_scans, description="survey"), inertial)
    return f"{config.out}: {config.length:g} m, {n_scans} scans, {returns} returns"


def _inertial(walk: Walk, of_avia: np.random.Generator, of_mti: np.random.Generator) -> list[tuple[int, str, bytes]]:
    """Messages of both IMUs as time in ns, topic and bytes, in order of time."""
    inner = imu.measure_inertial(of_avia, walk, 200.0, imu.AVIA_LIDAR)
    outer = imu.measure_inertial(of_mti, walk, 100.0, imu.MTI_LIDAR)
    out = []
    for topic, frame, sample, quaternion, unit in (
        # The Livox driver publishes its accelerometer in g and no orientation.
        ("/livox/imu", "livox_frame", inner, None, imu.GRAVITY),
        ("/imu/data", "imu_link", outer, outer.quaternion, 1.0),
    ):
        at = np.rint(sample.time * 1e9).astype(np.int64)
        raw = messages.imu_messages(frame, at, quaternion, sample.gyro, sample.accel / unit)
        out += [(int(t), topic, m) for t, m in zip(at, raw, strict=True)]
    return sorted(out, key=lambda m: m[:2])


def _record(config: SurveyConfig, lidar: Iterable[Scan], inertial: list[tuple[int, str, bytes]]) -> int:
    """Write the bag, and the clouds if asked; return the number of returns.

    A message is recorded when it is complete: a scan one period after its stamp.
    """
    returns, waiting = 0, iter([*inertial, (2**62, "", b"")])
    with ExitStack() as stack:
        bag = stack.enter_context(Writer(stack.enter_context(write.replacing(config.out / "survey.bag"))))
        topics = {
            name: bag.add_connection(name, kind, msgdef=text, md5sum=md5)
            for name, kind, text, md5 in (
                ("/livox/lidar", messages.CUSTOM_TYPE, messages.CUSTOM_DEFINITION, messages.CUSTOM_MD5),
                ("/livox/imu", messages.IMU_TYPE, messages.IMU_DEFINITION, messages.IMU_MD5),
                ("/imu/data", messages.IMU_TYPE, messages.IMU_DEFINITION, messages.IMU_MD5),
            )
        }
        cloud = stack.enter_context(_cloud(config.out, stack)) if config.cloud else None
        at, topic, raw = next(waiting)
        for seq, scan in enumerate(lidar):
            end = scan.begin + round(avia.SCAN_PERIOD * 1e9)
            while at < end:
                bag.write(topics[topic], messages.stamp(at), raw)
                at, topic, raw = next(waiting)
            raw_scan = messages.custom_message(seq, scan.begin, scan.points)
            bag.write(topics["/livox/lidar"], messages.stamp(end), raw_scan)
            returns += int(scan.valid.sum())
            if cloud:
                kept = np.empty(int(scan.valid.sum()), write.CLOUD_POINT)
                kept["x"], kept["y"], kept["z"] = scan.placed[scan.valid].T
                kept["intensity"] = scan.points["reflectivity"][scan.valid]
                cloud.add(kept)
    return returns


def _cloud(folder: Path, stack: ExitStack) -> write.CloudWriter:
    ply, pcd = (stack.enter_context(write.replacing(folder / name)) for name in ("cloud.ply", "cloud.pcd"))
    return write.CloudWriter(ply, pcd)
