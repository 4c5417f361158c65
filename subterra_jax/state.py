"""Params (what a task is) and state (what changes) of an environment: a few fields of its own, and those of its parts.

`params.odometry`, `state.slip`: what the package's own parts and rules have is an attribute, and a misspelt one is
found by a type checker. What a part or a rule from outside has is an entry of `parts`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any, Generic, TypeVar, overload

import jax
import jax.numpy as jnp
import numpy as np
from flax.core import FrozenDict
from jaxtyping import Array, Float, Int

from subterra_jax.rows import vary_like
from subterra_jax.tunnel import Tunnel


def as_array(value: Any, like: Any = None) -> Any:
    """Make a number an array of 32 bits with a type of its own: a weakly typed one would compile a function anew.

    Args:
        value: A number or an array; anything else is returned unchanged, and so is an array of random keys.
        like: Array whose type is needed; None makes integers int32 and everything else float32.

    Raises:
        ValueError: Integers are needed and a Python number is none.
    """
    wants_whole = like is not None and jnp.issubdtype(like.dtype, jnp.integer)
    if wants_whole and isinstance(value, float) and not value.is_integer():
        raise ValueError(f"a whole number is needed, got {value}")
    if not isinstance(value, _NUMBERS) or jax.dtypes.issubdtype(jnp.result_type(value), jax.dtypes.extended):
        return value
    whole = jnp.issubdtype(jnp.result_type(value), jnp.integer)
    needed = (jnp.int32 if whole else jnp.float32) if like is None else like.dtype
    return jax.lax.convert_element_type(value, needed)


def as_arrays(tree: Any) -> Any:
    """Make every leaf an array of 32 bits, as `as_array` does; a tuple of numbers becomes one array."""
    one = lambda leaf: as_array(np.asarray(leaf) if isinstance(leaf, tuple) else leaf)  # noqa: E731
    return jax.tree.map(one, tree, is_leaf=lambda leaf: isinstance(leaf, tuple) and leaf != ())


def make_alike(tree: Any) -> Any:
    """Give each leaf a type of its own of at most 32 bits and, inside `jax.shard_map`, all leaves the same axes.

    A `lax.scan` asks for both of what it carries.
    """

    def one(leaf: Any) -> Any:
        kind = jnp.result_type(leaf)
        if jax.dtypes.issubdtype(kind, jax.dtypes.extended):
            return leaf
        wide = kind.itemsize == 8 and not jnp.issubdtype(kind, jnp.complexfloating)
        return jax.lax.convert_element_type(leaf, f"{kind.name[:-2]}32" if wide else kind)

    return vary_like(jax.tree.map(one, tree))


_NUMBERS: Any = (bool, int, float, np.ndarray, np.generic, jax.Array)


def _like(old: Any, new: Any) -> Any:
    """Make the numbers of a new value arrays of the old one's types; a tree of axes, which has no arrays, stays."""
    if not any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(old)):
        return new
    if jax.tree.structure(old) == jax.tree.structure(new):  # type: ignore[operator]
        return jax.tree.map(lambda was, leaf: as_array(leaf, was) if isinstance(was, jax.Array) else leaf, old, new)
    return jax.tree.map(as_array, new)


class _Named:
    """Fields, and entries of the field `parts`."""

    parts: Mapping[str, Any]

    def replace(self, **updates: Any) -> Any:
        """Return a copy with other fields, or other parts of names that are there.

        Python numbers become arrays of the types that were there, so that what is compiled for the old fields serves
        the new ones.

        Raises:
            ValueError: There is no such field or part, or a whole number is needed.
        """
        own = {field.name for field in dataclasses.fields(self)}  # type: ignore[arg-type]
        if unknown := set(updates) - own - set(self.parts):
            raise ValueError(
                f"no {sorted(unknown)} in {type(self).__name__}; there are {sorted(own | set(self.parts))}"
            )
        fields = {name: _like(getattr(self, name), value) for name, value in updates.items() if name in own}
        parts = {name: _like(self.parts[name], value) for name, value in updates.items() if name not in own}
        if parts:
            kind: Any = type(self.parts)
            fields["parts"] = kind({**fields.get("parts", self.parts), **parts})
        return dataclasses.replace(self, **fields)  # type: ignore[type-var]


_T = TypeVar("_T")


class _Entry(Generic[_T]):
    """An entry of `parts` that is read as an attribute. Those of another task are no attributes."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    @overload
    def __get__(self, instance: None, owner: type) -> _Entry[_T]: ...

    @overload
    def __get__(self, instance: _Named, owner: type) -> _T: ...

    def __get__(self, instance: _Named | None, owner: type) -> _Entry[_T] | _T:
        if instance is None:
            return self
        if self._name not in instance.parts:
            raise AttributeError(f"{owner.__name__} has no {self._name!r}; its parts are {sorted(instance.parts)}")
        return instance.parts[self._name]


class _ParamsOfParts(_Named):
    vehicle: _Entry[Any] = _Entry()
    lidar: _Entry[Any] = _Entry()  # `LidarParams`, or `SpatialParams`
    odometry: _Entry[Any] = _Entry()
    start: _Entry[Any] = _Entry()
    reward: _Entry[Any] = _Entry()  # the rule's
    slip: _Entry[Any] = _Entry()
    obstacles: _Entry[Any] = _Entry()
    faults: _Entry[Any] = _Entry()
    imu: _Entry[Any] = _Entry()
    goal: _Entry[Any] = _Entry()
    reported: _Entry[Any] = _Entry()
    goal_coverage: _Entry[Float[Array, ""]] = _Entry()
    track: _Entry[Any] = _Entry()  # the ground of robots by physics: `physics.ground`
    walk: _Entry[Any] = _Entry()  # the walking robot, its gait, and the surface that it sees: `b2.mission`
    policy: _Entry[Any] = _Entry()
    relief: _Entry[Any] = _Entry()


class _StatesOfParts(_Named):
    goal: _Entry[Any] = _Entry()  # the rule's
    odometry: _Entry[Any] = _Entry()
    slip: _Entry[Any] = _Entry()
    obstacles: _Entry[Any] = _Entry()
    faults: _Entry[Any] = _Entry()
    imu: _Entry[Any] = _Entry()
    legs: _Entry[Any] = _Entry()  # of `b2.mission`


@partial(jax.tree_util.register_dataclass, data_fields=["tunnel", "horizon", "parts"], meta_fields=["goal_kind"])
@dataclasses.dataclass(frozen=True)
class EnvParams(_ParamsOfParts):
    """Everything about a task that is data. Every leaf may be vmapped.

    Attributes:
        tunnel: Tunnel, or a stack of tunnels of which each episode draws one.
        horizon: Steps after which an episode is truncated.
        parts: Params of the robot, of each part and of the rule, by name. Those of the package are attributes too.
            Frozen, so that a tree of axes can be hashed, as a static argument must.
        goal_kind: What an agent is asked to do: `cover`, `stop`, `return` or `report`. Static.
    """

    tunnel: Tunnel
    horizon: Any
    parts: FrozenDict[str, Any]
    goal_kind: str = "cover"


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["position", "heading", "station", "lateral", "furthest", "command", "steps", "tunnel", "parts"],
    meta_fields=[],
)
@dataclasses.dataclass(frozen=True)
class State(_StatesOfParts):
    """State of one environment. It holds no key: randomness comes with each call.

    Attributes:
        position: Position in the tunnel frame, m.
        heading: Heading in the tunnel frame, rad, in [-π, π].
        station: Station, m.
        lateral: Distance to the left of the centreline, m.
        furthest: Furthest station so far, m.
        command: Last command obeyed, m/s and rad/s.
        steps: Steps taken in this episode.
        tunnel: Number of the tunnel in a stack; 0 where there is one.
        parts: States of the parts and, as `goal`, of the rule, by name.
    """

    position: Float[Array, 2]
    heading: Float[Array, ""]
    station: Float[Array, ""]
    lateral: Float[Array, ""]
    furthest: Float[Array, ""]
    command: Float[Array, 2]
    steps: Int[Array, ""]
    tunnel: Int[Array, ""]
    parts: dict[str, Any]
