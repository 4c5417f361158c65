"""Releases a trained policy: `python -m train.release RUN --out subterra_jax/data/policies/NAME.safetensors`.

Two files come of it, tensors and facts, which `subterra_jax.policies` loads without this room.
"""

import dataclasses
import hashlib
import json
import sys
from pathlib import Path
from typing import Any

import tyro
from safetensors.numpy import save

from subterra_jax.host.command import parse, run_command
from subterra_jax.host.files import require_file
from subterra_jax.policies.files import FACTS, SCHEMA, TENSORS
from train import cli, policies
from train.agents import agent_of, tensors_of
from train.b2.legs import Legs
from train.errors import RunFolderError
from train.evaluate import evaluate


@dataclasses.dataclass(frozen=True)
class Command:
    """Releases a trained policy with its scores on the task's fixed list of episodes.

    Attributes:
        run: Run folder of `train.navigate`, or one checkpoint in it.
        out: The tensors' file, which ends in `.safetensors`; the facts go beside it.
        tunnel: Tunnel file or name of the evaluation; the packaged tunnel if left out.
        lining: Variant of the walls of the evaluation; the tunnel's usual one if left out.
        episodes: Episodes of the evaluation.
    """

    run: tyro.conf.Positional[Path]
    out: Path
    tunnel: Path | None = None
    lining: str | None = None
    episodes: int = 500


def write(out: Path, networks: policies.AnyNetworks, policy: Any, facts: dict[str, Any]) -> None:
    """Writes a policy's two files, the tensors' first.

    Args:
        out: The tensors' file.
        networks: What the policy belongs to.
        policy: The policy.
        facts: At least `task` and `world`; name, kind, layout and hash are added.

    Raises:
        RunFolderError: They cannot be written.
    """
    tensors = save(dict(sorted(tensors_of(networks, policy).items())))
    whole = {
        "schema": SCHEMA,
        "name": out.name.removesuffix(TENSORS),
        "kind": networks.kind,
        "tensors_sha256": hashlib.sha256(tensors).hexdigest(),
        "layout": dataclasses.asdict(networks.layout),
        **facts,
    }
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        for path, content in ((out, tensors), (facts_file(out), (json.dumps(whole, indent=1) + "\n").encode())):
            fresh = path.with_name(f".{path.name}.partial")
            fresh.write_bytes(content)
            fresh.replace(path)
    except OSError as error:
        raise RunFolderError(f"{out}: cannot be written ({error.strerror})") from error


def facts_file(out: Path) -> Path:
    """The facts that belong to tensors."""
    return out.with_name(out.name.removesuffix(TENSORS) + FACTS)


def command(arguments: Command) -> None:
    """Evaluates and writes."""
    require_file(arguments.out, TENSORS)
    networks, policy, stored = policies.load_policy(arguments.run)
    world = _world(stored, arguments)
    found = evaluate(world, agent_of(networks, policy), arguments.episodes)
    facts = {
        "task": stored["task"],
        "world": stored["world"],
        "config": stored["config"],
        "iteration": stored["iteration"],
        "steps": stored["iteration"] * stored["config"]["n_envs"] * stored["config"]["unroll"],
        "versions": policies.versions(),
        "scores": {**world.facts, **found},
    }
    write(arguments.out, networks, policy, facts)
    cli.table(str(arguments.out), {name: value for name, value in found.items() if value is not None})


def _world(stored: dict[str, Any], arguments: Command) -> policies.World:
    """Where the policy is scored: what it was trained on, be it the stand-in of a robot on legs."""
    if stored["world"].get("embodiment") is None:
        return policies.open_world(stored["task"], arguments.tunnel, arguments.lining)
    from train.b2 import embodied  # MuJoCo is loaded only where legs are meant

    return embodied.open_world(stored["task"], arguments.tunnel, arguments.lining, Legs(robots=0))


def main() -> None:
    """Entry point of `python -m train.release`."""
    sys.exit(run_command(lambda: command(parse(_read))))


def _read(words: list[str]) -> Command:
    return tyro.cli(Command, args=words, prog="python -m train.release", description=__doc__)


if __name__ == "__main__":
    main()
