"""Takeaways for surveyors: alignment, LandXML, tables, drawings, clearance, and what is refused."""

import csv
import dataclasses
import json

import ezdxf
import laspy
import numpy as np
import openpyxl
import pytest
import tifffile
import trimesh

from scene.bore import Bore
from scene.errors import FitError, RecordingError
from scene.output import write_geometry
from scene.report import sections
from scene.report.__main__ import main
from scene.report.alignment import Alignment, Piece, Vertical, align_bore, design_of
from scene.report.clearance import Gauge, Rails, clearance, g1, read_gauge, throw
from scene.report.elements import fit_plan, fit_profile
from scene.report.landxml import read_landxml, write_landxml
from scene.report.profiles import LEAST_ELEMENT, Profile, stepped
from scene.survey.alignment import draw_railway, lay_out, metro_elements
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


def railway(length: float = 240.0):
    """A drawn railway, its points in plan with their run, and the knots that made it."""
    elements = draw_railway(np.random.default_rng(3), length)
    line = lay_out(np.random.default_rng(0), length, elements)
    points = line.frames(np.arange(0.0, length + 0.01, 1.0)).position
    run = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points[:, :2], axis=0).T))])
    return elements, points, run


def test_lines_arcs_and_clothoids_of_a_railway_are_found_in_a_noisy_axis():
    truth, points, run = railway()
    noisy = points + np.random.default_rng(1).normal(0.0, 0.003, points.shape)
    fit = fit_plan(noisy[:, :2], run, 0.001)
    assert fit.rms < 0.004
    inner = truth.plan[(truth.plan > 5.0) & (truth.plan < 235.0)]
    knots = fit.profile.knot
    assert np.median([np.abs(knots - place).min() for place in inner]) < 1.5
    for start, end, bend in ((45.0, 66.0, -2.8545e-3), (146.0, 169.0, 5.265e-3)):  # arcs of the truth
        assert fit.profile.at(np.linspace(start, end, 20)).mean() == pytest.approx(bend, rel=0.01)


def known(elements, fit, length):
    """Errors of the clothoids of a truth, as shares: of their lengths, and of the curvature at their sharper ends."""
    knot, value, rows = fit.profile.knot, fit.profile.value, []
    for start, end, first, last in zip(
        elements.plan[:-1], elements.plan[1:], elements.curvature[:-1], elements.curvature[1:], strict=True
    ):
        if start < 1.0 or end > length - 1.0 or first == last:
            continue
        i, j = (int(np.argmin(np.abs(knot - place))) for place in (start, end))
        sharper, found = (last, value[j]) if abs(last) > abs(first) else (first, value[i])
        rows.append(((knot[j] - knot[i]) / (end - start) - 1.0, found / sharper - 1.0))
    return np.abs(rows).T


def points_of(elements, length, sigma, seed):
    """Points of a known alignment every metre, m, and their run."""
    line = lay_out(np.random.default_rng(0), length, elements)
    points = line.frames(np.arange(0.0, length + 0.01, 1.0)).position[:, :2]
    run = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    return points + np.random.default_rng(seed).normal(0.0, sigma, points.shape), run


@pytest.mark.slow
def test_every_clothoid_of_the_metro_is_found_to_a_thousandth_where_nothing_is_uncertain():
    elements = metro_elements(np.random.default_rng(0), 351.0)
    fit = fit_plan(*points_of(elements, 351.0, 0.0, 0), 0.0)
    length, bend = known(elements, fit, 351.0)
    assert len(length) >= 9
    assert max(length.max(), bend.max()) < 0.001


@pytest.mark.slow
def test_clothoids_are_found_to_a_hundredth_where_noise_leaves_that_much():
    """Two tenths of a millimetre of noise; with 3 mm even the best estimate of these lengths is off by more."""
    elements = draw_railway(np.random.default_rng(13), 351.0)
    fit = fit_plan(*points_of(elements, 351.0, 0.0002, 5), 0.0)
    length, bend = known(elements, fit, 351.0)
    assert len(length) >= 5
    assert max(length.max(), bend.max()) < 0.01


def test_a_knot_as_near_as_may_be_to_another_does_not_hold_the_rest():
    knot = np.array([0.0, 20.0, 20.0 + LEAST_ELEMENT, 60.0, 90.0])
    profile = Profile(knot, np.zeros(5), np.zeros(3))
    tie = np.full(5, -1)
    moved = stepped(profile, tie, np.array([0.0, 0.0, 0.0, 2.0, 0.0, 5.0]), True).knot
    assert moved == pytest.approx([0.0, 22.0, 22.0 + LEAST_ELEMENT, 65.0, 90.0])


def test_fewer_elements_are_used_where_more_misfit_is_allowed():
    _, points, run = railway()
    counts = [len(fit_plan(points[:, :2], run, tolerance).profile.knot) for tolerance in (0.001, 0.05)]
    assert counts[1] < counts[0] < 40


def test_a_grade_with_a_parabola_is_found():
    station = np.arange(0.0, 121.0)
    profile = Profile(np.array([0.0, 40.0, 80.0, 120.0]), np.array([-0.01, -0.01, 0.02, 0.02]), np.array([5.0]))
    fit = fit_profile(profile.height(station), station, 5e-4)
    assert [element.kind for element in fit.elements] == ["grade", "parabola", "grade"]
    assert [element.start for element in fit.elements[1:]] == pytest.approx([40.0, 80.0], abs=1.0)
    assert fit.elements[-1].last == pytest.approx(0.02, abs=1e-4)


def test_curvature_integrates_to_a_circle():
    bend = Profile(np.array([0.0, 100.0]), np.array([0.01, 0.01]), np.array([0.0, 0.0, 0.0]))
    at, heading = bend.plan(np.array([50.0 * np.pi]))  # beyond the last knot the last value holds
    assert heading[0] == pytest.approx(np.pi / 2)
    at, _ = bend.plan(np.array([100.0]))
    assert at[0] == pytest.approx([100.0 * np.sin(1.0), 100.0 * (1.0 - np.cos(1.0))], abs=1e-6)


ALIGNMENT = Alignment(
    "made by hand", 1000.0,
    (Piece(np.array([271_100.0, 2_103_050.0]), 0.3, 40.0, 0.0, 0.0),),
    (Vertical(0.0, -12.0, 30.0, 0.01, 0.01), Vertical(30.0, -11.7, 40.0, 0.01, -0.02)),
)  # fmt: skip


def chained(*bends: tuple[float, float, float]) -> Alignment:
    """Elements of length, first and last curvature, each where the one before ends."""
    pieces = [ALIGNMENT.plan[0]]
    for length, first, last in bends:
        place, heading = pieces[-1].at(np.array([pieces[-1].length]))
        pieces.append(Piece(place[0], float(heading[0]), length, first, last))
    return dataclasses.replace(ALIGNMENT, plan=tuple(pieces))


def test_landxml_reads_back_to_under_a_micrometre(tmp_path):
    there = chained(
        (30.0, 0.0, 0.004), (50.0, 0.004, 0.004), (25.0, 0.004, 0.0), (20.0, 0.0, -0.01), (9.0, -0.01, -0.02)
    )
    write_landxml(tmp_path / "a.xml", there)
    back = read_landxml(tmp_path / "a.xml")
    for one, other in zip(there.sample(), back.sample(), strict=True):
        assert np.abs(one - other).max() < 1e-6
    assert [piece.kind for piece in back.plan] == ["line", "clothoid", "arc", "clothoid", "clothoid", "clothoid"]
    write_landxml(tmp_path / "b.xml", back)
    again = read_landxml(tmp_path / "b.xml")
    assert np.abs(again.sample()[1] - there.sample()[1]).max() < 1e-6


def test_landxml_in_feet_is_read_in_metres(tmp_path):
    write_landxml(tmp_path / "a.xml", chained((30.0, 0.0, 0.004)))
    text = (tmp_path / "a.xml").read_text().replace('linearUnit="meter"', 'linearUnit="foot"')
    (tmp_path / "a.xml").write_text(text)
    assert read_landxml(tmp_path / "a.xml").length == pytest.approx(70.0 * 0.3048)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (("<LandXML", "<Other"), "not an XML file|no LandXML"),
        (("clothoid", "bloss"), "'bloss' is not read"),
        (('linearUnit="meter"', 'linearUnit="cubit"'), "unit 'cubit'"),
        (('radiusEnd="250.0"', 'radiusEnd="25.0"'), "ends .* m from the beginning of the next"),
        (('rot="ccw"', 'turn="ccw"'), "lacks a part"),
    ],
)
def test_landxml_that_is_none_is_refused_in_a_sentence(tmp_path, change, sentence):
    write_landxml(tmp_path / "a.xml", chained((30.0, 0.0, 0.004), (20.0, 0.004, 0.004)))
    text = (tmp_path / "a.xml").read_text()
    assert change[0] in text
    (tmp_path / "a.xml").write_text(text.replace(*change))
    with pytest.raises(RecordingError, match=sentence):
        read_landxml(tmp_path / "a.xml")


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
    table = sections.tabulate(round_bore, design, ORIGIN, 0.0)
    assert table["largest_diameter"][0] - table["smallest_diameter"][0] == pytest.approx(0.12, abs=1e-3)
    # ∫ of the positive half: 2.9 · 0.03 · 2 ∫ cos over a quarter, to the first order.
    assert table["over"][0] == pytest.approx(2.9 * 0.03 * 2.0, rel=0.02)
    assert table["under"][0] == pytest.approx(2.9 * 0.03 * 2.0, rel=0.02)
    over, under = sections.volumes(table)
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


def test_a_gauge_that_cuts_the_wall_has_less_than_nothing(bore: Bore):
    flat = np.zeros(len(bore.station))
    wide = Gauge("wide", np.array([[-3.0, 1.5], [3.0, 1.5], [3.0, 2.5], [-3.0, 2.5]]))
    assert clearance(bore, Rails(flat, flat - 3.0, flat, 1.435), wide, flat)[:, 0] == pytest.approx(-0.2, abs=0.01)


@pytest.mark.parametrize(
    ("rows", "sentence"),
    [
        ("0,1\n1,1\n1,2\n", "not closed"),
        ("0,0\n1,1\n1,0\n0,1\n0,0\n", "crosses itself"),
        ("a,b\n1,1\n1,0\n0,1\n", "not a gauge polygon"),
    ],
)
def test_a_gauge_that_is_no_polygon_is_refused(tmp_path, rows, sentence):
    (tmp_path / "g.csv").write_text(rows)
    with pytest.raises(RecordingError, match=sentence):
        read_gauge(tmp_path / "g.csv")


def test_g1_is_a_polygon_of_its_known_size():
    points = g1().points
    assert np.ptp(points[:, 0]) == pytest.approx(3.29)
    assert points[:, 1].max() == pytest.approx(4.31)


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
    assert book["metres"].max_row == 26
    assert book["metres"]["B2"].value == pytest.approx(700.0, abs=0.01)  # the design's chainage
    assert read_landxml(out / "alignment.xml").length == pytest.approx(24.0, abs=0.02)
    field = tifffile.imread(out / "unrolled.tif")
    assert field.shape[1] == 360
    assert np.abs(field).max() < 1e-6  # the same section everywhere, held against its own median
    with (out / "offsets.csv").open() as file:
        offsets = np.array(list(csv.reader(file))[1:], float)
    assert offsets[10:-10, 2] == pytest.approx(-0.1, abs=0.003)  # the bore lies to the left of the design
    points = laspy.read(out / "points.laz")
    assert len(points) == 3  # those 100 m on are beyond the end
    assert points["station"] == pytest.approx(712.0, abs=0.02)
    assert points["offset"] == pytest.approx([0.0, -1.0, 2.85], abs=0.002)
    assert points["height"] == pytest.approx([2.8, 0.5, -0.5], abs=0.002)
    assert points["deviation"] == pytest.approx(
        [0.0, np.hypot(1.0, 0.5) - 2.8, 0.05 * np.hypot(2.85, 0.5) / 2.85], abs=0.003
    )
    assert np.column_stack([points.x, points.y, points.z]) == pytest.approx(cloud_of(bore)[:3] + ORIGIN, abs=1e-3)
    page = (out / "report.html").read_text()
    assert "Clearance" in page
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


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["nowhere"], "not a scene folder"),
        (["{scene}", "--design", "{far}"], "does not meet the tunnel"),
        (["{scene}", "--radius", "0.1"], "between 0.5 and 30 m"),
        (["{scene}", "--radius", "2.0", "--section", "x.csv"], "exclude each other"),
        (["{scene}", "--gauge", "x.csv"], "no such file"),
    ],
)
def test_mistakes_end_in_a_sentence_and_write_nothing(scene, tmp_path, capsys, words, sentence):
    far = tmp_path / "far.csv"
    far.write_text("CHAINAGE,EASTING,NORTHING,ELEVATION\n" + "".join(f"{k},{k},0,0\n" for k in range(9)))
    out = tmp_path / "out"
    assert main([*(word.format(scene=scene, far=far) for word in words), "--out", str(out)]) == 2
    assert sentence in capsys.readouterr().err
    assert not out.exists()


def test_a_section_that_does_not_go_once_around_the_axis_is_refused(bore: Bore):
    with pytest.raises(FitError, match="just once"):
        sections.polygon_section(bore, np.array([[1.0, 0.0], [2.0, 0.0], [2.0, 1.0]]), "aside")
