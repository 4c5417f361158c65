"""Takeaways for surveyors: tables, chainages, drawings, clearance, and what is refused."""

import csv
import dataclasses
import json
import re

import ezdxf
import ifcopenshell
import ifcopenshell.geom
import laspy
import matplotlib.pyplot as plt
import numpy as np
import openpyxl
import pytest
import shapely
import tifffile
import trimesh

from scene.bore import Bore, axis_through
from scene.errors import FitError, RecordingError
from scene.output import write_geometry
from scene.report import drawings, sections
from scene.report.__main__ import main
from scene.report.alignment import align_bore, design_of
from scene.report.clearance import Gauge, Rails, bend, clearance, contour, read_gauge, throw
from scene.report.landxml import read_landxml
from scene.report.page import _apart
from scene.writing.mjcf import SceneConfig
from scene.writing.track import TrackConfig, lay_track

ORIGIN = np.array([271_000.0, 2_103_000.0, -17.0])


@pytest.fixture(scope="module")
def scene(bore: Bore, tmp_path_factory):
    folder = tmp_path_factory.mktemp("built") / "arc"
    (folder / "meshes").mkdir(parents=True)
    write_geometry(folder, "arc", "simulated", bore, lay_track(bore, TrackConfig()), SceneConfig())
    manifest = {"name": "arc", "input_provenance": "simulated", "frame": {"origin": ORIGIN.tolist()},
                "detected": {"chainage_start": 100.0}}  # fmt: skip
    (folder / "manifest.json").write_text(json.dumps(manifest))
    trimesh.PointCloud(cloud_of(bore)).export(folder / "cloud.ply")
    return folder


def cloud_of(bore: Bore) -> np.ndarray:
    """Three points at station 12: on the crown, 1 m left of the axis and 0.5 m up, and 5 cm behind the right wall."""
    frame = bore.axis.at(np.array([12.0]))
    places = ((0.0, 2.8), (1.0, 0.5), (-2.85, -0.5))
    points = np.concatenate([frame.position + left * frame.lateral + up * frame.up for left, up in places])
    return np.concatenate([points, points + 100.0 * frame.tangent])


def test_points_are_located_on_a_design(bore: Bore):
    fit = align_bore(bore, "arc", ORIGIN, 500.0, 0.001)
    design = design_of(fit.alignment, ORIGIN)
    moved = bore.position - 0.25 * bore.lateral + 0.1 * bore.up
    chainage, right, above = design.locate(moved[10:-10]).T
    assert right == pytest.approx(0.25, abs=0.003)
    assert above == pytest.approx(0.1, abs=0.003)
    plan = np.hypot(*bore.tangent[:, :2].T).mean()
    assert chainage == pytest.approx(500.0 + plan * bore.station[10:-10], abs=0.02)


def test_the_best_fit_circle_ovality_and_breaks_of_a_known_section(bore: Bore):
    angle = bore.angle
    oval = 2.9 + 0.03 * np.cos(2.0 * angle)  # to the first order an ellipse, 12 cm between its diameters
    moved = np.hypot(0.0, 0.0) + oval
    round_bore = dataclasses.replace(bore, radius=np.repeat(moved[None], len(bore.station), axis=0))
    left, up, radius, rms = sections.fit_circles(round_bore)
    assert [left[0], up[0]] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert radius[0] == pytest.approx(2.9, abs=1e-3)
    assert rms[0] == pytest.approx(0.03 / np.sqrt(2.0), rel=0.02)
    design = sections.circle_section(round_bore, 2.9)
    table = sections.tabulate(round_bore, design, ORIGIN, round_bore.station, np.array([3.1, 12.0]))
    assert table["station"] == pytest.approx([3.1, 12.0])
    place = round_bore.axis.at(np.array([3.1])).position[0] + ORIGIN  # not of the next row of the bore
    assert [table[name][0] for name in ("easting", "northing", "elevation")] == pytest.approx(place, abs=1e-6)
    assert table["largest_diameter"][0] - table["smallest_diameter"][0] == pytest.approx(0.12, abs=1e-3)
    # ∫ of the positive half: 2.9 · 0.03 · 2 ∫ cos over a quarter, to the first order.
    assert table["over"][0] == pytest.approx(2.9 * 0.03 * 2.0, rel=0.02)
    assert table["under"][0] == pytest.approx(2.9 * 0.03 * 2.0, rel=0.02)
    over, under = sections.volumes(round_bore, design)
    assert over == pytest.approx(table["over"][0] * 24.0, rel=0.02)
    assert under == pytest.approx(over, rel=0.02)


def test_clearance_of_a_d_section_is_exact(bore: Bore):
    flat = np.zeros(len(bore.station))
    rails = Rails(flat, flat - 3.0, flat, 1.435)
    box = Gauge("box", np.array([[-1.5, 1.5], [1.5, 1.5], [1.5, 3.0], [-1.5, 3.0]]))
    free = clearance(bore, rails, box, flat)
    assert free[:, 0] == pytest.approx(1.3, abs=0.002)  # upright walls 2.8 m from the axis
    # On a bend of 100 m to the left the middle moves 0.451 m to the left and the ends 0.42 m to the right.
    inner, outer = throw(flat + 0.01)
    assert inner[0] == pytest.approx(19.0**2 / 800.0)
    assert outer[0] == pytest.approx(3.7 * 22.7 / 200.0)
    bent = clearance(bore, rails, box, flat + 0.01)
    assert bent[:, 0] == pytest.approx(1.3 - inner[0], abs=0.002)
    assert (bent[:, 1] > 0.0).all()
    # 15 cm of cant: the body leans by asin(0.15 / 1.435) to the right; its upper right corner comes nearest.
    lean = np.arcsin(0.15 / 1.435)
    canted = clearance(bore, dataclasses.replace(rails, cant=flat + 0.15), box, flat)
    corners = [(y * np.cos(lean) - z * np.sin(lean), -3.0 + z * np.cos(lean) + y * np.sin(lean)) for y, z in box.points]
    exact = min(2.8 - abs(y) if z < 0.0 else 2.8 - np.hypot(y, z) for y, z in corners)
    assert canted[:, 0] == pytest.approx(exact, abs=0.005)
    assert (canted[:, 1] < 0.0).all()


def test_the_throw_is_of_the_bend_that_both_bogies_stand_on(bore: Bore):
    turn = np.linspace(0.0, 0.5, 201)
    circle = axis_through(100.0 * np.column_stack([np.sin(turn), 1.0 - np.cos(turn), 0.0 * turn]), 0.25)
    n = len(circle.station)
    around = dataclasses.replace(
        bore, station=circle.station, position=circle.position, tangent=circle.tangent, lateral=circle.lateral,
        up=circle.up,
    )  # fmt: skip
    rails = Rails(np.zeros(n), np.zeros(n), np.zeros(n), 1.435)
    # 8 v / a² of an arc is 1 / R but for (a / 4 R)².
    assert bend(around, rails) == pytest.approx(0.01, rel=0.003)
    assert bend(around, dataclasses.replace(rails, left=rails.left + 2.0)) == pytest.approx(1.0 / 98.0, rel=0.003)
    back = dataclasses.replace(around, position=circle.position * [1.0, -1.0, 1.0], lateral=-circle.lateral)
    assert bend(back, rails) == pytest.approx(-0.01, rel=0.003)
    # A wander of 5 mm over 16 m, as rough walls leave in an axis, is a bend of R = 1,300 m where it is taken locally,
    # a throw of 35 mm; a vehicle does not see the most of it.
    wander = dataclasses.replace(rails, left=0.005 * np.sin(2.0 * np.pi * circle.station / 16.0))
    inner, _ = throw(bend(around, wander) - bend(around, rails))
    assert inner.max() < 0.011


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_rows_stand_at_round_chainages_whichever_way_they_count(bore: Bore, way: float):
    chainage = 100.3 + way * bore.station
    station = sections.at_round_chainages(bore, chainage, 10.0)
    assert np.all(np.diff(station) > 0.0)
    assert np.interp(station, bore.station, chainage) == pytest.approx(
        [110.0, 120.0] if way > 0 else [100.0, 90.0, 80.0]
    )


def test_worst_places_are_no_neighbours():
    station, size = np.arange(30.0), np.zeros(30)
    size[[10, 11, 12, 20]] = 4.0, 5.0, 3.0, 2.0
    assert _apart(station, size)[:2] == [11, 20]


def test_a_wide_mouth_does_not_hide_what_the_wall_does(bore: Bore, tmp_path):
    radius = bore.radius.copy()
    radius[:5] += 3.0
    radius[40:, :] += 0.02
    design = sections.polygon_section(bore, np.array([[-9.0, -9.0], [9.0, -9.0], [9.0, 9.0], [-9.0, 9.0]]), "wide")
    design = dataclasses.replace(design, radius=np.broadcast_to(bore.radius[0], bore.radius.shape))
    drawings.write_unrolled(tmp_path, dataclasses.replace(bore, radius=radius), design, bore.station)
    picture = plt.imread(tmp_path / "unrolled.png")[..., :3]
    middle = picture[picture.shape[0] // 2, picture.shape[1] // 2]
    assert middle[0] - middle[2] > 0.1  # 2 cm are red, not as white as on a scale of 3 m


def test_a_gauge_that_cuts_the_wall_has_less_than_nothing(bore: Bore):
    flat = np.zeros(len(bore.station))
    wide = Gauge("wide", np.array([[-3.0, 1.5], [3.0, 1.5], [3.0, 2.5], [-3.0, 2.5]]))
    assert clearance(bore, Rails(flat, flat - 3.0, flat, 1.435), wide, flat)[:, 0] == pytest.approx(-0.2, abs=0.01)


@pytest.mark.parametrize(
    ("rows", "sentence"),
    [
        ("0,1\n1,1\n1,2\n", "not closed"),
        ("0,0\n1,1\n1,0\n0,1\n0,0\n", "crosses itself"),
        ("a,b\n1,1\n1,0\n0,1\n", "not a polygon"),
        ("-1500,400\n1500,400\n1500,3000\n-1500,400\n", "3000 m large; is it in millimetres"),
    ],
)
def test_a_gauge_that_is_no_polygon_is_refused(tmp_path, rows, sentence):
    (tmp_path / "g.csv").write_text(rows)
    with pytest.raises(RecordingError, match=sentence):
        read_gauge(tmp_path / "g.csv")


def test_the_contours_nest_and_have_their_known_sizes():
    bodies = [shapely.Polygon(contour(name).points) for name in ("ga", "gb", "gc")]
    for body, highest in zip(bodies, (4.35, 4.35, 4.70), strict=True):
        assert body.is_valid
        assert body.bounds == pytest.approx((-1.645, 0.4, 1.645, highest))
        assert not body.contains(shapely.Point(1.63, 0.8))
        assert body.contains(shapely.Point(-1.63, 1.2))
    # GB adds the corners of semitrailers to GA, and GC those of whole lorries to GB.
    ga, gb, gc = bodies
    assert gb.buffer(1e-6).contains(ga)
    assert gc.buffer(1e-6).contains(gb)
    assert gb.contains(shapely.Point(1.35, 4.0))
    assert not ga.contains(shapely.Point(1.35, 4.0))
    assert gc.contains(shapely.Point(1.5, 4.6))


def test_the_folder_holds_what_surveyors_open(scene, bore: Bore, tmp_path):
    design = tmp_path / "design.csv"
    with np.load(scene / "bore.npz") as data:
        position, lateral = data["position"], data["lateral"]
    rows = np.column_stack([700.0 + np.arange(len(position)) * 0.25, position - 0.1 * lateral + ORIGIN])
    np.savetxt(design, rows, delimiter=",", header="CHAINAGE,EASTING,NORTHING,ELEVATION", comments="", fmt="%.5f")
    out = tmp_path / "report"
    assert main([str(scene), "--design", str(design), "--out", str(out)]) == 0
    for name in ("sections.dxf", "plan_profile.dxf"):
        assert not ezdxf.readfile(out / name).audit().errors
    book = openpyxl.load_workbook(out / "rings.xlsx")
    assert book.sheetnames == ["facts", "metres", "rings"]
    # The design's chainage, at its whole metres.
    assert [row[1] for row in book["metres"].iter_rows(min_row=2, values_only=True)] == pytest.approx(
        np.arange(700.0, book["metres"].max_row + 698.5), abs=1e-3
    )
    assert book["metres"].max_row == 26
    rings = np.array([row[:5] for row in book["rings"].iter_rows(min_row=2, values_only=True)], float)
    assert rings[:, 0] == pytest.approx(bore.ring_station)  # and not the row of the bore next to it
    assert rings[:, 2:] == pytest.approx(bore.axis.at(bore.ring_station).position + ORIGIN, abs=1e-5)
    assert read_landxml(out / "alignment.xml").length == pytest.approx(24.0, abs=0.02)
    field = tifffile.imread(out / "unrolled.tif")
    assert field.shape[1] == 360
    assert np.abs(field).max() < 1e-6  # the same section everywhere, held against its own median
    with (out / "offsets.csv").open() as file:
        offsets = np.array(list(csv.reader(file))[1:], float)
    assert offsets[10:-10, 2] == pytest.approx(-0.1, abs=0.003)  # the bore lies to the left of the design
    points = laspy.read(out / "points.laz")
    assert len(points) == 3  # those 100 m on are beyond the end
    assert points["station"] == pytest.approx(700.0 + 0.25 * 12.0 / bore.station[1], abs=0.02)  # the design's
    assert points["offset"] == pytest.approx([0.0, -1.0, 2.85], abs=0.002)
    assert points["height"] == pytest.approx([2.8, 0.5, -0.5], abs=0.002)
    assert points["deviation"] == pytest.approx(
        [0.0, np.hypot(1.0, 0.5) - 2.8, 0.05 * np.hypot(2.85, 0.5) / 2.85], abs=0.003
    )
    assert np.column_stack([points.x, points.y, points.z]) == pytest.approx(cloud_of(bore)[:3] + ORIGIN, abs=1e-3)
    page = (out / "report.html").read_text()
    assert "Clearance" in page
    assert re.search(r">\d+\.\d\d ± \d+\.\d\d m<", page)  # lengths with what the points leave open
    assert re.search(r">left, \d+\.\d ± \d+\.\d m<", page)
    assert page.count("data:image/png") == 4
    again = tmp_path / "again"
    assert main([str(scene), "--design", str(design), "--out", str(again)]) == 0
    same = (
        "points.laz",
        "sections.csv",
        "alignment.xml",
        "sections.dxf",
        "unrolled.tif",
        "clearance.csv",
        "offsets.csv",
        "tunnel.ifc",
    )
    assert all((out / name).read_bytes() == (again / name).read_bytes() for name in same)


def test_chainages_that_fall_along_the_bore_fall_in_every_file(scene, bore: Bore, tmp_path):
    """A design from the other portal: it counts from 700 at the bore's end, 24 m off, and 5 % shorter."""
    design, out = tmp_path / "design.csv", tmp_path / "report"
    chainage = 700.0 + 0.95 * (24.0 - bore.station)
    rows = np.column_stack([chainage, bore.position + ORIGIN])[::-1]
    np.savetxt(design, rows, delimiter=",", header="CHAINAGE,EASTING,NORTHING,ELEVATION", comments="", fmt="%.5f")
    assert main([str(scene), "--design", str(design), "--out", str(out)]) == 0
    whole = np.arange(722.0, 699.5, -1.0)
    for name, column, wanted in (
        ("sections.csv", 1, whole),
        ("clearance.csv", 0, whole),
        ("offsets.csv", 1, chainage),
    ):
        with (out / name).open() as file:
            found = np.array([float(row[column]) for row in list(csv.reader(file))[1:]])
        assert found == pytest.approx(wanted, abs=0.02), name
    points = laspy.read(out / "points.laz")
    assert points["station"] == pytest.approx(700.0 + 0.95 * 12.0, abs=0.03)
    there = read_landxml(out / "alignment.xml")  # runs from 700 on, from the bore's end to its beginning
    assert there.start == pytest.approx(700.0, abs=0.02)
    _, line = there.sample()
    assert line[0] == pytest.approx(bore.position[-1] + ORIGIN, abs=0.01)
    assert line[-1] == pytest.approx(bore.position[0] + ORIGIN, abs=0.01)
    labels = [one.dxf.text for one in ezdxf.readfile(out / "sections.dxf").modelspace().query("TEXT")]
    assert [float(one) for one in labels] == pytest.approx([720.0, 710.0, 700.0], abs=0.01)
    model = ifcopenshell.open(out / "tunnel.ifc")
    (sign,) = model.by_type("IfcReferent")
    assert float(sign.Name) == pytest.approx(700.0, abs=0.02)
    swept = model.by_type("IfcSpatialZone")[0]
    settings = ifcopenshell.geom.settings()
    settings.set("use-world-coords", True)
    corners = np.array(ifcopenshell.geom.create_shape(settings, swept).geometry.verts).reshape(-1, 3) - ORIGIN
    _, left, up = bore.axis.local(corners)
    wall = np.interp(np.arctan2(up, left), bore.angle, bore.radius[0], period=2.0 * np.pi)
    assert np.median(np.abs(np.hypot(left, up) - wall)) < 0.005
    pieces = ezdxf.readfile(out / "plan_profile.dxf").modelspace().query("LWPOLYLINE")
    heights = [np.array(one.get_points("xy"))[:, 1] for one in pieces]
    assert max(one.max() for one in heights[3:]) < min(one.min() for one in heights[:3])  # the profile, below the plan


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["nowhere"], "not a scene folder"),
        (["{scene}", "--design", "{far}"], "does not meet the tunnel"),
        (["{scene}", "--design", "{km}"], "grows by 0.001 m on a metre of the design axis"),
        (["{scene}", "--radius", "0.1"], "between 0.5 and 30 m"),
        (["{scene}", "--radius", "2.0", "--section", "x.csv"], "exclude each other"),
        (["{scene}", "--gauge", "x.csv"], "no such file"),
    ],
)
def test_mistakes_end_in_a_sentence_and_write_nothing(scene, tmp_path, capsys, words, sentence):
    far = tmp_path / "far.csv"
    far.write_text("CHAINAGE,EASTING,NORTHING,ELEVATION\n" + "".join(f"{k},{k},0,0\n" for k in range(9)))
    km = tmp_path / "km.csv"  # where the tunnel is, its chainage in kilometres
    with np.load(scene / "bore.npz") as data:
        rows = np.column_stack([data["station"] / 1e3, data["position"] + ORIGIN])
    np.savetxt(km, rows, delimiter=",", header="CHAINAGE,EASTING,NORTHING,ELEVATION", comments="", fmt="%.6f")
    out = tmp_path / "out"
    assert main([*(word.format(scene=scene, far=far, km=km) for word in words), "--out", str(out)]) == 2
    assert sentence in capsys.readouterr().err
    assert not out.exists()


def test_a_section_that_does_not_go_once_around_the_axis_is_refused(bore: Bore):
    with pytest.raises(FitError, match="just once"):
        sections.polygon_section(bore, np.array([[1.0, 0.0], [2.0, 0.0], [2.0, 1.0]]), "aside")
