"""The alignment, the lining's inner surface, the clear bore and the track as IFC 4.3 (IFC4X3).

IFC 4.3 has no tunnel: the facility is an `IfcRailway`. What is not known is not invented: the lining has its inner
surface alone, since nobody sees its thickness, and the clear bore is the air within it, swept along the alignment.
"""

import re
import uuid
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from scene.bore import Bore
from scene.report.alignment import Alignment, Piece, Vertical
from scene.report.clearance import Rails
from subterra_jax.host.errors import MissingLibraryError

_SECTION_STEP = 5.0  # m between the sections of the swept bore
_SECTION_POINTS = 48
_RAIL_HALF, _RAIL_HEIGHT = 0.0365, 0.176  # m; half the head's width, and height of CHN60
_SPACE = uuid.UUID("6f0a1b0e-5b0c-4d3e-9d1e-51b7e7a0c0de")  # of the names from which identifiers are made
_SLEEPER = re.compile(r'<geom name="sleeper_(\d+)"[^>]* pos="([^"]+)" quat="([^"]+)"')


class IfcModel:
    """An IFC file that is being written; the same input gives the same identifiers.

    Args:
        name: Name of the tunnel.
        origin: Offset of the tunnel frame, m: the place of the site.

    Raises:
        MissingLibraryError: `ifcopenshell` is not installed.
    """

    def __init__(self, name: str, origin: Float[np.ndarray, "3"]):
        try:
            import ifcopenshell
        except ImportError as missing:
            raise MissingLibraryError("tunnel.ifc", "ifcopenshell", "survey") from missing
        self.file: Any = ifcopenshell.file(schema="IFC4X3")
        self._compress = ifcopenshell.guid.compress
        self._made = 0
        make = self.file.create_entity
        metre = make("IfcSIUnit", UnitType="LENGTHUNIT", Name="METRE")
        radian = make("IfcSIUnit", UnitType="PLANEANGLEUNIT", Name="RADIAN")
        space = self.axes()
        self.context = make("IfcGeometricRepresentationContext", None, "Model", 3, 1e-5, space, None)
        body = ("Body", "Model", None, None, None, None, self.context, None, "MODEL_VIEW", None)
        self.body = make("IfcGeometricRepresentationSubContext", *body)
        axis = ("Axis", "Model", None, None, None, None, self.context, None, "MODEL_VIEW", None)
        self.axis = make("IfcGeometricRepresentationSubContext", *axis)
        self.project = self.rooted("IfcProject", Name=name, RepresentationContexts=[self.context])
        self.project.UnitsInContext = make("IfcUnitAssignment", [metre, radian])
        self.site = self.rooted("IfcSite", Name=name, ObjectPlacement=self.place(None, origin))
        self.railway = self.rooted("IfcRailway", Name=name, ObjectPlacement=self.place(self.site))
        self.rooted("IfcRelAggregates", RelatingObject=self.project, RelatedObjects=[self.site])
        self.rooted("IfcRelAggregates", RelatingObject=self.site, RelatedObjects=[self.railway])

    def rooted(self, kind: str, **attributes: Any) -> Any:
        """Add an entity with an identifier."""
        self._made += 1
        key = f"{attributes.get('Name', '')} {kind} {self._made}"
        return self.file.create_entity(kind, GlobalId=self._compress(uuid.uuid5(_SPACE, key).hex), **attributes)

    def point(self, *place: float) -> Any:
        """Add a point, m."""
        return self.file.create_entity("IfcCartesianPoint", [float(value) for value in place])

    def axes(self, place: Any = (0.0, 0.0, 0.0), up: Any = None, ahead: Any = None) -> Any:
        """Add a frame."""
        direction = [
            None if one is None else self.file.create_entity("IfcDirection", [float(value) for value in one])
            for one in (up, ahead)
        ]
        return self.file.create_entity("IfcAxis2Placement3D", self.point(*place), *direction)

    def place(self, above: Any, place: Any = (0.0, 0.0, 0.0), up: Any = None, ahead: Any = None) -> Any:
        """Add a placement relative to that of another object."""
        relative = None if above is None else above.ObjectPlacement
        return self.file.create_entity("IfcLocalPlacement", relative, self.axes(place, up, ahead))

    def shape(self, kind: str, items: list[Any], context: Any = None) -> Any:
        """Add a representation as a product's shape."""
        name = "Body" if context is None else "Axis"
        one = self.file.create_entity("IfcShapeRepresentation", context or self.body, name, kind, items)
        return self.file.create_entity("IfcProductDefinitionShape", None, None, [one])

    def contain(self, products: list[Any]) -> None:
        """Put products into the railway."""
        attributes = {"RelatedElements": products, "RelatingStructure": self.railway}
        self.rooted("IfcRelContainedInSpatialStructure", **attributes)

    def surface(self, points: Float[np.ndarray, "v 3"], faces: np.ndarray, closed: bool) -> Any:
        """Add triangles, points in the tunnel frame, m."""
        listed = self.file.create_entity("IfcCartesianPointList3D", np.round(points, 5).tolist())
        return self.file.create_entity("IfcTriangulatedFaceSet", listed, None, closed, (faces + 1).tolist())


def write_ifc(
    path: Path, bore: Bore, alignment: Alignment, rails: Rails | None, scene: Path, origin: Float[np.ndarray, "3"]
) -> None:
    """Write a tunnel as IFC4X3.

    Args:
        path: File to write.
        bore: The bore.
        alignment: Its alignment, in the input's frame.
        rails: The track; `None` without.
        scene: The `scene.xml` with the sleepers.
        origin: Offset of the tunnel frame, m.

    Raises:
        MissingLibraryError: `ifcopenshell` is not installed.
    """
    model = IfcModel(alignment.name, origin)
    curve = add_alignment(model, alignment, origin)
    products = [_add_lining(model, bore)]
    if rails is not None:
        products += [*_add_rails(model, bore, rails), *_add_sleepers(model, scene)]
    model.contain(products)
    _add_clear_bore(model, bore, alignment, curve, origin)
    header = model.file.header
    header.file_name.name, header.file_name.time_stamp = path.name, "1970-01-01T00:00:00"
    model.file.write(str(path))


def add_alignment(model: IfcModel, alignment: Alignment, origin: Float[np.ndarray, "3"]) -> Any:
    """Add the alignment with its semantic and its geometric segments; returns its curve."""
    make = model.file.create_entity
    whole = model.rooted("IfcAlignment", Name=alignment.name, ObjectPlacement=model.place(model.site))
    level = model.rooted("IfcAlignmentHorizontal", Name="plan", ObjectPlacement=model.place(whole))
    layouts, curves = [level], []
    pieces = [piece for piece in alignment.plan if piece.length > 1e-6]
    _nest(model, level, [_plan_segment(model, piece, origin) for piece in [*pieces, _ending(pieces[-1])]])
    for k, piece in enumerate([*pieces, _ending(pieces[-1])]):
        curves.append(_plan_curve(model, piece, origin, last=k == len(pieces)))
    base = make("IfcCompositeCurve", curves, False)
    curve = base
    if alignment.profile:
        upright = model.rooted("IfcAlignmentVertical", Name="profile", ObjectPlacement=model.place(whole))
        layouts.append(upright)
        verticals = list(alignment.profile)
        last = verticals[-1]
        height = float(last.at(np.array([last.length]))[0])
        verticals.append(Vertical(last.start + last.length, height, 0.0, last.last, last.last))
        _nest(model, upright, [_profile_segment(model, one, origin) for one in verticals])
        bends = [_profile_curve(model, one, origin, last=k == len(verticals) - 1) for k, one in enumerate(verticals)]
        curve = make("IfcGradientCurve", bends, False, base, None)
    model.rooted("IfcRelNests", RelatingObject=whole, RelatedObjects=layouts)
    flat = make("IfcShapeRepresentation", model.axis, "FootPrint", "Curve2D", [base])
    shapes = [flat]
    if curve is not base:
        shapes = [make("IfcShapeRepresentation", model.axis, "Axis", "Curve3D", [curve]), flat]
    whole.Representation = make("IfcProductDefinitionShape", None, None, shapes)
    _add_start(model, whole, base, alignment.start)
    model.rooted("IfcRelAggregates", RelatingObject=model.project, RelatedObjects=[whole])
    model.rooted("IfcRelReferencedInSpatialStructure", RelatedElements=[whole], RelatingStructure=model.site)
    return curve


def _add_start(model: IfcModel, whole: Any, base: Any, start: float) -> None:
    """Add the chainage of the beginning."""
    make = model.file.create_entity
    along = make("IfcPointByDistanceExpression", make("IfcLengthMeasure", 0.0), None, None, None, base)
    linear = make("IfcLinearPlacement", None, make("IfcAxis2PlacementLinear", along, None, None), None)
    sign = model.rooted("IfcReferent", Name=f"{start:.3f}", ObjectPlacement=linear, PredefinedType="STATION")
    value = make("IfcPropertySingleValue", "Station", None, make("IfcLengthMeasure", float(start)), None)
    pset = model.rooted("IfcPropertySet", Name="Pset_Stationing", HasProperties=[value])
    model.rooted("IfcRelDefinesByProperties", RelatedObjects=[sign], RelatingPropertyDefinition=pset)
    model.rooted("IfcRelNests", RelatingObject=whole, RelatedObjects=[sign])


def _nest(model: IfcModel, layout: Any, designs: list[Any]) -> None:
    segments = [
        model.rooted(
            "IfcAlignmentSegment", Name=f"{layout.Name} {k}", ObjectPlacement=model.place(layout), DesignParameters=one
        )
        for k, one in enumerate(designs)
    ]
    model.rooted("IfcRelNests", RelatingObject=layout, RelatedObjects=segments)


def _ending(piece: Piece) -> Piece:
    """Return the segment of no length that ends a layout."""
    place, heading = piece.at(np.array([piece.length]))
    return Piece(place[0], float(heading[0]), 0.0, piece.last, piece.last)


def _radius(curvature: float) -> float:
    return 0.0 if curvature == 0.0 else 1.0 / curvature


def _plan_segment(model: IfcModel, piece: Piece, origin: Float[np.ndarray, "3"]) -> Any:
    kind = {"line": "LINE", "arc": "CIRCULARARC", "clothoid": "CLOTHOID"}[piece.kind]
    return model.file.create_entity(
        "IfcAlignmentHorizontalSegment", StartPoint=model.point(*(piece.start - origin[:2])),
        StartDirection=float(piece.heading), StartRadiusOfCurvature=_radius(piece.first),
        EndRadiusOfCurvature=_radius(piece.last), SegmentLength=float(piece.length), PredefinedType=kind,
    )  # fmt: skip


def _plan_curve(model: IfcModel, piece: Piece, origin: Float[np.ndarray, "3"], last: bool) -> Any:
    """Add a curve segment: a stretch of a parent curve, moved to its place."""
    make = model.file.create_entity
    here = make("IfcAxis2Placement2D", model.point(0.0, 0.0), make("IfcDirection", [1.0, 0.0]))
    begin, run = 0.0, piece.length
    if piece.kind == "line":
        parent = make("IfcLine", model.point(0.0, 0.0), make("IfcVector", make("IfcDirection", [1.0, 0.0]), 1.0))
    elif piece.kind == "arc":
        parent = make("IfcCircle", here, abs(1.0 / piece.first))
        run = piece.length if piece.first > 0.0 else -piece.length
    else:
        # Curvature s / A²: the stretch begins where the parent has the curvature of the piece's beginning.
        slope = (piece.last - piece.first) / piece.length
        parent = make("IfcClothoid", here, float(np.sign(slope) / np.sqrt(abs(slope))))
        begin = piece.first / slope
    heading = make("IfcDirection", [float(np.cos(piece.heading)), float(np.sin(piece.heading))])
    placed = make("IfcAxis2Placement2D", model.point(*(piece.start - origin[:2])), heading)
    measure = [make("IfcLengthMeasure", float(value)) for value in (begin, run)]
    return make("IfcCurveSegment", "DISCONTINUOUS" if last else "CONTSAMEGRADIENT", placed, *measure, parent)


def _profile_segment(model: IfcModel, one: Vertical, origin: Float[np.ndarray, "3"]) -> Any:
    bend = one.first != one.last
    return model.file.create_entity(
        "IfcAlignmentVerticalSegment", StartDistAlong=float(one.start), HorizontalLength=float(one.length),
        StartHeight=float(one.height - origin[2]), StartGradient=float(one.first), EndGradient=float(one.last),
        RadiusOfCurvature=float(one.length / (one.last - one.first)) if bend else None,
        PredefinedType="PARABOLICARC" if bend else "CONSTANTGRADIENT",
    )  # fmt: skip


def _profile_curve(model: IfcModel, one: Vertical, origin: Float[np.ndarray, "3"], last: bool) -> Any:
    make = model.file.create_entity
    slope = np.hypot(1.0, one.first)
    if one.first == one.last:
        parent = make("IfcLine", model.point(0.0, 0.0), make("IfcVector", make("IfcDirection", [1.0, 0.0]), 1.0))
        run, aim = one.length * slope, [1.0 / slope, one.first / slope]
    else:
        here = make("IfcAxis2Placement2D", model.point(0.0, 0.0), make("IfcDirection", [1.0, 0.0]))
        bend = 0.5 * (one.last - one.first) / one.length
        parent = make("IfcPolynomialCurve", here, [0.0, 1.0], [0.0, float(one.first), float(bend)], None)
        along = np.linspace(0.0, one.length, 201)
        run = float(np.trapezoid(np.hypot(1.0, one.first + 2.0 * bend * along), along))
        aim = [1.0 / slope, one.first / slope]
    place = make(
        "IfcAxis2Placement2D",
        model.point(one.start, one.height - origin[2]),
        make("IfcDirection", [float(a) for a in aim]),
    )
    measure = [make("IfcLengthMeasure", float(value)) for value in (0.0, run)]
    return make("IfcCurveSegment", "DISCONTINUOUS" if last else "CONTSAMEGRADIENT", place, *measure, parent)


def _ring(bore: Bore, rows: np.ndarray, count: int) -> Float[np.ndarray, "n c 3"]:
    """Return points on the wall at some stations, evenly by angle."""
    columns = np.unique(np.linspace(0, len(bore.angle), count, endpoint=False).round().astype(int))
    y, z = (bore.radius[rows][:, columns] * turn(bore.angle[columns]) for turn in (np.cos, np.sin))
    return bore.position[rows, None] + y[..., None] * bore.lateral[rows, None] + z[..., None] * bore.up[rows, None]


def _add_lining(model: IfcModel, bore: Bore) -> Any:
    """Add the inner surface of the lining as measured, faces towards the air."""
    every = max(1, round(1.0 / float(bore.station[1] - bore.station[0])))
    rows = np.unique(np.append(np.arange(0, len(bore.station), every), len(bore.station) - 1))
    points = _ring(bore, rows, 72)
    n, m = points.shape[:2]
    low = np.arange((n - 1) * m)
    around = low - low % m + (low % m + 1) % m
    faces = np.concatenate([np.stack([low, low + m, around], 1), np.stack([around, low + m, around + m], 1)])
    shape = model.shape("Tessellation", [model.surface(points.reshape(-1, 3), faces, False)])
    return model.rooted(
        "IfcBuildingElementProxy", Name="lining, inner surface as measured", ObjectType="TUNNEL LINING",
        ObjectPlacement=model.place(model.railway), Representation=shape,
    )  # fmt: skip


def _add_clear_bore(
    model: IfcModel, bore: Bore, alignment: Alignment, curve: Any, origin: Float[np.ndarray, "3"]
) -> None:
    """Add the air within the lining as sections swept along the alignment."""
    make = model.file.create_entity
    run = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(bore.position[:, :2], axis=0).T))])
    along = np.linspace(0.0, min(run[-1], alignment.length), max(2, int(run[-1] / _SECTION_STEP) + 1))
    rows = np.unique([int(np.argmin(np.abs(run - one))) for one in along])
    wall = _ring(bore, rows, _SECTION_POINTS)
    chainage, axis = alignment.sample()
    axis = axis - origin
    begin, end = (float(np.hypot(*(one - bore.position[0])[:2])) for one in axis[[0, -1]])
    if begin > end:  # the alignment runs against the stations
        rows, wall, run = rows[::-1], wall[::-1], run[-1] - run
    heading = np.unwrap(np.arctan2(*np.gradient(axis[:, :2], axis=0).T[::-1]))
    place = run[rows] * alignment.length / run.max()
    middle = np.stack([np.interp(place, chainage - alignment.start, part) for part in axis.T], axis=-1)
    turn = np.interp(place, chainage - alignment.start, heading)
    apart = wall - middle[:, None]
    left = apart[..., 1] * np.cos(turn)[:, None] - apart[..., 0] * np.sin(turn)[:, None]
    sections, positions = [], []
    for k in range(len(rows)):
        outline = np.round(np.column_stack([left[k], apart[k, :, 2]]), 5).tolist()
        line = make("IfcIndexedPolyCurve", make("IfcCartesianPointList2D", [*outline, outline[0]]), None, False)
        sections.append(make("IfcArbitraryClosedProfileDef", "AREA", f"{alignment.start + place[k]:.2f}", line))
        point = make("IfcPointByDistanceExpression", make("IfcLengthMeasure", float(place[k])), None, None, None, curve)
        positions.append(make("IfcAxis2PlacementLinear", point, None, None))
    solid = make("IfcSectionedSolidHorizontal", curve, sections, positions)
    zone = model.rooted(
        "IfcSpatialZone", Name="clear bore as measured", ObjectType="CLEAR BORE", PredefinedType="USERDEFINED",
        ObjectPlacement=model.place(model.railway), Representation=model.shape("AdvancedSweptSolid", [solid]),
    )  # fmt: skip
    model.rooted("IfcRelAggregates", RelatingObject=model.railway, RelatedObjects=[zone])


def _add_rails(model: IfcModel, bore: Bore, rails: Rails) -> list[Any]:
    """Add both rails as bars of their height and of the width of their heads."""
    every = max(1, round(1.0 / float(bore.station[1] - bore.station[0])))
    rows = np.unique(np.append(np.arange(0, len(bore.station), every), len(bore.station) - 1))
    made = []
    for side, name in ((0.5, "left rail"), (-0.5, "right rail")):
        left = rails.left[rows] + side * rails.gauge
        up = rails.up[rows] + side * rails.cant[rows]
        corners = [(_RAIL_HALF, 0.0), (-_RAIL_HALF, 0.0), (-_RAIL_HALF, -_RAIL_HEIGHT), (_RAIL_HALF, -_RAIL_HEIGHT)]
        bar = np.stack(
            [
                bore.position[rows] + (left + y)[:, None] * bore.lateral[rows] + (up + z)[:, None] * bore.up[rows]
                for y, z in corners
            ],
            1,
        )
        n, low = len(rows), np.arange(4 * (len(rows) - 1))
        around = low - low % 4 + (low % 4 + 1) % 4
        faces = [np.stack([low, around, low + 4], 1), np.stack([around, around + 4, low + 4], 1)]
        ends = np.array([(0, 2, 1), (0, 3, 2)])
        faces += [ends, ends[:, ::-1] + 4 * (n - 1)]
        shape = model.shape("Tessellation", [model.surface(bar.reshape(-1, 3), np.concatenate(faces), True)])
        made.append(
            model.rooted(
                "IfcRail",
                Name=name,
                ObjectPlacement=model.place(model.railway),
                Representation=shape,
                PredefinedType="RAIL",
            )
        )
    return made


def _add_sleepers(model: IfcModel, scene: Path) -> list[Any]:
    """Add the sleepers of the scene, one box shared by all, its top at the given place."""
    make = model.file.create_entity
    rectangle = make("IfcRectangleProfileDef", "AREA", "sleeper", None, 0.2, 2.5)
    box = make(
        "IfcExtrudedAreaSolid", rectangle, model.axes((0.0, 0.0, -0.16)), make("IfcDirection", [0.0, 0.0, 1.0]), 0.16
    )
    one = make("IfcShapeRepresentation", model.body, "Body", "SweptSolid", [box])
    shared = make("IfcRepresentationMap", model.axes(), one)
    same = make("IfcCartesianTransformationOperator3D", None, None, model.point(0.0, 0.0, 0.0), None, None)
    made = []
    for number, place, quat in _SLEEPER.findall(scene.read_text()):
        w, x, y, z = (float(word) for word in quat.split())
        ahead = (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y))
        up = (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y))
        placed = model.place(model.railway, [float(word) for word in place.split()], up, ahead)
        shape = model.shape("MappedRepresentation", [make("IfcMappedItem", shared, same)])
        made.append(
            model.rooted(
                "IfcTrackElement",
                Name=f"sleeper {number}",
                ObjectPlacement=placed,
                Representation=shape,
                PredefinedType="SLEEPER",
            )
        )
    return made
