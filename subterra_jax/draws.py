"""The random numbers of a reset and of a step: only those that a task's parts need."""

import dataclasses

import jax
from jaxtyping import PRNGKeyArray

from subterra_jax import faults, slip
from subterra_jax.state import EnvParams, ResetNoise, StepNoise

Batch = tuple[int, ...]


def draw_reset(key: PRNGKeyArray, batch: Batch, params: EnvParams) -> ResetNoise:
    """Random numbers for a batch of resets; row i does not depend on the size of the batch."""
    start_key, bias_key, tunnel_key, slip_key, goal_key, station_key, seed_key, severity_key = jax.random.split(key, 8)
    noise = ResetNoise(
        start=jax.random.uniform(start_key, (*batch, 2), minval=-1.0),
        bias=jax.random.normal(bias_key, (*batch, params.odometry.n_reset_noise)),
    )
    if params.tunnel.count > 1:
        noise = dataclasses.replace(noise, tunnel=jax.random.uniform(tunnel_key, batch))
    if params.slip is not None:
        noise = dataclasses.replace(noise, slip=jax.random.normal(slip_key, (*batch, slip.N_RESET_NOISE)))
    if params.goal is not None:
        noise = dataclasses.replace(
            noise,
            goal=jax.random.uniform(goal_key, (*batch, 3)),
            station=jax.random.normal(station_key, batch),
        )
    if params.obstacles is not None or params.faults is not None:
        noise = dataclasses.replace(noise, seed=jax.random.bits(seed_key, (*batch, 2)))
    if params.faults is not None:
        noise = dataclasses.replace(noise, severity=jax.random.uniform(severity_key, batch))
    return noise


def draw_step(key: PRNGKeyArray, batch: Batch, params: EnvParams) -> StepNoise:
    """Random numbers for one step of a batch; row i does not depend on the size of the batch."""
    n_odometry, n_beams = params.odometry.n_step_noise, params.lidar.n_beams
    n_slip = 0 if params.slip is None else slip.N_STEP_NOISE
    normal = jax.random.normal(key, (*batch, n_odometry + n_beams + n_slip))
    noise = StepNoise(odometry=normal[..., :n_odometry], ranges=normal[..., n_odometry : n_odometry + n_beams])
    if n_slip:
        noise = dataclasses.replace(noise, slip=normal[..., n_odometry + n_beams :])
    if params.faults is not None:
        uniform = jax.random.uniform(jax.random.fold_in(key, 1), (*batch, faults.n_step_noise(n_beams)))
        noise = dataclasses.replace(noise, faults=uniform)
    return noise
