"""Entries: one agent's episodes of one task in one tunnel, kept in a folder so that a run can be resumed."""

import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import subterra_jax as st
from benchmarks.leaderboard.config import OWN_POLICY, TRAITS, LeaderboardError, World, code_digests, make_driver
from benchmarks.results import constants_facts, version, write_file
from subterra_jax import policies
from subterra_jax.evaluation import Records, evaluate, listed_episodes
from subterra_jax.evaluation.bounds import stop_bounds
from subterra_jax.evaluation.episodes import SHA256
from subterra_jax.rules import StopAt

SCHEMA = "subterra.leaderboard-entry/1"


@dataclass(frozen=True)
class Entry:
    """Episodes of one agent.

    Attributes:
        task: Task id.
        world: Tunnel and lining, for reports.
        agent: Name of the agent.
        traits: Inputs that the agent declares: `uses_lidar`, `uses_map`, `privileged`.
        records: Its episodes.
        bounds: Success that theory allows without looking at the walls, see `stop_bounds`; `None` where unknown.
    """

    task: str
    world: str
    agent: str
    traits: dict[str, bool]
    records: Records
    bounds: dict[str, float] | None = None


def make_entry(folder: Path, task: str, world: World, agent: str, episodes: int, batch: int) -> tuple[Entry, bool]:
    """Evaluates an agent, or reads the entry of an earlier run with the same inputs.

    Args:
        folder: Folder of the entries.
        task: Task id.
        world: Tunnel and lining.
        agent: Name of the agent.
        episodes: Number of episodes.
        batch: Episodes driven at the same time.

    Returns:
        The entry, and whether it was read.

    Raises:
        LeaderboardError: The folder cannot be written.
        PolicyError: A policy was made for another task.
    """
    name = policies.PREFIX + policies.name_for(task) if agent == OWN_POLICY else agent
    inputs = {
        "schema": SCHEMA,
        "evaluation": SHA256,
        "task": task,
        "tunnel": _digest(world),
        "lining": world.lining,
        "agent": agent,
        "episodes": episodes,
        "version": version("subterra-jax"),
        **constants_facts(),
        **_weights(name),
        **({"code": code} if (code := code_digests(task, name)) else {}),
    }
    path = folder / f"{_file_name(task)}.{_file_name(world.title)}.{_file_name(agent)}.json"
    if (kept := _read(path, inputs)) is not None:
        records = Records.from_columns(kept["records"])
        return Entry(task, world.title, agent, kept["traits"], records, kept.get("bounds")), True
    env, params = st.make(task, world.plan, world.lining, estimates=True)
    driver = make_driver(name, params)
    if name.startswith(policies.PREFIX):
        policies.check_fits(driver, env, params, name)
    traits = {trait: bool(getattr(driver, trait)) for trait in TRAITS}
    records = evaluate(env, params, driver, listed_episodes(task, params, episodes), batch)
    plain = type(env.rule) is StopAt and params.obstacles is None and params.faults is None
    bounds = stop_bounds(params) if plain else None
    content = {"inputs": inputs, "traits": traits, "bounds": bounds, "records": records.as_columns()}
    write(path, (json.dumps(content, allow_nan=False) + "\n").encode())
    return Entry(task, world.title, agent, traits, records, bounds), False


def write(path: Path, content: bytes) -> None:
    """Writes a file whole or not at all, and its folder.

    Raises:
        LeaderboardError: The file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, content)
    except OSError as error:
        raise LeaderboardError(f"{path}: cannot be written ({error.strerror})") from error


def _read(path: Path, inputs: dict[str, Any]) -> dict[str, Any] | None:
    """Returns the content of an entry if it was made from the same inputs."""
    try:
        content = json.loads(path.read_bytes())
        return content if content["inputs"] == inputs else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _weights(agent: str) -> dict[str, str]:
    """Returns the digest of a policy's weights: other weights under the same name are driven again."""
    policy = agent.removeprefix(policies.PREFIX)
    return {} if policy == agent else {"policy": policies.load(policy)[1]["tensors_sha256"]}


def _digest(world: World) -> str:
    """Returns the hash of the geometry that is driven through."""
    digest = hashlib.sha256()
    for values in (world.plan.centre, world.plan.half_width, world.plan.lining(world.lining).segments):
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def _file_name(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9-]+", "_", name)
