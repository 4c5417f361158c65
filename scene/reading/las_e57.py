"""LAS, LAZ and E57 clouds, a chunk at a time.

Sources: ASPRS LAS 1.4 R15; OGC 12-063r5 (WKT2), 01-009 (WKT1) and 19-008r4 (GeoTIFF keys and codes of units); ASTM
E2807 (E57: coordinates in metres; a pose is a unit quaternion w, x, y, z and a translation).
"""

import re
import struct
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import laspy
import lazrs
import numpy as np
from jaxtyping import Bool
from laspy.vlrs.known import GeoKeyDirectoryVlr, LasZipVlr, WktCoordinateSystemVlr
from scipy.spatial.transform import Rotation

from scene.errors import RecordingError
from scene.reading.source import BATCH, UNITS, CloudSource

if TYPE_CHECKING:
    from pye57 import E57, ScanHeader

DEGREES = "degrees"
_CODES = {9001: "m", 9002: "ft", 9003: "us-ft"}
_MODEL, _GEOGRAPHIC, _LINEAR, _VERTICAL = 1024, 2, 3076, 4099  # keys of GeoTIFF, and its value for degrees
_SYSTEMS, _USER_DEFINED = (3072, 4096), 32767  # keys of the projected and the vertical system; a code that is none
_WKT_UNIT = re.compile(r'\b(?:LENGTH)?UNIT\[\s*"([^"]*)"\s*,\s*([-+.\deE]+)')
_SAME_FACTOR = 1e-6  # a foot and a US survey foot differ by 2e-6


def declared_unit(records: Iterable[Any]) -> str | None:
    """Return a key of `UNITS`, or other units in words, from VLRs and EVLRs of `laspy`; `None` where no record says."""
    known = list(records)
    for record in known:
        if isinstance(record, WktCoordinateSystemVlr):
            return _unit_of_wkt(record.string)
    for record in known:
        if isinstance(record, GeoKeyDirectoryVlr):
            return _unit_of_keys({key.id: key.value_offset for key in record.geo_keys if not key.tiff_tag_location})
    return None


def _unit_of_wkt(text: str) -> str | None:
    vertical = re.search(r"VERT(?:_CS|CRS|ICALCRS)", text)
    flat, height = (text[: vertical.start()], text[vertical.start() :]) if vertical else (text, "")
    if not re.search(r"PROJ(?:CS|CRS|ECTEDCRS)|LOCAL_CS|ENG(?:CRS|INEERINGCRS)|GEOCCS|GEODCRS", flat):
        return DEGREES if re.search(r"GEOG(?:CS|CRS|RAPHICCRS)", text) else None
    for inner in ("GEOGCS", "BASEGEOGCRS", "BASEGEODCRS", "PARAMETER", "ELLIPSOID"):
        flat = _remove_parts(flat, inner)
    units = [_unit_name(name, float(factor)) for name, factor in _WKT_UNIT.findall(flat)]
    heights = [_unit_name(name, float(factor)) for name, factor in _WKT_UNIT.findall(height)]
    return _join_units(units[-1] if units else None, heights[-1] if heights else None)


def _unit_of_keys(keys: dict[int, int]) -> str | None:
    if keys.get(_MODEL) == _GEOGRAPHIC:
        return DEGREES

    def unit(key: int) -> str | None:
        code = keys.get(key)
        return None if code is None else _CODES.get(code, f"EPSG unit {code}")

    return _join_units(unit(_LINEAR), unit(_VERTICAL))


def _join_units(flat: str | None, height: str | None) -> str | None:
    return flat if height in (None, flat) or flat is None else f"{flat} in plan and {height} in height"


def _unit_name(name: str, factor: float) -> str:
    return next(
        (unit for unit, metres in UNITS.items() if abs(factor / metres - 1) < _SAME_FACTOR), f"{name} ({factor:g} m)"
    )


def _remove_parts(text: str, name: str) -> str:
    """Return the text less every bracketed part of that name."""
    while at := re.search(rf"\b{name}\s*\[", text):
        depth, end = 1, at.end()
        while depth and end < len(text):
            depth += {"[": 1, "]": -1}.get(text[end], 0)
            end += 1
        text = text[: at.start()] + text[end:]
    return text


_LARGEST_CHUNK = 10_000_000  # points; LASzip writes 50,000


# Source: ASPRS LAS 1.4 R15, table 17: 7 is low noise, 18 high noise.
_NOISE = (7, 18)


def open_las(path: Path, keep_noise: bool = False) -> CloudSource:
    """Opens a LAS or LAZ file; points that are withheld or noise are left out and counted, unless `keep_noise`.

    Raises `ValueError` for damage, or fewer bytes than its header promises.
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
        records = [*header.vlrs, *(header.evlrs or [])]
        unit, crs = declared_unit(records), declared_crs(records)

    left_out: Counter[str] = Counter()

    def chunks() -> Iterator[np.ndarray]:
        read = 0
        left_out.clear()
        # The parallel decoder believes every size in the chunk table, and a wrong one ends the process.
        with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as reader:
            for points in reader.chunk_iterator(BATCH):
                xyz = np.column_stack([points.x, points.y, points.z, points.intensity])
                read += len(points)
                if not keep_noise:
                    withheld = np.asarray(points.withheld).astype(bool)
                    noise = ~withheld & np.isin(np.asarray(points.classification), _NOISE)
                    left_out.update(_counts(withheld=withheld, noise=noise))
                    xyz = xyz[~withheld & ~noise]
                yield xyz
        if read != count:
            raise ValueError(f"it ends after {read} of {count} points")

    return CloudSource(name, chunks, box, unit, count, crs, left_out)


def _counts(**masks: Bool[np.ndarray, " n"]) -> dict[str, int]:
    """Return how many points each mask holds; none of those that hold no point."""
    return {name: int(mask.sum()) for name, mask in masks.items() if mask.any()}


def declared_crs(records: Iterable[Any]) -> str | None:
    """Return the WKT of a LAS file's records, or the EPSG code of its GeoTIFF keys; `None` where none says."""
    known = list(records)
    for record in known:
        if isinstance(record, WktCoordinateSystemVlr) and record.string.strip("\0 "):
            return str(record.string).strip("\0 ")
    for record in known:
        if isinstance(record, GeoKeyDirectoryVlr):
            keys = {key.id: key.value_offset for key in record.geo_keys if not key.tiff_tag_location}
            codes = [keys[key] for key in _SYSTEMS if 0 < keys.get(key, 0) < _USER_DEFINED]
            return " + ".join(f"EPSG:{code}" for code in codes) or None
    return None


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


_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")


def open_e57(path: Path) -> CloudSource:
    """Opens all scans of an E57 file, in the file's frame.

    Raises:
        RecordingError: The library that reads it, which no other format needs, is not installed.
        ValueError: It is damaged, or has no coordinates.
    """
    try:
        from pye57 import E57
    except ImportError as error:
        raise RecordingError(f"{path}: E57 is read by pye57, which is not installed: pip install pye57") from error
    with E57(str(path)) as file:
        scans, root = file.scan_count, file.image_file.root()
        name = "coordinateMetadata"
        crs = (str(root[name].value()).strip() or None) if root.isDefined(name) else None
    left_out: Counter[str] = Counter()

    def chunks() -> Iterator[np.ndarray]:
        left_out.clear()
        with E57(str(path)) as file:
            for index in range(scans):
                try:
                    yield from _read_e57_scan(file, file.get_header(index), left_out)
                except Exception as error:
                    raise ValueError(f"scan {index} of {scans}: {error}") from error

    return CloudSource(f"E57, {scans} scans", chunks, np.empty((0, 3)), "m", None, crs, left_out)


def _read_e57_scan(file: "E57", header: "ScanHeader", left_out: Counter[str]) -> Iterator[np.ndarray]:
    """Yields the points of a scan in the file's frame; what lies in the scanner itself is no return and is counted."""
    fields = header.point_fields
    system = next((s for s in (_CARTESIAN, _SPHERICAL) if set(s) <= set(fields)), None)
    if system is None:
        raise ValueError(f"no coordinates among the fields {', '.join(fields)}")
    flag = "cartesianInvalidState" if system is _CARTESIAN else "sphericalInvalidState"
    flags = [flag] if flag in fields else []
    count = header.point_count
    rotation, translation = _e57_pose(header)
    data, buffers = file.make_buffers([*system, *flags], min(max(count, 1), BATCH))
    reader = header.points.reader(buffers)
    read = 0
    while size := reader.read():
        read += size
        a, b, c = (data[name][:size] for name in system)
        if system is _SPHERICAL:
            a, b, c = a * np.cos(c) * np.cos(b), a * np.cos(c) * np.sin(b), a * np.sin(c)
        points = np.stack([a, b, c], axis=1)
        back = (points != 0).any(axis=1)
        if flags:
            back &= data[flag][:size] == 0
        left_out.update(_counts(no_return=~back))
        points = points[back]
        yield rotation.apply(points) + translation
    if read != count:
        raise ValueError(f"it ends after {read} of {count} points")


def _e57_pose(header: "ScanHeader") -> tuple[Rotation, np.ndarray]:
    """Pose by the names of its nodes: the library takes them in the order of the file."""
    if not header.has_pose():
        return Rotation.identity(), np.zeros(3)
    pose: Any = header.pose
    rotation, translation = Rotation.identity(), np.zeros(3)
    if pose.isDefined("rotation"):
        rotation = Rotation.from_quat([pose["rotation"][name].value() for name in "xyzw"])
    if pose.isDefined("translation"):
        translation = np.array([pose["translation"][name].value() for name in "xyz"])
    return rotation, translation
