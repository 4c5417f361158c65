"""The walking environment in MJX."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.b2 import constants as b2
from subterra_jax.b2.observation import locate
from subterra_jax.physics.rotations import rotate
from tests.recorded import check, named
from tests.subterra_jax.b2.conftest import N_ROBOTS


def run(walking, seconds, params, seed=0):
    """Zero actions for a while; last state, and what every step reported."""
    _, state = walking.reset(seed, params)
    outcome = []
    for k in range(round(seconds / 0.02)):
        _, state, _, terminated, _, info = walking.step(1000 * seed + k, state, params=params)
        outcome.append({"terminated": terminated, **info})
    return state, {name: np.stack([step[name] for step in outcome]) for name in outcome[0]}


def test_under_no_command_the_zero_action_stands_on_sleepers(walking):
    _, outcome = run(walking, 2.0, walking.commanded((0.0, 0.0, 0.0)))
    assert not outcome["terminated"].any()
    settled = outcome["station"][60:]  # once the feet have found the ballast
    assert np.abs(settled - settled[0]).max() < 0.05


def test_the_zero_action_walks_over_sleepers_at_three_quarters_of_what_is_asked(walking):
    """The trot without its policy; one in six stumbles and has half of it, see `test_policy`."""
    state, outcome = run(walking, 4.0, walking.commanded((0.6, 0.0, 0.0)))
    assert not outcome["terminated"].any()
    speed = (outcome["station"][-1] - outcome["station"][99]) * np.asarray(state.facing) / 2.0
    assert speed.mean() == pytest.approx(0.45, abs=0.05)
    assert np.median(speed) == pytest.approx(0.45, abs=0.04)
    assert (np.abs(speed - 0.4) < 0.25).all()
    assert np.abs(np.asarray(state.body.qpos[:, :2])).max() < 1.5


def test_a_new_command_comes_once_in_its_hold_on_average(walking):
    often = walking.params.replace(command=walking.params.command.replace(hold=jnp.float32(0.2)))
    _, state = walking.reset(3, often)
    came = []
    for k in range(50):
        before = np.asarray(state.drawn_command)
        _, state, *_ = walking.step(900 + k, state, params=often)
        came.append((np.asarray(state.drawn_command) != before).any(axis=1))
    assert 0.05 < np.mean(came) < 0.18  # a tenth of 400, less those that ask to stand twice


def test_terms_of_the_reward_sum_to_the_reward_and_the_info_has_the_contract_s_keys(walking):
    _, state = walking.reset(1)
    _, _, reward, _, _, info = walking.step(1, state)
    paid = sum(np.asarray(value) for name, value in info.items() if name.startswith("reward_"))
    np.testing.assert_allclose(reward, paid, rtol=1e-5)
    assert {"coverage", "station", "lateral", "contact", "success", "fall", "final_observation"} <= info.keys()
    for k in range(4):
        told = walking.step(k, state, 0.5 * jnp.sin(jnp.arange(12.0) + k) * jnp.ones((N_ROBOTS, 1)))
        state = told[1]
    check(__file__, "steps", named(told), 2e-3)


def test_the_observation_has_the_size_and_the_parts_it_claims(walking):
    obs, _ = walking.reset(4)
    assert obs.shape == (N_ROBOTS, walking.env.observation_size(walking.params))
    fields = walking.env.fields(walking.params)
    assert max(part.stop for part in fields.values()) == obs.shape[1]
    np.testing.assert_allclose(np.linalg.norm(obs[:, fields["gravity"]], axis=1), 1.0, atol=0.1)
    np.testing.assert_allclose(obs[:, fields["action"]], 0.0)


def test_resets_lie_all_along_the_tunnel_and_face_both_ways(walking):
    states = [walking.reset(seed)[1] for seed in range(8)]
    anchors = np.concatenate([state.anchor for state in states]) * 0.6
    facing = np.concatenate([state.facing for state in states])
    assert anchors.min() > 24.0
    assert anchors.max() < 351.0 - 24.0
    assert np.ptp(anchors) > 200.0
    assert 10 < (facing > 0).sum() < 54


def test_robots_differ_within_their_ranges(walking):
    _, state = walking.reset(5)
    for values, (low, high) in ((state.build.friction, (0.4, 1.0)), (state.build.mass, (0.8, 1.05))):
        assert np.ptp(np.asarray(values)) > 0.0
        assert low <= np.asarray(values).min() <= np.asarray(values).max() <= high


def test_a_fall_terminates_and_the_next_episode_begins_elsewhere(walking):
    _, state = walking.reset(6)
    sunk = dataclasses.replace(state, body=dataclasses.replace(state.body, qpos=state.body.qpos.at[0, 2].add(-0.35)))
    _, after, reward, terminated, truncated, info = walking.step(6, sunk)
    np.testing.assert_array_equal(terminated, [True] + [False] * (N_ROBOTS - 1))
    assert not truncated.any()
    assert float(info["reward_fall"][0]) == float(walking.params.reward.fall)
    assert int(after.steps[0]) == 0
    assert int(after.anchor[0]) != int(state.anchor[0])
    assert int(after.steps[1]) == 1
    assert float(reward[0]) < float(reward[1])


def test_the_horizon_truncates_as_a_success(walking):
    params = dataclasses.replace(walking.params, horizon=jnp.int32(1))
    _, state = walking.reset(7)
    _, _, _, terminated, truncated, info = walking.step(7, state, params=params)
    assert truncated.all()
    assert not terminated.any()
    assert info["success"].all()


def test_a_nan_in_the_action_is_read_as_nothing(walking):
    _, state = walking.reset(8)
    zero = walking.step(8, state)[0]
    corrupted = walking.step(8, state, jnp.full((N_ROBOTS, 12), jnp.nan))[0]
    np.testing.assert_array_equal(zero, corrupted)


def test_random_extreme_actions_leave_no_nan(walking):
    _, state = walking.reset(9)
    for k in range(50):
        action = jnp.sign(jax.random.normal(jax.random.key(k), (N_ROBOTS, 12)))
        obs, state, reward, _, _, info = walking.step(k, state, action)
    assert np.isfinite(obs).all()
    assert np.isfinite(reward).all()
    assert np.isfinite(info["final_observation"]).all()


def test_a_robot_that_leaves_the_numbers_is_a_fall_and_corrupts_nobody(walking):
    _, state = walking.reset(10)
    wild = dataclasses.replace(state, body=dataclasses.replace(state.body, qvel=state.body.qvel.at[0].set(1e30)))
    obs, _, reward, terminated, _, _ = walking.step(10, wild)
    assert bool(terminated[0])
    assert np.isfinite(obs).all()
    assert np.isfinite(reward).all()


@jax.jit
def moved_aside(track, state, lateral):
    """Return the robots moved aside to a lateral offset, m."""
    turned = track.quaternion[state.anchor]
    aim = jax.vmap(rotate, in_axes=(0, None))(turned, jnp.array([0.0, 1.0, 0.0]))
    away = lateral - jax.vmap(locate)(state.body, turned).lateral
    aside = state.body.qpos.at[:, :3].add(away[:, None] * aim)
    return dataclasses.replace(state, body=dataclasses.replace(state.body, qpos=aside))


def test_a_wall_is_told_as_contact(walking):
    _, state = walking.reset(11)
    assert walking.step(11, moved_aside(walking.params.track, state, 2.7))[5]["contact"].all()
    assert not walking.step(11, state)[5]["contact"].any()


def test_a_wall_stops_a_robot_that_is_told_to_walk_through_it(walking):
    params = walking.commanded((0.0, 0.3, 0.0))
    _, state = walking.reset(12, params)
    state, reached, touched = moved_aside(walking.params.track, state, 2.3 * state.facing), [], False
    for k in range(150):
        _, state, _, _, _, info = walking.step(k, state, params=params)
        reached.append(np.abs(info["lateral"]))
        touched = touched or bool(info["contact"].any())
    assert touched
    assert np.max(reached[0]) < 2.4
    assert 2.45 < np.max(reached) < 2.825 - 0.1


def test_a_misspelt_field_is_refused_by_name():
    with pytest.raises(ValueError, match="no field \\['horizn'\\] in WalkParams"):
        st.make("Subterra/B2Walk-v1", horizn=3)


def test_contacts_and_rows_stay_as_few_as_they_are_meant_to_be(walking):
    data = walking.env.physics.blank
    assert data._impl.contact.dist.shape[0] == 4 * 2 + 2
    assert data._impl.nefc == 12 + 4 * 8 + 2
    assert walking.env.physics.host.body("base_link").mass[0] == pytest.approx(b2.TRUNK.mass)
