"""Two surveys of one tunnel: what moved is found with its place and size, and nothing where nothing moved."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from scene.bore import Bore
from scene.compare import CompareConfig, _inside, _patches, compare_clouds, main, name_clock

CONFIG = CompareConfig(Path("a"), Path("b"), Path("c"))


def survey(bore: Bore, seed: int, bulge: float = 0.0, spacing: float = 0.06, noise: float = 0.002) -> np.ndarray:
    """Points of the wall with noise; from 10 to 12 m a metre of the left wall is moved inwards."""
    rng = np.random.default_rng(seed)
    station = rng.uniform(0.0, bore.length, round(bore.length * 18.0 / spacing**2))
    angle = rng.uniform(-np.pi, np.pi, len(station))
    frame = bore.axis.at(station)
    order = np.argsort(bore.angle)
    radius = np.interp(angle, bore.angle[order], bore.radius[0][order], period=2.0 * np.pi)
    radius += rng.normal(0.0, noise, len(station))
    moved = (station > 10.0) & (station < 12.0) & (np.abs(angle) < 0.5 / 2.8)
    radius -= bulge * moved
    outwards = np.cos(angle)[:, None] * frame.lateral + np.sin(angle)[:, None] * frame.up
    return frame.position + radius[:, None] * outwards


def test_a_bulge_of_3_cm_is_found_with_its_place_and_nothing_else(bore: Bore):
    result = compare_clouds(bore, survey(bore, 1), survey(bore, 2, bulge=0.03), CONFIG)
    assert len(result.changes) == 1
    (change,) = result.changes
    assert change.start == pytest.approx(10.0, abs=0.3)
    assert change.end == pytest.approx(12.0, abs=0.3)
    assert change.angle == pytest.approx(0.0, abs=0.05)
    assert name_clock(change.angle) in ("9:00", "8:45", "9:15")
    assert change.most == pytest.approx(-0.03, abs=0.002)
    assert change.median == pytest.approx(-0.03, abs=0.002)  # places at the rim would make it 26 mm
    assert 1.5 < change.area < 3.5
    assert change.detection < 0.01


def test_the_movement_of_a_patch_is_of_what_lies_inside_its_rim():
    mask = np.zeros((6, 8), bool)
    mask[1:5, [6, 7, 0, 1]] = True  # across the seam
    assert np.argwhere(_inside(mask, 1)).tolist() == [[2, 0], [2, 7], [3, 0], [3, 7]]
    assert not _inside(mask, 2).any()


def test_nothing_is_found_where_nothing_moved(bore: Bore):
    result = compare_clouds(bore, survey(bore, 3), survey(bore, 4), CONFIG)
    assert result.changes == ()
    assert np.isfinite(result.moved).mean() > 0.95
    # The level of detection holds what its name says: 5 % of the places lie beyond it where nothing moved, fewer with
    # a registration error that is not there.
    assert np.mean(np.abs(result.moved) > result.detection) < 0.05


def test_the_level_of_detection_holds_where_few_points_are(bore: Bore):
    """Some six points a place, 10 cm apart in depth as among cables: with 1.96 for Student's t 7 % lie beyond it."""
    one, other = (survey(bore, seed, spacing=0.17, noise=0.1) for seed in (11, 12))
    result = compare_clouds(bore, one, other, CONFIG)
    assert result.changes == ()
    compared = np.isfinite(result.moved)
    assert 0.4 < compared.mean() < 0.6
    assert np.mean(np.abs(result.moved[compared]) > result.detection[compared]) < 0.05


@pytest.mark.parametrize(("across", "ratio", "found"), [(2, 1.3, 0), (2, 4.0, 1), (8, 1.3, 1)])
def test_a_patch_counts_by_its_size_and_by_how_far_it_moved(across: int, ratio: float, found: int):
    station, angle = np.arange(40) * 0.25, np.linspace(-np.pi, np.pi, 90, endpoint=False)
    moved, detection, cell = np.zeros((40, 90)), np.full((40, 90), 0.01), np.full((40, 90), 0.06)
    moved[10 : 10 + across, 20:25] = ratio * 0.01  # 0.6 m², about three places apart, or 2.4 m² and twelve
    patches = _patches(np.abs(moved) > detection, station, angle, moved, detection, cell, CONFIG)
    assert len(patches) == found


def test_a_bulge_across_the_seam_of_the_angle_is_one_change(bore: Bore):
    points = survey(bore, 6)
    station, left, up = bore.axis.local(points)
    right = (np.abs(station - 15.0) < 1.0) & (left < -2.5) & (np.abs(up) < 0.5)  # about the angle pi
    moved = points + right[:, None] * 0.03 * bore.axis.at(station).lateral
    result = compare_clouds(bore, survey(bore, 7), moved, CONFIG)
    assert len(result.changes) == 1
    assert abs(result.changes[0].angle) == pytest.approx(np.pi, abs=0.1)


@pytest.mark.parametrize(
    ("angle", "clock"), [(np.pi / 2, "12:00"), (0.0, "9:00"), (np.pi, "3:00"), (-np.pi / 2, "6:00")]
)
def test_the_clock_has_12_at_the_crown_and_9_on_the_left(angle, clock):
    assert name_clock(angle) == clock


def write_scene(folder: Path, bore: Bore, points: np.ndarray, origin: tuple[float, float, float]) -> Path:
    folder.mkdir(parents=True)
    bore.save(folder / "bore.npz")
    trimesh.PointCloud(points).export(folder / "cloud.ply")
    (folder / "manifest.json").write_text(json.dumps({"name": "t", "frame": {"origin": list(origin)}}))
    return folder


def test_folders_with_other_origins_are_compared_and_written(bore: Bore, tmp_path, capsys):
    one = write_scene(tmp_path / "one", bore, survey(bore, 1, spacing=0.08), (100.0, 200.0, 0.0))
    shift = np.array([3.0, -2.0, 0.0])
    moved = dataclasses.replace(bore, position=bore.position - shift)
    other = write_scene(tmp_path / "other", moved, survey(bore, 2, 0.03, 0.08) - shift, (103.0, 198.0, 0.0))
    out = tmp_path / "out"
    assert main([str(one), str(other), "--out", str(out)]) == 0
    assert " at 9:00: -" in capsys.readouterr().out
    assert len((out / "changes.csv").read_text().splitlines()) == 2
    assert sorted(path.name for path in out.iterdir()) == ["change.npz", "change.png", "changes.csv"]
    far = write_scene(tmp_path / "far", bore, survey(bore, 3, spacing=0.2), (900.0, 200.0, 0.0))
    assert main([str(one), str(far), "--out", str(tmp_path / "no")]) == 2
    assert "of one tunnel, and in one frame?" in capsys.readouterr().err
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize(
    ("command", "module"),
    [("scene.compare a b --out o", "py4dgeo"), ("scene.report a", "ezdxf")],
)
def test_a_missing_extra_is_named_in_one_sentence(tmp_path, command, module):
    """With `python -m`, since what a command lacks is looked for while its package is imported."""
    (tmp_path / "sitecustomize.py").write_text(
        "import importlib.machinery as m, sys\n"
        "class Without(m.PathFinder):\n"
        "    @classmethod\n"
        "    def find_spec(cls, name, path=None, target=None):\n"
        f"        return None if name == {module!r} else super().find_spec(name, path, target)\n"
        "sys.meta_path[:] = [Without if one is m.PathFinder else one for one in sys.meta_path]\n"
    )
    paths = os.pathsep.join([str(tmp_path), str(Path(__file__).parents[2])])
    run = subprocess.run(
        [sys.executable, "-m", *command.split()], cwd=tmp_path, env={**os.environ, "PYTHONPATH": paths},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (run.returncode, len(run.stderr.splitlines())) == (2, 1), run.stderr
    assert f"{module} is not installed" in run.stderr
