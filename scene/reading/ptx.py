"""PTX clouds: one or more scans of a tripod, each with its own place, as text.

A scan has ten lines before its points: columns, rows, place of the scanner, its three axes, and a matrix of four lines
that takes a row of coordinates from the right (x, y, z, 1). A point at the origin is a direction without return.
"""

from collections import Counter
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import Float

from scene.reading.source import BATCH, CloudSource, Lines

_HEADER = 10  # lines
_MOST = 1 << 33  # points of a scan


def open_ptx(path: Path) -> CloudSource:
    """Opens all scans of a PTX file, in the file's frame, m; raises `ValueError`, which names the line at fault."""
    left_out: Counter[str] = Counter()
    text = Lines(path, (0, 1, 2))

    def chunks() -> Iterator[np.ndarray]:
        left_out.clear()
        with path.open("rb") as file:
            line = 1
            while header := list(islice(file, _HEADER)):
                if not b"".join(header).strip():
                    return
                count, matrix = _read_header(header, line)
                line += _HEADER
                for start in range(0, count, BATCH):
                    lines = list(islice(file, min(BATCH, count - start)))
                    rows = text.parse(b"".join(lines), line + start)
                    if len(rows) < min(BATCH, count - start):
                        left = count - start - len(rows)
                        raise ValueError(f"it ends {left} of {count} points before a scan's header says")
                    back = (rows != 0).any(axis=1)
                    if not back.all():
                        left_out["no_return"] += int((~back).sum())
                    yield rows[back] @ matrix[:3, :3] + matrix[3, :3]
                line += count

    first = next(chunks(), np.empty((0, 3)))
    return CloudSource("PTX", chunks, first[:: max(len(first) // 2000, 1)], "m", left_out=left_out)


def _read_header(lines: list[bytes], first: int) -> tuple[int, Float[np.ndarray, "4 4"]]:
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
