"""PLY and PCD clouds: binary ones mapped from disk, ASCII ones read in blocks of lines."""

import re
import struct
from pathlib import Path

import lzf
import numpy as np
from plyfile import PlyData
from pypcd4.pypcd4 import Encoding, MetaData

from scene.reading.source import CloudSource, Lines, source_from_records, source_from_text

_HEADER_LIMIT = 1 << 16  # bytes; a longer header is none
_PLY_BYTES = {"char": 1, "uchar": 1, "short": 2, "ushort": 2, "int": 4, "uint": 4, "float": 4, "double": 8}
_PLY_BYTES |= {"int8": 1, "uint8": 1, "int16": 2, "uint16": 2, "int32": 4, "uint32": 4, "float32": 4, "float64": 8}


def open_ply(path: Path) -> CloudSource:
    """Opens the vertices of a PLY file; raises `ValueError` for damage, or fewer bytes than its header promises."""
    lines, size = _ply_header(path)
    form = lines[1].split()[1] if len(lines) > 1 and lines[1].startswith("format ") else "unknown"
    count, names, first = _ply_vertices(lines, path.stat().st_size - size, form == "ascii")
    if form == "ascii" and first:
        return source_from_text("PLY ascii", path, names, size, len(lines) + 1, count)
    return source_from_records(f"PLY {form}", read_ply_records(path))


def read_ply_records(path: Path) -> np.ndarray:
    """Reads all vertices with all their properties, as `open_ply`; binary ones stay on disk until they are touched."""
    lines, size = _ply_header(path)
    _ply_vertices(lines, path.stat().st_size - size, "format ascii 1.0" in lines)
    return PlyData.read(str(path), mmap="c")["vertex"].data


def _ply_header(path: Path) -> tuple[list[str], int]:
    """Return the header's lines, and its size in bytes."""
    with path.open("rb") as file:
        head = file.read(_HEADER_LIMIT)
    end = re.search(rb"^end_header\r?\n", head, re.MULTILINE)
    if not head.startswith(b"ply") or end is None:
        raise ValueError("its header does not start with ply, or does not end")
    return head[: end.start()].decode("ascii", "replace").splitlines(), end.end()


def _ply_vertices(lines: list[str], body: int, ascii_form: bool) -> tuple[int, list[str], bool]:
    """Number of vertices, names of their properties, and whether they are the first element.

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
        least = 2 * len(properties) if ascii_form else sum(_PLY_BYTES.get(words[1], 1) for words in properties)
        total += count * max(least, 1)
        if count < 0 or total - ascii_form > body:
            raise ValueError(f"its header promises {count} of element {name}, but only {body} bytes follow")
    vertex = next((element for element in elements if element[0] == "vertex"), None)
    if vertex is None:
        raise ValueError("it has no element vertex")
    return vertex[1], [words[-1] for words in vertex[2]], elements[0][0] == "vertex"


_LARGEST_RATIO = 100  # LZF copies at most 264 bytes by 3


def open_pcd(path: Path) -> CloudSource:
    """Opens the points of a PCD file; raises `ValueError` for damage, or fewer bytes than its header promises."""
    meta, start, line = _pcd_header(path)
    if meta.data is Encoding.ASCII:
        return source_from_text("PCD ascii", path, _column_names(meta), start, line, meta.points)
    return source_from_records(f"PCD {meta.data.value}", read_pcd_records(path))


def read_pcd_records(path: Path) -> np.ndarray:
    """Reads all points with all their fields, as `open_pcd`; uncompressed ones stay on disk until they are touched."""
    meta, start, line = _pcd_header(path)
    kind = meta.build_dtype()
    body = path.stat().st_size - start
    if not meta.points:
        return np.empty(0, kind)
    if meta.data is Encoding.ASCII:
        names = _column_names(meta)
        text = Lines(path, tuple(range(len(names))), start=start, line=line, count=meta.points)
        rows = np.concatenate(list(text.rows()))
        named = np.empty(len(rows), [(name, "f8") for name in names])
        for name, column in zip(names, rows.T, strict=True):
            named[name] = column
        return named
    if meta.data is Encoding.BINARY:
        _require_bytes(meta.points * kind.itemsize, body)
        return np.memmap(path, kind, "r", start, (meta.points,))
    return _read_compressed(path, start, body, meta.points, kind)


def _pcd_header(path: Path) -> tuple[MetaData, int, int]:
    """Return the header, the byte after it, and the number of the line after it."""
    with path.open("rb") as file:
        head = file.read(_HEADER_LIMIT)
    lines, start = [], 0
    for line in head.splitlines(keepends=True):
        lines.append(line.decode("ascii", "replace").strip())
        start += len(line)
        if lines[-1].startswith("DATA"):
            return MetaData.parse_header(lines), start, len(lines) + 1
    raise ValueError("its header has no DATA line")


def _column_names(meta: MetaData) -> list[str]:
    """One name for each number of a line."""
    counted = zip(meta.fields, meta.count, strict=True)
    return [name if k == 0 else f"{name}#{k}" for name, count in counted for k in range(count)]


def _require_bytes(promised: int, body: int) -> None:
    if promised > body:
        raise ValueError(f"its header promises {promised} bytes of points, but only {body} follow")


def _read_compressed(path: Path, start: int, body: int, points: int, kind: np.dtype) -> np.ndarray:
    size = points * kind.itemsize
    _require_bytes(size, body * _LARGEST_RATIO)
    with path.open("rb") as file:
        file.seek(start)
        packed, unpacked = struct.unpack("<II", file.read(8))
        _require_bytes(packed, body - 8)
        if unpacked < size:
            raise ValueError(f"its {points} points take {size} bytes, but it holds {unpacked}")
        _require_bytes(unpacked, body * _LARGEST_RATIO)
        data = lzf.decompress(file.read(packed), unpacked)
    if data is None or len(data) != unpacked:
        raise ValueError("its compressed data is damaged")
    out, offset = np.empty(points, kind), 0
    for name in kind.names or ():
        out[name] = np.frombuffer(data, kind[name], points, offset)
        offset += points * kind[name].itemsize
    return out
