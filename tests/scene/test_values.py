"""Surveys are drawn, and scenes built from them, as they were; `tests.recorded` says how tables are written anew."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import mujoco
import numpy as np
import pytest

from scene.poses.calibration import PRESETS, UNCALIBRATED
from scene.survey.bore import draw_bore
from scene.survey.carrier import IMUS, LIDARS, Carried, calibration, draw_walk, measure_inertial, measure_prism
from scene.survey.cast import Caster, Face, sweeps
from scene.survey.config import LidarName, SurveyConfig, TruthName
from scene.survey.lidar import SCAN_PERIOD
from scene.survey.simulate import make_device
from scene.survey.write import describe_truth
from scene.writing.folder import write_geometry
from scene.writing.mjcf import SceneConfig
from scene.writing.track import TrackConfig, lay_track
from tests.recorded import arrays_of, check

TABLE = Path(__file__).with_name("values.csv")
CONFIG = SurveyConfig(Path(), length=24.0, seed=3, tolerances=True, texture=0.5)


def files_of(scene: Path) -> dict[str, Any]:
    """Contents of the arrays and of both models of a scene folder."""
    found: dict[str, Any] = {}
    for path in sorted(scene.glob("*.npz")):
        with np.load(path) as data:
            found[path.stem] = {name: data[name] for name in data.files}
    for path in sorted(scene.glob("*.xml")):
        found[path.stem] = arrays_of(mujoco.MjModel.from_xml_path(str(path)))
    for path in sorted((scene / "meshes").glob("*.obj")):
        lines = path.read_text().splitlines()
        rows = {kind: [line.split()[1:] for line in lines if line.startswith(f"{kind} ")] for kind in ("v", "vt")}
        found[path.stem] = {kind: np.array(numbers, float) for kind, numbers in rows.items()}
    return found


def test_the_builder_finds_in_a_survey_what_it_found(simulated):
    facts = json.loads((simulated.scene / "manifest.json").read_text())
    told = {name: fact for name, fact in facts.items() if name not in ("files", "versions", "builder", "inputs")}
    del told["detected"]["clock_offset"]  # next to nothing, and of another processor another nothing
    check(TABLE, "found", {"manifest": told, "seen": simulated.found.seen, **files_of(simulated.scene)})


def test_an_arc_with_niches_is_written_as_it_was(arc_scene):
    check(TABLE, "arc", files_of(arc_scene[0]))


def test_a_round_bore_has_its_track_on_a_slab_as_it_had(bore, tmp_path):
    tube = replace(bore, radius=np.full_like(bore.radius, 2.8))
    laid = lay_track(tube, TrackConfig())
    write_geometry(tmp_path, "round", "simulated", tube, laid, SceneConfig())
    check(TABLE, "round", {**files_of(tmp_path), "track": laid})


@pytest.mark.parametrize("truth", get_args(TruthName))
def test_a_bore_is_drawn_as_it_was(truth):
    config = replace(CONFIG, truth=truth)
    bore = draw_bore(np.random.SeedSequence(3), config.length, truth, tolerances=True)
    told = describe_truth(bore, config) | ({} if truth == "paper" else {"config": "as that of paper"})
    check(TABLE, truth, {"truth": told, "mesh": bore.mesh()})


@pytest.mark.parametrize("name", get_args(LidarName))
def test_a_device_measures_what_it_measured(name):
    bore = draw_bore(np.random.SeedSequence(3), CONFIG.length, "metro")
    walk = draw_walk(np.random.default_rng(4), bore, 1.0, SCAN_PERIOD)
    carried, lidar = Carried(walk, LIDARS[name]), make_device(name, CONFIG).lidar
    face = Face(bore.alignment, bore.section, CONFIG.texture, CONFIG.seed)
    caster = Caster(bore.mesh(), lidar.range_max)
    sweep = next(iter(sweeps(np.random.default_rng(5), lidar, carried, caster, CONFIG.errors, face=face)))
    inertial = [measure_inertial(np.random.default_rng(6), carried, i.rate, i.mount, CONFIG.errors) for i in IMUS[name]]
    prism = measure_prism(np.random.default_rng(7), walk, CONFIG.errors.prism_noise)
    poses = carried.poses(np.linspace(0.0, walk.duration, 50))
    value = {"sweep": sweep, "inertial": inertial, "prism": prism, "poses": poses, "calibration": calibration(name)}
    check(TABLE, name, value, 1e-3)


def test_mounts_are_those_of_their_sources():
    check(TABLE, "mounts", {**PRESETS, "none": UNCALIBRATED}, 1e-6)
