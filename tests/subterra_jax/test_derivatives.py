"""Derivatives through sensors and steps: analytic answers, and central differences of 64 bits."""

import dataclasses
import functools
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax import lidar
from subterra_jax.lidar import LidarParams
from subterra_jax.parts.unicycle import clearance
from tests.subterra_jax.modes import NEEDS_KERNELS, wide
from tests.subterra_jax.tunnels import straight, tunnel_arrays

pytestmark = pytest.mark.door


@pytest.fixture(scope="module")
def corridor(plan_of) -> st.Tunnel:
    return st.Tunnel.from_plan(plan_of(tunnel_arrays(straight(80.0), half_width=2.0)), "smooth")


@pytest.mark.parametrize("fused", [pytest.param(True, marks=NEEDS_KERNELS), False])
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


@pytest.mark.parametrize("fused", [pytest.param(True, marks=NEEDS_KERNELS), False])
def test_a_range_changes_with_the_wall_that_it_meets(corridor, fused):
    there = jnp.float32(0.0), jnp.float32(40.0)

    def range_to_left(walls):
        moved = dataclasses.replace(corridor, box=corridor.box.at[1].add(walls), packed=None)
        scan = lambda y: lidar.scan(moved, jnp.stack([40.0, y]), *there, LidarParams(fused=fused))  # noqa: E731
        return jax.vmap(scan)(jnp.zeros(2))[0, 4]

    assert float(jax.jit(jax.grad(range_to_left))(0.0)) == pytest.approx(1.0, abs=1e-5)


def test_the_clearance_changes_towards_the_nearest_wall(corridor):
    slope = jax.jit(jax.vmap(jax.grad(lambda p: clearance(corridor, p, jnp.float32(40.0)))))
    points = jnp.array([[40.0, 1.5], [40.0, -1.7], [40.0, 0.0], [40.0, 2.0]])
    expected = [[0.0, -1.0], [0.0, 1.0], [0.0, 0.0], [0.0, 0.0]]  # beyond 0.8 m, and in the wall itself: 0
    np.testing.assert_allclose(slope(points), expected, atol=1e-5)


@pytest.mark.slow
def test_a_standing_robot_and_one_inside_a_box_have_no_nan_in_their_derivatives():
    env, params = st.make("Subterra/Obstructed-v1", estimates=True)
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
    """Return whether an episode ends within these steps."""

    def one(state, noise):
        state, _, terminated, *_ = env.advance(state, action, noise, params)
        return state, terminated

    return jnp.any(jax.lax.scan(one, states, noises)[1])


def relative_errors(task: str, n: int, n_steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives by both numbers of an action against central differences of 64 bits: errors, and where to trust them.

    Away from edges: the episode does not end, and differences of two sizes, and those at starts 0.1 mm to each side,
    agree to a tenth of a percent for both numbers, so that no beam passes from one wall to another and nothing is
    clipped in between. In 20 steps at 600 m 32 bits round a position by about as much: a beam that grazes a far wall
    then has a derivative that differs by percents, and one near an edge may meet another wall than in 64 bits.
    """
    env, params = st.make(task, tunnel="open:train:1")  # whose walls have few edges: packaged ones are surveyed
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

        def differences(step: float, aside: tuple[float, ...] = (0.0, 0.0)) -> np.ndarray:
            columns, start = [], args[1].replace(position=args[1].position + 1e-4 * np.array(aside))
            for moved in step * np.eye(2):
                above, below = (measure(args[0] + sign * moved, start, *args[2:]) for sign in (1.0, -1.0))
                assert above.dtype == np.float64
                columns.append((above - below) / (2.0 * step))
            return np.stack(columns, axis=1)

        small, large = (1e-5, 1e-3) if n_steps < 20 else (1e-7, 1e-4)
        fine = differences(small)
        others = [differences(large), *(differences(small, corner) for corner in product((-1.0, 1.0), repeat=2))]
    size = np.maximum(np.abs(fine), 1e-3)
    agree = np.all([np.abs(other - fine) < 1e-3 * size for other in others], axis=(0, 2))
    return np.abs(slopes - fine) / size, agree & ~ended


@pytest.mark.parametrize(
    ("task", "n", "n_steps"),
    [
        pytest.param("Subterra/StopAt-v1", 100, 3),
        *(
            pytest.param(f"Subterra/{task}-v1", n, n_steps, marks=pytest.mark.slow)
            for task in ("Traverse", "StopAt", "Obstructed")
            for n, n_steps in ((2000, 1), (10_000, 20))
        ),
    ],
)
def test_derivatives_agree_with_central_differences(task, n, n_steps):
    errors, trusted = relative_errors(task, n, n_steps)
    assert trusted.sum() >= min(n // 2, 1000), trusted.mean()
    print(task, n_steps, trusted.sum(), errors[trusted].max(axis=0))
    assert errors[trusted].max() < 0.005
