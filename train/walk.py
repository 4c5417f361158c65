"""Teaches the Unitree B2 to walk on a track: `python -m train.walk --out DIR`.

What is learnt is added to a trot that walks by itself; `--seeds 0 1 2` trains one after the other, each into a folder
of its own; `--release FILE` writes the last one for `subterra_jax.load_policy`.
"""

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import Annotated

import jax
import tyro

from subterra_jax.b2 import tasks
from subterra_jax.b2.params import WalkRewardParams
from subterra_jax.host.command import EXIT_INTERRUPTED, parse, run_command
from subterra_jax.host.files import require_file
from subterra_jax.host.task_ids import WALK
from subterra_jax.policies.files import TENSORS
from subterra_jax.tunnel.sources import load_tunnel, tunnel_digest
from train.b2.walking import WalkConfig, WalkSession, make_walk_config, make_walk_learner
from train.config import ConfigError, check
from train.options import insert_file, reward_of, settings_of, with_weights
from train.session import check_seeds
from train.sinks import Logs
from train.world import World, with_reward


@dataclasses.dataclass(frozen=True)
class Command:
    """Trains a gait by PPO. The defaults of the settings follow from `--preset`.

    Example: python -m train.walk --out out/walk --seeds 0 1 2 --release out/walk.safetensors
    """

    out: Path  # run folder to write: checkpoint/, config.json, log.jsonl, episodes.csv, curve.png, evaluation.json
    tunnel: Path | None = None  # tunnel file or name, its sleepers laid by standard; `subterra-351` if left out
    scene: Path | None = None  # built scene folder, whose own sleepers are walked on; instead of a tunnel
    preset: str | None = None  # `cpu` or `gpu`; what jax runs on if left out
    # train these seeds, one after the other, into `out/seed-<k>`; one run of `--seed` if left out
    seeds: tuple[int, ...] = ()
    # Go on from the newest checkpoint in `out`; from the beginning where there is none yet. Only the limits on
    # training may differ.
    resume: bool = False
    overwrite: bool = False  # throw away the run that `out` holds
    robots: int = 1000  # robots of the evaluation after training, an episode of 20 s each
    release: Path | None = None  # write the policy of the last seed there, a `.safetensors` file
    # YAML, TOML or JSON file with options, or a run's `config.json`; options override it
    settings: Annotated[Path | None, tyro.conf.arg(name="config")] = None
    # further places to log to
    logs: Annotated[Logs, tyro.conf.OmitArgPrefixes] = dataclasses.field(default_factory=Logs)
    # settings of PPO
    config: Annotated[WalkConfig, tyro.conf.OmitArgPrefixes] = dataclasses.field(default_factory=WalkConfig)


def read_command(arguments: list[str]) -> Command:
    """Reads a command line; defaults follow from the preset that it names.

    Raises:
        ConfigError: There is no such preset, or the file that `--config` names is wrong.
    """
    return _read_words(insert_file(arguments, _read_words))


def _read_words(arguments: list[str]) -> Command:
    """Reads a command line without looking into the file that it may name."""
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--preset", default=None)
    named, _ = early.parse_known_args(arguments)
    preset = named.preset or ("cpu" if jax.default_backend() == "cpu" else "gpu")
    default = Command(out=tyro.MISSING, preset=preset, config=make_walk_config(preset))
    if preset == "cpu":
        default = dataclasses.replace(default, robots=64)
    default = with_weights(default, WalkRewardParams())
    return tyro.cli(type(default), args=arguments, default=default, prog="python -m train.walk", description=__doc__)


def open_world(tunnel: Path | None, scene: Path | None) -> World:
    """Opens the walking task on a tunnel, or in a built scene.

    Raises:
        ConfigError: Both are given.
        SubterraError: It cannot be read, has no track, or is too narrow.
    """
    if tunnel is not None and scene is not None:
        raise ConfigError(f"either a tunnel or a scene, got both {tunnel} and {scene}")
    file = tunnel if scene is None else scene / "tunnel.npz"
    plan = load_tunnel(file)
    env, params = tasks.make(tunnel=None if scene else plan, scene=scene, privileged=True)
    facts = {
        "task": WALK,
        "lining": plan.default_lining,
        "tunnel": plan.name,
        "tunnel_provenance": plan.provenance,
        "tunnel_sha256": tunnel_digest(file),
        "track": "by standard" if scene is None else "of the scene",
    }
    return World(WALK, env, params, facts)


def command(arguments: Command) -> int:
    """Trains, draws the curves, evaluates each policy, and releases the last where asked.

    Returns:
        Exit status: 0, or 130 after Ctrl-C, with the checkpoint saved.
    """
    check(arguments.config)
    check_seeds(arguments.seeds)
    if arguments.robots < 1:
        raise ConfigError(f"robots must be at least 1, got {arguments.robots}")
    if arguments.release is not None:
        require_file(arguments.release, TENSORS)
    world = with_reward(open_world(arguments.tunnel, arguments.scene), reward_of(arguments))
    for seed in arguments.seeds or (arguments.config.seed,):
        out = arguments.out / f"seed-{seed}" if arguments.seeds else arguments.out
        if not _train_seed(arguments, world, dataclasses.replace(arguments.config, seed=seed), out):
            return EXIT_INTERRUPTED
    return 0


def _train_seed(arguments: Command, world: World, config: WalkConfig, out: Path) -> bool:
    """Trains, scores and releases one seed; False after Ctrl-C."""
    n_seen = dataclasses.replace(world.env, privileged=False).observation_size(world.params)
    learner = make_walk_learner(world.env, world.params, config, n_seen)
    alone = settings_of(dataclasses.replace(arguments, config=config))
    session = WalkSession(out, world, learner, logs=arguments.logs, command=alone)
    last = session.train(resume=arguments.resume, overwrite=arguments.overwrite, label=f"seed {config.seed}")
    if last is None:
        return False
    scores = session.score(last, arguments.robots)
    if arguments.release is not None:
        session.release(arguments.release, last, scores)
    return True


def main() -> None:
    """Runs `python -m train.walk`."""
    sys.exit(run_command(lambda: command(parse(read_command))))


if __name__ == "__main__":
    main()
