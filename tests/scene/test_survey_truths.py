"""Every class of truth against rays of its own, and the furniture's statistics."""

import json
from pathlib import Path

import numpy as np
import pytest

from scene.survey.alignment import lay_out, metro_elements
from scene.survey.mesh import Part
from tests.scene.surveyed import Cast, frames, load_cast, survey
from tests.shared import METRO, needs_metro

LENGTH = 18.0
SHELL = (Part.LINING, Part.JOINT, Part.POCKET, Part.FLOOR)
TYPES = {
    "paper": "D", "metro": "D", "horseshoe": "horseshoe", "irregular": "irregular", "circle": "circle",
}  # fmt: skip


def make(out: Path, *more: object) -> Path:
    return survey(out, "--length", LENGTH, "--seed", 6, *more, "--sensors")


@pytest.fixture(scope="module", params=TYPES)
def bare(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict, Cast]:
    name = request.param
    folder = make(tmp_path_factory.mktemp(name), "--truth", name)
    truth = json.loads((folder / "truth.json").read_text())
    assert truth["config"]["truth"] == name
    return folder, truth, load_cast(folder / "truth.ply")


def test_width_and_height_are_what_rays_measure(bare: tuple[Path, dict, Cast]) -> None:
    _, truth, cast = bare
    assert truth["section_type"] == TYPES[truth["config"]["truth"]]
    position, _, lateral, up = frames(truth)
    rings, checked = np.array([*truth["rings"]["station"], np.inf]), 0
    fall, steep = truth["crossfall"], 3e-3 if truth["section_type"] == "irregular" else 1e-3
    for i, station in enumerate(truth["station"][4:-4], start=4):
        if abs(abs(station - rings) - 0.22).min() < 0.13:
            continue  # a ray would measure into a pocket
        floor = -0.5 * truth["height_smooth"][i]
        foot = floor + fall * (0.5 * truth["width"][i] + truth["middle"][i][0]) + 0.002
        level = np.arange(foot, -floor - 0.55, 0.005)[:, None] * up[i]
        # From beside the track, whose rails would catch the lowest rays.
        left = cast(position[i] + 1.4 * lateral[i] + level, lateral[i])
        right = cast(position[i] - 1.4 * lateral[i] + level, -lateral[i])
        width = left + 2.8 + right
        assert width.max() == pytest.approx(truth["width"][i], abs=steep)
        crown = cast(position[i : i + 1], up[i])[0]
        down = cast(position[i : i + 1] + 1.4 * lateral[i], -up[i])[0]
        assert crown + down + 1.4 * fall == pytest.approx(truth["height"][i], abs=steep)
        middle = truth["middle"][i]
        assert middle[1] == pytest.approx(0.5 * (crown - down - 1.4 * fall), abs=steep)
        widest = width > width.max() - 1e-3
        assert (abs(0.5 * (left - right)[widest] - middle[0]) < 0.02).any()
        checked += 1
    assert checked > 20


@needs_metro
def test_the_metro_alignment_follows_the_real_ring_centres() -> None:
    rows = np.genfromtxt(METRO / "export_best_fit_result.csv", delimiter=",", names=True)
    centres = np.stack([rows["EASTING"], rows["NORTHING"], rows["ELEVATION"]], axis=-1)[::-1]
    station = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(centres, axis=0), axis=1))]) - 820.0
    window = (station >= 0.0) & (station <= 351.0)
    rng = np.random.default_rng(0)
    curve = lay_out(rng, 351.0, metro_elements(rng, 351.0)).frames(station[window]).position
    centres = centres[window]
    # The frame's heading and origin are drawn: the best rigid motion in plan, and a shift in height.
    plan, real = (p[:, 0] + 1j * p[:, 1] - (p[:, 0] + 1j * p[:, 1]).mean() for p in (curve, centres))
    turn = np.vdot(plan, real)
    plan_error = abs(plan * turn / abs(turn) - real)
    rise = curve[:, 2] - centres[:, 2]
    assert np.sqrt(np.mean(plan_error**2)) < 0.015
    assert (rise - rise.mean()).std() < 0.012
    assert window.sum() > 48
