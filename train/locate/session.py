"""A training of one or several localisers at once: tunnels, iterations, log, checkpoints, policies, scores."""

import dataclasses
import hashlib
import json
import shutil
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy
import tyro

from subterra_jax.host.files import replace_file, require_folder
from subterra_jax.policies import TRAINED_UNDER, PolicyError, training_conditions
from subterra_jax.policies.files import SCHEMA
from subterra_jax.policies.locate.agent import KIND, flat
from train.checkpoint import FOLDER, has_checkpoint, load_checkpoint, remove_folder, save_checkpoint
from train.config import ConfigError, at_least, positive
from train.folder import RunFolderError
from train.locate import scores, tunnels
from train.locate.learner import LocateConfig, LocateLearner
from train.options import settings_of
from train.policies import facts_file
from train.sinks import TENSORBOARD, Board, check_tensorboard
from train.world import library_versions

POLICY, LOG, CURVE, SCORES, CONFIG = "policy.safetensors", "log.jsonl", "curve.jsonl", "scores.json", "config.json"
_KINDS = ("straight", "cast", "sprayed", "masonry")
VAL_SEED = 2**20


@dataclasses.dataclass(frozen=True)
class Command:
    """Trains localisers, and scores them on drives in `val` on the way.

    Attributes:
        out: Folder with one `seed-<k>` for each seed (`policy.safetensors` and its facts, `log.jsonl`, `curve.jsonl`
            with scores on `val` against time, `scores.json`), with `config.json` and `checkpoint/`.
        task: Task that is driven, one that starts facing growing stations.
        sensor: The LiDAR, by name: `planar16`, or a spinning one as `spin16x64`.
        tunnels: Tunnels to learn in.
        val: Tunnels to score in.
        drives: Drives of the score, the same for every seed and network.
        seeds: Seeds of weights and drives, trained at once.
        cache: Folder in which made tunnels are kept from run to run.
        score_every: Time between two scores, s.
        save_every: Time between two checkpoints, s.
        resume: Go on from the newest checkpoint, or from the beginning.
        overwrite: Throw away the run that `out` holds.
        tensorboard: Write the log for TensorBoard as well.
        settings: YAML, TOML or JSON file with options, or a run's `config.json`; options override it.
        config: Settings.
    """

    out: Path
    task: str = "Subterra/StopAt-v1"
    sensor: str = tunnels.PLANAR
    tunnels: str = ",".join(f"open:{kind}:train:0-15" for kind in _KINDS)
    val: str = ",".join(f"open:{kind}:val:0-9" for kind in _KINDS)
    drives: int = 512
    seeds: tuple[int, ...] = (0,)
    cache: Path | None = None
    score_every: float = 15.0
    save_every: float = 60.0
    resume: bool = False
    overwrite: bool = False
    tensorboard: bool = False
    settings: Annotated[Path | None, tyro.conf.arg(name="config")] = None
    config: Annotated[LocateConfig, tyro.conf.OmitArgPrefixes] = dataclasses.field(default_factory=LocateConfig)


def check(arguments: Command) -> None:
    """Refuses settings that cannot be trained with.

    Raises:
        ConfigError: A number is out of range, a network unknown, a seed twice, or a library missing.
    """
    config = arguments.config
    at_least(config, 1, "n_envs", "minibatch", "chunk", "epochs")
    at_least(config, 200, "n_steps")
    positive(config, "learning_rate", "max_grad_norm", "minutes")
    for name in ("hidden", "wrong"):
        if not 0.0 <= getattr(config, name) < 1.0:
            raise ConfigError(f"{name} must be at least 0 and below 1, got {getattr(config, name)}")
    if config.map and arguments.sensor != tunnels.PLANAR:
        raise ConfigError(f"a map is of the walls in the plane of {tunnels.PLANAR}; {arguments.sensor} sees others")
    if config.n_envs % config.minibatch:
        raise ConfigError(f"n_envs = {config.n_envs} must be a multiple of minibatch = {config.minibatch}")
    at_least(arguments, 1, "drives")
    positive(arguments, "score_every", "save_every")
    if len(set(arguments.seeds)) != len(arguments.seeds) or not arguments.seeds or min(arguments.seeds) < 0:
        raise ConfigError(f"seeds must differ and be at least 0, got {' '.join(map(str, arguments.seeds)) or 'none'}")
    try:
        LocateLearner.check(config)
    except (ValueError, PolicyError) as error:
        raise ConfigError(str(error)) from error
    if arguments.tensorboard:
        check_tensorboard()


def run(arguments: Command) -> None:
    """Trains, saves and scores.

    Raises:
        ConfigError: A setting is wrong, or a run to go on with was begun with others.
        RunFolderError: The folder holds a run, and neither `resume` nor `overwrite` is said.
        SubterraError: There is no such task or tunnel, or a folder cannot be written.
    """
    check(arguments)
    check_folder(arguments)
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
    drives = scores.record(val_env, val_params, jax.random.key(VAL_SEED), arguments.drives)
    session = Session(arguments, env, params, drives, maps)
    begin(session, arguments)
    session.train()
    finish(session, arguments, drives)


def begin(session: "Session", arguments: Command) -> None:
    """Throws away what the folder holds of another run, and writes the settings of this one."""
    if not session.spent:
        _clear(arguments.out)
    _write_config(arguments)  # not before a run of other settings has been refused: it would take these for its own


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
        with replace_file(folder / SCORES) as fresh:
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
            _forget(folder, self.spent)
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
            _append(folder / LOG, row)
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
            _append(folder / CURVE, {**row, "within": within, "error": error, **maps})
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
        facts = {"seconds": self.spent, "settings": _identity(self._arguments)}
        plain = dataclasses.replace(self.state, key=jax.random.key_data(self.state.key))
        save_checkpoint(self._arguments.out, int(self.state.steps[0]), {"state": plain}, facts)
        for index, seed in enumerate(self._arguments.seeds):
            place = self._arguments.out / f"seed-{seed}" / POLICY
            save(
                place, self.weights(index), int(self.state.steps[index]), seed, self._env, self._params, self._arguments
            )

    def _restore(self) -> None:
        stored = load_checkpoint(self._arguments.out)
        _check_same(self._arguments, stored.facts.get("settings"))
        plain = dataclasses.replace(self.state, key=jax.random.key_data(self.state.key))
        state = jax.tree.map(jnp.asarray, stored.restore("state", plain))
        self.state = dataclasses.replace(state, key=jax.random.wrap_key_data(state.key))
        self.spent = float(stored.facts["seconds"])


def save(path: Path, weights: Any, updates: int, seed: int, env: Any, params: Any, arguments: Command) -> None:
    """Writes weights and facts, as `st.load_policy` reads them."""
    named = {name: np.asarray(leaf, np.float32) for name, leaf in flat(jax.device_get(weights)).items()}
    content = safetensors.numpy.save(dict(sorted(named.items())))
    bounds = env.action_space(params)
    layout = {
        "network": arguments.config.network,
        "action_low": [float(x) for x in bounds.low[:2]],
        "action_high": [float(x) for x in bounds.high[:2]],
    }
    facts = {
        "schema": SCHEMA,
        "name": f"locate-{arguments.config.network}",
        "kind": KIND,
        "task": env.id,
        "layout": layout,
        "tensors_sha256": hashlib.sha256(content).hexdigest(),
        TRAINED_UNDER: _conditions(env, params),
        "config": dataclasses.asdict(arguments.config),
        "seed": seed,
        "tunnels": arguments.tunnels,
        "world": {"tunnel": arguments.tunnels, "lining": None, "sensor": arguments.sensor},
        "updates": updates,
        "versions": library_versions(),
    }
    for place, data in ((path, content), (facts_file(path), f"{json.dumps(facts, indent=1)}\n".encode())):
        with replace_file(place) as fresh:
            fresh.write_bytes(data)


def _conditions(env: Any, params: Any) -> dict[str, Any]:
    """Returns the conditions of the training; a localiser reads ranges and numbers by name, among whatever fields."""
    return dataclasses.replace(training_conditions(env, params), fields=None).to_json()


def _identity(arguments: Command) -> dict[str, Any]:
    """Returns the settings that a run must keep when it goes on; the time may be another."""
    config = dataclasses.asdict(arguments.config)
    config.pop("minutes")
    plain = {
        "task": arguments.task,
        "sensor": arguments.sensor,
        "tunnels": arguments.tunnels,
        "seeds": list(arguments.seeds),
        **config,
    }
    return json.loads(json.dumps(plain))


def _check_same(arguments: Command, was: dict[str, Any] | None) -> None:
    other = [name for name, value in _identity(arguments).items() if was is None or was.get(name) != value]
    if other:
        raise ConfigError(f"{arguments.out}: was begun with another {other[0]}; train into another folder")


def check_folder(arguments: Command) -> None:
    """Refuses a folder that holds a run, unless it is to be gone on with as what it was, or thrown away."""
    require_folder(arguments.out)
    place = arguments.out / CONFIG
    if arguments.resume:
        if has_checkpoint(arguments.out):
            return  # the checkpoint itself says what it is of
        if place.exists():
            try:
                was = json.loads(place.read_text())["settings"]
            except (OSError, ValueError, KeyError, TypeError) as error:
                raise ConfigError(f"{place}: cannot be read; --overwrite begins anew") from error
            _check_same(arguments, was)
        print(f"{arguments.out}: no checkpoint yet; begins at the beginning", file=sys.stderr)
    elif not arguments.overwrite and (has_checkpoint(arguments.out) or place.exists()):
        raise RunFolderError(f"{arguments.out}: holds a run already; --resume goes on with it, --overwrite replaces it")


def _clear(out: Path) -> None:
    """Throws away what a folder holds of another run; the checkpoints first, which a later `--resume` believes."""
    remove_folder(out / FOLDER)
    for folder in out.glob("seed-*"):
        for place in (folder / POLICY, facts_file(folder / POLICY), folder / LOG, folder / CURVE, folder / SCORES):
            place.unlink(missing_ok=True)
        shutil.rmtree(folder / TENSORBOARD, ignore_errors=True)


def _write_config(arguments: Command) -> None:
    arguments.out.mkdir(parents=True, exist_ok=True)
    facts = {
        "schema": "subterra.locate/1",
        "command": settings_of(arguments),
        "settings": _identity(arguments),
        "versions": library_versions(),
    }
    with replace_file(arguments.out / CONFIG) as fresh:
        fresh.write_text(json.dumps(facts, indent=1) + "\n")


def _append(path: Path, row: dict[str, Any]) -> None:
    with path.open("a") as log:
        log.write(json.dumps(row) + "\n")


def _forget(folder: Path, seconds: float) -> None:
    """Leaves out the lines of a log after the checkpoint that is gone on from."""
    for name in (LOG, CURVE):
        if (path := folder / name).exists():
            # A line without its end is one that a kill cut off.
            lines = [line for line in path.read_text().splitlines(keepends=True) if line.endswith("\n")]
            with replace_file(path) as fresh:
                fresh.write_text("".join(line for line in lines if json.loads(line)["seconds"] <= round(seconds, 2)))
