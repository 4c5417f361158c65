"""Any mode of JAX: 64 bits, strict promotion, derivatives, shards, and what is compiled once."""

import contextlib
import dataclasses
import functools
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax import lidar, lidar3d, native
from subterra_jax.baselines import registry
from subterra_jax.lidar import LidarParams
from subterra_jax.lidar3d import beams
from subterra_jax.lidar3d.surface import Axis, Triangles
from subterra_jax.parts.unicycle import clearance
from tests.subterra_jax import surfaces
from tests.subterra_jax.tunnels import straight, tunnel_arrays

pytestmark = pytest.mark.door

KINDS = [f"Subterra/{name}-v0" for name in ("Traverse", "StopAt", "Return", "Obstructed", "Faulted", "Relocalise")]
needs_kernels = pytest.mark.skipif(not native.supported(), reason="numba is not installed, or this is no CPU")


@contextlib.contextmanager
def mode(**settings: Any) -> Iterator[None]:
    """JAX with other settings, for a while."""
    before = {name: getattr(jax.config, name) for name in settings}
    for name, value in settings.items():
        jax.config.update(name, value)
    try:
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)


def wide() -> Any:
    return mode(jax_enable_x64=True)


def strict() -> Any:
    return mode(jax_numpy_dtype_promotion="strict", jax_numpy_rank_promotion="raise")


def drive(env: st.TunnelEnv, params: st.EnvParams, n_envs: int, n_steps: int) -> Any:
    """A batch at its start, and what it meets on a way of drawn actions, which have 64 bits where JAX allows them."""
    batch, space = st.AutoReset(env), env.action_space(params)

    def policy(key, obs):
        return jax.vmap(space.sample)(jax.random.split(key, n_envs)).astype(float)

    obs, state = batch.reset(jax.random.key(0), params, n_envs)
    return obs, st.rollout(batch, policy, jax.random.key(1), obs, state, params, n_steps)


def assert_same(one: Any, other: Any) -> None:
    for (path, a), b in zip(jax.tree_util.tree_flatten_with_path(one)[0], jax.tree.leaves(other), strict=True):
        assert a.dtype == b.dtype or "action" in str(path), path
        np.testing.assert_array_equal(a, b, err_msg=jax.tree_util.keystr(path))


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
@pytest.mark.parametrize("kernels", [pytest.param(True, marks=needs_kernels), False])
def test_the_lidar_in_three_dimensions_and_its_derivatives_run_in_it(settings, kernels, monkeypatch):
    axis = surfaces.axis_of(12.0)
    surface = surfaces.tube(axis, 2.0, 12, 7)
    relief = lidar3d.Relief.from_triangles(Axis(**axis), Triangles(*surface))
    if not kernels:
        monkeypatch.setattr(native, "supported", lambda: False)

    def scan(position, orientation, station):
        return lidar3d.scan(relief, position, orientation, station, beams.planar(5), 30.0)

    where = jnp.array([6.0, 0.0, 0.0]), jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.float32(6.0)
    with settings():
        for function in (scan, jax.jacfwd(scan), jax.jacrev(scan), jax.vmap(scan, (None, None, None), axis_size=2)):
            assert jax.eval_shape(function, *where).dtype == jnp.float32


def test_the_same_episodes_come_out():
    task = "Subterra/FaultedShort-v0"
    env, params = st.make(task, horizon=12)
    plain = drive(env, params, 6, 25)
    with wide(), strict():
        env, params = st.make(task, horizon=12)
        assert_same(plain, drive(env, params, 6, 25))


@pytest.mark.slow
@pytest.mark.parametrize("task", list(st.tasks.BUILT_IN))
@pytest.mark.parametrize("fused", [True, False])
def test_the_same_episodes_of_every_task_come_out(task, fused):
    options: dict[str, Any] = {"horizon": 40, "lidar": LidarParams(fused=fused)}
    env, params = st.make(task, **options)
    plain = drive(env, params, 16, 100)
    with wide(), strict():
        env, params = st.make(task, **options)
        assert_same(plain, drive(env, params, 16, 100))


RELEASED = ("Faulted", "Obstructed", "Relocalise", "Return", "StopAt", "Traverse")


@pytest.mark.parametrize(
    ("driver", "task"),
    [
        ("dead-reckoning", "StopAt"),
        *(pytest.param(n, "StopAt", marks=pytest.mark.slow) for n in registry.names() if n != "dead-reckoning"),
        *(pytest.param(f"{name}-v0", name, marks=pytest.mark.slow) for name in RELEASED),
    ],
)
def test_agents_drive_in_64_bits_as_in_32(driver, task):
    def drive_by() -> Any:
        env, params = st.make(f"Subterra/{task}-v0")
        policy, batch = st.load_policy(driver, env, params), st.AutoReset(env)
        obs, state = batch.reset(jax.random.key(0), params, 2)
        steps = st.rollout(batch, policy, jax.random.key(1), obs, state, params, 3)[2]
        return {name: leaf for name, leaf in steps.items() if name != "memory"}

    plain = drive_by()
    with wide():
        assert_same(plain, drive_by())


def count_compilations(function: Any) -> tuple[Any, Any]:
    """A function as compiled, and how often it was traced."""
    counts = []

    def counted(*args: Any) -> Any:
        counts.append(1)
        return function(*args)

    return jax.jit(counted), counts


def test_replacing_params_by_python_numbers_compiles_nothing_anew():
    env, params = st.make("Subterra/StopAtShort-v0")
    step, counts = count_compilations(lambda state, params: env.step(jax.random.key(1), state, jnp.ones(2), params))
    _, state = env.reset(jax.random.key(0), params)
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


def test_replacing_leaves_a_tree_of_axes_as_it_is():
    _, params = st.make("Subterra/StopAtShort-v0")
    axes = jax.tree.map(lambda _: None, params).replace(horizon=0)
    assert axes.horizon == 0
    assert isinstance(axes.horizon, int)


# Derivatives


@pytest.fixture(scope="module")
def corridor(plan_of) -> st.Tunnel:
    return st.Tunnel.from_plan(plan_of(tunnel_arrays(straight(80.0), half_width=2.0)), "smooth")


@pytest.mark.parametrize("fused", [pytest.param(True, marks=needs_kernels), False])
def test_a_range_changes_as_the_walls_normal_says(corridor, fused):
    """Beam 4 of 16 looks straight at the left wall, beam 2 at 45° to it, beam 0 along the tunnel."""
    params = LidarParams(fused=fused)

    def ranges(pose):
        return lidar.scan(corridor, pose[:2], pose[2], jnp.float32(40.0), params)

    poses = jnp.tile(jnp.array([40.0, 0.5, 0.0]), (3, 1))
    slope = jax.jit(jax.vmap(jax.jacfwd(ranges)))(poses)[0]
    np.testing.assert_allclose(slope[4], [0.0, -1.0, 0.0], atol=1e-5)
    # The left wall is 1.5 m away: range 1.5 √2, which turning towards the wall shortens.
    np.testing.assert_allclose(slope[2], [0.0, -np.sqrt(2.0), -1.5 * np.sqrt(2.0)], atol=1e-4)
    np.testing.assert_array_equal(slope[0], 0.0)  # it meets nothing
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.jacrev(ranges)))(poses)[0], slope, atol=1e-5)


@pytest.mark.parametrize("fused", [pytest.param(True, marks=needs_kernels), False])
def test_a_range_changes_with_the_wall_that_it_meets(corridor, fused):
    there = jnp.float32(0.0), jnp.float32(40.0)

    def range_to_left(walls):
        moved = dataclasses.replace(corridor, box=corridor.box + jnp.array([0, walls, 0, 0, 0, 0])[:, None])
        scan = lambda y: lidar.scan(moved, jnp.stack([40.0, y]), *there, LidarParams(fused=fused))  # noqa: E731
        return jax.vmap(scan)(jnp.zeros(2))[0, 4]

    assert float(jax.jit(jax.grad(range_to_left))(0.0)) == pytest.approx(1.0, abs=1e-5)


def test_the_clearance_changes_towards_the_nearest_wall(corridor):
    slope = jax.jit(jax.vmap(jax.grad(lambda p: clearance(corridor, p, jnp.float32(40.0)))))
    points = jnp.array([[40.0, 1.5], [40.0, -1.7], [40.0, 0.0], [40.0, 2.0]])
    expected = [[0.0, -1.0], [0.0, 1.0], [0.0, 0.0], [0.0, 0.0]]  # beyond 0.8 m, and in the wall itself: 0
    np.testing.assert_allclose(slope(points), expected, atol=1e-5)


def test_a_standing_robot_and_one_inside_a_box_have_no_nan_in_their_derivatives():
    env, params = st.make("Subterra/ObstructedShort-v0", estimates=True)
    _, state = env.reset(jax.random.key(0), params)

    def total(action, position):
        obs, after, reward, *_, info = env.step(jax.random.key(1), state.replace(position=position), action, params)
        numbers = [leaf for leaf in jax.tree.leaves((obs, after, reward, info)) if leaf.dtype == jnp.float32]
        return sum(jnp.sum(leaf) for leaf in numbers)

    slope = jax.jit(jax.grad(total, (0, 1)))
    slopes = slope(jnp.zeros(4), state.position)
    assert all(np.isfinite(leaf).all() for leaf in slopes)
    box = jax.jit(env.boxes)(state, params)[0].centre[1]
    slopes = slope(jnp.zeros(4), box)
    assert all(np.isfinite(leaf).all() for leaf in slopes)


def value(env, action, states, noises, params, weights):
    """Weighted sum of all that 1 or 20 steps show, and the reward."""

    def one(state, noise):
        state, reward, *_ = env.advance(state, action, noise, params)
        return state, reward + jnp.sum(weights * env.observe(state, noise, params))

    return jnp.sum(jax.lax.scan(one, states, noises)[1])


def ends(env, action, states, noises, params):
    """Whether an episode ends within these steps."""

    def one(state, noise):
        state, _, terminated, *_ = env.advance(state, action, noise, params)
        return state, terminated

    return jnp.any(jax.lax.scan(one, states, noises)[1])


def relative_errors(task: str, n: int, n_steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives by both numbers of an action against central differences of 64 bits: errors, and where to trust them.

    Away from edges: the episode does not end, and differences of two sizes agree to a tenth of a percent for both
    numbers, so that no beam passes from one wall to another and nothing is clipped in between. The larger one moves the
    robot further than 32 bits round, which may bring a beam near an edge to another wall than 64 bits do.

    Returns:
        Relative errors `(n, 2)`, and whether a state is away from edges `(n,)`.
    """
    env, params = st.make(task)
    batch = st.AutoReset(env)
    keys = jax.random.split(jax.random.key(2), (n, n_steps))
    space = env.action_space(params)
    action = jax.vmap(space.sample)(jax.random.split(jax.random.key(1), n)) * jnp.array(
        [0.3, 0.2 if n_steps < 20 else 0.03]
    ) + jnp.array([1.0, 0])
    # Spread along the tunnel: the states after a drive of 80 steps.
    policy = lambda key, obs: jnp.stack([1.5 + 0.5 * jax.random.normal(key, n), -0.5 * (obs[:, 4] - obs[:, 12])], 1)  # noqa: E731
    obs, state = batch.reset(jax.random.key(0), params, n)
    _, state, _ = st.rollout(batch, policy, jax.random.key(4), obs, state, params, 80)
    noise = jax.vmap(jax.vmap(lambda key: env.draw_step(key, (), params)))(keys)
    weights = jnp.abs(jax.random.normal(jax.random.key(3), (env.observation_size(params),)))
    every = (0, 0, 0, None, None)
    slopes = jax.jit(jax.vmap(jax.grad(functools.partial(value, env)), every))(action, state, noise, params, weights)
    ended = jax.jit(jax.vmap(functools.partial(ends, env), every[:4]))(action, state, noise, params)
    with wide():
        args = jax.tree.map(
            lambda leaf: leaf.astype(float) if leaf.dtype == jnp.float32 else leaf,
            (action, state, noise, params, weights),
        )
        measure = jax.jit(jax.vmap(functools.partial(value, env), every))

        def differences(step: float) -> np.ndarray:
            columns = []
            for moved in step * np.eye(2):
                above, below = (measure(args[0] + sign * moved, *args[1:]) for sign in (1.0, -1.0))
                assert above.dtype == np.float64
                columns.append((above - below) / (2.0 * step))
            return np.stack(columns, axis=1)

        fine, coarse = (differences(step) for step in ((1e-5, 1e-3) if n_steps < 20 else (1e-7, 1e-4)))
    size = np.maximum(np.abs(fine), 1e-3)
    return np.abs(slopes - fine) / size, np.all(np.abs(coarse - fine) < 1e-3 * size, axis=1) & ~ended


@pytest.mark.parametrize(
    ("task", "n", "n_steps"),
    [
        pytest.param("Subterra/StopAt-v0", 100, 3),
        *(
            pytest.param(f"Subterra/{task}-v0", n, n_steps, marks=pytest.mark.slow)
            for task in ("Traverse", "StopAt", "Obstructed")
            for n, n_steps in ((2000, 1), (10_000, 20))
        ),
    ],
)
def test_derivatives_agree_with_central_differences(task, n, n_steps):
    errors, trusted = relative_errors(task, n, n_steps)
    assert trusted.sum() >= min(n // 2, 1000), trusted.mean()
    print(task, n_steps, trusted.sum(), errors[trusted].max(axis=0))
    assert errors[trusted].max() < 0.01


# Transformations


def test_the_methods_run_in_shards_as_alone():
    code = """
import jax, jax.numpy as jnp, numpy as np, subterra_jax as st
from jax.sharding import Mesh, PartitionSpec as P
env, params = st.make("Subterra/FaultedShort-v0")
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


@pytest.fixture(scope="module")
def short() -> tuple[Any, Any, Any]:
    env, params = st.make("Subterra/StopAtShort-v0")
    return env, params, env.reset(jax.random.key(0), params)[1]


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


def count(event: str, function: Any) -> int:
    """How often JAX reports an event while a function runs."""
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
    held = {"speed": jnp.float32(0.5)}
    inner = jax.jit(lambda obs: jnp.zeros((3, 1)) + held["speed"])

    def roll(policy):
        return st.rollout(batch, policy, jax.random.key(1), obs, state, params, 2)[2]["action"][0, 0, 0]

    def policy(key, obs):
        return jnp.concatenate([jnp.zeros((3, 1)) + held["speed"], jnp.zeros((3, 1))], axis=1)

    assert float(roll(policy)) == 0.5
    held["speed"] = jnp.float32(0.75)
    assert count(COMPILES, lambda: roll(policy)) == 0
    assert float(roll(policy)) == 0.75
    assert float(roll(lambda key, obs: policy(key, obs))) == 0.75
    # What a compiled policy holds is part of it.
    first, second = (
        functools.partial(lambda own, key, obs: jnp.concatenate([own(obs), jnp.zeros((3, 1))], axis=1), own)
        for own in (inner, jax.jit(lambda obs: jnp.zeros((3, 1)) + jnp.float32(1.25)))
    )
    assert [float(roll(first)), float(roll(second))] == [0.75, 1.25]


def test_a_second_env_compiles_nothing(short):
    env, params, state = short
    again, others = st.make("Subterra/StopAtShort-v0")
    env.step(jax.random.key(1), state, jnp.ones(2), params)

    def use():
        _, state = again.reset(jax.random.key(0), others)
        again.step(jax.random.key(1), state, jnp.ones(2), others)

    assert count(COMPILES, use) == 0


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
    first = gymnasium.make("Subterra/TraverseShort-v0")
    obs, _ = first.reset(seed=0)

    def second():
        again, _ = gymnasium.make("Subterra/TraverseShort-v0").reset(seed=0)
        np.testing.assert_array_equal(obs, again)

    assert count(COMPILES, second) == 0
    casts, cast = [], lidar.scan
    monkeypatch.setattr(lidar, "scan", lambda *args: casts.append(1) or cast(*args))
    other = gymnasium.make("Subterra/TraverseShort-v0", horizon=3, lidar=LidarParams(n_beams=5))
    assert len(casts) == 2  # by reset and by step
    other.reset(seed=0)
    assert [other.step(np.float32([0.0, 0.0]))[3] for _ in range(3)] == [False, False, True]


def test_programs_are_kept_on_disk_only_where_it_is_asked_for(tmp_path: Path):
    code = (
        "import sys, jax, jax.numpy as jnp, subterra_jax as st\n"
        "before = jax.config.jax_compilation_cache_dir\n"
        "jax.jit(lambda x: x + 1)(1)\n"
        "print(before, st.cache_programs())\n"
        "env, params = st.make('Subterra/TraverseShort-v0')\n"
        "env.reset(jax.random.key(0), params)"
    )
    places = {"XDG_CACHE_HOME": str(tmp_path), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    clean = {name: text for name, text in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-c", code], env={**clean, **places}, capture_output=True, text=True, check=True
    )
    before, folder = done.stdout.split()
    assert before == "None"
    assert Path(folder).is_relative_to(tmp_path / "subterra" / "compiled")
    assert list(Path(folder).iterdir())


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(st.SubterraError, match="cannot be written"):
        st.cache_programs(tmp_path / "file" / "x")


# Shapes


@pytest.mark.parametrize(("estimates", "size"), [(False, 2), (True, 4)])
def test_an_action_of_another_shape_is_refused_in_one_sentence(estimates, size, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # the tests' own checker would come first
    env, params = st.make("Subterra/StopAtShort-v0", estimates=estimates)
    batch = st.AutoReset(env)
    _, one = jax.eval_shape(env.reset, jax.random.key(0), params)
    _, many = jax.eval_shape(lambda: batch.reset(jax.random.key(0), params, 5))
    right = {(size,), (5, size)}
    for shape in {(), (1,), (2,), (3,), (4,), (7,), (5, 1), (5, 7), (5, 2), (5, 4), (4, size), (5, size, 1)} - right:
        for step, state in ((env.step, one), (batch.step, many)):
            with pytest.raises(ValueError, match=rf"{size}.*got an array of shape") as caught:
                jax.eval_shape(step, jax.random.key(0), state, jax.ShapeDtypeStruct(shape, jnp.float32), params)
            assert "\n" not in str(caught.value)
    jax.eval_shape(env.step, jax.random.key(0), one, [0.0] * size, params)  # a list will do


# Tunnels by name and by hand


def test_an_unknown_tunnel_is_told_those_there_are():
    with pytest.raises(
        st.TunnelError, match="subterra-352: no such tunnel file; by name there are subterra-351, metro"
    ):
        st.make("Subterra/Traverse-v0", tunnel="subterra-352")


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda a: {"tangent": -a["tangent"]}, "field 'tangent' is flipped at index 0"),
        (lambda a: {"tangent": np.where(np.arange(len(a["tangent"]))[:, None] == 9, -1, 1) * a["tangent"]}, "index 9"),
        (
            lambda a: {"left_smooth": a["right_smooth"], "right_smooth": a["left_smooth"]},
            "'left_smooth' lies to the other",
        ),
        (lambda a: {"right_pockets": a["left_pockets"]}, "field 'right_pockets' lies to the other side"),
    ],
)
def test_a_file_written_by_hand_is_checked_like_arrays(plan_of, spoil, message):
    arrays = tunnel_arrays(straight(40.0))
    plan_of(arrays)
    with pytest.raises(st.TunnelError, match=message) as caught:
        plan_of({**arrays, **spoil(arrays)})
    assert "\n" not in str(caught.value)
