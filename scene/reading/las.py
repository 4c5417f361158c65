"""LAS and LAZ clouds through `laspy` and `lazrs`, a chunk at a time."""

import struct
from collections.abc import Iterator
from pathlib import Path

import laspy
import lazrs
import numpy as np
from laspy.vlrs.known import LasZipVlr

from scene.reading.lasunit import declared_unit
from scene.reading.source import BATCH, CloudSource

_LARGEST_CHUNK = 10_000_000  # points; LASzip writes 50,000


def open_cloud(path: Path) -> CloudSource:
    """The points of a LAS or LAZ file.

    Raises:
        ValueError: Damaged, or with fewer bytes than its header promises.
    """
    _require_sane_header(path)
    with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as reader:
        header = reader.header
        size = header.point_format.size * header.point_count
        compressed = bool(header.are_points_compressed)
        follow = path.stat().st_size - header.offset_to_point_data
        if follow < 0 or (not compressed and size > follow):
            raise ValueError(f"its header promises {header.point_count} points, but only {follow} bytes follow")
        scales, offsets = np.asarray(header.scales), np.asarray(header.offsets)
        if not (np.isfinite([scales, offsets]).all() and (scales != 0).all()):
            raise ValueError(f"its scales {scales} and offsets {offsets} are no numbers to use")
        box = np.array([header.mins, header.maxs], np.float64)
        kind = "LAZ" if compressed else "LAS"
        if compressed:
            _require_sane_chunks(path, header)
        name = f"{kind} {header.version}, point format {header.point_format.id}"
        count = header.point_count
        unit = declared_unit([*header.vlrs, *(header.evlrs or [])])

    def chunks() -> Iterator[np.ndarray]:
        read = 0
        # The parallel decoder believes every size in the chunk table, and a wrong one ends the process.
        with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as reader:
            for points in reader.chunk_iterator(BATCH):
                yield np.stack([np.asarray(points.x), np.asarray(points.y), np.asarray(points.z)], axis=1)
                read += len(points)
        if read != count:
            raise ValueError(f"it ends after {read} of {count} points")

    return CloudSource(name, chunks, box, unit, count)


def _require_sane_header(path: Path) -> None:
    """Refuses counts that the library would loop over or allocate for without looking at the file.

    Source: ASPRS LAS 1.4 R15, public header block.
    """
    end = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(375)
    if len(head) < 227 or not head.startswith(b"LASF"):
        raise ValueError("its header is cut short")
    size, start, records = struct.unpack_from("<HII", head, 94)
    if not 227 <= size <= start <= end or records * 54 > start - size:
        raise ValueError(f"its header of {size} bytes claims {records} records before byte {start} of {end}")
    if head[24:26] >= b"\x01\x04" and len(head) >= 255:
        first, extended = struct.unpack_from("<QI", head, 235)
        if extended and (first > end or extended * 60 > end - first):
            raise ValueError(f"its header claims {extended} extended records from byte {first} of {end}")


def _require_sane_chunks(path: Path, header: laspy.LasHeader) -> None:
    """Refuses sizes that the decoder would allocate for without looking at the file.

    Source: LASzip specification 3.4: the first 8 bytes of the points say where the chunk table is, which starts with a
    version and the number of chunks.
    """
    record = next((v.record_data for v in header.vlrs if isinstance(v, LasZipVlr)), None)
    if record is None:
        raise ValueError("it has no LASzip record")
    vlr = lazrs.LazVlr(record)
    if vlr.item_size() != header.point_format.size:
        raise ValueError(f"its LASzip record is for points of {vlr.item_size()} bytes, not {header.point_format.size}")
    if not vlr.uses_variable_size_chunks() and not 0 < vlr.chunk_size() <= _LARGEST_CHUNK:
        raise ValueError(f"its chunks claim {vlr.chunk_size()} points each")
    end = path.stat().st_size
    with path.open("rb") as file:
        file.seek(header.offset_to_point_data)
        (table,) = struct.unpack("<q", file.read(8))
        if table == -1:  # written as a stream: the place is at the very end
            file.seek(-8, 2)
            (table,) = struct.unpack("<q", file.read(8))
        if not header.offset_to_point_data < table <= end - 8:
            raise ValueError(f"its chunk table would be at byte {table} of {end}")
        file.seek(table)
        _, count = struct.unpack("<II", file.read(8))
    if count > header.point_count:
        raise ValueError(f"its chunk table claims {count} chunks for {header.point_count} points")
