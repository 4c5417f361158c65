"""PTX clouds: one or more scans of a tripod, each with its own place, as text.

A scan has ten lines before its points: columns, rows, place of the scanner, its three axes, and a matrix of four lines
that takes a row of coordinates from the right (x, y, z, 1). A point at the origin is a direction without return.
"""

from collections import Counter
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import IO

import numpy as np
from jaxtyping import Float

from scene.reading.source import BATCH, CloudSource

_HEADER = 10  # lines
_MOST = 1 << 33  # points of a scan


def open_ptx(path: Path) -> CloudSource:
    """Opens all scans of a PTX file, in the file's frame, m; raises `ValueError`, which names the line at fault."""
    left_out: Counter[str] = Counter()

    def chunks() -> Iterator[np.ndarray]:
        left_out.clear()
        with path.open(encoding="ascii", errors="replace") as file:
            line = 1
            while header := list(islice(file, _HEADER)):
                if not "".join(header).strip():
                    return
                count, matrix = _read_header(header, line)
                line += _HEADER
                for start in range(0, count, BATCH):
                    rows = _read_points(file, min(BATCH, count - start), line + start)
                    back = (rows != 0).any(axis=1)
                    if not back.all():
                        left_out["no_return"] += int((~back).sum())
                    yield rows[back] @ matrix[:3, :3] + matrix[3, :3]
                line += count

    first = next(chunks(), np.empty((0, 3)))
    return CloudSource("PTX", chunks, first[:: max(len(first) // 2000, 1)], "m", left_out=left_out)


def _read_header(lines: list[str], first: int) -> tuple[int, Float[np.ndarray, "4 4"]]:
    """Return the number of points of a scan, and its matrix; `first` is the number of its first line."""
    try:
        numbers = [[float(word) for word in line.split()] for line in lines]
        columns, rows = int(numbers[0][0]), int(numbers[1][0])
        matrix = np.array(numbers[6:])
        if [len(row) for row in numbers] != [1, 1, 3, 3, 3, 3, 4, 4, 4, 4] or not 0 <= columns * rows < _MOST:
            raise ValueError
        return columns * rows, matrix
    except (ValueError, IndexError) as error:
        raise ValueError(f"lines {first} to {first + _HEADER - 1} are no header of a PTX scan") from error


def _read_points(file: IO[str], count: int, first: int) -> Float[np.ndarray, "n 3"]:
    """Return x, y and z of the next lines; `first` is the number of the first."""
    lines = list(islice(file, count))
    if len(lines) < count:
        raise ValueError(f"it ends at line {first + len(lines)}, {count - len(lines)} points before its header says")
    try:
        return np.loadtxt(lines, usecols=(0, 1, 2), ndmin=2)
    except ValueError as error:
        bad = next((k for k, line in enumerate(lines) if not _holds_point(line)), 0)
        raise ValueError(f"line {first + bad} holds no point: {lines[bad].strip()[:60]!r}") from error


def _holds_point(line: str) -> bool:
    try:
        return len([float(word) for word in line.split()[:3]]) == 3
    except ValueError:
        return False
