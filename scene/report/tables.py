"""The table of sections as a spreadsheet and as CSV, and the cloud with places on the bore as LAZ."""

import csv
import datetime
from pathlib import Path

import laspy
import numpy as np
from jaxtyping import Float
from openpyxl import Workbook
from openpyxl.formatting.rule import ColorScaleRule
from openpyxl.styles import Font
from openpyxl.utils import get_column_letter

from scene.bore import Bore

HEADS = {
    "station": ("station", "m"), "chainage": ("chainage", "m"), "easting": ("easting of the axis", "m"),
    "northing": ("northing of the axis", "m"), "elevation": ("elevation of the axis", "m"), "width": ("width", "m"),
    "height": ("height", "m"), "area": ("area", "m²"), "circle_radius": ("best-fit circle: radius", "m"),
    "circle_left": ("its middle left of the axis", "m"), "circle_up": ("its middle above the axis", "m"),
    "circle_rms": ("residual of the circle, RMS", "m"), "largest_diameter": ("largest diameter", "m"),
    "smallest_diameter": ("smallest diameter", "m"), "ovality": ("ovality: difference over mean", "1"),
    "over": ("overbreak against the design", "m²"), "under": ("underbreak against the design", "m²"),
    "deviation_mean": ("mean deviation, outwards", "m"), "deviation_most": ("largest outwards", "m"),
    "deviation_least": ("largest inwards", "m"), "residual": ("points off the section, RMS", "m"),
    "coverage": ("share of the section seen", "1"), "confidence": ("probability of 5 cm", "1"),
    "filled": ("interpolated", ""),
}  # fmt: skip


def write_csv(path: Path, table: np.ndarray) -> None:
    """Write the table with its units in the first row."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([f"{head} [{unit}]" if unit else head for head, unit in HEADS.values()])
        writer.writerows([_cell(row[name]) for name in HEADS] for row in table)


def write_workbook(path: Path, tables: dict[str, np.ndarray], facts: dict[str, str]) -> None:
    """Write a workbook: a sheet of facts, then one for each table, colours where the wall leaves the design."""
    book = Workbook()
    # No times of day: the same scene gives the same sheet.
    book.properties.created = book.properties.modified = datetime.datetime(2000, 1, 1)
    first = book.active
    first.title = "facts"
    for row in facts.items():
        first.append(row)
    first.column_dimensions["A"].width, first.column_dimensions["B"].width = 34, 70
    for title, table in tables.items():
        sheet = book.create_sheet(title)
        sheet.append([f"{head}, {unit}" if unit else head for head, unit in HEADS.values()])
        for row in table:
            sheet.append([_cell(row[name]) for name in HEADS])
        sheet.freeze_panes = "C2"
        for k, (name, (head, _)) in enumerate(HEADS.items(), 1):
            letter = get_column_letter(k)
            sheet.column_dimensions[letter].width = max(10, min(18, len(head)))
            sheet[f"{letter}1"].font = Font(bold=True)
            if name.startswith("deviation") and len(table):
                blue, white, red = "5A8AC6", "FFFFFF", "F8696B"
                scale = ColorScaleRule("min", None, blue, "num", 0, white, "max", None, red)
                sheet.conditional_formatting.add(f"{letter}2:{letter}{len(table) + 1}", scale)
    book.save(path)


def _cell(value: np.generic) -> float | str:
    if isinstance(value, np.bool_):
        return "yes" if value else "no"
    return round(float(value), 6) if np.isfinite(value) else ""


def write_points(
    path: Path,
    bore: Bore,
    points: Float[np.ndarray, "p 3"],
    origin: Float[np.ndarray, "3"],
    chainage: Float[np.ndarray, " n"],
) -> None:
    """Write points as LAZ in the input's frame, each with its place on the bore as extra dimensions.

    These are `station` (chainage), `offset` (to the right of the axis), `height` (above the axis) and `deviation`
    (outside the smooth section, so that pockets and track are deviations too), m. Points beyond the ends are left out.

    Args:
        path: The file.
        bore: The bore.
        points: Points in the tunnel frame, m.
        origin: Offset of the tunnel frame, m.
        chainage: Chainage of each station of the bore, m.
    """
    station, left, up = bore.axis.local(points)
    inside = (station >= 0.0) & (station <= bore.length)
    station, left, up, points = station[inside], left[inside], up[inside], points[inside]
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.offsets, header.scales = np.floor(origin), np.full(3, 1e-4)
    header.creation_date = datetime.date(2000, 1, 1)  # no times of day
    values = {
        "station": np.interp(station, bore.station, chainage),
        "offset": -left,
        "height": up,
        "deviation": _deviation(bore, station, left, up),
    }
    for name in values:
        header.add_extra_dim(laspy.ExtraBytesParams(name=name, type=np.float32 if name != "station" else np.float64))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = (points + origin).T
    for name, column in values.items():
        cloud[name] = column
    cloud.write(path)


def _deviation(bore: Bore, station: np.ndarray, left: np.ndarray, up: np.ndarray) -> Float[np.ndarray, " n"]:
    """Return how far points lie outside the smooth section, bilinear in station and angle, m."""
    n, m = bore.radius.shape
    row = np.clip(station / bore.station[1], 0.0, n - 1.0)
    column = np.mod((np.arctan2(up, left) - bore.angle[0]) / (2.0 * np.pi) * m, m)
    r, c = np.minimum(row.astype(int), n - 2), np.minimum(column.astype(int), m - 1)
    along, across, d = row - r, column - c, (c + 1) % m
    near = bore.radius[r, c] * (1.0 - across) + bore.radius[r, d] * across
    far = bore.radius[r + 1, c] * (1.0 - across) + bore.radius[r + 1, d] * across
    return np.hypot(left, up) - (near * (1.0 - along) + far * along)
