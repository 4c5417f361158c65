"""Checks a submission to the arena's hidden half: poses of one program on every recording of a set, without the truth.

A submission is a folder of `NAME.tum`, one for each recording, and `program.json` with `name`, `version` and `command`.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.command import BenchmarkError
from benchmarks.slam.reading import ODOMETRY, recordings_in
from benchmarks.slam.score import LEAST_COVERED, check_rate
from benchmarks.slam.tracks import read_track

FACTS, KEYS = "program.json", ("name", "version", "command")
_LEAST_WAY = 2.0  # m; a program that saw less motion has no direction


@dataclass(frozen=True)
class SubmissionConfig:
    """Settings of a check."""

    submission: Path  # Folder of `NAME.tum` and `program.json`.
    recordings: Path  # Set that the program ran on, or its `recordings/`.


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
    recordings = recordings_in(config.recordings)
    missing = [one.name for one in recordings if not (folder / f"{one.name}.tum").is_file()]
    if missing:
        count = f"{len(missing)} of {len(recordings)} recordings are"
        raise BenchmarkError(f"{folder}: {missing[0]}.tum is missing ({count})")
    checked = (_check(folder / f"{one.name}.tum", one / "recording" / ODOMETRY) for one in recordings)
    return [f"{facts['name']} {facts['version']}", *checked]


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


def _check(path: Path, odometry: Path) -> str:
    """Checks the poses of one recording, whose odometer says when it began and ended.

    A drive that leads away from where its first pose looks was written in another frame than the LiDAR's, as a
    camera's, and would be scored as an error of the way.
    """
    track = read_track(path, odometry, "none")
    if track.covered < LEAST_COVERED:
        least = f"{100.0 * LEAST_COVERED:g} % are needed"
        raise BenchmarkError(f"{path}: covers {100.0 * track.covered:.0f} % of the recording; {least}")
    check_rate(path, track)
    way = track.position[-1] - track.position[0]
    length = float(np.linalg.norm(way))
    forward = float(track.rotation[0].as_matrix()[:, 0] @ way) / max(length, 1e-9)
    if length > _LEAST_WAY and forward < 0.5:
        angle = float(np.degrees(np.arccos(np.clip(forward, -1.0, 1.0))))
        raise BenchmarkError(
            f"{path}: its first pose looks {angle:.0f}° away from where it drives: poses must be those of the LiDAR, "
            "x forward"
        )
    return f"{path.name}: {len(track.time)} poses over {100.0 * track.covered:.0f} % of the recording"
