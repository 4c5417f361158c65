"""Programs for SLAM, with their own defaults and one thread: `evalio`'s, `rko-lio` and ours.

`main` runs one in this process: it reads the bag, feeds sweeps and IMU samples in order, writes the LiDAR's poses and
prints one line of JSON. The libraries are optional (`pip install -e '.[slam]'`).
"""

import json
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from benchmarks.command import BenchmarkError
from benchmarks.slam import odometry
from benchmarks.slam.reading import CALIBRATION, Poses, read_samples
from scene.poses.trajectory import Trajectory, save_tum
from subterra_jax.host.versions import VERSION

WHEELS, DOPPLER = "wheel-odometry", "doppler-odometry"
# What is not left at a program's defaults: sums of several threads differ from run to run; points are undistorted by
# their times, which evalio leaves out; no sweep is skipped to keep up with real time.
_CHANGES = {"max_num_threads": 1, "num_threads": 1, "ls_num_threads": 1, "numberOfCores": 1, "deskew": True,
            "realtime": False}  # fmt: skip


class Program(NamedTuple):
    """A program that gives poses."""

    package: str  # Package that it comes with; empty for ours
    run: Callable[[Path], Poses]  # Runs it on the folder of a recording of the arena


def _run_evalio(name: str, recording: Path) -> Poses:
    from evalio.pipelines import get_pipeline
    from evalio.types import ImuMeasurement

    from benchmarks.slam.evalio import EvalioRecording

    given = EvalioRecording(recording)
    kind: Any = get_pipeline(name)
    program = kind()
    settings = kind.default_params()
    program.set_params(settings | {key: value for key, value in _CHANGES.items() if key in settings})
    program.set_imu_params(given.imu)
    program.set_lidar_params(given.lidar)
    program.set_imu_T_lidar(given.mount)
    program.initialize()
    mount, seconds, rows = given.mount.to_mat(), 0.0, []
    for sample in given.samples():
        started = time.perf_counter()
        (program.add_imu if isinstance(sample, ImuMeasurement) else program.add_lidar)(sample)
        seconds += time.perf_counter() - started
        rows += [(stamp.sec + 1e-9 * stamp.nsec, pose.to_mat() @ mount) for stamp, pose in program.saved_estimates()]
        program.saved_features_matrix(), program.saved_maps_matrix()  # what is not taken piles up
    return np.array([t for t, _ in rows]), np.array([pose for _, pose in rows]).reshape(-1, 4, 4), seconds


def _run_rko(recording: Path) -> Poses:
    from rko_lio.config import LIOConfig
    from rko_lio.lio import LIO

    mount = np.linalg.inv(_mount(recording))
    program, seconds, rows = LIO(LIOConfig(max_num_threads=1)), 0.0, []
    for stamp, content in read_samples(recording):
        started = time.perf_counter()
        if isinstance(content, tuple):
            program.add_imu_measurement(*content, stamp, extrinsic_imu2base=mount)
        else:
            seen = content[(content["x"] != 0.0) | (content["y"] != 0.0)]
            program.register_scan(_xyz(seen), stamp + seen["t"].astype(np.int64), np.eye(4), stamp, stamp + 100_000_000)
            rows.append((1e-9 * stamp + 0.1, np.array(program.pose())))
        seconds += time.perf_counter() - started
    return np.array([t for t, _ in rows]), np.array([pose for _, pose in rows]), seconds


def _mount(recording: Path) -> np.ndarray:
    """Returns the pose of the LiDAR in the IMU's frame."""
    pose = np.eye(4)
    pose[:3, 3] = yaml.safe_load((recording / CALIBRATION).read_text())["imu"]["shift_from_lidar"]
    return pose


def _bundles(recording: Path) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Yields the stamp (ns) of each sweep, its returns, and the IMU samples since the last: s, force, turn rate."""
    samples: list[np.ndarray] = []
    for stamp, content in read_samples(recording):
        if isinstance(content, tuple):
            samples.append(np.concatenate([[1e-9 * stamp], *content]))
        elif samples:
            yield stamp, content[(content["x"] != 0.0) | (content["y"] != 0.0)], np.array(samples)
            samples = samples[-1:]


def _xyz(points: np.ndarray) -> np.ndarray:
    return np.column_stack([points["x"], points["y"], points["z"]]).astype(np.float64)


def _run_bundles(step: Callable[[int, np.ndarray, np.ndarray], Any], recording: Path) -> Poses:
    """Runs a step that returns the time (s) and the pose of the LiDAR after each sweep, or None."""
    seconds, rows = 0.0, []
    for bundle in _bundles(recording):
        started = time.perf_counter()
        row = step(*bundle)
        seconds += time.perf_counter() - started
        rows += [] if row is None else [row]
    return np.array([t for t, _ in rows]), np.array([pose for _, pose in rows]).reshape(-1, 4, 4), seconds


def _run_se3(recording: Path) -> Poses:
    from se3_lio import SE3LIO

    mount = _mount(recording)
    program = SE3LIO(None, mount)

    def step(stamp: int, points: np.ndarray, samples: np.ndarray) -> Any:
        state, _ = program.register_frame(_xyz(points), 1e-9 * points["t"], samples, 1e-9 * stamp)
        return float(state.stamp), np.array(state.pose) @ mount

    return _run_bundles(step, recording)


def _run_genz(recording: Path) -> Poses:
    from genz_lio import Config, GenZLIO

    config = Config()
    config.max_threads, config.mapping.extrinsic_t = 1, _mount(recording)[:3, 3]
    program = GenZLIO(config)

    def step(stamp: int, points: np.ndarray, samples: np.ndarray) -> Any:
        begin, rest = 1e-9 * stamp, {"intensities": points["intensity"], "rings": points["ring"]}
        found = program.register_scan(
            _xyz(points), begin, begin + 0.1, samples, 1e-9 * points["t"], **rest, timing_prepared=True
        )
        return (float(found.timestamp), np.array(program.lidar_pose)) if found.valid else None

    return _run_bundles(step, recording)


def _run_pelorus(recording: Path) -> Poses:
    from pelorus import Handle

    program = Handle()
    none = [0.0] * 9

    def step(stamp: int, points: np.ndarray, samples: np.ndarray) -> Any:
        for t, *values in samples:
            seconds, rest = divmod(round(1e9 * t), 1_000_000_000)
            program.add_imu(seconds, rest, [1.0, 0.0, 0.0, 0.0], [-1.0, *none[1:]], values[3:], none, values[:3], none)
        program.add_pointcloud(np.column_stack([_xyz(points), points["t"]]), *divmod(stamp, 1_000_000_000))
        for _ in range(200):  # another thread answers
            if (found := program.try_recv()) is not None:
                pose = np.eye(4)
                w, x, y, z = found["orientation"]
                pose[:3, :3], pose[:3, 3] = Rotation.from_quat([x, y, z, w]).as_matrix(), found["position"]
                return found["timestamp_sec"] + 1e-9 * found["timestamp_nanosec"], pose
            time.sleep(0.005)
        return None

    return _run_bundles(step, recording)


PROGRAMS = {
    **{f"evalio-{name}": Program("evalio", partial(_run_evalio, name))
       for name in ("kiss", "genz", "mad", "ct", "loam", "liosam", "dlio", "form")},
    "rko-lio": Program("rko-lio", _run_rko),
    "genz-lio": Program("genz-lio", _run_genz),
    "pelorus": Program("pelorus", _run_pelorus),
    "se3-lio": Program("se3-lio", _run_se3),
    "intensity-odometry": Program("", partial(odometry.run, odometry.by_brightness)),
    DOPPLER: Program("", partial(odometry.run, odometry.by_doppler)),
}  # fmt: skip
FURTHER = ("genz-lio", "pelorus", "se3-lio")  # whose packages are no part of the extra `slam`


def find_program(name: str) -> str:
    """Returns the version of a program's package; empty for the robot's own odometry.

    Raises:
        BenchmarkError: There is no such program, or it is not installed.
    """
    if name == WHEELS:
        return ""
    if name not in PROGRAMS:
        raise BenchmarkError(f"no program {name!r}; there are {', '.join([WHEELS, *PROGRAMS])}")
    if not (package := PROGRAMS[name].package):
        return VERSION
    try:
        return version(package)
    except PackageNotFoundError as error:
        raise BenchmarkError(f"{name} needs {package}, which is not installed: pip install {package}") from error


def main(words: list[str]) -> int:
    """Runs `NAME RECORDING TARGET` and prints one line of JSON; returns 1 with a reason where the program fails."""
    try:
        times, poses, seconds = PROGRAMS[words[0]].run(Path(words[1]))
    except (BenchmarkError, ValueError) as error:
        print(error, file=sys.stderr)
        return 1
    if len(times) < 2 or not np.isfinite(poses).all():
        problem = "gives poses that are not finite" if len(times) >= 2 else f"gives {len(times)} poses"
        print(problem, file=sys.stderr)
        return 1
    turns = Rotation.from_matrix(poses[:, :3, :3])
    save_tum(Trajectory(times, poses[:, :3, 3], turns, words[0]), Path(words[2]))
    fraction = seconds / float(times[-1] - times[0])
    print(json.dumps({"poses": len(times), "seconds": round(seconds, 2), "share": round(fraction, 3)}))
    return 0
