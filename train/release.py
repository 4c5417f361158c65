"""Releases a trained policy: `python -m train.release RUN --out subterra_jax/data/policies/NAME.safetensors`.

Two files come of it, tensors and facts, which `subterra_jax.policies` loads without this room.
"""

import dataclasses
import sys
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from subterra_jax import policies as released
from subterra_jax.host.command import parse, run_command
from subterra_jax.host.files import require_file
from subterra_jax.policies import TRAINED_UNDER, Conditions
from subterra_jax.policies.files import TENSORS
from subterra_jax.policies.learnt import Learnt
from train.config import ConfigError
from train.evaluate import evaluate
from train.log import print_table
from train.policies import write_tensors
from train.world import World, library_versions, lidar_of, open_world


@dataclasses.dataclass(frozen=True)
class Command:
    """Releases a trained policy with its scores on the task's fixed list of episodes."""

    run: tyro.conf.Positional[Path]  # run folder of `train`, or one checkpoint in it
    out: Path  # the tensors' file, which ends in `.safetensors`; the facts go beside it
    tunnel: Path | None = None  # tunnel file or name of the evaluation; the packaged tunnel if left out
    lining: str | None = None  # variant of the walls of the evaluation; the tunnel's usual one if left out
    episodes: int = 500  # episodes of the evaluation
    half: bool = False  # write the weights in float16


def command(arguments: Command) -> None:
    """Evaluates the policy and writes its two files."""
    require_file(arguments.out, TENSORS)
    agent, stored = released.load(arguments.run)
    world = _world(stored, arguments)
    if not isinstance(agent, Learnt):
        raise ConfigError(f"{arguments.run}: a policy of kind {stored['kind']}, which this command does not release")
    found = evaluate(world, agent, arguments.episodes)
    facts = {
        "task": stored["task"],
        "world": stored["world"],
        "config": stored["config"],
        TRAINED_UNDER: Conditions.from_facts(stored).to_json(),
        "iteration": stored["iteration"],
        "steps": stored["iteration"] * stored["config"]["n_envs"] * stored["config"]["unroll"],
        "versions": library_versions(),
        "scores": {**world.facts, **found},
    }
    tensors = {name: np.asarray(tensor) for name, tensor in agent.tensors.items()}
    write_tensors(arguments.out, agent.kind, agent.layout, tensors, facts, arguments.half)
    print_table(str(arguments.out), {name: value for name, value in found.items() if value is not None})


def _world(stored: dict[str, Any], arguments: Command) -> World:
    """Opens the world to score in: of the robot that was trained, or of the stand-in of one on legs."""
    if stored["world"].get("motion") != "b2":
        return open_world(stored["task"], arguments.tunnel, arguments.lining, **lidar_of(stored["world"]))
    from train.b2 import embodied  # MuJoCo is loaded only where legs are meant

    return embodied.open_world(stored["task"], arguments.tunnel, arguments.lining)


def main() -> None:
    """Runs `python -m train.release`."""
    sys.exit(run_command(lambda: command(parse(_read))))


def _read(words: list[str]) -> Command:
    return tyro.cli(Command, args=words, prog="python -m train.release", description=__doc__)


if __name__ == "__main__":
    main()
