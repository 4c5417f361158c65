"""Tables of a survey, from CSV or XLSX, row by row."""

import csv
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import openpyxl

SUFFIXES = (".csv", ".txt", ".xlsx")
_MOST_CELLS = 64


@dataclass(frozen=True)
class Sheet:
    """One table.

    Attributes:
        header: Cells of its first row, as text.
        rows: Where each other row stands (`line 2`), and its cells; empty rows are left out.
    """

    header: tuple[str, ...]
    rows: Iterator[tuple[str, tuple[Any, ...]]]


@contextmanager
def sheets(path: Path) -> Iterator[Iterator[Sheet]]:
    """The tables of a file, each to be read before the next is asked for.

    Raises:
        Exception: Whatever the library raises on damage.
    """
    if path.suffix.lower() == ".xlsx":
        with path.open("rb") as file:
            book = openpyxl.load_workbook(file, read_only=True, data_only=True)
            yield (_xlsx(sheet) for sheet in book.worksheets)
    else:
        with path.open(newline="", encoding="utf-8-sig") as file:
            yield iter([_csv(file)])


def _csv(file: Any) -> Sheet:
    first = file.readline(1 << 16)
    delimiter = max(",;\t", key=first.count)
    header = tuple(cell.strip() for cell in next(csv.reader([first], delimiter=delimiter), []))
    reader = csv.reader(file, delimiter=delimiter)

    def rows() -> Iterator[tuple[str, tuple[Any, ...]]]:
        for row in reader:
            if any(cell.strip() for cell in row):
                yield f"line {reader.line_num + 1}", tuple(row)

    return Sheet(header, rows())


def _xlsx(sheet: Any) -> Sheet:
    cells = sheet.iter_rows(values_only=True, max_col=_MOST_CELLS)
    header = tuple("" if cell is None else str(cell).strip() for cell in next(cells, ()))

    def rows() -> Iterator[tuple[str, tuple[Any, ...]]]:
        for number, row in enumerate(cells, 2):
            if any(cell is not None for cell in row):
                yield f"sheet {sheet.title!r} row {number}", row

    return Sheet(header, rows())
