import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from rich.console import Console

from scene import cloud
from scene.bore import POCKET, STATION_STEP, Bore
from scene.build import build
from scene.config import BuildConfig
from scene.fitting.section import measure_extents
from scene.geometry import N_ANGLES, axis_through, section_angles
from scene.reading import las_e57, source, tables
from scene.survey.config import SurveyConfig
from scene.survey.simulate import simulate
from scene.writing.folder import Reconstruction, write_geometry
from scene.writing.furnished import FurnitureConfig
from scene.writing.mjcf import SceneConfig
from scene.writing.track import Track, TrackConfig, lay_track
from tests.scene.clouds import curved_d_bore


def arc_bore(length: float = 24.0, radius: float = 60.0, grade: float = 0.01, half_width: float = 2.8) -> Bore:
    """A D-section with exact corners on an arc, with a pair of pockets on each wall every 3 m at LiDAR height."""
    turn = np.linspace(0, length / radius, 40)
    points = np.stack([radius * np.sin(turn), radius * (1 - np.cos(turn)), grade * radius * turn + 3.2], axis=1)
    axis = axis_through(points, STATION_STEP)
    angle = section_angles() + np.pi / N_ANGLES
    with np.errstate(divide="ignore"):
        wall = np.where(np.sin(angle) > 0, half_width, half_width / np.abs(np.cos(angle)))
        floor = np.where(np.sin(angle) < 0, 3.2 / np.abs(np.sin(angle)), np.inf)
    section = np.minimum(wall, floor)
    n = len(axis.station)
    width, height = measure_extents(angle, section[None])
    bore = Bore(
        axis.station, axis.position, axis.tangent, axis.lateral, axis.up, np.repeat(width, n), np.repeat(height, n),
        angle, np.repeat(section[None], n, axis=0), np.zeros(n), np.ones(n), np.zeros(n, bool), np.empty(0),
        np.empty(0, POCKET),
    )  # fmt: skip
    joints = np.arange(1.5, length - 1.0, 3.0)
    lidar = np.arctan2(-3.2 + 0.06 + 0.7, half_width)
    rows = [(s + d, a, 0.2, 0.16, 0.13, 1.0, True) for s in joints for d in (-0.2, 0.2) for a in (lidar, np.pi - lidar)]
    return replace(bore, ring_station=joints, pocket=np.array(rows, POCKET))


@pytest.fixture(scope="session")
def bore() -> Bore:
    return arc_bore()


ORIGIN = [271_000.0, 2_103_000.0, -17.0]


@pytest.fixture(scope="session")
def arc_scene(bore, tmp_path_factory) -> tuple[Path, Track, dict[str, int]]:
    """The scene folder of the arc with niches, its track, and the number of each asset in it."""
    folder = tmp_path_factory.mktemp("built") / "arc"
    folder.mkdir()
    laid = lay_track(bore, TrackConfig())
    config = SceneConfig(furniture=FurnitureConfig(passage_spacing=12.0, plate_spacing=8.0))
    count, _ = write_geometry(folder, "arc", "simulated", bore, laid, config)
    one = {"schema": "subterra.manifest/1", "name": "arc", "input_provenance": "simulated", "frame": {"origin": ORIGIN}}
    (folder / "manifest.json").write_text(json.dumps(one))
    return folder, laid, count


@pytest.fixture(scope="session")
def bore_file(tmp_path_factory) -> Path:
    """A cloud of 24 m of a curved D-shaped bore."""
    path = tmp_path_factory.mktemp("cloud") / "bore.ply"
    trimesh.PointCloud(curved_d_bore(length=24, per_metre=2000, offset=(12.0, -3.0, 2.0)).points).export(path)
    return path


@dataclass(frozen=True)
class Simulated:
    """A simulated survey of sizes as built, and the scene that was built from it with its true poses."""

    survey: Path
    scene: Path
    found: Reconstruction
    truth: dict


@pytest.fixture(scope="session")
def simulated(tmp_path_factory) -> Simulated:
    folder = tmp_path_factory.mktemp("simulated")
    survey, scene = folder / "survey", folder / "scene"
    config = SurveyConfig(survey, truth="metro", length=19.0, seed=601, tolerances=True, speed=2.0)
    simulate(config, Console(quiet=True))
    named = BuildConfig(provenance="simulated")
    found = build(survey / "survey.bag", scene, survey / "groundtruth.tum", named)
    return Simulated(survey, scene, found, json.loads((survey / "truth.json").read_text()))


@pytest.fixture
def small_blocks(monkeypatch):
    """Blocks so small that a file of a few hundred points has several."""
    for module in (source, tables, las_e57):
        monkeypatch.setattr(module, "BATCH", 300)
    monkeypatch.setattr(source, "_TEXT_BLOCK", 5000)
    monkeypatch.setattr(cloud, "_MERGE_AT", 350)


@pytest.fixture
def silent(recwarn):
    """No warning of a library reaches the user, whatever the input."""
    yield
    seen = [one for one in recwarn if issubclass(one.category, RuntimeWarning | UserWarning)]
    assert not [one for one in seen if not issubclass(one.category, pytest.PytestWarning)]
