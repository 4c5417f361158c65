"""Rays of both LiDARs against embree in a small built scene, and in a spoiled one."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

from benchmarks.rays import picture
from benchmarks.rays.__main__ import RaysConfig, command, main, run
from benchmarks.rays.casting import Agreement
from scene.writing.folder import write_geometry
from scene.writing.mjcf import SceneConfig
from scene.writing.track import TrackConfig, lay_track
from subterra_jax.lidar3d.relief import Relief
from subterra_jax.lidar3d.surface import read_mesh, read_scene
from tests.scene.conftest import arc_bore

RAYS = 6400


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A furnished bore of 24 m in a bend, with track and pockets."""
    folder = tmp_path_factory.mktemp("rays") / "scene"
    folder.mkdir()
    bore = arc_bore()
    write_geometry(folder, "arc", "simulated", bore, lay_track(bore, TrackConfig()), SceneConfig())
    return folder


def check(scene: Path, linings: tuple[str, ...], kinds: tuple[str, ...]) -> None:
    found, rates = run(RaysConfig(scene=scene, n=RAYS, linings=linings, kinds=kinds))
    judged = [one for one in found if one.judged]
    assert len(judged) == len(linings or ("smooth", "pockets", "furnished")) * len(kinds)
    for one in judged:
        assert one.holds, one.figures()
        assert np.ptp(one.range) > 8.0  # they look at much more than the nearest wall
        assert one.title.startswith("planar") or np.percentile(one.error, 99.9) < 1e-3
    assert all(rate > 0.0 for rate in rates.values())


def test_the_planar_lidar_agrees_with_embree_in_every_lining(scene: Path) -> None:
    check(scene, (), ("planar",))


def test_the_3d_lidar_agrees_with_embree_in_lining_and_track(scene: Path) -> None:
    check(scene, ("pockets",), ("3d",))


@pytest.mark.slow
def test_the_3d_lidar_agrees_with_embree_in_every_lining(scene: Path) -> None:
    check(scene, ("smooth", "furnished"), ("3d",))


def test_a_wall_that_is_2_cm_off_is_noticed(scene: Path, tmp_path: Path) -> None:
    spoiled = tmp_path / "spoiled"
    shutil.copytree(scene, spoiled)
    lining = trimesh.load(spoiled / "meshes" / "lining.ply", process=False)
    lining.vertices[:, 1] += 0.02
    lining.export(spoiled / "meshes" / "lining.ply")
    out = tmp_path / "rays.json"
    assert main(RaysConfig(scene=spoiled, n=3200, linings=("pockets",), kinds=("planar",), out=out)) == 1
    report = json.loads(out.read_text())
    assert report["schema"] == "subterra.rays/1"
    assert [one["holds"] for one in report["comparisons"]] == [False, True]
    assert report["comparisons"][0]["all"]["p50"] > 5e-3
    assert json.loads((tmp_path / "records.json").read_text())


def test_a_ray_that_passes_an_edge_is_counted_and_told_apart() -> None:
    error = np.array([0.0, 0.0, 0.0, 0.0005, 0.3])
    one = Agreement("x", error, np.array([False] * 4 + [True]), np.ones(5), np.arange(5.0))
    figures = one.figures()
    assert figures["n_edge"] == 1
    assert figures["all"]["max"] == 0.3
    assert figures["without_edges"]["max"] == 0.0005
    assert figures["worst"][0] == {"station": 3.0, "range": 1.0, "error": 0.0005}
    assert not one.holds


def test_what_a_scene_draws_holds_lining_and_track(scene: Path) -> None:
    drawn, lining = read_scene(scene, "pockets"), read_mesh(scene / "meshes" / "lining.ply")
    track = read_scene(scene, "pockets", ("lining", "recess", "floor", "fastening", "nails"))
    assert len(drawn.faces) == len(lining.faces) + len(track.faces)
    # 41 sleepers of 12 triangles, and rails of six boxes for every 3 m.
    assert len(track.faces) == 12 * 41 + 12 * 6 * 9
    assert Relief.from_scene(scene, "smooth").vertex.shape[1] == 2


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--scene", "nowhere"], "nowhere: is no built scene: tunnel.npz is missing"),
        (
            ["--scene", "SCENE", "--linings", "brick"],
            "has no mesh of lining 'brick'; it has smooth, pockets, furnished",
        ),
        (["--scene", "SCENE", "--kinds", "4d"], "there is no kind '4d'"),
        (["--scene", "SCENE", "--n", "0"], "n must be at least 1, got 0"),
    ],
)
def test_a_users_mistake_is_one_sentence_and_status_2(
    scene: Path, arguments: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command([str(scene) if word == "SCENE" else word for word in arguments]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert said[0].startswith("error: ")
    assert complaint in said[0]


@pytest.mark.slow
def test_the_picture_shows_what_each_sensor_sees(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    config = picture.PictureConfig(tmp_path / "sensors.png", station=30.0)
    azimuth, elevation, ranges = picture.look(config, "spin16x64")
    assert azimuth.shape == elevation.shape == ranges.shape == (16, 64)
    assert np.abs(azimuth).max() > 174.0
    assert np.ptp(elevation) == pytest.approx(30.0, abs=0.01)
    aside = np.abs(np.abs(azimuth) - 90.0) < 5.0
    assert np.median(ranges[aside]) < 4.0  # the walls
    assert np.median(ranges[8][np.abs(azimuth[8]) < 6.0]) > 10.0  # along the bore
    picture.main(config)
    assert capsys.readouterr().out.split() == [str(config.out)]
    assert config.out.stat().st_size > 50_000
