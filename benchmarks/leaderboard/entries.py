"""One entry: an agent's episodes of one task in one tunnel. A folder keeps them, so that a run can go on."""

import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import subterra_jax as st
from benchmarks.leaderboard.config import OWN, LeaderboardError, World
from benchmarks.throughput.facts import version
from subterra_jax import policies
from subterra_jax.baselines.registry import make_agent
from subterra_jax.evaluation import Records, evaluate, listed_episodes
from subterra_jax.evaluation.bounds import stop_bounds
from subterra_jax.evaluation.episodes import SHA256
from subterra_jax.rules import StopAt

SCHEMA = "subterra.leaderboard-entry/1"


@dataclass(frozen=True)
class Entry:
    """Episodes of one agent.

    Attributes:
        task: Id of the task.
        world: Tunnel and lining, for people.
        agent: Name of the agent.
        traits: What it uses: `uses_lidar`, `uses_map`, `privileged`.
        records: Its episodes.
        bounds: Success that theory allows without a look at the walls, see `stop_bounds`; None where none is known.
    """

    task: str
    world: str
    agent: str
    traits: dict[str, bool]
    records: Records
    bounds: dict[str, float] | None = None


def entry_of(folder: Path, task: str, world: World, agent: str, episodes: int, batch: int) -> tuple[Entry, bool]:
    """An entry, and whether it had been driven before: then it is read.

    Args:
        folder: Where entries are kept.
        task: Id of the task.
        world: The tunnel.
        agent: Name of the agent.
        episodes: How many episodes.
        batch: Episodes driven at the same time.

    Raises:
        LeaderboardError: The folder cannot be written.
        PolicyError: A policy that was made for another task.
    """
    name = policies.PREFIX + policies.name_for(task) if agent == OWN else agent
    inputs = {
        "schema": SCHEMA,
        "evaluation": SHA256,
        "task": task,
        "tunnel": _digest(world),
        "lining": world.lining,
        "agent": agent,
        "episodes": episodes,
        "version": version("subterra-jax"),
        **_weights(name),
    }
    path = folder / f"{_plain(task)}.{_plain(world.title)}.{_plain(agent)}.json"
    if (found := _read(path, inputs)) is not None:
        records = Records.from_columns(found["records"])
        return Entry(task, world.title, agent, found["traits"], records, found.get("bounds")), True
    env, params = st.make(task, world.plan, world.lining, estimates=True)
    driver = make_agent(name, params)
    if name.startswith(policies.PREFIX):
        policies.check_fits(driver, env, params, name)  # type: ignore[arg-type]
    traits = {name: bool(getattr(driver, name)) for name in ("uses_lidar", "uses_map", "privileged")}
    records = evaluate(env, params, driver, listed_episodes(task, params, episodes), batch)
    plain = type(env.rule) is StopAt and params.obstacles is None and params.faults is None
    bounds = stop_bounds(params) if plain else None
    _write(path, {"inputs": inputs, "traits": traits, "bounds": bounds, "records": records.as_columns()})
    return Entry(task, world.title, agent, traits, records, bounds), False


def write(path: Path, content: bytes) -> None:
    """Write a file whole or not at all.

    Raises:
        LeaderboardError: It cannot be written.
    """
    partial = path.with_suffix(path.suffix + ".partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_bytes(content)
        partial.replace(path)
    except OSError as error:
        raise LeaderboardError(f"{path}: cannot be written ({error.strerror})") from error


def _write(path: Path, content: dict[str, Any]) -> None:
    write(path, (json.dumps(content, allow_nan=False) + "\n").encode())


def _read(path: Path, inputs: dict[str, Any]) -> dict[str, Any] | None:
    """What a file holds, if it was made from the same inputs."""
    try:
        found = json.loads(path.read_bytes())
        return found if found["inputs"] == inputs else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _weights(agent: str) -> dict[str, str]:
    """Which weights a released policy has: another release under the same name is driven anew."""
    policy = agent.removeprefix(policies.PREFIX)
    return {} if policy == agent else {"policy": policies.load(policy)[1]["tensors_sha256"]}


def _digest(world: World) -> str:
    """Hash of the geometry that is driven through."""
    digest = hashlib.sha256()
    for values in (world.plan.centre, world.plan.half_width, world.plan.lining(world.lining).segments):
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def _plain(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9-]+", "_", name)
