"""PCD clouds: the header by `pypcd4`; binary data mapped, ASCII in blocks of lines, compressed data whole."""

import struct
from pathlib import Path

import lzf
import numpy as np
from pypcd4.pypcd4 import Encoding, MetaData

from scene.reading.source import CloudSource, from_records
from scene.reading.text import Lines

_HEADER_LIMIT = 1 << 16
_LARGEST_RATIO = 100  # LZF copies at most 264 bytes by 3


def open_cloud(path: Path) -> CloudSource:
    """The points of a PCD file.

    Raises:
        ValueError: Damaged, or with fewer bytes than its header promises.
    """
    meta, start, line = _header(path)
    if meta.data is Encoding.ASCII:
        names = _column_names(meta)
        missing = [name for name in "xyz" if name not in names]
        if missing:
            raise ValueError(f"it has no field {', '.join(missing)}")
        text = Lines(path, tuple(names.index(n) for n in "xyz"), start=start, line=line, count=meta.points)
        first = next(text.rows(), np.empty((0, 3))) if meta.points else np.empty((0, 3))
        return CloudSource("PCD ascii", text.rows, first)
    return from_records(f"PCD {meta.data.value}", records(path))


def records(path: Path) -> np.ndarray:
    """All points with all their fields; uncompressed ones stay on disk until they are touched.

    Raises:
        ValueError: Damaged, or with fewer bytes than its header promises.
    """
    meta, start, line = _header(path)
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
        _require(meta.points * kind.itemsize, body)
        return np.memmap(path, kind, "r", start, (meta.points,))
    return _compressed(path, start, body, meta.points, kind)


def _header(path: Path) -> tuple[MetaData, int, int]:
    """The header, the byte after it, and the number of the line after it."""
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


def _require(promised: int, body: int) -> None:
    if promised > body:
        raise ValueError(f"its header promises {promised} bytes of points, but only {body} follow")


def _compressed(path: Path, start: int, body: int, points: int, kind: np.dtype) -> np.ndarray:
    size = points * kind.itemsize
    _require(size, body * _LARGEST_RATIO)
    with path.open("rb") as file:
        file.seek(start)
        packed, unpacked = struct.unpack("<II", file.read(8))
        _require(packed, body - 8)
        if unpacked < size:
            raise ValueError(f"its {points} points take {size} bytes, but it holds {unpacked}")
        _require(unpacked, body * _LARGEST_RATIO)
        data = lzf.decompress(file.read(packed), unpacked)
    if data is None or len(data) != unpacked:
        raise ValueError("its compressed data is damaged")
    out, offset = np.empty(points, kind), 0
    for name in kind.names or ():
        out[name] = np.frombuffer(data, kind[name], points, offset)
        offset += points * kind[name].itemsize
    return out
