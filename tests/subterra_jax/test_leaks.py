"""Nobody knows what he has not measured: the leak tests of the task design."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental import checkify
from jaxtyping import Array, Float, Int, PRNGKeyArray

import subterra_jax as st
from subterra_jax.baselines.registry import make_agent, names
from subterra_jax.evaluation import evaluate, listed_episodes
from subterra_jax.evaluation.floor import floor, within
from tests.subterra_jax.panel import panel

N = 200
AGENTS = ("fused", "oracle", "random")


def odometry_bound(params) -> float:
    """Success of a stop by the odometer alone, in closed form: bias, wandering error and noise of each step."""
    goal, odometry = params.goal, params.odometry
    furthest = min(float(goal.high), float(params.tunnel.length) - 2.0 * float(goal.margin))
    distance = np.linspace(float(goal.low), furthest, 200)
    sigma, length = float(odometry.wander.sigma), float(odometry.wander.length)
    wandered = 2.0 * sigma**2 * length * (distance + length * np.expm1(-distance / length))
    noise = float(odometry.distance_sigma) ** 2 / float(params.vehicle.speed_max * params.vehicle.period) * distance
    variance = (float(odometry.distance_bias_sigma) * distance) ** 2 + wandered + noise
    return within(float(goal.tolerance), np.sqrt(variance))


def three_errors(bound: float, n: int = N) -> float:
    """Three standard errors of a success rate of n episodes."""
    return 3.0 * np.sqrt(bound * (1.0 - bound) / n)


@pytest.fixture(scope="module")
def control():
    """The short stop where no wall tells a station: a way to drive it, and its bound."""
    env, params = st.make("Subterra/StopAtShort-v1", tunnel="control")
    agents = [make_agent(name, params) for name in AGENTS]
    episodes = listed_episodes(env, params, N)

    def success(name, **corrupted):
        return evaluate(env, params, panel(agents, AGENTS.index(name), **corrupted), episodes).success.mean()

    return success, floor(params)


def test_fusing_both_stops_as_often_as_theory_says_and_no_more(control):
    success, bound = control
    assert abs(success("fused") - bound) < three_errors(bound)


def test_who_drives_at_random_is_not_above_the_fused_bound_which_is_one_of_knowing_not_of_driving(control):
    success, bound = control
    assert success("random") < bound + three_errors(bound)
    assert success("oracle") == 1.0  # the truth stops always


def test_who_is_always_told_the_same_goal_stops_as_often_as_chance_has_it(control):
    success, _ = control
    # Goals lie anywhere in 50 m and more, and a stop counts within 0.25 m on either side.
    chance = 0.5 / 50.0
    assert success("oracle", goal=175.0) < chance + three_errors(chance)


def test_who_gets_the_beams_in_the_wrong_order_cannot_traverse():
    env, params = st.make("Subterra/TraverseShort-v1")
    agents, episodes = [make_agent("dead-reckoning", params)], listed_episodes(env, params, 50)
    order = np.random.default_rng(0).permutation(16)
    assert evaluate(env, params, panel(agents), episodes).success.all()
    assert evaluate(env, params, panel(agents, order=order), episodes).success.mean() < 0.2


@pytest.mark.timeout(900)
@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(names()) - {"oracle"}))
def test_on_the_control_tunnel_nobody_beats_fused_dead_reckoning_by_three_points(name):
    env, params = st.make("Subterra/StopAt-v1", tunnel="control", lining="smooth")
    bound = floor(params)
    agent = make_agent(name, params)
    success = evaluate(env, params, agent, listed_episodes(env, params, N)).success.mean()
    print(f"{name}: {100 * success:.1f} %, bound {100 * bound:.1f} %")
    assert success <= bound + 0.03 + three_errors(bound)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "name", "bound"),
    [("StopAt", "dead-reckoning", odometry_bound), ("StopAt", "fused", floor), ("Traverse", "fused", lambda _: 1.0)],
)
def test_over_the_whole_list_dead_reckoning_lands_at_its_bounds(task, name, bound):
    env, params = st.make(f"Subterra/{task}-v1", tunnel="subterra-351")
    expected = bound(params)
    success = evaluate(env, params, make_agent(name, params), listed_episodes(env, params)).success.mean()
    print(f"{name}: {100 * success:.1f} %, bound {100 * expected:.1f} %")
    assert abs(success - expected) <= three_errors(expected, 500)


_EXTREMES = (np.nan, np.inf, -np.inf, 3e38, -3e38, 0.0, -0.0, 1e-38)
_CHUNK = 100
_CHECKED_ENVS, _CHECKED_STEPS = 8, 50


def wild_actions(key: PRNGKeyArray, n_envs: int, low: np.ndarray, high: np.ndarray) -> Float[Array, "n_envs n_action"]:
    """Draws actions: a third inside the box, a third up to ten times outside it, a third extreme.

    In every eighth environment all actions lie inside, so that some episodes last long.
    """
    shape = (n_envs, len(low))
    inside_key, outside_key, kind_key, which_key = jax.random.split(key, 4)
    inside = low + (high - low) * jax.random.uniform(inside_key, shape)
    outside = 10.0 * np.maximum(np.abs(low), np.abs(high)) * jax.random.uniform(outside_key, shape, minval=-1.0)
    extreme = jnp.asarray(_EXTREMES, jnp.float32)[jax.random.randint(which_key, shape, 0, len(_EXTREMES))]
    kind = jnp.where((jnp.arange(n_envs) % 8 == 0)[:, None], 0, jax.random.randint(kind_key, shape, 0, 3))
    return jnp.where(kind == 0, inside, jnp.where(kind == 1, outside, extreme))


def _violations(
    state: Any, obs: Float[Array, "n_envs n_obs"], reward: Float[Array, "n_envs"], low: np.ndarray, high: np.ndarray
) -> dict[str, Int[Array, ""]]:
    """Counts wrong numbers by name."""
    leaves = jax.tree_util.tree_flatten_with_path(state)[0]
    counts = {
        f"state{jax.tree_util.keystr(path)} not finite": jnp.sum(~jnp.isfinite(leaf))
        for path, leaf in leaves
        if jnp.issubdtype(leaf.dtype, jnp.floating)
    }
    # Written so that a NaN counts as outside.
    counts["observation outside its space"] = jnp.sum(~((obs >= low) & (obs <= high)))
    counts["observation not finite"] = jnp.sum(~jnp.isfinite(obs))
    counts["reward not finite"] = jnp.sum(~jnp.isfinite(reward))
    return counts


def soak(env: st.TunnelEnv, params: st.EnvParams, n_envs: int, n_steps: int, seed: int) -> dict[str, int]:
    """Counts violations by name in at least `n_steps` environment steps; empty where there are none."""
    batch, space, actions = st.AutoReset(env), env.observation_space(params), env.action_space(params)

    @jax.jit
    def chunk(key: PRNGKeyArray, state: Any, params: st.EnvParams) -> tuple[Any, dict[str, Int[Array, ""]]]:
        def step(state: Any, key: PRNGKeyArray) -> tuple[Any, dict[str, Int[Array, ""]]]:
            action_key, step_key = jax.random.split(key)
            action = wild_actions(action_key, n_envs, actions.low, actions.high)
            obs, state, reward, _, _, info = batch.step(step_key, state, action, params)
            both = jnp.concatenate([obs, info["final_observation"]])
            return state, _violations(state, both, reward, space.low, space.high)

        state, counts = jax.lax.scan(step, state, jax.random.split(key, _CHUNK))
        return state, jax.tree.map(jnp.sum, counts)

    key = jax.random.key(seed)
    state = jax.jit(lambda key, params: batch.reset(key, params, n_envs)[1])(key, params)
    total: dict[str, int] = {}
    for i in range(-(-n_steps // (n_envs * _CHUNK))):
        state, counts = chunk(jax.random.fold_in(key, i + 1), state, params)
        for name, count in jax.device_get(counts).items():
            total[name] = total.get(name, 0) + int(count)
    return {name: count for name, count in total.items() if count}


def first_complaint(env: st.TunnelEnv, params: st.EnvParams, seed: int) -> str | None:
    """Returns checkify's first complaint about a reset and some steps: NaN, division by 0 or index out of range."""
    actions = env.action_space(params)

    def drive(key: PRNGKeyArray, params: st.EnvParams) -> Array:
        obs, state = jax.vmap(env.reset, (0, None))(jax.random.split(key, _CHECKED_ENVS), params)

        def step(carry: tuple[Any, Array], key: PRNGKeyArray) -> tuple[tuple[Any, Array], None]:
            action_key, step_key = jax.random.split(key)
            action = wild_actions(action_key, _CHECKED_ENVS, actions.low, actions.high)
            keys = jax.random.split(step_key, _CHECKED_ENVS)
            obs, state, *_ = jax.vmap(env.step, (0, 0, 0, None))(keys, carry[0], action, params)
            return (state, obs), None

        return jax.lax.scan(step, (state, obs), jax.random.split(key, _CHECKED_STEPS))[0][1]

    errors = checkify.float_checks | checkify.index_checks
    error, _ = jax.jit(checkify.checkify(drive, errors=errors))(jax.random.key(seed), params)
    return error.get()


@pytest.mark.slow
@pytest.mark.parametrize("task", st.TASKS)
def test_every_task_is_clean_under_wild_actions_and_checkify(task):
    env, params = st.make(task, estimates=True)
    assert first_complaint(env, params, seed=0) is None
    assert soak(env, params, 1000, 200_000, seed=1) == {}
