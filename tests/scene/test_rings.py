import numpy as np
import pytest

from scene.errors import FitError, RecordingError
from scene.fitting.rings import bore_from_rings, fit_rings
from scene.reading.formats import detect
from scene.reading.ringsurvey import read_ring_survey
from tests.shared import METRO, needs_metro

COLUMNS = ("POINT", "EASTING", "NORTHING", "ELEVATION")


def survey_text(radius: float = 2.9, count: int = 12, per_ring: int = 8) -> str:
    """Rings every 1.5 m along easting, centres 10 m up."""
    lines = [",".join(COLUMNS)]
    for ring in range(count):
        for point in range(per_ring):
            turn = 2 * np.pi * point / per_ring
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
