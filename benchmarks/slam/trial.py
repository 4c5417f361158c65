"""Run a library, or the robot's own odometer, on recordings; poses go to `OUT/NAME.tum`."""

import dataclasses
import json
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from benchmarks.slam import reading
from benchmarks.slam.errors import SlamError
from benchmarks.slam.libraries import Library, installed, run
from benchmarks.slam.recordset import recordings_in
from benchmarks.throughput.facts import environment_facts

SCHEMA = "subterra.slam-run/1"
WHEELS = "wheel-odometry"


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """What to run on what.

    Attributes:
        library: `kiss-icp`, `genz-icp`, `kiss-icp-planar`, or `wheel-odometry`, which copies what the robot reckoned.
        recordings: A set of recordings, or its `recordings/`.
        out: Folder for the poses, `NAME.tum` each; what is there already is not run again.
    """

    library: str
    recordings: Path
    out: Path


def run_all(config: RunConfig) -> Iterator[tuple[str, str]]:
    """Run on every recording that has what the library reads; yields each name and what became of it.

    Raises:
        SlamError: No such library, it is not installed, no recordings, or none with what it reads.
    """
    library, number = (None, "") if config.library == WHEELS else installed(config.library)
    bags, ran = recordings_in(config.recordings), []
    try:
        config.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SlamError(f"{config.out}: cannot be written ({error.strerror})") from error
    for name, bag in bags:
        target = config.out / f"{name}.tum"
        if library is not None and library.topic not in reading.topics(bag):
            yield name, f"has no {library.topic}"
            continue
        ran.append(name)
        if target.is_file():
            yield name, "there already"
        elif library is None:
            shutil.copyfile(bag / "odometry.tum", target)
            yield name, "copied"
        else:
            yield name, _run_one(library, bag, target)
    if not ran:
        raise SlamError(f"{config.recordings}: no recording has what {config.library} reads")
    facts = {"schema": SCHEMA, "library": config.library, "version": number, "recordings": ran, **environment_facts()}
    (config.out / "run.json").write_text(json.dumps(facts, indent=1, default=str) + "\n")


def _run_one(library: Library, bag: Path, target: Path) -> str:
    feed = reading.clouds if library.topic == reading.CLOUDS else reading.planar
    began = time.monotonic()
    times, poses = run(library, feed(bag))
    seconds = time.monotonic() - began
    save_tum(target, times, poses)
    return f"{len(times)} sweeps in {seconds:.0f} s"


def save_tum(path: Path, times: Float[np.ndarray, " n"], poses: Float[np.ndarray, "n 4 4"]) -> None:
    """Write poses as rows `t x y z qx qy qz qw`."""
    rows = np.column_stack([times, poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)])
    partial = path.with_name(f".{path.name}.partial")
    np.savetxt(partial, rows, fmt="%.9f")
    partial.replace(path)
