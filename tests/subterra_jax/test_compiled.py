"""Programs: compiled once, whatever the values; in shards, checkpointed, watched for NaN, uncompiled, kept on disk."""

import dataclasses
import functools
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax import lidar
from subterra_jax.compiled import keep_programs
from subterra_jax.lidar import LidarParams
from tests.subterra_jax.modes import assert_same, mode

pytestmark = pytest.mark.door


@pytest.fixture(scope="module")
def short() -> tuple[Any, Any, Any]:
    env, params = st.make("Subterra/StopAtShort-v1")
    return env, params, env.reset(jax.random.key(0), params)[1]


# Transformations


@pytest.mark.slow
def test_the_methods_run_in_shards_as_alone():
    code = """
import jax, jax.numpy as jnp, numpy as np, subterra_jax as st
from jax.sharding import Mesh, PartitionSpec as P
env, params = st.make("Subterra/Faulted-v1")
batch = st.AutoReset(env)
def go(keys, params):
    obs, state = batch.reset(keys[0], params, 4)
    obs, _, steps = st.rollout(batch, lambda key, obs: jnp.ones((4, 2)), keys[0], obs, state, params, 3)
    return obs, steps["reward"].T
def slope(scale, keys, params):
    def total(scale):
        _, state = jax.vmap(env.reset, (0, None))(keys, params)
        drive = jnp.ones((1, 2)) * scale
        step = lambda state, _: jax.vmap(env.step, (0, 0, 0, None))(keys, state, drive, params)[1::-1]
        return jax.lax.psum(jnp.sum(jax.lax.scan(step, state, length=2)[1]), "x")
    return jax.grad(total)(scale)
mesh = Mesh(np.array(jax.devices()), ("x",))
keys = jax.random.split(jax.random.key(0), 2)
sharded = jax.jit(jax.shard_map(go, mesh=mesh, in_specs=(P("x"), P()), out_specs=P("x")))(keys, params)
alone = [jax.jit(go)(key[None], params) for key in keys]
for a, *b in zip(sharded, *alone, strict=True):
    np.testing.assert_array_equal(a, np.concatenate(b))
together = jax.jit(jax.shard_map(slope, mesh=mesh, in_specs=(P(), P("x"), P()), out_specs=P()))
total = lambda scale, key: slope(scale, key[None], params)
print(len(jax.devices()), float(together(jnp.float32(0.5), keys, params)))
"""
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "XLA_FLAGS": flags},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    devices, total = done.stdout.split()
    assert int(devices) == 2
    assert np.isfinite(float(total))
    assert float(total) != 0.0


def test_a_step_can_be_checkpointed_and_its_state_given_away(short):
    env, params, state = short

    def total(action, wrap):
        step = wrap(lambda state, key: env.step(key, state, action, params)[1::-1])
        return jnp.sum(jax.lax.scan(step, state, jax.random.split(jax.random.key(1), 4))[1][:, 1])

    one, other = (
        jax.jit(jax.grad(functools.partial(total, wrap=w)))(jnp.array([1.0, 0.1]))
        for w in (jax.checkpoint, lambda f: f)
    )
    np.testing.assert_allclose(one, other, rtol=1e-5)
    assert np.all(one != 0.0)
    step = lambda state: env.step(jax.random.key(1), state, jnp.ones(2), params)[1]  # noqa: E731
    copy = jax.tree.map(jnp.copy, state)
    given = jax.jit(step, donate_argnums=0)(copy)
    assert_same(given, jax.jit(step)(state))
    assert copy.position.is_deleted()


@pytest.mark.slow
def test_a_step_runs_with_nans_watched_and_uncompiled(short):
    env, params, state = short
    plain = env.step(jax.random.key(1), state, jnp.ones(2), params)
    with mode(jax_debug_nans=True):
        watched = env.step(jax.random.key(1), state, jnp.ones(2), params)
        jax.jit(jax.grad(lambda action: env.step(jax.random.key(1), state, action, params)[2]))(jnp.zeros(2))
    assert_same(plain, watched)
    with jax.disable_jit():
        by_hand = env.step(jax.random.key(1), state, jnp.ones(2), params)
    for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(by_hand), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)


# Compiled once


def count_compilations(function: Any) -> tuple[Any, Any]:
    """A function as compiled, and how often it was traced."""
    counts = []

    def counted(*args: Any) -> Any:
        counts.append(1)
        return function(*args)

    return jax.jit(counted), counts


def test_replacing_params_by_python_numbers_compiles_nothing_anew(short):
    env, params, state = short
    step, counts = count_compilations(lambda state, params: env.step(jax.random.key(1), state, jnp.ones(2), params))
    step(state, params)
    again = params.replace(
        horizon=50, lidar=params.lidar.replace(range_sigma=0, range_max=20.0), goal=params.goal.replace(tolerance=2)
    )
    for path, leaf in jax.tree_util.tree_flatten_with_path(again)[0]:
        assert isinstance(leaf, jax.Array), path
    step(state, again)
    step(state.replace(station=3, steps=4), params)
    assert len(counts) == 1
    assert int(again.horizon) == 50
    assert float(again.goal.tolerance) == 2.0


@pytest.mark.parametrize("horizon", [50.5, float("nan"), float("inf")])
def test_replacing_a_count_by_a_fraction_is_refused(horizon):
    _, params = st.make("Subterra/TraverseShort-v1")
    with pytest.raises(ValueError, match=f"a whole number is needed, got {horizon}"):
        params.replace(horizon=horizon)
    assert int(params.replace(horizon=50.0).horizon) == 50


def count(event: str, function: Any) -> int:
    """Return the number of times that JAX reports an event while a function runs."""
    counts = []
    listen = lambda name, *_, **__: counts.append(name == event)  # noqa: E731
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        function()
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    return sum(counts)


COMPILES = "/jax/core/compile/backend_compile_duration"


def test_a_rollout_compiles_once_for_a_policy_and_reads_its_weights_each_time(short):
    env, params, _ = short
    batch = st.AutoReset(env)
    obs, state = batch.reset(jax.random.key(0), params, 3)

    def roll(policy):
        return float(st.rollout(batch, policy, jax.random.key(1), obs, state, params, 2)[2]["action"][0, 0, 0])

    def drive(speed, key, obs):
        return jnp.zeros((3, 2)).at[:, 0].set(speed)

    assert roll(jax.tree_util.Partial(drive, jnp.float32(0.5))) == 0.5
    assert count(COMPILES, lambda: roll(jax.tree_util.Partial(drive, jnp.float32(0.5)))) == 0
    assert roll(jax.tree_util.Partial(drive, jnp.float32(0.75))) == 0.75
    # What a function holds is part of it.
    assert [roll(lambda key, obs, speed=speed: drive(speed, key, obs)) for speed in (0.25, 1.25)] == [0.25, 1.25]


def test_a_rule_that_cannot_be_hashed_runs_all_the_same(short):
    env, params, _ = short

    class Own(type(env.rule)):
        __hash__ = None

    own = dataclasses.replace(env, rule=Own())
    with pytest.raises(TypeError):
        hash(own)
    _, after = jax.eval_shape(own.reset, jax.random.key(0), params)
    assert after.position.shape == (2,)


def test_gymnasium_traces_and_compiles_an_environment_once(short, monkeypatch):
    gymnasium = pytest.importorskip("gymnasium")
    first = gymnasium.make("Subterra/TraverseShort-v1")
    obs, _ = first.reset(seed=0)

    def second():
        again, _ = gymnasium.make("Subterra/TraverseShort-v1").reset(seed=0)
        np.testing.assert_array_equal(obs, again)

    assert count(COMPILES, second) == 0
    casts, cast = [], lidar.scan
    monkeypatch.setattr(lidar, "scan", lambda *args: casts.append(1) or cast(*args))
    other = gymnasium.make("Subterra/TraverseShort-v1", horizon=3, lidar=LidarParams(n_beams=5))
    assert len(casts) == 2  # by reset and by step
    other.reset(seed=0)
    assert [other.step(np.float32([0.0, 0.0]))[3] for _ in range(3)] == [False, False, True]


def test_programs_are_kept_on_disk_from_the_first_make_on_and_not_by_the_import(tmp_path: Path):
    code = (
        "import sys, jax, jax.numpy as jnp, subterra_jax as st\n"
        "before = jax.config.jax_compilation_cache_dir\n"
        "jax.jit(lambda x: x + 1)(1)\n"
        "env, params = st.make('Subterra/TraverseShort-v1', tunnel='control')\n"
        "print(before, jax.config.jax_compilation_cache_dir, st.cache_programs())\n"
        "env.reset(jax.random.key(0), params)"
    )
    places = {"XDG_CACHE_HOME": str(tmp_path), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    clean = {name: text for name, text in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-c", code], env={**clean, **places}, capture_output=True, text=True, check=True
    )
    before, folder, same = done.stdout.split()
    assert (before, same) == ("None", folder)
    assert Path(folder).is_relative_to(tmp_path / "subterra" / "compiled")
    assert list(Path(folder).iterdir())
    with mode(jax_compilation_cache_dir=None, jax_enable_compilation_cache=False):  # the user forbids it
        keep_programs()
        assert jax.config.jax_compilation_cache_dir is None


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(st.SubterraError, match="cannot be written"):
        st.cache_programs(tmp_path / "file" / "x")


def test_a_step_by_hand_is_that_of_a_compiled_function_and_may_be_part_of_one():
    """By hand it is compiled in haste, which is no option of a program inside of another."""
    env, params = st.make("Subterra/TraverseShort-v1", tunnel="control")
    key = jax.random.key(0)
    obs, state = env.reset(key, params)
    inside = jax.jit(lambda: env.reset(jax.random.key(0), params))()
    np.testing.assert_allclose(inside[0], obs, atol=1e-4)
    args = key, state, jnp.array([1.0, 0.1]), params
    np.testing.assert_allclose(jax.jit(env.step)(*args)[0], env.step(*args)[0], atol=1e-4)
