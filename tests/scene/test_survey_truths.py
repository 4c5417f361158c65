"""Every class of truth against rays of its own, and the furniture's statistics."""

import json
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import trimesh

from scene.survey.alignment import lay_out, metro_elements
from scene.survey.bore import draw_bore
from scene.survey.config import TruthName
from scene.survey.furniture import draw_furniture
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


def test_sizes_are_those_of_the_class(bare: tuple[Path, dict, Cast]) -> None:
    _, truth, _ = bare
    station, width, height = (np.array(truth[k]) for k in ("station", "width", "height"))
    name = truth["config"]["truth"]
    sizes = {"horseshoe": (5.8, 5.9), "circle": (5.796, 4.896)}.get(name, (5.65, 6.36))
    middle = abs(station / LENGTH - 0.5) < 0.1
    # Slow fields of 5 cm, and roughness of 1 cm or 13 cm: the largest width over all levels is then above the mean.
    within = 0.9 if name == "irregular" else 0.2
    np.testing.assert_allclose(width[middle], sizes[0], atol=within)
    np.testing.assert_allclose(height, sizes[1], atol=max(within, 0.25))
    if name == "irregular":
        assert width[-1] - np.median(width) > 2.0
        smooth = np.array(truth["width_smooth"])[np.searchsorted(station, LENGTH - np.array([6.0, 3.0, 0.0]))]
        np.testing.assert_allclose(smooth - smooth[0], [0.0, 0.75, 3.0], atol=0.15)  # opens with the square
        assert not truth["pockets"] + truth["rings"]["station"]


@pytest.mark.parametrize("correlation", [1.0, 4.0])
def test_irregular_walls_have_the_spread_and_correlation_asked_for(correlation: float) -> None:
    station, girth = np.arange(0.0, 400.0, 1.0), np.arange(0.0, 12.0, 0.5)
    values = np.concatenate([
        draw_bore(np.random.SeedSequence(s), 351.0, "irregular", correlation).section.roughness.over(station, girth)
        for s in range(6)
    ])  # fmt: skip
    assert values.std() == pytest.approx(0.13, rel=0.04)
    lag = round(correlation)
    together = np.mean(values[:-lag] * values[lag:]) / values.var()
    assert together == pytest.approx(np.exp(-1.0), abs=0.06)


def test_furniture_strays_as_configured() -> None:
    drawn = [draw_furniture(np.random.default_rng(s), 351.0) for s in range(4)]
    filled = np.concatenate([f.filled[f.pocketed].ravel() for f in drawn])
    assert filled.mean() == pytest.approx(0.05, abs=3 * np.sqrt(0.05 * 0.95 / len(filled)))
    depth = np.concatenate([f.depth.ravel() for f in drawn])
    assert depth.mean() == pytest.approx(0.13, abs=3 * 0.01 / np.sqrt(len(depth)))
    # Cut at three standard deviations, which takes 1.5 % of the spread.
    assert depth.std() == pytest.approx(0.01 * 0.987, abs=3 * 0.01 / np.sqrt(2 * len(depth)) + 1e-4)
    jitter = np.concatenate(
        [f.sleepers - np.polyval(np.polyfit(n, f.sleepers, 1), n) for f in drawn for n in [np.arange(len(f.sleepers))]]
    )
    assert jitter.std() == pytest.approx(0.01 * 0.987, abs=3 * 0.01 / np.sqrt(2 * len(jitter)) + 1e-4)
    spacing = [np.polyfit(np.arange(len(f.sleepers)), f.sleepers, 1)[0] for f in drawn]
    np.testing.assert_allclose(spacing, 0.6, atol=3 * 0.01 * np.sqrt(12 / 585**3))
    assert {len(f.sleepers) for f in drawn} <= {584, 585}
    pairs = np.concatenate([(~f.filled[f.pocketed]).all(axis=2).ravel() for f in drawn])
    nails = np.concatenate([f.nails[f.pocketed].ravel() for f in drawn])
    assert nails[pairs].mean() == pytest.approx(0.97, abs=3 * np.sqrt(0.97 * 0.03 / pairs.sum()))
    assert not nails[~pairs].any()


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


@pytest.mark.parametrize("name", [n for n in get_args(TruthName) if n != "metro"])
def test_every_surface_faces_the_air(name: TruthName) -> None:
    bore = draw_bore(np.random.SeedSequence(2), 15.0, name)
    mesh = bore.mesh()
    origin = mesh.vertices.mean(axis=0)
    for solid in (Part.NAIL, Part.SLEEPER, Part.RAIL, Part.FASTENING):
        faces = mesh.faces[mesh.part == solid]
        assert bool(len(faces)) == ((name, solid) != ("irregular", Part.NAIL))
        one = trimesh.Trimesh(mesh.vertices - origin, faces)
        assert not len(faces) or (one.is_watertight and one.is_winding_consistent and one.volume > 0)
    shell = trimesh.Trimesh(mesh.vertices - origin, mesh.faces[np.isin(mesh.part, SHELL)])
    assert shell.is_winding_consistent
    assert shell.volume < 0  # normals point inwards
    # Two mouths, and nothing else, are open.
    edges = shell.edges_sorted[trimesh.grouping.group_rows(shell.edges_sorted, require_count=1)]
    along = bore.alignment.frames(np.array([0.0, 15.0]))
    offset = shell.vertices[edges][:, :, None] + origin - along.position
    assert len(edges) > 0
    assert abs(np.einsum("emkj,kj->emk", offset, along.tangent)).min(axis=2).max() < 1e-3
