"""Scores of a policy without its exploration noise: `python -m train.evaluate --task ID [--policy PATH]`."""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import tyro

from subterra_jax import policies as released
from subterra_jax.evaluation import Records, listed_episodes
from subterra_jax.evaluation import evaluate as drive
from subterra_jax.evaluation.episodes import N_LISTED, SHA256
from subterra_jax.evaluation.records import summarise
from subterra_jax.host.command import parse, run_command
from subterra_jax.policies.trained import Trained
from train.config import ConfigError
from train.log import print_table
from train.policies import open_agent
from train.without import Part, without
from train.world import World, lidar_of, open_world

_BATCH = 500


def check_episodes(n: int, name: str = "episodes") -> None:
    """Raises `ConfigError` where the list has not so many episodes."""
    if n < 1:
        raise ConfigError(f"{name} must be at least 1, got {n}")
    if n > N_LISTED:
        raise ConfigError(f"{name} must be at most {N_LISTED}, which is what the list has, got {n}")


def evaluate(world: World, agent: Trained, n_episodes: int) -> dict[str, Any]:
    """Evaluates an agent on the first listed episodes.

    Args:
        world: The task.
        agent: The driver.
        n_episodes: Episodes, 1 to 500.

    Returns:
        As `subterra_jax.evaluation.records.summarise`, and `coverage_min`, `contacts` (episodes ended at a wall) and
        `list_sha256`, of the list of episodes. What does not apply to the task is None.

    Raises:
        ConfigError: There are not so many episodes.
        PolicyError: The agent does not fit the task.
    """
    check_episodes(n_episodes)
    released.check_fits(agent, world.env, world.params, agent.name)
    episodes = listed_episodes(world.env, world.params, n_episodes)
    return scores(drive(world.env, world.params, agent.with_map(world.params), episodes, _BATCH))


def scores(records: Records) -> dict[str, Any]:
    """Summarises episodes."""
    covered = records.coverage.min()
    return {
        **summarise(records),
        "coverage_min": None if covered != covered else float(covered),
        "contacts": int(records.contact.sum()),
        "list_sha256": SHA256,
    }


@dataclasses.dataclass(frozen=True)
class Command:
    """Scores a trained policy without its exploration noise, on the fixed list of episodes."""

    # run folder of `train`, one checkpoint in it, a `.safetensors` file, or the name of a released policy; the
    # one released for the task if left out
    policy: Path | None = None
    task: str | None = None  # task id; the one it was trained on if left out
    # tunnel file or names, as in training; the packaged tunnel, or a few of `open:train`, if left out
    tunnel: Path | None = None
    lining: str | None = None  # variant of the walls; the tunnel's usual one if left out
    episodes: int = N_LISTED  # episodes to drive, the first of the task's 500
    # go without a part, for an ablation: the `start` is reported 40 m off; `front`: the localiser reads no walls;
    # `walls`: no beam has an echo; `odometry` stands still; `memory`: the way is dead-reckoned
    without: Part | None = None
    json: bool = False  # one line of JSON instead of a table


def command(arguments: Command) -> None:
    """Evaluates the policy and prints its scores."""
    check_episodes(arguments.episodes)
    agent, facts = open_agent(arguments.policy, arguments.task)
    shown = lidar_of(facts.get("world", {}))
    world = open_world(arguments.task or facts["task"], arguments.tunnel, arguments.lining, **shown)
    source = arguments.policy or agent.name
    released.check_fits(agent, world.env, world.params, source)
    if arguments.without is not None:
        agent = without(agent, arguments.without)
    found = {**world.facts, **evaluate(world, agent, arguments.episodes)}
    if arguments.json:
        print(json.dumps(found))
    else:
        table = {name: value for name, value in found.items() if value is not None and name not in world.facts}
        print_table(f"{world.task}, {world.facts['tunnel']}, {world.facts['lining']}: {Path(source).name}", table)


def main() -> None:
    """Runs `python -m train.evaluate`."""
    sys.exit(run_command(lambda: command(parse(_read))))


def _read(words: list[str]) -> Command:
    return tyro.cli(Command, args=words, prog="python -m train.evaluate", description=__doc__)


if __name__ == "__main__":
    main()
