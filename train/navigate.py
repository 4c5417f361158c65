"""Trains a navigation policy: `python -m train.navigate --task Subterra/TraverseShort-v1 --out DIR`.

`--memory gru` trains one that remembers where it is, for the tasks that end with a stop at a goal, and `--teacher
oracle` lets it learn from one that knows. `--seeds 0 1 2 3 4` trains several at once, each into its own folder.
Defaults of the settings follow from the task, the memory, the teacher and the machine.
"""

import argparse
import dataclasses
import sys
import time
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import tyro

from subterra_jax.host.command import EXIT_INTERRUPTED, parse, run_command
from train import devices
from train.belief.learner import BeliefConfig, make_belief_config
from train.config import ConfigError, Legs, PPOConfig, make_config
from train.devices import Cluster
from train.evaluate import check_episodes
from train.options import insert_file, reward_of, settings_of, with_weights
from train.ppo import check_config, make_learner, seed_axes
from train.recurrent.config import (
    DistillConfig,
    RecurrentConfig,
    make_distill_config,
    make_recurrent_config,
)
from train.session import Session, check_seeds, run_seeds
from train.sinks import Logs
from train.snapshot import Snapshot
from train.world import World, open_world, require_task, task_reward, with_reward

_DEFAULT_TASK = "Subterra/TraverseShort-v1"
_MEMORIES = ("none", "gru", "map")
_DESCRIPTION = """Trains a navigation policy; defaults follow from `--task`, `--memory`, `--teacher` and `--preset`.

python -m train.navigate --task Subterra/StopAtShort-v1 --memory gru --teacher oracle --out out/stop"""


@dataclasses.dataclass(frozen=True)
class Command:
    """Trains a navigation policy; defaults follow from `--task`, `--memory`, `--teacher` and `--preset`.

    Attributes:
        out: Run folder to write: checkpoint/, config.json, log.jsonl, log.csv, episodes.csv, curve.*, evaluation.json.
        task: Task id.
        tunnel: Tunnel file, or a name: `subterra-351` (if left out), `metro`, `control`, or several of which
            each episode draws one: `open:train:0-255`.
        lining: Variant of the walls; `pockets`, or its first, if left out.
        sensor: LiDAR; `planar16` is the task's own, `avia` no image.
        memory: `none`: a perceptron over a few observations. `gru`: a network that remembers; it learns by reward, or
            with `--teacher oracle` (any baseline, policy file or run folder) from a teacher. `map`: a belief over the
            places of a known tunnel, for Relocalise.
        preset: `cpu` or `gpu`; what jax runs on if left out.
        seeds: Train these seeds at once, each into `out/seed-<k>`.
        resume: Go on from the newest checkpoint, or from the beginning.
        overwrite: Throw away the run that `out` holds.
        evaluation_episodes: Episodes of the evaluation after training, of 500.
        embodiment: `scout`, the tasks' robot; or `b2`, tried on four legs afterwards.
        settings: YAML, TOML or JSON file with options, or a run's `config.json`; options override it.
        legs: The trial of `--embodiment b2`.
        logs: Further places to log to.
        cluster: Other processes to train with.
        config: Settings of PPO.
    """

    out: Path
    task: str = _DEFAULT_TASK
    tunnel: Path | None = None
    lining: str | None = None
    sensor: Literal["planar16", "spin16x64", "vlp16", "os1-64", "avia"] = "planar16"
    memory: Literal["none", "gru", "map"] = "none"
    preset: str | None = None
    seeds: tuple[int, ...] = ()
    resume: bool = False
    overwrite: bool = False
    evaluation_episodes: int = 200
    embodiment: Literal["scout", "b2"] = "scout"
    settings: Annotated[Path | None, tyro.conf.arg(name="config")] = None
    legs: Legs = dataclasses.field(default_factory=Legs)
    logs: Annotated[Logs, tyro.conf.OmitArgPrefixes] = dataclasses.field(default_factory=Logs)
    cluster: Annotated[Cluster, tyro.conf.OmitArgPrefixes] = dataclasses.field(default_factory=Cluster)
    config: Annotated[PPOConfig, tyro.conf.OmitArgPrefixes] = dataclasses.field(default_factory=PPOConfig)


@dataclasses.dataclass(frozen=True)
class RecurrentCommand(Command):
    """Trains a policy with memory, by reward."""

    config: Annotated[RecurrentConfig, tyro.conf.OmitArgPrefixes] = dataclasses.field(  # type: ignore[assignment]
        default_factory=RecurrentConfig
    )


@dataclasses.dataclass(frozen=True)
class DistillCommand(Command):
    """Trains a policy with memory, by a teacher."""

    config: Annotated[DistillConfig, tyro.conf.OmitArgPrefixes] = dataclasses.field(  # type: ignore[assignment]
        default_factory=DistillConfig
    )


@dataclasses.dataclass(frozen=True)
class BeliefCommand(Command):
    """Trains the sensor of a policy that has the map and keeps a belief over it."""

    config: Annotated[BeliefConfig, tyro.conf.OmitArgPrefixes] = dataclasses.field(  # type: ignore[assignment]
        default_factory=BeliefConfig
    )


def read_command(arguments: list[str]) -> Command:
    """Reads a command line; defaults follow from the task, memory and preset that it names.

    Raises:
        ConfigError: There is no such task, memory or preset; or the file that `--config` names is wrong.
    """
    return _read_words(insert_file(arguments, _read_words))


def _read_words(arguments: list[str]) -> Command:
    """Reads a command line without looking into the file that it may name."""
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--task", default=_DEFAULT_TASK)
    early.add_argument("--memory", default=_MEMORIES[0])
    early.add_argument("--teacher")
    early.add_argument("--preset")
    early.add_argument("--coordinator")
    early.add_argument("--processes", type=int)
    early.add_argument("--process", type=int)
    named, _ = early.parse_known_args(arguments)
    devices.join_cluster(Cluster(named.coordinator, named.processes, named.process))
    preset = named.preset or ("cpu" if jax.default_backend() == "cpu" else "gpu")
    default = with_weights(_default(named.task, named.memory, named.teacher, preset), task_reward(named.task))
    return tyro.cli(
        type(default),
        args=arguments,
        default=default,
        prog="python -m train.navigate",
        description=_DESCRIPTION,
        config=(tyro.conf.FlagCreatePairsOff,),
    )


def _default(task: str, memory: str, teacher: str | None, preset: str) -> Command:
    """Returns the command for a task, with every setting filled in."""
    if memory not in _MEMORIES:
        raise ConfigError(f"unknown memory {memory!r}; there are {', '.join(_MEMORIES)}")
    if memory != "gru" and teacher is not None:
        raise ConfigError(f"teacher = {teacher} teaches a policy with memory; give --memory gru as well")
    config: Any
    if memory == "none":
        return Command(out=tyro.MISSING, preset=preset, config=make_config(task, preset))
    require_task(task)
    if memory == "map":
        return BeliefCommand(out=tyro.MISSING, memory="map", preset=preset, config=make_belief_config(preset))
    if teacher is None:
        config = make_recurrent_config(task, preset)
        return RecurrentCommand(out=tyro.MISSING, memory="gru", preset=preset, config=config)
    config = make_distill_config(task, preset)
    return DistillCommand(out=tyro.MISSING, memory="gru", preset=preset, config=config)


def command(arguments: Command) -> int:
    """Trains, then draws the curve and evaluates the policy that was kept.

    Returns:
        Exit status: 0, or 130 after Ctrl-C, with the checkpoint saved.
    """
    config = arguments.config
    check_config(config)
    check_episodes(arguments.evaluation_episodes, "evaluation_episodes")
    check_seeds(arguments.seeds)
    world = with_reward(_world(arguments), reward_of(arguments))
    if arguments.seeds:
        return _several(arguments, world)
    learner = make_learner(world, config)
    session = Session(arguments.out, world, learner, logs=arguments.logs, command=settings_of(arguments))
    return _train_and_score(session, arguments)


def _world(arguments: Command) -> World:
    """Opens the task for the robot that is to do it."""
    if arguments.embodiment == "scout":
        return open_world(arguments.task, arguments.tunnel, arguments.lining, arguments.sensor)
    if arguments.sensor != "planar16":
        raise ConfigError(f"sensor = {arguments.sensor}: the B2 carries planar16")
    from train.b2 import embodied  # MuJoCo is loaded only where legs are meant

    return embodied.open_world(arguments.task, arguments.tunnel, arguments.lining, arguments.legs)


def _train_and_score(session: Session, arguments: Command) -> int:
    started = time.perf_counter()
    last = session.train(resume=arguments.resume, overwrite=arguments.overwrite)
    if last is None:
        return EXIT_INTERRUPTED
    if not devices.leads():
        return 0
    session.score(last, arguments.evaluation_episodes)
    if arguments.embodiment == "b2" and arguments.legs.robots:
        from train.b2 import embodied

        embodied.score(session, last, arguments.tunnel, arguments.legs)
    _report(last, time.perf_counter() - started)
    return 0


def _several(arguments: Command, world: World) -> int:
    sessions = []
    if arguments.config.parts > 1:
        raise ConfigError(f"parts = {arguments.config.parts} cannot be trained for several seeds at once")
    for seed in arguments.seeds:
        config = dataclasses.replace(arguments.config, seed=seed)
        learner, out = make_learner(world, config, seed_axes()), arguments.out / f"seed-{seed}"
        alone = settings_of(dataclasses.replace(arguments, config=config))
        sessions.append(Session(out, world, learner, logs=arguments.logs, command=alone))
    return run_seeds(
        arguments.out,
        sessions,
        resume=arguments.resume,
        overwrite=arguments.overwrite,
        episodes=arguments.evaluation_episodes,
    )


def _report(snapshot: Snapshot, seconds: float) -> None:
    coverage, success = snapshot.window.mean("coverage"), snapshot.window.mean("success")
    if coverage is None or success is None:
        print(f"no episode has finished in {seconds:.0f} s of training; more --steps are needed")
        return
    print(
        f"last {len(snapshot.window.last)} training episodes: coverage {100.0 * coverage:.2f} %, "
        f"success {100.0 * success:.0f} %; {snapshot.window.count} episodes in {seconds:.0f} s"
    )


def main() -> None:
    """Runs `python -m train.navigate`."""
    sys.exit(run_command(lambda: command(parse(read_command))))


if __name__ == "__main__":
    main()
