"""Domain randomisation: environments of one batch that differ in any number of their params."""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from subterra_jax.params import check_robot
from subterra_jax.state import EnvParams


@dataclasses.dataclass(frozen=True)
class LogUniform:
    """A range in which every ratio is as likely as any other.

    Attributes:
        low: Least value, above 0.
        high: Largest value.
    """

    low: float
    high: float


Range = tuple[int | float, int | float] | LogUniform


def randomize(
    key: PRNGKeyArray, params: EnvParams, ranges: Mapping[str, Range], n_envs: int
) -> tuple[EnvParams, EnvParams]:
    """Params of a batch of environments, each with its own draw.

        params, axes = randomize(key, params, {"lidar.range_sigma": (0.0, 0.1), "vehicle.speed_max": (1.0, 2.0)}, 1024)
        batch = AutoReset(env, params_axes=axes)

    The draw is made once, for all episodes of an environment; what an episode draws by itself (biases, slip, goals,
    which tunnel of a stack) stays as it is. Everything may vary without slowing the fused kernels of a GPU but the
    tunnel, which is refused: several tunnels belong in one stack.

    Args:
        key: Source of the draws. What is drawn for one name does not depend on the other names.
        params: What all environments share but for the named numbers.
        ranges: By dotted name of a number in `params`: least and largest value, drawn uniformly, or `LogUniform`. Whole
            numbers are drawn with both ends included.
        n_envs: Number of environments.

    Returns:
        The params with `(n_envs, ...)` where a name was given, and the same tree with 0 there and None elsewhere, for
        `AutoReset.params_axes`; it can be hashed, as a static argument must.

    Raises:
        ValueError: A name is unknown, static or part of the tunnel, a range is empty or has a value that the simulator
            cannot honour, or `n_envs` is below 1.
    """
    if n_envs < 1:
        raise ValueError(f"n_envs must be at least 1, got {n_envs}")
    leaves = {name: _find(params, name) for name in ranges}
    bounds = {name: _bounds(name, needed, leaves[name]) for name, needed in ranges.items()}
    _check(params, bounds)
    axes = jax.tree.map(lambda _: None, params)
    for name, leaf in leaves.items():
        own_key = jax.random.fold_in(key, zlib.crc32(name.encode()))
        drawn = _draw(own_key, leaf.dtype, (n_envs, *leaf.shape), *bounds[name], isinstance(ranges[name], LogUniform))
        params, axes = _replace_part(params, name.split("."), drawn), _replace_part(axes, name.split("."), 0)
    return params, axes


def _find(params: EnvParams, name: str) -> Array:
    node: Any = params
    path = name.split(".")
    for depth, part in enumerate(path):
        here = ".".join(path[:depth]) or "the params"
        if node is None:
            raise ValueError(f"no {name!r} to randomise: this task has no {here}")
        fields = _fields(node)
        if part not in fields:
            raise ValueError(f"no {name!r} to randomise: {here} has {', '.join(fields) or 'no parts'}")
        if depth == 0 and part == "tunnel":
            raise ValueError(f"{name!r} cannot be randomised: the tunnel is one for all; stack several instead")
        if not fields[part]:
            raise ValueError(f"{name!r} cannot be randomised: it is static, because the shape of arrays depends on it")
        node = _entry(node, part)
    if node is None or dataclasses.is_dataclass(node):
        raise ValueError(f"{name!r} is no number" if node is not None else f"this task has no {name!r} to randomise")
    return jnp.asarray(node)


def _entry(node: Any, name: str) -> Any:
    return node.parts[name] if isinstance(node, EnvParams) and name in node.parts else getattr(node, name)


def _fields(node: Any) -> dict[str, bool]:
    """Names in a part of the params, and whether each is data; a static one fixes the shape of arrays."""
    if isinstance(node, EnvParams):
        return dict.fromkeys(("tunnel", "horizon", *node.parts), True)
    if not dataclasses.is_dataclass(node):
        return {}
    return {field.name: field.metadata.get("pytree_node", True) for field in dataclasses.fields(node)}


def _bounds(name: str, needed: Range, leaf: Array) -> tuple[int | float, int | float]:
    """Least and largest value of a range, or what is wrong with it."""
    log = isinstance(needed, LogUniform)
    low, high = (needed.low, needed.high) if isinstance(needed, LogUniform) else needed
    if not (np.isfinite(low) and np.isfinite(high) and low <= high):
        raise ValueError(f"range of {name!r} must be finite and not empty, got {low} to {high}")
    if log and low <= 0.0:
        raise ValueError(f"log-uniform range of {name!r} must be above 0, got {low} to {high}")
    if jnp.issubdtype(leaf.dtype, jnp.integer) and (log or low != int(low) or high != int(high)):
        raise ValueError(f"range of {name!r} must be uniform and of whole numbers, got {low} to {high}")
    return low, high


def _check(params: EnvParams, bounds: dict[str, tuple[int | float, int | float]]) -> None:
    def extremes(name: str) -> tuple[Any, Any]:
        value = np.asarray(_find(params, name))
        return bounds.get(name, (value.min(), value.max()))

    furthest = extremes("lidar.range_max")[1]
    if furthest > params.tunnel.reach + 1e-6:
        raise ValueError(
            f"'lidar.range_max' goes up to {furthest:g} m, but the tunnel was made for {params.tunnel.reach:g} m"
        )
    radius, (_, speed), (_, period) = (extremes(f"vehicle.{name}") for name in ("radius", "speed_max", "period"))
    robot = params.vehicle.replace(radius=np.array(radius), speed_max=speed, period=period)
    check_robot({"lidar": params.lidar, "vehicle": robot})


def _draw(
    key: PRNGKeyArray, dtype: Any, shape: tuple[int, ...], low: int | float, high: int | float, log: bool
) -> Array:
    if jnp.issubdtype(dtype, jnp.integer):
        return jax.random.randint(key, shape, int(low), int(high) + 1, dtype)
    if log:
        return jnp.clip(jnp.exp(jax.random.uniform(key, shape, dtype, np.log(low), np.log(high))), low, high)
    return jax.random.uniform(key, shape, dtype, low, high)


def _replace_part(node: Any, path: list[str], value: Any) -> Any:
    if len(path) > 1:
        value = _replace_part(_entry(node, path[0]), path[1:], value)
    return node.replace(**{path[0]: value})
