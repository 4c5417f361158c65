"""A reader of a user's own: a zip of PLY scans, one file a sweep, named by its time in s."""

import io
import zipfile
from pathlib import Path

from plyfile import PlyData

from scene.reading import RawScan, ScanSource, register_reader, scan_from_records


def open_zip(path: Path, topic: str | None = None) -> ScanSource:
    archive = zipfile.ZipFile(path)
    names = sorted((name for name in archive.namelist() if name.endswith(".ply")), key=time_of)

    def read(index: int) -> RawScan:
        ply = PlyData.read(io.BytesIO(archive.read(names[index])))
        return scan_from_records(time_of(names[index]), ply["vertex"].data)

    return ScanSource(path, len(names), {"kind": "zip of PLY scans"}, read, archive.close)


def time_of(name: str) -> float:
    return float(Path(name).stem)


register_reader("plyzip", open_zip, label="zip of PLY scans", suffixes=(".zip",))
