"""Peers do the same work as ours, or say what they do instead."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from benchmarks.throughput import mujoco_route
from benchmarks.throughput.peers import BatchedPeer, Route, find_peers, jaxnav_loop, measure_peer, pendulum_loop
from benchmarks.throughput.timing import Loop, Timing
from subterra_jax.lidar import reference
from subterra_jax.parts.odometer import OdometryParams


@pytest.fixture(scope="module")
def plan() -> st.TunnelPlan:
    return st.load_tunnel().slice(100.0, 60.0)


def route(plan: st.TunnelPlan, **overrides) -> tuple[mujoco_route.MujocoTunnel, st.TunnelEnv, st.EnvParams]:
    quiet = st.make("Subterra/Traverse-v1")[1]
    sigmas = ("distance_sigma", "distance_bias_sigma", "heading_sigma", "heading_bias_sigma")
    overrides["odometry"] = OdometryParams(**dict.fromkeys(sigmas, 0.0))
    overrides["lidar"] = quiet.lidar.replace(range_sigma=0.0)
    env, params = st.make("Subterra/Traverse-v1", plan, **overrides)
    return mujoco_route.MujocoTunnel(mujoco_route.extrude_walls(plan, "pockets"), plan, params), env, params


def test_extruded_walls_give_the_ranges_of_the_reference(plan):
    peer, *_ = route(plan)
    peer.reset(seed=0)
    poses = reference.random_poses(plan, 100, np.random.default_rng(0))
    truth = reference.scan(plan.lining("pockets").segments, poses.position, poses.heading)
    found = np.empty_like(truth)
    for k in range(100):
        (peer.x, peer.y), peer.heading, peer.station = poses.position[k], float(poses.heading[k]), poses.station[k]
        found[k] = peer.ranges()
    # A ray past the edge of a pocket may see either side of it.
    assert np.mean(np.abs(found - truth) < 1e-3) > 0.998


def test_the_papers_route_moves_pays_and_sees_as_ours_does(plan):
    peer, env, params = route(plan)
    obs, _ = peer.reset(seed=3)
    _, state = env.reset(jax.random.key(0), params)
    state = state.replace(
        position=jnp.array([peer.x, peer.y], jnp.float32), heading=jnp.float32(peer.heading),
        lateral=jnp.float32(0.0), station=jnp.float32(0.0), furthest=jnp.float32(0.0),
    )  # fmt: skip
    step = jax.jit(env.step)
    rng = np.random.default_rng(1)
    for k in range(40):
        action = np.array([rng.uniform(0.0, 2.5), rng.uniform(-0.3, 0.3)])
        obs, reward, terminated, truncated, info = peer.step(action)
        ours, state, gain, ended, _, told = step(jax.random.key(k), state, jnp.asarray(action, jnp.float32), params)
        assert [terminated, truncated, bool(ended)] == [False] * 3
        np.testing.assert_allclose([peer.x, peer.y], state.position, atol=1e-3)
        assert info["station"] == pytest.approx(float(told["station"]), abs=2e-3)
        assert info["coverage"] == pytest.approx(float(told["coverage"]), abs=1e-4)
        assert reward == pytest.approx(float(gain), abs=1e-3)
        assert obs[16] == pytest.approx(float(ours[16]), abs=1e-3)
        assert obs[17] == pytest.approx(float(ours[17]), abs=1e-3)
        assert np.median(np.abs(obs[:16] - np.asarray(ours)[:16])) < 5e-3
    assert obs.shape == (18,)
    assert obs.dtype == np.float32


def test_the_papers_route_ends_at_a_wall_and_begins_anew(plan):
    peer, *_ = route(plan)
    peer.reset(seed=0)
    ended = [peer.step(np.array([2.0, 1.5]))[2] for _ in range(60)]
    assert any(ended)
    speed = mujoco_route.measure(peer, Timing(steps=80, repeats=2))
    assert speed.n_envs == 1
    assert 0.0 < speed.share_done < 1.0


def test_a_scene_folder_without_a_scene_is_named(plan, tmp_path):
    with pytest.raises(st.SubterraError, match=r"scene\.xml"):
        mujoco_route.load_scene(tmp_path, plan, "pockets")
    (tmp_path / "scene.xml").write_text("<mujoco><nonsense/></mujoco>")
    with pytest.raises(st.SubterraError, match="cannot read it"):
        mujoco_route.load_scene(tmp_path, plan, "pockets")


def test_a_peer_that_is_not_installed_is_left_out_with_its_reason(plan, monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnax", None)
    found = find_peers(("auto",))
    assert set(found) == {"jaxnav", "gymnax", "mujoco"}
    where = Route(plan, "pockets", st.make("Subterra/Traverse-v1", plan)[1], None)
    peer = measure_peer("gymnax", found["gymnax"], (1, 2), where, Timing(), lambda _: None)
    assert peer.speeds == []
    assert "gymnax" in peer.left_out["all"]
    assert find_peers(("none",)) == {}


def test_a_peer_that_breaks_is_left_out_with_its_reason(plan):
    def broken(n_envs: int) -> Loop:
        raise RuntimeError("RESOURCE_EXHAUSTED: 1 TiB" if n_envs > 4 else "no such map")

    module = BatchedPeer("numpy", "a", 16, broken)
    where = Route(plan, "pockets", st.make("Subterra/Traverse-v1", plan)[1], None)
    peer = measure_peer("jaxnav", module, (4, 8), where, Timing(), lambda _: None)
    assert peer.left_out == {"4": "RuntimeError: no such map", "8": "out of memory"}
    assert peer.speeds == []


def stepped(loop: Loop, n_envs: int):
    carry = jax.jit(loop.reset)(jax.random.key(0), loop.params)
    (obs, _), rest, done = jax.jit(loop.step)(jax.random.key(1), carry, loop.params)
    assert np.isfinite(float(rest))
    assert 0.0 <= float(done) <= 1.0
    return obs


def test_jaxnav_has_as_many_beams_as_ours_and_one_agent():
    pytest.importorskip("jaxmarl")
    obs = stepped(jaxnav_loop(3), 3)
    assert {name: value.shape for name, value in obs.items()} == {"agent_0": (3, 16 + 5)}


def test_pendulum_has_no_sensor():
    pytest.importorskip("gymnax")
    assert stepped(pendulum_loop(3), 3).shape == (3, 3)
