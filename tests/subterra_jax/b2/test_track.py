"""Sleepers by standard and from a scene, and the window of them that follows the robot."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.b2 import kinematics
from subterra_jax.b2.track import (
    RAIL_HALF,
    RAIL_OFFSET,
    TrackError,
    WindowConfig,
    lay_standard_track,
    move_anchor,
    read_scene_track,
    window_poses,
)
from tests.subterra_jax.tunnels import straight, tunnel_arrays

CONFIG = WindowConfig()
FORWARD = jnp.array([1.0, 0.0, 0.0])
poses, follow = jax.jit(window_poses, static_argnums=3), jax.jit(move_anchor)
rotate = jax.jit(kinematics.rotate)


@pytest.fixture(scope="module")
def plan():
    return st.load_tunnel()


@pytest.fixture(scope="module")
def track(plan):
    return lay_standard_track(plan)


def write_scene(folder, yaw, grade=0.0, protrusion=0.05, count=12):
    """A scene with sleepers every 0.7 m along a straight line and one slab of ballast under them."""
    along = np.array([np.cos(yaw) * np.cos(grade), np.sin(yaw) * np.cos(grade), np.sin(grade)])
    across = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    up = np.cross(along, across)
    pitched = jnp.array([np.cos(grade / 2), 0.0, -np.sin(grade / 2), 0.0])
    turn = kinematics.compose(kinematics.yaw_quaternion(jnp.float32(yaw)), pitched)
    quat = " ".join(f"{q:.8f}" for q in turn)
    lines = []
    for k in range(count):
        top = 0.7 * (k + 1) * along
        lines.append(f'<geom name="sleeper_{k:04d}" pos="{top[0]:.6f} {top[1]:.6f} {top[2]:.6f}" quat="{quat}"/>')
    slab = 4.0 * along - (protrusion + 0.1) * up
    lines.append(f'<geom name="bed_000" size="5 2 0.1" pos="{slab[0]} {slab[1]} {slab[2]}" quat="{quat}"/>')
    (folder / "scene.xml").write_text(f"<mujoco><worldbody>{''.join(lines)}</worldbody></mujoco>")


def test_351_metres_have_586_sleepers(track):
    assert track.station.shape == (586,)
    np.testing.assert_allclose(np.diff(track.station), 0.6, atol=1e-4)


def test_sleepers_lie_on_the_centreline_across_the_tangent(plan, track):
    centre, tangent = (
        np.column_stack([np.interp(track.station, plan.station, values[:, i]) for i in range(2)])
        for values in (plan.centre, plan.tangent)
    )
    forward = jax.jit(jax.vmap(kinematics.rotate, in_axes=(0, None)))(track.quaternion, FORWARD)
    np.testing.assert_allclose(track.position[:, :2], centre, atol=1e-4)
    np.testing.assert_allclose(forward[:, :2], tangent, atol=2e-3)


def test_a_scenes_own_sleepers_are_taken_with_grade_and_protrusion(tmp_path, plan_of):
    write_scene(tmp_path, yaw=0.0, grade=0.02)
    found = read_scene_track(tmp_path, plan_of(tunnel_arrays(straight(20.0))))
    np.testing.assert_allclose(found.station, 0.7 * np.cos(0.02) * np.arange(1, 13), atol=1e-5)
    np.testing.assert_allclose(found.protrusion, 0.05, atol=1e-5)
    np.testing.assert_allclose(
        kinematics.rotate(found.quaternion[3], FORWARD), [np.cos(0.02), 0.0, np.sin(0.02)], atol=1e-6
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<mujoco><worldbody/></mujoco>", "0 sleepers: the scene has no track to walk on"),
        (None, "not a readable scene"),
    ],
)
def test_a_scene_without_a_track_is_refused_by_name(tmp_path, plan_of, text, message):
    if text is not None:
        (tmp_path / "scene.xml").write_text(text)
    with pytest.raises(TrackError, match=rf"scene\.xml: {message}"):
        read_scene_track(tmp_path, plan_of(tunnel_arrays(straight(20.0))))


def test_a_tunnel_of_three_metres_is_too_short_for_a_track(plan_of):
    with pytest.raises(TrackError, match="too short for a track"):
        lay_standard_track(plan_of(tunnel_arrays(straight(3.0))))


def test_the_window_holds_ballast_four_sleepers_and_two_rails(plan_of):
    level = lay_standard_track(plan_of(tunnel_arrays(straight(20.0))))
    positions, quaternions = poses(level, jnp.int32(10), jnp.float32(0.1), CONFIG)
    assert positions.shape == (7, 3)
    np.testing.assert_allclose(positions[0], [0.0, 0.0, -0.06], atol=1e-6)
    np.testing.assert_allclose(positions[1:5, 0], [-0.6, 0.0, 0.6, 1.2], atol=1e-5)
    np.testing.assert_allclose(positions[1:5, 2] + 0.05, 0.0, atol=1e-6)
    np.testing.assert_allclose(positions[5:, 1], [RAIL_OFFSET, -RAIL_OFFSET], atol=1e-6)
    np.testing.assert_allclose(positions[5:, 2], RAIL_HALF[1], atol=1e-6)
    np.testing.assert_allclose(quaternions[:, 0], 1.0, atol=1e-6)


def test_the_gauge_is_1435_millimetres_between_the_heads():
    assert 2.0 * (RAIL_OFFSET - RAIL_HALF[0]) == pytest.approx(1.435)


def test_sleepers_reach_a_metre_to_either_side_wherever_the_robot_is(track):
    for ahead in (-0.29, -0.1, 0.1, 0.29):
        positions, _ = poses(track, jnp.int32(100), jnp.float32(ahead), CONFIG)
        middles = np.linalg.norm(positions[1:5, :2], axis=1) * [-1, 1, 1, 1] if ahead > 0 else None
        if middles is None:
            middles = np.linalg.norm(positions[1:5, :2], axis=1) * [-1, -1, 1, 1]
        # The next sleeper that is not there begins beyond the feet's reach.
        assert middles[0] - 0.6 + 0.1 - ahead < -0.95
        assert middles[3] + 0.6 - 0.1 - ahead > 0.95


def test_the_anchor_follows_the_robot_and_places_add_up_to_a_tenth_of_a_millimetre():
    long = lay_standard_track(st.load_tunnel("metro"))
    anchor, local = jnp.int32(1500), jnp.zeros(3)
    start = np.asarray(long.position[1500], np.float64)
    walked = np.zeros(3)
    for k in range(600):
        stride = 0.04 * np.asarray(rotate(long.quaternion[anchor], FORWARD), np.float64)
        walked += stride
        anchor, local = follow(long, anchor, local + stride.astype(np.float32))
        assert np.linalg.norm(local) < 0.45, k
    assert int(anchor) == 1540
    np.testing.assert_allclose(np.asarray(long.position[anchor], np.float64) + local, start + walked, atol=1e-4)
