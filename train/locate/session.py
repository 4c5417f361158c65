"""A training of one or several localisers at once: iterations, log, checkpoints, scores."""

import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from subterra_jax.host.files import replace_file
from train import tunnels
from train.checkpoint import has_checkpoint, load_checkpoint, save_checkpoint
from train.locate import keeping, scores
from train.locate.command import Command, check, identity
from train.locate.learner import LocateLearner
from train.sinks import Board

VAL_SEED = 2**20


def run(arguments: Command) -> None:
    """Trains, saves and scores.

    Raises:
        ConfigError: A setting is wrong, or a run to go on with was begun with others.
        RunFolderError: The folder holds a run, and neither `resume` nor `overwrite` is said.
        SubterraError: There is no such task or tunnel, or a folder cannot be written.
    """
    check(arguments)
    keeping.check_folder(arguments)
    started = time.monotonic()
    everything = tunnels.load(
        tunnels.names_of(arguments.tunnels) + tunnels.names_of(arguments.val),
        None,
        arguments.cache,
        arguments.sensor,
    )
    n_train = len(tunnels.names_of(arguments.tunnels))
    env, params = tunnels.enter(arguments.task, everything[:n_train], arguments.sensor)
    val_env, val_params = tunnels.enter(arguments.task, everything[n_train:], arguments.sensor)
    maps: Any = (None, None)
    if arguments.config.map:
        maps = (
            tunnels.map_of(everything[:n_train], params.tunnel),
            tunnels.map_of(everything[n_train:], val_params.tunnel),
        )
    print(f"{len(everything)} tunnels: {time.monotonic() - started:.0f} s", flush=True)
    drives = scores.record(
        val_env, val_params, jax.random.key(VAL_SEED), arguments.drives, speed=arguments.config.speed
    )
    session = Session(arguments, env, params, drives, maps)
    begin(session, arguments)
    session.train()
    finish(session, arguments, drives)


def begin(session: "Session", arguments: Command) -> None:
    """Throws away what the folder holds of another run, and writes the settings of this one."""
    if not session.spent:
        keeping.clear(arguments.out)
    # Not before a run of other settings has been refused: it would take these for its own.
    keeping.write_config(arguments)


def finish(session: "Session", arguments: Command, drives: Any) -> None:
    """Writes and prints the scores of all seeds."""
    for index, seed in enumerate(arguments.seeds):
        folder = arguments.out / f"seed-{seed}"
        table = scores.by_kind(session.judge(index), np.asarray(drives.tunnel), tunnels.names_of(arguments.val))
        facts = {
            "config": dataclasses.asdict(arguments.config),
            "seed": seed,
            "seconds": session.spent,
            "scores": table,
        }
        with replace_file(folder / keeping.SCORES) as fresh:
            fresh.write_text(json.dumps(facts, indent=1) + "\n")
        for kind, row in table.items():
            values = {name: round(value, 3) for name, value in row.items()}
            print(arguments.config.network, f"seed {seed}", kind, values, flush=True)


class Session:
    """Training of several seeds in one compiled program, until the time is over.

    Args:
        arguments: The command.
        env: Environment to learn in.
        params: Its parameters.
        drives: Recorded drives in `val`.
        maps: Maps of the tunnels to learn in and of those of `val`, for a network that learns to take one.
    """

    def __init__(self, arguments: Command, env: Any, params: Any, drives: Any, maps: Any = (None, None)) -> None:
        self._arguments, self._env, self._params, self._drives = arguments, env, params, drives
        self._strip = maps[0]
        learner = LocateLearner(env, params, arguments.config)
        self._iterate: Any = jax.jit(jax.vmap(learner.iterate, in_axes=(0, None, None, None)), donate_argnums=0)
        self._judge: Any = scores.make_judge(arguments.config.network)
        self._val_strip = maps[1]
        self.state = jax.vmap(learner.init)(jnp.asarray(arguments.seeds))
        self.spent = 0.0  # s of training, with compiling
        if arguments.resume and has_checkpoint(arguments.out):
            self._restore()

    def weights(self, index: int) -> Any:
        """Returns the weights of a seed."""
        return jax.tree.map(lambda leaf: leaf[index], self.state.weights)

    def judge(self, index: int) -> scores.Found:
        """Returns the scores of a seed on the recorded drives."""
        return jax.device_get(self._judge(self.weights(index), self._drives, self._val_strip))

    def compile(self) -> None:
        """Compiles iteration and score, which the first of each would do otherwise."""
        left = jnp.float32(1.0)
        self._iterate = self._iterate.lower(self.state, self._params, left, self._strip).compile()
        self._judge = self._judge.lower(self.weights(0), self._drives, self._val_strip).compile()

    def train(self) -> None:
        """Trains until the time is over: logs every iteration, scores and saves now and then."""
        self.open()
        while self.spent < self._budget:
            self.turn()
        self.close()

    def open(self, budget: float | None = None) -> None:
        """Makes the folders, and forgets what they hold of after the checkpoint that is gone on from.

        Args:
            budget: Time of the training, s; None is that of the settings.
        """
        arguments = self._arguments
        self._folders = [arguments.out / f"seed-{seed}" for seed in arguments.seeds]
        for folder in self._folders:
            folder.mkdir(parents=True, exist_ok=True)
            keeping.forget(folder, self.spent)
        self._boards = [Board(folder, self._steps()) for folder in self._folders] if arguments.tensorboard else []
        self._budget = 60.0 * arguments.config.minutes if budget is None else budget
        self._compiled = 0.0 if self.spent else None
        self._told = self._saved = self.spent

    def turn(self) -> None:
        """Takes one iteration, logs it, and scores and saves where it is time."""
        before, offset = time.monotonic(), self.spent
        passed = lambda: offset + time.monotonic() - before  # noqa: E731
        left = 1.0
        if self._compiled is not None:
            left = max(self._budget - self.spent, 0.0) / max(self._budget - self._compiled, 1e-6)
        self.state, terms = self._iterate(self.state, self._params, jnp.float32(min(left, 1.0)), self._strip)
        rows = jax.device_get(terms)
        self.spent = passed()
        if self._compiled is None:
            self._compiled = self.spent
        rate = self._per_iteration() / (self.spent - offset)
        for index, folder in enumerate(self._folders):
            row = {"step": self._steps(), "seconds": round(self.spent, 2), "rate": round(rate)}
            row |= {name: float(values[index]) for name, values in rows.items()}
            keeping.append(folder / keeping.LOG, row)
            if self._boards:
                self._boards[index].write({**row, "timing": {"steps_per_second": rate}})
        if self.spent - self._told > self._arguments.score_every:
            self._score(self._folders)
            self.spent = self._told = passed()
        if self.spent - self._saved > self._arguments.save_every:
            self._save()
            self.spent = self._saved = passed()

    def close(self) -> None:
        """Scores and saves for the last time."""
        self._score(self._folders)
        self._save()
        for board in self._boards:
            board.close()

    def _score(self, folders: list[Path]) -> None:
        """Adds the scores of all seeds to their curves."""
        for index, folder in enumerate(folders):
            found = self.judge(index)
            within, error = float(np.nanmean(found["within"])), float(np.nanmedian(found["error"]))
            row = {"seconds": round(self.spent, 2), "updates": int(self.state.steps[index]), "step": self._steps()}
            maps = {name: float(np.nanmean(found[name])) for name in scores.WITH_MAP if name in found}
            keeping.append(folder / keeping.CURVE, {**row, "within": within, "error": error, **maps})
            further = "".join(f", {name} {value:.3f}" for name, value in maps.items())
            print(
                f"{self.spent:.0f} s, {folder.name}: {row['updates']} updates, {within:.3f} within 1 m{further}",
                flush=True,
            )

    def _per_iteration(self) -> int:
        return self._arguments.config.n_envs * self._arguments.config.n_steps

    def _steps(self) -> int:
        """Returns the environment steps of each seed so far."""
        config = self._arguments.config
        updates = int(self.state.steps[0])
        return updates // max(config.epochs * (config.n_envs // config.minibatch), 1) * self._per_iteration()

    def _save(self) -> None:
        """Writes a checkpoint, and the policies as they are now."""
        facts = {"seconds": self.spent, "settings": identity(self._arguments)}
        plain = dataclasses.replace(self.state, key=jax.random.key_data(self.state.key))
        save_checkpoint(self._arguments.out, int(self.state.steps[0]), {"state": plain}, facts)
        for index, seed in enumerate(self._arguments.seeds):
            place = self._arguments.out / f"seed-{seed}" / keeping.POLICY
            keeping.save(
                place, self.weights(index), int(self.state.steps[index]), seed, self._env, self._params, self._arguments
            )

    def _restore(self) -> None:
        stored = load_checkpoint(self._arguments.out)
        keeping.check_same(self._arguments, stored.facts.get("settings"))
        plain = dataclasses.replace(self.state, key=jax.random.key_data(self.state.key))
        state = jax.tree.map(jnp.asarray, stored.restore("state", plain))
        self.state = dataclasses.replace(state, key=jax.random.wrap_key_data(state.key))
        self.spent = float(stored.facts["seconds"])
