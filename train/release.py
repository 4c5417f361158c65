"""Releases a trained policy: `python -m train.release RUN --out subterra_jax/data/policies/NAME.safetensors`.

Two files come of it, tensors and facts, which `subterra_jax.policies` loads without this room.
"""

import dataclasses
import sys
from pathlib import Path
from typing import Any

import tyro

from subterra_jax.host.command import parse, run_command
from subterra_jax.host.files import require_file
from subterra_jax.policies import TRAINED_UNDER, Conditions
from subterra_jax.policies.files import TENSORS
from train.config import Legs
from train.evaluate import evaluate
from train.locate import release as localiser
from train.log import print_table
from train.policies import load_policy, make_agent, write_policy
from train.world import PLANAR, World, library_versions, open_world


@dataclasses.dataclass(frozen=True)
class Command:
    """Releases a trained policy with its scores on the task's fixed list of episodes.

    Attributes:
        run: Run folder of `train.navigate`, or one checkpoint in it; or the folder of a seed of `train.locate`.
        out: The tensors' file, which ends in `.safetensors`; the facts go beside it.
        tunnel: Tunnel file or name of the evaluation; the packaged tunnel if left out.
        lining: Variant of the walls of the evaluation; the tunnel's usual one if left out.
        episodes: Episodes of the evaluation.
        measured: Tables of `benchmarks.kinds` or `train.locate.look` whose rows go into the card of a localiser.
    """

    run: tyro.conf.Positional[Path]
    out: Path
    tunnel: Path | None = None
    lining: str | None = None
    episodes: int = 500
    measured: tuple[Path, ...] = ()


def command(arguments: Command) -> None:
    """Evaluates the policy and writes its two files."""
    require_file(arguments.out, TENSORS)
    if localiser.is_localiser(arguments.run):
        found = localiser.release(arguments.run, arguments.out, arguments.episodes, arguments.measured)
        print_table(str(arguments.out), {name: value for name, value in found.items() if value is not None})
        return
    networks, policy, stored = load_policy(arguments.run)
    world = _world(stored, arguments)
    found = evaluate(world, make_agent(networks, policy), arguments.episodes)
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
    write_policy(arguments.out, networks, policy, facts)
    print_table(str(arguments.out), {name: value for name, value in found.items() if value is not None})


def _world(stored: dict[str, Any], arguments: Command) -> World:
    """Opens the world to score in: of the robot that was trained, or of the stand-in of one on legs."""
    if stored["world"].get("embodiment") is None:
        return open_world(stored["task"], arguments.tunnel, arguments.lining, stored["world"].get("sensor", PLANAR))
    from train.b2 import embodied  # MuJoCo is loaded only where legs are meant

    return embodied.open_world(stored["task"], arguments.tunnel, arguments.lining, Legs(robots=0))


def main() -> None:
    """Runs `python -m train.release`."""
    sys.exit(run_command(lambda: command(parse(_read))))


def _read(words: list[str]) -> Command:
    return tyro.cli(Command, args=words, prog="python -m train.release", description=__doc__)


if __name__ == "__main__":
    main()
