"""Trains a policy by PPO: `python -m train --task StopAt-v1 --out out/stop`.

Defaults of the settings follow from the task, the memory and the machine. `--seeds 0 1 2 3 4` trains several at once,
each into its own folder.
"""

import argparse
import dataclasses
import sys
import time
from pathlib import Path
from typing import Annotated, Literal

import jax
import tyro

from subterra_jax.host.command import EXIT_INTERRUPTED, parse, run_command
from train import clock
from train.config import ConfigError, TrainConfig, check, make_config
from train.devices import with_seed
from train.evaluate import check_episodes
from train.options import insert_file, reward_of, settings_of, with_weights
from train.session import Session, check_seeds, run_seeds
from train.setup import make_learner
from train.sinks import Logs
from train.snapshot import Snapshot
from train.world import World, open_world, require_task, task_reward, with_reward

DEFAULT_TASK = "Subterra/StopAtShort-v1"
_DESCRIPTION = """Trains a policy by PPO; defaults follow from `--task`, `--memory` and `--preset`.

python -m train --task StopAt-v1 --memory gru --auxiliary --out out/stop"""


@dataclasses.dataclass(frozen=True)
class Command:
    """Trains a policy by PPO; defaults follow from `--task`, `--memory` and `--preset`."""

    # run folder to write: checkpoint/, config.json, log.jsonl, log.csv, episodes.csv, curve.*, evaluation.json
    out: Path
    task: str = DEFAULT_TASK  # task id; `FILE.py:ID` for one of your own
    # Tunnel file, or a name: `subterra-351`, `metro`, `control`, or several with commas between, of which each
    # episode draws one: `open:train:0-15`. Left out, a task with a goal has `open:train:0-15`, on a CPU `:0-3`, since
    # each tunnel takes seconds to make (`st.make` has twelve: each kind equally often), and another the packaged one.
    tunnel: Path | None = None
    lining: str | None = None  # variant of the walls; the tunnel's usual one if left out
    # LiDAR; `planar16` is the task's own
    sensor: Literal["planar16", "spin16x64", "vlp16", "os1-64", "avia"] = "planar16"
    intensity: bool = False  # the LiDAR gives intensities too
    texture: float = 0.0  # what they tell of the walls: from 0, all alike, to 1, an old, wet metro
    hidden_start: bool = False  # the true start is off the one that is reported
    # `rover` has mass: physics in MJX, best begun from a policy on wheels; `b2` is a planar robot that obeys as late as
    # one on four legs, on which `benchmarks.b2_traverse` tries the policy
    motion: Literal["wheels", "rover", "b2"] = "wheels"
    val: Path | None = None  # tunnels of the evaluation after training; those of the training if left out
    preset: str | None = None  # `cpu` or `gpu`; what jax runs on if left out
    seeds: tuple[int, ...] = ()  # train these seeds at once, each into `out/seed-<k>`
    resume: bool = False  # go on from the newest checkpoint, or from the beginning
    overwrite: bool = False  # throw away the run that `out` holds
    evaluation_episodes: int = 200  # episodes of the evaluation after training, of 500; 0 leaves it out
    # YAML, TOML or JSON file with options, or a run's `config.json`; options override it
    settings: Annotated[Path | None, tyro.conf.arg(name="config")] = None
    # further places to log to
    logs: Annotated[Logs, tyro.conf.OmitArgPrefixes] = dataclasses.field(default_factory=Logs)
    # settings of PPO
    config: Annotated[TrainConfig, tyro.conf.OmitArgPrefixes] = dataclasses.field(default_factory=TrainConfig)


def read_command(arguments: list[str]) -> Command:
    """Reads a command line; defaults follow from the task, memory and preset that it names.

    Raises:
        ConfigError: There is no such task, memory or preset; or the file that `--config` names is wrong.
    """
    return _read_words(insert_file(arguments, _read_words))


def _read_words(arguments: list[str]) -> Command:
    """Reads a command line without looking into the file that it may name."""
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--task", default=DEFAULT_TASK)
    early.add_argument("--memory", default="none")
    early.add_argument("--preset")
    named, _ = early.parse_known_args(arguments)
    preset = named.preset or ("cpu" if jax.default_backend() == "cpu" else "gpu")
    task = require_task(named.task)
    config = make_config(task, preset, named.memory)
    default = with_weights(Command(out=tyro.MISSING, preset=preset, config=config), task_reward(task))
    return tyro.cli(
        type(default),
        args=arguments,
        default=default,
        prog="python -m train",
        description=_DESCRIPTION,
        config=(tyro.conf.FlagCreatePairsOff,),
    )


def command(arguments: Command) -> int:
    """Trains, then draws the curve and evaluates the policy that was kept.

    Returns:
        Exit status: 0, or 130 after Ctrl-C, with the checkpoint saved.
    """
    check(arguments.config)
    if arguments.evaluation_episodes:
        check_episodes(arguments.evaluation_episodes, "evaluation_episodes")
    check_seeds(arguments.seeds)
    clock.lap("import")
    world = with_reward(_world(arguments), reward_of(arguments))
    clock.lap("tunnel")
    status = _several(arguments, world) if arguments.seeds else _one(arguments, world)
    print(clock.line(), file=sys.stderr)
    return status


def _world(arguments: Command) -> World:
    """Opens the task for the robot that is to do it."""
    if arguments.motion != "b2":
        return open_world(
            arguments.task,
            arguments.tunnel,
            arguments.lining,
            arguments.sensor,
            arguments.val,
            arguments.preset,
            arguments.hidden_start,
            arguments.intensity,
            arguments.texture,
            arguments.motion,
        )
    for name, usual in (("sensor", "planar16"), ("intensity", False), ("hidden_start", False), ("val", None)):
        if (given := getattr(arguments, name)) != usual:
            raise ConfigError(f"{name} = {given} is not for motion = b2; with it, it is {usual}")
    from train.b2 import embodied  # MuJoCo is loaded only where legs are meant

    return embodied.open_world(arguments.task, arguments.tunnel, arguments.lining)


def _one(arguments: Command, world: World) -> int:
    learner = make_learner(world, arguments.config)
    session = Session(arguments.out, world, learner, logs=arguments.logs, command=settings_of(arguments))
    started = time.perf_counter()
    last = session.train(resume=arguments.resume, overwrite=arguments.overwrite)
    if last is None:
        return EXIT_INTERRUPTED
    if arguments.evaluation_episodes:
        session.score(last, arguments.evaluation_episodes)
        clock.lap("evaluate")
    _report(last, time.perf_counter() - started, world.covers)
    return 0


def _several(arguments: Command, world: World) -> int:
    sessions = []
    if arguments.config.parts > 1:
        raise ConfigError(f"parts = {arguments.config.parts} cannot be trained for several seeds at once")
    first = make_learner(world, arguments.config)
    for seed in arguments.seeds:
        learner, out = with_seed(first, seed), arguments.out / f"seed-{seed}"
        alone = settings_of(dataclasses.replace(arguments, config=learner.config))
        sessions.append(Session(out, world, learner, logs=arguments.logs, command=alone))
    return run_seeds(
        arguments.out,
        sessions,
        resume=arguments.resume,
        overwrite=arguments.overwrite,
        episodes=arguments.evaluation_episodes,
    )


def _report(snapshot: Snapshot, seconds: float, covers: bool) -> None:
    coverage, success = snapshot.window.mean("coverage"), snapshot.window.mean("success")
    if coverage is None or success is None:
        print(f"no episode has finished in {seconds:.0f} s of training; more --steps are needed")
        return
    covered = f"coverage {100.0 * coverage:.2f} %, " if covers else ""
    print(
        f"last {len(snapshot.window.last)} training episodes: {covered}success {100.0 * success:.0f} %; "
        f"{snapshot.window.count} episodes in {seconds:.0f} s"
    )


def main() -> None:
    """Runs `python -m train`."""
    sys.exit(run_command(lambda: command(parse(read_command))))


if __name__ == "__main__":
    main()
