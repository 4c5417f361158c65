"""Trains a navigation policy: `python -m train.navigate --task Subterra/TraverseShort-v0 --out DIR`.

`--memory gru` trains one that remembers where it is, for the tasks that end with a stop at a goal; `--seeds 0 1 2 3 4`
trains several at once, each into a folder of its own.
"""

import argparse
import dataclasses
import sys
import time
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import tyro

from train import cli, cluster, policies, ppo, recurrent, seeds, spread
from train.cluster import Cluster
from train.config import PPOConfig, TrainConfig, check, make_config
from train.errors import ConfigError
from train.evaluate import check_episodes
from train.learner import Learner
from train.log import Bar
from train.recurrent.config import RecurrentConfig
from train.session import Session

_DEFAULT_TASK = "Subterra/TraverseShort-v0"
_MEMORIES = ("none", "gru")


@dataclasses.dataclass(frozen=True)
class Command:
    """Trains a navigation policy by PPO. The defaults of the settings follow from `--task`, `--memory` and `--preset`.

    Attributes:
        out: Run folder to write: checkpoint/, config.json, log.jsonl, episodes.csv, curve.png, evaluation.json.
        task: Task id.
        tunnel: Tunnel file, or a name: `subterra-351` (if left out), `metro-asbuilt`, `control`, `procedural:train:7`,
            or of several `procedural:train:0-255`, of which each episode draws one.
        lining: Variant of the walls; `pockets` if left out, or the first where a tunnel has none.
        memory: `none`: a perceptron over a few observations. `gru`: a network that remembers, with an estimation head.
        preset: `cpu` or `gpu`; what jax runs on if left out.
        seeds: Train these seeds at once, into `out/seed-<k>`, and draw them together; one run of `--seed` if left out.
        resume: Go on from the checkpoint in `out`; only the limits on training may differ.
        overwrite: Throw away the run that `out` holds.
        evaluation_episodes: Episodes of the evaluation after training, the first of the task's 500.
        cluster: Other processes to train with.
        config: Settings of PPO.
    """

    out: Path
    task: str = _DEFAULT_TASK
    tunnel: Path | None = None
    lining: str | None = None
    memory: Literal["none", "gru"] = "none"
    preset: str | None = None
    seeds: tuple[int, ...] = ()
    resume: bool = False
    overwrite: bool = False
    evaluation_episodes: int = 200
    cluster: Annotated[Cluster, tyro.conf.OmitArgPrefixes] = dataclasses.field(default_factory=Cluster)
    config: Annotated[PPOConfig, tyro.conf.OmitArgPrefixes] = dataclasses.field(default_factory=PPOConfig)


@dataclasses.dataclass(frozen=True)
class RecurrentCommand(Command):
    """The same for a policy with memory."""

    config: Annotated[RecurrentConfig, tyro.conf.OmitArgPrefixes] = dataclasses.field(  # type: ignore[assignment]
        default_factory=RecurrentConfig
    )


def parse(arguments: list[str]) -> Command:
    """The command line, with the defaults of the task, memory and preset that it names itself.

    Raises:
        ConfigError: There is no such task, memory or preset.
    """
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--task", default=_DEFAULT_TASK)
    early.add_argument("--memory", default=_MEMORIES[0])
    early.add_argument("--preset", default=None)
    early.add_argument("--coordinator")
    early.add_argument("--processes", type=int)
    early.add_argument("--process", type=int)
    named, _ = early.parse_known_args(arguments)
    cluster.join(Cluster(named.coordinator, named.processes, named.process))
    preset = named.preset or ("cpu" if jax.default_backend() == "cpu" else "gpu")
    if named.memory not in _MEMORIES:
        raise ConfigError(f"unknown memory {named.memory!r}; there are {', '.join(_MEMORIES)}")
    if named.memory == "gru":
        policies.known_task(named.task)
        remembering: Any = recurrent.config.make_config(named.task, preset)
        default: Command = RecurrentCommand(out=tyro.MISSING, memory="gru", preset=preset, config=remembering)
    else:
        default = Command(out=tyro.MISSING, preset=preset, config=make_config(named.task, preset))
    return tyro.cli(type(default), args=arguments, default=default)


def make_learner(world: policies.World, config: TrainConfig, axes: tuple[str, ...] = ()) -> ppo.Trainable:
    """What trains with such settings.

    Raises:
        ConfigError: A setting makes no sense, or no such network can learn this task.
    """
    spreads = config.parts > 1
    names = ((spread.PART,), spread.SPLIT) if spreads else (axes,)
    learner: Any
    if isinstance(config, RecurrentConfig):
        learner = recurrent.learner.RecurrentLearner(world.env, world.params, config, *names)
    else:
        assert isinstance(config, PPOConfig)
        learner = Learner(world.env, world.params, config, *names)
    return spread.Spread(learner) if spreads else learner


def command(arguments: Command) -> int:
    """Trains, then draws the curve and evaluates the policy that was kept.

    Returns:
        Exit status: 0, or 130 after Ctrl-C, with the checkpoint saved.
    """
    config = arguments.config
    if isinstance(config, RecurrentConfig):
        recurrent.config.check(config)
    else:
        check(config)
    check_episodes(arguments.evaluation_episodes, "evaluation_episodes")
    seeds.check(arguments.seeds)
    world = policies.open_world(arguments.task, arguments.tunnel, arguments.lining)
    if arguments.seeds:
        return _several(arguments, world)
    session = Session(arguments.out, world, make_learner(world, config))
    snapshot = session.folder.begin(resume=arguments.resume, overwrite=arguments.overwrite)
    return _single(session, snapshot, arguments.evaluation_episodes)


def _single(session: Session, snapshot: ppo.Snapshot | None, episodes: int) -> int:
    started, config, world = time.perf_counter(), session.learner.config, session.world
    session.open(snapshot)
    bar = Bar(config.steps, snapshot.iteration * config.steps_per_iteration if snapshot else 0)
    with cli.deferred_interrupt() as interrupt:

        def watch(now: ppo.Snapshot) -> bool:
            # Processes that train together stop together: at the end.
            stop = interrupt.wanted and jax.process_count() == 1
            if cluster.leads():
                bar.show(now.record)
            session.note(now, save=stop)
            return stop

        try:
            last = ppo.train(world.env, world.params, config, learner=session.learner, snapshot=snapshot, watch=watch)
        finally:
            bar.close()
            session.close()
        session.finish(last)
        if interrupt.wanted:
            print(f"interrupted after {last.iteration} iterations; go on with --resume", file=sys.stderr)
            return cli.EXIT_INTERRUPTED
    if not cluster.leads():
        return 0
    session.score(last, episodes)
    _tell(last, time.perf_counter() - started)
    return 0


def _several(arguments: Command, world: policies.World) -> int:
    sessions = []
    if arguments.config.parts > 1:
        raise ConfigError(f"parts = {arguments.config.parts} cannot be trained for several seeds at once")
    for seed in arguments.seeds:
        config = dataclasses.replace(arguments.config, seed=seed)
        sessions.append(Session(arguments.out / f"seed-{seed}", world, make_learner(world, config, seeds.axes())))
    return seeds.run(
        arguments.out,
        sessions,
        resume=arguments.resume,
        overwrite=arguments.overwrite,
        episodes=arguments.evaluation_episodes,
    )


def _tell(snapshot: ppo.Snapshot, seconds: float) -> None:
    coverage, success = snapshot.window.mean("coverage"), snapshot.window.mean("success")
    if coverage is None or success is None:
        print(f"no episode has finished in {seconds:.0f} s of training; more --steps are needed")
        return
    print(
        f"last {len(snapshot.window.last)} training episodes: coverage {100.0 * coverage:.2f} %, "
        f"success {100.0 * success:.0f} %; {snapshot.window.count} episodes in {seconds:.0f} s"
    )


def main() -> None:
    """Entry point of `python -m train.navigate`."""
    cli.run(lambda: command(parse(sys.argv[1:])))


if __name__ == "__main__":
    main()
