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

from benchmarks.command import BenchmarkError
from benchmarks.results import environment_facts, write_file
from benchmarks.slam.inertial import PROGRAMS, find_program, run_program
from benchmarks.slam.recordings import (
    CALIBRATION,
    CLOUDS,
    PLANAR,
    Sweep,
    check_recording,
    count_messages,
    read_clouds,
    read_planar,
    recordings_in,
)
from benchmarks.slam.tum import save_tum
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
        raise BenchmarkError(f"no library {name!r}; there are {', '.join([*LIBRARIES, *PROGRAMS, WHEELS])}")
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
RUN_FILE = "run.json"


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """Settings of a run.

    Attributes:
        library: `kiss-icp`, `genz-icp`, `kiss-icp-planar`; one of `evalio-` and `kiss`, `genz`, `mad`, `ct`, `loam`,
            `liosam`, `dlio`, `form`, or `rko-lio`, `ring-filter`, `particle-filter`, on recordings of the arena; or
            `wheel-odometry`, which copies the robot's own odometry.
        recordings: Set of recordings, or its `recordings/`.
        out: Folder for the poses, `NAME.tum`; files there already are kept.
        limit: Time after which a program of the arena counts as failed on a recording, s.
    """

    library: str
    recordings: Path
    out: Path
    limit: float = 3600.0


def run_all(config: RunConfig) -> Iterator[tuple[str, str]]:
    """Runs on every recording with the library's topic; yields each name and a line about its result.

    Raises:
        BenchmarkError: The library is unknown or not installed, a bag is missing or damaged, or no recording has its
            topic.
    """
    if config.library in PROGRAMS:
        yield from _run_inertial(config)
        return
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
    write_file(config.out / RUN_FILE, (json.dumps(facts, indent=1, default=str) + "\n").encode())


def _run_inertial(config: RunConfig) -> Iterator[tuple[str, str]]:
    """Runs a program that needs the times of points; those that fail are listed in `run.json` with the reason."""
    number, results = find_program(config.library), _results_so_far(config.out / RUN_FILE)
    bags = [(name, bag.parent) for name, bag in recordings_in(config.recordings)]
    if not any((folder / CALIBRATION).is_file() for _, folder in bags):
        raise BenchmarkError(
            f"{config.recordings}: holds no {CALIBRATION}, which {config.library} needs "
            "(`python -m benchmarks.slam arena` makes such recordings)"
        )
    for _, folder in bags:
        check_recording(folder)  # a damaged bag is no failure of the program
    for name, folder in bags:
        target = config.out / f"{name}.tum"
        if target.is_file():
            yield name, "there already"
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        results[name] = run_program(config.library, folder, target, config.limit)
        _write_facts(config, number, [name for name, _ in bags], results)
        yield name, describe_run(results[name])
    _write_facts(config, number, [name for name, _ in bags], results)


def describe_run(result: dict[str, Any]) -> str:
    """Returns a line about a program's run on one recording."""
    if "failed" in result:
        return f"failed: {result['failed']}"
    return f"{result['poses']} poses in {result['seconds']:.0f} s, {100.0 * result['share']:.0f} % of real time"


def _results_so_far(path: Path) -> dict[str, dict[str, Any]]:
    try:
        return json.loads(path.read_text())["results"]
    except (OSError, ValueError, KeyError):
        return {}


def _write_facts(config: RunConfig, number: str, names: list[str], results: dict[str, dict[str, Any]]) -> None:
    facts = {"schema": SCHEMA, "library": config.library, "version": number, "recordings": names, "results": results}
    write_file(config.out / RUN_FILE, (json.dumps(facts | environment_facts(), indent=1, default=str) + "\n").encode())


def _run_one(library: Library, bag: Path, target: Path) -> str:
    read_sweeps = read_clouds if library.topic == CLOUDS else read_planar
    started = time.monotonic()
    times, poses = estimate_poses(library, read_sweeps(bag))
    seconds = time.monotonic() - started
    save_tum(target, times, poses)
    return f"{len(times)} sweeps in {seconds:.0f} s"
