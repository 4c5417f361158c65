"""Across the rooms: a scene built from a cloud, and the environment that runs in it."""

import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import trimesh

import subterra_jax as st
from benchmarks import reference
from scene.build import build
from scene.config import BuildConfig, ReconstructConfig
from scene.fitting.lining import LiningConfig
from scene.writing.track import TrackConfig
from tests.scene.clouds import curved_d_bore
from tests.shared import METRO, needs_metro


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pipeline")
    trimesh.PointCloud(curved_d_bore(length=24, radius=200, grade=0.0, per_metre=4000).points).export(folder / "c.ply")
    build(folder / "c.ply", folder / "scene")
    return folder / "scene"


def device_scans(plan: st.TunnelPlan, poses: reference.Poses, lining: str) -> np.ndarray:
    """Ranges of the environment's LiDAR, without noise, from each pose."""
    params = st.make("Subterra/Traverse-v1", tunnel=plan, lining=lining)[1]
    return reference.simulate(params.tunnel, poses, params.lidar)


@pytest.mark.parametrize(("lining", "file"), [("pockets", "scene.xml"), ("furnished", "scene_furnished.xml")])
def test_the_environments_lidar_sees_what_mujoco_sees_in_the_scene(scene, lining, file):
    """Sixteen beams from 300 random poses in the planar tunnel, and `mj_multiRay` against the scene's triangles."""
    plan = st.load_tunnel(scene / "tunnel.npz")
    poses = reference.random_poses(plan, 300, np.random.default_rng(0))
    ours = device_scans(plan, poses, lining)
    model = mujoco.MjModel.from_xml_path(str(scene / file))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    height = np.interp(poses.station, plan.station, plan.elevation) + plan.lidar_height
    visible = np.array([1, 1, 0, 0, 0, 0], np.uint8)
    theirs = np.empty_like(ours)
    for k, (position, heading) in enumerate(zip(poses.position, poses.heading, strict=True)):
        angle = heading + np.arange(16) * np.pi / 8
        beams = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(16)]).astype(np.float64)
        distance, hit = np.empty(16), np.empty(16, np.int32)
        origin = np.array([*position, height[k]], np.float64)
        mujoco.mj_multiRay(model, data, origin, beams.ravel(), visible, 1, -1, hit, distance, None, 16, 30.0)
        theirs[k] = np.where(hit < 0, 30.0, distance)
    error = np.abs(ours - np.minimum(theirs, 30.0))
    assert np.median(error) < 0.01
    assert np.mean(error < 0.05) > 0.97


@pytest.mark.parametrize("lining", ["pockets", "furnished"])
def test_an_episode_runs_on_a_scene_just_built(scene, lining):
    env, params = st.make("Subterra/Traverse-v1", tunnel=scene / "tunnel.npz", lining=lining)
    obs, state = env.reset(jax.random.key(0), params)
    step = jax.jit(env.step)
    for k in range(20):
        obs, state, _, terminated, truncated, info = step(jax.random.key(k), state, jnp.array([2.0, 0.0]), params)
        assert not terminated
        assert not truncated
    assert obs.shape == (18,)
    assert float(info["coverage"]) == pytest.approx(20 * 0.2 / 24, abs=0.04)
    assert (len(st.load_tunnel(scene / "tunnel.npz").lining(lining).furniture) > 0) == (lining == "furnished")


def metro_rings(folder: Path, first: int, last: int) -> Path:
    """A copy of the metro's survey with these rings alone."""
    shutil.copytree(METRO, folder, copy_function=shutil.copyfile)
    folder.chmod(0o755)
    (table,) = folder.glob("*import_WRS*.csv")
    header, *rows = table.read_text().splitlines()
    table.write_text("\n".join([header, *(row for row in rows if first <= float(row.split(",")[0]) < last + 1)]) + "\n")
    return folder


@needs_metro
def test_the_environment_runs_in_a_window_of_the_real_metro(tmp_path):
    # A third of its rings, and without what stands there by standard: that takes a while and changes no wall.
    bare = BuildConfig(
        reconstruct=ReconstructConfig(lining=LiningConfig(lay="none")), track=TrackConfig(lay="standard")
    )
    build(metro_rings(tmp_path / "survey", 400, 700), tmp_path / "metro", config=bare)
    window = st.load_tunnel(tmp_path / "metro" / "tunnel.npz").slice(30.0, 351.0)
    assert window.length == pytest.approx(351.0, abs=0.3)
    env, params = st.make("Subterra/Traverse-v1", tunnel=window, lining="smooth")
    keys = jax.random.split(jax.random.key(0), 8)
    obs, _ = jax.vmap(env.reset, (0, None))(keys, params)
    assert np.isfinite(np.asarray(obs)).all()
    poses = reference.random_poses(window, 200, np.random.default_rng(0))
    truth = reference.scan(window.lining("smooth").segments, poses.position, poses.heading)
    assert np.abs(device_scans(window, poses, "smooth") - truth).max() < 1e-3
