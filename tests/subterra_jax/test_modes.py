"""Any mode of JAX: 64 bits and strict promotion."""

from typing import Any

import jax
import jax.numpy as jnp
import pytest

import subterra_jax as st
from subterra_jax import lidar3d, native
from subterra_jax.baselines import registry
from subterra_jax.lidar import LidarParams
from subterra_jax.lidar3d import beams
from subterra_jax.lidar3d.surface import Axis, Triangles
from tests.subterra_jax import surfaces
from tests.subterra_jax.modes import NEEDS_KERNELS, assert_same, strict, wide

pytestmark = pytest.mark.door

KINDS = [f"Subterra/{name}-v1" for name in ("Traverse", "StopAt", "Return", "Obstructed", "Faulted", "Relocalise")]


def drive(env: st.TunnelEnv, params: st.EnvParams, n_envs: int, n_steps: int) -> Any:
    """A batch at its start, and what it meets on a way of drawn actions, which have 64 bits where JAX allows them."""
    batch, space = st.AutoReset(env), env.action_space(params)

    def policy(key, obs):
        return jax.vmap(space.sample)(jax.random.split(key, n_envs)).astype(float)

    obs, state = batch.reset(jax.random.key(0), params, n_envs)
    return obs, st.rollout(batch, policy, jax.random.key(1), obs, state, params, n_steps)


@pytest.mark.parametrize("task", KINDS)
def test_every_kind_of_task_runs_in_64_bits_under_strict_promotion_and_keeps_32(task):
    with wide(), strict():
        env, params = st.make(task)
        shapes = jax.eval_shape(lambda: drive(env, params, 4, 3))
        one = jax.eval_shape(lambda: env.reset(jax.random.key(0), params))
    shapes[1][2].pop("action")  # as the policy gave it
    for path, leaf in jax.tree_util.tree_flatten_with_path((shapes, one, params))[0]:
        assert leaf.dtype in (jnp.float32, jnp.int32, jnp.uint32, jnp.bool_), (path, leaf.dtype)
        assert not leaf.weak_type, path


@pytest.mark.parametrize("settings", [wide, strict])
@pytest.mark.parametrize("kernels", [pytest.param(True, marks=NEEDS_KERNELS), False])
def test_the_lidar_in_three_dimensions_and_its_derivatives_run_in_it(settings, kernels, monkeypatch):
    axis = surfaces.axis_of(12.0)
    surface = surfaces.tube(axis, 2.0, 12, 7)
    relief = lidar3d.Relief.from_triangles(Axis(**axis), Triangles(*surface))
    if not kernels:
        monkeypatch.setattr(native, "supported", lambda: False)

    def scan(position, directions, station):
        return surfaces.ranges(relief, position, directions, station)

    where = jnp.array([6.0, 0.0, 0.0]), jnp.asarray(beams.planar(5)), jnp.float32(6.0)
    with settings():
        for function in (scan, jax.jacfwd(scan), jax.jacrev(scan), jax.vmap(scan, (None, None, None), axis_size=2)):
            assert jax.eval_shape(function, *where).dtype == jnp.float32


def drive_by(driver: str, env: st.TunnelEnv, params: st.EnvParams, n_envs: int, n_steps: int) -> Any:
    """Return all that a batch and an agent meet from its start; not the agent's memory, whose types are its own."""
    policy, batch = st.load_policy(driver, env, params), st.AutoReset(env)
    obs, state = batch.reset(jax.random.key(0), params, n_envs)
    steps = st.rollout(batch, policy, jax.random.key(1), obs, state, params, n_steps)[2]
    return obs, {name: leaf for name, leaf in steps.items() if name != "memory"}


@pytest.mark.slow
@pytest.mark.parametrize("task", [id for id in st.TASKS])
@pytest.mark.parametrize("fused", [True, False])
def test_the_same_episodes_of_every_task_come_out(task, fused):
    options: dict[str, Any] = {"horizon": 40, "lidar": LidarParams(fused=fused)}
    env, params = st.make(task, **options)
    plain = drive(env, params, 16, 100)
    with wide(), strict():
        env, params = st.make(task, **options)
        assert_same(plain, drive(env, params, 16, 100))


RELEASED = ("Traverse",)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("driver", "task"), [*((name, "StopAt") for name in registry.names()), *((f"{name}-v1", name) for name in RELEASED)]
)
def test_agents_drive_in_64_bits_as_in_32(driver, task):
    task = f"Subterra/{task}-v1"
    plain = drive_by(driver, *st.make(task), 2, 3)
    with wide():
        assert_same(plain, drive_by(driver, *st.make(task), 2, 3))
