"""Sizes drawn within building tolerance, and the surveyed mesh that has them."""

from dataclasses import fields

import numpy as np
import pytest

from scene.survey.bore import draw_bore
from scene.survey.config import SurveyConfig
from scene.survey.furniture import DESIGN, TOLERANCE, draw_sizes
from scene.survey.mesh import Part
from scene.survey.write import describe_truth


@pytest.fixture(scope="module")
def bores():
    return [draw_bore(np.random.SeedSequence(7), 20.0, "paper", tolerances=on) for on in (False, True)]


def test_every_size_is_drawn_within_its_tolerance_and_differs_from_the_design() -> None:
    drawn = [draw_sizes(np.random.default_rng(seed)) for seed in range(40)]
    for size in fields(DESIGN):
        if size.name in TOLERANCE:
            values = np.array([getattr(one, size.name) for one in drawn])
            middle = 0.12 if size.name == "pocket_depth" else getattr(DESIGN, size.name)
            assert (abs(values - middle) <= TOLERANCE[size.name] + 1e-9).all(), size.name
            assert values.std() > 0.3 * TOLERANCE[size.name], size.name
    rows = np.array([one.row_depth for one in drawn])
    assert abs(rows[:, :4] - rows[:, 4:]).min(axis=1).max() > 0.0  # no bore is alike left and right


def test_without_tolerances_a_bore_is_as_designed_and_all_other_draws_stay(bores) -> None:
    designed, built = (bore.furniture for bore in bores)
    assert designed.sizes == DESIGN
    assert designed.rail_axis == pytest.approx(0.754)
    assert designed.joints[0] == built.joints[0]
    np.testing.assert_array_equal(designed.filled[:12], built.filled[:12])
    station = np.arange(0.0, 20.0)
    np.testing.assert_array_equal(bores[0].section.width(station), bores[1].section.width(station))


def test_the_surface_has_the_sizes_that_the_truth_states(bores, tmp_path) -> None:
    bore = bores[1]
    truth, mesh = describe_truth(bore, SurveyConfig(tmp_path, tolerances=True)), bore.mesh()
    points = mesh.vertices[np.unique(mesh.faces[mesh.part == Part.RAIL])]
    frame = bore.alignment.frames(np.array([10.0]))
    near = points[abs((points - frame.position[0]) @ frame.tangent[0]) < 0.2] - frame.position[0]
    left, up = near @ frame.lateral[0], near @ frame.up[0]
    faces = left[(up > up.max() - 0.02) & (up < up.max() - 0.011)] - truth["tracks"][0]
    gap = faces[faces > 0].min() - faces[faces < 0].max()
    assert gap == pytest.approx(truth["rails"]["gauge"], abs=2e-3)
    assert np.ptp(up) == pytest.approx(truth["rails"]["height"], abs=2e-3)
    assert truth["rails"]["gauge"] == bore.furniture.sizes.gauge != DESIGN.gauge
    assert np.median(np.diff(truth["rings"]["station"])) == pytest.approx(bore.furniture.sizes.ring_width, abs=1e-6)
    depth = {side: np.mean([p["depth"] for p in truth["pockets"] if p["side"] == side]) for side in ("left", "right")}
    assert depth["left"] != pytest.approx(depth["right"], abs=1e-4)
