"""From recordings to scores: the set, the libraries, the folders; and what a tube does to an odometry."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

from benchmarks.command import BenchmarkError
from benchmarks.fidelity.derive.surface import Caster
from benchmarks.slam import programs, reading
from benchmarks.slam.__main__ import command
from benchmarks.slam.recordings import SetConfig, plan_set
from scene.poses.trajectory import load_tum
from scene.writing.folder import write_geometry
from scene.writing.mjcf import SceneConfig
from scene.writing.track import TrackConfig, lay_track
from subterra_jax.lidar3d.surface import read_scene
from subterra_jax.recorder.sensors import CLOUD_SIGMA
from tests.benchmarks.slam.tracks import EPOCH, line, write_axis, write_tum
from tests.scene.conftest import arc_bore

STEP = 0.2


def bare(ways: np.ndarray, k: int) -> np.ndarray:
    """A sweep in a square bore without ends: the same wherever along it one stands."""
    del k
    reach = 2.5 / np.maximum(np.abs(ways[:, 1:]).max(axis=1), 1e-9)
    return ways[reach < 25.0] * reach[reach < 25.0, None]


def landmarks(ways: np.ndarray, k: int) -> np.ndarray:
    """A sweep among things that stand still, 0.2 m further each time."""
    return 12.0 * ways * np.linspace(0.2, 1.0, len(ways))[:, None] - [STEP * k, 0.0, 0.0]


@pytest.mark.parametrize("make", [lambda: programs.make_kiss(None, 100.0), programs.make_genz])
def test_an_odometry_that_is_right_among_landmarks_does_not_move_along_a_bare_bore(make):
    ways = np.random.default_rng(0).normal(size=(6000, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    ends = [
        programs.estimate_poses(make(), [(EPOCH + 0.1 * k, world(ways, k)) for k in range(16)])[1][-1, :3, 3]
        for world in (landmarks, bare)
    ]
    np.testing.assert_allclose(ends[0], [15 * STEP, 0.0, 0.0], atol=0.05)
    np.testing.assert_allclose(ends[1], 0.0, atol=0.05)


def test_unknown_and_missing_programs_are_named(monkeypatch):
    with pytest.raises(BenchmarkError, match="no program 'fast'; there are wheel-odometry, evalio-kiss"):
        programs.find_program("fast")
    monkeypatch.setitem(programs.PROGRAMS, "absent", programs.Program("no-such-package", lambda at: None))
    with pytest.raises(BenchmarkError, match="absent needs no-such-package, which is not installed"):
        programs.find_program("absent")


@pytest.mark.parametrize(("poses", "reason"), [
    ((np.zeros(1), np.zeros((1, 4, 4)), 0.0), "gives 1 poses"),
    ((np.arange(3.0), np.full((3, 4, 4), np.nan), 0.0), "gives poses that are not finite"),
    ([(EPOCH, np.zeros((0, 3)))], "sweep 0 holds no point"),
])  # fmt: skip
def test_a_program_that_gives_no_track_says_why(poses, reason, tmp_path, monkeypatch, capsys):
    run = (lambda at: poses) if isinstance(poses, tuple) else (lambda at: programs.estimate_poses(np.eye, poses))
    monkeypatch.setitem(programs.PROGRAMS, "mine", programs.Program("jax", run))
    assert programs.main(["mine", str(tmp_path), str(tmp_path / "poses.tum")]) == 1
    assert capsys.readouterr().err == f"{reason}\n"
    assert not (tmp_path / "poses.tum").exists()


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A set of one recording with clouds of a bend of 24 m, what two programs make of it, and their scores."""
    folder = tmp_path_factory.mktemp("slam")
    scene = folder / "scene"
    scene.mkdir()
    bore = arc_bore()
    write_geometry(scene, "arc", "simulated", bore, lay_track(bore, TrackConfig()), SceneConfig())
    wanted = ("--tasks", "TraverseShort", "--episodes", "1", "--steps", "30", "--columns", "120", "--beams", "180")
    assert command(["record", "--scene", str(scene), "--out", str(folder / "set"), *wanted]) == 0
    for name in ("wheel-odometry", "kiss-icp", "kiss-icp-planar"):
        asked = ("--library", name, "--recordings", str(folder / "set"), "--out", str(folder / name))
        assert command(["run", *asked]) == 0
    programs = [str(folder / name) for name in ("wheel-odometry", "kiss-icp", "kiss-icp-planar")]
    told = ("--truth", str(folder / "set" / "truth"), "--piece", "2", "--out", str(folder / "scores"))
    assert command(["score", "--estimate", *programs, *told]) == 0
    return folder


def test_a_set_keeps_truth_apart_and_its_clouds_lie_on_the_walls(made):
    recording = made / "set" / "recordings" / "TraverseShort-pockets-000"
    assert not list((made / "set" / "recordings").rglob("*truth*"))
    assert "secret" not in (made / "set" / "set.json").read_text()
    assert (made / "set" / "truth" / "TraverseShort-pockets-000" / "lidar.tum").is_file()
    clouds, flat = list(reading.read_clouds(recording)), list(reading.read_planar(recording))
    assert len(clouds) == len(flat) == 31
    surface = read_scene(made / "scene", "pockets")
    caster = Caster(trimesh.Trimesh(surface.vertices, surface.faces, process=False))
    truth = load_tum(made / "set" / "truth" / "TraverseShort-pockets-000" / "lidar.tum")
    for (time, points), sigma in ((clouds[20], CLOUD_SIGMA), (flat[20], 0.05)):
        (place,), turn = truth.at(np.array([time]))
        distance = np.linalg.norm(points, axis=1)
        reach = caster.first(np.broadcast_to(place, points.shape), turn.apply(points / distance[:, None]))[0]
        error = distance - reach
        assert np.median(np.abs(error)) == pytest.approx(0.674 * sigma, rel=0.25)
        assert abs(np.median(error)) < 0.3 * sigma


def test_programs_are_scored_side_by_side(made):
    content = json.loads((made / "scores" / "scores.json").read_text())
    scores = {row["program"]: row for row in content["scores"]}
    assert set(scores) == {"wheel-odometry", "kiss-icp", "kiss-icp-planar"}
    for row in scores.values():
        assert row["covered"] == pytest.approx(1.0)
        assert row["distance"] == pytest.approx(6.0, rel=0.1)
        assert row["across_rms"] < 0.5
    assert scores["wheel-odometry"]["drift"] < 8.0
    text = (made / "scores" / "scores.md").read_text()
    assert text.count("TraverseShort-pockets-000") == 3
    assert (made / "scores" / "scores.png").read_bytes().startswith(b"\x89PNG")


def test_what_is_there_is_not_done_again(made, capsys):
    pose = made / "kiss-icp" / "TraverseShort-pockets-000.tum"
    before = pose.stat().st_mtime_ns
    asked = ("--library", "kiss-icp", "--recordings", str(made / "set"), "--out", str(made / "kiss-icp"))
    assert command(["run", *asked]) == 0
    assert "there already" in capsys.readouterr().err
    assert pose.stat().st_mtime_ns == before
    assert command(["record", "--out", str(made / "set"), "--tasks", "TraverseShort", "--secret", "1"]) == 2
    assert "was recorded with other settings" in capsys.readouterr().err


def test_a_truncated_or_foreign_recording_is_one_sentence(made, tmp_path, capsys):
    bag = tmp_path / "recordings" / "one" / "recording"
    shutil.copytree(made / "set" / "recordings" / "TraverseShort-pockets-000" / "recording", bag)
    with pytest.raises(BenchmarkError, match=r"has no topic /other; it has /cmd_vel, /imu"):
        next(reading.read_clouds(bag.parent, "/other"))
    data = (bag / "recording.mcap").read_bytes()
    (bag / "recording.mcap").write_bytes(data[: len(data) // 2])
    out = ("--out", str(tmp_path / "out"))
    assert command(["run", "--library", "kiss-icp", "--recordings", str(tmp_path), *out]) == 2
    told = capsys.readouterr().err
    assert "not a whole recording" in told
    assert told.count("\n") == 1
    assert command(["run", "--library", "kiss-icp", "--recordings", str(tmp_path / "none"), *out]) == 2
    assert "holds no recordings" in capsys.readouterr().err
    blocked = ("--recordings", str(made / "set"), "--out", str(bag / "recording.json"))
    assert command(["run", "--library", "wheel-odometry", *blocked]) == 2
    assert "recording.json: is a file" in capsys.readouterr().err


def test_a_recording_of_the_arena_must_be_whole_before_a_program_runs_on_it(made, tmp_path, capsys):
    one = tmp_path / "recordings" / "one"
    shutil.copytree(made / "set" / "recordings" / "TraverseShort-pockets-000" / "recording", one / "recording")
    (one.parent / "two").mkdir()
    shutil.copytree(one / "recording", one.parent / "two" / "recording")
    (one.parent / "two" / "calibration.yaml").write_text("lidar: {topic: /points}\nimu: {topic: /imu}\n")
    asked = ("run", "--library", "rko-lio", "--recordings", str(tmp_path), "--out", str(tmp_path / "out"))
    for text, sentence in (
        (None, "one/calibration.yaml: is missing"), ("{", "is no calibration"), ("lidar: 3", "is no calibration"),
        ("lidar: {topic: /moon}\nimu: {topic: /imu}\n", "has no topic /moon; it has /cmd_vel"),
    ):  # fmt: skip
        if text is not None:
            (one / "calibration.yaml").write_text(text)
        assert command([*asked]) == 2
        told = capsys.readouterr().err
        assert sentence in told
        assert told.count("\n") == 1
    (one / "calibration.yaml").write_text("lidar: {topic: /points}\nimu: {topic: /imu}\n")
    data = (one / "recording" / "recording.mcap").read_bytes()
    (one / "recording" / "recording.mcap").write_bytes(data[: len(data) // 2])
    assert command([*asked]) == 2
    assert "one/recording: not a whole recording" in capsys.readouterr().err
    (one / "recording" / "metadata.yaml").unlink()
    assert command([*asked]) == 2
    assert "one/recording: is no recording: metadata.yaml is missing" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_boxes_and_faults_are_recorded_without_clouds_and_a_driver_knows_the_way(tmp_path):
    config = SetConfig(tmp_path, tasks=("StopAt", "Obstructed", "Relocalise"), episodes=2, scene=tmp_path)
    found = dict(plan_set(config))
    assert list(found)[:2] == ["StopAt-pockets-000", "StopAt-pockets-001"]
    assert found["StopAt-pockets-000"].cloud == "vlp16"
    assert found["Obstructed-pockets-001"].cloud == "none"
    assert found["Relocalise-pockets-000"].agent == "particle-filter"
    with pytest.raises(BenchmarkError, match="no task 'Fly'"):
        plan_set(SetConfig(tmp_path, tasks=("Fly",)))


def test_a_secret_gives_episodes_that_are_in_no_list(tmp_path):
    def seeds(secret: int) -> list[int]:
        plan = plan_set(SetConfig(tmp_path, tasks=("StopAt", "Return"), secret=secret))
        assert all(one.episode is None for _, one in plan)
        return [one.seed for _, one in plan]

    assert len(set(seeds(1) + seeds(2))) == 12
    assert seeds(1) == seeds(1)


def test_a_folder_without_anything_to_score_is_refused(tmp_path, capsys):
    truth = write_tum(tmp_path / "truth" / "one" / "lidar.tum", *line())
    write_axis(truth.parent / "axis.csv", line()[1])
    mine = write_tum(tmp_path / "mine" / "one.tum", *line()).parent
    asked = ("--truth", str(tmp_path / "truth"))
    assert command(["score", "--estimate", str(mine), *asked]) == 0
    assert command(["score", "--estimate", str(mine / "one.tum"), *asked]) == 0
    capsys.readouterr()
    write_tum(tmp_path / "others" / "two.tum", *line())
    for given, sentence in ((tmp_path / "others", "holds no NAME.tum"), (tmp_path / "nobody", "no such file")):
        assert command(["score", "--estimate", str(given), *asked]) == 2
        assert sentence in capsys.readouterr().err
