"""Programs on a recording, each in a process of its own: `evalio`'s pipelines, `rko-lio`, trackers of `subterra_jax`.

The process reads the bag, feeds sweeps and IMU samples in order, and writes the LiDAR's poses. A program that crashes
takes its process with it and no more.
"""

import json
import os
import subprocess
import sys
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks.command import BenchmarkError
from benchmarks.slam.sweep_points import read_samples
from benchmarks.slam.tum import Poses, save_tum

EVALIO = ("kiss", "genz", "mad", "ct", "loam", "liosam", "dlio", "form")
TRACKERS = ("ring-filter", "particle-filter")  # of the station alone: `trackers`
PROGRAMS = {  # name to its package
    **{f"evalio-{name}": "evalio" for name in EVALIO}, "rko-lio": "rko-lio", **dict.fromkeys(TRACKERS, "jax"),
}  # fmt: skip
# What is not left at a program's defaults: sums of several threads differ from run to run; points are undistorted by
# their times, which evalio leaves out; no sweep is skipped to keep up with real time.
_CHANGES = {"max_num_threads": 1, "num_threads": 1, "ls_num_threads": 1, "numberOfCores": 1, "deskew": True,
            "realtime": False}  # fmt: skip
_LEAST_POSES = 2
_SAYS = '{"poses"'  # beginning of the line in which the process reports


def find_program(name: str) -> str:
    """Returns the version of a program's package.

    Raises:
        BenchmarkError: It is not installed.
    """
    package = PROGRAMS[name]
    try:
        return version(package)
    except PackageNotFoundError as error:
        raise BenchmarkError(f"{name} needs {package}, which is not installed: pip install {package}") from error


_ALONE = "import sys; from benchmarks.slam.inertial import main; sys.exit(main(sys.argv[1:]))"


def run_program(name: str, recording: Path, target: Path, limit: float = 3600.0) -> dict[str, Any]:
    """Runs a program on a recording in a process of its own, for `limit` s at most.

    Args:
        name: One of `PROGRAMS`.
        recording: Folder with `calibration.yaml` and `recording/`.
        target: TUM file to write; it is not written where the program fails.
        limit: Time after which it counts as failed, s.

    Returns:
        `seconds` that the program took, `share` of the recording's duration, `poses`; or `failed` with the reason.
    """
    words = [sys.executable, "-c", _ALONE, name, str(recording.resolve()), str(target.resolve())]
    path = os.pathsep.join(filter(None, [str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]))
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": path}
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=limit, env=environment, check=False)
    except subprocess.TimeoutExpired:
        return {"failed": f"did not finish within {limit:g} s"}
    if done.returncode:
        last = done.stderr.strip().splitlines()[-1:] or [f"ended with status {done.returncode}"]
        reason = last[0] if done.returncode > 0 else f"crashed with signal {-done.returncode}: {last[0]}"
        return {"failed": reason}
    said = [line for line in done.stdout.splitlines() if line.startswith(_SAYS)]  # libraries print too
    return json.loads(said[-1])


def _evalio(name: str, recording: Path) -> Poses:
    from evalio.pipelines import get_pipeline
    from evalio.types import ImuMeasurement

    from benchmarks.slam.evalio_sets import open_set

    dataset = next(iter(open_set(recording.parent.parent, [recording.name])))
    kind: Any = get_pipeline(name)
    program = kind()
    settings = kind.default_params()
    program.set_params(settings | {key: value for key, value in _CHANGES.items() if key in settings})
    program.set_imu_params(dataset.imu_params())
    program.set_lidar_params(dataset.lidar_params())
    program.set_imu_T_lidar(dataset.imu_T_lidar())
    program.initialize()
    mount, seconds, rows = dataset.imu_T_lidar().to_mat(), 0.0, []
    for sample in dataset.data_iter():
        started = time.perf_counter()
        (program.add_imu if isinstance(sample, ImuMeasurement) else program.add_lidar)(sample)
        seconds += time.perf_counter() - started
        rows += [(stamp.sec + 1e-9 * stamp.nsec, pose.to_mat() @ mount) for stamp, pose in program.saved_estimates()]
        program.saved_features_matrix(), program.saved_maps_matrix()  # what is not taken piles up
    return np.array([t for t, _ in rows]), np.array([pose for _, pose in rows]).reshape(-1, 4, 4), seconds


def _rko(recording: Path) -> Poses:
    from rko_lio.config import LIOConfig
    from rko_lio.lio import LIO

    mount = np.eye(4)
    mount[:3, 3] = -np.array(yaml.safe_load((recording / "calibration.yaml").read_text())["imu"]["shift_from_lidar"])
    program, seconds, rows = LIO(LIOConfig(max_num_threads=1)), 0.0, []
    for stamp, content in read_samples(recording):
        started = time.perf_counter()
        if isinstance(content, tuple):
            program.add_imu_measurement(*content, stamp, extrinsic_imu2base=mount)
        else:
            seen = content[(content["x"] != 0.0) | (content["y"] != 0.0)]
            xyz = np.column_stack([seen["x"], seen["y"], seen["z"]]).astype(np.float64)
            program.register_scan(xyz, stamp + seen["t"].astype(np.int64), np.eye(4), stamp, stamp + 100_000_000)
            rows.append((1e-9 * stamp + 0.1, np.array(program.pose())))
        seconds += time.perf_counter() - started
    return np.array([t for t, _ in rows]), np.array([pose for _, pose in rows]), seconds


def _run(name: str, recording: Path) -> Poses:
    if name in TRACKERS:
        from benchmarks.slam.trackers import run_tracker

        return run_tracker(name, recording)
    return _rko(recording) if name == "rko-lio" else _evalio(name.removeprefix("evalio-"), recording)


def main(words: list[str]) -> int:
    """Runs `NAME RECORDING TARGET` and prints one line of JSON."""
    name, recording, target = words[0], Path(words[1]), Path(words[2])
    try:
        times, poses, seconds = _run(name, recording)
    except (BenchmarkError, ValueError) as error:
        print(error, file=sys.stderr)
        return 1
    if len(times) < _LEAST_POSES or not np.isfinite(poses).all():
        problem = "gives poses that are not finite" if len(times) >= _LEAST_POSES else f"gives {len(times)} poses"
        print(problem, file=sys.stderr)
        return 1
    save_tum(target, times, poses)
    share = seconds / float(times[-1] - times[0])
    print(json.dumps({"poses": len(times), "seconds": round(seconds, 2), "share": round(share, 3)}))
    return 0
