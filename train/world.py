"""Worlds to train on: a task on a tunnel, opened and checked before anything is compiled."""

import dataclasses
import hashlib
import math
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import jax.numpy as jnp

import subterra_jax as st
from subterra_jax.host.versions import VERSION
from subterra_jax.policies import TRAINED_UNDER, training_conditions
from subterra_jax.tasks import MOTIONS, TaskError, find
from subterra_jax.tunnel.sources import tunnel_digest
from train import tunnels
from train.config import ConfigError
from train.tunnels import PLANAR

REWARD = "reward"  # fact of a world with other weights than the task's
_PACKAGES = ("jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy")


@dataclasses.dataclass(frozen=True)
class World:
    """A task on a tunnel."""

    task: str  # task id
    env: Any  # the environment
    params: Any  # its parameters
    facts: dict[str, Any]  # task, lining, and the tunnel file's name, provenance and SHA-256: the identity of the world
    unchanged: Any = None  # its params before `with_reward`; None where nothing was changed
    val: "World | None" = None  # world of the evaluation after training; None is this one

    @property
    def covers(self) -> bool:
        """True where coverage is the task; elsewhere it says nothing."""
        return hasattr(self.env, "rule") and self.env.rule.goal_kind == "cover"

    def scored(self) -> "World":
        """Returns the world of the evaluation after training."""
        return self if self.val is None else self.val

    @property
    def task_params(self) -> Any:
        """Params of the task as it is scored: with its own reward."""
        return self.params if self.unchanged is None else self.unchanged

    @property
    def trained_under(self) -> dict[str, Any]:
        """Conditions of a training here, as facts of its policies; none for a robot that is taught to walk."""
        if not hasattr(self.env, "rule"):
            return {}
        return {TRAINED_UNDER: training_conditions(self.env, self.task_params).to_json()}


def task_reward(task: str) -> Any:
    """Returns the weights of a task's reward, a dataclass of numbers; None for a task without.

    Raises:
        ConfigError: As `require_task`.
    """
    entry = st.TASKS[require_task(task)]
    weights = {**entry.rule.defaults(), **entry.params}.get(REWARD)
    return weights if dataclasses.is_dataclass(weights) else None


def with_reward(world: World, weights: Mapping[str, float]) -> World:
    """Returns a world with other weights of the reward; it remembers those that differ from the task's.

    Raises:
        ConfigError: The task has no such weight, or it is not finite.
    """
    usual = getattr(world.params, "reward", None) if weights else None
    known = [field.name for field in dataclasses.fields(usual)] if usual is not None else []
    changed = {}
    for name, weight in weights.items():
        if name not in known:
            raise ConfigError(f"{world.task} has no weight reward.{name}; there are {', '.join(known) or 'none'}")
        if not math.isfinite(weight):
            raise ConfigError(f"reward.{name} must be finite, got {weight}")
        if jnp.float32(weight) != getattr(usual, name):
            changed[name] = weight
    if not changed:
        return world
    reward: Any = usual
    params = world.params.replace(reward=reward.replace(**{name: jnp.float32(w) for name, w in changed.items()}))
    return dataclasses.replace(
        world, params=params, facts={**world.facts, REWARD: changed}, unchanged=world.task_params
    )


def require_task(task: str) -> str:
    """Returns the id of a task; `FILE.py:ID` first runs a user's file.

    Raises:
        ConfigError: There is no such task, or this command does not learn it.
    """
    try:
        task = find(task, short=True)
    except TaskError as error:
        raise ConfigError(str(error)) from error
    if task not in st.TASKS:
        raise ConfigError(f"{task} is not learnt by this command; there are {', '.join(st.TASKS)}")
    return task


_TUNNELS = {"cpu": "open:train:0-3", "gpu": "open:train:0-15"}


def open_world(
    task: str,
    tunnel: Path | str | None,
    lining: str | None = None,
    sensor: str = PLANAR,
    val: Path | str | None = None,
    preset: str | None = "cpu",
    hidden_start: bool = False,
    intensity: bool = False,
    texture: float = 0.0,
    motion: str = MOTIONS[0],
) -> World:
    """Opens a task on a tunnel.

    Args:
        task: Task id.
        tunnel: File or name, or several names with commas between, as `open:train:0-15`, of which each episode draws
            one. None is a few of `open:train` in a task with a goal, and the packaged tunnel elsewhere.
        lining: Variant of the walls; None is the tunnel's usual one.
        sensor: LiDAR, as `st.make` takes it by name.
        val: Tunnels of the evaluation after training; None is `tunnel`.
        preset: Says how many tunnels are a few.
        hidden_start: The true start is off the one that is reported.
        intensity: The LiDAR gives intensities too.
        texture: Dial of what they tell, as for `st.make`.
        motion: As for `st.make`.

    Raises:
        ConfigError: There is no such task or sensor, or the tunnel has no room for it.
        TunnelError: The tunnel file is missing or wrong, or has no such lining.
    """
    task = require_task(task)
    if tunnel is None and st.TASKS[task].rule.goal_kind != "cover":
        tunnel = _TUNNELS[preset or "cpu"]
    chosen: dict[str, Any] = {"hidden_start": hidden_start, "intensity": intensity, "texture": texture}
    chosen |= {"motion": motion} if motion != MOTIONS[0] else {}
    world = _open(task, tunnel, lining, sensor, chosen)
    return world if val is None else dataclasses.replace(world, val=_open(task, val, lining, sensor, chosen))


def lidar_of(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the arguments of `open_world` that say what a world's LiDAR shows, and how its robot moves."""
    return {name: facts[name] for name in ("sensor", "intensity", "texture", "motion") if name in facts}


def _open(task: str, tunnel: Path | str | None, lining: str | None, sensor: str, chosen: dict[str, Any]) -> World:
    names: list[Any] = [tunnel] if tunnel is None else [*tunnels.names_of(str(tunnel))]
    several = len(names) > 1
    given: Any = names if several else names[0]
    try:
        if several and sensor != PLANAR:
            given = tunnels.load(names, lining, sensor, st.TASKS[task].stretch)
        env, params = st.make(task, given, lining, sensor=sensor, **chosen)
    except st.SubterraError:
        raise
    except ValueError as error:
        raise ConfigError(str(error)) from error
    plan = None if several else st.load_tunnel(names[0])
    facts: dict[str, Any] = {
        "task": task,
        "lining": lining or (None if plan is None else plan.default_lining),
        "tunnel": str(tunnel) if plan is None else plan.name,
        "tunnel_provenance": "generated" if plan is None else plan.provenance,
        "constants": st.constants_digest(env, params),
        "tunnel_sha256": _digest(names),
    }
    if sensor != PLANAR:
        facts["sensor"] = sensor
    return World(task, env, params, facts | {name: value for name, value in chosen.items() if value})


def _digest(names: list[Any]) -> str:
    """Returns the SHA-256 of a tunnel, or of several; generated ones are known by name and version."""
    if len(names) == 1:
        return tunnel_digest(names[0])
    each = [f"{name} {VERSION}" if str(name).startswith("open:") else tunnel_digest(name) for name in names]
    return hashlib.sha256("\n".join(each).encode()).hexdigest()


def library_versions() -> dict[str, str]:
    """Returns the versions of the libraries that a result depends on."""
    installed = {package.metadata["Name"]: package.version for package in metadata.distributions()}
    return {"subterra-jax": VERSION, **{name: installed.get(name, "not installed") for name in _PACKAGES}}
