"""Alignments as LandXML 1.2, written and read; points are north, east, as LandXML has it."""

import math
import xml.etree.ElementTree as ET
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float

from scene.errors import RecordingError, require_input
from scene.report.alignment import Alignment, Piece, Vertical

_NAMESPACE = "http://www.landxml.org/schema/LandXML-1.2"
_UNITS = {"meter": 1.0, "foot": 0.3048, "USSurveyFoot": 1200.0 / 3937.0, "millimeter": 1e-3, "kilometer": 1e3}
_JOIN = 0.05  # m; elements further apart than this are no alignment


def write_landxml(path: Path, alignment: Alignment) -> None:
    """Write an alignment; the same alignment gives the same bytes."""
    ET.register_namespace("", _NAMESPACE)
    root = ET.Element(f"{{{_NAMESPACE}}}LandXML", version="1.2", date="1970-01-01", time="00:00:00", language="English")
    units = _child(root, "Units")
    _child(units, "Metric", linearUnit="meter", areaUnit="squareMeter", volumeUnit="cubicMeter",
           temperatureUnit="celsius", pressureUnit="HPA", angularUnit="radians", directionUnit="radians")  # fmt: skip
    _child(root, "Application", name="Subterra")
    parent = _child(_child(root, "Alignments"), "Alignment", name=alignment.name, staStart=_number(alignment.start),
                    length=_number(alignment.length))  # fmt: skip
    geometry, begun = _child(parent, "CoordGeom"), alignment.start
    for piece in alignment.plan:
        _write_piece(geometry, piece, begun)
        begun += piece.length
    if alignment.profile:
        line = _child(_child(parent, "Profile"), "ProfAlign", name=alignment.name)
        _write_profile(line, alignment)
    ET.indent(root, " ")
    path.write_bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")


def _child(parent: ET.Element, tag: str, text: str = "", **attributes: str) -> ET.Element:
    child = ET.SubElement(parent, f"{{{_NAMESPACE}}}{tag}", attributes)
    child.text = text or None
    return child


def _number(value: float) -> str:
    """Return a number with every digit that counts."""
    return repr(round(float(value), 9))


def _place(point: Float[np.ndarray, "2"]) -> str:
    return f"{point[1]:.7f} {point[0]:.7f}"


def _write_piece(geometry: ET.Element, piece: Piece, station: float) -> None:
    place, heading = piece.at(np.array([0.0, piece.length]))
    common = {"length": _number(piece.length), "staStart": _number(station)}
    if piece.kind == "line":
        # Directions are clockwise from north.
        one = _child(geometry, "Line", dir=_number((math.pi / 2 - piece.heading) % (2 * math.pi)), **common)
        _child(one, "Start", _place(place[0]))
        _child(one, "End", _place(place[1]))
        return
    side = "ccw" if piece.first + piece.last > 0.0 else "cw"
    if piece.kind == "arc":
        radius = 1.0 / piece.first
        centre = place[0] + radius * np.array([-math.sin(piece.heading), math.cos(piece.heading)])
        one = _child(geometry, "Curve", rot=side, crvType="arc", radius=_number(abs(radius)),
                     delta=_number(abs(piece.length * piece.first)), **common)  # fmt: skip
        _child(one, "Start", _place(place[0]))
        _child(one, "Center", _place(centre))
        _child(one, "End", _place(place[1]))
        return
    one = _child(geometry, "Spiral", rot=side, spiType="clothoid", radiusStart=_radius(piece.first),
                 radiusEnd=_radius(piece.last), **common)  # fmt: skip
    _child(one, "Start", _place(place[0]))
    _child(one, "PI", _place(_crossing(place, heading)))
    _child(one, "End", _place(place[1]))


def _radius(curvature: float) -> str:
    return "INF" if curvature == 0.0 else _number(abs(1.0 / curvature))


def _crossing(place: Float[np.ndarray, "2 2"], heading: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
    """Return where the tangents at both ends meet."""
    tangent = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    matrix = np.column_stack([tangent[0], -tangent[1]])
    if abs(np.linalg.det(matrix)) < 1e-12:
        return place.mean(axis=0)
    return place[0] + np.linalg.solve(matrix, place[1] - place[0])[0] * tangent[0]


def _write_profile(line: ET.Element, alignment: Alignment) -> None:
    """Write points of intersection; a parabola is one with a length, tangents are what lies between."""
    first, last = alignment.profile[0], alignment.profile[-1]
    _child(line, "PVI", _vertex(alignment.start + first.start, first.height))
    for one in alignment.profile:
        if one.first != one.last:
            middle = one.start + one.length / 2
            text = _vertex(alignment.start + middle, one.height + one.first * one.length / 2)
            _child(line, "ParaCurve", text, length=_number(one.length))
    end = np.array([last.length])
    _child(line, "PVI", _vertex(alignment.start + last.start + last.length, float(last.at(end)[0])))


def _vertex(station: float, height: float) -> str:
    return f"{station:.7f} {height:.7f}"


def read_landxml(path: Path) -> Alignment:
    """Read the first alignment of a LandXML file of any version: lines, arcs and clothoids, vertices and parabolas.

    Raises:
        RecordingError: It is no LandXML, holds no alignment, or one with elements that are not read here.
    """
    try:
        root = ET.fromstring(require_input(path).read_bytes())
    except ET.ParseError as error:
        raise RecordingError(f"{path}: not an XML file ({error})") from error
    found = next((one for one in root.iter() if _tag(one) == "Alignment"), None)
    if _tag(root) != "LandXML" or found is None:
        raise RecordingError(f"{path}: holds no LandXML alignment")
    scale = _unit(root, path)
    try:
        geometry = next(one for one in found if _tag(one) == "CoordGeom")
        pieces = tuple(_read_piece(one, scale, path) for one in geometry if _tag(one) in ("Line", "Curve", "Spiral"))
        line = next((one for one in found.iter() if _tag(one) == "ProfAlign"), None)
        start = float(found.get("staStart", "0")) * scale
        profile = () if line is None else _read_profile(line, start, scale)
    except (StopIteration, KeyError, ValueError, TypeError) as error:
        raise RecordingError(f"{path}: the alignment lacks a part or holds what is no number ({error!r})") from error
    if not pieces:
        raise RecordingError(f"{path}: the alignment has no elements in plan")
    _require_chain(pieces, path)
    return Alignment(found.get("name") or path.stem, start, pieces, profile)


def _tag(element: ET.Element) -> str:
    return element.tag.rpartition("}")[2]


def _unit(root: ET.Element, path: Path) -> float:
    """Return metres in the file's unit of length."""
    units = next((one for one in root if _tag(one) == "Units"), None)
    name = next((one.get("linearUnit", "meter") for one in units), "meter") if units is not None else "meter"
    if name not in _UNITS:
        raise RecordingError(f"{path}: the unit {name!r} is not one of {', '.join(_UNITS)}")
    return _UNITS[name]


def _read_piece(element: ET.Element, scale: float, path: Path) -> Piece:
    points = {_tag(child): _read_place(child, scale) for child in element if _tag(child) in _POINTS}
    start, end = points["Start"], points["End"]
    if _tag(element) == "Line":
        run = end - start
        return Piece(start, math.atan2(run[1], run[0]), float(np.hypot(*run)), 0.0, 0.0)
    side = {"ccw": 1.0, "cw": -1.0}[element.attrib["rot"]]
    if _tag(element) == "Curve":
        spoke, last = start - points["Center"], end - points["Center"]
        radius = float(np.hypot(*spoke))
        turn = side * (math.atan2(last[1], last[0]) - math.atan2(spoke[1], spoke[0])) % (2 * math.pi)
        heading = math.atan2(spoke[1], spoke[0]) + side * math.pi / 2
        return Piece(start, heading, radius * turn, side / radius, side / radius)
    if (kind := element.get("spiType", "clothoid")) != "clothoid":
        raise RecordingError(f"{path}: a spiral of type {kind!r} is not read, only clothoids are")
    run = points["PI"] - start
    curvature = [side * _curvature(element.attrib[name], scale) for name in ("radiusStart", "radiusEnd")]
    return Piece(start, math.atan2(run[1], run[0]), float(element.attrib["length"]) * scale, *curvature)


_POINTS = ("Start", "End", "Center", "PI")


def _read_place(element: ET.Element, scale: float) -> Float[np.ndarray, "2"]:
    north, east = (float(word) * scale for word in (element.text or "").split()[:2])
    return np.array([east, north])


def _curvature(radius: str, scale: float) -> float:
    return 0.0 if radius.upper() == "INF" else 1.0 / (float(radius) * scale)


def _require_chain(pieces: tuple[Piece, ...], path: Path) -> None:
    for number, (one, other) in enumerate(pairwise(pieces), 1):
        gap = float(np.hypot(*(one.at(np.array([one.length]))[0][0] - other.start)))
        if gap > _JOIN:
            raise RecordingError(
                f"{path}: element {number} ends {gap:.2f} m from the beginning of the next; are radii, lengths and the "
                "order north, east as LandXML has them?"
            )


def _read_profile(line: ET.Element, start: float, scale: float) -> tuple[Vertical, ...]:
    """Return tangents and parabolas between the points of intersection."""
    vertices = []
    for child in line:
        if _tag(child) not in ("PVI", "ParaCurve"):
            raise ValueError(f"{_tag(child)} in a profile is not read")
        station, height = (float(word) * scale for word in (child.text or "").split()[:2])
        vertices.append((station - start, height, float(child.get("length", "0")) * scale))
    grades = [(after[1] - before[1]) / (after[0] - before[0]) for before, after in pairwise(vertices)]
    found: list[Vertical] = []
    for number, ((station, height, length), (next_station, _, next_length)) in enumerate(pairwise(vertices)):
        grade = grades[number]
        if length > 0.0:
            before = grades[number - 1]
            found.append(Vertical(station - length / 2, height - before * length / 2, length, before, grade))
        begin, end = station + length / 2, next_station - next_length / 2
        if end - begin > 1e-6:
            found.append(Vertical(begin, height + grade * length / 2, end - begin, grade, grade))
    return tuple(found)
