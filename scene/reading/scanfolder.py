"""A folder with one file a sweep (PCD, PLY or KITTI .bin) and their times, from a list or from the files' names."""

import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from scene.errors import RecordingError
from scene.reading.ply_pcd import read_pcd_records, read_ply_records
from scene.reading.scans import RawScan, ScanSource, scan_from_records
from scene.reading.source import cause

_FORMATS = {".pcd": "PCD", ".ply": "PLY", ".bin": "KITTI bin"}
_LISTS = ("times.txt", "timestamps.txt")
# Whole numbers as names are times since 1970, in the unit that puts them after 1973; smaller ones only count.
_NAME_UNITS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3), (1e8, 1.0))
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
    times = []
    for index, line in enumerate(lines):
        time = _time_in_line(line)
        if time is None:
            raise RecordingError(f"{path}: line {index + 1} is no time: {line[:40]!r}")
        times.append(time)
    return times


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


def _time_in_line(line: str) -> float | None:
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


def _read_records(file: Path) -> np.ndarray:
    suffix = file.suffix.lower()
    if suffix != ".bin":
        return read_ply_records(file) if suffix == ".ply" else read_pcd_records(file)
    size = file.stat().st_size
    if size % _KITTI.itemsize:
        raise ValueError(f"{size} bytes are no whole number of {_KITTI.itemsize}-byte points")
    return np.fromfile(file, _KITTI)
