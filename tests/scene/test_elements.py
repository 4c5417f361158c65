"""Elements fitted to an axis: how well known ones are found, what noise is, LandXML there and back."""

import dataclasses

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from scene.bore import POCKET, Bore, axis_through
from scene.errors import RecordingError
from scene.fitting.profile import section_angles
from scene.report.alignment import Alignment, Piece, Vertical, align_bore, design_of, turn_around
from scene.report.elements import fit_plan, fit_profile
from scene.report.landxml import read_landxml, write_landxml
from scene.report.noise import correlated_noise, find_spread
from scene.report.profiles import LEAST_ELEMENT, PlanTarget, Profile, adjust, jacobian, stepped
from scene.survey.alignment import draw_railway, lay_out, metro_elements

ORIGIN = np.array([271_000.0, 2_103_000.0, -17.0])


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


@pytest.mark.slow
def test_a_design_comes_back_from_the_axis_of_its_tunnel_to_a_millimetre_by_default(tmp_path):
    bends = [(30.0, 0.0, 0.004), (50.0, 0.004, 0.004), (25.0, 0.004, 0.0), (20.0, 0.0, 0.0), (30.0, 0.0, -0.003),
             (40.0, -0.003, -0.003)]  # fmt: skip
    verticals = (Vertical(0.0, -12.0, 80.0, 0.01, 0.01), Vertical(80.0, -11.2, 40.0, 0.01, -0.02),
                 Vertical(120.0, -11.4, 115.0, -0.02, -0.02))  # fmt: skip
    write_landxml(tmp_path / "in.xml", dataclasses.replace(chained(*bends), profile=verticals))
    design = design_of(read_landxml(tmp_path / "in.xml"), ORIGIN)
    fit = align_bore(tube(design.axis), "out", ORIGIN, 1000.0)
    write_landxml(tmp_path / "out.xml", fit.alignment)
    back = design_of(read_landxml(tmp_path / "out.xml"), ORIGIN)
    off = back.locate(design.axis.position[4:-4])[:, 1:]
    assert np.abs(off).max() < 0.001
    assert len(fit.plan.elements) <= len(bends) + 3
    assert len(fit.profile.elements) <= 5


def tube(axis):
    """A bore of 2.8 m about an axis."""
    n, angle = len(axis.station), section_angles()
    none = np.zeros(n)
    return Bore(
        axis.station, axis.position, axis.tangent, axis.lateral, axis.up, none + 5.6, none + 5.6, angle,
        np.full((n, len(angle)), 2.8), none, none + 1.0, np.zeros(n, bool), np.empty(0), np.empty(0, POCKET), none,
    )  # fmt: skip


@pytest.mark.slow
def test_noise_that_errs_alike_over_some_metres_is_no_element():
    """As in an axis out of a smoothed cloud: from point to point it is smooth, and yet it is 3 mm of noise."""
    truth, points, run = railway()
    noise = gaussian_filter1d(np.random.default_rng(6).normal(size=points.shape), 2.0, axis=0)
    points = points + 0.003 * noise / noise.std()
    fit = fit_plan(points[:, :2], run)
    inner = truth.plan[(truth.plan > 1.0) & (truth.plan < 239.0)]
    assert len(fit.profile.knot) <= len(inner) + 4  # 15 knots for 9 were noise thought to be new at each point
    assert 0.001 < fit.rms < 0.005


@pytest.mark.slow
def test_the_dearest_knots_come_first_so_that_none_is_left_over():
    elements = draw_railway(np.random.default_rng(3), 351.0)
    fit = fit_plan(*points_of(elements, 351.0, 0.0, 0))
    inner = elements.plan[(elements.plan > 1.0) & (elements.plan < 350.0)]
    assert len(fit.profile.knot) - 2 <= len(inner)  # all put in at once, 23 knots settle where 13 are
    assert np.abs(fit.residual).max() < 0.001


def test_noise_is_told_from_its_correlation():
    noise = np.random.default_rng(0).normal(0.0, 0.003, 4000)
    sigma, alike = correlated_noise(noise, 0)
    assert [sigma, alike] == pytest.approx([0.003, 1.0], rel=0.1)
    smooth = gaussian_filter1d(noise, 3.0)
    sigma, alike = correlated_noise(smooth, 0)
    assert sigma == pytest.approx(smooth.std(), rel=0.1)
    assert alike == pytest.approx(2.0 * np.sqrt(np.pi) * 3.0, rel=0.2)  # integral of the correlation, a Gaussian
    assert correlated_noise(np.append(noise, [9.0] * 20), 0)[0] == pytest.approx(0.003, rel=0.1)
    assert correlated_noise(noise, 3000)[0] == pytest.approx(0.006, rel=0.1)


@pytest.mark.parametrize("metres", [0.0, pytest.param(2.0, marks=pytest.mark.slow)])
def test_what_the_points_leave_open_is_what_fits_of_fresh_noise_differ_by(metres):
    """White noise, and one that errs alike over some metres; one and the same railway with all of its elements told."""
    elements, points, run = railway()
    inner = (elements.plan > 1.0) & (elements.plan < 239.0)
    knot = np.concatenate([[0.0], elements.plan[inner], run[-1:]])
    value = np.interp(knot, elements.plan, elements.curvature)
    number = {bend: k for k, bend in enumerate(dict.fromkeys(value[value != 0.0]))}
    tie = np.array([number.get(bend, -1) for bend in value])
    heading = np.arctan2(*(points[5] - points[0])[1::-1])
    across = np.array([-np.sin(heading), np.cos(heading)])
    clean = PlanTarget(points[:, :2], run, across)
    truth = adjust(Profile(knot, value, np.array([*points[0, :2], heading])), tie, clean)
    assert np.abs(clean.miss(truth)).max() < 1e-4
    random, off, told = np.random.default_rng(8), [], []
    for _ in range(30):
        noise = random.normal(size=(len(points), 2))
        noise = gaussian_filter1d(noise, metres, axis=0) if metres else noise
        target = PlanTarget(points[:, :2] + 0.001 * noise / noise.std(), run, across)
        fit = truth
        for _ in range(3):  # a few millimetres of noise are soon linear
            step = np.linalg.lstsq(jacobian(fit, tie, target, True), -target.miss(fit), rcond=1e-10)[0]
            fit = stepped(fit, tie, step, True)
        spread = find_spread(fit, tie, target)
        off.append([*(np.diff(fit.knot) - np.diff(truth.knot)), *(fit.value - truth.value)[tie >= 0]])
        told.append(
            [*(one.length for one in spread), *(np.array([*(o.first for o in spread), spread[-1].last])[tie >= 0])]
        )
    share = np.sqrt(np.mean(np.square(off), axis=0) / np.mean(np.square(told), axis=0))
    assert np.median(share) == pytest.approx(1.0, abs=0.2)
    assert share == pytest.approx(1.0, abs=0.5)


def test_a_ring_survey_is_fitted_at_its_rings_and_not_where_it_was_interpolated(bore: Bore):
    axis = axis_through(np.column_stack([np.arange(0.0, 301.0, 5.0), np.zeros((61, 2))]), 0.25)
    rings = np.arange(0.0, 300.0, 7.0)
    near = np.abs(axis.station[:, None] - rings).min(axis=1) < 0.2
    survey = dataclasses.replace(tube(axis), filled=~near, ring_station=rings)
    assert align_bore(survey, "rings", ORIGIN, 0.0).plan.station == pytest.approx(rings, abs=0.13)
    assert len(align_bore(dataclasses.replace(survey, filled=near & ~near), "all", ORIGIN, 0.0).plan.station) == 301


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


def test_an_alignment_turned_around_is_the_same_line(tmp_path):
    there = chained((30.0, 0.0, 0.004), (50.0, 0.004, 0.004), (20.0, 0.0, -0.01))
    back = turn_around(there, 10.0)
    (_, one), (station, other) = there.sample(), back.sample()
    assert station[0] == 10.0
    assert other[::-1] == pytest.approx(one, abs=1e-6)
    assert turn_around(back, there.start).sample()[1] == pytest.approx(one, abs=1e-6)
