"""Trains a navigation policy: `python -m train.navigate --task Subterra/TraverseShort-v0 --out DIR`."""

import argparse
import dataclasses
import sys
import time
from pathlib import Path
from typing import Annotated

import jax
import tyro

from train import cli, curve, policies, ppo, runfolder
from train.config import PPOConfig, check, make_config
from train.errors import ConfigError
from train.evaluate import EVALUATION_SEED, evaluate
from train.learner import Learner
from train.log import Bar, RunLog

_DEFAULT_TASK = "Subterra/TraverseShort-v0"


@dataclasses.dataclass(frozen=True)
class Command:
    """Trains a navigation policy by PPO. The defaults of the settings follow from `--task` and `--preset`.

    Attributes:
        out: Run folder to write: checkpoint/, config.json, log.jsonl, episodes.csv, curve.png, evaluation.json.
        task: Task id.
        tunnel: Tunnel file; the packaged tunnel if left out.
        lining: Variant of the walls.
        preset: `cpu` or `gpu`; what jax runs on if left out.
        resume: Go on from the checkpoint in `out`; only the limits on training may differ.
        overwrite: Throw away the run that `out` holds.
        evaluation_episodes: Episodes of the evaluation after training.
        config: Settings of PPO.
    """

    out: Path
    task: str = _DEFAULT_TASK
    tunnel: Path | None = None
    lining: str = "pockets"
    preset: str | None = None
    resume: bool = False
    overwrite: bool = False
    evaluation_episodes: int = 200
    config: Annotated[PPOConfig, tyro.conf.OmitArgPrefixes] = dataclasses.field(default_factory=PPOConfig)


def parse(arguments: list[str]) -> Command:
    """The command line, with the defaults of the task and preset that it names itself.

    Raises:
        ConfigError: There is no such task or preset.
    """
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--task", default=_DEFAULT_TASK)
    early.add_argument("--preset", default=None)
    named, _ = early.parse_known_args(arguments)
    preset = named.preset or ("cpu" if jax.default_backend() == "cpu" else "gpu")
    default = make_config(named.task, preset)
    return tyro.cli(Command, args=arguments, default=Command(out=tyro.MISSING, preset=preset, config=default))


def command(arguments: Command) -> int:
    """Trains, then draws the curve and evaluates the best policy.

    Returns:
        Exit status: 0, or 130 after Ctrl-C, with the checkpoint saved.
    """
    config = check(arguments.config)
    if arguments.evaluation_episodes < 1:
        raise ConfigError(f"evaluation_episodes must be at least 1, got {arguments.evaluation_episodes}")
    world = policies.open_world(arguments.task, arguments.tunnel, arguments.lining)
    learner = Learner(world.env, world.params, config)
    run = runfolder.RunFolder(arguments.out, world, learner)
    snapshot = None
    if arguments.resume:
        snapshot = run.resume()
    else:
        run.start(overwrite=arguments.overwrite)

    started = time.perf_counter()
    log = RunLog(run.path, snapshot.iteration if snapshot else 0, snapshot.window.count if snapshot else 0)
    bar = Bar(config.steps, snapshot.iteration * config.steps_per_iteration if snapshot else 0)
    with cli.deferred_interrupt() as interrupt:

        def watch(now: ppo.Snapshot) -> bool:
            log.write(now.record, now.rows)
            bar.show(now.record)
            if now.iteration % config.checkpoint_every == 0 or interrupt.wanted:
                run.save(now)
            return interrupt.wanted

        try:
            snapshot = ppo.train(world.env, world.params, config, learner=learner, snapshot=snapshot, watch=watch)
        finally:
            bar.close()
            log.close()
        run.save(snapshot)
        curve.write_curve([run.path], run.path / "curve.png")
        if interrupt.wanted:
            print(f"interrupted after {snapshot.iteration} iterations; go on with --resume", file=sys.stderr)
            return cli.EXIT_INTERRUPTED

    scores = evaluate(
        world.env,
        world.params,
        learner.networks,
        snapshot.policy,
        arguments.evaluation_episodes,
        EVALUATION_SEED,
    )
    run.write_json("evaluation.json", {"schema": "subterra.evaluation/1", **world.facts, **scores})
    cli.table(f"{world.task}, seed {config.seed}: best policy, no exploration noise", scores)
    _tell(snapshot, time.perf_counter() - started)
    return 0


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
