"""The table of sections as a spreadsheet and as CSV."""

import csv
import datetime
from pathlib import Path

import numpy as np
from openpyxl import Workbook
from openpyxl.formatting.rule import ColorScaleRule
from openpyxl.styles import Font
from openpyxl.utils import get_column_letter

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
