"""The table of input formats: its rows, rows of a user's own, and the search for the format of an input."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from scene.errors import RecordingError
from scene.reading.las_e57 import open_e57, open_las
from scene.reading.ply_pcd import open_pcd, open_ply
from scene.reading.ringsurvey import is_ring_survey, read_ring_survey
from scene.reading.rosbag import RosBag
from scene.reading.scans import open_folder, scan_files
from scene.reading.tables import open_ptx, open_table
from scene.reading.times import TimeConfig
from subterra_jax.host.loading import UserCodeError, load_module

Kind = Literal["recording", "cloud", "rings"]
_SHOWN_FACTS = ("format", "topic", "message_type", "times", "point_times", "unit", "axes", "crs")
# Flags without the path of the nested configs before them: `--unit mm`, not `--reconstruct.reading.unit mm`.
_FLAG = tyro.conf.arg(prefix_name=False)


@dataclass(frozen=True)
class ReadingConfig:
    """Facts about an input that the user gives, in place of detection."""

    topic: Annotated[str | None, _FLAG] = None  # LiDAR topic of a bag; found by its type where not given.
    # Format of the input: bag, rosbag2, mcap, db3, scans, ply, pcd, las, e57, table, rings.
    format: Annotated[str | None, _FLAG] = None
    # Unit of a registered cloud or a ring survey: m, cm, mm, ft or us-ft.
    unit: Annotated[str | None, _FLAG] = None
    # Axes of a registered cloud that point east, north and up, such as xyz, xzy or -yxz.
    axes: Annotated[str | None, _FLAG] = None
    # Order of the quaternions of a trajectory: xyzw, as TUM has it, or wxyz; found by the scans where not given.
    quaternion: Annotated[Literal["xyzw", "wxyz"] | None, _FLAG] = None
    # Sets the clock of the IMU, or of a trajectory, right where its turns show that it differs from the LiDAR's.
    clock: Annotated[Literal["auto"] | None, _FLAG] = None
    times: Annotated[TimeConfig, tyro.conf.arg(name="")] = field(default_factory=TimeConfig)  # Times of points.
    # Use points of a LAS file that are withheld or classified as noise, too.
    keep_noise: Annotated[bool, _FLAG] = False
    # Columns of a table or a ring survey by what they hold, as x=Rechtswert,y=Hochwert,z=Hoehe,ring=Ring,point=Punkt.
    columns: Annotated[str | None, _FLAG] = None


@dataclass(frozen=True)
class Format:
    """One row of the table."""

    name: str  # Word for `--format`
    label: str  # Name for people
    kind: Kind  # `recording`, `cloud` or `rings`
    # Opens a file: a recording as `(path, topic) -> ScanSource`, a bag with further ones of its recording as well; a
    # cloud as `path -> CloudSource`; rings as `(path, unit) -> RingSurvey`; tables and rings take the user's columns
    open: Callable[..., Any]
    suffixes: tuple[str, ...] = ()  # Endings of file names, lower case
    magic: tuple[bytes, ...] = ()  # First bytes of a file, at most 64; any of them


_TABLE = (
    Format("bag", "ROS1 bag", "recording", partial(RosBag, "bag"), (".bag",), (b"#ROSBAG",)),
    Format("rosbag2", "ROS2 bag", "recording", partial(RosBag, "rosbag2")),
    Format("mcap", "MCAP file", "recording", partial(RosBag, "mcap"), (".mcap",), (b"\x89MCAP0\r\n",)),
    Format("db3", "ROS2 bag", "recording", partial(RosBag, "db3"), (".db3",), (b"SQLite format 3\x00",)),
    Format("scans", "folder of scans", "recording", open_folder),
    Format("ply", "PLY", "cloud", open_ply, (".ply",), (b"ply\n", b"ply\r")),
    Format("pcd", "PCD", "cloud", open_pcd, (".pcd",), (b"# .PCD", b"VERSION ")),
    Format("las", "LAS", "cloud", open_las, (".las", ".laz"), (b"LASF",)),
    Format("e57", "E57", "cloud", open_e57, (".e57",), (b"ASTM-E57",)),
    Format("ptx", "PTX", "cloud", open_ptx, (".ptx",)),
    Format("table", "table", "cloud", open_table, (".xyz", ".csv", ".txt", ".asc", ".pts")),
    Format("rings", "ring survey", "rings", read_ring_survey, (".xlsx",)),
)
_PACKED = {b"\x28\xb5\x2f\xfd": "zstd -d", b"\x1f\x8b": "gzip -d", b"BZh": "bzip2 -d", b"\xfd7zXZ": "xz -d"}
_own: dict[str, Format] = {}


@dataclass(frozen=True)
class Detected:
    """An input and its format."""

    path: Path  # The file or folder to open; inside the input where that is a folder with one file
    format: Format  # Row of the table
    by: str  # Way it was found: `content`, `name` or `flag`


def register_reader(
    name: str,
    open: Callable[..., Any],
    *,
    kind: Kind = "recording",
    label: str = "",
    suffixes: tuple[str, ...] = (),
    magic: tuple[bytes, ...] = (),
) -> None:
    """Adds a row to the table of formats; it is tried before those of this package.

    A row of the same name that was added before is replaced.

    Args:
        name: Word for `--format`.
        open: Opens a file; see `Format`.
        kind: `recording` or `cloud`.
        label: Name for people; `name` where not given.
        suffixes: Endings of file names, lower case, such as `.zip`.
        magic: First bytes of a file, at most 64; any of them.

    Raises:
        ValueError: The name belongs to a format of this package, or the kind is neither of the two.
    """
    if name in {row.name for row in _TABLE}:
        raise ValueError(f"format {name!r} is one of this package; choose another name")
    if kind not in ("recording", "cloud"):
        raise ValueError(f"kind must be recording or cloud, got {kind!r}")
    _own[name] = Format(name, label or name, kind, open, suffixes, magic)


def load_reader(source: str) -> None:
    """Runs a file or module of the user's; raises `UserCodeError` where that fails, or no reader is registered."""
    load_module(source)
    if not _own:
        raise UserCodeError(f"{source}: registers no reader")


def detect(path: Path, name: str | None = None) -> Detected:
    """Finds the format of an input by its first bytes, then by its name; a format's `name` takes the place of both.

    Raises `RecordingError` for an input of no known kind and for the name of no format.
    """
    rows = {row.name: row for row in (*_own.values(), *_TABLE)}
    if name is not None:
        if name not in rows:
            raise RecordingError(f"{path}: format {name!r} is none of {', '.join(rows)}")
        return Detected(path, rows[name], "flag")
    detected = _detect_in_folder(path, rows) if path.is_dir() else _detect_file(path, rows)
    if detected is None:
        own = "".join(f", {row.label}" for row in _own.values())
        raise RecordingError(
            f"{path}: of no known kind; a ROS bag or MCAP, a folder of timed scans, a cloud (PLY, PCD, LAS, LAZ, E57, "
            f"PTX, XYZ, CSV) or a ring survey (CSV, XLSX){own} is needed"
        )
    return detected


_LEFT_OUT = {
    "points_without_time": "points without a time of their sweep",
    "scans_out_of_order": "scans out of order",
    "scans_without_pose": "scans without a pose",
}


def left_out(facts: dict[str, Any]) -> str:
    """Return what of an input was left out, and why, for people; empty where nothing was."""
    known = [f"{facts[key]:,} {words}" for key, words in _LEFT_OUT.items() if facts.get(key)]
    clouds = facts.get("points_left_out", {}).items()
    return ", ".join([*known, *(f"{count:,} points ({why.replace('_', ' ')})" for why, count in clouds)])


def describe(facts: dict[str, Any]) -> str:
    """Return what was detected of a recording, a cloud or a survey, in one line for people."""
    parts = [f"{facts['kind']}"]
    parts += [f"{key.replace('_', ' ')} {facts[key]}" for key in _SHOWN_FACTS if key in facts]
    if dropped := left_out(facts):
        parts.append(f"left out: {dropped}")
    if others := facts.get("other_lidar_topics"):
        parts.append(f"not read: {' '.join(others)} (--topic chooses)")
    return "; ".join(parts)


def _detect_file(path: Path, rows: dict[str, Format]) -> Detected | None:
    try:
        with path.open("rb") as file:
            head = file.read(64)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from error
    for row in rows.values():
        if row.magic and head.startswith(row.magic):
            return Detected(path, row, "content")
    suffix = path.suffix.lower()
    own = next((row for row in _own.values() if suffix in row.suffixes), None)
    if own is None and is_ring_survey(path):
        return Detected(path, rows["rings"], "content")
    packed = next((tool for magic, tool in _PACKED.items() if head.startswith(magic)), None)
    if own is None and packed is not None:
        raise RecordingError(f"{path}: is compressed; decompress it first: {packed} {path.name}")
    row_by_name = own or next((row for row in _TABLE if suffix in row.suffixes), None)
    return None if row_by_name is None else Detected(path, row_by_name, "name")


def _detect_in_folder(path: Path, rows: dict[str, Format]) -> Detected | None:
    if (path / "metadata.yaml").is_file():
        return Detected(path, rows["rosbag2"], "content")
    files = sorted(path.iterdir())
    bags = [file for file in files if file.suffix in (".mcap", ".db3", ".bag")]
    if len(bags) == 1:
        return _detect_file(bags[0], rows)
    if len(bags) > 1:
        kinds = {file.suffix[1:] for file in bags}
        if len(kinds) > 1:
            raise RecordingError(f"{path}: holds bags of several kinds ({', '.join(sorted(kinds))}); name those of one")
        return Detected(path, rows[kinds.pop()], "content")  # a recording that was split
    surveys = [file for file in files if file.is_file() and is_ring_survey(file)]
    if len(surveys) == 1:
        return Detected(surveys[0], rows["rings"], "content")
    if surveys:
        names = ", ".join(file.name for file in surveys)
        raise RecordingError(f"{path}: holds {len(surveys)} ring surveys ({names}); name one")
    if scan_files(path):
        return Detected(path, rows["scans"], "content")
    folders = [file for file in files if file.is_dir()]
    return _detect_in_folder(folders[0], rows) if len(folders) == 1 else None  # as archives unpack
