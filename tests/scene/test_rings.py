"""Ring surveys in both layouts: circles, and what is refused by name and cause."""

import numpy as np
import pytest

from scene.build import judge, reconstruct
from scene.cleaning.clean import ExtentConfig
from scene.config import ReconstructConfig
from scene.errors import FitError, RecordingError, Refusal
from scene.fitting.rings import bore_from_rings, fit_rings
from scene.judging.judge import JudgingConfig
from scene.progress import Stages
from scene.reading.formats import detect
from scene.reading.ringsurvey import read_ring_survey
from scene.writing.track import TrackConfig, lay_track
from tests.scene.files import RING_HEADER, ring_rows, write_xlsx
from tests.shared import METRO, SHARED, needs_metro

COLUMNS = ("POINT", "EASTING", "NORTHING", "ELEVATION")


def survey_text(radius: float = 2.9, count: int = 12, per_ring: int = 8, shown: float = 1.0) -> str:
    """Rings every 1.5 m along easting, centres 10 m up; the first part of each ring is shown."""
    lines = [",".join(COLUMNS)]
    for ring in range(count):
        for point in range(per_ring):
            turn = 2 * np.pi * shown * point / per_ring
            row = (1000 + 1.5 * ring, 500 + radius * np.cos(turn), 10 + radius * np.sin(turn))
            lines.append(f"{ring}.{point + 1}," + ",".join(f"{value:.4f}" for value in row))
    return "\r\n".join(lines) + "\r\n"


def test_circles_are_recovered(tmp_path):
    (tmp_path / "s.csv").write_text(survey_text())
    fit = fit_rings(read_ring_survey(detect(tmp_path).path))
    np.testing.assert_allclose(fit.radius, 2.9, atol=2e-4)
    np.testing.assert_allclose(fit.centre, [[1000 + 1.5 * k, 500, 10] for k in range(12)], atol=2e-4)
    bore = bore_from_rings(fit, np.array([1000.0, 500, 10]))
    assert bore.length == pytest.approx(16.5, abs=1e-3)
    np.testing.assert_allclose(bore.ring_station, 1.5 * np.arange(12), atol=1e-3)
    assert not bore.filled[::6].any()  # stations of rings, 0.25 m apart from the next
    assert bore.filled[3::6].all()


@pytest.mark.parametrize("reverse", [False, True])
def test_a_ring_survey_is_a_round_bore_from_its_first_ring_to_its_last_or_back(tmp_path, reverse, capsys):
    (tmp_path / "s.csv").write_text(survey_text())
    result = reconstruct(tmp_path, None, ReconstructConfig(extent=ExtentConfig(reverse=reverse)), Stages())
    ends = np.array([[1000.0, 500, 10], [1016.5, 500, 10]])[:: -1 if reverse else 1]
    np.testing.assert_allclose(result.bore.position[[0, -1]] + result.origin, ends, atol=1e-3)
    facts = result.facts
    assert (facts["rings"], facts["first_ring"], facts["last_ring"]) == (12, *(("11", "0") if reverse else ("0", "11")))
    assert (facts["radius_mean"], facts["radius_sd"]) == pytest.approx((2.9, 0.0), abs=1e-4)
    assert facts["stations_grow"].startswith("against this, by --reverse" if reverse else "with the order of the rings")
    assert "detected: " in capsys.readouterr().out
    assert "holds no returns" in judge(result, lay_track(result.bore, TrackConfig()), JudgingConfig()).summary()


def test_a_ring_is_seen_as_far_as_its_points_reach_and_an_eighth_of_a_turn_more(tmp_path):
    (tmp_path / "s.csv").write_text(survey_text(per_ring=17, shown=0.53125))  # every 11.25°, half a turn
    fit = fit_rings(read_ring_survey(tmp_path / "s.csv"))
    np.testing.assert_allclose(fit.radius, 2.9, atol=1e-3)
    np.testing.assert_allclose(fit.seen, 0.5 + 2 / 16, atol=0.01)
    np.testing.assert_allclose(bore_from_rings(fit, np.zeros(3)).coverage, 0.625, atol=0.01)


def test_one_gross_outlier_does_not_move_a_ring(tmp_path):
    text = survey_text().replace("3.1,1004.5000,502.9000", "3.1,1004.5000,503.3000")
    (tmp_path / "s.csv").write_text(text)
    fit = fit_rings(read_ring_survey(tmp_path / "s.csv"))
    assert np.linalg.norm(fit.centre[3] - [1004.5, 500, 10]) < 0.02


def test_point_ten_of_a_ring_is_not_point_one(tmp_path):
    (tmp_path / "s.csv").write_text(survey_text(per_ring=10))
    survey = read_ring_survey(tmp_path / "s.csv")
    assert len(survey.names) == 12
    assert all(len(points) == 10 for points in survey.points)


@pytest.mark.parametrize(
    ("text", "error", "cause"),
    [
        ("", RecordingError, "columns are"),
        ("A,B\n1,2\n", RecordingError, "columns are"),
        (",".join(COLUMNS) + "\n", RecordingError, "holds 0 rings"),
        (survey_text().replace("1000.0000", "abc", 1), RecordingError, "line 2 is not a ring point"),
        (survey_text().replace("1000.0000", "nan", 1), RecordingError, "is not a ring point"),
        (survey_text().replace("0.1,", "01,", 1), RecordingError, "is not a ring point"),
        (survey_text(per_ring=4), FitError, "ring 0 has 4 points"),
    ],
)
def test_a_bad_survey_is_refused_by_name_and_cause(tmp_path, text, error, cause):
    (tmp_path / "s.csv").write_text(text)
    with pytest.raises(error, match=rf"s\.csv: .*{cause}"):
        fit_rings(read_ring_survey(tmp_path / "s.csv"))


@needs_metro
def test_the_real_metro_has_its_published_length_radius_and_centres():
    """Against the best-fit circles that the survey's author published."""
    fit = fit_rings(read_ring_survey(detect(METRO).path))
    reference = np.genfromtxt(METRO / "export_best_fit_result.csv", delimiter=",", skip_header=1)
    assert len(fit.names) == 217
    assert fit.radius.mean() == pytest.approx(2.898, abs=0.005)
    assert np.sqrt(np.mean(np.sum((fit.centre - reference[:, 1:4]) ** 2, axis=1))) < 0.02
    bore = bore_from_rings(fit, np.floor(np.median(fit.centre, axis=0)))
    assert bore.length == pytest.approx(1283.7, rel=0.002)


WATER = SHARED / "data" / "water_tunnel_asbuilt"


def fitted_rings(path, **options):
    return fit_rings(read_ring_survey(path, **options))


def test_a_workbook_with_rings_is_found_and_read(tmp_path):
    path = write_xlsx(tmp_path / "s.xlsx", ring_rows(offset=0.04))
    found = detect(tmp_path)
    assert (found.path, found.format.name) == (path, "rings")
    survey = read_ring_survey(path)
    fit = fit_rings(survey)
    np.testing.assert_allclose(fit.radius, 1.7, atol=1e-6)  # targets stood 4 cm inside the wall


def test_the_same_layout_as_csv_reads_alike(tmp_path):
    lines = [";".join([*RING_HEADER, 300 * "-"]), *(";".join(map(str, row)) for row in ring_rows())]
    (tmp_path / "s.csv").write_text("\n".join(lines))
    np.testing.assert_allclose(fitted_rings(tmp_path / "s.csv").radius, 1.7, atol=1e-6)


def test_millimetres_by_header_or_flag_become_metres(tmp_path):
    rows = [(r, p, *(1000 * value for value in rest)) for r, p, *rest in ring_rows()]
    header = tuple(name.replace("M.", "mm") for name in RING_HEADER)
    np.testing.assert_allclose(
        fitted_rings(write_xlsx(tmp_path / "a.xlsx", rows, header=header)).radius, 1.7, atol=1e-6
    )
    wrong = write_xlsx(tmp_path / "b.xlsx", rows)
    np.testing.assert_allclose(fitted_rings(wrong, unit="mm").radius, 1.7, atol=1e-6)
    with pytest.raises(FitError, match=r"b\.xlsx: ring 0 .* 1700 m") as raised:
        fitted_rings(wrong)
    assert raised.value.code is Refusal.RINGS


def changed(row, **values):
    return tuple(values.get(name, value) for name, value in zip("rpenzo", row, strict=True))


def test_a_bad_row_of_a_workbook_is_named_by_sheet_and_row(tmp_path):
    rows = ring_rows()
    for value in ("n/a", None, float("nan")):
        path = write_xlsx(tmp_path / "s.xlsx", [*rows[:5], changed(rows[5], n=value), *rows[6:]])
        with pytest.raises(RecordingError, match=r"s\.xlsx: sheet 'Survey' row 7 is not a ring point"):
            read_ring_survey(path)


@pytest.mark.parametrize(
    ("edit", "cause"),
    [
        (lambda row: changed(row, e=row[2] + 100) if row[0] > 5 else row, r"rings 5 and 6 .* 104\.8 m"),
        (lambda row: changed(row, e=2000 - row[2]) if row[0] > 5 else row, "at ring 5"),
        (lambda row: changed(row, e=1004.8) if row[0] == 2 else row, "rings 1 and 2"),
    ],
)
def test_a_gap_a_turn_or_a_repeated_ring_is_named(tmp_path, edit, cause):
    path = write_xlsx(tmp_path / "s.xlsx", [edit(row) for row in ring_rows()])
    with pytest.raises(FitError, match=rf"s\.xlsx: .*{cause}") as raised:
        fitted_rings(path)
    assert raised.value.code is Refusal.RINGS


@pytest.mark.skipif(not WATER.is_dir(), reason="the water tunnel's survey is not here")
def test_the_real_water_tunnel_has_its_published_diameter():
    survey = read_ring_survey(detect(WATER).path)
    fit = fit_rings(survey)
    assert len(fit.names) == 46
    assert 2 * fit.radius.mean() == pytest.approx(3.396, abs=0.015)
    assert fit.radius.std() < 0.003, "rings measured with and without a target must agree"
