"""The environment contract, over every task."""

from pathlib import Path

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.lidar import LidarParams
from subterra_jax.lidar3d.echo import EchoParams
from subterra_jax.lidar3d.space import Mount
from subterra_jax.parts import FaultParams, ImuParams, make_sensor
from subterra_jax.parts.obstacles import ObstacleParams
from subterra_jax.parts.unicycle import VehicleParams
from tests.recorded import check, named

VALUES = Path(__file__).with_name("episodes.csv")
INFO = {"coverage", "station", "lateral", "half_width", "clearance", "contact", "success"}
BEAMS = np.random.default_rng(0).normal(size=(24, 3)) * [1.0, 1.0, 0.4]
SPATIAL = make_sensor(
    BEAMS / np.linalg.norm(BEAMS, axis=1, keepdims=True),
    shape=(4, 6), times=jnp.linspace(-0.1, 0.0, 24), range_min=1.8,
    mount=Mount(0.8, 0.1, 0.02, -0.05, 0.3), echo=EchoParams(weakest=4e-3, mixed=0.9, divergence=0.2, mixing=True),
    sweep=True, intensity=True, doppler=True, texture=1.0,
)  # fmt: skip
HARD = {
    "faults": FaultParams(severity_low=3, dropout_rate=0.2, freeze_rate=0.3), "obstacles": ObstacleParams(),
    "lidar": LidarParams(intensity=True, texture=1.0), "hidden_start": True,
}  # fmt: skip
# Between them they have every part that a task can have, and every channel of a LiDAR.
COVERING = {
    "Traverse": ("Subterra/TraverseShort-v1", {}),
    "Return": ("Subterra/Return-v1", {}),
    "Relocalise": ("Subterra/Relocalise-v1", {}),
    "Faulted and obstructed": ("Subterra/Faulted-v1", HARD),
    "Spatial": ("Subterra/TraverseShort-v1", {"sensor": SPATIAL, "imu": ImuParams(samples=3), "tunnel": "metro"}),
}


@pytest.fixture(scope="module", params=sorted(COVERING))
def task(request):
    id, overrides = COVERING[request.param]
    env, params = st.make(id, **overrides)
    return env, params, jax.jit(env.reset), jax.jit(env.step)


def forward(env):
    """Straight ahead at full speed, with zeros for whatever else an action holds."""
    return jnp.zeros(env.action_size).at[0].set(2.0)


def test_an_entry_that_a_task_lacks_is_no_attribute_and_neither_is_a_misspelt_one():
    env, params = st.make("Subterra/TraverseShort-v1")
    state = jax.eval_shape(env.reset, jax.random.key(0), params)[1]
    for tree in (params, state):
        with pytest.raises(AttributeError, match="has no 'slip'; its parts are"):
            _ = tree.slip
        with pytest.raises(AttributeError, match="no attribute 'odometer'"):
            _ = tree.odometer


@pytest.mark.parametrize("estimates", [False, True])
@pytest.mark.parametrize("id", sorted(id for id in st.TASKS))
def test_every_task_gives_what_the_contract_says(id, estimates):
    env, params = st.make(id, estimates=estimates)
    n_obs = env.observation_size(params)
    obs, state = jax.eval_shape(env.reset, jax.random.key(0), params)
    assert (obs.shape, obs.dtype) == ((n_obs,), jnp.float32)
    obs, after, reward, terminated, truncated, info = jax.eval_shape(
        env.step, jax.random.key(0), state, forward(env), params
    )
    assert (obs.shape, reward.shape, terminated.shape, truncated.shape) == ((n_obs,), (), (), ())
    assert (reward.dtype, terminated.dtype, truncated.dtype) == (jnp.float32, jnp.bool_, jnp.bool_)
    assert set(info) >= INFO
    assert ("estimate_error" in info) == (env.action_size > 2)
    assert jax.tree.structure(state) == jax.tree.structure(after)
    described = [jax.tree.map(lambda x: (x.shape, x.dtype, x.weak_type), tree) for tree in (state, after)]
    assert described[0] == described[1]


@pytest.mark.parametrize("id", sorted(id for id in st.TASKS))
def test_the_parts_of_an_observation_are_named_and_bounded(id):
    env, params = st.make(id)
    parts = list(env.fields(params).values())
    assert parts[0].start == 0
    assert [part.stop for part in parts[:-1]] == [part.start for part in parts[1:]]
    assert env.observation_space(params).shape == (parts[-1].stop,) == (env.observation_size(params),)
    space = env.action_space(params)
    assert space.shape == (env.action_size,)
    np.testing.assert_array_equal(space.high[:2], np.float32([2.0, 1.5]))
    np.testing.assert_array_equal(space.low[:2], np.float32([0.0, -1.5]))


def test_an_episode_is_what_it_was(task, request):
    """Observations, infos and rewards of one way, and the state at its end, are those of before."""
    env, params, reset, step = task
    obs, state = reset(jax.random.key(3), params)
    seen = [(obs, jnp.zeros(()), {})]
    for k in range(12):
        action = forward(env) * (1.0 - 0.05 * k) + 0.3 * jnp.sin(jnp.arange(env.action_size) + k)
        obs, state, reward, *_, info = step(jax.random.key(k), state, action, params)
        seen.append((obs, reward, info))
    flat, rewards, infos = ([one[i] for one in seen] for i in range(3))
    sensed = {name: np.stack([obs[part] for obs in flat]) for name, part in env.fields(params).items()}
    noted = {name: np.stack([info[name] for info in infos[1:]]) for name in infos[1]}
    if sensed.pop("doppler", sensed.pop("intensity", None)) is not None:  # whose noise hashes the last bits of another
        draws = {name: one for name, one in env.draw_step(jax.random.key(1), (), params).items() if one != ()}
        quiet = {name: one.replace(normal=jax.tree.map(jnp.zeros_like, one.normal)) for name, one in draws.items()}
        sensed["quiet"] = jax.jit(env.observe)(state, quiet, params)
    space, known = env.observation_space(params), env.privileged(state, params)
    assert all(((obs >= space.low) & (obs <= space.high)).all() for obs in flat)
    assert space.contains(space.low) & space.contains(space.high)
    here = params.tunnel.pick(state.tunnel)
    known |= {"way": env.rule.shortest_way(state, here, params), "least": env.rule.least_length(params)}
    told = {"sensed": sensed, "reward": np.stack(rewards), "info": noted, "state": named(state), "known": known}
    starts = jax.jit(lambda key: jax.vmap(env.begin, (0, None))(env.draw_reset(key, (32,), params), params))
    told["starts"] = named(starts(jax.random.key(5)))
    told["space"] = {"low": space.low, "high": space.high, "images": env.images(params)}
    told["space"]["drawn"] = jax.vmap(space.sample)(jax.random.split(jax.random.key(0), 7))
    check(VALUES, f"episode {request.node.callspec.params['task']}", told, 3e-4)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30])
def test_actions_that_are_not_numbers_leave_everything_finite(task, bad):
    env, params, reset, step = task
    _, state = reset(jax.random.key(0), params)
    for k in range(3):
        obs, state, reward, *_ = step(jax.random.key(k), state, jnp.full(env.action_size, bad), params)
        assert np.isfinite(np.asarray(obs)).all()
        assert np.isfinite(float(reward))
        assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(state))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"id": "Subterra/Nowhere-v1"}, "no task 'Subterra/Nowhere-v1'"),
        ({"speed": 3.0}, "no field"),
        ({"lidar": LidarParams(n_beams=0)}, "n_beams must be at least 1, got 0"),
        ({"vehicle": VehicleParams(radius=0.81)}, "radius must be in"),
        ({"vehicle": VehicleParams(speed_max=2.01)}, "must leave 0.2 m"),
        ({"lining": "velvet"}, "no lining 'velvet'"),
        ({"id": "Subterra/B2Walk-v1", "sensor": "vlp16"}, "has the sensor 'planar16' alone, got 'vlp16'"),
        ({"id": 5}, "a task is named by its id, as Subterra/StopAt-v1, got 5"),
        ({"tunnel": 5}, "a tunnel is a name, a file, a plan, a Tunnel or a list of these, got 5"),
        ({"parts": [LidarParams()]}, "parts must hold subterra_jax.parts.Part alone, got LidarParams"),
        ({"horizon": 0}, "horizon must be a whole number of steps, at least 1, got 0"),
        ({"horizon": 2.5}, "horizon must be .*, got 2.5"),
        ({"horizon": np.nan}, "horizon must be .*, got nan"),
        ({"horizon": "long"}, "horizon must be .*, got 'long'"),
    ],
)
def test_a_mistake_is_refused_with_its_value(arguments, message, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # the tests' own checker would come first
    with pytest.raises((ValueError, st.TunnelError), match=message):
        st.make(**{"id": "Subterra/TraverseShort-v1", **arguments})


def test_a_ready_tunnel_is_taken_as_it_is_but_not_beyond_its_reach():
    plan = st.load_tunnel().slice(100.0, 80.0)
    tunnel = st.Tunnel.from_plan(plan, "smooth")
    _, params = st.make("Subterra/TraverseShort-v1", tunnel=tunnel)
    assert float(params.tunnel.length) == pytest.approx(80.0)
    with pytest.raises(ValueError, match="ranges up to 30"):
        st.make("Subterra/TraverseShort-v1", tunnel=tunnel, lidar=LidarParams(range_max=50.0))


@pytest.mark.door
@pytest.mark.parametrize(("estimates", "size"), [(False, 2), (True, 4)])
def test_an_action_of_another_shape_is_refused_in_one_sentence(estimates, size, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # the tests' own checker would come first
    env, params = st.make("Subterra/StopAtShort-v1", estimates=estimates)
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


@pytest.mark.door
@pytest.mark.parametrize("count", [0, -1, 2.5, "4", None])
def test_a_batch_of_no_size_and_a_rollout_of_no_length_are_refused(count, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    env, params = st.make("Subterra/TraverseShort-v1")
    batch, key = st.AutoReset(env), jax.random.key(0)
    with pytest.raises(ValueError, match=f"n_envs must be a whole number, at least 1, got {count!r}"):
        batch.reset(key, params, count)
    if count == 0:
        return  # no step at all is a rollout
    obs, state = jax.eval_shape(lambda: batch.reset(key, params, 4))
    with pytest.raises(ValueError, match=f"n_steps must be a whole number, at least 0, got {count!r}"):
        st.rollout(batch, lambda key, obs: jnp.zeros((4, 2)), key, obs, state, params, count)
