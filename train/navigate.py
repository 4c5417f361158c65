"""Trains a navigation policy: `python -m train.navigate --task Subterra/TraverseShort-v0 --out DIR`.

`--memory gru` trains one that remembers where it is, for the tasks that end with a stop at a goal, and `--teacher
oracle` lets it learn from somebody who knows; `--seeds 0 1 2 3 4` trains several at once, each into its own folder.
"""

import dataclasses
import sys
import time

import jax

from subterra_jax.host.command import EXIT_INTERRUPTED, parse, run_command
from train import cli, policies, ppo, seeds
from train.commandline import Command, read_command
from train.devices import cluster
from train.errors import ConfigError
from train.evaluate import check_episodes
from train.learners import checked, make_learner
from train.run.log import Bar
from train.run.session import Session
from train.run.snapshot import Snapshot


def command(arguments: Command) -> int:
    """Trains, then draws the curve and evaluates the policy that was kept.

    Returns:
        Exit status: 0, or 130 after Ctrl-C, with the checkpoint saved.
    """
    config = arguments.config
    checked(config)
    check_episodes(arguments.evaluation_episodes, "evaluation_episodes")
    seeds.check(arguments.seeds)
    world = _world(arguments)
    if arguments.seeds:
        return _several(arguments, world)
    session = Session(arguments.out, world, make_learner(world, config), tensorboard=arguments.tensorboard)
    snapshot = session.folder.begin(resume=arguments.resume, overwrite=arguments.overwrite)
    return _single(session, snapshot, arguments)


def _world(arguments: Command) -> policies.World:
    """The task, for the robot that is to do it."""
    if arguments.embodiment == "scout":
        return policies.open_world(arguments.task, arguments.tunnel, arguments.lining)
    from train.b2 import embodied  # MuJoCo is loaded only where legs are meant

    return embodied.open_world(arguments.task, arguments.tunnel, arguments.lining, arguments.legs)


def _single(session: Session, snapshot: Snapshot | None, arguments: Command) -> int:
    started, config, world = time.perf_counter(), session.learner.config, session.world
    session.open(snapshot)
    bar = Bar(config.steps, snapshot.iteration * config.steps_per_iteration if snapshot else 0)
    with cli.deferred_interrupt() as interrupt:

        def watch(now: Snapshot) -> bool:
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
            return EXIT_INTERRUPTED
    if not cluster.leads():
        return 0
    session.score(last, arguments.evaluation_episodes)
    if arguments.embodiment == "b2" and arguments.legs.robots:
        from train.b2 import embodied

        embodied.score(session, last, arguments.tunnel, arguments.legs)
    _tell(last, time.perf_counter() - started)
    return 0


def _several(arguments: Command, world: policies.World) -> int:
    sessions = []
    if arguments.config.parts > 1:
        raise ConfigError(f"parts = {arguments.config.parts} cannot be trained for several seeds at once")
    for seed in arguments.seeds:
        config = dataclasses.replace(arguments.config, seed=seed)
        learner, out = make_learner(world, config, seeds.axes()), arguments.out / f"seed-{seed}"
        sessions.append(Session(out, world, learner, tensorboard=arguments.tensorboard))
    return seeds.run(
        arguments.out,
        sessions,
        resume=arguments.resume,
        overwrite=arguments.overwrite,
        episodes=arguments.evaluation_episodes,
    )


def _tell(snapshot: Snapshot, seconds: float) -> None:
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
    sys.exit(run_command(lambda: command(parse(read_command))))


if __name__ == "__main__":
    main()
