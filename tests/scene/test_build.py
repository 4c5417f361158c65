"""The builder's command from input to scene folder; what is killed or has no room leaves the previous output."""

import hashlib
import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

from scene.build import build, main
from subterra_jax.host.errors import OutputError
from subterra_jax.host.files import replace_folder
from tests.scene.bags import write_bag, write_bag_without_lidar, write_tum
from tests.scene.clouds import curved_d_bore


@pytest.fixture
def command(monkeypatch, capsys):
    """`python -m scene.build ARGUMENTS` in this process: exit status and standard error."""

    def run(*arguments: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["scene.build", *map(str, arguments)])
        with np.errstate():
            status = main()
        return status, capsys.readouterr().err

    return run


@pytest.fixture(scope="module")
def scene(bore_file, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "bore"
    build(bore_file, out)
    return out


def test_the_scene_folder_holds_everything_the_format_asks_for(scene):
    for name in ("scene.xml", "bore.npz", "tunnel.npz", "manifest.json", "meshes/lining.ply", "meshes/solid.ply"):
        assert (scene / name).stat().st_size > 0
    manifest = json.loads((scene / "manifest.json").read_text())
    assert manifest["schema"] == "subterra.manifest/1"
    assert manifest["provenance"]["track"] == "none: the survey shows no rails"
    assert manifest["count"]["sleepers"] == 0
    assert len(manifest["inputs"][0]["sha256"]) == 64
    lining = (scene / "meshes" / "lining.ply").read_bytes()
    assert manifest["files"]["meshes/lining.ply"] == hashlib.sha256(lining).hexdigest()
    assert {"scene.xml", "bore.npz", "tunnel.npz"} < set(manifest["files"])


def test_whole_meshes_are_in_the_tunnel_frame(scene):
    with np.load(scene / "bore.npz") as bore:
        position = bore["position"]
    for name in ("lining", "solid"):
        mesh = trimesh.load(scene / "meshes" / f"{name}.ply")
        assert (mesh.bounds[0] < position.min(axis=0) + 0.1).all()
        assert (mesh.bounds[1] > position.max(axis=0) - 0.1).all()
    assert trimesh.load(scene / "meshes" / "solid.ply").is_volume


def test_the_rover_stands_then_drives_two_metres_and_turns(scene):
    model = mujoco.MjModel.from_xml_path(str(scene / "scene.xml"))
    data = mujoco.MjData(model)
    assert (model.nu, model.actuator(0).name, model.actuator(1).name) == (2, "speed", "yaw_rate")
    mujoco.mj_step(model, data, 250)
    assert np.abs(data.qvel).max() < 0.05
    start, ahead = data.qpos[:3].copy(), data.body("scout").xmat.reshape(3, 3)[:, 0].copy()
    assert np.linalg.norm(model.stat.center[:2] - start[:2]) < 0.05, "a viewer looks at it, from behind"
    assert np.cos(np.radians(model.vis.global_.azimuth) - np.arctan2(ahead[1], ahead[0])) > 0.999
    data.ctrl[:] = (1.0, 0.0)
    mujoco.mj_step(model, data, 560)
    driven = data.qpos[:3] - start
    assert driven @ ahead == pytest.approx(2.0, abs=0.15)
    assert np.linalg.norm(driven - (driven @ ahead) * ahead) < 0.1
    data.ctrl[:] = (0.0, 0.0)
    mujoco.mj_step(model, data, 250)
    driven = data.qpos[:3] - start
    data.ctrl[:] = (0.0, 0.6)
    mujoco.mj_step(model, data, 500)
    now = data.body("scout").xmat.reshape(3, 3)[:, 0]
    assert np.arctan2(np.cross(ahead, now)[2], ahead @ now) == pytest.approx(0.9, abs=0.15)  # it lags, and scrubs
    assert np.linalg.norm(data.qpos[:3] - start - driven) < 0.1


def test_the_middle_of_the_bore_is_free_and_its_walls_stop_a_body(scene):
    model = mujoco.MjModel.from_xml_path(str(scene / "scene.xml"))
    data = mujoco.MjData(model)
    data.qvel[:2] = 3 * np.array([-np.sin(0.7), np.cos(0.7)])
    for _ in range(1000):
        mujoco.mj_step(model, data)
    names = {
        mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom)
        for contact in data.contact
        for geom in (contact.geom1, contact.geom2)
    }
    with np.load(scene / "bore.npz") as bore:
        distance = np.linalg.norm(bore["position"][:, :2] - data.qpos[:2], axis=1).min()
    assert distance < 2.83, f"the scout went through the wall; it touches {names}"


def test_a_failed_build_leaves_the_previous_scene_whole(scene, tmp_path, command):
    before = {path: path.stat().st_mtime_ns for path in scene.rglob("*")}
    bad = tmp_path / "bad.ply"
    bad.write_bytes(b"ply\n")
    own = scene / "meshes" / "lining.ply"
    for source, out, why in ((bad, scene, "bad.ply: "), (own, scene, "would replace"), (bad, tmp_path, "not replaced")):
        status, said = command(source, "--out", out)
        assert (status, why in said) == (2, True), said
    assert before == {path: path.stat().st_mtime_ns for path in scene.rglob("*")}


BAD = {  # words of a command, @ before files of the folder below, and the sentence
    "@none.bag": r"none\.bag: no such file",
    "@x.docx": r"x\.docx: of no known kind",
    "@cut.bag": r"cut\.bag: not a whole ROS1 bag",
    "@note.bag": r"note\.bag: has no LiDAR topic",
    "@a.bag --trajectory @early.tum": r"early\.tum runs from 0\.00 to 8\.00 s, but the LiDAR",
    "@a.bag --trajectory @no.tum": r"no\.tum: no such file",
    "@short.ply --trajectory @early.tum": r"early\.tum: a trajectory goes with a bag",
    "@nan.ply": r"nan\.ply: none of its 99 points is finite",
    "@short.ply": r"short\.ply: the tunnel is .* m long; at least 10 m",
    "@plane.ply": r"plane\.ply: ",
    "@empty": r"empty: of no known kind",
    "@pipe": "pipe: neither a file nor a folder",
    "@short.ply --name a/b": "--name must be at most 100 characters",
    "@short.ply --date yesterday": "--date must be a day such as",
    "@short.ply --reconstruct.voxel 9": r"--reconstruct\.voxel must lie between 0\.001 and 1 m, got 9",
    "@short.ply --reader @exits.py": r"exits\.py: SystemExit",
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> Path:
    folder, rng = tmp_path_factory.mktemp("bad"), np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(0, 60, 9999), rng.uniform(0, 8, 9999), np.zeros(9999)])
    for name, points in (("short", curved_d_bore(length=5).points), ("plane", flat), ("nan", np.full((99, 3), np.nan))):
        trimesh.PointCloud(points).export(folder / f"{name}.ply")
    bag = write_bag(folder / "a.bag", [(100.0 + 0.1 * k, rng.uniform(-3, 3, (200, 3))) for k in range(5)])
    (folder / "cut.bag").write_bytes(bag.read_bytes()[:500])
    write_bag_without_lidar(folder / "note.bag")
    write_tum(folder / "early.tum", np.column_stack([np.arange(9.0), np.zeros((9, 6)), np.ones(9)]))
    (folder / "x.docx").write_text("x")
    (folder / "exits.py").write_text("raise SystemExit(0)")
    (folder / "empty").mkdir()
    os.mkfifo(folder / "pipe")
    return folder


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_sentence_status_2_and_no_output(case, inputs, tmp_path, command):
    out = tmp_path / "scene"
    status, outcome = command(*(inputs / word[1:] if word[0] == "@" else word for word in case.split()), "--out", out)
    assert status == 2, outcome
    lines = [line for line in outcome.splitlines() if line.strip()]
    assert len(lines) == 1, outcome
    assert re.search(rf"^error: .*{BAD[case]}", lines[0]), lines[0]
    assert not list(tmp_path.iterdir())


ROOT = Path(__file__).parents[2]


def test_a_folder_is_replaced_and_a_half_done_replacement_is_put_right(tmp_path):
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
    build = start(bore_file, "--out", out)
    while build.poll() is None and not (tmp_path / ".scene.partial" / "scene.xml").exists():
        time.sleep(0.005)
    build.send_signal(signal.SIGKILL)
    assert build.wait() == -signal.SIGKILL
    assert (out / "scene.xml").read_text() == "mine"

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
