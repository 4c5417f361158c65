"""One recording: a drive through a bore, cast by the survey's simulator and written as bags, the truth apart."""

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from jaxtyping import Float

from benchmarks.results import write_file
from benchmarks.slam.arena import bags
from benchmarks.slam.arena.bags import FormatName, Message
from benchmarks.slam.arena.drives import REST, WHEEL_RATE, Drive, MotionName, draw_drive, measure_wheels
from benchmarks.slam.arena.walls import WallName, draw_walls
from scene.survey import carrier, messages
from scene.survey.carrier import Carried, Mount, Poses
from scene.survey.cast import Caster, Face, Hits, sweeps
from scene.survey.config import SensorErrors
from scene.survey.lidar import Lidar, Sweep, avia, os1, vlp16
from scene.survey.mesh import Part
from scene.survey.write import write_tum

SensorName = Literal["avia", "vlp16", "os1-16", "os1-32", "os1-64"]
IMU_TOPIC, IMU_FRAME, IMU_RATE = "/imu/data", "imu_link", 200.0
# p_imu = p_lidar + shift: the IMU hangs 10 cm under the LiDAR and 5 cm behind it, axes parallel.
IMU = Mount(np.eye(3), np.array([0.05, -0.02, 0.10]))
_HERE = Mount(np.eye(3), np.zeros(3))
_BEHIND, _AHEAD = 45.0, 45.0  # m of bore beyond the drive, further than echoes come back from
_TRUTH_RATE, _AXIS_STEP = 200.0, 0.25  # Hz; m


@dataclass(frozen=True)
class Sensor:
    """A LiDAR as its driver publishes it."""

    lidar: Lidar  # Model
    topic: str  # Topic of its sweeps
    frame: str  # Frame of its points
    kind: str  # Type of its messages
    encode: Callable[[Sweep, Lidar], bytes]  # A sweep as one of them
    beams: int  # Lines
    ahead: float = _AHEAD  # Bore that it may see before the end of the drive, m


def make_sensor(name: SensorName) -> Sensor:
    """Returns a sensor by name.

    The VLP-16's sweeps are stamped at their first packet (`timestamp_first_packet: true` of its driver), as programs
    that use the times of points expect; the OS1 runs with 512 columns.
    """
    if name == "avia":
        return Sensor(avia(), "/livox/lidar", "livox_frame", messages.CUSTOM_TYPE, messages.custom_message, 6, 85.0)
    if name == "vlp16":
        lidar = replace(vlp16(), stamp=0)
        return Sensor(lidar, "/velodyne_points", "velodyne", messages.CLOUD_TYPE, messages.velodyne_message, 16)
    rings = int(name.removeprefix("os1-"))
    lidar = os1(512, rings)
    return Sensor(lidar, "/ouster/points", "os_sensor", messages.CLOUD_TYPE, messages.ouster_message, rings)


@dataclass(frozen=True)
class Course:
    """One recording of the arena: what is driven through, how, and with which sensor."""

    name: str  # Name of the recording
    walls: WallName  # Position on the dial
    sensor: SensorName = "vlp16"  # LiDAR
    motion: MotionName = "trolley"  # Way of carrying it
    dust: float = 0.0  # Density of the dust that moves with it; 0 is none, 1 full
    distance: float = 60.0  # Length of the way, m
    texture: float = 0.0  # Brightness of the lining; from 0, all alike, to 1
    doppler: bool = False  # The LiDAR measures the speed of each range too


@dataclass(frozen=True)
class Scene:
    """A course, drawn: its drive and its sensor, and seeds for their noise."""

    course: Course
    sensor: Sensor
    drive: Drive
    seeds: dict[str, np.random.SeedSequence]


def draw_scene(course: Course, seed: np.random.SeedSequence) -> Scene:
    """Draws bore, drive and noise of a course."""
    names = ("walls", "drive", "dust", "lidar", "imu", "wheels", "texture")
    seeds = dict(zip(names, seed.spawn(len(names)), strict=True))
    sensor = make_sensor(course.sensor)
    bore = draw_walls(seeds["walls"], course.walls, _BEHIND + course.distance + sensor.ahead)
    drive = draw_drive(np.random.default_rng(seeds["drive"]), bore, course.motion, _BEHIND, course.distance)
    return Scene(course, sensor, drive, seeds)


def face_of(scene: Scene) -> Face | None:
    """Returns the brightness of the bore; `None` where it is the same everywhere."""
    if scene.course.texture == 0.0:
        return None
    bore, seed = scene.drive.bore, int(scene.seeds["texture"].generate_state(1)[0]) >> 1
    return Face(bore.alignment, bore.section, scene.course.texture, seed)


def cast_sweeps(scene: Scene) -> Iterator[Sweep]:
    """Yields the sweeps of a scene; every point is cast from the pose at its own time."""
    veil = None
    if scene.course.dust > 0.0:
        veil = draw_dust(np.random.default_rng(scene.seeds["dust"]), scene.course.dust)
    lidar = scene.sensor.lidar
    caster = Caster(scene.drive.bore.mesh(), lidar.range_max)
    rng = np.random.default_rng(scene.seeds["lidar"])
    carried, face, doppler = Carried(scene.drive, _HERE), face_of(scene), scene.course.doppler
    return sweeps(rng, lidar, carried, caster, SensorErrors(), veil=veil, face=face, doppler=doppler)


def stream(scene: Scene) -> Iterator[Message]:
    """Yields all messages of a recording in order of time; a sweep comes when it is complete."""
    level, height = np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.0, 0.0, scene.drive.carrier.height])
    frames = ((scene.sensor.frame, height), (IMU_FRAME, height + IMU.origin))
    yield bags.static_message([bags.transform(frame, shift, level) for frame, shift in frames])
    waiting = sorted([*_inertial(scene), *_odometry(scene)[0]], key=lambda m: m[:2])
    sent, sensor = 0, scene.sensor
    for sweep in cast_sweeps(scene):
        end = sweep.begin + 100_000_000
        while sent < len(waiting) and waiting[sent].time < end:
            yield waiting[sent]
            sent += 1
        yield Message(end, sensor.topic, sensor.kind, sensor.encode(sweep, sensor.lidar))
    yield from waiting[sent:]


def _inertial(scene: Scene) -> list[Message]:
    rng = np.random.default_rng(scene.seeds["imu"])
    sample = carrier.measure_inertial(rng, Carried(scene.drive, _HERE), IMU_RATE, IMU, SensorErrors())
    at = np.rint(sample.time * 1e9).astype(np.int64)
    raw = messages.imu_messages(IMU_FRAME, at, None, sample.gyro, sample.accel)
    return [Message(int(t), IMU_TOPIC, messages.IMU_TYPE, one) for t, one in zip(at, raw, strict=True)]


def _odometry(scene: Scene) -> tuple[list[Message], Float[np.ndarray, "n"], Poses]:
    time = np.arange(round(scene.drive.duration * WHEEL_RATE)) / WHEEL_RATE
    rng = np.random.default_rng(scene.seeds["wheels"])
    position, quaternion = measure_wheels(rng, scene.drive.station(time), scene.drive.poses(time))
    rows = zip(np.rint(time * 1e9).astype(np.int64), position, quaternion, strict=True)
    stamped = [bags.odometry_message(int(t), p, q, scene.sensor.frame) for t, p, q in rows]
    return stamped, time, Poses(position, quaternion)


def write_recording(scene: Scene, folder: Path, formats: tuple[FormatName, ...]) -> Iterator[Message]:
    """Writes the bags, odometry and calibration of a recording; yields its messages as they are written."""
    folder.mkdir(parents=True)
    yield from bags.write_bags(folder, formats, stream(scene))
    (folder / bags.MCAP).mkdir(exist_ok=True)
    _, time, poses = _odometry(scene)
    write_tum(folder / bags.MCAP / "odometry.tum", time, poses.position, poses.quaternion)
    write_file(folder / "calibration.yaml", yaml.safe_dump(calibration(scene), sort_keys=False).encode())


def calibration(scene: Scene) -> dict[str, Any]:
    """Returns topics, extrinsics and noise of a recording, for a program's own configuration."""
    lidar, root = scene.sensor.lidar, float(np.sqrt(IMU_RATE))
    return {
        "lidar": {
            "topic": scene.sensor.topic, "frame": scene.sensor.frame, "model": scene.course.sensor, "rate": 10.0,
            "rows": scene.sensor.beams, "columns": len(lidar.offset) // scene.sensor.beams,
            "range_min": lidar.range_min, "range_max": lidar.range_max, "stamp": "first point", "motion_in_sweep": True,
            "doppler": scene.course.doppler,
        },
        "imu": {
            "topic": IMU_TOPIC, "frame": IMU_FRAME, "rate": IMU_RATE, "rest_at_start": REST,
            "rotation_from_lidar": IMU.rotation.tolist(), "shift_from_lidar": IMU.shift.tolist(),
            "accel_noise_density": carrier.ACCEL_SIGMA / root, "accel_random_walk": carrier.ACCEL_WALK,
            "gyro_noise_density": carrier.GYRO_SIGMA / root, "gyro_random_walk": carrier.GYRO_WALK,
            "accel_bias_sigma": carrier.ACCEL_BIAS, "gyro_bias_sigma": carrier.GYRO_BIAS, "gravity": carrier.GRAVITY,
        },
        "wheels": {"topic": "/odom", "rate": WHEEL_RATE},
    }  # fmt: skip


def write_truth(scene: Scene, folder: Path) -> None:
    """Writes what a program must not see: the LiDAR's poses, the axis, and how the course was drawn."""
    folder.mkdir(parents=True, exist_ok=True)
    drive = scene.drive
    time = np.arange(round(drive.duration * _TRUTH_RATE) + 1) / _TRUTH_RATE
    poses = drive.poses(time)
    write_tum(folder / "lidar.tum", time, poses.position, poses.quaternion)
    station = np.arange(0.0, drive.bore.alignment.length + 1e-9, _AXIS_STEP)
    above = np.full_like(station, drive.carrier.height) - 0.5 * drive.bore.section.height(station)
    points = drive.bore.alignment.frames(station).point(np.zeros_like(station), above)
    rows = np.column_stack([station, points])
    np.savetxt(folder / "axis.csv", rows, fmt="%.6f", delimiter=",", header="station,x,y,z", comments="")
    facts = {"provenance": "simulated", **asdict(scene.course), "duration": drive.duration}
    write_file(folder / "course.json", (json.dumps(facts, indent=1) + "\n").encode())


# Dust that a robot drives in: puffs about the LiDAR that move with it, and whose echoes hide the walls behind them. The
# cloud stands still as seen from the robot: a program that matches sweeps finds it well-conditioned in every direction,
# and that the robot does not move (clutter lock).
_PUFFS = 90
_NEAR, _FAR = 0.8, 3.0  # m from the LiDAR to the middles of the puffs
_RADII = (0.15, 0.5)  # m
_DEPTH = 0.15  # m of dust after which 1 - 1/e of the pulses have come back
_AT_ONCE = 40_000  # rays met with all puffs at a time


@dataclass(frozen=True)
class Dust:
    """Spheres of dust in the LiDAR's frame."""

    middle: Float[np.ndarray, "k 3"]  # Their middles, m, `(k, 3)`
    radius: Float[np.ndarray, "k"]  # Their radii, m, `(k,)`
    density: float  # Density against that of full dust, 1

    def __call__(self, rng: np.random.Generator, ray: Float[np.ndarray, "n 3"], hits: Hits) -> Hits:
        """Returns what rays in the LiDAR's frame hit with the dust before the walls: a `Veil` of `scene.survey`."""
        distance = hits.distance.copy()
        dusty = np.zeros(len(ray), bool)
        for first in range(0, len(ray), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            echo = self._echo(rng, ray[part])
            dusty[part] = echo < distance[part]
            distance[part] = np.minimum(distance[part], echo)
        normal = np.where(dusty[:, None], -ray, hits.normal).astype(np.float32)
        return Hits(
            distance, np.where(dusty, 1.0, hits.cosine).astype(np.float32),
            np.where(dusty, Part.THING, hits.part).astype(np.uint8), normal,
        )  # fmt: skip

    def _echo(self, rng: np.random.Generator, ray: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Returns the range of the first echo from the dust, m; infinite where a pulse passes."""
        along = ray @ self.middle.T
        inside = self.radius**2 - (np.sum(self.middle**2, axis=1) - along**2)
        half = np.sqrt(np.maximum(inside, 0.0))
        echo = np.full(along.shape, np.inf)
        met = np.nonzero((inside > 0.0) & (along > half))
        depth = rng.exponential(_DEPTH / self.density, len(met[0]))
        echo[met] = np.where(depth < 2.0 * half[met], along[met] - half[met] + depth, np.inf)
        return echo.min(axis=1).astype(np.float32)


def draw_dust(rng: np.random.Generator, density: float) -> Dust:
    """Draws a cloud of a density, 1: 0.5 lets every second pulse through a mean puff that 1 would stop."""
    direction = rng.standard_normal((_PUFFS, 3)) * (1.0, 1.0, 0.3)  # about the level of the LiDAR
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    middle = direction * rng.uniform(_NEAR, _FAR, _PUFFS)[:, None]
    return Dust(middle, rng.uniform(*_RADII, _PUFFS), density)
