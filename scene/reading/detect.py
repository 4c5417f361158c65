"""What an input is: by its first bytes, then by its name."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scene.errors import RecordingError
from scene.reading import ringsurvey, scanfolder

_MAGIC = (
    (b"#ROSBAG", "bag"),
    (b"\x89MCAP0\r\n", "mcap"),
    (b"SQLite format 3\x00", "db3"),
    (b"ply\n", "ply"),
    (b"ply\r", "ply"),
    (b"# .PCD", "pcd"),
    (b"VERSION ", "pcd"),
    (b"LASF", "las"),
    (b"ASTM-E57", "e57"),
    (b"PAR1", "parquet"),
)
_SUFFIX = {
    ".bag": "bag", ".mcap": "mcap", ".db3": "db3", ".ply": "ply", ".pcd": "pcd", ".las": "las", ".laz": "las",
    ".e57": "e57", ".parquet": "parquet", ".xyz": "table", ".csv": "table", ".txt": "table", ".asc": "table",
    ".pts": "table", ".xlsx": "rings",
}  # fmt: skip
RECORDINGS = {"bag": "ROS1 bag", "rosbag2": "ROS2 bag", "mcap": "MCAP", "db3": "ROS2 bag", "scans": "folder of scans"}
CLOUDS = {
    "ply": "PLY", "pcd": "PCD", "las": "LAS", "e57": "E57", "table": "table", "parquet": "Parquet",
}  # fmt: skip
RINGS = "rings"
_TOLD = ("format", "topic", "message_type", "times", "point_times", "unit", "axes")


@dataclass(frozen=True)
class Detected:
    """What to read, and as what.

    Attributes:
        path: The file or folder to open; inside the input where that is a folder with one file.
        format: A key of `RECORDINGS` or `CLOUDS`, or `RINGS`.
        by: How it was found: `content`, `name` or `flag`.
    """

    path: Path
    format: str
    by: str


def detect(path: Path, said: str | None = None) -> Detected:
    """The format of an input.

    Args:
        path: A file or folder that exists.
        said: A format that overrides detection.

    Raises:
        RecordingError: Of no known kind, or `said` is no format.
    """
    if said is not None:
        if said not in {*RECORDINGS, *CLOUDS, RINGS}:
            known = ", ".join([*RECORDINGS, *CLOUDS, RINGS])
            raise RecordingError(f"{path}: format {said!r} is none of {known}")
        return Detected(path, said, "flag")
    found = _in_folder(path) if path.is_dir() else _in_file(path)
    if found is None:
        raise RecordingError(
            f"{path}: of no known kind; a ROS bag or MCAP, a folder of timed scans, a cloud (PLY, PCD, LAS, LAZ, E57, "
            "XYZ, CSV, Parquet) or a ring survey (CSV, XLSX) is needed"
        )
    return found


def sentence(facts: dict[str, Any]) -> str:
    """What was detected, in one line for people.

    Args:
        facts: Of a recording, a cloud or a survey.
    """
    told = [f"{facts['kind']}"]
    told += [f"{key.replace('_', ' ')} {facts[key]}" for key in _TOLD if key in facts]
    if others := facts.get("other_lidar_topics"):
        told.append(f"not read: {' '.join(others)} (--topic chooses)")
    return "; ".join(told)


def _in_file(path: Path) -> Detected | None:
    try:
        with path.open("rb") as file:
            head = file.read(64)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from error
    for magic, found in _MAGIC:
        if head.startswith(magic):
            return Detected(path, found, "content")
    if ringsurvey.is_survey(path):
        return Detected(path, RINGS, "content")
    if found_by_name := _SUFFIX.get(path.suffix.lower()):
        return Detected(path, found_by_name, "name")
    return None


def _in_folder(path: Path) -> Detected | None:
    if (path / "metadata.yaml").is_file():
        return Detected(path, "rosbag2", "content")
    bags = [file for file in sorted(path.iterdir()) if file.suffix in (".mcap", ".db3", ".bag")]
    if len(bags) == 1:
        return _in_file(bags[0])
    if len(bags) > 1:
        raise RecordingError(f"{path}: holds {len(bags)} bags and no metadata.yaml; name one of them")
    surveys = [file for file in sorted(path.iterdir()) if file.is_file() and ringsurvey.is_survey(file)]
    if len(surveys) == 1:
        return Detected(surveys[0], RINGS, "content")
    if surveys:
        names = ", ".join(file.name for file in surveys)
        raise RecordingError(f"{path}: holds {len(surveys)} ring surveys ({names}); name one")
    return Detected(path, "scans", "content") if scanfolder.scan_files(path) else None
