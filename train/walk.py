"""Teaches the Unitree B2 to walk on a track: `python -m train.walk --out DIR`.

What is learnt is added to a trot that walks by itself; `--seeds 0 1 2` trains one after the other, each into a folder
of its own; `--release FILE` writes the last one for `subterra_jax.b2.gait.load_policy`.
"""

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import Annotated

import jax
import tyro

from subterra_jax.b2 import WALK, tasks
from subterra_jax.host.command import EXIT_INTERRUPTED, parse, run_command
from subterra_jax.host.files import require_file
from subterra_jax.policies.files import TENSORS
from subterra_jax.tunnel.sources import load_tunnel, tunnel_digest
from train import cli, ppo, seeds
from train.b2.config import WalkConfig, make_config
from train.b2.network import WalkLearner
from train.b2.session import WalkSession
from train.config import check
from train.errors import ConfigError
from train.policies import World
from train.run.log import Bar


@dataclasses.dataclass(frozen=True)
class Command:
    """Trains a gait by PPO. The defaults of the settings follow from `--preset`.

    Example: python -m train.walk --out out/walk --seeds 0 1 2 --release out/walk.safetensors

    Attributes:
        out: Run folder to write: checkpoint/, config.json, log.jsonl, episodes.csv, curve.png, evaluation.json.
        tunnel: Tunnel file or name, its sleepers laid by standard; `subterra-351` if left out.
        scene: Built scene folder, whose own sleepers are walked on; instead of a tunnel.
        preset: `cpu` or `gpu`; what jax runs on if left out.
        seeds: Train these seeds, one after the other, into `out/seed-<k>`; one run of `--seed` if left out.
        resume: Go on from the checkpoint in `out`; only the limits on training may differ.
        overwrite: Throw away the run that `out` holds.
        robots: Robots of the evaluation after training, an episode of 20 s each.
        release: Write the policy of the last seed there, a `.safetensors` file.
        config: Settings of PPO.
    """

    out: Path
    tunnel: Path | None = None
    scene: Path | None = None
    preset: str | None = None
    seeds: tuple[int, ...] = ()
    resume: bool = False
    overwrite: bool = False
    robots: int = 1000
    release: Path | None = None
    config: Annotated[WalkConfig, tyro.conf.OmitArgPrefixes] = dataclasses.field(default_factory=WalkConfig)


def read_command(arguments: list[str]) -> Command:
    """The command line, with the defaults of the preset that it names itself.

    Raises:
        ConfigError: There is no such preset.
    """
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--preset", default=None)
    named, _ = early.parse_known_args(arguments)
    preset = named.preset or ("cpu" if jax.default_backend() == "cpu" else "gpu")
    on_cpu = {"robots": 64} if preset == "cpu" else {}
    default = Command(out=tyro.MISSING, preset=preset, config=make_config(preset), **on_cpu)  # type: ignore[arg-type]
    return tyro.cli(Command, args=arguments, default=default, prog="python -m train.walk")


def open_world(tunnel: Path | None, scene: Path | None) -> World:
    """The walking task on a tunnel, or in a built scene.

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
    seeds.check(arguments.seeds)
    if arguments.robots < 1:
        raise ConfigError(f"robots must be at least 1, got {arguments.robots}")
    if arguments.release is not None:
        require_file(arguments.release, TENSORS)
    world = open_world(arguments.tunnel, arguments.scene)
    for seed in arguments.seeds or (arguments.config.seed,):
        out = arguments.out / f"seed-{seed}" if arguments.seeds else arguments.out
        if not _one(arguments, world, dataclasses.replace(arguments.config, seed=seed), out):
            return EXIT_INTERRUPTED
    return 0


def _one(arguments: Command, world: World, config: WalkConfig, out: Path) -> bool:
    """One seed; whether it came to its end."""
    n_seen = dataclasses.replace(world.env, privileged=False).observation_size(world.params)
    session = WalkSession(out, world, WalkLearner(world.env, world.params, config, n_seen))
    snapshot = session.folder.begin(resume=arguments.resume, overwrite=arguments.overwrite)
    session.open(snapshot)
    bar = Bar(config.steps, snapshot.iteration * config.steps_per_iteration if snapshot else 0)
    with cli.deferred_interrupt() as interrupt:

        def watch(now: ppo.Snapshot) -> bool:
            bar.show(now.record, of=f"seed {config.seed}")
            session.note(now, save=interrupt.wanted)
            return interrupt.wanted

        try:
            last = ppo.train(
                world.env,
                world.params,
                config,
                learner=session.learner,
                snapshot=snapshot,
                watch=watch,
                deterministic=config.deterministic,
            )
        finally:
            bar.close()
            session.close()
        session.finish(last)
        if interrupt.wanted:
            print(f"interrupted after {last.iteration} iterations; go on with --resume", file=sys.stderr)
            return False
    found = session.score(last, arguments.robots)
    if arguments.release is not None:
        session.release(arguments.release, last, found)
    return True


def main() -> None:
    """Entry point of `python -m train.walk`."""
    sys.exit(run_command(lambda: command(parse(read_command))))


if __name__ == "__main__":
    main()
