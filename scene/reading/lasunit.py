"""The unit of a LAS file's coordinates, from the coordinate system among its records.

Sources: ASPRS LAS 1.4 R15, "Coordinate Reference System VLRs"; OGC 12-063r5 (WKT2) and 01-009 (WKT1); OGC 19-008r4
(GeoTIFF), keys and codes of units.
"""

import re
from collections.abc import Iterable
from typing import Any

from laspy.vlrs.known import GeoKeyDirectoryVlr, WktCoordinateSystemVlr

from scene.reading.frame import UNITS

DEGREES = "degrees"
_CODES = {9001: "m", 9002: "ft", 9003: "us-ft"}
_MODEL, _GEOGRAPHIC, _LINEAR, _VERTICAL = 1024, 2, 3076, 4099
_UNIT = re.compile(r'\b(?:LENGTH)?UNIT\[\s*"([^"]*)"\s*,\s*([-+.\deE]+)')
_SAME = 1e-6  # a foot and a US survey foot differ by 2e-6


def declared_unit(records: Iterable[Any]) -> str | None:
    """A key of `frame.UNITS`, or what else the coordinates are in, in words; `None` where no record says.

    Args:
        records: VLRs and EVLRs as `laspy` parsed them.
    """
    found = list(records)
    for record in found:
        if isinstance(record, WktCoordinateSystemVlr):
            return _of_wkt(record.string)
    for record in found:
        if isinstance(record, GeoKeyDirectoryVlr):
            return _of_keys({key.id: key.value_offset for key in record.geo_keys if not key.tiff_tag_location})
    return None


def _of_wkt(text: str) -> str | None:
    flat, _, height = _split(text)
    if not re.search(r"PROJ(?:CS|CRS|ECTEDCRS)|LOCAL_CS|ENG(?:CRS|INEERINGCRS)|GEOCCS|GEODCRS", flat):
        return DEGREES if re.search(r"GEOG(?:CS|CRS|RAPHICCRS)", text) else None
    for inner in ("GEOGCS", "BASEGEOGCRS", "BASEGEODCRS", "PARAMETER", "ELLIPSOID"):
        flat = _without(flat, inner)
    units = [_named(name, float(factor)) for name, factor in _UNIT.findall(flat)]
    heights = [_named(name, float(factor)) for name, factor in _UNIT.findall(height)]
    return _agreed(units[-1] if units else None, heights[-1] if heights else None)


def _of_keys(keys: dict[int, int]) -> str | None:
    if keys.get(_MODEL) == _GEOGRAPHIC:
        return DEGREES

    def unit(key: int) -> str | None:
        code = keys.get(key)
        return None if code is None else _CODES.get(code, f"EPSG unit {code}")

    return _agreed(unit(_LINEAR), unit(_VERTICAL))


def _agreed(flat: str | None, height: str | None) -> str | None:
    return flat if height in (None, flat) or flat is None else f"{flat} in plan and {height} in height"


def _named(name: str, factor: float) -> str:
    return next((unit for unit, metres in UNITS.items() if abs(factor / metres - 1) < _SAME), f"{name} ({factor:g} m)")


def _split(text: str) -> tuple[str, str, str]:
    """Plan and height of a compound system."""
    at = re.search(r"VERT(?:_CS|CRS|ICALCRS)", text)
    return (text[: at.start()], at.group(), text[at.start() :]) if at else (text, "", "")


def _without(text: str, name: str) -> str:
    """The text less every bracketed part of that name."""
    while at := re.search(rf"\b{name}\s*\[", text):
        depth, end = 1, at.end()
        while depth and end < len(text):
            depth += {"[": 1, "]": -1}.get(text[end], 0)
            end += 1
        text = text[: at.start()] + text[end:]
    return text
