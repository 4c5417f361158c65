"""Coordinates among named columns: what files call x, y and z, and the unit their header gives."""

import re
from collections.abc import Sequence

_NAMES = (
    ("x", "easting", "east", "e"),
    ("y", "northing", "north", "n"),
    ("z", "elevation", "elev", "height", "altitude", "h"),
)
_UNIT = re.compile(
    r"[\s_]*[(\[]?\s*\b(mm|millimet(?:er|re)s?|m|met(?:er|re)s?|us[ -]?ft|ft|feet|foot)\b\.?\s*[)\]]?$", re.IGNORECASE
)
_STARTS = (("mm", "mm"), ("milli", "mm"), ("m", "m"), ("us", "us-ft"), ("f", "ft"))


def plain(name: str) -> tuple[str, str | None]:
    """A column's name in lower case without its unit, and the unit, a key of `frame.UNITS`, where it gives one.

    `EASTING (M.)` is `easting` in m; a name that is a unit alone is left as it is.
    """
    text = name.strip().lstrip("/#").strip().strip('"')
    bracketed = re.search(r"[(\[]([^)\]]*)[)\]]", text)
    found = _UNIT.search(" " + (bracketed.group(1) if bracketed else text.replace("_", " ")))
    base = re.sub(r"[(\[][^)\]]*[)\]]", "", text).strip() if bracketed else text
    unit = None
    if found and (bracketed or " " in text.replace("_", " ")):
        unit = next(unit for start, unit in _STARTS if found.group(1).lower().startswith(start))
        base = base if bracketed else _UNIT.sub("", " " + base.replace("_", " "))
    return base.strip(" _.").lower(), unit


def find_xyz(names: Sequence[str]) -> tuple[list[int], str | None] | None:
    """Which columns hold x, y and z, and their declared unit; `None` where one of them is missing.

    Raises:
        ValueError: The three columns declare different units.
    """
    known = [plain(name) for name in names]
    bare = [name for name, _ in known]
    at = []
    for wanted in _NAMES:
        index = next((bare.index(name) for name in wanted if name in bare), None)
        if index is None:
            return None
        at.append(index)
    units = {known[index][1] for index in at} - {None}
    if len(units) > 1:
        raise ValueError(f"its columns {', '.join(names[i] for i in at)} differ in unit")
    return at, next(iter(units), None)
