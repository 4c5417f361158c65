"""Clouds as text: XYZ, CSV, TXT, ASC and PTS, with delimiter, decimal comma and header detected."""

from pathlib import Path

import numpy as np

from scene.reading.columns import find_xyz
from scene.reading.source import CloudSource
from scene.reading.text import Lines

_HEAD = 1 << 16
_PROBES = 16
_DELIMITERS = ((";", "semicolon"), ("\t", "tab"), (",", "comma"))


def open_cloud(path: Path) -> CloudSource:
    """The points of a text table: columns by the names of its header, or the first three.

    Raises:
        ValueError: No text, or no line with three numbers near its start.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD)
    if b"\0" in head:
        raise ValueError("it is binary, not text")
    lines = head.decode("utf-8-sig", "replace").splitlines()
    delimiter, name = _delimiter(lines)
    comma = delimiter == ";" and any("," in line for line in lines) and not any("." in line for line in lines[1:])
    skip, columns, unit = _layout(lines, delimiter, comma)
    start = sum(len(line) for line in head.splitlines(keepends=True)[:skip])
    text = Lines(path, tuple(columns), delimiter, start, skip + 1, None, comma)
    return CloudSource(f"text, {name} between columns", text.rows, _sample(text), unit)


def _delimiter(lines: list[str]) -> tuple[str | None, str]:
    """That of most lines; white space where there is no other."""
    body = [line for line in lines[:200] if line.strip()]
    for mark, name in _DELIMITERS:
        if body and sum(line.count(mark) >= 2 for line in body) > len(body) / 2:
            return mark, name
    return None, "white space"


def _layout(lines: list[str], delimiter: str | None, comma: bool) -> tuple[int, list[int], str | None]:
    """Lines before the numbers, the columns of x, y and z, and the unit that a header declares."""
    found, unit = None, None
    for index, line in enumerate(lines):
        words = [word.strip() for word in line.split(delimiter)]
        if _numeric(words[:3], comma) or (found and _numeric([words[i] for i in found if i < len(words)], comma)):
            return index, found or [0, 1, 2], unit
        named = find_xyz(words) if len(words) >= 3 else None
        if named is not None:
            found, unit = named
        elif index and not line.startswith(("#", "/")) and line.strip() and found:
            return index, found, unit  # the reader will name this line
        elif len(words) > 3 and found is None and not line.startswith(("#", "/")) and not _numeric(words, comma):
            raise ValueError(f"line {index + 1} has no columns x, y, z: {line[:60]!r}")
    raise ValueError("no line near its start holds three numbers")


def _numeric(words: list[str], comma: bool) -> bool:
    try:
        return len(words) >= 3 and bool([float(word.replace(",", ".") if comma else word) for word in words[:3]])
    except ValueError:
        return False


def _sample(text: Lines) -> np.ndarray:
    """Lines from places spread over the whole file; those that do not read are left to the reading proper."""
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
