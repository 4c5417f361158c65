"""As-built surveys of rings, from CSV or XLSX, in either layout that surveyors use.

A ring survey has easting, northing and elevation, and names each point by `POINT` (`ring.point`) or by `RING NO.` and
`POINT NO.`; `OFFSET`, where it is given, is the distance of the target off the wall.
"""

import csv
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
from jaxtyping import Float

from scene.errors import RecordingError
from scene.reading.source import UNIT_NAMES, UNITS, cause, refuse_damage
from scene.reading.tables import find_column, find_xyz, is_map_name, plain_name

TABLE_SUFFIXES = (".csv", ".txt", ".xlsx")
_MOST_CELLS = 64  # cells of a row that are read


@dataclass(frozen=True)
class Sheet:
    """One table."""

    header: tuple[str, ...]  # Cells of its first row, as text
    # Place of each other row (`line 2`), and its cells; empty rows are left out
    rows: Iterator[tuple[str, tuple[Any, ...]]]


@contextmanager
def open_sheets(path: Path) -> Iterator[Iterator[Sheet]]:
    """Opens the tables of a file, each to be read before the next is taken; the library raises anything on damage."""
    if path.suffix.lower() == ".xlsx":
        with path.open("rb") as file:
            book = openpyxl.load_workbook(file, read_only=True, data_only=True)
            yield (_xlsx_sheet(sheet) for sheet in book.worksheets)
    else:
        with path.open(newline="", encoding="utf-8-sig") as file:
            yield iter([_csv_sheet(file)])


def _csv_sheet(file: Any) -> Sheet:
    first = file.readline(1 << 16)
    delimiter = max(",;\t", key=first.count)
    header = tuple(cell.strip() for cell in next(csv.reader([first], delimiter=delimiter), []))
    reader = csv.reader(file, delimiter=delimiter)

    def rows() -> Iterator[tuple[str, tuple[Any, ...]]]:
        for row in reader:
            if any(cell.strip() for cell in row):
                yield f"line {reader.line_num + 1}", tuple(row)

    return Sheet(header, rows())


def _xlsx_sheet(sheet: Any) -> Sheet:
    cells = sheet.iter_rows(values_only=True, max_col=_MOST_CELLS)
    header = tuple("" if cell is None else str(cell).strip() for cell in next(cells, ()))

    def rows() -> Iterator[tuple[str, tuple[Any, ...]]]:
        for number, row in enumerate(cells, 2):
            if any(cell is not None for cell in row):
                yield f"sheet {sheet.title!r} row {number}", row

    return Sheet(header, rows())


NEEDED = "EASTING, NORTHING, ELEVATION with POINT (ring.point), or with RING NO. and POINT NO."
_MIN_RINGS = 4  # with fewer a table is no ring survey
_SHOWN = 100  # characters of a wrong header


@dataclass(frozen=True)
class RingSurvey:
    """Points of each ring, in the order of the file."""

    path: Path  # The file
    names: list[str]  # Ring numbers as written
    points: list[Float[np.ndarray, "k 3"]]  # Easting, northing, elevation of each ring's points, m each
    offsets: list[Float[np.ndarray, " k"]]  # Distance of each point inside the wall, m
    facts: dict[str, str]  # Detected facts, for people and the manifest

    def reversed(self) -> "RingSurvey":
        """Return the same survey with its rings in the opposite order."""
        return replace(self, names=self.names[::-1], points=self.points[::-1], offsets=self.offsets[::-1])


@dataclass(frozen=True)
class _RingColumns:
    """The columns of a ring table."""

    xyz: list[int]
    unit: str | None
    point: int | None
    ring: int | None
    offset: int | None


def is_ring_survey(path: Path) -> bool:
    """Return whether a file's header is that of a ring survey; false for a file that cannot be read."""
    if path.suffix.lower() not in TABLE_SUFFIXES:
        return False
    try:
        with open_sheets(path) as tables:
            return any(_find_ring_columns(sheet.header) is not None for sheet in tables)
    except Exception:  # not a table at all; another reader may know it, or will say what is wrong
        return False


def read_ring_survey(path: Path, unit: str | None = None, given: dict[str, str] | None = None) -> RingSurvey:
    """Reads a ring survey, CSV or XLSX; `unit`, a key of `UNITS`, and the columns `given` override the header.

    In the layout with `POINT` this must be text, since `0.10` is not `0.1`. Raises `RecordingError`, which names the
    file and the line, or the sheet and row.
    """
    if unit not in (None, *UNITS):
        raise RecordingError(f"{path}: unit {unit!r} is none of {UNIT_NAMES}")
    rings: dict[str, list[tuple[float, ...]]] = {}
    columns, headers = None, []
    with refuse_damage(path, "a readable survey", RecordingError), open_sheets(path) as tables:
        for sheet in tables:
            headers.append(",".join(sheet.header))
            if columns is None and (columns := _find_ring_columns(sheet.header, given)) is not None:
                _read_rings(path, sheet, columns, rings)
    if columns is None:
        raise RecordingError(f"{path}: columns are {' | '.join(headers)[:_SHOWN]!r}; {NEEDED} are needed")
    if len(rings) < _MIN_RINGS:
        raise RecordingError(f"{path}: holds {len(rings)} rings; at least {_MIN_RINGS} are needed")
    rows = [np.asarray(points) * UNITS[unit or columns.unit or "m"] for points in rings.values()]
    how = "by flag" if unit else "declared" if columns.unit else "by default"
    layout = "POINT as ring.point" if columns.ring is None else "RING NO. and POINT NO."
    facts = {"format": f"{path.suffix[1:].upper()}, {layout}", "unit": f"{unit or columns.unit or 'm'} ({how})"}
    return RingSurvey(path, list(rings), [r[:, :3] for r in rows], [r[:, 3] for r in rows], facts)


_RING = ("ring no", "ring", "ring number", "ring nr", "ringnr", "anneau", "anillo", "anello")
_POINT = ("point", "point no", "point number", "punkt", "punktnr", "punkt nr", "punto", "pt")
_OFFSET = ("offset", "target offset", "prism offset")


def _find_ring_columns(header: tuple[str, ...], given: dict[str, str] | None = None) -> _RingColumns | None:
    names = [plain_name(name)[0] for name in header]
    columns = find_xyz(header, given)
    if columns is None or (not given and ("chainage" in names or not is_map_name(header[columns[0][0]]))):
        return None

    def at(key: str, options: tuple[str, ...]) -> int | None:
        if given and key in given:
            return find_column(header, given[key])
        return next((names.index(name) for name in options if name in names), None)

    ring, point = at("ring", _RING), at("point", _POINT)
    if point is None or (ring is None and not given and names[columns[0][0]] != "easting"):
        return None  # a cloud with numbers of points
    return _RingColumns(*columns, point, ring, at("offset", _OFFSET))


def _read_rings(path: Path, sheet: Sheet, columns: _RingColumns, rings: dict[str, list[tuple[float, ...]]]) -> None:
    for where, row in sheet.rows:
        try:
            ring = _ring_name(row, columns)
            offset = 0.0 if columns.offset is None else float(row[columns.offset] or 0.0)
            point = (*(float(row[index]) for index in columns.xyz), offset)
            if not np.isfinite(point).all():
                raise ValueError(f"it holds {point}")
        except (ValueError, TypeError, IndexError) as error:
            raise RecordingError(f"{path}: {where} is not a ring point ({cause(error)})") from error
        rings.setdefault(ring, []).append(point)


def _ring_name(row: tuple[Any, ...], columns: _RingColumns) -> str:
    if columns.ring is not None:
        name = row[columns.ring]
        if name in (None, ""):
            raise ValueError("it names no ring")
        return str(int(name)) if isinstance(name, float) and name.is_integer() else str(name).strip()
    name = row[columns.point or 0]
    ring, dot, _ = name.partition(".") if isinstance(name, str) else ("", "", "")
    if not dot:
        raise ValueError(f"point {name!r} is not ring.point as text")
    return ring
