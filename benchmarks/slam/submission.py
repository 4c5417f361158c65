"""Checks a submission to the arena's hidden half: poses of one program on every recording of a set, without the truth.

A submission is a folder of `NAME.tum`, one for each recording, and `program.json` with `name`, `version` and `command`.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.command import BenchmarkError
from benchmarks.slam.recordings import recordings_in
from benchmarks.slam.score import LEAST_RATE
from scene.errors import RecordingError
from scene.poses.trajectory import load_tum

FACTS, KEYS = "program.json", ("name", "version", "command")
LEAST_COVERED = 0.9  # share of the recording between the first pose and the last
_ODOMETRY = "odometry.tum"


@dataclass(frozen=True)
class SubmissionConfig:
    """Settings of a check.

    Attributes:
        submission: Folder of `NAME.tum` and `program.json`.
        recordings: Set that the program ran on, or its `recordings/`.
    """

    submission: Path
    recordings: Path


def check_submission(config: SubmissionConfig) -> list[str]:
    """Returns a line for each file of a submission that can be scored.

    Raises:
        BenchmarkError: A file is missing or unreadable, has too few poses, other times than its recording, or covers
            too little of it.
    """
    folder = config.submission
    if not folder.is_dir():
        raise BenchmarkError(f"{folder}: no such folder")
    facts = _read_facts(folder / FACTS)
    bags = recordings_in(config.recordings)
    missing = [name for name, _ in bags if not (folder / f"{name}.tum").is_file()]
    if missing:
        raise BenchmarkError(f"{folder}: {missing[0]}.tum is missing ({len(missing)} of {len(bags)} recordings are)")
    return [f"{facts['name']} {facts['version']}", *(_check(folder / f"{name}.tum", bag) for name, bag in bags)]


def _read_facts(path: Path) -> dict[str, str]:
    try:
        facts = json.loads(path.read_text())
    except OSError as error:
        raise BenchmarkError(f"{path}: is missing; it says name, version and command of the program") from error
    except ValueError as error:
        raise BenchmarkError(f"{path}: is no JSON ({error})") from error
    absent = [key for key in KEYS if not isinstance(facts, dict) or not isinstance(facts.get(key), str)]
    if absent:
        raise BenchmarkError(f"{path}: has no {absent[0]!r}; it needs {', '.join(KEYS)}, each a text")
    return facts


def _check(path: Path, bag: Path) -> str:
    """Checks the poses of one recording, whose odometer says when it began and ended."""
    try:
        poses, drive = load_tum(path), load_tum(bag / _ODOMETRY)
    except RecordingError as error:
        raise BenchmarkError(str(error)) from error
    begin, end = drive.times[0], drive.times[-1]
    inside = (poses.times >= begin - 0.2) & (poses.times <= end + 0.2)
    count, run = int(inside.sum()), float(end - begin)
    if count < 2:
        raise BenchmarkError(
            f"{path}: its times, {poses.times[0]:.1f} to {poses.times[-1]:.1f} s, do not overlap those of the "
            f"recording, {begin:.1f} to {end:.1f} s"
        )
    covered = float(np.ptp(poses.times[inside])) / run
    if covered < LEAST_COVERED:
        least = 100.0 * LEAST_COVERED
        raise BenchmarkError(f"{path}: covers {100.0 * covered:.0f} % of the recording; {least:g} % are needed")
    if count < LEAST_RATE * run:
        raise BenchmarkError(f"{path}: has {count} poses in {run:.0f} s; at least {LEAST_RATE:g} a second are needed")
    _check_frame(path, poses.rotations[inside][0].as_matrix(), poses.positions[inside])
    return f"{path.name}: {count} poses over {100.0 * covered:.0f} % of the recording"


def _check_frame(path: Path, first: np.ndarray, positions: np.ndarray) -> None:
    """Checks that poses are the LiDAR's: x forward. A drive that leads sideways was written in another frame.

    A camera's frame, z forward, or a body's, turned, would be scored as an error of the way.
    """
    way = positions[-1] - positions[0]
    length = float(np.linalg.norm(way))
    if length < 2.0:  # a program that saw no motion has no direction
        return
    forward = float(first[:, 0] @ way) / length
    if forward < 0.5:
        angle = float(np.degrees(np.arccos(np.clip(forward, -1.0, 1.0))))
        raise BenchmarkError(
            f"{path}: its first pose looks {angle:.0f}° away from where it drives: poses must be those of the LiDAR, "
            "x forward"
        )
