"""Params of an environment: gathered from its motion, parts and rule, made arrays, and checked; and their digest.

Every number enters the digest under its dotted path; class names do not enter. Whoever renames a part or a field makes
another digest, and writes it into released policies and cells: the tests list every key and its value.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from flax.core import FrozenDict

from subterra_jax.parts import Part
from subterra_jax.rules import Rule, Start
from subterra_jax.state import EnvParams, as_arrays
from subterra_jax.tunnel import CONTACT_REACH
from subterra_jax.tunnel.blocks import LIDAR_GAP
from subterra_jax.tunnel_env import TunnelEnv


def collect_entries(env: TunnelEnv, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Gather the entries of `EnvParams` that motion, parts and rule of an environment read.

    Args:
        overrides: Entries in place of the defaults.

    Raises:
        ValueError: An override names no entry, or is of another type than the entry.
    """
    entries: dict[str, Any] = {}
    sources: list[Part | Rule] = [env.motion, *env.parts, env.rule]
    for source in sources:
        entries |= source.defaults()
    if unknown := set(overrides) - set(entries):
        raise ValueError(f"no field {sorted(unknown)} in {env.id}; there are {sorted([*entries, 'horizon'])}")
    for name, value in overrides.items():
        needed = type(entries[name])
        if dataclasses.is_dataclass(entries[name]) and not isinstance(value, needed):
            raise ValueError(f"{name} must be {needed.__name__} for {env.id}, got {type(value).__name__}")
    return {**entries, **overrides}


def make_params(env: TunnelEnv, tunnel: Any, horizon: Any, entries: Mapping[str, Any]) -> EnvParams:
    """Make params whose every leaf is a 32-bit array; a weakly typed one would compile each function a second time."""
    return as_arrays(EnvParams(tunnel=tunnel, horizon=horizon, parts=FrozenDict(entries), goal_kind=env.rule.goal_kind))


def check_robot(entries: Mapping[str, Any]) -> None:
    """Refuse, with the value, what the simulator would otherwise get silently wrong.

    Raises:
        ValueError: No beam, or a robot so large or so fast that its LiDAR or its contact would be wrong.
    """
    n_beams, robot = entries["lidar"].n_beams, entries["vehicle"]
    if n_beams < 1:
        raise ValueError(f"n_beams must be at least 1, got {n_beams}")
    if not np.all((np.asarray(robot.radius) > 0.0) & (np.asarray(robot.radius) <= CONTACT_REACH)):
        raise ValueError(f"radius must be in (0, {CONTACT_REACH}] m, got {robot.radius}")
    if np.any(robot.radius - np.asarray(robot.speed_max) * robot.period < LIDAR_GAP - 1e-6):
        raise ValueError(
            f"radius {robot.radius} m less one step of {robot.speed_max} m/s for {robot.period} s must leave "
            f"{LIDAR_GAP} m between LiDAR and walls"
        )


def check_together(env: TunnelEnv, params: EnvParams) -> None:
    """Refuse parts and a rule that do not go together.

    Raises:
        ValueError: Two parts share a name or an observed entry, the rule needs a part that is missing, or its start is
            malformed.
    """
    names = [part.name for part in (env.motion, *env.parts)]
    if twice := {name for name in names if names.count(name) > 1}:
        raise ValueError(f"{env.id}: two parts are called {min(twice)!r}; a name must be one part's own")
    if missing := set(env.rule.needs) - set(names):
        rule = type(env.rule).__name__
        raise ValueError(f"{env.id}: the rule {rule} needs the part {min(missing)!r}; there are {sorted(names)}")
    _check_start(env, params)
    env.fields(params)  # refuses an entry that two of them observe
    for part in env.parts:
        part.check(frozenset(names), params)


def _check_start(env: TunnelEnv, params: EnvParams) -> None:
    """Refuse a start that is not one, naming the rule and what it returned."""

    def start() -> Any:
        draws = env.draw_reset(jax.random.key(0), (), params)
        made = env.rule.start(draws["rule"], params.tunnel.pick(0), params)
        if not isinstance(made, Start):
            raise ValueError(f"{name}.start must return a Start, got {type(made).__name__}")
        return {field.name: getattr(made, field.name) for field in dataclasses.fields(Start)}

    name = f"{env.id}: the rule {type(env.rule).__name__}"
    try:
        shapes = jax.eval_shape(start)
    except TypeError as error:
        raise ValueError(f"{name}.start returned something that is no array ({error})") from error
    for field in ("station", "lateral", "heading", "backwards"):
        if shapes[field].shape != ():
            raise ValueError(f"{name}.start must return one number as {field}, got an array of {shapes[field].shape}")


def check_length(env: TunnelEnv, params: EnvParams) -> None:
    """Refuse a tunnel in which the task has no room.

    Raises:
        ValueError: The tunnel is too short.
    """
    shortest, needed = float(np.min(np.asarray(params.tunnel.length))), env.rule.least_length(params)
    if shortest < needed:
        raise ValueError(f"{env.id} needs a tunnel of {needed:g} m, this one has {shortest:.1f} m")


def task_figures(env: TunnelEnv, params: EnvParams) -> dict[str, Any]:
    """Return the numbers of a task by path, whatever its tunnel, the key of its rule, and the names of its parts."""
    leaves = jax.tree_util.tree_flatten_with_path({"horizon": params.horizon, **params.parts})[0]
    return {
        "rule": env.rule.key,
        "parts": [part.name for part in (env.motion, *env.parts)],
        "beams": params.lidar.n_beams,
        "numbers": {jax.tree_util.keystr(path, simple=True, separator="."): plain(leaf) for path, leaf in leaves},
    }


def plain(leaf: Any) -> Any:
    """Return a number or an array as plain values that JSON writes in one way."""
    return np.round(np.asarray(leaf, np.float64), 9).tolist()


def digest(content: Any) -> str:
    """Return the SHA-256 of plain values."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
