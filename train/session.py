"""The host's side of a run, or of several seeds at once: folder, log, checkpoints, curve, evaluation and summary."""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from subterra_jax.evaluation.episodes import SHA256
from subterra_jax.host.command import EXIT_INTERRUPTED
from subterra_jax.host.files import replace_file
from train import clock
from train.checkpoint import iterations
from train.config import ConfigError
from train.curve import GOAL, write_curve
from train.evaluate import evaluate
from train.folder import RunFolder
from train.log import Bar, RunLog, deferred_interrupt, print_table, read_log
from train.policies import make_agent
from train.ppo import train_seeds
from train.sinks import NO_LOGS, Logs, Sink
from train.snapshot import WINDOW, Snapshot, Trainable, finished
from train.world import World

EVALUATION = "evaluation.json"


class Session:
    """One run, from the command to its figures.

    Args:
        path: Run folder.
        world: World to train on.
        learner: Learner to train.
        logs: Further places to log to.
        command: As for `RunFolder`.

    Raises:
        ConfigError: A library that `logs` asks for is not installed.
        OutputError: No folder can be written there.
    """

    def __init__(
        self, path: Path, world: World, learner: Trainable, *, logs: Logs = NO_LOGS, command: Any = None
    ) -> None:
        self.folder, self.world, self.learner = RunFolder(path, world, learner, command), world, learner
        self.log: RunLog | None = None
        self._logs = logs.checked()
        self._sinks: list[Sink] = []

    def open(self, snapshot: Snapshot | None) -> None:
        """Begins to log, after a snapshot or from the beginning."""
        iteration, episodes = (snapshot.iteration, snapshot.window.count) if snapshot else (0, 0)
        self.log = RunLog(self.folder.path, iteration, episodes)
        step = iteration * self.learner.config.steps_per_iteration
        self._sinks = self._logs.open(self.folder.path, step, dataclasses.asdict(self.learner.config))

    def train(self, *, resume: bool, overwrite: bool, label: str = "") -> Snapshot | None:
        """Trains the run to its end, then writes the last checkpoint and the curve.

        Args:
            resume: Go on from the folder's checkpoint.
            overwrite: Throw away the run that the folder holds.
            label: Name of the run in the progress bar.

        Returns:
            The last snapshot; None after Ctrl-C, with the checkpoint saved.
        """
        last = train_sessions([self], [self.folder.begin(resume=resume, overwrite=overwrite)], [label])
        write_curve([self.folder.path], self.folder.path / "curve.png")
        clock.lap("curve")
        return None if last is None else last[0]

    def note(self, now: Snapshot, *, save: bool = False) -> None:
        """Logs an iteration; writes a checkpoint where one is due, or asked for."""
        if self.log is not None:
            self.log.write(now.record, now.rows)
        for sink in self._sinks:
            sink.write(now.record)
        if save or now.iteration % self.learner.config.checkpoint_every == 0:
            self.folder.save(now)

    def close(self) -> None:
        """Closes the log."""
        for open_log in (self.log, *self._sinks):
            if open_log is not None:
                open_log.close()
        self.log, self._sinks = None, []

    def finish(self, snapshot: Snapshot) -> None:
        """Writes the last checkpoint, unless it has been written."""
        if not self.folder.has(snapshot.iteration):
            self.folder.save(snapshot)

    def score(self, snapshot: Snapshot, episodes: int) -> dict[str, Any]:
        """Evaluates the policy that was kept, writes `evaluation.json`, and prints the scores."""
        agent = make_agent(self.learner.driver, snapshot.policy)
        found = evaluate(self.world.scored(), agent, episodes)
        self.folder.write_json(EVALUATION, {"schema": "subterra.evaluation/1", **self.world.facts, **found})
        kept = "best" if self.learner.config.KEEPS_BEST else "last"
        table = {name: value for name, value in found.items() if value is not None and value != SHA256}
        print_table(f"{self.world.task}, seed {self.learner.config.seed}: {kept} policy, no exploration noise", table)
        return found


def check_seeds(seeds: tuple[int, ...]) -> None:
    """Raises `ConfigError` for a seed below 0 or one that is named twice."""
    for seed in seeds:
        if seed < 0:
            raise ConfigError(f"seeds must not be negative, got {seed}")
        if seeds.count(seed) > 1:
            raise ConfigError(f"seed {seed} is named {seeds.count(seed)} times")


def train_sessions(
    sessions: list[Session], snapshots: list[Snapshot | None], labels: list[str]
) -> list[Snapshot] | None:
    """Trains runs that differ by their seed to their end, each from its snapshot; None after Ctrl-C, all saved."""
    config = sessions[0].learner.config
    for session, snapshot in zip(sessions, snapshots, strict=True):
        session.open(snapshot)
    done = max((s.iteration for s in snapshots if s), default=0) * config.steps_per_iteration
    bar = Bar(config.steps, done, sessions[0].world.covers)
    with deferred_interrupt() as interrupt:

        def stop() -> bool:
            return interrupt.needed

        def watch(k: int, now: Snapshot) -> None:
            bar.show(now.record, of=labels[k])
            sessions[k].note(now, save=stop())

        try:
            last = train_seeds([s.learner for s in sessions], sessions[0].world.params, snapshots, watch, stop)
        finally:
            bar.close()
            for session in sessions:
                session.close()
        for session, snapshot in zip(sessions, last, strict=True):
            session.finish(snapshot)
        if interrupt.needed:
            done = max(snapshot.iteration for snapshot in last)
            print(f"interrupted after {done} iterations; go on with --resume", file=sys.stderr)
            return None
    return last


def run_seeds(out: Path, sessions: list[Session], *, resume: bool, overwrite: bool, episodes: int) -> int:
    """Trains, draws and evaluates every seed; prints what each took to reach the goal.

    Returns:
        Exit status: 0, or 130 after Ctrl-C, with the checkpoints saved.
    """
    snapshots = (
        resume_seeds(sessions) if resume else [s.folder.begin(resume=False, overwrite=overwrite) for s in sessions]
    )
    last = train_sessions(sessions, snapshots, [f"seed {session.learner.config.seed}" for session in sessions])
    write_curve([session.folder.path for session in sessions], out / "curve.png")
    clock.lap("curve")
    if last is None:
        return EXIT_INTERRUPTED
    if not episodes:
        return 0
    found = [session.score(snapshot, episodes) for session, snapshot in zip(sessions, last, strict=True)]
    clock.lap("evaluate")
    write_summary(out, [session.folder.path for session in sessions], found, sessions[0].world.covers)
    return 0


def resume_seeds(sessions: list[Session]) -> list[Snapshot | None]:
    """Returns the snapshot of every seed; of those that are not done, the last iteration that they have in common.

    They begin at the beginning where they have none: a kill came between their first checkpoints.
    """
    found: list[Snapshot | None] = [session.folder.begin(resume=True, overwrite=False) for session in sessions]
    behind = [k for k, s in enumerate(found) if s is None or not finished(s, sessions[k].learner.config)]
    common = set.intersection(*[set(iterations(sessions[k].folder.path)) for k in behind]) if behind else set()
    for k in behind:
        if not common:
            sessions[k].folder.start()
        found[k] = sessions[k].folder.resume(max(common)) if common else None
    return found


SEEDS = "seeds.json"
_UNIT = {"episodes": 1.0, "steps": 1e3, "seconds": 1.0, "seconds_compiled": 1.0}
_WHAT = tuple(_UNIT)


def reached(run: Path) -> dict[str, float] | None:
    """Finds when the rolling hundred of a run first met the goal; None if it never did.

    Returns:
        `episodes` and `steps` until then, `seconds` with compilation and `seconds_compiled` without.
    """
    for line in read_log(run):
        full = line["episodes"] >= WINDOW
        if full and line["coverage_mean_100"] >= GOAL and line["success_mean_100"] == 1.0:
            seconds = line["timing"]["seconds"]
            return {
                "episodes": line["episodes"],
                "steps": line["step"],
                "seconds": seconds,
                "seconds_compiled": seconds - line["timing"]["compile_seconds"],
            }
    return None


def write_summary(out: Path, runs: list[Path], scores: list[dict[str, Any]], covers: bool) -> None:
    """Prints a line for each seed and their mean ± standard deviation; writes `seeds.json`."""
    rows: list[dict[str, Any]] = [
        {"run": run.name, "reached": reached(run), "last": read_log(run)[-1], "evaluation": found}
        for run, found in zip(runs, scores, strict=True)
    ]
    summary = _mean_and_spread(rows)
    Console().print(_table(rows, summary) if covers else _success_table(rows))
    with replace_file(out / SEEDS) as fresh:
        content = {"schema": "subterra.seeds/1", "goal": GOAL, "mean_sd": summary, "runs": rows}
        fresh.write_text(json.dumps(content) + "\n")


def _table(rows: list[dict[str, Any]], summary: dict[str, tuple[float, float]]) -> Table:
    """Makes a table with a line for each seed, narrow enough for 80 columns."""
    grid = Table(title=f"to {100 * GOAL:.0f} % coverage and 100 % success of the last {WINDOW}; at the end")
    for heading in ("run", "episodes", "k steps", "s", "s compiled", "coverage %", "success %"):
        grid.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        when = [f"{row['reached'][name] / _UNIT[name]:,.1f}" for name in _WHAT] if row["reached"] else ["never"] * 4
        covered = row["last"]["coverage_mean_100"]
        last = "none yet" if covered is None else f"{100 * covered:.2f}"
        grid.add_row(row["run"], *when, last, f"{100 * row['evaluation']['success']:.1f}")
    grid.add_section()
    spread = [[f"{summary[name][k] / _UNIT[name]:,.1f}" for name in summary] for k in (0, 1)]
    grid.add_row("mean", *spread[0])
    grid.add_row("± sd", *spread[1])
    return grid


def _success_table(rows: list[dict[str, Any]]) -> Table:
    """Makes the table of a task with a goal, where success says all."""
    grid = Table(title=f"success, %: of the last {WINDOW} training episodes, and of the evaluation")
    for heading in ("run", "k steps", "s", "training", "evaluation"):
        grid.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        last, found = row["last"], 100 * row["evaluation"]["success"]
        training = "none yet" if last["success_mean_100"] is None else f"{100 * last['success_mean_100']:.0f}"
        grid.add_row(
            row["run"], f"{last['step'] / 1e3:,.0f}", f"{last['timing']['seconds']:,.0f}", training, f"{found:.1f}"
        )
    scores = np.array([100 * row["evaluation"]["success"] for row in rows])
    grid.add_section()
    grid.add_row("mean ± sd", "", "", "", f"{scores.mean():.1f} ± {scores.std(ddof=min(1, len(rows) - 1)):.1f}")
    return grid


def _mean_and_spread(rows: list[dict[str, Any]]) -> dict[str, tuple[float, float]]:
    """Returns mean and standard deviation over the seeds that reached the goal; empty if none did."""
    found = [row["reached"] for row in rows if row["reached"]]
    spread = {name: np.array([row[name] for row in found], float) for name in _WHAT} if found else {}
    return {name: (float(v.mean()), float(v.std(ddof=min(1, len(v) - 1)))) for name, v in spread.items()}
