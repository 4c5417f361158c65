"""A folder with one file a sweep (PCD, PLY or KITTI .bin) and their times, from a list or from the files' names."""

import re
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from scene.errors import RecordingError
from scene.reading import pcd, ply
from scene.reading.cause import cause
from scene.reading.pointtimes import FIELDS, make_scan
from scene.reading.scan import Scan
from scene.reading.source import stacked

_SUFFIXES = (".pcd", ".ply", ".bin")
_LISTS = ("times.txt", "timestamps.txt")
# Whole numbers as names are times since 1970, in the unit that puts them after 1973; smaller ones only count.
_NAME_UNITS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3), (1e8, 1.0))
_KITTI = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])


class _NoTopics:
    """Stands for a bag's reader: a folder holds nothing beside its scans."""

    connections: tuple[Any, ...] = ()

    def messages(self, **_: Any) -> Iterator[Any]:
        """None."""
        return iter(())


class ScanFolder:
    """A folder of timed scans.

    Attributes:
        reader: Empty: there is nothing beside the LiDAR.
        topic: The folder's name.
        scan_count: Files.
        facts: What was detected; the convention of point times is known after the first scan.

    Raises:
        RecordingError: No scans, or no times for them.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.topic, self.reader = path, path.name, _NoTopics()
        self._files = scan_files(path)
        if not self._files:
            raise RecordingError(f"{path}: holds no scans ({', '.join(_SUFFIXES)})")
        self.scan_count = len(self._files)
        self._times, source = self._find_times()
        suffix = self._files[0].suffix.lower()
        self.facts: dict[str, Any] = {
            "kind": "folder of scans",
            "format": {".bin": "KITTI bin", ".pcd": "PCD", ".ply": "PLY"}[suffix],
            "times": source,
        }

    def close(self) -> None:
        """Nothing is held open."""

    def deserialize(self, raw: bytes, message_type: str) -> Any:
        """A folder holds no messages."""
        raise RecordingError(f"{self.path}: holds no {message_type}")

    def scans(self, skip: int = 0) -> Iterator[Scan]:
        """The scans in the order of their names.

        Args:
            skip: Scans at the start that are not read.

        Raises:
            RecordingError: A file is damaged; says which.
        """
        for file, stamp in zip(self._files[skip:], self._times[skip:], strict=True):
            try:
                records = _read(file)
                name = next((name for name in FIELDS if name in (records.dtype.names or ())), None)
                points = stacked(records).astype(np.float32)
                scan, convention = make_scan(stamp, points, None if name is None else records[name], name or "")
            except Exception as error:  # the libraries raise anything on damage
                raise RecordingError(f"{file}: not a readable scan ({cause(error)})") from error
            if convention:
                self.facts.setdefault("point_times", convention)
            yield scan

    def _find_times(self) -> tuple[list[float], str]:
        for place in (self.path, self.path.parent):
            for name in _LISTS:
                if (place / name).is_file():
                    return self._listed(place / name), name
        times = [_time_in_name(file.stem) for file in self._files]
        if None in times:
            without = self._files[times.index(None)]
            raise RecordingError(
                f"{without}: its name gives no time, and there is no {' or '.join(_LISTS)} beside the scans"
            )
        return [time for time in times if time is not None], "file names"

    def _listed(self, path: Path) -> list[float]:
        try:
            lines = [line.strip() for line in path.read_text("utf-8-sig").splitlines() if line.strip()]
        except (OSError, UnicodeDecodeError) as error:
            raise RecordingError(f"{path}: cannot be read ({cause(error)})") from error
        if len(lines) != len(self._files):
            raise RecordingError(f"{path}: holds {len(lines)} times for {len(self._files)} scans")
        times = []
        for index, line in enumerate(lines):
            time = _listed_time(line)
            if time is None:
                raise RecordingError(f"{path}: line {index + 1} is no time: {line[:40]!r}")
            times.append(time)
        return times


def scan_files(path: Path) -> list[Path]:
    """The scans in a folder, of the one suffix that most have, in the order of the numbers in their names."""
    files = [file for file in path.iterdir() if file.is_file() and file.suffix.lower() in _SUFFIXES]
    if not files:
        return []
    suffixes = [file.suffix.lower() for file in files]
    most = max(_SUFFIXES, key=suffixes.count)
    return sorted((f for f in files if f.suffix.lower() == most), key=_order)


def _order(file: Path) -> tuple[list[int], str]:
    return [int(digits) for digits in re.findall(r"\d+", file.stem)], file.name


def _time_in_name(stem: str) -> float | None:
    numbers = re.findall(r"\d+(?:\.\d+)?", stem)
    if not numbers:
        return None
    if "." in numbers[-1]:
        return float(numbers[-1])
    value = int(numbers[-1])
    if len(numbers) > 1 and len(numbers[-1]) == 9 and int(numbers[-2]) >= 1e8:
        return int(numbers[-2]) + value * 1e-9  # seconds_nanoseconds
    return next((value * scale for least, scale in _NAME_UNITS if value >= least), None)


def _listed_time(line: str) -> float | None:
    """Seconds (KITTI odometry), whole nanoseconds, or a date with a time of day (KITTI raw)."""
    try:
        if re.fullmatch(r"\d{11,}", line):
            return next(int(line) * scale for least, scale in _NAME_UNITS if int(line) >= least)
        if re.match(r"\d{4}-\d\d-\d\d[ T]", line):
            whole, _, fraction = line.partition(".")
            return datetime.fromisoformat(whole).replace(tzinfo=UTC).timestamp() + float(f"0.{fraction or 0}")
        value = float(line.split()[-1].rstrip(","))
    except (ValueError, IndexError):
        return None
    return value if np.isfinite(value) else None


def _read(file: Path) -> np.ndarray:
    suffix = file.suffix.lower()
    if suffix != ".bin":
        return ply.records(file) if suffix == ".ply" else pcd.records(file)
    size = file.stat().st_size
    if size % _KITTI.itemsize:
        raise ValueError(f"{size} bytes are no whole number of {_KITTI.itemsize}-byte points")
    return np.fromfile(file, _KITTI)
