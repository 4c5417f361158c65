"""Builds that are killed: what is kept, what it counts for, and that nothing of it shows in the result."""

import os
import re
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh

from scene.cloud import VoxelMean
from scene.poses.odometry import OdometryLog, estimate_odometry
from scene.poses.registration import register_scans
from scene.poses.trajectory import Trajectory
from scene.progress import Stages
from scene.reading.cloudfile import read_cloud
from scene.reading.formats import ReadingConfig
from scene.reading.recording import Recording
from scene.resume import Partial, input_record, library_versions, partial_folder, resume_key
from subterra_jax.host import files
from subterra_jax.host.errors import OutputError
from subterra_jax.host.files import replace_folder
from tests.scene.bags import write_bag
from tests.scene.clouds import curved_d_bore

ROOT = Path(__file__).parents[2]


class Killed(KeyboardInterrupt):
    """Stands for a kill at this very place."""


def partial(folder: Path, key: str = "a", fresh: bool = False) -> Partial:
    kept = Partial(folder, fresh, every=0.0)
    kept.open(key)
    return kept


def stage(dies_after: int | None = None):
    counter = Stages().start("scans", 60)
    advance = counter.advance

    def counted(steps: int = 1) -> None:
        advance(steps)
        if dies_after is not None and counter.done - began > dies_after:
            raise Killed

    began, counter.advance = 0, counted
    resume = counter.resume

    def resumed(done: int) -> None:
        nonlocal began
        began = done
        resume(done)

    counter.resume = resumed
    return counter


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """A walk of 6 m through a bore, seen 12 m around."""
    rng = np.random.default_rng(0)
    bore = curved_d_bore(length=40, per_metre=300, yaw=0.0, radius=1e4, grade=0.0, offset=(-20.0, 0.0, 0.0)).points
    scans = []
    for k in range(60):
        here = bore[np.abs(bore[:, 0] - 0.1 * k) < 12] - (0.1 * k, 0, 0)
        scans.append((100.0 + 0.1 * k, here[rng.permutation(len(here))[:1200]]))
    return write_bag(tmp_path_factory.mktemp("walk") / "walk.bag", scans)


@pytest.mark.parametrize("dies_after", [3, 25])
def test_an_odometry_that_is_killed_again_and_again_ends_on_the_same_bits(bag, tmp_path, dies_after):
    with Recording(bag) as recording:
        whole = estimate_odometry(recording, None, stage(), OdometryLog(Partial(None), "o"))
        for _ in range(60 // dies_after + 1):
            kept = partial(tmp_path / "kept")
            try:
                again = estimate_odometry(recording, None, stage(dies_after), OdometryLog(kept, "o"))
                break
            except Killed:
                kept.close()
    np.testing.assert_array_equal(again.trajectory.positions, whole.trajectory.positions)
    np.testing.assert_array_equal(again.trajectory.rotations.as_quat(), whole.trajectory.rotations.as_quat())
    np.testing.assert_array_equal(again.weakest, whole.weakest)


def test_a_registration_that_is_killed_ends_on_the_same_bits(bag, tmp_path, capsys):
    times = np.linspace(100.3, 107.0, 30)  # the first scans have no pose
    with Recording(bag) as recording:
        poses = estimate_odometry(recording, None, stage(), OdometryLog(Partial(None), "o")).trajectory
        poses = Trajectory(times, *poses.at(times), "poses")
        whole = register_scans(recording, poses, 0.02, stage())
        kept = partial(tmp_path / "kept")
        with pytest.raises(Killed):
            register_scans(recording, poses, 0.02, stage(45), partial=kept)
        kept.close()
        again = register_scans(recording, poses, 0.02, stage(), partial=partial(tmp_path / "kept"))
    assert "Resumed at 72 % of scans" in capsys.readouterr().out
    assert (again.cloud.returns, again.uncovered) == (whole.cloud.returns, whole.uncovered)
    assert whole.uncovered == 3
    np.testing.assert_array_equal(again.low, whole.low)
    for name in ("points", "weights", "origin"):
        np.testing.assert_array_equal(getattr(again.cloud, name), getattr(whole.cloud, name))


def test_a_bore_file_goes_on_behind_the_chunks_that_were_thinned(tmp_path, capsys):
    points = np.random.default_rng(0).uniform(-9, 9, (1_200_000, 3)).astype(np.float32)
    trimesh.PointCloud(points).export(tmp_path / "c.ply")
    whole, facts = read_cloud(tmp_path / "c.ply", 0.5)
    kept = partial(tmp_path / "kept")
    with pytest.raises(Killed):
        read_cloud(tmp_path / "c.ply", 0.5, ReadingConfig(), stage(600_000), kept)
    kept.close()
    kept = partial(tmp_path / "kept")
    again, facts_again = read_cloud(tmp_path / "c.ply", 0.5, ReadingConfig(), stage(), kept)
    assert "Resumed at 42 % of scans" in capsys.readouterr().out
    np.testing.assert_array_equal(again.points, whole.points)
    assert facts_again == facts


def test_thinning_goes_on_from_its_arrays_on_the_same_bits():
    batches = np.random.default_rng(0).uniform(-2, 2, (9, 4000, 3))
    whole, half = VoxelMean(0.1), VoxelMean(0.1)
    for index, batch in enumerate(batches):
        whole.add(batch)
        half.add(batch)
        if index == 4:
            half = VoxelMean.restored(0.1, half.arrays())
    np.testing.assert_array_equal(half.cloud().points, whole.cloud().points)
    assert half.returns == whole.returns == 36000


def test_results_of_another_key_are_discarded_with_a_sentence_and_fresh_ones_without(tmp_path, capsys):
    folder = tmp_path / "kept"
    kept = partial(folder, "a")
    kept.save("cloud", x=np.arange(3))
    kept.close()
    again = partial(folder, "a")
    np.testing.assert_array_equal(again.load("cloud")["x"], np.arange(3))
    again.close()
    other = partial(folder, "b")
    assert other.load("cloud") is None
    assert "another input, configuration or version was discarded" in capsys.readouterr().out
    other.save("cloud", x=np.arange(3))
    other.close()
    assert partial(folder, "b", fresh=True).load("cloud") is None
    assert not capsys.readouterr().out


def test_the_key_follows_inputs_and_settings(tmp_path):
    (tmp_path / "a").write_bytes(b"1")
    (tmp_path / "b").write_bytes(b"1")
    one = input_record([tmp_path / "a"])
    keys = {resume_key(record, value) for record in (one, input_record([tmp_path / "b"])) for value in (0.04, 0.05)}
    assert len(keys) == 4
    assert resume_key(one, 0.04) in keys


def test_libraries_that_are_not_installed_have_no_version():
    assert list(library_versions(("numpy", "no-such-library"))) == ["numpy"]


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.99])
def test_a_damaged_partial_result_is_computed_again(tmp_path, keep):
    kept = partial(tmp_path / "kept")
    kept.save("cloud", x=np.arange(300))
    file = tmp_path / "kept" / "cloud.npz"
    raw = file.read_bytes()
    file.write_bytes(raw[: int(keep * len(raw))])
    assert kept.load("cloud") is None
    flipped = bytearray(raw)
    flipped[len(raw) // 2] ^= 1
    file.write_bytes(flipped)
    assert kept.load("cloud") is None


def test_two_builds_of_one_output_are_refused(tmp_path):
    first = partial(tmp_path / "kept")
    with pytest.raises(OutputError, match="another build is at work"):
        partial(tmp_path / "kept")
    first.close()
    partial(tmp_path / "kept").discard()
    assert not (tmp_path / "kept").exists()


def test_a_disk_that_takes_no_partial_results_stops_them_and_not_the_build(tmp_path, capsys):
    kept = partial(tmp_path / "kept")
    (tmp_path / "kept" / "cloud.tmp").mkdir()  # in the way of the file
    kept.save("cloud", x=np.arange(3))
    assert "no partial results are kept (Is a directory)" in capsys.readouterr().out
    assert not kept.due()
    assert not (tmp_path / "kept").exists()


@pytest.mark.parametrize("exchange", [True, False])
def test_a_folder_is_replaced_and_a_half_done_replacement_is_put_right(tmp_path, exchange, monkeypatch):
    if not exchange:
        monkeypatch.setattr(files, "_exchange", lambda one, other: False)
    out = tmp_path / "out"
    for text in ("old", "new"):
        with replace_folder(out) as folder:
            (folder / "a").write_text(text)
    assert (out / "a").read_text() == "new"
    out.rename(tmp_path / ".out.stale")  # as a kill between two renames leaves it
    (tmp_path / ".out.partial").mkdir()

    def fill_the_disk() -> None:
        with replace_folder(out) as folder:
            assert not list(folder.iterdir())
            raise OSError(28, "No space left on device")

    with pytest.raises(OutputError, match="No space left"):
        fill_the_disk()
    assert (out / "a").read_text() == "new"
    assert [entry.name for entry in tmp_path.iterdir()] == ["out"]


def start(*arguments: object, limit: int | None = None) -> subprocess.Popen:
    def limited() -> None:
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    return subprocess.Popen(
        [sys.executable, "-m", "scene.build", *map(str, arguments)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=limited,
    )


@pytest.mark.slow
def test_a_kill_while_writing_and_a_full_disk_leave_the_previous_output_whole(bore_file, tmp_path):
    out = tmp_path / "scene"
    out.mkdir()
    (out / "scene.xml").write_text("mine")
    build = start(bore_file, "--out", out, "--keep-every", "0")
    while build.poll() is None and not (tmp_path / ".scene.partial" / "scene.xml").exists():
        time.sleep(0.005)
    build.send_signal(signal.SIGKILL)
    assert build.wait() == -signal.SIGKILL
    assert (out / "scene.xml").read_text() == "mine"
    assert partial_folder(out).exists()

    full = start(bore_file, "--out", out, limit=100_000)  # bytes a file
    said, error = full.communicate(timeout=120)
    assert full.returncode == 2, error
    assert re.fullmatch(rf"error: {re.escape(str(out))}: cannot be written \(.*\)\n", error), error
    assert (out / "scene.xml").read_text() == "mine"

    done = start(bore_file, "--out", out)
    said, error = done.communicate(timeout=120)
    assert done.returncode == 0, error
    assert (out / "scene.xml").read_text() != "mine"
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene"], said


@pytest.mark.slow
def test_a_build_that_is_killed_in_its_odometry_goes_on_and_leaves_nothing_behind(bag, tmp_path):
    out = tmp_path / "scene"
    build = start(bag, "--out", out, "--keep-every", "0")
    while build.poll() is None and not list(partial_folder(out).glob("odometry-first-*.npz")):
        time.sleep(0.005)
    os.kill(build.pid, signal.SIGKILL)
    build.communicate()
    again = start(bag, "--out", out)
    said, _ = again.communicate(timeout=120)
    assert "of LiDAR odometry, first pass" in said
    assert again.returncode in (0, 2)  # a walk of 6 m may or may not pass for a tunnel
    assert not partial_folder(out).exists()
