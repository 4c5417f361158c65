"""Ten lines of control that never read the odometry solve the short task."""

import jax
import jax.numpy as jnp
import numpy as np

import subterra_jax as st


def centre_line(key, obs):
    """PD control on the LiDAR: the side beams tell the offset, the slanted ones the heading."""
    ranges = jnp.minimum(obs[:, :16], 12.0)
    offset = 0.5 * (ranges[:, 4] - ranges[:, 12])
    slant = 0.5 * (ranges[:, 2] - ranges[:, 14])
    yaw_rate = 0.3 * offset + 0.5 * slant
    return jnp.stack([jnp.full_like(yaw_rate, 2.0), yaw_rate], axis=-1)


def test_a_pd_controller_on_the_lidar_always_reaches_the_goal_of_the_short_task():
    env, params = st.make("Subterra/TraverseShort-v1")
    batch = st.AutoReset(env)
    obs, state = jax.jit(lambda key: batch.reset(key, params, 100))(jax.random.key(0))
    run = jax.jit(lambda key, obs, state: st.rollout(batch, centre_line, key, obs, state, params, 330)[2])
    record = run(jax.random.key(1), obs, state)
    ended = np.asarray(record["terminated"] | record["truncated"])
    success = np.asarray(record["info"]["success"])
    assert (ended.sum(axis=0) >= 1).all()
    assert (success == ended).all()
    first = ended.argmax(axis=0)
    coverage = np.asarray(record["info"]["coverage"])[first, np.arange(100)]
    assert ((coverage >= 0.9) & (coverage < 0.91)).all()
