"""MuJoCo's own engine does to a robot what MJX does, and remembers nothing."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from subterra_jax.b2 import engine, physics
from subterra_jax.b2.engine import MujocoPhysics
from subterra_jax.b2.params import Body, Surroundings
from subterra_jax.b2.walk import command_joints

PERIOD = 0.02


@pytest.fixture(scope="module")
def in_c():
    return MujocoPhysics()


@pytest.fixture(scope="module")
def moment(walking):
    """Eight robots on their way, what is around them, and where their servos are to go."""
    params = walking.told((0.5, 0.0, 0.0))
    aims = jax.jit(jax.vmap(lambda s: command_joints(s, jnp.zeros(12), PERIOD, params)[1]))
    around = jax.jit(jax.vmap(lambda s: walking.env.surroundings(s, params)))

    def seen(state):
        return jax.device_get((state.body, aims(state), around(state), state.build))

    _, state = walking.reset(3, params)
    for k in range(20):
        _, state, *_ = walking.step(k, state, params=params)
    return params, state, seen


def of(tree, k):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[k], tree)


@pytest.mark.slow
def test_half_a_second_in_both_engines_ends_in_the_same_joint_angles(walking, moment, in_c):
    """From one state, told the same targets: within 1e-4 rad after 25 control periods, 125 steps of physics."""
    params, state, seen = moment
    robots, bodies = range(3), of(state.body, slice(3))
    shift = np.zeros((3, 3), np.float32)
    for k in range(25):
        _, aims, around, build = seen(state)
        before = state
        _, state, _, terminated, truncated, _ = walking.step(100 + k, state, params=params)
        assert not (terminated | truncated)[:3].any()
        # A robot that has passed on to another anchor is told from there.
        track = params.track.position
        after = [in_c.run_one(of(bodies, r), aims[r], of(around, r), of(build, r)) for r in robots]
        bodies = jax.tree.map(lambda *parts: np.stack(parts), *after)
        shift = np.asarray(track[state.anchor] - track[before.anchor])[:3]
        bodies = dataclasses.replace(bodies, qpos=bodies.qpos - np.pad(shift, ((0, 0), (0, 16))))
    np.testing.assert_allclose(bodies.qpos[:, 7:], state.body.qpos[:3, 7:], atol=1e-4)
    np.testing.assert_allclose(bodies.qpos[:, :7], state.body.qpos[:3, :7], atol=1e-4)
    assert np.abs(np.asarray(state.body.qvel[:3, 6:])).max() > 0.5, "nothing moved"


@pytest.mark.slow
def test_a_robot_s_step_depends_neither_on_who_was_there_before_nor_on_the_batch(moment, in_c):
    _, state, seen = moment
    what = seen(state)
    alone = [in_c.run_one(*of(what, k)) for k in (2, 5, 2)]
    together = in_c.run_rows(*of(what, slice(6)))
    for name in ("qpos", "qvel", "warmstart"):
        assert np.array_equal(getattr(alone[0], name), getattr(alone[2], name))
        assert np.array_equal(getattr(alone[0], name), getattr(together, name)[2])
        assert not np.array_equal(getattr(alone[0], name), getattr(alone[1], name))


def test_walls_push_in_numpy_as_in_the_graph_and_only_those_who_are_near():
    rng = np.random.default_rng(0)
    pushed = jax.jit(physics.wall_wrench)
    n_pushed = 0
    for lateral in (0.0, 0.2, -0.45, 0.5):
        quaternion = np.array([np.cos(0.3), 0.02, -0.03, np.sin(0.3)], np.float32)
        track = np.array([np.cos(0.2), 0.0, 0.0, np.sin(0.2)], np.float32)
        side = np.array([-np.sin(0.4), np.cos(0.4), 0.0])
        qpos = np.concatenate([lateral * side, quaternion / np.linalg.norm(quaternion), np.zeros(12)])
        body = Body(*(part.astype(np.float32) for part in (qpos, rng.normal(size=18), np.zeros(18))))
        around = Surroundings((np.zeros((7, 3)), np.zeros((7, 4))), track, np.float32(0.6))
        told = engine.wall_wrench(body.qpos, body.qvel, around)
        np.testing.assert_allclose(told, pushed(body, around), rtol=1e-3, atol=0.5)
        n_pushed += bool(np.any(told))
        far = dataclasses.replace(around, half_width=np.float32(2.4))
        assert engine.far_from_walls(body.qpos, far)
        assert not engine.wall_wrench(body.qpos, body.qvel, far).any()
    assert n_pushed >= 2
