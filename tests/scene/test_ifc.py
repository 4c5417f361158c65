"""IFC: what the validator says, and whether the geometry that it opens with is where the tunnel is."""

import dataclasses

import ifcopenshell
import ifcopenshell.geom
import ifcopenshell.validate
import numpy as np
import pytest
from scipy.spatial import KDTree

from scene.bore import Bore
from scene.report.alignment import Alignment, Piece, Vertical, align_bore
from scene.report.clearance import Rails
from scene.report.ifc import IfcModel, add_alignment, write_ifc

ORIGIN = np.array([271_000.0, 2_103_000.0, -17.0])
SLEEPER = '<geom name="sleeper_{k:04d}" type="mesh" pos="{k} 0 -2" quat="1 0 0 0" />\n'


def vertices(product):
    """Points of a product as ifcopenshell's own engine makes them, in the file's frame, m."""
    settings = ifcopenshell.geom.settings()
    settings.set("use-world-coords", True)
    shape = ifcopenshell.geom.create_shape(settings, product)
    return np.array(shape.geometry.verts).reshape(-1, 3)


def wall_at(bore: Bore, left, up):
    """Distance of the wall from the axis towards points, m; the fixture's section is the same everywhere."""
    return np.interp(np.arctan2(up, left), bore.angle, bore.radius[0], period=2.0 * np.pi)


def complaints(file):
    log = ifcopenshell.validate.json_logger()
    ifcopenshell.validate.validate(file, log, express_rules=False)
    return [str(one["message"]) for one in log.statements]


@pytest.fixture(scope="module")
def short(bore: Bore):
    """The first 24 m of the arc."""
    keep = slice(0, int(np.searchsorted(bore.station, 24.0)))
    return dataclasses.replace(
        bore,
        station=bore.station[keep],
        position=bore.position[keep],
        tangent=bore.tangent[keep],
        radius=bore.radius[keep],
        filled=bore.filled[keep],
    )


@pytest.fixture(scope="module")
def file(short: Bore, tmp_path_factory):
    folder = tmp_path_factory.mktemp("ifc")
    (folder / "scene.xml").write_text("".join(SLEEPER.format(k=k) for k in range(5)))
    n = len(short.station)
    rails = Rails(np.zeros(n), np.full(n, -2.0), np.zeros(n), 1.508)
    alignment = align_bore(short, "arc", ORIGIN, 100.0, 0.002).alignment
    for name in ("a.ifc", "b.ifc"):
        write_ifc(folder / name, short, alignment, rails, folder / "scene.xml", ORIGIN)
    assert (folder / "a.ifc").read_bytes().replace(b"a.ifc", b"b.ifc") == (folder / "b.ifc").read_bytes()
    return ifcopenshell.open(folder / "a.ifc")


def test_the_validator_has_nothing_to_say(file):
    assert file.schema_identifier.startswith("IFC4X3")
    assert complaints(file) == []
    file.by_type("IfcRail")[0].PredefinedType = "CHECKRAIL"
    (pset,) = file.by_type("IfcPropertySet")
    kept, pset.HasProperties = pset.HasProperties, []
    assert complaints(file), "a spoiled file passes"
    pset.HasProperties = kept


def test_lining_rails_and_sleepers_open_where_they_are(file, short: Bore):
    lining = vertices(file.by_type("IfcBuildingElementProxy")[0]) - ORIGIN
    _, left, up = short.axis.local(lining)
    assert np.hypot(left, up) == pytest.approx(wall_at(short, left, up), abs=0.002)
    assert {rail.Name for rail in file.by_type("IfcRail")} == {"left rail", "right rail"}
    rail = vertices(next(one for one in file.by_type("IfcRail") if one.Name == "left rail")) - ORIGIN
    _, left, up = short.axis.local(rail)
    assert [left.mean(), up.max(), up.min()] == pytest.approx([0.754, -2.0, -2.176], abs=0.01)
    sleepers = file.by_type("IfcTrackElement")
    assert len(sleepers) == 5
    top = vertices(sleepers[3]) - ORIGIN
    assert [top[:, 0].mean(), top[:, 2].max()] == pytest.approx([3.0, -2.0], abs=1e-4)


def test_the_clear_bore_is_swept_along_the_alignment_to_the_wall(file, short: Bore):
    swept = vertices(file.by_type("IfcSpatialZone")[0]) - ORIGIN
    _, left, up = short.axis.local(swept)
    away = np.abs(np.hypot(left, up) - wall_at(short, left, up))
    assert np.median(away) < 0.005
    assert away.max() < 0.05, "between two sections or two points of one"
    assert np.ptp(swept, axis=0).max() > 20.0


def test_an_alignment_of_every_kind_opens_to_a_millimetre_of_its_own_points():
    pieces = [Piece(ORIGIN[:2] + 50.0, 0.3, 40.0, 0.0, 0.0)]
    for length, first, last in (
        (30.0, 0.0, 0.004), (50.0, 0.004, 0.004), (25.0, 0.004, 0.0), (20.0, 0.0, -0.01), (9.0, -0.01, -0.02),
        (15.0, -0.02, -0.02), (12.0, -0.02, -0.005),
    ):  # fmt: skip
        place, heading = pieces[-1].at(np.array([pieces[-1].length]))
        pieces.append(Piece(place[0], float(heading[0]), length, first, last))
    length = sum(piece.length for piece in pieces)
    profile = (
        Vertical(0.0, -12.0, 60.0, 0.01, 0.01), Vertical(60.0, -11.4, 80.0, 0.01, -0.02),
        Vertical(140.0, -11.8, length - 140.0, -0.02, -0.02),
    )  # fmt: skip
    alignment = Alignment("by hand", 1000.0, tuple(pieces), profile)
    model = IfcModel("by hand", ORIGIN)
    add_alignment(model, alignment, ORIGIN)
    assert complaints(model.file) == []
    there = vertices(model.file.by_type("IfcAlignment")[0])
    there = there + (ORIGIN if np.abs(there[:, 0]).max() < 1e5 else 0.0)
    _, points = alignment.sample(0.01)
    away, nearest = KDTree(points).query(there)
    assert len(there) > 100
    assert away.max() < 0.006, "half a step between the points of comparison, and a millimetre"
    assert np.abs((there - points[nearest])[:, 2]).max() < 0.001
    assert there[-1] == pytest.approx(points[-1], abs=0.001)
