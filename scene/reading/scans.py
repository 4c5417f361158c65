"""Sweeps as readers of recordings return them, and folders of sweeps.

A folder has one file a sweep (PCD, PLY or KITTI .bin), and times from a list or from the files' names.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from scene.errors import RecordingError
from scene.reading.ply_pcd import read_pcd_records, read_ply_records
from scene.reading.source import cause, stack_points
from scene.reading.times import RawScan, make_scan, seconds_in, time_field


class ScanSource:
    """An open recording, as a reader returns it.

    Attributes:
        path: The recording, for messages.
        topic: The LiDAR topic; the file's or folder's name where there are no topics.
        scan_count: Number of scans.
        facts: Detected facts, for people and the manifest; `kind` is needed.
        reader: A bag's reader, for the IMU beside the LiDAR: `connections` and `messages(connections=…)`; else `None`.
    """

    path: Path
    topic: str
    scan_count: int
    facts: dict[str, Any]
    reader: Any = None

    def __init__(
        self,
        path: Path,
        scan_count: int,
        facts: dict[str, Any],
        read: Callable[[int], RawScan],
        close: Callable[[], None] = lambda: None,
    ) -> None:
        """Describes the recording.

        `read` reads the scan of a number from 0, as `make_scan` returns it. It may raise anything on damage.
        """
        self.path, self.topic, self.scan_count, self.facts = path, path.name, scan_count, facts
        self._read, self._close = read, close

    def scans(self, only: frozenset[int] | None = None) -> Iterator[RawScan]:
        """Yields all scans, or `only` those of some numbers; `RecordingError` says which is damaged."""
        for index in range(self.scan_count) if only is None else sorted(only):
            try:
                raw = self._read(index)
            except RecordingError:
                raise
            except Exception as error:  # readers and their libraries raise anything on damage
                raise RecordingError(f"{self.path}: scan {index} is not readable ({cause(error)})") from error
            yield raw

    def close(self) -> None:
        self._close()

    def deserialize(self, raw: bytes, message_type: str) -> Any:
        raise RecordingError(f"{self.path}: holds no {message_type}")


def scan_from_records(stamp: float, records: Shaped[np.ndarray, " n"]) -> RawScan:
    """Return a sweep from points with fields x, y, z (m) and perhaps a time, in any unit.

    Raises `ValueError` where a coordinate is missing.
    """
    name, unit = time_field(records.dtype.names or ())
    points = stack_points(records).astype(np.float32)
    intensity = points[:, 3] if points.shape[1] > 3 else None
    scan = make_scan(stamp, points[:, :3], None if name is None else records[name], name or "", intensity)
    return replace(scan, unit=unit)


_FORMATS = {".pcd": "PCD", ".ply": "PLY", ".bin": "KITTI bin"}
_LISTS = ("times.txt", "timestamps.txt")
_LEAST = 10**8  # s since 1970; smaller numbers in names only count
_KITTI = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])


def open_folder(path: Path, topic: str | None = None) -> ScanSource:
    """Opens a folder of timed scans, in the order of their names; `topic` is not used.

    Raises `RecordingError` where there are no scans, or no times for them.
    """
    files = scan_files(path)
    if not files:
        raise RecordingError(f"{path}: holds no scans ({', '.join(_FORMATS)})")
    times, source = _find_times(path, files)

    def read(index: int) -> RawScan:
        try:
            return scan_from_records(times[index], _read_records(files[index]))
        except Exception as error:  # the libraries raise anything on damage
            raise RecordingError(f"{files[index]}: not a readable scan ({cause(error)})") from error

    facts = {"kind": "folder of scans", "format": _FORMATS[files[0].suffix.lower()], "times": source}
    return ScanSource(path, len(files), facts, read)


def scan_files(path: Path) -> list[Path]:
    """Return the scans in a folder, of the one suffix that most have, in the order of the numbers in their names."""
    files = [file for file in path.iterdir() if file.is_file() and file.suffix.lower() in _FORMATS]
    if not files:
        return []
    suffixes = [file.suffix.lower() for file in files]
    most = max(_FORMATS, key=suffixes.count)
    chosen = [file for file in files if file.suffix.lower() == most]
    return sorted(chosen, key=lambda file: ([int(digits) for digits in re.findall(r"\d+", file.stem)], file.name))


def _find_times(path: Path, files: list[Path]) -> tuple[list[float], str]:
    """Time of each scan, s, and where it was found."""
    for folder in (path, path.parent):
        for name in _LISTS:
            if (folder / name).is_file():
                return _read_list(folder / name, len(files)), name
    times = [_time_in_name(file.stem) for file in files]
    if None in times:
        file = files[times.index(None)]
        raise RecordingError(f"{file}: its name gives no time, and there is no {' or '.join(_LISTS)} beside the scans")
    return [time for time in times if time is not None], "file names"


def _read_list(path: Path, count: int) -> list[float]:
    try:
        lines = [line.strip() for line in path.read_text("utf-8-sig").splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: cannot be read ({cause(error)})") from error
    if len(lines) != count:
        raise RecordingError(f"{path}: holds {len(lines)} times for {count} scans")
    times = [_time_in_line(line) for line in lines]
    if None in times:
        index = times.index(None)
        raise RecordingError(f"{path}: line {index + 1} is no time: {lines[index][:40]!r}")
    return [time for time in times if time is not None]


def _time_in_name(stem: str) -> float | None:
    numbers = re.findall(r"\d+(?:\.\d+)?", stem)
    if not numbers:
        return None
    if "." in numbers[-1]:
        return float(numbers[-1])
    value = int(numbers[-1])
    if len(numbers) > 1 and len(numbers[-1]) == 9 and int(numbers[-2]) >= _LEAST:
        return int(numbers[-2]) + value * 1e-9  # seconds_nanoseconds
    return value * seconds_in(value) if value >= _LEAST else None


def _time_in_line(line: str) -> float | None:
    """Seconds (KITTI odometry), whole nanoseconds, or a date with a time of day (KITTI raw)."""
    try:
        if re.fullmatch(r"\d{11,}", line):
            return int(line) * seconds_in(int(line))
        if re.match(r"\d{4}-\d\d-\d\d[ T]", line):
            whole, _, fraction = line.partition(".")
            return datetime.fromisoformat(whole).replace(tzinfo=UTC).timestamp() + float(f"0.{fraction or 0}")
        value = float(line.split()[-1].rstrip(","))
    except (ValueError, IndexError):
        return None
    return value if np.isfinite(value) else None


def _read_records(file: Path) -> np.ndarray:
    suffix = file.suffix.lower()
    if suffix != ".bin":
        return read_ply_records(file) if suffix == ".ply" else read_pcd_records(file)
    size = file.stat().st_size
    if size % _KITTI.itemsize:
        raise ValueError(f"{size} bytes are no whole number of {_KITTI.itemsize}-byte points")
    return np.fromfile(file, _KITTI)
