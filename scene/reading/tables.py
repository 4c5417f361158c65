"""Clouds as text (XYZ, CSV, TXT, ASC, PTS) with x, y, z by the names of their columns, and PTX.

A scan of a PTX file has ten lines before its points: columns, rows, place of the scanner, its three axes, and a matrix
of four lines that takes a row of coordinates from the right (x, y, z, 1). A point at the origin is a direction without
return.
"""

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import Float

from scene.errors import RecordingError
from scene.reading.source import BATCH, CloudSource, Lines

# English, German, Spanish, French and Italian surveyors' words; the first one is that of a cloud, not of a map.
_XYZ_NAMES = (
    ("x", "easting", "east", "e", "rechtswert", "rechts", "ostwert", "ost", "este", "est"),
    ("y", "northing", "north", "n", "hochwert", "hoch", "nordwert", "nord", "norte"),
    ("z", "elevation", "elev", "height", "altitude", "h", "hoehe", "höhe", "kote", "cota", "quota", "level", "rl"),
)
_UNIT_WORDS = "mm|millimet(?:er|re)s?|cm|centimet(?:er|re)s?|m|met(?:er|re)s?|us[ -]?ft|ft|feet|foot"
_COLUMN_UNIT = re.compile(rf"[\s_]*[(\[]?\s*\b({_UNIT_WORDS})\b\.?\s*[)\]]?$", re.IGNORECASE)
_UNIT_STARTS = (("mm", "mm"), ("milli", "mm"), ("c", "cm"), ("m", "m"), ("us", "us-ft"), ("f", "ft"))


def plain_name(name: str) -> tuple[str, str | None]:
    """Return a column's name in lower case without its unit, and the unit, a key of `frame.UNITS`, where it gives one.

    `EASTING (M.)` is `easting` in m; a name that is a unit alone is left as it is.
    """
    text = name.strip().lstrip("/#").strip().strip('"')
    bracketed = re.search(r"[(\[]([^)\]]*)[)\]]", text)
    match = _COLUMN_UNIT.search(" " + (bracketed.group(1) if bracketed else text.replace("_", " ")))
    base = re.sub(r"[(\[][^)\]]*[)\]]", "", text).strip() if bracketed else text
    unit = None
    if match and (bracketed or " " in text.replace("_", " ")):
        unit = next(unit for start, unit in _UNIT_STARTS if match.group(1).lower().startswith(start))
        base = base if bracketed else _COLUMN_UNIT.sub("", " " + base.replace("_", " "))
    return base.strip(" _.").lower(), unit


def is_map_name(name: str) -> bool:
    """Return whether a column's name is a map's word for east, such as `Easting` or `Rechtswert`."""
    return plain_name(name)[0] in _XYZ_NAMES[0][1:]


COLUMN_KEYS = ("x", "y", "z", "ring", "point", "offset")


def given_columns(path: Path, text: str | None) -> dict[str, str] | None:
    """Return the columns of a file that a user names, `x=Rechtswert,y=Hochwert,z=Hoehe`, by what they hold.

    Keys are those of `COLUMN_KEYS`; a column is its name in the header, or its number from 1. `None` where none is
    named. Raises `RecordingError` for any other text.
    """
    pairs = [part.partition("=") for part in (text or "").split(",") if part.strip()]
    columns = {key.strip().lower(): name.strip() for key, _, name in pairs}
    if set(columns) - set(COLUMN_KEYS) or not all(columns.values()) or len(columns) < len(pairs):
        example = "x=Rechtswert,y=Hochwert,z=Hoehe"
        raise RecordingError(f"{path}: columns {text!r} are not pairs such as {example} ({COLUMN_KEYS})")
    return columns or None


def find_column(names: Sequence[str], given: str) -> int | None:
    """Return the index of a column that a user names by its header or its number from 1; `None` without one."""
    needed = plain_name(given)[0]
    for index, name in enumerate(names):
        if name.strip() == given or plain_name(name)[0] == needed:
            return index
    return int(given) - 1 if given.isdigit() and 0 < int(given) <= len(names) else None


def find_xyz(names: Sequence[str], given: dict[str, str] | None = None) -> tuple[list[int], str | None] | None:
    """Finds the columns of x, y and z, and their declared unit; `None` where one is missing.

    `given` names columns as `given_columns` returns them. Raises `ValueError` where the three declare different units.
    """
    known = [plain_name(name) for name in names]
    bare = [name for name, _ in known]
    at = []
    for key, options in zip("xyz", _XYZ_NAMES, strict=True):
        index = next((bare.index(name) for name in options if name in bare), None)
        if given and key in given:
            index = find_column(names, given[key])
        if index is None:
            return None
        at.append(index)
    units = {known[index][1] for index in at} - {None}
    if len(units) > 1:
        raise ValueError(f"its columns {', '.join(names[i] for i in at)} differ in unit")
    return at, next(iter(units), None)


_HEAD_BYTES = 1 << 16  # of a file by which its layout is found
_PROBES = 16  # places of a file that are looked at
_DECIMALS = re.compile(r"\s*(?:-?\d+,\d+\s+)+-?\d+(?:,\d+)?\s*")  # numbers apart by blanks, with commas in them
_DELIMITERS = ((";", "semicolon"), ("\t", "tab"), (",", "comma"))


def open_table(path: Path, given: dict[str, str] | None = None) -> CloudSource:
    """Opens a text table: columns that the user named, by the names of its header, or the first three.

    `given` is what `given_columns` returns. Raises `ValueError` where it is no text, or no line near its start holds
    three numbers.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    if b"\0" in head:
        wide = head.startswith((b"\xff\xfe", b"\xfe\xff"))
        raise ValueError("it is text in UTF-16; save it as UTF-8" if wide else "it is binary, not text")
    lines = head.decode("utf-8-sig", "replace").splitlines()
    delimiter, name = _find_delimiter(lines)
    comma = delimiter != "," and any("," in line for line in lines) and not any("." in line for line in lines[1:])
    skip, columns, unit = _find_columns(lines, delimiter, comma, given)
    start = sum(len(line) for line in head.splitlines(keepends=True)[:skip])
    start = start or len(head) - len(head.removeprefix(b"\xef\xbb\xbf"))
    text = Lines(path, tuple(columns), delimiter, start, skip + 1, None, comma, path.suffix.lower() == ".pts")
    return CloudSource(f"text, {name} between columns", text.rows, _sample_lines(text), unit)


def _find_delimiter(lines: list[str]) -> tuple[str | None, str]:
    """Delimiter of most lines; white space where there is no other."""
    body = [line for line in lines[:200] if line.strip()]
    for mark, name in _DELIMITERS:
        apart = [line for line in body if line.count(mark) >= 2 and not (mark == "," and _DECIMALS.fullmatch(line))]
        if body and len(apart) > len(body) / 2:
            return mark, name
    return None, "white space"


def _find_columns(
    lines: list[str], delimiter: str | None, comma: bool, given: dict[str, str] | None
) -> tuple[int, list[int], str | None]:
    """Number of lines before the numbers, columns of x, y and z, and the unit that a header declares."""
    columns, unit = None, None
    if given and all(given.get(key, "").isdigit() for key in "xyz"):
        columns = [int(given[key]) - 1 for key in "xyz"]
    for index, line in enumerate(lines):
        words = [word.strip() for word in line.split(delimiter)]
        if given and columns is None and _numeric(words[:3], comma):
            raise ValueError(f"no line of names before line {index + 1} holds the columns {', '.join(given.values())}")
        if _numeric(words[:3], comma) or (columns and _numeric([words[i] for i in columns if i < len(words)], comma)):
            return index, columns or [0, 1, 2], unit
        if not given and {"lat", "latitude", "lon", "longitude"} & {plain_name(word)[0] for word in words}:
            raise ValueError("its columns are in degrees; project them to metres")
        named = find_xyz(words, given) if len(words) >= 3 else None
        if named is not None:
            columns, unit = named
        elif index and not line.startswith(("#", "/")) and line.strip() and columns:
            return index, columns, unit  # the reader will name this line
        elif len(words) > 3 and columns is None and not line.startswith(("#", "/")) and not _numeric(words, comma):
            raise ValueError(f"line {index + 1} has no columns x, y, z: {line[:60]!r}")
    raise ValueError("no line near its start holds three numbers")


def _numeric(words: list[str], comma: bool) -> bool:
    try:
        return len(words) >= 3 and bool([float(word.replace(",", ".") if comma else word) for word in words[:3]])
    except ValueError:
        return False


def _sample_lines(text: Lines) -> np.ndarray:
    """Points from places spread over the whole file; lines that do not parse are left out here."""
    size, points = text.path.stat().st_size, [np.empty((0, 3))]
    with text.path.open("rb") as file:
        for start in np.linspace(text.start, max(size - 4096, text.start), _PROBES).astype(int):
            file.seek(start)
            lines = file.read(4096).split(b"\n")
            # The first line of a block in the middle of the file is cut, and so is the last.
            whole = lines[0 if start == text.start else 1 : -1]
            try:
                points.append(text.parse(b"\n".join(whole), 1))
            except ValueError:
                continue
    return np.concatenate(points)


_HEADER = 10  # lines
_MOST = 1 << 33  # points of a scan


def open_ptx(path: Path) -> CloudSource:
    """Opens all scans of a PTX file, in the file's frame, m; raises `ValueError`, which names the line at fault."""
    left_out: Counter[str] = Counter()
    text = Lines(path, (0, 1, 2))

    def chunks() -> Iterator[np.ndarray]:
        left_out.clear()
        with path.open("rb") as file:
            line = 1
            while header := list(islice(file, _HEADER)):
                if not b"".join(header).strip():
                    return
                count, matrix = _read_header(header, line)
                line += _HEADER
                for start in range(0, count, BATCH):
                    lines = list(islice(file, min(BATCH, count - start)))
                    rows = text.parse(b"".join(lines), line + start)
                    if len(rows) < min(BATCH, count - start):
                        left = count - start - len(rows)
                        raise ValueError(f"it ends {left} of {count} points before a scan's header says")
                    back = (rows != 0).any(axis=1)
                    if not back.all():
                        left_out["no_return"] += int((~back).sum())
                    yield rows[back] @ matrix[:3, :3] + matrix[3, :3]
                line += count

    first = next(chunks(), np.empty((0, 3)))
    return CloudSource("PTX", chunks, first[:: max(len(first) // 2000, 1)], "m", left_out=left_out)


def _read_header(lines: list[bytes], first: int) -> tuple[int, Float[np.ndarray, "4 4"]]:
    """Return the number of points of a scan, and its matrix; `first` is the number of its first line."""
    try:
        numbers = [[float(word) for word in line.split()] for line in lines]
        columns, rows = int(numbers[0][0]), int(numbers[1][0])
        matrix = np.array(numbers[6:])
        if [len(row) for row in numbers] != [1, 1, 3, 3, 3, 3, 4, 4, 4, 4] or not 0 <= columns * rows < _MOST:
            raise ValueError
        return columns * rows, matrix
    except (ValueError, IndexError) as error:
        raise ValueError(f"lines {first} to {first + _HEADER - 1} are no header of a PTX scan") from error
