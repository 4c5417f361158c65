"""How well a gait walks: falls, and how far the velocity is from what was asked for."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from subterra_jax.b2.params import WalkParams
from subterra_jax.b2.walk import WalkEnv

Act = Callable[[Float[Array, "robot obs"]], Float[Array, "robot 12"]]
_STRIDE = 0.4  # s, over which velocities are averaged: the trunk sways with every stride
_SETTLED = 1.0  # s, after which a start no longer counts


def walker(
    env: WalkEnv, act: Act, n_robots: int, n_steps: int, seed: int = 7
) -> Callable[[WalkParams], dict[str, Float[np.ndarray, "..."]]]:
    """What lets robots walk one episode each, pushed and commanded as its params say; compiled once for all of them.

    Args:
        env: The environment; its observation is what `act` sees.
        act: Observations to actions.
        n_robots: How many.
        n_steps: Control periods.
        seed: Of everything that is drawn.

    Returns:
        A function of params, whose result has every step's `velocity` and `asked` `(step, robot, 3)`, and `fall`,
        `over` (the episode had ended before it), `contact` and `effort` `(step, robot)`.
    """
    start_key, walk_key = jax.random.split(jax.random.key(seed))
    begin, advance = jax.vmap(env.begin, in_axes=(0, None)), jax.vmap(env.advance, in_axes=(0, 0, 0, None))
    observe = jax.vmap(lambda state, params: env.observe(state, None, params), in_axes=(0, None))

    @jax.jit
    def run(params: WalkParams) -> dict[str, Array]:
        state = begin(env.draw_reset(start_key, (n_robots,), params), params)

        def step(carry: tuple[Any, Bool[Array, "robot"]], key: Array) -> tuple[Any, dict[str, Array]]:
            state, over = carry
            action = act(observe(state, params))
            noise = env.draw_step(key, (n_robots,), params)
            state, _, fallen, truncated, info = advance(state, action, noise, params)
            kept = {name: info[name] for name in ("velocity", "asked", "fall", "effort", "contact")}
            return (state, over | fallen | truncated), {**kept, "over": over}

        over = jnp.zeros(n_robots, bool)
        return jax.lax.scan(step, (state, over), jax.random.split(walk_key, n_steps))[1]

    return lambda params: {name: np.asarray(values) for name, values in run(params).items()}


def score(records: dict[str, np.ndarray], period: float) -> dict[str, float]:
    """Figures of what a `walker` tells.

    Returns:
        `falls` (share of the robots that fell before the episode's end), `velocity_error` (m/s, mean distance in plan
        between velocity and command), `yaw_rate_error` (rad/s, mean absolute), both averaged over a stride of 0.4 s
        against the slewed command and from 1 s after the start, `contacts` (share of robots that touched a wall),
        `power` (W, mean mechanical), and `robots`.
    """
    alive = ~records["over"]
    width, first = round(_STRIDE / period), round(_SETTLED / period)
    error = _mean(records["velocity"] - records["asked"], width)[first:]
    whole = _mean(alive.astype(np.float32), width)[first:] > 0.999
    plan, turn = np.hypot(error[..., 0], error[..., 1]), np.abs(error[..., 2])
    return {
        "falls": float((records["fall"] & alive).any(axis=0).mean()),
        "velocity_error": float(plan[whole].mean()) if whole.any() else float("nan"),
        "yaw_rate_error": float(turn[whole].mean()) if whole.any() else float("nan"),
        "contacts": float((records["contact"] & alive).any(axis=0).mean()),
        "power": float(records["effort"][alive].mean()),
        "robots": int(alive.shape[1]),
    }


def _mean(values: Float[np.ndarray, "step ..."], width: int) -> Float[np.ndarray, "window ..."]:
    """Means of all windows of so many steps."""
    total = np.cumsum(values, axis=0, dtype=np.float64)
    total = np.concatenate([np.zeros_like(total[:1]), total])
    return (total[width:] - total[:-width]) / width
