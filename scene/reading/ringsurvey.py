"""An as-built survey of rings, in either layout that surveyors hand over, with the design axis where it comes along.

A ring survey has easting, northing and elevation, and names each point by `POINT` (`ring.point`) or by `RING NO.` and
`POINT NO.`; `OFFSET`, where it is given, is how far the target stood off the wall. A table with `CHAINAGE` instead of
rings is the design axis.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from scene.errors import RecordingError
from scene.reading.cause import cause, refusing
from scene.reading.columns import find_xyz, plain
from scene.reading.frame import UNIT_NAMES, UNITS
from scene.reading.sheets import SUFFIXES, Sheet, sheets

NEEDED = "EASTING, NORTHING, ELEVATION with POINT (ring.point), or with RING NO. and POINT NO."
_MIN_RINGS = 4
_SHOWN = 100  # characters of a wrong header


@dataclass(frozen=True)
class RingSurvey:
    """Points of each ring, in the order of the file.

    Attributes:
        path: The file.
        names: Ring numbers as written.
        points: Easting, northing, elevation of each ring's points, m, `(k, 3)` each.
        offsets: How far each point lies inside the wall, m, `(k,)` each.
        design: Chainage, easting, northing, elevation of the design axis, m, `(d, 4)`; `None` where there is none.
        facts: What was detected, for people and the manifest.
    """

    path: Path
    names: list[str]
    points: list[Float[np.ndarray, "k 3"]]
    offsets: list[Float[np.ndarray, " k"]]
    design: Float[np.ndarray, "d 4"] | None
    facts: dict[str, str]


@dataclass(frozen=True)
class _Columns:
    """Where a ring table keeps what."""

    xyz: list[int]
    unit: str | None
    point: int | None
    ring: int | None
    offset: int | None


def is_survey(path: Path) -> bool:
    """Whether a file's header is that of a ring survey; a file that cannot be read is none."""
    if path.suffix.lower() not in SUFFIXES:
        return False
    try:
        with sheets(path) as tables:
            return any(_columns(sheet.header) is not None for sheet in tables)
    except Exception:  # not a table at all; another reader may know it, or will say what is wrong
        return False


def read_survey(path: Path, unit: str | None = None) -> RingSurvey:
    """Reads a ring survey.

    Args:
        path: CSV or XLSX. In the layout with `POINT` this must be text, since `0.10` is not `0.1`.
        unit: A key of `frame.UNITS`, overriding the header.

    Raises:
        RecordingError: Names the file, and the line or the sheet and row.
    """
    if unit not in (None, *UNITS):
        raise RecordingError(f"{path}: unit {unit!r} is none of {UNIT_NAMES}")
    rings: dict[str, list[tuple[float, ...]]] = {}
    columns, headers, design = None, [], None
    with refusing(path, "a readable survey", RecordingError), sheets(path) as tables:
        for sheet in tables:
            headers.append(",".join(sheet.header))
            if columns is None and (columns := _columns(sheet.header)) is not None:
                _read_rings(path, sheet, columns, rings)
            elif design is None and (at := _design_columns(sheet.header)) is not None:
                design = _read_design(path, sheet, at)
    if columns is None:
        raise RecordingError(f"{path}: columns are {' | '.join(headers)[:_SHOWN]!r}; {NEEDED} are needed")
    if len(rings) < _MIN_RINGS:
        raise RecordingError(f"{path}: holds {len(rings)} rings; at least {_MIN_RINGS} are needed")
    rows = [np.asarray(points) * UNITS[unit or columns.unit or "m"] for points in rings.values()]
    how = "by flag" if unit else "declared" if columns.unit else "by default"
    layout = "POINT as ring.point" if columns.ring is None else "RING NO. and POINT NO."
    facts = {"format": f"{path.suffix[1:].upper()}, {layout}", "unit": f"{unit or columns.unit or 'm'} ({how})"}
    return RingSurvey(path, list(rings), [r[:, :3] for r in rows], [r[:, 3] for r in rows], design, facts)


def _columns(header: tuple[str, ...]) -> _Columns | None:
    names = [plain(name)[0] for name in header]
    found = find_xyz(header)
    if found is None or "chainage" in names or "easting" not in names:
        return None

    def at(*wanted: str) -> int | None:
        return next((names.index(name) for name in wanted if name in names), None)

    ring, point = at("ring no", "ring", "ring number"), at("point", "point no", "point number")
    if point is None:
        return None
    return _Columns(*found, point, ring, at("offset", "target offset", "prism offset"))


def _design_columns(header: tuple[str, ...]) -> list[int] | None:
    names = [plain(name)[0] for name in header]
    found = find_xyz(header)
    rings = any(name.startswith("ring") for name in names)
    return None if found is None or rings or "chainage" not in names else [names.index("chainage"), *found[0]]


def _read_rings(path: Path, sheet: Sheet, columns: _Columns, rings: dict[str, list[tuple[float, ...]]]) -> None:
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


def _ring_name(row: tuple[Any, ...], columns: _Columns) -> str:
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


def _read_design(path: Path, sheet: Sheet, at: list[int]) -> Float[np.ndarray, "d 4"]:
    rows = []
    for where, row in sheet.rows:
        try:
            rows.append([float(row[index]) for index in at])
        except (ValueError, TypeError, IndexError) as error:
            raise RecordingError(f"{path}: {where} is no point of the design axis ({cause(error)})") from error
    return np.asarray(rows, np.float64).reshape(-1, 4)
