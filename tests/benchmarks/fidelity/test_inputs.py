"""Mistakes of a user with the commands: one sentence, status 2, nothing half-written."""

import sys
from pathlib import Path

import pytest

from benchmarks.fidelity.__main__ import main
from benchmarks.fidelity.candidate import load_candidate
from benchmarks.fidelity.files import FidelityError
from benchmarks.fidelity.inputs import Inputs, complete_inputs, with_sigma
from benchmarks.fidelity.references import HoldConfig


def test_a_recording_without_poses_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FidelityError, match="--recording and --trajectory go together"):
        complete_inputs(Inputs(scene=tmp_path, recording=tmp_path))


def test_references_without_a_scene_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FidelityError, match="need --scene"):
        complete_inputs(Inputs(truth=tmp_path))


def test_a_folder_without_a_manifest_is_no_scene(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text("<mujoco/>")
    with pytest.raises(FidelityError, match=r"bore\.npz is missing"):
        load_candidate(tmp_path)


def test_the_noise_of_a_sensor_comes_from_its_data_sheet() -> None:
    assert with_sigma(HoldConfig(), Path("survey_os1.bag")).sigma == 0.03
    assert with_sigma(HoldConfig(), Path("unknown.bag")).sigma == HoldConfig().sigma
    assert with_sigma(HoldConfig(sigma=0.011), Path("survey_os1.bag")).sigma == 0.011


def test_a_mistake_at_the_command_line_ends_in_one_sentence_and_status_2(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["fidelity", "run", "--scene", str(tmp_path), "--out", str(tmp_path / "o")])
    assert main() == 2
    assert capsys.readouterr().err.strip() == f"error: {tmp_path}: is no scene folder, scene.xml is missing"
    assert not (tmp_path / "o").exists()
