"""PLY clouds: binary ones mapped by `plyfile`, ASCII ones in blocks of lines."""

import re
from pathlib import Path

import numpy as np
from plyfile import PlyData

from scene.reading.source import CloudSource, from_records
from scene.reading.text import Lines

_HEADER_LIMIT = 1 << 16
_BYTES = {"char": 1, "uchar": 1, "short": 2, "ushort": 2, "int": 4, "uint": 4, "float": 4, "double": 8}
_BYTES |= {"int8": 1, "uint8": 1, "int16": 2, "uint16": 2, "int32": 4, "uint32": 4, "float32": 4, "float64": 8}


def open_cloud(path: Path) -> CloudSource:
    """The vertices of a PLY file.

    Raises:
        ValueError: Damaged, or with fewer bytes than its header promises.
    """
    lines, size = _header(path)
    form = lines[1].split()[1] if len(lines) > 1 and lines[1].startswith("format ") else "unknown"
    count, names, first = _vertices(lines, path.stat().st_size - size, form == "ascii")
    if form == "ascii" and first:
        missing = [name for name in "xyz" if name not in names]
        if missing:
            raise ValueError(f"it has no field {', '.join(missing)}")
        columns = tuple(names.index(name) for name in "xyz")
        text = Lines(path, columns, start=size, line=len(lines) + 1, count=count)
        sample = np.concatenate([np.empty((0, 3)), *_first(text)])
        return CloudSource("PLY ascii", text.rows, sample)
    return from_records(f"PLY {form}", records(path))


def records(path: Path) -> np.ndarray:
    """All vertices with all their properties; binary ones stay on disk until they are touched.

    Raises:
        ValueError: Damaged, or with fewer bytes than its header promises.
    """
    lines, size = _header(path)
    _vertices(lines, path.stat().st_size - size, "format ascii 1.0" in lines)
    return PlyData.read(str(path), mmap="c")["vertex"].data


def _header(path: Path) -> tuple[list[str], int]:
    """The header's lines, and its size in bytes."""
    with path.open("rb") as file:
        head = file.read(_HEADER_LIMIT)
    end = re.search(rb"^end_header\r?\n", head, re.MULTILINE)
    if not head.startswith(b"ply") or end is None:
        raise ValueError("its header does not start with ply, or does not end")
    return head[: end.start()].decode("ascii", "replace").splitlines(), end.end()


def _vertices(lines: list[str], body: int, ascii_form: bool) -> tuple[int, list[str], bool]:
    """How many vertices, their properties, and whether nothing comes before them.

    A count that the file cannot hold is refused here, before anything is allocated for it.
    """
    elements: list[tuple[str, int, list[list[str]]]] = []
    for line in lines:
        words = line.split()
        if words[:1] == ["element"] and len(words) == 3:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"] and elements:
            elements[-1][2].append(words)
    total = 0
    for name, count, properties in elements:
        least = 2 * len(properties) if ascii_form else sum(_BYTES.get(words[1], 1) for words in properties)
        total += count * max(least, 1)
        if count < 0 or total - ascii_form > body:
            raise ValueError(f"its header promises {count} of element {name}, but only {body} bytes follow")
    found = next((element for element in elements if element[0] == "vertex"), None)
    if found is None:
        raise ValueError("it has no element vertex")
    return found[1], [words[-1] for words in found[2]], elements[0][0] == "vertex"


def _first(text: Lines) -> list[np.ndarray]:
    return [rows for rows, _ in zip(text.rows(), range(1), strict=False)]
