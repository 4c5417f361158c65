"""Truths of places as scanners meet them: portal, corridor, works, platform, road, and slab track."""

import json
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import trimesh
from plyfile import PlyData
from scipy.spatial import cKDTree

from scene.survey.cast import draw_strays
from scene.survey.config import TruthName
from scene.survey.mesh import Part
from tests.scene.surveyed import frames, load_trajectory, survey
from tests.scene.test_survey_truths import SHELL, TYPES

LENGTH = 18.0
SIZES = {
    "portal": (8.7, 6.6), "corridor": (5.1, 4.4), "works": (5.65, 6.36), "platform": (5.65, 6.36),
    "road": (9.6, 7.0), "slabtrack": (5.1, 5.5),
}  # fmt: skip
TRACKS = {"portal": [2.0, -2.0], "corridor": [], "road": []}


def test_every_truth_is_tested_here_or_with_the_bare_bores() -> None:
    assert {*SIZES, *TYPES} == set(get_args(TruthName))


@pytest.fixture(scope="module", params=SIZES)
def place(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path, dict]:
    folder = tmp_path_factory.mktemp(request.param)
    survey(folder, "--truth", request.param, "--length", LENGTH, "--seed", 4, "--sensors")
    return request.param, folder, json.loads((folder / "truth.json").read_text())


def shell_of(folder: Path, parts: tuple[Part, ...] = SHELL) -> trimesh.Trimesh:
    ply = PlyData.read(folder / "truth.ply")
    vertices = np.column_stack([ply["vertex"][k] for k in "xyz"])
    faces = np.vstack(ply["face"]["vertex_indices"])[np.isin(ply["face"]["part"], parts)]
    return trimesh.Trimesh(vertices, faces, process=False)


def test_sizes_are_what_rays_measure_between_the_bare_walls(place: tuple[str, Path, dict]) -> None:
    name, folder, truth = place
    shell = shell_of(folder)
    origin = np.floor(shell.vertices[0])
    shell.apply_translation(-origin)
    position, _, lateral, up = frames(truth)
    position = position - origin
    steep = 6e-3 if name == "portal" else 2e-3

    def reach(start: np.ndarray, ray: np.ndarray) -> np.ndarray:
        place, rays, _ = shell.ray.intersects_location(start, np.broadcast_to(ray, start.shape), multiple_hits=False)
        out = np.full(len(start), np.nan)
        out[rays] = np.linalg.norm(place - start[rays], axis=1)
        return out

    for i in range(6, len(truth["station"]) - 6, 5):
        half = 0.5 * truth["height_smooth"][i]
        start = position[i] + np.arange(0.01 - half, half - 0.5, 0.01)[:, None] * up[i]
        chord = reach(start, lateral[i]) + reach(start, -lateral[i])
        if not any(abs(truth["station"][i] - s) < 0.4 for k in (0.3, 0.7) for s in (k * LENGTH, k * LENGTH + 2)):
            assert np.nanmax(chord) == pytest.approx(truth["width"][i], abs=steep)
        tall = reach(position[i : i + 1], up[i]) + reach(position[i : i + 1], -up[i])
        assert tall[0] == pytest.approx(truth["height"][i], abs=steep)
    bare = np.array(truth["aside"]) == 0.0
    bare &= np.array(truth["station"]) < LENGTH - 9.0
    np.testing.assert_allclose(np.array(truth["width_smooth"])[bare], SIZES[name][0], atol=0.2)
    np.testing.assert_allclose(truth["height_smooth"], SIZES[name][1], atol=0.2)


def test_tracks_and_things_stand_where_the_truth_says(place: tuple[str, Path, dict]) -> None:
    name, folder, truth = place
    position, tangent, lateral, up = frames(truth)
    station, half = np.array(truth["station"]), 0.5 * np.array(truth["height_smooth"])

    def local(points: np.ndarray) -> np.ndarray:
        near = np.argmin(np.linalg.norm(points[:, None] - position, axis=2), axis=1)
        off = points - position[near]
        parts = (np.einsum("ij,ij->i", off, axis[near]) for axis in (tangent, lateral, up))
        along, left, above = parts
        return np.stack([station[near] + along, left, above + half[near]], axis=1)

    assert truth["tracks"] == TRACKS.get(name, [0.0])
    sleepers = np.array(truth["sleepers"]["position"]).reshape(-1, 3)
    assert len(sleepers) == len(truth["sleepers"]["station"])
    if len(sleepers):
        rise = 0.22 if name == "slabtrack" else 0.06
        np.testing.assert_allclose(local(sleepers)[:, 2], rise, atol=0.02)
        tops = shell_of(folder, (Part.SLEEPER,))
        seen = local(np.asarray(tops.vertices)[np.unique(tops.faces)])
        assert abs(seen[:, 2].max() - rise) < 0.03
        for track in truth["tracks"]:
            assert (abs(seen[:, 1] - track) < 1.27).any()
        assert (abs(seen[:, 1:2] - np.array(truth["tracks"])).min(axis=1) < 1.27).all()
    assert bool(truth["things"]) == (name in ("works", "platform", "road", "corridor"))
    if truth["things"]:
        mesh = shell_of(folder, (Part.THING,))
        corners = local(np.asarray(mesh.vertices)[np.unique(mesh.faces)])
        inside = np.zeros(len(corners), bool)
        for thing in truth["things"]:
            low = np.array([thing["start"], thing["right"], thing["low"]]) - 0.03
            high = np.array([thing["end"], thing["left"], thing["high"]]) + 0.03
            inside |= ((corners > low) & (corners < high)).all(axis=1)
        assert inside.all()
        sizes = [thing["end"] - thing["start"] for thing in truth["things"] if thing["kind"] == "vehicle"]
        assert name != "works" or max(sizes) == pytest.approx(0.3 * LENGTH)


def test_works_leave_a_gap_and_strays_and_the_slab_shows_its_floor(tmp_path: Path) -> None:
    survey(
        tmp_path, "--truth", "works", "--length", 18, "--seed", 4, "--sensors", "vlp16", "--cloud", "--scan-every", 8
    )
    truth = json.loads((tmp_path / "truth.json").read_text())
    cloud = PlyData.read(tmp_path / "cloud.ply")["vertex"]
    points = np.column_stack([cloud[k] for k in "xyz"])
    position, _, lateral, up = frames(truth)
    near = cKDTree(position).query(points)[1]
    off = points - position[near]
    left, above = np.einsum("ij,ij->i", off, lateral[near]), np.einsum("ij,ij->i", off, up[near])
    station = np.array(truth["station"])[near]
    wall = (abs(abs(left) - 2.82) < 0.2) & (above > -2.5) & (above < 0.0)
    start, end = truth["dark"]
    assert end - start == pytest.approx(4.0)
    dark = wall & (station > start + 0.5) & (station < end - 0.5)
    before = wall & (station > start - 3.5) & (station < start - 0.5)
    assert dark.sum() < 0.02 * before.sum()
    behind = np.mean((abs(left) > 3.1) & (station < start))
    assert 0.01 < behind < 0.04  # 3 % of the returns, some of them along the bore
    assert truth["strays"] == truth["config"]["errors"]["strays"] == 0.03
    assert len(load_trajectory(tmp_path / "groundtruth_vlp16.tum").time) > 100


def test_the_asked_share_of_returns_strays_by_up_to_6_m_and_none_draws_nothing() -> None:
    rng, exact = np.random.default_rng(1), np.full(200_000, 5.0, np.float32)
    off = draw_strays(rng, 0.03, exact) - exact
    stray = off > 0.0
    assert stray.mean() == pytest.approx(0.03, abs=3 * np.sqrt(0.03 * 0.97 / len(off)))
    assert off[stray].mean() == pytest.approx(3.0, abs=0.1)
    assert 5.9 < off.max() <= 6.0
    state = rng.bit_generator.state
    assert draw_strays(rng, 0.0, exact) is exact
    assert rng.bit_generator.state == state  # bare bores keep their bytes
