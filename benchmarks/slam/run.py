"""Runs LiDAR odometry libraries, or the robot's own odometer, on recordings; poses go to `OUT/NAME.tum`.

The libraries are optional (`pip install 'subterra-jax[slam]'`); each runs with its own defaults.
"""

import dataclasses
import importlib
import json
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from benchmarks.command import BenchmarkError
from benchmarks.results import environment_facts, write_file
from benchmarks.slam.recordings import CLOUDS, PLANAR, Sweep, count_messages, read_clouds, read_planar, recordings_in
from subterra_jax.host.files import replace_file

Step = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "4 4"]]
_PLANAR_VOXEL = 0.3  # m: planar scans reach 30 m where the clouds reach 100 m


class Library(NamedTuple):
    """A LiDAR odometry program.

    Attributes:
        package: Package on PyPI.
        topic: Topic that it reads.
        make: Starts an odometry: a function from a sweep's points to the pose of the sensor.
    """

    package: str
    topic: str
    make: Callable[[], Step]


def _kiss(voxel: float | None, max_range: float) -> Step:
    config = importlib.import_module("kiss_icp.config")
    made = config.KISSConfig()
    made.data.max_range, made.data.deskew = max_range, False
    made.mapping.voxel_size = made.data.max_range / 100.0 if voxel is None else voxel
    made.registration.max_num_threads = 1  # sums of several threads differ from run to run
    odometry: Any = importlib.import_module("kiss_icp.kiss_icp").KissICP(made)

    def step(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "4 4"]:
        odometry.register_frame(points, np.zeros(len(points)))
        return np.array(odometry.last_pose)

    return step


def _genz() -> Step:
    made = importlib.import_module("genz_icp.config").GenZConfig()
    made.registration.max_num_threads = 1
    odometry: Any = importlib.import_module("genz_icp.genz_icp").GenZICP(made)

    def step(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "4 4"]:
        odometry.register_frame(points, np.zeros(0))
        return np.array(odometry.last_pose)

    return step


LIBRARIES = {
    "kiss-icp": Library("kiss-icp", CLOUDS, lambda: _kiss(None, 100.0)),
    "genz-icp": Library("genz-icp", CLOUDS, _genz),
    "kiss-icp-planar": Library("kiss-icp", PLANAR, lambda: _kiss(_PLANAR_VOXEL, 30.0)),
}


def find_library(name: str) -> tuple[Library, str]:
    """Returns a library by name, and its version.

    Raises:
        BenchmarkError: There is no such library, or it is not installed.
    """
    if name not in LIBRARIES:
        raise BenchmarkError(f"no library {name!r}; there are {', '.join(LIBRARIES)}")
    library = LIBRARIES[name]
    try:
        return library, version(library.package)
    except PackageNotFoundError as error:
        raise BenchmarkError(f"{name} needs {library.package}, which is not installed: pip install {library.package}"
                        ) from error  # fmt: skip


def estimate_poses(
    library: Library, sweeps: Iterable[Sweep]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 4 4"]]:
    """Runs a library; returns times, s, and poses of the sensor in the frame of its first sweep.

    Raises:
        BenchmarkError: There is no sweep, a sweep holds no point, or a pose is not finite.
    """
    step = library.make()
    times: list[float] = []
    poses: list[np.ndarray] = []
    for stamp, points in sweeps:
        if not len(points):
            raise BenchmarkError(f"{library.package}: sweep {len(times)} holds no point")
        pose = step(np.ascontiguousarray(points, np.float64))
        if not np.isfinite(pose).all():
            raise BenchmarkError(f"{library.package}: the pose of sweep {len(times)} is not finite")
        times.append(stamp)
        poses.append(pose)
    if not times:
        raise BenchmarkError(f"{library.package}: there is no sweep to run on")
    return np.array(times), np.stack(poses)


SCHEMA = "subterra.slam-run/1"
WHEELS = "wheel-odometry"


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """Settings of a run.

    Attributes:
        library: `kiss-icp`, `genz-icp`, `kiss-icp-planar`, or `wheel-odometry`, which copies the robot's own odometry.
        recordings: Set of recordings, or its `recordings/`.
        out: Folder for the poses, `NAME.tum`; files there already are kept.
    """

    library: str
    recordings: Path
    out: Path


def run_all(config: RunConfig) -> Iterator[tuple[str, str]]:
    """Runs on every recording with the library's topic; yields each name and a line about its result.

    Raises:
        BenchmarkError: The library is unknown or not installed, or no recording has its topic.
    """
    library, number = (None, "") if config.library == WHEELS else find_library(config.library)
    bags, ran = recordings_in(config.recordings), []
    for name, bag in bags:
        target = config.out / f"{name}.tum"
        if library is not None and library.topic not in count_messages(bag):
            yield name, f"has no {library.topic}"
            continue
        ran.append(name)
        if target.is_file():
            yield name, "there already"
        elif library is None:
            with replace_file(target) as fresh:
                shutil.copyfile(bag / "odometry.tum", fresh)
            yield name, "copied"
        else:
            yield name, _run_one(library, bag, target)
    if not ran:
        raise BenchmarkError(f"{config.recordings}: no recording has what {config.library} reads")
    facts = {"schema": SCHEMA, "library": config.library, "version": number, "recordings": ran, **environment_facts()}
    write_file(config.out / "run.json", (json.dumps(facts, indent=1, default=str) + "\n").encode())


def _run_one(library: Library, bag: Path, target: Path) -> str:
    read_sweeps = read_clouds if library.topic == CLOUDS else read_planar
    started = time.monotonic()
    times, poses = estimate_poses(library, read_sweeps(bag))
    seconds = time.monotonic() - started
    save_tum(target, times, poses)
    return f"{len(times)} sweeps in {seconds:.0f} s"


def save_tum(path: Path, times: Float[np.ndarray, " n"], poses: Float[np.ndarray, "n 4 4"]) -> None:
    """Writes poses as rows `t x y z qx qy qz qw`."""
    rows = np.column_stack([times, poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)])
    with replace_file(path) as fresh:
        np.savetxt(fresh, rows, fmt="%.9f")
