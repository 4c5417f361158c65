"""Starts and goals that a caller chooses: Gymnasium's `reset(options={"goal": 40.0, "start": 5.0})`."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from subterra_jax.host.errors import SubterraError
from subterra_jax.parts.unicycle import clearance, in_contact
from subterra_jax.rules import Choice
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel import at_station
from subterra_jax.tunnel_env import TunnelEnv

_PLACE = ("station", "lateral", "heading")


class OptionError(SubterraError, ValueError):
    """An episode cannot begin as the options ask."""


def read_choice(env: TunnelEnv, params: EnvParams, options: Mapping[str, Any] | None) -> Choice | None:
    """Read the options of a reset.

    Args:
        env: The environment.
        params: Its params.
        options: `start`: a station (m), or a mapping with `station` (m), `lateral` (m to the left of the centreline)
            and `heading` (rad against the centreline); `goal`: a station (m). What is left out is drawn.

    Returns:
        Numbers, float32, NaN for what is drawn; `None` where nothing is chosen.

    Raises:
        OptionError: The task has no such thing, or a value is no number or outside of the tunnel.
    """
    if not options:
        return None
    if unknown := sorted(set(options) - {"goal", "start"}):
        raise OptionError(f"no option {unknown[0]!r} in a reset of {env.id}; there are 'goal' and 'start'")
    start = options.get("start", {})
    start = start if isinstance(start, Mapping) else {"station": start}
    if unknown := sorted(set(start) - set(_PLACE)):
        raise OptionError(f"no {unknown[0]!r} in options['start']; there are {', '.join(_PLACE)}")
    if "goal" in options and not env.rule.chooses_goal:
        raise OptionError(f"{env.id} has no goal to choose; its options may hold 'start' alone")
    wishes = {f"options['start']['{name}']": start.get(name) for name in _PLACE} | {
        "options['goal']": options.get("goal")
    }
    station, lateral, heading, goal = (_number(name, wish) for name, wish in wishes.items())
    length = float(np.min(np.asarray(params.tunnel.length)))
    _check_within("options['start']", station, 0.0, length)
    _check_within("a heading in options['start']", heading, -np.pi, np.pi, "rad")
    if env.rule.chooses_goal:
        margin = float(np.max(np.asarray(params.goal.margin)))
        _check_within("options['goal']", goal, margin, length - margin)
    return Choice(station, lateral, heading, goal)


def reset_chosen(
    env: TunnelEnv, key: PRNGKeyArray, params: EnvParams, choice: Choice
) -> tuple[Float[Array, "n_obs"], State, Bool[Array, ""]]:
    """Begin an episode as `TunnelEnv.reset` does with the same key, but for what was chosen.

    Returns:
        First observation, state, and whether the robot stands clear of walls and obstacles.
    """
    start_key, scan_key = jax.random.split(key)
    state = env.begin({**env.draw_reset(start_key, (), params), "choice": choice}, params)
    obs = env.observe(state, env.draw_step(scan_key, (), params), params)
    tunnel = params.tunnel.pick(state.tunnel)
    gap = clearance(tunnel, state.position, state.station)
    for part in env.parts:
        beside = part.clearance(state.parts[part.name], state.position, state.station, tunnel, params)
        gap = jnp.minimum(gap, beside)
    inside = jnp.abs(state.lateral) <= at_station(tunnel, state.station)[4] - params.vehicle.radius
    return obs, state, inside & ~in_contact(tunnel, gap, state.station, params.vehicle)


def check_clear(clear: Any, choice: Choice) -> None:
    """Refuse a start in a wall or an obstacle.

    Raises:
        OptionError: Naming the start.
    """
    if not clear:
        side = "" if np.isnan(choice.lateral) else f", {choice.lateral:g} m to the left of the centreline"
        place = "the drawn station" if np.isnan(choice.station) else f"{choice.station:g} m"
        raise OptionError(f"options['start']: at {place}{side} the robot would touch a wall or an obstacle")


def _number(name: str, wish: Any) -> np.ndarray:
    """Return a wish as one float32 number; NaN for none."""
    try:
        return np.asarray(np.nan if wish is None else wish, np.float32).reshape(())
    except (TypeError, ValueError):
        raise OptionError(f"{name} must be one number, got {wish!r}") from None


def _check_within(name: str, value: np.ndarray, low: float, high: float, unit: str = "m") -> None:
    if not np.isnan(value) and not low - 1e-6 <= value <= high + 1e-6:
        raise OptionError(f"{name} must lie from {low:.2f} to {high:.2f} {unit} here, got {value:g}")
