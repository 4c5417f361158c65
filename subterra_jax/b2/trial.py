"""Many B2s on their way at once, each drawn anew, and the figures of the whole."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.baselines.agent import Agent
from subterra_jax.env import TunnelEnv
from subterra_jax.episode import Driver, Episode, Taken
from subterra_jax.state import EnvParams, State

_CHUNK = 25  # steps between two looks at whether any robot is still on its way


@struct.dataclass
class Walk:
    """Robots on their way.

    Attributes:
        state: State of the environment.
        over: The robot has arrived or failed.
        success: The robot has arrived.
        contact: The robot touched a wall.
        fall: The robot fell.
        steps: Steps taken.
    """

    state: State
    over: Bool[Array, "*n"]
    success: Bool[Array, "*n"]
    contact: Bool[Array, "*n"]
    fall: Bool[Array, "*n"]
    steps: Int[Array, "*n"]


def drive(
    env: TunnelEnv,
    params: EnvParams,
    agent: Agent,
    n_robots: int,
    seed: int = 0,
    watch: Callable[[Walk], None] | None = None,
) -> tuple[Walk, Float[np.ndarray, "n"]]:
    """Let robots walk until all have arrived or failed.

    Args:
        env: The task.
        params: Its params.
        agent: The agent that steers.
        n_robots: Number of robots.
        seed: Seed of the first; the others have those after it.
        watch: Called now and then with the robots as they are.

    Returns:
        The robots at their ends, and all lateral offsets on the way, m.
    """
    driver = Driver(env, start=_start, add=_add, keep=_keep)
    now = driver.begin(params, agent, seed + np.arange(n_robots, dtype=np.uint32))
    offsets = []
    for last, kept in driver.drive(params, agent, now, _CHUNK):
        now, lateral = last, np.asarray(kept).ravel()
        offsets.append(lateral[~np.isnan(lateral)])
        if watch is not None:
            watch(_walk(now))
    return _walk(now), np.concatenate(offsets)


def _walk(now: Episode) -> Walk:
    success, contact, fall = now.tally
    return jax.device_get(Walk(now.state, now.over, success, contact, fall, now.state.steps))


def _start(state: State, params: EnvParams) -> tuple[Array, Array, Array]:
    del state, params
    no = jnp.zeros((), bool)
    return no, no, no


def _add(now: Episode, taken: Taken, params: EnvParams) -> tuple[tuple[Array, Array, Array], Array]:
    """Note how the robot fares."""
    del now, params
    flags = (taken.info["success"], taken.info["contact"], taken.info["fall"])
    return flags, taken.terminated | taken.truncated


def _keep(now: Episode, taken: Taken, params: EnvParams) -> Float[Array, ""]:
    """Keep the lateral offset, m; NaN once the episode is over."""
    del params
    return jnp.where(now.over, jnp.nan, taken.after.lateral)


def figures(now: Walk, lateral: Float[np.ndarray, "n"], params: EnvParams) -> dict[str, float]:
    """What came of it: percentages of robots, of the tunnel and of the way, speed (m/s) and offset (m)."""
    begun, period, length = (float(np.asarray(x)) for x in (
        params.start.station, params.vehicle.period, params.tunnel.length
    ))  # fmt: skip
    walked = np.asarray(now.state.station) - begun
    error = (np.asarray(now.state.odometry.distance) - walked) / np.maximum(walked, 1.0)
    share = 100.0 / len(now.over)
    return {
        "robots": float(len(now.over)),
        "success_percent": share * float(np.sum(now.success)),
        "fall_percent": share * float(np.sum(now.fall)),
        "contact_percent": share * float(np.sum(now.contact)),
        "coverage_median_percent": 100.0 * float(np.median(now.state.furthest)) / length,
        "speed_mean": float(np.mean(walked / (np.asarray(now.steps) * period))),
        "lateral_rms": float(np.sqrt(np.mean(np.square(lateral)))),
        "odometer_error_percent": 100.0 * float(np.mean(error)),
        "odometer_error_sigma_percent": 100.0 * float(np.std(error)),
    }
