"""LiDAR odometry of today, each run with its own defaults: a stream of sweeps in, poses out.

They are optional: `pip install 'subterra-jax[slam]'`.
"""

import importlib
from collections.abc import Callable, Iterable
from importlib.metadata import PackageNotFoundError, version
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from benchmarks.slam.errors import SlamError
from benchmarks.slam.reading import CLOUDS, PLANAR, Sweep

Step = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "4 4"]]
_PLANAR_VOXEL = 0.3  # m: planar scans reach 30 m where the clouds reach 100 m


class Library(NamedTuple):
    """A program on the leaderboard.

    Attributes:
        package: That it comes from.
        topic: That it reads.
        make: Begins an odometry: a function from a sweep's points to the pose of the sensor.
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


def installed(name: str) -> tuple[Library, str]:
    """A library by name, and its version.

    Raises:
        SlamError: There is no such library, or it is not installed.
    """
    if name not in LIBRARIES:
        raise SlamError(f"no library {name!r}; there are {', '.join(LIBRARIES)}")
    library = LIBRARIES[name]
    try:
        return library, version(library.package)
    except PackageNotFoundError as error:
        raise SlamError(f"{name} needs {library.package}, which is not installed: pip install {library.package}"
                        ) from error  # fmt: skip


def run(library: Library, sweeps: Iterable[Sweep]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 4 4"]]:
    """Times (s) and poses of the sensor in the frame of its first sweep.

    Raises:
        SlamError: There is no sweep, one holds no point, or the library gave a pose that is none.
    """
    step = library.make()
    times: list[float] = []
    poses: list[np.ndarray] = []
    for time, points in sweeps:
        if not len(points):
            raise SlamError(f"{library.package}: sweep {len(times)} holds no point")
        pose = step(np.ascontiguousarray(points, np.float64))
        if not np.isfinite(pose).all():
            raise SlamError(f"{library.package}: the pose of sweep {len(times)} is not finite")
        times.append(time)
        poses.append(pose)
    if not times:
        raise SlamError(f"{library.package}: there is no sweep to run on")
    return np.array(times), np.stack(poses)
