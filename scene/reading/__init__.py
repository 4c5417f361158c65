"""Readers of input files, one file for each family of formats, and the door for a reader of a user's own.

`formats` holds the one table of formats and finds the format of an input. Readers raise `ValueError` with position and
cause. `recording`, `cloudfile` and `ringsurvey` turn whatever a reader or its library raises into one `RecordingError`
that names the file.
"""

from scene.reading.formats import Format, register_reader
from scene.reading.scans import ScanSource, make_scan, scan_from_records
from scene.reading.source import CloudSource, source_from_records
from scene.reading.times import RawScan

__all__ = [
    "CloudSource", "Format", "RawScan", "ScanSource", "make_scan", "register_reader", "scan_from_records",
    "source_from_records",
]  # fmt: skip
