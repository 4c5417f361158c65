"""The type of section is chosen by the data, with its parameters, stretch by stretch."""

import numpy as np
import pytest

from scene.bore import load_bore
from tests.scene.clouds import curved_d_bore
from tests.scene.fits import rebuilt
from tests.scene.shapes import midline, swept


@pytest.mark.parametrize(
    ("kind", "expected", "crown", "wall"),
    [
        ("d", "d", 2.8, np.inf),
        ("horseshoe", "horseshoe", 2.8, 5.6),
        ("circle", "circle", 2.75, 2.75),
        ("circle on a floor", "circle", 2.75, 2.75),
        ("ellipse", "free", np.nan, np.nan),
    ],
)
def test_a_section_is_told_with_its_radii(kind, expected, crown, wall):
    bore, _ = rebuilt(swept(kind, 24, yaw=0.8), midline(kind, 24, yaw=0.8))
    assert len(bore.stretch) == 1
    (stretch,) = bore.stretch
    assert stretch["type"] == expected
    assert stretch["rms"] < 0.004
    assert stretch["start"] == 0
    assert stretch["end"] == pytest.approx(bore.length)
    np.testing.assert_allclose([stretch["crown_radius"], stretch["wall_radius"]], [crown, wall], rtol=0.01)


def test_a_change_of_section_is_found_where_it_is():
    points = np.concatenate([swept("horseshoe", 20, yaw=-1.0), swept("d", 20, yaw=-1.0, start=20.0)])
    bore, _ = rebuilt(points, midline("d", 40, yaw=-1.0))
    assert list(bore.stretch["type"]) in (["horseshoe", "d"], ["d", "horseshoe"])
    assert bore.stretch["end"][0] == pytest.approx(20, abs=2.1)
    assert set(bore.section_type) == {"horseshoe", "d"}


def test_curvature_grade_and_types_are_in_the_bore_file(tmp_path):
    bore, _ = rebuilt(curved_d_bore(length=40, radius=150, grade=0.01).points)
    bore.save(tmp_path / "bore.npz")
    with np.load(tmp_path / "bore.npz") as data:
        inner = (data["station"] > 5) & (data["station"] < 35)
        sign = np.sign(np.median(data["grade"]))  # the bore may be run from either end
        np.testing.assert_allclose(sign * data["curvature"][inner], 1 / 150, rtol=0.1)
        np.testing.assert_allclose(sign * data["grade"], 0.01, atol=0.003)
        assert (data["section_type"] == "d").all()
    again = load_bore(tmp_path / "bore.npz")
    np.testing.assert_array_equal(again.confidence, bore.confidence)
    np.testing.assert_array_equal(again.stretch, bore.stretch)


def test_confidence_is_high_on_a_wall_that_was_seen():
    bore, _ = rebuilt(swept("circle", 20, yaw=0.1), midline("circle", 20, yaw=0.1))
    assert bore.confidence.min() > 0.99
